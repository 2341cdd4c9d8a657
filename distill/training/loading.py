"""Data of a training: the summary of a split, tokens and pictures by worker processes, features of pictures on disk."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cosfly.formats.places import flight_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.worker import end_with_parent
from distill.schema import Sample
from distill.student.chat import PLAIN_WEIGHTS, AnswerWeights, EncodedSample, Processor, special_token_in
from distill.student.features import FramePicture, PictureReader, Tensors, encode, pictures_of
from distill.student.model import Student
from distill.student.saving import save_tensors
from distill.training.settings import Steps, TrainConfig

MOST_WORKERS = 16
SAMPLES_AT_ONCE = 64  # samples that a worker counts at a time
PICTURES_PER_FILE = 256
TOO_LONG, SPECIAL_TOKEN, UNREADABLE = "too_long", "special_token", "unreadable_picture"

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def num_workers(wanted: int) -> int:
    """Return the number of worker processes: one per CPU, at most MOST_WORKERS, if the wanted number is negative."""
    return wanted if wanted >= 0 else min(MOST_WORKERS, num_cpus())


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


# --- samples ----------------------------------------------------------------------------------------------------------


class SampleTokens(NamedTuple):
    """What the summary of a split keeps of a sample. place: its index in the split."""

    place: int
    key: str
    num_tokens: int
    num_answer_tokens: int
    decision: str
    pictures: tuple[FramePicture, ...]
    skip_reason: str = ""
    skip_detail: str = ""


@dataclass(frozen=True)
class Tokenizer:
    """Tokenizes samples of a split by their indices, also in worker processes."""

    samples: Sequence[Sample]
    processor: Processor
    max_pixels: int
    weights: AnswerWeights = PLAIN_WEIGHTS

    def __call__(self, indices: Sequence[int]) -> list[tuple[EncodedSample, Sample]]:
        samples = [self.samples[index] for index in indices]
        return [(self.processor.encode(sample, self.max_pixels, self.weights), sample) for sample in samples]

    def count(self, indices: Sequence[int], max_tokens: int) -> list[SampleTokens]:
        """Count the tokens of samples, and find those that cannot be used."""
        found = []
        for index in indices:
            sample, reason, detail, prompt, answer = self.samples[index], "", "", 0, 0
            if token := special_token_in(self.processor, sample):
                reason, detail = SPECIAL_TOKEN, f"a text contains {token}"
            else:
                encoded = self.processor.encode(sample, self.max_pixels)
                prompt, answer = len(encoded.prompt_ids), len(encoded.answer_ids)
                if prompt + answer > max_tokens:
                    reason, detail = TOO_LONG, f"{prompt} prompt + {answer} answer tokens, at most {max_tokens}"
            pictures = tuple(pictures_of(sample))
            decision = sample.decision
            found.append(SampleTokens(index, sample.key, prompt + answer, answer, decision, pictures, reason, detail))
        return found


@dataclass(frozen=True)
class DatasetSummary:
    """The samples of a split that are used, by increasing index, and those that are skipped."""

    used: list[SampleTokens]
    skipped: list[SampleTokens]

    def __len__(self) -> int:
        return len(self.used)

    @property
    def lengths(self) -> np.ndarray:
        """Tokens of each used sample, (n,) int64."""
        return np.array([sample.num_tokens for sample in self.used], dtype=np.int64)

    @property
    def decisions(self) -> Counter[str]:
        return Counter(sample.decision for sample in self.used)

    @property
    def skip_reasons(self) -> Counter[str]:
        return Counter(sample.skip_reason for sample in self.skipped)

    def without(self, unreadable: Mapping[FramePicture, str]) -> DatasetSummary:
        """Skip the samples with a picture that cannot be read."""
        used, skipped = [], [*self.skipped]
        for sample in self.used:
            bad = next((picture for picture in sample.pictures if picture in unreadable), None)
            if bad is None:
                used.append(sample)
            else:
                skipped.append(sample._replace(skip_reason=UNREADABLE, skip_detail=unreadable[bad]))
        return DatasetSummary(used, skipped)


def summarize(
    tokenizer: Tokenizer, chosen: Sequence[int], max_tokens: int, *, workers: int, accelerator: Any, label: str
) -> DatasetSummary:
    """Count the tokens of the chosen samples of a split; each process of the training counts its share."""
    from accelerate.utils import gather_object

    chunks = [chosen[start : start + SAMPLES_AT_ONCE] for start in range(0, len(chosen), SAMPLES_AT_ONCE)]
    mine = chunks[accelerator.process_index :: accelerator.num_processes]
    counted: list[SampleTokens] = []
    with progress_bar(label, total=sum(map(len, mine))) as advance:
        count = partial(tokenizer.count, max_tokens=max_tokens)
        for part in in_order(count, mine, max(0, min(workers, len(mine) - 1))):
            counted += part
            advance(len(part))
    known: dict[FramePicture, FramePicture] = {}  # equal pictures become one object
    whole = [
        sample._replace(pictures=tuple(known.setdefault(picture, picture) for picture in sample.pictures))
        for sample in sorted(gather_object(counted))
    ]
    return DatasetSummary([s for s in whole if not s.skip_reason], [s for s in whole if s.skip_reason])


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


# --- pictures ---------------------------------------------------------------------------------------------------------


class FeatureFiles:
    """Features of all pictures of a training, in memory-mapped files that its processes share.

    With a vision tower that is trained, the files have the inputs of the tower, which then encodes them at each use.
    unreadable: picture -> why it cannot be read.
    """

    def __init__(self, folder: Path, pictures: Iterable[FramePicture]) -> None:
        self.folder, self.pictures = folder, sorted(set(pictures))
        self.unreadable: dict[FramePicture, str] = {}
        self._tensors: dict[FramePicture, tuple[Any, str, list[str]]] = {}  # its file, prefix and names

    def write(
        self, student: Student, reader: PictureReader, workers: int, accelerator: Any, *, is_frozen: bool
    ) -> None:
        """Read and encode the pictures whose files do not exist yet, each process its share, and open all files."""
        import torch

        size = PICTURES_PER_FILE
        files = {
            self.folder / f"{start // size:06d}.safetensors": self.pictures[start : start + size]
            for start in range(0, len(self.pictures), size)
        }
        self.folder.mkdir(parents=True, exist_ok=True)
        share = list(files)[accelerator.process_index :: accelerator.num_processes]
        missing = [path for path in share if not path.exists()]
        wanted = [picture for path in missing for picture in files[path]]
        read = in_order(reader.try_to_read, wanted, min(workers, len(wanted)))
        with torch.no_grad(), progress_bar("distill.train: pictures", total=len(wanted)) as advance:
            for path in missing:
                found = {str(i): next(read) for i in range(len(files[path]))}
                errors = {number: one for number, one in found.items() if isinstance(one, str)}
                good = {number: one for number, one in found.items() if not isinstance(one, str)}
                if is_frozen:
                    good = dict(zip(good, encode(student, list(good.values())), strict=True))
                tensors = {f"{number}/{name}": t for number, one in good.items() for name, t in one.items()}
                save_tensors(path, tensors, errors)
                advance(len(found))
        accelerator.wait_for_everyone()
        for path, pictures in files.items():
            self._open(path, pictures)

    def _open(self, path: Path, pictures: Sequence[FramePicture]) -> None:
        from safetensors import safe_open

        file = safe_open(path, framework="pt")
        self.unreadable |= {pictures[int(number)]: words for number, words in (file.metadata() or {}).items()}
        for key in list(file.keys()):
            number, _, name = key.partition("/")
            self._tensors.setdefault(pictures[int(number)], (file, number, []))[2].append(name)

    def __getitem__(self, picture: FramePicture) -> Tensors:
        file, number, names = self._tensors[picture]
        return {name: file.get_tensor(f"{number}/{name}") for name in names}


# --- all together -----------------------------------------------------------------------------------------------------


Rows = Sequence[tuple[EncodedSample, Sample]]


@dataclass
class TrainingContext:
    """A student, what it learns from and is validated on, and the processes of the training."""

    student: Student
    cfg: TrainConfig
    seed: int
    accelerator: Any
    workers: int
    train: tuple[Tokenizer, DatasetSummary]
    val: tuple[Tokenizer, DatasetSummary]
    features: FeatureFiles

    def __post_init__(self) -> None:
        self.steps = Steps.make(self.cfg, len(self.train[1]), self.seed)

    def total(self, values: Sequence[float]) -> list[float]:
        """Add up numbers over all processes."""
        import torch

        tensor = torch.tensor(values, dtype=torch.float64, device=self.student.device)
        return self.accelerator.reduce(tensor, "sum").tolist()

    def rows(self, split: tuple[Tokenizer, DatasetSummary], shares: Iterable[Sequence[int]]) -> Iterator[Rows]:
        """Yield the rows of each share of the used samples of a split."""
        tokenizer, summary = split
        indices = ([summary.used[number].place for number in share] for share in shares)
        return in_order(tokenizer, indices, self.workers)

    def features_of(self, rows: Rows) -> list[Tensors]:
        """Return the features of the pictures of rows, row after row."""
        found = [self.features[picture] for _, sample in rows for picture in pictures_of(sample)]
        return encode(self.student, found) if self.cfg.train_vision else found
