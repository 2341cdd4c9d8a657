"""The chat of a student: prompt, order of pictures and their pixels, identical in training, inference and serving."""

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from PIL import Image
from pydantic import Field, PositiveInt

from cosfly.formats.captions import Language, Place, Prompt
from cosfly.llm.client import EndpointConfig
from cosfly.llm.contract import Request
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model
from cosfly.viz.frame_views import View, encode_picture, frame_label

JPEG_QUALITY = 90
IMAGE_PART: dict[str, Any] = {"type": "image"}  # a picture in the input of a chat template
MAX_ANSWER_TOKENS = 512  # 1.5 times the longest answer in training


class StudentEndpointConfig(EndpointConfig):
    """Sampling of a student: greedy and without thinking, as in training."""

    own_names: ClassVar[dict[str, str]] = {
        "caption.endpoint.max_tokens": "distill.infer.max_new_tokens",
        "caption.endpoint.json_schema": "distill.infer.constrained",
        "caption.endpoint (temperature, top_p, max_tokens, extra_body)": "distill.infer.endpoint.extra_body",
        " or fewer (caption.image.modalities, caption.image.layout=tiled)": "",
        "caption.image.modalities=[] or ": "",
        "caption.endpoint": "distill.infer.endpoint",
        "caption.image.max_side_px": "distill.infer.max_pixels",
    }
    temperature: ClassVar[float] = 0.0  # type: ignore[misc]
    top_p: ClassVar[float] = 1.0
    max_tokens: ClassVar[int] = MAX_ANSWER_TOKENS  # type: ignore[misc]
    json_schema: ClassVar[bool] = False  # type: ignore[misc]
    extra_body: dict[str, Any] = Field(
        {"chat_template_kwargs": {"enable_thinking": False}}, description="further fields of the request"
    )


def chat_messages(prompt: Prompt, frames: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the chat of a sample: system text, each frame's pictures after its name, question.

    frames: Picture parts of each frame, oldest first; a frame without pictures gets no label.
    """
    content: list[dict[str, Any]] = []
    for index, pictures in enumerate(frames):
        if pictures:
            content += [{"type": "text", "text": frame_label(index)}, *pictures]
    content.append({"type": "text", "text": prompt.user})
    return [{"role": "system", "content": prompt.system}, {"role": "user", "content": content}]


class EncodedImage(NamedTuple):
    """One picture of a request: its base64 data URL and the sha256 of its bytes."""

    url: str
    digest: str


def limited_size(size_px: tuple[int, int], max_pixels: int) -> tuple[int, int]:
    """Return the size in which a picture of (width, height) px is given to a student; 0 disables the limit.

    The student's own processor gets this picture in training, inference and a server, so all make the same tokens.
    """
    scale = math.sqrt(max_pixels / math.prod(size_px))
    if max_pixels == 0 or scale >= 1.0:
        return size_px
    width_px, height_px = (max(1, int(side_px * scale)) for side_px in size_px)
    return width_px, height_px


def limited_picture(rgb: np.ndarray, max_pixels: int) -> np.ndarray:
    """Scale a picture, (h, w, 3) uint8 RGB, down to `limited_size`."""
    height_px, width_px = rgb.shape[:2]
    size_px = limited_size((width_px, height_px), max_pixels)
    if size_px == (width_px, height_px):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize(size_px, Image.Resampling.BICUBIC))


def picture_to_send(rgb: np.ndarray, max_pixels: int) -> EncodedImage:
    """Encode a picture, (h, w, 3) uint8 RGB, without loss, scaled down to `max_pixels`; 0 disables scaling."""
    return encoded_image(limited_picture(rgb, max_pixels), "png")


def encoded_image(rgb: np.ndarray, encoding: Literal["jpeg", "png"] = "jpeg") -> EncodedImage:
    """Encode a picture, (h, w, 3) uint8 RGB; a teacher gets JPEG."""
    data = encode_picture(rgb, encoding, JPEG_QUALITY)
    url = f"data:image/{encoding};base64,{base64.b64encode(data).decode('ascii')}"
    return EncodedImage(url, sha256_bytes(data))


def student_request(
    prompt: Prompt, frames: Sequence[Sequence[EncodedImage]], schema: dict, sampling: EndpointConfig, seed: int = 0
) -> Request:
    """Return a request to an engine.

    Args:
        frames: Pictures of each frame, oldest first.
        schema: JSON schema of the answer.
    """
    parts = [[{"type": "image_url", "image_url": {"url": picture.url}} for picture in pictures] for pictures in frames]
    digests = [picture.digest for pictures in frames for picture in pictures]
    return sampling.request(chat_messages(prompt, parts), digests, schema, seed)


# --- the chat format of training --------------------------------------------------------------------------------------

CHAT_FORMAT_FILE = "cosfly_student.json"
CHAT_FORMAT = FileFormat("cosfly.student", "1.0", "student")


class FrameFormat(Record):
    """The pictures of a frame."""

    views: tuple[View, ...]  # in order
    size_px: tuple[PositiveInt, PositiveInt]  # width and height
    depth_range_m: float = Field(gt=0, allow_inf_nan=False)  # largest depth in depth pictures


class ChatFormat(Record):
    """`cosfly_student.json`, next to a student's weights: the form of its chats in training."""

    prompts: dict[Language, Prompt] = Field(min_length=1)  # one question per language
    num_frames: int = Field(ge=1)  # of a window
    looks: list[FrameFormat] = Field(min_length=1)  # picture formats of all training samples, sorted
    max_pixels: int = Field(ge=1)  # of a picture (`limited_size`)
    decision: Place = "last"  # among the fields of an answer


def write_chat_format(folder: Path, chat_format: ChatFormat) -> None:
    """Write `cosfly_student.json` into the folder of a student's weights."""
    write_model(folder / CHAT_FORMAT_FILE, chat_format, CHAT_FORMAT)


def read_chat_format(folder: Path) -> ChatFormat:
    """Read `cosfly_student.json` from the folder of a student's weights or the output directory above it."""
    student = _student_folder(folder)
    return read_model(student / CHAT_FORMAT_FILE, ChatFormat, CHAT_FORMAT, tree=student)


def student_files(folder: Path) -> dict[str, Path]:
    """Return the files that identify a student, its chat format and weights, by name, as inputs of a stage."""
    student = _student_folder(folder)
    files = (student / CHAT_FORMAT_FILE, *sorted(student.glob("*.safetensors")))
    return {f"student/{path.name}": path for path in files}


def _student_folder(folder: Path) -> Path:
    """Return the folder of a student's weights: a folder itself, or `adapter` or `model` in it."""
    for candidate in (folder, folder / "adapter", folder / "model"):
        if (candidate / CHAT_FORMAT_FILE).is_file():
            return candidate
    what = f"the student's folder has no {CHAT_FORMAT_FILE}, which stores the format of the student's prompts"
    expected = "this file in the folder, or in adapter/ or model/ below the folder"
    fix = "pass the output directory of cosfly distill train or merge"
    raise InputError(what, where=folder, expected=expected, fix=fix)
