"""What the steps of `distill` hand on: a training set, with its one reader and its one writer. Needs no torch.

training_set.json                          whence it came, its splits, and the system prompts, each once
train.parquet  val.parquet  test.parquet   a sample a row; a split without samples has no file
README.md                                  for `datasets.load_dataset`
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self, get_args, get_origin, overload

import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.formats.captions import FIELDS, Language, Place, Prompt
from cosfly.formats.frames import frame_name
from cosfly.formats.predictions import Split
from cosfly.geometry.splits import SPLITS
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import atomic_file, write_bytes
from cosfly.runtime.json_io import FileFormat, Record, read_model, validated, write_model
from cosfly.runtime.run_dir import fingerprint
from cosfly.runtime.tables import TableRows
from cosfly.viz.frame_views import VIEW_FILES, Pictures, View

RECORD, RECORD_FORMAT = "training_set.json", FileFormat("cosfly.training_set", "4.0", "training set")
PAGE = "README.md"
# Rows of a row group. One look at a sample, in an order drawn by lot, decodes them; the footer, of which a reader and
# the writer hold all, grows by the groups.
ROWS_AT_ONCE = 1000


class SplitMember(Record):
    """Of any kind of sample, what says whose it is."""

    sample_id: str  # unique in the set
    run: str  # the tree that its flight stands in
    town: str
    trajectory: str
    variant: str
    walk: str  # whom it follows: samples of one walk are in one split
    window: tuple[int, ...]  # indices of the frames of its pictures, oldest first

    @property
    def key(self) -> str:
        """Unique name of the sample."""
        return self.sample_id


class Sample(SplitMember):
    """One sample: what the student sees, and what it should answer."""

    language: Language
    window_id: str  # of its window in the tree of its run, as its captions name it
    views: tuple[View, ...]  # the pictures of each frame, in this order
    picture_px: tuple[int, int]  # (width, height) of each, which pixel values of prompt and answer refer to
    depth_range_m: float  # dark end of depth pictures
    prompt: Prompt  # names these pictures
    answer: str  # JSON text of the three fields
    decision: str  # the answer's flight_decision
    label: str | None  # the decision that the future geometry calls for; None: it cannot tell
    contradicted: tuple[str, ...] | None  # decisions that the future geometry rules out; None: not known
    values_contradicted: int | None  # values of the answer that match no fact; None: nobody compared them
    repair: str | None  # strategy of the repair that made the answer; None: as the teacher gave it
    weight: float
    past: tuple[float, ...] = ()  # see cosfly/inspection/blind_baseline.py; () where not known

    @property
    def key(self) -> str:
        return f"{self.sample_id}/{self.language}"

    @property
    def folder(self) -> str:
        """Where its flight stands in the tree of its run."""
        return f"{self.town}/{self.trajectory}/{self.variant}"

    @property
    def frames(self) -> list[str]:
        """Folders of the playback tree, oldest first."""
        return [f"{self.folder}/{frame_name(index)}" for index in self.window]

    @property
    def pictures(self) -> Pictures:
        return Pictures(self.views, self.picture_px, "separate", self.depth_range_m)

    def without_pictures(self) -> Sample:
        """Return the sample as a student that takes no pictures gets it: its prompt says that none are given."""
        told, none = (pictures.sentence(self.language) for pictures in (self.pictures, Pictures((), self.picture_px)))
        user = self.prompt.user.replace(told, none)
        return self.model_copy(update={"views": (), "prompt": self.prompt.model_copy(update={"user": user})})

    @property
    def images(self) -> list[str]:
        """Files of the playback tree in the order of the pictures made of them: frame by frame, its views together."""
        return [f"{frame}/{VIEW_FILES[view]}" for frame in self.frames for view in self.views]


def decision_place(answer: str) -> Place:
    """Return where the decision is among the fields of the JSON text of an answer."""
    return "first" if answer.lstrip("{ ").startswith(f'"{FIELDS[-1]}"') else "last"


class SourceTree(Record):
    """A playback tree that samples name frames of: its run and its fingerprint (cosfly/runtime/run_dir.py)."""

    run: str
    sha256: str


class TrainingSet(Record):
    """`training_set.json`. samples: of each split. systems: the system prompts, which samples name by their place."""

    split_by: Literal["walk", "town"]
    trees: list[SourceTree]
    samples: dict[Split, int]
    systems: list[str]


def read_training_set(dataset: Path) -> TrainingSet:
    """Read a training set's record."""
    path = dataset / RECORD
    if not path.exists():
        raise InputError(
            "the folder is not a training set", where=dataset, got=f"no {RECORD}", fix="run cosfly distill prepare"
        )
    return read_model(path, TrainingSet, RECORD_FORMAT, tree=dataset)


def resolve_trees(dataset: Path, data: Sequence[Path]) -> dict[str, Path]:
    """Return which of the given playback trees belongs to which run of a training set: run -> tree."""
    record = read_training_set(dataset)
    run_of = {tree.sha256: tree.run for tree in record.trees}
    trees: dict[str, Path] = {}
    for path in data:
        run = run_of.get(fingerprint(path))
        if run is None:
            words = "the training set was not made of this playback tree"
            expected = ", ".join(f"{tree.run}: {tree.sha256}" for tree in record.trees)
            fix = "pass the unchanged trees of the training set, or prepare a training set from this tree"
            raise InputError(words, where=path, got=fingerprint(path), expected=expected, fix=fix)
        trees[run] = path
    if missing := [tree.run for tree in record.trees if tree.run not in trees]:
        words, fix = "a playback tree of the training set is missing", "pass --data once for each of its trees"
        expected = f"--data also for the runs {', '.join(missing)}"
        raise InputError(words, where=dataset, got=", ".join(map(str, data)) or "none", expected=expected, fix=fix)
    return {tree.run: trees[tree.run] for tree in record.trees}


def tree_inputs(trees: Mapping[str, Path]) -> dict[str, Path]:
    """Name playback trees as inputs of a stage: `data`; of several with a number in front."""
    return {f"{number}.data" if len(trees) > 1 else "data": tree for number, tree in enumerate(trees.values(), 1)}


def arrow_type(of: Any) -> pa.DataType:
    """Return the type of a column that holds values of a field: text, number, flag, a tuple of one, or nothing."""
    if (parts := get_args(of)) and get_origin(of) is not Literal:
        first = parts[0]
        if get_origin(of) is tuple:
            return pa.list_(pa.field("element", arrow_type(first)))
        return arrow_type(first)  # or None
    return {int: pa.int32(), float: pa.float64(), bool: pa.bool_()}.get(of, pa.string())


def columns_of(model: type[SplitMember], **changed: pa.DataType) -> pa.Schema:
    """Return the columns of a file of samples: their fields, and where a file holds something else its type."""
    own = {name: field.annotation for name, field in model.model_fields.items()}
    types = {name: arrow_type(of) for name, of in own.items()} | changed
    return pa.schema([pa.field(n, of, nullable=type(None) in get_args(own.get(n))) for n, of in types.items()])


COLUMNS = columns_of(Sample, prompt=pa.string(), system=pa.int32())  # system: number of one of the record's


def split_path(dataset: Path, split: str) -> Path:
    """Return the file of a split: `train`, `validation` or `test`."""
    return dataset / f"{split}.parquet"


class Samples(Sequence[Sample]):
    """The samples of a split: any by its number, all in a stream. Holds a few row groups; a process that it is sent to
    opens its own. text_only: samples are given without their pictures."""

    def __init__(self, dataset: Path, split: Split, *, text_only: bool = False) -> None:
        self.text_only = text_only
        record = read_training_set(dataset)
        self.path, self._systems = split_path(dataset, split), record.systems
        self._rows = TableRows(self.path, COLUMNS.names) if record.samples.get(split) else None

    def __len__(self) -> int:
        return 0 if self._rows is None else len(self._rows)

    def __iter__(self) -> Iterator[Sample]:
        return (self._sample(number, row) for number, row in enumerate(self._rows or ()))

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if self._rows is None or not -len(self) <= index < len(self):
            raise IndexError(index)
        number = index % len(self)
        return self._sample(number, self._rows[number])

    def _sample(self, number: int, row: dict[str, Any]) -> Sample:
        where = f"{self.path}: row {number}"
        system, user = row.pop("system"), row.pop("prompt")
        if not isinstance(system, int) or not 0 <= system < len(self._systems) or not isinstance(user, str):
            raise InputError(
                "the sample has no valid prompt",
                where=where,
                got=shown([system, user]),
                expected=f"a prompt of {RECORD}",
            )
        sample = validated(Sample, {**row, "prompt": Prompt(system=self._systems[system], user=user)}, where)
        return sample.without_pictures() if self.text_only else sample


def open_split(dataset: Path, split: Split, *, text_only: bool = False) -> Samples:
    """Open a split; with `text_only` as a student that takes no pictures gets it."""
    return Samples(dataset, split, text_only=text_only)


class SplitFiles:
    """Rows to one parquet file a split, one by one; of each split at most a row group waits in memory. paths: what was
    written."""

    def __init__(self, out: Path, columns: pa.Schema) -> None:
        self.out, self._columns, self._stack = out, columns, contextlib.ExitStack()
        self.paths: list[Path] = []
        self.counts: dict[Split, int] = dict.fromkeys(SPLITS, 0)
        self._rows: dict[Split, list[dict[str, Any]]] = {}
        self._writers: dict[Split, pq.ParquetWriter] = {}

    def add(self, split: Split, row: dict[str, Any]) -> None:
        self.counts[split] += 1
        waiting = self._rows.setdefault(split, [])
        waiting.append(row)
        if len(waiting) == ROWS_AT_ONCE:
            self._write(split)

    @contextlib.contextmanager
    def writing(self) -> Iterator[Self]:
        """Hold the files open; they appear when the block ends without an error."""
        with self._stack:
            yield self
            for split, waiting in self._rows.items():
                if waiting:
                    self._write(split)

    def _write(self, split: Split) -> None:
        if split not in self._writers:
            path = split_path(self.out, split)
            file = self._stack.enter_context(atomic_file(path))
            # Least and greatest values help nobody here, and those of whole prompts make a footer of 8 kB a row group.
            writer = pq.ParquetWriter(file, self._columns, compression="zstd", write_statistics=False)
            self._writers[split] = self._stack.enter_context(writer)
            self.paths.append(path)
        self._writers[split].write_table(pa.Table.from_pylist(self._rows[split], schema=self._columns))
        self._rows[split] = []


class TrainingSetWriter(SplitFiles):
    """Takes the samples of a training set one by one. files: what was written."""

    def __init__(self, out: Path) -> None:
        super().__init__(out, COLUMNS)
        self.files: list[Path] = []
        self._systems: dict[str, int] = {}

    def add_sample(self, split: Split, sample: Sample) -> None:
        row = sample.model_dump(mode="json")
        row["system"] = self._systems.setdefault(sample.prompt.system, len(self._systems))
        row["prompt"] = sample.prompt.user
        self.add(split, row)

    def finish(self, split_by: Literal["walk", "town"], trees: Iterable[SourceTree]) -> TrainingSet:
        """Write the record and the page, after the block ended and the splits stand."""
        record = TrainingSet(
            split_by=split_by,
            trees=list(trees),
            samples=self.counts,
            systems=list(self._systems),
        )
        write_model(self.out / RECORD, record, RECORD_FORMAT)
        write_bytes(self.out / PAGE, _page(record))
        self.files = [*self.paths, self.out / RECORD, self.out / PAGE]
        return record


_SPLIT_NAMES = {"train": "train", "val": "validation", "test": "test"}  # as `datasets` calls them


def page_of(title: str, samples: Mapping[Split, int], text: str) -> bytes:
    """Return the README.md of a folder of splits, whose header lets `datasets.load_dataset` open it."""
    found = [split for split in SPLITS if samples[split]]
    files = "".join(f"  - split: {_SPLIT_NAMES[split]}\n    path: {split}.parquet\n" for split in found)
    counts = "".join(f"- {_SPLIT_NAMES[split]}: {samples[split]} samples\n" for split in found)
    header = f"---\nconfigs:\n- config_name: default\n  data_files:\n{files}---\n"
    return f"{header}# {title}\n\n{counts}\n{text}".encode()


def _page(record: TrainingSet) -> bytes:
    return page_of(
        "Training set",
        record.samples,
        f"No two splits share a {record.split_by}. `system` is the index of a sample's system prompt in `systems` of\n"
        f"`{RECORD}`, `prompt` its question, `answer` the expected answer; its pictures are frames `window` of the\n"
        "playback trees of\n"
        f"{json.dumps([tree.run for tree in record.trees], ensure_ascii=False)}, which are not part of it.\n",
    )
