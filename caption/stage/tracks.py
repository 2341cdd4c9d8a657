"""The tracks of a run: their names, their share of a limit, their windows, and their part files.

A finished track is a part file `parts/<name>.jsonl`. A track that a limit cuts is `parts/<name>.<windows>.cut`, which
does not count as finished under another limit; one with an unanswered window is `parts/<name>.gap`. The folder is
removed when nothing can be added to the product.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from caption.schema import CaptionConfig, Window, WindowConfig
from caption.stage.windows import current_frames, cut_windows
from cosfly.formats.places import flight_ids, place_of
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.runtime.errors import InputError, VerifyError

log = logging.getLogger(__name__)

PARTS = "parts"


@dataclass(frozen=True)
class TrackInput:
    """A track to caption. max_windows: The first windows that a limit allows; None for all."""

    name: str
    folder: Path
    max_windows: int | None = None

    def part(self, stage_path: Path) -> Path:
        end = ".jsonl" if self.max_windows is None else f".{self.max_windows}.cut"
        return stage_path / PARTS / f"{self.name}{end}"

    def gap(self, stage_path: Path) -> Path:
        return stage_path / PARTS / f"{self.name}.gap"

    @property
    def item_id(self) -> str:
        return self.name if self.max_windows is None else f"{self.name}[:{self.max_windows}]"

    def windows(self, cfg: CaptionConfig) -> Iterator[Window]:
        """Yield the windows in order of time; InputError if the track or its clean twin cannot be read."""
        track = replace(read_track(self.folder), given_id=self.name)
        try:
            twin = read_twin(track)
        except VerifyError as error:  # it has other frames
            log.warning("caption: %s: the labels do not use the clean track: %s", track.flight_id, error)
            twin = None
        return islice(cut_windows(track, cfg.window, twin), self.max_windows)

    def guess_num_windows(self, cfg: WindowConfig) -> int:
        """Estimate the number of windows from the frame folders, without reading the track."""
        num_frames = sum(1 for _ in (self.folder / "frames_playback").glob("frame_*"))
        count = len(current_frames(num_frames, cfg))
        return count if self.max_windows is None else min(count, self.max_windows)


def find_inputs(cfg: CaptionConfig, data: Path) -> tuple[list[TrackInput], bool]:
    """Return the tracks of a run in the order of the product, and whether the limit of the settings cuts them.

    The windows that a limit allows do not depend on the order of work.
    """
    folders = find_tracks(data, cfg.flights)
    ids = flight_ids([place_of(folder) for folder in folders])
    tracks = [TrackInput(ids[place_of(folder)], folder) for folder in folders]
    tracks.sort(key=lambda track: f"{track.name}_frame_")  # the order of the sample ids
    if cfg.limit is None:
        return tracks, False
    left = cfg.limit
    inputs: list[TrackInput] = []
    for track in tracks:
        try:
            count = sum(1 for _ in track.windows(cfg))
        except InputError:
            count = 0  # the run itself records the failure
        if count > left:
            if left:
                inputs.append(replace(track, max_windows=left))
            return inputs, True
        inputs.append(track)
        left -= count
    return inputs, False


def parts_of(stage_path: Path, tracks: Sequence[TrackInput]) -> list[Path]:
    """Return the existing part files, or parts with gaps, in the order of the product."""
    paths = [(track.part(stage_path), track.gap(stage_path)) for track in tracks]
    return [part if part.exists() else gap for part, gap in paths if part.exists() or gap.exists()]
