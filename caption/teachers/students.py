"""A student behind a server as a teacher (`--as-student FOLDER`), with the prompts, pictures and sampling of its training.

That is the paper's stage 3: tracks without labels get their captions from a student, which are checked and recorded
like those of any other teacher.
"""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from caption.schema import CaptionConfig
from caption.teachers.foreign import Terms
from caption.teachers.prompt_files import Vocabulary
from caption.teachers.prompts import Frames, Question, regeneration_lines, system_prompt
from cosfly.formats.captions import Language
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.contract import Request
from cosfly.llm.student_chat import (
    MAX_ANSWER_TOKENS,
    ChatFormat,
    StudentEndpointConfig,
    picture_to_send,
    read_chat_format,
    student_request,
)
from cosfly.runtime.errors import ConfigError, TeacherError
from cosfly.viz.frame_views import Pictures


def student_settings(cfg: CaptionConfig, vocabulary: Vocabulary) -> CaptionConfig:
    """Return settings whose windows, pictures, answer format and sampling are those of the student's training, if any."""
    folder = cfg.student.folder
    if folder is None:
        return cfg
    chat_format = read_chat_format(folder)
    check_prompts(chat_format, folder, vocabulary)
    first = chat_format.looks[0]
    kinds = {(look.views, look.depth_range_m, max(look.size_px)) for look in chat_format.looks}
    if len(kinds) > 1:
        what = "a student that was trained with pictures of several kinds cannot write captions"
        got = "; ".join(_described(look.views, look.size_px) for look in chat_format.looks)
        raise ConfigError(what, where=folder, got=got, expected="pictures of one kind")
    sampling = {name: getattr(StudentEndpointConfig(), name) for name in ("temperature", "top_p", "extra_body")}
    return cfg.model_copy(update={
        "writing": "prose",
        "window": cfg.window.model_copy(update={"num_frames": chat_format.num_frames}),
        "image": cfg.image.model_copy(update={
            "modalities": first.views, "layout": "separate", "max_side_px": max(first.size_px),
            "depth_range_m": first.depth_range_m,
        }),
        "endpoint": cfg.endpoint.model_copy(update={
            **sampling, "max_tokens": MAX_ANSWER_TOKENS, "json_schema": cfg.student.constrained,
        }),
    })  # fmt: skip


def check_prompts(chat_format: ChatFormat, folder: Path, vocabulary: Vocabulary) -> None:
    """Check that prompts are written today as they were in the student's training."""
    if "en" not in chat_format.prompts:
        what = "the student was not trained with English answers"
        raise ConfigError(what, where=folder, got=f"answers in {', '.join(chat_format.prompts)}")
    for language, prompt in chat_format.prompts.items():
        is_same = prompt.system == system_prompt(f"system_{language}", vocabulary)
        if not (is_same and _is_of_template(prompt.user, language, chat_format, vocabulary)):
            raise ConfigError(
                "the student was trained with another version of the prompt", where=f"{folder}: {language}",
                got=f"the prompt {prompt.user[:80]!r}",
                fix="use the prompts (caption.prompts, caption.text_state) and the version of cosfly that captioned "
                "its training set, or train the student again",
            )  # fmt: skip


def _is_of_template(user: str, language: Language, chat_format: ChatFormat, vocabulary: Vocabulary) -> bool:
    """Return whether a question is the template of its language, filled with the student's pictures. The template
    becomes a pattern: \\0 marks its slots, because re.escape would change a pattern in them."""
    template = vocabulary.templates[f"user_{language}"]
    looks = [Pictures(look.views, look.size_px, "separate", look.depth_range_m) for look in chat_format.looks]
    patterns = {
        "num_frames": str(chat_format.num_frames),
        "pictures": "|".join(re.escape(pictures.sentence(language)) for pictures in looks),
    }
    pattern = re.escape(template.substitute({slot: f"\0{slot}\0" for slot in template.get_identifiers()}))
    pattern = re.sub("\0(.+?)\0", lambda slot: f"(?:{patterns.get(slot[1], '.+?')})", pattern)
    return re.fullmatch(pattern + r"(\n.+)*", user) is not None  # lines of goal, other people and mission may follow


class TrainedStudent:
    """Makes the requests to a student, in the form of its training, from the settings of `student_settings`."""

    def __init__(self, cfg: CaptionConfig) -> None:
        assert cfg.student.folder is not None
        self.chat_format = read_chat_format(cfg.student.folder)
        self._sampling = cfg.endpoint
        self.encode = partial(picture_to_send, max_pixels=self.chat_format.max_pixels)
        self.terms = Terms("prose", is_fixed=True, has_mirror="zh" in self.chat_format.prompts)

    def request(
        self, question: Question, language: Language, decision: str | None, frames: Frames, seed: int
    ) -> Request:
        """Return the request in one language; a student does not translate. In English a regeneration adds its sentences
        to the system prompt, although the training had none. TeacherError: The training had other pictures."""
        pictures = question.pictures
        trained_with = {(look.views, look.size_px) for look in self.chat_format.looks}
        if (pictures.views, pictures.size_px) not in trained_with:
            raise TeacherError(
                "the pictures of this playback tree differ from those that the student was trained with",
                where=question.window.sample_id, got=_described(pictures.views, pictures.size_px),
                expected=" or ".join(_described(views, size_px) for views, size_px in sorted(trained_with)),
                fix="pass tracks with such pictures, or train a student on pictures like these",
            )  # fmt: skip
        prompt = question.asked[language]
        if language == "en":
            prompt = prompt.model_copy(update={"system": prompt.system + regeneration_lines(question)})
        schema = answer_schema(decision, language, place=self.chat_format.decision)
        return student_request(prompt, frames, schema, self._sampling, seed)


def _described(views: Sequence[str], size_px: tuple[int, int]) -> str:
    return f"{', '.join(views) or 'none'} of {size_px[0]} x {size_px[1]} px"
