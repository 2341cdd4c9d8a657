"""The stage's ledger: what became of every window, in counts that add up."""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Callable
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from cosfly.formats.captions import TOKENS, Caption, TeacherRecord, Usage
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.run_dir import Tally

NUM_CARDS = 24
# Fields of the report that count captions by a word.
WORDS = (
    "structured", "verdicts_of_first_answers", "verdicts_of_accepted", "labels", "label_from", "judgements",
    "structure", "bilingual", "writing", "recovered",
)  # fmt: skip


# --- the report -------------------------------------------------------------------------------------------------------


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", populate_by_name=True)


class RepairCounts(_Record):
    """Rejected answers: rung or, where none mended it, outcome -> count; strategy -> the same; asks -> count."""

    rejected: int
    rungs: dict[str, int]
    outcomes_by_strategy: dict[str, dict[str, int]]
    asks: dict[str, int]


class KeyframeCounts(_Record):
    """What keyframes saved and what they missed."""

    windows: int
    taken: int
    reasons: dict[str, int]
    calls_saved: int
    changes_missed: int


class CaptionReport(_Record):
    """`caption_report.json`. Counts by a word are in falling order; `confusion`: label -> first decision -> count.

    judge_tokens: of all runs into the folder; left out where no judge was asked.
    """

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
    keyframes: KeyframeCounts | None  # None: all windows were taken
    structure: dict[str, int]
    bilingual: dict[str, int]
    writing: dict[str, int]  # of accepted captions: how the texts were made
    values: dict[str, dict[str, int]]  # of all captions: language -> values_filled, _matched, _contradicted
    contradicted_captions: int
    recovered: dict[str, int]
    refusals: dict[str, str] = {}  # of dropped windows: code -> the last message of the server
    judge_tokens: Usage | None = None

    def warnings(self) -> list[str]:
        """Return what a person must know before the captions are used."""
        return [
            f"windows were dropped because of {code} ({words}); --retry-failed asks about them again"
            for code, words in self.refusals.items()
        ]

    def as_json(self) -> dict:
        left_out = {"judge_tokens"} if self.judge_tokens is None else set()
        return self.model_dump(mode="json", by_alias=True, exclude=left_out)


# --- the ledger -------------------------------------------------------------------------------------------------------


class Shelf:
    """Keeps some captions of every kind for a person to read: those of the smallest hash, whatever the order they come
    in."""

    def __init__(self, per_kind: int = NUM_CARDS) -> None:
        self.per_kind = per_kind
        self._kinds: dict[str, list[tuple[str, str, Caption]]] = {}

    def add(self, caption: Caption) -> None:
        kind = "dropped" if caption.status == "dropped" else "repaired" if caption.repair else str(caption.verdict)
        shelf = self._kinds.setdefault(kind, [])
        entry = (sha256_bytes(caption.sample_id.encode())[:16], caption.sample_id, caption)
        if len(shelf) < self.per_kind or entry[:2] < shelf[-1][:2]:
            insort(shelf, entry, key=lambda kept: kept[:2])
            del shelf[self.per_kind :]

    def cards(self) -> list[Caption]:
        """Return up to `per_kind` captions in order of their ids, the kinds taking turns."""
        left = [list(self._kinds[kind]) for kind in sorted(self._kinds)]
        chosen: list[Caption] = []
        while len(chosen) < self.per_kind and any(left):
            chosen += [shelf.pop(0)[2] for shelf in left if shelf]
        return sorted(chosen[: self.per_kind], key=lambda caption: caption.sample_id)


class Ledger:
    """Counts captions one by one; memory does not grow with them."""

    def __init__(self) -> None:
        self.windows = Tally()
        self.num_asks = self.num_skipped = self.num_missed = 0
        self.teacher: TeacherRecord | None = None
        self.shelf = Shelf()
        self.words = {name: Counter[str]() for name in WORDS}
        self.keyframes: Counter[str] = Counter()
        self.repairs: Counter[str] = Counter()
        self.values: Counter[tuple[str, str]] = Counter()  # language, name of the count
        self.num_contradicted = 0
        self.refusals: dict[str, str] = {}
        self.tokens: Counter[str] = Counter()
        self.repair_asks: Counter[int] = Counter()
        self.confusion: Counter[tuple[str, str]] = Counter()  # label, first decision
        self.outcomes: Counter[tuple[str, str]] = Counter()  # strategy, rung or why there is none

    def add(self, caption: Caption) -> None:
        self.windows.input += 1
        self.num_asks += caption.attempts
        self.teacher = caption.teacher.model_copy(update={"structured": None})
        self.tokens.update(caption.usage.model_dump())
        self.words["labels"][caption.label or "none"] += 1
        self.words["label_from"][caption.label_from] += 1
        if caption.status == "accepted":
            self.windows.kept += 1
            self.words["verdicts_of_accepted"][str(caption.verdict)] += 1
            self.words["writing"][caption.writing] += 1
        else:
            self.windows.dropped[str(caption.drop_reason)] += 1
            if caption.checks.refusal is not None:
                code, _, words = caption.checks.refusal.partition(": ")
                self.refusals[code] = words
        repair = caption.repair
        if caption.en is not None:
            self.words["verdicts_of_first_answers"][str(repair.first_verdict if repair else caption.verdict)] += 1
            decision = repair.first_decision if repair else caption.en.flight_decision
            self.confusion[caption.label or "none", decision] += 1
        if repair:
            became = repair.rung or repair.outcome
            self.repairs[became] += 1
            self.repair_asks[repair.asks] += 1
            self.outcomes[repair.strategy, became] += 1
        self.shelf.add(caption)
        if caption.judge:
            self.words["judgements"][caption.judge.verdict] += 1
            if caption.judge.overruled_by is not None:
                self.words["judgements"][f"overruled_by_{caption.judge.overruled_by}"] += 1
        self._add_checks(caption)

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
        for name in ("structure", "bilingual"):
            if (outcome := getattr(checks, name)) is not None:
                self.words[name][outcome] += 1
        self.words["recovered"].update(checks.recovered or ())
        self.words["structured"][caption.teacher.structured or "none"] += 1

    def tally(self, num_unanswered: int) -> Tally:
        """Return the windows' tally and check that nothing was lost."""
        assert self.repairs.total() == self.repair_asks.total()
        failed = Counter({"no_answer": num_unanswered} if num_unanswered else {})
        tally = self.windows.model_copy(update={"input": self.windows.input + num_unanswered, "failed": failed})
        tally.check()
        return tally

    def report(self, flights: Tally, windows: Tally, judge_tokens: Usage | None) -> CaptionReport:
        order = {token: i for i, token in enumerate((*TOKENS, "none"))}
        confusion = _nested(self.confusion, lambda pair: (order[pair[0]], order[pair[1]]))
        return CaptionReport(
            teacher=self.teacher,
            flights=flights,
            windows=windows,
            **{name: _sorted(counts) for name, counts in self.words.items()},
            asks=self.num_asks,
            tokens=dict(sorted(self.tokens.items())),
            confusion=confusion,
            repair=RepairCounts(
                rejected=self.repairs.total(),
                rungs=_sorted(self.repairs),
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
        taken = self.keyframes.total()
        if not taken:
            return None
        return KeyframeCounts(
            windows=taken + self.num_skipped,
            taken=taken,
            reasons=_sorted(self.keyframes),
            calls_saved=round(self.num_skipped * (self.num_asks / taken)),
            changes_missed=self.num_missed,
        )


def _nested(
    counts: Counter[tuple[str, str]], key: Callable[[tuple[str, str]], Any] | None = None
) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for one, two in sorted(counts, key=key):
        found.setdefault(one, {})[two] = counts[one, two]
    return found


def _sorted(counts: Counter[str]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))
