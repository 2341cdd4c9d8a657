"""The plan of a world: what a language model or the rules make of a prompt, and all that the layout is made from.

Source: app:simworld:step1, the structured high-level plan.
"""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cosfly.maps.synthetic import MIN_BLOCK_M, SyntheticConfig
from cosfly.maps.town_blocks import LotsConfig
from cosfly.runtime.json_io import FileFormat, Record
from cosfly.worldgen.objects import OBJECTS, Object, assets

PLAN_FORMAT = FileFormat("cosfly.world_plan", "1", "plan of a world")

Range = tuple[float, float]
OPEN_SHARE = 0.45  # of an open block that objects may fill
SPACE_M = 4.0  # round each object
EDGE_M = 14.0  # of an open block, both sides together, that belongs to its trees


class NamedObject(Record):
    """So many of an object of the table."""

    name: str = Field(description="a name of the object table")
    count: int = Field(1, ge=1, le=60)


class WorldPlan(BaseModel):
    """What a world shall be. Lengths in m, ranges from low to high; all that is measured afterwards has a range."""

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
    def _can_be(self) -> Self:
        limits = {"footprint_m": (6.0, 120.0), "heights_m": (3.0, 450.0), "building_share": (0.0, 0.8)}
        for name, (least, most) in (limits | {"trees_per_ha": (0.0, 400.0)}).items():
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(f"{name} is from {low:g} to {high:g}, not a range within {least:g} to {most:g}")
        if self.plazas + self.greens >= self.blocks_along**2:
            raise ValueError(f"{self.plazas} plazas and {self.greens} greens leave no block of {self.blocks_along**2}")
        narrowest_m = self.block_m * (1.0 - self.unevenness) / (1.0 + self.unevenness)
        if narrowest_m < MIN_BLOCK_M + 1.0 or self.setback_m > narrowest_m / 5:
            what = f"blocks as narrow as {narrowest_m:.1f} m, less than {MIN_BLOCK_M + 1.0:g} m or five times setback_m"
            raise ValueError(f"{what}: raise block_m, or lower unevenness or setback_m")
        return self


def objects_of(plan: WorldPlan) -> list[tuple[Object, int]]:
    """Return the objects that a plan names and the table has, with their counts; of a name twice, the sum."""
    counts: dict[str, int] = {}
    for wanted in plan.objects:
        counts[wanted.name] = counts.get(wanted.name, 0) + wanted.count
    return [(OBJECTS[name], count) for name, count in counts.items() if name in OBJECTS]


def unknown_objects(plan: WorldPlan) -> list[str]:
    """Return what a plan names and no table has, an entry for each."""
    return [one.name for one in plan.objects if one.name not in OBJECTS for _ in range(one.count)] + plan.not_in_table


def town_settings(plan: WorldPlan, name: str) -> SyntheticConfig:
    """Return the town generator's settings for a plan: open blocks enough, and large enough, for its objects."""
    block_m, along = plan.block_m, plan.blocks_along
    placed = [(one, count) for one, count in objects_of(plan) if one.where == "open"]
    for one, _ in placed:
        block_m = max(block_m, min(max(one.size_m[:2]) * one.least_scale + EDGE_M + 4.0, 150.0))
    narrowest = block_m * (1.0 - plan.unevenness) / (1.0 + plan.unevenness)
    room = OPEN_SHARE * (narrowest - EDGE_M) ** 2
    needed = sum(
        count * (one.size_m[0] * one.least_scale + SPACE_M) * (one.size_m[1] * one.least_scale + SPACE_M)
        for one, count in placed
    )
    num_open = max(plan.plazas + plan.greens, int(-(-needed // room)))
    while num_open > along**2 // 2 and along < 9:
        along += 1
    plazas = max(plan.plazas, num_open - plan.greens)
    verge_m, streets = 10.0, along * plan.street_m + max(plan.avenue_m, plan.river_m)
    kind = "lanes" if plan.lanes else "lots"
    shares = {kind: float(along**2 - plazas - plan.greens), "plaza": float(plazas), "green": float(plan.greens)}
    return SyntheticConfig(
        name=name, size_m=block_m * along + streets + 2 * verge_m, num_blocks=along, street_m=plan.street_m,
        boulevard_m=plan.avenue_m, unevenness=plan.unevenness, center="plaza" if plazas else None,
        blocks={block: share for block, share in shares.items() if share > 0}, river_m=plan.river_m,
        bridges=plan.bridges, shore_m=plan.shore_m, verge_m=verge_m, parked_share=plan.parked_share, tree_parts=False,
        tree_share=0.0 if plan.trees_per_ha[1] < 3 else 0.4 if plan.trees_per_ha[1] < 25 else 0.9,
        lots=LotsConfig(
            footprints_m=_footprints(plan), heights_m=plan.heights_m, gap_m=plan.gap_m, setback_m=plan.setback_m,
            fall_m=0.5 * (block_m + plan.street_m) * along if plan.high_center else 0.0,
        ),
    )  # fmt: skip


def _footprints(plan: WorldPlan) -> list[tuple[float, float]]:
    """SimWorld's own footprints within a plan's range; where it has fewer than four, all of them scaled into it."""
    low, high = plan.footprint_m
    sizes = [(x, y) for name, (x, y, _) in assets().items() if name.startswith("BP_Building")]
    fitting = [size for size in sizes if low <= min(size) and max(size) <= high]
    if len(fitting) >= 4:
        return fitting
    slim = sorted(size for size in sizes if max(size) / min(size) < 2.2)
    shares = [k / (len(slim) - 1) for k in range(len(slim))]
    longest = [low + (high - low) * share for share in shares]
    return [
        (round(x * side / max(x, y), 1), round(max(low * 0.6, y * side / max(x, y)), 1))
        for (x, y), side in zip(slim, longest, strict=True)
    ]
