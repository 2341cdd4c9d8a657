"""Whence a training set comes: runs with their playback trees and captions, and the flights that the captions are of."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cosfly.errors import InputError, VerifyError
from cosfly.look.frame_views import VIEW_FILES, View
from cosfly.products.actions import OWN_ACTIONS
from cosfly.products.captions import Caption
from cosfly.products.flights import find_flights, track_of
from cosfly.products.frames import frame_name, frame_path
from cosfly.products.places import TRACKS, FlightChoice, Place, flight_ids, folder_name, sample_id
from cosfly.products.playback import read_flight
from cosfly.products.splits import Course, walks_of
from cosfly.reading.files import check_stays_below
from cosfly.work.provenance import was_made_of
from cosfly.work.store import inside

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Source:
    """One run's part of a training set: its name, playback tree and captions."""

    run: str
    data: Path
    captions: Path

    @classmethod
    def of_run(cls, folder: Path) -> Source:
        """Take a run folder as `cosfly run` makes it.

        Raises:
            InputError: it is none.
        """
        if not (folder / "render").is_dir():
            raise InputError(
                "not a run folder", where=folder, expected="a folder with render/ and caption/",
                fix="give --data and --captions where they stand elsewhere",
            )  # fmt: skip
        captions = folder / "caption/captions.jsonl"
        check_stays_below(captions, captions.parent)
        return cls.of_files(folder / "render", captions)

    @classmethod
    def of_files(cls, data: Path, captions: Path) -> Source:
        """Name a run by the folder that its tree stands in."""
        return cls(folder_name(data.absolute().parent.name), data, captions)


def inputs_of(sources: Sequence[Source]) -> dict[str, Path]:
    """Name what a stage reads: `data`, `captions`, `actions` where the captions are of a set of their own; of several runs with the run's number in front."""
    return {
        f"{number}.{name}" if len(sources) > 1 else name: path
        for number, source in enumerate(sources, 1)
        for name, path in (
            ("data", source.data), ("captions", source.captions), ("actions", source.captions.with_name(OWN_ACTIONS)),
        )
        if name != "actions" or path.is_file()
    }  # fmt: skip


def check_sources(sources: Sequence[Source], unbound: Literal["refuse", "accept"]) -> None:
    """Check that runs can be told apart, and that their captions are on record as made of some tree; of which, the stage's folder checks.

    Raises:
        InputError: two runs have one name. VerifyError: captions have no record of their tree.
    """
    name, count = Counter(source.run for source in sources).most_common(1)[0]
    if count > 1:
        raise InputError(
            "two runs have one name", got=f"{count} of {name}", expected="trees in folders of different names",
            fix="rename the folder that one of the trees stands in",
        )  # fmt: skip
    for source in sources:
        if was_made_of(source.captions, "data") is not None:
            continue
        if unbound == "refuse":
            raise VerifyError(
                "no record says of which playback tree these captions were made", where=source.captions,
                got="no stage.json of cosfly caption beside them", expected="the folder that cosfly caption wrote",
                fix="give the captions where they were made; if they are certainly of this tree: --set distill.prepare.unbound=accept",
            )  # fmt: skip
        log.warning("%s: taken for captions of %s, which no record says", source.captions, source.data)


# --- flights ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CaptionedFlight:
    """A flight that captions are of. flight_id: unique among all runs, None for the captions' own. key: of its walk, before these
    are known. size_px: (width, height) of its frames, None where it stands in no tree; num_frames: of them."""

    source: Source
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

    def is_chosen(self, choice: FlightChoice) -> bool:
        """Tell whether a flight is one of those that are chosen."""
        return choice.names(f"{self.town}/{self.trajectory}/{self.variant}") and (
            len(choice.tracks) == len(TRACKS) or track_of(self.folder) in choice.tracks
        )

    def sample_id(self, caption: Caption) -> str:
        return caption.sample_id if self.flight_id is None else sample_id(self.flight_id, caption.frame_index)

    def whole_frames(self, views: Sequence[View]) -> set[int]:
        """Give the frames that have the files of all views; without views, those of the flight's record."""
        if not views:
            return set(range(self.num_frames))
        found = set()
        for folder in (self.folder / frame_name(0)).parent.glob("frame_*"):
            if folder.name[6:].isdigit() and all(frame_path(folder, VIEW_FILES[view]).is_file() for view in views):
                found.add(int(folder.name[6:]))
        return found


class Flights:
    """The flights of several trees by their names in captions, each read when it is first asked for."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._ids = _ids_of(sources) if len(sources) > 1 else None
        self._found: dict[tuple[str, str, str, str], CaptionedFlight] = {}
        self._courses: list[Course] = []

    def of(self, source: Source, caption: Caption) -> CaptionedFlight:
        """Find the flight of a caption.

        Raises:
            InputError: a name is none of a folder, or the flight cannot be read.
        """
        names = (caption.town, caption.trajectory, caption.variant)
        key = (source.run, *names)
        if key not in self._found:
            for name in names:
                if name != Path(name).name or name in ("", ".", ".."):
                    raise InputError("not a folder name", where=f"{source.captions}: {caption.sample_id}", got=name)
            self._found[key] = self._read(source, inside(source.data, "/".join(names), beside=True))
        return self._found[key]

    def _read(self, source: Source, folder: Path) -> CaptionedFlight:
        town, trajectory, variant = folder.parts[-3:]  # the tree may have been converted since
        flight_id, size_px, num_frames = None, None, 0
        if (folder / "trajectory.json").exists():
            flight = read_flight(folder, strict=False)
            name = f"{source.run}/{town}/{trajectory}"
            self._courses.append(Course(name, town, flight.time_s, flight.walked_m).at_seconds())
            size_px, num_frames = (flight.camera.width_px, flight.camera.height_px), len(flight)
        if self._ids is not None:
            flight_id = self._ids.get(Place(source.run, town, trajectory, variant))
        return CaptionedFlight(source, town, trajectory, variant, flight_id, size_px, num_frames)

    def walks(self) -> dict[str, str]:
        """Tell the walks of the flights that were read since this was last asked, by their keys; what tells them is let go."""
        courses, self._courses = self._courses, []
        return walks_of(courses)


def _ids_of(sources: Sequence[Source]) -> dict[Place, str]:
    places = [
        Place(source.run, *folder.relative_to(source.data).parts[-3:])
        for source in sources
        for folder in find_flights(source.data)
    ]
    return flight_ids(places)
