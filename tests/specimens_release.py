"""Small releases of the specimen tree, and what they are made of; those of conftest.py are read by many tests."""

import json
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
from commands import working_here
from specimens_distill import make_caption as caption_of_frame

from cosfly.formats.captions import Caption, write_captions
from cosfly.formats.inspection import (
    RESULTS,
    Funnel,
    Inspection,
    TrackFunnel,
    TrackInspection,
    TrajectoryFunnel,
    count_trajectories,
    write_inspection,
)  # fmt: skip
from cosfly.formats.issues import Issue
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.pipeline import run as pipeline
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load
from release.build.config import ReleaseConfig
from release.build.sources import Source
from release.build.stage import run
from release.columns import SPLIT_NAMES
from release.record import read_record
from specimens import make_playback_tree

NUM_POINTS = 12
TOWNS = ("Town01", "Town02")
TWO_SPLITS = {"split_by": "town", "validation_fraction": 0.4, "test_fraction": 0.0}
FREE = {"licence": "cc-by-4.0", "pairs": "any", "validation_fraction": 0, "test_fraction": 0}
CFG = ReleaseConfig(num_frames=8, shard_mb=1, row_group_mb=1, credits="Map: a specimen.", **FREE)
DROPPED = {"status": "dropped", "drop_reason": "hard_conflict"}
REPAIR = {"strategy": "anchored", "asks": 1, "first_decision": "hover", "first_verdict": "HARD_CONFLICT"}


def make_caption(flight, index: int, **change) -> Caption:
    """Give a caption in slots of one frame; every fourth was repaired, of every second sentences were read."""
    plain = caption_of_frame(flight.town, flight.trajectory, flight.variant, index)
    is_straight = plain.en.flight_decision == "track_straight"
    own = {
        "sample_id": f"{flight.flight_id}_frame_{index:05d}", "future": [index + 1], "picture_px": (96, 54),
        "teacher": {"kind": "rules", "model": "rules-1", "settings": {"seed": 0}},
        "label": "track_straight", "verdict": "CONSISTENT" if is_straight else "SOFT_CONFLICT",
        "repair": REPAIR if index % 4 == 0 else None, "writing": "slots",
        "checks": {"values": {"en": {"values_filled": 2}}} if index % 2 else {},
    }  # fmt: skip
    return Caption.model_validate({**plain.model_dump(), **own, **change})


def make_inspection(tree: Path, rejected: dict[str, tuple[str, str]]) -> Inspection:
    flights = []
    for folder in find_tracks(tree):
        name = folder.relative_to(tree).as_posix()
        town, trajectory, variant = folder.parts[-3:]
        result, code = rejected.get(name, ("accepted", ""))
        issues = [Issue(severity="error", code=code, where="x", got="y", expected="z")] if code else []
        place = {"town": town, "trajectory": trajectory, "variant": variant, "folder": name, "trace_id": trajectory}
        flights.append(TrackInspection(**place, result=result, issues=issues, metrics={}))
    rendered = count_trajectories(flights, planned=False)
    planned = rendered["rendered"] + 3
    trajectories = TrajectoryFunnel(planned=planned, dropped={"smoothness": 2}, not_rendered=1, **rendered)
    counts = {result: sum(flight.result == result for flight in flights) for result in RESULTS}
    funnel = TrackFunnel(inspected=len(flights), without_trace=0, reasons={}, **counts)
    return Inspection(settings={}, funnel=Funnel(trajectories=trajectories, flights=funnel), flights=flights)


def make_inputs(root: Path) -> Path:
    """Write tree/ of six flights (two not accepted), captions.jsonl, inspect.json."""
    tree = make_playback_tree(root / "tree", 3, NUM_POINTS, width_px=96, height_px=54, towns=TOWNS)
    captions = []
    for flight in map(read_track, find_tracks(tree)):
        captions += [make_caption(flight, index) for index in range(4, NUM_POINTS - 1)]
        captions.append(make_caption(flight, 11, **DROPPED, en=None, zh=None))
    write_captions(root / "captions.jsonl", captions)
    names = [folder.relative_to(tree).as_posix() for folder in find_tracks(tree)]
    gone = {names[1]: ("rejected", "missing_file"), names[4]: ("review", "stray_frame")}
    write_inspection(root / "inspect.json", make_inspection(tree, gone))
    return root


def source_of(inputs: Path, run: str = "one") -> Source:
    return Source(run, inputs / "tree", inputs / "captions.jsonl", inputs / "inspect.json")


def build(inputs: Path, out: Path, cfg: ReleaseConfig = CFG, **more) -> Path:
    return run(cfg, [source_of(inputs)], out, **more)


def make_release(root: Path, num_frames: int = 400, window: int = 5, **change) -> Path:
    """Release a tree of three trajectories in two towns with captions of windows of so many frames."""
    make_playback_tree(root / "tree", 3, NUM_POINTS, width_px=96, height_px=54, towns=TOWNS)
    return release_of(root, window=window, num_frames=num_frames, **change)


def release_of(
    root: Path,
    window: int = 5,
    picture_px: tuple[int, int] = (96, 54),
    changes: Callable[[Caption], dict] = lambda caption: {},
    **settings,
) -> Path:
    """Release the tree of a folder with a caption of each whole window; changes: of captions, by their fields."""
    captions = [
        make_caption(flight, i, window=list(range(i - window + 1, i + 1)), picture_px=picture_px)
        for flight in map(read_track, find_tracks(root / "tree"))
        for i in range(4, len(flight) - 1)
    ]
    write_captions(root / "captions.jsonl", [one.model_copy(update=changes(one)) for one in captions])
    write_inspection(root / "inspect.json", make_inspection(root / "tree", {}))
    return build(root, root / "release", CFG.model_copy(update={"num_frames": 400, **settings}))


def rewrite_captions(root: Path, change) -> None:
    lines = [json.loads(line) for line in (root / "captions.jsonl").read_text(encoding="utf-8").splitlines()]
    change(lines)
    (root / "captions.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n", encoding="utf-8")


def rows_by_id(dataset: Path) -> dict[str, dict]:
    shards = sorted(read_record(dataset / "release.json").shards, key=lambda shard: SPLIT_NAMES.index(shard.split))
    return {row["sample_id"]: row for shard in shards for row in pq.read_table(dataset / shard.path).to_pylist()}


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


SMALL_RUN = [
    "pedestrians.num_paths=2", "pedestrians.min_distance_m=15", "pedestrians.max_distance_m=25", "render.width_px=256",
    "render.height_px=144", "render.fovs_deg=[60, 90]", "inspect.legible_min=0", "caption.window.stride=2", "workers=1",
]  # fmt: skip


def run_here(told: list[str], out: Path) -> Path:
    """Go the whole way from a map to a release in this process: workers take longer to start than a few flights."""
    with working_here():
        pipeline.run(load(RunConfig, None, told), out)
    return out
