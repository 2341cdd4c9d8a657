"""What goes into a release: the runs it is made of, their tracks, maps and licence, and what each track is called."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from cosfly.formats.boxes import UNKNOWN_LICENCE
from cosfly.formats.inspection import REVIEW, Inspection, TrajectoryFunnel, read_settled
from cosfly.formats.places import ALL_TRACKS, Place, TrackChoice, flight_ids, folder_name
from cosfly.formats.town import read_town_map
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import check_stays_below, inside
from release.build.captions import FlightKey
from release.record import ReleasedMap

IN_REVIEW = "review: "  # how the reason begins why a track is dropped that waits for a person
NOT_CHOSEN = "not chosen"  # why a track is dropped that `release.flights` does not name


@dataclass(frozen=True)
class Source:
    """One run's part of a release: its name, playback tree, captions, and inspection where there is one."""

    run: str
    data: Path
    captions: Path
    inspect: Path | None = None

    @property
    def files(self) -> dict[str, Path]:
        """The files by their role."""
        files = {"data": self.data, "captions": self.captions}
        if self.inspect is not None:
            files["inspect"] = self.inspect
            if (decisions := self.inspect.with_name(REVIEW)).exists():
                files["review"] = decisions
        return files

    @classmethod
    def of_run(cls, folder: Path) -> Source:
        """Take a run folder as `cosfly run` makes it."""
        if not (folder / "render").is_dir():
            raise InputError(
                "the folder is not a run directory", where=folder,
                expected="a folder with render/, caption/ and inspect/",
                fix="pass --data, --captions and --inspect if they are in other folders",
            )  # fmt: skip
        captions, inspected = folder / "caption/captions.jsonl", folder / "inspect/inspect.json"
        for product in (captions, inspected):
            check_stays_below(product, product.parent)
        return cls.of_files(folder / "render", captions, inspected)

    @classmethod
    def of_files(cls, data: Path, captions: Path, inspect: Path | None = None) -> Source:
        """Name a run by the folder that contains its tree."""
        return cls(folder_name(data.absolute().parent.name), data, captions, inspect)


def told_apart(sources: list[Source]) -> list[Source]:
    """Add to runs that share a name that of the tree, as for two trees in one folder, or of the folder above, as for
    towns of two runs: rows and records know a run by its name alone."""
    counts = Counter(source.run for source in sources)
    named = [
        replace(one, run=folder_name(f"{one.run}_{one.data.absolute().name}")) if counts[one.run] > 1 else one
        for one in sources
    ]
    counts = Counter(source.run for source in named)
    named = [
        replace(one, run=folder_name(f"{one.data.absolute().parents[1].name}_{given.run}"))
        if counts[one.run] > 1
        else one
        for given, one in zip(sources, named, strict=True)
    ]
    name, count = Counter(source.run for source in named).most_common(1)[0]
    if count > 1:
        raise InputError(
            "several runs have the same name", got=f"{count} runs with the name {name}",
            expected="trees with different names, or in folders with different names",
            fix="rename one of the trees, or the folder that contains it",
        )  # fmt: skip
    return named


def input_names(sources: list[Source]) -> list[dict[str, str]]:
    """Return of each source role -> name among the stage's inputs: of several with a number in front."""
    return [
        {role: f"{number}.{role}" if len(sources) > 1 else role for role in source.files}
        for number, source in enumerate(sources, 1)
    ]


@dataclass(frozen=True)
class Candidate:
    """A track that a source has: where it is stored and what it is called.

    source: Its number. dropped: Why it is not released, `result: reason` of the inspection, else None. sha256: Of its
    files as they were inspected; five_ray_mean: As it was inspected; None without an inspection.
    """

    source: int
    place: Place
    folder: Path
    flight_id: str = ""
    dropped: str | None = None
    sha256: str | None = None
    five_ray_mean: float | None = None

    @property
    def name(self) -> str:
        """Its name in the release's records."""
        return f"{self.trajectory}/{self.place.variant}"

    @property
    def trajectory(self) -> str:
        """What it shares with its other track."""
        return "/".join((self.place.run, self.place.town, self.place.trajectory))

    @property
    def key(self) -> FlightKey:
        """What its captions call it."""
        return self.place.town, self.place.trajectory, self.place.variant


@dataclass(frozen=True)
class Material:
    """All tracks of the sources, and the funnel of their inspections. num_inspected: Of the tracks."""

    candidates: list[Candidate]
    num_inspected: int
    trajectories: TrajectoryFunnel | None


def gather(sources: list[Source], *, include_review: bool, choice: TrackChoice = ALL_TRACKS) -> Material:
    """List the tracks of the runs with the results of their inspections; those that are not chosen are dropped."""
    wanted = ("accepted", "review") if include_review else ("accepted",)
    found: list[Candidate] = []
    inspections: list[Inspection] = []
    for number, source in enumerate(sources):
        if source.inspect is None:
            for folder in find_tracks(source.data):
                inner = folder.relative_to(source.data)
                dropped = None if choice.names(inner.as_posix()) else NOT_CHOSEN
                found.append(Candidate(number, _place(source, inner), folder, dropped=dropped))
            continue
        inspections.append(read_settled(source.inspect))
        for one in inspections[-1].flights:
            dropped = None if one.result in wanted else f"{one.result}: {one.reason}"
            if not choice.names(one.folder):
                dropped = NOT_CHOSEN
            folder, five_ray = inside(source.data, one.folder, in_parent=True), one.metrics.get("five_ray_mean")
            place = _place(source, Path(one.folder))
            if Path(one.folder).parts[-2:] not in ((one.trajectory, one.variant), (one.variant,)):
                raise InputError(
                    "the record of a track has the folder of another track", where=source.inspect, got=one.folder,
                    expected=f"a folder that ends in {one.trajectory}/{one.variant}", fix="run cosfly inspect again",
                )  # fmt: skip
            found.append(Candidate(number, place, folder, "", dropped, one.sha256, five_ray))
    # Dropped tracks make no name longer: `release verify` knows the released ones alone.
    ids = flight_ids([one.place for one in found])
    ids |= flight_ids([one.place for one in found if one.dropped is None])
    candidates = [replace(one, flight_id=ids[one.place]) for one in found]
    return Material(candidates, sum(len(one.flights) for one in inspections), _funnel_of(inspections))


def _funnel_of(inspections: list[Inspection]) -> TrajectoryFunnel | None:
    """Return the sum of the funnels of trajectories, None without an inspection."""
    counts, reasons = Counter[str](), Counter[str]()
    for funnel in (inspection.funnel.trajectories for inspection in inspections):
        counts.update(funnel.model_dump(exclude={"dropped"}))
        reasons.update(funnel.dropped)
    return TrajectoryFunnel(dropped=dict(sorted(reasons.items())), **counts) if inspections else None


def maps_of(candidates: list[Candidate]) -> list[ReleasedMap]:
    """Return the maps that tracks show, each once."""
    towns = {(track.place.town, track.folder.parent.parent) for track in candidates}
    shown = {ReleasedMap(town=town, **dict(read_town_map(folder))) for town, folder in towns}
    return sorted(shown, key=lambda one: (one.town, one.name, one.licence, one.credits))


def _place(source: Source, folder: Path) -> Place:
    """Return the place of a track by its folder in the tree. Folders above the town, in a tree of several, are part of
    the run's name."""
    town, trajectory, variant = ("", "", *folder.parts)[-3:]
    return Place("_".join((source.run, *folder.parts[:-3])), town, trajectory, variant)


def choose_licence(licence: str | None, maps: list[tuple[str, str]]) -> str:
    """Return the licence of the data set: `licence` where it is given, else that of the maps, of each its name and
    licence.
    """
    chosen = licence or maps[0][1]
    if chosen == UNKNOWN_LICENCE or (licence is None and len({one for _, one in maps}) > 1):
        raise ConfigError(
            "the maps state no licence, or different ones", where="release.licence",
            got=", ".join(f"{name}: {one}" for name, one in maps),
            expected="a licence identifier of the Hugging Face Hub",
            fix="pass --set release.licence=LICENCE, such as cc-by-4.0 or apache-2.0",
        )  # fmt: skip
    return chosen
