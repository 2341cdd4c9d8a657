"""Why a window is dropped: the codes of `drop_reason` and their meanings, for messages and docs/captions.md."""

from __future__ import annotations

from collections.abc import Mapping

REASONS = {
    "order_to_come": "the mission's order comes in the window's future, so no observed frame tells of it; the teacher "
    "is not asked",
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


def meaning_of(reason: str) -> str:
    """Return the meaning of a code of `drop_reason`."""
    return REASONS.get(reason, "docs/captions.md explains no such code")


def explained(dropped: Mapping[str, int], most: int = 3) -> str:
    """Return the most common reasons with their counts and meanings."""
    ordered = sorted(dropped.items(), key=lambda pair: (-pair[1], pair[0]))[:most]
    return "; ".join(f"{count} {reason} ({meaning_of(reason)})" for reason, count in ordered)
