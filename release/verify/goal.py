"""The goal of a flight against the picture that it is of: whom do its words mean there, and what does it show?"""

from __future__ import annotations

import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.frames import PERSON_ID
from cosfly.products.goals import LANDMARKS, SeenFrame, meant, target_picture, words_of
from cosfly.products.kinds import KINDS
from cosfly.products.people import People
from cosfly.products.png import parse_png
from release.columns import COMPANY_COLUMNS, TARGET_PICTURE, matrices_of
from release.flight_rows import FlightRows
from release.verify.findings import Findings

SAME_LEVELS = 3.0  # of 255, in the mean: libraries enlarge differently
SAME_PLACE_M = 1.0  # the pixels of somebody, limbs or what is not hidden, are so near to the middle


def check_goal(
    flight: FlightRows, i: int, decoded: tuple[np.ndarray, np.ndarray], rgb: bytes | memoryview | None, found: Findings
) -> None:
    """Check the goal in the row that it is of. decoded: depth and instance, empty where there is none."""
    depth, instance = decoded
    if flight.people is not None and instance.size and flight.rows[i].get("others_in_view") is not None:
        _check_company(flight, flight.people, i, _picture(flight, i, decoded), found)
    goal, people = flight.goal, flight.people
    if goal is None or goal.frame != flight.index[i] or not instance.size:
        return
    if people is None:
        found.error("goal", flight.where(i, "people"), "null", "what the people look like that the goal tells apart")
        return
    if (words := words_of(goal.says, people.target)) != (told := {"en": goal.en, "zh": goal.zh}):
        found.error("goal", flight.where(i, "goal_en"), str(told), f"{words}, of goal_says and people")
    picture = _picture(flight, i, decoded)
    kinds, ids = picture.kinds, picture.ids
    looks = {PERSON_ID: people.target, **people.others}
    if unknown := sorted({*np.unique(ids[kinds == KINDS["Pedestrians"]]).tolist()} - {*looks}):
        found.error("goal", flight.where(i, "people"), f"{unknown[:4]} are seen", "all who are, by instance id")
    if depth.size or not {*goal.says} & {"near", "far", *LANDMARKS}:
        whom = meant(goal.says, people.target, looks, picture)
        if whom != {PERSON_ID}:
            got = f"true of {', '.join(map(str, sorted(whom))) or 'nobody'}"
            found.error("goal", flight.where(i, "goal_says"), got, f"true of the target alone, {PERSON_ID}")
    if (shown := flight.rows[i].get(TARGET_PICTURE)) and rgb:
        where = flight.where(i, TARGET_PICTURE)
        try:
            pixels, of_frame = (parse_png(data, where).pixels()[..., :3] for data in (shown["bytes"], rgb))
        except InputError as error:
            found.error("goal", where, f"{error.what}: {error.got}", "a picture")
            return
        expected = target_picture(of_frame, flight.mask_box[i].tolist()).astype(float)
        if pixels.shape != expected.shape or np.abs(pixels - expected).mean() > SAME_LEVELS:
            found.error("goal", where, "another picture", "target_mask_bbox of image, with room around")


def _check_company(flight: FlightRows, people: People, i: int, picture: SeenFrame, findings: Findings) -> None:
    """Check what a row says of other people in view: how many, the nearest, the most alike."""
    count, away_m, nearest, *alike = (flight.rows[i].get(name) for name in COMPANY_COLUMNS)
    seen = [number for number in people.others if (picture.ids == number).any()]
    if len(seen) != count:
        findings.error("others", flight.where(i, "others_in_view"), count, f"{len(seen)}, of `people` who have a pixel")
    if tuple(alike) != (expected := people.most_alike(seen)):
        findings.error("others", flight.where(i, "alike_id"), alike, f"{expected}, of `people` who have a pixel")
    if nearest is None or away_m is None:
        is_right, got = not seen, "null"
    else:
        offset_m, got = flight.pose[i, :2] - flight.target_m[i, :2], f"{nearest}, {away_m:g} m away"
        measured_m = dict.fromkeys(seen, float(away_m))
        if picture.depth.size:
            measured_m = {number: float(np.hypot(*(picture.place_m(number)[:2] + offset_m))) for number in seen}
        least_m = min(measured_m.values(), default=0.0)
        is_right = abs(measured_m.get(nearest, np.inf) - away_m) <= SAME_PLACE_M and away_m <= least_m + SAME_PLACE_M
    if not is_right:
        who = "the nearest of `people` who have a pixel, as far as their depth says, null without any"
        findings.error("others", flight.where(i, "other_id"), got, who)


def _picture(flight: FlightRows, i: int, decoded: tuple[np.ndarray, np.ndarray]) -> SeenFrame:
    depth, instance = decoded
    matrix, rotation = matrices_of(flight.intrinsics[i : i + 1])[0], flight.rotations[i] @ BODY_FROM_CAMERA
    ids = instance[..., 1] | instance[..., 2].astype(np.uint16) << 8
    return SeenFrame(instance[..., 0], ids, depth, matrix, rotation)
