"""What chance would give on the same windows: shares of a run mean little without it.

Most decisions that a flight does not contradict are no conflict, so a teacher that guesses has much of its work
accepted. All figures here are expectations, worked out from counts; nothing is drawn.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

from pydantic import BaseModel, ConfigDict

from cosfly.products.captions import Caption, Language
from cosfly.work.store import sha256_bytes

FEWEST_WINDOWS = 30  # below, a share says nothing
FEWEST_TEXTS = 0.01  # distinct texts for each window, below which a warning says so
_VERDICTS = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")
_NO_NUMBERS = str.maketrans("", "", "0123456789.-−")


class Shares(BaseModel):
    """Shares of the windows by the verdict of their first answer."""

    model_config = ConfigDict(extra="forbid")

    consistent: float
    soft_conflict: float
    hard_conflict: float
    abstain: float


class ChanceReport(BaseModel):
    """A run's first answers beside what chance gives.

    random_decisions: every action equally often. shuffled_decisions: the run's own decisions dealt to its windows anew.
    one_decision: the best single one, `decision`, for every window. distinct_texts: language -> texts that differ in
    more than their numbers, of the windows that have an answer. warnings: what is no better than chance.
    """

    model_config = ConfigDict(extra="forbid")

    windows: int
    first_answers: Shares
    random_decisions: Shares
    shuffled_decisions: Shares
    one_decision: Shares
    decision: str
    distinct_texts: dict[Language, int]
    warnings: list[str]


class ChanceCounts:
    """Counts windows one by one; memory grows with the number of distinct texts only, by a short hash each. tokens: of
    all actions."""

    def __init__(self, tokens: Sequence[str]) -> None:
        self.tokens = tokens
        self.num_windows = 0
        self.decisions: Counter[str] = Counter()
        self.verdicts: Counter[str] = Counter()
        self.labels: Counter[str] = Counter()
        self.hard: Counter[str] = Counter()  # decision -> windows that contradict it
        self.open: Counter[str] = Counter()  # decision -> windows without a label that do not contradict it
        self.texts: dict[Language, set[str]] = {"en": set(), "zh": set()}

    def add(self, caption: Caption) -> None:
        """Count a window that has an answer and whose flight says what it contradicts."""
        contradicted = caption.checks.contradicted
        if caption.en is None or contradicted is None:
            return
        repair = caption.repair
        self.num_windows += 1
        self.decisions[repair.first_decision if repair else caption.en.flight_decision] += 1
        self.verdicts[str(repair.first_verdict if repair else caption.verdict)] += 1
        self.hard.update(contradicted)
        if caption.label is None:
            self.open.update(set(self.tokens) - set(contradicted))
        else:
            self.labels[caption.label] += 1
        for language, texts in self.texts.items():
            coc = caption.en if language == "en" else caption.zh
            template = (caption.slots or {}).get(language, coc)
            if template is not None:
                text = f"{template.critical_components}\n{template.reasoning_trace}".translate(_NO_NUMBERS)
                texts.add(sha256_bytes(text.encode())[:16])

    def report(self) -> ChanceReport | None:
        """Give the figures; None where no window has any."""
        n = self.num_windows
        if n == 0:
            return None
        first = Shares(**{name.lower(): self.verdicts[name] / n for name in _VERDICTS})
        best = max(self.tokens, key=lambda action: self.labels[action])
        shuffled = self._expected((action, self.decisions[action] / n) for action in self.tokens)
        constant = self._expected([(best, 1.0)])
        return ChanceReport(
            windows=n,
            first_answers=first,
            random_decisions=self._expected((action, 1.0 / len(self.tokens)) for action in self.tokens),
            shuffled_decisions=shuffled,
            one_decision=constant,
            decision=best,
            distinct_texts={language: len(texts) for language, texts in self.texts.items()},
            warnings=self._warnings(first, shuffled, constant, best),
        )

    def _expected(self, weights: Iterable[tuple[str, float]]) -> Shares:
        """Give the shares of decisions that are dealt without a look at the windows: action -> how often."""
        n, consistent, hard, abstain = self.num_windows, 0.0, 0.0, 0.0
        for action, weight in weights:
            consistent += weight * self.labels[action] / n
            hard += weight * self.hard[action] / n
            abstain += weight * self.open[action] / n
        soft = max(0.0, 1.0 - consistent - hard - abstain)
        return Shares(consistent=consistent, soft_conflict=soft, hard_conflict=hard, abstain=abstain)

    def _warnings(self, first: Shares, shuffled: Shares, constant: Shares, best: str) -> list[str]:
        n = self.num_windows
        if n < FEWEST_WINDOWS:
            return []
        found = []
        # Two standard errors of a share of independent windows; neighbours overlap, so the truth is wider still.
        noise = 2.0 * math.sqrt(shuffled.consistent * (1.0 - shuffled.consistent) / n)
        if first.consistent <= shuffled.consistent + noise:
            found.append(
                f"the decisions are no better than chance: {100 * first.consistent:.1f} % of {n:,} agree with the "
                f"flight, {100 * shuffled.consistent:.1f} % would if the same decisions were dealt at random"
            )
        elif first.consistent <= constant.consistent:
            found.append(
                f"always {best} would agree with the flight as often: {100 * constant.consistent:.1f} %, "
                f"the decisions {100 * first.consistent:.1f} % of {n:,}"
            )
        for language, texts in self.texts.items():
            if texts and len(texts) <= max(1, FEWEST_TEXTS * n):
                found.append(f"{len(texts)} distinct texts ({language}) for {n:,} windows: the teacher repeats itself")
        return found
