"""Which tracks are released and which shard holds them: decided before any is written, so that neither the number of
workers nor a kill changes it."""

from __future__ import annotations

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from cosfly.formats.frames import DEPTH_PNG, FILE_NAMES, FRAMES_DIR, frame_name, frame_path
from cosfly.formats.inspection import how_to_decide
from cosfly.formats.places import TrackChoice, TrackName
from cosfly.formats.playback import Track, read_track
from cosfly.geometry.splits import Course, walks_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError, NothingKept
from cosfly.runtime.run_dir import StageFolder, Tally, write_failures
from release.build.captions import CaptionAccount, FlightKey, TrackCaptions, index_captions
from release.build.config import ReleaseConfig
from release.build.problems import Problems
from release.build.sources import IN_REVIEW, NOT_CHOSEN, Candidate, Material, Source, choose_licence, gather, maps_of
from release.columns import SPLIT_NAMES, Placement, SplitName
from release.record import ReleasedMap
from release.rules import select_frames, split_flights

UNPLACED = Placement(walk="", split="train")  # before the splits are assigned
NO_TWIN = "its other track is not released"  # why a track is dropped


@dataclass(frozen=True)
class Chosen:
    """A track that is released. size_px: Width, height. selected: Its released frames; num_bytes: Of their files."""

    candidate: Candidate
    track: TrackName
    num_frames: int
    size_px: tuple[int, int]
    captions: TrackCaptions
    selected: tuple[int, ...] = ()
    num_bytes: int = 0
    placement: Placement = UNPLACED

    @property
    def name(self) -> str:
        return self.candidate.name

    @property
    def trajectory(self) -> str:
        return self.candidate.trajectory

    @property
    def captioned(self) -> list[int]:
        """Its released frames that have a caption."""
        return [i for i in self.selected if i in self.captions.spans]


@dataclass(frozen=True)
class PlannedShard:
    """A shard to write. name: Of its part, the same for the same tracks of the same sizes."""

    name: str
    split: SplitName
    tracks: list[Chosen]


@dataclass(frozen=True)
class ReleasePlan:
    """All that is decided before the first byte is written."""

    tracks: list[Chosen]
    shards: list[PlannedShard]
    account: CaptionAccount
    material: Material
    dropped: Counter[str]
    maps: list[ReleasedMap]
    licence: str


def make_plan(cfg: ReleaseConfig, sources: list[Source], stage: StageFolder) -> ReleasePlan:
    """Read all of the material but the pictures, and decide what is released where.

    Raises:
        InputError, VerifyError: Names the first problems; `failures.jsonl` has all.
    """
    problems = Problems()
    choice, accepts = TrackChoice(match=cfg.flights), cfg.unbound == "accept"
    material = gather(sources, include_review=cfg.include_review, accept_unbound=accepts, choice=choice)
    tracks, walks, dropped = survey_tracks(material.candidates, sources, cfg.tracks, problems)
    tracks, without_twin = keep_pairs(tracks, cfg, problems)
    dropped = dropped + without_twin
    _check_sizes(tracks, problems)
    account = _index_captions(sources, material, tracks, problems)
    report_problems(problems, stage)
    if not tracks:
        raise _no_track(sources, material, dropped, stage)
    tracks = [_with_size(track, cfg, account.window_frames, problems) for track in tracks]
    report_problems(problems, stage)
    tracks = place_tracks(tracks, walks, cfg)
    maps = maps_of([track.candidate for track in tracks])
    licence = choose_licence(cfg.licence, [(one.town, one.licence) for one in maps])
    return ReleasePlan(tracks, shards_of(tracks, cfg.shard_bytes), account, material, dropped, maps, licence)


def report_problems(problems: Problems, stage: StageFolder) -> None:
    """Write `failures.jsonl` and refuse the release if there are problems."""
    path = stage.path / "failures.jsonl"
    if problems.failures:
        write_failures(path, problems.failures)
    problems.raise_any(
        "nothing is released, because the inputs have {}", f", see {path}", where=stage.path,
        fix="fix these problems or exclude the tracks, then run the same command again; finished shards are kept",
    )  # fmt: skip


# --- tracks -----------------------------------------------------------------------------------------------------------


def survey_tracks(
    candidates: list[Candidate], sources: list[Source], tracks: tuple[TrackName, ...], problems: Problems
) -> tuple[list[Chosen], dict[str, str], Counter[str]]:
    """Read the tracks that no inspection drops.

    Returns:
        Those of the wanted kinds; trajectory -> walk; why others are dropped.
    """
    found: list[Chosen] = []
    dropped = Counter(one.dropped for one in candidates if one.dropped is not None)
    wanted = [one for one in candidates if one.dropped is None]

    def courses() -> Iterator[Course]:
        with progress_bar("release: flights read", total=len(wanted)) as advance:
            for one in wanted:
                advance(1)
                with problems.collected(one.name):
                    track = open_track(one)
                    _check_frames(track)
                    kind: TrackName = "clean" if track.is_original else "perturbed"
                    if kind not in tracks:
                        dropped[f"track {kind} not wanted"] += 1
                        continue
                    size_px = (track.camera.width_px, track.camera.height_px)
                    captions = TrackCaptions(sources[one.source].captions)
                    found.append(Chosen(one, kind, len(track), size_px, captions))
                    planned_m = track.targets_m - track.perturbation.target_m
                    yield Course(one.trajectory, one.place.town, track.time_s, planned_m)

    walks = walks_of(courses())
    return found, walks, dropped


def open_track(candidate: Candidate) -> Track:
    """Read a track under the name that it has in the release: trees of cosfly strictly, those of others as far as the
    public layout demands."""
    track = read_track(candidate.folder, strict=False)
    if track.is_ours and track.issues:
        track = read_track(candidate.folder)  # raises the issue
    return replace(track, run=candidate.place.run, given_id=candidate.flight_id)


def _check_frames(track: Track) -> None:
    """Check that a track has a folder of pictures for each point."""
    assert track.folder is not None
    folder = track.folder / FRAMES_DIR
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    missing = [i for i in range(len(track)) if frame_name(i).rpartition("/")[2] not in names]
    if missing:
        raise InputError(
            "frames are missing", where=folder, got=f"{len(missing)} of {len(track)}, the first {missing[0]}",
            expected="a folder for each point of trajectory.json",
            fix="render the track again, or reject it in the review",
        )  # fmt: skip


def keep_pairs(tracks: list[Chosen], cfg: ReleaseConfig, problems: Problems) -> tuple[list[Chosen], Counter[str]]:
    """Drop tracks whose other track is not released, unless `pairs` is `any` or one kind of track is wanted.

    Args:
        tracks: Those that every other filter keeps.
    Returns:
        The others, and the number of dropped ones.
    """
    groups = defaultdict[str, list[Chosen]](list)
    for track in tracks:
        groups[track.trajectory].append(track)
    for group in groups.values():
        got = ", ".join(f"{one.track} {one.num_frames} frames" for one in group)
        if len({one.track for one in group}) < len(group):
            what, expected = "a trajectory has two clean or two perturbed tracks", "one track of each kind"
            problems.add(group[0].name, InputError(what, where=group[0].candidate.folder, got=got, expected=expected))
        if len({one.num_frames for one in group}) > 1:
            problems.add(group[0].name, InputError("the two tracks of a trajectory differ in length", got=got))
    if cfg.pairs == "any" or len(cfg.tracks) < 2:
        return tracks, Counter()
    kept = [track for track in tracks if len(groups[track.trajectory]) == 2]
    return kept, +Counter({NO_TWIN: len(tracks) - len(kept)})


def _check_sizes(tracks: list[Chosen], problems: Problems) -> None:
    """Check that all tracks have pictures of one size."""
    groups = defaultdict[str, list[str]](list)
    for track in tracks:
        groups["{} x {} px".format(*track.size_px)].append(track.name)
    if len(groups) > 1:
        got = "; ".join(f"{size}: {len(names)} tracks, such as {names[0]}" for size, names in sorted(groups.items()))
        what, expected = "the tracks differ in the size of pictures", "one size for all tracks of a release"
        problems.add(min(groups.values(), key=len)[0], InputError(what, got=got, expected=expected))


def _index_captions(
    sources: list[Source], material: Material, tracks: list[Chosen], problems: Problems
) -> CaptionAccount:
    """Find the captions of each track, and return an account of all."""
    total = CaptionAccount()
    for number, source in enumerate(sources):
        own = defaultdict[FlightKey, list[Chosen]](list)  # with several towns of one name, a key has several tracks
        for track in tracks:
            if track.candidate.source == number:
                own[track.candidate.key].append(track)
        others = {one.key for one in material.candidates if one.source == number} - own.keys()
        lengths = {key: min(track.num_frames for track in group) for key, group in own.items()}
        found = {key: group[0].captions for key, group in own.items()}
        index_captions(source.captions, found, lengths, others, total, problems)
        for group in own.values():
            if len(group) > 1 and group[0].captions.spans:
                names = ", ".join(track.name for track in group)
                fix = "release their trees separately"
                error = InputError("the captions fit several tracks", where=source.captions, got=names, fix=fix)
                problems.add(names, error)
    return total


def _no_track(sources: list[Source], material: Material, dropped: Counter[str], stage: StageFolder) -> NothingKept:
    """Return the error that no track is left, and what to do: most often a person has to decide."""
    tally = Tally(input=len(material.candidates), dropped=dropped)
    waiting = [one.source for one in material.candidates if (one.dropped or "").startswith(IN_REVIEW)]
    if dropped[NOT_CHOSEN] == len(material.candidates):
        return stage.nothing_kept(tally, expected="a track that release.flights names", fix="change --flights")
    inspected = next((s.inspect for s in [*(sources[k] for k in waiting), *sources] if s.inspect), None)
    choose = "choose other tracks with release.tracks, release.pairs or release.flights"
    if dropped[NO_TWIN]:
        choose = "release single tracks too with --set release.pairs=any, or choose others with release.tracks"
    if inspected is None:
        return stage.nothing_kept(tally, expected="a flight", fix=choose)
    folder = inspected.parent
    fix = f"fix what {folder / 'report.html'} lists and inspect again, or {choose}"
    if waiting:
        again = "then run the same command again; or release them without a decision with another --out and"
        fix = f"{how_to_decide(folder)}; {again} --set release.include_review=true"
    return stage.nothing_kept(tally, expected="a track that the inspection accepted", where=folder, fix=fix)


# --- splits and shards ------------------------------------------------------------------------------------------------


def _with_size(track: Chosen, cfg: ReleaseConfig, window_frames: int, problems: Problems) -> Chosen:
    """Return a track with its selected frames and the bytes of their files, depth unpacked."""
    total = 0
    selected = tuple(select_frames(track.num_frames, cfg.num_frames, cfg.selection, window_frames).tolist())
    for i in selected:
        for file in cfg.modalities:
            path = frame_path(track.candidate.folder / frame_name(i), FILE_NAMES[file])
            size = path.stat().st_size if path.exists() else 0
            total += 4 * math.prod(track.size_px) if size and path.name == DEPTH_PNG else size
            if not size:
                error = InputError("a file of the frame is missing or empty", where=path, fix="render the track again")
                problems.add(track.name, error)
    return replace(track, selected=selected, num_bytes=total)


def place_tracks(tracks: list[Chosen], walks: dict[str, str], cfg: ReleaseConfig) -> list[Chosen]:
    """Assign whole walks, or whole towns, to splits, and name the other track of each."""
    towns = {track.name: (walks[track.trajectory], track.candidate.place.town) for track in tracks}
    splits = split_flights(towns, cfg.split_by, cfg.fractions, cfg.split_seed)
    groups = defaultdict[str, list[str]](list)
    for track in tracks:
        groups[track.trajectory].append(track.name)
    pairs = {name: next((other for other in own if other != name), None) for own in groups.values() for name in own}
    return [
        replace(one, placement=Placement(walk=walks[one.trajectory], split=splits[one.name], pair=pairs[one.name]))
        for one in tracks
    ]


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


def shards_of(tracks: list[Chosen], target_bytes: int) -> list[PlannedShard]:
    """Return the shards in the order of the release: split by split, and in each whole trajectories, both tracks of one
    next to each other."""
    shards: list[PlannedShard] = []
    for split in SPLIT_NAMES:
        trajectories = defaultdict[str, list[Chosen]](list)
        for track in tracks:
            if track.placement.split == split:
                trajectories[track.trajectory].append(track)
        own = list(trajectories.values())
        sizes = [sum(track.num_bytes for track in group) for group in own]
        for number, indices in enumerate(plan_shards(sizes, target_bytes)):
            members = [track for index in indices for track in own[index]]
            parts = (f"{one.name} {one.placement} {len(one.selected)} {one.num_bytes}\n" for one in members)
            digest = hashlib.sha256("".join(parts).encode()).hexdigest()[:12]
            shards.append(PlannedShard(f"{split}-{number:05d}-{digest}", split, members))
    return shards
