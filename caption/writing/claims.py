"""Claims: prose, and beside it a list of what each sentence states, which is compared with the facts and with the
words.

For teachers that cannot write slots. An answer is refused whose claims are not true, not of its text, or whose text
holds a number or an opposite that is neither claimed nor true (caption/truth/coverage.py). The Chinese text is held
against the same claims, sentence by sentence.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from pydantic import ValidationError

from caption.schema import EvidenceConfig, Judged
from caption.truth.claims import judge_claims
from caption.truth.facts import Facts
from caption.truth.glossary import written_units
from caption.truth.mirror import check_mirror, flight_numbers
from caption.truth.references import QUANTITIES
from caption.truth.sizes import same_size
from caption.truth.stated import read_stated
from caption.writing.contract import Draft, Refused, WayOfWriting
from cosfly.errors import plain
from cosfly.products.answer_text import Parsed
from cosfly.products.captions import Claim, Language, Modality, Writing
from cosfly.products.sentences import sentences_of

MAX_CLAIMS = 60
MAX_TEXT = 48  # characters of a claim's texts
MAX_QUOTE = 200  # characters
MAX_COMPLAINTS = 8  # named at once
UNITS = ("m", "mps", "deg", "dps", "px", "percent", "times")

_TEXT = {"type": "string", "maxLength": MAX_TEXT}
CLAIM_SCHEMA: dict[str, Any] = {
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
    "items": CLAIM_SCHEMA
    | {
        "properties": CLAIM_SCHEMA["properties"]
        | {"quote": {"type": "string", "minLength": 1, "maxLength": MAX_QUOTE}},
        "required": [*CLAIM_SCHEMA["required"], "quote"],
    },
}

# What a problem of judge_claims begins with -> the reason that is counted.
_REASONS = {
    "false": "claims_false",
    "decision": "claims_against_decision",
    "uncovered": "claims_uncovered",
    "text says otherwise": "claims_against_text",
    "claims disagree": "claims_disagree",
    "text is not true": "claims_text_false",
    "not in the text": "claims_not_in_text",
    "unknown quantity": "claims_unknown_quantity",
    "unobserved frame": "claims_unobserved_frame",
    "unknown fact": "claims_unknown_fact",
    "claim of no sentence": "claims_no_sentence",
}


class Claims(WayOfWriting):
    """The teacher writes prose and its claims."""

    name: Writing = "claims"
    system = "system_claims_en"
    mirror_system = "mirror_system"
    fields: Mapping[str, dict] = {"claims": {"type": "array", "maxItems": MAX_CLAIMS, "items": CLAIM_SCHEMA}}
    optional: Mapping[str, dict] = {}

    def table(self, facts: Facts) -> str:
        return "Table of facts:\n" + "\n".join(measured_series(facts))

    def read(self, answer: Parsed, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        claims = read_claims(answer.more.get("claims"))
        if isinstance(claims, Refused):
            return claims
        draft = Draft(answer.coc, answer.therefore, claims=claims)
        return refuse_problems(self.judge(draft, facts, EvidenceConfig(), "en"), draft) or draft

    def read_mirror(self, answer: Parsed, english: Draft, facts: Facts) -> Draft | Refused:
        assert answer.coc is not None
        draft = Draft(answer.coc, claims=english.claims)
        ours, theirs = (len(list(sentences_of(coc))) for coc in (english.coc, answer.coc))
        if ours != theirs:
            words = f"The English has {ours} sentences and the Chinese {theirs}; write one for each."
            return Refused("sentences", words, draft)
        problem = check_mirror(english.coc, answer.coc, flight_numbers(facts))
        if problem is not None:
            return Refused(problem, f"The Chinese text is not that of the English one: {problem}.", draft)
        refused = refuse_problems(self.judge(draft, facts, EvidenceConfig(), "zh"), draft)
        return refused or draft

    def judge(self, draft: Draft, facts: Facts, cfg: EvidenceConfig, language: Language) -> list[Judged]:
        return judge_claims(draft.coc, draft.claims, facts, cfg, language, self.vocabulary.actions)


def measured_series(facts: Facts) -> list[str]:
    """Give a line for each quantity that was measured: its values at the frames."""
    return [
        f"{name}: {series} {quantity.unit}"
        for name, quantity in QUANTITIES.items()
        if (series := _series(quantity.read(facts), quantity.digits))
    ]


def _series(values: Sequence[float | None], digits: int) -> str:
    """Write a series, "" where nothing of it is known."""
    known = any(value is not None for value in values)
    return ", ".join("-" if value is None else f"{value:.{digits}f}" for value in values) if known else ""


def read_claims(value: Any) -> tuple[Claim, ...] | Refused:
    """Read the list of claims of an answer; what is wrong with it is for its writer."""
    if not isinstance(value, list):
        return Refused("claims_malformed", '"claims" must be a list of objects.')
    if len(value) > MAX_CLAIMS:
        return Refused("claims_too_many", f"{len(value)} claims, at most {MAX_CLAIMS}; write fewer sentences.")
    claims = []
    for number, item in enumerate(value, 1):
        claim = _claim(item)
        if isinstance(claim, str):
            return Refused("claims_malformed", f"Claim {number}: {claim}.")
        claims.append(claim)
    return tuple(claims)


def read_quoted(value: Any, sentences: Mapping[str, str], language: Language) -> list[Claim]:
    """Read a list of claims that quote the words they stand for. Left out are claims that are malformed, that quote
    what their sentence does not hold, or whose number their quote does not hold."""
    claims = list[Claim]()
    for item in value[:MAX_CLAIMS] if isinstance(value, list) else ():
        quote = item.get("quote") if isinstance(item, dict) else None
        if not isinstance(quote, str) or not 0 < len(quote) <= MAX_QUOTE:
            continue
        read = _claim({name: part for name, part in item.items() if name != "quote"})
        if isinstance(read, str):
            continue
        claim = read.model_copy(update={"quote": quote})
        if quote in sentences.get(claim.sentence, "") and _is_quoted(claim, quote, language):
            claims.append(claim)
    return claims


def _is_quoted(claim: Claim, quote: str, language: Language) -> bool:
    """Tell whether a claim's number stands in its quote."""
    if isinstance(claim.value, str):
        return True
    return any(same_size(numeral, claim) for numeral in read_stated(quote, language).numerals)


def _claim(item: Any) -> Claim | str:
    """Read one claim, or say what is wrong with it. An empty text is none."""
    if not isinstance(item, dict):
        return "it must be an object"
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
        return f"a text is longer than {MAX_TEXT} characters"
    try:
        return Claim(**given)
    except (ValidationError, TypeError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": (), "msg": str(error)}
        return f"{'.'.join(str(part) for part in first['loc'])}: {plain(str(first['msg']))}"


_NUMBER = re.compile(r"[-+]?\d{1,9}(?:\.\d{1,9})?")
_FRAME = re.compile(r"t(\d{1,2})(?!\d)", re.IGNORECASE)


def _frames(at: str) -> str:
    """Write the frames of a claim in one way, whatever stands between them: "t1..t4" is t1-t4."""
    found = _FRAME.findall(at)
    if not found or _FRAME.sub("", at).strip(" .,-–~:to至到") != "":
        return at
    return f"t{found[0]}" if len(found) == 1 else f"t{found[0]}-t{found[-1]}"


def refuse_problems(judged: Sequence[Judged], draft: Draft) -> Refused | None:
    """Refuse a text for what was found in its sentences; None where nothing was."""
    problems = [(one.name, problem) for one in judged for problem in one.problems]
    if not problems:
        return None
    named = "; ".join(f"{name} {problem}" for name, problem in problems[:MAX_COMPLAINTS])
    complaint = (
        f'Sentence by sentence: {named}. "uncovered" stands in the text without a claim of its sentence and is not '
        f'true; "text says '
        'otherwise": the sentence says the opposite of this claim; "text is not true": its words are not, whatever is '
        'claimed; "false" is not what was measured. Mend text and claims together.'
    )
    reason = _REASONS.get(problems[0][1].partition(":")[0], "claims_wrong")
    return Refused(reason, complaint, draft)
