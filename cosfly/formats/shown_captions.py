"""The interface between `release verify` and `caption`: captions as released, and the findings of their checker.

`release` reads rows and pictures, `caption` checks labels and verdicts; the command line passes one to the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from cosfly.formats.captions import Language, Writing
from cosfly.formats.playback import Track


@dataclass(frozen=True)
class ShownCaption:
    """One caption of a track. frame_index: Its current frame. prompts: By language, empty where none is released.

    texts: By language and field. values: By language, numbers of values (`ValueCounts`), None where not counted.
    evidence: JSON of `captions.Evidence`. picture_px: (width, height) of the pictures, to which pixels refer.
    """

    sample_id: str
    frame_index: int
    window: Sequence[int]
    picture_px: tuple[int, ...]
    prompts: dict[Language, str]
    texts: dict[Language, dict[str, str]]
    writing: Writing
    values: dict[Language, tuple[int | None, ...]]
    evidence: str
    decision: str
    repair: str | None
    label: str | None
    verdict: str | None


@dataclass(frozen=True)
class ReleasedTrack:
    """A track. flight: All of its points. captions: Those that are released. twin: The clean track of a perturbed one;
    None if not released. settings: Those recorded for the captions; empty means the defaults."""

    flight: Track
    captions: Sequence[ShownCaption]
    twin: Track | None
    settings: dict[str, Any]


Mismatch = tuple[str, str, str, str]  # a contradiction: code, where, got and expected of its finding
CaptionReader = Callable[[ReleasedTrack], list[Mismatch]]
