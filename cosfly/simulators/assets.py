"""Kinds of the assets of a SimWorld city, by name, and of the objects of a level, by class."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from typing import NamedTuple

from cosfly.formats.kinds import KINDS
from cosfly.runtime.io import sha256_bytes


class Asset(NamedTuple):
    """A family of assets: its kind, and its full size (3,) m if the size table has a placeholder."""

    pattern: str
    kind: str
    default_size_m: tuple[float, float, float] | None = None


# The first pattern that matches an asset's name decides.
ASSETS = (
    Asset("BP_Building_*", "Buildings"),
    Asset("BP_Tree*", "Vegetation"),
    Asset("BP_RoadCone_C", "Static", (0.4, 0.4, 0.75)),
    Asset("BP_RoadBlocker_C", "Static", (2.0, 0.6, 1.0)),
    Asset("BP_Road*", "Roads"),
    Asset("Landscape*", "Terrain"),
    Asset("BP_Scooter_*", "Motorcycle", (1.8, 0.7, 1.2)),
    Asset("BP_Hydrant_C", "Static", (0.4, 0.4, 0.9)),
    Asset("BP_Trash_bin_*", "Static", (0.8, 0.8, 1.2)),
    Asset("BP_Trash_can_C", "Static", (0.6, 0.6, 1.0)),
    Asset("BP_Rabbish_C", "Static", (1.0, 1.0, 0.6)),
    Asset("BP_Can*_C", "Static", (0.5, 0.5, 0.8)),
    Asset("BP_Box*_C", "Static", (0.8, 0.6, 0.6)),
    Asset("BP_Cart*_C", "Static", (2.0, 1.1, 2.1)),
    Asset("BP_Couch_C", "Static", (2.0, 0.9, 0.9)),
    Asset("BP_Table*_C", "Static", (1.6, 1.6, 0.9)),
    Asset("BP_Soda*_C", "Static", (1.1, 0.9, 1.9)),  # vending machines
)

PEOPLE = ("*User_Agent*", "*Pedestrian*", "*Humanoid*")
# Classes with bounds that are no part of a town: movers, and objects of the engine itself.
NOT_TOWN = (
    *PEOPLE, "*Vehicle*", "*Robot*", "*Volume*", "*Sky*", "*Camera*", "*Pawn*", "*Character*", "*Controller*",
    "*Light", "*Manager*", "*Reflection*", "*Fog*", "*NavMesh*", "*LevelBounds*", "*WorldSettings*", "*Brush*",
)  # fmt: skip


def asset_of(name: str) -> Asset | None:
    """Find an asset's entry by its name."""
    return next((asset for asset in ASSETS if fnmatchcase(name, asset.pattern)), None)


def kind_of(class_name: str) -> str | None:
    """Return the kind of an object by its class: that of an asset, or the one in its name, as in Buildings_C.

    None is no part of a town, or unknown.
    """
    if asset := asset_of(class_name):
        return asset.kind
    found = re.match(r"(?:BP_)?([A-Za-z]+)", class_name)
    return found[1] if found and found[1] in KINDS and not is_no_part_of_town(class_name) else None


def is_no_part_of_town(class_name: str) -> bool:
    """Return whether a class is one of NOT_TOWN."""
    return any(fnmatchcase(class_name, pattern) for pattern in NOT_TOWN)


def is_person(path: str) -> bool:
    """Return whether an asset is a person, by its path."""
    return any(fnmatchcase(path, pattern) for pattern in PEOPLE)


def id_of(name: str) -> int:
    """Return the id of an object's box: 48 bits of its name's hash, the same for every client of a level."""
    return int(sha256_bytes(name.encode())[:12], 16)
