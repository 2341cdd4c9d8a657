"""Every sample looked at before training begins, by many processes: its real number of tokens, and whether it can be learnt from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosfly.console import progress_bar
from cosfly.errors import InputError
from cosfly.frame_views import VIEW_FILES
from cosfly.products.playback import flight_of
from cosfly.store import inside
from distill.schema import Sample
from distill.student.encoding import encode_text, image_size, special_token_in
from distill.student.features import Picture, pictures_of
from distill.student.model import Processor
from distill.training.loading import in_order
from distill.training.ranks import Ranks

SAMPLES_AT_ONCE = 64  # what a worker is given
TOO_LONG, SPECIAL_TOKEN, UNFIT_PICTURE = "too_long", "special_token", "unfit_picture"


@dataclass(frozen=True)
class Counted:
    """What was seen of one sample. reason: why it is left out, with `detail`; None: it is learnt from."""

    index: int
    key: str
    prompt_tokens: int
    answer_tokens: int
    decision: str
    pictures: tuple[Picture, ...]
    reason: str | None = None
    detail: str = ""


@dataclass(frozen=True)
class Looker:
    """Looks at samples; goes to worker processes."""

    samples: Sequence[Sample]
    processor: Processor
    trees: Mapping[str, Path]
    max_tokens: int

    def __call__(self, indices: Sequence[int]) -> list[Counted]:
        sizes: dict[Picture, str] = {}
        return [self._count(index, self.samples[index], sizes) for index in indices]

    def _count(self, index: int, sample: Sample, checked: dict[Picture, str]) -> Counted:
        found = special_token_in(self.processor, sample)
        if found is not None:
            return Counted(index, sample.key, 0, 0, sample.decision, (), SPECIAL_TOKEN, f"{found} stands in a text")
        row, pictures = encode_text(self.processor, sample), tuple(pictures_of(sample))
        counts = len(row.prompt_ids), len(row.answer_ids)
        if len(row) > self.max_tokens:
            detail = f"{counts[0]} prompt + {counts[1]} answer tokens, at most {self.max_tokens}"
            return Counted(index, sample.key, *counts, sample.decision, (), TOO_LONG, detail)
        for picture in pictures:
            if picture not in checked:
                checked[picture] = self._why_unfit(sample, picture)
            if checked[picture]:
                return Counted(index, sample.key, *counts, sample.decision, (), UNFIT_PICTURE, checked[picture])
        return Counted(index, sample.key, *counts, sample.decision, pictures)

    def _why_unfit(self, sample: Sample, picture: Picture) -> str:
        """Compare the header of a picture's file with the prompt; the empty string: it fits."""
        try:
            path = inside(self.trees[picture.run], picture.frame) / VIEW_FILES[picture.view]
            sample.pictures.check_size(path, image_size(path))
        except InputError as error:
            return str(error)
        return ""


@dataclass
class Census:
    """The samples of a split that are learnt from, and how many were left out for what reason.

    indices (n,): their places in the split. prompt_tokens, answer_tokens (n,). examples: reason -> the first sample left out.
    """

    indices: np.ndarray
    prompt_tokens: np.ndarray
    answer_tokens: np.ndarray
    num_samples: int
    decisions: Counter[str]
    skipped: Counter[str]
    examples: dict[str, str]
    pictures: list[Picture]  # each once
    _places: list[np.ndarray] = field(repr=False)  # of the pictures of each sample in `pictures`

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def tokens(self) -> np.ndarray:
        return self.prompt_tokens + self.answer_tokens

    def pictures_of(self, position: int) -> list[Picture]:
        """Give the pictures of the sample at `position` of `indices`."""
        return [self.pictures[place] for place in self._places[position]]


def take_census(
    samples: Sequence[Sample],
    chosen: Sequence[int],
    processor: Processor,
    trees: Mapping[str, Path],
    *,
    max_tokens: int,
    workers: int,
    ranks: Ranks,
    label: str,
) -> Census:
    """Look at the chosen samples of a split; each process of the training takes its share.

    Raises:
        InputError: the training set cannot be read.
    """
    chunks = [chosen[start : start + SAMPLES_AT_ONCE] for start in range(0, len(chosen), SAMPLES_AT_ONCE)]
    mine, looker = chunks[ranks.rank :: ranks.size], Looker(samples, processor, trees, max_tokens)
    seen: list[Counted] = []
    with progress_bar(label, total=sum(map(len, mine))) as advance:
        for counted in in_order(looker, mine, max(0, min(workers, len(mine) - 1))):
            seen += counted
            advance(len(counted))
    everything = sorted((c for part in ranks.gathered(seen) for c in part), key=lambda counted: counted.index)
    return _summed(everything)


def _summed(everything: Sequence[Counted]) -> Census:
    kept = [counted for counted in everything if counted.reason is None]
    left_out = [counted for counted in everything if counted.reason is not None]
    examples: dict[str, str] = {}
    for counted in left_out:
        examples.setdefault(str(counted.reason), f"{counted.key}: {counted.detail}")
    places: dict[Picture, int] = {}
    of_samples = [
        np.array([places.setdefault(picture, len(places)) for picture in counted.pictures], np.int32)
        for counted in kept
    ]
    return Census(
        indices=np.array([counted.index for counted in kept], np.int64),
        prompt_tokens=np.array([counted.prompt_tokens for counted in kept], np.int64),
        answer_tokens=np.array([counted.answer_tokens for counted in kept], np.int64),
        num_samples=len(everything),
        decisions=Counter(counted.decision for counted in kept),
        skipped=Counter(str(counted.reason) for counted in left_out),
        examples=examples,
        pictures=list(places),
        _places=of_samples,
    )


# --- which samples of val ---------------------------------------------------------------------------------------------


def choose_over_all(samples: Sequence[Sample], count: int, rng: np.random.Generator) -> list[int]:
    """Choose samples of a split by turns over all decisions, and within a decision by turns over all flights.

    Returns:
        Indices, increasing: at most `count`.
    """
    by_decision: dict[str, dict[str, list[int]]] = {}
    for index, sample in enumerate(samples):
        flights = by_decision.setdefault(sample.decision, {})
        flights.setdefault(flight_of(sample.sample_id), []).append(index)
    queues = [_by_turns([_shuffled(f, rng) for f in _shuffled(list(flights.values()), rng)])
              for _, flights in sorted(by_decision.items())]  # fmt: skip
    return sorted(_by_turns(queues)[:count])


def _shuffled(items: list, rng: np.random.Generator) -> list:
    return [items[place] for place in rng.permutation(len(items))]


def _by_turns(queues: Sequence[Sequence]) -> list:
    """Take the first of each, then the second of each, and so on."""
    longest = max((len(queue) for queue in queues), default=0)
    return [queue[turn] for turn in range(longest) for queue in queues if turn < len(queue)]
