"""The stage's ledger: what became of every window, in counts that add up."""

from __future__ import annotations

from bisect import insort
from collections import Counter
from typing import Any

from cosfly.products.captions import ACTIONS, Caption
from cosfly.stage_folder import Tally
from cosfly.store import sha256_bytes

TEXT_FIELDS = ("critical_components", "reasoning_trace")
BIN_CHARACTERS = {"en": 25, "zh": 10}  # a Chinese character carries about as much as two or three Latin letters
NUM_CARDS = 24
REPORT_SCHEMA, REPORT_VERSION = "cosfly.caption_report", "1.0"


class Shelf:
    """Keeps some captions of every kind for a person to read: those of the smallest hash, whatever the order they come in."""

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
        """Give up to `per_kind` captions in order of their ids, the kinds taking turns."""
        left = [list(self._kinds[kind]) for kind in sorted(self._kinds)]
        chosen: list[Caption] = []
        while len(chosen) < self.per_kind and any(left):
            chosen += [shelf.pop(0)[2] for shelf in left if shelf]
        return sorted(chosen[: self.per_kind], key=lambda caption: caption.sample_id)


class Ledger:
    """Counts captions one by one; memory does not grow with them."""

    def __init__(self) -> None:
        self.num_windows = self.num_accepted = self.num_asks = 0
        self.drops: Counter[str] = Counter()
        self.first_verdicts: Counter[str] = Counter()
        self.final_verdicts: Counter[str] = Counter()
        self.labels: Counter[str] = Counter()
        self.confusion: Counter[tuple[str, str]] = Counter()
        self.repairs: Counter[str] = Counter()
        self.repair_asks: Counter[int] = Counter()
        self.evidence: Counter[str] = Counter()
        self.bilingual: Counter[str] = Counter()
        self.recovered: Counter[str] = Counter()
        self.structured: Counter[str] = Counter()
        self.tokens: Counter[str] = Counter()
        self.outcomes: Counter[tuple[str, str]] = Counter()  # strategy, rung or why there is none
        self.lengths: Counter[tuple[str, str, int]] = Counter()  # language, field, bin
        self.shelf = Shelf()
        self.judgements: Counter[str] = Counter()
        self.keyframes: Counter[str] = Counter()
        self.num_skipped = self.num_missed = 0
        self.teacher: dict[str, Any] = {}

    def add(self, caption: Caption) -> None:
        self.num_windows += 1
        self.num_asks += caption.attempts
        self.teacher = {name: value for name, value in caption.teacher.items() if name != "structured"}
        self.tokens.update(caption.usage)
        self.labels[caption.label or "none"] += 1
        if caption.status == "accepted":
            self.num_accepted += 1
            self.final_verdicts[str(caption.verdict)] += 1
        else:
            self.drops[str(caption.drop_reason)] += 1
        if caption.en is not None:
            first = caption.repair or {"first_verdict": caption.verdict, "first_decision": caption.en.flight_decision}
            self.first_verdicts[first["first_verdict"]] += 1
            self.confusion[caption.label or "none", first["first_decision"]] += 1
        if caption.repair:
            self.repairs[caption.repair["rung"] or caption.repair["outcome"]] += 1
            self.repair_asks[caption.repair["asks"]] += 1
            self.outcomes[caption.repair["strategy"], caption.repair["rung"] or caption.repair["outcome"]] += 1
        for language, coc in (("en", caption.en), ("zh", caption.zh)):
            if coc is not None and caption.status == "accepted":
                for field in TEXT_FIELDS:
                    self.lengths[language, field, len(getattr(coc, field)) // BIN_CHARACTERS[language]] += 1
        self.shelf.add(caption)
        if caption.judge:
            self.judgements[caption.judge["verdict"]] += 1
            if "overruled_by" in caption.judge:
                self.judgements[f"overruled_by_{caption.judge['overruled_by']}"] += 1
        keyframe = caption.checks.get("keyframe")
        if keyframe:
            self.keyframes[keyframe["reason"]] += 1
            self.num_skipped += keyframe["skipped"]
            self.num_missed += keyframe["missed"]
        self._add_checks(caption)

    def _add_checks(self, caption: Caption) -> None:
        evidence = caption.checks.get("evidence")
        if isinstance(evidence, list):
            self.evidence.update({problem.partition(":")[0] for problem in evidence})
            self.evidence["samples"] += 1
        if "bilingual" in caption.checks:
            self.bilingual[caption.checks["bilingual"]] += 1
        self.recovered.update(caption.checks.get("recovered", ()))
        self.structured[caption.teacher.get("structured", "none")] += 1

    def tally(self, num_unanswered: int) -> Tally:
        """Give the windows' tally and check that nothing was lost."""
        failed = {"no_answer": num_unanswered} if num_unanswered else {}
        total = self.num_windows + num_unanswered
        tally = Tally(input=total, kept=self.num_accepted, dropped=dict(self.drops), failed=failed)
        tally.check()
        rejected = sum(self.repairs.values())
        assert rejected == sum(self.repair_asks.values())
        return tally

    def report(self, flights: Tally, windows: Tally) -> dict:
        """Give `caption_report.json`."""
        confusion: dict[str, dict[str, int]] = {}
        order = {token: i for i, token in enumerate((*ACTIONS, "none"))}
        for label, decision in sorted(self.confusion, key=lambda pair: (order[pair[0]], order[pair[1]])):
            confusion.setdefault(label, {})[decision] = self.confusion[label, decision]
        return {
            "schema": REPORT_SCHEMA,
            "schema_version": REPORT_VERSION,
            "teacher": self.teacher,
            "flights": flights.model_dump(),
            "windows": windows.model_dump(),
            "asks": self.num_asks,
            "tokens": dict(sorted(self.tokens.items())),
            "structured": _sorted(self.structured),
            "verdicts_of_first_answers": _sorted(self.first_verdicts),
            "verdicts_of_accepted": _sorted(self.final_verdicts),
            "labels": _sorted(self.labels),
            "confusion_label_to_first_decision": confusion,
            "repair": {
                "rejected": sum(self.repairs.values()),
                "rungs": _sorted(self.repairs),
                "outcomes_by_strategy": self._outcomes_by_strategy(),
                "asks": {str(asks): count for asks, count in sorted(self.repair_asks.items())},
            },
            "lengths": self._length_report(),
            "judgements": _sorted(self.judgements),
            "keyframes": self._keyframe_report(),
            "bilingual": _sorted(self.bilingual),
            "evidence_contradictions": _sorted(self.evidence),
            "recovered": _sorted(self.recovered),
        }

    def _outcomes_by_strategy(self) -> dict[str, dict[str, int]]:
        found: dict[str, dict[str, int]] = {}
        for strategy, outcome in sorted(self.outcomes):
            found.setdefault(strategy, {})[outcome] = self.outcomes[strategy, outcome]
        return found

    def _length_report(self) -> dict:
        """Give, per language and field, the width of a bin in characters and the counts from length 0 on."""
        found: dict[str, dict] = {}
        for language, width in BIN_CHARACTERS.items():
            for field in TEXT_FIELDS:
                bins = {b: n for (lang, name, b), n in self.lengths.items() if (lang, name) == (language, field)}
                counts = [bins.get(b, 0) for b in range(max(bins, default=-1) + 1)]
                found.setdefault(language, {})[field] = {"bin_characters": width, "counts": counts}
        return found

    def _keyframe_report(self) -> dict | None:
        """Say what keyframes saved and what they missed; None where all windows were taken."""
        taken = sum(self.keyframes.values())
        if not taken:
            return None
        calls = self.num_asks / taken
        return {
            "windows": taken + self.num_skipped,
            "taken": taken,
            "reasons": _sorted(self.keyframes),
            "calls_saved": round(self.num_skipped * calls),
            "changes_missed": self.num_missed,
        }


def _sorted(counts: Counter[str]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))
