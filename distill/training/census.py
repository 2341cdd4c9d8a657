"""Every sample looked at before training begins, by many processes: its real number of tokens, and whether it can be learnt from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosfly.errors import InputError
from cosfly.look.frame_views import VIEW_FILES
from cosfly.products.places import flight_of
from cosfly.work.console import progress_bar
from cosfly.work.store import inside
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

    indices (n,): their places in the split, increasing. prompt_tokens, answer_tokens (n,). examples: reason -> the first sample left out.
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

    def pictures_of(self, index: int) -> list[Picture]:
        """Give the pictures of the sample at a place of the split."""
        return [self.pictures[place] for place in self._places[int(np.searchsorted(self.indices, index))]]


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
    seen = _Seen()
    with progress_bar(label, total=sum(map(len, mine))) as advance:
        for counted in in_order(looker, mine, max(0, min(workers, len(mine) - 1))):
            seen.add(counted)
            advance(len(counted))
    return _census(ranks.gathered(seen))


@dataclass
class _Seen:
    """What one process saw, each picture once, so that a million samples take little. rows: (index, prompt, answer tokens)."""

    rows: list[tuple[int, int, int]] = field(default_factory=list)
    of_samples: list[np.ndarray] = field(default_factory=list)  # places of the pictures of each row
    places: dict[Picture, int] = field(default_factory=dict)
    decisions: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    examples: dict[str, tuple[int, str]] = field(default_factory=dict)  # reason -> index and words of the first

    def add(self, everything: Sequence[Counted]) -> None:
        for counted in everything:
            if counted.reason is not None:
                self.skipped[counted.reason] += 1
                self.examples.setdefault(counted.reason, (counted.index, f"{counted.key}: {counted.detail}"))
                continue
            self.rows.append((counted.index, counted.prompt_tokens, counted.answer_tokens))
            self.of_samples.append(self.places_of(counted.pictures))
            self.decisions[counted.decision] += 1

    def places_of(self, pictures: Sequence[Picture]) -> np.ndarray:
        return np.array([self.places.setdefault(picture, len(self.places)) for picture in pictures], np.int32)


def _census(parts: Sequence[_Seen]) -> Census:
    """Put together what the processes saw, in the order of the split."""
    whole = _Seen()
    of_samples: list[np.ndarray] = []
    for part in parts:
        new_place = whole.places_of(list(part.places))
        of_samples += [new_place[places] for places in part.of_samples]
        whole.rows += part.rows
        whole.decisions += part.decisions
        whole.skipped += part.skipped
        for reason, example in part.examples.items():
            whole.examples[reason] = min(example, whole.examples.get(reason, example))
    rows = np.array(whole.rows, np.int64).reshape(-1, 3)
    order = np.argsort(rows[:, 0])
    return Census(
        indices=rows[order, 0],
        prompt_tokens=rows[order, 1],
        answer_tokens=rows[order, 2],
        num_samples=len(rows) + whole.skipped.total(),
        decisions=whole.decisions,
        skipped=whole.skipped,
        examples={reason: words for reason, (_, words) in whole.examples.items()},
        pictures=list(whole.places),
        _places=[of_samples[place] for place in order],
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
