"""The kinds of a SimWorld city's assets, by name, and of a level's objects, by class: `assets.yaml`."""

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from cosfly.formats.kinds import KINDS
from cosfly.runtime.config import read_yaml
from cosfly.runtime.io import sha256_bytes


class Asset(NamedTuple):
    """A family of assets."""

    pattern: str  # of their names
    kind: str
    size_m: Sequence[float] | None = None  # full size of those for which the size table holds only a placeholder


_TABLE = read_yaml(Path(__file__).with_name("assets.yaml"))
ASSETS = tuple(Asset(**fields) for fields in _TABLE["assets"])
NOT_TOWN = _TABLE["not_town"]


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
    """Return whether a class has bounds but does not belong to a town."""
    return any(fnmatchcase(class_name, pattern) for pattern in NOT_TOWN)


def id_of(name: str) -> int:
    """Return the id of an object's box: 48 bits of the hash of its name, the same for every client of a level."""
    return int(sha256_bytes(name.encode())[:12], 16)
