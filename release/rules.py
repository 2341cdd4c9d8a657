"""The rules that the record of a release states: which frames of a track are released, and how splits are assigned."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cosfly.formats.predictions import Split
from cosfly.geometry.splits import assign_splits, town_family
from release.columns import CONTRACT, SplitName
from release.record import Selection, Settings, Shard, SplitBy, StoredDepth, digest_of

WINDOWS_A_RUN = 6  # a run of 6 (w - 1) frames holds 5 (w - 1) + 1 whole windows of w frames

RULES: dict[Selection, str] = {
    "stride": "of n frames m are kept, all where n <= m, by a uniform stride: frame k of m is frame "
    "floor(k (n - 1) / (m - 1)) of the track, floor((n - 1) / 2) where m = 1",
    "windows": "of n frames m are kept, all where n <= m, in r = max(1, floor(m / max(1, 6 (w - 1)))) runs (w: "
    "frames of a caption's window): frame k of m is in run j = floor(((k + 1) r - 1) / m) and is frame "
    "k + floor(j (n - m) / (r - 1)) of the track, k + floor((n - m) / 2) where r = 1",
    "all": "all frames are kept",
}


def select_frames(num_points: int, num_frames: int, selection: Selection, window_frames: int) -> np.ndarray:
    """Choose frames of a track.

    Args:
        num_points: n, the track's frames. num_frames: m, how many to keep; a track of m or fewer is kept whole.
        window_frames: w, frames of a caption's window, for the selection `windows`.
    Returns:
        (k,) int64, strictly increasing. Runs differ in length, and the gaps between them, by at most one. With two runs
        or more (of `stride` each is one frame) the first and the last frame are kept; one run stands in the middle.
    """
    if num_points < 0 or window_frames < 1 or num_frames < 1:
        raise ValueError(f"cannot choose {num_frames} of {num_points} frames for windows of {window_frames} frames")
    if selection == "all" or num_points <= num_frames:
        return np.arange(num_points)
    run_frames = WINDOWS_A_RUN * (window_frames - 1) if selection == "windows" else 1
    num_runs = max(1, num_frames // max(1, run_frames))
    skipped, k = num_points - num_frames, np.arange(num_frames, dtype=np.int64)
    if num_runs == 1:
        return k + skipped // 2
    return k + ((k + 1) * num_runs - 1) // num_frames * skipped // (num_runs - 1)


NAME_OF: dict[Split, SplitName] = {"train": "train", "val": "validation", "test": "test"}
SPLIT_RULE = (
    "A walk is a pedestrian trajectory of a town: tracks of it show the person at the same places at the same "
    "seconds. Walks or towns are ranked by the sha256 of the seed and their name, without the name of the run: the "
    "first go to test, the next to validation, the rest to train. Each split that has a share gets at least one. If "
    "there are fewer than splits, train is filled first, then validation."
)


def split_flights(
    flights: Mapping[str, tuple[str, str]], by: SplitBy, fractions: Mapping[SplitName, float], seed: int
) -> dict[str, SplitName]:
    """Return the split of each track, given its walk and town. Walks, or families of towns, without a released track
    have no rank."""
    shares: dict[Split, float] = {"val": fractions["validation"], "test": fractions["test"]}
    groups = {name: walk if by == "walk" else town_family(town) for name, (walk, town) in flights.items()}
    splits = assign_splits(groups.values(), shares, seed)
    return {name: NAME_OF[splits[group]] for name, group in groups.items()}


def stated_rules(settings: Settings, shards: Sequence[Shard]) -> dict[str, Any]:
    """Return what every record of such a release states."""
    return {
        "frame_selection": RULES[settings.selection],
        "depth": StoredDepth() if "depth" in settings.modalities else None,
        "coordinates": CONTRACT,
        "content_digest": digest_of(shards),
    }


def group_by_size(sizes: Sequence[int], target_bytes: int) -> list[list[int]]:
    """Group consecutive things by index: a group is closed as soon as it reaches the target."""
    groups: list[list[int]] = []
    total = 0
    for index, size in enumerate(sizes):
        if not groups or total >= target_bytes:
            groups.append([])
            total = 0
        groups[-1].append(index)
        total += size
    return groups
