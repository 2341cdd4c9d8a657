"""A student's chat: the one renderer for those who train it, run it, serve it and ask it.

A student answers well only what it was taught, so its prompt, the order of its pictures and their pixels come from here
alone.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

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
MAX_ANSWER_TOKENS = 512  # unless told otherwise: an answer as long as is taught, and a half more


class StudentEndpointConfig(EndpointConfig):
    """How a student is asked: greedily and without thinking, as it was taught."""

    temperature: ClassVar[float] = 0.0  # type: ignore[misc]
    top_p: ClassVar[float] = 1.0
    max_tokens: ClassVar[int] = MAX_ANSWER_TOKENS  # type: ignore[misc]
    json_schema: ClassVar[bool] = False  # type: ignore[misc]
    extra_body: dict[str, Any] = Field(
        {"chat_template_kwargs": {"enable_thinking": False}}, description="further fields of the request"
    )


def chat_messages(prompt: Prompt, frames: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the chat of a sample: the system text, then each frame's pictures under its name, and the question.

    Args:
        frames: the parts that stand for the pictures of each frame, oldest first; a frame without any is not named.
    """
    content: list[dict[str, Any]] = []
    for number, pictures in enumerate(frames):
        if pictures:
            content += [{"type": "text", "text": frame_label(number)}, *pictures]
    content.append({"type": "text", "text": prompt.user})
    return [{"role": "system", "content": prompt.system}, {"role": "user", "content": content}]


@dataclass(frozen=True)
class SentPicture:
    """A picture as a part of a request, and the sha256 of its bytes."""

    part: dict[str, Any]
    digest: str


def picture_to_send(rgb: np.ndarray, max_pixels: int) -> SentPicture:
    """Encode a picture, (h, w, 3) uint8 RGB, without loss; larger ones are made smaller.

    Args:
        max_pixels: most pixels that stay; 0: all.
    """
    data = encode_picture(_bounded(rgb, max_pixels), IMAGE_ENCODING, 0)
    url = f"data:image/{IMAGE_ENCODING};base64,{base64.b64encode(data).decode('ascii')}"
    return SentPicture({"type": "image_url", "image_url": {"url": url}}, sha256_bytes(data))


def student_request(
    prompt: Prompt, frames: Sequence[Sequence[SentPicture]], schema: dict, sampling: EndpointConfig, seed: int = 0
) -> Request:
    """Return what an engine is asked.

    Args:
        frames: the pictures of each frame, oldest first.
        schema: of the answer; `answer_schema(language=...)` for a free one.
    """
    messages = chat_messages(prompt, [[picture.part for picture in pictures] for pictures in frames])
    return sampling.request(messages, [picture.digest for pictures in frames for picture in pictures], schema, seed)


def _bounded(picture: np.ndarray, max_pixels: int) -> np.ndarray:
    height_px, width_px = picture.shape[:2]
    scale = math.sqrt(max_pixels / (width_px * height_px))
    if max_pixels == 0 or scale >= 1.0:
        return picture
    size = (max(1, int(width_px * scale)), max(1, int(height_px * scale)))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC))


# --- what a student was taught ----------------------------------------------------------------------------------------

TAUGHT, TAUGHT_FORMAT = "cosfly_student.json", FileFormat("cosfly.student", "1.0", "student")


class FrameLook(BaseModel):
    """How frames were shown: their views in this order, (width, height) of each picture, and the dark end of those of
    depth."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    views: tuple[View, ...]
    size_px: tuple[PositiveInt, PositiveInt]
    depth_range_m: float = Field(gt=0, allow_inf_nan=False)


class Taught(BaseModel):
    """`cosfly_student.json`, beside a student's weights: what its chats looked like when it was taught.

    prompts: of each language that it was taught, one of the questions, whose words tell the version of all. num_frames:
    of a window.
    looks: of all training samples, sorted. max_pixels: most that its image processor kept of a picture.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    prompts: dict[Language, Prompt] = Field(min_length=1)
    num_frames: int = Field(ge=1)
    looks: list[FrameLook] = Field(min_length=1)
    max_pixels: int = Field(ge=1)


def write_taught(folder: Path, taught: Taught) -> None:
    write_model(folder / TAUGHT, taught, TAUGHT_FORMAT)


def read_taught(folder: Path) -> Taught:
    """Read what a student was taught, from the folder of its weights or the output folder that they stand in."""
    place = _place_of(folder)
    return read_model(place / TAUGHT, Taught, TAUGHT_FORMAT, tree=place)


def student_files(folder: Path) -> dict[str, Path]:
    """Return what decides who a student is, what it was taught and its weights, for the inputs of a stage: name ->
    path.

    A server tells a name only, and under one name may serve another student tomorrow.
    """
    place = _place_of(folder)
    return {f"student/{path.name}": path for path in (place / TAUGHT, *sorted(place.glob("*.safetensors")))}


def _place_of(folder: Path) -> Path:
    places = [folder, folder / "adapter", folder / "model"]
    place = next((place for place in places if (place / TAUGHT).is_file()), None)
    if place is None:
        raise InputError(
            "nothing here says what the student was taught",
            where=folder,
            expected=f"{TAUGHT} in it, in adapter/ or in model/",
            fix="give what cosfly distill train or merge wrote",
        )
    return place
