"""Why a window is dropped: the codes of `drop_reason` and what each means, for messages and the table of
docs/captions.md."""

from __future__ import annotations

from collections.abc import Mapping

# Code, or its beginning up to the underscore -> what it means. The longest that fits counts.
REASONS = {
    "order_to_come": "the mission's order comes in the window's future, so nothing that was seen tells of it; nobody "
    "was asked",
    "missing_frame": "a picture of the window is missing; nobody was asked",
    "unreadable_frame": "a picture of the window cannot be read",
    "refused_": "the server refused the request, as the word behind says; see `checks.refusal`",
    "engine": "the vLLM engine refused the request",
    "structure_": "no answer had the fields that were asked for, in 3 asks; the word behind says what was "
    "wrong with the last",
    "regeneration_context_full": "prompt and answer fill the server's context: raise it, or send smaller pictures",
    "structure_context_full": "prompt and answer fill the server's context: raise it, or send smaller pictures",
    "hard_conflict": "the flight contradicts the decision (caption.repair.hard_conflict=drop)",
    "soft_conflict": "the decision is not the label (caption.repair.soft_conflict=drop)",
    "conflict_without_label": "the decision is in conflict, and geometry has no label to anchor a repair to",
    "conflict_not_repairable": "the decision of a given caption is in conflict, and its writer cannot be asked again",
    "regeneration_failed": "no answer of caption.repair.max_asks asks had a decision without conflict and a text that "
    "leads to it",
    "decision_against_reasoning": "the text comes to another action than the decision",
    "evidence": "the text contradicts what was measured; see `checks.evidence`",
    "not_in_file": "the file of captions or predictions has none for this window",
    "failed": "the student gave no answer",
    "slots_unknown_reference": "a slot is no name of the table of facts",
    "slots_unknown_fact": "a slot names a fact that is not known in this window",
    "slots_unobserved_frame": "a text names a frame that was not observed",
    "slots_unbalanced_braces": "a brace is not closed or not opened",
    "slots_negated": "a negation stands before a slot, which is always true",
    "slots_no_side": "a side is asked of what has none here",
    "slots_sign_differs": "a number stands beside a direction of other frames",
    "slots_number_outside": "a number or an amount stands outside slots",
    "slots_unit_outside": "another unit than the slot's stands behind it",
    "slots_pole_outside": "a word of direction, trend, comparison or sight stands outside slots",
    "bilingual_decision": "the two languages decide differently",
    "bilingual_script": "a text is not written in its language",
    "bilingual_number": "a number stands in one language alone",
    "bilingual_polarity_": "an opposite is turned round between the languages",
    "bilingual_sentences": "the languages have different numbers of sentences",
    "bilingual_slots": "a sentence has other slots in the other language",
    "bilingual_glossary": "a term is not translated as the glossary has it",
    "bilingual_": "the Chinese text was refused as the English would be, for the code behind",
}  # fmt: skip


def meaning_of(reason: str) -> str:
    """Return what a code of `drop_reason` means."""
    beginnings = [code for code in REASONS if reason == code or (code.endswith("_") and reason.startswith(code))]
    return REASONS[max(beginnings, key=len)] if beginnings else "docs/captions.md explains no such code"


def explained(dropped: Mapping[str, int], most: int = 3) -> str:
    """Return the commonest reasons with their counts and meanings."""
    ordered = sorted(dropped.items(), key=lambda pair: (-pair[1], pair[0]))[:most]
    return "; ".join(f"{count} {reason} ({meaning_of(reason)})" for reason, count in ordered)
