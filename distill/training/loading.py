"""Work that is done ahead by worker processes: tokens counted, and steps made ready, texts to tokens and pictures to patches."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeVar

from cosfly.errors import CosflyError, EnvironmentMissing, InputError
from cosfly.reading.limits import Limits, limits, use_limits
from cosfly.work.worker import end_with_parent
from distill.schema import Sample
from distill.student.encoding import Encoded, encode_text
from distill.student.features import Loaded, Picture, PictureReader, VisionFeatures, pictures_of

log = logging.getLogger(__name__)

ORDERS_AHEAD = 2  # for each worker
MOST_WORKERS = 16

Asked = TypeVar("Asked")
Given = TypeVar("Given")


# --- workers ----------------------------------------------------------------------------------------------------------


def num_workers(wanted: int) -> int:
    """Give how many workers to start: one a core, at most MOST_WORKERS, unless told otherwise."""
    return wanted if wanted >= 0 else min(MOST_WORKERS, len(os.sched_getaffinity(0)))


@dataclass(frozen=True)
class _Work(Generic[Asked, Given]):
    """What torch's loader takes for a data set whose items are named by orders. An error comes back as a value: the loader would
    raise another in its place."""

    function: Callable[[Asked], Given]
    limits: Limits

    def __getitem__(self, order: Asked) -> Given | CosflyError:
        use_limits(self.limits)
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


def in_order(function: Callable[[Asked], Given], orders: Iterable[Asked], workers: int) -> Iterator[Given]:
    """Yield function(order) for each order, in their order; an order is taken only a few before it is its turn.

    Args:
        workers: processes; 0: everything is done here.
    Raises:
        CosflyError: the first one of the function. EnvironmentMissing: a worker was killed.
    """
    import torch

    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")  # threads of its own would not survive the fork
    loader: Any = torch.utils.data.DataLoader(
        _Work(function, limits()),  # type: ignore[arg-type]  # all that the loader asks of a data set
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

    torch says it from a signal's handler, so wherever this process then is: in the middle of a step as well as where it waits for a sample.
    """
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise EnvironmentMissing(
            "a process that reads samples was ended by the system",
            got=str(error).splitlines()[0][:160],
            fix="run the same command again; where memory was short, give the machine more (a container also --shm-size), "
            "or lower distill.train.data_workers",
        ) from error


# --- steps ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A sample ready to be computed, but for the features of its pictures."""

    encoded: Encoded
    pictures: tuple[Picture, ...]
    sample: Sample


@dataclass(frozen=True)
class Order:
    """What a worker is to make: rows of samples, and pictures that are not known yet."""

    step: int
    samples: Sequence[int]
    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Packed:
    """Pictures that were read, their patches in one tensor and their features in another: a tensor on its way from one process to
    another holds a file open, and a step may have hundreds of pictures.

    pictures: each with its key, whether features were found, and how many rows are its own.
    """

    pictures: list[tuple[Picture, str, bool, int]]
    patches: Any
    features: Any

    @classmethod
    def of(cls, loaded: Sequence[Loaded]) -> Packed:
        import torch

        has_features = [item.features is not None for item in loaded]
        arrays = [item.features if found else item.patches for item, found in zip(loaded, has_features, strict=True)]
        joined = []
        for kind in (False, True):
            own = [array for array, found in zip(arrays, has_features, strict=True) if found is kind]
            joined.append(torch.cat(own) if own else None)
        facts = zip(loaded, has_features, arrays, strict=True)
        return cls([(item.picture, item.key, found, len(array)) for item, found, array in facts], *joined)

    def loaded(self) -> list[Loaded]:
        found, begin = [], {False: 0, True: 0}
        for picture, key, has_features, count in self.pictures:
            rows = slice(begin[has_features], begin[has_features] + count)
            begin[has_features] += count
            if has_features:  # of its own, since it may be kept when the others are let go
                found.append(Loaded(picture, key, features=self.features[rows].clone()))
            else:
                found.append(Loaded(picture, key, patches=self.patches[rows]))
        return found


@dataclass(frozen=True)
class Made:
    """What a worker made. unreadable: picture -> why it cannot be read."""

    step: int
    rows: list[Row]
    packed: Packed
    unreadable: dict[Picture, str]


@dataclass(frozen=True)
class Maker:
    """Makes what is ordered; goes to worker processes."""

    samples: Sequence[Sample]
    reader: PictureReader

    def __call__(self, order: Order) -> Made:
        samples = [self.samples[index] for index in order.samples]
        rows = [Row(encode_text(self.reader.processor, s), tuple(pictures_of(s)), s) for s in samples]
        loaded, unreadable = [], {}
        for picture in order.pictures:
            try:
                loaded.append(self.reader.read(picture))
            except InputError as error:
                unreadable[picture] = str(error)
        return Made(order.step, rows, Packed.of(loaded), unreadable)


@dataclass(frozen=True)
class Ready:
    """The rows of a step. left_out: key of a sample whose pictures cannot be read -> why."""

    step: int
    rows: list[Row]
    left_out: dict[str, str]


@dataclass
class Supply:
    """Gives the rows of one step after the other, features of their pictures at hand, and measures how long it was waited for."""

    features: VisionFeatures
    reader: PictureReader
    workers: int
    waited_s: float = 0.0  # for the last step
    _unreadable: dict[Picture, str] = field(default_factory=dict)

    def steps(
        self,
        samples: Sequence[Sample],
        pictures: Callable[[int], Sequence[Picture]],
        shares: Iterable[tuple[int, Sequence[int]]],
    ) -> Iterator[Ready]:
        """Yield what is ready for each (step, indices of samples).

        Args:
            pictures: gives the pictures of a sample by its index.
        """
        plan = self.features.plan()
        orders = (
            Order(step, indices, self.features.wanted(plan, (p for index in indices for p in pictures(index))))
            for step, indices in shares
        )
        made_steps = in_order(Maker(samples, self.reader), orders, self.workers)
        while True:
            begun_s = time.monotonic()
            made = next(made_steps, None)
            if made is None:
                return
            self._unreadable |= made.unreadable
            self.features.take(made.packed.loaded())
            ready = Ready(made.step, [], {})
            for row in made.rows:
                bad = next((picture for picture in row.pictures if picture in self._unreadable), None)
                if bad is None:
                    ready.rows.append(row)
                else:
                    ready.left_out[row.encoded.key] = self._unreadable[bad]
            self.waited_s = time.monotonic() - begun_s
            yield ready
            self.features.end_step()
