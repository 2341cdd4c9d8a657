"""`cosfly distill dual-track`: playback trees to windows over both tracks, to learn denoising and prediction from (app:dual_track).

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
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field

from cosfly.errors import InputError, VerifyError
from cosfly.geometry import step_s
from cosfly.products.flights import find_flights, read_twin
from cosfly.products.places import Place, flight_ids, folder_name, place_of, sample_id
from cosfly.products.playback import ORIGINAL, Flight, read_flight
from cosfly.products.splits import SPLITS, Course, Split, assign_splits, town_family, walks_of
from cosfly.reading.documents import read_model, validated
from cosfly.reading.tables import rows_of
from cosfly.work.console import progress_bar
from cosfly.work.provenance import fingerprint
from cosfly.work.stage_folder import Failed, Resume, StageFolder, Tally, write_failures
from cosfly.work.store import write_bytes, write_model
from distill.prepare.splitting import SplitConfig, check_no_leak
from distill.schema import PAGE, SourceTree, SplitFiles, page_of, split_path

RECORD, RECORD_SCHEMA, VERSION = "tracks.json", "cosfly.track_windows", "1.0"
AXES = "right-handed: metres, x east, y north, z up; degrees, yaw counter-clockwise from east, pitch nose-up"

Vector = tuple[float, float, float]


class TrackSample(BaseModel):
    """One window: what was seen on the perturbed track, where drone and person really were then, and where they went.

    *_position_m, *_rotation_deg: the camera's x, y, z and pitch, yaw, roll; *_target_m: the person's hip point, None where nobody is.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    sample_id: str  # as a caption's of the same observed frames
    run: str  # the tree that its flight stands in
    town: str
    trajectory: str
    variant: str  # of the perturbed flight
    walk: str  # whom it follows: windows of one walk are in one split
    window: tuple[int, ...]  # indices of the observed frames, oldest first
    future: tuple[int, ...]  # of the frames to predict
    time_s: tuple[float, ...]  # of both
    states: tuple[str | None, ...]  # of the observed frames: STATES of cosfly/products/playback.py
    observed_position_m: tuple[Vector, ...]  # perturbed: what a model is given
    observed_rotation_deg: tuple[Vector, ...]
    observed_target_m: tuple[Vector | None, ...]
    clean_position_m: tuple[Vector, ...]  # of the same frames: the target of denoising
    clean_rotation_deg: tuple[Vector, ...]
    clean_target_m: tuple[Vector | None, ...]
    future_position_m: tuple[Vector, ...]  # the target of prediction
    future_rotation_deg: tuple[Vector, ...]
    future_target_m: tuple[Vector | None, ...]

    @property
    def key(self) -> str:
        return self.sample_id

    @property
    def language(self) -> str:
        """None: there are no words in it."""
        return ""


_VECTORS = pa.list_(pa.field("element", pa.list_(pa.field("element", pa.float64()))))
COLUMNS = pa.schema([
    *(pa.field(name, pa.string(), nullable=False) for name in ("sample_id", "run", "town", "trajectory", "variant", "walk")),
    *(pa.field(name, pa.list_(pa.field("element", pa.int32())), nullable=False) for name in ("window", "future")),
    pa.field("time_s", pa.list_(pa.field("element", pa.float64())), nullable=False),
    pa.field("states", pa.list_(pa.field("element", pa.string())), nullable=False),
    *(
        pa.field(f"{part}_{what}", _VECTORS, nullable=False)
        for part in ("observed", "clean", "future")
        for what in ("position_m", "rotation_deg", "target_m")
    ),
])  # fmt: skip


class TrackSet(BaseModel):
    """`tracks.json`. samples: windows of each split; observed, predicted, stride: of a window, in frames."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    split_by: Literal["walk", "town"]
    observed: int
    predicted: int
    stride: int
    axes: str = AXES
    trees: list[SourceTree]
    samples: dict[Split, int]


def write_record(out: Path, record: TrackSet) -> list[Path]:
    """Write the record and the page of a set whose splits stand; gives their paths."""
    write_model(out / RECORD, record, schema=RECORD_SCHEMA, version=VERSION)
    text = (
        f"Windows of {record.observed} frames that were observed on a perturbed flight (`observed_*`), where drone and person really were in them\n"
        f"(`clean_*`) and in the {record.predicted} frames after them (`future_*`); a window begins every {record.stride} frames. No two splits share\n"
        f"a {record.split_by}. Axes: {record.axes}. The pictures are frames `window` of the playback trees of\n"
        f"{json.dumps([tree.run for tree in record.trees], ensure_ascii=False)}, which are not part of it.\n"
    )
    write_bytes(out / PAGE, page_of("Windows over two tracks", record.samples, text))
    return [out / RECORD, out / PAGE]


def read_track_set(dataset: Path) -> TrackSet:
    """Read the record of a set of windows.

    Raises:
        InputError: it is missing, of another version, or malformed.
    """
    return read_model(
        dataset / RECORD, TrackSet, schema=RECORD_SCHEMA, version=VERSION, what="set of windows", tree=dataset
    )


def read_track_samples(dataset: Path, split: Split) -> Iterator[TrackSample]:
    """Yield the windows of a split, a row group in memory; none where it has none.

    Raises:
        InputError: names the file, the row and the field.
    """
    if not read_track_set(dataset).samples.get(split):
        return
    path = split_path(dataset, split)
    for number, row in enumerate(rows_of(path, COLUMNS.names, tree=dataset)):
        yield validated(TrackSample, row, f"{path}: row {number}")


STAGE = "distill.dual_track"
NO_TWIN, OTHER_FRAMES, SHORT = "no_clean_flight", "clean_flight_of_other_frames", "shorter_than_a_window"
UNEVEN = "uneven_steps"
STEP_TOLERANCE_S = 1e-3


class DualTrackConfig(SplitConfig):
    """Settings of `distill dual-track`; defaults of tab:augmentation_params."""

    observed: int = Field(5, ge=1, le=1000, description="perturbed frames that a model is given")
    predicted: int = Field(5, ge=0, le=1000, description="frames after them to predict; 0: denoising alone")
    stride: int = Field(3, ge=1, le=1000, description="frames from one window's begin to the next one's")

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
    """Read playback trees; write windows by split (distill/tracks.py) into `out`, which is returned.

    Of each perturbed flight with its clean one beside it, N frames, that is (N - length) // stride + 1 windows. Flights that cannot be
    read are failures, which stop no others.

    Raises:
        NothingKept: no flight gives a window. InputError: two trees are of one run, or there are too few walks to split.
    """
    runs = _runs(trees)
    inputs = {f"{n}.data" if len(trees) > 1 else "data": tree for n, tree in enumerate(trees, 1)}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return out
    # Two passes: the splits must be known before the first window is written.
    paired, courses, tally = _survey(stage, cfg, runs)
    walks = walks_of(courses)
    split_of = _splits(cfg, paired, walks, seed)
    with SplitFiles(out, COLUMNS).writing() as files:
        facts = _write(files, cfg, paired, walks, split_of)
    trees_of = [SourceTree(run=name, sha256=fingerprint(tree)) for name, tree in runs.items()]
    record = TrackSet(
        split_by=cfg.split_by, observed=cfg.observed, predicted=cfg.predicted, stride=cfg.stride, trees=trees_of, samples=files.counts,
    )  # fmt: skip
    written = [*files.paths, *write_record(out, record)]
    check_no_leak({split: read_track_samples(out, split) for split in SPLITS}, cfg.split_by)
    stage.finish(written, tally, split_by=cfg.split_by, **facts)
    return out


def _runs(trees: Sequence[Path]) -> dict[str, Path]:
    """Name each tree by the folder that it stands in."""
    runs = {folder_name(tree.absolute().parent.name): tree for tree in trees}
    if len(runs) < len(trees):
        raise InputError(
            "two runs have one name", got=", ".join(str(tree) for tree in trees), expected="trees in folders of different names",
            fix="rename the folder that one of the trees stands in",
        )  # fmt: skip
    return runs


def _survey(
    stage: StageFolder, cfg: DualTrackConfig, runs: Mapping[str, Path]
) -> tuple[list[_PairedFlight], list[Course], Tally]:
    """Find the perturbed flights that give windows, the walks' courses, and what becomes of the others."""
    folders = [(folder, place_of(folder, run)) for run, tree in runs.items() for folder in find_flights(tree)]
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
        raise stage.nothing_kept(tally, expected=f"a perturbed flight of {cfg.length} frames beside its clean one")
    return paired, courses, tally


def _read_pair(folder: Path, cfg: DualTrackConfig) -> tuple[Flight, Flight] | str | None:
    """Read a perturbed flight and its clean one; None for a clean flight, a word for why there are no windows."""
    flight = read_flight(folder, strict=False)
    if flight.is_original:
        return None
    try:
        twin = read_twin(flight)
    except VerifyError:
        return OTHER_FRAMES
    if twin is None:
        return NO_TWIN
    if not any(True for _ in windows_of(len(flight), cfg)):
        return SHORT
    return flight, twin


def windows_of(num_frames: int, cfg: DualTrackConfig) -> range:
    """Give the first frames of the windows of a flight."""
    return range(0, num_frames - cfg.length + 1, cfg.stride)


def _splits(
    cfg: DualTrackConfig, paired: Sequence[_PairedFlight], walks: Mapping[str, str], seed: int
) -> dict[str, Split]:
    """Give each flight's key its split; walks (or towns) are ranked as those of captions are."""
    group_of = {
        flight.key: town_family(flight.place.town) if cfg.split_by == "town" else walks[flight.key] for flight in paired
    }
    split_of = assign_splits(
        group_of.values(), cfg.fractions, seed, too_few=cfg.too_few,
        what="walks with both tracks" if cfg.split_by == "walk" else "towns with both tracks",
        fix="give more flights, set a fraction to 0, or --set distill.dual_track.too_few=fill",
    )  # fmt: skip
    return {key: split_of[group] for key, group in group_of.items()}


def _write(
    files: SplitFiles, cfg: DualTrackConfig, paired: Sequence[_PairedFlight], walks: Mapping[str, str], split_of: Mapping[str, Split]
) -> dict[str, Any]:  # fmt: skip
    """Write the windows; gives the facts of the manifest: of each split, and how many windows were left out."""
    facts: dict[str, dict[str, Any]] = {split: {"samples": 0, "flights": 0, "walks": set(), "observed_frames": Counter()} for split in SPLITS}  # fmt: skip
    left_out = 0
    with progress_bar(f"{STAGE}: writing", total=len(paired)) as advance:
        for found in paired:
            advance(1)
            pair = _read_pair(found.folder, cfg)
            assert isinstance(pair, tuple), "the flight was changed while it was read"
            split, own = split_of[found.key], facts[split_of[found.key]]
            own["flights"] += 1
            own["walks"].add(walks[found.key])
            for sample in samples_of(found, *pair, walks[found.key], cfg):
                if sample is None:
                    left_out += 1
                    continue
                files.add(split, sample.model_dump(mode="json"))
                own["samples"] += 1
                own["observed_frames"].update(str(state) for state in sample.states)
    for own in facts.values():
        own["walks"], own["observed_frames"] = len(own["walks"]), dict(sorted(own["observed_frames"].items()))
    return {"splits": facts, "windows_left_out": {UNEVEN: left_out}}


def samples_of(
    found: _PairedFlight, flight: Flight, twin: Flight, walk: str, cfg: DualTrackConfig
) -> Iterator[TrackSample | None]:
    """Cut a pair of flights into windows; None for one whose frames are not evenly apart in time."""
    step = step_s(flight.time_s)
    for first in windows_of(len(flight), cfg):
        seen, after = slice(first, first + cfg.observed), slice(first + cfg.observed, first + cfg.length)
        time_s = flight.time_s[first : first + cfg.length]
        if len(time_s) > 1 and np.abs(np.diff(time_s) - step).max() > STEP_TOLERANCE_S:
            yield None
            continue
        parts = {"observed": (flight, seen), "clean": (twin, seen), "future": (twin, after)}
        vectors = {
            f"{part}_{what}": _vectors(values[rows])
            for part, (track, rows) in parts.items()
            for what, values in (("position_m", track.positions_m), ("rotation_deg", track.rotations_deg), ("target_m", track.targets_m))
        }  # fmt: skip
        frames = range(first, first + cfg.length)
        yield TrackSample(
            sample_id=sample_id(found.flight_id, frames[cfg.observed - 1]),
            run=found.place.run, town=found.place.town, trajectory=found.place.trajectory, variant=found.place.variant, walk=walk,
            window=tuple(frames[: cfg.observed]), future=tuple(frames[cfg.observed :]), time_s=tuple(time_s.tolist()),
            states=tuple(flight.states[seen]), **vectors,
        )  # fmt: skip


def _vectors(rows: np.ndarray) -> tuple[Any, ...]:
    """Give vectors (k, 3), those of nobody as None."""
    return tuple(None if np.isnan(row).any() else tuple(row.tolist()) for row in rows + 0.0)
