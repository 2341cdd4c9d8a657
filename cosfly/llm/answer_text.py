"""What the answer of a teacher or a student must look like: its JSON schema, and how it is read (sec:appendix_e)."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
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


def answer_schema(decision: str | None = None, language: Language = "en", more: Mapping[str, dict] = {}) -> dict:
    """Return the JSON schema of an answer; a given decision is the enum's one value.

    Args:
        more: further fields and their schemas; they stand after the texts and before the decision.
    """
    properties: dict[str, dict] = {
        name: {"type": "string", "minLength": characters, "maxLength": MAX_CHARACTERS[name]}
        for name, characters in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items()
    }
    properties |= more
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

    Text around the answer's object is removed and named in `recovered` (cosfly/runtime/model_json.py), as are raw
    control characters inside strings. Anything else is a failure with a reason word.

    Args:
        more: names of the further fields that were asked for.
        finish_reason: why the writer ended, where it is known.
        optional: those of `more` that an answer may leave out.
    """
    names = (*FIELDS, *more)
    found = find_object(text, names, finish_reason)
    if (value := found.value) is None:
        return Parsed(None, found.reason, found.recovered)
    names = tuple(name for name in names if name in value or name not in optional)
    if len(value) != len(names) or not all(map(value.__contains__, names)):
        return Parsed(None, "missing_field" if set(names) - value.keys() else "extra_field", found.recovered)
    texts = [value[name] for name in FIELDS]
    if not all(isinstance(text, str) for text in texts):
        return Parsed(None, "field_not_text", found.recovered)
    plain = [_CONTROL.sub("", text) for text in texts]
    recovered = found.recovered if plain == texts else (*found.recovered, "control_characters")
    cleaned = {name: text.strip() for name, text in zip(FIELDS, plain, strict=True)}
    if (reason := _problem_of(cleaned, language)) is not None:
        return Parsed(None, reason, recovered)
    if (action := normalize_action(cleaned["flight_decision"])) is None:
        return Parsed(None, "decision_not_in_closed_set", recovered)
    stated = value.get("therefore")
    therefore = normalize_action(stated) if isinstance(stated, str) else None
    if therefore is None and "therefore" in names:
        return Parsed(None, "therefore_not_in_closed_set", recovered)
    others = {name: value[name] for name in names if name not in (*FIELDS, "therefore")}
    return Parsed(Coc(**cleaned | {"flight_decision": action}), None, recovered, therefore, others)


def _problem_of(texts: Mapping[str, str], language: Language) -> str | None:
    """Return what makes a text none of a caption: it is short, stands for another one, or is in another language."""
    for name, min_characters in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items():
        text = texts[name]
        if len(text) < min_characters:
            return f"{name}_too_short"
        is_bracketed = (text[0], text[-1]) in (("<", ">"), ("[", "]"))
        if is_bracketed or (any(map(text.__contains__, _DOTS)) and _is_left_out(text, min_characters)):
            return f"{name}_placeholder"
        if not is_in_script(text, language):
            return f"{name}_wrong_language"
    return None


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
    ends = [0, *(match.end() for match in END.finditer(text)), len(text)]
    for piece in (text[start:end] for start, end in pairwise(ends)):
        if piece and not piece.isspace():
            pieces.append(piece)
        elif pieces:
            pieces[-1] += piece
    return tuple(pieces)
