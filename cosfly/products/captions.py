"""Chain-of-Cause captions on disk: the three-field answer with its decision of the closed set (actions.py), `captions.jsonl`.

Shared by caption (which writes), distill and release (which read). How a decision is judged against the geometry lives in
caption/truth/actions.py; here is only what an answer must look like.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from operator import is_
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import to_json

from cosfly import in_place
from cosfly.chat.contract import Usage
from cosfly.chat.objects import find_object
from cosfly.products.actions import action_tokens
from cosfly.reading.documents import model_lines
from cosfly.store import atomic_file

_DECISION = re.compile(
    r"""[\s"'`*_<\[({“”‘’「『【《]*(?:[0-9]{1,2}[.)]\s*)?"""
    r"""(?:(?:option|action|decision|answer|(?:flight|final)[\s_-]?(?:decision|action|answer)|动作|决策|飞行决策)["'`*]*\s*[:=]\s*["'`*]*)?"""
    r"""(?P<action>[a-z]+(?:[\s_-]+[a-z]+)*)(?:\(\))?[\s"'`*_>\])}“”‘’」』】》.,;:!。、]*"""
)

FIELDS = ("critical_components", "reasoning_trace", "flight_decision")
MIN_CHARACTERS = {"critical_components": 20, "reasoning_trace": 30}
# A Chinese character carries about as much as three Latin letters, so the same thought is a third as long.
MIN_CHARACTERS_ZH = {"critical_components": 7, "reasoning_trace": 10}
MAX_DECISION_CHARACTERS = 100  # with all that may stand round a token
MAX_CHARACTERS = {"critical_components": 1200, "reasoning_trace": 1600}  # bounded: a server may pad for ever

Language = Literal["en", "zh"]
TeacherKind = Literal["rules", "endpoint", "vllm", "file", "student"]
Writing = Literal["slots", "claims", "prose"]
Modality = Literal["observed", "predicted", "hypothetical"]
SentenceState = Literal["proved", "contradicted", "unread"]
Verdict = Literal["CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN"]
# Whose motion a label was taken from: the flight's own, which nothing perturbed; the clean flight beside it; its own less the
# recorded offsets; or, where nobody recorded them, the perturbed one: then the label holds noise.
LabelFrom = Literal["flight", "twin", "offsets", "perturbed"]
CAPTION_VERSION: Literal["2.0"] = "2.0"


@in_place.kept()
def _tokens_by_letters() -> dict[str, str]:
    return {token.replace("_", ""): token for token in action_tokens()}


def normalize_action(text: str) -> str | None:
    """Give the token for any spelling (spaces, hyphens, case; quotes, marks and brackets round it; `Decision:` before it), else None."""
    by_letters = _tokens_by_letters()
    if by_letters.get(text.replace("_", "")) == text:
        return text
    if len(text) > MAX_DECISION_CHARACTERS:
        return None
    plain = "".join(char for char in unicodedata.normalize("NFKC", text) if unicodedata.category(char) != "Cf")
    found = _DECISION.fullmatch(plain.lower())
    return by_letters.get(re.sub(r"[\s_-]", "", found["action"])) if found else None


def answer_schema(
    decision: str | None = None, language: Language = "en", more: Mapping[str, dict] | None = None
) -> dict:
    """Give the JSON schema of an answer; a given decision is the enum's one value.

    Args:
        more: further fields and their schemas; they stand after the texts and before the decision, which decoders keep to.
    """
    properties: dict[str, dict] = {
        name: {"type": "string", "minLength": characters, "maxLength": MAX_CHARACTERS[name]}
        for name, characters in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items()
    }
    properties |= more or {}
    properties["flight_decision"] = {"type": "string", "enum": [decision] if decision else list(action_tokens())}
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


class Coc(BaseModel):
    """One Chain-of-Cause answer in one language."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    critical_components: str
    reasoning_trace: str
    flight_decision: str


@dataclass(frozen=True)
class Parsed:
    """A checked answer: `coc` is None when the structure is wrong, for the `reason`; `recovered` names what was mended.

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
_PLAIN_ZH = re.compile(
    r"[\u4e00-\u9fff\d\s，。、；：（）！？%/.,;:()-]*+(?:(?:\{[^{}]*\}|[A-Za-z](?![A-Za-z{]))[\u4e00-\u9fff\d\s，。、；：（）！？%/.,;:()-]*+)*+"
)
_OTHER_LETTER = re.compile(r"[^\W\d_a-zA-Z\u00c0-\u024f\u4e00-\u9fff]")


def parse_answer(
    text: str, language: Language = "en", more: Collection[str] = (), finish_reason: str | None = None
) -> Parsed:
    """Check the structure of a raw answer (phase 3 of sec:appendix_e).

    What stands round the answer's object, and what differs from JSON in punctuation alone, is taken off and named in `recovered`
    (cosfly/chat/objects.py), as are raw control characters inside strings. Anything else is a failure with a reason word.

    Args:
        more: names of the further fields that were asked for.
        finish_reason: why the writer ended, where it is known.
    """
    names = (*FIELDS, *more)
    found = find_object(text, names, finish_reason)
    recovered = list(found.mended)
    parsed = Parsed(None, found.reason) if found.value is None else _checked(found.value, language, names, recovered)
    return replace(parsed, recovered=tuple(recovered)) if recovered else parsed


def _checked(value: dict[str, Any], language: Language, names: Collection[str], recovered: list[str]) -> Parsed:
    if len(value) != len(names) or not all(map(value.__contains__, names)):
        return Parsed(None, "missing_field" if set(names) - value.keys() else "extra_field")
    if not all(isinstance(value[name], str) for name in FIELDS):
        return Parsed(None, "field_not_text")
    if not all(value[name].isprintable() or not _CONTROL.search(value[name]) for name in FIELDS):
        value = {name: _CONTROL.sub("", text) if name in FIELDS else text for name, text in value.items()}
        recovered.append("control_characters")
    cleaned = {name: value[name].strip() for name in FIELDS}
    for name, characters in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items():
        problem = _problem_of(cleaned[name], language, characters)
        if problem is not None:
            return Parsed(None, f"{name}_{problem}")
    action = normalize_action(cleaned["flight_decision"])
    if action is None:
        return Parsed(None, "decision_not_in_closed_set")
    therefore = normalize_action(value["therefore"]) if isinstance(value.get("therefore"), str) else None
    if therefore is None and "therefore" in names:
        return Parsed(None, "therefore_not_in_closed_set")
    others = {name: value[name] for name in names if name not in (*FIELDS, "therefore")}
    return Parsed(Coc(**{**cleaned, "flight_decision": action}), therefore=therefore, more=others)


def _problem_of(text: str, language: Language, min_characters: int) -> str | None:
    """Say what makes a text none of a caption: it is short, stands for another one, or is in another language."""
    if len(text) < min_characters:
        return "too_short"
    if (text[0], text[-1]) in (("<", ">"), ("[", "]")) or (
        any(map(text.__contains__, _DOTS)) and _is_left_out(text, min_characters)
    ):
        return "placeholder"
    return None if is_in_script(text, language) else "wrong_language"


def _is_left_out(text: str, min_characters: int) -> bool:
    """Tell whether dots stand for the text, or for its beginning or end."""
    at_an_end = _LEFT_OUT.match(text) or _LEFT_OUT.search(text, len(text) - 3)
    return at_an_end is not None or len(_LEFT_OUT.sub("", text).strip()) < min_characters


def is_in_script(text: str, language: Language) -> bool:
    """Tell whether a text is written in its language: Chinese has no more Latin words than characters, English the reverse.

    Letters of other scripts are of neither. The names in slots are no words.
    """
    if text.isascii() if language == "en" else _PLAIN_ZH.fullmatch(text):
        return True
    text = _SLOT.sub("", text)
    num_han, num_words = sum(map(len, _HAN.findall(text))), len(_LATIN.findall(text))
    num_others = len(_OTHER_LETTER.findall(text))
    return num_words + num_others <= num_han if language == "zh" else num_han + num_others <= num_words


def verdict_on(decision: str, label: str | None, contradicted: Collection[str]) -> Verdict:
    """Give the verdict on a decision from what a caption's record says of its window's future, whoever decided."""
    if decision == label:
        return "CONSISTENT"
    if decision in contradicted:
        return "HARD_CONFLICT"
    return "ABSTAIN" if label is None else "SOFT_CONFLICT"


# --- captions.jsonl ---------------------------------------------------------------------------------------------------


OWN_PROMPTS = "prompts"  # beside `captions.jsonl`: the prompts of whoever made them, where these do not ship
QUESTIONS = ("user_en", "user_zh")  # of them, what is asked of a window
PICTURES_MARK = "<pictures>"  # in a prompt: the place of the sentence that says what pictures are given


class Prompt(BaseModel):
    """A question in one language. That of a caption holds PICTURES_MARK: a teacher and a student see different pictures.

    The line with the mark says what frames there are; the lines after it hold what was measured on them, and the mission.
    """

    model_config = ConfigDict(extra="forbid")
    system: str
    user: str

    def told(self, pictures: str, *, measured: bool = True) -> Prompt:
        """Give the question with the sentence about the pictures at its mark, and if asked without what was measured."""
        begin, mark, end = self.user.partition(PICTURES_MARK)
        user = self.user if measured or not mark else begin + mark + end.partition("\n")[0]
        return Prompt(system=self.system, user=user.replace(PICTURES_MARK, pictures))


_Value = TypeVar("_Value")
_Given = Annotated[_Value | None, Field(exclude_if=partial(is_, None))]  # a key that is left out where it has no value


class TeacherSettings(BaseModel):
    """How a teacher was asked; the rule teacher has a seed only."""

    model_config = ConfigDict(extra="forbid")

    temperature: _Given[float] = None
    top_p: _Given[float] = None
    max_tokens: _Given[int] = None
    seed: int
    extra_body: _Given[dict[str, Any]] = None


class TeacherRecord(BaseModel):
    """Who answered. structured: how the answer's shape was enforced (see Reply); left out where nothing was asked. run: of a student's
    predictions for several trees, the one that these captions are of."""

    model_config = ConfigDict(extra="forbid")

    kind: TeacherKind
    model: str
    settings: TeacherSettings
    structured: _Given[str] = None
    run: _Given[str] = None


class JudgeRecord(BaseModel):
    """What a judge said of a conflict: one of Judgement, or `unjudged`; overruled_by: geometry or text, where it was."""

    model_config = ConfigDict(extra="forbid")

    verdict: str
    reason: str
    model: str
    overruled_by: _Given[str] = None


class RepairRecord(BaseModel):
    """What became of a rejected answer.

    rung: the ask that mended it (hint, multi_sample, anchored, fix_label). outcome: repaired, failed, no_label.
    """

    model_config = ConfigDict(extra="forbid")

    strategy: str
    rung: str | None = None
    outcome: str = "no_label"
    asks: int = 0
    first_decision: str
    first_verdict: Verdict | None


class KeyframeRecord(BaseModel):
    """Why a window was taken (start, change, stride); windows left out up to the next; changes of the label among them."""

    model_config = ConfigDict(extra="forbid")

    reason: str
    skipped: int
    missed: int


class Claim(BaseModel):
    """One thing that a sentence states.

    sentence: `C1` is the first of critical_components, `R1` of reasoning_trace. quantity: what is claimed, with its aspect
    (`distance`, `trend:speed`), or `decision`. at: `t4`, `t0-t4`; empty: the current frame, the whole window. unit: m, mps, deg ...
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sentence: str
    quantity: str
    at: str | None = None
    value: Annotated[float, Field(strict=True)] | str  # true is no 1.0
    unit: str | None = None
    modality: Modality = "observed"


class Template(BaseModel):
    """The two texts of an answer with slots in place of facts."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    critical_components: str
    reasoning_trace: str


class Checks(BaseModel):
    """What was checked. structure, bilingual: `ok` or a reason. refused: why answers of the right structure were
    not taken, one reason each. evidence: `ok` or the contradictions. sentences: language -> state of
    each sentence of both texts, in order. contradicted: decisions that the flight contradicts, whatever was decided. recovered: what
    was mended in the answers' text. frame: what is wrong with a picture. refusal: the server's words where it refused the window, or
    how it cut the answer short of `max_tokens`."""

    model_config = ConfigDict(extra="forbid")

    keyframe: _Given[KeyframeRecord] = None
    structure: _Given[str] = None
    refused: _Given[list[str]] = None
    bilingual: _Given[str] = None
    evidence: _Given[Literal["ok"] | list[str]] = None
    sentences: _Given[dict[Language, list[SentenceState]]] = None
    contradicted: _Given[list[str]] = None
    recovered: _Given[list[str]] = None
    frame: _Given[str] = None
    refusal: _Given[str] = None


class Caption(BaseModel):
    """One line of `captions.jsonl`: one window, its answers, and everything that was found out about them.

    `en` and `zh` are None when the window was dropped before an answer of the right structure existed; `zh` also where a file of captions
    has English alone.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    schema_version: Literal["2.0"] = CAPTION_VERSION
    sample_id: str
    town: str
    trajectory: str
    variant: str
    frame_index: int
    window: list[int]
    future: list[int]
    prompt: dict[str, Prompt]  # language -> prompt, with PICTURES_MARK
    prompt_hash: str  # of what the teacher was asked
    picture_px: tuple[int, int]  # (width, height) of a picture that was sent, which pixel values refer to
    depth_range_m: float | None = None  # dark end of the depth pictures; None: none was sent
    teacher: TeacherRecord
    usage: Usage  # of the teacher, all asks
    attempts: int
    writing: Writing = "prose"  # how the texts were made: filled slots, prose beside claims, prose
    therefore: str | None = None  # the decision that the reasoning came to, before the decision itself
    en: Coc | None = None
    zh: Coc | None = None
    slots: dict[Language, Template] | None = None  # what the texts were filled from
    claims: list[Claim] | None = None  # what the English text states, by its writer
    label_from: LabelFrom
    label: str | None  # ground-truth decision from the future geometry; None: geometry cannot tell
    verdict: Verdict | None = None
    judge: JudgeRecord | None = None
    repair: RepairRecord | None = None
    checks: Checks = Checks()
    status: Literal["accepted", "dropped"]
    drop_reason: str | None = None

    def coverage(self, language: Language) -> float | None:
        """Share of a language's sentences that are proved; None where none was judged."""
        states = (self.checks.sentences or {}).get(language)
        return states.count("proved") / len(states) if states else None


def write_captions(path: Path, captions: Iterable[Caption]) -> int:
    """Write `captions.jsonl` (one line per caption, in the order given) under a temporary name, then rename.

    Streams, so memory stays flat. Returns the number of lines.
    """
    return write_caption_lines(path, (to_json(caption) + b"\n" for caption in captions))


def write_caption_lines(path: Path, lines: Iterable[bytes]) -> int:
    """The same for captions that are UTF-8 text already, ends of lines included."""
    count = 0
    with atomic_file(path) as file:
        for line in lines:
            file.write(line)
            count += 1
    return count


def read_captions(path: Path) -> Iterator[Caption]:
    """Yield the captions of `captions.jsonl`.

    Raises:
        InputError: names the file, the line and the field.
    """
    return (caption for _, caption in caption_lines(path))


def caption_lines(path: Path) -> Iterator[tuple[str, Caption]]:
    """Yield each line of `captions.jsonl` as it stands there, its end included, and what it says; raises as `read_captions`."""
    return model_lines(path, Caption, what="captions", fix="run cosfly caption first")
