"""The tracks of a run: their names, their share of a limit, their windows, and their part files.

A finished track is a part file `parts/<name>.jsonl`. A track that a limit cuts is `parts/<name>.<windows>.cut`, which
does not count as finished under another limit; one with an unanswered window is `parts/<name>.gap`. The folder is
removed when nothing can be added to the product.
"""

import contextlib
import logging
from bisect import bisect_left
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
    """A track to caption. chosen: Numbers of the windows that a limit allows; None for all."""

    name: str
    folder: Path
    chosen: frozenset[int] | None = None

    def part(self, stage_path: Path) -> Path:
        end = ".jsonl" if self.chosen is None else f".{len(self.chosen)}.cut"  # a larger limit adds windows
        return stage_path / PARTS / f"{self.name}{end}"

    def gap(self, stage_path: Path) -> Path:
        return stage_path / PARTS / f"{self.name}.gap"

    @property
    def item_id(self) -> str:
        return self.name if self.chosen is None else f"{self.name}[{len(self.chosen)}]"

    def windows(self, cfg: CaptionConfig) -> Iterator[Window]:
        """Yield the windows in order of time; InputError if the track or its clean twin cannot be read."""
        track = replace(read_track(self.folder), given_id=self.name)
        try:
            twin = read_twin(track)
        except VerifyError as error:  # it has other frames
            log.warning("caption: %s: the labels do not use the clean track: %s", track.flight_id, error)
            twin = None
        windows = enumerate(cut_windows(track, cfg.window, twin))
        return (window for number, window in windows if self.chosen is None or number in self.chosen)

    def guess_num_windows(self, cfg: WindowConfig) -> int:
        """Estimate the number of windows from the frame folders, without reading the track if it has any."""
        num_frames = sum(1 for _ in (self.folder / "frames_playback").glob("frame_*"))
        if not num_frames:
            with contextlib.suppress(InputError):  # the run itself records the failure
                num_frames = len(read_track(self.folder))
        return len(current_frames(num_frames, cfg)) if self.chosen is None else len(self.chosen)


def spread(total: int, count: int) -> list[int]:
    """Return `count` numbers below `total`, spread evenly (van der Corput); a larger count only adds to a smaller."""
    bits = total.bit_length()
    numbers = (int(f"{i:0{bits}b}"[::-1], 2) * total >> bits for i in range(1 << bits))
    return sorted(islice(dict.fromkeys(numbers), count))


def find_inputs(cfg: CaptionConfig, data: Path) -> tuple[list[TrackInput], bool]:
    """Return the tracks of a run in the order of the product, and whether the limit of the settings cuts them; it takes
    windows spread over all tracks."""
    folders = find_tracks(data, cfg.flights)
    ids = flight_ids([place_of(folder) for folder in folders])
    tracks = [TrackInput(ids[place_of(folder)], folder) for folder in folders]
    tracks.sort(key=lambda track: f"{track.name}_frame_")  # the order of the sample ids
    counts = [track.guess_num_windows(cfg.window) for track in tracks] if cfg.limit else []
    if cfg.limit is None or cfg.limit >= sum(counts):
        return tracks, False
    numbers, inputs, begin = spread(sum(counts), cfg.limit), [], 0
    for track, count in zip(tracks, counts, strict=True):
        of_track = numbers[bisect_left(numbers, begin) : bisect_left(numbers, begin + count)]
        if of_track:
            chosen = None if len(of_track) == count else frozenset(number - begin for number in of_track)
            inputs.append(replace(track, chosen=chosen))
        begin += count
    return inputs, True


def parts_of(stage_path: Path, tracks: Sequence[TrackInput]) -> list[Path]:
    """Return the existing part files, or parts with gaps, in the order of the product."""
    paths = [(track.part(stage_path), track.gap(stage_path)) for track in tracks]
    return [part if part.exists() else gap for part, gap in paths if part.exists() or gap.exists()]
