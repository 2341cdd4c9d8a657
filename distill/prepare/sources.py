"""Runs that a training set is made of, with their playback trees and captions, and the flights of these captions."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cosfly.formats.captions import Caption
from cosfly.formats.frames import frame_name, frame_path
from cosfly.formats.places import TRACKS, Place, TrackChoice, flight_ids, folder_name, sample_id
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks, track_of
from cosfly.geometry.splits import Course, walks_of
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import check_stays_below, inside
from cosfly.runtime.run_dir import record_of
from cosfly.viz.frame_views import VIEW_FILES, View

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunSource:
    """One run's part of a training set: its name, playback tree and captions."""

    run: str
    data: Path
    captions: Path

    @classmethod
    def of_run(cls, folder: Path) -> RunSource:
        """Take a run folder as `cosfly run` makes it."""
        if not (folder / "render").is_dir():
            what, fix = "the folder is not a run directory", "pass --data and --captions if they are in other folders"
            if any((folder / name).is_file() for name in ("release.json", "dataset/release.json")):
                what, fix = (
                    "a release is not a run directory",
                    "pass the run that the release was built from",
                )
            raise InputError(what, where=folder, expected="the folders render/ and caption/", fix=fix)
        captions = folder / "caption/captions.jsonl"
        check_stays_below(captions, captions.parent)
        return cls.of_files(folder / "render", captions)

    @classmethod
    def of_files(cls, data: Path, captions: Path) -> RunSource:
        return cls(run_of(data), data, captions)


def inputs_of(sources: Sequence[RunSource]) -> dict[str, Path]:
    """Name what a stage reads: `data`, `captions`; of several runs with a number."""
    inputs: dict[str, Path] = {}
    for number, source in enumerate(sources, 1):
        files = {"data": source.data, "captions": source.captions}
        inputs |= {f"{number}.{name}" if len(sources) > 1 else name: path for name, path in files.items()}
    return inputs


def run_of(tree: Path) -> str:
    """Name the run of a playback tree by the folder that it stands in."""
    return folder_name(tree.absolute().parent.name)


def check_names(runs: Sequence[str]) -> None:
    """Check that no two runs have one name."""
    if len(set(runs)) < len(runs):
        fix = "rename the folder that contains one of the trees"
        raise InputError("two runs have the same name", got=", ".join(runs), fix=fix)


def check_sources(sources: Sequence[RunSource], unbound: Literal["refuse", "accept"]) -> None:
    """Check that run names differ, and that the captions are recorded as made from a tree; the stage checks which."""
    check_names([source.run for source in sources])
    for source in sources:
        if (record := record_of(source.captions)) is not None and "data" in record.inputs:
            continue
        if unbound == "refuse":
            words = "the playback tree of these captions is not recorded"
            fix = "pass the output of cosfly caption, or accept them with --set distill.prepare.unbound=accept"
            raise VerifyError(words, where=source.captions, got="no stage.json next to the captions", fix=fix)
        log.warning("%s: used as captions of %s, although this is not recorded", source.captions, source.data)


@dataclass(frozen=True)
class CaptionedFlight:
    """A flight that captions are of.

    flight_id: unique among all runs, None for the captions' own. key: of its walk, before these are known. num_frames,
    size_px: of its frames, (width, height); None where it stands in no tree.
    """

    source: RunSource
    town: str
    trajectory: str
    variant: str
    flight_id: str | None
    size_px: tuple[int, int] | None
    num_frames: int

    @property
    def key(self) -> str:
        return f"{self.source.run}/{self.town}/{self.trajectory}"

    @property
    def folder(self) -> Path:
        return self.source.data / self.town / self.trajectory / self.variant

    def is_chosen(self, choice: TrackChoice) -> bool:
        return choice.names(f"{self.town}/{self.trajectory}/{self.variant}") and (
            len(choice.tracks) == len(TRACKS) or track_of(self.folder) in choice.tracks
        )

    def sample_id(self, caption: Caption) -> str:
        return caption.sample_id if self.flight_id is None else sample_id(self.flight_id, caption.frame_index)

    def whole_frames(self, views: Sequence[View]) -> set[int]:
        """Return the frames that have the files of all views; without views, those of the flight's record."""
        if not views:
            return set(range(self.num_frames))
        found = set()
        for folder in (self.folder / frame_name(0)).parent.glob("frame_*"):
            if folder.name[6:].isdigit() and all(frame_path(folder, VIEW_FILES[view]).is_file() for view in views):
                found.add(int(folder.name[6:]))
        return found


class Flights:
    """The flights of several trees by their names in captions, each read when it is first asked for."""

    def __init__(self, sources: Sequence[RunSource]) -> None:
        self._ids = _ids_of(sources) if len(sources) > 1 else None
        self._found: dict[tuple[str, str, str, str], CaptionedFlight] = {}
        self._courses: list[Course] = []

    def of(self, source: RunSource, caption: Caption) -> CaptionedFlight:
        """Find the flight of a caption."""
        names = (caption.town, caption.trajectory, caption.variant)
        key = (source.run, *names)
        if key not in self._found:
            if bad := [name for name in names if name != Path(name).name or name in ("", ".", "..")]:
                raise InputError(
                    "a name in the caption is not a folder name",
                    where=f"{source.captions}: {caption.sample_id}",
                    got=bad[0],
                )
            self._found[key] = self._read(source, inside(source.data, "/".join(names), in_parent=True))
        return self._found[key]

    def _read(self, source: RunSource, folder: Path) -> CaptionedFlight:
        town, trajectory, variant = folder.parts[-3:]  # the tree may have been converted since
        flight_id, size_px, num_frames = None, None, 0
        if (folder / "trajectory.json").exists():
            flight = read_track(folder, strict=False)
            name = f"{source.run}/{town}/{trajectory}"
            self._courses.append(Course(name, town, flight.time_s, flight.walked_m).at_seconds())
            size_px, num_frames = (flight.camera.width_px, flight.camera.height_px), len(flight)
        if self._ids is not None:
            flight_id = self._ids.get(Place(source.run, town, trajectory, variant))
        return CaptionedFlight(source, town, trajectory, variant, flight_id, size_px, num_frames)

    def walks(self) -> dict[str, str]:
        """Tell the walks of the flights that were read since this was last asked, by key; what tells them is let go."""
        courses, self._courses = self._courses, []
        return walks_of(courses)


def _ids_of(sources: Sequence[RunSource]) -> dict[Place, str]:
    places = [
        Place(source.run, *folder.relative_to(source.data).parts[-3:])
        for source in sources
        for folder in find_tracks(source.data)
    ]
    return flight_ids(places)
