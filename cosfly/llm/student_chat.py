"""A student's chat: prompt, order of pictures and their pixels, the same in training, inference and serving."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from cosfly.formats.captions import Language, Prompt
from cosfly.llm.client import EndpointConfig
from cosfly.llm.contract import Request
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import FileFormat, read_model, write_model
from cosfly.viz.frame_views import View, encode_picture, frame_label

IMAGE_ENCODING: Literal["png"] = "png"
IMAGE_PART: dict[str, Any] = {"type": "image"}  # a picture as chat templates know it
MAX_ANSWER_TOKENS = 512  # 1.5 times the longest answer in training


class StudentEndpointConfig(EndpointConfig):
    """Sampling of a student: greedy and without thinking, as in training."""

    temperature: ClassVar[float] = 0.0  # type: ignore[misc]
    top_p: ClassVar[float] = 1.0
    max_tokens: ClassVar[int] = MAX_ANSWER_TOKENS  # type: ignore[misc]
    json_schema: ClassVar[bool] = False  # type: ignore[misc]
    extra_body: dict[str, Any] = Field(
        {"chat_template_kwargs": {"enable_thinking": False}}, description="further fields of the request"
    )


def chat_messages(prompt: Prompt, frames: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the chat of a sample: system text, each frame's pictures after its name, question.

    Args:
        frames: the picture parts of each frame, oldest first; a frame without pictures is not named.
    """
    content: list[dict[str, Any]] = []
    for number, pictures in enumerate(frames):
        if pictures:
            content += [{"type": "text", "text": frame_label(number)}, *pictures]
    content.append({"type": "text", "text": prompt.user})
    return [{"role": "system", "content": prompt.system}, {"role": "user", "content": content}]


class EncodedImage(NamedTuple):
    """One picture of a request: its base64 data URL, and the sha256 of its bytes."""

    url: str
    digest: str


def picture_to_send(rgb: np.ndarray, max_pixels: int) -> EncodedImage:
    """Encode a picture, (h, w, 3) uint8 RGB, without loss, scaled down to `max_pixels`; 0: not scaled."""
    height_px, width_px = rgb.shape[:2]
    scale = math.sqrt(max_pixels / (width_px * height_px))
    if max_pixels and scale < 1.0:
        size = (max(1, int(width_px * scale)), max(1, int(height_px * scale)))
        rgb = np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BICUBIC))
    data = encode_picture(rgb, IMAGE_ENCODING, 0)
    url = f"data:image/{IMAGE_ENCODING};base64,{base64.b64encode(data).decode('ascii')}"
    return EncodedImage(url, sha256_bytes(data))


def student_request(
    prompt: Prompt, frames: Sequence[Sequence[EncodedImage]], schema: dict, sampling: EndpointConfig, seed: int = 0
) -> Request:
    """Return a request to an engine. frames: the pictures of each frame, oldest first. schema: of the answer."""
    parts = [[{"type": "image_url", "image_url": {"url": one.url}} for one in pictures] for pictures in frames]
    digests = [picture.digest for pictures in frames for picture in pictures]
    return sampling.request(chat_messages(prompt, parts), digests, schema, seed)


# --- the chat format of training --------------------------------------------------------------------------------------

CHAT_FORMAT_FILE, CHAT_FORMAT = "cosfly_student.json", FileFormat("cosfly.student", "1.0", "student")


class FrameFormat(BaseModel):
    """The pictures of a frame: their views in order, width and height of each, and the far end of depth pictures."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    views: tuple[View, ...]
    size_px: tuple[PositiveInt, PositiveInt]
    depth_range_m: float = Field(gt=0, allow_inf_nan=False)


class ChatFormat(BaseModel):
    """`cosfly_student.json`, next to a student's weights: the form of its chats in training.

    prompts: one question per language. num_frames: of a window. looks: picture formats of all training samples, sorted.
    max_pixels: limit of its image processor.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    prompts: dict[Language, Prompt] = Field(min_length=1)
    num_frames: int = Field(ge=1)
    looks: list[FrameFormat] = Field(min_length=1)
    max_pixels: int = Field(ge=1)


def write_chat_format(folder: Path, taught: ChatFormat) -> None:
    """Write `cosfly_student.json` into the folder of a student's weights."""
    write_model(folder / CHAT_FORMAT_FILE, taught, CHAT_FORMAT)


def read_chat_format(folder: Path) -> ChatFormat:
    """Read `cosfly_student.json` from the folder of a student's weights or the output directory above it."""
    place = _place_of(folder)
    return read_model(place / CHAT_FORMAT_FILE, ChatFormat, CHAT_FORMAT, tree=place)


def student_files(folder: Path) -> dict[str, Path]:
    """Return the files that identify a student, chat format and weights, as inputs of a stage: name -> path."""
    place = _place_of(folder)
    return {f"student/{path.name}": path for path in (place / CHAT_FORMAT_FILE, *sorted(place.glob("*.safetensors")))}


def _place_of(folder: Path) -> Path:
    places = [folder, folder / "adapter", folder / "model"]
    place = next((place for place in places if (place / CHAT_FORMAT_FILE).is_file()), None)
    if place is None:
        what = f"the folder contains no {CHAT_FORMAT_FILE}, which describes the student's training"
        expected, fix = "it in the folder, in adapter/ or in model/", "pass the output of cosfly distill train or merge"
        raise InputError(what, where=folder, expected=expected, fix=fix)
    return place
