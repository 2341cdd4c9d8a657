"""The pictures of a flight against each other: what stands still is carried from frame to frame through the poses (cosfly/space/reprojection.py).

That is where exchanged pictures, poses and cameras come to light: each of them may be right alone. Thresholds lie between what honest
flights of six runs showed at worst and what the smallest exchange, that of two frames half a second apart, shows typically
(docs/releases.md).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from cosfly.space.reprojection import (
    LEAST_PAIRS,
    Agreement,
    View,
    compare_views,
    correlate_colours,
    is_zoomed,
    usual_correlations,
    way_px,
)
from cosfly.work.items import advance
from release.record import DepthCoding, DepthCodingName
from release.verify.findings import Findings
from release.verify.person import check_shown
from release.verify.pictures import check_picture, decode, least_step, view_of
from release.verify.pixels import BLOCK_PX, NUM_IDS, look_of, new_kinds
from release.verify.places import Kept, can_be_kept, kept_rows, thinned
from release.verify.rows import FlightRows
from release.verify.sources import Pictures

LEAST_SEEN, LEAST_AGREE = 150, 100  # points, for a share to mean something
NEAR_FRAMES = 2  # farther apart, more is hidden behind other things
AGREE_LEAST = 0.5  # honest 0.81 and more
THROUGH_MOST = 0.02  # points in front of what is drawn: honest 0.001
ERROR_MOST = {"float32": 2e-4, "float16": 2e-3, "millimetre_png": 2e-3}  # of planes; honest below 1e-5 as float32
SAME_LEAST = 0.95  # of the instances, of ground the kinds; honest 0.985
# Below the median of a flight's frames of one zoom; honest 0.08, and under heavy rain by night, whose streaks and wet ground are other ones in
# every frame, 0.152.
COLOUR_DROP, COLOUR_DROP_RAIN = 0.15, 0.2  # dry; where it rains as hard as it can
# That median itself, by the width of the pictures: the coarser, the less of a detail lies in the same pixel again. Honest 0.94 and more at
# 320 px; at 160 px 0.90 and more, but 0.77 in a flight over Delft.
COLOUR_LEAST, COLOUR_LEAST_AT_PX = (0.65, 0.82), (160.0, 320.0)
# Grey levels: of a pale square the grain alone, 4 from frame to frame, leaves honest frames a correlation of 0.7.
CONTRAST = 10.0
TINT = 2.0  # grey levels of hue beyond the median of a flight; honest 0.1
# Grey levels of brightness beside the frame before, less what its way through fog explains, and times the median of a flight: honest 4.7.
SHADE, SHADE_TIMES = 6.0, 8.0
NEARER_M = 0.5  # a way towards the person or away from it by which fog shows in the brightness
# Of the points that agree, as float32, on planes: depth that was made rough has none. Honest 0.8 and more in the median of a flight.
PLANES_LEAST = 0.1
# How much better the next frame's place must explain a frame's colours to be where they are from: of colours that agree with the frame
# before as usual in the flight or around it, of others (honest 0.03 at most), and of frames that lie nearer to each other than so much: rows of colours are
# a pixel off at most, and honest frames 0.5 px apart agreed better by 0.067 with the next one's place.
BETTER_BY_USUAL, BETTER_BY, UNUSUAL = 0.07, 0.045, 0.04
AROUND = 5  # frames before and after, which by night may agree less than the flight does, or tell nothing
BETTER_BY_NEAR, NEAR_PX = 0.1, 2.0
# Frames so near to each other may agree better with the next one's place by what is usually lost on the way, so many times: pictures without
# smoothed edges lose by where in a pixel a point comes out (honest 1.7 times 0.08).
FEW_PX, LOST_TIMES = 3.0, 2.0
# Of the lesser of both neighbours, in hue and in detail: honest 0.6 and 0.9 of ours; and what these must have for that to mean something.
LOOKS_LEAST, LOOK_LEAST = (0.2, 0.6), 2.0
TWINS_LOOK = (0, 1, 4, 5, 6)  # of `look_of`, what twins have about the same of
# Steps over edges of blocks to those elsewhere: honest 0.998 to 1.004 over a flight; JPEG of quality 40 1.85. So many edges, for that to mean something.
BLOCKS_MOST, LEAST_BLOCK_EDGES = 1.1, 300
# Between the two nearest depths of a frame's sample: honest 4e-6 m; of so many frames of a flight the least counts.
STEP_MOST_M, STEPS_LOOKED_AT = 2e-4, 8
# Flights of others: depth may be rough, but it is equally rough in all frames.
ROUGH_ERROR, TIMES_ROUGH = 1e-3, 20.0


@dataclass
class _Pairs:
    """What neighbouring frames say of each other: row of the later one, agreement, correlation of its colours at the next frame's place, and
    how far away that is."""

    rows: list[int] = field(default_factory=list)
    gaps: list[int] = field(default_factory=list)
    found: list[Agreement] = field(default_factory=list)
    elsewhere: list[float] = field(default_factory=list)
    ways_px: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Shown:
    """What is kept of a flight's pictures to compare it with others. keys: of each row a number that tells its colour picture from others,
    and one for its depth; 0 where it has none. kinds: id * 256 + kind of what is seen. look: how colourful and sharp, red and blue less green, brightness, grey levels, or nothing.
    kept: rows and frames that are compared with other walks.
    """

    keys: list[tuple[int, int]]
    kinds: list[int]
    look: list[float]
    kept: list[tuple[int, Kept]]


NOTHING_SHOWN = Shown([], [], [], [])


def check_pictures(
    flight: FlightRows,
    pictures: Iterator[Pictures],
    coding: DepthCoding,
    rounded_as: DepthCodingName,
    findings: Findings,
) -> Shown:
    """Check all pictures of a flight, one after the other; memory holds three frames.

    Args:
        coding: of the depth. rounded_as: the coding whose errors it has.
    """
    keys: list[tuple[int, int]] = []
    pairs, kinds = _Pairs(), np.full(NUM_IDS, -1, np.int16)
    looks = np.full((len(flight), 8), np.nan)
    outlines = np.full(len(flight), np.nan)
    steps: list[float] = []  # of some frames' depth
    kept: list[tuple[int, Kept]] = []
    to_keep = kept_rows(len(flight))
    before: list[tuple[int, View]] = []  # the two frames before
    for i, files in enumerate(pictures):
        advance()
        decoded = decode(flight, i, files, coding, findings)
        keys.append(_keys(files, decoded))
        look = look_of(decoded[2]) if decoded is not None and decoded[2] is not None else looks[i]
        if decoded is None or not check_picture(flight, i, decoded, look[-1], findings):
            before = []
            continue
        if decoded[1].size and not flight.is_foreign:
            _check_kinds(flight, i, decoded[1], kinds, findings)
        looks[i] = look
        outlines[i] = decoded[3]
        if rounded_as == "float32" and i % max(1, len(flight) // STEPS_LOOKED_AT) == 0:
            steps.append(least_step(decoded[0]))
        view = view_of(flight, i, decoded)
        if decoded[0].size:
            _compare(flight, i, view, before, pairs)
            if i in to_keep and view.instance.size and can_be_kept(flight, i):
                kept.append((i, thinned(view, flight.intrinsics[i])))
        before = [*before[-1:], (i, view)]
    _judge(flight, pairs, rounded_as, findings)
    check_shown(flight, outlines, findings)
    if not flight.is_foreign:
        _judge_looks(flight, looks[:, :2], findings)
        _judge_blocks(flight, looks[:, 2:4], findings)
        least = min((step for step in steps if np.isfinite(step)), default=0.0)
        if least > STEP_MOST_M:
            findings.error("depth_coding", flight.name, f"depths that are {least:.4f} m apart or equal", "float32 as it was drawn, as the record says: depths that differ by millionths")  # fmt: skip
    known = looks[np.isfinite(looks).all(axis=1)][:, TWINS_LOOK]
    ids = np.flatnonzero(kinds >= 0)
    return Shown(keys, (ids << 8 | kinds[ids]).tolist(), known.mean(axis=0).tolist() if len(known) else [], kept)


def _keys(files: Pictures, decoded: object) -> tuple[int, int]:
    """Numbers that are the same for the same pictures: the checksums of a PNG's pixels, and a digest of the depth's samples."""
    colour, depth = files.get("rgb") or b"", files.get("depth") or b""
    # The last bytes before the IEND chunk (12): the stream's own checksum and that of its chunk (4 each).
    told = int.from_bytes(colour[-20:-12], "big")
    samples = np.frombuffer(depth, np.uint8)[:: max(1, len(depth) // 8192)].tobytes() if decoded else b""
    return told, int.from_bytes(hashlib.blake2b(samples, digest_size=8).digest(), "big") if samples else 0


def _check_kinds(flight: FlightRows, i: int, instance: np.ndarray, kinds: np.ndarray, findings: Findings) -> None:
    """An instance is of one kind in all frames. kinds: (NUM_IDS,) as in the frames before, -1 of what was not seen; what is new is added."""
    for code in new_kinds(instance, kinds):
        own, kind = code >> 8, code & 255
        if kinds[own] < 0:
            kinds[own] = kind
        elif kinds[own] != kind:
            findings.error("instance_kind", flight.where(i, "instance"), f"instance {own} of kind {kind}", f"kind {kinds[own]}, as before")  # fmt: skip


def _compare(flight: FlightRows, i: int, view: View, before: list[tuple[int, View]], pairs: _Pairs) -> None:
    """Compare a frame with the one before; and the colours of that one, at this frame's place, with the one before it."""
    if not before:
        return
    k, previous = before[-1]
    pairs.rows.append(i)
    pairs.gaps.append(int(flight.index[i] - flight.index[k]))
    pairs.found.append(
        compare_views(previous, view, flight.intrinsics[k], flight.intrinsics[i], least_contrast=CONTRAST)
    )
    pairs.elsewhere.append(np.nan)
    if is_zoomed(
        flight.intrinsics[k], flight.intrinsics[i]
    ):  # other detail is seen: depth and instances tell, colours do not
        pairs.found[-1] = replace(pairs.found[-1], correlation=np.nan, tint=np.nan, shade=np.nan)
    pairs.ways_px.append(np.nan)
    if len(before) == 2 and previous.colours is not None and len(pairs.found) >= 2:
        pairs.ways_px[-2] = way_px(previous, view, flight.intrinsics[k], flight.intrinsics[i])
        moved = replace(view, colours=previous.colours)
        pairs.elsewhere[-2] = correlate_colours(
            before[0][1], moved, flight.intrinsics[before[0][0]], flight.intrinsics[i], least_contrast=CONTRAST
        )


def _judge_looks(flight: FlightRows, looks: np.ndarray, findings: Findings) -> None:
    """A frame is about as colourful and as sharp as both frames beside it.

    Args:
        looks: (n, 2) grey levels, of each row what `look_of` gives; NaN where nobody knows.
    """
    gaps = np.diff(flight.index)
    for k in range(1, len(flight) - 1):
        least = np.minimum(looks[k - 1], looks[k + 1])
        zoomed = any(is_zoomed(flight.intrinsics[k], flight.intrinsics[other]) for other in (k - 1, k + 1))
        if gaps[k - 1] > NEAR_FRAMES or gaps[k] > NEAR_FRAMES or zoomed:
            continue
        for name, own, beside, share in zip(("colourful", "sharp"), looks[k], least, LOOKS_LEAST, strict=True):
            if beside >= LOOK_LEAST and own < share * beside:
                got = f"{own:.1f} grey levels where the frames beside it have {beside:.1f} and more"
                findings.error("scene_colour", flight.where(k, "image"), got, f"a picture about as {name} as these")


def _judge_blocks(flight: FlightRows, steps: np.ndarray, findings: Findings) -> None:
    """Pictures that were drawn and packed without loss have no blocks.

    Args:
        steps: (n, 2) grey levels, from pixel to pixel over edges of blocks and elsewhere; NaN where nobody knows.
    """
    known = steps[np.isfinite(steps).all(axis=1)]
    if len(known) * flight.size_px[0, 0] < LEAST_BLOCK_EDGES * BLOCK_PX:
        return
    over, inside = known.mean(axis=0)
    if inside > 0.0 and over > BLOCKS_MOST * inside:
        findings.error("scene_colour", flight.name, f"pixels that differ {over / inside:.2f} times as much over every {BLOCK_PX}th edge as elsewhere", f"at most {BLOCKS_MOST:g}: pictures that no lossy coding cut into blocks")  # fmt: skip


def _judge_planes(flight: FlightRows, found: list[Agreement], findings: Findings) -> None:
    """What is drawn is made of planes, and its depth is exact."""
    shares = [pair.planes / pair.agree for pair in found if pair.agree >= LEAST_AGREE]
    if len(shares) >= LEAST_PAIRS and np.median(shares) < PLANES_LEAST:
        findings.error("scene_depth", flight.name, f"depth of which {np.median(shares):.0%} of the points lie on planes", f"at least {PLANES_LEAST:.0%}: depth as it was drawn, without noise")  # fmt: skip


def _around(colours: np.ndarray) -> np.ndarray:
    """Give the median correlation of the frames round each, (n,); NaN where one of them has too little contrast to have any: so has its neighbour."""
    return np.array([np.median(colours[max(0, k - AROUND) : k + AROUND + 1]) for k in range(len(colours))])


def _better_by(way: float, usual: float, *, is_unusual: bool) -> float:
    """How much better a frame's colours must agree with the next frame's place, `way` px away, to be from there. usual: how much the flight's
    agree with the frame before; NaN where nobody knows."""
    least = BETTER_BY_NEAR if way < NEAR_PX else BETTER_BY if is_unusual else BETTER_BY_USUAL
    return max(least, LOST_TIMES * (1.0 - usual)) if way < FEW_PX else least


def _shades(flight: FlightRows, pairs: _Pairs) -> np.ndarray:
    """Give how much brighter each frame is than the one before, grey levels (n,), less what fog makes of coming nearer.

    What fog lies before is brighter or darker by how far away it is. How much a metre makes is the median of the flight's own pairs.
    """
    rows, shades = np.array(pairs.rows), np.array([pair.shade for pair in pairs.found])
    place, person = flight.pose[rows, :3], flight.target_m[rows - 1]
    farther_m = np.linalg.norm(place - person, axis=1) - np.linalg.norm(flight.pose[rows - 1, :3] - person, axis=1)
    far = np.isfinite(shades) & (np.abs(farther_m) > NEARER_M)
    if far.sum() < LEAST_PAIRS:
        return shades
    return shades - float(np.median(shades[far] / farther_m[far])) * np.nan_to_num(farther_m)


def _judge(flight: FlightRows, pairs: _Pairs, rounded_as: DepthCodingName, findings: Findings) -> None:
    """Find the pairs of frames that do not show one world."""
    if not pairs.found:
        return
    errors = np.array([pair.error for pair in pairs.found])
    agree = np.array([pair.agree / max(pair.seen, 1) for pair in pairs.found])
    limit, least = ERROR_MOST[rounded_as], AGREE_LEAST
    if flight.is_foreign:
        usual = float(np.nanmedian(errors)) if np.isfinite(errors).any() else np.inf
        if usual > ROUGH_ERROR or np.median(agree) < 0.8:
            findings.note("scene_not_judged", flight.name, f"depth that is {usual:.1%} beside the next frame's", "pictures of one world; of flights that cosfly drew this is an error")  # fmt: skip
            return
        limit, least = max(limit, TIMES_ROUGH * usual), AGREE_LEAST
    colours = np.array([pair.correlation for pair in pairs.found])
    skies = flight.column("weather_params")
    told = [sky.get("precipitation") for sky in skies if isinstance(sky, dict)]
    rain = min(max((one for one in told if isinstance(one, int | float)), default=0.0), 100.0) / 100.0
    drop_most = COLOUR_DROP + rain * (COLOUR_DROP_RAIN - COLOUR_DROP)
    usuals, drops = usual_correlations(colours, flight.intrinsics[pairs.rows, 0], drop_most)
    tints = np.array([pair.tint for pair in pairs.found])
    usual_tint = float(np.nanmedian(tints)) if np.isfinite(tints).any() else np.nan
    least_colour = float(np.interp(flight.size_px[0, 0], COLOUR_LEAST_AT_PX, COLOUR_LEAST))
    if np.isfinite(usuals).any() and not flight.is_foreign and np.nanmedian(usuals) < least_colour:
        findings.error("scene_colour", flight.name, f"colours that agree by {np.nanmedian(usuals):.2f} from frame to frame", "pictures of this flight")  # fmt: skip
    if rounded_as == "float32" and not flight.is_foreign:
        _judge_planes(flight, pairs.found, findings)
    shades = _shades(flight, pairs)
    shade_most = max(SHADE, SHADE_TIMES * float(np.nanmedian(np.abs(shades)))) if np.isfinite(shades).any() else np.inf
    around = np.minimum(usuals, _around(colours))
    compared = zip(pairs.rows, pairs.gaps, pairs.found, pairs.elsewhere, pairs.ways_px, usuals, around, drops, shades, strict=True)  # fmt: skip
    for i, gap, pair, elsewhere, way, usual_colour, near_colour, drop, shade in compared:
        if pair.seen < LEAST_SEEN:
            continue
        share, through = pair.agree / pair.seen, pair.through / pair.seen
        where = flight.where(i)
        if (gap <= NEAR_FRAMES and (share < least or through > THROUGH_MOST)) or pair.error > limit:
            off = f", planes {pair.error:.2%} off" if np.isfinite(pair.error) else ""
            got = f"{share:.0%} of the points where the frame before has them, {through:.1%} before what is drawn{off}"
            expected = f"at least {least:.0%}, at most {THROUGH_MOST:.1%} and planes {limit:.2%} off: depth, pose and camera that agree with the frame before"  # fmt: skip
            findings.error("scene_depth", where, got, expected)
            continue
        if gap <= NEAR_FRAMES and pair.shifted and not flight.is_foreign:
            findings.error("scene_depth", where, f"a thing of {pair.shifted} points farther away than in the frame before", "what stands still at its place")  # fmt: skip
            continue
        if pair.agree < LEAST_AGREE:
            continue
        if pair.same < SAME_LEAST * pair.agree:
            findings.error("scene_instance", where, f"{pair.same / pair.agree:.1%} of the instances of the frame before", f"at least {SAME_LEAST:.0%} where the depth agrees")  # fmt: skip
        elif pair.renamed and gap <= NEAR_FRAMES and not flight.is_foreign:
            findings.error("scene_instance", where, f"a thing of {pair.renamed} points under another id than in the frame before", "one id for a thing")  # fmt: skip
        if pair.correlation < usual_colour - drop:
            findings.error("scene_colour", where, f"a picture that resembles the one before by {pair.correlation:.2f}, its camera's way allowed for (1: the same)", f"at least {usual_colour - drop:.2f}, by the flight's other frames: look whether it is of this frame")  # fmt: skip
        elif abs(shade) > shade_most and gap <= NEAR_FRAMES and not flight.is_foreign:
            findings.error("scene_colour", where, f"a picture that is {abs(shade):.0f} grey levels {'brighter' if shade > 0 else 'darker'} than the frame before, its camera's way allowed for", f"at most {shade_most:.0f}, by the flight's other frames")  # fmt: skip
        elif pair.tint > usual_tint + TINT:
            findings.error("scene_colour", where, f"colours that differ by {pair.tint:.0f} grey levels from the frame before", f"at most {usual_tint + TINT:.0f}, by the flight's other frames")  # fmt: skip
        elif elsewhere > pair.correlation + _better_by(way, usual_colour, is_unusual=pair.correlation < near_colour - UNUSUAL):  # fmt: skip
            findings.error("scene_colour", where, f"a picture that resembles the one before by {pair.correlation:.3f}, and would by {elsewhere:.3f} if it were the next frame's", "pictures in their frames' order: compare it with those beside it")  # fmt: skip
