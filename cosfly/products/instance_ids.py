"""`instance_ids.json` in a town's folder of the playback tree: which box an id of `instance.png` stands for. Render writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from cosfly.products.boxes import BoxMap
from cosfly.reading.documents import read_model

IDS_SCHEMA, IDS_VERSION, IDS_FILE = "cosfly.instance_ids", "1.0", "instance_ids.json"


class InstanceIds(BaseModel):
    """person: the target's id; shared: that of boxes without one of their own; others: of who moves beside the target; boxes: (id, box id)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    person: int
    shared: int
    others: list[int] = []
    num_shared: int
    are_box_ids: bool
    boxes: list[tuple[int, int]]

    def of_boxes(self, box_map: BoxMap) -> np.ndarray:
        """Give the ids of a map's boxes, (n,); `shared` for a box that is not listed."""
        own = {box_id: instance_id for instance_id, box_id in self.boxes}
        return np.array([own.get(int(box_id), self.shared) for box_id in box_map.ids.tolist()])


def read_instance_ids(town: Path) -> InstanceIds:
    """Read the ids of a town's folder.

    Raises:
        InputError: missing, or not such a file; names the field.
    """
    return read_model(
        town / IDS_FILE, InstanceIds, schema=IDS_SCHEMA, version=IDS_VERSION, what="record of ids", tree=town.parent
    )
