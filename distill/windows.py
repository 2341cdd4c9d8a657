"""Captioned windows for training code of one's own: frames, facts, caption, from a playback tree, a run or a release.

`Windows` needs no torch and gives NumPy arrays; `WindowDataset` is the same as a `torch.utils.data.Dataset` of tensors. Both are map-style, pickle, and
open their files anew in each process, so they go into a `DataLoader` with workers as they are. Right-handed axes, as in a release.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, get_args

import cv2
import numpy as np

from cosfly.errors import ConfigError, EnvironmentMissing, InputError
from cosfly.look.frame_views import scaled_size
from cosfly.products.captions import Language
from distill.window_sources import open_source

if TYPE_CHECKING:
    import torch.utils.data

    class WindowDataset(torch.utils.data.Dataset[dict[str, Any]]):
        """Captioned windows as tensors; arguments as of `Windows`."""

        left_out: Counter[str]

        def __init__(self, source: str | Path, captions: str | Path | None = None, **options: Any) -> None: ...
        def __len__(self) -> int: ...


class Window(TypedDict):
    """One window of k frames.

    flight: run/town/trajectory/variant. window: (k,) int64, frames of the flight, the caption's own last. frames: (k, 3, h, w) uint8 RGB.
    facts: FACTS of window_sources.py, (k, members) or (k,) float64, NaN where it is not known; FLAGS (k,) bool; pixels are those of the unscaled frame.
    prompt: system and user. caption: the three texts, `label` and `verdict`; "" where there is none.
    """

    sample_id: str
    flight: str
    window: np.ndarray
    frames: np.ndarray
    facts: dict[str, np.ndarray]
    prompt: dict[str, str]
    caption: dict[str, str]


class Windows(Sequence[Window]):
    """The accepted captions of a source with the frames that they were made of, in the order of the source.

    Args:
        source: a release (or its `dataset/`), a run folder, or a playback tree; then `captions` names its captions.jsonl.
        language: of prompt and caption. split: of a release `train`, `validation` or `test`; None takes all.
        max_side_px: frames are scaled down to this longest side; None takes the size that pixels in prompt and caption refer to.
    Raises:
        ConfigError: an option that is none. InputError: nothing to read, or not readable; a picture, when its window is read.
    """

    def __init__(
        self, source: str | Path, captions: str | Path | None = None, *, language: Language = "en",
        split: str | None = None, max_side_px: int | None = None,
    ) -> None:  # fmt: skip
        if language not in get_args(Language):
            raise ConfigError("not a language of captions", got=str(language), expected=", ".join(get_args(Language)))
        if max_side_px is not None and max_side_px < 1:
            raise ConfigError(
                "not a size of a picture", where="max_side_px", got=str(max_side_px), expected="1 or more"
            )
        self.max_side_px = max_side_px
        self._source = open_source(Path(source), None if captions is None else Path(captions), language, split)
        self.left_out = Counter[str]()  # captions that give no window, by reason
        self._places = list(self._source.places(self.left_out))
        if not self._places:
            why = ", ".join(f"{reason} {count}" for reason, count in self.left_out.items())
            raise InputError(
                "no window to learn from", where=source, got=why or "no captions",
                expected=f"accepted captions in {language!r} whose frames are there",
            )  # fmt: skip

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Window:  # type: ignore[override]  # one window at a time
        place = self._places[index]
        read = self._source.read(place)
        sizes = {picture.shape for picture in read.pictures}
        if len(sizes) != 1:
            raise InputError("frames of one window differ in size", where=place.sample_id, got=str(sorted(sizes)))
        small = [_scaled(picture, self.max_side_px or max(read.size_px)) for picture in read.pictures]
        return Window(
            sample_id=place.sample_id, flight="/".join(place.flight), window=np.array(place.window, dtype=np.int64),
            frames=np.ascontiguousarray(np.stack(small).transpose(0, 3, 1, 2)), facts=read.facts, prompt=read.prompt, caption=read.caption,
        )  # fmt: skip


def _scaled(picture: np.ndarray, max_side_px: int | None) -> np.ndarray:
    height_px, width_px = picture.shape[:2]
    size = scaled_size(width_px, height_px, max_side_px)
    return picture if size == (width_px, height_px) else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


@functools.cache
def _dataset_class() -> type:
    """Make the class: its base is PyTorch's, which is loaded when somebody asks for it and not before."""
    try:
        import torch
        from torch.utils.data import Dataset
    except ImportError:
        raise EnvironmentMissing("PyTorch is not installed", fix="pip install 'cosfly[distill]'") from None

    class WindowDataset(Windows, Dataset):
        """Captioned windows as tensors; arguments as of `Windows`."""

        def __getitem__(self, index: int) -> dict[str, Any]:  # type: ignore[override]
            window = Windows.__getitem__(self, index)
            facts = {name: torch.from_numpy(value) for name, value in window["facts"].items()}
            return {**window, "facts": facts, **{name: torch.from_numpy(window[name]) for name in ("window", "frames")}}  # type: ignore[literal-required]

    WindowDataset.__qualname__ = "WindowDataset"  # pickled by this name
    return WindowDataset


def __getattr__(name: str) -> Any:
    if name == "WindowDataset":
        return _dataset_class()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
