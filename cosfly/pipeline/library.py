"""cosfly as a library: stages as functions over values in memory, with the settings and results of the commands.

`import cosfly` loads nothing until a name is used. Positions are world metres, x east, y north, z up; angles degrees.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.captions import read_captions
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import intrinsic_matrix, look_at, world_from_camera
from cosfly.maps.stage import SOURCES, MapsConfig
from cosfly.maps.stage import load_map as load_source
from cosfly.pedestrians.stage import follow_route, make_pedestrian
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory, screens_of
from cosfly.render.contract import Frame
from cosfly.render.person import PosedPerson, choose_clothes, gait_of
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import renderer_of
from cosfly.render.weather import WeatherConfig, random_seed, read_pools, weather_of
from cosfly.runtime.config import build
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig, simplify

__all__ = ["BoxMap", "DroneTrace", "Frame", "load_map", "plan", "read_captions", "render_frames"]

# Settings that a function accepts; it rejects the others of the section.
PEDESTRIAN_SETTINGS = PedestriansConfig.model_fields.keys() - {"num_paths", "others", "look_alikes", "traffic"}
PACE_SETTINGS = {"pace", "hurry_speed_mps", "dt_s"}  # of a pedestrian on a given route
PICTURE_SETTINGS = {"backend", "look", "rim", *WeatherConfig.model_fields}
STEP_S = 0.5  # time between the positions of `render_frames`, for the stride of the person
FILE_SETTING = {"simworld": "world", "cityjson": "path", "boxes": "path"}  # source: the setting that names its file


def load_map(path: str | Path | None = None, *, source: str | None = None, seed: int = 0, **settings: Any) -> BoxMap:
    """Load or generate a map.

    Args:
        path: `boxes_3d.json`, `step2_simplified.json`, a table or GeoJSON of boxes, or the file of a source; None
            generates a town.
        source: `synthetic`, `simworld`, `cityjson`, `boxes` or `carla`; None chooses by the file. CARLA is queried in
            another process, so a script that uses it needs `if __name__ == "__main__":`.
        settings: Of the source, as in `maps.<source>` of a configuration: `load_map(size_m=400)`.
    """
    if not isinstance(seed, int):
        raise ConfigError("the seed is invalid", where="load_map", got=repr(seed)[:40], expected="a whole number")
    path = Path(path) if isinstance(path, str) else path
    if source is None and path is not None and path.suffix == ".json" and not settings:
        return read_boxes(path)
    source = source or ("synthetic" if path is None else "boxes")
    if source not in SOURCES:
        expected = f"one of {', '.join(SOURCES)}"
        raise ConfigError("there is no map source of this name", where="load_map", got=source, expected=expected)
    if path is not None:
        if source not in FILE_SETTING:
            problem = f"the map source {source} reads no file, but a path is given"
            raise ConfigError(problem, where="load_map", got=str(path), fix="omit the path, or use another source")
        _check_taken(settings, settings.keys() - {FILE_SETTING[source]}, "load_map")
        settings[FILE_SETTING[source]] = path
    return load_source(build(MapsConfig, {"source": source, source: settings}, "load_map"), seed=seed)


def plan(
    box_map: BoxMap, route_m: Any = None, *, seed: int = 0, pedestrian: dict[str, Any] | None = None, **settings: Any
) -> DroneTrace:
    """Plan one drone trajectory behind one pedestrian. A map that is not simplified yet is simplified first.

    Args:
        route_m: (k, 2) route of the pedestrian over free ground; None draws one for the seed.
        pedestrian: Settings of the pedestrian, as in `pedestrians` of a configuration.
        settings: As in `plan` of a configuration: `plan(box_map, planner="muco", altitude_max_m=30)`.

    Raises:
        NoPathError: There is no route, or no drone trajectory.
    """
    from cosfly.geometry.kernels import obstacle_index

    pedestrian = pedestrian or {}
    walking = build(PedestriansConfig, pedestrian, "plan: pedestrian")
    _check_taken(pedestrian, PEDESTRIAN_SETTINGS if route_m is None else PACE_SETTINGS, "plan: pedestrian")
    cfg = build(PlanConfig, settings, "plan")
    _check_taken(settings, settings.keys() - ({"track_astar"} - {cfg.planner}), "plan")
    if not box_map.header.passes:
        box_map = simplify(box_map, SimplifyConfig()).box_map
    rng = rng_for(seed, "pedestrians", "path_00000")
    if route_m is None:
        target = make_pedestrian("path_00000", walkable_ground(box_map, walking), walking, rng).trajectory
    else:
        route_m = _checked_route(route_m)
        target = follow_route("path_00000", route_m, box_map.ground, walking, rng, rng.spawn(1)[0])
    return plan_trajectory(target, obstacle_index(box_map), cfg, seed, screens_of(box_map))


def _checked_route(route: Any) -> np.ndarray:
    """Return a route as an array, (k, 2) float64 m; raise InputError if it is none."""
    try:
        route_m = np.asarray(route, dtype=np.float64)
        got = f"an array of shape {route_m.shape}"
    except (TypeError, ValueError):
        route_m = np.empty(0)
        got = repr(route)[:60]
    is_route = route_m.ndim == 2 and route_m.shape[1] == 2 and len(route_m) >= 2 and np.isfinite(route_m).all()
    if not is_route or not np.diff(route_m, axis=0).any(axis=1).all():
        expected = "an array (k, 2) of finite metres, at least two rows, with no row equal to the next"
        raise InputError("the route is invalid", where="route_m", got=got, expected=expected)
    return route_m


def render_frames(
    box_map: BoxMap,
    position_m: Any,
    rotation_deg: Any = None,
    *,
    target_m: Any = None,
    fov_deg: float = 60.0,
    size_px: tuple[int, int] = (1280, 720),
    seed: int = 0,
    **settings: Any,
) -> list[Frame]:
    """Render the view of a camera from one or more positions.

    Args:
        position_m: (3,) or (n, 3).
        rotation_deg: Pitch, yaw, roll, of the same shape; None looks at the target.
        target_m: Hip of the target, of the same shape; None for no person.
        fov_deg: Horizontal field of view.
        size_px: Width and height.
        settings: As in `render` of a configuration: `look`, `backend` and those of weather.

    Returns:
        n frames: rgb (h, w, 3) uint8, depth (h, w) float32 z-depth in m, kinds and instance ids (h, w).
    """
    positions = _rows_of_three(position_m, "position_m")
    targets = None if target_m is None else _rows_of_three(target_m, "target_m", len(positions))
    if rotation_deg is not None:
        rotations = _rows_of_three(rotation_deg, "rotation_deg", len(positions))
    elif targets is not None:
        pitch, yaw = look_at(positions, targets)
        rotations = np.degrees(np.column_stack([pitch, yaw, np.zeros(len(positions))]))
    else:
        fix = "pass rotation_deg, or pass target_m to look at the target"
        raise InputError("the camera has no direction", where="render_frames", fix=fix)
    camera = {"width_px": size_px[0], "height_px": size_px[1], "fovs_deg": [fov_deg]}
    cfg = build(RenderConfig, settings | camera, "render_frames")
    _check_taken(settings, PICTURE_SETTINGS, "render_frames")
    if cfg.weather_seed < 0:
        cfg = cfg.model_copy(update={"weather_seed": random_seed()})
    weather = weather_of(cfg, read_pools(cfg), 0)
    intrinsic = intrinsic_matrix(cfg.width_px, cfg.height_px, fov_deg)
    people: list[PosedPerson | None] = [None] * len(positions)
    if targets is not None:
        gait = gait_of(targets, STEP_S * np.arange(len(targets)))
        clothes = choose_clothes(rng_for(seed, "render", "library"))
        people = [gait.posed(i, target, clothes) for i, target in enumerate(targets)]
    with contextlib.closing(renderer_of(cfg, box_map, seed)) as renderer:
        renderer.prepare(positions.min(axis=0), positions.max(axis=0), None if weather is None else weather.params)
        poses = zip(positions, rotations, people, strict=True)
        return [renderer.render(world_from_camera(*pose), intrinsic, person) for *pose, person in poses]


def _check_taken(settings: dict[str, Any], taken: Collection[str], where: str) -> None:
    """Raise ConfigError if a function ignores some of its settings."""
    if ignored := sorted(settings.keys() - taken):
        raise ConfigError(
            "some settings have no effect here",
            where=where,
            got=", ".join(ignored),
            expected=f"settings among {', '.join(sorted(taken))}" if taken else None,
            fix="remove these settings",
        )


def _rows_of_three(values: Any, name: str, count: int | None = None) -> np.ndarray:
    """Return an argument of (3,) or (n, 3) as (n, 3) float64; if `count` is given, n must be equal to it."""
    rows = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) == 0 or count not in (None, len(rows)):
        expected = "(3,) or (n, 3)" if count is None else f"({count}, 3), the shape of position_m"
        got = f"an array of shape {rows.shape}"
        raise InputError("the array has the wrong shape", where=name, got=got, expected=expected)
    return rows
