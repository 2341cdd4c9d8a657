"""The top-down picture of a batch of flights: `plan.png`."""

from __future__ import annotations

import cv2
import numpy as np

from cosfly.products.boxes import BoxMap
from cosfly.products.traces import DroneTrace
from cosfly.products.walks import Walk
from cosfly.topview import add_caption, draw_overview, png_bytes

MARGIN_M = 25.0
SIZE_PX = 1400
WALK_COLOR, HALO_COLOR, SIGHT_COLOR = (20, 20, 30), (255, 255, 255), (70, 90, 110)
SEEN_COLOR, HIDDEN_COLOR = (
    np.array([20.0, 110.0, 230.0]),
    np.array([225.0, 30.0, 40.0]),
)  # flights: blue sees, red does not
FRAMES_BETWEEN_SIGHTS = 20  # a line of sight every 10 s


def draw_flights(box_map: BoxMap, walks: list[Walk], traces: list[DroneTrace]) -> bytes:
    """Draw obstacles, walks (dark) and flights (blue where the target is seen, red where hidden).

    Returns:
        PNG bytes. Dropped flights are thin; a walk without a flight ends in a cross.
    """
    everything = np.vstack([walk.positions_m[:, :2] for walk in walks] + [trace.positions_m[:, :2] for trace in traces])
    low, high = everything.min(axis=0) - MARGIN_M, everything.max(axis=0) + MARGIN_M
    picture = draw_overview(box_map, size_px=SIZE_PX, low_xy=low, high_xy=high)
    picture = (0.55 * picture + 0.45 * 255).astype(np.uint8)  # the town steps back behind the flights
    scale = SIZE_PX / (high - low + 4.0).max()  # draw_overview adds 2 m on every side

    def pixels(points_m: np.ndarray) -> np.ndarray:
        """(n, 2) int32 with four fractional bits."""
        xy = np.stack([points_m[:, 0] - low[0] + 2.0, high[1] + 2.0 - points_m[:, 1]], axis=1)
        return np.round(xy * scale * 16).astype(np.int32)

    flown = {trace.path_id for trace in traces}
    for walk in walks:
        line = pixels(walk.positions_m)
        cv2.polylines(picture, [line], False, HALO_COLOR, 5, cv2.LINE_AA, shift=4)
        cv2.polylines(picture, [line], False, WALK_COLOR, 2, cv2.LINE_AA, shift=4)
        if walk.path_id not in flown:
            end = tuple(int(v) // 16 for v in line[-1])
            cv2.drawMarker(picture, end, HIDDEN_COLOR.tolist(), cv2.MARKER_TILTED_CROSS, 16, 3, cv2.LINE_AA)
    for trace in traces:
        _draw_flight(picture, trace, pixels(trace.positions_m), pixels(trace.targets_m))
    num_dropped = sum(trace.drop_reason is not None for trace in traces)
    text = f"{box_map.name}: {len(walks)} walks (dark), {len(traces)} flights (blue: sees, red: hidden), {num_dropped} dropped"
    return png_bytes(add_caption(picture, text))


def _draw_flight(picture: np.ndarray, trace: DroneTrace, drone: np.ndarray, target: np.ndarray) -> None:
    """Draw one flight with a line of sight every few seconds and its id where it begins."""
    for i in range(0, len(drone), FRAMES_BETWEEN_SIGHTS):
        cv2.line(picture, drone[i].tolist(), target[i].tolist(), SIGHT_COLOR, 1, cv2.LINE_AA, shift=4)
    width = 1 if trace.drop_reason else 3
    if width > 1:
        cv2.polylines(picture, [drone], False, HALO_COLOR, 6, cv2.LINE_AA, shift=4)
    for i in range(len(drone) - 1):
        color = SEEN_COLOR * trace.visibility[i] + HIDDEN_COLOR * (1.0 - trace.visibility[i])
        cv2.line(picture, drone[i].tolist(), drone[i + 1].tolist(), color.tolist(), width, cv2.LINE_AA, shift=4)
    begin = (int(drone[0, 0]) // 16, int(drone[0, 1]) // 16)
    cv2.circle(picture, begin, 5, SEEN_COLOR.tolist(), -1, cv2.LINE_AA)
    for color, thickness in ((HALO_COLOR, 4), (WALK_COLOR, 1)):
        place = (begin[0] + 8, begin[1] - 6)
        cv2.putText(picture, trace.path_id, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thickness, cv2.LINE_AA)
