"""A CityJSON city model (1.1 or 2.0, one document or a text sequence, plain or gzipped) as a map of oriented boxes.

Polygons are cut into several boxes, because one box around an object can be hundreds of metres wide. Surfaces become
thin slabs that never obstruct a pedestrian. Green areas with the heights of their canopy become a lawn, and trees where
they rise over the ground.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import shapely
from pydantic import Field
from shapely.geometry import Polygon

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.formats.meshes import MESHES_FILE, Meshes, MeshRef
from cosfly.maps.boxlist import WIDEST_M, BoxList, MapLicence, MapName, origin_m, required
from cosfly.maps.cityjson_file import CityObject, Surface, read_model
from cosfly.maps.footprints import (
    CUT_SHARES,
    MIN_AREA_M2,
    Rectangle,
    check_outline,
    cover,
    num_cuts,
    polygons_of,
    united,
    with_derived_ground,
)
from cosfly.runtime.config import Config

log = logging.getLogger(__name__)

# Shape of boxes: share of its boxes that a footprint fills; pieces that are no longer, m, are not cut again.
SOLID_FILL, SOLID_PIECE_M = 0.9, 3.0
WALL_FILL, WALL_PIECE_M = 0.6, 1.0
SURFACE_FILL, SURFACE_PIECE_M = 0.8, 2.0
WATER_FILL, WATER_PIECE_M = 0.97, 1.5  # an obstacle that must not spill over quays and bridges
SURFACE_MAX_M = 60.0  # longer slabs are cut even if full
STEEP = 0.02  # a surface with a projection of less than this share of its area is a wall: it has no footprint

# Heights.
SLAB_M = 0.3
WALL_MAX_M = 2.5  # highest wall: laser heights are often of trees above
FOOT_M = 0.01  # vertices this near to the lowest one are the solid's foot
EDGE_M = 0.05  # parts that only touch a rectangle are not over it
# Tops of surfaces over the ground. Where slabs overlap a little the higher kind is seen, so paths cover roads and roads
# cover lawns.
SURFACE_TOPS_M = {
    "Sidewalks": 0.0, "Bridge": -0.02, "Walls": 0.0, "Roads": -0.03, "RailTrack": -0.03, "Ground": -0.05,
    "Terrain": -0.1, "Water": -0.07,
}  # fmt: skip

# Trees.
CANOPY_M, CANOPY_MAX_M = 2.5, 40.0  # green that rises higher over the ground is a tree; tallest tree
CANOPY_CELL_M = 2.0  # raster cell of canopies
MOST_CELLS = 400_000  # of all canopies; vast ones get larger cells
CROWN_CELLS, CROWN_MIN_M = 3, 3.6  # cells along a tree's side at most; least width of a crown: plots are smaller

# The ground. Surfaces that people walk on at the file's height; not water, which is lower than its banks, nor green,
# with the canopy in its vertices.
TERRAIN_KINDS = ("Roads", "Sidewalks", "Ground", "Terrain", "RailTrack")
FLAT_WITHIN_M = 3.0  # ground that rises less over the whole map keeps its heights
REPORTED_RISE_M = 1.0  # a smaller rise is kerbs and steps
RISE_SHARES = (2, 98)  # percentiles: a few stray vertices do not tilt a town
FAR_M = 100 * WIDEST_M  # of corners beyond all samples, so that the ground of the border goes on
SAME_PLACE_M = 0.1  # vertices nearer than this are one, at their mean height


class CityJsonConfig(Config):
    """A CityJSON city model."""

    name: MapName = "CityJson"
    path: Path | None = Field(None, description="CityJSON file: .json or .city.jsonl, also gzipped")
    licence: MapLicence = UNKNOWN_LICENCE
    credits: str = Field("", description="attribution of the model's makers, in one or more sentences")
    units: Literal["auto", "m", "ft", "us-ft"] = Field(
        "auto",
        description="unit of the coordinates: m, ft (0.3048 m) or us-ft (0.3048006 m); auto: what `referenceSystem` "
        "declares, and without that metres",
    )
    # largest share of objects that may be skipped because they are invalid or far away
    most_skipped: ClassVar[float] = 0.2
    tool: str = Field("CityJSON", description="tool and version that made the file, for the records")
    solids: bool = Field(True, description="draw solids with their own roofs and walls; planners use the boxes")
    derive_ground: bool = Field(True, description="derive streets, pavements and lawn for a model that has no streets")

    def inputs(self) -> dict[str, Path]:
        return {"city_model": required(self.path, "maps.cityjson.path")}


class Facet(NamedTuple):
    """The projection of a surface that is not upright, and its plane z = a x + b y + c."""

    polygon: Polygon
    plane: np.ndarray  # (3,): a, b, c


class Crown(NamedTuple):
    """The cells of one tree in the raster of a canopy; the ends are excluded."""

    x0: int
    y0: int
    x1: int
    y1: int
    height_m: float


def load(cfg: CityJsonConfig, seed: int = 0) -> BoxMap:
    """Read a city model; the seed changes nothing."""
    path = cfg.inputs()["city_model"]
    model = read_model(path, cfg.units, cfg.most_skipped)
    objects, origin = _centred(model.objects, path)
    boxes, meshes = _boxes_of(_flattened(objects), cfg, model.dropped.counts)
    header = MapHeader(
        name=cfg.name, source=MapSource(tool=cfg.tool, version=f"CityJSON {model.version}", file=path.name),
        licence=cfg.licence, credits=cfg.credits, ground_z_m=0.0,
        offset_m=dict(zip("xyz", origin.tolist(), strict=True)),
        num_objects=model.num_objects, dropped_objects=dict(+model.dropped.counts),
    )  # fmt: skip
    box_map = replace(boxes.box_map(header), meshes=meshes)
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


def _boxes_of(objects: list[CityObject], cfg: CityJsonConfig, dropped: Counter[str]) -> tuple[BoxList, Meshes]:
    """Return the boxes of all objects by the forms of their rules (solid, wall, surface, green), and their meshes.

    An object without a box is counted in `dropped`.
    """
    facets_of = {item.object_id: _facets(item) for item in objects}
    footprints = {key: united([facet.polygon for facet in facets]) for key, facets in facets_of.items()}
    greens = [item for item in objects if item.rule.form == "green" and facets_of[item.object_id]]
    cell_m = _canopy_cell_m(greens)
    boxes = BoxList()
    meshes = Meshes()
    for item in objects:
        footprint = footprints[item.object_id]
        kind = item.rule.kind
        num_before = len(boxes)
        if item.rule.form == "solid":
            _add_solid(boxes, meshes, cfg, item, footprint)
        elif item.rule.form == "wall":
            _add_wall(boxes, item, footprint)
        elif kind == "Water":  # all water is added last
            continue
        else:
            _add_surface(boxes, kind, footprint)
            facets = facets_of[item.object_id]
            if item.rule.form == "green" and facets:
                _add_trees(boxes, item, facets, cell_m)
        if kind == "Bridge":
            _add_surface(boxes, "Sidewalks", footprint)  # for pedestrians
        if len(boxes) == num_before:
            dropped["no_footprint"] += 1
    water = _open_water(objects, footprints)
    _add_surface(boxes, "Water", water)
    for item in objects:
        if item.rule.kind == "Water" and shapely.intersection(footprints[item.object_id], water).area <= MIN_AREA_M2:
            dropped["under_other_surfaces"] += 1
    return boxes, meshes


def _open_water(objects: list[CityObject], footprints: dict[str, Any]) -> Any:
    """Return the water without the bridges and streets that cross it: pedestrians cannot walk on water."""
    water = united([footprints[item.object_id] for item in objects if item.rule.kind == "Water"])
    crossing_kinds = ("Bridge", "Roads", "Sidewalks", "Ground")
    crossing = [footprints[item.object_id] for item in objects if item.rule.kind in crossing_kinds]
    if crossing:
        water = shapely.difference(water, shapely.buffer(united(crossing), 0.05))
    return water


def _centred(objects: list[CityObject], path: Path) -> tuple[list[CityObject], np.ndarray]:
    """Move the middle of the map to the origin and the usual height of roads to z = 0; return the offset too."""
    corners = np.concatenate([item.corners() for item in objects])
    roads = [item.corners() for item in objects if item.rule.kind in ("Roads", "Sidewalks")]
    ground = np.median(np.concatenate(roads)[:, 2]) if roads else np.percentile(corners[:, 2], 5)
    origin = origin_m(corners.min(axis=0), corners.max(axis=0), f"{path}: vertices", float(ground))
    return [item.moved(lambda ring: ring - origin) for item in objects], origin


# --- footprints -------------------------------------------------------------------------------------------------------


def _facets(item: CityObject) -> list[Facet]:
    """Project the surfaces of an object that are not upright."""
    facets = []
    for ring, *holes in item.surfaces:
        # Newell's normal is correct for any planar ring; np.cross is slow on short rings.
        after = np.concatenate([ring[1:], ring[:1]])
        normal = (ring[:, [1, 2, 0]] * after[:, [2, 0, 1]] - ring[:, [2, 0, 1]] * after[:, [1, 2, 0]]).sum(axis=0)
        if abs(normal[2]) <= STEEP * np.linalg.norm(normal) or abs(normal[2]) < 1e-6:
            continue
        a, b = -normal[0] / normal[2], -normal[1] / normal[2]
        middle = ring.mean(axis=0)
        plane = np.array([a, b, middle[2] - a * middle[0] - b * middle[1]])
        polygon = Polygon(ring[:, :2], [hole[:, :2] for hole in holes])
        check_outline(polygon, item.object_id)
        facets.append(Facet(polygon, plane))
    return facets


def _pieces(boxes: BoxList, footprint: Any, tolerance_m: float, **settings: Any) -> Iterator[Rectangle]:
    """Yield the rectangles that cover each polygon of a footprint, simplified; their number is bounded before."""
    for polygon in polygons_of(footprint):
        sizes = settings["min_size_m"], settings.get("max_size_m", np.inf)
        simple = polygon.simplify(tolerance_m)
        boxes.reserve(num_cuts(simple, *sizes, settings.get("shares", (0.5,))), shapely.count_coordinates(simple))
        yield from cover(simple, **settings)


# --- solids and walls -------------------------------------------------------------------------------------------------


def _add_solid(boxes: BoxList, meshes: Meshes, cfg: CityJsonConfig, item: CityObject, footprint: Any) -> None:
    """Add a solid as upright boxes from the ground (or below it) to its top, and its mesh to draw.

    A box is as high as the mesh in it, so that planners know its spires.
    """
    z = item.corners()[:, 2]
    bottom_m = min(float(z.min()), 0.0)
    top_m = max(float(z.max()), float(z.min()) + 0.1)
    mesh = solid_mesh(item.detailed, bottom_m) if cfg.solids else None
    first_row = len(boxes)
    for rectangle in _pieces(boxes, footprint, 0.05, min_fill=SOLID_FILL, min_size_m=SOLID_PIECE_M, shares=CUT_SHARES):
        high_m = max(top_m if mesh is None else _top_within(mesh, rectangle, top_m), bottom_m + 0.1)
        boxes.add(item.rule.kind, rectangle.center, rectangle.size, bottom_m, high_m, rectangle.yaw_deg)
    rows = range(first_row, len(boxes))
    if mesh is not None and rows:
        meshes.made[item.object_id] = mesh
        ref = MeshRef(file=MESHES_FILE, node=item.object_id, fit="world")
        meshes.refs.update({row + 1: ref for row in rows})  # ids are rows counted from 1


def solid_mesh(surfaces: list[Surface], foot_m: float) -> np.ndarray | None:
    """Return the triangles of surfaces, (k, 3, 3) m; None if none has an area.

    The foot is lowered to `foot_m`, so that no house floats over ground that a map made flat.
    """
    lowest = min(float(ring[:, 2].min()) for surface in surfaces for ring in surface)
    parts = []
    for surface in surfaces:
        rings = [ring.copy() for ring in surface]
        for ring in rings:
            ring[ring[:, 2] <= lowest + FOOT_M, 2] = min(lowest, foot_m)
        parts.append(_triangles_of(rings))
    corners = np.concatenate(parts)
    return corners if len(corners) else None


def _add_wall(boxes: BoxList, item: CityObject, footprint: Any) -> None:
    """Add a wall as boxes that are as high as the upper quartile of its vertices."""
    top_m = float(np.clip(np.percentile(item.corners()[:, 2], 75), 0.3, WALL_MAX_M))
    for piece in _pieces(boxes, footprint, 0.02, min_fill=WALL_FILL, min_size_m=WALL_PIECE_M):
        boxes.add(item.rule.kind, piece.center, piece.size, -SLAB_M, top_m, piece.yaw_deg)


def _top_within(mesh: np.ndarray, rectangle: Rectangle, default: float) -> float:
    """Return the height of the highest triangle over a rectangle; `default` if there is none."""
    yaw = np.radians(rectangle.yaw_deg)
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    flat = (mesh[..., :2] - rectangle.center) @ axes.T
    half = np.array(rectangle.size) / 2.0 - EDGE_M
    over = ((flat.min(axis=1) < half) & (flat.max(axis=1) > -half)).all(axis=1)
    return float(mesh[over, :, 2].max()) if over.any() else default


def _triangles_of(rings: Surface) -> np.ndarray:
    """Return the triangles of a surface, (k, 3, 3) m, with its own corners and the winding of its outline.

    If the outline crosses itself, its valid parts are used; their new corners lie in the surface's plane.
    """
    outline = rings[0]
    normal = np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0)  # Newell's, twice the area
    if np.linalg.norm(normal) < 1e-9:
        return np.zeros((0, 3, 3))
    if len(rings) == 1 and len(outline) == 3:
        return outline[None]
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(normal, side)])  # seen from outside the outline turns counter-clockwise
    middle = outline.mean(axis=0)
    flat = [(ring - middle) @ axes.T for ring in rings]
    polygon = Polygon(flat[0], flat[1:])
    pieces = polygons_of(polygon if polygon.is_valid else shapely.make_valid(polygon))
    flat_corners = map(tuple, np.concatenate(flat).tolist())
    corner_at = dict(zip(flat_corners, np.concatenate(rings), strict=True))  # (x, y) in the plane -> corner
    triangles = []
    for triangle in shapely.get_parts([shapely.constrained_delaunay_triangles(piece) for piece in pieces]):
        positions = shapely.get_coordinates(shapely.orient_polygons(triangle))[:3]
        triangles.append([corner_at.get((x, y), middle + (x, y) @ axes) for x, y in positions.tolist()])
    return np.array(triangles).reshape(-1, 3, 3)


# --- surfaces and trees -----------------------------------------------------------------------------------------------


def _add_surface(boxes: BoxList, kind: str, footprint: Any) -> None:
    """Add a surface as slabs at the height of its kind, so that it never obstructs a pedestrian."""
    top_m = SURFACE_TOPS_M.get(kind, -0.1)
    fill, piece_m = (WATER_FILL, WATER_PIECE_M) if kind == "Water" else (SURFACE_FILL, SURFACE_PIECE_M)
    for piece in _pieces(boxes, footprint, 0.05, min_fill=fill, min_size_m=piece_m, max_size_m=SURFACE_MAX_M):
        boxes.add(kind, piece.center, piece.size, top_m - SLAB_M, top_m, piece.yaw_deg)


def _canopy_cell_m(greens: list[CityObject]) -> float:
    """Return the raster cell of canopies, so that all of them together have at most about MOST_CELLS."""
    cell_m = CANOPY_CELL_M
    spans = np.array([np.ptp(item.corners()[:, :2], axis=0) for item in greens]).reshape(-1, 2)
    while (spans / cell_m + 1).prod(axis=1).sum() > MOST_CELLS + len(greens):
        cell_m += CANOPY_CELL_M
    if cell_m > CANOPY_CELL_M:
        log.warning("plants cover so large an area that trees are made of cells of %g m", cell_m)
    return cell_m


def _add_trees(boxes: BoxList, item: CityObject, facets: list[Facet], cell_m: float) -> None:
    """Add a vegetation box for every patch of raster cells where the green rises over CANOPY_M."""
    heights_m, first_cell = _canopy_heights(item, facets, cell_m)
    for crown in _crowns(heights_m):
        begin = np.add(first_cell, (crown.x0, crown.y0))
        end = np.add(first_cell, (crown.x1, crown.y1))
        size_m = np.maximum((end - begin) * cell_m, CROWN_MIN_M)
        boxes.add("Vegetation", (begin + end) / 2 * cell_m, size_m, 0.0, min(crown.height_m, CANOPY_MAX_M))


def _canopy_heights(item: CityObject, facets: list[Facet], cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise a surface: the highest corner in each cell, and the height over the cell's middle.

    Return heights (nx, ny) m, 0 off the surface, and the indices (2,) of the first cell: low corner / cell_m.
    """
    bounds = np.array([facet.polygon.bounds for facet in facets])
    corners = item.corners()
    first_cell = np.floor(np.minimum(bounds[:, :2].min(axis=0), corners[:, :2].min(axis=0)) / cell_m).astype(int)
    last_cell = np.floor(np.maximum(bounds[:, 2:].max(axis=0), corners[:, :2].max(axis=0)) / cell_m).astype(int)
    heights_m = np.zeros(last_cell - first_cell + 1)
    cells = np.floor(corners[:, :2] / cell_m).astype(int) - first_cell
    np.maximum.at(heights_m, (cells[:, 0], cells[:, 1]), corners[:, 2])
    for facet, facet_bounds in zip(facets, bounds, strict=True):
        # The cells with their middle in the facet's bounds: none where the facet lies between the middles.
        begin = np.ceil(facet_bounds[:2] / cell_m - 0.5).astype(int)
        end = np.floor(facet_bounds[2:] / cell_m - 0.5).astype(int) + 1
        grids = np.meshgrid(np.arange(begin[0], end[0]), np.arange(begin[1], end[1]), indexing="ij")
        cells = np.stack([grid.ravel() for grid in grids], axis=1)
        x, y = (cells.T + 0.5) * cell_m
        a, b, c = facet.plane
        z = a * x + b * y + c
        inside = shapely.intersects_xy(facet.polygon, x, y)
        cells = cells[inside] - first_cell
        np.maximum.at(heights_m, (cells[:, 0], cells[:, 1]), z[inside])
    return heights_m, first_cell


def _crowns(heights_m: np.ndarray) -> list[Crown]:
    """Gather the cells of a canopy, heights (nx, ny) m, into trees, the highest first.

    Every cell over CANOPY_M is in exactly one tree.
    """
    is_free = heights_m > CANOPY_M
    crowns = []
    for flat_index in np.argsort(-heights_m, axis=None, kind="stable"):
        x, y = (int(index) for index in np.unravel_index(flat_index, heights_m.shape))
        if not heights_m[x, y] > CANOPY_M:
            break
        if is_free[x, y]:
            x0, y0, x1, y1 = _grown(is_free, x, y)
            is_free[x0:x1, y0:y1] = False
            crowns.append(Crown(x0, y0, x1, y1, float(heights_m[x0:x1, y0:y1].max())))
    return crowns


def _grown(is_free: np.ndarray, x: int, y: int) -> tuple[int, int, int, int]:
    """Grow a cell by free rows and columns to at most CROWN_CELLS a side; return x0, y0, x1, y1, ends excluded."""
    tree = (x, y, x + 1, y + 1)
    before = (0, 0, 0, 0)
    while tree != before:
        before = tree
        # One more column in the west or east, or row in the south or north; of several that fit the last counts.
        for step in ((-1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)):
            x0, y0, x1, y1 = (side + change for side, change in zip(before, step, strict=True))
            fits = x0 >= 0 and y0 >= 0 and x1 <= is_free.shape[0] and y1 <= is_free.shape[1]
            if fits and max(x1 - x0, y1 - y0) <= CROWN_CELLS and is_free[x0:x1, y0:y1].all():
                tree = x0, y0, x1, y1
    return tree


# --- flat ground ------------------------------------------------------------------------------------------------------


def _flattened(objects: list[CityObject]) -> list[CityObject]:
    """Lower the objects by the height of the ground, so that it is flat at 0.

    Surfaces are lowered vertex by vertex. A solid is lowered as a whole, by the lowest ground below it, or its roof
    would slope.
    """
    terrain = [item.corners() for item in objects if item.rule.form == "surface" and item.rule.kind in TERRAIN_KINDS]
    if terrain:
        samples = np.concatenate(terrain)
    else:  # the bases of buildings
        solids = [item for item in objects if item.rule.form == "solid"] or objects
        ends = [(item.corners().min(axis=0), item.corners().max(axis=0)) for item in solids]
        samples = np.array([[*(first + last)[:2] / 2, first[2]] for first, last in ends])
    rise_m = float(np.ptp(np.percentile(samples[:, 2], RISE_SHARES)))
    if rise_m <= FLAT_WITHIN_M:
        if rise_m > REPORTED_RISE_M:
            log.warning("the ground rises by %.1f m: surfaces are laid flat, buildings keep their heights", rise_m)
        return objects
    log.warning("the ground rises by %.1f m: the map is made flat", rise_m)
    ground_m = _heights_between(samples)
    up = np.array([0.0, 0.0, 1.0])

    def lowered(item: CityObject) -> CityObject:
        if item.rule.form != "solid":
            return item.moved(lambda ring: ring - np.outer(ground_m(ring[:, :2]), up))
        lowest_m = ground_m(item.corners()[:, :2]).min()
        return item.moved(lambda ring: ring - lowest_m * up)

    return [lowered(item) for item in objects]


def _heights_between(samples: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from places, (n, 2), to heights, (n,): linear between samples, (k, 3).

    Beyond the samples a height is about that of the border.
    """
    # Imported here: half a second that every command would spend for the settings of the maps.
    from scipy.interpolate import LinearNDInterpolator

    places, group = np.unique(np.round(samples[:, :2] / SAME_PLACE_M), axis=0, return_inverse=True)
    heights = np.bincount(group.ravel(), samples[:, 2]) / np.bincount(group.ravel())
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * FAR_M  # so that every place lies between samples
    heights = np.append(heights, np.full(len(corners), heights.mean()))
    return LinearNDInterpolator(np.concatenate([places * SAME_PLACE_M, corners]), heights)
