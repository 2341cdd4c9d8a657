"""Read a release: its rows, checked for what every reader relies on, its tracks in order, with frames and points, and
the rows of a track as arrays, which checks and exports use.

Memory holds a row group and the points of one shard, however large the release is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby, zip_longest
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cosfly.formats.frames import Camera, FrameFile
from cosfly.formats.people import Goal, People, read_goal
from cosfly.formats.playback import EVENTS, Perturbation, TargetRecord, Track
from cosfly.geometry.axes import rotation_matrices
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import parse_document, validated
from cosfly.runtime.tables import arrow_errors, open_table, row_batches, row_groups
from release.columns import (
    BOX,
    COMPANY_COLUMNS,
    INTRINSICS,
    PICTURES,
    PLACE,
    POINT,
    POINT_NAMES,
    POSE,
    REQUIRED,
    SCALAR_NAMES,
    matrices_of,
    track_name,
)
from release.record import Shard

Row = dict[str, Any]
Pictures = dict[FrameFile, bytes | memoryview | None]  # of a frame
BATCH_ROWS = 2  # whose pictures are in memory at once
MOST_FRAMES = 10_000_000  # of a track
LEAST_ZOOMED = 3  # rows whose camera is not that of most rows
LARGEST = 1e9  # of a value: beyond any town, track and picture
REBUILD = "download the release again, or build it again"


def vectors(rows: Sequence[Row], name: str, members: tuple[str, ...]) -> np.ndarray:
    """Return a column of structs of numbers, (n, members) float64, NaN where null or incomplete."""
    structs = (row.get(name) or {} for row in rows)
    values = [[struct.get(member) for member in members] for struct in structs]
    return np.array(values, dtype=np.float64).reshape(-1, len(members))


def _vectors(name: str, members: tuple[str, ...]) -> cached_property[np.ndarray]:
    """Return the property of `TrackRows` that has a column of structs."""
    return cached_property(lambda track: vectors(track.rows, name, members))


@dataclass(frozen=True)
class TrackRows:
    """The n rows of one track in the order of their frames; a column that a format lacks is None in all rows."""

    name: str  # run/town/trajectory/variant
    rows: Sequence[Row]
    given_id: str | None = None  # what its sample ids must begin with, None if that is not known

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, i: Any, column: str = "") -> str:
        """Return the name of a row, and of a column of it, for messages."""
        row = self.rows[int(i)]
        frame = row.get("sample_id") or f"{self.name} frame {row.get('frame_index')}"
        return f"{frame}: {column}" if column else str(frame)

    def column(self, name: str) -> list[Any]:
        return [row.get(name) for row in self.rows]

    def numbers(self, name: str) -> np.ndarray:
        """Return a column of numbers, (n,) float64, NaN where null."""
        return np.array([np.nan if value is None else value for value in self.column(name)], dtype=np.float64)

    def flags(self, name: str) -> np.ndarray:
        """Return a column of flags, (n,) bool, False where null."""
        return np.array([bool(value) for value in self.column(name)])

    # Columns as float64, NaN where null. Poses are x, y, z in metres and pitch, yaw, roll in degrees, right-handed.
    time_s = cached_property(lambda self: self.numbers("time_s"))  # (n,)
    visibility = cached_property(lambda self: self.numbers("visibility"))  # (n,)
    pose = _vectors("pose", POSE)  # (n, 6)
    target_m = _vectors("target", POINT)  # (n, 3)
    drone_offset = _vectors("drone_offset", POSE)  # (n, 6)
    target_offset = _vectors("target_offset", POINT)  # (n, 3)
    uv = _vectors("target_uv", ("u_px", "v_px"))  # (n, 2)
    box = _vectors("target_bbox", BOX)  # (n, 4) xmin, ymin, xmax, ymax, px
    mask_box = _vectors("target_mask_bbox", BOX)  # (n, 4)
    intrinsics = _vectors("intrinsics", INTRINSICS)  # (n, 4) fx, fy, cx, cy, px

    @cached_property
    def index(self) -> np.ndarray:
        """(n,) int64, the indices of the frames, -1 where null."""
        return np.array([-1 if i is None else i for i in self.column("frame_index")], np.int64)

    @cached_property
    def zooms(self) -> bool:
        """Whether the camera changes; one or two rows that differ from all others are no zoom."""
        _, counts = np.unique(self.intrinsics, axis=0, return_counts=True)
        return bool(len(self) - counts.max() >= LEAST_ZOOMED)

    @cached_property
    def size_px(self) -> np.ndarray:
        """(n, 2) width, height."""
        return np.stack([self.numbers("width_px"), self.numbers("height_px")], axis=1)

    @cached_property
    def is_foreign(self) -> bool:
        """Whether the rows have nothing that only cosfly writes, a box of the person's pixels or the outcome of each
        event of a perturbation. The person may then be of another size."""
        outcomes = [struct or {} for struct in self.column("perturbation")]
        has_outcomes = any(all(outcome.get(event) for event in EVENTS) for outcome in outcomes)
        return bool(np.isnan(self.mask_box).all()) and not has_outcomes

    @cached_property
    def rotations(self) -> np.ndarray:
        """world_from_body, (n, 3, 3)."""
        return rotation_matrices(np.radians(self.pose[:, 3:]))

    @cached_property
    def people(self) -> People | None:
        """What people look like, None if the column is null. Raises InputError, as `goal` does."""
        text, where = self.rows[0].get("people"), self.where(0, "people")
        return None if text is None else validated(People, parse_document(text, where), where)

    @cached_property
    def goal(self) -> Goal | None:
        """Whom to follow, None if the columns are null; its frame is an index in the whole track."""
        values = {name: self.rows[0].get(f"goal_{name}") for name in ("frame", "en", "zh", "says")}
        return None if values["frame"] is None else read_goal(values, MOST_FRAMES, self.where(0, "goal_en"))

    @property
    def is_clean(self) -> bool:
        return self.rows[0].get("track") == "clean"

    @cached_property
    def track(self) -> Track:
        """The rows as a track of a playback tree."""
        first = self.rows[0]
        matrices = matrices_of(self.intrinsics)
        has_mask = not np.isnan(self.mask_box).all()
        target = TargetRecord(
            in_view=self.flags("target_in_view"), visible=self.flags("target_visible"),
            depth_m=self.numbers("target_depth_m"), uv=self.uv, bbox=self.box, visibility=self.visibility,
            mask_bbox=self.mask_box if has_mask else None,
            legible=None if None in self.column("target_legible") else self.flags("target_legible"),
        )  # fmt: skip
        perturbation = Perturbation(
            self.flags("is_perturbed"), self.drone_offset[:, :3], self.drone_offset[:, 3:], self.target_offset
        )
        bystanders = None
        if None not in self.column("others_in_view"):
            bystanders = np.stack([self.numbers(name) for name in COMPANY_COLUMNS], axis=1)
        return Track(
            town=str(first.get("town")), trajectory=str(first.get("trajectory")), variant=str(first.get("variant")),
            camera=Camera(int(self.size_px[0, 0]), int(self.size_px[0, 1]), matrices[0]), time_s=self.time_s,
            positions_m=self.pose[:, :3], rotations_deg=self.pose[:, 3:], targets_m=self.target_m,
            is_original=self.is_clean, target=target, perturbation=perturbation,
            intrinsics=matrices if self.zooms else None, people=self.people, goal=self.goal, bystanders=bystanders,
        )  # fmt: skip


# --- files ------------------------------------------------------------------------------------------------------------


def bounded(value: float) -> float:
    """Return a value that a track can have; raise InputError if it is no finite number, or beyond LARGEST."""
    if not -LARGEST < value < LARGEST:  # NaN is not
        expected = f"a number from {-LARGEST:g} to {LARGEST:g}"
        raise InputError("a value of a track is out of range", where="data", got=str(value), expected=expected)
    return value


def row_lists(shard: Path, columns: Sequence[str], *, strict: bool = True) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of a parquet file of a release, a row group at a time; `strict` raises InputError if a required
    value is null or a number is not finite."""
    for group in row_groups(shard, list(columns), tree=shard.parents[1]):
        if strict:
            _check_values(group, shard)
        with arrow_errors(shard):  # text that is no UTF-8 shows here
            rows = group.to_pylist()
        del group
        yield rows
        del rows


def _check_values(group: pa.Table, shard: Path) -> None:
    """Raise InputError if a required value or a number of a struct is null, or a number is not finite."""
    for member in group.schema:
        where, column = f"{shard}: {member.name}", group.column(member.name)
        parts = [column]
        if pa.types.is_struct(member.type):
            parts = [pc.struct_field(column, i) for i in range(member.type.num_fields)]
        # A struct of numbers is null as a whole or not at all; of one of words some may be null.
        is_of_numbers = all(pa.types.is_floating(part.type) for part in parts)
        is_incomplete = is_of_numbers and any(part.null_count > column.null_count for part in parts)
        if is_incomplete or (member.name in REQUIRED and column.null_count):
            expected = "a value in every row"
            raise InputError("a required value is missing in a row", where=where, got="null", expected=expected)
        for part in parts:
            if pa.types.is_floating(part.type) and pc.all(pc.is_finite(part)).as_py() is False:
                raise InputError("a number is not finite", where=where)


def read_tracks(
    folder: Path, shard: Shard, columns: Sequence[str] = SCALAR_NAMES, *, strict: bool = True
) -> Iterator[tuple[TrackRows, TrackRows]]:
    """Yield the tracks of a shard in order: the rows of the released frames, with these columns, and those of all
    points; InputError if these are not of the same tracks in the same order, or as in `row_lists`."""
    names = [*PLACE, *(name for name in columns if name not in PLACE)]
    tracks_of_frames = _rows_by_track(folder / shard.path, names, strict)
    tracks_of_points = _rows_by_track(folder / shard.points.path, POINT_NAMES, strict)
    for pair in zip_longest(tracks_of_frames, tracks_of_points, fillvalue=(None, iter(()))):
        (place, frames), (place_of_points, points) = pair
        if place is None or place != place_of_points:
            what = "the points file has other tracks than the frames file"
            got, expected = [
                "no further points" if other is None else f"points of {track_name(other)}"
                for other in (place_of_points, place)
            ]
            raise InputError(what, where=folder / shard.points.path, got=got, expected=expected, fix=REBUILD)
        name = track_name(place)
        yield TrackRows(name, list(frames)), TrackRows(name, list(points))


def _rows_by_track(path: Path, columns: Sequence[str], strict: bool) -> Iterator[tuple[Any, Iterator[Row]]]:
    """Yield the place and the rows of each track of a file; the rows are read before the next track."""
    return groupby(chain.from_iterable(row_lists(path, columns, strict=strict)), itemgetter(*PLACE))


def read_pictures(folder: Path, shard: Shard, files: Sequence[FrameFile]) -> Iterator[Pictures]:
    """Yield the pictures of the rows of a shard, in order."""
    names = {file: PICTURES[file].name for file in files}
    path = folder / shard.path
    with open_table(path, tree=folder) as table:
        for group in range(table.num_row_groups):
            for batch in row_batches(path, table, group, list(names.values()), BATCH_ROWS):
                for row in batch.to_pylist():
                    cells = ((file, row[name]) for file, name in names.items())
                    yield {file: cell["bytes"] if isinstance(cell, dict) else cell for file, cell in cells}
