"""Read a release: its rows, checked for what every reader relies on, and its tracks with frames and points, in order;
and the rows of a track as arrays, which checks and exports use.

Memory holds a row group and the points of one shard, however large the release is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cosfly.formats.captions import FIELDS
from cosfly.formats.frames import Camera, FrameFile
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.people import Goal, People, read_goal
from cosfly.formats.playback import EVENTS, Perturbation, TargetRecord, Track
from cosfly.formats.shown_captions import ReleasedTrack, ShownCaption
from cosfly.geometry.axes import BODY_FROM_CAMERA, CORNER_SIGNS, rotation_matrices
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import parse_document, validated
from cosfly.runtime.tables import arrow_errors, open_table, row_batches, row_groups
from release.columns import (
    BOX,
    COMPANY_COLUMNS,
    INTRINSICS,
    LANGUAGES,
    PICTURES,
    PLACE,
    POINT,
    POINT_NAMES,
    POSE,
    REQUIRED,
    SCALAR_NAMES,
    VALUES,
    matrices_of,
    track_name,
)
from release.record import Shard

Row = dict[str, Any]
Pictures = dict[FrameFile, bytes | memoryview | None]  # of a frame
BATCH_ROWS = 2  # whose pictures are in memory at once
NEAR_M = 0.3  # the renderers' near plane
MOST_FRAMES = 10_000_000  # of a track
LEAST_ZOOMED = 3  # rows whose camera is not that of most rows
LARGEST = 1e9  # of a value: beyond any town, track and picture
REBUILD = "download the release again, or build it again"


def vectors(rows: Sequence[Row], name: str, members: tuple[str, ...]) -> np.ndarray:
    """Return a column of groups, (n, members) float64, NaN where null or incomplete."""
    groups = (row.get(name) or {} for row in rows)
    return np.array([[group.get(m) for m in members] for group in groups], dtype=np.float64).reshape(-1, len(members))


def _vectors(name: str, members: tuple[str, ...]) -> cached_property[np.ndarray]:
    return cached_property(lambda track: vectors(track.rows, name, members))


@dataclass(frozen=True)
class TrackRows:
    """The rows of one track in the order of their frames, with the columns of a release; a column that a format lacks
    is None everywhere.

    name: `run/town/trajectory/variant`. given_id: what its sample ids must begin with, None where nobody knows.
    is_foreign: nothing says that cosfly drew it, so that its person may be of another size.
    """

    name: str
    rows: Sequence[Row]
    given_id: str | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, i: Any, column: str = "") -> str:
        """Name a row, and a column of it."""
        row = self.rows[int(i)]
        place = row.get("sample_id") or f"{self.name} frame {row.get('frame_index')}"
        return f"{place}: {column}" if column else str(place)

    def column(self, name: str) -> list[Any]:
        return [row.get(name) for row in self.rows]

    def numbers(self, name: str) -> np.ndarray:
        """Return a column of numbers, (n,) float64, NaN where null."""
        return np.array([np.nan if value is None else value for value in self.column(name)], dtype=np.float64)

    def flags(self, name: str) -> np.ndarray:
        return np.array([bool(value) for value in self.column(name)])

    index = cached_property(
        lambda self: np.array([-1 if i is None else i for i in self.column("frame_index")], np.int64)
    )
    time_s = cached_property(lambda self: self.numbers("time_s"))
    visibility = cached_property(lambda self: self.numbers("visibility"))
    pose = _vectors("pose", POSE)
    target_m = _vectors("target", POINT)
    drone_offset = _vectors("drone_offset", POSE)
    target_offset = _vectors("target_offset", POINT)
    uv = _vectors("target_uv", ("u_px", "v_px"))
    box = _vectors("target_bbox", BOX)
    mask_box = _vectors("target_mask_bbox", BOX)
    intrinsics = _vectors("intrinsics", INTRINSICS)

    @cached_property
    def zooms(self) -> bool:
        """Whether its camera changes; one or two rows that differ from all others are no zoom."""
        _, counts = np.unique(self.intrinsics, axis=0, return_counts=True)
        return bool(len(self) - counts.max() >= LEAST_ZOOMED)

    @cached_property
    def size_px(self) -> np.ndarray:
        """(n, 2) width, height."""
        return np.stack([self.numbers("width_px"), self.numbers("height_px")], axis=1)

    @cached_property
    def events(self) -> list[dict[str, str] | None]:
        groups = self.column("perturbation")
        return [group if group and all(group.get(event) for event in EVENTS) else None for group in groups]

    @cached_property
    def is_foreign(self) -> bool:
        """Nothing in the rows is what only cosfly writes: the box of the person's pixels, or what became of a
        perturbation."""
        return bool(np.isnan(self.mask_box).all()) and not any(self.events)

    @cached_property
    def rotations(self) -> np.ndarray:
        """world_from_body, (n, 3, 3)."""
        return rotation_matrices(np.radians(self.pose[:, 3:]))

    @cached_property
    def projected_corners(self) -> np.ndarray:
        """The corners of a person of ours at each row's target, (n, 8, 2) px; NaN where one lies behind the camera."""
        corners = self.target_m[:, None, :] + CORNER_SIGNS * np.array(PERSON_HALF_EXTENTS_M)
        body = np.einsum("nji,nkj->nki", self.rotations, corners - self.pose[:, None, :3])
        x, y, z = np.moveaxis(body @ BODY_FROM_CAMERA, 2, 0)
        fx, fy, cx, cy = (values[:, None] for values in self.intrinsics.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = np.stack([fx * x / z + cx, fy * y / z + cy], axis=2)
        uv[~(z > NEAR_M).all(axis=1)] = np.nan
        return uv

    @cached_property
    def people(self) -> People | None:
        """What people look like, None where nobody says. Raises InputError, as `goal` does."""
        told, where = self.rows[0].get("people"), self.where(0, "people")
        return None if told is None else validated(People, parse_document(told, where), where)

    @cached_property
    def goal(self) -> Goal | None:
        """Whom to follow; its frame is that of the whole track."""
        told = {name: self.rows[0].get(f"goal_{name}") for name in ("frame", "en", "zh", "says")}
        is_told = told["frame"] is not None
        return read_goal(told, MOST_FRAMES, self.where(0, "goal_en")) if is_told else None

    @property
    def is_clean(self) -> bool:
        return self.rows[0].get("track") == "clean"

    @cached_property
    def track(self) -> Track:
        """The same as a track of the playback tree, for those who know that."""
        first = self.rows[0]
        matrices = matrices_of(self.intrinsics)
        camera = Camera(int(self.size_px[0, 0]), int(self.size_px[0, 1]), matrices[0])
        has_mask = not np.isnan(self.mask_box).all()
        return Track(
            town=str(first.get("town")), trajectory=str(first.get("trajectory")), variant=str(first.get("variant")),
            camera=camera, time_s=self.time_s, positions_m=self.pose[:, :3], rotations_deg=self.pose[:, 3:],
            targets_m=self.target_m, is_original=self.is_clean,
            target=TargetRecord(
                in_view=self.flags("target_in_view"), visible=self.flags("target_visible"),
                depth_m=self.numbers("target_depth_m"), uv=self.uv, bbox=self.box,
                visibility=self.numbers("visibility"), mask_bbox=self.mask_box if has_mask else None,
                legible=None if None in self.column("target_legible") else self.flags("target_legible"),
            ),
            perturbation=Perturbation(
                self.flags("is_perturbed"), self.drone_offset[:, :3], self.drone_offset[:, 3:], self.target_offset
            ),
            intrinsics=matrices if self.zooms else None,
            people=self.people, goal=self.goal, bystanders=None if None in self.column("others_in_view")
            else np.stack([self.numbers(name) for name in COMPANY_COLUMNS], axis=1),
        )  # fmt: skip

    def shown(self, points: TrackRows, twin: TrackRows | None, settings: dict[str, Any]) -> ReleasedTrack:
        """Return what a checker of captions needs. points, twin: All points of this track and of its clean one.
        settings: Of the captions, as the record has them."""
        captions = [shown_caption(row) for row in self.rows if row.get("has_caption")]
        same = twin is not None and len(twin) == len(points)
        return ReleasedTrack(points.track, captions, twin.track if twin is not None and same else None, settings)


def shown_caption(row: Row) -> ShownCaption:
    """Return the caption of a row. Raises KeyError and TypeError where the row has not all of one, which is found
    elsewhere."""
    return ShownCaption(
        sample_id=row["sample_id"],
        frame_index=row["frame_index"],
        window=row["caption_window"] or [],
        picture_px=tuple(row["caption_picture_px"]),
        prompts={language: row[f"prompt_{language}"] for language in LANGUAGES if row.get(f"prompt_{language}")},
        texts={language: {name: row[f"caption_{language}_{name}"] for name in FIELDS} for language in LANGUAGES},
        writing=row["writing"],
        values={language: tuple(row[f"{name}_{language}"] for name in VALUES) for language in LANGUAGES},
        evidence=row["evidence"],
        decision=row["decision"],
        repair=row["repair_strategy"],
        label=row["label"],
        verdict=row["verdict"],
    )


# --- files ------------------------------------------------------------------------------------------------------------


def bounded(value: float) -> float:
    """Return a value that a track can have; raise InputError if it is no finite number, or beyond LARGEST."""
    if not -LARGEST < value < LARGEST:  # NaN is not
        expected = f"a number from {-LARGEST:g} to {LARGEST:g}"
        raise InputError("a value of a track is out of range", where="data", got=str(value), expected=expected)
    return value


def row_lists(shard: Path, columns: Sequence[str], *, strict: bool = True) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of a parquet file of a release, a row group at a time.

    Args:
        strict: Raise InputError if a value that must be there is null, or a number is not finite.
    """
    for group in row_groups(shard, list(columns), tree=shard.parents[1]):
        if strict:
            _check_values(group, shard)
        with arrow_errors(shard):  # text that is no UTF-8 shows here
            rows = group.to_pylist()
        del group
        yield rows
        del rows


def _check_values(group: pa.Table, shard: Path) -> None:
    """Raise InputError if a required column has a null, or a column of numbers one that is not finite."""
    for member in group.schema:
        column = group.column(member.name)
        most_nulls = 0 if member.name in REQUIRED else column.null_count
        is_struct = pa.types.is_struct(member.type)
        parts = [pc.struct_field(column, i) for i in range(member.type.num_fields)] if is_struct else []
        is_plain = all(pa.types.is_floating(part.type) for part in parts)  # words may be missing
        if any(part.null_count > most_nulls for part in (column, *(parts if is_plain else ()))):
            where, expected = f"{shard}: {member.name}", "a value in every row"
            raise InputError("a required value is missing in a row", where=where, got="null", expected=expected)
        for part in parts or [column]:
            if pa.types.is_floating(part.type) and pc.all(pc.is_finite(part)).as_py() is False:
                raise InputError("a number is not finite", where=f"{shard}: {member.name}")


def read_tracks(
    folder: Path, shard: Shard, columns: Sequence[str] = SCALAR_NAMES, *, strict: bool = True
) -> Iterator[tuple[TrackRows, TrackRows]]:
    """Yield the tracks of a shard in order: the rows of the released frames, and those of all points.

    Args:
        columns: Of the frames, besides PLACE; never pictures. strict: As in `row_lists`.
    Raises:
        InputError: Frames and points are not of the same tracks in the same order.
    """
    names = [*PLACE, *(name for name in columns if name not in PLACE)]
    both = [
        groupby(chain.from_iterable(row_lists(folder / file.path, wanted, strict=strict)), itemgetter(*PLACE))
        for file, wanted in ((shard, names), (shard.points, POINT_NAMES))
    ]
    points = both[1]
    for place, frames in both[0]:
        own, of_points = next(points, (None, ()))
        if own != place:
            got = "no further points" if own is None else f"points of {track_name(own)}"
            what, expected = "the points file has other tracks than the frames file", f"points of {track_name(place)}"
            raise InputError(what, where=folder / shard.points.path, got=got, expected=expected, fix=REBUILD)
        name = track_name(place)
        yield TrackRows(name, list(frames)), TrackRows(name, list(of_points))
    if (more := next(points, None)) is not None:
        what, got = "the points file has other tracks than the frames file", f"points of {track_name(more[0])}"
        raise InputError(what, where=folder / shard.points.path, got=got, expected="no further points", fix=REBUILD)


def read_pictures(folder: Path, shard: Shard, files: Sequence[FrameFile]) -> Iterator[Pictures]:
    """Yield the pictures of the rows of a shard, in order."""
    names, path = {file: PICTURES[file].name for file in files}, folder / shard.path
    with open_table(path, tree=folder) as table:
        for group in range(table.num_row_groups):
            for batch in row_batches(path, table, group, list(names.values()), BATCH_ROWS):
                for row in batch.to_pylist():
                    cells = ((file, row[name]) for file, name in names.items())
                    yield {file: cell["bytes"] if isinstance(cell, dict) else cell for file, cell in cells}
