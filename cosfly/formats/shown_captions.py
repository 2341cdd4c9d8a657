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
    """One caption of a released track."""

    sample_id: str
    frame_index: int  # of its current frame
    window: Sequence[int]
    picture_px: tuple[int, ...]  # (width, height) of the pictures, to which pixels refer
    prompts: dict[Language, str]  # empty where none is released
    texts: dict[Language, dict[str, str]]  # by language and field
    writing: Writing
    values: dict[Language, tuple[int | None, ...]]  # numbers of values (`ValueCounts`); None where not counted
    evidence: str  # JSON of `captions.Evidence`
    decision: str
    repair: str | None
    label: str | None
    verdict: str | None


@dataclass(frozen=True)
class ReleasedTrack:
    flight: Track  # with all of its points
    captions: Sequence[ShownCaption]  # those that are released
    twin: Track | None  # the clean track of a perturbed one; None if it is not released
    settings: dict[str, Any]  # as recorded for the captions; empty means the defaults


Mismatch = tuple[str, str, str, str]  # a contradiction: code, where, got and expected of its finding
CaptionReader = Callable[[ReleasedTrack], list[Mismatch]]
