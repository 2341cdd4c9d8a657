"""Statistics of features as LeRobot keeps them, of an episode and of several: min, max, mean, std, count, and for v3 quantiles.

Of pictures they are those of a few frames of the episode and of every fourth pixel, colours from 0 to 1 by channel, depth in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SAMPLED_FRAMES, PIXEL_STEP = 5, 4
Summary = dict[str, list]  # name of the statistic -> values, nested as LeRobot has them


def sampled(num_frames: int) -> set[int]:
    """Give the frames of an episode whose pictures count."""
    return {int(i) for i in np.linspace(0, num_frames - 1, min(num_frames, SAMPLED_FRAMES)).round()}


def thinned(picture: np.ndarray) -> np.ndarray:
    """Give every fourth pixel of a picture, (k, channels) float64: colours from 0 to 1, depth (two dimensions) as it is."""
    few = picture[::PIXEL_STEP, ::PIXEL_STEP]
    return few.reshape(-1, 1).astype(np.float64) if picture.ndim == 2 else few.reshape(-1, 3) / 255.0


def summarize(values: np.ndarray, count: int, *, is_picture: bool = False) -> Summary:
    """Summarize (k, d) values, NaN left out; `count` is the number of frames they are of. Without any value all is zero, and so is count."""
    known = ~np.isnan(values)
    has_any = known.any(axis=0)
    filled = np.where(has_any, values, 0.0)
    found = {
        "min": np.nanmin(filled, axis=0), "max": np.nanmax(filled, axis=0),
        "mean": np.nanmean(filled, axis=0), "std": np.nanstd(filled, axis=0),
        **{name: np.nanquantile(filled, share, axis=0) for name, share in QUANTILES.items()},
    }  # fmt: skip
    nested = {name: _nested(value, is_picture) for name, value in found.items()}
    return nested | {"count": [count if has_any.any() else 0]}


def merged(summaries: Sequence[Summary]) -> Summary:
    """Summarize what was summarized: exact but for the quantiles, which are means of quantiles, as LeRobot's own are."""
    parts = [part for part in summaries if part["count"][0]] or summaries
    counts = np.array([part["count"][0] for part in parts], dtype=np.float64)
    weights = counts / counts.sum() if counts.sum() else np.full(len(parts), 1 / len(parts))
    stacked = {name: np.array([part[name] for part in parts], dtype=np.float64) for name in parts[0] if name != "count"}
    mean = np.tensordot(weights, stacked["mean"], axes=1)
    variance = np.tensordot(weights, stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2, axes=1)
    found: dict[str, Any] = {name: np.tensordot(weights, stacked[name], axes=1) for name in QUANTILES}
    found |= {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
    }
    return {name: value.tolist() for name, value in found.items()} | {"count": [int(counts.sum())]}


def _nested(value: np.ndarray, is_picture: bool) -> list:
    return value.reshape(-1, 1, 1).tolist() if is_picture else value.tolist()
