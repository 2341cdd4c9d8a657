"""A seeded town: streets on a grid, lawns, and blocks of one kind each, from market to skyscrapers; perhaps a river
with bridges.

It is made to be planned and rendered, not to imitate one place. Every block draws from its own random generator, so
that one block does not change with another. Heights: pavements at z = 0; carriageways, lawns and paint a few
centimetres lower, so that no two surfaces share a plane. A few boxes lie below the ground or inside others, as in maps
that simulators export.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from cosfly.formats.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.maps.boxlist import BoxList
from cosfly.maps.town_blocks import (
    BASE_TOP_M,
    BLOCKS,
    LAWN_TOP_M,
    PAINT_TOP_M,
    PAVED_TOP_M,
    ROAD_TOP_M,
    SLAB_M,
    WATER_TOP_M,
    LotsConfig,
    bench,
    lots,
    point,
    ring,
    tree,
)
from cosfly.runtime.config import Config
from cosfly.runtime.errors import nearest
from cosfly.runtime.seeding import rng_for

GENERATOR_VERSION = "1"

MIN_BLOCK_M = 34.0  # below this no block type finds room
DASH_M, DASH_GAP_M = 3.0, 6.0
RAILING_M = 0.2

# What a preset sets; a setting that is given as well wins. Towns of other plan, density and height: what is learnt in
# one is not yet known to hold in another.
PRESETS: dict[str, dict[str, Any]] = {
    "small_town": {},
    "grid": {
        "size_m": 330.0, "num_blocks": 4, "street_m": 18.0, "boulevard_m": 26.0, "unevenness": 0.0, "parked_share": 0.6,
        "blocks": {"courtyard": 0.6, "towers": 0.2, "square": 0.1, "park": 0.1},
    },
    "old_town": {
        "size_m": 270.0, "num_blocks": 4, "street_m": 12.0, "boulevard_m": 15.0, "unevenness": 0.12,
        "parked_share": 0.1, "tree_share": 0.3, "blocks": {"lanes": 0.75, "square": 0.15, "market": 0.1},
    },
    "towers": {
        "size_m": 340.0, "num_blocks": 3, "street_m": 26.0, "boulevard_m": 40.0, "unevenness": 0.1,
        "blocks": {"skyscrapers": 0.55, "towers": 0.25, "square": 0.2},
    },
    "park": {
        "size_m": 320.0, "num_blocks": 3, "street_m": 16.0, "boulevard_m": 26.0, "unevenness": 0.2, "parked_share": 0.2,
        "blocks": {"park": 0.45, "meadow": 0.35, "houses": 0.2},
    },
    "campus": {
        "size_m": 310.0, "num_blocks": 3, "street_m": 15.0, "boulevard_m": 28.0, "unevenness": 0.15,
        "parked_share": 0.15,
        "blocks": {"campus": 0.6, "meadow": 0.2, "square": 0.2},
    },
    "village": {
        "size_m": 300.0, "num_blocks": 3, "street_m": 13.0, "boulevard_m": 16.0, "unevenness": 0.3, "parked_share": 0.1,
        "tree_share": 0.4, "blocks": {"farm": 0.45, "houses": 0.35, "meadow": 0.2},
    },
    "river": {
        "size_m": 320.0, "num_blocks": 4, "street_m": 16.0, "boulevard_m": 26.0, "unevenness": 0.1, "river_m": 46.0,
        "blocks": {"courtyard": 0.45, "houses": 0.2, "park": 0.2, "square": 0.15},
    },
    "market": {
        "size_m": 280.0, "num_blocks": 3, "street_m": 18.0, "boulevard_m": 30.0, "unevenness": 0.1, "parked_share": 0.2,
        "blocks": {"market": 0.45, "courtyard": 0.35, "lanes": 0.2},
    },
}  # fmt: skip


class SyntheticConfig(Config):
    """The synthetic town."""

    name: str = Field("SynthTown", min_length=1, description="map name, the head of the playback tree's folder names")
    preset: str = Field(
        "small_town",
        description="kind of town, which sets what is not given below (a name in PRESETS)",
    )
    size_m: float = Field(280.0, ge=80.0, le=4000.0, description="side of the square town, m")
    num_blocks: int = Field(3, ge=1, le=60, description="building blocks along each side")
    street_m: float = Field(20.0, ge=12.0, le=60.0, description="width of a street from front to front, m")
    boulevard_m: float = Field(28.0, ge=12.0, le=80.0, description="width of the two wide streets, m")
    unevenness: float = Field(
        0.0, ge=0.0, le=0.5, description="how much the sides of blocks differ: share of the mean side; 0: all alike"
    )
    blocks: dict[str, float] = Field(
        {}, description="share of each kind of block (a name in BLOCKS); none: a park, a square, the rest built up"
    )
    center: str | None = Field(None, description="kind of block in the middle, of those in `blocks`; none: any")
    lots: LotsConfig = Field(default_factory=LotsConfig, description="buildings of blocks of kind `lots`")
    river_m: float = Field(0.0, ge=0.0, le=120.0, description="width of a river in place of a boulevard, m; 0: none")
    bridges: int = Field(0, ge=0, description="streets that cross the river; 0: all")
    shore_m: float = Field(0.0, ge=0.0, le=500.0, description="open water along the south edge, how wide, m; 0: none")
    verge_m: float = Field(10.0, ge=4.0, description="lawn round the town, m")
    parked_share: float = Field(0.4, ge=0.0, le=1.0, description="share of parking places that are taken; 0 for none")
    tree_parts: bool = Field(True, description="trees of wide streets in parts, as simulators export them; no: one box")
    tree_share: float = Field(0.85, ge=0.0, le=1.0, description="share of street tree places planted; 0 for none")

    @model_validator(mode="before")
    @classmethod
    def _take_the_presets(cls, given: Any) -> Any:
        if not isinstance(given, dict) or not isinstance(given.get("preset", ""), str):
            return given
        return PRESETS.get(given.get("preset", ""), {}) | given

    @model_validator(mode="after")
    def _names_are_known(self) -> SyntheticConfig:
        center = [(self.center, list(self.blocks))] if self.center else []
        for name, known in (
            (self.preset, list(PRESETS)), *((block, list(BLOCKS)) for block in self.blocks), *center
        ):  # fmt: skip
            if name not in known:
                raise ValueError(f"there is no {name!r}{nearest(name, known)}; there are {', '.join(known)}")
        if self.blocks and (min(self.blocks.values()) < 0 or sum(self.blocks.values()) <= 0):
            raise ValueError("the shares of blocks must not be negative and must add up to more than 0")
        return self

    @model_validator(mode="after")
    def _blocks_have_room(self) -> SyntheticConfig:
        streets = self.num_blocks * self.street_m + max(self.boulevard_m, self.river_m)
        side = (self.size_m - 2 * self.verge_m - streets) / self.num_blocks
        side *= (1.0 - self.unevenness) / (1.0 + self.unevenness)  # the narrowest that chance can give
        if side < MIN_BLOCK_M:
            raise ValueError(
                f"a block would be {side:.1f} m wide, less than {MIN_BLOCK_M:.0f} m: raise size_m or lower num_blocks"
            )
        return self

    @property
    def licence(self) -> str:
        return OUR_LICENCE

    def inputs(self) -> dict[str, Path]:
        return {}


@dataclass(frozen=True)
class Strip:
    """One street's cross-section along its axis: from front to front, with the carriageway inside."""

    low_m: float
    high_m: float
    sidewalk_m: float

    @property
    def middle_m(self) -> float:
        return (self.low_m + self.high_m) / 2

    @property
    def road(self) -> tuple[float, float]:
        return self.low_m + self.sidewalk_m, self.high_m - self.sidewalk_m


@dataclass(frozen=True)
class Streets:
    """All streets, low to high: rows along x, columns along y; river: the row that is water, if there is one."""

    rows: list[Strip]
    columns: list[Strip]
    river: Strip | None

    def along(self, axis: int) -> list[Strip]:
        """Streets along x (0) or y (1)."""
        return self.columns if axis else self.rows

    def stretches(self, axis: int) -> list[tuple[float, float]]:
        """Return the stretches of a street along an axis between the carriageways that cross it."""
        return [(a.road[1], b.road[0]) for a, b in itertools.pairwise(self.along(1 - axis))]


def load(cfg: SyntheticConfig, seed: int) -> BoxMap:
    """Build the town of a seed."""
    boxes = BoxList()
    streets = street_grid(cfg, seed)
    half = cfg.size_m / 2
    boxes.add_span("Terrain", (-half, -half), (half, half), BASE_TOP_M - SLAB_M, BASE_TOP_M)
    _surfaces(boxes, cfg, streets)
    _road_paint(boxes, streets)
    for axis in (0, 1):
        for number, strip in enumerate(streets.along(axis)):
            _street_furniture(boxes, cfg, axis, strip, streets, rng_for(seed, "maps", f"street {axis} {number}"))
    _crossings(boxes, streets)
    _verge(boxes, cfg, streets, rng_for(seed, "maps", "verge"))
    if streets.river is not None:
        _river(boxes, cfg, streets, streets.river)
    if cfg.shore_m:
        _shore(boxes, cfg)
    kinds = _block_kinds(cfg, rng_for(seed, "maps", "plan"))
    makers = BLOCKS | {"lots": partial(lots, style=cfg.lots)}
    for row in range(cfg.num_blocks):
        for column in range(cfg.num_blocks):
            low = np.array([streets.columns[column].high_m, streets.rows[row].high_m])
            high = np.array([streets.columns[column + 1].low_m, streets.rows[row + 1].low_m])
            kind = kinds[row * cfg.num_blocks + column]
            makers[kind](boxes, low, high, rng_for(seed, "maps", f"block {row} {column}"))
    source = MapSource(tool="cosfly maps synthetic", version=GENERATOR_VERSION, seed=seed)
    return boxes.box_map(MapHeader(name=cfg.name, source=source, licence=OUR_LICENCE, ground_z_m=0.0))


def street_grid(cfg: SyntheticConfig, seed: int) -> Streets:
    """Return the streets of a town, and its river."""
    wide = 1 if cfg.num_blocks > 1 else 0  # the boulevard's place
    rows = _strips(cfg, cfg.river_m or cfg.boulevard_m, wide, rng_for(seed, "maps", "rows"))
    columns = _strips(cfg, cfg.boulevard_m, wide, rng_for(seed, "maps", "columns"))
    return Streets(rows, columns, rows[wide] if cfg.river_m else None)


def _strips(cfg: SyntheticConfig, widest_m: float, wide: int, rng: np.random.Generator) -> list[Strip]:
    """Return the streets across one axis, low to high; number `wide` is the widest."""
    widths = [cfg.street_m] * (cfg.num_blocks + 1)
    widths[wide] = widest_m
    parts = 1.0 + cfg.unevenness * rng.uniform(-1.0, 1.0, cfg.num_blocks)
    sides_m = (cfg.size_m - 2 * cfg.verge_m - sum(widths)) * parts / parts.sum()
    strips, at = [], -cfg.size_m / 2 + cfg.verge_m
    for width, side_m in zip(widths, [*sides_m.tolist(), 0.0], strict=True):
        strips.append(Strip(at, at + width, 6.0 if width >= 26 else max(2.5, 0.22 * width)))
        at += width + side_m
    return strips


def _surfaces(boxes: BoxList, cfg: SyntheticConfig, streets: Streets) -> None:
    """Carriageways, and between them one pavement slab for each block (with its own ground on top of it later)."""
    rows, columns = streets.rows, streets.columns
    first, last = (columns[0].road[0], rows[0].road[0]), (columns[-1].road[1], rows[-1].road[1])
    for row, column in zip(rows, columns, strict=True):
        if row is not streets.river:
            boxes.add_span("Roads", (first[0], row.road[0]), (last[0], row.road[1]), ROAD_TOP_M - SLAB_M, ROAD_TOP_M)
        for low, high in streets.stretches(1):
            boxes.add_span("Roads", (column.road[0], low), (column.road[1], high), ROAD_TOP_M - SLAB_M, ROAD_TOP_M)
    # The pavement of a block is a ring: the middle belongs to the block.
    for a, b in itertools.pairwise(columns):
        for c, d in itertools.pairwise(rows):
            kerbs = (a.road[1], c.road[1]), (b.road[0], d.road[0])
            ring(boxes, "Sidewalks", *kerbs, (a.high_m, c.high_m), (b.low_m, d.low_m), PAVED_TOP_M)
    ring(
        boxes, "Sidewalks", (columns[0].low_m, rows[0].low_m), (columns[-1].high_m, rows[-1].high_m), first, last,
        PAVED_TOP_M,
    )  # fmt: skip


def _river(boxes: BoxList, cfg: SyntheticConfig, streets: Streets, river: Strip) -> None:
    """Water from edge to edge between quays, and a bridge with railings where a street along y crosses it."""
    low, high = river.road
    count = len(streets.columns)
    crossing = streets.columns  # those with a bridge, as evenly spread as they can be
    if 0 < cfg.bridges < count:
        crossing = [streets.columns[int((k + 0.5) * count / cfg.bridges)] for k in range(cfg.bridges)]
    edges = [-cfg.size_m / 2, *(m for strip in crossing for m in (strip.low_m, strip.high_m)), cfg.size_m / 2]
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        boxes.add_span("Water", (a, low), (b, high), -1.2, WATER_TOP_M)
        for quay in (low, high):
            boxes.add_span("Walls", (a, quay - RAILING_M), (b, quay + RAILING_M), -1.2, 0.5)
    for strip in crossing:
        boxes.add_span("Roads", (strip.road[0], low), (strip.road[1], high), ROAD_TOP_M - SLAB_M, ROAD_TOP_M)
        for side, kerb, edge in ((-1, strip.road[0], strip.low_m), (1, strip.road[1], strip.high_m)):
            boxes.add_span("Sidewalks", (min(kerb, edge), low), (max(kerb, edge), high), -SLAB_M, PAVED_TOP_M)
            railing = edge - side * RAILING_M
            boxes.add_span("Fences", (min(railing, edge), low), (max(railing, edge), high), -SLAB_M, 1.1)


def _shore(boxes: BoxList, cfg: SyntheticConfig) -> None:
    """Open water south of the town, and the wall of a quay before it."""
    half = cfg.size_m / 2
    boxes.add_span("Water", (-half, -half - cfg.shore_m), (half, -half - RAILING_M), -1.2, WATER_TOP_M)
    boxes.add_span("Walls", (-half, -half - RAILING_M), (half, -half), -1.2, 0.4)


def _road_paint(boxes: BoxList, streets: Streets) -> None:
    """Centre dashes, and a zebra crossing at both ends of every stretch."""
    for axis in (0, 1):
        for strip in streets.along(axis):
            for low, high in streets.stretches(axis) if strip is not streets.river else []:
                for at in np.arange(low + 7.0, high - 7.0 - DASH_M, DASH_M + DASH_GAP_M):
                    _paint(boxes, axis, at + DASH_M / 2, strip.middle_m, DASH_M, 0.16)
                for end in (low + 2.5, high - 2.5):
                    for across in np.arange(strip.road[0] + 0.7, strip.road[1] - 0.5, 1.2):
                        _paint(boxes, axis, end, across, 3.0, 0.55)


def _paint(boxes: BoxList, axis: int, along: float, across: float, length_m: float, width_m: float) -> None:
    size = point(axis, length_m, width_m)
    boxes.add("RoadLines", point(axis, along, across), size, ROAD_TOP_M - 0.04, PAINT_TOP_M)


def _street_furniture(
    boxes: BoxList, cfg: SyntheticConfig, axis: int, strip: Strip, streets: Streets, rng: np.random.Generator
) -> None:
    """Lamps, trees, parked cars, benches, bins and signs along both kerbs of a street."""
    wide = strip.high_m - strip.low_m >= 26
    parked_share = cfg.parked_share if strip is not streets.river else 0.0
    for low, high in streets.stretches(axis):
        for side, kerb in ((-1, strip.road[0]), (1, strip.road[1])):
            furniture = kerb + side * 1.0  # the row of lamps and trees, on the pavement
            for number, along in enumerate(np.arange(low + 9.0, high - 8.0, 8.0)):
                if number % 3 == 0:
                    _lamp(boxes, axis, along, furniture, -side)
                elif (wide or number % 3 == 1) and rng.random() < cfg.tree_share:
                    crown = rng.uniform(2.6, 3.4) if not wide else rng.uniform(3.4, 4.6)
                    tree(
                        boxes,
                        point(axis, along, furniture),
                        crown,
                        rng.uniform(5.5, 9.5),
                        rng,
                        in_parts=wide and cfg.tree_parts,
                    )
                elif rng.random() < 0.5:
                    bench(boxes, axis, along, furniture, rng)
            for along in np.arange(low + 9.5, high - 11.0, 6.6):
                if rng.random() < parked_share:
                    _parked(boxes, axis, along + rng.uniform(-0.4, 0.4), kerb - side * 1.15, rng)
            _sign(boxes, axis, low + 6.0 if side < 0 else high - 6.0, kerb + side * 0.6)


def _lamp(boxes: BoxList, axis: int, along: float, across: float, towards: int) -> None:
    boxes.add("Poles", point(axis, along, across), (0.2, 0.2), 0.0, 7.6)
    boxes.add("Poles", point(axis, along, across + towards * 0.9), point(axis, 0.16, 2.0), 7.45, 7.6)


def _parked(boxes: BoxList, axis: int, along: float, across: float, rng: np.random.Generator) -> None:
    if rng.random() < 0.06:
        boxes.add("Truck", point(axis, along, across), point(axis, 6.2, 2.2), ROAD_TOP_M, 2.7)
        return
    length = rng.uniform(4.0, 4.7)
    boxes.add("Car", point(axis, along, across), point(axis, length, 1.8), ROAD_TOP_M, rng.uniform(1.4, 1.65))


def _sign(boxes: BoxList, axis: int, along: float, across: float) -> None:
    boxes.add("Poles", point(axis, along, across), (0.08, 0.08), 0.0, 2.9)
    boxes.add("TrafficSigns", point(axis, along + 0.07, across), point(axis, 0.06, 0.65), 2.2, 2.85)


def _crossings(boxes: BoxList, streets: Streets) -> None:
    """A signal on two opposite corners of every inner crossing; its three lamps are boxes inside its housing."""
    for a in streets.columns[1:-1]:
        for b in (strip for strip in streets.rows[1:-1] if strip is not streets.river):
            for side in (-1, 1):
                x, y = (a.road[1] + 0.7, b.road[1] + 0.7) if side > 0 else (a.road[0] - 0.7, b.road[0] - 0.7)
                boxes.add("Poles", (x, y), (0.16, 0.16), 0.0, 3.4)
                boxes.add("TrafficLight", (x - side * 0.3, y), (0.36, 0.34), 2.5, 3.5)
                for low in (2.54, 2.86, 3.18):
                    boxes.add("TrafficLight", (x - side * 0.3, y), (0.3, 0.3), low, low + 0.28)
    for strip in streets.rows:  # a sewer under every street along x
        ends = streets.columns[0].low_m, streets.columns[-1].high_m
        boxes.add_span("Static", (ends[0], strip.middle_m - 0.6), (ends[1], strip.middle_m + 0.6), -4.2, -3.0)


def _verge(boxes: BoxList, cfg: SyntheticConfig, streets: Streets, rng: np.random.Generator) -> None:
    """Lawn, trees and a fence with gates round the town; nothing of it stands in a river."""
    half, edge, river = cfg.size_m / 2, streets.columns[-1].high_m, streets.river
    ring(boxes, "Terrain", (-half,) * 2, (half,) * 2, (-edge,) * 2, (edge,) * 2, LAWN_TOP_M)
    for side in (-1, 1):
        for axis in (0, 1):
            line = side * (half - 0.4)
            for at in np.arange(-half + 2.0, half - 12.0, 14.0):  # 12 m panels, 2 m gates
                if river is None or axis == 0 or not river.low_m < at + 6.0 < river.high_m:
                    boxes.add("Fences", point(axis, at + 6.0, line), point(axis, 12.0, 0.1), -0.1, 1.3)
            for at in np.arange(-half + 8.0, half - 6.0, 11.0):
                in_river = river is not None and axis == 1 and river.low_m - 6.0 < at < river.high_m + 6.0
                if rng.random() < 0.75 and not in_river:
                    along = at + rng.uniform(-2, 2)
                    place = point(axis, along, side * (half - 0.45 * cfg.verge_m + rng.uniform(-0.8, 0.8)))
                    tree(boxes, place, rng.uniform(3.5, 5.5), rng.uniform(6.0, 12.0), rng)


def _block_kinds(cfg: SyntheticConfig, rng: np.random.Generator) -> list[str]:
    """One kind for each block, shuffled: of each its share, or a park, a square, and the built kinds in turn."""
    count = cfg.num_blocks * cfg.num_blocks
    if cfg.blocks:
        kinds = _shared_out(cfg.blocks, count)
    else:
        built = ("courtyard", "houses", "towers")
        share = max(1, count // 9)
        kinds = ["park"] * (share if count > 1 else 0) + ["square"] * (share if count > 3 else 0)
        kinds += [built[i % 3] for i in range(count - len(kinds))]
    kinds = [kinds[i] for i in rng.permutation(count)]
    if cfg.center in kinds:
        middle, at = cfg.num_blocks // 2 * (cfg.num_blocks + 1), kinds.index(cfg.center)
        kinds[middle], kinds[at] = kinds[at], kinds[middle]
    return kinds


def _shared_out(shares: dict[str, float], count: int) -> list[str]:
    """So many names, each as often as its share says, the largest remainders rounded up."""
    exact = {name: share / sum(shares.values()) * count for name, share in shares.items()}
    names = [name for name, value in exact.items() for _ in range(int(value))]
    by_remainder = sorted(exact, key=lambda name: int(exact[name]) - exact[name])
    return names + by_remainder[: count - len(names)]
