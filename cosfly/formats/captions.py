"""`captions.jsonl`: Chain-of-Cause captions, the three-field answer and its closed set of decisions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from functools import partial
from operator import is_
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import Record, model_lines

FIELDS = ("critical_components", "reasoning_trace", "flight_decision")
Place = Literal["first", "last"]  # of the decision among the fields of an answer


def fields_in_order(decision: Place) -> tuple[str, ...]:
    """Return the fields of an answer, with the decision in its place."""
    return FIELDS if decision == "last" else (FIELDS[-1], *FIELDS[:-1])


Language = Literal["en", "zh"]
TeacherKind = Literal["rules", "endpoint", "vllm", "file", "student"]
Writing = Literal["slots", "prose"]
Verdict = Literal["CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN"]
# The motion from which a label follows: that of a clean track itself (flight), of the clean twin, of a perturbed track
# without the recorded offsets, or of the perturbed track itself if none are recorded; such a label is noisy.
LabelFrom = Literal["flight", "twin", "offsets", "perturbed"]
CAPTION_VERSION: Literal["2.0"] = "2.0"


class Usage(Record):
    """Tokens of one or several answers; 0 if a server does not count them."""

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

    def ordered(self, decision: Place) -> dict[str, str]:
        """Return the fields of an answer, with the decision in its place."""
        return {name: getattr(self, name) for name in fields_in_order(decision)}


def verdict_on(decision: str, label: str | None, contradicted: Collection[str]) -> Verdict:
    """Return the verdict on a decision, given the label and the contradicted decisions of its window."""
    if decision == label:
        return "CONSISTENT"
    if decision in contradicted:
        return "HARD_CONFLICT"
    return "ABSTAIN" if label is None else "SOFT_CONFLICT"


# --- decisions -------------------------------------------------------------------------------------------------------


class Action(NamedTuple):
    group: str  # heading in tables
    en: str  # infinitive phrase
    zh: str


# In the order of prompts, schemas and tables.
ACTIONS = {
    "track_straight": Action("tracking", "keep tracking straight ahead", "保持直线跟踪"),
    "yaw_left_to_follow": Action("heading", "yaw left to follow", "向左偏航跟随"),
    "yaw_right_to_follow": Action("heading", "yaw right to follow", "向右偏航跟随"),
    "circle_left": Action("heading", "circle to the left", "向左环绕"),
    "circle_right": Action("heading", "circle to the right", "向右环绕"),
    "ascend": Action("vertical", "ascend", "上升"),
    "descend": Action("vertical", "descend", "下降"),
    "move_forward": Action("translation", "move forward", "前进"),
    "move_backward": Action("translation", "move backward", "后退"),
    "strafe_left": Action("translation", "strafe left", "向左平移"),
    "strafe_right": Action("translation", "strafe right", "向右平移"),
    "slow_down": Action("speed", "slow down", "减速"),
    "speed_up": Action("speed", "speed up", "加速"),
    "search_to_reacquire_target": Action("recovery", "search to reacquire the target", "搜索以重新捕获目标"),
    "hover": Action("recovery", "hover", "悬停"),
    "break_off": Action("recovery", "break off", "中止跟踪"),
    "return_to_home": Action("recovery", "return to home", "返航"),
}
TOKENS = tuple(ACTIONS)
ORDERS = ("break_off", "return_to_home")  # only a mission orders these; geometry never implies them
BY_LETTERS = {token.replace("_", ""): token for token in TOKENS}  # tokens by their letters


def not_in_set(token: object, where: object) -> InputError:
    """Return the error of a decision that is not in the set."""
    expected = f"one of {', '.join(TOKENS)}"
    return InputError("the decision is unknown", where=str(where), got=str(token), expected=expected)


# --- captions.jsonl ---------------------------------------------------------------------------------------------------


OWN_PROMPTS = "prompts"  # folder next to `captions.jsonl` with prompts that are not part of cosfly
QUESTIONS = ("user_en", "user_zh", "user_paper_en", "user_paper_zh")  # the prompts that ask about a window
GOAL_WORDS: dict[Language, str] = {"en": "Goal: follow %s.", "zh": "任务：跟踪%s。"}  # one line of a prompt
GOAL_BEGINS = tuple(words.partition("%s")[0] for words in GOAL_WORDS.values())
PICTURES_MARK = "<pictures>"  # replaced in a prompt by the sentence about the pictures


class Prompt(Record):
    """A question in one language.

    The question of a caption holds PICTURES_MARK, because teacher and student see different pictures. The lines after
    the mark hold measurements and the mission.
    """

    system: str
    user: str

    def filled(self, sentence: str, *, measured: bool = True) -> Prompt:
        """Return the question with a sentence about the pictures, with or without measurements; the goal is kept."""
        user = self.user
        begin, mark, end = user.partition(PICTURES_MARK)
        if mark and not measured:
            first, *lines = end.split("\n")
            goals = [line for line in lines if line.startswith(GOAL_BEGINS)]
            user = begin + mark + "\n".join([first, *goals])
        return Prompt(system=self.system, user=user.replace(PICTURES_MARK, sentence))


_Value = TypeVar("_Value")
_Omitted = Annotated[_Value | None, Field(exclude_if=partial(is_, None))]  # a key that is omitted without a value


class TeacherSettings(Record):
    """The sampling settings of a teacher; the rule teacher has only a seed."""

    temperature: _Omitted[float] = None
    top_p: _Omitted[float] = None
    max_tokens: _Omitted[int] = None
    seed: int
    extra_body: _Omitted[dict[str, Any]] = None


class TeacherRecord(Record):
    """The author of an answer."""

    kind: TeacherKind
    model: str
    settings: TeacherSettings
    structured: _Omitted[str] = None  # how the form of the answer was enforced (see Reply)
    run: _Omitted[str] = None  # the run of these captions, if a student predicted for several trees


class JudgeRecord(Record, frozen=False):
    """The verdict of a judge on a conflict."""

    verdict: str  # one of Judgement, or `unjudged`
    reason: str
    model: str
    overruled_by: _Omitted[str] = None  # geometry or text


class RepairRecord(Record, frozen=False):
    """The regeneration of a rejected answer."""

    strategy: str
    rung: str | None = None  # the attempt that fixed it: hint, multi_sample, anchored, fix_label
    outcome: str = "no_label"  # repaired, failed, no_label
    asks: int = 0  # number of requests
    first_decision: str  # of the rejected answer
    first_verdict: Verdict | None


Pixels = Annotated[int, Field(ge=1, le=1 << 20)]


class Template(Record):
    """The two texts of an answer with slots in place of facts."""

    critical_components: str
    reasoning_trace: str


class ValueCounts(Record):
    """The values of a caption in one language: numbers with a unit, and relations that fill slots.

    Nothing else of the text is checked.
    """

    values_filled: int = 0  # filled from the facts, and therefore right
    values_matched: int = 0  # written by the teacher and equal to a fact of the same unit, perhaps of another quantity
    values_contradicted: int = 0  # written by the teacher and equal to no fact


class Evidence(Record):
    """The evidence for the checks of a caption: the column `evidence` of a release."""

    slots: _Omitted[dict[Language, Template]] = None  # templates of the texts
    contradictions: list[str] = Field([])  # a message for each contradicted value
    contradicted: list[str] = Field([])  # decisions that the track contradicts


class Checks(Record, frozen=False):
    """Results of the checks of a caption."""

    structure: _Omitted[str] = None  # `ok` or a reason
    refused: _Omitted[list[str]] = None  # why answers of the right structure were refused
    bilingual: _Omitted[str] = None  # `ok` or a reason
    values: _Omitted[dict[Language, ValueCounts]] = None
    contradictions: _Omitted[list[str]] = None  # as in Evidence
    contradicted: _Omitted[list[str]] = None  # as in Evidence
    recovered: _Omitted[list[str]] = None  # fixes of the text of the answers
    frame: _Omitted[str] = None  # the problem of a picture
    refusal: _Omitted[str] = None  # message of a server that refused the window, or the reason why it cut the answer


class Caption(BaseModel):
    """One line of `captions.jsonl`: one window, its answers and their checks."""

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
    prompt_hash: str  # of the question to the teacher
    picture_px: tuple[Pixels, Pixels]  # (width, height) of the sent pictures, to which pixel values refer
    depth_range_m: float | None = None  # largest depth in the depth pictures; None: none was sent
    teacher: TeacherRecord
    usage: Usage  # of all requests to the teacher
    attempts: int
    writing: Writing = "prose"  # how the texts were made: filled slots or prose
    therefore: str | None = None  # the decision at the end of the reasoning, before the final decision
    en: Coc | None = None  # None without an answer of the right structure
    zh: Coc | None = None  # None also in English-only files
    slots: dict[Language, Template] | None = None  # the templates of the texts
    label_from: LabelFrom
    label: str | None  # ground-truth decision from the future geometry; None: undetermined
    verdict: Verdict | None = None
    judge: JudgeRecord | None = None
    repair: RepairRecord | None = None
    checks: Checks = Checks()
    status: Literal["accepted", "dropped"]
    drop_reason: str | None = None

    @property
    def evidence(self) -> Evidence:
        checks = self.checks
        contradictions = checks.contradictions or []
        return Evidence(slots=self.slots, contradictions=contradictions, contradicted=checks.contradicted or [])


def line_of(caption: Caption) -> bytes:
    """Return a caption as its line of `captions.jsonl`, end included."""
    # This takes three quarters of the time of pydantic_core.to_json.
    return Caption.__pydantic_serializer__.to_json(caption) + b"\n"


def write_captions(path: Path, captions: Iterable[Caption]) -> int:
    """Write `captions.jsonl`, streaming, in the given order; return the number of lines."""
    return write_caption_lines(path, map(line_of, captions))


def write_caption_lines(path: Path, lines: Iterable[bytes]) -> int:
    """Write the lines of captions (`line_of`); return their number."""
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
    """Yield each line of `captions.jsonl`, its end included, and its caption."""
    return model_lines(path, Caption, what="captions", fix="run cosfly caption first")


def caption_spans(path: Path) -> Iterator[tuple[tuple[int, int], Caption]]:
    """Yield where each line of `captions.jsonl` is stored, its first byte and its size, and its caption."""
    begin = 0
    for line, caption in caption_lines(path):
        size = len(line.encode())
        yield (begin, size), caption
        begin += size
