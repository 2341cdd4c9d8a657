"""A student behind a server as a teacher (`--as-student FOLDER`): asked with the very prompts, pictures and sampling
that it was taught with.

That is the paper's stage 3: flights that nobody labelled get their captions from a student, judged and marked like any
other teacher's.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from string import Template

import numpy as np

from caption.answer_formats.contract import Draft
from caption.schema import CaptionConfig
from caption.teachers.foreign import Terms
from caption.teachers.prompts import Question, decision_words, student_prompt
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import Language, Prompt
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.client import EndpointConfig
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


def as_taught(cfg: CaptionConfig, vocabulary: Vocabulary) -> CaptionConfig:
    """Return the settings of a run that asks a student, from what its folder says: windows, pictures, way of writing
    and sampling.

    Where nobody is asked as a student they stay as they are.
    """
    folder = cfg.student.folder
    if folder is None:
        return cfg
    taught = read_chat_format(folder)
    check_prompts(taught, folder, vocabulary)
    views, ranges = {look.views for look in taught.looks}, {look.depth_range_m for look in taught.looks}
    sides = {max(look.size_px) for look in taught.looks}
    if not len(views) == len(ranges) == len(sides) == 1:
        raise ConfigError(
            "the student was taught with pictures of several kinds", where=folder, got=str(taught.looks)[:200]
        )
    picture = {
        "modalities": views.pop(),
        "layout": "separate",
        "max_side_px": sides.pop(),
        "depth_range_m": ranges.pop(),
    }
    sampling = StudentEndpointConfig()
    asked = {name: getattr(sampling, name) for name in ("temperature", "top_p", "extra_body")}
    asked |= {"max_tokens": cfg.student.max_new_tokens, "json_schema": cfg.student.constrained}
    return cfg.model_copy(update={
        "writing": "prose",
        "window": cfg.window.model_copy(update={"num_frames": taught.num_frames}),
        "image": cfg.image.model_copy(update={**picture, "encoding": IMAGE_ENCODING}),
        "endpoint": cfg.endpoint.model_copy(update=asked),
        # Asked again it answers the same, and of corrections it was taught nothing.
        "structure_asks": 1, "correction_asks": 0, "mirror_asks": 1,
    })  # fmt: skip


def check_prompts(taught: ChatFormat, folder: Path, vocabulary: Vocabulary) -> None:
    """Check that prompts are written today as they were for the student."""
    if "en" not in taught.prompts:
        raise ConfigError("the student was taught no English", where=folder, got=", ".join(taught.prompts))
    for language, prompt in taught.prompts.items():
        template = vocabulary.templates[f"user_{language}"]
        if prompt.system != student_prompt(language, vocabulary) or not _is_of_template(
            prompt.user, language, taught, template
        ):
            raise ConfigError(
                "the student was taught another version of the prompt", where=f"{folder}: {language}",
                got=prompt.user[:80],
                fix="ask it with the prompts (caption.prompts, caption.text_state) and the version of cosfly that "
                "captioned its training set, or train it again",
            )  # fmt: skip


def _is_of_template(user: str, language: Language, taught: ChatFormat, template: Template) -> bool:
    told = {"num_frames": re.escape(str(taught.num_frames)), "pictures": "|".join(
        re.escape(Pictures(look.views, look.size_px, "separate",
        look.depth_range_m).sentence(language)) for look in taught.looks
    )}  # fmt: skip
    pattern, end = "", 0
    for match in template.pattern.finditer(template.template):
        name = match["named"] or match["braced"]
        pattern += re.escape(template.template[end : match.start()])
        pattern += f"(?:{told.get(name, '.+?')})" if name else r"\$"
        end = match.end()
    pattern += re.escape(template.template[end:])
    return re.fullmatch(pattern + r"(\n.+)?", user) is not None  # a mission's line may follow


class TaughtStudent:
    """What is asked of a student about a window, in the words that it was taught."""

    def __init__(self, cfg: CaptionConfig) -> None:
        """
        Args:
            cfg: as `as_taught` gives it.
        """
        assert cfg.student.folder is not None
        self.taught = read_chat_format(cfg.student.folder)
        self._sampling: EndpointConfig = cfg.endpoint
        self.terms = Terms("prose", (), has_mirror="zh" in self.taught.prompts, is_translated=False)

    def encode(self, rgb: np.ndarray) -> EncodedImage:
        """Encode a picture as it was taught."""
        return picture_to_send(rgb, self.taught.max_pixels)

    def check(self, question: Question) -> None:
        """Check that a window is shown as those were that the student learnt from.

        Raises:
            TeacherError: the tree lacks a view, or its camera has another picture.
        """
        shown = question.pictures
        if all((look.views, look.size_px) != (shown.views, shown.size_px) for look in self.taught.looks):
            raise TeacherError(
                "the student was taught with other pictures than this playback tree has",
                where=question.window.sample_id,
                got=f"{', '.join(shown.views) or 'none'} of {shown.size_px[0]} x {shown.size_px[1]} px",
                expected=" or ".join(
                    f"{', '.join(k.views)} of {k.size_px[0]} x {k.size_px[1]} px" for k in self.taught.looks
                ),
                fix="give flights of such a camera, or train a student on pictures like these",
            )

    def request(self, question: Question, frames: Sequence[Sequence[EncodedImage]], seed: int) -> Request:
        """Return the English question."""
        prompt = self._reworked(question.asked["en"], question)
        return self._request(prompt, frames, answer_schema(question.decision), seed)

    def mirror_request(
        self, question: Question, english: Draft, frames: Sequence[Sequence[EncodedImage]], seed: int
    ) -> Request:
        """Return the Chinese question, which is of the window as the English one is: a student translates nothing.

        The Chinese of an answer whose decision was given must hold that decision.
        """
        decision = english.coc.flight_decision if question.decision else None
        schema = answer_schema(decision, "zh")
        return self._request(question.asked["zh"], frames, schema, seed)

    def _reworked(self, prompt: Prompt, question: Question) -> Prompt:
        """Add what a repair says, as for any teacher: the student was not taught it, but may follow."""
        more = []
        if question.decision is not None:
            more.append(decision_words(question.decision, question.way.vocabulary))
        if question.rejected is not None:
            more.append(question.way.vocabulary.templates["hint_en"].substitute(rejected=question.rejected))
        return prompt.model_copy(update={"system": "\n".join([prompt.system, *more])})

    def _request(self, prompt: Prompt, frames: Sequence[Sequence[EncodedImage]], schema: dict, seed: int) -> Request:
        return student_request(prompt, frames, schema, self._sampling, seed)
