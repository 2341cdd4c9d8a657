"""The plan of a world: the answer of a language model or of the rules to a prompt, and the only input of the layout.

Source: app:simworld:step1, the structured high-level plan.
"""

from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from cosfly.runtime.config import read_yaml
from cosfly.runtime.json_io import Record, dump_json

VERGE_M = 10.0  # of lawn around the town
PATH_M = 4.0  # width of a footpath
LEAST_FOOTPRINT_M = 6.0  # side of a building
LEAST_INSIDE_M = 30.0  # side of a town without its edges, its river and its widest street


class ObjectPart(NamedTuple):
    """One box of an object, m from the middle of its footprint and over the ground."""

    kind: str
    x: float  # middle
    y: float
    wide: float  # full size along x
    deep: float  # full size along y
    low: float
    high: float


class Object(Record):
    """An object that a prompt can name; objects.yaml explains the fields."""

    name: str
    parts: tuple[ObjectPart, ...] = ()
    where: Literal["open", "green", "water", "bank", "quay", "layout"] = "open"
    words: tuple[str, ...] = ()
    asset: str | None = None
    least_scale: float = 1.0

    @property
    def size_m(self) -> tuple[float, float]:
        """Full size of the footprint, centred at its middle."""
        wide = 2 * max(abs(part.x) + part.wide / 2 for part in self.parts)
        deep = 2 * max(abs(part.y) + part.deep / 2 for part in self.parts)
        return wide, deep


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


Range = tuple[float, float]  # low and high end


def _within(values: Range, low: float, high: float) -> Range:
    if not low <= values[0] <= values[1] <= high:
        raise ValueError(f"the range must lie within {low:g} to {high:g}, the lower value first")
    return values


Footprint = Annotated[Range, AfterValidator(partial(_within, low=LEAST_FOOTPRINT_M, high=120.0))]
Heights = Annotated[Range, AfterValidator(partial(_within, low=3.0, high=450.0))]
Share = Annotated[Range, AfterValidator(partial(_within, low=0.0, high=0.8))]
TreesPerHa = Annotated[Range, AfterValidator(partial(_within, low=0.0, high=400.0))]


class NamedObject(Record):
    """An object of the table, and how many of it."""

    name: str = Field(description="a name of the object table")
    count: int = Field(1, ge=1, le=500)


class Buildings(Record):
    """Buildings of one kind."""

    name: str = Field(description="what they are called, such as warehouse")
    count: int | None = Field(None, ge=1, le=1000, description="how many; null: as many as there is room for")
    footprint_m: Footprint = Field((12.0, 30.0), description="sides of buildings")
    heights_m: Heights = Field((8.0, 24.0), description="heights of buildings")


class WorldPlan(BaseModel):
    """Properties of a world. Lengths are in m; properties that are measured afterwards have a range, low to high."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    pattern: Literal["grid", "radial", "organic", "linear", "campus"] = Field(
        "grid",
        description="streets: grid; radial (avenues from a middle, rings); organic (winding); linear (one long road, "
        "along a river if there is one); campus (a ring road, footpaths over lawns)",
    )
    size_m: Range | None = Field(
        None, description="the town from west to east and from south to north, 80 to 2000; null: as its blocks need"
    )
    blocks_along: float = Field(4.0, ge=1.0, le=9.0, description="blocks along each side of a town without size_m")
    block_m: float = Field(60.0, ge=20.0, le=180.0, description="mean side of a block")
    street_m: float = Field(16.0, ge=5.0, le=40.0, description="streets, from front to front; below 9 without cars")
    avenue_m: float = Field(24.0, ge=5.0, le=60.0, description="main streets, from front to front")
    unevenness: float = Field(0.1, ge=0.0, le=0.3, description="how much the sides of blocks differ")
    buildings: list[Buildings] = Field([], max_length=12, description="kinds of buildings that are named")
    only_these: bool = Field(False, description="there are no buildings but those of `buildings` and `objects`")
    footprint_m: Footprint = Field((12.0, 30.0), description="sides of other buildings")
    heights_m: Heights = Field((8.0, 24.0), description="heights of other buildings")
    building_share: Share = Field((0.0, 0.8), description="ground that buildings cover, of the town without water")
    gap_m: float = Field(3.0, ge=0.05, le=40.0, description="between neighbouring buildings")
    setback_m: float = Field(1.0, ge=0.0, le=15.0, description="from pavement to front; from 2.5 on there are gardens")
    trees_per_ha: TreesPerHa = Field((10.0, 60.0), description="trees on a hectare of the town without water")
    plazas: int = Field(1, ge=0, le=20, description="paved open blocks")
    greens: int = Field(1, ge=0, le=40, description="blocks that are lawn with trees")
    river_m: float = Field(0.0, ge=0.0, le=100.0, description="width of a river, or of the water at a shore; 0: none")
    is_shore: bool = Field(False, description="the water is along the southern edge, as in a harbour")
    bridges: int | None = Field(None, ge=0, le=10, description="bridges over the river; null: one to four")
    bridge_m: float | None = Field(None, ge=3.0, le=40.0, description="width of bridges; null: as the streets")
    parked_share: float = Field(0.25, ge=0.0, le=1.0, description="share of parking places that are taken")
    objects: list[NamedObject] = Field(
        [], max_length=40, description=f"each once, as {{name: church, count: 1}}; names: {', '.join(OBJECTS)}"
    )
    not_used: list[str] = Field([], max_length=200, description="words of the prompt that no other field holds")

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if self.size_m and not 80.0 <= min(self.size_m) <= max(self.size_m) <= 2000.0:
            raise ValueError(f"size_m is {self.size_m[0]:g} x {self.size_m[1]:g}, but must lie within 80 to 2000 m")
        edges_m = 2 * VERGE_M + max(self.avenue_m, self.street_m) + self.river_m
        if self.size_m and min(self.size_m) < edges_m + LEAST_INSIDE_M:
            expected = f"{edges_m + LEAST_INSIDE_M:g} m for its edges, river and widest street"
            raise ValueError(f"size_m is {self.size_m[0]:g} x {self.size_m[1]:g}, but needs at least {expected}")
        return self

    def to_yaml(self) -> str:
        """Return the plan as a file to edit, which describes each field."""
        text = "# To build this town again: cosfly world THIS_FILE --out DIR. Lengths are in m.\n"
        for name, field in type(self).model_fields.items():
            text += f"\n# {field.description}\n{name}: {dump_json(self.model_dump(mode='json')[name])}\n"
        return text

    def kinds_of_buildings(self) -> list[Buildings]:
        """Return the kinds of buildings to build: the counted ones first, then those that take the remaining lots."""
        ordinary = Buildings(name="building", footprint_m=self.footprint_m, heights_m=self.heights_m)
        fill = [group for group in self.buildings if group.count is None]
        counted = [group for group in self.buildings if group.count is not None]
        if not fill and not self.only_these:
            fill = [ordinary]
        return counted + fill

    def known_objects(self) -> list[tuple[Object, int]]:
        """Return the named objects of the table with their counts, summed over equal names."""
        counts: dict[str, int] = {}
        for named in self.objects:
            counts[named.name] = counts.get(named.name, 0) + named.count
        return [(OBJECTS[name], count) for name, count in counts.items() if name in OBJECTS]

    def unknown_objects(self) -> list[str]:
        """Return the names of objects that the table lacks, as often as they are counted."""
        unknown = [named for named in self.objects if named.name not in OBJECTS]
        return [named.name for named in unknown for _ in range(named.count)]
