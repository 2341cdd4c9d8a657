"""What the synthetic town is made of: trees, benches, and the kinds of building blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from pydantic import Field

from cosfly.maps.boxlist import BoxList
from cosfly.runtime.config import Config

# Tops of the surfaces, m. Two centimetres apart at least: a depth buffer tells them apart at 300 m.
PAVED_TOP_M, LAWN_TOP_M, PAINT_TOP_M, ROAD_TOP_M, BASE_TOP_M = 0.0, -0.02, -0.03, -0.06, -0.12
WATER_TOP_M = 0.05  # over the ground, so that it is an obstacle: nobody walks on a pond
SLAB_M = 0.3
PASSAGE_M, ARCADE_M = 3.2, 3.0  # what people walk under: its clear height, the depth of an arcade
LEAST_FRONT_M = 7.0  # what is left of a row is built up if it is longer


class LotsConfig(Config):
    """The buildings of blocks of kind `lots`."""

    footprints_m: list[tuple[float, float]] = Field(
        [(12.0, 10.0), (18.0, 13.0), (26.0, 15.0)], min_length=1, description="sizes to choose from: front, depth, m"
    )
    heights_m: tuple[float, float] = Field((8.0, 20.0), description="lowest and highest building, m")
    fall_m: float = Field(
        0.0, ge=0.0, description="distance from the middle of the town at which only the lowest stand, m; 0: anywhere"
    )
    gap_m: float = Field(2.0, ge=0.5, le=60.0, description="least gap between two buildings, m")
    setback_m: float = Field(1.0, ge=0.0, le=20.0, description="from the pavement to the fronts, m")


def ring(
    boxes: BoxList, kind: str, low, high, inner_low, inner_high, top_m: float, base_m: float | None = None
) -> None:
    """Four slabs round a rectangle."""
    base = top_m - SLAB_M if base_m is None else base_m
    boxes.add_span(kind, low, (high[0], inner_low[1]), base, top_m)
    boxes.add_span(kind, (low[0], inner_high[1]), high, base, top_m)
    boxes.add_span(kind, (low[0], inner_low[1]), (inner_low[0], inner_high[1]), base, top_m)
    boxes.add_span(kind, (inner_high[0], inner_low[1]), (high[0], inner_high[1]), base, top_m)


def bench(boxes: BoxList, axis: int, along: float, across: float, rng: np.random.Generator) -> None:
    """A bench of 1.8 m along a street, and a bin beside it."""
    boxes.add("Static", point(axis, along, across), point(axis, 1.8, 0.55), 0.0, 0.48)
    boxes.add("Static", point(axis, along + 1.5, across), (0.5, 0.5), 0.0, 0.95)
    if rng.random() < 0.5:  # the bin's liner: a box inside a box of the same kind
        boxes.add("Static", point(axis, along + 1.5, across), (0.4, 0.4), 0.05, 0.9)


def tree(
    boxes: BoxList, xy, crown_m: float, height_m: float, rng: np.random.Generator, *, in_parts: bool = False
) -> None:
    """One box from the ground to the top, or a stem and overlapping parts of a crown, as simulators export trees."""
    x, y = xy
    if not in_parts:
        boxes.add("Vegetation", xy, (crown_m, crown_m * rng.uniform(0.9, 1.1)), 0.0, height_m)
        return
    boxes.add("Vegetation", xy, (0.45, 0.45), 0.0, height_m * 0.5)
    for part in range(5):
        size = crown_m * rng.uniform(0.5, 0.65)
        shift = (crown_m - size) / 2
        dx, dy = ((-shift, -shift), (shift, -shift), (-shift, shift), (shift, shift), (0.0, 0.0))[part]
        low = 2.3 + rng.uniform(0.0, 0.8) + (height_m * 0.25 if part == 4 else 0.0)
        boxes.add(
            "Vegetation", (x + dx, y + dy), (size, size), low, height_m * (1.0 if part == 4 else rng.uniform(0.75, 0.9))
        )


def point(axis: int, along: float, across: float) -> tuple[float, float]:
    """Return a point of a street along x (axis 0) or along y (axis 1)."""
    return (along, across) if axis == 0 else (across, along)


def _ground(boxes: BoxList, kind: str, low: np.ndarray, high: np.ndarray) -> None:
    top = PAVED_TOP_M if kind == "Sidewalks" else LAWN_TOP_M
    boxes.add_span(kind, low, high, top - SLAB_M, top)


def _park(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Lawns between two crossing paths, a pond with a stone rim, groves, a hedge with openings."""
    middle = (low + high) / 2
    lane = 2.0
    boxes.add_span("Sidewalks", (low[0], middle[1] - lane), (high[0], middle[1] + lane), -SLAB_M, PAVED_TOP_M)
    for a, b in ((low[1], middle[1] - lane), (middle[1] + lane, high[1])):
        boxes.add_span("Sidewalks", (middle[0] - lane, a), (middle[0] + lane, b), -SLAB_M, PAVED_TOP_M)
        boxes.add_span("Terrain", (low[0], a), (middle[0] - lane, b), LAWN_TOP_M - SLAB_M, LAWN_TOP_M)
        boxes.add_span("Terrain", (middle[0] + lane, a), (high[0], b), LAWN_TOP_M - SLAB_M, LAWN_TOP_M)
    pond = np.array([middle + np.array((3.5, 3.5)), high - 3.5])
    boxes.add_span("Water", pond[0] + 0.5, pond[1] - 0.5, -0.8, WATER_TOP_M)
    ring(boxes, "Static", pond[0], pond[1], pond[0] + 0.5, pond[1] - 0.5, 0.3, base_m=-0.5)
    for quarter_low, quarter_high in (
        (low, middle), ((middle[0], low[1]), (high[0], middle[1])), ((low[0], middle[1]), (middle[0], high[1])),
    ):  # fmt: skip
        inner = np.array([np.asarray(quarter_low) + 4.5, np.asarray(quarter_high) - 4.5])
        for _ in range(5):
            place = rng.uniform(inner[0], inner[1])
            tree(boxes, place, rng.uniform(4.0, 6.5), rng.uniform(8.0, 14.0), rng, in_parts=rng.random() < 0.5)
    for y in (low[1] + 0.5, high[1] - 0.5):
        for a, b in ((low[0], middle[0] - 4.0), (middle[0] + 4.0, high[0])):
            boxes.add_span("Vegetation", (a, y - 0.4), (b, y + 0.4), 0.0, 1.1)
    for step in (-11.0, -7.0, 7.0, 11.0):
        bench(boxes, 0, middle[0] + step, middle[1] - lane + 0.4, rng)


def _square(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """A paved square with a hall, a fountain, kiosks and trees in rows."""
    _ground(boxes, "Sidewalks", low, high)
    middle, size = (low + high) / 2, high - low
    hall = np.array([size[0] * 0.5, min(14.0, size[1] * 0.3)])
    center = np.array([middle[0], high[1] - hall[1] / 2 - 2.0])
    boxes.add("Buildings", center, hall, -1.5, 9.0)
    boxes.add("Buildings", center, (6.0, 6.0), 9.0, 17.0)  # a clock tower on the roof
    boxes.add("Water", (middle[0], middle[1] - 4.0), (5.0, 5.0), -0.6, 0.45)
    outer, inner = middle + np.array([(-3.0, -7.0), (3.0, -1.0)]), middle + np.array([(-2.5, -6.5), (2.5, -1.5)])
    ring(boxes, "Static", outer[0], outer[1], inner[0], inner[1], 0.6, -0.4)
    for x in np.linspace(low[0] + 4.0, high[0] - 4.0, 6):
        tree(boxes, (x, low[1] + 3.5), rng.uniform(3.0, 3.8), rng.uniform(5.5, 7.5), rng)
    for side in (-1, 1):
        kiosk = (middle[0] + side * size[0] * 0.3, middle[1] - size[1] * 0.12)
        boxes.add("Static", kiosk, (3.2, 2.6), 0.0, 2.8, yaw_deg=side * 18.0)
        boxes.add("Static", kiosk, (1.0, 1.0), 0.1, 1.6)  # crates inside it
        bench(boxes, 1, middle[1] - 4.0, middle[0] + side * 6.0, rng)


def _courtyard(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Four L-shaped houses round a green yard, with a passage on every side."""
    _ground(boxes, "Terrain", low, high)
    low, high = low + 1.5, high - 1.5
    middle, depth = (low + high) / 2, min(12.0, 0.24 * (high - low).min())
    gap = rng.uniform(5.5, 7.0) / 2
    for sx in (-1, 1):
        for sy in (-1, 1):
            corner = np.array([low[0] if sx < 0 else high[0], low[1] if sy < 0 else high[1]])
            height = rng.uniform(10.0, 19.0)
            back = corner[1] - sy * depth
            _between(boxes, corner, (middle[0] + sx * gap, back), -2.0, height)
            lower = height - rng.choice([0.0, 3.0, 6.0])
            _between(boxes, (corner[0], back), (corner[0] - sx * depth, middle[1] + sy * gap), -2.0, lower)
            _between(boxes, corner - (sx * 2.0, sy * 2.0), corner - (sx * 6.0, sy * 6.0), height, height + 2.6)
            cellar = corner - (sx * 1.0, sy * 1.0), corner - (sx * 9.0, sy * (depth - 1.0))
            _between(boxes, *cellar, -5.0, -2.2)
    yard = np.array([low + depth + 4.0, high - depth - 4.0])
    for _ in range(4):
        place = rng.uniform(yard[0], yard[1])
        tree(boxes, place, rng.uniform(3.5, 5.0), rng.uniform(6.0, 9.0), rng, in_parts=rng.random() < 0.5)
    bench(boxes, 0, middle[0], middle[1], rng)


def _between(boxes: BoxList, a, b, low_m: float, high_m: float, kind: str = "Buildings") -> None:
    """A box whose footprint has two given opposite corners, in any order."""
    boxes.add_span(kind, np.minimum(a, b), np.maximum(a, b), low_m, high_m)


def _houses(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Two rows of detached houses, slightly turned, back to back with gardens, hedges and garden walls between."""
    _ground(boxes, "Terrain", low, high)
    middle = (low + high) / 2
    columns = max(2, int((high[0] - low[0]) // 18.0))
    pitch = (high[0] - low[0]) / columns
    for row, side in ((low[1], 1), (high[1], -1)):
        for column in range(columns):
            center = np.array([low[0] + (column + 0.5) * pitch, row + side * 8.5]) + rng.uniform(-0.6, 0.6, 2)
            width, depth, height = rng.uniform(9.0, 11.0), rng.uniform(8.0, 10.0), rng.uniform(5.6, 7.6)
            yaw = rng.uniform(-7.0, 7.0)
            boxes.add("Buildings", center, (width, depth), -0.5, height, yaw)
            boxes.add("Buildings", center, (width * 0.92, depth * 0.5), height, height + 1.8, yaw)  # the ridge
            boxes.add("Buildings", center, (width * 0.5, depth * 0.5), 0.2, height - 0.5, yaw)  # rooms inside
            garden = np.array([center[0] + rng.uniform(-3.0, 3.0), (center[1] + side * 5.0 + middle[1]) / 2])
            tree(boxes, garden, rng.uniform(2.8, 4.2), rng.uniform(4.0, 7.0), rng, in_parts=rng.random() < 0.3)
            if column:
                edge = low[0] + column * pitch
                front, back = (edge - 0.12, center[1] + side * 1.0), (edge + 0.12, middle[1] - side * 3.5)
                _between(boxes, front, back, -0.2, 1.7, "Walls")
    for column in range(columns):
        a = low[0] + column * pitch + 3.5
        boxes.add_span("Fences", (a, middle[1] - 0.06), (a + pitch - 5.5, middle[1] + 0.06), -0.1, 1.2)
    for column in range(columns):
        a = low[0] + column * pitch
        boxes.add_span("Vegetation", (a + 0.6, low[1] + 0.4), (a + pitch * 0.55, low[1] + 1.2), 0.0, 1.0)


def _towers(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Two towers on podiums, one lower slab between them, on a paved plot."""
    _ground(boxes, "Sidewalks", low, high)
    size = high - low
    for number, share in enumerate((np.array([0.27, 0.3]), np.array([0.72, 0.7]))):
        center = low + size * share
        podium = np.array([size[0] * 0.4, size[1] * 0.42])
        yaw = float(rng.choice([0.0, 0.0, -12.0, 15.0])) if number else 0.0
        boxes.add("Buildings", center, podium, -1.0, 5.0)
        boxes.add("Buildings", center, podium * rng.uniform(0.6, 0.72), 5.0, rng.uniform(20.0, 35.0), yaw)
        boxes.add("Buildings", center + podium * 0.1, (5.0, 5.0), 1.0, 18.0, yaw)  # the lift shaft, inside
    slab, height = size * (0.34, 0.2), rng.uniform(8.0, 12.0)
    boxes.add("Buildings", low + size * (0.73, 0.22), slab, -1.0, height, rng.uniform(-9.0, 9.0))
    for place in ((0.2, 0.62), (0.32, 0.72), (0.2, 0.84), (0.34, 0.9)):
        tree(boxes, low + size * place, rng.uniform(3.2, 4.4), rng.uniform(6.0, 9.0), rng, in_parts=rng.random() < 0.5)


def _lanes(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Terraces of narrow old houses of unlike heights, with lanes between them, one way through built over."""
    _ground(boxes, "Sidewalks", low, high)
    lane, depth = 5.6, 8.5
    rows = max(2, int((high[1] - low[1] + lane) // (depth + lane)))
    depth = (high[1] - low[1] - (rows - 1) * lane) / rows
    gap_row = rng.integers(rows)
    for row in range(rows):
        base, at = low[1] + row * (depth + lane), low[0]
        passage = rng.uniform(0.35, 0.65) * (high[0] - low[0]) + low[0]  # a way through the terrace
        while at < high[0] - 4.0:
            width = min(rng.uniform(5.5, 9.0), high[0] - at)
            height, ridge = rng.uniform(6.5, 13.0), rng.uniform(1.6, 2.6)
            is_passage = at <= passage < at + width
            if is_passage and row == gap_row:
                _between(boxes, (at, base), (at + lane, base + depth), PASSAGE_M, height)
            elif not is_passage:
                _between(boxes, (at, base), (at + width, base + depth), -1.0, height)
                low_y, high_y = base + depth * 0.28, base + depth * 0.72
                _between(boxes, (at + 0.2, low_y), (at + width - 0.2, high_y), height, height + ridge)
            at += width if not is_passage else lane
        if row == gap_row:
            bench(boxes, 0, passage, base - lane / 2 if row else base + depth + lane / 2, rng)


def _skyscrapers(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Three towers of unlike height on a plaza, with a colonnade of trees."""
    _ground(boxes, "Sidewalks", low, high)
    size = high - low
    for place in ((0.25, 0.27), (0.74, 0.34), (0.42, 0.76)):
        center, foot = low + size * place, size * rng.uniform(0.24, 0.32, 2)
        height, yaw = rng.uniform(40.0, 110.0), float(rng.choice([0.0, 0.0, 20.0, -30.0]))
        boxes.add("Buildings", center, foot, -2.0, height * 0.6, yaw)
        boxes.add("Buildings", center, foot * 0.75, height * 0.6, height, yaw)
        boxes.add("Poles", center, (0.6, 0.6), height, height + 9.0)
        boxes.add("Buildings", center, (4.0, 4.0), 0.5, height * 0.55, yaw)  # the lift shaft, inside
    for along in np.arange(low[0] + 5.0, high[0] - 4.0, 9.0):
        tree(boxes, (along, high[1] - 3.5), rng.uniform(3.0, 4.0), rng.uniform(6.0, 9.0), rng)
    bench(boxes, 0, low[0] + size[0] * 0.75, low[1] + size[1] * 0.75, rng)


def _campus(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Two long halls and a library round a lawn, with paths from door to door."""
    _ground(boxes, "Terrain", low, high)
    size, middle = high - low, (low + high) / 2
    for y in (low[1] + size[1] * 0.14, high[1] - size[1] * 0.14):
        long = np.array([size[0] * rng.uniform(0.62, 0.8), size[1] * 0.17])
        height = rng.uniform(8.0, 15.0)
        boxes.add("Buildings", (middle[0], y), long, -1.0, height)
        boxes.add("Buildings", (middle[0], y), (long[0] * 0.3, long[1] * 0.6), height, height + 2.8)
        # Lecture rooms inside.
        boxes.add("Buildings", (middle[0], y), (long[0] * 0.9, long[1] * 0.5), 0.2, height - 1.0)
    library = (high[0] - size[0] * 0.14, middle[1])
    boxes.add("Buildings", library, size * (0.2, 0.26), -1.0, rng.uniform(14.0, 22.0), rng.uniform(-12.0, 12.0))
    for y in (middle[1] - size[1] * 0.16, middle[1] + size[1] * 0.16):
        boxes.add_span("Sidewalks", (low[0], y - 1.5), (high[0] - size[0] * 0.28, y + 1.5), -SLAB_M, PAVED_TOP_M)
        bench(boxes, 0, low[0] + size[0] * 0.3, y + 2.4, rng)
    for _ in range(6):
        place = rng.uniform(low + size * (0.06, 0.3), low + size * (0.66, 0.7))
        tree(boxes, place, rng.uniform(4.0, 6.0), rng.uniform(7.0, 12.0), rng, in_parts=rng.random() < 0.5)


def _farm(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """A farmhouse and a barn at a yard, an orchard in rows, a field behind a dry wall."""
    _ground(boxes, "Terrain", low, high)
    size = high - low
    yaw = rng.uniform(-10.0, 10.0)
    house, barn = low + size * (0.24, 0.2), low + size * (0.3, 0.62)
    boxes.add("Buildings", house, (12.0, 8.5), -0.5, 5.6, yaw)
    boxes.add("Buildings", house, (11.0, 4.4), 5.6, 7.8, yaw)
    boxes.add("Buildings", barn, (17.0, 10.0), -0.3, 6.2, yaw + 90.0)
    boxes.add("Buildings", barn, (16.0, 5.0), 6.2, 8.6, yaw + 90.0)
    boxes.add("Static", low + size * (0.44, 0.4), (2.6, 1.6), 0.0, 1.2, yaw)  # a cart
    for x in np.arange(low[0] + size[0] * 0.56, high[0] - 3.0, 6.5):
        for y in np.arange(low[1] + 4.0, low[1] + size[1] * 0.55, 6.5):
            if rng.random() < 0.9:
                place = np.array([x, y]) + rng.uniform(-0.5, 0.5, 2)
                tree(boxes, place, rng.uniform(2.4, 3.4), rng.uniform(3.5, 5.0), rng)
    wall = low[1] + size[1] * 0.66
    for a, b in ((0.52, 0.72), (0.8, 1.0)):  # with a gate
        boxes.add_span("Walls", (low[0] + size[0] * a, wall - 0.3), (low[0] + size[0] * b, wall + 0.3), -0.2, 1.0)
    tree(boxes, low + size * (0.12, 0.42), rng.uniform(5.0, 7.0), rng.uniform(9.0, 13.0), rng, in_parts=True)


def _market(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Rows of stalls with awnings round a market hall that has arcades on its long sides."""
    _ground(boxes, "Sidewalks", low, high)
    size, middle = high - low, (low + high) / 2
    hall = size * (0.34, 0.26)
    boxes.add("Buildings", middle, hall - (0.0, 2 * ARCADE_M), -0.5, PASSAGE_M)
    boxes.add("Buildings", middle, hall, PASSAGE_M, 7.0)
    boxes.add("Buildings", middle, hall * (0.9, 0.4), 7.0, 9.5)
    for x in np.linspace(-0.5, 0.5, 6) * (hall[0] - 0.5):
        for side in (-1, 1):
            boxes.add("Poles", middle + np.array([x, side * (hall[1] / 2 - 0.25)]), (0.5, 0.5), 0.0, PASSAGE_M)
    for y in np.arange(low[1] + 4.0, high[1] - 3.0, 7.0):
        for x in np.arange(low[0] + 4.0, high[0] - 3.0, 5.2):
            clear = (np.abs(np.array([x, y]) - middle) > hall / 2 + 3.5).any()
            if clear and rng.random() < 0.7:
                yaw = rng.uniform(-6.0, 6.0)
                boxes.add("Static", (x, y), (2.6, 1.6), 0.0, 1.0, yaw)
                boxes.add("Static", (x, y), (3.2, 2.4), 2.3, 2.5, yaw)  # the awning
                boxes.add("Poles", (x - 1.2, y), (0.1, 0.1), 0.0, 2.3)
                boxes.add("Poles", (x + 1.2, y), (0.1, 0.1), 0.0, 2.3)
    for x in (low[0] + 2.5, high[0] - 2.5):
        tree(boxes, (x, middle[1]), rng.uniform(3.5, 4.5), rng.uniform(7.0, 9.0), rng, in_parts=True)


def _meadow(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Open grass with a path along it, two groves and a pavilion: room for a drone to circle."""
    _ground(boxes, "Terrain", low, high)
    size, middle = high - low, (low + high) / 2
    boxes.add_span("Sidewalks", (low[0], middle[1] - 1.5), (high[0], middle[1] + 1.5), -SLAB_M, PAVED_TOP_M)
    for corner in (low + size * (0.18, 0.2), low + size * (0.8, 0.8)):
        for _ in range(4):
            tree(boxes, corner + rng.uniform(-5.0, 5.0, 2), rng.uniform(4.0, 6.0), rng.uniform(7.0, 12.0), rng)
    boxes.add("Static", low + size * (0.78, 0.24), (5.0, 5.0), 2.7, 3.4)
    for dx in (-2.2, 2.2):
        for dy in (-2.2, 2.2):
            boxes.add("Poles", low + size * (0.78, 0.24) + (dx, dy), (0.2, 0.2), 0.0, 2.7)
    bench(boxes, 0, middle[0], middle[1] + 2.4, rng)


def lots(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator, style: LotsConfig) -> None:
    """Two rows of building lots, each with its front to a street, back to back; before a front there is a path."""
    has_gardens = style.setback_m >= 2.5
    _ground(boxes, "Terrain" if has_gardens else "Sidewalks", low, high)
    size, (lowest, highest) = high - low, style.heights_m
    depth = size[1] / 2 - max(2.5, 0.08 * size[1]) - style.setback_m
    fall = min(1.0, float(np.linalg.norm((low + high) / 2)) / style.fall_m) if style.fall_m else 0.0
    for row, side in ((low[1], 1), (high[1], -1)):
        at = low[0] + style.gap_m / 2
        while (room := high[0] - style.gap_m / 2 - at) >= LEAST_FRONT_M:
            front, deep = style.footprints_m[rng.integers(len(style.footprints_m))]
            share = min(1.0, depth / deep)
            front, deep = front * share, deep * share
            front = room if room < front + LEAST_FRONT_M + style.gap_m else front
            height = lowest + (highest - lowest) * rng.beta(1.3, 1.7) * (1.0 - 0.9 * fall)
            middle = np.array([at + front / 2, row + side * (style.setback_m + deep / 2)])
            boxes.add("Buildings", middle, (front, deep), 0.0, height)
            if has_gardens:
                ends = (middle[0] - 0.8, row), (middle[0] + 0.8, row + side * style.setback_m)
                _between(boxes, *ends, -SLAB_M, PAVED_TOP_M, "Sidewalks")
            at += front + style.gap_m * rng.uniform(1.0, 1.6)


def _plaza(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """A paved square, free in the middle, with trees and benches along its edges."""
    _ground(boxes, "Sidewalks", low, high)
    for x in np.arange(low[0] + 6.0, high[0] - 5.0, 11.0):
        for y, inwards in ((low[1] + 2.5, 1), (high[1] - 2.5, -1)):
            tree(boxes, (x, y), rng.uniform(2.8, 3.8), rng.uniform(5.5, 8.0), rng)
            if rng.random() < 0.4:
                bench(boxes, 0, x + 4.0, y + inwards * 1.2, rng)


def _green(boxes: BoxList, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """A lawn between two crossing paths, free in the middle of each quarter, with trees along its edges."""
    middle, lane = (low + high) / 2, 1.5
    boxes.add_span("Sidewalks", (low[0], middle[1] - lane), (high[0], middle[1] + lane), -SLAB_M, PAVED_TOP_M)
    for a, b in ((low[1], middle[1] - lane), (middle[1] + lane, high[1])):
        boxes.add_span("Sidewalks", (middle[0] - lane, a), (middle[0] + lane, b), -SLAB_M, PAVED_TOP_M)
        for c, d in ((low[0], middle[0] - lane), (middle[0] + lane, high[0])):
            boxes.add_span("Terrain", (c, a), (d, b), LAWN_TOP_M - SLAB_M, LAWN_TOP_M)
    for axis in (0, 1):
        for along in np.arange(low[axis] + 6.0, high[axis] - 5.0, 9.0):
            for across in (low[1 - axis] + 4.0, high[1 - axis] - 4.0):
                if abs(along - middle[axis]) > 4.0:
                    tree(boxes, point(axis, along, across), rng.uniform(3.5, 5.5), rng.uniform(7.0, 12.0), rng)


BLOCKS: dict[str, Callable[..., None]] = {
    "park": _park, "square": _square, "courtyard": _courtyard, "houses": _houses, "towers": _towers, "lanes": _lanes,
    "skyscrapers": _skyscrapers, "campus": _campus, "farm": _farm, "market": _market, "meadow": _meadow,
    "plaza": _plaza, "green": _green, "lots": partial(lots, style=LotsConfig()),
}  # fmt: skip
