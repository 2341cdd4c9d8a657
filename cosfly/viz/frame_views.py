"""Frames as pictures, the same for teachers, students, contact sheets and reports."""

import base64
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from cosfly.formats.captions import Language
from cosfly.formats.frames import FILE_NAMES, SKY_DEPTH_M, frame_path, read_depth, read_instance, read_meta, read_rgb
from cosfly.formats.kinds import KINDS
from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import InputError

View = Literal["rgb", "depth", "segmentation", "middle"]
Layout = Literal["separate", "tiled"]
VIEW_FILES: dict[View, str] = {
    "rgb": FILE_NAMES["rgb"],
    "depth": FILE_NAMES["depth"],
    "segmentation": FILE_NAMES["instance"],
    "middle": FILE_NAMES["rgb"],
}
MIDDLE = 3  # `middle` enlarges 1 / MIDDLE of the width and height of a frame
DEPTH_RANGE_M = 100.0  # dark end of the pseudo-colour; targets are within a third of it
PEDESTRIAN_RGB = (255, 40, 40)
NUM_SHADES = 24
PAGE_JPEG_QUALITY = 72
_SENTENCES = read_yaml(Path(__file__).parent / "templates/pictures.yaml")  # of prompts


@dataclass(frozen=True)
class Pictures:
    """The pictures of each frame in a prompt."""

    views: tuple[View, ...]  # in this order; empty if no picture is sent
    size_px: tuple[int, int]  # width, height of one view; pixel values of the prompt and of the answer refer to it
    layout: Layout = "separate"  # one picture per view; tiled: one per frame, with the views from left to right
    depth_range_m: float = DEPTH_RANGE_M

    def read(self, frame: Path) -> list[np.ndarray]:
        """Read the pictures of a frame folder, each (h, w, 3) uint8 RGB.

        Raises:
            InputError: If a file is missing, damaged or of another size than the prompt says.
        """
        pictures = []
        for view in self.views:
            picture = read_view(frame, view, max_side_px=max(self.size_px), depth_range_m=self.depth_range_m)
            self.check_size(frame_path(frame, VIEW_FILES[view]), (picture.shape[1], picture.shape[0]))
            pictures.append(picture)
        return self.arranged(pictures)

    def arranged(self, views: list[np.ndarray]) -> list[np.ndarray]:
        """Return the pictures of a frame from its views, each (h, w, 3): these, or one with all side by side."""
        return [np.hstack(views)] if views and self.layout == "tiled" else views

    def check_size(self, file: Path, found_px: tuple[int, int]) -> None:
        """Check that a file of (width, height) gives pictures of `size_px`."""
        if scaled_size(*found_px, max(self.size_px)) != self.size_px:
            raise InputError(
                "the picture cannot be scaled to the size that the prompt states",
                where=file,
                got="{} x {} px".format(*found_px),
                expected="at least {} x {} px, with this aspect ratio".format(*self.size_px),
                fix="pass the directory of rendered tracks for which the captions were written",
            )

    def sentence(self, language: Language) -> str:
        """Return the sentence of a prompt that describes these pictures."""
        count = len(self.views)
        is_tiled = self.layout == "tiled" and count > 1
        frame_sentence = _SENTENCES["frame"][language][3 if is_tiled else min(count, 2)]  # none, one, several, tiled
        numbers = {"range": self.depth_range_m, "middle": MIDDLE}
        words = [_SENTENCES["views"][language][view].format(**numbers) for view in self.views]
        listed = {"en": ", ", "zh": "、"}[language].join(words)
        pixel_sentence = _SENTENCES["pixels"][language][2 if "middle" in self.views else int(is_tiled)]
        return frame_sentence.format(count=count, views=listed) + pixel_sentence.format(*self.size_px)


def frame_label(number: int) -> str:
    """Return the text before the pictures of a frame of a window; answers name frames the same way."""
    return f"t{number}:"


def scaled_size(width_px: int, height_px: int, max_side_px: int | None) -> tuple[int, int]:
    """Return (width, height) px of a picture scaled down to a longest side; None keeps the size."""
    if max_side_px is None or max_side_px >= max(width_px, height_px):
        return width_px, height_px
    scale = max_side_px / max(width_px, height_px)
    return max(1, round(width_px * scale)), max(1, round(height_px * scale))


def spread(count: int, most: int) -> list[int]:
    """Return at most `most` of the numbers below `count`, evenly spaced, with the first and the last."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most)).round()})


def read_view(
    frame: Path, view: View, *, max_side_px: int | None = None, depth_range_m: float = DEPTH_RANGE_M
) -> np.ndarray:
    """Read one view of a frame folder as a picture, (h, w, 3) uint8 RGB.

    Args:
        max_side_px: scale down to this longest side; None keeps the size.
    """
    if view == "rgb":
        return bounded(read_rgb(frame), max_side_px)
    if view == "middle":
        return _middle(read_rgb(frame), max_side_px)
    if view == "depth":
        return depth_colors(bounded(read_depth(frame), max_side_px, nearest=True), depth_range_m)
    kinds, ids = read_instance(frame)
    with contextlib.suppress(InputError):  # a tree of other software has no annotation
        bystanders = read_meta(frame).others
        bystander_ids = [] if bystanders is None else [other.instance_id for other in bystanders.others]
        is_other_pedestrian = np.isin(ids, bystander_ids) & (kinds == KINDS["Pedestrians"])
        kinds = np.where(is_other_pedestrian, KINDS["Rider"], kinds)  # only the target is red
    return segmentation_colors(bounded(kinds, max_side_px, nearest=True), bounded(ids, max_side_px, nearest=True))


def _middle(rgb: np.ndarray, max_side_px: int | None) -> np.ndarray:
    """Return the middle of a picture, (h, w, 3), enlarged to the size that the whole would have.

    It does not depend on the target's position, which a model must not learn from it.
    """
    height_px, width_px = rgb.shape[:2]
    part = max(1, round(width_px / MIDDLE)), max(1, round(height_px / MIDDLE))
    x_px, y_px = (width_px - part[0]) // 2, (height_px - part[1]) // 2
    middle = rgb[y_px : y_px + part[1], x_px : x_px + part[0]]
    size = scaled_size(width_px, height_px, max_side_px)
    return cv2.resize(middle, size, interpolation=cv2.INTER_AREA if size[0] < part[0] else cv2.INTER_CUBIC)


def depth_colors(depth_m: np.ndarray, range_m: float = DEPTH_RANGE_M) -> np.ndarray:
    """Colour z-depth (h, w) with inferno reversed: near is bright, `range_m` and the sky are black; (h, w, 3) RGB.

    The scale is fixed, not stretched per frame, so that the same colour is the same distance in every frame.
    """
    share = np.clip(np.where(depth_m >= SKY_DEPTH_M, range_m, depth_m) / range_m, 0.0, 1.0)
    share = np.where(depth_m <= 0.0, 1.0, share)  # 0.0 means invalid, not near
    reversed_level = np.round(255.0 * (1.0 - share)).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(reversed_level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def segmentation_colors(kinds: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Colour classes in muted, fixed tones and pedestrians in red; kinds (h, w), ids (h, w) -> (h, w, 3) RGB."""
    # Neighbouring instances of one class differ a little, so that buildings are distinguishable.
    shades = (ids % NUM_SHADES) * 37 % NUM_SHADES
    rows = np.minimum(kinds, len(KINDS) - 1) * np.uint16(NUM_SHADES) + shades
    return np.take(_PALETTE, rows, axis=0)


def encode_picture(rgb: np.ndarray, encoding: Literal["jpeg", "png"], jpeg_quality: int) -> bytes:
    """Encode a picture, (h, w, 3) uint8 RGB."""
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if encoding == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 6]
    done, data = cv2.imencode(f".{encoding}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    assert done, "OpenCV encodes any 8-bit picture"
    return data.tobytes()


def thumbnail(frame: Path, width_px: int, jpeg_quality: int = 80) -> str | None:
    """Return `rgb.png` of a frame folder as a small JPEG in base64; None if it cannot be read."""
    with contextlib.suppress(InputError):
        return small_jpeg(read_rgb(frame), width_px, jpeg_quality)
    return None


def small_jpeg(rgb: np.ndarray, width_px: int, jpeg_quality: int = 80) -> str:
    """Return a picture, (h, w, 3) uint8 RGB, as a JPEG of a width in base64."""
    height_px = max(1, round(width_px * rgb.shape[0] / rgb.shape[1]))
    small = cv2.resize(rgb, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return base64.b64encode(encode_picture(small, "jpeg", jpeg_quality)).decode("ascii")


def page_pictures(views: Mapping[View, Callable[[], np.ndarray]], width_px: int) -> dict[View, str]:
    """Return the pictures of a frame on a page, JPEG in base64, without those that cannot be read.

    Args:
        views: Readers of views as (h, w, 3) uint8 RGB. width_px: Of the colours; other views have half of it.
    """
    pictures: dict[View, str] = {}
    for view, read in views.items():
        with contextlib.suppress(InputError):
            pictures[view] = small_jpeg(read(), width_px if view == "rgb" else width_px // 2, PAGE_JPEG_QUALITY)
    return pictures


def _palette() -> np.ndarray:
    """Return muted tones, NUM_SHADES of each class, (29 * NUM_SHADES, 3), with vivid pedestrians only."""
    hues = (np.arange(len(KINDS)) * 111) % 180
    hsv = np.stack([hues, np.full(len(KINDS), 70), np.full(len(KINDS), 150)], axis=-1).astype(np.uint8)
    tones = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].astype(np.int64)
    shades = np.arange(NUM_SHADES) - NUM_SHADES // 2
    colors = np.clip(tones[:, None] + shades[:, None], 0, 255).astype(np.uint8)
    colors[KINDS["Pedestrians"]] = PEDESTRIAN_RGB
    return colors.reshape(-1, 3)


_PALETTE = _palette()


def bounded(image: np.ndarray, max_side_px: int | None, *, nearest: bool = False) -> np.ndarray:
    """Return a picture, (h, w) or (h, w, 3), scaled down to a longest side."""
    height, width = image.shape[:2]
    size = scaled_size(width, height, max_side_px)
    if size == (width, height):
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA)
