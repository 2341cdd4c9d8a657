"""Data of a training: the samples that are used, as tokens, and the features of their pictures."""

import logging
import os
import signal
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.limits import memory_bytes, num_cpus
from cosfly.runtime.worker import LEFT_TO_THE_PARENT, end_with_parent
from distill.schema import Sample
from distill.student.chat import EncodedSample, Processor
from distill.student.features import FramePicture, PictureReader, Tensors, encode, pictures_of, read_features
from distill.student.model import Student
from distill.training.settings import STAGE, TrainConfig

log = logging.getLogger(__name__)

MOST_WORKERS = 16
SAMPLES_PER_WORKER = 64  # for fewer, another worker process is not worth its start
FEATURES_SHARE = 0.5  # of the memory of a machine: for the features of pictures in all of its processes

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class _Computed:
    """A data set of the results of a function. It returns errors, because the loader would replace a raised one."""

    function: Callable[[Any], Any]

    def __getitem__(self, item: Any) -> Any:
        try:
            return self.function(item)
        except CosflyError as error:
            return error


def _start_worker(parent_pid: int, _: int) -> None:
    """Prepare a worker process: it ends with its parent, ignores signals for that, and uses one thread."""
    import cv2
    import torch

    end_with_parent(parent_pid)  # a worker with a result would wait for a killed parent, and hold the folder's lock
    for number in LEFT_TO_THE_PARENT:
        signal.signal(number, signal.SIG_IGN)
    torch.set_num_threads(1)
    cv2.setNumThreads(0)


def in_order(function: Callable[[ItemT], ResultT], items: Sequence[ItemT], max_workers: int) -> Iterator[ResultT]:
    """Yield function(item) for each item, in order, computed ahead by worker processes: at most so many, 0 for none,
    negative for one per CPU up to MOST_WORKERS."""
    import torch

    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")  # threads do not survive the fork
    if max_workers < 0:
        max_workers = min(MOST_WORKERS, num_cpus())
    workers = min(max_workers, len(items) // SAMPLES_PER_WORKER)
    loader: Any = torch.utils.data.DataLoader(
        _Computed(function),  # type: ignore[arg-type]  # a loader without batches needs nothing else
        batch_size=None, sampler=items, num_workers=workers, worker_init_fn=partial(_start_worker, os.getpid()),
        multiprocessing_context="fork" if workers else None, collate_fn=lambda result: result,
    )  # fmt: skip
    for result in loader:
        if isinstance(result, CosflyError):
            raise result
        yield result


class TrainingSample(NamedTuple):
    """A sample as tokens, with its pictures."""

    sample_index: int  # in the split
    row: EncodedSample
    pictures: tuple[FramePicture, ...]


class SkippedSample(NamedTuple):
    """A sample that cannot be used."""

    reason: str
    message: str  # the sample, and what is wrong with it


@dataclass
class TrainingSplit:
    """The samples of a split as tokens."""

    samples: Sequence[Sample]
    processor: Processor
    max_pixels: int
    decision_weight: float
    used: list[TrainingSample] = field(default_factory=list)  # by increasing index
    skipped: defaultdict[str, list[str]] = field(default_factory=lambda: defaultdict(list))  # reason -> messages

    def encode(self, generator: np.random.Generator, most: int, max_tokens: int, workers: int) -> None:
        """Encode at most so many samples, chosen at random, and skip those that cannot be used."""
        known: dict[FramePicture, FramePicture] = {}  # equal pictures become one object
        indices = generator.permutation(len(self.samples)).tolist()
        if workers < 0:  # no more than the samples that are needed keep busy
            workers = min(MOST_WORKERS, num_cpus(), most // SAMPLES_PER_WORKER)
        encoded = in_order(partial(self._encode, max_tokens=max_tokens), indices, workers)
        with progress_bar(f"{STAGE}: encoding texts", total=min(most, len(indices))) as advance:
            while len(self.used) < most and (sample := next(encoded, None)):
                if isinstance(sample, SkippedSample):
                    self.skipped[sample.reason].append(sample.message)
                else:
                    pictures = tuple(known.setdefault(picture, picture) for picture in sample.pictures)
                    self.used.append(sample._replace(pictures=pictures))
                    advance(1)
        self.used.sort(key=lambda sample: sample.sample_index)

    def _encode(self, index: int, max_tokens: int) -> TrainingSample | SkippedSample:
        sample = self.samples[index]
        texts = (sample.prompt.system, sample.prompt.user, sample.answer)
        if token := next((t for t in self.processor.chat_tokens if any(t in text for text in texts)), None):
            return SkippedSample("special_token", f"{sample.key}: a text contains {token}")
        row = self.processor.encode(sample, self.max_pixels, self.decision_weight)
        if len(row) > max_tokens:
            return SkippedSample("too_long", f"{sample.key}: {len(row)} tokens")
        return TrainingSample(index, row, tuple(pictures_of(sample)))

    def skip_unreadable(self, unreadable: Mapping[FramePicture, str]) -> None:
        """Skip the samples with a picture that cannot be read, given the messages of such pictures."""
        readable = []
        for sample in self.used:
            messages = [unreadable[picture] for picture in sample.pictures if picture in unreadable]
            if messages:
                self.skipped["unreadable_picture"].append(messages[0])
            else:
                readable.append(sample)
        self.used = readable

    @property
    def lengths(self) -> np.ndarray:
        """Tokens of each used sample, (n,) int64."""
        return np.array([len(sample.row) for sample in self.used], dtype=np.int64)


@dataclass
class TrainingContext:
    """A student, what it learns from and is validated on, and the processes of the training."""

    student: Student
    cfg: TrainConfig
    seed: int
    accelerator: Any
    train: TrainingSplit
    val: TrainingSplit
    reader: PictureReader
    features: dict[FramePicture, Tensors] = field(default_factory=dict)

    def read_pictures(self) -> None:
        """Read and encode all pictures once, and skip the samples with a picture that cannot be read.

        Features that do not fit into their share of the memory are not kept: these pictures are encoded at each use.
        """
        most_bytes = FEATURES_SHARE * memory_bytes() / int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        splits = self.train, self.val
        pictures = list(dict.fromkeys(p for split in splits for sample in split.used for p in sample.pictures))
        with progress_bar(f"{STAGE}: pictures", total=len(pictures)) as advance:
            inputs = in_order(self.reader.try_to_read, pictures, self.cfg.data_workers)
            counted = (advance(1) or result for result in inputs)
            results = read_features(
                self.student, pictures, counted, is_frozen=not self.cfg.train_vision, most_bytes=most_bytes
            )
        self.features = {picture: tensors for picture, tensors in results.items() if not isinstance(tensors, str)}
        if num_not_kept := len(pictures) - len(results):
            words = "%s: the features of %d pictures do not fit into the memory: they are encoded at each use"
            log.warning(words, STAGE, num_not_kept)
        unreadable = {picture: message for picture, message in results.items() if isinstance(message, str)}
        for split in splits:
            split.skip_unreadable(unreadable)

    def features_of(self, samples: Iterable[TrainingSample]) -> list[Tensors]:
        """Return the features of the pictures of samples, sample after sample."""
        pictures = [picture for sample in samples for picture in sample.pictures]
        not_kept = [picture for picture in dict.fromkeys(pictures) if picture not in self.features]
        inputs = map(self.reader.read, not_kept)
        again: Any = read_features(self.student, not_kept, inputs, is_frozen=not self.cfg.train_vision)
        features = [again[picture] if picture in again else self.features[picture] for picture in pictures]
        return encode(self.student, features) if self.cfg.train_vision else features

    def total(self, values: Sequence[float]) -> list[float]:
        """Add up numbers over all processes."""
        import torch

        tensor = torch.tensor(values, dtype=torch.float64, device=self.student.device)
        return self.accelerator.reduce(tensor, "sum").tolist()
