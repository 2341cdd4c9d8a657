"""Slots: the teacher names facts, their values are filled in from the flight, in both languages.

Numbers, units, sides, trends and the mirror are right by construction. A sentence is proved if its words beside slots
are known and fit them (earned.py), or if claims that quote the others hold; else it is unread.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, get_args

from pydantic import ValidationError

from caption.answer_formats.contract import Draft, Refused, WayOfWriting
from caption.answer_formats.earned import is_earned
from caption.answer_formats.filling import Filler, facts_of
from caption.answer_formats.outside import SLOT_MARK
from caption.answer_formats.templates import Sentence, read_sentence
from caption.schema import Judged
from caption.verification.claims import judge_sentence
from caption.verification.facts import Facts
from caption.verification.glossary import load_glossary, written_units
from caption.verification.mirror import TEXTS, lacking
from caption.verification.references import QUANTITIES
from caption.verification.sizes import same_size
from caption.verification.stated import Pole, read_stated
from cosfly.formats.captions import Claim, Coc, Language, Modality, SentenceState, Template, Writing
from cosfly.llm.answer_text import Parsed, cut_sentences

MAX_CLAIMS = 60
MAX_TEXT = 48  # characters of a claim's texts
MAX_QUOTE = 200  # characters
UNITS = ("m", "mps", "deg", "dps", "px", "percent", "times")

_TEXT = {"type": "string", "maxLength": MAX_TEXT}
_CLAIM_SCHEMA: dict[str, Any] = {
    "type": "object",
    "properties": {
        "sentence": {"type": "string", "pattern": "^[CR][1-9][0-9]?$"},
        "quantity": _TEXT,
        "at": {"type": "string", "maxLength": 9},
        "value": {"anyOf": [{"type": "number"}, _TEXT]},
        "unit": {"type": "string", "enum": ["", *UNITS]},
        "modality": {"type": "string", "enum": list(get_args(Modality))},
    },
    "required": ["sentence", "quantity", "at", "value", "unit", "modality"],
    "additionalProperties": False,
}

QUOTED_SCHEMA: dict[str, Any] = {
    "type": "array",
    "maxItems": MAX_CLAIMS,
    "items": _CLAIM_SCHEMA
    | {
        "properties": _CLAIM_SCHEMA["properties"]
        | {"quote": {"type": "string", "minLength": 1, "maxLength": MAX_QUOTE}},
        "required": [*_CLAIM_SCHEMA["required"], "quote"],
    },
}


def read_quoted(value: Any, sentences: Mapping[str, str], language: Language) -> list[Claim]:
    """Read a list of claims that quote the words they stand for. Skipped are claims that are malformed, that quote
    what their sentence does not hold, or whose number their quote does not hold."""
    claims = list[Claim]()
    for item in value[:MAX_CLAIMS] if isinstance(value, list) else ():
        quote = item.get("quote") if isinstance(item, dict) else None
        if not isinstance(quote, str) or not 0 < len(quote) <= MAX_QUOTE:
            continue
        read = _claim({name: part for name, part in item.items() if name != "quote"})
        if read is None:
            continue
        claim = read.model_copy(update={"quote": quote})
        if quote in sentences.get(claim.sentence, "") and _is_quoted(claim, quote, language):
            claims.append(claim)
    return claims


def _is_quoted(claim: Claim, quote: str, language: Language) -> bool:
    """Return whether a claim's number stands in its quote."""
    if isinstance(claim.value, str):
        return True
    return any(same_size(numeral, claim) for numeral in read_stated(quote, language).numerals)


def _claim(item: dict[str, Any]) -> Claim | None:
    """Read one claim, None where it is malformed. An empty text is none."""
    given = {name: None if name in ("at", "unit") and text in ("", "null") else text for name, text in item.items()}
    unit = written_units("en").get(str(given.get("unit")).lower())
    if given.get("unit") not in UNITS and unit is not None and unit.factor == 1.0:
        given["unit"] = unit.name  # "m/s"
    if given.get("at") is not None:
        given["at"] = _frames(str(given["at"]))
    value = given.get("value")
    if given.get("unit") and isinstance(value, str) and _NUMBER.fullmatch(value):
        given["value"] = float(value)
    if any(isinstance(text, str) and len(text) > MAX_TEXT for text in given.values()):
        return None
    try:
        return Claim(**given)
    except (ValidationError, TypeError):
        return None


_NUMBER = re.compile(r"[-+]?\d{1,9}(?:\.\d{1,9})?")
_FRAME = re.compile(r"t(\d{1,2})(?!\d)", re.IGNORECASE)


def _frames(at: str) -> str:
    """Write the frames of a claim in one way, whatever stands between them: "t1..t4" is t1-t4."""
    found = _FRAME.findall(at)
    if not found or _FRAME.sub("", at).strip(" .,-–~:to至到") != "":
        return at
    return f"t{found[0]}" if len(found) == 1 else f"t{found[0]}-t{found[-1]}"


MAX_COMPLAINTS = 6  # named at once
CONTRADICTIONS = ("false", "text says otherwise", "claims disagree", "decision")  # among the problems of claims
# Dimension of a word -> what claims of it begin with.
CLAIMED_BY: dict[str, tuple[str, ...]] = {
    "trend": ("trend",), "pace": ("comparison", "compared"), "motion": ("target_motion", "drone_motion"),
    "gap": ("trend", "walking"), "visibility": ("visibility",), "centre": ("framing", "side"),
}  # fmt: skip
# By slots alone nothing is contradicted, so nobody asks which sentence it was.
_JUDGED = {state: Judged("", "", state) for state in get_args(SentenceState)}


class Slots(WayOfWriting):
    """The teacher writes templates."""

    name: Writing = "slots"
    system = "system_slots_en"
    mirror_system = "mirror_slots_system"
    fields: Mapping[str, dict] = {}
    optional: Mapping[str, dict] = {"claims": QUOTED_SCHEMA}

    def table(self, facts: Facts) -> str:
        return fact_table(facts)

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        filler = Filler(facts, answer.coc.flight_decision, "en")
        return _fill(answer.coc, filler, answer.more.get("claims"), answer.therefore)

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        assert english.template is not None
        if answer.coc.flight_decision != english.coc.flight_decision:
            return Refused("decision", f'"flight_decision" must stay {english.coc.flight_decision}.')
        problem = _compare(english.template, answer.coc, facts)
        if problem is not None:
            return problem
        filler = Filler(facts, answer.coc.flight_decision, "zh")
        found = _fill(answer.coc, filler, answer.more.get("claims"))
        if isinstance(found, Refused):
            return found
        missing = lacking(_terms(english.template, facts), found.coc)
        return Refused("glossary", missing, found) if missing else found

    def judge(self, draft: Draft, facts: Facts, language: Language) -> list[Judged]:
        return list(draft.judged)


@lru_cache(maxsize=64)  # an English text is read again when its mirror is held against it
def read_text(text: str, language: Language, num_frames: int, step_s: float) -> tuple[Sentence | Refused, ...]:
    """Read the sentences of a text."""
    return tuple([read_sentence(part, language, num_frames, step_s) for part in cut_sentences(text)])


def _fill(written: Coc, filler: Filler, claimed: Any, therefore: str | None = None) -> Draft | Refused:
    """Fill the templates of an answer, or tell all that is wrong with their sentences.

    Args:
        claimed: the claims of the answer, as they came. Those of sentences that slots prove are not kept.
    """
    facts, language, num_frames = filler.facts, filler.language, len(filler.facts)
    judged: list[Judged] = []
    claims: list[Claim] = []
    problems: list[Refused] = []
    doubts: list[str] = []
    texts: dict[str, str] = {}
    for name in TEXTS:
        filled: list[str] = []
        is_reasoning = name == "reasoning_trace"
        sentences = read_text(getattr(written, name), language, num_frames, facts.step_s)
        for number, sentence in enumerate(sentences, 1):
            plain: str | Refused = (
                sentence if isinstance(sentence, Refused) else filler.fill(sentence, is_reasoning=is_reasoning)
            )
            if isinstance(plain, str) and isinstance(sentence, Sentence):
                found, own = _JUDGED[sentence.state], list[Claim]()
                if claimed and sentence.state == "unread":
                    key = f"{name[0].upper()}{number}"
                    own = read_quoted(claimed, {key: sentence.beside}, language)
                    if own:
                        found = _judge_beside(key, sentence, own, filler)
                judged.append(found)
                claims += own
                words = (*sentence.doubtful, *(claim.quote for claim in own))
                if words and found.state == "unread":
                    doubts.append(
                        f'{name}, sentence {number}: "{words[0]}" is said by no slot and no claim that holds.'
                    )
                filled.append(plain)
            elif isinstance(plain, Refused):
                problems.append(Refused(plain.reason, f"{name}, sentence {number}: {plain.complaint}."))
        texts[name] = "".join(filled)
    if problems:
        return Refused(problems[0].reason, " ".join(problem.complaint for problem in problems[:MAX_COMPLAINTS]))
    template = Template(
        critical_components=written.critical_components,
        reasoning_trace=written.reasoning_trace,
        claims=claims or None,
    )
    return Draft(
        Coc(**texts, flight_decision=written.flight_decision),
        therefore,
        template,
        tuple(judged),
        " ".join(doubts[:MAX_COMPLAINTS]),
    )


def _judge_beside(name: str, sentence: Sentence, claims: Sequence[Claim], filler: Filler) -> Judged:
    """Judge a sentence that its slots do not prove by claims of the words beside them."""
    facts, language = filler.facts, filler.language
    beside, references = sentence.beside, [place.slot.reference for place in sentence.places]
    found = judge_sentence(name, beside, claims, filler.decision, facts, language)
    problems = tuple(one for one in found.problems if one.startswith(CONTRADICTIONS))
    if problems:
        return Judged(name, "", "contradicted", problems)
    poles = read_stated(beside, language).poles
    claimed = {
        at: claim.quantity.partition("trend:")[2]
        for claim in claims
        for pole in _words_of(claim, beside, poles)
        for at in range(pole.start, pole.start + len(pole.word))
    }
    is_proved = found.state == "proved" and claimed and is_earned(beside, references, len(facts), language, claimed)
    return Judged(name, "", "proved" if is_proved else "unread")


def _words_of(claim: Claim, beside: str, poles: Sequence[Pole]) -> list[Pole]:
    """Return the measurable words of a claim's quote; none where one is of another kind or another's, denied or
    wished."""
    start, quote = beside.find(claim.quote or ""), claim.quote or ""
    own = [pole for pole in poles if start <= pole.start and pole.start + len(pole.word) <= start + len(quote)]
    whose = {"target_motion": "drone", "drone_motion": "target"}.get(claim.quantity)  # of the other one
    kind = claim.quantity.partition(":")[0]
    is_of_kind = all(kind in CLAIMED_BY.get(one.dimension, ()) and one.about != whose for one in own)
    is_stated = claim.modality == "observed" and not any(one.is_negated or one.is_plan for one in own)
    return own if SLOT_MARK not in quote and is_of_kind and is_stated else []


def _terms(english: Template, facts: Facts) -> list[tuple[str, str]]:
    """Return the glossary's terms of an English template, slots aside: these are filled in from the glossary."""
    found: list[tuple[str, str]] = []
    for name in TEXTS:
        for sentence in read_text(getattr(english, name), "en", len(facts), facts.step_s):
            assert isinstance(sentence, Sentence)  # else there is no English draft
            found += sentence.terms
    return list(dict.fromkeys(found))  # in their order, so that a complaint is the same in every run


def _compare(english: Template, chinese: Coc, facts: Facts) -> Refused | None:
    """Hold the Chinese template against the English one: sentence by sentence the same slots, each in its script."""
    for name in TEXTS:
        ours = read_text(getattr(english, name), "en", len(facts), facts.step_s)
        theirs = read_text(getattr(chinese, name), "zh", len(facts), facts.step_s)
        if len(ours) != len(theirs):
            words = f"{name} has {len(ours)} sentences in English and {len(theirs)} in Chinese; write one for each."
            return Refused("sentences", words)
        for number, (mine, other) in enumerate(zip(ours, theirs, strict=True), 1):
            assert isinstance(mine, Sentence)  # else there is no English draft
            if isinstance(other, Refused):
                return Refused(other.reason, f"{name}, sentence {number}: {other.complaint}.")
            if mine.names != other.names:
                names = "; ".join(f"{{{name}}}" for name in mine.names) or "none"
                return Refused("slots", f"{name}, sentence {number} must hold these slots and no other: {names}.")
            if not other.is_in_script:
                return Refused("script", f"{name}, sentence {number} is not written in Chinese.")
    return None


# --- what a teacher is shown ------------------------------------------------------------------------------------------

_SERIES = (
    "speed", "altitude", "distance", "target_speed", "yaw", "pitch", "offset_x", "offset_y", "bearing", "box_width",
    "box_height",
)  # fmt: skip
_SPANNED = ("speed", "altitude", "distance", "target_speed", "box_height")  # shown with change and trend
_NOW = (
    "mean:target_speed", "target_travelled", "travelled", "displacement", "climb_rate", "slant", "height_over_target",
    "depression",
    "heading", "target_heading", "change:target_heading", "others_in_view", "other_distance",
    "alike_differences",
)  # fmt: skip
_WORDS = (
    "target_motion", "drone_motion", "comparison:speed", "side:yaw", "side:target_heading", "side:bearing",
    "side:offset_x",
    "side:offset_y", "box@t0", "box",
)  # fmt: skip


def fact_table(facts: Facts) -> str:
    """Return the facts of a window with the names of their slots, as they are filled in; what is not known is left
    out."""
    last = len(facts) - 1
    lines = []
    for name in _SERIES:
        values = dict(facts_of(facts, [f"{name}@t{i}" for i in range(last + 1)]))
        if not values:
            continue
        unit = " " + load_glossary().written_units["en"][QUANTITIES[name].unit]
        series = ", ".join(values.get(f"{name}@t{i}", "-").removesuffix(unit) for i in range(last + 1))
        more = [f"change:{name}", f"trend:{name}"] if name in _SPANNED else []
        lines.append(f"{{{name}@t0}} to {{{name}@t{last}}}: {series}{unit}{_listed(facts, more, '; ')}")
    seen = ", ".join(text for _, text in facts_of(facts, [f"visibility@t{i}" for i in range(last + 1)]))
    lines.append(f"{{visibility@t0}} to {{visibility@t{last}}}: {seen}")
    lines += [_listed(facts, names).removeprefix("; ") for names in (_NOW, _WORDS)]
    return "Table of facts (- is not known; {decision} is there too):\n" + "\n".join(lines)


def _listed(facts: Facts, names: Sequence[str], before: str = "") -> str:
    listed = "; ".join(f"{{{name}}} {text}" for name, text in facts_of(facts, names))
    return before + listed if names else ""
