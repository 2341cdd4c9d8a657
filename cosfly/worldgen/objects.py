"""What a prompt can name: the table of objects with their sizes, and SimWorld's assets with theirs.

A node of a kind without an asset is named after the kind, as Water_C, with a cube of 1 m as its size:
SimWorld's loader says that it lacks such an asset and leaves it out, our importer reads it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Literal

from cosfly.runtime.config import read_yaml
from cosfly.runtime.json_io import Record
from cosfly.simulators.assets import ASSETS

Where = Literal["open", "quay", "water", "layout"]
Part = tuple[str, float, float, float, float, float, float]  # kind, middle x y, size x y, low, high, m
STRETCH = 6.0  # longest side of an asset's box over the shortest, relative to the asset's own, that still looks like it


class Object(Record):
    """One thing that can be named; the table says what its fields mean."""

    name: str
    parts: tuple[Part, ...] = ()
    where: Where = "open"
    words: tuple[str, ...] = ()
    asset: str | None = None
    least_scale: float = 1.0

    @property
    def size_m(self) -> tuple[float, float]:
        """Full size of its footprint, centred at its middle; on a quay without what hangs over the water."""
        parts = [part for part in self.parts if self.where == "open" or part[5] < 3.0]
        return (
            2 * max(abs(x) + wide / 2 for _, x, _, wide, _, _, _ in parts),
            2 * max(abs(y) + deep / 2 for _, _, y, _, deep, _, _ in parts),
        )


@cache
def assets() -> dict[str, tuple[float, float, float]]:
    """Return SimWorld's buildings and trees: name -> full size at yaw 0, m."""
    sizes = read_yaml(Path(__file__).with_name("assets.yaml"))
    return {f"BP_{name}_C": tuple(map(float, size)) for name, size in sizes.items()}  # type: ignore[misc]


@cache
def _furniture() -> dict[str, tuple[float, float, float]]:
    """SimWorld's street furniture by the names of its assets, with the sizes that our importer gives it, m."""
    names = {"BP_Trash_bin_*": "BP_Trash_bin_a_C"}
    return {
        names.get(asset.pattern, asset.pattern.replace("*", "")): asset.default_size_m
        for asset in ASSETS
        if asset.default_size_m is not None and asset.kind == "Static"
    }


def _objects() -> dict[str, Object]:
    table = read_yaml(Path(__file__).with_name("objects.yaml"))
    for one in table.values():
        if "asset" in one:
            x, y, z = assets()[one["asset"]]
            one["parts"] = [("Buildings", 0.0, 0.0, x, y, 0.0, z)]
    return {name: Object(name=name, **one) for name, one in table.items()}


OBJECTS = _objects()


def asset_for(kind: str, size_m: Iterable[float]) -> tuple[str, tuple[float, float, float]]:
    """Return the asset whose box is most like a box, and its size; one named after the kind where none is."""
    size = tuple(size_m)
    families = {
        "Buildings": ("BP_Building", assets()),
        "Vegetation": ("BP_Tree", assets()),
        "Static": ("", _furniture()),
    }
    begin, table = families.get(kind, ("", {}))
    unlike = {
        name: [math.log(a / b) for a, b in zip(size, one, strict=True)]
        for name, one in table.items()
        if name.startswith(begin)
    }
    near = min(unlike, key=lambda name: sum(x * x for x in unlike[name]), default=None)
    if (
        near is None
        or max(unlike[near]) - min(unlike[near]) > math.log(STRETCH)
        or (kind == "Static" and max(map(abs, unlike[near])) > math.log(2.0))
    ):
        return f"{kind}_C", (1.0, 1.0, 1.0)
    return near, table[near]
