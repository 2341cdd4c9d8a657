"""The events of a stage as a picture: what each worker did when, memory and cores below. And how it scales: speed, use, restarts."""

from __future__ import annotations

import numpy as np

from cosfly.bench.tables import Bench
from cosfly.look.topview import INK, PAPER, Color, draw_area, draw_dot, draw_line, draw_text, png_bytes
from cosfly.work.stage_events import Event
from cosfly.work.worker_pool import WORDS

WIDTH_PX, LEFT_PX, RIGHT_PX, ROW_PX, TOP_PX, CURVE_PX = 1400, 110, 1370, 46, 84, 150
PANEL_PX = (380, 230)  # width, height of each figure of `bench.png`
FAINT: Color = (215, 215, 215)
STARTING: Color = (225, 225, 225)
COLORS: dict[str, Color] = {
    "kept": (120, 170, 225),
    "dropped": (190, 190, 140),
    "failed": (150, 60, 170),
    "worker_died": (215, 60, 50),
    "heartbeat_lost": (240, 150, 40),
    "timed_out": (190, 120, 20),
}
LABELS = {
    "worker_died": "died",
    "heartbeat_lost": "stood still",
    "timed_out": "over its limit",
    "failed": "failed item",
}


def draw_events(events: list[Event], title: str) -> bytes:
    """Draw a row for each worker (grey: starting, blue: an item done, red and orange: lost) over time; PNG bytes."""
    started = [event.at_s for event in events]
    begin_s, end_s = min(started, default=0.0), max(started, default=1.0)
    num_rows = 1 + max((event.worker or 0 for event in events), default=0)
    bottom = TOP_PX + num_rows * ROW_PX
    picture = np.full((bottom + 2 * (CURVE_PX + 60) + 20, WIDTH_PX, 3), PAPER, dtype=np.uint8)

    def x_of(at_s: float) -> float:
        return LEFT_PX + (RIGHT_PX - LEFT_PX) * (at_s - begin_s) / max(end_s - begin_s, 1e-9)

    draw_text(picture, title, 20, 30, 0.65)
    _legend(picture)
    for tick in _ticks(end_s - begin_s):
        x = x_of(begin_s + tick)
        draw_line(picture, np.array([[x, TOP_PX], [x, bottom]]), FAINT)
        draw_text(picture, f"{tick:g} s", x, bottom + 18, 0.45, align=0.5)
    for row in range(num_rows):
        draw_text(picture, f"worker {row}", 20, TOP_PX + row * ROW_PX + 28, 0.5)
        _draw_worker(picture, [event for event in events if event.worker == row], TOP_PX + row * ROW_PX, x_of)
    probes = [event for event in events if event.event == "probe"]
    times = np.array([x_of(probe.at_s) for probe in probes])
    memory = np.array([sum((probe.rss_mib or {}).values()) for probe in probes])
    _draw_curve(picture, bottom + 56, "memory of all workers (MiB)", times, memory)
    cores = np.array([probe.cores_used or 0.0 for probe in probes])
    _draw_curve(picture, bottom + 56 + CURVE_PX + 50, "cores in use", times, cores)
    return png_bytes(picture)


def _legend(picture: np.ndarray) -> None:
    x = float(LEFT_PX)
    for name, color in (("starting", STARTING), *COLORS.items()):
        draw_area(picture, _box(x, 48, x + 22, 64), color)
        x = draw_text(picture, LABELS.get(name, name), x + 28, 61, 0.45) + 22


def _box(left: float, top: float, right: float, bottom: float) -> np.ndarray:
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def _draw_worker(picture, events: list[Event], top: float, x_of) -> None:
    free_s = None  # since when the process has been there without an item
    for event in events:
        if event.event in ("worker_started", "restarted"):
            free_s = event.at_s
        if event.event != "item_done" and event.event not in WORDS:
            continue
        begun_s = event.at_s - (event.seconds or 0.0)
        if free_s is not None:
            draw_area(picture, _box(x_of(free_s), top + 12, x_of(begun_s), top + ROW_PX - 12), STARTING)
            free_s = None
        kind = event.status if event.event == "item_done" else event.event
        bar = _box(x_of(begun_s), top + 6, x_of(event.at_s), top + ROW_PX - 6)
        draw_area(picture, bar, COLORS[str(kind)])
        draw_line(picture, bar, PAPER, closed=True)
        name = event.item or ""
        if bar[1, 0] - bar[0, 0] > 8 * len(name) + 8:
            draw_text(picture, name, float(bar[0, 0]) + 5, top + 28, 0.42)
    for event in events:
        if event.event in WORDS:
            draw_dot(picture, np.array([x_of(event.at_s), top + ROW_PX / 2]), 6, COLORS[event.event])


def _draw_curve(picture, top: float, title: str, x: np.ndarray, values: np.ndarray) -> None:
    """Draw values against zero, their greatest at the top."""
    bottom, most = top + CURVE_PX, float(values.max(initial=0.0))
    draw_line(picture, _box(LEFT_PX, top, RIGHT_PX, bottom), INK, closed=True)
    draw_text(picture, title, LEFT_PX, top - 8, 0.5)
    draw_text(picture, f"{most:.4g}", LEFT_PX - 8, top + 8, 0.45, align=1.0)
    draw_text(picture, "0", LEFT_PX - 8, bottom + 4, 0.45, align=1.0)
    if most:
        draw_line(picture, np.stack([x, bottom - CURVE_PX * values / most], axis=1), COLORS["kept"], 2)


def draw_scaling(bench: Bench) -> bytes:
    """Draw three panels: speed against that of one worker times their number, cores and memory, restarts of each run; PNG bytes."""
    rows, (width, height) = bench.undisturbed, PANEL_PX
    picture = np.full((height + 110, 3 * width + 160, 3), PAPER, dtype=np.uint8)
    workers = np.array([row.workers for row in rows], dtype=np.float64)
    speeds = np.array([row.per_s for row in rows])
    ideal = speeds[0] / workers[0] * workers
    unit = "frames/s" if bench.counts_frames else "items/s"
    draw_text(picture, f"{bench.stage} on {bench.cores} cores", 20, 28, 0.65)
    curves = (
        (f"{unit}; faint: if it scaled", [(ideal, FAINT), (speeds, COLORS["kept"])]),
        ("cores in use (blue), GiB (orange)", [(np.array([row.cores_used for row in rows]), COLORS["kept"]),
                                               (np.array([row.peak_memory_mib / 1024 for row in rows]), COLORS["heartbeat_lost"])]),
    )  # fmt: skip
    for number, (title, lines) in enumerate(curves):
        left, top = 60.0 + number * (width + 40), 64.0
        draw_text(picture, title, left, top - 8, 0.5)
        draw_line(picture, _box(left, top, left + width, top + height), INK, closed=True)
        most = max(float(values.max(initial=0.0)) for values, _ in lines) or 1.0
        draw_text(picture, f"{most:.3g}", left - 6, top + 10, 0.42, align=1.0)
        x = left + 20 + (width - 40) * (workers - workers.min()) / max(float(np.ptp(workers)), 1.0)
        for values, color in lines:
            points = np.stack([x, top + height - (height - 12) * values / most], axis=1)
            draw_line(picture, points, color, 2)
            for point in points:
                draw_dot(picture, point, 4, color)
        for place, count in zip(x, workers, strict=True):
            draw_text(picture, f"{count:.0f}", float(place), top + height + 18, 0.45, align=0.5)
        draw_text(picture, "workers", left + width / 2, top + height + 36, 0.42, align=0.5)
    left, top = 60.0 + 2 * (width + 40), 64.0
    draw_text(picture, "restarts of each run", left, top - 8, 0.5)
    draw_line(picture, _box(left, top, left + width, top + height), INK, closed=True)
    most_restarts, step = max(1, *(row.restarts for row in bench.rows)), width / len(bench.rows)
    for number, row in enumerate(bench.rows):
        x, bar = left + number * step, (height - 40) * row.restarts / most_restarts
        draw_area(picture, _box(x + 8, top + height - bar, x + step - 8, top + height), COLORS["worker_died"])
        draw_text(picture, str(row.restarts), x + step / 2, top + height - bar - 6, 0.45, align=0.5)
        name = f"{row.workers}" if row.fault == "none" else f"{row.workers}, {row.fault}"
        draw_text(picture, name, x + step / 2, top + height + 18, 0.42, align=0.5)
    draw_text(picture, "workers, planted faults", left + width / 2, top + height + 36, 0.42, align=0.5)
    return png_bytes(picture)


def _ticks(span_s: float) -> np.ndarray:
    """Give about eight round numbers of seconds from 0."""
    rough = max(span_s, 1e-3) / 8.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(k for k in (1.0, 2.0, 5.0, 10.0) if k * power >= rough)
    return np.arange(0.0, span_s + 1e-9, step)
