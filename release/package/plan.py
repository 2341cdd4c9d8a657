"""Which flights stand in which shard. Decided before any is written, so that neither workers nor a kill change it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.frames import FILE_NAMES, FrameFile, frame_name
from release.columns import SPLIT_NAMES, SplitName
from release.package.captions import FlightCaptions
from release.package.shards import FlightPart
from release.package.survey import Placing, Surveyed, Tell
from release.subsample import select_frames


@dataclass(frozen=True)
class PlannedShard:
    """A shard to write. name: of its part, the same for the same flights of the same sizes."""

    name: str
    split: SplitName
    parts: list[FlightPart]
    num_frames: int


def plan_shards(sizes: Sequence[int], target_bytes: int) -> list[list[int]]:
    """Group consecutive flights: a shard is closed as soon as it reaches the target."""
    groups: list[list[int]] = []
    total = 0
    for index, size in enumerate(sizes):
        if not groups or total >= target_bytes:
            groups.append([])
            total = 0
        groups[-1].append(index)
        total += size
    return groups


def selected_bytes(
    flight: Surveyed, files: Sequence[FrameFile], num_frames: int | None, window_frames: int, tell: Tell
) -> tuple[int, int]:
    """Give the number of a flight's selected frames and the bytes of their files; `tell` takes files that are not there."""
    folder, total = flight.candidate.folder, 0
    selected = select_frames(flight.num_frames, num_frames, window_frames).tolist()
    for i in selected:
        for file in files:
            path = folder / frame_name(i) / FILE_NAMES[file]
            size = _size(path)
            total += size
            if not size:
                tell(flight.name, InputError("a frame's file is missing or empty", where=path, fix="render it again"))
    return len(selected), total


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def shards_of(
    flights: list[tuple[Surveyed, FlightCaptions, int, int]], placings: dict[str, Placing], target_bytes: int
) -> list[PlannedShard]:
    """Give the shards in the order of the release: split by split, and in each the flights as they come.

    Args:
        flights: each with its captions, number of selected frames, and their bytes.
    """
    shards: list[PlannedShard] = []
    for split in SPLIT_NAMES:
        own = [entry for entry in flights if placings[entry[0].name].split == split]
        for number, group in enumerate(plan_shards([entry[3] for entry in own], target_bytes)):
            members = [own[index] for index in group]
            parts = [FlightPart(f.candidate, placings[f.name], captions) for f, captions, *_ in members]
            named = "".join(f"{f.name} {placings[f.name]} {frames} {size}\n" for f, _, frames, size in members)
            name = f"{split}-{number:05d}-{hashlib.sha256(named.encode()).hexdigest()[:12]}"
            shards.append(PlannedShard(name, split, parts, sum(entry[2] for entry in members)))
    return shards
