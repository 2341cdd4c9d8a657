"""Windows over the two tracks of a flight (app:dual_track): a set of samples to learn denoising and prediction from. Needs no torch.

tracks.json                                whence it came, its splits, how windows are cut
train.parquet  val.parquet  test.parquet   a window a row; a split without windows has no file
README.md                                  for `datasets.load_dataset`
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
from pydantic import BaseModel, ConfigDict

from cosfly.products.splits import Split
from cosfly.reading.documents import read_model, validation_errors
from cosfly.reading.tables import rows_of
from cosfly.work.store import write_bytes, write_model
from distill.schema import PAGE, SourceTree, SplitFiles, page_of, split_path

RECORD, RECORD_SCHEMA, VERSION = "tracks.json", "cosfly.track_windows", "1.0"
AXES = "right-handed: metres, x east, y north, z up; degrees, yaw counter-clockwise from east, pitch nose-up"

Vector = tuple[float, float, float]


class TrackSample(BaseModel):
    """One window: what was seen on the perturbed track, where drone and person really were then, and where they went.

    *_position_m, *_rotation_deg: the camera's x, y, z and pitch, yaw, roll; *_target_m: the person's hip point, None where nobody is.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    sample_id: str  # as a caption's of the same observed frames
    run: str  # the tree that its flight stands in
    town: str
    trajectory: str
    variant: str  # of the perturbed flight
    walk: str  # whom it follows: windows of one walk are in one split
    window: tuple[int, ...]  # indices of the observed frames, oldest first
    future: tuple[int, ...]  # of the frames to predict
    time_s: tuple[float, ...]  # of both
    states: tuple[str | None, ...]  # of the observed frames: STATES of cosfly/products/playback.py
    observed_position_m: tuple[Vector, ...]  # perturbed: what a model is given
    observed_rotation_deg: tuple[Vector, ...]
    observed_target_m: tuple[Vector | None, ...]
    clean_position_m: tuple[Vector, ...]  # of the same frames: the target of denoising
    clean_rotation_deg: tuple[Vector, ...]
    clean_target_m: tuple[Vector | None, ...]
    future_position_m: tuple[Vector, ...]  # the target of prediction
    future_rotation_deg: tuple[Vector, ...]
    future_target_m: tuple[Vector | None, ...]

    @property
    def key(self) -> str:
        return self.sample_id

    @property
    def language(self) -> str:
        """None: there are no words in it."""
        return ""


_VECTORS = pa.list_(pa.field("element", pa.list_(pa.field("element", pa.float64()))))
COLUMNS = pa.schema([
    *(pa.field(name, pa.string(), nullable=False) for name in ("sample_id", "run", "town", "trajectory", "variant", "walk")),
    *(pa.field(name, pa.list_(pa.field("element", pa.int32())), nullable=False) for name in ("window", "future")),
    pa.field("time_s", pa.list_(pa.field("element", pa.float64())), nullable=False),
    pa.field("states", pa.list_(pa.field("element", pa.string())), nullable=False),
    *(
        pa.field(f"{part}_{what}", _VECTORS, nullable=False)
        for part in ("observed", "clean", "future")
        for what in ("position_m", "rotation_deg", "target_m")
    ),
])  # fmt: skip


class TrackSet(BaseModel):
    """`tracks.json`. samples: windows of each split; observed, predicted, stride: of a window, in frames."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    split_by: Literal["walk", "town"]
    observed: int
    predicted: int
    stride: int
    axes: str = AXES
    trees: list[SourceTree]
    samples: dict[Split, int]


def write_record(out: Path, record: TrackSet) -> list[Path]:
    """Write the record and the page of a set whose splits stand; gives their paths."""
    write_model(out / RECORD, record, schema=RECORD_SCHEMA, version=VERSION)
    text = (
        f"Windows of {record.observed} frames that were observed on a perturbed flight (`observed_*`), where drone and person really were in them\n"
        f"(`clean_*`) and in the {record.predicted} frames after them (`future_*`); a window begins every {record.stride} frames. No two splits share\n"
        f"a {record.split_by}. Axes: {record.axes}. The pictures are frames `window` of the playback trees of\n"
        f"{json.dumps([tree.run for tree in record.trees], ensure_ascii=False)}, which are not part of it.\n"
    )
    write_bytes(out / PAGE, page_of("Windows over two tracks", record.samples, text))
    return [out / RECORD, out / PAGE]


def read_track_set(dataset: Path) -> TrackSet:
    """Read the record of a set of windows.

    Raises:
        InputError: it is missing, of another version, or malformed.
    """
    return read_model(
        dataset / RECORD, TrackSet, schema=RECORD_SCHEMA, version=VERSION, what="set of windows", tree=dataset
    )


def read_track_samples(dataset: Path, split: Split) -> Iterator[TrackSample]:
    """Yield the windows of a split, a row group in memory; none where it has none.

    Raises:
        InputError: names the file, the row and the field.
    """
    if not read_track_set(dataset).samples.get(split):
        return
    path = split_path(dataset, split)
    for number, row in enumerate(rows_of(path, COLUMNS.names, tree=dataset)):
        with validation_errors(f"{path}: row {number}"):
            yield TrackSample.model_validate(row)


def add_sample(files: SplitFiles, split: Split, sample: TrackSample) -> None:
    """Write a sample into its split's file."""
    row: dict[str, Any] = sample.model_dump(mode="json")
    files.add(split, row)
