"""A seeded town: streets on a grid, lawns, and blocks of one kind each, from market to skyscrapers; perhaps a river.

Every block draws from its own random generator, so that one block does not change with another. Pavements are at z = 0;
carriageways, lawns and paint a few centimetres lower, so that no two surfaces share a plane. A few boxes lie below the
ground or inside others, as in maps that simulators export.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator

from cosfly.formats.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.maps.boxlist import BoxList, Pair
from cosfly.maps.town_blocks import BLOCKS, ORDINARY_LOTS, ROAD_TOP_M, SLAB_M, WATER_TOP_M, Lots, Plot, Range, point
from cosfly.runtime.config import Config
from cosfly.runtime.errors import nearest
from cosfly.runtime.seeding import rng_for

GENERATOR_VERSION = "1"

MIN_BLOCK_M = 34.0  # no kind of block fits into a smaller one
WIDE_M = 26.0  # wider streets have wide pavements and large trees
VERGE_M = 10.0  # of lawn around the town
DASH_M, DASH_GAP_M = 3.0, 6.0
RAILING_M = 0.2
PAINT_TOP_M, BASE_TOP_M = -0.03, -0.12  # over and below ROAD_TOP_M


@dataclass(frozen=True)
class TownPlan:
    """Streets and blocks of a town; lengths in m."""

    size_m: float = 280.0  # side of the square town
    num_blocks: int = 3  # along each side
    street_m: float = 20.0  # width from front to front
    boulevard_m: float = 28.0  # width of the widest street of each direction
    unevenness: float = 0.0  # how much the sides of blocks differ, as a share of the mean side
    blocks: Mapping[str, float] = field(default_factory=dict)  # share of each kind, a name in BLOCKS
    center: str | None = None  # kind of the block in the middle
    lots: Lots = ORDINARY_LOTS  # buildings of blocks of kind `lots`
    river_m: float = 0.0  # width of a river in place of a boulevard; 0: none
    bridges: int = 0  # streets that cross the river; 0: all
    shore_m: float = 0.0  # width of open water along the south edge; 0: none
    parked_share: float = 0.4  # of parking places that are taken
    tree_share: float = 0.85  # of places of street trees that are planted
    tree_parts: bool = True  # trees of wide streets consist of parts, as simulators export them

    @property
    def narrowest_block_m(self) -> float:
        """The smallest side of a block, for any seed."""
        streets = self.num_blocks * self.street_m + max(self.boulevard_m, self.river_m)
        side = (self.size_m - 2 * VERGE_M - streets) / self.num_blocks
        return side * (1.0 - self.unevenness) / (1.0 + self.unevenness)


# Towns of different plan, density and height, so that results of one can be checked in another.
PRESETS = {"small_town": TownPlan()} | {
    name: TownPlan(size_m, along, street_m, boulevard_m, unevenness, kinds, river_m=river_m, parked_share=parked,
                   tree_share=trees)
    for name, size_m, along, street_m, boulevard_m, river_m, unevenness, parked, trees, kinds in (
        ("grid", 330.0, 4, 18.0, 26.0, 0.0, 0.0, 0.6, 0.85,
         {"courtyard": 0.6, "towers": 0.2, "square": 0.1, "park": 0.1}),
        ("old_town", 270.0, 4, 12.0, 15.0, 0.0, 0.12, 0.1, 0.3, {"lanes": 0.75, "square": 0.15, "market": 0.1}),
        ("towers", 340.0, 3, 26.0, 40.0, 0.0, 0.1, 0.4, 0.85, {"skyscrapers": 0.55, "towers": 0.25, "square": 0.2}),
        ("park", 320.0, 3, 16.0, 26.0, 0.0, 0.2, 0.2, 0.85, {"park": 0.45, "meadow": 0.35, "houses": 0.2}),
        ("campus", 310.0, 3, 15.0, 28.0, 0.0, 0.15, 0.15, 0.85, {"campus": 0.6, "meadow": 0.2, "square": 0.2}),
        ("village", 300.0, 3, 13.0, 16.0, 0.0, 0.3, 0.1, 0.4, {"farm": 0.45, "houses": 0.35, "meadow": 0.2}),
        ("river", 320.0, 4, 16.0, 26.0, 46.0, 0.1, 0.4, 0.85,
         {"courtyard": 0.45, "houses": 0.2, "park": 0.2, "square": 0.15}),
        ("market", 280.0, 3, 18.0, 30.0, 0.0, 0.1, 0.2, 0.85, {"market": 0.45, "courtyard": 0.35, "lanes": 0.2}),
    )
}  # fmt: skip


class SyntheticConfig(Config):
    """The synthetic town."""

    name: str = Field("SynthTown", min_length=1, description="map name, the head of the playback tree's folder names")
    preset: str = Field("small_town", description=f"kind of town: {', '.join(PRESETS)}")
    size_m: float | None = Field(
        None, ge=80.0, le=4000.0, description="side of the square town, m; null takes the preset's"
    )
    num_blocks: int | None = Field(None, ge=1, le=60, description="blocks along each side; null takes the preset's")

    @model_validator(mode="after")
    def _is_possible(self) -> SyntheticConfig:
        if self.preset not in PRESETS:
            hint = nearest(self.preset, list(PRESETS))
            raise ValueError(f"there is no preset {self.preset!r}{hint}; there are {', '.join(PRESETS)}")
        if (side := self.plan.narrowest_block_m) < MIN_BLOCK_M:
            what = f"a block would be {side:.1f} m wide, less than {MIN_BLOCK_M:.0f} m"
            raise ValueError(f"{what}: raise size_m or lower num_blocks")
        return self

    @property
    def plan(self) -> TownPlan:
        """The preset with the given sizes."""
        given = {name: value for name in ("size_m", "num_blocks") if (value := getattr(self, name)) is not None}
        return dataclasses.replace(PRESETS[self.preset], **given)

    @property
    def licence(self) -> str:
        return OUR_LICENCE

    def inputs(self) -> dict[str, Path]:
        return {}


class Strip(NamedTuple):
    """One street's cross-section along its axis: from front to front, and the carriageway inside."""

    low_m: float
    high_m: float
    road: Range

    @property
    def middle_m(self) -> float:
        return (self.low_m + self.high_m) / 2


@dataclass(frozen=True)
class Streets:
    """All streets, low to high: rows along x, columns along y; river: the row that is water, if there is one."""

    rows: list[Strip]
    columns: list[Strip]
    river: Strip | None

    def along(self, axis: int) -> list[Strip]:
        """Return the streets along x (0) or y (1)."""
        return self.columns if axis else self.rows

    def stretches(self, axis: int) -> list[Range]:
        """Return the stretches of a street along an axis between the carriageways that cross it."""
        return [(a.road[1], b.road[0]) for a, b in pairwise(self.along(1 - axis))]

    def blocks(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the low and the high corner of each block, row by row."""
        return [
            (np.array([a.high_m, c.high_m]), np.array([b.low_m, d.low_m]))
            for c, d in pairwise(self.rows)
            for a, b in pairwise(self.columns)
        ]


def load(cfg: SyntheticConfig, seed: int) -> BoxMap:
    """Build the town of a seed."""
    return build_town(cfg.plan, cfg.name, seed)


def build_town(plan: TownPlan, name: str, seed: int) -> BoxMap:
    """Build the town of a plan and a seed."""
    streets, half = street_grid(plan, seed), plan.size_m / 2

    def plot_of(low: Pair, high: Pair, item: str) -> Plot:
        return Plot(boxes, low, high, rng_for(seed, "maps", item), plan.lots)

    boxes, corners = BoxList(), ((-half, -half), (half, half))
    town = plot_of(*corners, "verge")
    town.span("Terrain", *corners, BASE_TOP_M - SLAB_M, BASE_TOP_M)
    _add_surfaces(town, streets)
    _add_road_paint(town, streets)
    for axis in (0, 1):
        for number, strip in enumerate(streets.along(axis)):
            _furnish_street(plot_of(*corners, f"street {axis} {number}"), plan, axis, strip, streets)
    _add_crossings(town, streets)
    _add_verge(town, streets)
    if streets.river is not None:
        _add_river(town, plan, streets, streets.river)
    if plan.shore_m:
        town.span("Water", (-half, -half - plan.shore_m), (half, -half - RAILING_M), -1.2, WATER_TOP_M)
        town.span("Walls", (-half, -half - RAILING_M), (half, -half), -1.2, 0.4)  # of a quay
    kinds = _block_kinds(plan, rng_for(seed, "maps", "plan"))
    for number, (kind, block) in enumerate(zip(kinds, streets.blocks(), strict=True)):
        row, column = divmod(number, plan.num_blocks)
        BLOCKS[kind](plot_of(*block, f"block {row} {column}"))
    source = MapSource(tool="cosfly maps synthetic", version=GENERATOR_VERSION, seed=seed)
    return boxes.box_map(MapHeader(name=name, source=source, licence=OUR_LICENCE, ground_z_m=0.0))


def street_grid(plan: TownPlan, seed: int) -> Streets:
    """Return the streets of a town, and its river."""
    wide = 1 if plan.num_blocks > 1 else 0  # the boulevard's place

    def strips(widest_m: float, axis: str) -> list[Strip]:
        widths = [plan.street_m] * (plan.num_blocks + 1)
        widths[wide] = widest_m
        parts = 1.0 + plan.unevenness * rng_for(seed, "maps", axis).uniform(-1.0, 1.0, plan.num_blocks)
        sides_m = (plan.size_m - 2 * VERGE_M - sum(widths)) * parts / parts.sum()
        found, at = [], -plan.size_m / 2 + VERGE_M
        for width, side_m in zip(widths, [*sides_m.tolist(), 0.0], strict=True):
            sidewalk_m = 6.0 if width >= WIDE_M else max(2.5, 0.22 * width)
            found.append(Strip(at, at + width, (at + sidewalk_m, at + width - sidewalk_m)))
            at += width + side_m
        return found

    rows = strips(plan.river_m or plan.boulevard_m, "rows")
    return Streets(rows, strips(plan.boulevard_m, "columns"), rows[wide] if plan.river_m else None)


def _add_surfaces(town: Plot, streets: Streets) -> None:
    """Add carriageways, and a ring of pavement around each block and the town; the ground of a block is its own."""
    rows, columns = streets.rows, streets.columns
    first, last = (columns[0].road[0], rows[0].road[0]), (columns[-1].road[1], rows[-1].road[1])
    for row, column in zip(rows, columns, strict=True):
        if row is not streets.river:
            town.lay("Roads", (first[0], row.road[0]), (last[0], row.road[1]))
        for low, high in streets.stretches(1):
            town.lay("Roads", (column.road[0], low), (column.road[1], high))
    for a, b in pairwise(columns):
        for c, d in pairwise(rows):
            kerbs = (a.road[1], c.road[1]), (b.road[0], d.road[0])
            town.ring("Sidewalks", kerbs, ((a.high_m, c.high_m), (b.low_m, d.low_m)))
    town.ring("Sidewalks", ((columns[0].low_m, rows[0].low_m), (columns[-1].high_m, rows[-1].high_m)), (first, last))


def _add_river(town: Plot, plan: TownPlan, streets: Streets, river: Strip) -> None:
    """Add water from edge to edge between quays, and a bridge with railings where a street along y crosses it."""
    (low, high), count, crossing = river.road, len(streets.columns), streets.columns
    if 0 < plan.bridges < count:  # spread evenly
        crossing = [crossing[int((k + 0.5) * count / plan.bridges)] for k in range(plan.bridges)]
    edges = [-plan.size_m / 2, *(m for strip in crossing for m in (strip.low_m, strip.high_m)), plan.size_m / 2]
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        town.span("Water", (a, low), (b, high), -1.2, WATER_TOP_M)
        for quay in (low, high):
            town.span("Walls", (a, quay - RAILING_M), (b, quay + RAILING_M), -1.2, 0.5)
    for strip in crossing:
        town.lay("Roads", (strip.road[0], low), (strip.road[1], high))
        for side, kerb, edge in ((-1, strip.road[0], strip.low_m), (1, strip.road[1], strip.high_m)):
            town.lay("Sidewalks", (kerb, low), (edge, high))
            town.span("Fences", (edge - side * RAILING_M, low), (edge, high), -SLAB_M, 1.1)


def _add_road_paint(town: Plot, streets: Streets) -> None:
    """Add centre dashes, and a zebra crossing at both ends of every stretch."""
    for axis in (0, 1):
        for strip in streets.along(axis):
            for low, high in streets.stretches(axis) if strip is not streets.river else []:
                dashes = np.arange(low + 7.0, high - 7.0 - DASH_M, DASH_M + DASH_GAP_M) + DASH_M / 2
                stripes = np.arange(strip.road[0] + 0.7, strip.road[1] - 0.5, 1.2)
                paint = [(at, strip.middle_m, DASH_M, 0.16) for at in dashes]
                paint += [(end, across, 3.0, 0.55) for end in (low + 2.5, high - 2.5) for across in stripes]
                for along, across, length_m, width_m in paint:
                    size = point(axis, length_m, width_m)
                    town.add("RoadLines", point(axis, along, across), size, ROAD_TOP_M - 0.04, PAINT_TOP_M)


def _furnish_street(plot: Plot, plan: TownPlan, axis: int, strip: Strip, streets: Streets) -> None:
    """Add lamps, trees, parked cars, benches, bins and signs along both kerbs of a street."""
    rng, wide = plot.rng, strip.high_m - strip.low_m >= WIDE_M
    parked_share = plan.parked_share if strip is not streets.river else 0.0
    for low, high in streets.stretches(axis):
        for side, kerb in ((-1, strip.road[0]), (1, strip.road[1])):
            row = kerb + side * 1.0  # of lamps and trees, on the pavement
            for number, along in enumerate(np.arange(low + 9.0, high - 8.0, 8.0)):
                place = point(axis, along, row)
                if number % 3 == 0:
                    plot.add("Poles", place, (0.2, 0.2), 0.0, 7.6)
                    plot.add("Poles", point(axis, along, row - side * 0.9), point(axis, 0.16, 2.0), 7.45, 7.6)
                elif (wide or number % 3 == 1) and rng.random() < plan.tree_share:
                    crowns = (3.4, 4.6) if wide else (2.6, 3.4)
                    plot.tree(place, crowns, (5.5, 9.5), float(wide and plan.tree_parts))
                elif rng.random() < 0.5:
                    plot.bench(axis, along, row)
            for along in np.arange(low + 9.5, high - 11.0, 6.6):
                if rng.random() < parked_share:
                    place = point(axis, along + rng.uniform(-0.4, 0.4), kerb - side * 1.15)
                    is_truck = rng.random() < 0.06
                    size = (6.2, 2.2) if is_truck else (rng.uniform(4.0, 4.7), 1.8)
                    top = 2.7 if is_truck else rng.uniform(1.4, 1.65)
                    plot.add("Truck" if is_truck else "Car", place, point(axis, *size), ROAD_TOP_M, top)
            along, across = low + 6.0 if side < 0 else high - 6.0, kerb + side * 0.6
            plot.add("Poles", point(axis, along, across), (0.08, 0.08), 0.0, 2.9)
            plot.add("TrafficSigns", point(axis, along + 0.07, across), point(axis, 0.06, 0.65), 2.2, 2.85)


def _add_crossings(town: Plot, streets: Streets) -> None:
    """Add a signal on two opposite corners of every inner crossing; its lamps are boxes inside its housing."""
    for a in streets.columns[1:-1]:
        for b in (strip for strip in streets.rows[1:-1] if strip is not streets.river):
            for side, end in ((-1, 0), (1, 1)):
                x, y = a.road[end] + side * 0.7, b.road[end] + side * 0.7
                town.add("Poles", (x, y), (0.16, 0.16), 0.0, 3.4)
                town.add("TrafficLight", (x - side * 0.3, y), (0.36, 0.34), 2.5, 3.5)
                for low in (2.54, 2.86, 3.18):
                    town.add("TrafficLight", (x - side * 0.3, y), (0.3, 0.3), low, low + 0.28)
    low_m, high_m = streets.columns[0].low_m, streets.columns[-1].high_m
    for strip in streets.rows:  # a sewer under every street along x
        town.span("Static", (low_m, strip.middle_m - 0.6), (high_m, strip.middle_m + 0.6), -4.2, -3.0)


def _add_verge(town: Plot, streets: Streets) -> None:
    """Add lawn, trees and a fence with gates around the town, but not in a river."""
    rng, half, edge, river = town.rng, town.high[0], streets.columns[-1].high_m, streets.river
    town.ring("Terrain", (town.low, town.high), ((-edge,) * 2, (edge,) * 2))
    for side in (-1, 1):
        for axis in (0, 1):
            for at in np.arange(-half + 2.0, half - 12.0, 14.0):  # 12 m panels, 2 m gates
                if river is None or axis == 0 or not river.low_m < at + 6.0 < river.high_m:
                    place = point(axis, at + 6.0, side * (half - 0.4))
                    town.add("Fences", place, point(axis, 12.0, 0.1), -0.1, 1.3)
            for at in np.arange(-half + 8.0, half - 6.0, 11.0):
                in_river = river is not None and axis == 1 and river.low_m - 6.0 < at < river.high_m + 6.0
                if rng.random() < 0.75 and not in_river:
                    along = at + rng.uniform(-2, 2)
                    place = point(axis, along, side * (half - 0.45 * VERGE_M + rng.uniform(-0.8, 0.8)))
                    town.tree(place, (3.5, 5.5), (6.0, 12.0))


def _block_kinds(plan: TownPlan, rng: np.random.Generator) -> list[str]:
    """Return one kind for each block, shuffled: of each its share, or a park, a square, and the built kinds in turn."""
    count = plan.num_blocks * plan.num_blocks
    if plan.blocks:  # of each kind so many, the largest remainders rounded up
        exact = {name: share / sum(plan.blocks.values()) * count for name, share in plan.blocks.items()}
        kinds = [name for name, value in exact.items() for _ in range(int(value))]
        kinds += sorted(exact, key=lambda name: int(exact[name]) - exact[name])[: count - len(kinds)]
    else:
        share = max(1, count // 9)
        kinds = ["park"] * (share if count > 1 else 0) + ["square"] * (share if count > 3 else 0)
        kinds += [("courtyard", "houses", "towers")[i % 3] for i in range(count - len(kinds))]
    kinds = [kinds[i] for i in rng.permutation(count)]
    if plan.center in kinds:
        middle, at = plan.num_blocks // 2 * (plan.num_blocks + 1), kinds.index(plan.center)
        kinds[middle], kinds[at] = kinds[at], kinds[middle]
    return kinds
