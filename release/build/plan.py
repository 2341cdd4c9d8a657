"""Choose the tracks of a release, their frames, splits and shards: before any is written, so that neither the number of
workers nor a kill changes it."""

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from cosfly.formats.frames import DEPTH_PNG, FILE_NAMES, frame_name, frame_path
from cosfly.formats.inspection import how_to_decide
from cosfly.formats.places import TrackChoice, TrackName
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.geometry.splits import Course, walks_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError, NothingKept
from cosfly.runtime.io import CHECKSUMS, checksum_lines, read_checksums
from cosfly.runtime.run_dir import StageFolder, Tally
from release.build.captions import CaptionAccount, FlightKey, TrackCaptions, index_captions
from release.build.config import ReleaseConfig
from release.build.sources import IN_REVIEW, NOT_CHOSEN, Candidate, Material, Source, choose_licence, gather, maps_of
from release.columns import SPLIT_NAMES, Placement, SplitName
from release.record import ReleasedMap
from release.rules import group_by_size, select_frames, split_flights

UNPLACED = Placement(walk="", split="train")  # before the splits are assigned
NO_TWIN = "its other track is not released"  # why a track is dropped


@dataclass(frozen=True)
class Chosen:
    """A track that is released."""

    candidate: Candidate
    track: TrackName
    size_px: tuple[int, int]  # width, height
    captions: TrackCaptions
    selected: tuple[int, ...] = ()  # its released frames
    num_bytes: int = 0  # of the files of these
    placement: Placement = UNPLACED

    @property
    def name(self) -> str:
        return self.candidate.name

    @property
    def trajectory(self) -> str:
        return self.candidate.trajectory

    @property
    def num_frames(self) -> int:
        return self.captions.num_frames

    @property
    def captioned(self) -> list[int]:
        """Its released frames that have a caption."""
        return [i for i in self.selected if i in self.captions.spans]


@dataclass(frozen=True)
class PlannedShard:
    """A shard to write."""

    name: str  # of its file while the release is being built, the same for the same tracks of the same sizes
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
    """Read all of the material but the pictures, and decide what is released where; InputError or VerifyError if it
    cannot be released."""
    material = gather(sources, include_review=cfg.include_review, choice=TrackChoice(match=cfg.flights))
    tracks, walks, dropped = survey_tracks(material.candidates, sources, cfg.tracks)
    tracks, left_out = keep_pairs(tracks, cfg)
    dropped = dropped + left_out
    _check_sizes(tracks)
    account = _index_captions(sources, material, tracks)
    if not tracks:
        raise _no_track(sources, material, dropped, stage)
    tracks = place_tracks([_with_size(track, cfg, account.window_frames) for track in tracks], walks, cfg)
    maps = maps_of([track.candidate for track in tracks])
    licence = choose_licence(cfg.licence, [(town_map.town, town_map.licence) for town_map in maps])
    return ReleasePlan(tracks, shards_of(tracks, cfg.shard_bytes), account, material, dropped, maps, licence)


# --- tracks -----------------------------------------------------------------------------------------------------------


def survey_tracks(
    candidates: list[Candidate], sources: list[Source], tracks: tuple[TrackName, ...]
) -> tuple[list[Chosen], dict[str, str], Counter[str]]:
    """Read the tracks that no inspection drops; return those of the kinds `tracks`, trajectory -> walk, and the counts
    of the others by reason."""
    chosen: list[Chosen] = []
    dropped = Counter(candidate.dropped for candidate in candidates if candidate.dropped is not None)
    remaining = [candidate for candidate in candidates if candidate.dropped is None]

    def courses() -> Iterator[Course]:
        """Yield the pedestrian's course of each track, and note in passing whether the track is chosen."""
        with progress_bar("release: tracks read", total=len(remaining)) as advance:
            for candidate in remaining:
                advance(1)
                track = open_track(candidate)
                kind: TrackName = "clean" if track.is_original else "perturbed"
                if kind not in tracks:
                    dropped[f"track {kind} not wanted"] += 1
                    continue
                captions = TrackCaptions(sources[candidate.source].captions, len(track))
                chosen.append(Chosen(candidate, kind, (track.camera.width_px, track.camera.height_px), captions))
                positions_m = track.targets_m - track.perturbation.target_m
                yield Course(candidate.trajectory, candidate.place.town, track.time_s, positions_m)

    walks = walks_of(courses())
    return chosen, walks, dropped


def digest_of_pictures(folder: Path) -> bytes | None:
    """Return a digest of the colour pictures of a track, None if the track has no checksums."""
    if not (folder / CHECKSUMS).exists():
        return None
    pictures = {name: digest for name, digest in read_checksums(folder).items() if name.endswith(FILE_NAMES["rgb"])}
    return hashlib.sha256(checksum_lines(pictures).encode()).digest() if pictures else None


def open_track(candidate: Candidate) -> Track:
    """Read a track under its name in the release; trees of cosfly must fit our own format, others the public one."""
    track = read_track(candidate.folder)
    if track.is_ours and track.issues:
        raise track.issues[0]
    return replace(track, run=candidate.place.run, given_id=candidate.flight_id)


def keep_pairs(tracks: list[Chosen], cfg: ReleaseConfig) -> tuple[list[Chosen], Counter[str]]:
    """Drop tracks whose other track is not released, unless `pairs` is `any` or only one kind of track is released,
    and trajectories with the pictures of another one; return the others, and why how many are dropped."""
    groups = defaultdict[str, list[Chosen]](list)
    for track in tracks:
        groups[track.trajectory].append(track)
    for group in groups.values():
        kinds, lengths = {track.track for track in group}, {track.num_frames for track in group}
        if len(kinds) < len(group) or len(lengths) > 1:
            raise InputError(
                "the tracks of a trajectory are not a pair", where=group[0].candidate.folder.parent,
                got=", ".join(f"{track.track} {track.num_frames} frames" for track in group),
                expected="one clean and one perturbed track of the same length",
            )  # fmt: skip
    num_needed = 1 if cfg.pairs == "any" else len(cfg.tracks)
    complete = [group for group in groups.values() if len(group) >= num_needed]
    kept, seen = list[Chosen](), set[tuple[bytes | None, ...]]()
    for group in complete:
        digests = tuple(digest_of_pictures(track.candidate.folder) for track in group)
        if digests not in seen or None in digests:  # runs of one seed have trajectories in common
            seen.add(digests)
            kept += group
    num_complete = sum(map(len, complete))
    counts = Counter({NO_TWIN: len(tracks) - num_complete, "copy of another track": num_complete - len(kept)})
    return kept, +counts  # without a count of 0


def _check_sizes(tracks: list[Chosen]) -> None:
    """Check that all tracks have pictures of one size."""
    groups = defaultdict[str, list[str]](list)
    for track in tracks:
        groups["{} x {} px".format(*track.size_px)].append(track.name)
    if len(groups) > 1:
        got = "; ".join(f"{size}: {len(names)} tracks, such as {names[0]}" for size, names in sorted(groups.items()))
        what, expected = "the tracks differ in the size of pictures", "one size in all tracks of a release"
        raise InputError(what, got=got, expected=expected)


def _index_captions(sources: list[Source], material: Material, tracks: list[Chosen]) -> CaptionAccount:
    """Find the captions of each track, and return an account of all."""
    total = CaptionAccount()
    for number, source in enumerate(sources):
        released = dict[FlightKey, TrackCaptions]()
        for track in tracks:
            key = track.candidate.key
            if track.candidate.source != number:
                continue
            if key in released:
                what, fix = "the track occurs in several runs below this directory", "build a release of each run"
                raise InputError(what, where=source.captions, got="/".join(key), fix=fix)
            released[key] = track.captions
        unreleased = {one.key for one in material.candidates if one.source == number} - released.keys()
        index_captions(source.captions, released, unreleased, total)
    return total


def _no_track(sources: list[Source], material: Material, dropped: Counter[str], stage: StageFolder) -> NothingKept:
    """Return the error that no track is left, and what to do: most often a person has to decide."""
    tally = Tally(input=len(material.candidates), dropped=dropped)
    waiting = [sources[one.source] for one in material.candidates if (one.dropped or "").startswith(IN_REVIEW)]
    if dropped[NOT_CHOSEN] == len(material.candidates):
        return stage.nothing_kept(tally, expected="a track that release.flights names", fix="change --flights")
    fix = "choose other tracks with release.tracks, release.pairs or release.flights"
    if dropped[NO_TWIN]:
        fix = "release single tracks too with --set release.pairs=any, or choose others with release.tracks"
    inspected = next((source.inspect.parent for source in [*waiting, *sources] if source.inspect), None)
    if inspected is None:
        return stage.nothing_kept(tally, expected="a track", fix=fix)
    fix = f"fix what {inspected / 'report.html'} lists and inspect again, or {fix}"
    if waiting:
        again = "then run the same command again; or release them without a decision with another --out and"
        fix = f"{how_to_decide(inspected)}; {again} --set release.include_review=true"
    return stage.nothing_kept(tally, expected="a track that the inspection accepted", where=inspected, fix=fix)


# --- splits and shards ------------------------------------------------------------------------------------------------


def _with_size(track: Chosen, cfg: ReleaseConfig, window_frames: int) -> Chosen:
    """Return a track with its selected frames and the bytes of their files, depth unpacked."""
    num_bytes = 0
    selected = tuple(select_frames(track.num_frames, cfg.num_frames, cfg.selection, window_frames).tolist())
    for i in selected:
        for file in cfg.modalities:
            path = frame_path(track.candidate.folder / frame_name(i), FILE_NAMES[file])
            size = path.stat().st_size if path.exists() else 0
            if not size:
                fix = "render the track again, or reject it in the review"
                raise InputError("a file of the frame is missing or empty", where=path, fix=fix)
            num_bytes += 4 * math.prod(track.size_px) if path.name == DEPTH_PNG else size  # it is stored as float32
    return replace(track, selected=selected, num_bytes=num_bytes)


def place_tracks(tracks: list[Chosen], walks: dict[str, str], cfg: ReleaseConfig) -> list[Chosen]:
    """Assign whole walks, or whole towns, to splits, and name the other track of each."""
    towns = {track.name: (walks[track.trajectory], track.candidate.place.town) for track in tracks}
    splits = split_flights(towns, cfg.split_by, cfg.fractions, cfg.split_seed)
    groups = defaultdict[str, list[str]](list)
    for track in tracks:
        groups[track.trajectory].append(track.name)
    placed = []
    for track in tracks:
        pair = next((name for name in groups[track.trajectory] if name != track.name), None)
        placement = Placement(walk=walks[track.trajectory], split=splits[track.name], pair=pair)
        placed.append(replace(track, placement=placement))
    return placed


def shards_of(tracks: list[Chosen], target_bytes: int) -> list[PlannedShard]:
    """Return the shards split by split, each of whole trajectories with their tracks next to each other."""
    shards: list[PlannedShard] = []
    for split in SPLIT_NAMES:
        trajectories = defaultdict[str, list[Chosen]](list)
        for track in tracks:
            if track.placement.split == split:
                trajectories[track.trajectory].append(track)
        groups = list(trajectories.values())
        sizes = [sum(track.num_bytes for track in group) for group in groups]
        for number, indices in enumerate(group_by_size(sizes, target_bytes)):
            members = [track for index in indices for track in groups[index]]
            lines = [f"{track.name} {track.placement} {len(track.selected)} {track.num_bytes}\n" for track in members]
            digest = hashlib.sha256("".join(lines).encode()).hexdigest()[:12]
            shards.append(PlannedShard(f"{split}-{number:05d}-{digest}", split, members))
    return shards
