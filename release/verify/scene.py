"""Compare the pictures of a track with each other by reprojection (cosfly/geometry/reprojection.py): depth, poses and
cameras of neighbouring frames show one world. Colours are not compared: weather, light and renderers change them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosfly.formats.frames import PERSON_ID, SHARED_ID, SKY_DEPTH_M, FrameFile, depth_values
from cosfly.formats.kinds import KINDS
from cosfly.formats.people import Goal, People
from cosfly.geometry.axes import BODY_FROM_CAMERA
from cosfly.geometry.goals import SeenFrame, meant, target_picture, words_of
from cosfly.geometry.reprojection import LEAST_SEEN, Agreement, View, compare_views
from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import InputError
from cosfly.runtime.png import colours_of
from cosfly.runtime.worker import advance
from release.columns import PICTURES, TARGET_PICTURE
from release.reading import Pictures, TrackRows
from release.verify.findings import Findings

PERSON, SKY, MOST_KIND = KINDS["Pedestrians"], KINDS["Sky"], max(KINDS.values())
NUM_IDS = 65536  # of instances
GRID = 64  # rows and columns of points at which kinds and depths are compared
SAME_LEVELS = 3.0  # of 255, in the mean: libraries enlarge pictures differently
LEAST_AGREE = 100  # points, for a share to mean something
NEAR_FRAMES = 2  # farther apart, more is hidden behind other things
GONE_MOST = 0.02  # points before what the other frame draws: honest 0.001
ERROR_MOST = 2e-4  # of planes; honest below 1e-5
SAME_LEAST = 0.95  # of the instances, of ground the kinds; honest 0.985
# Of the medians of a track: ground and what stands on it. Honest 7e-7 and 4e-7; depth that is 0.3 m off 8e-5 and more
# of ground; depth that is scaled by 2 % 1.8e-4 and more of what stands; pixels on a round tower 1e-4 at most.
FLAT_MOST, STANDING_MOST = 2e-5, 1e-4
LEAST_FRAMES = 5  # for a median
# UnrealCV sends depth in half precision. Two half-precision numbers differ by 2 ** -11 of the greater one or more; the
# conversion to metres in single precision changes that by 2 ** -23 at most. Rounding changes a depth by 2 ** -11 at
# most, half of the greatest difference of neighbouring numbers, and a pair of frames compares two rounded depths.
HALF_STEP = 2.0**-11
SAME_STEP = 0.99 * HALF_STEP
LEAST_DEPTHS = 100  # different ones in a picture, for their distances to mean something


class Decoded(NamedTuple):
    """The pictures of a frame; empty, (0, 0) and (0, 0, 3), if the release has none."""

    depth: np.ndarray  # (h, w) float32, m
    instance: np.ndarray  # (h, w, 3) uint8: kind, low and high byte of the id


def decode(track: TrackRows, i: int, files: Pictures, findings: Findings) -> Decoded | None:
    """Unpack the pictures of a row; None, with findings, if one is not a whole picture of the row's size."""
    width, height = (int(n) for n in track.size_px[i])
    decoded: dict[FrameFile, np.ndarray] = {}
    for file, data in files.items():
        where = track.where(i, PICTURES[file].name)
        try:
            if not data:
                raise InputError("there is no picture", got="null" if data is None else "0 bytes")
            pixels = depth_values(memoryview(data), Path(where)) if file == "depth" else colours_of(data, where)
            if pixels.shape[1::-1] != (width, height):
                raise InputError("the picture has another size", got=f"{pixels.shape[1]} x {pixels.shape[0]} px")
            decoded[file] = pixels
        except InputError as error:
            findings.error("picture", where, f"{error.what}: {error.got}", f"a {file} picture of {width} x {height} px")
    if len(decoded) < len(files):
        return None
    depth = decoded.get("depth", np.empty((0, 0), np.float32))
    depth.flags.writeable = False  # the compiled checks are compiled for such, once
    return Decoded(depth, decoded.get("instance", np.empty((0, 0, 3), np.uint8)))


# --- one frame --------------------------------------------------------------------------------------------------------


def check_picture(track: TrackRows, i: int, decoded: Decoded, findings: Findings) -> bool:
    """Check depth and mask of a row with each other and with the row; return whether the depth can be used."""
    depth = decoded.depth
    is_usable = True
    if depth.size:
        low_m, high_m = float(depth.min()), float(depth.max())
        is_usable = 0.0 <= low_m < high_m < np.inf  # NaN is not
        if not is_usable:
            got, expected = f"{low_m:.3f} to {high_m:.3f} m", f"a range within 0 to {SKY_DEPTH_M:g} m"
            findings.error("depth_range", track.where(i, "depth"), got, expected)
    if decoded.instance.size and not track.is_foreign:
        _check_instance(track, i, decoded, findings)
    return is_usable


def _check_instance(track: TrackRows, i: int, decoded: Decoded, findings: Findings) -> None:
    """Check the mask: the person where the row has it, kinds that exist, sky where the depth is the sky's."""
    depth = decoded.depth
    where, recorded = track.where(i, "instance"), track.mask_box[i].tolist()
    counts, edges = survey(depth, np.ascontiguousarray(decoded.instance))
    num_odd_sky, num_person, num_odd_person, most_kind = counts.tolist()
    box = edges.astype(float).tolist() if num_person else [np.nan] * 4
    if not np.array_equal(box, recorded, equal_nan=True):
        got = f"{num_person} pixels of the person in {box}"
        findings.error("mask", where, got, f"{recorded}, the target_mask_bbox")
    if num_odd_person:
        findings.error("mask", where, f"{num_odd_person} pixels of the target with another kind", f"kind {PERSON}")
    if most_kind > MOST_KIND:
        findings.error("mask", where, f"kind {most_kind}", f"kinds of 0 to {MOST_KIND}")
    if depth.size and num_odd_sky:
        got = f"{num_odd_sky:,} pixels are sky in only one of instance and depth"
        findings.error("sky", where, got, "the same sky in both")


@njit(cache=True, nogil=True)
def survey(depth, instance):  # type: ignore[no-untyped-def]
    """Count pixels of a frame, with depth (h, w), or (0, 0) without one, and instance (h, w, 3).

    Returns:
        Four counts (4,): pixels that are sky by only one of depth and kind; pixels of the target; those of them with
        another kind than a person's; and the greatest kind. The box of the target (4,): left, top, right, bottom, px.
    """
    num_odd_sky, num_person, num_odd_person, most_kind = 0, 0, 0, 0
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    for y in range(len(instance)):
        for x in range(instance.shape[1]):
            kind = instance[y, x, 0]
            most_kind = max(most_kind, kind)
            if len(depth) > 0:
                num_odd_sky += (kind == SKY) != (depth[y, x] == SKY_DEPTH_M)
            if instance[y, x, 1] == 255 and instance[y, x, 2] == 255:
                num_person += 1
                num_odd_person += kind != PERSON
                box[0], box[1] = min(box[0], x), min(box[1], y)
                box[2], box[3] = max(box[2], x + 1), max(box[3], y + 1)
    return np.array([num_odd_sky, num_person, num_odd_person, most_kind], np.int64), box


def check_goal(track: TrackRows, i: int, decoded: Decoded, rgb: bytes | memoryview | None, findings: Findings) -> None:
    """Check the goal, if a row is the one that it describes."""
    goal, people = track.goal, track.people
    if goal is None or goal.frame != track.index[i] or not decoded.instance.size:
        return
    if people is None:
        findings.error("goal", track.where(i, "people"), "null", "the appearance of the people in the frame")
        return
    _check_words(track, i, goal, people, decoded, findings)
    target_cell = track.rows[i].get(TARGET_PICTURE)
    if target_cell and rgb:
        _check_target_picture(track, i, target_cell["bytes"], rgb, findings)


def _check_words(track: TrackRows, i: int, goal: Goal, people: People, decoded: Decoded, findings: Findings) -> None:
    """Check that the texts of a goal are those of its terms, and that these are true of the target only."""
    texts, expected = {"en": goal.en, "zh": goal.zh}, words_of(goal.says, people.target)
    if texts != expected:
        findings.error("goal", track.where(i, "goal_en"), str(texts), f"{expected}, from goal_says and people")
    kind, low, high = np.moveaxis(decoded.instance, 2, 0)
    ids = low | high.astype(np.uint16) << 8
    looks = {PERSON_ID: people.target, **people.others}
    if unknown := sorted({*np.unique(ids[kind == PERSON]).tolist()} - {*looks}):
        got = f"no entry for the visible people {unknown[:4]}"
        findings.error("goal", track.where(i, "people"), got, "an entry for each visible person, by instance id")
    if decoded.depth.size or not {*goal.says} & {"near", "far"}:
        described = meant(goal.says, people.target, looks, SeenFrame(ids, decoded.depth))
        if described != {PERSON_ID}:
            got = f"true of {', '.join(map(str, sorted(described))) or 'nobody'}"
            findings.error("goal", track.where(i, "goal_says"), got, f"true of the target, {PERSON_ID}, only")


def _check_target_picture(track: TrackRows, i: int, data: bytes, rgb: bytes | memoryview, findings: Findings) -> None:
    """Check that the picture of the target is the part of the frame's picture around it."""
    where = track.where(i, TARGET_PICTURE)
    try:
        pixels, of_frame = colours_of(data, where), colours_of(rgb, where)
    except InputError as error:
        findings.error("goal", where, f"{error.what}: {error.got}", "a picture")
        return
    expected = target_picture(of_frame, track.mask_box[i].tolist()).astype(float)
    if pixels.shape != expected.shape or np.abs(pixels - expected).mean() > SAME_LEVELS:
        findings.error("goal", where, "a different picture", "the part of image around target_mask_bbox")


# --- a track ----------------------------------------------------------------------------------------------------------


class FramePair(NamedTuple):
    """Two neighbouring frames of a track."""

    row: int  # of the later one
    gap: int  # frames between their indices
    agreement: Agreement


def check_pictures(track: TrackRows, pictures: Iterator[Pictures], findings: Findings) -> None:
    """Check all pictures of a track, one after the other; memory holds two frames."""
    pairs: list[FramePair] = []
    kinds = np.full(NUM_IDS, -1, np.int64)  # of the instances that were seen
    steps: list[float] = []
    previous: tuple[int, View] | None = None  # the row before, if it can be compared
    for i, files in enumerate(pictures):
        advance()
        decoded = decode(track, i, files, findings)
        if decoded is None or not check_picture(track, i, decoded, findings):
            previous = None
            continue
        if decoded.instance.size and not track.is_foreign:
            _check_kinds(track, i, decoded.instance, kinds, findings)
        check_goal(track, i, decoded, files.get("rgb"), findings)
        rotation = np.ascontiguousarray(track.rotations[i] @ BODY_FROM_CAMERA)
        view = View(decoded.depth, decoded.instance, rotation, track.pose[i, :3].copy())
        if decoded.depth.size and previous is not None:
            k, view_before = previous
            agreement = compare_views(view_before, view, track.intrinsics[k], track.intrinsics[i])
            pairs.append(FramePair(i, int(track.index[i] - track.index[k]), agreement))
        if decoded.depth.size:
            steps += _step_of(decoded.depth)
        previous = (i, view)
    if pairs and not track.is_foreign:  # depth of others may be rough
        is_half_precision = min(steps, default=0.0) >= SAME_STEP
        _judge_pairs(track, pairs, 2 * HALF_STEP if is_half_precision else 0.0, findings)


def _on_grid(picture: np.ndarray) -> np.ndarray:
    """Return the values of a picture at GRID x GRID points."""
    rows, columns = (np.linspace(0, size - 1, GRID).astype(int) for size in picture.shape[:2])
    return picture[np.ix_(rows, columns)]


def _step_of(depth: np.ndarray) -> list[float]:
    """Return the least difference of two depths at a grid of points, as a share; an empty list if few differ."""
    depths = np.unique(_on_grid(depth)).astype(np.float64)
    depths = depths[(depths > 0.0) & (depths < SKY_DEPTH_M)]
    return [float((np.diff(depths) / depths[1:]).min())] if len(depths) >= LEAST_DEPTHS else []


def _check_kinds(track: TrackRows, i: int, instance: np.ndarray, kinds: np.ndarray, findings: Findings) -> None:
    """Check at a grid of points that an instance has one kind in all frames; `kinds`, (NUM_IDS,), has those that were
    seen, otherwise -1, and gets the new ones."""
    kind, low, high = np.moveaxis(_on_grid(instance).astype(np.int64), 2, 0)
    ids = low | high << 8
    is_new = (ids != 0) & (ids != SHARED_ID) & (kinds[ids] != kind)
    for instance_id, new_kind in np.unique(np.stack([ids, kind], axis=-1)[is_new], axis=0):
        if kinds[instance_id] >= 0:
            got = f"instance {instance_id} of kind {new_kind}"
            expected = f"kind {kinds[instance_id]}, as in the frames before"
            findings.error("instance_kind", track.where(i, "instance"), got, expected)
        kinds[instance_id] = new_kind


def _judge_pairs(track: TrackRows, pairs: list[FramePair], rounding: float, findings: Findings) -> None:
    """Report depth that is scaled or shifted, whose planes move with the camera, and pairs of frames that do not show
    one world. rounding: error of two rounded depths, as a share."""
    for what, most, errors in (
        ("ground", FLAT_MOST + rounding, [pair.agreement.error_flat for pair in pairs]),
        ("objects on it", STANDING_MOST + rounding, [pair.agreement.error_off_flat for pair in pairs]),
    ):
        known = [error for error in errors if np.isfinite(error)]
        if len(known) >= LEAST_FRAMES and (error := float(np.median(known))) > most:
            got = f"an error of {error:.4%} in the planes of {what} between frames"
            expected = f"at most {most:.4%}, for depth in metres along the optical axis"
            findings.error("scene_depth", track.name, got, expected)
    for pair in pairs:
        if pair.agreement.seen >= LEAST_SEEN:
            _judge_pair(track, pair, ERROR_MOST + rounding, findings)


def _judge_pair(track: TrackRows, pair: FramePair, error_most: float, findings: Findings) -> None:
    """Report two frames whose depths, or else whose instances, do not show one world."""
    seen, where = pair.agreement, track.where(pair.row)
    has_gone = pair.gap <= NEAR_FRAMES and seen.missing_share > GONE_MOST
    if seen.error > error_most or has_gone:
        error = f", and an error of {seen.error:.2%} in planes" if np.isfinite(seen.error) else ""
        points = "of the points in front of the surfaces of this or the previous frame"
        agree = "for depth, pose and camera that agree with the previous frame"
        expected = f"at most {GONE_MOST:.1%}, and an error of at most {error_most:.2%}, {agree}"
        findings.error("scene_depth", where, f"{seen.missing_share:.1%} {points}{error}", expected)
    elif seen.agree >= LEAST_AGREE and seen.same < SAME_LEAST * seen.agree:
        got = f"{seen.same / seen.agree:.1%} of the points with the instance id of the previous frame"
        findings.error("scene_instance", where, got, f"at least {SAME_LEAST:.0%} of the points with the same depth")
