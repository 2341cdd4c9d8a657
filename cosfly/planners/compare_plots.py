"""Pictures of a comparison, drawn with OpenCV: overlay from above, altitude and visibility over time, radar of the axes."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from cosfly.look.topview import INK, PAPER, add_caption, draw_area, draw_dot, draw_line, draw_text, png_bytes
from cosfly.planners.contract import PLANNERS, title_of
from cosfly.planners.overview import draw_walks
from cosfly.products.boxes import BoxMap
from cosfly.products.traces import DroneTrace
from cosfly.products.walks import Walk

# RGB: the paper's blue and orange, then others that differ in brightness too.
PALETTE = ((30, 100, 210), (235, 120, 20), (20, 150, 90), (150, 60, 170), (120, 90, 60), (20, 170, 190))
LEGEND_PX = 160  # of one planner
FAINT = (215, 215, 215)


def color_of(planner: str) -> tuple[int, int, int]:
    """Give a planner's color, the same in every comparison."""
    return PALETTE[list(PLANNERS).index(planner) % len(PALETTE)]


def _legend(picture: np.ndarray, planners: Collection[str], y: float) -> None:
    x = float(picture.shape[1] - LEGEND_PX * len(planners))
    for planner in planners:
        draw_line(picture, np.array([[x, y - 5], [x + 34, y - 5]]), color_of(planner), 3)
        x = draw_text(picture, title_of(planner), x + 42, y) + 18


# --- from above -------------------------------------------------------------------------------------------------------


def draw_overlay(box_map: BoxMap, walks: list[Walk], flights: dict[str, list[DroneTrace]]) -> bytes:
    """Draw walks (dark) and the flights of each planner over the map; PNG bytes."""
    picture, view = draw_walks(box_map, walks, [trace for traces in flights.values() for trace in traces])
    for planner, traces in flights.items():
        for trace in traces:
            line = view.pixels(trace.positions_m)
            draw_line(picture, line, color_of(planner), 2, halo=5)
            draw_dot(picture, line[0], 5, color_of(planner))
    caption = add_caption(picture, f"{box_map.name}: {len(walks)} walks (dark); dots are starts")
    _legend(caption, flights, 25)
    return png_bytes(caption)


# --- over time --------------------------------------------------------------------------------------------------------


def draw_series(walks: list[Walk], flights: dict[str, list[DroneTrace]]) -> bytes:
    """Draw altitude above the walk and visibility over time: every flight thin, the mean of those still flying thick."""
    ground = [walk.positions_m[:, 2] for walk in walks]
    altitudes = {p: [t.positions_m[:, 2] - g for t, g in zip(ts, ground, strict=True)] for p, ts in flights.items()}
    seen = {planner: [trace.visibility for trace in traces] for planner, traces in flights.items()}
    end_s = max(float(trace.time_s[-1]) for traces in flights.values() for trace in traces)
    top = max(float(values.max()) for rows in altitudes.values() for values in rows)
    picture = np.full((880, 1400, 3), PAPER, dtype=np.uint8)
    times = {planner: [trace.time_s - trace.time_s[0] for trace in traces] for planner, traces in flights.items()}
    bottom = min(20.0, *(float(values.min()) for rows in altitudes.values() for values in rows))
    high = max(10.0 * np.ceil((top + 1.0) / 10.0), 30.0)
    _panel(picture, (90, 60, 1360, 410), "altitude above the walk (m)", (bottom - 2.0, high), end_s, times, altitudes)
    _panel(picture, (90, 480, 1360, 820), "five-ray visibility", (-0.03, 1.05), end_s, times, seen)
    draw_text(picture, "time (s)", 725, 866, align=0.5)
    draw_text(picture, f"{len(walks)} walks: every flight thin, the mean of those still flying thick", 90, 28, 0.6)
    _legend(picture, flights, 28)
    return png_bytes(picture)


def _panel(picture, frame, title, bounds, end_s, times, values) -> None:
    """Draw one axis. frame: left, top, right, bottom, px. bounds: low, high. times, values: planner -> one row per flight."""
    left, top, right, bottom = frame

    def pixels(t, v) -> np.ndarray:
        x = left + (right - left) * np.asarray(t, dtype=np.float64) / max(end_s, 1e-9)
        y = bottom - (bottom - top) * (np.asarray(v, dtype=np.float64) - bounds[0]) / (bounds[1] - bounds[0])
        return np.stack([x, y], axis=1)

    for tick in _ticks(*bounds):
        draw_line(picture, pixels([0, end_s], [tick, tick]), FAINT)
        draw_text(picture, f"{tick:g}", left - 10, pixels([0], [tick])[0, 1] + 5, 0.5, align=1.0)
    for tick in _ticks(0.0, end_s):
        draw_line(picture, np.array([pixels([tick], [bounds[0]])[0], pixels([tick], [bounds[1]])[0]]), FAINT)
        draw_text(picture, f"{tick:g}", pixels([tick], [bounds[0]])[0, 0], bottom + 20, 0.5, align=0.5)
    for planner, rows in values.items():
        pale = tuple(int(0.35 * c + 0.65 * p) for c, p in zip(color_of(planner), PAPER, strict=True))
        for t, v in zip(times[planner], rows, strict=True):
            draw_line(picture, pixels(t, v), pale)
    for planner, rows in values.items():
        longest = max(times[planner], key=len)
        mean = [np.mean([row[i] for row in rows if len(row) > i]) for i in range(len(longest))]
        draw_line(picture, pixels(longest, mean), color_of(planner), 3)
    draw_line(picture, np.array([[left, top], [right, top], [right, bottom], [left, bottom]]), INK, closed=True)
    draw_text(picture, title, left, top - 10)


def _ticks(low: float, high: float) -> np.ndarray:
    """Give about six round numbers from low to high."""
    rough = (high - low) / 6.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(k for k in (1.0, 2.0, 5.0, 10.0) if k * power >= rough)
    ticks = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    return np.round(ticks, 6) + 0.0  # no minus zero


# --- axes -------------------------------------------------------------------------------------------------------------


def draw_radar(axes: dict[str, dict[str, float]]) -> bytes:
    """Draw the four axis scores of each planner, 0 in the middle and 1 at the rim; PNG bytes."""
    picture = np.full((700 + 30 * len(axes), 900, 3), PAPER, dtype=np.uint8)  # a line of words for each planner
    names = [name for name in next(iter(axes.values())) if name != "mean"]
    middle, radius_px = np.array([450.0, 340.0 + 30.0 * len(axes)]), 270.0
    angles = np.arange(len(names)) * 2.0 * np.pi / len(names) - np.pi / 2.0
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for share in (0.25, 0.5, 0.75, 1.0):
        draw_line(picture, middle + radius_px * share * spokes, FAINT, closed=True)
        draw_text(picture, f"{share:g}", middle[0] + 6, middle[1] - radius_px * share + 14, 0.42, (130, 130, 130))
    for spoke, name in zip(spokes, names, strict=True):
        draw_line(picture, np.array([middle, middle + radius_px * spoke]), FAINT)
        x, y = middle + (radius_px + 22) * spoke
        align = 0.5 if abs(spoke[0]) < 0.1 else float(spoke[0] < 0)
        draw_text(picture, name.replace("_", " "), x, y + 5, 0.6, align=align)
    for planner, scores in axes.items():
        shape = middle + radius_px * spokes * np.clip([[scores[name]] for name in names], 0.0, 1.0)
        filled = picture.copy()
        draw_area(filled, shape, color_of(planner))
        picture[:] = (0.82 * picture + 0.18 * filled).astype(np.uint8)
        draw_line(picture, shape, color_of(planner), 3, closed=True)
    for row, (planner, scores) in enumerate(axes.items()):
        words = ", ".join(f"{name.replace('_', ' ')} {scores[name]:.3f}" for name in names)
        draw_line(picture, np.array([[40, 30 + 30 * row], [74, 30 + 30 * row]]), color_of(planner), 3)
        draw_text(picture, f"{title_of(planner)}: mean {scores['mean']:.3f} ({words})", 84, 35 + 30 * row, 0.5)
    return png_bytes(picture)
