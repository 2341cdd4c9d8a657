"""Compare the pictures of a flight with each other by reprojection (cosfly/space/reprojection.py): depth, poses and
cameras of neighbouring frames show one world. Colours are not compared: weather, light and renderers change them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.frames import PERSON_ID
from cosfly.products.goals import LANDMARKS, SeenFrame, meant, target_picture, words_of
from cosfly.products.kinds import KINDS
from cosfly.products.png import colours_of
from cosfly.space.reprojection import LEAST_SEEN, Agreement, View, compare_views
from cosfly.work.items import advance
from release.columns import TARGET_PICTURE, matrices_of
from release.flight_rows import FlightRows
from release.verify.findings import Findings
from release.verify.pictures import NUM_IDS, check_picture, decode, new_kinds
from release.verify.sources import Pictures

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


LEAST_AGREE = 100  # points, for a share to mean something
NEAR_FRAMES = 2  # farther apart, more is hidden behind other things
GONE_MOST = 0.02  # points before what the other frame draws: honest 0.001
ERROR_MOST = 2e-4  # of planes; honest below 1e-5
SAME_LEAST = 0.95  # of the instances, of ground the kinds; honest 0.985
# Of the medians of a flight: ground and what stands on it. Honest 7e-7 and 4e-7; depth that is 0.3 m off 8e-5 and more
# of ground; depth that is scaled by 2 % 1.8e-4 and more of what stands; pixels on a round tower 1e-4 at most.
FLAT_MOST, STANDING_MOST = 2e-5, 1e-4
LEAST_FRAMES = 5  # for a median
Pair = tuple[int, int, Agreement]  # of neighbouring frames: row of the later one, frames between them


def check_pictures(flight: FlightRows, pictures: Iterator[Pictures], findings: Findings) -> None:
    """Check all pictures of a flight, one after the other; memory holds two frames."""
    pairs, kinds = list[Pair](), np.full(NUM_IDS, -1, np.int16)
    before: tuple[int, View] | None = None
    for i, files in enumerate(pictures):
        advance()
        decoded = decode(flight, i, files, findings)
        if decoded is None or not check_picture(flight, i, decoded, findings):
            before = None
            continue
        if decoded[1].size and not flight.is_foreign:
            _check_kinds(flight, i, decoded[1], kinds, findings)
        check_goal(flight, i, decoded, files.get("rgb"), findings)
        rotation = np.ascontiguousarray(flight.rotations[i] @ BODY_FROM_CAMERA)
        view = View(*decoded, rotation, flight.pose[i, :3].copy())
        if decoded[0].size and before is not None:
            k, previous = before
            agreement = compare_views(previous, view, flight.intrinsics[k], flight.intrinsics[i])
            pairs.append((i, int(flight.index[i] - flight.index[k]), agreement))
        before = (i, view)
    if pairs and not flight.is_foreign:  # depth of others may be rough
        _judge_pairs(flight, pairs, findings)


def _check_kinds(flight: FlightRows, i: int, instance: np.ndarray, kinds: np.ndarray, findings: Findings) -> None:
    """Check that an instance is of one kind in all frames. kinds: (NUM_IDS,) as in the frames before; what is new is
    added."""
    for code in new_kinds(instance, kinds):
        own, kind = code >> 8, code & 255
        if kinds[own] >= 0:
            got = f"instance {own} of kind {kind}"
            findings.error("instance_kind", flight.where(i, "instance"), got, f"kind {kinds[own]}, as before")
        else:
            kinds[own] = kind


def _judge_scale(flight: FlightRows, pairs: list[Pair], findings: Findings) -> None:
    """Find depth that is scaled or set off: its planes move with the camera."""
    for what, most, errors in (
        ("ground", FLAT_MOST, [pair.error_flat for *_, pair in pairs]),
        ("what stands on it", STANDING_MOST, [pair.error_standing for *_, pair in pairs]),
    ):
        known = [error for error in errors if np.isfinite(error)]
        if len(known) >= LEAST_FRAMES and (error := float(np.median(known))) > most:
            got = f"planes of {what} that are {error:.4%} off from frame to frame"
            findings.error("scene_depth", flight.name, got, f"at most {most:.4%}: depth in metres along the axis")


def _judge_pairs(flight: FlightRows, pairs: list[Pair], findings: Findings) -> None:
    """Find the pairs of frames that do not show one world."""
    _judge_scale(flight, pairs, findings)
    for i, gap, pair in pairs:
        if pair.seen >= LEAST_SEEN and (odd := _odd_pair(pair, gap <= NEAR_FRAMES)):
            findings.error(odd[0], flight.where(i), *odd[1:])


def _odd_pair(pair: Agreement, is_near: bool) -> tuple[str, str, str] | None:
    """Give code, got and expected of two frames that do not show one world, else None."""
    if pair.error > ERROR_MOST or (is_near and pair.gone > GONE_MOST):
        off = f", planes {pair.error:.2%} off" if np.isfinite(pair.error) else ""
        got = f"{pair.gone:.1%} of the points before what this frame or the one before draws{off}"
        most = f"at most {GONE_MOST:.1%} and planes {ERROR_MOST:.2%} off"
        return "scene_depth", got, f"{most}: depth, pose and camera that agree with the frame before"
    if is_near and pair.shifted:
        got = f"a thing of {pair.shifted} points farther away than in the frame before"
        return "scene_depth", got, "what stands still at its place"
    if pair.agree >= LEAST_AGREE and pair.same < SAME_LEAST * pair.agree:
        got = f"{pair.same / pair.agree:.1%} of the instances of the frame before"
        return "scene_instance", got, f"at least {SAME_LEAST:.0%} where the depth agrees"
    if is_near and pair.agree >= LEAST_AGREE and pair.renamed:
        got = f"a thing of {pair.renamed} points under another id than in the frame before"
        return "scene_instance", got, "one id for a thing"
    return None
