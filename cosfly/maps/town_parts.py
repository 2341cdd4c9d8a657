"""The parts of generated towns: trees, benches, paint and furniture of streets, and the kinds of building blocks."""

from collections.abc import Callable
from typing import Any

import numpy as np

from cosfly.maps.boxlist import PAINT_TOP_M, ROAD_TOP_M, SLAB_M, TOPS_M, BoxList, Pair

WATER_TOP_M = 0.05  # over the ground, so that water is an obstacle to pedestrians
WIDE_M = 26.0  # wider streets have wide pavements and large trees
PASSAGE_M = 3.2  # clear height of passages and arcades
ARCADE_M = 3.0  # depth of an arcade
RAILING_M = 0.2
WATER_BOTTOM_M = -1.2
DASH_M, DASH_GAP_M = 3.0, 6.0
# Lamps and parked cars: distances from the ends of a stretch, which have zebra crossings, to the next, and to the kerb.
LAMPS_START_M, LAMPS_END_M, LAMP_SPACING_M, LAMP_FROM_KERB_M = 9.0, 8.0, 8.0, 1.0
PARKING_START_M, PARKING_END_M, PARKING_SPACING_M, PARKED_FROM_KERB_M = 9.5, 11.0, 6.6, 1.15
TRUCK_SHARE = 0.06  # of parked cars

Range = tuple[float, float]


def point(axis: int, along: float, across: float) -> tuple[float, float]:
    """Return a point of a street along x (axis 0) or along y (axis 1)."""
    return (along, across) if axis == 0 else (across, along)


def pavement_m(street_m: float) -> float:
    """Return the width of each pavement of a street from its width from front to front."""
    return 6.0 if street_m >= WIDE_M else max(2.5, 0.22 * street_m)


class Plot(BoxList):
    """A rectangle of the town, from its low to its high corner, (2,) m, with its own random generator.

    Its boxes are added to the town's list.
    """

    def __init__(self, town: BoxList, low: Pair, high: Pair, rng: np.random.Generator) -> None:
        super().__init__(town.rows, town.kinds, frame=town.frame)
        self.low = np.asarray(low)
        self.high = np.asarray(high)
        self.rng = rng
        self.size = self.high - self.low
        self.middle = (self.low + self.high) / 2

    def at(self, x: float, y: float) -> np.ndarray:
        """Return the point at x and y, shares of the plot's sides from its low corner."""
        return self.low + self.size * (x, y)

    def ring(self, kind: str, outer: Any, inner: Any, heights_m: Range | None = None) -> None:
        """Add four slabs between two rectangles, each by its low and high corner; without heights they are ground."""
        heights = heights_m or (TOPS_M[kind] - SLAB_M, TOPS_M[kind])
        low, high = outer
        inner_low, inner_high = inner
        self.span(kind, low, (high[0], inner_low[1]), *heights)
        self.span(kind, (low[0], inner_high[1]), high, *heights)
        self.span(kind, (low[0], inner_low[1]), (inner_low[0], inner_high[1]), *heights)
        self.span(kind, (inner_high[0], inner_low[1]), (high[0], inner_high[1]), *heights)

    def stack(self, kind: str, center: Pair, yaw_deg: float, *parts: tuple[Pair, float, float]) -> None:
        """Add boxes around one middle, each by its footprint and its height interval."""
        for size, low_m, high_m in parts:
            self.add(kind, center, size, low_m, high_m, yaw_deg)

    def bench(self, axis: int, along: float, across: float) -> None:
        """Add a bench of 1.8 m along a street, and a bin next to it."""
        self.add("Static", point(axis, along, across), point(axis, 1.8, 0.55), 0.0, 0.48)
        self.add("Static", point(axis, along + 1.5, across), (0.5, 0.5), 0.0, 0.95)
        if self.rng.random() < 0.5:  # the inner bin, a box inside a box of the same kind
            self.add("Static", point(axis, along + 1.5, across), (0.4, 0.4), 0.05, 0.9)

    def tree(self, position: Pair, crowns_m: Range, heights_m: Range, parts: float = 0.0) -> None:
        """Add a tree: one box, or a stem and overlapping parts of a crown, as simulators export trees.

        Args:
            crowns_m, heights_m: ranges of the crown's width and the tree's height.
            parts: probability of a tree in parts.
        """
        rng = self.rng
        x, y = position
        crown = rng.uniform(*crowns_m)
        height = rng.uniform(*heights_m)
        has_parts = parts == 1.0 or (parts > 0.0 and rng.random() < parts)
        if not has_parts:
            self.add("Vegetation", position, (crown, crown * rng.uniform(0.9, 1.1)), 0.0, height)
            return
        self.add("Vegetation", position, (0.45, 0.45), 0.0, height * 0.5)
        for dx, dy in ((-1, -1), (1, -1), (-1, 1), (1, 1), (0, 0)):
            is_top = dx == 0
            size = crown * rng.uniform(0.5, 0.65)
            shift = (crown - size) / 2
            low = 2.3 + rng.uniform(0.0, 0.8) + (height * 0.25 if is_top else 0.0)
            top = height * (1.0 if is_top else rng.uniform(0.75, 0.9))
            if top > low:  # a low tree lacks some
                self.add("Vegetation", (x + dx * shift, y + dy * shift), (size, size), low, top)

    def crossing_paths(self, half_m: float) -> None:
        """Lay two crossing paths, and lawn in the quarters between them."""
        low, high = self.low, self.high
        x, y = self.middle
        self.lay("Sidewalks", (low[0], y - half_m), (high[0], y + half_m))
        for south, north in ((low[1], y - half_m), (y + half_m, high[1])):
            self.lay("Sidewalks", (x - half_m, south), (x + half_m, north))
            for west, east in ((low[0], x - half_m), (x + half_m, high[0])):
                self.lay("Terrain", (west, south), (east, north))


def add_road_paint(
    plot: Plot, axis: int, stretch: Range, kerbs: Range, crossings: tuple[bool, bool] = (True, True)
) -> None:
    """Add centre dashes, and zebra crossings at the low and the high end of a stretch of street."""

    def paint(along: float, across: float, length_m: float, width_m: float) -> None:
        size = point(axis, length_m, width_m)
        plot.add("RoadLines", point(axis, along, across), size, ROAD_TOP_M - 0.04, PAINT_TOP_M)

    low, high = stretch
    for start in np.arange(low + 7.0, high - 7.0 - DASH_M, DASH_M + DASH_GAP_M):
        paint(start + DASH_M / 2, (kerbs[0] + kerbs[1]) / 2, DASH_M, 0.16)
    for end, has_crossing in zip((low + 2.5, high - 2.5), crossings, strict=True):
        if has_crossing:
            for across in np.arange(kerbs[0] + 0.7, kerbs[1] - 0.5, 1.2):
                paint(end, across, 3.0, 0.55)


def furnish(
    plot: Plot, axis: int, stretch: Range, kerbs: Range, *, parked_share: float, tree_share: float,
    is_wide: bool = False, has_road: bool = True,
) -> None:  # fmt: skip
    """Add lamps, trees, benches, bins, parked cars and signs along both kerbs of a stretch of street.

    `side` is -1 at the low kerb and 1 at the high one: kerb + side lies on the pavement, kerb - side on the road.
    """
    for side, kerb in zip((-1, 1), kerbs, strict=True):
        _add_lamps_and_trees(plot, axis, stretch, side, kerb, tree_share, is_wide=is_wide)
        if has_road:
            _add_parked_cars(plot, axis, stretch, side, kerb, parked_share)
            _add_sign(plot, axis, stretch, side, kerb)


def _add_lamps_and_trees(
    plot: Plot, axis: int, stretch: Range, side: int, kerb: float, tree_share: float, *, is_wide: bool
) -> None:
    """Add a row of lamps, and of trees or benches between them, on the pavement."""
    rng = plot.rng
    low, high = stretch
    across = kerb + side * LAMP_FROM_KERB_M
    for index, along in enumerate(np.arange(low + LAMPS_START_M, high - LAMPS_END_M, LAMP_SPACING_M)):
        place = point(axis, along, across)
        if index % 3 == 0:
            plot.add("Poles", place, (0.2, 0.2), 0.0, 7.6)
            arm = point(axis, along, across - side * 0.9)  # over the carriageway
            plot.add("Poles", arm, point(axis, 0.16, 2.0), 7.45, 7.6)
        elif (is_wide or index % 3 == 1) and rng.random() < tree_share:
            crowns_m = (3.4, 4.6) if is_wide else (2.6, 3.4)
            plot.tree(place, crowns_m, (5.5, 9.5), 1.0 if is_wide else 0.0)
        elif rng.random() < 0.5:
            plot.bench(axis, along, across)


def _add_parked_cars(plot: Plot, axis: int, stretch: Range, side: int, kerb: float, parked_share: float) -> None:
    """Add cars and a few trucks along a kerb of the carriageway."""
    rng = plot.rng
    low, high = stretch
    for along in np.arange(low + PARKING_START_M, high - PARKING_END_M, PARKING_SPACING_M):
        if rng.random() < parked_share:
            place = point(axis, along + rng.uniform(-0.4, 0.4), kerb - side * PARKED_FROM_KERB_M)
            if rng.random() < TRUCK_SHARE:
                plot.add("Truck", place, point(axis, 6.2, 2.2), ROAD_TOP_M, 2.7)
            else:
                length_m = rng.uniform(4.0, 4.7)
                plot.add("Car", place, point(axis, length_m, 1.8), ROAD_TOP_M, rng.uniform(1.4, 1.65))


def _add_sign(plot: Plot, axis: int, stretch: Range, side: int, kerb: float) -> None:
    """Add one traffic sign on the pavement: near the low end of a stretch at its low kerb, else near the high end."""
    low, high = stretch
    along = low + 6.0 if side < 0 else high - 6.0
    across = kerb + side * 0.6
    plot.add("Poles", point(axis, along, across), (0.08, 0.08), 0.0, 2.9)
    plot.add("TrafficSigns", point(axis, along + 0.07, across), point(axis, 0.06, 0.65), 2.2, 2.85)


def _park(plot: Plot) -> None:
    """Build lawns between two crossing paths, a pond with a stone rim, groves, a hedge with openings."""
    low, high = plot.low, plot.high
    middle = plot.middle
    plot.crossing_paths(2.0)
    pond = np.array([middle + 3.5, high - 3.5])
    water = pond[0] + 0.5, pond[1] - 0.5
    plot.span("Water", *water, -0.8, WATER_TOP_M)
    plot.ring("Static", pond, water, (-0.5, 0.3))
    for x, y in ((0, 0), (1, 0), (0, 1)):  # the quarters without the pond
        quarter_low = np.where((x, y), middle, low) + 4.5
        quarter_high = np.where((x, y), high, middle) - 4.5
        for _ in range(5):
            plot.tree(plot.rng.uniform(quarter_low, quarter_high), (4.0, 6.5), (8.0, 14.0), 0.5)
    for y in (low[1] + 0.5, high[1] - 0.5):
        for west, east in ((low[0], middle[0] - 4.0), (middle[0] + 4.0, high[0])):
            plot.span("Vegetation", (west, y - 0.4), (east, y + 0.4), 0.0, 1.1)
    for step in (-11.0, -7.0, 7.0, 11.0):
        plot.bench(0, middle[0] + step, middle[1] - 2.0 + 0.4)


def _square(plot: Plot) -> None:
    """Build a paved square with a hall, a fountain, kiosks and trees in rows."""
    plot.lay("Sidewalks", plot.low, plot.high)
    low, high = plot.low, plot.high
    middle, size = plot.middle, plot.size
    hall = np.array([size[0] * 0.5, min(14.0, size[1] * 0.3)])
    center = np.array([middle[0], high[1] - hall[1] / 2 - 2.0])
    plot.stack("Buildings", center, 0.0, (hall, -1.5, 9.0), ((6.0, 6.0), 9.0, 17.0))  # a clock tower on the roof
    plot.add("Water", middle - (0.0, 4.0), (5.0, 5.0), -0.6, 0.45)
    plot.ring("Static", np.add(middle, [(-3, -7), (3, -1)]), np.add(middle, [(-2.5, -6.5), (2.5, -1.5)]), (-0.4, 0.6))
    for x in np.linspace(low[0] + 4.0, high[0] - 4.0, 6):
        plot.tree((x, low[1] + 3.5), (3.0, 3.8), (5.5, 7.5))
    for side in (-1, 1):
        kiosk = (middle[0] + side * size[0] * 0.3, middle[1] - size[1] * 0.12)
        plot.add("Static", kiosk, (3.2, 2.6), 0.0, 2.8, side * 18.0)
        plot.add("Static", kiosk, (1.0, 1.0), 0.1, 1.6)  # crates inside it
        plot.bench(1, middle[1] - 4.0, middle[0] + side * 6.0)


def _courtyard(plot: Plot) -> None:
    """Build four L-shaped houses around a green yard, with a passage on every side."""
    plot.lay("Terrain", plot.low, plot.high)
    rng = plot.rng
    low, high = plot.low + 1.5, plot.high - 1.5
    middle = (low + high) / 2
    depth = min(12.0, 0.24 * (high - low).min())
    gap = rng.uniform(5.5, 7.0) / 2
    for sx, sy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        corner = np.array([low[0] if sx < 0 else high[0], low[1] if sy < 0 else high[1]])
        height = rng.uniform(10.0, 19.0)
        back = corner[1] - sy * depth
        plot.span("Buildings", corner, (middle[0] + sx * gap, back), -2.0, height)
        lower = height - rng.choice([0.0, 3.0, 6.0])
        plot.span("Buildings", (corner[0], back), (corner[0] - sx * depth, middle[1] + sy * gap), -2.0, lower)
        roof = corner - (sx * 2.0, sy * 2.0), corner - (sx * 6.0, sy * 6.0)
        plot.span("Buildings", *roof, height, height + 2.6)
        cellar = corner - (sx * 1.0, sy * 1.0), corner - (sx * 9.0, sy * (depth - 1.0))
        plot.span("Buildings", *cellar, -5.0, -2.2)
    for _ in range(4):
        plot.tree(rng.uniform(low + depth + 4.0, high - depth - 4.0), (3.5, 5.0), (6.0, 9.0), 0.5)
    plot.bench(0, *middle)


def _houses(plot: Plot) -> None:
    """Build two rows of slightly turned houses, back to back, with gardens, hedges and garden walls between them."""
    plot.lay("Terrain", plot.low, plot.high)
    rng, middle = plot.rng, plot.middle
    low, high = plot.low, plot.high
    columns = max(2, int((high[0] - low[0]) // 18.0))
    pitch = (high[0] - low[0]) / columns
    for row, side in ((low[1], 1), (high[1], -1)):
        for column in range(columns):
            center = np.array([low[0] + (column + 0.5) * pitch, row + side * 8.5]) + rng.uniform(-0.6, 0.6, 2)
            width = rng.uniform(9.0, 11.0)
            depth = rng.uniform(8.0, 10.0)
            height = rng.uniform(5.6, 7.6)
            yaw = rng.uniform(-7.0, 7.0)
            walls = (width, depth), -0.5, height
            ridge = (width * 0.92, depth * 0.5), height, height + 1.8
            rooms = (width * 0.5, depth * 0.5), 0.2, height - 0.5
            plot.stack("Buildings", center, yaw, walls, ridge, rooms)
            garden = np.array([center[0] + rng.uniform(-3.0, 3.0), (center[1] + side * 5.0 + middle[1]) / 2])
            plot.tree(garden, (2.8, 4.2), (4.0, 7.0), 0.3)
            if column:
                edge = low[0] + column * pitch
                front = edge - 0.12, center[1] + side * 1.0
                back = edge + 0.12, middle[1] - side * 3.5
                plot.span("Walls", front, back, -0.2, 1.7)
    edges = low[0] + pitch * np.arange(columns)
    for x in edges + 3.5:
        plot.span("Fences", (x, middle[1] - 0.06), (x + pitch - 5.5, middle[1] + 0.06), -0.1, 1.2)
    for x in edges:
        plot.span("Vegetation", (x + 0.6, low[1] + 0.4), (x + pitch * 0.55, low[1] + 1.2), 0.0, 1.0)


def _towers(plot: Plot) -> None:
    """Build two towers on podiums and a lower slab between them, on a paved plot."""
    plot.lay("Sidewalks", plot.low, plot.high)
    rng, size = plot.rng, plot.size
    for number, center in enumerate((plot.at(0.27, 0.3), plot.at(0.72, 0.7))):
        podium = size * (0.4, 0.42)
        yaw = float(rng.choice([0.0, 0.0, -12.0, 15.0])) if number else 0.0
        plot.add("Buildings", center, podium, -1.0, 5.0)
        plot.add("Buildings", center, podium * rng.uniform(0.6, 0.72), 5.0, rng.uniform(20.0, 35.0), yaw)
        plot.add("Buildings", center + podium * 0.1, (5.0, 5.0), 1.0, 18.0, yaw)  # the lift shaft, inside
    height = rng.uniform(8.0, 12.0)
    plot.add("Buildings", plot.at(0.73, 0.22), size * (0.34, 0.2), -1.0, height, rng.uniform(-9.0, 9.0))
    for place in ((0.2, 0.62), (0.32, 0.72), (0.2, 0.84), (0.34, 0.9)):
        plot.tree(plot.at(*place), (3.2, 4.4), (6.0, 9.0), 0.5)


def _lanes(plot: Plot) -> None:
    """Build terraces of narrow old houses with lanes between them; one passage has a building over it."""
    plot.lay("Sidewalks", plot.low, plot.high)
    rng = plot.rng
    low, high = plot.low, plot.high
    lane = 5.6
    rows = max(2, int((high[1] - low[1] + lane) // (8.5 + lane)))
    depth = (high[1] - low[1] - (rows - 1) * lane) / rows
    gap_row = rng.integers(rows)
    for row in range(rows):
        base = low[1] + row * (depth + lane)
        x = low[0]
        passage = rng.uniform(0.35, 0.65) * (high[0] - low[0]) + low[0]  # a gap in the terrace
        while x < high[0] - 4.0:
            width = min(rng.uniform(5.5, 9.0), high[0] - x)
            height = rng.uniform(6.5, 13.0)
            ridge = rng.uniform(1.6, 2.6)
            is_passage = x <= passage < x + width
            if is_passage and row == gap_row:
                plot.span("Buildings", (x, base), (x + lane, base + depth), PASSAGE_M, height)
            elif not is_passage:
                plot.span("Buildings", (x, base), (x + width, base + depth), -1.0, height)
                low_y, high_y = base + depth * 0.28, base + depth * 0.72
                plot.span("Buildings", (x + 0.2, low_y), (x + width - 0.2, high_y), height, height + ridge)
            x += lane if is_passage else width
        if row == gap_row:
            plot.bench(0, passage, base - lane / 2 if row else base + depth + lane / 2)


def _skyscrapers(plot: Plot) -> None:
    """Build three towers of different heights on a plaza, with a colonnade of trees."""
    plot.lay("Sidewalks", plot.low, plot.high)
    rng = plot.rng
    for center in (plot.at(0.25, 0.27), plot.at(0.74, 0.34), plot.at(0.42, 0.76)):
        foot = plot.size * rng.uniform(0.24, 0.32, 2)
        height = rng.uniform(40.0, 110.0)
        yaw = float(rng.choice([0.0, 0.0, 20.0, -30.0]))
        plot.add("Buildings", center, foot, -2.0, height * 0.6, yaw)
        plot.add("Buildings", center, foot * 0.75, height * 0.6, height, yaw)
        plot.add("Poles", center, (0.6, 0.6), height, height + 9.0)
        plot.add("Buildings", center, (4.0, 4.0), 0.5, height * 0.55, yaw)  # the lift shaft, inside
    for x in np.arange(plot.low[0] + 5.0, plot.high[0] - 4.0, 9.0):
        plot.tree((x, plot.high[1] - 3.5), (3.0, 4.0), (6.0, 9.0))
    plot.bench(0, *plot.at(0.75, 0.75))


def _campus(plot: Plot) -> None:
    """Build two long halls and a library around a lawn, with paths from door to door."""
    plot.lay("Terrain", plot.low, plot.high)
    rng = plot.rng
    low, high = plot.low, plot.high
    middle, size = plot.middle, plot.size
    for y in (low[1] + size[1] * 0.14, high[1] - size[1] * 0.14):
        hall = np.array([size[0] * rng.uniform(0.62, 0.8), size[1] * 0.17])
        height = rng.uniform(8.0, 15.0)
        skylight = hall * (0.3, 0.6), height, height + 2.8
        lecture_rooms = hall * (0.9, 0.5), 0.2, height - 1.0
        plot.stack("Buildings", (middle[0], y), 0.0, (hall, -1.0, height), skylight, lecture_rooms)
    library = (high[0] - size[0] * 0.14, middle[1])
    plot.add("Buildings", library, size * (0.2, 0.26), -1.0, rng.uniform(14.0, 22.0), rng.uniform(-12.0, 12.0))
    for y in (middle[1] - size[1] * 0.16, middle[1] + size[1] * 0.16):
        plot.lay("Sidewalks", (low[0], y - 1.5), (high[0] - size[0] * 0.28, y + 1.5))
        plot.bench(0, low[0] + size[0] * 0.3, y + 2.4)
    for _ in range(6):
        plot.tree(rng.uniform(plot.at(0.06, 0.3), plot.at(0.66, 0.7)), (4.0, 6.0), (7.0, 12.0), 0.5)


def _farm(plot: Plot) -> None:
    """Build a farmhouse and a barn at a yard, an orchard in rows, a field behind a dry wall."""
    plot.lay("Terrain", plot.low, plot.high)
    rng, size = plot.rng, plot.size
    low, high = plot.low, plot.high
    yaw = rng.uniform(-10.0, 10.0)
    plot.stack("Buildings", plot.at(0.24, 0.2), yaw, ((12.0, 8.5), -0.5, 5.6), ((11.0, 4.4), 5.6, 7.8))  # the house
    plot.stack("Buildings", plot.at(0.3, 0.62), yaw + 90.0, ((17.0, 10.0), -0.3, 6.2), ((16.0, 5.0), 6.2, 8.6))
    plot.add("Static", plot.at(0.44, 0.4), (2.6, 1.6), 0.0, 1.2, yaw)  # a cart
    for x in np.arange(low[0] + size[0] * 0.56, high[0] - 3.0, 6.5):
        for y in np.arange(low[1] + 4.0, low[1] + size[1] * 0.55, 6.5):
            if rng.random() < 0.9:
                plot.tree(np.array([x, y]) + rng.uniform(-0.5, 0.5, 2), (2.4, 3.4), (3.5, 5.0))
    wall = low[1] + size[1] * 0.66
    for a, b in ((0.52, 0.72), (0.8, 1.0)):  # with a gate
        plot.span("Walls", (low[0] + size[0] * a, wall - 0.3), (low[0] + size[0] * b, wall + 0.3), -0.2, 1.0)
    plot.tree(plot.at(0.12, 0.42), (5.0, 7.0), (9.0, 13.0), 1.0)


def _market(plot: Plot) -> None:
    """Build rows of stalls with awnings around a market hall that has arcades on its long sides."""
    plot.lay("Sidewalks", plot.low, plot.high)
    rng, middle = plot.rng, plot.middle
    low, high = plot.low, plot.high
    hall = plot.size * (0.34, 0.26)
    arcades = hall - (0.0, 2 * ARCADE_M), -0.5, PASSAGE_M
    plot.stack("Buildings", middle, 0.0, arcades, (hall, PASSAGE_M, 7.0), (hall * (0.9, 0.4), 7.0, 9.5))
    for x in np.linspace(-0.5, 0.5, 6) * (hall[0] - 0.5):
        for side in (-1, 1):
            plot.add("Poles", np.add(middle, (x, side * (hall[1] / 2 - 0.25))), (0.5, 0.5), 0.0, PASSAGE_M)
    for y in np.arange(low[1] + 4.0, high[1] - 3.0, 7.0):
        for x in np.arange(low[0] + 4.0, high[0] - 3.0, 5.2):
            if (np.abs((x, y) - middle) > hall / 2 + 3.5).any() and rng.random() < 0.7:
                yaw = rng.uniform(-6.0, 6.0)
                awning = (3.2, 2.4), 2.3, 2.5
                plot.stack("Static", (x, y), yaw, ((2.6, 1.6), 0.0, 1.0), awning)
                for post in (x - 1.2, x + 1.2):
                    plot.add("Poles", (post, y), (0.1, 0.1), 0.0, 2.3)
    for x in (low[0] + 2.5, high[0] - 2.5):
        plot.tree((x, middle[1]), (3.5, 4.5), (7.0, 9.0), 1.0)


def _meadow(plot: Plot) -> None:
    """Lay grass with a path along it, two groves and a pavilion: room for a drone to circle."""
    plot.lay("Terrain", plot.low, plot.high)
    middle = plot.middle
    plot.lay("Sidewalks", (plot.low[0], middle[1] - 1.5), (plot.high[0], middle[1] + 1.5))
    for corner in (plot.at(0.18, 0.2), plot.at(0.8, 0.8)):
        for _ in range(4):
            plot.tree(corner + plot.rng.uniform(-5.0, 5.0, 2), (4.0, 6.0), (7.0, 12.0))
    pavilion = plot.at(0.78, 0.24)
    plot.add("Static", pavilion, (5.0, 5.0), 2.7, 3.4)
    for leg in ((-2.2, -2.2), (-2.2, 2.2), (2.2, -2.2), (2.2, 2.2)):
        plot.add("Poles", pavilion + leg, (0.2, 0.2), 0.0, 2.7)
    plot.bench(0, middle[0], middle[1] + 2.4)


BLOCKS: dict[str, Callable[[Plot], None]] = {
    "park": _park, "square": _square, "courtyard": _courtyard, "houses": _houses, "towers": _towers, "lanes": _lanes,
    "skyscrapers": _skyscrapers, "campus": _campus, "farm": _farm, "market": _market, "meadow": _meadow,
}  # fmt: skip
