"""Labels and verdicts of released captions, recomputed from the track that they are released with.

A reader for `cosfly release verify`, which gives a track as its rows show it. A window is checked only if its future
frames are released.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from caption.schema import FutureMotion
from caption.stage.windows import LabelMotion, cut_future, label_motion
from caption.verification.actions import TABLE, ActionTable, Motion, Thresholds, measure
from caption.verification.glossary import prompt_line
from cosfly.formats.captions import ORDERS, verdict_on
from cosfly.formats.segments import MISSION_KINDS
from cosfly.formats.shown_captions import Mismatch, ReleasedTrack, ShownCaption

NUDGE = 1e-9  # of a threshold: rounding error of subtracting the offsets again


def read_released(shown: ReleasedTrack) -> list[Mismatch]:
    """Return the labels and verdicts of a track's captions that do not follow from its frames."""
    rows = {int(index): row for row, index in enumerate(shown.frame_indices)}
    motion = label_motion(shown.flight, shown.twin)
    found = (_mismatch(shown, motion, caption, rows) for caption in shown.captions)
    return [mismatch for mismatch in found if mismatch is not None]


def _mismatch(
    shown: ReleasedTrack, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int]
) -> Mismatch | None:
    """Compare label and verdict with the frames after the window, if these are released."""
    where, lines = f"{caption.sample_id}: label", itertools.product(caption.prompts.items(), MISSION_KINDS)
    has_order = any(text.endswith("\n" + prompt_line(kind, language)) for (language, text), kind in lines)
    if caption.prompts and has_order != (caption.label in ORDERS):
        got = f"{caption.label}, and {'an order' if has_order else 'no order'} in the prompt"
        return "label", where, got, "an order as the label if and only if the prompt has one"
    future = _future(shown, motion, caption, rows)
    if future is None:
        return None
    measured = measure(replace(future, order=caption.label) if has_order else future)
    label = TABLE.label_of(measured)
    if label != caption.label and caption.label not in _nearly(measured):
        return "label", where, str(caption.label), f"{label}, by the frames after the window"
    verdict = verdict_on(caption.decision, caption.label, TABLE.contradicted_by(measured, caption.label))
    if caption.verdict is None or verdict == caption.verdict:
        return None
    got = f"{caption.verdict} for {caption.decision} (label {caption.label})"
    return "verdict", f"{caption.sample_id}: verdict", got, f"{verdict}, by the frames after the window"


def _nearly(measured: Motion) -> set[str | None]:
    """Return the labels of thresholds a nudge away: a value may lie on one."""
    numbers = {name: value for name, value in vars(Thresholds()).items() if name != "absent_share"}
    scaled = [Thresholds(**{n: v * (1.0 + side * NUDGE) for n, v in numbers.items()}) for side in (-1, 1)]
    return {ActionTable(one).label_of(measured) for one in scaled}


def _future(
    shown: ReleasedTrack, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int]
) -> FutureMotion | None:
    """Return the motion after a window from the released rows; None if one of its frames is not released."""
    num_future = int(shown.settings.get("window", {}).get("future_frames", 5))
    first = rows.get(caption.frame_index - 1)
    wanted = [rows.get(caption.frame_index + k) for k in range(-1, num_future + 1)]
    if first is None or wanted != list(range(first, first + len(wanted))):
        return None
    if np.isnan(shown.flight.positions_m[first : first + len(wanted)]).any():
        return None
    return cut_future(shown.flight, motion, first + 1, num_future)
