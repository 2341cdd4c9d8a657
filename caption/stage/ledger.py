"""What became of every window: the reasons to drop one, and counts that add up."""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import zip_longest
from operator import itemgetter
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from cosfly.formats.captions import TOKENS, Caption, TeacherRecord, Usage
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import Record
from cosfly.runtime.run_dir import Tally

NUM_CARDS = 24
# Fields of the report that count captions by a word.
WORDS = (
    "structured", "verdicts_of_first_answers", "verdicts_of_accepted", "labels", "label_from", "judgements",
    "structure", "bilingual", "writing", "recovered",
)  # fmt: skip
# The codes of `drop_reason` and their meanings, for messages and docs/captions.md.
REASONS = {
    "order_to_come": "the mission's order comes in the window's future and is not known in an observed frame; the "
    "teacher is not asked",
    "unusable_frame": "a picture of the window is missing or cannot be read; see `checks.frame`",
    "refused": "the server or engine refused the request; see `checks.refusal`",
    "not_in_file": "the file of captions or predictions has none for this window",
    "structure": "no answer had the requested fields; see `checks.structure`",
    "context_full": "prompt and answer fill the server's context: raise it, or send smaller pictures",
    "conflict": "the decision is in conflict with the flight (see `verdict`), and the settings or a given caption "
    "exclude a regeneration",
    "no_label": "the decision is in conflict, and geometry has no label to anchor a regeneration to",
    "regeneration_failed": "no answer of caption.repair.max_asks asks had a decision without conflict",
    "decision_mismatch": "the reasoning leads to another action than the decision",
    "contradicted_value": "a number of the text contradicts the measured facts; see `checks.contradictions`",
    "invalid_slot": "a slot names nothing, an unknown fact or an unobserved frame, or its braces, unit or side do not "
    "fit",
    "no_reason": "no observed fact supports the given decision",
    "bilingual": "the two languages do not say the same; see `checks.bilingual`",
}


def most_common(counts: Mapping[str, int]) -> dict[str, int]:
    """Return counts in falling order; equal ones by name."""
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))


def explain_drops(dropped: Mapping[str, int]) -> str:
    """Return the three most common reasons with their counts and meanings."""
    reasons = list(most_common(dropped).items())[:3]
    unknown = "docs/captions.md explains no such code"
    return "; ".join(f"{count} {reason} ({REASONS.get(reason, unknown)})" for reason, count in reasons)


# --- the report -------------------------------------------------------------------------------------------------------


class RepairCounts(Record):
    """Counts of rejected answers. rungs: By the attempt that fixed them, or by the outcome if none did."""

    rejected: int
    rungs: dict[str, int]
    outcomes_by_strategy: dict[str, dict[str, int]]
    asks: dict[str, int]


class KeyframeCounts(Record):
    """Counts of chosen windows, and of the windows, calls and label changes that they skip."""

    windows: int
    taken: int
    reasons: dict[str, int]
    calls_saved: int
    changes_missed: int


class CaptionReport(BaseModel):
    """`caption_report.json`. Counts by a word are in falling order; `confusion`: label -> first decision -> count.

    judge_tokens: Of all runs into the directory; not written if no judge was asked.
    """

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    schema_: Literal["cosfly.caption_report"] = Field("cosfly.caption_report", alias="schema")
    schema_version: Literal["1.0"] = "1.0"
    teacher: TeacherRecord | None
    flights: Tally
    windows: Tally
    asks: int
    tokens: dict[str, int]
    structured: dict[str, int]
    verdicts_of_first_answers: dict[str, int]
    verdicts_of_accepted: dict[str, int]
    labels: dict[str, int]
    label_from: dict[str, int]
    confusion: dict[str, dict[str, int]] = Field(alias="confusion_label_to_first_decision")
    repair: RepairCounts
    judgements: dict[str, int]
    keyframes: KeyframeCounts | None  # None: all windows were used
    structure: dict[str, int]
    bilingual: dict[str, int]
    writing: dict[str, int]  # of accepted captions: how the texts were made
    values: dict[str, dict[str, int]]  # of all captions: language -> values_filled, _matched, _contradicted
    contradicted_captions: int
    recovered: dict[str, int]
    refusals: dict[str, str] = {}  # of dropped windows: code -> the last message of the server
    judge_tokens: Usage | None = None

    def warnings(self) -> list[str]:
        """Return what a reader must know before using the captions."""
        return [
            f"windows were dropped because of {code} ({message}); --retry-failed asks about them again"
            for code, message in self.refusals.items()
        ]

    def as_json(self) -> dict:
        return self.model_dump(mode="json", by_alias=True, exclude=set() if self.judge_tokens else {"judge_tokens"})


# --- the ledger -------------------------------------------------------------------------------------------------------


class SampleCards:
    """Samples captions of every kind for the page: those of the smallest hash, in whatever order they come."""

    def __init__(self) -> None:
        self._kinds: dict[str, list[tuple[tuple[str, str], Caption]]] = {}

    def add(self, caption: Caption) -> None:
        kind = "dropped" if caption.status == "dropped" else "repaired" if caption.repair else str(caption.verdict)
        cards = self._kinds.setdefault(kind, [])
        key = (sha256_bytes(caption.sample_id.encode())[:16], caption.sample_id)
        if len(cards) < NUM_CARDS or key < cards[-1][0]:
            insort(cards, (key, caption), key=itemgetter(0))
            del cards[NUM_CARDS:]

    def chosen(self) -> list[Caption]:
        """Return up to NUM_CARDS captions, the kinds in turn, sorted by id."""
        turns = zip_longest(*(self._kinds[kind] for kind in sorted(self._kinds)))
        captions = [card[1] for turn in turns for card in turn if card is not None]
        return sorted(captions[:NUM_CARDS], key=lambda caption: caption.sample_id)


class Ledger:
    """Counts captions one by one; memory does not grow with them."""

    def __init__(self) -> None:
        self.windows = Tally()
        self.num_asks = self.num_skipped = self.num_missed = self.num_contradicted = 0
        self.teacher: TeacherRecord | None = None
        self.cards = SampleCards()
        self.words = {name: Counter[str]() for name in WORDS}
        self.keyframes: Counter[str] = Counter()
        self.values: Counter[tuple[str, str]] = Counter()  # language, name of the count
        self.refusals: dict[str, str] = {}
        self.tokens: Counter[str] = Counter()
        self.repair_asks: Counter[int] = Counter()
        self.rungs: Counter[str] = Counter()  # the attempt that repaired, or the outcome if none did
        self.confusion: Counter[tuple[str, str]] = Counter()  # label, first decision
        self.outcomes: Counter[tuple[str, str]] = Counter()  # strategy, rung or outcome

    def add(self, caption: Caption) -> None:
        """Count a caption."""
        self.windows.input += 1
        self.num_asks += caption.attempts
        self.teacher = caption.teacher.model_copy(update={"structured": None})
        self.tokens.update(caption.usage.model_dump())
        self.cards.add(caption)
        self._add_outcome(caption)
        self._add_checks(caption)
        label, repair, judge = caption.label or "none", caption.repair, caption.judge
        self.words["labels"][label] += 1
        self.words["label_from"][caption.label_from] += 1
        self.words["structured"][caption.teacher.structured or "none"] += 1
        if caption.en is not None:
            verdict = repair.first_verdict if repair else caption.verdict
            self.words["verdicts_of_first_answers"][str(verdict)] += 1
            self.confusion[label, repair.first_decision if repair else caption.en.flight_decision] += 1
        if repair:
            self.repair_asks[repair.asks] += 1
            rung = repair.rung or repair.outcome
            self.rungs[rung] += 1
            self.outcomes[repair.strategy, rung] += 1
        if judge:
            self.words["judgements"][judge.verdict] += 1
            if judge.overruled_by is not None:
                self.words["judgements"][f"overruled_by_{judge.overruled_by}"] += 1

    def _add_outcome(self, caption: Caption) -> None:
        if caption.status == "accepted":
            self.windows.kept += 1
            self.words["verdicts_of_accepted"][str(caption.verdict)] += 1
            self.words["writing"][caption.writing] += 1
            return
        self.windows.dropped[str(caption.drop_reason)] += 1
        if caption.checks.refusal is not None:
            code, _, message = caption.checks.refusal.partition(": ")
            self.refusals[code] = message

    def _add_checks(self, caption: Caption) -> None:
        checks = caption.checks
        if checks.keyframe is not None:
            self.keyframes[checks.keyframe.reason] += 1
            self.num_skipped += checks.keyframe.skipped
            self.num_missed += checks.keyframe.missed
        for language, counts in (checks.values or {}).items():
            for name, count in counts.model_dump().items():
                self.values[language, name] += count
        self.num_contradicted += checks.contradictions is not None
        self.words["structure"].update([checks.structure] if checks.structure else [])
        self.words["bilingual"].update([checks.bilingual] if checks.bilingual else [])
        self.words["recovered"].update(checks.recovered or ())

    def tally(self, num_unanswered: int) -> Tally:
        """Return the tally of the windows and check that none was lost."""
        failed = Counter({"no_answer": num_unanswered} if num_unanswered else {})
        tally = self.windows.model_copy(update={"input": self.windows.input + num_unanswered, "failed": failed})
        tally.check()
        return tally

    def report(self, tracks: Tally, windows: Tally, judge_tokens: Usage | None) -> CaptionReport:
        order = {token: i for i, token in enumerate((*TOKENS, "none"))}
        return CaptionReport(
            teacher=self.teacher,
            flights=tracks,
            windows=windows,
            **{name: most_common(counts) for name, counts in self.words.items()},
            asks=self.num_asks,
            tokens=dict(sorted(self.tokens.items())),
            confusion=_nested(self.confusion, lambda pair: (order[pair[0]], order[pair[1]])),
            repair=RepairCounts(
                rejected=self.rungs.total(),
                rungs=most_common(self.rungs),
                outcomes_by_strategy=_nested(self.outcomes),
                asks={str(asks): count for asks, count in sorted(self.repair_asks.items())},
            ),
            keyframes=self._keyframes(),
            values=_nested(self.values),
            contradicted_captions=self.num_contradicted,
            refusals=dict(sorted(self.refusals.items())),
            judge_tokens=judge_tokens,
        )

    def _keyframes(self) -> KeyframeCounts | None:
        num_chosen = self.keyframes.total()
        if not num_chosen:
            return None
        return KeyframeCounts(
            windows=num_chosen + self.num_skipped,
            taken=num_chosen,
            reasons=most_common(self.keyframes),
            calls_saved=round(self.num_skipped * (self.num_asks / num_chosen)),
            changes_missed=self.num_missed,
        )


def _nested(
    counts: Counter[tuple[str, str]], key: Callable[[tuple[str, str]], Any] | None = None
) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for outer, inner in sorted(counts, key=key):
        found.setdefault(outer, {})[inner] = counts[outer, inner]
    return found
