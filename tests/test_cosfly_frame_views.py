"""Frames as pictures: one look for teachers, students and people."""

import asyncio
import base64
import io
import re
from functools import partial

import numpy as np
import pytest
from PIL import Image
from specimens_captions import VOCABULARY
from tables import each

from caption.schema import CaptionConfig, ImageConfig, Window, WindowConfig
from caption.stage.window_loop import caption_window
from caption.stage.windows import cut_windows
from caption.teachers.prompts import make_question, question_messages
from caption.teachers.teacher import RuleTeacher, encode_frame
from cosfly.formats.captions import PICTURES_MARK, Language
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.llm.student_chat import encoded_image
from distill.inference.stage import EngineAnswers, InferConfig, Inputs
from distill.prepare.stage import PrepareConfig, make_sample
from distill.schema import Sample
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 1, 10, with_augmented=False)


# Views, layout, largest side: every count of views, orders that are not the usual one, both layouts and sizes.
SHAPES = [
    (("rgb",), "separate", 640), (("depth", "rgb"), "tiled", 40), (("segmentation", "rgb", "depth"), "separate", 40),
    (("depth", "segmentation", "rgb"), "tiled", 640),
]  # fmt: skip
NAMES = {
    "en": {"RGB": "rgb", "depth": "depth", "segmentation": "segmentation", "enlarged": "middle"},
    "zh": {"RGB": "rgb", "深度": "depth", "分割": "segmentation", "放大": "middle"},
}


def told_views(text: str, language: Language) -> tuple[str, ...]:
    places = {view: text.find(name) for name, view in NAMES[language].items() if name in text}
    return tuple(sorted(places, key=places.__getitem__))


def told_count(text: str, language: Language) -> int:
    several = {"en": r"given as (\d+) pictures", "zh": r"每帧依次给出 (\d+) 张"}[language]
    found = re.search(several, text)
    if found is None:
        assert {"en": "given as one picture", "zh": "每帧给出一张图像"}[language] in text
    return int(found.group(1)) if found else 1


def told_size(text: str) -> tuple[int, int]:
    [(width, height)] = re.findall(r"(\d+) [x×] (\d+) (?:px|像素)", text)
    return int(width), int(height)


def sent_pictures(messages: list[dict]) -> list[np.ndarray]:
    parts = [part["image_url"]["url"] for part in messages[1]["content"] if part["type"] == "image_url"]
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB")) for url in parts]


@pytest.fixture(scope="module")
def window(tree) -> Window:
    return next(cut_windows(read_track(find_tracks(tree)[0]), WindowConfig()))


def ask(window: Window, cfg: ImageConfig) -> tuple[dict[Language, str], list[np.ndarray]]:
    question = make_question(window.observed, cfg, "prose", VOCABULARY)
    encode = partial(encoded_image, encoding="png")
    frames = [encode_frame(folder, question.pictures, encode) for folder in window.observed.frame_folders]
    messages, _ = question_messages(question, frames)
    assert messages[1]["content"][-1]["text"] == question.asked["en"].user
    return {language: prompt.user for language, prompt in question.asked.items()}, sent_pictures(messages)


def test_a_teacher_is_told_what_it_is_shown(window):
    middle = [(("middle",), "separate", 640), (("rgb", "middle", "depth"), "tiled", 40)]
    for views, layout, max_side_px in [*SHAPES, *middle]:
        cfg = ImageConfig(modalities=views, layout=layout, max_side_px=max_side_px)
        told, pictures = ask(window, cfg)
        for language, text in told.items():
            assert told_views(text, language) == views
            assert len(pictures) == 5 * told_count(text, language)
            width, height = told_size(text)
            assert (width, height) == ((64, 36) if max_side_px == 640 else (40, 22))
            across = len(views) if layout == "tiled" else 1
            assert {picture.shape for picture in pictures} == {(height, across * width, 3)}


@each(("views", "layout", "max_side_px"), SHAPES)
def test_a_student_is_told_what_it_is_shown_and_sees_what_its_teacher_saw(tree, window, views, layout, max_side_px):
    image = {"layout": layout, "max_side_px": max_side_px, "depth_range_m": 40.0}
    cfg = CaptionConfig.model_validate({"image": image, "window": {"require_images": True}})
    caption = asyncio.run(caption_window(window, RuleTeacher(0), cfg, VOCABULARY))
    _, shown = ask(window, cfg.image)
    if layout == "tiled":
        shown = [part for picture in shown for part in np.split(picture, 3, axis=1)]
    teachers = [dict(zip(cfg.image.modalities, shown[3 * i : 3 * i + 3], strict=True)) for i in range(5)]
    assert caption.status == "accepted"
    for language in ("en", "zh"):
        sample = make_sample(caption, language, PrepareConfig(modalities=views))
        assert isinstance(sample, Sample)
        text = sample.prompt.user
        pictures = [picture for frame in sample.frames for picture in sample.pictures.read(tree / frame)]
        assert PICTURES_MARK not in text
        assert told_views(text, language) == views
        assert len(pictures) == 5 * told_count(text, language) == 5 * len(views)
        assert told_size(text) == pictures[0].shape[1::-1]
        assert ("40 m and beyond" in text or "40 米及更远" in text) == ("depth" in views)
        expected = [teachers[i][view] for i in range(5) for view in views]
        for picture, wanted in zip(pictures, expected, strict=True):
            assert np.array_equal(picture, wanted)
        inputs, cfg = Inputs((), {"": tree}, "", None), InferConfig(engine="endpoint")
        request = EngineAnswers(None, None, inputs, cfg)._request(sample)  # as `vllm` is asked too
        kinds = [part.get("text", "picture") for part in request.messages[1]["content"]]
        assert kinds == [word for i in range(5) for word in (f"t{i}:", *["picture"] * len(views))] + [text]
        for picture, wanted in zip(sent_pictures(request.messages), expected, strict=True):
            assert np.array_equal(picture, wanted)
