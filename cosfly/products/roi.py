"""`roi_polygon.json`: where pedestrians may walk. The paper's form, and ours with holes and several outer rings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel

from cosfly.errors import InputError
from cosfly.store import read_json, validation_errors


class RoiPolygon(BaseModel):
    """One outer ring with holes, world x and y in metres."""

    points_world: list[tuple[float, float]] = []
    holes: list[list[tuple[float, float]]] = []


class Roi(RoiPolygon):
    """`roi_polygon.json`: the paper's form (one closed ring), and ours with holes and several outer rings."""

    closed: bool = True
    polygons: list[RoiPolygon] = []

    def rings(self) -> list[RoiPolygon]:
        """All polygons in one form."""
        return [self, *self.polygons] if self.points_world else self.polygons


def read_roi(path: Path) -> Roi:
    """Read a region of interest.

    Raises:
        InputError: malformed, not closed, or a ring of fewer than three finite points.
    """
    value = read_json(path, what="region of interest")
    with validation_errors(path):
        roi = Roi.model_validate(value)
    if not roi.closed:
        where, fix = f"{path}: closed", "close it in the editor"
        raise InputError("the polygon is not closed", where=where, got="false", expected="true", fix=fix)
    if not roi.rings():
        raise InputError("no polygon", where=f"{path}: points_world", expected="at least three points")
    for number, polygon in enumerate(roi.rings()):
        for ring in (polygon.points_world, *polygon.holes):
            if len(ring) < 3 or not np.isfinite(np.array(ring, dtype=np.float64)).all():
                where, got = f"{path}: polygon {number}", f"{len(ring)} points"
                raise InputError("not a ring", where=where, got=got, expected="at least three finite points")
    return roi
