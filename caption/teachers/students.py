"""A student behind a server as a teacher (`--as-student FOLDER`), with the prompts, pictures and sampling of its training.

That is the paper's stage 3: tracks without labels get their captions from a student, which are checked and recorded
like those of any other teacher.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from caption.answer_formats.contract import Draft
from caption.schema import CaptionConfig
from caption.teachers.foreign import Terms
from caption.teachers.prompts import Question, decision_words, student_prompt
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import Language
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.contract import Request
from cosfly.llm.student_chat import (
    IMAGE_ENCODING,
    ChatFormat,
    EncodedImage,
    StudentEndpointConfig,
    picture_to_send,
    read_chat_format,
    student_request,
)
from cosfly.runtime.errors import ConfigError, TeacherError
from cosfly.viz.frame_views import Pictures

Frames = Sequence[Sequence[EncodedImage]]  # pictures of each frame, oldest first


def student_settings(cfg: CaptionConfig, vocabulary: Vocabulary) -> CaptionConfig:
    """Return settings whose windows, pictures, answer format and sampling are those of the student's training.

    Without a student the settings do not change.
    """
    folder = cfg.student.folder
    if folder is None:
        return cfg
    chat_format = read_chat_format(folder)
    check_prompts(chat_format, folder, vocabulary)
    first = chat_format.looks[0]
    kinds = {(look.views, look.depth_range_m, max(look.size_px)) for look in chat_format.looks}
    if len(kinds) > 1:
        what = "the student was trained with pictures of several kinds"
        raise ConfigError(
            what, where=folder, got="; ".join(_described(look.views, look.size_px) for look in chat_format.looks)
        )
    sampling = {name: getattr(StudentEndpointConfig(), name) for name in ("temperature", "top_p", "extra_body")}
    return cfg.model_copy(update={
        "writing": "prose",
        "window": cfg.window.model_copy(update={"num_frames": chat_format.num_frames}),
        "image": cfg.image.model_copy(update={
            "modalities": first.views, "layout": "separate", "max_side_px": max(first.size_px),
            "depth_range_m": first.depth_range_m, "encoding": IMAGE_ENCODING,
        }),
        "endpoint": cfg.endpoint.model_copy(update={
            **sampling, "max_tokens": cfg.student.max_new_tokens, "json_schema": cfg.student.constrained,
        }),
        # A student gives the same answer again, and its training has no corrections.
        "structure_asks": 1, "correction_asks": 0, "mirror_asks": 1,
    })  # fmt: skip


def check_prompts(chat_format: ChatFormat, folder: Path, vocabulary: Vocabulary) -> None:
    """Check that prompts are written today as they were in the student's training."""
    if "en" not in chat_format.prompts:
        raise ConfigError(
            "the student was not trained with English answers", where=folder, got=", ".join(chat_format.prompts)
        )
    for language, prompt in chat_format.prompts.items():
        is_same = prompt.system == student_prompt(language, vocabulary)
        if not (is_same and _is_of_template(prompt.user, language, chat_format, vocabulary)):
            raise ConfigError(
                "the student was trained with another version of the prompt", where=f"{folder}: {language}",
                got=prompt.user[:80],
                fix="use the prompts (caption.prompts, caption.text_state) and the version of cosfly that captioned "
                "its training set, or train the student again",
            )  # fmt: skip


def _is_of_template(user: str, language: Language, chat_format: ChatFormat, vocabulary: Vocabulary) -> bool:
    """Return whether a question is the template of its language, filled with the student's pictures."""
    template = vocabulary.templates[f"user_{language}"]
    pictures = [Pictures(look.views, look.size_px, "separate", look.depth_range_m) for look in chat_format.looks]
    known = {
        "num_frames": str(chat_format.num_frames),
        "pictures": "|".join(re.escape(one.sentence(language)) for one in pictures),
    }
    slots = template.get_identifiers()
    pattern = re.escape(template.substitute({slot: f"\0{slot}\0" for slot in slots}))
    for slot in slots:
        pattern = pattern.replace(f"\0{slot}\0", f"(?:{known.get(slot, '.+?')})")
    return re.fullmatch(pattern + r"(\n.+)?", user) is not None  # the line of a mission may follow


class TrainedStudent:
    """Makes the requests to a student, in the form of its training."""

    def __init__(self, cfg: CaptionConfig) -> None:
        """
        Args:
            cfg: Settings as returned by `student_settings`.
        """
        assert cfg.student.folder is not None
        self.chat_format = read_chat_format(cfg.student.folder)
        self._sampling = cfg.endpoint
        self.terms = Terms("prose", has_mirror="zh" in self.chat_format.prompts, is_translated=False)

    def encode(self, rgb: np.ndarray) -> EncodedImage:
        """Encode a picture as in the student's training."""
        return picture_to_send(rgb, self.chat_format.max_pixels)

    def check(self, question: Question) -> None:
        """Check that a window has pictures like those of the training: its views, and the size of its camera."""
        pictures = question.pictures
        wanted = {(look.views, look.size_px) for look in self.chat_format.looks}
        if (pictures.views, pictures.size_px) not in wanted:
            raise TeacherError(
                "the pictures of this playback tree differ from those that the student was trained with",
                where=question.window.sample_id,
                got=_described(pictures.views, pictures.size_px),
                expected=" or ".join(_described(*one) for one in sorted(wanted)),
                fix="pass tracks with such pictures, or train a student on pictures like these",
            )

    def request(self, question: Question, frames: Frames, seed: int) -> Request:
        """Return the English request. A regeneration adds its sentences, which the training did not have."""
        vocabulary, prompt = question.way.vocabulary, question.asked["en"]
        system = prompt.system
        if question.decision is not None:
            system += "\n" + decision_words(question.decision, vocabulary)
        if question.rejected is not None:
            system += "\n" + vocabulary.templates["hint_en"].substitute(rejected=question.rejected)
        prompt = prompt.model_copy(update={"system": system})
        return student_request(prompt, frames, answer_schema(question.decision), self._sampling, seed)

    def mirror_request(self, question: Question, english: Draft, frames: Frames, seed: int) -> Request:
        """Return the Chinese request, about the same window: a student translates nothing.

        If the English decision was given, the Chinese answer must have the same one.
        """
        schema = answer_schema(english.coc.flight_decision if question.decision else None, "zh")
        return student_request(question.asked["zh"], frames, schema, self._sampling, seed)


def _described(views: Sequence[str], size_px: tuple[int, int]) -> str:
    return f"{', '.join(views) or 'none'} of {size_px[0]} x {size_px[1]} px"
