"""Stage 5: drone trajectories to a playback tree: RGB, depth and instance frames of a clean and a perturbed track."""

import importlib
import logging
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from cosfly.formats.boxes import BoxMap, check_ground, read_boxes
from cosfly.formats.bystanders import Bystander, read_bystanders
from cosfly.formats.frames import Camera, Look
from cosfly.formats.places import place_of, town_folder
from cosfly.formats.town import IDS_FILE, IDS_FORMAT, write_town_map
from cosfly.formats.traces import DroneTrace, read_traces
from cosfly.formats.weather import WeatherRecord
from cosfly.geometry.axes import intrinsic_matrix, step_s
from cosfly.render.camera import zoomed_deg
from cosfly.render.contract import PERSON_ID, SHARED_ID, Renderer, has_own_ids, instance_ids, other_id
from cosfly.render.person import choose_clothes, dress_bystanders, gait_of
from cosfly.render.perturbation import PERTURBED, PerturbedTrack, Poses, Surroundings, perturb
from cosfly.render.settings import RenderConfig
from cosfly.render.track import VARIANTS, TrackScript, render_track
from cosfly.render.weather import random_seed, read_pools, weathers_of
from cosfly.runtime.config import Config
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import CHECKSUMS, atomic_folder, inside, sha256_bytes
from cosfly.runtime.json_io import dump_json, write_json
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Kept, StageFolder, Tally, checked_inputs, fingerprint, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work

log = logging.getLogger(__name__)

RENDERERS = {
    "gl": "cosfly.render.gl.backend:GlRenderer",
    "pyrender": "cosfly.render.pyrender_backend:PyrenderRenderer",
    "carla": "cosfly.render.carla_backend:CarlaRenderer",
    "unrealcv": "cosfly.render.unrealcv_backend:UnrealCvRenderer",
}
TRAJECTORY = "trajectory_"
# Names of trajectories are times of ten digits, as those of the public release.
FIRST_S = 1_000_000_000
SPAN_S = 999_000_000
FROM_ONE_RUN = "pass the others.json that was written together with path.json"


def open_renderer(
    name: str, box_map: BoxMap, width_px: int, height_px: int, look: Look | None = None, num_others: int = 0,
    settings: Config | None = None,
) -> Renderer:  # fmt: skip
    """Open a renderer for one map and at most `num_others` bystanders; settings: the renderer's own, if it has any."""
    module, _, attribute = RENDERERS[name].partition(":")
    options = {} if settings is None else {"settings": settings}
    renderer = getattr(importlib.import_module(module), attribute)
    return renderer(box_map, width_px, height_px, look or Look(), num_others, **options)


def renderer_of(cfg: RenderConfig, box_map: BoxMap, num_others: int = 0, like: Renderer | None = None) -> Renderer:
    """Open the renderer of the settings.

    Args:
        like: A renderer of another map with the same settings; if possible, its device is shared.
    """
    if with_map := getattr(like, "with_map", None):
        return with_map(box_map)
    settings = getattr(cfg, cfg.backend, None)
    return open_renderer(cfg.backend, box_map, cfg.width_px, cfg.height_px, cfg.look, num_others, settings)


# --- scripts of tracks ------------------------------------------------------------------------------------------------


def camera_of(cfg: RenderConfig, fov_deg: float) -> Camera:
    """Return the camera of the settings with a horizontal field of view."""
    return Camera(cfg.width_px, cfg.height_px, intrinsic_matrix(cfg.width_px, cfg.height_px, fov_deg))


def make_track_script(
    planned: DroneTrace, path_index: int, track: str, town: str, surroundings: Surroundings, cfg: RenderConfig,
    seed: int, others: Sequence[Bystander] = (), weather: WeatherRecord | None = None,
) -> TrackScript:  # fmt: skip
    """Choose all that one track shows. Both tracks of a trajectory share field of view, people and weather.

    Args:
        planned: Every `frame_stride`-th of its poses is drawn.
        others: The bystanders, at the times of `planned`.
    """
    assert cfg.first_timestamp is not None, "`run` sets it"
    trace = planned.every(cfg.frame_stride)
    excerpt = planned.drawn_as(path_index)
    # The gait begins with the whole trajectory that `planned` is a part of, so that its frames look the same.
    before_m = excerpt.before_m[:-1]
    before_s = trace.time_s[0] - step_s(planned.time_s) * np.arange(len(before_m), 0, -1)
    gait = gait_of(np.vstack([before_m, trace.targets_m]), np.concatenate([before_s, trace.time_s]))
    shared_rng = rng_for(seed, "render", excerpt.path_id)
    fov_deg = float(cfg.fovs_deg[int(shared_rng.integers(len(cfg.fovs_deg)))])
    clothes = choose_clothes(shared_rng)
    drawn_others = [other.every(cfg.frame_stride) for other in others]
    others_rng = rng_for(seed, "render", f"{excerpt.path_id}/others")
    bystanders = dress_bystanders(drawn_others, trace.time_s, clothes.looks, others_rng)
    cameras = (camera_of(cfg, fov_deg),) * len(trace.time_s)
    if cfg.zoom.mode == "dynamic":
        zoom_rng = rng_for(seed, "render", f"{excerpt.path_id}/zoom")
        fovs_deg = zoomed_deg(fov_deg, cfg.fovs_deg, cfg.zoom, trace.time_s, trace.segments, zoom_rng)
        cameras = tuple(camera_of(cfg, fov_deg) for fov_deg in fovs_deg.tolist())
    poses = Poses(trace.positions_m, trace.rotations_deg, trace.targets_m, trace.clearances_m)
    perturbed = PerturbedTrack.unperturbed(poses)
    if track == "perturbed":
        rng = rng_for(seed, "render", f"{trace.path_id}/{PERTURBED}")
        perturbed = perturb(poses, cameras, surroundings, cfg.perturbation, rng, bystanders, step_s(trace.time_s))
    return TrackScript(
        town=town, trajectory=f"{TRAJECTORY}{cfg.first_timestamp + path_index}", variant=VARIANTS[track],
        path_index=path_index, trace=trace, cameras=cameras, perturbed=perturbed, gait=gait.since(len(before_m)),
        clothes=clothes, bystanders=bystanders, look=cfg.look if weather is None else None, weather=weather,
    )  # fmt: skip


# --- the stage --------------------------------------------------------------------------------------------------------


class RenderInputs(NamedTuple):
    """The files that a worker reads."""

    boxes: Path  # drawn map
    simplified: Path  # map for clearances
    traces: Path
    others: Path | None


def run(
    cfg: RenderConfig, boxes: Path, simplified: Path, traces: Path, out: Path, *, seed: int = 0, workers: int = 0,
    watch: Watch = Watch(), others: Path | None = None,
) -> Path:  # fmt: skip
    """Read the maps `boxes_3d.json` (drawn) and `step2_simplified.json` (clearance), `drone_trace.json` and, with
    bystanders, `others.json`; write the playback tree.

    Trajectories that the planner dropped are not drawn; the manifest counts them. Return the tree's root, `out`.
    """
    files = RenderInputs(boxes, simplified, traces, others)
    box_map, inputs = _checked_inputs(cfg, files)
    stage = StageFolder.open(out, "render", config=cfg, inputs=inputs, seed=seed)
    if stage.is_complete:
        return out
    check_ground(box_map, boxes)
    all_traces = _read_distinct_traces(traces)
    passed = {
        path_index: trace
        for path_index, trace in enumerate(all_traces)
        if trace.drop_reason is None and cfg.path_index in (None, path_index)
    }
    if not passed:
        tally = Tally(input=len(all_traces), dropped=Counter(str(trace.drop_reason) for trace in all_traces))
        raise stage.nothing_kept(tally, expected="at least one trajectory that the planner accepted")
    _, num_others = bystanders_of(others, all_traces)
    ids = instance_ids(box_map, num_others)
    if num_shared := int((ids == SHARED_ID).sum()):
        log.warning("render: %d boxes share the instance id %d, because ids have 16 bits", num_shared, SHARED_ID)
    town, updates = _names(stage, cfg, box_map.name, files, seed)
    cfg = cfg.model_copy(update=updates)
    items = [
        Item(f"{trace.path_id}/{VARIANTS[track]}", (path_index, track), len(trace.time_s[:: cfg.frame_stride]))
        for path_index, trace in passed.items()
        for track in cfg.tracks
    ]
    arguments = (cfg, files, out, town, seed, min(workers, len(items)))
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="render: frames")
    ids_file = _write_ids(out / town, box_map, ids, num_others)
    map_file = write_town_map(out / town, box_map.header)
    rendered = [result_of(record, _RenderedTrack) for record in finished.kept]
    outputs = [inside(out, track.folder) / name for track in rendered for name in ("trajectory.json", CHECKSUMS)]
    stage.finish(
        [*outputs, ids_file, map_file],
        finished.tally,
        town=town,
        flights=[record.result for record in finished.kept],
        num_frames=sum(track.num_frames for track in rendered),
        num_traces=len(all_traces),
        num_traces_not_rendered=len(all_traces) - len(passed),
        num_boxes_sharing_an_id=num_shared,
        goals=dict(sorted(Counter(track.goal for track in rendered).items())),
    )
    return out


def _checked_inputs(cfg: RenderConfig, files: RenderInputs) -> tuple[BoxMap, dict[str, Path]]:
    """Check settings and inputs before anything is written; return the drawn map and the paths of all inputs."""
    inputs = {"boxes": files.boxes, "simplified": files.simplified, "traces": files.traces}
    if files.others is not None:
        inputs["others"] = files.others
    read_pools(cfg)
    inputs |= cfg.pool_files()
    checked_inputs(inputs)  # before the map is read for the names of its meshes, which are inputs too
    box_map = read_boxes(files.boxes)
    inputs |= {f"mesh {name}": path for name, path in box_map.meshes.files().items()}
    if cfg.path_index is not None and cfg.path_index >= (num := len(read_traces(files.traces))):
        problem = "the input has no drone trajectory with this index"
        expected = f"an index from 0 to {num - 1}"
        raise ConfigError(problem, where="render.path_index", got=cfg.path_index, expected=expected)
    return box_map, inputs


def _read_distinct_traces(path: Path) -> list[DroneTrace]:
    """Read the drone trajectories; raise InputError if two have the same id."""
    traces = read_traces(path)
    if twice := [path_id for path_id, num in Counter(trace.path_id for trace in traces).items() if num > 1]:
        fix = "run the plan stage again"
        raise InputError("two drone trajectories have the same id", where=path, got=min(twice), fix=fix)
    return traces


def _write_ids(folder: Path, box_map: BoxMap, ids: np.ndarray, num_others: int) -> Path:
    """Write which instance ids the people and the boxes of a map have; ids: (n,) of the boxes."""
    path = folder / IDS_FILE
    record = {
        **IDS_FORMAT.header,
        "person": PERSON_ID,
        "shared": SHARED_ID,
        **({"others": [other_id(number) for number in range(num_others)]} if num_others else {}),
        "num_shared": int((ids == SHARED_ID).sum()),
        "are_box_ids": has_own_ids(box_map, num_others),
        "boxes": [[a, b] for a, b in zip(ids.tolist(), box_map.ids.tolist(), strict=True) if a != SHARED_ID],
    }
    write_json(path, record, indent=None)
    return path


class _RenderedTrack(BaseModel):
    """The values of a rendered track in the journal that are read again."""

    folder: str
    num_frames: int
    goal: str = "absent"
    weather_seed: int | None = None


def bystanders_of(others: Path | None, traces: list[DroneTrace]) -> tuple[dict[str, list[Bystander]], int]:
    """Read the bystanders of every trajectory, by path id, and the greatest number of bystanders of one trajectory.

    Those of a flown trajectory are cut to its length, because an episode may end before its pedestrian trajectory.
    """
    if others is None:
        return {}, 0
    bystanders = {path.path_id: path.others for path in read_bystanders(others)}
    for trace in traces:
        where = f"{others}: {trace.path_id}"
        if trace.path_id not in bystanders:
            raise InputError("the file has no bystanders for the drone trajectory", where=where, fix=FROM_ONE_RUN)
        num_times = len(trace.time_s)
        if trace.is_flown:
            bystanders[trace.path_id] = [bystander.until(num_times) for bystander in bystanders[trace.path_id]]
        for bystander in bystanders[trace.path_id]:
            if len(bystander.positions_m) != num_times:
                raise InputError(
                    "a bystander has more or fewer positions than the drone trajectory",
                    where=where,
                    got=f"{len(bystander.positions_m)} positions",
                    expected=f"{num_times} positions",
                    fix=FROM_ONE_RUN,
                )
    return bystanders, max(map(len, bystanders.values()), default=0)


def _names(
    stage: StageFolder, cfg: RenderConfig, map_name: str, files: RenderInputs, seed: int
) -> tuple[str, dict[str, int]]:
    """Return the town's folder, and the settings that name the first trajectory and seed the weather.

    A resumed tree keeps its folder, names and seed.
    """
    town = town_folder(cfg.town or map_name)
    settings = cfg.recorded()
    del settings["depth_format"]  # poses are the same in either
    named_by = [town, seed, fingerprint(files.traces), settings]
    if files.others is not None:
        named_by.append(fingerprint(files.others))
    first = cfg.first_timestamp
    weather_seed = cfg.weather_seed
    if first is None:
        first = FIRST_S + int(sha256_bytes(dump_json(named_by).encode()), 16) % SPAN_S
    index_of = {trace.path_id: path_index for path_index, trace in enumerate(read_traces(files.traces))}
    existing = [  # index of the trajectory and track
        (index_of[path_id], result_of(item, _RenderedTrack))
        for item in stage.items()
        if isinstance(item, Kept) and (path_id := item.id.rpartition("/")[0]) in index_of
    ]
    if existing:
        path_index, track = existing[0]
        place = place_of(Path(track.folder))
        town = place.town
        first = int(place.trajectory.removeprefix(TRAJECTORY)) - path_index
    if weather_seed < 0:
        weather_seed = next((track.weather_seed for _, track in existing if track.weather_seed), None) or random_seed()
    return town, {"first_timestamp": first, "weather_seed": weather_seed}


def make_worker(cfg: RenderConfig, files: RenderInputs, out: Path, town: str, seed: int, num_processes: int) -> Work:
    """Open a renderer in this process and return the function that draws one track of a trajectory."""
    if num_processes > 1:
        # Processes share the cores: one rasteriser thread each. The driver reads it when it loads.
        os.environ.setdefault("LP_NUM_THREADS", str(max(1, num_cpus() // num_processes)))
    surroundings = Surroundings(read_boxes(files.simplified))
    all_traces = read_traces(files.traces)
    bystanders, num_others = bystanders_of(files.others, all_traces)
    weathers = weathers_of(cfg, read_pools(cfg), (trace.drawn_as(n).number for n, trace in enumerate(all_traces)))
    renderer = renderer_of(cfg, read_boxes(files.boxes), num_others)

    def work(item: Item) -> Outcome:
        path_index, track = item.payload
        trace = all_traces[path_index]
        weather = weathers[trace.drawn_as(path_index).number]
        trace_bystanders = bystanders.get(trace.path_id, ())
        script = make_track_script(trace, path_index, track, town, surroundings, cfg, seed, trace_bystanders, weather)
        folder = out / town / script.trajectory / script.variant
        with atomic_folder(folder) as unfinished:
            rendered = render_track(renderer, script, unfinished, cfg)
        result: dict[str, Any] = {
            "folder": str(folder.relative_to(out)),
            "num_frames": len(rendered),
            "fov_deg": round(rendered.camera.fov_deg, 6),
            "fovs_deg": None if rendered.intrinsics is None else [round(fov, 6) for fov in rendered.fovs_deg],
            "num_visible": int(rendered.target.visible.sum()),
            "mean_visibility": round(float(rendered.target.visibility.mean()), 6),
            "num_perturbed": int(rendered.perturbation.is_perturbed.sum()),
            "goal": rendered.raw["goal"]["absent"] if rendered.goal is None else "told",
        }
        if weather is not None:
            result |= {"weather": weather.weather_name, "time_of_day": weather.tod_name}
            result["weather_seed"] = cfg.weather_seed
        return Outcome({name: value for name, value in result.items() if value is not None})

    return work
