"""What is released and which flights stand in which shard. Decided before any is written, so that neither workers nor a
kill change it."""

from __future__ import annotations

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cosfly.formats.frames import DEPTH_PNG, FILE_NAMES, frame_name, frame_path
from cosfly.formats.inspection import how_to_decide
from cosfly.formats.places import TrackChoice
from cosfly.runtime.errors import CosflyError, InputError, NothingKept, VerifyError
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, write_failures
from release.build.captions import CaptionAccount, FlightCaptions, FlightKey, index_captions
from release.build.config import ReleaseConfig
from release.build.shards import FlightPart
from release.build.sources import IN_REVIEW, Material, Source, choose_licence, gather, maps_of
from release.build.survey import NO_TWIN, Surveyed, Tell, check_alike, keep_pairs, place_flights, survey
from release.columns import SPLIT_NAMES, Placement, SplitName
from release.record import ReleasedMap
from release.rules import select_frames

NUM_NAMED = 10  # things that are wrong, in a message; failures.jsonl has all


class Faults:
    """Takes what is wrong, and refuses to go on."""

    def __init__(self, stage: StageFolder) -> None:
        self._stage, self.failures = stage, list[Failed]()

    def tell(self, item_id: str, error: CosflyError) -> None:
        self.failures.append(Failed(id=item_id, code=error.code, message=str(error)))

    def check(self) -> None:
        """Refuse to go on if anything is wrong.

        Raises:
            InputError, VerifyError: names the first; `failures.jsonl` has all.
        """
        if not self.failures:
            return
        path = self._stage.path / "failures.jsonl"
        write_failures(path, self.failures)
        listed = [failure.message for failure in self.failures[:NUM_NAMED]]
        more = f" | and {len(self.failures) - NUM_NAMED} more, see {path}" if len(self.failures) > NUM_NAMED else ""
        kind = VerifyError if all(failure.code == VerifyError.code for failure in self.failures) else InputError
        problems = "1 problem" if len(self.failures) == 1 else f"{len(self.failures)} problems"
        raise kind(
            f"nothing is released, because the inputs have {problems}", where=self._stage.path,
            got=" | ".join(listed) + more,
            fix="fix these problems or exclude the tracks, then run the same command again; finished shards are kept",
        )  # fmt: skip


@dataclass(frozen=True)
class PlannedShard:
    """A shard to write. name: of its part, the same for the same flights of the same sizes."""

    name: str
    split: SplitName
    parts: list[FlightPart]
    num_frames: int


def plan_shards(sizes: Sequence[int], target_bytes: int) -> list[list[int]]:
    """Group consecutive trajectories: a shard is closed as soon as it reaches the target."""
    groups: list[list[int]] = []
    total = 0
    for index, size in enumerate(sizes):
        if not groups or total >= target_bytes:
            groups.append([])
            total = 0
        groups[-1].append(index)
        total += size
    return groups


def selected_bytes(flight: Surveyed, cfg: ReleaseConfig, window_frames: int, tell: Tell) -> tuple[int, int]:
    """Count a flight's selected frames and the bytes of their files, depth unpacked; `tell` takes files that are not
    there."""
    folder, total = flight.candidate.folder, 0
    selected = select_frames(flight.num_frames, cfg.num_frames, cfg.selection, window_frames).tolist()
    for i in selected:
        for file in cfg.modalities:
            path = frame_path(folder / frame_name(i), FILE_NAMES[file])
            size = _size(path)
            total += 4 * math.prod(flight.size_px) if size and path.name == DEPTH_PNG else size
            if not size:
                tell(
                    flight.name,
                    InputError("a file of the frame is missing or empty", where=path, fix="render the track again"),
                )
    return len(selected), total


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def shards_of(
    flights: list[tuple[Surveyed, FlightCaptions, int, int]], placements: dict[str, Placement], target_bytes: int
) -> list[PlannedShard]:
    """Return the shards in the order of the release: split by split, and in each whole trajectories, both tracks of one
    next to each other.

    Args:
        flights: each with its captions, number of selected frames, and their bytes.
    """
    shards: list[PlannedShard] = []
    for split in SPLIT_NAMES:
        trajectories = defaultdict[str, list[tuple[Surveyed, FlightCaptions, int, int]]](list)
        for entry in flights:
            if placements[entry[0].name].split == split:
                trajectories[entry[0].candidate.trajectory].append(entry)
        own = list(trajectories.values())
        sizes = [sum(entry[3] for entry in tracks) for tracks in own]
        for number, group in enumerate(plan_shards(sizes, target_bytes)):
            members = [entry for index in group for entry in own[index]]
            parts = [FlightPart(f.candidate, placements[f.name], captions) for f, captions, *_ in members]
            named = "".join(f"{f.name} {placements[f.name]} {frames} {size}\n" for f, _, frames, size in members)
            name = f"{split}-{number:05d}-{hashlib.sha256(named.encode()).hexdigest()[:12]}"
            shards.append(PlannedShard(name, split, parts, sum(entry[2] for entry in members)))
    return shards


# --- the material ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReleasePlan:
    """All that is decided before the first byte is written."""

    flights: list[tuple[Surveyed, FlightCaptions, int, int]]
    placements: dict[str, Placement]
    shards: list[PlannedShard]
    account: CaptionAccount
    material: Material
    left_out: Counter[str]
    window_frames: int
    maps: list[ReleasedMap]
    licence: str


def make_plan(cfg: ReleaseConfig, sources: list[Source], stage: StageFolder) -> ReleasePlan:
    """Look at all of the material, and decide what goes where."""
    faults = Faults(stage)
    choice, accepts = TrackChoice(match=cfg.flights), cfg.unbound == "accept"
    material = gather(sources, include_review=cfg.include_review, accept_unbound=accepts, choice=choice)
    flights, walks, left_out = survey(material.candidates, cfg.tracks, faults.tell)
    flights, without_twin = keep_pairs(flights, cfg.pairs, cfg.tracks, faults.tell)
    left_out = left_out + without_twin
    check_alike(flights, faults.tell)
    captions, account = _index(sources, material, flights, faults)
    faults.check()
    if not flights:
        raise _no_flight(sources, material, left_out, stage)
    sized = [
        (flight, captions[flight.name], *selected_bytes(flight, cfg, account.window_frames, faults.tell))
        for flight in flights
    ]
    faults.check()
    placements = place_flights(flights, walks, cfg.split_by, cfg.fractions, cfg.split_seed)
    maps = maps_of([flight.candidate for flight in flights])
    return ReleasePlan(
        flights=sized, placements=placements, shards=shards_of(sized, placements, cfg.shard_bytes), account=account,
        material=material, left_out=left_out, window_frames=account.window_frames, maps=maps,
        licence=choose_licence(cfg.licence, [(one.town, one.licence) for one in maps]),
    )  # fmt: skip


def _no_flight(sources: list[Source], material: Material, left_out: Counter[str], stage: StageFolder) -> NothingKept:
    """Say that no flight is left, and what to do: most often a person has to decide."""
    tally = Tally(input=len(material.candidates), dropped=left_out)
    waiting = [one.source for one in material.candidates if (one.left_out or "").startswith(IN_REVIEW)]
    inspected = next((s.inspect for s in [*(sources[k] for k in waiting), *sources] if s.inspect), None)
    choose = "choose other tracks with release.tracks, release.pairs or release.flights"
    if left_out[NO_TWIN]:
        choose = "release single tracks too with --set release.pairs=any, or choose others with release.tracks"
    if inspected is None:
        return stage.nothing_kept(tally, expected="a flight", fix=choose)
    folder = inspected.parent
    if waiting:
        again = "then run the same command again; or release them without a decision with another --out and"
        fix = f"{how_to_decide(folder)}; {again} --set release.include_review=true"
    else:
        fix = f"fix what {folder / 'report.html'} lists and inspect again, or {choose}"
    return stage.nothing_kept(tally, expected="a track that the inspection accepted", where=folder, fix=fix)


def _index(
    sources: list[Source], material: Material, flights: list[Surveyed], faults: Faults
) -> tuple[dict[str, FlightCaptions], CaptionAccount]:
    """Find the captions of each flight, by its name."""
    total, found = CaptionAccount(), dict[str, FlightCaptions]()
    for number, source in enumerate(sources):
        own = _by_key([flight for flight in flights if flight.candidate.source == number])
        others: set[FlightKey] = {one.key for one in material.candidates if one.source == number} - own.keys()
        lengths = {key: min(flight.num_frames for flight in group) for key, group in own.items()}
        captions, account = index_captions(source.captions, lengths, others, faults.tell)
        for key, of_flight in captions.items():
            if len(own[key]) > 1 and of_flight.spans:
                names = ", ".join(flight.name for flight in own[key])
                what = "the captions fit several tracks"
                faults.tell(
                    names, InputError(what, where=source.captions, got=names, fix="release their trees separately")
                )
            found |= {flight.name: of_flight for flight in own[key]}
        total = total + account
    return found, total


def _by_key(flights: list[Surveyed]) -> dict[FlightKey, list[Surveyed]]:
    """Group flights by what their captions call them: of a tree with several towns of one name more than one."""
    groups: dict[FlightKey, list[Surveyed]] = defaultdict(list)
    for flight in flights:
        groups[flight.candidate.key].append(flight)
    return groups
