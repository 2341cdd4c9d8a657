"""Compare the pictures of a track with each other by reprojection (cosfly/geometry/reprojection.py): depth, poses and
cameras of neighbouring frames show one world. Colours are not compared: weather, light and renderers change them.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cosfly.formats.frames import PERSON_ID, SHARED_ID, SKY_DEPTH_M, FrameFile, depth_values
from cosfly.formats.kinds import KINDS
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
NOTHING = np.empty((0, 0), np.float32)
NO_IDS = np.empty((0, 0, 3), np.uint8)
NUM_IDS, GRID = 65536, 64  # instance ids; rows and columns of points at which kinds are compared
Decoded = tuple[np.ndarray, np.ndarray]  # depth, instance


def decode(track: TrackRows, i: int, files: Pictures, findings: Findings) -> Decoded | None:
    """Unpack the pictures of a row; None, with findings, where one is not a whole picture of the row's size."""
    width, height = (int(n) for n in track.size_px[i])
    found: dict[FrameFile, np.ndarray] = {}
    for file, data in files.items():
        where = track.where(i, PICTURES[file].name)
        try:
            if not data:
                raise InputError("there is no picture", got="null" if data is None else "0 bytes")
            pixels = depth_values(memoryview(data), Path(where)) if file == "depth" else colours_of(data, where)
            if pixels.shape[1::-1] != (width, height):
                raise InputError("the picture has another size", got=f"{pixels.shape[1]} x {pixels.shape[0]} px")
            found[file] = pixels
        except InputError as error:
            findings.error("picture", where, f"{error.what}: {error.got}", f"a {file} picture of {width} x {height} px")
    if len(found) < len(files):
        return None
    depth = found.get("depth", NOTHING)
    depth.flags.writeable = False  # the compiled checks are compiled for such, once
    return depth, found.get("instance", NO_IDS)


def check_picture(track: TrackRows, i: int, decoded: Decoded, findings: Findings) -> bool:
    """Check depth and mask of a row with each other and with the row; False where the depth is no depth."""
    depth, instance = decoded
    low_m, high_m = (float(depth.min()), float(depth.max())) if depth.size else (0.0, 0.0)
    good = not depth.size or 0.0 <= low_m < high_m < np.inf  # NaN is not
    if not good:
        got, expected = f"{low_m:.3f} to {high_m:.3f} m", f"a range within 0 to {SKY_DEPTH_M:g} m"
        findings.error("depth_range", track.where(i, "depth"), got, expected)
    if instance.size and not track.is_foreign:
        _check_instance(track, i, depth, instance, findings)
    return good


def _check_instance(track: TrackRows, i: int, depth: np.ndarray, instance: np.ndarray, findings: Findings) -> None:
    """Check the mask: the person where the row has it, kinds that exist, sky where the depth is the sky's."""
    where, recorded = track.where(i, "instance"), track.mask_box[i].tolist()
    counts, pixels = survey(depth, np.ascontiguousarray(instance))
    num_odd_sky, num_person, num_odd_person, most_kind = counts.tolist()
    box = pixels.astype(float).tolist() if num_person else [np.nan] * 4
    if not np.array_equal(box, recorded, equal_nan=True):
        findings.error(
            "mask", where, f"{num_person} pixels of the person in {box}", f"{recorded}, the target_mask_bbox"
        )
    if num_odd_person:
        findings.error("mask", where, f"{num_odd_person} pixels of the target with another kind", f"kind {PERSON}")
    if most_kind > MOST_KIND:
        findings.error("mask", where, f"kind {most_kind}", f"kinds of 0 to {MOST_KIND}")
    if depth.size and num_odd_sky:
        got = f"{num_odd_sky:,} pixels are sky in only one of instance and depth"
        findings.error("sky", where, got, "the same sky in both")


@njit(cache=True, nogil=True)
def survey(depth, instance):  # type: ignore[no-untyped-def]
    """Return counts (4,) and the box (4,) of the person, edges at borders, of a mask (h, w, 3) and a depth or nothing.

    Counts: pixels that are sky by one of depth and kind alone, of the person, of its id with another kind; the greatest
    kind.
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


SAME_LEVELS = 3.0  # of 255, in the mean: libraries enlarge differently


def check_goal(
    track: TrackRows, i: int, decoded: tuple[np.ndarray, np.ndarray], rgb: bytes | memoryview | None, found: Findings
) -> None:
    """Check the goal in the row that it is of. decoded: depth and instance, empty where there is none."""
    depth, instance = decoded
    goal, people = track.goal, track.people
    if goal is None or goal.frame != track.index[i] or not instance.size:
        return
    if people is None:
        found.error("goal", track.where(i, "people"), "null", "the appearance of the people in the frame")
        return
    if (words := words_of(goal.says, people.target)) != (told := {"en": goal.en, "zh": goal.zh}):
        found.error("goal", track.where(i, "goal_en"), str(told), f"{words}, from goal_says and people")
    ids = instance[..., 1] | instance[..., 2].astype(np.uint16) << 8
    looks = {PERSON_ID: people.target, **people.others}
    if unknown := sorted({*np.unique(ids[instance[..., 0] == KINDS["Pedestrians"]]).tolist()} - {*looks}):
        got = f"no entry for the visible people {unknown[:4]}"
        found.error("goal", track.where(i, "people"), got, "an entry for each visible person, by instance id")
    if depth.size or not {*goal.says} & {"near", "far"}:
        whom = meant(goal.says, people.target, looks, SeenFrame(ids, depth))
        if whom != {PERSON_ID}:
            got = f"true of {', '.join(map(str, sorted(whom))) or 'nobody'}"
            found.error("goal", track.where(i, "goal_says"), got, f"true of the target, {PERSON_ID}, only")
    if (shown := track.rows[i].get(TARGET_PICTURE)) and rgb:
        where = track.where(i, TARGET_PICTURE)
        try:
            pixels, of_frame = (colours_of(data, where) for data in (shown["bytes"], rgb))
        except InputError as error:
            found.error("goal", where, f"{error.what}: {error.got}", "a picture")
            return
        expected = target_picture(of_frame, track.mask_box[i].tolist()).astype(float)
        if pixels.shape != expected.shape or np.abs(pixels - expected).mean() > SAME_LEVELS:
            found.error("goal", where, "a different picture", "the part of image around target_mask_bbox")


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
Pair = tuple[int, int, Agreement]  # of neighbouring frames: row of the later one, frames between them


def check_pictures(track: TrackRows, pictures: Iterator[Pictures], findings: Findings) -> None:
    """Check all pictures of a track, one after the other; memory holds two frames."""
    pairs, kinds, steps = list[Pair](), np.full(NUM_IDS, -1, np.int64), list[float]()
    before: tuple[int, View] | None = None
    for i, files in enumerate(pictures):
        advance()
        decoded = decode(track, i, files, findings)
        if decoded is None or not check_picture(track, i, decoded, findings):
            before = None
            continue
        if decoded[1].size and not track.is_foreign:
            _check_kinds(track, i, decoded[1], kinds, findings)
        check_goal(track, i, decoded, files.get("rgb"), findings)
        rotation = np.ascontiguousarray(track.rotations[i] @ BODY_FROM_CAMERA)
        view = View(*decoded, rotation, track.pose[i, :3].copy())
        if decoded[0].size and before is not None:
            k, previous = before
            agreement = compare_views(previous, view, track.intrinsics[k], track.intrinsics[i])
            pairs.append((i, int(track.index[i] - track.index[k]), agreement))
        if decoded[0].size:
            steps += _step_of(decoded[0])
        before = (i, view)
    if pairs and not track.is_foreign:  # depth of others may be rough
        is_half = min(steps, default=0.0) >= SAME_STEP
        _judge_pairs(track, pairs, 2 * HALF_STEP if is_half else 0.0, findings)


def _on_grid(picture: np.ndarray) -> np.ndarray:
    """Return the values of a picture at GRID x GRID points."""
    return picture[np.ix_(*(np.linspace(0, size - 1, GRID).astype(int) for size in picture.shape[:2]))]


def _step_of(depth: np.ndarray) -> list[float]:
    """Return the least distance of two depths at a grid of points, as a share; nothing where few differ."""
    depths = np.unique(_on_grid(depth)).astype(np.float64)
    depths = depths[(depths > 0.0) & (depths < SKY_DEPTH_M)]
    return [float((np.diff(depths) / depths[1:]).min())] if len(depths) >= LEAST_DEPTHS else []


def _check_kinds(track: TrackRows, i: int, instance: np.ndarray, kinds: np.ndarray, findings: Findings) -> None:
    """Check at a grid of points that a thing has one kind in all frames. kinds: (NUM_IDS,), -1: not seen yet."""
    kind, low, high = np.moveaxis(_on_grid(instance).astype(np.int64), 2, 0)
    ids = low | high << 8
    is_new = (ids != 0) & (ids != SHARED_ID) & (kinds[ids] != kind)
    for own, found in np.unique(np.stack([ids, kind], axis=-1)[is_new], axis=0):
        if kinds[own] >= 0:
            got, expected = f"instance {own} of kind {found}", f"kind {kinds[own]}, as in the frames before"
            findings.error("instance_kind", track.where(i, "instance"), got, expected)
        kinds[own] = found


def _judge_pairs(track: TrackRows, pairs: list[Pair], rounding: float, findings: Findings) -> None:
    """Find depth that is scaled or shifted, whose planes move with the camera, and pairs that do not show one world.
    rounding: Of two depths, as a share."""
    for what, most, errors in (
        ("ground", FLAT_MOST + rounding, [pair.error_flat for *_, pair in pairs]),
        ("objects on it", STANDING_MOST + rounding, [pair.error_off_flat for *_, pair in pairs]),
    ):
        known = [error for error in errors if np.isfinite(error)]
        if len(known) >= LEAST_FRAMES and (error := float(np.median(known))) > most:
            got = f"an error of {error:.4%} in the planes of {what} between frames"
            expected = f"at most {most:.4%}, for depth in metres along the optical axis"
            findings.error("scene_depth", track.name, got, expected)
    for i, gap, pair in pairs:
        if pair.seen >= LEAST_SEEN and (odd := _odd_pair(pair, gap <= NEAR_FRAMES, ERROR_MOST + rounding)):
            findings.error(odd[0], track.where(i), *odd[1:])


def _odd_pair(pair: Agreement, is_near: bool, error_most: float) -> tuple[str, str, str] | None:
    """Return code, got and expected of two frames that do not show one world, else None."""
    is_known, off = pair.agree >= LEAST_AGREE, ""
    if np.isfinite(pair.error):
        off = f", and an error of {pair.error:.2%} in planes"
    rules = (
        (pair.error > error_most or (is_near and pair.missing_share > GONE_MOST), "scene_depth",
         f"{pair.missing_share:.1%} of the points in front of the surfaces of this or the previous frame{off}",
         f"at most {GONE_MOST:.1%}, and an error of at most {error_most:.2%}, for depth, pose and camera that agree "
         "with the previous frame"),
        (is_known and pair.same < SAME_LEAST * pair.agree, "scene_instance",
         f"{pair.same / max(1, pair.agree):.1%} of the points with the instance id of the previous frame",
         f"at least {SAME_LEAST:.0%} of the points with the same depth"),
    )  # fmt: skip
    return next(((code, got, expected) for is_odd, code, got, expected in rules if is_odd), None)
