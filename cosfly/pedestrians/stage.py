"""Stage `pedestrians`: trajectories over the free ground of a simplified map (Step 3 of the paper, sec:step3).

Speed follows the literal formulas on the route, one waypoint per cell width, so that curvature slows a pedestrian only
in the one or two steps next to a corner. Without collinear waypoints the low speed of a corner would extend over the
straight segment behind it (0.92 instead of 1.07 m/s on the same 40 routes of a test town).

The route is straightened first. At a turn of 45 degrees from cell to cell the formulas give 0.16 m/s, and a route along
a street that is not parallel to an axis turns every few cells: on 20 routes of Delft, 35 % of the positions were slower
than 0.3 m/s, and 1 % are with straight lines.
"""

import colorsys
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel

from cosfly.formats.boxes import read_boxes
from cosfly.formats.bystanders import BYSTANDERS_FILE, Bystanders, write_bystanders
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PedestrianTrajectory, pace_field, paces_of, walk_id, write_paths
from cosfly.formats.roi import read_roi
from cosfly.geometry.trajectory_metrics import length_m
from cosfly.pedestrians.astar import route_cost
from cosfly.pedestrians.bystanders import bystanders_of
from cosfly.pedestrians.speed_model import PACES, timed_route
from cosfly.pedestrians.walkable import (
    CROSSING,
    ROAD,
    PedestriansConfig,
    StepSeconds,
    WalkableGround,
    count_on_road,
    timed,
    walkable_ground,
)
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import StageFolder, result_of
from cosfly.runtime.seeding import draw_by_share, rng_for
from cosfly.runtime.worker import Item, Outcome, Work
from cosfly.viz.topview import PAPER, TopView, add_caption, draw_dot, draw_line, draw_scale, png_bytes

log = logging.getLogger(__name__)

STAGE = "pedestrians"
REPORT_FORMAT = FileFormat("cosfly.pedestrians_report", "1.0")
RETRY_REASONS = ("no_goal", "detour")
MUCH_ON_ROAD = 0.2  # share of points on carriageways that is worth a line although it cannot be avoided
UNUSED_SHARE = 0.01  # of the walkable ground; less is not worth a line of the log

# The overview picture: RGB of cells and of the outline of the region of interest.
LONGER_SIDE_PX = 1600
OBSTACLE, MARGIN, UNUSED, USED = (74, 76, 84), (158, 158, 164), (232, 228, 218), (190, 219, 238)
ON_ROAD, ON_CROSSING, ROI_LINE = (203, 201, 214), (246, 226, 150), (226, 120, 20)
CAPTION = (
    "dark: obstacles, grey: margin, beige: other ground, blue: walkable, violet: carriageway, yellow: crossings, "
    "orange: region"
)


class PedestrianResult(NamedTuple):
    trajectory: PedestrianTrajectory
    num_rejected: dict[str, int]  # pairs of ends, by RETRY_REASONS
    seconds: dict[str, float]  # by step


def make_pedestrian(
    path_id: str, ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator, pace: str | None = None
) -> PedestrianResult:
    """Make one trajectory: draw its ends, find the route, apply a pace (None: drawn by its share), sample it."""
    seconds = StepSeconds(float)
    pace_rng = rng.spawn(1)[0]  # a child takes no draw from its parent: shares of paces change no route
    route_m, num_rejected = _draw_route(path_id, ground, cfg, rng, seconds)
    with timed(seconds, "report"):  # a name in manifests, which the following of the route shares with the report
        trajectory = follow_route(path_id, route_m, ground.z_m, cfg, rng, pace_rng, pace)
    return PedestrianResult(trajectory, num_rejected, dict(seconds))


def follow_route(
    path_id: str, route_m: np.ndarray, ground_z_m: float, cfg: PedestriansConfig, rng: np.random.Generator,
    pace_rng: np.random.Generator, pace: str | None = None,
) -> PedestrianTrajectory:  # fmt: skip
    """Return the trajectory along a route, (k, 2) m, at a pace; None: one that is drawn by its share.

    pace_rng draws the pace, its stops and turns; rng draws the speeds.
    """
    name = pace or draw_by_share(cfg.pace, pace_rng)
    route = timed_route(route_m, PACES[name], cfg, rng, pace_rng)
    time_s, positions_m, speeds_mps = route.resample(cfg.dt_s)
    on_ground = np.insert(positions_m, 2, ground_z_m, axis=1)
    return PedestrianTrajectory(path_id, route.polyline_m, time_s, on_ground, speeds_mps, name)


def _draw_route(
    path_id: str, ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator, seconds: StepSeconds
) -> tuple[np.ndarray, dict[str, int]]:
    """Draw pairs of ends until one is accepted; return its route, (k, 2) m, and the rejected pairs by reason."""
    limits = cfg.min_distance_m / cfg.resolution_m, cfg.max_distance_m / cfg.resolution_m
    rejected = dict.fromkeys(RETRY_REASONS, 0)
    for _ in range(cfg.num_retries + 1):
        with timed(seconds, "sample"):
            start = ground.sample_start(rng)
            goals = ground.sample_goals(start, *limits, rng)
        if not goals:
            rejected["no_goal"] += 1
            continue
        with timed(seconds, "astar"):
            cells = ground.route(start, goals[0])
        if route_cost(cells) > cfg.max_detour * np.hypot(*(cells[-1] - cells[0])):
            rejected["detour"] += 1
            continue
        with timed(seconds, "astar"):
            return ground.waypoints_m(cells), rejected
    raise NoPathError(
        "no random pair of start and goal has a suitable route", where=path_id,
        got=f"{cfg.num_retries + 1} tries: {rejected['no_goal']} without a goal, {rejected['detour']} with a long "
        "detour",
        expected=f"a goal {cfg.min_distance_m:g} to {cfg.max_distance_m:g} m away, and a route without a long detour",
        fix="in the section pedestrians, lower min_distance_m or raise max_distance_m or num_retries",
    )  # fmt: skip


class _PedestrianRecord(BaseModel):
    """The journal entry of a trajectory."""

    path: dict[str, Any]
    retries: dict[str, int]
    seconds: dict[str, float]
    bystanders: dict[str, Any] = {}  # where there are bystanders


def make_worker(cfg: PedestriansConfig, seed: int, ground: WalkableGround) -> Work:
    """Return the function that makes one trajectory, and its bystanders where the settings ask for them."""

    def work(item: Item) -> Outcome:
        pedestrian = make_pedestrian(item.item_id, ground, cfg, rng_for(seed, STAGE, item.item_id), item.payload)
        trajectory = pedestrian.trajectory
        record = {"path": trajectory.as_json(), "retries": pedestrian.num_rejected, "seconds": pedestrian.seconds}
        if cfg.others:
            rng = rng_for(seed, STAGE, f"{item.item_id}/others")
            record["bystanders"] = bystanders_of(trajectory, ground, cfg, rng).as_json()
        return Outcome(record)

    return work


def report(
    ground: WalkableGround, paths: list[PedestrianTrajectory], retries: list[dict[str, int]], failed: dict[str, int]
) -> dict[str, Any]:
    """Return `pedestrians_report.json`: equal inputs give equal bytes, so times are written to the manifest.

    retries: the rejected pairs of ends of each path, by reason.
    """
    rows = [_report_row(ground, path, rejected) for path, rejected in zip(paths, retries, strict=True)]
    sums = {
        key: sum(row[key] for row in rows)
        for key in ("waypoints", "points", "on_carriageway", "on_crossings", "length_m", "duration_s")
    }
    total = {
        "paths": len(rows),
        **{key: sums[key] for key in ("waypoints", "points", "on_carriageway", "on_crossings")},
        "on_carriageway_share": round(sums["on_carriageway"] / sums["points"], 4),
        "length_m": round(sums["length_m"], 3),
        "duration_s": sums["duration_s"],
        "mean_speed_mps": round(sums["length_m"] / sums["duration_s"], 4),
        "retries": {reason: sum(rejected[reason] for rejected in retries) for reason in RETRY_REASONS},
    }
    return {**REPORT_FORMAT.header, "ground": ground.counts, "paths": rows, "failed": failed, "total": total}


def _report_row(ground: WalkableGround, path: PedestrianTrajectory, rejected: dict[str, int]) -> dict[str, Any]:
    path_m = length_m(path.polyline_m)
    duration_s = float(path.time_s[-1])
    on_road, on_crossings = count_on_road(path, ground.footing, ground.grid)
    return {
        "id": path.path_id,
        **pace_field(path.pace),
        "waypoints": len(path.polyline_m),
        "length_m": round(path_m, 3),
        "straight_m": round(float(np.linalg.norm(path.polyline_m[-1] - path.polyline_m[0])), 3),
        "points": len(path.time_s),
        "on_carriageway": on_road,
        "on_crossings": on_crossings,
        "duration_s": duration_s,
        "mean_speed_mps": round(path_m / duration_s, 4),
        "retries": rejected,
    }


def _write_bystanders(path: Path, records: list[dict], header: dict, cfg: PedestriansConfig) -> dict[str, int]:
    """Write `others.json`; return how many bystanders were requested and placed; warn where some are missing."""
    items = [Bystanders.from_json(record, f"{path.parent}: items.jsonl") for record in records]
    write_bystanders(path, items, header)
    num_requested = cfg.others * len(items)
    num_placed = sum(len(bystanders.others) for bystanders in items)
    if num_placed < num_requested:
        log.warning("pedestrians: only %d of %d bystanders could be placed", num_placed, num_requested)
    return {"wanted": num_requested, "placed": num_placed}


def run(
    cfg: PedestriansConfig, simplified_map: Path, out: Path, *, seed: int = 0, workers: int = 0,
    watch: Watch = Watch(), roi: Path | None = None,
) -> Path:  # fmt: skip
    """Make pedestrian trajectories on `step2_simplified.json`; return the path of `path.json`.

    The other products are a report, `paths.png`, and `others.json` if there are bystanders. Failed trajectories are
    counted.

    roi: File of a region of interest, outside which nobody walks.
    """
    inputs = {"map": simplified_map} | ({"roi": roi} if roi else {})
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed)
    product = out / "path.json"
    if stage.is_complete:
        return product
    seconds = StepSeconds(float)
    with timed(seconds, "read"):
        box_map = read_boxes(simplified_map)
        region = read_roi(roi) if roi else None
    ground = walkable_ground(box_map, cfg, region, where=simplified_map, roi_where=roi or "", seconds=seconds)
    unused_share = 1 - ground.counts["cells_used"] / ground.counts["cells_walkable"]
    if unused_share >= UNUSED_SHARE:
        words = "%.0f %% of the walkable ground is in areas too small to walk in (pedestrians.min_component_cells=%d)"
        log.info(words, 100 * unused_share, cfg.min_component_cells)
    items = [Item(walk_id(k), pace) for k, pace in enumerate(paces_of(cfg.num_paths, cfg.pace, seed))]
    # Workers need the labels only; sending the rest takes time.
    ground_of_workers = replace(ground, inflated=ground.grid, is_in_roi=None)
    worker_args = (cfg, seed, ground_of_workers)
    outcomes = run_items(stage, items, make_worker, worker_args, workers=workers, watch=watch, label="trajectories")
    if not outcomes.tally.kept:
        raise stage.nothing_kept(outcomes.tally)
    results = [result_of(record, _PedestrianRecord) for record in outcomes.kept]
    paths = [PedestrianTrajectory.from_json(result.path, f"{out}: items.jsonl") for result in results]
    for result in results:
        for step, duration_s in result.seconds.items():
            seconds[step] += duration_s
    outputs = [product, out / "pedestrians_report.json", out / "paths.png"]
    with timed(seconds, "report"):
        retries = [result.retries for result in results]
        summary = report(ground, paths, retries, dict(sorted(outcomes.tally.failed.items())))
        write_paths(product, paths, {"map": box_map.name, "seed": seed, "settings": cfg.all_values()})
        if cfg.others:
            header = {"map": box_map.name, "seed": seed, "dt_s": cfg.dt_s}
            outputs.append(out / BYSTANDERS_FILE)
            summary["others"] = _write_bystanders(outputs[-1], [result.bystanders for result in results], header, cfg)
        write_json(out / "pedestrians_report.json", summary)
        share = summary["total"]["on_carriageway_share"]
        if share and cfg.road_cost == 1 and box_map.is_any_of({KINDS["Sidewalks"]}).any():
            words = "%.1f %% of the points are on carriageways, away from crossings; "
            log.info(words + "set pedestrians.road_cost=20 to keep people on pavements", 100 * share)
        elif share > MUCH_ON_ROAD:
            log.info("%.0f %% of the points are on carriageways: the map has few pavements or paths there", 100 * share)
        write_bytes(out / "paths.png", draw_overview(ground, paths))
    rounded = {step: round(value, 4) for step, value in seconds.items()}
    stage.finish(outputs, outcomes.tally, ground=ground.counts, total=summary["total"], seconds_by_step=rounded)
    return product


# --- the overview picture ---------------------------------------------------------------------------------------------


def draw_overview(ground: WalkableGround, paths: list[PedestrianTrajectory]) -> bytes:
    """Draw the ground and the trajectories, north up; a ring is a start, a dot a goal; return PNG bytes."""
    grid = ground.grid
    num_x, num_y = grid.size
    colors = np.full((num_y, num_x, 3), UNUSED, dtype=np.uint8)
    # Later colours cover earlier ones.
    colors[ground.walkable] = USED
    colors[ground.walkable & (ground.footing >= ROAD)] = ON_ROAD
    colors[ground.walkable & (ground.footing == CROSSING)] = ON_CROSSING
    colors[ground.inflated.occupied] = MARGIN
    colors[grid.occupied] = OBSTACLE
    scale = LONGER_SIDE_PX / max(num_x, num_y)
    width, height = max(1, round(num_x * scale)), max(1, round(num_y * scale))
    method = cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA
    picture = cv2.resize(np.ascontiguousarray(colors[::-1]), (width, height), interpolation=method)
    per_m = scale / grid.resolution_m
    # A cell's colour fills its pixels; coordinates are 0 in the middle of the first pixel.
    view = TopView(grid.x_min_m + 0.5 / per_m, grid.y_min_m + (height - 0.5) / per_m, per_m, (width, height))
    thickness = max(1, round(LONGER_SIDE_PX / 600))
    if ground.is_in_roi is not None:
        outlines, _ = cv2.findContours(ground.is_in_roi.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        for outline in outlines:
            draw_line(picture, view.pixels(ground.grid.centers_of(outline[:, 0])), ROI_LINE, thickness, closed=True)
    for index, path in enumerate(paths):
        color = _color_of(index)
        line = view.pixels(path.polyline_m)
        draw_line(picture, line, color, thickness)
        draw_dot(picture, line[0], 7, PAPER)
        draw_dot(picture, line[0], 7, color, thickness)
        draw_dot(picture, line[-1], 6, color)
    draw_scale(picture, view)
    return png_bytes(add_caption(picture, f"{len(paths)} trajectories, a ring is a start; {CAPTION}"))


def _color_of(index: int) -> tuple[int, int, int]:
    """Return the colour of a trajectory; those of neighbours are far apart on the colour circle (golden ratio)."""
    rgb = colorsys.hsv_to_rgb((0.02 + index * 0.618034) % 1.0, 0.85, (0.62, 0.85)[index % 2])
    red, green, blue = (round(part * 255) for part in rgb)
    return red, green, blue
