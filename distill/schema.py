"""The training set, which the steps of `distill` share: its record, its one reader and its one writer. Needs no torch.

training_set.json                          the playback trees, how the set was split, and the samples of each split
train.parquet  val.parquet  test.parquet   one sample per row; a split without samples has no file
README.md                                  what is in it; `datasets.load_dataset` opens the folder
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel

from cosfly.formats.captions import FIELDS, Language, Place, Prompt
from cosfly.formats.frames import frame_name
from cosfly.formats.predictions import Split
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_file, write_bytes
from cosfly.runtime.json_io import FileFormat, Record, dump_json, read_model, validated
from cosfly.runtime.run_dir import fingerprint
from cosfly.runtime.tables import rows_of
from cosfly.viz.frame_views import VIEW_FILES, Pictures, View

RECORD, RECORD_FORMAT = "training_set.json", FileFormat("cosfly.training_set", "5.0", "training set")
PAGE = "README.md"
ROWS_AT_ONCE = 1000  # rows of a row group: reading one sample decodes them all


class SplitMember(Record):
    """The identity of a sample of any kind."""

    sample_id: str  # unique in the set
    run: str  # the playback tree of its track
    town: str
    trajectory: str
    variant: str
    walk: str  # its pedestrian trajectory: all samples of one are in one split
    window: tuple[int, ...]  # indices of its frames, oldest first


class Sample(SplitMember):
    """What the student sees, and the answer that it learns."""

    language: Language
    window_id: str  # of its window in its tree, as the captions name it
    views: tuple[View, ...]  # the pictures of each frame, in this order
    picture_px: tuple[int, int]  # (width, height) of each, to which pixel values of prompt and answer refer
    depth_range_m: float  # dark end of depth pictures
    prompt: Prompt  # names these pictures
    answer: str  # JSON text of the three fields
    decision: str  # the answer's flight_decision
    label: str | None  # the decision that the future geometry implies; None: undetermined
    contradicted: tuple[str, ...] | None  # decisions that the future geometry rules out; None: unknown
    past: tuple[float, ...] = ()  # see cosfly/inspection/blind_baseline.py; () if unknown

    @property
    def key(self) -> str:
        """Unique name of the sample."""
        return f"{self.sample_id}/{self.language}"

    @property
    def frames(self) -> list[str]:
        """Folders of its frames in the playback tree, oldest first."""
        return [f"{self.town}/{self.trajectory}/{self.variant}/{frame_name(index)}" for index in self.window]

    @property
    def pictures(self) -> Pictures:
        return Pictures(self.views, self.picture_px, "separate", self.depth_range_m)

    def without_pictures(self) -> Sample:
        """Return the sample for a student that takes no pictures; its prompt says that none are given."""
        no_pictures = Pictures((), self.picture_px)
        user = self.prompt.user.replace(self.pictures.sentence(self.language), no_pictures.sentence(self.language))
        return self.model_copy(update={"views": (), "prompt": self.prompt.model_copy(update={"user": user})})

    @property
    def images(self) -> list[str]:
        """Files of the playback tree in the order of the pictures: frame by frame, the views of a frame together."""
        return [f"{frame}/{VIEW_FILES[view]}" for frame in self.frames for view in self.views]


def decision_place(answer: str) -> Place:
    """Return where the decision is among the fields of the JSON text of an answer."""
    return "first" if answer.lstrip("{ ").startswith(f'"{FIELDS[-1]}"') else "last"


class SourceTree(Record):
    """A playback tree whose frames the samples name: its run and its fingerprint (cosfly/runtime/run_dir.py)."""

    run: str
    sha256: str


class TrainingSet(Record):
    """`training_set.json`."""

    split_by: Literal["walk", "town"]
    trees: list[SourceTree]  # empty without pictures
    samples: dict[Split, int]  # number of them


def read_training_set(dataset: Path) -> TrainingSet:
    """Read the record of a training set."""
    return read_model(dataset / RECORD, TrainingSet, RECORD_FORMAT, tree=dataset)


def resolve_trees(dataset: Path, data: Sequence[Path]) -> dict[str, Path]:
    """Return which of the given playback trees belongs to which run of a training set: run -> tree."""
    digests = {tree.run: tree.sha256 for tree in read_training_set(dataset).trees}  # two runs may have equal trees
    if not digests:  # a set without pictures
        return {}
    paths = {fingerprint(path): path for path in data}
    for digest, path in paths.items():
        if digest not in digests.values():
            what = "the training set was not made from this directory of rendered tracks"
            expected = ", ".join(f"{run}: {sha256}" for run, sha256 in digests.items())
            fix = "pass the unchanged trees of the training set, or prepare a training set from this tree"
            raise InputError(what, where=path, got=f"the digest {digest}", expected=expected, fix=fix)
    if missing := [run for run, digest in digests.items() if digest not in paths]:
        problem, again = "--data lacks playback trees of the training set", "pass --data for these trees, too"
        raise InputError(problem, where=dataset, expected=f"also the trees of {', '.join(missing)}", fix=again)
    return {run: paths[digest] for run, digest in digests.items()}


def tree_inputs(trees: Collection[Path], captions: Collection[Path] = ()) -> dict[str, Path]:
    """Return playback trees and their captions as named inputs of a stage: `data`, `captions`; of several `1.data`."""
    inputs: dict[str, Path] = {}
    for name, paths in (("data", trees), ("captions", captions)):
        for number, path in enumerate(paths, 1):
            inputs[f"{number}.{name}" if len(trees) > 1 else name] = path
    return inputs


def arrow_type(annotation: Any) -> pa.DataType:
    """Return the type of a column for a field: text, number, flag, record, a tuple of one of these, or optional."""
    parts, origin = get_args(annotation), get_origin(annotation)
    if origin is tuple:
        return pa.list_(pa.field("element", arrow_type(parts[0])))
    if parts and origin is not Literal:
        return arrow_type(parts[0])  # a type or None
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return pa.struct(columns_of(annotation))
    return {int: pa.int32(), float: pa.float64(), bool: pa.bool_()}.get(annotation, pa.string())


def columns_of(model: type[BaseModel]) -> pa.Schema:
    """Return the columns of a file of records."""
    fields = []
    for name, field in model.model_fields.items():
        is_optional = type(None) in get_args(field.annotation)
        fields.append(pa.field(name, arrow_type(field.annotation), is_optional))
    return pa.schema(fields)


def split_path(dataset: Path, split: str) -> Path:
    """Return the file of a split."""
    return dataset / f"{split}.parquet"


def open_split(dataset: Path, split: Split, *, text_only: bool = False) -> list[Sample]:
    """Read the samples of a split; `text_only` for a student that takes no pictures: they come without them."""
    path = split_path(dataset, split)
    is_empty = not read_training_set(dataset).samples.get(split)
    rows = () if is_empty else rows_of(path, columns_of(Sample).names)
    samples = (validated(Sample, row, f"{path}: row {number}") for number, row in enumerate(rows))
    return [sample.without_pictures() if text_only else sample for sample in samples]


def write_splits(
    out: Path, model: type[SplitMember], records: Mapping[Split, Iterable[SplitMember]]
) -> tuple[dict[Split, int], list[Path]]:
    """Write a parquet file per split, which appears when it is complete; return counts of records, and the files."""
    columns = columns_of(model)
    counts: dict[Split, int] = {}
    for split, in_split in records.items():
        counts[split] = 0
        rows = (record.model_dump(mode="json") for record in in_split)
        with contextlib.ExitStack() as stack:
            writer: pq.ParquetWriter | None = None
            while part := list(islice(rows, ROWS_AT_ONCE)):
                if writer is None:
                    file = stack.enter_context(atomic_file(split_path(out, split)))
                    # Statistics of whole prompts would make the footer large.
                    settings: Any = {"compression": "zstd", "write_statistics": False}
                    writer = stack.enter_context(pq.ParquetWriter(file, columns, **settings))
                writer.write_table(pa.Table.from_pylist(part, schema=columns))
                counts[split] += len(part)
    return counts, [split_path(out, split) for split, count in counts.items() if count]


def write_page(out: Path, title: str, samples: Mapping[Split, int], trees: Sequence[SourceTree], text: str) -> Path:
    """Write README.md of a folder of splits."""
    counts = "".join(f"- {split}: {count} samples\n" for split, count in samples.items() if count)
    pictures = "Its samples have no pictures.\n"
    if trees:
        runs = dump_json([tree.run for tree in trees])
        pictures = f"Its pictures are the frames `window` of the playback trees of {runs}, which are not part of it.\n"
    write_bytes(out / PAGE, f"# {title}\n\n{counts}\n{text}\n{pictures}".encode())
    return out / PAGE
