"""`roi_polygon.json`: where pedestrians may walk. The paper's form, and ours with holes and several outer rings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel

from cosfly.errors import InputError
from cosfly.products.columns import is_in_range
from cosfly.reading.documents import read_json, validation_errors
from cosfly.reading.limits import limits, over_limit


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
    num_vertices = sum(len(ring) for polygon in roi.rings() for ring in (polygon.points_world, *polygon.holes))
    if num_vertices > limits().polygon_vertices:
        raise over_limit("polygon_vertices", path, f"{num_vertices:,} vertices")
    for number, polygon in enumerate(roi.rings()):
        for ring in (polygon.points_world, *polygon.holes):
            if len(ring) < 3 or not is_in_range(np.array(ring, dtype=np.float64)):
                where, got = f"{path}: polygon {number}", f"{len(ring)} points"
                raise InputError("not a ring", where=where, got=got, expected="at least three finite points")
    return roi
