"""Work that is done ahead by worker processes: samples are counted and checked, steps made ready."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from cosfly.formats.frames import frame_path
from cosfly.formats.places import flight_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError, EnvironmentMissing, InputError
from cosfly.runtime.io import inside
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.worker import end_with_parent
from cosfly.viz.frame_views import VIEW_FILES
from distill.schema import Sample
from distill.student.chat import PLAIN_WEIGHTS, AnswerWeights, EncodedSample, Processor, image_size, special_token_in
from distill.student.features import (
    FramePicture,
    PictureData,
    PictureReader,
    VisionFeatures,
    pack,
    pictures_of,
    unpack,
)
from distill.training.ranks import Ranks

log = logging.getLogger(__name__)

ORDERS_AHEAD = 2  # for each worker
MOST_WORKERS = 16

OrderT = TypeVar("OrderT")
ResultT = TypeVar("ResultT")


def num_workers(wanted: int) -> int:
    """Return the number of workers: the wanted one; if it is negative, one per CPU, at most MOST_WORKERS."""
    return wanted if wanted >= 0 else min(MOST_WORKERS, num_cpus())


@dataclass(frozen=True)
class _Work(Generic[OrderT, ResultT]):
    """What torch's loader takes for a data set whose items are named by orders. An error comes back as a value: the
    loader would raise another in its place."""

    function: Callable[[OrderT], ResultT]

    def __getitem__(self, order: OrderT) -> ResultT | CosflyError:
        try:
            return self.function(order)
        except CosflyError as error:
            return error


def _begin_worker(parent_pid: int, _: int) -> None:
    import cv2
    import torch

    # Else one that has something to hand over waits for ever, and with it the lock of the folder.
    end_with_parent(parent_pid)
    torch.set_num_threads(1)
    cv2.setNumThreads(0)


def _as_it_is(given: Any) -> Any:
    return given


def in_order(function: Callable[[OrderT], ResultT], orders: Iterable[OrderT], workers: int) -> Iterator[ResultT]:
    """Yield function(order) for each order, in their order; an order is taken only a few before it is its turn.

    Args:
        workers: processes; 0: everything is done here.
    """
    import torch

    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")  # threads of its own would not survive the fork
    loader: Any = torch.utils.data.DataLoader(
        _Work(function),  # type: ignore[arg-type]  # all that the loader asks of a data set
        batch_size=None,
        sampler=orders,
        num_workers=workers,
        prefetch_factor=ORDERS_AHEAD if workers else None,
        worker_init_fn=partial(_begin_worker, os.getpid()),
        multiprocessing_context="fork" if workers else None,
        collate_fn=_as_it_is,
    )
    with reader_errors():
        for given in loader:
            if isinstance(given, CosflyError):
                raise given
            yield given


@contextlib.contextmanager
def reader_errors() -> Iterator[None]:
    """Turn torch's word that a process which reads samples was killed into an error for people.

    torch says it from a signal's handler, wherever this process then is, also in the middle of a step.
    """
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        fix = "run the same command again; if memory (or --shm-size) is short, lower distill.train.data_workers"
        words, got = "the system killed a process that reads samples", str(error).splitlines()[0][:160]
        raise EnvironmentMissing(words, got=got, fix=fix) from error


@dataclass(frozen=True)
class Row:
    """A sample ready to be computed, but for the features of its pictures."""

    encoded: EncodedSample
    pictures: tuple[FramePicture, ...]
    sample: Sample


@dataclass(frozen=True)
class Order:
    """What a worker is to make: rows of samples, and pictures that are not known yet."""

    step: int
    samples: Sequence[int]
    pictures: Sequence[FramePicture]


@dataclass(frozen=True)
class StepData:
    """What a worker made. packed: the pictures (`unpack`). unreadable: picture -> why it cannot be read."""

    step: int
    rows: list[Row]
    packed: Any
    unreadable: dict[FramePicture, str]


@dataclass(frozen=True)
class Maker:
    """Makes what is ordered; goes to worker processes."""

    samples: Sequence[Sample]
    reader: PictureReader
    weights: AnswerWeights

    def __call__(self, order: Order) -> StepData:
        samples, reader = [self.samples[index] for index in order.samples], self.reader
        encode = partial(reader.processor.encode, max_pixels=reader.max_pixels, weights=self.weights)
        rows = [Row(encode(sample), tuple(pictures_of(sample)), sample) for sample in samples]
        loaded: list[PictureData] = []
        unreadable: dict[FramePicture, str] = {}
        for picture in order.pictures:
            try:
                loaded.append(self.reader.read(picture))
            except InputError as error:
                unreadable[picture] = str(error)
        return StepData(order.step, rows, pack(loaded), unreadable)


@dataclass(frozen=True)
class ReadyStep:
    """The rows of a step. left_out: key of a sample whose pictures cannot be read -> why."""

    step: int
    rows: list[Row]
    left_out: dict[str, str]


@dataclass
class Supply:
    """Gives the rows of one step after the other, features of their pictures at hand, and measures how long it was
    waited for."""

    features: VisionFeatures
    reader: PictureReader
    workers: int
    weights: AnswerWeights = PLAIN_WEIGHTS
    waited_s: float = 0.0  # for the last step
    _unreadable: dict[FramePicture, str] = field(default_factory=dict)

    def steps(
        self,
        samples: Sequence[Sample],
        pictures: Callable[[int], Sequence[FramePicture]],
        shares: Iterable[tuple[int, Sequence[int]]],
    ) -> Iterator[ReadyStep]:
        """Yield what is ready for each (step, indices of samples).

        Args:
            pictures: gives the pictures of a sample by its index.
        """
        plan = self.features.plan()
        orders = (
            Order(step, indices, self.features.wanted(plan, (p for index in indices for p in pictures(index))))
            for step, indices in shares
        )
        made_steps = in_order(Maker(samples, self.reader, self.weights), orders, self.workers)
        begun_s = time.monotonic()
        for made in made_steps:
            self._unreadable |= made.unreadable
            self.features.take(unpack(made.packed))
            ready = ReadyStep(made.step, [], {})
            for row in made.rows:
                bad = next((picture for picture in row.pictures if picture in self._unreadable), None)
                if bad is None:
                    ready.rows.append(row)
                else:
                    ready.left_out[row.encoded.key] = self._unreadable[bad]
            self.waited_s = time.monotonic() - begun_s
            yield ready
            self.features.end_step()
            begun_s = time.monotonic()


SAMPLES_AT_ONCE = 64  # what a worker is given
TOO_LONG, SPECIAL_TOKEN, UNFIT_PICTURE = "too_long", "special_token", "unfit_picture"


@dataclass
class SampleCounts:
    """What was seen of some samples, each picture once, so that a million samples take little. rows: (index, prompt,
    answer tokens)."""

    rows: list[tuple[int, int, int]] = field(default_factory=list)
    of_samples: list[np.ndarray] = field(default_factory=list)  # places of the pictures of each row
    places: dict[FramePicture, int] = field(default_factory=dict)
    decisions: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    examples: dict[str, tuple[int, str]] = field(default_factory=dict)  # reason -> index and words of the first

    def places_of(self, pictures: Iterable[FramePicture]) -> np.ndarray:
        return np.array([self.places.setdefault(picture, len(self.places)) for picture in pictures], np.int32)

    def add(self, part: SampleCounts) -> None:
        new_place = self.places_of(part.places)
        self.of_samples += [new_place[places] for places in part.of_samples]
        self.rows += part.rows
        self.decisions += part.decisions
        self.skipped += part.skipped
        for reason, example in part.examples.items():
            self.examples[reason] = min(example, self.examples.get(reason, example))


@dataclass(frozen=True)
class Counting:
    """Looks at samples; goes to worker processes."""

    samples: Sequence[Sample]
    processor: Processor
    trees: Mapping[str, Path]
    max_tokens: int
    max_pixels: int

    def __call__(self, indices: Sequence[int]) -> SampleCounts:
        seen, checked = SampleCounts(), dict[FramePicture, str]()
        for index in indices:
            sample = self.samples[index]
            token = special_token_in(self.processor, sample)
            row = None if token else self.processor.encode(sample, self.max_pixels)
            if row is None:
                reason, detail = SPECIAL_TOKEN, f"a text contains {token}"
            elif len(row) > self.max_tokens:
                counts = f"{len(row.prompt_ids)} prompt + {len(row.answer_ids)} answer tokens"
                reason, detail = TOO_LONG, f"{counts}, at most {self.max_tokens}"
            elif detail := self._why_unfit(sample, checked):
                reason = UNFIT_PICTURE
            else:
                seen.rows.append((index, len(row.prompt_ids), len(row.answer_ids)))
                seen.of_samples.append(seen.places_of(pictures_of(sample)))
                seen.decisions[sample.decision] += 1
                continue
            seen.skipped[reason] += 1
            seen.examples.setdefault(reason, (index, f"{sample.key}: {detail}"))
        return seen

    def _why_unfit(self, sample: Sample, checked: dict[FramePicture, str]) -> str:
        """Compare the headers of the pictures' files with the prompt; the empty string: they fit."""
        for picture in pictures_of(sample):
            if picture not in checked:
                checked[picture] = ""
                try:
                    path = frame_path(inside(self.trees[picture.run], picture.frame), VIEW_FILES[picture.view])
                    sample.pictures.check_size(path, image_size(path))
                except InputError as error:
                    checked[picture] = str(error)
            if checked[picture]:
                return checked[picture]
        return ""


@dataclass
class Census:
    """The samples of a split that are learnt from, and how many were left out for what reason.

    indices (n,): their places in the split, increasing. prompt_tokens, answer_tokens (n,). examples: reason -> the
    first sample left out.
    """

    indices: np.ndarray
    prompt_tokens: np.ndarray
    answer_tokens: np.ndarray
    num_samples: int
    decisions: Counter[str]
    skipped: Counter[str]
    examples: dict[str, str]
    pictures: list[FramePicture]  # each once
    _places: list[np.ndarray] = field(repr=False)  # of the pictures of each sample in `pictures`

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def tokens(self) -> np.ndarray:
        return self.prompt_tokens + self.answer_tokens

    def pictures_of(self, index: int) -> list[FramePicture]:
        """Return the pictures of the sample at a place of the split."""
        return [self.pictures[place] for place in self._places[int(np.searchsorted(self.indices, index))]]


def take_census(
    samples: Sequence[Sample],
    chosen: Sequence[int],
    processor: Processor,
    trees: Mapping[str, Path],
    *,
    max_tokens: int,
    max_pixels: int,
    workers: int,
    ranks: Ranks,
    label: str,
) -> Census:
    """Look at the chosen samples of a split; each process of the training takes its share."""
    chunks = [chosen[start : start + SAMPLES_AT_ONCE] for start in range(0, len(chosen), SAMPLES_AT_ONCE)]
    mine, counting = chunks[ranks.rank :: ranks.size], Counting(samples, processor, trees, max_tokens, max_pixels)
    seen, whole = SampleCounts(), SampleCounts()
    with progress_bar(label, total=sum(map(len, mine))) as advance:
        for counts in in_order(counting, mine, max(0, min(workers, len(mine) - 1))):
            seen.add(counts)
            advance(len(counts.rows) + counts.skipped.total())
    for part in ranks.gathered(seen):
        whole.add(part)
    rows = np.array(whole.rows, np.int64).reshape(-1, 3)
    order = np.argsort(rows[:, 0])  # that of the split
    return Census(
        indices=rows[order, 0],
        prompt_tokens=rows[order, 1],
        answer_tokens=rows[order, 2],
        num_samples=len(rows) + whole.skipped.total(),
        decisions=whole.decisions,
        skipped=whole.skipped,
        examples={reason: words for reason, (_, words) in whole.examples.items()},
        pictures=list(whole.places),
        _places=[whole.of_samples[place] for place in order],
    )


def choose_over_all(samples: Sequence[Sample], count: int, rng: np.random.Generator) -> list[int]:
    """Choose samples of a split by turns over all decisions, and within a decision by turns over all flights.

    Returns:
        Indices, increasing: at most `count`.
    """
    by_decision: dict[str, dict[str, list[int]]] = {}
    for index, sample in enumerate(samples):
        flights = by_decision.setdefault(sample.decision, {})
        flights.setdefault(flight_of(sample.sample_id), []).append(index)
    queues = []
    for _, flights in sorted(by_decision.items()):
        own = [_shuffled(indices, rng) for indices in _shuffled(list(flights.values()), rng)]
        queues.append(_by_turns(own))
    return sorted(_by_turns(queues)[:count])


def _shuffled(items: list, rng: np.random.Generator) -> list:
    return [items[place] for place in rng.permutation(len(items))]


def _by_turns(queues: Sequence[Sequence]) -> list:
    """Take the first of each, then the second of each, and so on."""
    longest = max((len(queue) for queue in queues), default=0)
    return [queue[turn] for turn in range(longest) for queue in queues if turn < len(queue)]
