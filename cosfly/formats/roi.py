"""`roi_polygon.json`, where pedestrians may walk: the paper's form, and ours with holes."""

from pathlib import Path

import shapely
from pydantic import BaseModel
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import AXES, BoxMap
from cosfly.formats.columns import numbers
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import over_limit, read_bytes
from cosfly.runtime.json_io import parse_document, validated, write_json

WHAT = "region of interest"
MOST_VERTICES = 100_000  # of a region; to see that a spiky ring does not cross itself takes 8 s then


class RoiPolygon(BaseModel):
    """One outer ring with holes, world x and y in metres."""

    points_world: list[tuple[float, float]] = []
    holes: list[list[tuple[float, float]]] = []


class Roi(RoiPolygon):
    """`roi_polygon.json`: the paper's form (one closed ring), and ours with holes and several outer rings."""

    description: str = ""
    map: str = ""  # that it was drawn on, if the file names one
    axes: str = ""  # of this map
    closed: bool = True
    polygons: list[RoiPolygon] = []

    def rings(self) -> list[RoiPolygon]:
        """Return all polygons as rings."""
        return [self, *self.polygons] if self.points_world else self.polygons

    def region(self) -> BaseGeometry:
        """Return all polygons without their holes as one area."""
        areas = [
            shapely.Polygon(ring.points_world) - shapely.union_all([shapely.Polygon(hole) for hole in ring.holes])
            for ring in self.rings()
        ]
        return shapely.union_all(areas)

    def check_map(self, box_map: BoxMap, where: str | Path) -> None:
        """Check that the map and the axes in the file, if it holds them, are those of this map."""
        expected_values = {
            "map": ("the region of interest was drawn on another map", box_map.name),
            "axes": ("the region of interest was drawn with other axes", AXES),
        }
        for name, (what, expected) in expected_values.items():
            if (got := getattr(self, name)) not in ("", expected):
                fix = "draw the region on this map with cosfly roi edit"
                raise InputError(what, where=f"{where}: {name}", got=got, expected=expected, fix=fix)


def write_roi(path: Path, roi: Roi) -> None:
    """Write what `read_roi` reads; one polygon without holes is the paper's form (subsec:appendix_g_editor)."""
    fields = roi.model_dump(exclude_defaults=True)
    points = {name: fields.pop(name) for name in ("points_world", "holes", "polygons") if name in fields}
    write_json(path, {**fields, "closed": True, **points}, indent=None)


def read_roi(path: Path) -> Roi:
    """Read a region of interest; raises as `parse_roi`."""
    return parse_roi(read_bytes(path, what=WHAT), path)


def parse_roi(data: bytes, path: Path) -> Roi:
    """Return the region of interest of a file's bytes."""
    roi = validated(Roi, parse_document(data, path), path)
    if not roi.closed:
        what = "the polygon of the region of interest is not closed"
        fix = "close the polygon with cosfly roi edit"
        raise InputError(what, where=f"{path}: closed", got="false", expected="true", fix=fix)
    if not roi.rings():
        expected = "a polygon with at least three points"
        fix = "draw the region with cosfly roi edit"
        raise InputError("the region has no polygon", where=f"{path}: points_world", expected=expected, fix=fix)
    rings = [(k, ring) for k, polygon in enumerate(roi.rings()) for ring in (polygon.points_world, *polygon.holes)]
    num_vertices = sum(len(ring) for _, ring in rings)
    if num_vertices > MOST_VERTICES:
        raise over_limit(path, f"{num_vertices:,} vertices", f"{MOST_VERTICES:,} vertices", "simplify the rings")
    for number, ring in rings:
        where = f"{path}: polygon {number}"
        if len(ring) < 3 or numbers(ring, None, 2) is None:
            what = "a ring of the polygon has too few points, or a coordinate that is not a finite number"
            raise InputError(what, where=where, got=f"the ring {ring}"[:80], expected="three or more finite points")
        reason = shapely.is_valid_reason(shapely.Polygon(ring))
        if reason != "Valid Geometry":
            fix = "draw the ring again without crossings"
            raise InputError("a ring of the polygon crosses itself", where=where, got=reason, fix=fix)
    return roi
