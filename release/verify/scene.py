"""The pictures of a flight against each other and against the ground: one world, seen through the poses and cameras of
the rows.

What stands still is carried from frame to frame by depth, pose and camera (cosfly/space/reprojection.py), so that
exchanged pictures, poses and cameras come to light: each of them may be right alone. The ground that is drawn beside
the person's feet is where the row has the feet, which a depth that is scaled or set off is not. Colours say nothing
here: weather, light, zoom and renderers change them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from cosfly.space.reprojection import LEAST_SEEN, Agreement, View, compare_views
from cosfly.work.items import advance
from release.flight_rows import FlightRows
from release.record import DepthCoding, DepthCodingName
from release.verify.findings import Findings
from release.verify.goal import check_goal
from release.verify.pictures import NUM_IDS, check_picture, decode, ground_beside, least_step, new_kinds, view_of
from release.verify.sources import Pictures

KEPT_GROUNDS = 200  # frames of a flight
LEAST_AGREE = 100  # points, for a share to mean something
NEAR_FRAMES = 2  # farther apart, more is hidden behind other things
GONE_MOST = 0.02  # points before what the other frame draws: honest 0.001
ERROR_MOST = {"float32": 2e-4, "float16": 2e-3, "millimetre_png": 2e-3}  # of planes; honest below 1e-5 as float32
SAME_LEAST = 0.95  # of the instances, of ground the kinds; honest 0.985
# Between the two nearest depths of a frame's sample: honest 4e-6 m; of so many frames of a flight the least counts.
STEP_MOST_M, STEPS_LOOKED_AT = 2e-4, 8
# Flights of others: depth may be rough, but it is equally rough in all frames.
ROUGH_ERROR, ROUGH_AGREE, TIMES_ROUGH = 1e-3, 0.8, 20.0
# Of the medians of a flight, as float32: ground and what stands on it. Honest 7e-7 and 4e-7; depth that is 0.3 m off
# 8e-5 and more of ground, depth that is scaled by 2 % 1.8e-4 and more of what stands. What is round is no plane: of
# pixels of a metre on a tower 1e-4 at most.
FLAT_MOST, STANDING_MOST = 2e-5, 1e-4
# Of ground beside the feet, in the median of so many frames: rounding of depth at some 40 m.
GROUND_MOST_M, LEAST_FRAMES = {"float32": 0.02, "float16": 0.05, "millimetre_png": 0.02}, 5


@dataclass(frozen=True)
class PictureKeys:
    """What is kept of a flight's pictures to compare it with others. pictures: of each row a number that tells its
    colour picture from others, and one for its depth; 0 where it has none. kinds: id * 256 + kind of what is seen.
    grounds_m: of frames, by their index, how high the ground lies over the feet of a person who walks where the plan
    says."""

    pictures: list[tuple[int, int]] = field(default_factory=list)
    kinds: list[int] = field(default_factory=list)
    grounds_m: list[tuple[int, float]] = field(default_factory=list)


Pair = tuple[int, int, Agreement]  # of neighbouring frames: row of the later one, frames between them


def check_pictures(
    flight: FlightRows,
    pictures: Iterator[Pictures],
    coding: DepthCoding,
    rounded_as: DepthCodingName,
    findings: Findings,
) -> PictureKeys:
    """Check all pictures of a flight, one after the other; memory holds two frames.

    Args:
        coding: of the depth. rounded_as: the coding whose errors it has.
    """
    keys, pairs = list[tuple[int, int]](), list[Pair]()
    kinds, grounds_m = np.full(NUM_IDS, -1, np.int16), np.full(len(flight), np.nan)
    steps: list[float] = []  # of some frames' depth
    before: tuple[int, View] | None = None
    for i, files in enumerate(pictures):
        advance()
        decoded = decode(flight, i, files, coding, findings)
        keys.append(_keys(files, decoded is not None))
        if decoded is None or not check_picture(flight, i, decoded, findings):
            before = None
            continue
        depth, instance = decoded
        check_goal(flight, i, decoded, files.get("rgb"), findings)
        if instance.size and not flight.is_foreign:
            _check_kinds(flight, i, instance, kinds, findings)
        if rounded_as == "float32" and i % max(1, len(flight) // STEPS_LOOKED_AT) == 0:
            steps.append(least_step(depth))
        if depth.size and instance.size:
            grounds_m[i] = ground_beside(flight, i, depth, instance)
        view = view_of(flight, i, decoded)
        if depth.size and before is not None:
            k, previous = before
            agreement = compare_views(previous, view, flight.intrinsics[k], flight.intrinsics[i])
            pairs.append((i, int(flight.index[i] - flight.index[k]), agreement))
        before = (i, view)
    if pairs:
        _judge_pairs(flight, pairs, rounded_as, findings)
    if flight.is_foreign:
        return PictureKeys(keys)
    _judge_ground(flight, grounds_m, rounded_as, findings)
    if (least := min((step for step in steps if np.isfinite(step)), default=0.0)) > STEP_MOST_M:
        expected = "float32 as it was drawn, as the record says: depths that differ by millionths"
        findings.error("depth_coding", flight.name, f"depths that are {least:.4f} m apart or equal", expected)
    ids = np.flatnonzero(kinds >= 0)
    planned = np.flatnonzero(np.isfinite(grounds_m) & ~(flight.target_offset != 0.0).any(axis=1))[:KEPT_GROUNDS]
    grounds = [(int(flight.index[i]), float(grounds_m[i])) for i in planned]
    return PictureKeys(keys, (ids << 8 | kinds[ids]).tolist(), grounds)


def _keys(files: Pictures, is_whole: bool) -> tuple[int, int]:
    """Numbers that are the same for the same pictures: the checksums of a PNG's pixels, and a digest of the depth's
    samples."""
    colour, depth = files.get("rgb") or b"", files.get("depth") or b""
    # The last bytes before the IEND chunk (12): the stream's own checksum and that of its chunk (4 each).
    checksum = int.from_bytes(colour[-20:-12], "big")
    samples = np.frombuffer(depth, np.uint8)[:: max(1, len(depth) // 8192)].tobytes() if is_whole else b""
    return checksum, int.from_bytes(hashlib.blake2b(samples, digest_size=8).digest(), "big") if samples else 0


def _check_kinds(flight: FlightRows, i: int, instance: np.ndarray, kinds: np.ndarray, findings: Findings) -> None:
    """An instance is of one kind in all frames. kinds: (NUM_IDS,) as in the frames before, -1: not seen; what is new is
    added."""
    for code in new_kinds(instance, kinds):
        own, kind = code >> 8, code & 255
        if kinds[own] < 0:
            kinds[own] = kind
        elif kinds[own] != kind:
            got, expected = f"instance {own} of kind {kind}", f"kind {kinds[own]}, as before"
            findings.error("instance_kind", flight.where(i, "instance"), got, expected)


def _judge_ground(flight: FlightRows, heights_m: np.ndarray, rounded_as: DepthCodingName, findings: Findings) -> None:
    """Who was moved to a place of another height was stood on the ground there. heights_m: of it over the feet, (n,),
    NaN: it is not seen."""
    known = heights_m[np.isfinite(heights_m) & (flight.target_offset[:, 2] != 0.0)]
    most_m = GROUND_MOST_M[rounded_as]
    if len(known) >= LEAST_FRAMES and abs(off_m := float(np.median(known))) > most_m:
        got = f"ground {abs(off_m):.2f} m {'above' if off_m > 0 else 'below'} the person's feet"
        findings.error("ground", flight.name, got, f"at most {most_m:g} m: depth in metres, as pose and camera say")


def _judge_scale(flight: FlightRows, pairs: list[Pair], findings: Findings) -> None:
    """Planes keep their place through all frames to the rounding of float32; those of a depth that is scaled or set off
    move with the camera."""
    for what, most, errors in (
        ("ground", FLAT_MOST, [pair.error_flat for *_, pair in pairs]),
        ("what stands on it", STANDING_MOST, [pair.error_standing for *_, pair in pairs]),
    ):
        known = [error for error in errors if np.isfinite(error)]
        if len(known) >= LEAST_FRAMES and (error := float(np.median(known))) > most:
            got = f"planes of {what} that are {error:.4%} off from frame to frame"
            findings.error("scene_depth", flight.name, got, f"at most {most:.4%}: depth in metres along the axis")


def _judge_pairs(flight: FlightRows, pairs: list[Pair], rounded_as: DepthCodingName, findings: Findings) -> None:
    """Find the pairs of frames that do not show one world."""
    errors = np.array([pair.error for *_, pair in pairs])
    limit = ERROR_MOST[rounded_as]
    if flight.is_foreign:
        usual = float(np.nanmedian(errors)) if np.isfinite(errors).any() else np.inf
        if usual > ROUGH_ERROR or np.median([pair.agree / max(pair.seen, 1) for *_, pair in pairs]) < ROUGH_AGREE:
            got = f"depth that is {usual:.1%} beside the next frame's"
            expected = "pictures of one world; of flights that cosfly drew this is an error"
            findings.note("scene_not_judged", flight.name, got, expected)
            return
        limit = max(limit, TIMES_ROUGH * usual)
    elif rounded_as == "float32":
        _judge_scale(flight, pairs, findings)
    for i, gap, pair in pairs:
        if pair.seen >= LEAST_SEEN and (odd := _odd_pair(pair, gap <= NEAR_FRAMES, flight.is_foreign, limit)):
            findings.error(odd[0], flight.where(i), *odd[1:])


def _odd_pair(pair: Agreement, is_near: bool, is_foreign: bool, limit: float) -> tuple[str, str, str] | None:
    """Give code, got and expected of two frames that do not show one world, else None. limit: of the error of
    planes."""
    if pair.error > limit or (is_near and pair.gone > GONE_MOST):
        off = f", planes {pair.error:.2%} off" if np.isfinite(pair.error) else ""
        got = f"{pair.gone:.1%} of the points before what this frame or the one before draws{off}"
        most = f"at most {GONE_MOST:.1%} and planes {limit:.2%} off"
        return "scene_depth", got, f"{most}: depth, pose and camera that agree with the frame before"
    is_ours = is_near and not is_foreign
    if is_ours and pair.shifted:
        got = f"a thing of {pair.shifted} points farther away than in the frame before"
        return "scene_depth", got, "what stands still at its place"
    if pair.agree >= LEAST_AGREE and pair.same < SAME_LEAST * pair.agree:
        got = f"{pair.same / pair.agree:.1%} of the instances of the frame before"
        return "scene_instance", got, f"at least {SAME_LEAST:.0%} where the depth agrees"
    if is_ours and pair.agree >= LEAST_AGREE and pair.renamed:
        got = f"a thing of {pair.renamed} points under another id than in the frame before"
        return "scene_instance", got, "one id for a thing"
    return None
