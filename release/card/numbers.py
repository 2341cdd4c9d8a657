"""Every number of the card and of `release.json`, computed from the parquet shards; none is typed."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.products.coverage import NAMED, Coverage, axis_values
from cosfly.reading.tables import open_table, rows_of
from release.columns import CAPTION_FACTS, CAPTION_FIELDS, CAPTION_SHARES, PICTURES, PLACE, POINT, SCALAR_NAMES
from release.record import CaptionNumbers, FileNumbers, FramesBy, Numbers, Spread

DIGITS = 4
# Columns of yes and no whose frames are counted.
FLAGS = ("is_perturbed", "target_in_view", "target_visible", "has_caption")


def read_rows(shards: Iterable[Path], columns: list[str] = SCALAR_NAMES) -> Iterator[dict[str, Any]]:
    """Yield the rows of all shards, a row group at a time; by default without pictures and depth."""
    for shard in shards:
        yield from rows_of(shard, columns, tree=shard.parents[1])


def compute_numbers(shards: list[Path], num_frames: int) -> Numbers:
    """Compute every number of the card.

    Args:
        shards: parquet files in their order.
        num_frames: the release's frames per flight; flights with fewer are counted as short.
    Returns:
        sums are exact (fsum), so that the same rows give the same digits everywhere.
    """
    counted = _Rows()
    for row in read_rows(shards):
        counted.add(row)
    return counted.numbers(shards, num_frames)


class _Rows:
    """Counts and values of rows that were read one after the other."""

    def __init__(self) -> None:
        self.counts = {name: Counter[str]() for name in (*FramesBy.model_fields, *CAPTION_FACTS)}
        self.totals, self.characters = Counter[str](), Counter[str]()
        self.flights: dict[tuple[str, ...], list[tuple[float, float, float, float]]] = {}
        self.samples: dict[str, list[float]] = {
            name: [] for name in ("height_m", "distance_m", "visibility", *CAPTION_SHARES)
        }
        self.fovs: dict[tuple[str, ...], str] = {}  # a trajectory keeps its field of view
        self.example: dict[str, str] = {}
        # For the coverage: person to drone (x, y, z), heading, height in px, visibility.
        self.seen: list[tuple[float, ...]] = []
        self.named: dict[str, list[str]] = {name: [] for name in NAMED}

    def add(self, row: dict[str, Any]) -> None:
        self.totals.update(name for name in FLAGS if row[name])
        fov = self.fovs[row["run"], row["town"], row["trajectory"]] = f"{row['fov_deg']:g}"
        size = f"{row['width_px']} x {row['height_px']}"
        for name, value in {"town": row["town"], "track": row["track"], "fov_deg": fov, "image_px": size}.items():
            self.counts[name][value] += 1
        pose, target, box = row["pose"], row["target"], row["target_mask_bbox"]
        flight = self.flights.setdefault((row["track"], *(row[name] for name in PLACE)), [])
        flight.append((row["time_s"], pose["x_m"], pose["y_m"], pose["z_m"]))
        offset = [math.nan] * 3 if target is None else [pose[axis] - target[axis] for axis in POINT]
        if target is not None:
            self.samples["height_m"].append(offset[2])
            self.samples["distance_m"].append(math.hypot(*offset))
        for name in ("visibility", *CAPTION_SHARES):
            if row[name] is not None:
                self.samples[name].append(row[name])
        height_px = None if box is None else box["ymax_px"] - box["ymin_px"]
        known = (row["target_heading_deg"], height_px, row["visibility"])
        self.seen.append((*offset, *(math.nan if value is None else value for value in known)))
        for kind, column in zip(NAMED, ("style", "pace", "label"), strict=True):
            self.named[kind] += [row[column]] if row[column] is not None else []
        if row["has_caption"]:
            self._add_caption(row)

    def _add_caption(self, row: dict[str, Any]) -> None:
        for name in CAPTION_FACTS:
            self.counts[name]["none" if row[name] is None else row[name]] += 1
        self.totals["with_label"] += row["label"] is not None
        self.totals["decision_equals_label"] += row["label"] is not None and row["decision"] == row["label"]
        texts = {name: row[name] for name in CAPTION_FIELDS}
        self.example = self.example or {"sample_id": row["sample_id"], **texts}
        self.characters.update({name: len(text or "") for name, text in texts.items()})

    def numbers(self, shards: list[Path], num_frames: int) -> Numbers:
        flights, samples, totals = self.flights.values(), self.samples, self.totals
        return Numbers(
            frames=len(self.seen),
            flights=len(flights),
            trajectories=len(self.fovs),
            frames_by=FramesBy(**{name: _sorted(self.counts[name]) for name in FramesBy.model_fields}),
            trajectories_by_fov_deg=_sorted(Counter(self.fovs.values())),
            flights_by_track=_sorted(Counter(track for track, *_ in self.flights)),
            frames_per_flight=_spread([float(len(points)) for points in flights]),
            flights_shorter_than_num_frames=sum(len(points) < num_frames for points in flights),
            flight_duration_s=_spread([points[-1][0] - points[0][0] for points in flights]),
            flight_length_m=_spread([_length(points) for points in flights]),
            height_over_target_m=_spread(samples["height_m"]),
            distance_to_target_m=_spread(samples["distance_m"]),
            visibility=_spread(samples["visibility"]),
            frames_perturbed=totals["is_perturbed"],
            frames_target_in_view=totals["target_in_view"],
            frames_target_visible=totals["target_visible"],
            coverage=self._coverage(),
            captions=self._captions(),
            files=FileNumbers(
                shards=len(shards),
                bytes=sum(shard.stat().st_size for shard in shards),
                bytes_by_modality=stored_bytes(shards),
            ),
        )

    def _coverage(self) -> Coverage:
        seen = np.array(self.seen, dtype=np.float64).reshape(-1, 6)
        return Coverage.of(axis_values(seen[:, :3], *seen[:, 3:].T), *(self.named[kind] for kind in NAMED))

    def _captions(self) -> CaptionNumbers:
        num_captions, characters = self.totals["has_caption"], self.characters
        facts: dict[str, Any] = {name: _sorted(self.counts[name]) for name in CAPTION_FACTS}
        return CaptionNumbers(
            frames_with=num_captions,
            frames_without=len(self.seen) - num_captions,
            with_label=self.totals["with_label"],
            decision_equals_label=self.totals["decision_equals_label"],
            **facts,
            mean_proved={name: _spread(self.samples[name]).mean for name in CAPTION_SHARES},
            mean_characters={
                name: round(characters[name] / num_captions, 1) if num_captions else None for name in CAPTION_FIELDS
            },
            example=self.example,
        )


def stored_bytes(shards: Iterable[Path]) -> dict[str, int]:
    """Give the bytes of each picture column, from the parquet footers; all small columns together as `annotations`."""
    owner = {column.name: file for file, column in PICTURES.items()}
    sizes: Counter[str] = Counter()
    for shard in shards:
        with open_table(shard, tree=shard.parents[1]) as table:
            for group in range(table.num_row_groups):
                for column in range(table.metadata.num_columns):
                    chunk = table.metadata.row_group(group).column(column)
                    sizes[owner.get(chunk.path_in_schema.split(".")[0], "annotations")] += chunk.total_compressed_size
    return dict(sorted(sizes.items()))


def _length(points: list[tuple[float, float, float, float]]) -> float:
    return math.fsum(math.dist(a[1:], b[1:]) for a, b in itertools.pairwise(points))


def _spread(values: list[float]) -> Spread:
    if not values:
        return Spread(count=0, mean=None, std=None, min=None, max=None)
    mean = math.fsum(values) / len(values)
    std = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / len(values))
    mean, std, low, high = (round(value, DIGITS) for value in (mean, std, min(values), max(values)))
    return Spread(count=len(values), mean=mean, std=std, min=low, max=high)


def _sorted(counts: Counter[str]) -> dict[str, int]:
    """Largest first, then by name: the order does not depend on the rows' order."""
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))
