"""Check the tracks of a shard or tree in a worker process: rows, points, captions, pictures."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from cosfly.formats.captions import TOKENS
from cosfly.formats.frames import LEGIBLE_CONTRAST, LEGIBLE_HEIGHT_PX, LEGIBLE_SHARE
from cosfly.formats.shown_captions import CaptionReader
from cosfly.geometry.axes import BODY_FROM_CAMERA
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import sha256_file
from cosfly.runtime.worker import Item, Outcome
from release.columns import CAPTION, CAPTION_NAMES, LANGUAGES, POINT_NAMES, REQUIRED, SCALARS, TARGET_PICTURE, WINDOW
from release.counting import count_track
from release.flight_rows import FlightRows, Row
from release.record import ReleaseRecord
from release.verify.findings import Findings
from release.verify.scene import check_pictures
from release.verify.sources import ReadTrack, ShardTracks, TrackSource

PIXEL_PX = 0.5  # a target's pixel: half a pixel is the most that another convention of pixel centres shifts it
DEPTH_M = 0.02  # z-depth of the target: rounded to centimetres at worst
FOV_DEG = 0.01  # the column is rounded to six digits
BOX_PX = 1.0  # our person's projected box, whose corners are exact but may be cut to the image
CENTRE_PX = 1.0  # the principal point is the picture's middle, (w - 1) / 2 in others' convention
SQUARE = 1e-6  # square pixels: fx = fy
STRIDE_SHARE = 0.1  # of the box's longer side: how far a figure in full stride reaches beyond it


def check_geometry(flight: FlightRows, findings: Findings) -> None:
    """Check camera, projection, boxes, depth and flags of a flight's rows."""
    _check_camera(flight, findings)
    _check_projection(flight, findings)
    _check_boxes(flight, findings)
    _check_flags(flight, findings)


def _check_camera(flight: FlightRows, findings: Findings) -> None:
    """Where the camera is the same in all rows, which identity.py holds, the first one tells."""
    told = np.arange(len(flight)) < (len(flight) if flight.zooms else 1)
    (fx, fy, cx, cy), (width, height), fovs = flight.intrinsics.T, flight.size_px.T, flight.numbers("fov_deg")
    is_positive, fov = (fx > 0) & (fy > 0), np.degrees(2.0 * np.arctan(width / (2.0 * fx)))
    is_middle = (np.abs(cx - width / 2) <= CENTRE_PX) & (np.abs(cy - height / 2) <= CENTRE_PX)
    told_again, shown = told & is_positive, lambda i: f"fx {fx[i]}, fy {fy[i]}"
    findings.judge(flight, (
        ("intrinsics", "intrinsics", told & ~is_positive, shown, "focal lengths above 0"),
        ("field_of_view", "fov_deg", told_again & ~(np.abs(fovs - fov) <= FOV_DEG),
         lambda i: f"{fovs[i]} degrees, focal length {fx[i]} px",
         lambda i: f"{fov[i]:.6f} degrees, from width and focal length"),
        ("intrinsics", "intrinsics", told_again & (np.abs(fx - fy) > SQUARE * fx), shown, "square pixels"),
        ("intrinsics", "intrinsics", told_again & ~is_middle, lambda i: f"principal point ({cx[i]}, {cy[i]})",
         lambda i: f"the middle, ({width[i] / 2:g}, {height[i] / 2:g})"),
    ))  # fmt: skip


def _check_projection(flight: FlightRows, findings: Findings) -> None:
    """The target's pixel and depth are those of pose and camera; NaN behind the camera."""
    body = np.einsum("nji,nj->ni", flight.rotations, flight.target_m - flight.pose[:, :3])
    x, y, z = (body @ BODY_FROM_CAMERA).T
    fx, fy, cx, cy = flight.intrinsics.T
    off_px = np.hypot(flight.uv[:, 0] - (fx * x / z + cx), flight.uv[:, 1] - (fy * y / z + cy))
    off_px[~(z > 0)] = np.nan
    has_target, depth_m = ~np.isnan(flight.target_m[:, 0]), flight.numbers("target_depth_m")
    wrong_px = has_target & ~np.isnan(flight.uv[:, 0]) & ~(off_px <= PIXEL_PX)
    wrong_m = has_target & ~np.isnan(depth_m) & ~(np.abs(depth_m - z) <= DEPTH_M)
    findings.judge(flight, (
        ("projection", "target_uv", wrong_px, lambda i: f"{off_px[i]:.3f} px from the projected target",
         f"at most {PIXEL_PX} px"),
        ("target_depth", "target_depth_m", wrong_m, lambda i: f"{depth_m[i]:.3f} m",
         lambda i: f"{z[i]:.3f} m, the value from pose and target"),
    ))  # fmt: skip


def _check_boxes(flight: FlightRows, findings: Findings) -> None:
    """Boxes lie in the picture the right way round, round the target; ours is that of the projected person."""
    box, mask, size = flight.box, flight.mask_box, np.tile(flight.size_px, 2)
    slack = np.inf if flight.is_foreign else 0.5
    has_box, has_mask = ~np.isnan(box[:, 0]), ~np.isnan(mask[:, 0])

    def turned(one: np.ndarray) -> Any:
        return (one[:, 2:] <= one[:, :2]).any(axis=1) | (one < -slack).any(axis=1) | (one > size + slack).any(axis=1)

    def shown(one: np.ndarray):  # type: ignore[no-untyped-def]
        return lambda i: one[i].round(1).tolist()

    inside = "min before max, inside the picture"
    findings.judge(flight, (
        ("box", "target_bbox", has_box & turned(box), shown(box), inside),
        ("box", "target_mask_bbox", has_mask & turned(mask), shown(mask), inside),
    ))  # fmt: skip
    if flight.is_foreign:
        return
    corners = flight.projected_corners
    expected = np.clip(np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1), 0.0, size)
    slack_px = 1.5 + STRIDE_SHARE * (box[:, 2:] - box[:, :2]).max(axis=1, keepdims=True)  # a mask's edges lie on pixels
    outside = (mask[:, :2] < box[:, :2] - slack_px).any(axis=1) | (mask[:, 2:] > box[:, 2:] + slack_px).any(axis=1)
    findings.judge(flight, (
        ("box", "target_bbox", has_box & (np.abs(box - expected).max(axis=1) > BOX_PX), shown(box),
         lambda i: f"{expected[i].round(1).tolist()}, the projected box of the person"),
        ("box", "target_mask_bbox", has_box & outside, shown(mask), "inside target_bbox"),
        ("box", "target_mask_bbox", has_mask & ~has_box, shown(mask), "null, because target_bbox is null"),
    ))  # fmt: skip


def _check_flags(flight: FlightRows, findings: Findings) -> None:
    in_view, visible = flight.flags("target_in_view"), flight.flags("target_visible")
    visibility = flight.numbers("visibility")
    has_target = ~np.isnan(flight.target_m[:, 0])
    has_box, has_mask = ~np.isnan(flight.box[:, 0]), ~np.isnan(flight.mask_box[:, 0])
    legible, height_px = flight.flags("target_legible"), flight.numbers("target_height_px")
    reads = visible & (height_px >= LEGIBLE_HEIGHT_PX) & (visibility >= LEGIBLE_SHARE)
    reads &= flight.numbers("target_contrast") >= LEGIBLE_CONTRAST
    box_px = np.nan_to_num(flight.box[:, 3] - flight.box[:, 1])
    is_ours = not flight.is_foreign
    findings.judge(flight, (("flags", *rule) for rule in (
        ("target_visible", visible & ~in_view, "true, but target_in_view is false", "false for a target out of view"),
        ("target_in_view", in_view & ~has_target, "true, but target is null", "false without a target"),
        ("target_legible", (legible != reads) & ~np.isnan(height_px), "a value that contradicts the limits",
         "true if the target is visible and its height, contrast and visibility are large enough, else false"),
        ("target_height_px", np.abs(height_px - box_px) > 0.01, "a different height from target_bbox",
         "the height of target_bbox"),
        ("target_bbox", (in_view != has_box) & is_ours, "null in view, or a box out of view",
         "a box if and only if the target is in view"),
        ("target_visible", visible & ~has_mask & is_ours, "true, but target_mask_bbox is null",
         "false without pixels of the target"),
    )))  # fmt: skip


CONSTANT = [column.name for column in SCALARS if column.constant]
ZOOMED = ("fov_deg", "intrinsics")  # but of a camera that zooms; check_geometry looks at each row
CLOSED = {c.name: TOKENS if c.words == "actions" else c.words for c in SCALARS if c.words}
RANGES = {column.name: column.ranges for column in SCALARS if column.ranges}
LARGEST = 1e7  # of any number: farther than any town reaches, m


def check_identity(flight: FlightRows, findings: Findings, elsewhere: Collection[str] = ()) -> None:
    """Check ids, names, constants, closed sets, ranges and nulls of a track's rows; not of the columns `elsewhere`."""
    _check_names(flight, findings)
    for name in (name for name in CONSTANT if name not in elsewhere):
        column = flight.column(name)
        differs = [value != column[0] and not (flight.zooms and name in ZOOMED) for value in column]
        if any(differs):
            i = differs.index(True)
            expected = f"{column[0]}, as in the first row of the track"
            findings.error("constant", flight.where(i, name), column[i], expected)
    for i, row in enumerate(flight.rows):
        for name in (name for name in row if name not in elsewhere):
            value, allowed = row[name], CLOSED.get(name, ())
            if value is None and name in REQUIRED:
                findings.error("null", flight.where(i, name), "null", "a value in every row")
            elif value is not None and allowed and value not in allowed:
                expected = f"one of {len(allowed)} words: {', '.join(allowed[:4])} ..."
                findings.error("closed_set", flight.where(i, name), repr(value), expected)
            elif isinstance(value, float | dict):
                _check_numbers(flight, i, name, value, findings)


def _check_names(flight: FlightRows, findings: Findings) -> None:
    first, index = flight.rows[0], flight.index
    if flight.name != "/".join(str(first.get(n)) for n in ("run", "town", "trajectory", "variant")):
        findings.error("flight", flight.name, "rows of another track", "rows of this track")
    for i, row in enumerate(flight.rows):
        given, number = row.get("sample_id"), row.get("frame_index") or 0
        own = f"{row.get('trajectory')}_{row.get('variant')}_frame_{number:05d}"
        expected = own if flight.given_id is None else f"{flight.given_id}_frame_{number:05d}"
        fits = str(given).endswith(own) if flight.given_id is None else given == expected
        if "sample_id" in row and not fits:
            findings.error(
                "sample_id", flight.where(i, "sample_id"), repr(given), f"{expected}, from the other columns of the row"
            )
    if (backwards := np.diff(index, prepend=-1) <= 0).any():
        k = int(np.argmax(backwards))
        findings.error("frame_index", flight.where(k), f"{index[max(k - 1, 0) :][:2]}", "increasing indices from 0")
    if (flight.time_s[1:] <= flight.time_s[:-1]).any():
        findings.error("time", flight.where(0, "time_s"), "times that do not increase", "increasing times")


def _check_numbers(flight: FlightRows, i: int, name: str, value: Any, findings: Findings) -> None:
    """Check that numbers are finite, of a sane size, and within their range; a group is whole or null."""
    if isinstance(value, dict) and name in ("perturbation", "image", "instance", TARGET_PICTURE):
        return
    ranges = RANGES.get(name, {})
    for member, number in value.items() if isinstance(value, dict) else (("", value),):
        low, high = ranges.get(member, (-LARGEST, LARGEST))
        if isinstance(number, str | bool) or (number is not None and low <= number <= high):
            continue
        place = flight.where(i, f"{name}.{member}".rstrip("."))
        if number is None:
            findings.error("null", place, "null", "a number, because its group is not null")
        elif not math.isfinite(number):
            findings.error("not_finite", place, number, "a finite number")
        else:
            findings.error("range", place, number, f"{low:g} to {high:g}")


def check_points(flight: FlightRows, points: FlightRows, findings: Findings) -> None:
    """Check that a track has all of its points, and each row the values of its point."""
    if not np.array_equal(points.index, np.arange(len(points))):
        findings.error("points", f"{flight.name}: points", "frame indices with gaps", f"0 to {len(points) - 1}")
        return
    for i, row in enumerate(flight.rows):
        point = points.rows[flight.index[i]] if 0 <= flight.index[i] < len(points) else {}
        for name in (name for name in POINT_NAMES if row.get(name) != point.get(name)):
            got = f"{shown(row.get(name))}, and {shown(point.get(name))} in the table of points"
            findings.error("points", flight.where(i, name), got, "the same value in both")


NEVER_NULL = [column.name for column in CAPTION if column.required]


def check_captions(flight: FlightRows, window_frames: int | None, findings: Findings) -> None:
    """Check the captions of a flight's rows.

    Args:
        window_frames: of every window, as the record says; None where nobody says.
    """
    for i, row in enumerate(flight.rows):

        def tell(code: str, column: str, got: object, expected: str, i: int = i) -> None:
            findings.error(code, flight.where(i, column), got, expected)

        if not row.get("has_caption"):
            if present := [name for name in CAPTION_NAMES if row.get(name) is not None]:
                tell("caption", present[0], "a value", "null, because has_caption is false")
        elif absent := [name for name in NEVER_NULL if name in row and not row[name]]:
            tell("caption", absent[0], shown(row.get(absent[0])), "a value, because has_caption is true")
        else:
            _check_window(row, window_frames, tell)
            _check_decision(row, tell)


def _check_window(row: Row, window_frames: int | None, tell: Callable[..., None]) -> None:
    window, index = row[WINDOW], row["frame_index"]
    if any(frame is None or frame > index for frame in window):
        tell("window", WINDOW, window, f"no frame after the current frame, {index}")
    elif window != list(range(index - len(window) + 1, index + 1)):
        tell("window", WINDOW, window, f"consecutive frames up to {index}")
    elif window_frames is not None and len(window) != window_frames:
        tell("window", WINDOW, f"{len(window)} frames", f"{window_frames} frames (settings.window_frames)")
    elif window[0] < 0:
        tell("window", WINDOW, window, "frames of the track")


def _check_decision(row: Row, tell: Callable[..., None]) -> None:
    """One decision, and a verdict that follows from it and the label."""
    decision, label, verdict = row["decision"], row["label"], row["verdict"]
    decisions = {decision, *(row[f"caption_{language}_flight_decision"] for language in LANGUAGES)}
    if len(decisions) > 1:
        tell("decision", "decision", ", ".join(map(str, sorted(decisions))), "the same decision in all columns")
    if (verdict == "CONSISTENT") != (label is not None and decision == label):
        got = f"{verdict}: decision {decision}, label {label}"
        tell("verdict", "verdict", got, "CONSISTENT if and only if the decision is the label")
    elif (verdict == "ABSTAIN" and label is not None) or (verdict == "SOFT_CONFLICT" and label is None):
        tell("verdict", "verdict", f"{verdict}, label {label}", "ABSTAIN if and only if there is no label")


Level = Literal["structure", "rows", "pixels"]
# What a senseless value raises in a check of another value; the cause is reported by a check of its own.
SENSELESS = (ValueError, KeyError, TypeError, IndexError, ArithmeticError, AttributeError)


@dataclass(frozen=True)
class Context:
    """What the record says that the checks of tracks need. captions: By run, the settings of its caption stage, if its
    source has one."""

    window_frames: int | None = None
    captions: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of_record(cls, record: ReleaseRecord) -> Context:
        captions = dict[str, dict[str, Any]]()
        for source in record.provenance.sources:
            own = [stage.config for stage in source.stages if stage.stage == "caption"]
            captions[source.run] = own[0] if len(own) == 1 else {}
        return cls(record.settings.window_frames, captions)

    def caption_settings(self, flight: FlightRows) -> dict[str, Any]:
        """Return the settings of a track's captions; folders above a town are part of a run's name."""
        name = flight.name.split("/")[0]
        runs = [run for run in self.captions if name == run or name.startswith(f"{run}_")]
        return self.captions[max(runs, key=len)] if runs else {}


def make_worker(
    level: Level, context: Context, reader: CaptionReader | None, digests: Mapping[str, str]
) -> Callable[[Item], Outcome]:
    """Worker factory: return the function that checks the tracks of a source in one pass, and returns their counts.

    Args:
        digests: sha256 by file, compared at the level `pixels`.
    """

    def work(item: Item) -> Outcome:
        findings, counts = Findings(), list[dict[str, Any]]()
        source: TrackSource = item.payload
        clean: FlightRows | None = None  # the points of the clean track of this trajectory
        try:
            for track in source:
                if track.points.is_clean:
                    clean = track.points
                is_twin = clean is not None and clean.name.rpartition("/")[0] == track.frames.name.rpartition("/")[0]
                twin = clean if is_twin and not track.points.is_clean else None
                _check_track(track, twin, level, context, reader, findings)
                with _reported(track.frames.name, findings):
                    counts.append(count_track(track.frames, track.points).model_dump())
            if level == "pixels":
                check_digests(source, digests, findings)
        except InputError as error:
            where = str(error.where or item.item_id)
            findings.error("unreadable", where, f"{error.what}: {error.got}", "tracks that can be read")
        except SENSELESS as error:
            findings.error("senseless", item.item_id, f"{type(error).__name__}: {error}", "rows that can be read")
        return Outcome({"findings": findings.dumped(), "counts": counts})

    return work


def check_digests(source: TrackSource, digests: Mapping[str, str], findings: Findings) -> None:
    """Compare the checksums of the files of a shard with the list."""
    if isinstance(source, ShardTracks):
        for name in (source.shard.path, source.shard.points.path):
            if name in digests and (found := sha256_file(source.folder / name, tree=source.folder)) != digests[name]:
                findings.error("checksum", name, found, digests[name])


@contextmanager
def _reported(name: str, findings: Findings) -> Iterator[None]:
    """Report values that make a check impossible."""
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            yield
    except (InputError, *SENSELESS) as error:
        findings.error("senseless", name, f"{type(error).__name__}: {error}", "values to compute with")


def _check_track(
    track: ReadTrack,
    twin: FlightRows | None,
    level: Level,
    context: Context,
    reader: CaptionReader | None,
    findings: Findings,
) -> None:
    """Run all checks of a track."""
    frames, points, pictures = track

    def read_captions() -> None:
        shown = frames.shown(points, twin, context.caption_settings(frames))
        for mismatch in reader(shown) if reader is not None else ():
            findings.error(*mismatch)

    checks: list[Callable[[], None]] = [
        lambda: check_identity(points, findings),
        lambda: check_geometry(points, findings),
        lambda: check_captions(frames, context.window_frames, findings),
        read_captions,
    ]
    if points is not frames:
        checks += [
            lambda: check_identity(frames, findings, elsewhere=POINT_NAMES),
            lambda: check_points(frames, points, findings),
        ]
    if level == "pixels":
        checks.append(lambda: check_pictures(frames, pictures, findings))
    for check in checks:
        with _reported(frames.name, findings):
            check()
    if level == "pixels":
        deque(pictures, maxlen=0)  # those that a failed check has not read
