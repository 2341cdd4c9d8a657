"""Files in a town's folder of the playback tree: `map.json` and `instance_ids.json`."""

from pathlib import Path

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, LicenceId, MapHeader
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

IDS_FILE = "instance_ids.json"
IDS_FORMAT = FileFormat("cosfly.instance_ids", "1.0", "record of ids")
TOWN_FILE = "map.json"
TOWN_FORMAT = FileFormat("cosfly.town_map", "1.0", "record of the town's map")


class TownMap(Record):
    """`map.json`: the map of a town."""

    name: str
    licence: LicenceId
    credits: str  # the attribution, in one or more sentences


def write_town_map(town: Path, header: MapHeader) -> Path:
    """Write what `read_town_map` reads; return the file."""
    town_map = TownMap(name=header.name, licence=header.licence, credits=header.credits)
    write_model(town / TOWN_FILE, town_map, TOWN_FORMAT)
    return town / TOWN_FILE


def read_town_map(town: Path) -> TownMap:
    """Read the map record of a town's folder; the licence of a foreign tree, without such a file, is unknown."""
    if not (town / TOWN_FILE).exists():
        return TownMap(name=town.name, licence=UNKNOWN_LICENCE, credits="")
    return read_model(town / TOWN_FILE, TownMap, TOWN_FORMAT, tree=town.parent)


class InstanceIds(Record):
    """`instance_ids.json`: the ids in `instance.png`, and the boxes that have them."""

    person: int  # id of the target
    shared: int  # id of all boxes without an id of their own
    others: list[int] = Field([])  # ids of bystanders
    num_shared: int  # number of boxes with the id `shared`
    are_box_ids: bool  # whether each box has its number in the map as its id
    boxes: list[tuple[int, int]]  # (id, id of the box in the map)

    def of_boxes(self, box_map: BoxMap) -> np.ndarray:
        """Return the ids of a map's boxes, (n,); `shared` for a box that is not listed."""
        id_of = {box_id: instance_id for instance_id, box_id in self.boxes}
        return np.array([id_of.get(int(box_id), self.shared) for box_id in box_map.ids.tolist()])


def read_instance_ids(town: Path) -> InstanceIds:
    """Read the ids of a town's folder; raises as `read_model`."""
    return read_model(town / IDS_FILE, InstanceIds, IDS_FORMAT, tree=town.parent)
