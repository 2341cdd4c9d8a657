"""Given answers instead of a model: captions written elsewhere (`file:PATH`), or predictions of a student (`student:PATH`).

A file has one line per window: sample_id, en {three fields} and, if the writer has them, zh {three fields}, therefore.
Predictions are `predictions.jsonl`. No answer can be asked for again; a window without one is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

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
    """One line of the file. The decision may be spelled as loosely as a model's."""

    sample_id: str
    en: Coc
    zh: Coc | None = None
    therefore: str | None = None


@dataclass(frozen=True)
class Terms:
    """How a teacher answers for a window.

    Args:
        fields: Fields of the answer beyond the paper's three.
        is_given: It can be asked for once only.
        is_translated: The Chinese is made from the English, not from the window.
    """

    writing: Writing
    fields: tuple[str, ...] = ()
    is_given: bool = False
    has_mirror: bool = True
    is_translated: bool = True


class GivenAnswer(NamedTuple):
    """An answer in one language. fields: Those beyond the paper's three. failure: Why it could not be made."""

    model: str
    reply: Reply
    fields: tuple[str, ...] = ()
    failure: str | None = None


Answers = dict[str, GivenAnswer]  # by sample id and language, with a slash between


def read_given(cfg: CaptionConfig) -> Answers:
    """Read the file of captions or predictions that the settings name; there must be one."""
    assert cfg.caption_file is not None
    if cfg.teacher_kind == "student":
        return read_student(cfg.caption_file, cfg.student.run)
    return read_foreign(cfg.caption_file)


def given_samples(answers: Answers) -> set[str]:
    """Return the ids of the windows that have an answer."""
    return {key.rpartition("/")[0] for key in answers}


def read_foreign(path: Path) -> Answers:
    """Read captions that were written elsewhere."""
    answers: Answers = {}
    fix = "pass --teacher file:PATH, a file with one caption per line"
    for number, (_, caption) in enumerate(model_lines(path, ForeignCaption, what="foreign captions", fix=fix), 1):
        sample_id = caption.sample_id
        if f"{sample_id}/en" in answers:
            raise InputError(
                "the file has two captions for the same window", where=f"{path}:{number}: sample_id", got=sample_id
            )
        more = caption.model_dump(include={"therefore"}, exclude_none=True)
        answers[f"{sample_id}/en"] = GivenAnswer(path.name, _reply(caption.en.model_dump() | more), tuple(more))
        if caption.zh is not None:
            answers[f"{sample_id}/zh"] = GivenAnswer(path.name, _reply(caption.zh.model_dump()))
    if not answers:
        raise InputError("the file contains no caption", where=path, fix=fix)
    return answers


def _reply(answer: dict) -> Reply:
    return Reply(dump_json(answer), None, "native", "stop")


def read_student(path: Path, run: str | None = None) -> Answers:
    """Read the predictions of a student for the windows of one tree.

    Args:
        run: The tree, as the training set names it; None if all predictions are of one tree.
    """
    predictions = read_predictions(path)
    runs = ", ".join(sorted({prediction.run for prediction in predictions}))
    chosen = [prediction for prediction in predictions if run in (None, prediction.run)]
    answers = {f"{one.window_id or one.sample_id}/{one.language}": _given(one) for one in chosen}
    if len(answers) < len(chosen):
        fix = "choose one of these trees with --set caption.student.run=NAME"
        raise InputError(
            "the predictions are for several trees with the same track names", where=path, got=runs, fix=fix
        )
    if not answers:
        expected, fix = f"one of {runs}" if runs else None, "pass the output of cosfly distill infer"
        raise InputError("the file contains no prediction", where=path, got=run, expected=expected, fix=fix)
    return answers


def _given(prediction: Prediction) -> GivenAnswer:
    """Return a prediction as the student wrote it; one that does not parse is refused later, like any answer."""
    reply = Reply(prediction.raw, None, "plain", "stop" if prediction.is_finished else "length")
    reason = prediction.reason or ""
    return GivenAnswer(prediction.model or "a student", reply, failure=reason if reason.startswith(FAILED) else None)


class GivenTeacher:
    """Answers from a file of captions or predictions."""

    def __init__(self, cfg: CaptionConfig, seed: int) -> None:
        self._answers = read_given(cfg)
        models = sorted({answer.model for answer in self._answers.values()})
        self.record = TeacherRecord(
            kind=cfg.teacher_kind,
            model=", ".join(models),
            settings=TeacherSettings(seed=seed),
            run=cfg.student.run if cfg.teacher_kind == "student" else None,
        )

    def terms(self, sample_id: str) -> Terms:
        english = self._answers.get(f"{sample_id}/en")
        has_mirror = f"{sample_id}/zh" in self._answers
        return Terms("prose", english.fields if english else (), is_given=True, has_mirror=has_mirror)

    async def ask(self, question: Question) -> Reply:
        return self._answer(question, "en")

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        return self._answer(question, "zh")

    def _answer(self, question: Question, language: Language) -> Reply:
        sample_id = question.window.sample_id
        answer = self._answers.get(f"{sample_id}/{language}")
        failure = NOT_IN_FILE if answer is None else answer.failure
        if answer is None or failure is not None:
            raise NoAnswer(str(failure), sample_id, is_final=True)
        return answer.reply
