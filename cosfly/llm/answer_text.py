"""The form of an answer of a teacher or student: its JSON schema, and the check of a raw answer (sec:appendix_e)."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

from cosfly.formats.captions import BY_LETTERS, FIELDS, TOKENS, Coc, Language, Place
from cosfly.runtime.model_json import find_object

_DECISION = re.compile(r"""[\s"'`*]*(?P<action>[a-z]+(?:[\s_-]+[a-z]+)*)[\s"'`*.]*""")

MIN_CHARACTERS = {"critical_components": 20, "reasoning_trace": 30}
# A Chinese character carries about as much meaning as three Latin letters.
MIN_CHARACTERS_ZH = {"critical_components": 7, "reasoning_trace": 10}
MAX_DECISION_CHARACTERS = 100  # of an action token with quotes around it
MAX_CHARACTERS = {"critical_components": 1200, "reasoning_trace": 1600}  # a server may pad without end


def normalize_action(text: str) -> str | None:
    """Return the token of an action that is written in any case, with spaces, hyphens or quotes; else None."""
    if len(text) > MAX_DECISION_CHARACTERS:
        return None
    match = _DECISION.fullmatch(text.lower())
    return BY_LETTERS.get(re.sub(r"[\s_-]", "", match["action"])) if match else None


def answer_schema(
    decision: str | None = None, language: Language = "en", more: Mapping[str, dict] = {}, place: Place = "last"
) -> dict:
    """Return the JSON schema of an answer.

    Args:
        decision: The only decision that is allowed; None allows all.
        more: Further fields and their schemas; they follow the texts and precede the decision.
        place: Of the decision. Servers write the fields in the order of the schema.
    """
    properties: dict[str, dict] = {
        name: {"type": "string", "minLength": characters, "maxLength": MAX_CHARACTERS[name]}
        for name, characters in _min_characters(language).items()
    }
    properties |= more
    decision_schema = {"flight_decision": {"type": "string", "enum": [decision] if decision else list(TOKENS)}}
    return object_schema(decision_schema | properties if place == "first" else properties | decision_schema)


def object_schema(properties: Mapping[str, dict]) -> dict:
    """Return the JSON schema of an object with these fields and no other."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


def _min_characters(language: Language) -> dict[str, int]:
    return MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS


@dataclass(frozen=True)
class Parsed:
    """A checked answer."""

    coc: Coc | None  # None if its structure is wrong
    reason: str | None = None  # the problem of the structure
    recovered: tuple[str, ...] = ()  # wrappings that were removed
    therefore: str | None = None  # the action in that field, if the prompt asks for it


_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_DOTS = ("...", "…", "。。。")  # instead of the beginning or the end of a text
_SLOT = re.compile(r"\{[^{}]*\}")
_HAN = re.compile(r"[\u4e00-\u9fff]+")
_LATIN = re.compile(r"[A-Za-z]{2,}")
_OTHER_LETTER = re.compile(r"[^\W\d_a-zA-Z\u00c0-\u024f\u4e00-\u9fff]")


def parse_answer(
    text: str, language: Language = "en", more: Collection[str] = (), finish_reason: str | None = None
) -> Parsed:
    """Check the structure of a raw answer (phase 3 of sec:appendix_e).

    Text around the answer's object is removed and named in `recovered` (cosfly/runtime/model_json.py), as are raw
    control characters inside strings. Anything else is a failure with a reason word.

    Args:
        more: Names of the further fields that the prompt asks for.
        finish_reason: Why the model stopped, if it is known.
    """
    names = (*FIELDS, *more)
    answer = find_object(text, names, finish_reason)
    value = answer.value
    if value is None:
        return Parsed(None, answer.reason, answer.recovered)
    if value.keys() != set(names):
        return Parsed(None, "missing_field" if set(names) - value.keys() else "extra_field", answer.recovered)
    texts = [value[name] for name in FIELDS]
    if not all(isinstance(text, str) for text in texts):
        return Parsed(None, "field_not_text", answer.recovered)
    plain = [_CONTROL.sub("", text) for text in texts]
    recovered = answer.recovered if plain == texts else (*answer.recovered, "control_characters")
    cleaned = {name: text.strip() for name, text in zip(FIELDS, plain, strict=True)}
    reason = _problem_of(cleaned, language)
    if reason is not None:
        return Parsed(None, reason, recovered)
    action = normalize_action(cleaned["flight_decision"])
    if action is None:
        return Parsed(None, "decision_not_in_closed_set", recovered)
    therefore_text = value.get("therefore")
    therefore = normalize_action(therefore_text) if isinstance(therefore_text, str) else None
    if therefore is None and "therefore" in names:
        return Parsed(None, "therefore_not_in_closed_set", recovered)
    return Parsed(Coc(**cleaned | {"flight_decision": action}), None, recovered, therefore)


def _problem_of(texts: Mapping[str, str], language: Language) -> str | None:
    """Return the reason why a text is not a caption: too short, a placeholder, or in another language."""
    for name, min_characters in _min_characters(language).items():
        text = texts[name]
        if len(text) < min_characters:
            return f"{name}_too_short"
        is_bracketed = (text[0], text[-1]) in (("<", ">"), ("[", "]"))
        if is_bracketed or text.startswith(_DOTS) or text.endswith(_DOTS):
            return f"{name}_placeholder"
        if not is_in_script(text, language):
            return f"{name}_wrong_language"
    return None


def is_in_script(text: str, language: Language) -> bool:
    """Return whether a text is in its language: Chinese may hold as many Latin words as characters, English vice versa.

    Each letter of another script counts against the language. Slot names are ignored.
    """
    if language == "en" and text.isascii():
        return True
    text = _SLOT.sub("", text)
    num_han = sum(map(len, _HAN.findall(text)))
    num_words = len(_LATIN.findall(text))
    num_others = len(_OTHER_LETTER.findall(text))
    if language == "zh":
        return num_words + num_others <= num_han
    return num_han + num_others <= num_words


# --- sentences -------------------------------------------------------------------------------------------------------

# A full stop after these abbreviations or inside a number does not end a sentence.
_ABBREVIATIONS = ("approx", "ca", "vs", "deg", "i\\.e", "e\\.g", "resp", "max", "min", "avg", "horiz")
_POINT = r"(?<=\.)(?=\s|$)" + "".join(rf"(?<!\b(?i:{word})\.)" for word in _ABBREVIATIONS)
# The end of a sentence: "right. ", "右转。", "really?!", a line break; not within "2.5 m" or "e.g. a car".
# The pattern begins with one character class, which the regex engine searches twice as fast as alternatives.
_MARKS = ".。！？!?\n"
END = re.compile(rf"[{_MARKS}](?:(?<=[。！？!?])[。！？!?]*|(?<=\n)|{_POINT})\s*")


def sentences_of(coc: Coc) -> list[str]:
    """Return the sentences of both texts of an answer, in order."""
    texts = (coc.critical_components, coc.reasoning_trace)
    return [sentence.strip() for text in texts for sentence in cut_sentences(text)]


@lru_cache(maxsize=256)  # an English text is cut again for the comparison with its mirrored text
def cut_sentences(text: str) -> tuple[str, ...]:
    """Cut a text at the ends of its sentences; the joined pieces are the text from its first sentence on."""
    pieces: list[str] = []
    ends = [0, *(match.end() for match in END.finditer(text)), len(text)]
    for piece in (text[start:end] for start, end in pairwise(ends)):
        if piece and not piece.isspace():
            pieces.append(piece)
        elif pieces:
            pieces[-1] += piece
    return tuple(pieces)
