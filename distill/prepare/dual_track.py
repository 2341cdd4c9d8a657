"""`cosfly distill dual-track`: windows over both tracks, to learn denoising and prediction from (app:dual_track).

Needs neither captions nor torch. Memory grows by the flights' courses, not by their windows.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from cosfly.formats.places import Place, flight_ids, place_of, sample_id
from cosfly.formats.playback import ORIGINAL, Track, read_track
from cosfly.formats.predictions import Split
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.geometry.axes import step_s
from cosfly.geometry.splits import SPLITS, Course, walks_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, Record, read_model, validated, write_model
from cosfly.runtime.run_dir import Failed, Resume, StageFolder, Tally, fingerprint, write_failures
from cosfly.runtime.tables import rows_of
from distill.prepare.sources import check_names, run_of
from distill.prepare.splitting import SplitConfig, check_no_leak
from distill.schema import PAGE, SourceTree, SplitFiles, SplitMember, columns_of, page_of, split_path, tree_inputs

STAGE = "distill.dual_track"
RECORD, RECORD_FORMAT = "tracks.json", FileFormat("cosfly.track_windows", "1.0", "set of windows")
AXES = "right-handed: metres, x east, y north, z up; degrees, yaw counter-clockwise from east, pitch nose-up"
NO_TWIN, OTHER_FRAMES, SHORT = "no_clean_flight", "clean_flight_of_other_frames", "shorter_than_a_window"
UNEVEN = "uneven_steps"
STEP_TOLERANCE_S = 1e-3

Vector = tuple[float, float, float]


class TrackSample(SplitMember):
    """One window: what was seen on the perturbed track, where drone and person really were, and where they went.

    *_position_m, *_rotation_deg: the camera's x, y, z and pitch, yaw, roll. *_target_m: the person's hip point, or
    None. `window` are the observed frames; `sample_id` is that of a caption of the same frames.
    """

    future: tuple[int, ...]  # of the frames to predict
    time_s: tuple[float, ...]  # of both
    states: tuple[str | None, ...]  # of the observed frames: STATES of cosfly/formats/playback.py
    observed_position_m: tuple[Vector, ...]  # perturbed: what a model is given
    observed_rotation_deg: tuple[Vector, ...]
    observed_target_m: tuple[Vector | None, ...]
    clean_position_m: tuple[Vector, ...]  # of the same frames: the target of denoising
    clean_rotation_deg: tuple[Vector, ...]
    clean_target_m: tuple[Vector | None, ...]
    future_position_m: tuple[Vector, ...]  # the target of prediction
    future_rotation_deg: tuple[Vector, ...]
    future_target_m: tuple[Vector | None, ...]


COLUMNS = columns_of(TrackSample)


class TrackSet(Record):
    """`tracks.json`. samples: windows of each split; observed, predicted, stride: of a window, in frames."""

    split_by: Literal["walk", "town"]
    observed: int
    predicted: int
    stride: int
    axes: str = AXES
    trees: list[SourceTree]
    samples: dict[Split, int]


def _page_of(record: TrackSet) -> bytes:
    runs = json.dumps([tree.run for tree in record.trees], ensure_ascii=False)
    return page_of(
        "Windows over two tracks", record.samples,
        f"Windows of {record.observed} frames of a perturbed track (`observed_*`), with the unperturbed poses of\n"
        f"drone and target in them (`clean_*`) and in the {record.predicted} frames after them (`future_*`);\n"
        f"a window begins every {record.stride} frames. No two splits share a {record.split_by}.\n"
        f"Axes: {record.axes}.\n"
        f"The pictures are the frames `window` of the playback trees of {runs}, which are not included.\n",
    )  # fmt: skip


def read_track_set(dataset: Path) -> TrackSet:
    """Read the record of a set of windows."""
    return read_model(dataset / RECORD, TrackSet, RECORD_FORMAT, tree=dataset)


def read_track_samples(dataset: Path, split: Split) -> Iterator[TrackSample]:
    """Yield the windows of a split, a row group in memory; none where it has none."""
    if not read_track_set(dataset).samples.get(split):
        return
    path = split_path(dataset, split)
    for number, row in enumerate(rows_of(path, COLUMNS.names, tree=dataset)):
        yield validated(TrackSample, row, f"{path}: row {number}")


class DualTrackConfig(SplitConfig):
    """Settings of `distill dual-track`; defaults of tab:augmentation_params."""

    observed: int = Field(5, ge=1, le=1000, description="number of perturbed frames that a model observes")
    predicted: int = Field(5, ge=0, le=1000, description="number of frames after them to predict; 0: only denoising")
    stride: int = Field(3, ge=1, le=1000, description="number of frames between the starts of two windows")

    @property
    def length(self) -> int:
        """Frames of a window and its future."""
        return self.observed + self.predicted


@dataclass(frozen=True)
class _PairedFlight:
    """A perturbed flight that gives windows: where it stands, and its id among all flights."""

    folder: Path
    place: Place
    flight_id: str

    @property
    def key(self) -> str:
        return f"{self.place.run}/{self.place.town}/{self.place.trajectory}"


def run(cfg: DualTrackConfig, trees: Sequence[Path], out: Path, *, seed: int = 0, resume: Resume = "if-same") -> Path:
    """Read playback trees; write windows by split into `out`, which is returned.

    Of each perturbed flight with its clean one beside it, N frames, that is (N - length) // stride + 1 windows. Flights
    that cannot be read are failures, which stop no others.

    Raises:
        NothingKept: no flight gives a window. InputError: two trees are of one run, or there are too few walks.
    """
    check_names([run_of(tree) for tree in trees])
    runs = {run_of(tree): tree for tree in trees}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=tree_inputs(runs), seed=seed, resume=resume)
    if stage.is_complete:
        return out
    # Two passes: the splits must be known before the first window is written.
    paired, courses, tally = _survey(stage, cfg, runs)
    walks = walks_of(courses)
    fix = "add trajectories, set a fraction to 0, or --set distill.dual_track.too_few=fill"
    owners = cfg.assigned({flight.key for flight in paired}, walks, seed, "pairs of tracks", fix)
    with SplitFiles(out, COLUMNS).writing() as files:
        facts = _write(files, cfg, paired, walks, {key: split for key, (_, split) in owners.items()})
    record = TrackSet(
        **cfg.model_dump(include={"split_by", "observed", "predicted", "stride"}),
        trees=[SourceTree(run=name, sha256=fingerprint(tree)) for name, tree in runs.items()],
        samples=files.counts,
    )
    write_model(out / RECORD, record, RECORD_FORMAT)
    write_bytes(out / PAGE, _page_of(record))
    check_no_leak({split: read_track_samples(out, split) for split in SPLITS}, cfg.split_by)
    stage.finish([*files.paths, out / RECORD, out / PAGE], tally, split_by=cfg.split_by, **facts)
    return out


def _survey(
    stage: StageFolder, cfg: DualTrackConfig, runs: Mapping[str, Path]
) -> tuple[list[_PairedFlight], list[Course], Tally]:
    """Find the perturbed flights that give windows, the walks' courses, and what becomes of the others."""
    folders = [(folder, place_of(folder, run)) for run, tree in runs.items() for folder in find_tracks(tree)]
    ids = flight_ids([place for _, place in folders])
    paired: list[_PairedFlight] = []
    courses: list[Course] = []
    dropped: Counter[str] = Counter()
    failures: list[Failed] = []
    with progress_bar(f"{STAGE}: reading", total=len(folders)) as advance:
        for folder, place in folders:
            advance(1)
            found = _PairedFlight(folder, place, ids[place])
            try:
                pair = None if folder.name == ORIGINAL else _read_pair(folder, cfg)
            except InputError as error:
                failures.append(Failed(id=f"{found.key}/{place.variant}", code=error.code, message=str(error)))
                continue
            if isinstance(pair, str):
                dropped[pair] += 1
            elif pair is not None:
                paired.append(found)
                courses.append(Course(found.key, place.town, pair[1].time_s, pair[1].walked_m).at_seconds())
    write_failures(stage.path / "failures.jsonl", failures)
    failed = Counter(failure.code for failure in failures)
    tally = Tally(input=len(paired) + dropped.total() + len(failures), kept=len(paired), dropped=dropped, failed=failed)
    if not paired:
        raise stage.nothing_kept(tally, expected=f"a perturbed track of {cfg.length} frames with its clean track")
    return paired, courses, tally


def _read_pair(folder: Path, cfg: DualTrackConfig) -> tuple[Track, Track] | str | None:
    """Read a perturbed flight and its clean one; None for a clean flight, a word for why there are no windows."""
    flight = read_track(folder, strict=False)
    if flight.is_original:
        return None
    try:
        twin = read_twin(flight)
    except VerifyError:
        return OTHER_FRAMES
    if twin is None:
        return NO_TWIN
    return (flight, twin) if windows_of(len(flight), cfg) else SHORT


def windows_of(num_frames: int, cfg: DualTrackConfig) -> range:
    """Return the first frames of the windows of a flight."""
    return range(0, num_frames - cfg.length + 1, cfg.stride)


def _write(
    files: SplitFiles,
    cfg: DualTrackConfig,
    paired: Sequence[_PairedFlight],
    walks: Mapping[str, str],
    split_of: Mapping[str, Split],
) -> dict[str, Any]:
    """Write the windows; gives the facts of the manifest: of each split, and how many windows were left out."""
    flights, left_out = Counter[Split](), 0
    states: dict[Split, Counter[str]] = {split: Counter() for split in SPLITS}
    with progress_bar(f"{STAGE}: writing", total=len(paired)) as advance:
        for found in paired:
            advance(1)
            pair = _read_pair(found.folder, cfg)
            assert isinstance(pair, tuple), "the flight was changed while it was read"
            split = split_of[found.key]
            flights[split] += 1
            for sample in samples_of(found, *pair, walks[found.key], cfg):
                if sample is None:
                    left_out += 1
                    continue
                files.add(split, sample.model_dump(mode="json"))
                states[split].update(map(str, sample.states))
    of_walks = Counter(split for _, split in {(walks[found.key], split_of[found.key]) for found in paired})
    facts = {
        split: {
            "samples": files.counts[split],
            "flights": flights[split],
            "walks": of_walks[split],
            "observed_frames": dict(sorted(states[split].items())),
        }
        for split in SPLITS
    }
    return {"splits": facts, "windows_left_out": {UNEVEN: left_out}}


def samples_of(
    found: _PairedFlight, flight: Track, twin: Track, walk: str, cfg: DualTrackConfig
) -> Iterator[TrackSample | None]:
    """Cut a pair of flights into windows; None for one whose frames are not evenly apart in time."""
    step, place = step_s(flight.time_s), found.place
    for first in windows_of(len(flight), cfg):
        now = first + cfg.observed
        time_s = flight.time_s[first : first + cfg.length]
        if len(time_s) > 1 and np.abs(np.diff(time_s) - step).max() > STEP_TOLERANCE_S:
            yield None
            continue
        seen, after = slice(first, now), slice(now, first + cfg.length)
        vectors: dict[str, Any] = {}
        for part, track, rows in (("observed", flight, seen), ("clean", twin, seen), ("future", twin, after)):
            vectors[f"{part}_position_m"] = _vectors(track.positions_m[rows])
            vectors[f"{part}_rotation_deg"] = _vectors(track.rotations_deg[rows])
            vectors[f"{part}_target_m"] = _vectors(track.targets_m[rows])
        yield TrackSample(
            sample_id=sample_id(found.flight_id, now - 1),
            **{name: getattr(place, name) for name in ("run", "town", "trajectory", "variant")},
            walk=walk,
            window=tuple(range(first, now)),
            future=tuple(range(now, first + cfg.length)),
            time_s=tuple(time_s.tolist()),
            states=tuple(flight.states[seen]),
            **vectors,
        )


def _vectors(rows: np.ndarray) -> tuple[Any, ...]:
    """Return vectors (k, 3), those of nobody as None."""
    return tuple(None if np.isnan(row).any() else tuple(row.tolist()) for row in rows + 0.0)
