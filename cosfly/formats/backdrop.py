"""A picture of a map from above (PNG) with its world frame (JSON), on which a region is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.columns import LARGEST
from cosfly.runtime.arrays import read_picture
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

FORMAT = FileFormat("cosfly.backdrop", "1.0", "world frame of a picture")


class WorldFrame(Record):
    """Position of a picture, north up: the world place of its top left corner, and the side of a pixel, m."""

    west_m: float = Field(ge=-LARGEST, le=LARGEST)
    north_m: float = Field(ge=-LARGEST, le=LARGEST)
    metres_per_px: float = Field(gt=0, le=1000)


@dataclass(frozen=True)
class Backdrop:
    """picture: (height, width, 3) uint8 RGB."""

    picture: np.ndarray
    world: WorldFrame

    @classmethod
    def read(cls, path: Path) -> Backdrop:
        """Read a picture and its world frame, the file of the same name that ends in `.json`."""
        return cls(read_picture(path)[..., ::-1], read_model(path.with_suffix(".json"), WorldFrame, FORMAT))

    def frame(self) -> dict[str, float]:
        """Return west, north, width and height, m."""
        height, width = (side * self.world.metres_per_px for side in self.picture.shape[:2])
        return {"west": self.world.west_m, "north": self.world.north_m, "width": width, "height": height}

    def covers(self, box_map: BoxMap) -> bool:
        """Return whether any of the map lies in the picture."""
        (low, high), frame = box_map.bounds(), self.frame()
        is_beside = frame["west"] > high[0] or frame["west"] + frame["width"] < low[0]
        return not (is_beside or frame["north"] < low[1] or frame["north"] - frame["height"] > high[1])


def write_backdrop(path: Path, png: bytes, world: WorldFrame) -> None:
    """Write a picture and its frame, the frame first, so that no picture lacks one."""
    path.unlink(missing_ok=True)  # which may lie elsewhere
    write_model(path.with_suffix(".json"), world, FORMAT)
    write_bytes(path, png)
