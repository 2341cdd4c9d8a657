"""What the pictures of some frames hold: percentiles of depth, and shares of pixels by kind. Frames are taken evenly
over the whole release."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M, FrameFile, depth_values
from cosfly.formats.kinds import KIND_NAMES
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.png import colours_of
from cosfly.runtime.tables import arrow_errors, open_table, row_groups
from cosfly.viz.frame_views import small_jpeg
from release.columns import PICTURES
from release.reading import check_columns
from release.record import ReleaseRecord

BIN_M, MOST_M = 0.25, 1000.0  # bins of the depth histogram; percentiles are to a bin
PICTURE_PX, JPEG_QUALITY = 640, 80
SHARES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@dataclass
class Pixels:
    """Pixels of the frames that were looked at, by depth and by kind; frames that show a kind at all."""

    frames: int = 0
    depths: np.ndarray = field(default_factory=lambda: np.zeros(int(MOST_M / BIN_M), dtype=np.int64))
    sky: int = 0
    invalid: int = 0
    kinds: np.ndarray = field(default_factory=lambda: np.zeros(256, dtype=np.int64))
    frames_with: np.ndarray = field(default_factory=lambda: np.zeros(256, dtype=np.int64))

    def add_depth(self, depth_m: np.ndarray) -> None:
        """Count the pixels of a depth image, (h, w) m."""
        self.sky += int((depth_m >= SKY_DEPTH_M).sum())
        self.invalid += int((depth_m <= INVALID_DEPTH_M).sum())
        known = depth_m[(depth_m > INVALID_DEPTH_M) & (depth_m < SKY_DEPTH_M)]
        self.depths += np.bincount((known / BIN_M).astype(np.int64), minlength=len(self.depths))[: len(self.depths)]

    def add_kinds(self, kinds: np.ndarray) -> None:
        """Count the pixels of a semantic image, (h, w) uint8."""
        counts = np.bincount(kinds.ravel(), minlength=256)
        self.kinds += counts
        self.frames_with += counts > 0

    def percentiles_m(self) -> list[tuple[float, float]]:
        """Return (share, m) of SHARES, to BIN_M; empty where no depth is known."""
        total = int(self.depths.sum())
        ends = np.cumsum(self.depths)
        return [(share, float((np.searchsorted(ends, share * total) + 1) * BIN_M)) for share in SHARES] if total else []

    def by_kind(self) -> list[tuple[str, float, float]]:
        """Return kind, share of all pixels, share of the frames that show it; the largest first."""
        order = sorted(np.flatnonzero(self.kinds).tolist(), key=lambda kind: -self.kinds[kind])
        total = int(self.kinds.sum())
        return [
            (KIND_NAMES.get(kind, f"kind {kind}"), self.kinds[kind] / total, self.frames_with[kind] / self.frames)
            for kind in order
        ]


def look_at(dataset: Path, record: ReleaseRecord, most: int) -> Pixels:
    """Decode at most `most` frames, spread evenly over the rows."""
    pixels, files = Pixels(), [file for file in record.settings.modalities if file != "rgb"]
    total = sum(shard.rows for shard in record.shards)
    wanted = {int(i) for i in np.linspace(0, total - 1, min(total, most)).round()} if files else set()
    with progress_bar("stats: pictures", len(wanted)) as advance:
        for row in _rows(dataset, record, files, wanted):
            pixels.frames += 1
            for file in files:
                where, cell = f"{row['sample_id']}: {PICTURES[file].name}", row[PICTURES[file].name]
                if file == "depth":
                    pixels.add_depth(depth_values(cell or b"", Path(where)))
                else:
                    pixels.add_kinds(colours_of((cell or {}).get("bytes") or b"", where)[..., 0])
            advance(1)
    return pixels


def middle_picture(dataset: Path, record: ReleaseRecord) -> str | None:
    """Return the colour picture of the middle frame, JPEG in base64; None where there is none, or it cannot be read."""
    if "rgb" not in record.settings.modalities:
        return None
    total = sum(shard.rows for shard in record.shards)
    for row in _rows(dataset, record, ["rgb"], {total // 2}):
        with contextlib.suppress(InputError):
            data = (row[PICTURES["rgb"].name] or {}).get("bytes") or b""
            return small_jpeg(colours_of(data, row["sample_id"]), PICTURE_PX, JPEG_QUALITY)
    return None


def _rows(
    dataset: Path, record: ReleaseRecord, files: Sequence[FrameFile], wanted: set[int]
) -> Iterator[dict[str, Any]]:
    """Yield the wanted rows by their number in the release; row groups without one are not read."""
    columns = ["sample_id", *(PICTURES[file].name for file in files)]
    begin = 0
    for shard in record.shards:
        path = dataset / shard.path
        with open_table(path, tree=dataset) as table:
            sizes = [table.metadata.row_group(k).num_rows for k in range(table.num_row_groups)]
        starts = (begin + np.cumsum([0, *sizes])).tolist()
        chosen = {k: [i - starts[k] for i in range(starts[k], starts[k + 1]) if i in wanted] for k in range(len(sizes))}
        groups = [k for k, rows in chosen.items() if rows]
        for k, group in zip(groups, row_groups(path, columns, tree=dataset, wanted=groups), strict=True):
            check_columns(group, columns, path)
            with arrow_errors(path):
                rows = group.take(chosen[k]).to_pylist()
            yield from rows
        begin = starts[-1]
