"""Every flight read once, before anything is written: what it is, what it cannot be, and how flights divide into pairs
and splits."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from cosfly.formats.frames import FRAMES_DIR, frame_name, read_meta
from cosfly.formats.places import TrackName
from cosfly.formats.playback import Track, read_track
from cosfly.geometry.splits import Course, town_family, walks_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from release.build.sources import Candidate
from release.columns import Placement, SplitName
from release.record import Pairs, SplitBy
from release.rules import split_groups

NO_TWIN = "its other track is not released"  # why a track is dropped
MOST_NAMED = 3  # flights of each kind in a message


@dataclass(frozen=True)
class Surveyed:
    """A flight that is released, as far as all of it must be known at once. size_px: width, height; version: of
    `trajectory.json`."""

    candidate: Candidate
    track: TrackName
    num_frames: int
    size_px: tuple[int, int]
    version: str

    @property
    def name(self) -> str:
        return self.candidate.name


Tell = Callable[[str, InputError], None]


def survey(
    candidates: list[Candidate], tracks: tuple[TrackName, ...], tell: Tell
) -> tuple[list[Surveyed], dict[str, str], Counter[str]]:
    """Read the flights that no inspection leaves out.

    Args:
        tell: takes what is wrong with a flight, under its name.
    Returns:
        flights of the wanted tracks; trajectory -> walk; why others are left out.
    """
    found: list[Surveyed] = []
    left_out = Counter(one.left_out for one in candidates if one.left_out is not None)
    wanted = [one for one in candidates if one.left_out is None]

    def courses() -> Iterator[Course]:
        with progress_bar("release: flights read", total=len(wanted)) as advance:
            for candidate in wanted:
                advance(1)
                try:
                    flight = open_flight(candidate)
                    _check_frames(flight)
                except InputError as error:
                    tell(candidate.name, error)
                    continue
                track: TrackName = "clean" if flight.is_original else "perturbed"
                if track not in tracks:
                    left_out[f"track {track} not wanted"] += 1
                    continue
                size_px = (flight.camera.width_px, flight.camera.height_px)
                version = f"{flight.raw.get('schema')} {flight.raw.get('schema_version')}"
                found.append(Surveyed(candidate, track, len(flight), size_px, version))
                yield Course(
                    candidate.trajectory,
                    candidate.place.town,
                    flight.time_s,
                    flight.targets_m - flight.perturbation.target_m,
                )

    walks = walks_of(courses())
    return found, walks, left_out


def open_flight(candidate: Candidate) -> Track:
    """Read a candidate under the name that it has in the release.

    Trees of ours are held to all of it, those of others to what the public layout demands of every reader.

    Raises:
        InputError: it cannot be read.
    """
    flight = read_track(candidate.folder, strict=False)
    if flight.is_ours and flight.issues:
        flight = read_track(candidate.folder)  # says what is wrong
    return replace(flight, run=candidate.place.run, given_id=candidate.flight_id)


def look_of(flight: Track, i: int) -> np.ndarray | None:
    """Return sun and air of a frame, (4,), None where there is no annotation or it does not say."""
    folder = flight.frame_folder(i)
    if not (folder / "meta.json").is_file():
        return None
    meta = read_meta(folder)
    if meta.index != i:
        raise InputError(
            "the annotation belongs to another frame", where=folder / "meta.json", got=f"index {meta.index}"
        )
    return None if meta.look is None else np.array(list(meta.look.model_dump().values()))


def _check_frames(flight: Track) -> None:
    """See that a flight has a picture folder for each point, and for none beside them."""
    assert flight.folder is not None
    folder = flight.folder / FRAMES_DIR
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    missing = [i for i in range(len(flight)) if frame_name(i).rpartition("/")[2] not in names]
    if missing:
        raise InputError(
            "frames are missing", where=folder, got=f"{len(missing)} of {len(flight)}, the first {missing[0]}",
            expected="a folder for each point of trajectory.json",
            fix="render the track again, or reject it in the review",
        )  # fmt: skip


def keep_pairs(
    flights: list[Surveyed], pairs: Pairs, tracks: tuple[TrackName, ...], tell: Tell
) -> tuple[list[Surveyed], Counter[str]]:
    """Drop tracks whose other track is not released, unless `pairs` is `any` or one kind of track is wanted.

    Args:
        flights: Those that every other filter keeps. tell: Takes trajectories whose tracks differ in length.
    Returns:
        The others, and the number of dropped ones.
    """
    groups: dict[str, dict[str, Surveyed]] = defaultdict(dict)
    for flight in flights:
        if flight.track in groups[flight.candidate.trajectory]:
            what, expected = "a trajectory has two clean or two perturbed tracks", "one track of each kind"
            tell(flight.name, InputError(what, where=flight.candidate.folder, got=flight.track, expected=expected))
        groups[flight.candidate.trajectory][flight.track] = flight
    for group in groups.values():
        lengths = {flight.num_frames for flight in group.values()}
        if len(lengths) > 1:
            got = ", ".join(f"{track} {flight.num_frames}" for track, flight in sorted(group.items()))
            tell(
                next(iter(group.values())).name,
                InputError("the two tracks of a trajectory differ in length", got=f"{got} frames"),
            )
    if pairs == "any" or len(tracks) < 2:
        return flights, Counter()
    kept = [flight for flight in flights if len(groups[flight.candidate.trajectory]) == 2]
    num_alone = len(flights) - len(kept)
    return kept, Counter({NO_TWIN: num_alone} if num_alone else {})


def check_alike(flights: list[Surveyed], tell: Tell) -> None:
    """See that all flights have pictures of one size and files of one version; `tell` takes what differs."""
    for what, name in (("size of pictures", "size_px"), ("version of trajectory.json", "version")):
        groups: dict[str, list[str]] = defaultdict(list)
        for flight in flights:
            groups[str(getattr(flight, name))].append(flight.name)
        if len(groups) > 1:
            parts = (
                f"{value}: {len(names)} tracks, such as {', '.join(names[:MOST_NAMED])}"
                for value, names in sorted(groups.items())
            )
            expected = f"the same {what} for all tracks of a release"
            error = InputError(f"the tracks differ in the {what}", got="; ".join(parts), expected=expected)
            tell(min(groups.values(), key=len)[0], error)


def place_flights(
    flights: list[Surveyed], walks: dict[str, str], by: SplitBy, fractions: dict[SplitName, float], seed: int
) -> dict[str, Placement]:
    """Hand out whole walks, or whole towns, to splits: flight -> where it belongs. Too few of them fill train first,
    then validation."""
    group_of = {
        f.name: walks[f.candidate.trajectory] if by == "walk" else town_family(f.candidate.place.town) for f in flights
    }
    splits = split_groups(group_of.values(), fractions, seed, f"{by}s")
    by_track = {(f.candidate.trajectory, f.track): f.name for f in flights}
    other: dict[TrackName, TrackName] = {"clean": "perturbed", "perturbed": "clean"}
    return {
        f.name: Placement(
            walk=walks[f.candidate.trajectory],
            split=splits[group_of[f.name]],
            pair=by_track.get((f.candidate.trajectory, other[f.track])),
        )
        for f in flights
    }
