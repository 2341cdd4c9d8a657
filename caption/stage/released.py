"""Labels and verdicts of released captions, recomputed from the flight that they are released with.

A reader for `cosfly release verify`, which gives a flight as its rows show it. What the rows do not show (the frames
after a window, where a stride left them out) is not judged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caption.schema import FutureMotion
from caption.stage.windows import LabelMotion, cut_future, label_motion
from caption.teachers.prompts import mission_lines
from caption.verification.actions import TABLE, ActionTable, Motion, Thresholds, measure
from cosfly.formats.captions import ORDERS
from cosfly.formats.shown_captions import Mismatch, ReleasedTrack, ShownCaption

NUDGE = 1e-9  # of a threshold: rounding error of subtracting the offsets again


def read_released(shown: ReleasedTrack) -> list[Mismatch]:
    """Return the labels and verdicts of a flight's captions that its frames do not give."""
    rows = {int(index): row for row, index in enumerate(shown.frame_indices)}
    motion = label_motion(shown.flight, shown.twin)
    return [lie for caption in shown.captions for lie in _label_lies(shown, motion, caption, rows)]


def _has_order(caption: ShownCaption) -> bool:
    """Return whether a prompt ends with the line of an order."""
    return any(
        text.endswith("\n" + line)
        for language, text in caption.prompts.items()
        for line in mission_lines(language).values()
    )


def _label_lies(
    shown: ReleasedTrack, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int]
) -> list[Mismatch]:
    """Compare label and verdict with the frames after the window, where these are released."""
    where = f"{caption.sample_id}: label"
    is_order = caption.label in ORDERS
    has_order = _has_order(caption)
    if caption.prompts and is_order != has_order:
        got = f"{caption.label}, and {'an order' if has_order else 'no order'} in the prompt"
        return [("label", where, got, "an order as label exactly where the prompt tells of one")]
    num_future = int(shown.settings.get("window", {}).get("future_frames", 5))
    future = _future(shown, motion, caption, rows, num_future)
    if future is None:
        return []
    if has_order:
        future = replace(future, order=caption.label)
    measured = measure(future)
    label = TABLE.label_of(measured)
    if label != caption.label and caption.label not in _nearly(measured):
        return [("label", where, str(caption.label), f"{label}, which the frames after the window show")]
    if caption.verdict is None:
        return []
    verdict = TABLE.verdict_of(caption.decision, measured, caption.label)
    if verdict != caption.verdict:
        got = f"{caption.verdict} for {caption.decision} (label {caption.label})"
        return [("verdict", f"{caption.sample_id}: verdict", got, f"{verdict}, by the frames after the window")]
    return []


def _nearly(measured: Motion) -> set[str | None]:
    """Return the labels of thresholds a nudge away: a value may lie on one."""
    numbers = {name: value for name, value in vars(Thresholds()).items() if name != "absent_share"}
    scaled = [Thresholds(**{n: v * (1.0 + side * NUDGE) for n, v in numbers.items()}) for side in (-1, 1)]
    return {ActionTable(one).label_of(measured) for one in scaled}


def _future(
    shown: ReleasedTrack, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int], num_future: int
) -> FutureMotion | None:
    """Return the motion after a window from the released rows; None where one of its frames is not released."""
    found = [rows.get(caption.frame_index + k) for k in range(-1, num_future + 1)]
    wanted = [row for row in found if row is not None]
    if len(wanted) < len(found) or wanted != list(range(wanted[0], wanted[0] + len(wanted))):
        return None
    return (
        None
        if np.isnan(shown.flight.positions_m[wanted]).any()
        else cut_future(shown.flight, motion, wanted[1], num_future)
    )
