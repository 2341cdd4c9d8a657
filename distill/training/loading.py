"""Data of a training: the samples that are used, their tokens by worker processes, features of their pictures."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.worker import end_with_parent
from distill.schema import Sample
from distill.student.chat import EncodedSample, FieldWeights, Processor, special_token_in
from distill.student.features import FramePicture, PictureReader, Tensors, encode, pictures_of, read_features
from distill.student.model import Student
from distill.training.settings import STAGE, TrainConfig

MOST_WORKERS = 16
SAMPLES_PER_WORKER = 64  # for fewer, another worker process is not worth its start
TOO_LONG, SPECIAL_TOKEN, UNREADABLE = "too_long", "special_token", "unreadable_picture"

Rows = Sequence[tuple[EncodedSample, Sample]]
ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def num_workers(wanted: int, num_items: int = MOST_WORKERS * SAMPLES_PER_WORKER) -> int:
    """Return the number of worker processes for some items; negative: one per CPU, at most MOST_WORKERS."""
    most = wanted if wanted >= 0 else min(MOST_WORKERS, num_cpus())
    return min(most, num_items // SAMPLES_PER_WORKER)


@dataclass(frozen=True)
class _Work:
    """A function as a data set whose indices are its arguments. An error is returned, because the loader would raise
    another one in its place."""

    function: Callable[[Any], Any]

    def __getitem__(self, item: Any) -> Any:
        try:
            return self.function(item)
        except CosflyError as error:
            return error


def _start_worker(parent_pid: int, _: int) -> None:
    import cv2
    import torch

    end_with_parent(parent_pid)  # a worker with a result would wait for a killed parent, and hold the folder's lock
    torch.set_num_threads(1)
    cv2.setNumThreads(0)


def _unchanged(value: Any) -> Any:
    return value


def in_order(function: Callable[[ItemT], ResultT], items: Iterable[ItemT], workers: int) -> Iterator[ResultT]:
    """Yield function(item) for each item, in order, computed ahead by `workers` processes; 0: in this process."""
    import torch

    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")  # threads do not survive the fork
    loader: Any = torch.utils.data.DataLoader(
        _Work(function),  # type: ignore[arg-type]  # all that the loader asks of a data set
        batch_size=None,
        sampler=items,
        num_workers=workers,
        worker_init_fn=partial(_start_worker, os.getpid()),
        multiprocessing_context="fork" if workers else None,
        collate_fn=_unchanged,
    )
    for result in loader:
        if isinstance(result, CosflyError):
            raise result
        yield result


class SampleTokens(NamedTuple):
    """The size of a sample, and why it is skipped, if it is. place: its index in the split."""

    place: int
    num_tokens: int
    num_answer_tokens: int
    pictures: tuple[FramePicture, ...]
    skip_reason: str = ""
    skip_detail: str = ""


@dataclass
class TrainingSplit:
    """The samples of a split as tokens: those that are used, by increasing place, and those that are skipped."""

    samples: Sequence[Sample]
    processor: Processor
    max_pixels: int
    weights: FieldWeights
    used: list[SampleTokens] = field(default_factory=list)
    skipped: list[SampleTokens] = field(default_factory=list)

    def count(self, places: Sequence[int], max_tokens: int, workers: int) -> None:
        """Count the tokens of samples, and skip those that cannot be used."""
        known: dict[FramePicture, FramePicture] = {}  # equal pictures become one object
        counted = in_order(partial(self._count, max_tokens=max_tokens), places, num_workers(workers, len(places)))
        with progress_bar(f"{STAGE}: counting tokens", total=len(places)) as advance:
            for sample in counted:
                pictures = tuple(known.setdefault(picture, picture) for picture in sample.pictures)
                (self.skipped if sample.skip_reason else self.used).append(sample._replace(pictures=pictures))
                advance(1)

    def _count(self, place: int, max_tokens: int) -> SampleTokens:
        sample = self.samples[place]
        pictures = tuple(pictures_of(sample))
        if token := special_token_in(self.processor, sample):
            return SampleTokens(place, 0, 0, pictures, SPECIAL_TOKEN, f"{sample.key}: a text contains {token}")
        row = self.processor.encode(sample, self.max_pixels)
        found = SampleTokens(place, len(row), len(row.answer_ids), pictures)
        if len(row) > max_tokens:
            return found._replace(skip_reason=TOO_LONG, skip_detail=f"{sample.key}: {len(row)} tokens")
        return found

    def skip_unreadable(self, unreadable: Mapping[FramePicture, str]) -> None:
        """Skip the samples with a picture that cannot be read."""
        used, self.used = self.used, []
        for sample in used:
            words = next((unreadable[picture] for picture in sample.pictures if picture in unreadable), "")
            sample = sample._replace(skip_reason=UNREADABLE if words else "", skip_detail=words)
            (self.skipped if words else self.used).append(sample)

    @property
    def lengths(self) -> np.ndarray:
        """Tokens of each used sample, (n,) int64."""
        return np.array([sample.num_tokens for sample in self.used], dtype=np.int64)

    @property
    def skip_reasons(self) -> Counter[str]:
        return Counter(sample.skip_reason for sample in self.skipped)

    def encode(self, places: Sequence[int]) -> Rows:
        samples = [self.samples[place] for place in places]
        return [(self.processor.encode(sample, self.max_pixels, self.weights), sample) for sample in samples]

    def rows(self, shares: Iterable[Sequence[int]], workers: int) -> Iterator[Rows]:
        """Yield the rows of each share of the used samples."""
        return in_order(self.encode, ([self.used[number].place for number in share] for share in shares), workers)


@dataclass
class TrainingContext:
    """A student, what it learns from and is validated on, and the processes of the training."""

    student: Student
    cfg: TrainConfig
    seed: int
    accelerator: Any
    train: TrainingSplit
    val: TrainingSplit
    features: dict[FramePicture, Tensors] = field(default_factory=dict)

    def read_pictures(self, reader: PictureReader) -> None:
        """Read and encode all pictures once, and skip the samples with a picture that cannot be read."""
        splits = self.train, self.val
        pictures = list(dict.fromkeys(p for split in splits for sample in split.used for p in sample.pictures))
        with progress_bar(f"{STAGE}: pictures", total=len(pictures)) as advance:
            read = in_order(reader.try_to_read, pictures, num_workers(self.cfg.data_workers, len(pictures)))
            counted = (advance(1) or tensors for tensors in read)
            is_frozen = not self.cfg.train_vision
            self.features, unreadable = read_features(self.student, pictures, counted, is_frozen=is_frozen)
        for split in splits:
            split.skip_unreadable(unreadable)

    def features_of(self, rows: Rows) -> list[Tensors]:
        """Return the features of the pictures of rows, row after row."""
        found = [self.features[picture] for _, sample in rows for picture in pictures_of(sample)]
        return encode(self.student, found) if self.cfg.train_vision else found

    def total(self, values: Sequence[float]) -> list[float]:
        """Add up numbers over all processes."""
        import torch

        tensor = torch.tensor(values, dtype=torch.float64, device=self.student.device)
        return self.accelerator.reduce(tensor, "sum").tolist()
