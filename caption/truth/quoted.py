"""Claims that quote the words they stand for: what a teacher states in words that no slot says.

Their JSON schema, and their reader. Whether they hold is compared in claims.py.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, get_args

from pydantic import ValidationError

from caption.truth.glossary import written_units
from caption.truth.sizes import same_size
from caption.truth.stated import read_stated
from cosfly.products.captions import Claim, Language, Modality

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
    """Tell whether a claim's number stands in its quote."""
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
