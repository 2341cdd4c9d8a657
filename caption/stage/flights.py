"""The flights of a run: their names, their share of a limit, their windows, and their part files.

A finished flight is a part file `parts/<name>.jsonl`. A flight that a limit cuts is `parts/<name>.<windows>.cut`, which
another limit does not take for finished; one in which a window has no answer yet is `parts/<name>.gap`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from caption.schema import CaptionConfig, Window, WindowConfig
from caption.stage.windows import current_frames, cut_windows
from cosfly.formats.captions import caption_lines, write_caption_lines
from cosfly.formats.places import ALL_TRACKS, TrackChoice, flight_ids, flight_of, place_of
from cosfly.formats.playback import Track, read_track
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.runtime.errors import InputError, VerifyError

log = logging.getLogger(__name__)

PARTS = "parts"


@dataclass(frozen=True)
class Allotted:
    """A flight and what a run may take of it: `most` windows, or all (None)."""

    name: str
    folder: Path
    most: int | None = None

    def part(self, stage_path: Path) -> Path:
        end = ".jsonl" if self.most is None else f".{self.most}.cut"
        return stage_path / PARTS / f"{self.name}{end}"

    def gap(self, stage_path: Path) -> Path:
        return stage_path / PARTS / f"{self.name}.gap"

    @property
    def item_id(self) -> str:
        return self.name if self.most is None else f"{self.name}[:{self.most}]"

    def windows(self, cfg: CaptionConfig) -> Iterator[Window]:
        """Yield its windows in order of time.

        Raises:
            InputError: it, or the clean flight beside it, cannot be read.
        """
        flight = replace(read_track(self.folder, strict=False), given_id=self.name)
        for number, window in enumerate(_cut(flight, cfg)):
            if number == self.most:
                return
            yield window

    def guess_num_windows(self, cfg: WindowConfig) -> int:
        """Guess the number of windows from the frame folders, without reading the flight: for display and estimates."""
        frames = self.folder / "frames_playback"
        count = sum(1 for entry in frames.iterdir() if entry.name.startswith("frame_")) if frames.is_dir() else 0
        count = len(current_frames(count, cfg))
        return count if self.most is None else min(count, self.most)


def _cut(flight: Track, cfg: CaptionConfig) -> Iterator[Window]:
    return cut_windows(flight, cfg.window, _twin_of(flight))


def _twin_of(flight: Track) -> Track | None:
    """Read the clean flight beside a perturbed one; one of other frames is left out, and the log says why."""
    try:
        return read_twin(flight)
    except VerifyError as error:
        log.warning("caption: %s: labels without its clean twin: %s", flight.flight_id, error)
        return None


def named_flights(data: Path, choice: TrackChoice = ALL_TRACKS) -> list[tuple[str, Path]]:
    """Return (flight id, folder) in the order of the product."""
    folders = find_tracks(data, choice)
    ids = flight_ids([place_of(folder) for folder in folders])
    named = [(ids[place_of(folder)], folder) for folder in folders]
    return sorted(named, key=lambda pair: f"{pair[0]}_frame_")  # the order of their sample ids


def allot(flights: list[tuple[str, Path]], cfg: CaptionConfig) -> tuple[list[Allotted], bool]:
    """Return which windows of each flight `limit` leaves, independent of the order of work; and whether it leaves any
    out."""
    if cfg.limit is None:
        return [Allotted(name, folder) for name, folder in flights], False
    left = cfg.limit
    allotted: list[Allotted] = []
    for name, folder in flights:
        try:
            flight = read_track(folder, strict=False)
            count = sum(1 for _ in _cut(flight, cfg))
        except InputError:
            count = 0  # the work itself records the failure
        if left == 0 and count > 0:
            return allotted, True
        allotted.append(Allotted(name, folder, left if count > left else None))
        if count > left:
            return allotted, True
        left -= count
    return allotted, False


def parts_of(stage_path: Path, allotted: list[Allotted], with_gaps: bool) -> list[Path]:
    """Return the part files of a run in the order of the product, which is that of the flights."""
    found: list[Path] = []
    for flight in allotted:
        part, gap = flight.part(stage_path), flight.gap(stage_path)
        if part.exists():
            found.append(part)
        elif with_gaps and gap.exists():
            found.append(gap)
    return found


def restore_parts(stage_path: Path, product: Path, allotted: Sequence[Allotted]) -> None:
    """Cut the product of a stage that was finished into its parts again, so that a run that goes on keeps what it
    holds.

    A flight of which any part stands there is left as it is: the product may hold only a share of it.
    """
    begun = {path.name.removesuffix(".cut").rsplit(".", 1)[0] for path in (stage_path / PARTS).glob("*")}
    lost = {flight.name: flight for flight in allotted if flight.most is None and flight.name not in begun}
    if not lost or not product.exists():
        return
    for name, captions in groupby(caption_lines(product), key=lambda pair: flight_of(pair[1].sample_id)):
        if name in lost:
            write_caption_lines(lost[name].part(stage_path), (line.encode() for line, _ in captions))
