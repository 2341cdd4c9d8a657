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
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from cosfly.formats.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.maps.boxlist import BASE_TOP_M, SLAB_M, BoxList, MapName, Pair
from cosfly.maps.town_parts import (
    BLOCKS,
    RAILING_M,
    WATER_BOTTOM_M,
    WATER_TOP_M,
    WIDE_M,
    Plot,
    Range,
    add_road_paint,
    furnish,
    pavement_m,
    point,
)
from cosfly.runtime.config import Config, read_yaml
from cosfly.runtime.errors import nearest
from cosfly.runtime.seeding import rng_for

GENERATOR_VERSION = "1"

MIN_BLOCK_M = 34.0  # no kind of block fits into a smaller one

VERGE_M = 10.0  # of lawn around the town


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
    river_m: float = 0.0  # width of a river in place of a boulevard; 0: none
    parked_share: float = 0.4  # of parking places that are taken
    tree_share: float = 0.85  # of places of street trees that are planted

    @property
    def narrowest_block_m(self) -> float:
        """The smallest side of a block, for any seed."""
        streets = self.num_blocks * self.street_m + max(self.boulevard_m, self.river_m)
        side = (self.size_m - 2 * VERGE_M - streets) / self.num_blocks
        return side * (1.0 - self.unevenness) / (1.0 + self.unevenness)


PRESETS = {name: TownPlan(**fields) for name, fields in read_yaml(Path(__file__).with_name("towns.yaml")).items()}


class SyntheticConfig(Config):
    """The synthetic town."""

    name: MapName = "SynthTown"
    preset: str = Field("small_town", description=f"kind of town: {', '.join(PRESETS)}")
    size_m: float | None = Field(
        None, ge=80.0, le=4000.0, description="side of the square town, m; null takes the preset's"
    )
    num_blocks: int | None = Field(None, ge=1, le=60, description="blocks along each side; null takes the preset's")

    @model_validator(mode="after")
    def _is_possible(self) -> SyntheticConfig:
        if self.preset not in PRESETS:
            hint = nearest(self.preset, list(PRESETS))
            raise ValueError(f"there is no preset {self.preset!r}{hint}; choose one of {', '.join(PRESETS)}")
        if (side := self.plan.narrowest_block_m) < MIN_BLOCK_M:
            expected = f"at least {MIN_BLOCK_M:.0f} m"
            raise ValueError(f"the blocks are {side:.1f} m wide; expected {expected}; raise size_m or lower num_blocks")
        return self

    @property
    def plan(self) -> TownPlan:
        """The preset, with the sizes of these settings where they are set."""
        sizes = {"size_m": self.size_m, "num_blocks": self.num_blocks}
        changes: dict[str, Any] = {name: value for name, value in sizes.items() if value is not None}
        return dataclasses.replace(PRESETS[self.preset], **changes)

    @property
    def licence(self) -> str:
        return OUR_LICENCE

    def inputs(self) -> dict[str, Path]:
        return {}


class Strip(NamedTuple):
    """The cross-section of one street, coordinates in m across it, world frame."""

    low_m: float  # house fronts
    high_m: float
    road: Range  # both kerbs of the carriageway

    @property
    def middle_m(self) -> float:
        return (self.low_m + self.high_m) / 2


@dataclass(frozen=True)
class Streets:
    """All streets of a town, from low to high coordinates."""

    rows: list[Strip]  # along x
    columns: list[Strip]  # along y
    river: Strip | None  # the row that is water, if there is one

    def along(self, axis: int) -> list[Strip]:
        """Return the streets along x (0) or y (1)."""
        return self.columns if axis else self.rows

    def stretches(self, axis: int) -> list[Range]:
        """Return the stretches of the streets along an axis: the intervals between the carriageways that cross them."""
        return [(a.road[1], b.road[0]) for a, b in pairwise(self.along(1 - axis))]

    def blocks(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the low and the high corner of each block, row by row."""
        return [
            (np.array([west.high_m, south.high_m]), np.array([east.low_m, north.low_m]))
            for south, north in pairwise(self.rows)
            for west, east in pairwise(self.columns)
        ]


def load(cfg: SyntheticConfig, seed: int) -> BoxMap:
    """Build the town of a seed."""
    return build_town(cfg.plan, cfg.name, seed)


def build_town(plan: TownPlan, name: str, seed: int) -> BoxMap:
    """Build the town of a plan and a seed.

    Builders add boxes in four ways: `add` takes the center and the size of a footprint, `span` two corners of it,
    `lay` adds ground between two corners at the height of its kind, and `ring` fills the area between two rectangles.
    """
    streets = street_grid(plan, seed)
    half = plan.size_m / 2
    boxes = BoxList()
    corners = ((-half, -half), (half, half))

    def plot_of(low: Pair, high: Pair, item: str) -> Plot:
        return Plot(boxes, low, high, rng_for(seed, "maps", item))

    town = plot_of(*corners, "verge")
    town.span("Terrain", *corners, BASE_TOP_M - SLAB_M, BASE_TOP_M)
    _add_surfaces(town, streets)
    for axis in (0, 1):
        for strip in streets.along(axis):
            if strip is not streets.river:
                for stretch in streets.stretches(axis):
                    add_road_paint(town, axis, stretch, strip.road)
    for axis in (0, 1):
        for index, strip in enumerate(streets.along(axis)):
            plot = plot_of(*corners, f"street {axis} {index}")
            is_wide = strip.high_m - strip.low_m >= WIDE_M
            parked_share = 0.0 if strip is streets.river else plan.parked_share
            for stretch in streets.stretches(axis):
                furnish(
                    plot, axis, stretch, strip.road, is_wide=is_wide, tree_share=plan.tree_share,
                    parked_share=parked_share,
                )  # fmt: skip
    _add_traffic_lights(town, streets)
    _add_sewers(town, streets)
    _add_verge(town, streets)
    if streets.river is not None:
        _add_river(town, plan, streets, streets.river)
    kinds = _block_kinds(plan, rng_for(seed, "maps", "plan"))
    for index, (kind, block) in enumerate(zip(kinds, streets.blocks(), strict=True)):
        row, column = divmod(index, plan.num_blocks)
        BLOCKS[kind](plot_of(*block, f"block {row} {column}"))
    source = MapSource(tool="cosfly maps synthetic", version=GENERATOR_VERSION, seed=seed)
    return boxes.box_map(MapHeader(name=name, source=source, licence=OUR_LICENCE, ground_z_m=0.0))


def street_grid(plan: TownPlan, seed: int) -> Streets:
    """Return the streets of a town, and its river."""
    widest = 1 if plan.num_blocks > 1 else 0  # index of the boulevard or the river
    rows = _strips(plan, widest, plan.river_m or plan.boulevard_m, rng_for(seed, "maps", "rows"))
    columns = _strips(plan, widest, plan.boulevard_m, rng_for(seed, "maps", "columns"))
    return Streets(rows, columns, rows[widest] if plan.river_m else None)


def _strips(plan: TownPlan, widest: int, widest_m: float, rng: np.random.Generator) -> list[Strip]:
    """Return the parallel streets of one direction; the one with the index `widest` is `widest_m` wide."""
    widths_m = [plan.street_m] * (plan.num_blocks + 1)
    widths_m[widest] = widest_m
    shares = 1.0 + plan.unevenness * rng.uniform(-1.0, 1.0, plan.num_blocks)
    sides_m = (plan.size_m - 2 * VERGE_M - sum(widths_m)) * shares / shares.sum()  # of the blocks between the streets
    strips = []
    at_m = -plan.size_m / 2 + VERGE_M
    for width_m, side_m in zip(widths_m, [*sides_m.tolist(), 0.0], strict=True):
        kerbs = at_m + pavement_m(width_m), at_m + width_m - pavement_m(width_m)
        strips.append(Strip(at_m, at_m + width_m, kerbs))
        at_m += width_m + side_m
    return strips


def _add_surfaces(town: Plot, streets: Streets) -> None:
    """Add carriageways, and a ring of pavement around each block and the town; blocks add their own ground."""
    rows, columns = streets.rows, streets.columns
    first = (columns[0].road[0], rows[0].road[0])  # outer corners of the carriageways
    last = (columns[-1].road[1], rows[-1].road[1])
    for row, column in zip(rows, columns, strict=True):
        if row is not streets.river:
            town.lay("Roads", (first[0], row.road[0]), (last[0], row.road[1]))
        for low, high in streets.stretches(1):
            town.lay("Roads", (column.road[0], low), (column.road[1], high))
    for west, east in pairwise(columns):
        for south, north in pairwise(rows):
            kerbs = (west.road[1], south.road[1]), (east.road[0], north.road[0])
            fronts = (west.high_m, south.high_m), (east.low_m, north.low_m)
            town.ring("Sidewalks", kerbs, fronts)
    outer_fronts = (columns[0].low_m, rows[0].low_m), (columns[-1].high_m, rows[-1].high_m)
    town.ring("Sidewalks", outer_fronts, (first, last))


def _add_river(town: Plot, plan: TownPlan, streets: Streets, river: Strip) -> None:
    """Add water from edge to edge between quays, and a bridge with railings where a street along y crosses it."""
    low, high = river.road
    bridge_edges = [m for strip in streets.columns for m in (strip.low_m, strip.high_m)]
    edges = [-plan.size_m / 2, *bridge_edges, plan.size_m / 2]
    for start, end in zip(edges[::2], edges[1::2], strict=True):  # between the bridges
        town.span("Water", (start, low), (end, high), WATER_BOTTOM_M, WATER_TOP_M)
        for quay in (low, high):
            town.span("Walls", (start, quay - RAILING_M), (end, quay + RAILING_M), WATER_BOTTOM_M, 0.5)
    for strip in streets.columns:
        town.lay("Roads", (strip.road[0], low), (strip.road[1], high))
        for side, kerb, edge in ((-1, strip.road[0], strip.low_m), (1, strip.road[1], strip.high_m)):
            town.lay("Sidewalks", (kerb, low), (edge, high))
            town.span("Fences", (edge - side * RAILING_M, low), (edge, high), -SLAB_M, 1.1)


def _add_traffic_lights(town: Plot, streets: Streets) -> None:
    """Add a signal on two opposite corners of every inner crossing; its lamps are boxes inside its housing."""
    crossing_rows = [strip for strip in streets.rows[1:-1] if strip is not streets.river]
    for column in streets.columns[1:-1]:
        for row in crossing_rows:
            for side, end in ((-1, 0), (1, 1)):
                x = column.road[end] + side * 0.7
                y = row.road[end] + side * 0.7
                town.add("Poles", (x, y), (0.16, 0.16), 0.0, 3.4)
                town.add("TrafficLight", (x - side * 0.3, y), (0.36, 0.34), 2.5, 3.5)
                for low in (2.54, 2.86, 3.18):
                    town.add("TrafficLight", (x - side * 0.3, y), (0.3, 0.3), low, low + 0.28)


def _add_sewers(town: Plot, streets: Streets) -> None:
    """Add a sewer under every street along x."""
    low_m, high_m = streets.columns[0].low_m, streets.columns[-1].high_m
    for strip in streets.rows:
        town.span("Static", (low_m, strip.middle_m - 0.6), (high_m, strip.middle_m + 0.6), -4.2, -3.0)


def _add_verge(town: Plot, streets: Streets) -> None:
    """Add lawn, trees and a fence with gates around the town, but not in a river."""
    rng = town.rng
    river = streets.river
    half = town.high[0]
    edge = streets.columns[-1].high_m
    town.ring("Terrain", (town.low, town.high), ((-edge,) * 2, (edge,) * 2))

    def is_in_river(axis: int, along: float, margin_m: float) -> bool:
        return axis == 1 and river is not None and river.low_m - margin_m < along < river.high_m + margin_m

    for side in (-1, 1):
        for axis in (0, 1):
            for start in np.arange(-half + 2.0, half - 12.0, 14.0):  # 12 m panels, 2 m gates
                if not is_in_river(axis, start + 6.0, 0.0):
                    place = point(axis, start + 6.0, side * (half - 0.4))
                    town.add("Fences", place, point(axis, 12.0, 0.1), -0.1, 1.3)
            for start in np.arange(-half + 8.0, half - 6.0, 11.0):
                if rng.random() < 0.75 and not is_in_river(axis, start, 6.0):
                    along = start + rng.uniform(-2, 2)
                    place = point(axis, along, side * (half - 0.45 * VERGE_M + rng.uniform(-0.8, 0.8)))
                    town.tree(place, (3.5, 5.5), (6.0, 12.0))


def _block_kinds(plan: TownPlan, rng: np.random.Generator) -> list[str]:
    """Return the kind of each block, shuffled.

    A plan with shares of kinds gets those, the largest remainders rounded up. Another plan gets a park, a square, and
    the built kinds in turn.
    """
    count = plan.num_blocks * plan.num_blocks
    kinds: list[str] = []
    if plan.blocks:
        exact = {name: share / sum(plan.blocks.values()) * count for name, share in plan.blocks.items()}
        for name, value in exact.items():
            kinds += [name] * int(value)
        kinds += sorted(exact, key=lambda name: int(exact[name]) - exact[name])[: count - len(kinds)]
    else:
        num_open = max(1, count // 9)
        if count > 1:
            kinds += ["park"] * num_open
        if count > 3:
            kinds += ["square"] * num_open
        kinds += [("courtyard", "houses", "towers")[i % 3] for i in range(count - len(kinds))]
    kinds = [kinds[i] for i in rng.permutation(count)]
    if plan.center in kinds:
        middle = plan.num_blocks // 2 * (plan.num_blocks + 1)
        swapped = kinds.index(plan.center)
        kinds[middle], kinds[swapped] = kinds[swapped], kinds[middle]
    return kinds
