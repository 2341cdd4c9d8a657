"""Which frames of a flight are released: uniform stride selection (sec:dataset_stats)."""

from __future__ import annotations

import numpy as np

RULE = "frame k of m is floor(k * (n - 1) / (m - 1)): first and last frame included, gaps differ by at most one; n <= m keeps all"


def select_frames(num_points: int, num_frames: int) -> np.ndarray:
    """Choose frames evenly from a flight.

    Args:
        num_points: n, the flight's frames.
        num_frames: m, how many to keep. A flight of m or fewer is kept whole, never padded.
    Returns:
        (min(n, m),) int64, strictly increasing, from 0 to n - 1; neighbours are (n-1)/(m-1) apart, rounded down or up.
    Raises:
        ValueError: n is negative or m is less than 1.
    """
    if num_points < 0 or num_frames < 1:
        raise ValueError(f"cannot choose {num_frames} of {num_points} frames")
    if num_points <= num_frames:
        return np.arange(num_points)
    if num_frames == 1:
        return np.zeros(1, dtype=np.int64)
    return np.arange(num_frames, dtype=np.int64) * (num_points - 1) // (num_frames - 1)
