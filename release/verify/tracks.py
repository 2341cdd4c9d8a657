"""Check the tracks of a shard in a worker process: rows and points; captions.py and scene.py check the rest."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosfly.formats.captions import TOKENS
from cosfly.formats.frames import LEGIBLE_CONTRAST, LEGIBLE_HEIGHT_PX, LEGIBLE_SHARE
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.places import Place, flight_ids
from cosfly.formats.shown_captions import CaptionReader
from cosfly.geometry.axes import BODY_FROM_CAMERA, CORNER_SIGNS
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import sha256_file
from cosfly.runtime.worker import Item, Outcome
from release.columns import POINT_NAMES, POINTS, SCALARS, Column
from release.counting import count_track
from release.reading import Pictures, TrackRows, read_pictures, read_tracks
from release.record import ReleaseRecord, Shard
from release.verify.captions import check_captions, released_track
from release.verify.findings import Findings
from release.verify.scene import check_pictures

PIXEL_PX = 0.5  # a target's pixel: half a pixel is the most that another convention of pixel centres shifts it
DEPTH_M = 0.02  # z-depth of the target: rounded to centimetres at worst
FOV_DEG = 0.01  # the column is rounded to six digits
BOX_PX = 1.0  # our person's projected box, whose corners are exact but may be cut to the image
CENTRE_PX = 1.0  # the principal point is the picture's middle, (w - 1) / 2 in others' convention
SQUARE = 1e-6  # square pixels: fx = fy
STRIDE_SHARE = 0.1  # of the box's longer side: how far a figure in full stride reaches beyond it
MASK_PX = 1.5  # and how far a mask does, whose edges lie on pixels
EDGE_PX = 0.5  # how far a box of ours may reach beyond the picture
HEIGHT_PX = 0.01  # of the target: rounded as its box is
NEAR_M = 0.3  # the renderers' near plane
ZOOMED = ("fov_deg", "intrinsics")  # columns that change if a camera zooms
NOT_IN_POINTS = [column for column in SCALARS if column.name not in POINT_NAMES]
LARGEST = 1e7  # of any number: farther than any town reaches, m


def check_camera(track: TrackRows, findings: Findings) -> None:
    """Check the camera: of the first row only unless it zooms, because `check_values` checks that it is constant."""
    is_checked = np.arange(len(track)) < (len(track) if track.zooms else 1)
    fx, fy, cx, cy = track.intrinsics.T
    width, height = track.size_px.T
    fov_deg = track.numbers("fov_deg")
    expected_deg = np.degrees(2.0 * np.arctan(width / (2.0 * fx)))
    is_middle = (np.abs(cx - width / 2) <= CENTRE_PX) & (np.abs(cy - height / 2) <= CENTRE_PX)
    is_square = (fx > 0) & (np.abs(fx - fy) <= SQUARE * fx)
    findings.judge(track, (
        ("intrinsics", "intrinsics", is_checked & ~(is_square & is_middle),
         lambda i: f"focal lengths ({fx[i]}, {fy[i]}), principal point ({cx[i]}, {cy[i]})",
         lambda i: f"equal focal lengths above 0, the middle ({width[i] / 2:g}, {height[i] / 2:g})"),
        ("field_of_view", "fov_deg", is_checked & ~(np.abs(fov_deg - expected_deg) <= FOV_DEG),
         lambda i: f"{fov_deg[i]} degrees, focal length {fx[i]} px",
         lambda i: f"{expected_deg[i]:.6f} degrees, from width and focal length"),
    ))  # fmt: skip


def check_projection(track: TrackRows, findings: Findings) -> None:
    """Check the pixel and depth of the target against pose and camera."""
    body = np.einsum("nji,nj->ni", track.rotations, track.target_m - track.pose[:, :3])
    x, y, z = (body @ BODY_FROM_CAMERA).T
    fx, fy, cx, cy = track.intrinsics.T
    off_px = np.hypot(track.uv[:, 0] - (fx * x / z + cx), track.uv[:, 1] - (fy * y / z + cy))
    off_px[~(z > 0)] = np.nan
    has_target, depth_m = ~np.isnan(track.target_m[:, 0]), track.numbers("target_depth_m")
    is_wrong_uv = has_target & ~np.isnan(track.uv[:, 0]) & ~(off_px <= PIXEL_PX)
    is_wrong_depth = has_target & ~np.isnan(depth_m) & ~(np.abs(depth_m - z) <= DEPTH_M)
    findings.judge(track, (
        ("projection", "target_uv", is_wrong_uv, lambda i: f"{off_px[i]:.3f} px from the projected target",
         f"at most {PIXEL_PX} px"),
        ("target_depth", "target_depth_m", is_wrong_depth, lambda i: f"{depth_m[i]:.3f} m",
         lambda i: f"{z[i]:.3f} m, the value from pose and target"),
    ))  # fmt: skip


def projected_corners(track: TrackRows) -> np.ndarray:
    """Return the corners of a person of ours at each row's target, (n, 8, 2) px; NaN if one lies behind the camera."""
    corners = track.target_m[:, None, :] + CORNER_SIGNS * np.array(PERSON_HALF_EXTENTS_M)
    body = np.einsum("nji,nkj->nki", track.rotations, corners - track.pose[:, None, :3])
    x, y, z = np.moveaxis(body @ BODY_FROM_CAMERA, 2, 0)
    fx, fy, cx, cy = (values[:, None] for values in track.intrinsics.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([fx * x / z + cx, fy * y / z + cy], axis=2)
    uv[~(z > NEAR_M).all(axis=1)] = np.nan
    return uv


def check_boxes(track: TrackRows, findings: Findings) -> None:
    """Check that boxes are inside the picture, min before max; those of our renderers are the projected person's."""
    box, mask, size = track.box, track.mask_box, np.tile(track.size_px, 2)
    is_ours, edge_px = not track.is_foreign, np.inf if track.is_foreign else EDGE_PX
    has_box, has_mask = ~np.isnan(box[:, 0]), ~np.isnan(mask[:, 0])
    corners = projected_corners(track)
    expected = np.clip(np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1), 0.0, size)
    is_wrong = is_ours & has_box & (np.abs(box - expected).max(axis=1) > BOX_PX)
    around_px = MASK_PX + STRIDE_SHARE * (box[:, 2:] - box[:, :2]).max(axis=1, keepdims=True)
    is_outside = (mask[:, :2] < box[:, :2] - around_px).any(axis=1) | (mask[:, 2:] > box[:, 2:] + around_px).any(axis=1)

    def is_no_box(edges: np.ndarray) -> Any:
        is_inverted = (edges[:, 2:] <= edges[:, :2]).any(axis=1)
        return is_inverted | (edges < -edge_px).any(axis=1) | (edges > size + edge_px).any(axis=1)

    findings.judge(track, (("box", *rule) for rule in (
        ("target_bbox", has_box & is_no_box(box), lambda i: box[i].tolist(), "min before max, inside the picture"),
        ("target_bbox", is_wrong, lambda i: box[i].round(1).tolist(),
         lambda i: f"{expected[i].round(1).tolist()}, the projected box of the person"),
        ("target_mask_bbox", has_mask & is_no_box(mask), lambda i: mask[i].tolist(),
         "min before max, inside the picture"),
        ("target_mask_bbox", is_ours & has_mask & (is_outside | ~has_box), lambda i: mask[i].tolist(),
         "inside target_bbox, null if that is null"),
    )))  # fmt: skip


def check_flags(track: TrackRows, findings: Findings) -> None:
    """Check the flags of the target against each other, its boxes, and the limits of legibility."""
    in_view, visible = track.flags("target_in_view"), track.flags("target_visible")
    has_target = ~np.isnan(track.target_m[:, 0])
    has_box, has_mask = ~np.isnan(track.box[:, 0]), ~np.isnan(track.mask_box[:, 0])
    height_px = track.numbers("target_height_px")
    is_legible = visible & (height_px >= LEGIBLE_HEIGHT_PX) & (track.visibility >= LEGIBLE_SHARE)
    is_legible &= track.numbers("target_contrast") >= LEGIBLE_CONTRAST
    is_wrong_legible = (track.flags("target_legible") != is_legible) & ~np.isnan(height_px)
    box_px = np.nan_to_num(track.box[:, 3] - track.box[:, 1])
    is_ours = not track.is_foreign
    findings.judge(track, (("flags", *rule) for rule in (
        ("target_visible", visible & ~in_view, "true, but target_in_view is false", "false for a target out of view"),
        ("target_in_view", in_view & ~has_target, "true, but target is null", "false without a target"),
        ("target_legible", is_wrong_legible, "a value that contradicts the limits",
         "true if the target is visible and its height, contrast and visibility are large enough, else false"),
        ("target_height_px", np.abs(height_px - box_px) > HEIGHT_PX, "a different height from target_bbox",
         "the height of target_bbox"),
        ("target_bbox", (in_view != has_box) & is_ours, "null in view, or a box out of view",
         "a box if and only if the target is in view"),
        ("target_visible", visible & ~has_mask & is_ours, "true, but target_mask_bbox is null",
         "false without pixels of the target"),
    )))  # fmt: skip


def check_values(track: TrackRows, columns: Sequence[Column], findings: Findings) -> None:
    """Check constants, nulls, closed sets and numbers of the columns of a track's rows, by the table of columns."""
    for column in columns:
        values = track.column(column.name)
        allowed: Sequence[str] = TOKENS if column.words == "actions" else column.words
        must_be_constant = column.constant and not (track.zooms and column.name in ZOOMED)
        for i, value in enumerate(values):
            if must_be_constant and value != values[0]:
                expected = f"{values[0]}, as in the first row of the track"
                findings.error("constant", track.where(i, column.name), value, expected)
                must_be_constant = False  # one finding is enough
            if value is None and column.required and column.of_caption is None:
                findings.error("null", track.where(i, column.name), "null", "a value in every row")
            elif value is not None and allowed and value not in allowed:
                expected = f"one of {len(allowed)} words: {', '.join(allowed[:4])} ..."
                findings.error("closed_set", track.where(i, column.name), repr(value), expected)
            elif isinstance(value, float):
                _check_number(track, i, column, "", value, findings)
            elif isinstance(value, dict) and isinstance(column.type, tuple):
                for member, number in value.items():
                    _check_number(track, i, column, member, number, findings)


def _check_number(
    track: TrackRows, i: int, column: Column, member: str, number: float | None, findings: Findings
) -> None:
    """Check that a number of a column, or of a member of its struct, is there, finite and within its range."""
    low, high = column.ranges.get(member, (-LARGEST, LARGEST))
    if number is not None and low <= number <= high:  # NaN is not
        return
    code = "null"
    if number is not None:
        code = "range" if math.isfinite(number) else "not_finite"
    findings.error(code, track.where(i, f"{column.name}.{member}".rstrip(".")), number, f"{low:g} to {high:g}")


def check_points(track: TrackRows, points: TrackRows, findings: Findings) -> None:
    """Check ids, that a track has all of its points in time, and that each row has the values of its point."""
    for i, row in enumerate(track.rows):
        sample_id, expected = row["sample_id"], f"{track.given_id}_frame_{row['frame_index'] or 0:05d}"
        if track.given_id is not None and sample_id != expected:
            findings.error("sample_id", track.where(i, "sample_id"), repr(sample_id), f"{expected}, by its track")
    if (points.time_s[1:] <= points.time_s[:-1]).any():
        findings.error("time", points.where(0, "time_s"), "times that do not increase", "increasing times")
    if not np.array_equal(points.index, np.arange(len(points))):
        findings.error("points", f"{track.name}: points", "frame indices with gaps", f"0 to {len(points) - 1}")
        return
    for i, row in enumerate(track.rows):
        point = points.rows[track.index[i]] if 0 <= track.index[i] < len(points) else {}
        for name in POINT_NAMES:
            if row.get(name) != point.get(name):
                got = f"{shown(row.get(name))}, and {shown(point.get(name))} in the table of points"
                findings.error("points", track.where(i, name), got, "the same value in both")


# --- the worker -------------------------------------------------------------------------------------------------------

Level = Literal["structure", "rows", "pixels"]
# What a senseless value raises in a check of another value; the cause is reported by a check of its own.
SENSELESS = (ValueError, KeyError, TypeError, IndexError, ArithmeticError, AttributeError)


@dataclass(frozen=True)
class Context:
    """What the checks of tracks need."""

    folder: Path
    record: ReleaseRecord
    level: Level
    reader: CaptionReader | None  # recomputes labels, verdicts and values
    digests: Mapping[str, str]  # file -> sha256

    @cached_property
    def ids(self) -> dict[str, str]:
        """The begin of the sample ids of each track, by the track's name."""
        places = {track.flight: Place(*track.flight.split("/")) for track in self.record.flights}
        ids = flight_ids(list(places.values()))
        return {name: ids[place] for name, place in places.items()}

    def caption_settings(self, track: TrackRows) -> dict[str, Any]:
        """Return the settings of a track's captions, empty if they are not recorded.

        The run in a track's name may be that of a source with the folders above the town added to it.
        """
        run = track.name.split("/")[0]
        sources = [source for source in self.record.provenance.sources if f"{run}_".startswith(f"{source.run}_")]
        stages = max(sources, key=lambda source: len(source.run)).stages if sources else []
        configs = [stage.config for stage in stages if stage.stage == "caption"]
        return configs[0] if len(configs) == 1 else {}

    def window_frames(self, track: TrackRows) -> int:
        """Return the frames of a window of a track; captions of several sources may differ in it."""
        window = self.caption_settings(track).get("window", {})
        return window.get("num_frames", self.record.settings.window_frames)


def make_worker(context: Context) -> Callable[[Item], Outcome]:
    """Return the function that checks a shard in one pass, and returns the counts of its tracks."""

    def work(item: Item) -> Outcome:
        findings, counts = Findings(), list[dict[str, Any]]()
        shard: Shard = item.payload
        files = context.record.settings.modalities
        pictures = read_pictures(context.folder, shard, files) if context.level == "pixels" else iter(())
        clean: TrackRows | None = None  # the points of the clean track before this one
        try:
            for rows, points in read_tracks(context.folder, shard, strict=False):
                frames = replace(rows, given_id=context.ids.get(rows.name))
                if points.is_clean:
                    clean, twin = points, None
                else:  # the clean track of a trajectory goes before the perturbed one
                    is_twin = clean is not None and clean.name.rpartition("/")[0] == points.name.rpartition("/")[0]
                    twin = clean if is_twin else None
                pictures_of_track = islice(pictures, len(frames))
                _check_track(frames, points, twin, pictures_of_track, context, findings)
                deque(pictures_of_track, maxlen=0)  # those that a failed check has not read
                with _reported(frames.name, findings):
                    counts.append(count_track(frames, points).model_dump())
                    findings.compare("leak", f"{frames.name}: split", frames.rows[0]["split"], shard.split)
            for name in (shard.path, shard.points.path):
                if context.level == "pixels" and name in context.digests:
                    sha256 = sha256_file(context.folder / name, tree=context.folder)
                    findings.compare("checksum", name, sha256, context.digests[name])
        except InputError as error:
            where = str(error.where or item.item_id)
            findings.error("unreadable", where, f"{error.what}: {error.got}", "tracks that can be read")
        except SENSELESS as error:
            findings.error("senseless", item.item_id, f"{type(error).__name__}: {error}", "rows that can be read")
        return Outcome({"findings": [kind.model_dump() for kind in findings.issues], "counts": counts})

    return work


@contextmanager
def _reported(name: str, findings: Findings) -> Iterator[None]:
    """Report values that make a check impossible."""
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            yield
    except (InputError, *SENSELESS) as error:
        findings.error("senseless", name, f"{type(error).__name__}: {error}", "values to compute with")


def _check_track(
    frames: TrackRows, points: TrackRows, twin: TrackRows | None, pictures: Iterator[Pictures], context: Context,
    findings: Findings,
) -> None:  # fmt: skip
    """Run all checks of a track."""

    def recompute_captions() -> None:
        track = released_track(frames, points, twin, context.caption_settings(frames))
        if context.reader is not None:
            for mismatch in context.reader(track):
                findings.error(*mismatch)

    checks: list[Callable[[], None]] = [
        lambda: check_values(points, POINTS, findings),
        lambda: check_values(frames, NOT_IN_POINTS, findings),
        lambda: check_camera(points, findings),
        lambda: check_projection(points, findings),
        lambda: check_boxes(points, findings),
        lambda: check_flags(points, findings),
        lambda: check_points(frames, points, findings),
        lambda: check_captions(frames, context.window_frames(frames), findings),
        recompute_captions,
    ]
    if context.level == "pixels":
        checks.append(lambda: check_pictures(frames, pictures, findings))
    for check in checks:
        with _reported(frames.name, findings):
            check()
