"""A caption as a release shows it, and what a reader of captions says of it: what `release verify` and `caption`
exchange.

Release knows rows and pictures, caption knows what is true of a window; neither imports the other. The command line
brings them together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cosfly.products.actions import ActionSet
from cosfly.products.captions import Coc, Language, Writing
from cosfly.products.playback import Flight


@dataclass(frozen=True)
class ShownCaption:
    """One caption of a flight. frame_index: its current frame; window: indices of what its prompt shows, as it says.

    prompts, systems: user prompts by language and what stood before each, empty where none is shown. picture_px:
    (width, height). states: by language, of its sentences, as its record says; empty where it does not say. evidence:
    what they follow from, as JSON; None where it is not shown.
    """

    sample_id: str
    frame_index: int
    window: tuple[int, ...]
    picture_px: tuple[int, int]
    answers: dict[Language, Coc]
    prompts: dict[Language, str]
    systems: dict[Language, str]
    decision: str
    label: str | None
    label_from: str
    verdict: str | None
    writing: Writing
    states: dict[Language, tuple[str, ...]]
    evidence: str | None


@dataclass(frozen=True)
class ShownFlight:
    """A flight as far as it is released. flight: of the frames `frame_indices` (n,), in order, which may have gaps;
    styles: (n,).

    actions: the closed set of their decisions. twin: the clean flight of a perturbed one, of the same frames; None
    where it is not released or shows others. settings: the captions' own, as they are on record; empty: the defaults.
    prompts: their questions, where these do not ship.
    """

    flight: Flight
    frame_indices: np.ndarray
    styles: Sequence[str | None]
    captions: Sequence[ShownCaption]
    actions: ActionSet
    twin: Flight | None
    settings: dict[str, Any]
    prompts: dict[str, str]


class Lie(NamedTuple):
    """Something that cannot be, in the words of a finding."""

    code: str
    where: str
    got: str
    expected: str


CaptionReader = Callable[[ShownFlight], list[Lie]]
