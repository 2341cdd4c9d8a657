"""`map.json` in a town's folder of the playback tree: what its flights show, and whose it is. Render writes it, a release reads it."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cosfly.products.boxes import UNKNOWN_LICENCE, LicenceId, MapHeader
from cosfly.reading.documents import read_model
from cosfly.work.store import write_model

TOWN_SCHEMA, TOWN_VERSION, TOWN_FILE = "cosfly.town_map", "1.0", "map.json"


class TownMap(BaseModel):
    """The map below a town's flights: its name and licence, and who must be named (one sentence or more)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    licence: LicenceId
    credits: str


def write_town_map(town: Path, header: MapHeader) -> Path:
    """Write what `read_town_map` reads; give the file."""
    shown = TownMap(name=header.name, licence=header.licence, credits=header.credits)
    write_model(town / TOWN_FILE, shown, schema=TOWN_SCHEMA, version=TOWN_VERSION)
    return town / TOWN_FILE


def read_town_map(town: Path) -> TownMap:
    """Read what a town's folder says of its map; a foreign tree has no such file, and its licence is unknown."""
    if not (town / TOWN_FILE).exists():
        return TownMap(name=town.name, licence=UNKNOWN_LICENCE, credits="")
    return read_model(
        town / TOWN_FILE, TownMap, schema=TOWN_SCHEMA, version=TOWN_VERSION, what="town's map", tree=town.parent
    )
