"""Captions of somebody else: a JSON-lines file in a teacher's place (`--teacher file:PATH`), or what a student answered
(`student:PATH`).

One line a window: sample_id, en {three fields}; where its writer has them, zh {three fields}, therefore. Or
`predictions.jsonl`. Nothing can be asked for again. A window without a line is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from caption.answer_formats.contract import Draft
from caption.schema import CaptionConfig
from caption.teachers.prompts import Question
from cosfly.formats.captions import Coc, Language, TeacherRecord, TeacherSettings, Writing
from cosfly.formats.predictions import FAILED, Prediction, read_predictions
from cosfly.llm.contract import NoAnswer, Reply
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import Record, dump_json, model_lines

NOT_IN_FILE = "not_in_file"


class ForeignCaption(Record):
    """One line of the file. The decision may be spelled in any way that an answer's may."""

    sample_id: str
    en: Coc
    zh: Coc | None = None
    therefore: str | None = None


@dataclass(frozen=True)
class Terms:
    """How a window is answered. fields: of the answer beyond the paper's three. is_given: it can be asked for once
    only. is_translated: the Chinese is made from the English, not from the window."""

    writing: Writing
    fields: tuple[str, ...]
    is_given: bool = False
    has_mirror: bool = True
    is_translated: bool = True


def read_foreign(path: Path) -> dict[str, str]:
    """Check the captions of a file; gives sample_id -> its line, which takes a tenth of the memory of what it says."""
    lines: dict[str, str] = {}
    fix = "give --teacher file:PATH with one caption a line"
    for number, (line, caption) in enumerate(model_lines(path, ForeignCaption, what="foreign captions", fix=fix), 1):
        if caption.sample_id in lines:
            raise InputError("a window has two captions", where=f"{path}:{number}: sample_id", got=caption.sample_id)
        lines[caption.sample_id] = line
    if not lines:
        raise InputError("the file holds no caption", where=path, fix=fix)
    return lines


class FileTeacher:
    """Answers from a file."""

    def __init__(self, path: Path, seed: int) -> None:
        self._lines = read_foreign(path)
        self._last: ForeignCaption | None = None  # a window is asked about three times
        self.record = TeacherRecord(kind="file", model=path.name, settings=TeacherSettings(seed=seed))

    def _caption(self, sample_id: str) -> ForeignCaption | None:
        if sample_id not in self._lines:
            return None
        if self._last is None or self._last.sample_id != sample_id:
            self._last = ForeignCaption.model_validate_json(self._lines[sample_id])
        return self._last

    def terms(self, sample_id: str) -> Terms:
        caption = self._caption(sample_id)
        if caption is None:
            return Terms("prose", (), is_given=True, has_mirror=False)
        given = () if caption.therefore is None else ("therefore",)
        return Terms("prose", given, is_given=True, has_mirror=caption.zh is not None)

    async def ask(self, question: Question) -> Reply:
        sample_id = question.window.sample_id
        caption = self._caption(sample_id)
        if caption is None:
            raise NoAnswer(NOT_IN_FILE, sample_id, is_final=True)
        return _given(caption.en.model_dump() | caption.model_dump(include={"therefore"}, exclude_none=True))

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        caption = self._caption(question.window.sample_id)
        assert caption is not None  # terms say so
        assert caption.zh is not None
        return _given(caption.zh.model_dump())


class StudentTeacher:
    """Answers with a student's predictions, as it wrote them: what does not parse is refused as a teacher's answer
    is."""

    def __init__(self, path: Path, run: str | None, seed: int) -> None:
        self._answers = read_student(path, run)
        names = sorted({prediction.model or "a student" for prediction in self._answers.values()})
        settings = TeacherSettings(seed=seed)
        self.record = TeacherRecord(kind="student", model=", ".join(names), settings=settings, run=run)

    def terms(self, sample_id: str) -> Terms:
        return Terms("prose", (), is_given=True, has_mirror=f"{sample_id}/zh" in self._answers)

    async def ask(self, question: Question) -> Reply:
        return self._answer(question, "en")

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        return self._answer(question, "zh")

    def _answer(self, question: Question, language: Language) -> Reply:
        sample_id = question.window.sample_id
        prediction = self._answers.get(f"{sample_id}/{language}")
        if prediction is None:
            raise NoAnswer(NOT_IN_FILE, sample_id, is_final=True)
        if (prediction.reason or "").startswith(FAILED):
            raise NoAnswer(str(prediction.reason), sample_id, is_final=True)
        return Reply(prediction.raw, None, "plain", "stop" if prediction.is_finished else "length")


def read_student(path: Path, run: str | None = None) -> dict[str, Prediction]:
    """Read the predictions of a student for the windows of one tree: window and language -> prediction.

    Args:
        run: the tree, as the training set names it; None where the predictions leave no doubt.
    """
    predictions = read_predictions(path)
    runs = sorted({prediction.run for prediction in predictions})
    found: dict[str, Prediction] = {}
    for prediction in predictions:
        if run in (None, prediction.run):
            key = f"{prediction.window_id or prediction.sample_id}/{prediction.language}"
            if found.setdefault(key, prediction) is not prediction:
                raise InputError(
                    "the predictions are for several trees that share names", where=path, got=", ".join(runs),
                    fix="say which one is given: --set caption.student.run=NAME",
                )  # fmt: skip
    if not found:
        expected = f"one of {', '.join(runs)}" if runs else None
        fix = "give what cosfly distill infer wrote"
        raise InputError("the file holds no prediction", where=path, got=run, expected=expected, fix=fix)
    return found


def given_samples(cfg: CaptionConfig, path: Path) -> set[str]:
    """Return the windows that a file of captions or predictions speaks of; raises as its reader."""
    if cfg.teacher_kind == "student":
        return {key.rpartition("/")[0] for key in read_student(path, cfg.student.run)}
    return set(read_foreign(path))


def _given(answer: dict) -> Reply:
    return Reply(dump_json(answer), None, "native", "stop")
