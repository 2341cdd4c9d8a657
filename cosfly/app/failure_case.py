"""The paper's failure case (fig:cosfly_matrix_world_failure) of a run: the flight that sees least, in six instants, as
boxes, as the world is drawn, and from above with its line of sight."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cosfly.look.overlay import Overlay
from cosfly.look.topview import PAPER, TopView, draw_dot, draw_line, draw_map, draw_text, png_bytes
from cosfly.products.boxes import read_boxes
from cosfly.products.flights import find_flights
from cosfly.products.frames import read_instance, read_meta, read_rgb
from cosfly.products.playback import Flight, read_flight
from cosfly.products.town import read_instance_ids
from cosfly.work.store import write_bytes

INSTANTS, STEP_S = 6, 2.0
TILE_PX, STRIP_PX = (360, 202), 24
REACH_M = 50.0  # round drone and person, of the view from above
CLEAR, OCCLUDED, DRONE = (30, 150, 60), (215, 40, 40), (35, 100, 220)
DASH_PX = 7.0


def failure_case(run: Path, picture: Path) -> dict[str, list[float]]:
    """Reads a run's maps and frames, writes the picture; gives what is told of each instant: s, five-ray visibility,
    rendered visibility.

    The six are 2 s apart, where the flight sees least; of a run in which nobody is hidden they show that.
    """
    from cosfly.space.kernels import obstacle_index, visibility

    box_map = read_boxes(run / "maps/boxes_3d.json")
    obstacles = obstacle_index(read_boxes(run / "simplify/step2_simplified.json"))
    flights = [read_flight(folder) for folder in find_flights(run / "render")]
    seen = [visibility(obstacles, flight.positions_m, flight.targets_m) for flight in flights]
    k = min(range(len(flights)), key=lambda k: float(np.nanmean(seen[k] + np.nan_to_num(flights[k].visibility))))
    flight, rays = flights[k], seen[k]
    stride = max(1, round(STEP_S / float(np.median(np.diff(flight.time_s)))))
    both = rays + np.nan_to_num(flight.visibility)
    first = int(np.argmin(np.convolve(both, np.ones(min(INSTANTS * stride, len(flight))), mode="valid")))
    frames = list(range(first, len(flight), stride))[:INSTANTS]
    overlay = Overlay(box_map, read_instance_ids(run / "render" / flight.town).of_boxes(box_map))
    columns = [_column(flight, i, float(rays[i]), overlay) for i in frames]
    write_bytes(picture, png_bytes(np.hstack(columns)))
    told = {i: [float(values[i]) for values in (flight.time_s, rays, flight.visibility)] for i in frames}
    return {f"{flight.flight_id}, frame {i}": row for i, row in told.items()}


def _column(flight: Flight, i: int, rays: float, overlay: Overlay) -> np.ndarray:
    folder, strip = flight.frame_folder(i), np.full((STRIP_PX, TILE_PX[0], 3), PAPER, dtype=np.uint8)
    draw_text(strip, f"{flight.time_s[i]:.1f} s, five rays {rays:.1f}, drawn {flight.visibility[i]:.2f}", 6, 17, 0.45)
    rgb, meta = read_rgb(folder), read_meta(folder)
    matrix = overlay.draw(np.full_like(rgb, 24), read_instance(folder)[1], meta)
    tiles = [cv2.resize(one, TILE_PX, interpolation=cv2.INTER_AREA) for one in (matrix, rgb)]
    ends = np.stack([flight.positions_m[i], flight.targets_m[i]])
    middle, half = ends.mean(axis=0)[:2], np.array(TILE_PX) / TILE_PX[0] * REACH_M
    view = TopView.around(np.stack([middle - half, middle + half]), TILE_PX[0], 0.0)
    above, (drone, person) = draw_map(overlay.box_map, view), view.pixels(ends)
    pieces = np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(person - drone) / DASH_PX)))[:, None]
    line = drone + pieces * (person - drone)
    if rays > 0.5:
        draw_line(above, line, CLEAR, 3)
    else:
        for a in range(0, len(line) - 1, 2):
            draw_line(above, line[a : a + 2], OCCLUDED, 3)
    draw_dot(above, drone, 6, DRONE)
    draw_dot(above, person, 5, (20, 20, 30))
    return np.vstack([strip, *tiles, cv2.resize(above, TILE_PX)])
