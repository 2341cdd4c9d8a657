"""What the answer of a teacher or a student must look like: its JSON schema, and how it is read (sec:appendix_e)."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from cosfly.formats.captions import BY_LETTERS, FIELDS, TOKENS, Coc, Language
from cosfly.runtime.model_json import find_object

_DECISION = re.compile(
    r"""[\s"'`*_<\[({“”‘’「『【《]*(?:[0-9]{1,2}[.)]\s*)?"""
    r"""(?:(?:option|action|decision|answer|(?:flight|final)[\s_-]?(?:decision|action|answer)|动作|决策|飞行决策)"""
    r"""["'`*]*\s*[:=]\s*["'`*]*)?"""
    r"""(?P<action>[a-z]+(?:[\s_-]+[a-z]+)*)(?:\(\))?[\s"'`*_>\])}“”‘’」』】》.,;:!。、]*"""
)

MIN_CHARACTERS = {"critical_components": 20, "reasoning_trace": 30}
# A Chinese character carries about as much as three Latin letters, so the same thought is a third as long.
MIN_CHARACTERS_ZH = {"critical_components": 7, "reasoning_trace": 10}
MAX_DECISION_CHARACTERS = 100  # with all that may stand round a token
MAX_CHARACTERS = {"critical_components": 1200, "reasoning_trace": 1600}  # bounded: a server may pad for ever


def normalize_action(text: str) -> str | None:
    """Return the token for any spelling (spaces, hyphens, case; quotes, brackets; `Decision:` before it), else None."""
    if BY_LETTERS.get(text.replace("_", "")) == text:
        return text
    if len(text) > MAX_DECISION_CHARACTERS:
        return None
    plain = "".join(char for char in unicodedata.normalize("NFKC", text) if unicodedata.category(char) != "Cf")
    found = _DECISION.fullmatch(plain.lower())
    return BY_LETTERS.get(re.sub(r"[\s_-]", "", found["action"])) if found else None


def answer_schema(
    decision: str | None = None, language: Language = "en", more: Mapping[str, dict] | None = None
) -> dict:
    """Return the JSON schema of an answer; a given decision is the enum's one value.

    Args:
        more: further fields and their schemas; they stand after the texts and before the decision.
    """
    properties: dict[str, dict] = {
        name: {"type": "string", "minLength": characters, "maxLength": MAX_CHARACTERS[name]}
        for name, characters in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items()
    }
    properties |= more or {}
    properties["flight_decision"] = {"type": "string", "enum": [decision] if decision else list(TOKENS)}
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


@dataclass(frozen=True)
class Parsed:
    """A checked answer: `coc` is None when the structure is wrong, for the `reason`. recovered: from which wrappings.

    therefore: the action of that field, where it was asked for. more: the other further fields, as they came.
    """

    coc: Coc | None
    reason: str | None = None
    recovered: tuple[str, ...] = ()
    therefore: str | None = None
    more: Mapping[str, Any] = field(default_factory=dict)


_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_DOTS = ("...", "…", "⋯", "。。。", "···")  # in the place of a text
_LEFT_OUT = re.compile(r"\.{3,}|…+|⋯+|。{3,}|·{3,}")
_SLOT = re.compile(r"\{[^{}]*\}")
_HAN = re.compile(r"[\u4e00-\u9fff]+")
_LATIN = re.compile(r"[A-Za-z]{2,}")
# All of it is Chinese but for numbers, marks, slots and single letters: most texts, and one scan tells.
_ZH = r"[\u4e00-\u9fff\d\s，。、；：（）！？%/.,;:()-]*+"
_PLAIN_ZH = re.compile(_ZH + r"(?:(?:\{[^{}]*\}|[A-Za-z](?![A-Za-z{]))" + _ZH + ")*+")
_OTHER_LETTER = re.compile(r"[^\W\d_a-zA-Z\u00c0-\u024f\u4e00-\u9fff]")


def parse_answer(
    text: str,
    language: Language = "en",
    more: Collection[str] = (),
    finish_reason: str | None = None,
    optional: Collection[str] = (),
) -> Parsed:
    """Check the structure of a raw answer (phase 3 of sec:appendix_e).

    What stands round the answer's object, and what differs from JSON in punctuation alone, is taken off and named in
    `recovered` (cosfly/runtime/model_json.py), as are raw control characters inside strings. Anything else is a failure
    with a reason word.

    Args:
        more: names of the further fields that were asked for.
        finish_reason: why the writer ended, where it is known.
        optional: those of `more` that an answer may leave out.
    """
    names = (*FIELDS, *more)
    found = find_object(text, names, finish_reason)
    recovered = list(found.recovered)
    if found.value is None:
        parsed = Parsed(None, found.reason)
    else:
        names = tuple(name for name in names if name in found.value or name not in optional)
        parsed = _checked(found.value, language, names, recovered)
    return replace(parsed, recovered=tuple(recovered)) if recovered else parsed


def _checked(value: dict[str, Any], language: Language, names: Collection[str], recovered: list[str]) -> Parsed:
    if len(value) != len(names) or not all(map(value.__contains__, names)):
        return Parsed(None, "missing_field" if set(names) - value.keys() else "extra_field")
    cleaned: dict[str, str] = {}
    has_control = False
    for name in FIELDS:
        text = value[name]
        if not isinstance(text, str):
            return Parsed(None, "field_not_text")
        if not text.isprintable() and _CONTROL.search(text):
            text, has_control = _CONTROL.sub("", text), True
        cleaned[name] = text.strip()
    if has_control:
        recovered.append("control_characters")
    for name, characters in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items():
        problem = _problem_of(cleaned[name], language, characters)
        if problem is not None:
            return Parsed(None, f"{name}_{problem}")
    action = normalize_action(cleaned["flight_decision"])
    if action is None:
        return Parsed(None, "decision_not_in_closed_set")
    stated = value.get("therefore")
    therefore = normalize_action(stated) if isinstance(stated, str) else None
    if therefore is None and "therefore" in names:
        return Parsed(None, "therefore_not_in_closed_set")
    others = {name: value[name] for name in names if name not in (*FIELDS, "therefore")}
    cleaned["flight_decision"] = action
    return Parsed(Coc(**cleaned), therefore=therefore, more=others)


def _problem_of(text: str, language: Language, min_characters: int) -> str | None:
    """Return what makes a text none of a caption: it is short, stands for another one, or is in another language."""
    if len(text) < min_characters:
        return "too_short"
    if (text[0], text[-1]) in (("<", ">"), ("[", "]")) or (
        any(map(text.__contains__, _DOTS)) and _is_left_out(text, min_characters)
    ):
        return "placeholder"
    return None if is_in_script(text, language) else "wrong_language"


def _is_left_out(text: str, min_characters: int) -> bool:
    """Return whether dots stand for the text, or for its beginning or end."""
    at_an_end = _LEFT_OUT.match(text) or _LEFT_OUT.search(text, len(text) - 3)
    return at_an_end is not None or len(_LEFT_OUT.sub("", text).strip()) < min_characters


def is_in_script(text: str, language: Language) -> bool:
    """Return whether a text is written in its language: Chinese has no more Latin words than characters.

    Letters of other scripts are of neither. The names in slots are no words.
    """
    if text.isascii() if language == "en" else _PLAIN_ZH.fullmatch(text):
        return True
    text = _SLOT.sub("", text)
    num_han, num_words = sum(map(len, _HAN.findall(text))), len(_LATIN.findall(text))
    num_others = len(_OTHER_LETTER.findall(text))
    return num_words + num_others <= num_han if language == "zh" else num_han + num_others <= num_words


# --- sentences -------------------------------------------------------------------------------------------------------

# A point after these ends no sentence, nor does one inside a number.
_ABBREVIATIONS = ("approx", "ca", "vs", "deg", "i\\.e", "e\\.g", "resp", "max", "min", "avg", "horiz")
_POINT = r"(?<=\.)(?=\s|$)" + "".join(rf"(?<!\b(?i:{word})\.)" for word in _ABBREVIATIONS)
# Begins with one class of characters, for which the engine looks by itself: twice as fast as with alternatives.
_MARKS = ".。！？!?\n"
END = re.compile(rf"[{_MARKS}](?:(?<=[。！？!?])[。！？!?]*|(?<=\n)|{_POINT})\s*")


def sentences_of(coc: Coc) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of the sentences of both texts of an answer, in order."""
    for letter, text in (("C", coc.critical_components), ("R", coc.reasoning_trace)):
        for number, part in enumerate(cut_sentences(text), 1):
            yield f"{letter}{number}", part.strip()


@lru_cache(maxsize=256)  # an English text is cut again when its mirror is held against it
def cut_sentences(text: str) -> tuple[str, ...]:
    """Cut a text at the ends of its sentences; together the pieces are the text."""
    pieces: list[str] = []
    start = 0
    for end in [*[match.end() for match in END.finditer(text)], len(text)]:
        piece = text[start:end]
        if piece and not piece.isspace():
            pieces.append(piece)
        elif pieces:
            pieces[-1] += piece
        start = end
    return tuple(pieces)
