"""A figure over samples with its interval, as reports hold it; and how it is drawn: by bootstrap over whole walks.

What follows one person on one way is alike, so its samples are no independent draws. Whole walks are drawn instead,
with replacement (Efron and Tibshirani 1993, sec. 8; the cluster bootstrap).
"""

from __future__ import annotations

import numpy as np

from cosfly.runtime.json_io import Record


class Figure(Record):
    """A figure over `count` samples with its interval; all None where nothing is known."""

    value: float | None
    low: float | None
    high: float | None
    count: int


def draw_pedestrians(num_walks: int, resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Draw as many walks as there are, with replacement, `resamples` times: (resamples, walks) counts."""
    return rng.multinomial(num_walks, np.full(num_walks, 1.0 / num_walks), size=resamples).astype(float)


def figure_of_draws(value: float, drawn: np.ndarray, count: int, num_walks: int, confidence: float) -> Figure:
    """Return a figure whose value on each draw is `drawn`, (draws,); NaN: of nothing."""
    if count == 0 or np.isnan(value):
        return Figure(value=None, low=None, high=None, count=count)
    low, high = interval_of(drawn, confidence) if num_walks > 1 else (None, None)  # one walk tells nothing of others
    return Figure(value=value, low=low, high=high, count=count)


def interval_of(drawn: np.ndarray, confidence: float) -> tuple[float | None, float | None]:
    """Return the percentiles between which `confidence` of what was drawn lies, NaN left out."""
    drawn = drawn[~np.isnan(drawn)]  # draws in which nothing of the kind occurs
    if not len(drawn):
        return None, None
    low, high = np.quantile(drawn, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)
