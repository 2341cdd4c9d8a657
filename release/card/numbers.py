"""Every number of the card and of `release.json`, computed from the parquet shards; none is typed.

Memory holds a row group and a few numbers a flight, however many frames there are. Sums are of whole millionths, so
they are exact and the same in any order.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.weather import preset_token
from cosfly.geometry.coverage import Coverage
from cosfly.runtime.errors import InputError
from cosfly.runtime.tables import arrow_errors, num_rows, open_table, row_groups
from release.columns import (
    CAPTION_FIELDS,
    COUNTED,
    PICTURES,
    PLACE,
    POINT,
    REQUIRED,
    VALUE_COLUMNS,
    points_schema,
    schema,
)
from release.record import POINTS_FOLDER, CaptionNumbers, FileNumbers, FramesBy, Numbers, Spread

DIGITS = 4
MILLION = 1_000_000
LARGEST = 1e9  # of a value: beyond any town, flight and picture
# Columns of yes and no whose frames are counted.
FLAGS = ("is_perturbed", "target_in_view", "target_visible", "target_legible", "has_caption")
COVERED = ("style", "pace", "label", "weather", "time_of_day")
COLUMNS = [
    "sample_id", *PLACE, "track", "style", "pace", "weather", "time_of_day", "frame_index", "time_s", "width_px",
    "height_px", "fov_deg", "pose", "drone_offset", "target",
    "target_heading_deg", "target_mask_bbox", "visibility", *FLAGS, *COUNTED, *VALUE_COLUMNS, *CAPTION_FIELDS,
]  # fmt: skip
Place3 = tuple[float, float, float]  # m


def compute_numbers(shards: list[Path], num_frames: int) -> Numbers:
    """Compute every number of the card.

    Args:
        shards: parquet files in their order.
        num_frames: the release's frames per flight; flights with fewer are counted as short.
    """
    counted = RowCounts()
    for shard in shards:
        for rows in row_lists(shard, COLUMNS):
            counted.add(rows)
            del rows  # before the next ones are made
    return counted.numbers(shards, num_frames)


def row_lists(shard: Path, columns: list[str]) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of a shard, a row group at a time, in which every value that must be there is there."""
    for group in row_groups(shard, columns, tree=shard.parents[1]):
        check_columns(group, columns, shard)
        for member in group.schema:
            column = group.column(member.name)
            wanted = 0 if member.name in REQUIRED else column.null_count
            is_struct = pa.types.is_struct(member.type)
            parts = [pc.struct_field(column, i) for i in range(member.type.num_fields)] if is_struct else []
            is_plain = all(pa.types.is_floating(part.type) for part in parts)  # words may be missing
            if any(part.null_count > wanted for part in (column, *(parts if is_plain else ()))):
                where, expected = f"{shard}: {member.name}", "a value in every row"
                raise InputError("the column has no value in a row", where=where, got="null", expected=expected)
        with arrow_errors(shard):  # text that is no UTF-8 shows here
            rows = group.to_pylist()
        del group
        yield rows
        del rows


def check_rows(shard: Path, rows: int) -> None:
    """See that a shard has as many rows as its record says, before they are read; raises as `row_lists`."""
    found = num_rows(shard)
    if found != rows:
        raise InputError(
            "the shard has the wrong number of rows",
            where=shard,
            got=f"{found} rows",
            expected=f"{rows} rows, as in release.json",
        )


def check_columns(group: pa.Table, columns: Iterable[str], shard: Path) -> None:
    """See that columns of a row group are those of a release."""
    expected_schema = points_schema() if shard.parent.name == POINTS_FOLDER else schema(tuple(PICTURES))
    for name in columns:
        found = group.schema.field(name).type if group.schema.get_field_index(name) >= 0 else None
        if found != expected_schema.field(name).type:
            got = "no column of this name" if found is None else str(found)
            expected = str(expected_schema.field(name).type)
            raise InputError(
                "the columns of the shard are not those of a release",
                where=f"{shard}: {name}",
                got=got,
                expected=expected,
            )


@dataclass
class Sum:
    """Count, exact sums in whole millionths, least and greatest of values."""

    count: int = 0
    total: int = 0
    squares: int = 0
    low: int | None = None
    high: int | None = None

    def add(self, value: float) -> None:
        """Add a value.

        Raises:
            InputError: it is no finite number, or beyond LARGEST.
        """
        self.join(Sum(1, *((part := millionths(value)), part * part, part, part)))

    def join(self, other: Sum) -> None:
        """Add the values of another sum."""
        self.count += other.count
        self.total += other.total
        self.squares += other.squares
        if other.low is not None and other.high is not None:
            self.low = other.low if self.low is None else min(self.low, other.low)
            self.high = other.high if self.high is None else max(self.high, other.high)

    def spread(self) -> Spread:
        """Return the sums as the record has them."""
        if not self.count or self.low is None or self.high is None:
            return Spread(count=0, mean=None, std=None, min=None, max=None)
        std = math.sqrt(self.count * self.squares - self.total * self.total) / self.count
        values = (self.total / self.count, std, self.low, self.high)
        mean, std, low, high = (round(value / MILLION, DIGITS) for value in values)
        return Spread(count=self.count, mean=mean, std=std, min=low, max=high)


def millionths(value: float) -> int:
    """Return a value in whole millionths; raises as `Sum.add`."""
    return round(bounded(value) * MILLION)


def bounded(value: float) -> float:
    """Return a value that a flight can have; raises as `Sum.add`."""
    if not -LARGEST < value < LARGEST:  # NaN is not
        expected = f"a number from {-LARGEST:g} to {LARGEST:g}"
        raise InputError("a number of a track is out of range", where="data", got=str(value), expected=expected)
    return value


@dataclass
class FlightCount:
    """What is kept of a flight: frames, its first and last time and place without perturbation (None: not known), the
    way between.

    A place is not known where a perturbed frame does not say how far it was shifted.
    """

    frames: int
    times_s: tuple[float, float]
    ends: tuple[Place3 | None, Place3 | None]
    length: int = 0  # millionths of a metre
    is_known: bool = True

    def join(self, later: FlightCount) -> None:
        """Go on with the frames that follow."""
        before, after = self.ends[1], later.ends[0]
        step = None if before is None or after is None else millionths(math.dist(before, after))
        self.is_known = self.is_known and later.is_known and step is not None
        self.length += later.length + (step or 0)
        self.frames += later.frames
        self.times_s, self.ends = (self.times_s[0], later.times_s[1]), (self.ends[0], later.ends[1])


def clean_place(row: Mapping[str, Any]) -> Place3 | None:
    """Return where the drone would be without the frame's perturbation, m; None where the row does not say."""
    offset = row["drone_offset"]
    if offset is None:
        return None
    x, y, z = (row["pose"][axis] - offset[axis] for axis in POINT)
    return x, y, z


SUMS = ("height_m", "distance_m", "visibility")


@dataclass
class RowCounts:
    """Counts and sums of rows, in their order."""

    rows: int = 0
    counts: dict[str, Counter[str]] = field(
        default_factory=lambda: {name: Counter() for name in (*FramesBy.model_fields, *COUNTED)}
    )
    totals: Counter[str] = field(default_factory=Counter)
    characters: Counter[str] = field(default_factory=Counter)
    values: Counter[str] = field(default_factory=Counter)
    sums: dict[str, Sum] = field(default_factory=lambda: {name: Sum() for name in SUMS})
    flights: dict[tuple[str, ...], FlightCount] = field(default_factory=dict)  # by track and PLACE
    fovs: dict[tuple[str, ...], Counter[str]] = field(default_factory=dict)  # of a trajectory: field of view -> frames
    coverage: Coverage = field(default_factory=Coverage)
    example: dict[str, str] = field(default_factory=dict)

    def add(self, rows: list[dict[str, Any]]) -> None:
        """Count rows that follow those counted so far."""
        seen, named = [], {name: list[str]() for name in COVERED}
        for row in rows:
            seen.append(self._add(row))
            for column, names in named.items():
                names += [row[column]] if row[column] is not None else []
        if rows:
            values = np.array(seen, dtype=np.float64)
            weathers, times = ([*map(preset_token, named[column])] for column in ("weather", "time_of_day"))
            styles, paces, labels = (named[column] for column in ("style", "pace", "label"))
            part = Coverage.of(values, TARGET_HEIGHT_M, styles, paces, labels, weathers, times)
            self.coverage = Coverage.total([self.coverage, part]) if self.rows else part
        self.rows += len(rows)

    def _add(self, row: dict[str, Any]) -> tuple[float, ...]:
        """Count a row; give what the coverage needs: person to drone (x, y, z), heading, height in px, visibility."""
        self.totals.update(name for name in FLAGS if row[name])
        self.totals["legible_told"] += row["target_legible"] is not None
        trajectory = row["run"], row["town"], row["trajectory"]
        self.fovs.setdefault(trajectory, Counter())[f"{row['fov_deg']:g}"] += 1
        size = f"{row['width_px']} x {row['height_px']}"
        for name, value in {"town": row["town"], "track": row["track"], "image_px": size}.items():
            self.counts[name][value] += 1
        pose, target, box = row["pose"], row["target"], row["target_mask_bbox"]
        place = clean_place(row)
        here = FlightCount(1, (row["time_s"], row["time_s"]), (place, place), is_known=place is not None)
        key = (row["track"], *(row[name] for name in PLACE))
        if key in self.flights:
            self.flights[key].join(here)
        else:
            self.flights[key] = here
        offset = [math.nan] * 3 if target is None else [pose[axis] - target[axis] for axis in POINT]
        if target is not None:
            self.sums["height_m"].add(offset[2])
            self.sums["distance_m"].add(math.hypot(*offset))
        if row["visibility"] is not None:
            self.sums["visibility"].add(row["visibility"])
        if row["has_caption"]:
            self._add_caption(row)
        height_px = None if box is None else box["ymax_px"] - box["ymin_px"]
        known = (row["target_heading_deg"], height_px, row["visibility"])
        return (*offset, *(math.nan if value is None else value for value in known))

    def _add_caption(self, row: dict[str, Any]) -> None:
        for name in COUNTED:
            self.counts[name]["none" if row[name] is None else row[name]] += 1
        self.totals["with_label"] += row["label"] is not None
        self.totals["decision_equals_label"] += row["label"] is not None and row["decision"] == row["label"]
        for name in VALUE_COLUMNS:
            self.values[name] += row[name] or 0
        texts = {name: row[name] for name in CAPTION_FIELDS}
        self.example = self.example or {"sample_id": row["sample_id"], **texts}
        self.characters.update({name: len(text or "") for name, text in texts.items()})

    def numbers(self, shards: list[Path], num_frames: int) -> Numbers:
        """Return the numbers of the rows of these shards."""
        self.counts["fov_deg"] = Counter()
        for frames in self.fovs.values():
            self.counts["fov_deg"][_fov_of(frames)] += frames.total()
        flights, sums, totals = self.flights.values(), self.sums, self.totals
        spread = {name: values.spread() for name, values in sums.items()}
        return Numbers(
            frames=self.rows,
            flights=len(flights),
            trajectories=len(self.fovs),
            frames_by=FramesBy(**{name: _sorted(self.counts[name]) for name in FramesBy.model_fields}),
            trajectories_by_fov_deg=_sorted(Counter(map(_fov_of, self.fovs.values()))),
            flights_by_track=_sorted(Counter(track for track, *_ in self.flights)),
            frames_per_flight=spread_of(float(flight.frames) for flight in flights),
            flights_shorter_than_num_frames=sum(flight.frames < (num_frames) for flight in flights),
            flight_duration_s=spread_of(flight.times_s[1] - flight.times_s[0] for flight in flights),
            flight_length_m=spread_of(flight.length / MILLION for flight in flights if flight.is_known),
            height_over_target_m=spread["height_m"],
            distance_to_target_m=spread["distance_m"],
            visibility=spread["visibility"],
            frames_perturbed=totals["is_perturbed"],
            frames_target_in_view=totals["target_in_view"],
            frames_target_visible=totals["target_visible"],
            frames_target_legible=totals["target_legible"] if totals["legible_told"] == self.rows else None,
            coverage=self.coverage if self.rows else Coverage.of(np.empty((0, 6)), TARGET_HEIGHT_M, (), ()),
            captions=self._captions(),
            files=FileNumbers(
                shards=len(shards),
                bytes=sum(shard.stat().st_size for shard in shards),
                bytes_by_modality=stored_bytes(shards),
            ),
        )

    def _captions(self) -> CaptionNumbers:
        num_captions, characters = self.totals["has_caption"], self.characters
        return CaptionNumbers(
            frames_with=num_captions,
            frames_without=self.rows - num_captions,
            with_label=self.totals["with_label"],
            decision_equals_label=self.totals["decision_equals_label"],
            frames_by={name: _sorted(self.counts[name]) for name in COUNTED},
            values={name: self.values[name] for name in VALUE_COLUMNS},
            mean_characters={
                name: round(characters[name] / num_captions, 1) if num_captions else None for name in CAPTION_FIELDS
            },
            example=self.example,
        )


def spread_of(values: Iterable[float]) -> Spread:
    """Return the spread of some values."""
    added = Sum()
    for value in values:
        added.add(value)
    return added.spread()


def stored_bytes(shards: Iterable[Path]) -> dict[str, int]:
    """Return the bytes of each picture column, from the parquet footers; all small columns together as
    `annotations`."""
    owner = {column.name: file for file, column in PICTURES.items()}
    sizes: Counter[str] = Counter()
    for shard in shards:
        with open_table(shard, tree=shard.parents[1]) as table:
            for group in range(table.num_row_groups):
                for column in range(table.metadata.num_columns):
                    chunk = table.metadata.row_group(group).column(column)
                    sizes[owner.get(chunk.path_in_schema.split(".")[0], "annotations")] += chunk.total_compressed_size
    return dict(sorted(sizes.items()))


def _fov_of(frames: Counter[str]) -> str:
    """Name a trajectory's field of view, or say that it changes."""
    return next(iter(frames)) if len(frames) == 1 else "changing"


def _sorted(counts: Counter[str]) -> dict[str, int]:
    """Largest first, then by name: the order does not depend on the rows' order."""
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))
