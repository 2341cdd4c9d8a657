"""Stage 5: drone trajectories to a playback tree: RGB, depth and instance frames of a clean and a perturbed track."""

import importlib
import logging
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
Inputs = tuple[Path, Path, Path, Path | None]  # drawn and simplified map, trajectories, bystanders
# Names of trajectories are times of ten digits, as those of the public release.
FIRST_S = 1_000_000_000
SPAN_S = 999_000_000
FROM_ONE_RUN = "pass the others.json that was written together with path.json"


def open_renderer(
    name: str,
    box_map: BoxMap,
    width_px: int,
    height_px: int,
    look: Look | None = None,
    num_others: int = 0,
    settings: Config | None = None,
) -> Renderer:
    """Open a renderer for one map and at most `num_others` bystanders; settings: the renderer's own, if it has any."""
    module, _, attribute = RENDERERS[name].partition(":")
    options = {} if settings is None else {"settings": settings}
    renderer = getattr(importlib.import_module(module), attribute)
    return renderer(box_map, width_px, height_px, look or Look(), num_others, **options)


def renderer_of(cfg: RenderConfig, box_map: BoxMap, num_others: int = 0, like: Renderer | None = None) -> Renderer:
    """Open the renderer of the settings; like: one of another map with these settings, whose device it shares if it
    can."""
    if with_map := getattr(like, "with_map", None):
        return with_map(box_map)
    settings = getattr(cfg, cfg.backend, None)
    return open_renderer(cfg.backend, box_map, cfg.width_px, cfg.height_px, cfg.look, num_others, settings)


# --- scripts of tracks ------------------------------------------------------------------------------------------------


def make_track_script(
    planned: DroneTrace,
    number: int,
    track: str,
    town: str,
    surroundings: Surroundings,
    cfg: RenderConfig,
    seed: int,
    others: Sequence[Bystander] = (),
    weather: WeatherRecord | None = None,
) -> TrackScript:
    """Choose all that one track shows. Both tracks of a trajectory share field of view, people and weather.

    Args:
        planned: Every `frame_stride`-th of its poses is drawn. others: At the same times.
    """
    assert cfg.first_timestamp is not None, "`run` sets it"
    trace = planned.every(cfg.frame_stride)
    looks = planned.drawn_as(number)
    before_m = looks.before_m[:-1]
    step = step_s(planned.time_s)
    before_s = trace.time_s[0] - step * np.arange(len(before_m), 0, -1)
    gait = gait_of(np.vstack([before_m, trace.targets_m]), np.concatenate([before_s, trace.time_s]))
    items = (f"{looks.path_id}{part}" for part in ("", "/others", "/zoom"))
    shared, others_rng, zoom_rng = (rng_for(seed, "render", item) for item in items)
    fov_deg = float(cfg.fovs_deg[int(shared.integers(len(cfg.fovs_deg)))])
    clothes = choose_clothes(shared)
    drawn_others = [other.every(cfg.frame_stride) for other in others]
    cast = dress_bystanders(drawn_others, trace.time_s, clothes.looks, others_rng)
    size_px = cfg.width_px, cfg.height_px
    fovs_deg = [fov_deg]
    if cfg.zoom.mode == "dynamic":
        fovs_deg = zoomed_deg(fov_deg, cfg.fovs_deg, cfg.zoom, trace.time_s, trace.segments, zoom_rng).tolist()
    cameras = tuple(Camera(*size_px, intrinsic_matrix(*size_px, fov_deg)) for fov_deg in fovs_deg)
    cameras = cameras if cfg.zoom.mode == "dynamic" else cameras * len(trace.time_s)
    poses = Poses(trace.positions_m, trace.rotations_deg, trace.targets_m, trace.clearances_m)
    perturbed = PerturbedTrack.unperturbed(poses)
    if track == "perturbed":
        rng = rng_for(seed, "render", f"{trace.path_id}/{PERTURBED}")
        perturbed = perturb(poses, cameras, surroundings, cfg.perturbation, rng, cast, step_s(trace.time_s))
    return TrackScript(
        town=town,
        trajectory=f"{TRAJECTORY}{cfg.first_timestamp + number}",
        variant=VARIANTS[track],
        path_index=number,
        trace=trace,
        cameras=cameras,
        perturbed=perturbed,
        gait=gait.since(len(before_m)),
        clothes=clothes,
        bystanders=cast,
        look=cfg.look if weather is None else None,
        weather=weather,
    )


# --- the stage --------------------------------------------------------------------------------------------------------


def run(
    cfg: RenderConfig,
    boxes: Path,
    simplified: Path,
    traces: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    others: Path | None = None,
) -> Path:
    """Read the maps `boxes_3d.json` (drawn) and `step2_simplified.json` (clearance), `drone_trace.json` and, with
    bystanders, `others.json`; writes the playback tree.

    Trajectories that the planner dropped are not drawn; the manifest counts them. Returns the tree's root, `out`.
    """
    inputs = {"boxes": boxes, "simplified": simplified, "traces": traces} | ({"others": others} if others else {})
    read_pools(cfg)  # checked before anything is written
    inputs |= cfg.pool_files()
    checked_inputs(inputs)  # before the map is read for the names of its meshes, which are inputs too
    box_map = read_boxes(boxes)
    inputs |= {f"mesh {name}": path for name, path in box_map.meshes.files().items()}
    if cfg.path_index is not None and cfg.path_index >= (num := len(read_traces(traces))):
        problem = "the input has no drone trajectory with this index"
        expected = f"an index from 0 to {num - 1}"
        raise ConfigError(problem, where="render.path_index", got=cfg.path_index, expected=expected)
    stage = StageFolder.open(out, "render", config=cfg, inputs=inputs, seed=seed)
    if stage.is_complete:
        return out
    check_ground(box_map, boxes)
    all_traces = read_traces(traces)
    if twice := [path_id for path_id, n in Counter(trace.path_id for trace in all_traces).items() if n > 1]:
        fix = "run the plan stage again"
        raise InputError("two drone trajectories have the same id", where=traces, got=min(twice), fix=fix)
    passed = {n: t for n, t in enumerate(all_traces) if t.drop_reason is None and cfg.path_index in (None, n)}
    if not passed:
        tally = Tally(input=len(all_traces), dropped=Counter(str(trace.drop_reason) for trace in all_traces))
        raise stage.nothing_kept(tally, expected="at least one trajectory that the planner accepted")
    _, num_others = bystanders_of(others, all_traces)
    ids = instance_ids(box_map, num_others)
    if num_shared := int((ids == SHARED_ID).sum()):
        log.warning("render: %d boxes share the instance id %d, because ids have 16 bits", num_shared, SHARED_ID)
    town, updates = _names(stage, cfg, box_map.name, traces, others, seed)
    cfg = cfg.model_copy(update=updates)
    items = [
        Item(f"{trace.path_id}/{VARIANTS[track]}", (number, track), len(trace.time_s[:: cfg.frame_stride]))
        for number, trace in passed.items()
        for track in cfg.tracks
    ]
    arguments = (cfg, (boxes, simplified, traces, others), out, town, seed, min(workers, len(items)))
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="render: frames")
    ids_file = out / town / IDS_FILE
    map_file = write_town_map(out / town, box_map.header)
    ids_record = {
        **IDS_FORMAT.header,
        "person": PERSON_ID,
        "shared": SHARED_ID,
        **({"others": [other_id(number) for number in range(num_others)]} if num_others else {}),
        "num_shared": num_shared,
        "are_box_ids": has_own_ids(box_map, num_others),
        "boxes": [[a, b] for a, b in zip(ids.tolist(), box_map.ids.tolist(), strict=True) if a != SHARED_ID],
    }
    write_json(ids_file, ids_record, indent=None)
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


class _RenderedTrack(BaseModel):
    """The values of a rendered track in the journal that are read again."""

    folder: str
    num_frames: int
    goal: str = "absent"
    weather_seed: int | None = None


def bystanders_of(others: Path | None, traces: list[DroneTrace]) -> tuple[dict[str, list[Bystander]], int]:
    """Read the bystanders of every trajectory, by path id, and how many ids they need: as many as one has at most."""
    if others is None:
        return {}, 0
    by_path = {path.path_id: path.others for path in read_bystanders(others)}
    for trace in traces:
        where = f"{others}: {trace.path_id}"
        if trace.path_id not in by_path:
            raise InputError("the file has no bystanders for the drone trajectory", where=where, fix=FROM_ONE_RUN)
        if other_lengths := {len(other.positions_m) for other in by_path[trace.path_id]} - {len(trace.time_s)}:
            raise InputError(
                "a bystander has more or fewer positions than the drone trajectory",
                where=where,
                got=f"{other_lengths.pop()} positions",
                expected=f"{len(trace.time_s)} positions",
                fix=FROM_ONE_RUN,
            )
    return by_path, max(map(len, by_path.values()), default=0)


def _names(
    stage: StageFolder, cfg: RenderConfig, map_name: str, traces: Path, others: Path | None, seed: int
) -> tuple[str, dict[str, int]]:
    """Return the town's folder, and the settings that name the first trajectory and seed the weather.

    A resumed tree keeps its folder, names and seed.
    """
    town = town_folder(cfg.town or map_name)
    settings = cfg.recorded()
    del settings["depth_format"]  # poses are the same in either
    named_by = [town, seed, fingerprint(traces), settings, *([] if others is None else [fingerprint(others)])]
    first = cfg.first_timestamp
    weather_seed = cfg.weather_seed
    if first is None:
        first = FIRST_S + int(sha256_bytes(dump_json(named_by).encode()), 16) % SPAN_S
    numbers = {trace.path_id: number for number, trace in enumerate(read_traces(traces))}
    begun = [(numbers.get(item.id.rpartition("/")[0]), item) for item in stage.items() if isinstance(item, Kept)]
    kept = [(number, result_of(item, _RenderedTrack)) for number, item in begun if number is not None]
    if kept:
        place = place_of(Path(kept[0][1].folder))
        town = place.town
        first = int(place.trajectory.removeprefix(TRAJECTORY)) - kept[0][0]
    if weather_seed < 0:
        weather_seed = next((track.weather_seed for _, track in kept if track.weather_seed), None) or random_seed()
    return town, {"first_timestamp": first, "weather_seed": weather_seed}


def make_worker(cfg: RenderConfig, inputs: Inputs, out: Path, town: str, seed: int, num_processes: int) -> Work:
    """Open a renderer in this process and return the function that draws one (trace, track)."""
    boxes, simplified, traces, others = inputs
    if num_processes > 1:
        # Processes share the cores: one rasteriser thread each. The driver reads it when it loads.
        os.environ.setdefault("LP_NUM_THREADS", str(max(1, num_cpus() // num_processes)))
    surroundings = Surroundings(read_boxes(simplified))
    all_traces = read_traces(traces)
    bystanders, num_others = bystanders_of(others, all_traces)
    box_map = read_boxes(boxes)
    weathers = weathers_of(cfg, read_pools(cfg), (trace.drawn_as(n).number for n, trace in enumerate(all_traces)))
    renderer = renderer_of(cfg, box_map, num_others)

    def work(item: Item) -> Outcome:
        number, track = item.payload
        trace = all_traces[number]
        weather = weathers[trace.drawn_as(number).number]
        trace_bystanders = bystanders.get(trace.path_id, ())
        script = make_track_script(trace, number, track, town, surroundings, cfg, seed, trace_bystanders, weather)
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
