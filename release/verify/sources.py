"""The tracks of a shard of a release, or one of a playback tree, as a worker reads them: rows, points and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from cosfly.formats.frames import FILE_NAMES, FrameFile, frame_path
from cosfly.formats.places import Place, flight_ids
from cosfly.formats.playback import Track, read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.tables import open_table, row_batches
from release.columns import PICTURES, SCALARS, Placement
from release.flight_rows import FlightRows
from release.reading import read_tracks
from release.record import Shard

BATCH_ROWS = 2  # whose pictures are in memory at once
Pictures = dict[FrameFile, bytes | memoryview | None]


class ReadTrack(NamedTuple):
    """One track. pictures: Of its frames, one after the other."""

    frames: FlightRows
    points: FlightRows
    pictures: Iterator[Pictures]


def sample_prefixes(names: list[str]) -> dict[str, str]:
    """Return with what the sample ids of each track, `run/town/trajectory/variant`, begin; empty if names repeat."""
    try:
        places = {name: Place(*name.split("/")) for name in names}
        ids = flight_ids(list(places.values()))
    except (InputError, TypeError):
        return {}
    return {name: ids[place] for name, place in places.items()}


@dataclass(frozen=True)
class ShardTracks:
    """The tracks of one shard. ids: As `sample_prefixes` gives them."""

    folder: Path
    shard: Shard
    files: tuple[FrameFile, ...]
    ids: dict[str, str]

    def __iter__(self) -> Iterator[ReadTrack]:
        """Yield the tracks; all pictures of one must be taken before the next one."""
        pictures = self._pictures()
        for frames, points in read_tracks(self.folder, self.shard, strict=False):
            given_id = self.ids.get(frames.name)
            yield ReadTrack(
                replace(frames, given_id=given_id), replace(points, given_id=given_id), islice(pictures, len(frames))
            )

    def _pictures(self) -> Iterator[Pictures]:
        names = {file: PICTURES[file].name for file in self.files}
        path = self.folder / self.shard.path
        with open_table(path, tree=self.folder) as table:
            for group in range(table.num_row_groups):
                for batch in row_batches(path, table, group, list(names.values()), BATCH_ROWS):
                    cells = {file: batch.column(name).to_pylist() for file, name in names.items()}
                    for i in range(len(batch)):
                        row = {file: column[i] for file, column in cells.items()}
                        yield {file: cell["bytes"] if isinstance(cell, dict) else cell for file, cell in row.items()}


@dataclass(frozen=True)
class TreeTrack:
    """One track of a playback tree, ours or the public one. folder: Relative to the tree."""

    tree: Path
    folder: str
    name: str
    files: tuple[FrameFile, ...]
    ids: dict[str, str]

    def __iter__(self) -> Iterator[ReadTrack]:
        track = replace(read_track(self.tree / self.folder, strict=False), run=self.name.split("/")[0])
        nowhere = Placement(walk="", split="train")  # a tree has no splits
        rows = []
        for i in range(len(track)):
            row = {column.name: column.cell(track, i, None, nowhere) for column in SCALARS}
            row |= {"walk": None, "split": None}
            if given_id := self.ids.get(self.name):
                row["sample_id"] = f"{given_id}_frame_{i:05d}"
            rows.append(row)
        frames = FlightRows(self.name, rows, self.ids.get(self.name))
        yield ReadTrack(frames, frames, self._pictures(track))

    def _pictures(self, track: Track) -> Iterator[Pictures]:
        for i in range(len(track)):
            paths = {file: frame_path(track.frame_folder(i), FILE_NAMES[file]) for file in self.files}
            yield {
                file: read_bytes(path, what="file of the frame", tree=self.tree) if path.is_file() else None
                for file, path in paths.items()
            }


TrackSource = ShardTracks | TreeTrack


def tracks_of_tree(tree: Path) -> list[TreeTrack]:
    """Find the tracks of a tree; of the kinds of pictures, those that any of its first frames has.

    Raises:
        InputError: It is no tree.
    """
    folders = find_tracks(tree)
    frames = [frame for folder in folders for frame in sorted(folder.glob("frames_playback/*"))[:1]]
    files = tuple(file for file, name in FILE_NAMES.items() if any(frame_path(f, name).exists() for f in frames))
    names = {}
    for path in folders:
        *above, town, trajectory, variant = ("", "", "", *path.relative_to(tree).parts)
        names["/".join(("_".join(filter(None, above)), town, trajectory, variant))] = path.relative_to(tree).as_posix()
    ids = sample_prefixes(list(names))
    return [TreeTrack(tree, folder, name, files, ids) for name, folder in names.items()]
