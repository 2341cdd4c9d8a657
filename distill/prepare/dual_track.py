"""`cosfly distill dual-track`: windows over both tracks, to learn denoising and prediction from (app:dual_track).

Needs neither captions nor torch.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.places import Place, flight_ids, place_of, sample_id
from cosfly.formats.playback import ORIGINAL, Track
from cosfly.formats.playback_file import read_track
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

    *_position_m, *_rotation_deg: x, y, z and pitch, yaw, roll of the camera. *_target_m: the target's hip, or None.
    `window` holds the observed frames; `sample_id` is that of a caption of the same frames.
    """

    future: tuple[int, ...]  # frames to predict
    time_s: tuple[float, ...]  # of both
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
    """The two tracks of one trajectory, of the same frames."""

    perturbed: Track
    clean: Track


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
    are failures and do not stop the others.

    Raises:
        NothingKept: no track gives a window.
        InputError: two trees are of one run.
    """
    check_names([run_of(tree) for tree in trees])
    runs = {run_of(tree): tree for tree in trees}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=tree_inputs(runs.values()), seed=seed)
    if stage.is_complete:
        return out
    folders = {place_of(folder, run): folder for run, tree in runs.items() for folder in find_tracks(tree)}
    ids = flight_ids(folders)
    pairs, failures, tally = _read_pairs(folders, cfg)
    write_failures(out / "failures.jsonl", failures)
    if not pairs:
        raise stage.nothing_kept(tally, expected=f"a perturbed track of {cfg.length} frames with its clean track")
    keys = {place: track_key(place) for place in pairs}
    walks = walks_of(Course(keys[at], at.town, clean.time_s, clean.walked_m) for at, (_, clean) in pairs.items())
    split_of = cfg.assigned(walks, walks, seed)
    walk_of = {place: walks[key] for place, key in keys.items()}
    places = {split: [place for place in pairs if split_of[keys[place]] == split] for split in SPLITS}
    samples = {
        split: chain.from_iterable(samples_of(place, ids[place], pairs[place], walk_of[place], cfg) for place in part)
        for split, part in places.items()
    }
    counts, paths = write_splits(out, TrackSample, samples)
    sources = [SourceTree(run=name, sha256=fingerprint(tree)) for name, tree in runs.items()]
    page = write_page(out, "Windows over two tracks", counts, sources, PAGE_TEXT.format(cfg=cfg))
    facts = {
        split: {"samples": counts[split], "tracks": len(part), "walks": len({walk_of[place] for place in part})}
        for split, part in places.items()
    }
    num_uneven = sum(len(windows_of(len(pair.clean), cfg)) for pair in pairs.values()) - sum(counts.values())
    stage.finish([*paths, page], tally, splits=facts, windows_left_out={"uneven_steps": num_uneven})
    return out


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


def samples_of(place: Place, flight_id: str, pair: Pair, walk: str, cfg: DualTrackConfig) -> Iterator[TrackSample]:
    """Cut a pair of tracks into windows, without those whose frames are not evenly apart in time."""
    perturbed, clean = pair
    step = step_s(perturbed.time_s)
    for first in windows_of(len(perturbed), cfg):
        now, end = first + cfg.observed, first + cfg.length  # where the observed and the predicted frames end
        time_s = perturbed.time_s[first:end]
        if len(time_s) > 1 and np.abs(np.diff(time_s) - step).max() > STEP_TOLERANCE_S:
            continue
        seen, after = slice(first, now), slice(now, end)
        vectors: dict[str, Any] = {}
        for part, track, rows in (("observed", perturbed, seen), ("clean", clean, seen), ("future", clean, after)):
            vectors[f"{part}_position_m"] = _vectors(track.positions_m[rows])
            vectors[f"{part}_rotation_deg"] = _vectors(track.rotations_deg[rows])
            vectors[f"{part}_target_m"] = _vectors(track.targets_m[rows])
        yield TrackSample(
            sample_id=sample_id(flight_id, now - 1), **asdict(place), walk=walk, window=tuple(range(first, now)),
            future=tuple(range(now, end)), time_s=tuple(time_s.tolist()), states=tuple(perturbed.states[seen]),
            **vectors,
        )  # fmt: skip


def _vectors(rows: np.ndarray) -> tuple[Any, ...]:
    """Return vectors (k, 3) as tuples, those with NaN as None."""
    return tuple(None if np.isnan(row).any() else tuple(row.tolist()) for row in rows + 0.0)  # no negative zeros
