"""The kinds of a SimWorld city's assets, by name, and of a level's objects, by class."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from typing import NamedTuple

from cosfly.formats.kinds import KINDS
from cosfly.runtime.io import sha256_bytes


class Asset(NamedTuple):
    """A family of assets.

    Attributes:
        pattern: Matches the names of the assets.
        default_size_m: Full size (3,), m, of assets for which the size table holds only a placeholder.
    """

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
# Classes of objects that have bounds but do not belong to a town: movers, and objects of the engine.
NOT_TOWN = (
    *PEOPLE, "*Vehicle*", "*Robot*", "*Volume*", "*Sky*", "*Camera*", "*Pawn*", "*Character*", "*Controller*",
    "*Light", "*Manager*", "*Reflection*", "*Fog*", "*NavMesh*", "*LevelBounds*", "*WorldSettings*", "*Brush*",
)  # fmt: skip


def asset_of(name: str) -> Asset | None:
    """Return the entry of an asset's name; None if there is none."""
    return next((asset for asset in ASSETS if fnmatchcase(name, asset.pattern)), None)


def kind_of(class_name: str) -> str | None:
    """Return the kind of an object by its class: the kind of an asset, or a kind in the name, as in Buildings_C.

    None means that the object is unknown or does not belong to a town.
    """
    if asset := asset_of(class_name):
        return asset.kind
    match = re.match(r"(?:BP_)?([A-Za-z]+)", class_name)
    if match is None or match[1] not in KINDS or is_no_part_of_town(class_name):
        return None
    return match[1]


def is_no_part_of_town(class_name: str) -> bool:
    """Return whether a class is one of NOT_TOWN."""
    return any(fnmatchcase(class_name, pattern) for pattern in NOT_TOWN)


def is_person(path: str) -> bool:
    """Return whether the path of an asset is one of PEOPLE."""
    return any(fnmatchcase(path, pattern) for pattern in PEOPLE)


def id_of(name: str) -> int:
    """Return the id of an object's box: 48 bits of the hash of its name, the same for every client of a level."""
    return int(sha256_bytes(name.encode())[:12], 16)
