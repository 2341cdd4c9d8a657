"""Chain-of-Cause captions on disk: the three-field answer with its decision (actions.py), `captions.jsonl`.

Shared by caption (which writes), distill and release (which read). What an answer must look like stands in
answer_text.py; how a decision is judged against the geometry in caption/truth/actions.py.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from functools import partial
from operator import is_
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import Record, model_lines

FIELDS = ("critical_components", "reasoning_trace", "flight_decision")
Language = Literal["en", "zh"]
TeacherKind = Literal["rules", "endpoint", "vllm", "file", "student"]
Writing = Literal["slots", "prose"]
Modality = Literal["observed", "predicted", "hypothetical"]
SentenceState = Literal["proved", "contradicted", "unread"]
Verdict = Literal["CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN"]
# Whose motion a label was taken from: the flight's own, which nothing perturbed; the clean flight beside it; its own
# less the recorded offsets; or, where nobody recorded them, the perturbed one: then the label holds noise.
LabelFrom = Literal["flight", "twin", "offsets", "perturbed"]
CAPTION_VERSION: Literal["2.0"] = "2.0"


class Usage(Record):
    """Tokens of one answer or of several; 0 where a server does not count them."""

    prompt_tokens: int = 0
    completion_tokens: int = 0

    def __add__(self, other: Usage) -> Usage:
        return Usage(
            prompt_tokens=self.prompt_tokens + other.prompt_tokens,
            completion_tokens=self.completion_tokens + other.completion_tokens,
        )

    @property
    def total(self) -> int:
        return self.prompt_tokens + self.completion_tokens


class Coc(Record):
    """One Chain-of-Cause answer in one language."""

    critical_components: str
    reasoning_trace: str
    flight_decision: str


def verdict_on(decision: str, label: str | None, contradicted: Collection[str]) -> Verdict:
    """Return the verdict on a decision from what a caption's record says of its window's future, whoever decided."""
    if decision == label:
        return "CONSISTENT"
    if decision in contradicted:
        return "HARD_CONFLICT"
    return "ABSTAIN" if label is None else "SOFT_CONFLICT"


# --- captions.jsonl ---------------------------------------------------------------------------------------------------


OWN_PROMPTS = "prompts"  # beside `captions.jsonl`: the prompts of whoever made them, where these do not ship
QUESTIONS = ("user_en", "user_zh")  # of them, what is asked of a window
GOAL_WORDS: dict[Language, str] = {"en": "Goal: follow %s.", "zh": "任务：跟踪%s。"}  # in a prompt, a line of its own
GOAL_BEGINS = tuple(words.partition("%s")[0] for words in GOAL_WORDS.values())
PICTURES_MARK = "<pictures>"  # in a prompt: the place of the sentence that says what pictures are given


class Prompt(Record):
    """A question in one language. That of a caption holds PICTURES_MARK: teacher and student see other pictures.

    The line with the mark says what frames there are; those after it, what was measured, and the mission.
    """

    system: str
    user: str

    def told(self, pictures: str, *, measured: bool = True) -> Prompt:
        """Return the question with the sentence about the pictures at its mark, with or without what was measured; the
        goal stays."""
        begin, mark, end = self.user.partition(PICTURES_MARK)
        first, *lines = end.split("\n")
        kept = [first, *(line for line in lines if line.startswith(GOAL_BEGINS))]
        user = self.user if measured or not mark else begin + mark + "\n".join(kept)
        return Prompt(system=self.system, user=user.replace(PICTURES_MARK, pictures))


_Value = TypeVar("_Value")
_Given = Annotated[_Value | None, Field(exclude_if=partial(is_, None))]  # a key that is left out where it has no value


class TeacherSettings(Record):
    """How a teacher was asked; the rule teacher has a seed only."""

    temperature: _Given[float] = None
    top_p: _Given[float] = None
    max_tokens: _Given[int] = None
    seed: int
    extra_body: _Given[dict[str, Any]] = None


class TeacherRecord(Record):
    """Who answered. structured: how the answer's shape was enforced (see Reply); left out where nothing was asked. run:
    of a student's predictions for several trees, the one that these captions are of."""

    kind: TeacherKind
    model: str
    settings: TeacherSettings
    structured: _Given[str] = None
    run: _Given[str] = None


class JudgeRecord(Record, frozen=False):
    """What a judge said of a conflict: one of Judgement, or `unjudged`; overruled_by: geometry or text."""

    verdict: str
    reason: str
    model: str
    overruled_by: _Given[str] = None


class RepairRecord(Record, frozen=False):
    """What became of a rejected answer.

    rung: the ask that mended it (hint, multi_sample, anchored, fix_label). outcome: repaired, failed, no_label.
    """

    strategy: str
    rung: str | None = None
    outcome: str = "no_label"
    asks: int = 0
    first_decision: str
    first_verdict: Verdict | None


class KeyframeRecord(Record, frozen=False):
    """Why a window was taken (start, change, stride); windows left out up to the next; label changes among them."""

    reason: str
    skipped: int
    missed: int


Pixels = Annotated[int, Field(ge=1, le=1 << 20)]


class Claim(BaseModel):
    """One thing that a sentence states.

    sentence: `C1` is the first of critical_components, `R1` of reasoning_trace. quantity: what is claimed, with its
    aspect (`distance`, `trend:speed`), or `decision`. at: `t4`, `t0-t4`; empty: the current frame, the whole window.
    unit: m, mps, deg ... quote: the words of the sentence that it stands for.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sentence: str
    quantity: str
    at: str | None = None
    value: Annotated[float, Field(strict=True)] | str  # true is no 1.0
    unit: str | None = None
    modality: Modality = "observed"
    quote: _Given[str] = None


class Template(Record):
    """The two texts of an answer with slots in place of facts. claims: of words beside slots, which they quote."""

    critical_components: str
    reasoning_trace: str
    claims: _Given[list[Claim]] = None


class Evidence(Record):
    """What the states of a caption's sentences follow from, so that an outsider can judge them again: the column
    `evidence` of a release.

    slots: the templates that the texts were filled from. problems: what is contradicted. contradicted: decisions that
    the flight contradicts.
    """

    slots: _Given[dict[Language, Template]] = None
    problems: list[str] = Field([])
    contradicted: list[str] = Field([])


class Checks(Record, frozen=False):
    """What was checked. structure, bilingual: `ok` or a reason. refused: why answers of the right structure were
    not taken, one reason each. evidence: `ok` or the contradictions. sentences: language -> state of
    each sentence of both texts, in order. contradicted: decisions that the flight contradicts, whatever was decided.
    recovered: what was mended in the answers' text. frame: what is wrong with a picture. refusal: the server's words
    where it refused the window, or how it cut the answer short of `max_tokens`."""

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

    `en` and `zh` are None when the window was dropped before an answer of the right structure existed; `zh` also where
    a file of captions has English alone.
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
    picture_px: tuple[Pixels, Pixels]  # (width, height) of a picture that was sent, which pixel values refer to
    depth_range_m: float | None = None  # dark end of the depth pictures; None: none was sent
    teacher: TeacherRecord
    usage: Usage  # of the teacher, all asks
    attempts: int
    writing: Writing = "prose"  # how the texts were made: filled slots or prose
    therefore: str | None = None  # the decision that the reasoning came to, before the decision itself
    en: Coc | None = None
    zh: Coc | None = None
    slots: dict[Language, Template] | None = None  # what the texts were filled from
    label_from: LabelFrom
    label: str | None  # ground-truth decision from the future geometry; None: geometry cannot tell
    verdict: Verdict | None = None
    judge: JudgeRecord | None = None
    repair: RepairRecord | None = None
    checks: Checks = Checks()
    status: Literal["accepted", "dropped"]
    drop_reason: str | None = None

    @property
    def evidence(self) -> Evidence:
        problems = self.checks.evidence if isinstance(self.checks.evidence, list) else []
        return Evidence(slots=self.slots, problems=problems, contradicted=self.checks.contradicted or [])

    def coverage(self, language: Language) -> float | None:
        """Share of a language's sentences that are proved; None where none was judged."""
        states = (self.checks.sentences or {}).get(language)
        return states.count("proved") / len(states) if states else None


def line_of(caption: Caption) -> bytes:
    """Return a caption as its line of `captions.jsonl`, end included."""
    # Three quarters of the time of pydantic_core.to_json.
    return Caption.__pydantic_serializer__.to_json(caption) + b"\n"


def write_captions(path: Path, captions: Iterable[Caption]) -> int:
    """Write `captions.jsonl` (one line per caption, in the order given) under a temporary name, then rename.

    Streams, so memory stays flat. Returns the number of lines.
    """
    return write_caption_lines(path, map(line_of, captions))


def write_caption_lines(path: Path, lines: Iterable[bytes]) -> int:
    """Return the same for captions that are lines already (`line_of`)."""
    count = 0
    with atomic_file(path) as file:
        for line in lines:
            file.write(line)
            count += 1
    return count


def read_captions(path: Path) -> Iterator[Caption]:
    """Yield the captions of `captions.jsonl`."""
    return (caption for _, caption in caption_lines(path))


def caption_lines(path: Path) -> Iterator[tuple[str, Caption]]:
    """Yield each line of `captions.jsonl`, its end included, and what it says; raises as `read_captions`."""
    return model_lines(path, Caption, what="captions", fix="run cosfly caption first")
