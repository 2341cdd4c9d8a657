"""Top-down pictures of trajectories: `plan.png` and `compare_overlay.png`."""

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.formats.traces import DroneTrace
from cosfly.planners.contract import ALL_PLANNERS, title_of
from cosfly.viz.topview import HALO, TopView, add_caption, draw_dot, draw_line, draw_map, draw_text, png_bytes

MARGIN_M = 27.0
LONGER_SIDE_PX = 1400
MAP_SHARE, WHITE_SHARE = 0.55, 0.45  # the map is pale, so that trajectories stand out
PEDESTRIAN_COLOR = (20, 20, 30)
SIGHT_COLOR = (70, 90, 110)
# A drone trajectory where the target is visible and where it is hidden; partial visibility mixes both.
SEEN_COLOR = np.array([20.0, 110.0, 230.0])
HIDDEN_COLOR = np.array([225.0, 30.0, 40.0])
FRAMES_BETWEEN_SIGHTS = 20  # one line of sight every 10 s
# Colors of planners: the paper's blue and orange, then others that also differ in brightness.
PALETTE = (
    (30, 100, 210), (235, 120, 20), (20, 150, 90), (150, 60, 170), (120, 90, 60), (20, 170, 190), (200, 40, 60),
    (110, 110, 110), (90, 200, 40), (230, 110, 190), (100, 0, 90), (0, 90, 60), (190, 170, 0), (110, 150, 250),
    (250, 160, 130),
)  # fmt: skip
LEGEND_PX = 24  # height of one planner's entry


def color_of(planner: str) -> tuple[int, int, int]:
    """Return a planner's color, the same in every comparison."""
    return PALETTE[list(ALL_PLANNERS).index(planner) % len(PALETTE)]


def _base_picture(
    box_map: BoxMap, pedestrians: list[PedestrianTrajectory], traces: list[DroneTrace]
) -> tuple[np.ndarray, TopView]:
    """Return a picture of the map around all trajectories, with the pedestrian trajectories on it, and its view."""
    points_m = np.vstack(
        [*(pedestrian.positions_m for pedestrian in pedestrians), *(trace.positions_m for trace in traces)]
    )
    view = TopView.around(points_m, LONGER_SIDE_PX, MARGIN_M)
    picture = (MAP_SHARE * draw_map(box_map, view) + WHITE_SHARE * 255).astype(np.uint8)
    for pedestrian in pedestrians:
        draw_line(picture, view.pixels(pedestrian.positions_m), PEDESTRIAN_COLOR, 2, halo=5)
    return picture, view


def draw_trajectories(box_map: BoxMap, pedestrians: list[PedestrianTrajectory], traces: list[DroneTrace]) -> bytes:
    """Draw obstacles, pedestrian trajectories (dark) and drone trajectories (blue; red where the target is hidden).

    Returns:
        PNG bytes. Dropped trajectories are thin; a pedestrian trajectory without a drone trajectory ends in a cross.
    """
    picture, view = _base_picture(box_map, pedestrians, traces)
    planned_ids = {trace.path_id for trace in traces}
    for pedestrian in pedestrians:
        if pedestrian.path_id not in planned_ids:
            end = view.pixels(pedestrian.positions_m[-1:])[0].astype(int).tolist()
            cv2.drawMarker(picture, end, HIDDEN_COLOR.tolist(), cv2.MARKER_TILTED_CROSS, 16, 3, cv2.LINE_AA)
    for trace in traces:
        _draw_trace(picture, view, trace)
    num_dropped = sum(trace.drop_reason is not None for trace in traces)
    drones = f"{len(traces)} drones (blue: target visible, red: hidden), {num_dropped} dropped"
    return png_bytes(add_caption(picture, f"{box_map.name}: {len(pedestrians)} pedestrians (dark), {drones}"))


def _draw_trace(picture: np.ndarray, view: TopView, trace: DroneTrace) -> None:
    """Draw one drone trajectory with its lines of sight, its start and its name."""
    drone = view.pixels(trace.positions_m)
    target = view.pixels(trace.targets_m)
    for i in range(0, len(drone), FRAMES_BETWEEN_SIGHTS):
        draw_line(picture, np.stack([drone[i], target[i]]), SIGHT_COLOR)
    if not trace.drop_reason:
        draw_line(picture, drone, HALO, 6)
    for i, visibility in enumerate(trace.visibility[:-1]):
        color = SEEN_COLOR * visibility + HIDDEN_COLOR * (1.0 - visibility)
        draw_line(picture, drone[i : i + 2], color.tolist(), 1 if trace.drop_reason else 3)
    start = drone[0].astype(int)
    draw_dot(picture, start, 5, SEEN_COLOR.tolist())
    draw_text(picture, trace.path_id, start[0] + 8, start[1] - 6, 0.5, PEDESTRIAN_COLOR, halo=HALO)


def draw_compared(
    box_map: BoxMap, pedestrians: list[PedestrianTrajectory], traces: dict[str, list[DroneTrace]]
) -> bytes:
    """Draw pedestrian trajectories (dark) and the trajectories of each planner over the map; return PNG bytes."""
    all_traces = [trace for planner_traces in traces.values() for trace in planner_traces]
    picture, view = _base_picture(box_map, pedestrians, all_traces)
    for planner, planner_traces in traces.items():
        for trace in planner_traces:
            line = view.pixels(trace.positions_m)
            draw_line(picture, line, color_of(planner), 2, halo=5)
            draw_dot(picture, line[0], 5, color_of(planner))
    picture = add_caption(picture, f"{box_map.name}: {len(pedestrians)} pedestrians (dark); dots are starts")
    _draw_legend(picture, list(traces))
    return png_bytes(picture)


def _draw_legend(picture: np.ndarray, planners: list[str]) -> None:
    """Draw a line and the title of each planner below the caption, at the left."""
    for place, planner in enumerate(planners, 1):
        y = 36.0 + LEGEND_PX * place
        draw_line(picture, np.array([[10.0, y - 5], [44.0, y - 5]]), color_of(planner), 3, halo=5)
        draw_text(picture, title_of(planner), 52.0, y, halo=HALO)
