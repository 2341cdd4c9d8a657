"""A seeded small town: streets on a grid, lawns, a park with a pond, a square, houses, courtyard blocks, towers.

It is made to be planned and rendered, not to imitate one place. Every block draws from its own random generator, so that
one block does not change with another. Heights: pavements at z = 0; carriageways, lawns and paint a few centimetres lower, so that
no two surfaces share a plane. A few boxes lie below the ground or inside others, as in maps that simulators export.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from cosfly.chance import rng_for
from cosfly.config import Config
from cosfly.maps.boxlist import BoxList
from cosfly.maps.census_town import census_town
from cosfly.maps.town_blocks import (
    BASE_TOP_M,
    BLOCKS,
    LAWN_TOP_M,
    PAINT_TOP_M,
    PAVEMENT_TOP_M,
    ROAD_TOP_M,
    SLAB_M,
    bench,
    point,
    ring,
    tree,
)
from cosfly.products.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource

GENERATOR_VERSION = "1"

MIN_BLOCK_M = 34.0  # below this no block type finds room
DASH_M, DASH_GAP_M = 3.0, 6.0


class SyntheticConfig(Config):
    """The synthetic town."""

    name: str = Field("SynthTown", min_length=1, description="map name, the head of the playback tree's folder names")
    preset: Literal["small_town", "town10"] = Field(
        "small_town",
        description="town10: as many boxes of each kind as the paper's town, over 619 x 506 m; the fields below then count for nothing",
    )
    size_m: float = Field(280.0, ge=80.0, le=4000.0, description="side of the square town, m")
    num_blocks: int = Field(3, ge=1, le=60, description="building blocks along each side")
    street_m: float = Field(20.0, ge=12.0, le=60.0, description="width of a street from front to front, m")
    boulevard_m: float = Field(28.0, ge=12.0, le=80.0, description="width of the two wide streets, m")
    verge_m: float = Field(10.0, ge=4.0, description="lawn round the town, m")
    parked_share: float = Field(0.4, ge=0.0, le=1.0, description="share of parking places that are taken; 0 for none")
    tree_share: float = Field(
        0.85, ge=0.0, le=1.0, description="share of street tree places that are planted; 0 for none"
    )

    @model_validator(mode="after")
    def _blocks_have_room(self) -> SyntheticConfig:
        streets = (self.num_blocks + 1) * self.street_m + (self.boulevard_m - self.street_m)
        side = (self.size_m - 2 * self.verge_m - streets) / self.num_blocks
        if side < MIN_BLOCK_M:
            raise ValueError(
                f"a block would be {side:.1f} m wide, at least {MIN_BLOCK_M:.0f} m are needed: raise size_m or lower num_blocks"
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


def load(cfg: SyntheticConfig, seed: int) -> BoxMap:
    """Build the town of a seed."""
    if cfg.preset == "town10":
        return census_town(cfg.name, seed)
    boxes = BoxList()
    strips = _strips(cfg)
    half = cfg.size_m / 2
    boxes.add_span("Terrain", (-half, -half), (half, half), BASE_TOP_M - SLAB_M, BASE_TOP_M)
    _surfaces(boxes, cfg, strips)
    _road_paint(boxes, strips)
    for axis in (0, 1):
        for number, strip in enumerate(strips):
            _street_furniture(boxes, cfg, axis, strip, strips, rng_for(seed, "maps", f"street {axis} {number}"))
    _crossings(boxes, strips)
    _verge(boxes, cfg, strips, rng_for(seed, "maps", "verge"))
    kinds = _block_kinds(cfg.num_blocks, rng_for(seed, "maps", "plan"))
    for row in range(cfg.num_blocks):
        for column in range(cfg.num_blocks):
            low = np.array([strips[column].high_m, strips[row].high_m])
            high = np.array([strips[column + 1].low_m, strips[row + 1].low_m])
            kind = kinds[row * cfg.num_blocks + column]
            BLOCKS[kind](boxes, low, high, rng_for(seed, "maps", f"block {row} {column}"))
    source = MapSource(tool="cosfly maps synthetic", version=GENERATOR_VERSION, seed=seed)
    return boxes.box_map(MapHeader(name=cfg.name, source=source, licence=OUR_LICENCE, ground_z_m=0.0))


def _strips(cfg: SyntheticConfig) -> list[Strip]:
    """The streets across one axis, low to high; both axes use the same. The second one is the boulevard."""
    widths = [cfg.street_m] * (cfg.num_blocks + 1)
    widths[1 if cfg.num_blocks > 1 else 0] = cfg.boulevard_m
    block_m = (cfg.size_m - 2 * cfg.verge_m - sum(widths)) / cfg.num_blocks
    strips, at = [], -cfg.size_m / 2 + cfg.verge_m
    for width in widths:
        strips.append(Strip(at, at + width, 6.0 if width >= 26 else max(2.5, 0.22 * width)))
        at += width + block_m
    return strips


def _segments(strips: list[Strip]) -> list[tuple[float, float]]:
    """The stretches of a street between the carriageways that cross it."""
    return [(a.road[1], b.road[0]) for a, b in itertools.pairwise(strips)]


def _surfaces(boxes: BoxList, cfg: SyntheticConfig, strips: list[Strip]) -> None:
    """Carriageways, and between them one pavement slab for each block (with its own ground on top of it later)."""
    first, last = strips[0].road[0], strips[-1].road[1]
    for strip in strips:
        boxes.add_span("Roads", (first, strip.road[0]), (last, strip.road[1]), ROAD_TOP_M - SLAB_M, ROAD_TOP_M)
        for low, high in _segments(strips):
            boxes.add_span("Roads", (strip.road[0], low), (strip.road[1], high), ROAD_TOP_M - SLAB_M, ROAD_TOP_M)
    # The pavement of a block is a ring: the middle belongs to the block.
    for a, b in itertools.pairwise(strips):
        for c, d in itertools.pairwise(strips):
            kerbs = (a.road[1], c.road[1]), (b.road[0], d.road[0])
            ring(boxes, "Sidewalks", *kerbs, (a.high_m, c.high_m), (b.low_m, d.low_m), PAVEMENT_TOP_M)
    outer = strips[0].low_m, strips[-1].high_m
    ring(boxes, "Sidewalks", (outer[0],) * 2, (outer[1],) * 2, (first,) * 2, (last,) * 2, PAVEMENT_TOP_M)


def _road_paint(boxes: BoxList, strips: list[Strip]) -> None:
    """Centre dashes, and a zebra crossing at both ends of every stretch."""
    for axis in (0, 1):
        for strip in strips:
            for low, high in _segments(strips):
                for at in np.arange(low + 7.0, high - 7.0 - DASH_M, DASH_M + DASH_GAP_M):
                    _paint(boxes, axis, at + DASH_M / 2, strip.middle_m, DASH_M, 0.16)
                for end in (low + 2.5, high - 2.5):
                    for across in np.arange(strip.road[0] + 0.7, strip.road[1] - 0.5, 1.2):
                        _paint(boxes, axis, end, across, 3.0, 0.55)


def _paint(boxes: BoxList, axis: int, along: float, across: float, length_m: float, width_m: float) -> None:
    size = point(axis, length_m, width_m)
    boxes.add("RoadLines", point(axis, along, across), size, ROAD_TOP_M - 0.04, PAINT_TOP_M)


def _street_furniture(
    boxes: BoxList, cfg: SyntheticConfig, axis: int, strip: Strip, strips: list[Strip], rng: np.random.Generator
) -> None:
    """Lamps, trees, parked cars, benches, bins and signs along both kerbs of a street."""
    wide = strip.high_m - strip.low_m >= 26
    for low, high in _segments(strips):
        for side, kerb in ((-1, strip.road[0]), (1, strip.road[1])):
            furniture = kerb + side * 1.0  # the row of lamps and trees, on the pavement
            for number, along in enumerate(np.arange(low + 9.0, high - 8.0, 8.0)):
                if number % 3 == 0:
                    _lamp(boxes, axis, along, furniture, -side)
                elif (wide or number % 3 == 1) and rng.random() < cfg.tree_share:
                    crown = rng.uniform(2.6, 3.4) if not wide else rng.uniform(3.4, 4.6)
                    tree(boxes, point(axis, along, furniture), crown, rng.uniform(5.5, 9.5), rng, in_parts=wide)
                elif rng.random() < 0.5:
                    bench(boxes, axis, along, furniture, rng)
            for along in np.arange(low + 9.5, high - 11.0, 6.6):
                if rng.random() < cfg.parked_share:
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


def _crossings(boxes: BoxList, strips: list[Strip]) -> None:
    """A signal on two opposite corners of every inner crossing; its three lamps are boxes inside its housing."""
    for a in strips[1:-1]:
        for b in strips[1:-1]:
            for side in (-1, 1):
                x, y = (a.road[1] + 0.7, b.road[1] + 0.7) if side > 0 else (a.road[0] - 0.7, b.road[0] - 0.7)
                boxes.add("Poles", (x, y), (0.16, 0.16), 0.0, 3.4)
                boxes.add("TrafficLight", (x - side * 0.3, y), (0.36, 0.34), 2.5, 3.5)
                for low in (2.54, 2.86, 3.18):
                    boxes.add("TrafficLight", (x - side * 0.3, y), (0.3, 0.3), low, low + 0.28)
    for strip in strips:  # a sewer under every street
        middle = strip.middle_m
        boxes.add_span("Static", (strips[0].low_m, middle - 0.6), (strips[-1].high_m, middle + 0.6), -4.2, -3.0)


def _verge(boxes: BoxList, cfg: SyntheticConfig, strips: list[Strip], rng: np.random.Generator) -> None:
    """Lawn, trees and a fence with gates round the town."""
    half, edge = cfg.size_m / 2, strips[-1].high_m
    ring(boxes, "Terrain", (-half,) * 2, (half,) * 2, (-edge,) * 2, (edge,) * 2, LAWN_TOP_M)
    for side in (-1, 1):
        for axis in (0, 1):
            line = side * (half - 0.4)
            for at in np.arange(-half + 2.0, half - 12.0, 14.0):  # 12 m panels, 2 m gates
                boxes.add("Fences", point(axis, at + 6.0, line), point(axis, 12.0, 0.1), -0.1, 1.3)
            for at in np.arange(-half + 8.0, half - 6.0, 11.0):
                if rng.random() < 0.75:
                    along = at + rng.uniform(-2, 2)
                    place = point(axis, along, side * (half - 0.45 * cfg.verge_m + rng.uniform(-0.8, 0.8)))
                    tree(boxes, place, rng.uniform(3.5, 5.5), rng.uniform(6.0, 12.0), rng)


def _block_kinds(num_blocks: int, rng: np.random.Generator) -> list[str]:
    """One kind for each block: a park first, then a square, then the built kinds in turn; shuffled."""
    built = ("courtyard", "houses", "towers")
    count = num_blocks * num_blocks
    share = max(1, count // 9)
    kinds = ["park"] * (share if count > 1 else 0) + ["square"] * (share if count > 3 else 0)
    kinds += [built[i % 3] for i in range(count - len(kinds))]
    return [kinds[i] for i in rng.permutation(count)]
