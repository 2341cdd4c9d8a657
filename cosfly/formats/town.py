"""Files in a town's folder of the playback tree: `map.json` (name and licence of the map) and `instance_ids.json` (the
box of each id in `instance.png`)."""

from pathlib import Path

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, LicenceId, MapHeader
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

IDS_FILE, IDS_FORMAT = "instance_ids.json", FileFormat("cosfly.instance_ids", "1.0", "record of ids")
TOWN_FILE, TOWN_FORMAT = "map.json", FileFormat("cosfly.town_map", "1.0", "record of the town's map")


class TownMap(Record):
    """The map of a town: its name, licence and attribution (one sentence or more)."""

    name: str
    licence: LicenceId
    credits: str


def write_town_map(town: Path, header: MapHeader) -> Path:
    """Write what `read_town_map` reads; return the file."""
    shown = TownMap(name=header.name, licence=header.licence, credits=header.credits)
    write_model(town / TOWN_FILE, shown, TOWN_FORMAT)
    return town / TOWN_FILE


def read_town_map(town: Path) -> TownMap:
    """Read the map record of a town's folder; the licence of a foreign tree, without such a file, is unknown."""
    if not (town / TOWN_FILE).exists():
        return TownMap(name=town.name, licence=UNKNOWN_LICENCE, credits="")
    return read_model(town / TOWN_FILE, TownMap, TOWN_FORMAT, tree=town.parent)


class InstanceIds(Record):
    """person: The target's id. shared: Of boxes without an id. others: Of bystanders. boxes: (id, box id)."""

    person: int
    shared: int
    others: list[int] = Field([])
    num_shared: int
    are_box_ids: bool
    boxes: list[tuple[int, int]]

    def of_boxes(self, box_map: BoxMap) -> np.ndarray:
        """Return the ids of a map's boxes, (n,); `shared` for a box that is not listed."""
        id_of = {box_id: instance_id for instance_id, box_id in self.boxes}
        return np.array([id_of.get(int(box_id), self.shared) for box_id in box_map.ids.tolist()])


def read_instance_ids(town: Path) -> InstanceIds:
    """Read the ids of a town's folder; raises as `read_model`."""
    return read_model(town / IDS_FILE, InstanceIds, IDS_FORMAT, tree=town.parent)
