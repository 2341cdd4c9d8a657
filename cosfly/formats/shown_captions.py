"""A caption as a release shows it, and what a reader of captions finds: what `release verify` and `caption` exchange.

Release knows rows and pictures, caption knows labels and verdicts; neither imports the other. The command line brings
them together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cosfly.formats.captions import Language
from cosfly.formats.playback import Track


@dataclass(frozen=True)
class ShownCaption:
    """One caption of a flight. frame_index: its current frame. prompts: by language, empty where none is shown."""

    sample_id: str
    frame_index: int
    prompts: dict[Language, str]
    decision: str
    label: str | None
    verdict: str | None


@dataclass(frozen=True)
class ShownFlight:
    """A flight as far as it is released. flight: of the frames `frame_indices` (n,), in order, which may have gaps.

    twin: the clean flight of a perturbed one, of the same frames; None
    where it is not released or shows others. settings: of the captions, as recorded; empty: the defaults.
    """

    flight: Track
    frame_indices: np.ndarray
    captions: Sequence[ShownCaption]
    twin: Track | None
    settings: dict[str, Any]


class Lie(NamedTuple):
    """Something that cannot be, in the words of a finding."""

    code: str
    where: str
    got: str
    expected: str


CaptionReader = Callable[[ShownFlight], list[Lie]]
