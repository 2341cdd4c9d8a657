"""The rules that the record of a release tells: which frames of a flight are released, and which walks stand in which
split.

The paper strides evenly (sec:dataset_stats), which at its flights of 618 to 770 frames and 400 of them leaves no window
of five frames whole (`release.uniform_stride` does so). Runs of six windows' steps keep five sixths of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from cosfly.formats.predictions import Split
from cosfly.geometry.splits import assign_splits
from release.columns import SplitName

WINDOWS_A_RUN = 6  # a run of 6 (w - 1) frames holds 5 (w - 1) + 1 whole windows of w frames

RULE = (
    "of n frames m are kept, all where n <= m or m is null, in r = max(1, floor(m / max(1, 6 (w - 1)))) runs (w: "
    "frames of a caption's window, 1 with uniform_stride): frame k of m is in run j = floor(((k + 1) r - 1) / m) "
    "and is frame k + floor(j (n - m) / (r - 1)) of the flight, k + floor((n - m) / 2) where r = 1. A caption is "
    "released where all frames of its window are"
)


def select_frames(num_points: int, num_frames: int | None, window_frames: int, uniform: bool = False) -> np.ndarray:
    """Choose frames of a flight in runs that are spread evenly.

    Args:
        num_points: n, the flight's frames.
        num_frames: m, how many to keep; None keeps all. A flight of m or fewer is kept whole, never padded.
        window_frames: w, frames of a caption's window. uniform: take it for 1, so that every run is one frame: the
        paper's even stride.
    Returns:
        (min(n, m),) int64, strictly increasing; runs differ in length, and the gaps between them, by at most one. With
        two runs or more the first and the last frame are kept; one run stands in the middle.
    """
    if num_points < 0 or window_frames < 1 or (num_frames is not None and num_frames < 1):
        raise ValueError(f"cannot choose {num_frames} of {num_points} frames for windows of {window_frames} frames")
    if num_frames is None or num_points <= num_frames:
        return np.arange(num_points)
    num_runs = max(1, num_frames // max(1, 0 if uniform else WINDOWS_A_RUN * (window_frames - 1)))
    left_out, k = num_points - num_frames, np.arange(num_frames, dtype=np.int64)
    if num_runs == 1:
        return k + left_out // 2
    return k + ((k + 1) * num_runs - 1) // num_frames * left_out // (num_runs - 1)


def is_whole(window: Iterable[int], selected: set[int]) -> bool:
    """Return whether all frames of a caption's window are released."""
    return selected.issuperset(window)


NAME_OF: dict[Split, SplitName] = {"train": "train", "val": "validation", "test": "test"}
SPLIT_RULE = (
    "whole walks (a walk: flights of one town, in any of its builds, whose person is at the same places at the "
    "same seconds), or whole towns; ranked by sha256 of the seed and the name, the first to test, the next to "
    "validation, the rest to train, one at least for each split that has a share; fewer than splits fill train, "
    "then validation"
)


def split_groups(
    groups: Iterable[str], fractions: Mapping[SplitName, float], seed: int, what: str
) -> dict[str, SplitName]:
    """Return each group, a walk or a family of towns, its split. Those of which no flight is released are not among
    them, and have no rank.
    """
    shares: dict[Split, float] = {"val": fractions["validation"], "test": fractions["test"]}
    splits = assign_splits(groups, shares, seed, too_few="fill", what=what)
    return {group: NAME_OF[split] for group, split in splits.items()}
