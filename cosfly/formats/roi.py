"""`roi_polygon.json`, where pedestrians may walk: the paper's form, ours with holes, and GeoJSON in metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pydantic import BaseModel
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import AXES, BoxMap
from cosfly.formats.columns import numbers
from cosfly.formats.geojson import Feature, features_of, is_geojson
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import over_limit, read_bytes
from cosfly.runtime.json_io import parse_document, validated, write_json

WHAT = "region of interest"
MOST_VERTICES = 100_000  # of a region; to see that a spiky ring does not cross itself takes 8 s then
SMALLEST_M = 1.0  # of a region; one that was drawn in degrees is smaller


class RoiPolygon(BaseModel):
    """One outer ring with holes, world x and y in metres."""

    points_world: list[tuple[float, float]] = []
    holes: list[list[tuple[float, float]]] = []


class Roi(RoiPolygon):
    """`roi_polygon.json`: the paper's form (one closed ring), and ours with holes and several outer rings.

    map, axes: of the map that it was drawn on, where the file says so.
    """

    description: str = ""
    map: str = ""
    axes: str = ""
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
        for name, got, expected in (("map", self.map, box_map.name), ("axes", self.axes, AXES)):
            if got not in ("", expected):
                raise InputError(
                    f"the region of interest was drawn with another {name}",
                    where=f"{where}: {name}",
                    got=got,
                    expected=expected,
                    fix="draw the region on this map with cosfly roi edit",
                )


def write_roi(path: Path, roi: Roi) -> None:
    """Write what `read_roi` reads; one polygon without holes is the paper's form (subsec:appendix_g_editor)."""
    fields = roi.model_dump(exclude_defaults=True)
    points = {name: fields.pop(name) for name in ("points_world", "holes", "polygons") if name in fields}
    write_json(path, {**fields, "closed": True, **points}, indent=None)


def read_roi(path: Path, most_vertices: int = MOST_VERTICES) -> Roi:
    """Read a region of interest of at most so many vertices in all its rings; raises as `parse_roi`."""
    return parse_roi(read_bytes(path, what=WHAT), path, most_vertices)


def parse_roi(data: bytes, path: Path, most_vertices: int = MOST_VERTICES) -> Roi:
    """Return the region of interest of a file's bytes."""
    value = parse_document(data, path)
    if is_geojson(value):
        value = {"polygons": _polygons_of(features_of(value, path), path)}
    roi = validated(Roi, value, path)
    if not roi.closed:
        fix = "close the polygon in the editor"
        raise InputError("the polygon is not closed", where=f"{path}: closed", got="false", expected="true", fix=fix)
    if not roi.rings():
        raise InputError("the file has no polygon", where=f"{path}: points_world", expected="at least three points")
    rings = [(k, ring) for k, polygon in enumerate(roi.rings()) for ring in (polygon.points_world, *polygon.holes)]
    num_vertices = sum(len(ring) for _, ring in rings)
    if num_vertices > most_vertices:
        raise over_limit(path, f"{num_vertices:,} vertices", f"{most_vertices:,}", "simplify its rings")
    for number, ring in rings:
        where = f"{path}: polygon {number}"
        if len(ring) < 3 or numbers(ring, None, 2) is None:
            what = "a ring has too few points, or a point that is not finite"
            raise InputError(what, where=where, got=f"{len(ring)} points", expected="at least three finite points")
        reason = shapely.is_valid_reason(shapely.Polygon(ring))
        if reason != "Valid Geometry":
            raise InputError(
                "a ring crosses itself", where=where, got=reason, fix="draw the ring again without crossings"
            )
    return roi


def _polygons_of(features: list[Feature], path: Path) -> list[dict[str, Any]]:
    """Convert GeoJSON, whose rings repeat their first point, to `RoiPolygon` records; InputError lists all problems."""
    problems: list[str] = []
    polygons: list[dict[str, Any]] = []
    for feature in features:
        if feature.problem:
            problems.append(f"{feature.where}: {feature.problem}")
        for rings in feature.parts:
            spread = np.ptp(rings[0], axis=0).max()
            if len(rings[0]) < 4 or spread < SMALLEST_M:
                problems.append(
                    f"{feature.where}: {len(rings[0])} points within {spread:.3g} m are too few or too close"
                )
            points, *holes = (ring[:-1].tolist() for ring in rings)
            polygons.append({"points_world": points, "holes": holes})
    if problems:
        expected = "polygons in world metres, x east and y north, not in longitude and latitude"
        raise InputError.of_all(problems, where=path, expected=expected)
    return polygons
