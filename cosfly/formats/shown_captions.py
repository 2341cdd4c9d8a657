"""The interface between `release verify` and `caption`: captions as released, and the findings of their checker.

`release` reads rows and pictures, `caption` checks labels and verdicts; the command line passes one to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosfly.formats.captions import Language
from cosfly.formats.playback import Track


@dataclass(frozen=True)
class ShownCaption:
    """One caption of a track. frame_index: its current frame. prompts: by language, empty where none is released."""

    sample_id: str
    frame_index: int
    prompts: dict[Language, str]
    decision: str
    label: str | None
    verdict: str | None


@dataclass(frozen=True)
class ReleasedTrack:
    """The released part of a track. flight: The frames `frame_indices`, (n,), ascending, possibly with gaps. twin: The
    clean track of a perturbed one with the same frames; None if not released. settings: Those recorded for the
    captions; empty means the defaults."""

    flight: Track
    frame_indices: np.ndarray
    captions: Sequence[ShownCaption]
    twin: Track | None
    settings: dict[str, Any]


Mismatch = tuple[str, str, str, str]  # a contradiction: code, where, got and expected of its finding
CaptionReader = Callable[[ReleasedTrack], list[Mismatch]]
