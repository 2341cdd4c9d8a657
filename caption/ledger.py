"""The stage's ledger: what became of every window, in counts that add up."""

from __future__ import annotations

from collections import Counter
from typing import Any

from cosfly.coc import ACTIONS, Caption
from cosfly.store import Tally

REPORT_SCHEMA, REPORT_VERSION = "cosfly.caption_report", "1.0"


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
        tally = Tally(self.num_windows + num_unanswered, self.num_accepted, dict(self.drops), failed)
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
            "flights": flights.as_dict(),
            "windows": windows.as_dict(),
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
                "asks": {str(asks): count for asks, count in sorted(self.repair_asks.items())},
            },
            "judgements": _sorted(self.judgements),
            "keyframes": self._keyframe_report(),
            "bilingual": _sorted(self.bilingual),
            "evidence_contradictions": _sorted(self.evidence),
            "recovered": _sorted(self.recovered),
        }

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
