"""What goes into a release: the runs it is made of, their flights, maps, licence and captions, and what each flight is called."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cosfly.errors import ConfigError, InputError
from cosfly.products.boxes import UNKNOWN_LICENCE
from cosfly.products.inspection import FlightInspection, Inspection, TrajectoryFunnel, read_inspection
from cosfly.products.places import Place, flight_ids, folder_name, stand, town_folder
from cosfly.products.town import read_town_map
from cosfly.provenance import fingerprint, warn_unbound, was_made_of
from cosfly.reading.files import check_stays_below
from release.columns import ReleasedCaption
from release.package.captions import ByFlight, load_captions
from release.record import ReleasedMap

Track = Literal["clean", "perturbed"]


@dataclass(frozen=True)
class Source:
    """One run's part of a release: its name, playback tree, captions and inspection."""

    run: str
    data: Path
    captions: Path
    inspect: Path

    @classmethod
    def of_run(cls, folder: Path) -> Source:
        """Take a run folder as `cosfly run` makes it.

        Raises:
            InputError: it is none.
        """
        if not (folder / "render").is_dir():
            raise InputError(
                "not a run folder", where=folder, expected="a folder with render/, caption/ and inspect/",
                fix="give --data, --captions and --inspect where they stand elsewhere",
            )  # fmt: skip
        captions, inspected = folder / "caption/captions.jsonl", folder / "inspect/inspect.json"
        for product in (captions, inspected):
            check_stays_below(product, product.parent)
        return cls.of_files(folder / "render", captions, inspected)

    @classmethod
    def of_files(cls, data: Path, captions: Path, inspect: Path) -> Source:
        """Name a run by the folder that its tree stands in."""
        return cls(folder_name(data.absolute().parent.name), data, captions, inspect)


@dataclass(frozen=True)
class Chosen:
    """A flight to release: where it stands, what it is called, and its captions by frame.

    sha256: of its files as they were inspected; None where the inspection does not say, or saw the tree in its older form.
    """

    place: Place
    folder: Path
    sha256: str | None
    flight_id: str
    captions: dict[int, ReleasedCaption]

    @property
    def name(self) -> str:
        """Its name in the release's records."""
        return "/".join((self.place.run, self.place.town, self.place.trajectory, self.place.variant))


@dataclass(frozen=True)
class Material:
    """All that a release is made of, and the account of what is left out."""

    chosen: list[Chosen]
    left_out: dict[str, int]
    inspected: int
    trajectories: TrajectoryFunnel
    captions: list[ByFlight]
    dropped: Counter[str]
    maps: list[ReleasedMap]


def gather(sources: list[Source], tracks: tuple[Track, ...], *, include_review: bool) -> Material:
    """Read inspections, captions and maps of the runs, and choose their flights.

    Raises:
        InputError: a file cannot be read, or two flights cannot be told apart.
    """
    inspections = [read_inspection(source.inspect) for source in sources]
    wanted = ("accepted", "review") if include_review else ("accepted",)
    places = [[_place(source, f) for f in one.flights] for source, one in zip(sources, inspections, strict=True)]
    ids = flight_ids([place for group in places for place in group])
    chosen, by_source, maps = list[Chosen](), list[ByFlight](), list[ReleasedMap]()
    left_out, dropped = Counter[str](), Counter[str]()
    for source, inspection, group in zip(sources, inspections, places, strict=True):
        warn_unbound([source.captions, source.inspect])
        saw_older = was_made_of(source.inspect, "data") not in (None, fingerprint(source.data))
        captions, dropped_here = load_captions(source.captions)
        by_source.append(captions)
        dropped += dropped_here
        for flight, place in zip(inspection.flights, group, strict=True):
            if flight.result not in wanted:
                left_out[f"{flight.result}: {flight.reason}"] += 1
            elif flight.track not in tracks:
                left_out[f"track {flight.track} not wanted"] += 1
            else:
                folder = stand(source.data, flight.folder)
                own = captions.get((town_folder(flight.town), flight.trajectory, flight.variant), {})
                sha256 = None if saw_older else flight.sha256
                chosen.append(Chosen(place, folder, sha256, ids[place], own))
                shown = ReleasedMap(town=place.town, **dict(read_town_map(folder.parent.parent)))
                if shown not in maps:
                    maps.append(shown)
    return Material(
        chosen,
        dict(sorted(left_out.items())),
        sum(len(inspection.flights) for inspection in inspections),
        _sum_of(inspections),
        by_source,
        dropped,
        sorted(maps, key=lambda shown: (shown.town, shown.name)),
    )


def _place(source: Source, flight: FlightInspection) -> Place:
    """Tell a flight's place from where it stands now: its tree may have been converted since the inspection.

    Folders above the town, in a tree of several, count as part of the run's name.

    Raises:
        InputError: the record of one flight has the folder of another.
    """
    parts = Path(flight.folder).parts[-2:]
    if parts != (flight.trajectory, flight.variant)[2 - len(parts) :]:
        raise InputError(
            "the record of one flight has the folder of another", where=source.inspect, got=flight.folder,
            expected=f"a folder that ends in {flight.trajectory}/{flight.variant}", fix="run cosfly inspect again",
        )  # fmt: skip
    town = stand(source.data, flight.folder).parent.parent.name
    return Place("_".join((source.run, *Path(flight.folder).parts[:-3])), town, flight.trajectory, flight.variant)


def _sum_of(inspections: list[Inspection]) -> TrajectoryFunnel:
    funnels = [inspection.funnel.trajectories for inspection in inspections]
    counts = {
        name: sum(getattr(funnel, name) for funnel in funnels)
        for name in TrajectoryFunnel.model_fields
        if name != "dropped"
    }
    dropped = sum((Counter(funnel.dropped) for funnel in funnels), Counter[str]())
    return TrajectoryFunnel(dropped=dict(sorted(dropped.items())), **counts)


def choose_licence(licence: str | None, maps: list[tuple[str, str]]) -> str:
    """Give the licence of the data set: `licence` where it is given, else that of the maps, of each its name and licence.

    Raises:
        ConfigError: it is not given, and the maps' are unknown or differ.
    """
    chosen = licence or maps[0][1]
    if chosen == UNKNOWN_LICENCE or (licence is None and len({one for _, one in maps}) > 1):
        raise ConfigError(
            "nobody says under which licence this may be released", where="release.licence",
            got=", ".join(f"{name}: {one}" for name, one in maps),
            expected="a licence identifier as the hub spells it", fix="--set release.licence=... (cc-by-4.0, apache-2.0, ...)",
        )  # fmt: skip
    return chosen
