"""Given answers instead of a model: captions written elsewhere (`file:PATH`), or predictions of a student (`student:PATH`).

A file has one line per window: sample_id, en {three fields} and, if the writer has it, zh {three fields}. Predictions
are `predictions.jsonl`. No answer can be asked for again; a window without one is dropped.
"""

from dataclasses import dataclass
from pathlib import Path

from caption.answer_formats.formats import Draft
from caption.schema import CaptionConfig
from caption.teachers.prompts import Question
from cosfly.formats.captions import Coc, Language, TeacherRecord, TeacherSettings, Writing
from cosfly.formats.predictions import FAILED, read_predictions
from cosfly.llm.contract import NoAnswer, Reply
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import Record, dump_json, model_lines

NOT_IN_FILE = "not_in_file"


class ForeignCaption(Record):
    """One line of the file. The decision may be spelled as loosely as a model's."""

    sample_id: str
    en: Coc
    zh: Coc | None = None


@dataclass(frozen=True)
class Terms:
    """How a teacher answers for a window."""

    writing: Writing
    is_given: bool = False  # the answer is in a file: no other one can be asked for
    # Asked again, the teacher gives the same answer; it has the paper's three fields only, and its Chinese is no
    # translation.
    is_fixed: bool = False
    has_mirror: bool = True


Answers = dict[tuple[str, Language], Reply | str]  # by sample id and language; a text says why an answer failed


def read_given(cfg: CaptionConfig) -> tuple[Answers, str]:
    """Read the file of captions or predictions that the settings name; return also the names of their writers."""
    assert cfg.caption_file is not None
    if cfg.teacher_kind == "student":
        return read_student(cfg.caption_file, cfg.student.run)
    return read_foreign(cfg.caption_file), cfg.caption_file.name


def read_foreign(path: Path) -> Answers:
    """Read captions that were written elsewhere."""
    answers: Answers = {}
    fix = "pass --teacher file:PATH with a file of one caption per line"
    for number, (_, caption) in enumerate(model_lines(path, ForeignCaption, what="foreign captions", fix=fix), 1):
        sample_id = caption.sample_id
        if (sample_id, "en") in answers:
            what = "the file has two captions for the same window"
            raise InputError(what, where=f"{path}:{number}: sample_id", got=sample_id, fix="remove one of them")
        texts: dict[Language, Coc | None] = {"en": caption.en, "zh": caption.zh}
        for language, coc in texts.items():
            if coc is not None:
                answers[sample_id, language] = Reply(dump_json(coc.model_dump()), None, "native", "stop")
    if not answers:
        raise InputError("the file contains no captions", where=path, fix=fix)
    return answers


def read_student(path: Path, run: str | None = None) -> tuple[Answers, str]:
    """Read the predictions of a student for the windows of one tree, `run` in the training set, None if all are of one
    tree; a prediction that does not parse is refused later."""
    predictions = read_predictions(path)
    runs = ", ".join(sorted({prediction.run for prediction in predictions}))
    chosen = [prediction for prediction in predictions if run in (None, prediction.run)]
    answers: Answers = {}
    for prediction in chosen:
        answer: Reply | str = Reply(prediction.raw, None, "plain", "stop" if prediction.is_finished else "length")
        if prediction.reason and prediction.reason.startswith(FAILED):
            answer = prediction.reason
        answers[prediction.window_id or prediction.sample_id, prediction.language] = answer
    if len(answers) < len(chosen):
        fix = "choose one of these runs with --set caption.student.run=NAME"
        what = "the predictions are for several runs with the same track names"
        raise InputError(what, where=path, got=runs, fix=fix)
    if not answers:
        what, got = f"the file contains no predictions for {run or 'any run'}", f"predictions for {runs or 'no run'}"
        raise InputError(what, where=path, got=got, fix="pass the output of cosfly distill infer for this run")
    return answers, ", ".join(sorted({prediction.model or "a student" for prediction in chosen}))


class GivenTeacher:
    """Answers from a file of captions or predictions."""

    def __init__(self, cfg: CaptionConfig, seed: int) -> None:
        self._answers, model = read_given(cfg)
        run = cfg.student.run if cfg.teacher_kind == "student" else None
        self.record = TeacherRecord(kind=cfg.teacher_kind, model=model, settings=TeacherSettings(seed=seed), run=run)

    def terms(self, sample_id: str) -> Terms:
        return Terms("prose", is_given=True, is_fixed=True, has_mirror=(sample_id, "zh") in self._answers)

    async def ask(self, question: Question) -> Reply:
        return self._answer(question, "en")

    async def mirror(self, question: Question, english: Draft, ask: int, complaint: str | None = None) -> Reply:
        return self._answer(question, "zh")

    def _answer(self, question: Question, language: Language) -> Reply:
        sample_id = question.window.sample_id
        answer = self._answers.get((sample_id, language), NOT_IN_FILE)
        if isinstance(answer, str):
            raise NoAnswer(answer, sample_id, is_final=True)
        return answer
