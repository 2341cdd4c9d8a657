"""Do the colours show the person where the mask does? How much they change at the person's outline, beside the frames before and after."""

from __future__ import annotations

import numpy as np

from cosfly.products.png import Png
from release.verify.findings import Findings
from release.verify.pixels import outline_of
from release.verify.rows import FlightRows

MOST_ROWS = 8  # of the person that are looked at: what they lean on has to be undone too
LEAST_PLACES = 6  # of its outline, for their mean to say something
NEAR_FRAMES, LEAST_NEIGHBOURS = 6, 4  # how far frames may be to say what is usual, and how many of them must
LEAST_USUAL = 8.0  # grey levels of three channels: of a person whom fog hides nothing is said
# Of what is usual; honest 0.48 and more in 7,710 frames by day and night, in fog and rain, 0.42 in 1,116 of 128 px. Painted over: 0.1 at the median.
SHOWN_LEAST = 0.3


def outline_step(colours: Png, instance: np.ndarray, box: np.ndarray) -> float:
    """Give the mean change of colours from pixel to pixel at the person's outline, grey levels of three channels; NaN where too little is seen.

    Args:
        instance: (h, w, 3) uint8; box: (4,) px, of the person's pixels, NaN where there are none.
    """
    if np.isnan(box).any():
        return np.nan
    height, width = instance.shape[:2]
    x0, y0, x1, y1 = np.clip(box, 0, [width, height, width, height]).astype(int).tolist()
    if x1 <= x0 or y1 <= y0:
        return np.nan
    rows = np.unique(np.linspace(y0, y1 - 1, MOST_ROWS).astype(int))
    total, num = outline_of(colours.rows(rows), instance, rows, max(0, x0 - 1), min(width, x1 + 1))
    return total / num if num >= LEAST_PLACES else np.nan


def check_shown(flight: FlightRows, steps: np.ndarray, findings: Findings) -> None:
    """A frame shows the person about as clearly as those beside it.

    Args:
        steps: (n,) of each row what `outline_step` gives.
    """
    known = np.flatnonzero(np.isfinite(steps))
    for i in known:
        near = known[(known != i) & (np.abs(flight.index[known] - flight.index[i]) <= NEAR_FRAMES)]
        if len(near) < LEAST_NEIGHBOURS:
            continue
        usual = float(np.median(steps[near]))
        if usual >= LEAST_USUAL and steps[i] < SHOWN_LEAST * usual:
            got = f"colours that change by {steps[i]:.0f} grey levels at the person's outline"
            findings.error("person", flight.where(i, "image"), got, f"at least {SHOWN_LEAST * usual:.0f}, by the frames beside it: the person whom the mask shows")  # fmt: skip
