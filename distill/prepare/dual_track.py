"""`cosfly distill dual-track`: windows over both tracks, to learn denoising and prediction from (app:dual_track).

Needs neither captions nor torch.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.places import Place, flight_ids, place_of, sample_id
from cosfly.formats.playback import ORIGINAL, Track
from cosfly.formats.playback_file import read_track
from cosfly.formats.predictions import Split
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.geometry.axes import step_s
from cosfly.geometry.splits import SPLITS, Course, walks_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.run_dir import Dropped, Failed, StageFolder, Tally, fingerprint, write_failures
from distill.prepare.stage import SplitConfig, check_names, run_of, track_key
from distill.schema import SourceTree, SplitMember, tree_inputs, write_page, write_splits

STAGE = "distill.dual_track"
STEP_TOLERANCE_S = 1e-3  # by which steps within a window may differ from the track's
PAGE_TEXT = """\
Windows of {cfg.observed} frames of a perturbed track (`observed_*`), with the unperturbed poses of drone and target in
them (`clean_*`) and in the {cfg.predicted} frames after them (`future_*`); a window begins every {cfg.stride} frames.
No two splits share a {cfg.split_by}.
Axes: right-handed: metres, x east, y north, z up; degrees, yaw counter-clockwise from east, pitch nose-up."""

Vector = tuple[float, float, float]


class TrackSample(SplitMember):
    """One window: the perturbed track as observed, the clean poses of the same frames, and those of the next frames.

    Positions are x, y, z and rotations pitch, yaw, roll of the camera; a target is the person's hip, or None. `window`
    has the observed frames, and `sample_id` is that of a caption of the same frames.
    """

    future: tuple[int, ...]  # frames to predict
    time_s: tuple[float, ...]  # of the observed frames and those to predict
    states: tuple[str | None, ...]  # of the observed frames: STATES of cosfly/formats/playback.py
    observed_position_m: tuple[Vector, ...]  # perturbed: the input of a model
    observed_rotation_deg: tuple[Vector, ...]
    observed_target_m: tuple[Vector | None, ...]
    clean_position_m: tuple[Vector, ...]  # of the same frames: the target of denoising
    clean_rotation_deg: tuple[Vector, ...]
    clean_target_m: tuple[Vector | None, ...]
    future_position_m: tuple[Vector, ...]  # the target of prediction
    future_rotation_deg: tuple[Vector, ...]
    future_target_m: tuple[Vector | None, ...]


class Pair(NamedTuple):
    """The two tracks of one trajectory, which have the same frames."""

    perturbed: Track
    clean: Track


@dataclass(frozen=True)
class PlacedPair:
    """A pair with its names."""

    place: Place
    flight_id: str  # with which sample ids begin
    walk: str
    pair: Pair


class DualTrackConfig(SplitConfig):
    """Settings of `distill dual-track`; defaults of tab:augmentation_params."""

    observed: int = Field(5, ge=1, le=1000, description="number of perturbed frames that a model observes")
    predicted: int = Field(5, ge=0, le=1000, description="number of frames after them to predict; 0: only denoising")
    stride: int = Field(3, ge=1, le=1000, description="number of frames between the starts of two windows")

    @property
    def length(self) -> int:
        """Frames of a window and its future."""
        return self.observed + self.predicted


def run(cfg: DualTrackConfig, trees: Sequence[Path], out: Path, *, seed: int = 0) -> Path:
    """Read playback trees; write windows by split into `out`, which is returned.

    A perturbed track of N frames with a clean one gives (N - length) // stride + 1 windows. Tracks that cannot be read
    are failures and do not stop the others. NothingKept: no track gives a window. InputError: two trees are of one run.
    """
    check_names([run_of(tree) for tree in trees])
    runs = {run_of(tree): tree for tree in trees}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=tree_inputs(runs.values()), seed=seed)
    if stage.is_complete:
        return out
    folders = {place_of(folder, run): folder for run, tree in runs.items() for folder in find_tracks(tree)}
    pairs, failures, tally = _read_pairs(folders, cfg)
    write_failures(out / "failures.jsonl", failures)
    if not pairs:
        raise stage.nothing_kept(tally, expected=f"a perturbed track of {cfg.length} frames with its clean track")
    by_split = place_pairs(pairs, flight_ids(folders), cfg, seed)
    samples = {
        split: (sample for placed in in_split for sample in samples_of(placed, cfg))
        for split, in_split in by_split.items()
    }
    counts, paths = write_splits(out, TrackSample, samples)
    sources = [SourceTree(run=name, sha256=fingerprint(tree)) for name, tree in runs.items()]
    page = write_page(out, "Windows over two tracks", counts, sources, PAGE_TEXT.format(cfg=cfg))
    facts = {
        split: {"samples": counts[split], "tracks": len(in_split), "walks": len({placed.walk for placed in in_split})}
        for split, in_split in by_split.items()
    }
    num_windows = sum(len(windows_of(len(pair.clean), cfg)) for pair in pairs.values())
    uneven = {"uneven_steps": num_windows - sum(counts.values())}  # all that `samples_of` skips
    stage.finish([*paths, page], tally, splits=facts, windows_left_out=uneven)
    return out


def place_pairs(
    pairs: Mapping[Place, Pair], ids: Mapping[Place, str], cfg: DualTrackConfig, seed: int
) -> dict[Split, list[PlacedPair]]:
    """Assign the pairs of each pedestrian trajectory, or town, to a split."""
    courses = [Course(track_key(place), place.town, c.time_s, c.walked_m) for place, (_, c) in pairs.items()]
    walks = walks_of(courses)
    split_of = cfg.assigned(walks.keys(), walks, seed)
    by_split: dict[Split, list[PlacedPair]] = {split: [] for split in SPLITS}
    for place, pair in pairs.items():
        key = track_key(place)
        by_split[split_of[key]].append(PlacedPair(place, ids[place], walks[key], pair))
    return by_split


def _read_pairs(folders: Mapping[Place, Path], cfg: DualTrackConfig) -> tuple[dict[Place, Pair], list[Failed], Tally]:
    """Read all perturbed tracks with their clean ones; return the pairs, the failures, and the counts of both."""
    pairs, failures, tally = dict[Place, Pair](), list[Failed](), Tally()
    with progress_bar(f"{STAGE}: reading", total=len(folders)) as advance:
        for place, folder in folders.items():
            advance(1)
            result = _read_pair(place, folder, cfg)
            if isinstance(result, Pair):
                pairs[place] = result
            elif result is not None and (failure := tally.count(result)):
                failures.append(failure)
    tally.kept = len(pairs)
    tally.input = tally.kept + tally.dropped.total() + len(failures)
    return pairs, failures, tally


def _read_pair(place: Place, folder: Path, cfg: DualTrackConfig) -> Pair | Dropped | Failed | None:
    """Read a perturbed track and its clean one; None for a clean track."""
    track_id = f"{track_key(place)}/{place.variant}"
    try:
        track = None if folder.name == ORIGINAL else read_track(folder)
        if track is None or track.is_original:  # a clean track may be in a folder of any name
            return None
        clean = read_twin(track)
    except VerifyError:
        return Dropped(id=track_id, reason="clean_flight_of_other_frames")
    except InputError as error:
        return Failed(id=track_id, code=error.code, message=str(error))
    if clean is None:
        return Dropped(id=track_id, reason="no_clean_flight")
    return Pair(track, clean) if windows_of(len(track), cfg) else Dropped(id=track_id, reason="shorter_than_a_window")


def windows_of(num_frames: int, cfg: DualTrackConfig) -> range:
    """Return the first frames of the windows of a track."""
    return range(0, num_frames - cfg.length + 1, cfg.stride)


def samples_of(placed: PlacedPair, cfg: DualTrackConfig) -> Iterator[TrackSample]:
    """Cut a pair of tracks into windows, without those whose frames are not evenly apart in time."""
    perturbed, clean = placed.pair
    step = step_s(perturbed.time_s)
    for first in windows_of(len(perturbed), cfg):
        observed = range(first, first + cfg.observed)
        future = range(observed.stop, first + cfg.length)
        time_s = perturbed.time_s[first : future.stop]
        if len(time_s) > 1 and np.abs(np.diff(time_s) - step).max() > STEP_TOLERANCE_S:
            continue
        vectors: dict[str, Any] = {}
        parts = (("observed", perturbed, observed), ("clean", clean, observed), ("future", clean, future))
        for part, track, frames in parts:
            rows = slice(frames.start, frames.stop)
            vectors[f"{part}_position_m"] = _vectors(track.positions_m[rows])
            vectors[f"{part}_rotation_deg"] = _vectors(track.rotations_deg[rows])
            vectors[f"{part}_target_m"] = _vectors(track.targets_m[rows])
        yield TrackSample(
            sample_id=sample_id(placed.flight_id, observed[-1]), **asdict(placed.place), walk=placed.walk,
            window=tuple(observed), future=tuple(future), time_s=tuple(time_s.tolist()),
            states=tuple(perturbed.states[first : observed.stop]), **vectors,
        )  # fmt: skip


def _vectors(rows: np.ndarray) -> tuple[Any, ...]:
    """Return vectors (k, 3) as tuples, those with NaN as None."""
    return tuple(None if np.isnan(row).any() else tuple(row.tolist()) for row in rows + 0.0)  # no negative zeros
