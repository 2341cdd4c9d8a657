"""The goal of a flight against the picture that it is of: whom do its words mean there, and what does it show?"""

from __future__ import annotations

import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.frames import PERSON_ID
from cosfly.products.goals import LANDMARKS, SeenFrame, meant, target_picture, words_of
from cosfly.products.kinds import KINDS
from cosfly.products.png import colours_of
from release.columns import TARGET_PICTURE, matrices_of
from release.flight_rows import FlightRows
from release.verify.findings import Findings

SAME_LEVELS = 3.0  # of 255, in the mean: libraries enlarge differently


def check_goal(
    flight: FlightRows, i: int, decoded: tuple[np.ndarray, np.ndarray], rgb: bytes | memoryview | None, found: Findings
) -> None:
    """Check the goal in the row that it is of. decoded: depth and instance, empty where there is none."""
    depth, instance = decoded
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
            pixels, of_frame = (colours_of(data, where) for data in (shown["bytes"], rgb))
        except InputError as error:
            found.error("goal", where, f"{error.what}: {error.got}", "a picture")
            return
        expected = target_picture(of_frame, flight.mask_box[i].tolist()).astype(float)
        if pixels.shape != expected.shape or np.abs(pixels - expected).mean() > SAME_LEVELS:
            found.error("goal", where, "another picture", "target_mask_bbox of image, with room around")


def _picture(flight: FlightRows, i: int, decoded: tuple[np.ndarray, np.ndarray]) -> SeenFrame:
    depth, instance = decoded
    matrix, rotation = matrices_of(flight.intrinsics[i : i + 1])[0], flight.rotations[i] @ BODY_FROM_CAMERA
    ids = instance[..., 1] | instance[..., 2].astype(np.uint16) << 8
    return SeenFrame(instance[..., 0], ids, depth, matrix, rotation)
