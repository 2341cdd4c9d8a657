"""The sources of a release: the runs it is made of, their tracks with their names, their maps and the licence."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from cosfly.formats.boxes import UNKNOWN_LICENCE
from cosfly.formats.inspection import REVIEW, Inspection, TrajectoryFunnel, read_settled
from cosfly.formats.places import ALL_TRACKS, Place, TrackChoice, flight_ids, folder_name
from cosfly.formats.town import IDS_FILE, read_town_map
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import check_stays_below, inside, sha256_file
from release.build.captions import FlightKey
from release.record import ReleasedMap

log = logging.getLogger(__name__)

IN_REVIEW = "review: "  # begin of the reason to drop a track that waits for a person's decision
NOT_CHOSEN = "not chosen"  # the reason to drop a track that `release.flights` does not name


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
        """Return the source of a run directory, the output of `cosfly run`."""
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
        """Return the source of these files; the run has the name of the folder that contains its tree."""
        return cls(folder_name(data.absolute().parent.name), data, captions, inspect)


def with_unique_names(sources: list[Source]) -> list[Source]:
    """Return the sources with different names, because rows and records know a run by its name alone.

    Two trees in one folder get the names of the trees too (`run_render`); two trees of equal names in folders of equal
    names get the name of the folder above (`above_run`).
    """
    own_names = [source.run for source in sources]
    names = list(own_names)
    for with_more in (lambda data, run: f"{run}_{data.name}", lambda data, run: f"{data.parents[1].name}_{run}"):
        counts = Counter(names)
        names = [
            folder_name(with_more(source.data.absolute(), run)) if counts[name] > 1 else name
            for source, run, name in zip(sources, own_names, names, strict=True)
        ]
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(
            "several runs have the same name", got=f"{count} runs with the name {name}",
            expected="trees with different names, or in folders with different names",
            fix="rename one of the trees, or the folder that contains it",
        )  # fmt: skip
    return [replace(source, run=name) for source, name in zip(sources, names, strict=True)]


def input_names(sources: list[Source]) -> list[dict[str, str]]:
    """Return for each source role -> name among the stage's inputs, with a number in front if there are several."""
    return [
        {role: f"{number}.{role}" if len(sources) > 1 else role for role in source.files}
        for number, source in enumerate(sources, 1)
    ]


@dataclass(frozen=True)
class Candidate:
    """A track of a source."""

    source: int  # number of the source
    place: Place
    folder: Path
    flight_id: str = ""  # with which its sample ids begin
    dropped: str | None = None  # why it is not released, as `result: reason` of the inspection; None if it may be
    sha256: str | None = None  # of its files as they were inspected, None without an inspection
    five_ray_mean: float | None = None  # as it was inspected

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
    """All tracks of the sources."""

    candidates: list[Candidate]
    num_inspected: int  # those of sources with an inspection
    trajectories: TrajectoryFunnel | None  # the sum of the inspections


def gather(sources: list[Source], *, include_review: bool, choice: TrackChoice = ALL_TRACKS) -> Material:
    """List the tracks of the runs with the results of their inspections; those that are not chosen are dropped."""
    results = ("accepted", "review") if include_review else ("accepted",)
    candidates: list[Candidate] = []
    inspections: list[Inspection] = []
    for number, source in enumerate(sources):
        if source.inspect is None:
            for folder in find_tracks(source.data):
                inner = folder.relative_to(source.data)
                dropped = None if choice.names(inner.as_posix()) else NOT_CHOSEN
                candidates.append(Candidate(number, _place(source, inner), folder, dropped=dropped))
        else:
            inspection = read_settled(source.inspect)
            inspections.append(inspection)
            candidates += _inspected(number, source, inspection, results, choice)
    # Dropped tracks make no id longer: `release verify` knows only the released ones.
    ids = flight_ids([candidate.place for candidate in candidates])
    ids |= flight_ids([candidate.place for candidate in candidates if candidate.dropped is None])
    candidates = [replace(candidate, flight_id=ids[candidate.place]) for candidate in candidates]
    num_inspected = sum(len(inspection.flights) for inspection in inspections)
    return Material(candidates, num_inspected, _funnel_of(inspections))


def _inspected(
    number: int, source: Source, inspection: Inspection, results: Collection[str], choice: TrackChoice
) -> Iterator[Candidate]:
    """Yield the tracks of an inspection; those with other results than `results` and those not chosen are dropped."""
    for track in inspection.flights:
        dropped = None if track.result in results else f"{track.result}: {track.reason}"
        if not choice.names(track.folder):
            dropped = NOT_CHOSEN
        inner = Path(track.folder)
        if inner.parts[-2:] not in ((track.trajectory, track.variant), (track.variant,)):
            raise InputError(
                "the record of a track has the folder of another track", where=source.inspect, got=track.folder,
                expected=f"a folder that ends in {track.trajectory}/{track.variant}", fix="run cosfly inspect again",
            )  # fmt: skip
        folder = inside(source.data, track.folder, in_parent=True)
        yield Candidate(
            number, _place(source, inner), folder, dropped=dropped, sha256=track.sha256,
            five_ray_mean=track.metrics.get("five_ray_mean"),
        )  # fmt: skip


def _funnel_of(inspections: list[Inspection]) -> TrajectoryFunnel | None:
    """Return the sum of the funnels of trajectories, None without an inspection."""
    counts, reasons = Counter[str](), Counter[str]()
    for funnel in (inspection.funnel.trajectories for inspection in inspections):
        counts.update(funnel.model_dump(exclude={"dropped"}))
        reasons.update(funnel.dropped)
    return TrajectoryFunnel(dropped=dict(sorted(reasons.items())), **counts) if inspections else None


def maps_of(candidates: list[Candidate]) -> list[ReleasedMap]:
    """Return the maps of the towns of tracks, each once; warn of different maps of one name."""
    towns = {(track.place.town, track.folder.parent.parent) for track in candidates}
    maps_of_town = Counter(town for town, _ in {(town, _digest_of_map(folder)) for town, folder in towns})
    for town in sorted(town for town, count in maps_of_town.items() if count > 1):
        words = "release: %d different maps are named %s and count as one town; give each a name (maps.synthetic.name)"
        log.warning(words, maps_of_town[town], town)
    maps = {ReleasedMap(town=town, **dict(read_town_map(folder))) for town, folder in towns}
    return sorted(maps, key=lambda town_map: (town_map.town, town_map.name, town_map.licence, town_map.credits))


def _digest_of_map(town: Path) -> str:
    """Return a digest of the boxes of a town's map; "" for a foreign tree."""
    return sha256_file(town / IDS_FILE) if (town / IDS_FILE).exists() else ""


def _place(source: Source, folder: Path) -> Place:
    """Return the place of a track by its folder in the tree; folders above the town are part of the run's name."""
    town, trajectory, variant = ("", "", *folder.parts)[-3:]
    return Place("_".join((source.run, *folder.parts[:-3])), town, trajectory, variant)


def choose_licence(licence: str | None, maps: list[tuple[str, str]]) -> str:
    """Return the licence of the data set: the given one, or else that of all its maps, given by town and licence."""
    of_maps = [map_licence for _, map_licence in maps]
    chosen = licence or of_maps[0]
    if chosen == UNKNOWN_LICENCE or (licence is None and len({*of_maps}) > 1):
        raise ConfigError(
            "the maps state no licence, or different ones", where="release.licence",
            got=", ".join(f"{town}: {map_licence}" for town, map_licence in maps),
            expected="a licence identifier of the Hugging Face Hub",
            fix="pass --set release.licence=LICENCE, such as cc-by-4.0, or that of the map, such as maps.boxes.licence",
        )  # fmt: skip
    return chosen
