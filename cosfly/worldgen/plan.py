"""The plan of a world: the answer of a language model or of the rules to a prompt, and the only input of the layout.

Source: app:simworld:step1, the structured high-level plan.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cosfly.maps.synthetic import MIN_BLOCK_M, VERGE_M, TownPlan
from cosfly.maps.town_blocks import Lots, Range
from cosfly.runtime.config import read_yaml
from cosfly.runtime.json_io import FileFormat, Record

PLAN_FORMAT = FileFormat("cosfly.world_plan", "1", "plan of a world")

OPEN_SHARE = 0.45  # share of an open block that objects may fill
SPACE_M = 4.0  # free ground around each object
EDGE_M = 14.0  # width of both edges of an open block together, which hold its trees
LOW_PART_M = 3.0  # parts of a quay that begin above this height are over the water


class Object(Record):
    """An object that a prompt can name; objects.yaml explains the fields.

    parts: kind, middle x y, size x y, low and high end of each box, m.
    """

    name: str
    parts: tuple[tuple[str, float, float, float, float, float, float], ...] = ()
    where: Literal["open", "quay", "water", "layout"] = "open"
    words: tuple[str, ...] = ()
    asset: str | None = None
    least_scale: float = 1.0

    @property
    def size_m(self) -> tuple[float, float]:
        """Full size of the footprint, centred at its middle; on a quay without the parts over the water."""
        parts = [part for part in self.parts if self.where == "open" or part[5] < LOW_PART_M]
        return (
            2 * max(abs(x) + wide / 2 for _, x, _, wide, _, _, _ in parts),
            2 * max(abs(y) + deep / 2 for _, _, y, _, deep, _, _ in parts),
        )


@cache
def assets() -> dict[str, tuple[float, ...]]:
    """Return SimWorld's buildings and trees: name -> full size at yaw 0, m."""
    sizes = read_yaml(Path(__file__).with_name("assets.yaml"))
    return {f"BP_{name}_C": tuple(map(float, size)) for name, size in sizes.items()}


def _objects() -> dict[str, Object]:
    table: dict[str, dict[str, Any]] = read_yaml(Path(__file__).with_name("objects.yaml"))
    for value in table.values():
        if "asset" in value:
            x, y, z = assets()[value["asset"]]
            value["parts"] = [("Buildings", 0.0, 0.0, x, y, 0.0, z)]
    return {name: Object(name=name, **value) for name, value in table.items()}


OBJECTS = _objects()


class NamedObject(Record):
    """An object of the table, and how many of it."""

    name: str = Field(description="a name of the object table")
    count: int = Field(1, ge=1, le=60)


class WorldPlan(BaseModel):
    """Properties of a world. Lengths are in m; properties that are measured afterwards have a range, low to high."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    blocks_along: int = Field(4, ge=2, le=9, description="building blocks along each side of the town")
    block_m: float = Field(60.0, ge=36.0, le=180.0, description="mean side of a block")
    street_m: float = Field(16.0, ge=12.0, le=40.0, description="streets, from front to front")
    avenue_m: float = Field(24.0, ge=12.0, le=60.0, description="the two widest streets")
    unevenness: float = Field(0.1, ge=0.0, le=0.3, description="how much the sides of blocks differ")
    footprint_m: Range = Field((12.0, 30.0), description="sides of buildings")
    heights_m: Range = Field((8.0, 24.0), description="heights of buildings")
    high_center: bool = Field(False, description="the highest buildings stand in the middle")
    building_share: Range = Field((0.15, 0.45), description="ground that buildings cover, of the town without water")
    gap_m: float = Field(3.0, ge=0.5, le=40.0, description="between neighbouring buildings")
    setback_m: float = Field(1.0, ge=0.0, le=15.0, description="from pavement to front; from 2.5 on there are gardens")
    trees_per_ha: Range = Field((10.0, 60.0), description="trees on a hectare of the town without water")
    plazas: int = Field(1, ge=0, le=20, description="paved open blocks")
    greens: int = Field(1, ge=0, le=40, description="blocks that are lawn with trees")
    lanes: bool = Field(False, description="blocks are terraces with narrow lanes, as in an old town")
    river_m: float = Field(0.0, ge=0.0, le=100.0, description="width of a river; 0: none")
    bridges: int = Field(0, ge=0, le=10, description="bridges over the river; 0: one at each street")
    shore_m: float = Field(0.0, ge=0.0, le=300.0, description="open water at the south edge; 0: none")
    parked_share: float = Field(0.25, ge=0.0, le=1.0, description="share of parking places that are taken")
    objects: list[NamedObject] = Field([], max_length=40, description="what the prompt names, each once")
    not_in_table: list[str] = Field([], max_length=100, description="what it names and the object table lacks")

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        limits = {"footprint_m": (6.0, 120.0), "heights_m": (3.0, 450.0), "building_share": (0.0, 0.8)}
        for name, (least, most) in (limits | {"trees_per_ha": (0.0, 400.0)}).items():
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name} is {low:g} to {high:g}, but must lie within {least:g} to {most:g}, the lower value first"
                )
        if self.plazas + self.greens >= self.blocks_along**2:
            raise ValueError(
                f"no block is left for buildings, because {self.plazas} plazas and {self.greens} green blocks take all "
                f"{self.blocks_along**2} blocks"
            )
        narrowest_m = self.block_m * (1.0 - self.unevenness) / (1.0 + self.unevenness)
        if narrowest_m < MIN_BLOCK_M + 1.0 or self.setback_m > narrowest_m / 5:
            expected = f"at least {MIN_BLOCK_M + 1.0:g} m and at least five times setback_m"
            fix = "raise block_m, or lower unevenness or setback_m"
            raise ValueError(f"the narrowest block is {narrowest_m:.1f} m wide, but must be {expected}; {fix}")
        return self

    def known_objects(self) -> list[tuple[Object, int]]:
        """Return the named objects of the table with their counts, summed over equal names."""
        counts: dict[str, int] = {}
        for named in self.objects:
            counts[named.name] = counts.get(named.name, 0) + named.count
        return [(OBJECTS[name], count) for name, count in counts.items() if name in OBJECTS]

    def unknown_objects(self) -> list[str]:
        """Return the names of objects that the table lacks, as often as they are counted."""
        unknown = [named for named in self.objects if named.name not in OBJECTS]
        return [named.name for named in unknown for _ in range(named.count)] + self.not_in_table


def town_plan(plan: WorldPlan) -> TownPlan:
    """Return the plan for the town generator, with enough open blocks, and large enough ones, for the objects."""
    block_m = plan.block_m
    along = plan.blocks_along
    placed = [(thing, count) for thing, count in plan.known_objects() if thing.where == "open"]
    for thing, _ in placed:
        block_m = max(block_m, min(max(thing.size_m) * thing.least_scale + EDGE_M + 4.0, 150.0))
    narrowest = block_m * (1.0 - plan.unevenness) / (1.0 + plan.unevenness)
    room = OPEN_SHARE * (narrowest - EDGE_M) ** 2
    needed = sum(
        count * math.prod(side * thing.least_scale + SPACE_M for side in thing.size_m) for thing, count in placed
    )
    num_open = max(plan.plazas + plan.greens, int(-(-needed // room)))
    while num_open > along**2 // 2 and along < 9:
        along += 1
    plazas = max(plan.plazas, num_open - plan.greens)
    shares = {"lanes" if plan.lanes else "lots": along**2 - plazas - plan.greens, "plaza": plazas, "green": plan.greens}
    streets_m = along * plan.street_m + max(plan.avenue_m, plan.river_m)
    tree_share = 0.4 if plan.trees_per_ha[1] < 25 else 0.9
    if plan.trees_per_ha[1] < 3:
        tree_share = 0.0
    return TownPlan(
        size_m=block_m * along + streets_m + 2 * VERGE_M, num_blocks=along, street_m=plan.street_m,
        boulevard_m=plan.avenue_m, unevenness=plan.unevenness, center="plaza" if plazas else None,
        blocks={block: float(share) for block, share in shares.items() if share > 0}, river_m=plan.river_m,
        bridges=plan.bridges, shore_m=plan.shore_m, parked_share=plan.parked_share, tree_parts=False,
        tree_share=tree_share,
        lots=Lots(
            footprints_m=_footprints(plan), heights_m=plan.heights_m, gap_m=plan.gap_m, setback_m=plan.setback_m,
            fall_m=0.5 * (block_m + plan.street_m) * along if plan.high_center else 0.0,
        ),
    )  # fmt: skip


def _footprints(plan: WorldPlan) -> tuple[Range, ...]:
    """Return the footprints of SimWorld's buildings in a plan's range; if fewer than four fit, scale all into it."""
    low, high = plan.footprint_m
    sizes = [(size[0], size[1]) for name, size in assets().items() if name.startswith("BP_Building")]
    fitting = [size for size in sizes if low <= min(size) and max(size) <= high]
    if len(fitting) >= 4:
        return tuple(fitting)
    slim = sorted(size for size in sizes if max(size) / min(size) < 2.2)
    longest = [low + (high - low) * k / (len(slim) - 1) for k in range(len(slim))]
    return tuple(
        (round(x * side / max(x, y), 1), round(max(low * 0.6, y * side / max(x, y)), 1))
        for (x, y), side in zip(slim, longest, strict=True)
    )
