"""A CityJSON city model (0.8 to 2.0, one document or a text sequence, plain or gzipped): polygons become oriented
boxes.

One box round an object can be hundreds of metres wide, so everything is cut up: solids into rectangles that cover their
footprint, surfaces into thin slabs that never stand in anybody's way, walls along their course. Vegetation is a surface
in such models, with the heights of its canopy in the vertices: it becomes a lawn, and trees where it rises well over
the ground. The middle of the map becomes the origin, and the usual height of its roads z = 0; `header.offset_m` leads
back. Ground that is nearly flat is made so; ground that slopes is kept as a grid of heights, from its terrain or the
feet of its buildings, and what is not a solid follows it.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from pydantic import Field
from shapely.geometry import Polygon

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, GroundGrid, LicenceId, MapHeader, MapSource
from cosfly.formats.meshes import MESHES_FILE, Mesh, Meshes, MeshRef
from cosfly.geometry.ground import Ground
from cosfly.maps.boxlist import BoxList
from cosfly.maps.cityjson_file import CityObject, read_model
from cosfly.maps.derived_ground import with_derived_ground
from cosfly.maps.footprints import CUT_SHARES, Rectangle, check_outline, cover, polygons_of, rectangle_polygon, united
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import ConfigError, InputError

FOOT_M = 0.01  # vertices this near to the lowest one are the solid's foot
EDGE_M = 0.05  # what only touches a rectangle is not over it


def solid_mesh(surfaces: list[list[np.ndarray]], foot_m: float) -> Mesh | None:
    """Triangulate surfaces; None where none has an area.

    Args:
        surfaces: rings of vertices, (n, 3) m, of each; ring 0 is the outline, others are holes.
        foot_m: height that the foot comes down to, so that no house floats over ground that a map made flat.
    """
    lowest = min(float(ring[:, 2].min()) for surface in surfaces for ring in surface)
    lowered = [[_founded(ring, lowest, foot_m) for ring in surface] for surface in surfaces]
    found = [part for surface in lowered if len(part := triangles_of(surface))]
    if not found:
        return None
    corners = np.concatenate(found)
    return Mesh(corners, np.full((len(corners), 3), np.nan))


def top_within(mesh: Mesh, rectangle: Rectangle, otherwise: float) -> float:
    """Height of the highest triangle whose bounds meet a rectangle; `otherwise` where none does."""
    yaw = np.radians(rectangle.yaw_deg)
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    flat, half = (mesh.corners_m[..., :2] - rectangle.center) @ axes.T, np.array(rectangle.size) / 2.0 - EDGE_M
    over = ((flat.min(axis=1) < half) & (flat.max(axis=1) > -half)).all(axis=1)
    return float(mesh.corners_m[over, :, 2].max()) if over.any() else otherwise


def _founded(ring: np.ndarray, lowest: float, foot_m: float) -> np.ndarray:
    low = ring.copy()
    low[ring[:, 2] <= lowest + FOOT_M, 2] = min(lowest, foot_m)
    return low


def triangles_of(rings: list[np.ndarray]) -> np.ndarray:
    """Cut a surface, rings of (n, 3), into triangles that turn as its outline does, (k, 3, 3). Corners are the
    surface's own where it is valid.

    Where an outline crosses itself, its valid parts are taken, and new corners lie in the surface's plane.
    """
    outline = rings[0]
    after = np.roll(outline, -1, axis=0)
    normal = np.cross(outline, after).sum(axis=0)  # Newell's, twice the area
    if np.linalg.norm(normal) < 1e-9:
        return np.zeros((0, 3, 3))
    normal /= np.linalg.norm(normal)
    if len(rings) == 1 and len(outline) == 3:
        return outline[None]
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(normal, side)])  # seen from outside the outline turns counter-clockwise
    middle = outline.mean(axis=0)
    flat = [(ring - middle) @ axes.T for ring in rings]
    if len(rings) == 1 and len(outline) == 4 and _is_convex(flat[0]):
        return outline[[(0, 1, 2), (0, 2, 3)]]
    polygon = Polygon(flat[0], flat[1:])
    pieces = polygons_of(polygon if polygon.is_valid else shapely.make_valid(polygon))
    own = {
        (x, y): corner
        for places, ring in zip(flat, rings, strict=True)
        for (x, y), corner in zip(places.tolist(), ring, strict=True)
    }
    found = []
    for triangle in shapely.get_parts([shapely.constrained_delaunay_triangles(piece) for piece in pieces]):
        places = shapely.get_coordinates(shapely.orient_polygons(triangle))[:3]
        found.append([own.get((x, y), middle + (x, y) @ axes) for x, y in places.tolist()])
    return np.array(found).reshape(-1, 3, 3)


def _is_convex(ring: np.ndarray) -> bool:
    edges = np.roll(ring, -1, axis=0) - ring
    following = np.roll(edges, -1, axis=0)
    return bool((edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0] > 0).all())


log = logging.getLogger(__name__)

SLAB_M = 0.3
# Surfaces that people stand on as the source has them. Not water, which lies lower than its banks, nor green, whose
# vertices are its canopy.
TERRAIN_KINDS = ("Roads", "Sidewalks", "Ground", "Terrain", "RailTrack")
RISE_SHARES = (2, 98)  # percentiles: a few stray vertices do not tilt a town
TOLD_RISE_M = 1.0  # less than this is kerbs and steps: made flat without a word
SAME_PLACE_M = 0.1  # vertices nearer than this are one, at their mean height
MOST_NODES = 250_000
SLOPED_WALL_M, SLOPED_WALL_DEPTH_M = 6.0, 1.0  # on a slope walls are cut into steps of this length, founded this deep
STEEP = 0.02  # a surface whose projection is less than this share of its area is a wall: it has no footprint
# Over the ground. Where slabs overlap a little the higher kind is seen, so paths cover roads and roads cover lawns.
SURFACE_TOPS_M = {
    "Sidewalks": 0.0, "Bridge": -0.02, "Walls": 0.0, "Roads": -0.03, "RailTrack": -0.03, "Ground": -0.05,
    "Terrain": -0.1, "Water": -0.07,
}  # fmt: skip


SOLID_FILL = 0.9  # share of a building's boxes that its footprint fills
SOLID_PIECE_M = 3.0  # building pieces of at most this length are not cut again, m
WALL_FILL = 0.6  # share of each box of a wall that the wall fills
WALL_PIECE_M = 1.0  # wall pieces of at most this length are not cut again, m
WALL_MAX_M = 2.5  # highest wall, m: laser heights are often of trees above
SURFACE_FILL = 0.8  # share of each slab that its surface fills
SURFACE_PIECE_M = 2.0  # slabs of at most this length are not cut again, m
SURFACE_MAX_M = 60.0  # longer slabs are cut however full they are, m
WATER_FILL = 0.97  # the same for water, an obstacle that must not spill over quays and bridges
WATER_PIECE_M = 1.5  # slabs of water of at most this length are not cut again, m
CANOPY_M = 2.5  # green that rises higher than this over the ground is a tree, m
CANOPY_MAX_M = 40.0  # tallest tree, m
CANOPY_CELL_M = 2.0  # raster cell of canopies, m
CROWN_CELLS = 3  # cells along a tree's side at most
GROUND_CELL_M = 4.0  # cell of the heights of ground that slopes, m
CROWN_MIN_M = 3.6  # least width of a crown, m: a street tree's plot is smaller


class CityJsonConfig(Config):
    """A CityJSON city model."""

    name: str = Field("CityJson", min_length=1, description="map name, the head of the playback tree's folder names")
    path: Path | None = Field(None, description="the CityJSON file, .json or .city.jsonl, or either gzipped")
    licence: LicenceId = Field(
        UNKNOWN_LICENCE, description="licence of the model, as the hub spells it (cc-by-4.0); goes into every release"
    )
    credits: str = Field("", description="who must be named: the model's makers, one sentence or more")
    tool: str = Field("CityJSON", description="tool and version that made the file, for the records")
    solids: bool = Field(
        True, description="draw solids with their own roofs and walls (meshes.glb); planners keep to the boxes"
    )
    flat_within_m: float = Field(3.0, ge=0.0, description="ground that rises less over the whole map is made flat, m")
    derive_ground: bool = Field(
        True,
        description="a model without streets, pavements and squares gets pavement along facades, asphalt between near "
        "buildings and lawn, derived from the buildings; the map's header and credits say so",
    )

    polygon_vertices: MayDiffer[int] = Field(
        100_000, ge=3, description="most vertices of a surface, its holes included; more are refused"
    )
    polygon_crossings: MayDiffer[int] = Field(
        500, ge=0, description="most crossings of an outline with itself; mending 1,000 takes a second"
    )

    def inputs(self) -> dict[str, Path]:
        if self.path is None:
            fix = "--set maps.cityjson.path=FILE"
            raise ConfigError("no file is given", where="maps.cityjson.path", expected="a path", fix=fix)
        return {"city_model": self.path}


class Facet(NamedTuple):
    """The projection of a surface that is not upright, and its plane z = a x + b y + c."""

    polygon: Polygon
    plane: np.ndarray


def load(cfg: CityJsonConfig, seed: int = 0) -> BoxMap:
    """Read a city model; the seed changes nothing."""
    cfg.inputs()
    assert cfg.path is not None
    model = read_model(cfg.path, cfg.polygon_vertices)
    objects, offset = _centred(model.objects, cfg.path)
    ground = ground_of(objects, cell_m=GROUND_CELL_M, flat_within_m=cfg.flat_within_m)
    objects = objects if ground.is_flat else [_over_ground(item, ground) for item in objects]
    facets = {item.object_id: _facets(item, cfg.polygon_crossings) for item in objects}
    footprints = {key: united([facet.polygon for facet in value]) for key, value in facets.items()}
    boxes, standing = BoxList(), set[int]()  # rows of solids, whose heights are the source's
    refs, made = dict[int, MeshRef](), dict[str, Mesh]()
    footprint_m2 = boxes_m2 = covered_m2 = 0.0
    for item in objects:
        footprint = footprints[item.object_id]
        if item.rule.form == "solid":
            first = len(boxes)
            outline, mesh = _add_solid(boxes, cfg, item, footprint, ground)
            standing.update(range(first, len(boxes)))
            if mesh is not None and len(boxes) > first:
                made[item.object_id] = mesh
                ref = MeshRef(file=MESHES_FILE, node=item.object_id, fit="world")
                refs |= {row + 1: ref for row in range(first, len(boxes))}
            if item.rule.kind == "Buildings":
                footprint_m2, boxes_m2 = footprint_m2 + footprint.area, boxes_m2 + outline.area
                covered_m2 += shapely.intersection(footprint, outline).area
        elif item.rule.form == "wall":
            _add_wall(boxes, item, footprint, is_flat=ground.is_flat)
        elif item.rule.kind != "Water":
            _add_surface(boxes, item.rule.kind, footprint)
        if item.rule.kind == "Bridge":
            _add_surface(boxes, "Sidewalks", footprint)  # what people walk on
        if item.rule.form == "green":
            _add_trees(boxes, item, facets[item.object_id])
    _add_water(boxes, objects, footprints)
    header = MapHeader(
        name=cfg.name,
        source=MapSource(tool=cfg.tool, version=f"CityJSON {model.version}", file=cfg.path.name),
        licence=cfg.licence,
        credits=cfg.credits,
        ground_z_m=0.0,
        offset_m={axis: float(offset[k]) for k, axis in enumerate("xyz")},
        building_footprint_m2=round(footprint_m2, 1),
        building_area_ratio=round(boxes_m2 / footprint_m2, 4) if footprint_m2 else None,
        building_covered_share=round(covered_m2 / footprint_m2, 4) if footprint_m2 else None,
        num_objects=model.num_objects,
        dropped_objects=model.dropped,
    )
    if not ground.is_flat:
        header = header.model_copy(update={"ground": GroundGrid.of(ground)})
    box_map = replace(boxes.box_map(header), meshes=Meshes(refs, made=made))  # ids are rows counted from 1
    if not ground.is_flat:
        follows = ~np.isin(np.arange(len(box_map)), list(standing))
        box_map.centers[follows, 2] += ground.height_at(box_map.centers[follows])
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


def _over_ground(item: CityObject, ground: Ground) -> CityObject:
    """Return an object with heights over the ground under each vertex; solids keep theirs, or their roofs would
    slope."""
    if item.rule.form == "solid":
        return item
    rings = [[r - np.outer(ground.height_at(r), [0.0, 0.0, 1.0]) for r in surface] for surface in item.surfaces]
    return item._replace(surfaces=rings)


def _centred(objects: list[CityObject], path: Path) -> tuple[list[CityObject], np.ndarray]:
    """Move the middle of the map to the origin and the usual height of roads to z = 0; gives the offset too."""
    corners = np.concatenate([item.corners() for item in objects])
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not (high - low <= 20_000).all():
        raise InputError(
            "the map is too wide or too high", where=f"{path}: vertices",
            got=" x ".join(f"{size:.6g}" for size in high - low) + " m", expected="at most 20 km",
            fix="cut a part out, or mend the stray vertex",
        )  # fmt: skip
    roads = [item.corners() for item in objects if item.rule.kind in ("Roads", "Sidewalks")]
    ground = np.median(np.concatenate(roads)[:, 2]) if roads else np.percentile(corners[:, 2], 5)
    offset = np.array([*np.round((low + high)[:2] / 2), round(float(ground), 3)])
    return [
        item._replace(surfaces=_moved(item.surfaces, offset), detailed=_moved(item.detailed, offset))
        for item in objects
    ], offset


def _moved(surfaces: list[list[np.ndarray]], offset: np.ndarray) -> list[list[np.ndarray]]:
    return [[ring - offset for ring in rings] for rings in surfaces]


def _facets(item: CityObject, most_crossings: int) -> list[Facet]:
    """Project the surfaces of an object that are not upright."""
    facets = []
    for surface in item.surfaces:
        ring = surface[0]
        # Newell's normal: right for any planar ring, whatever its first three corners are. (np.cross is slow on short
        # rings.)
        after = np.concatenate([ring[1:], ring[:1]])
        normal = (ring[:, [1, 2, 0]] * after[:, [2, 0, 1]] - ring[:, [2, 0, 1]] * after[:, [1, 2, 0]]).sum(axis=0)
        if abs(normal[2]) <= STEEP * np.linalg.norm(normal) or abs(normal[2]) < 1e-6:
            continue
        a, b = -normal[0] / normal[2], -normal[1] / normal[2]
        middle = ring.mean(axis=0)
        plane = np.array([a, b, middle[2] - a * middle[0] - b * middle[1]])
        polygon = Polygon(ring[:, :2], [hole[:, :2] for hole in surface[1:]])
        check_outline(polygon, item.object_id, most_crossings)
        facets.append(Facet(polygon, plane))
    return facets


# --- boxes ------------------------------------------------------------------------------------------------------------


def _add_solid(
    boxes: BoxList, cfg: CityJsonConfig, item: CityObject, footprint, ground: Ground
) -> tuple[Any, Mesh | None]:
    """Add a building as upright boxes from its lowest ground (or below it) to its top; gives the union of their
    outlines, and what is drawn.

    A box is as high as what is drawn in it: nothing of a spire, which the plainer geometry leaves out, stands out of
    what planners know.
    """
    z = item.corners()[:, 2]
    low = min(float(z.min()), float(ground.height_at(item.corners()).min()))
    high = max(float(z.max()), float(z.min()) + 0.1)
    mesh = solid_mesh(item.detailed, low) if cfg.solids else None
    outlines = []
    for polygon in polygons_of(footprint):
        outline = polygon.simplify(0.05)
        for rectangle in cover(outline, min_fill=SOLID_FILL, min_size_m=SOLID_PIECE_M, shares=CUT_SHARES):
            top = high if mesh is None else top_within(mesh, rectangle, high)
            boxes.add(item.rule.kind, rectangle.center, rectangle.size, low, max(top, low + 0.1), rectangle.yaw_deg)
            outlines.append(rectangle_polygon(rectangle))
    return united(outlines), mesh


def _add_wall(boxes: BoxList, item: CityObject, footprint, *, is_flat: bool) -> None:
    """Add a wall piece by piece along its course, as high as the middle of its heights says."""
    high = float(np.clip(np.percentile(item.corners()[:, 2], 75), 0.3, WALL_MAX_M))
    for polygon in polygons_of(footprint):
        longest_m, low = (np.inf, -SLAB_M) if is_flat else (SLOPED_WALL_M, -SLOPED_WALL_DEPTH_M)
        outline = polygon.simplify(0.02)
        for rectangle in cover(outline, min_fill=WALL_FILL, min_size_m=WALL_PIECE_M, max_size_m=longest_m):
            boxes.add(item.rule.kind, rectangle.center, rectangle.size, low, high, rectangle.yaw_deg)


def _add_surface(boxes: BoxList, kind: str, footprint) -> None:
    """Add a surface as slabs at the height of its kind: the map is flat, so that nothing of it stands in the way."""
    top = SURFACE_TOPS_M.get(kind, -0.1)
    fill, piece_m = (WATER_FILL, WATER_PIECE_M) if kind == "Water" else (SURFACE_FILL, SURFACE_PIECE_M)
    for polygon in polygons_of(footprint):
        for rectangle in cover(polygon.simplify(0.05), min_fill=fill, min_size_m=piece_m, max_size_m=SURFACE_MAX_M):
            boxes.add(kind, rectangle.center, rectangle.size, top - SLAB_M, top, rectangle.yaw_deg)


def _add_water(boxes: BoxList, objects: list[CityObject], footprints: dict[str, Any]) -> None:
    """Add water, cut out where anything crosses it: nobody walks on water, but people walk over bridges."""
    water = [footprints[item.object_id] for item in objects if item.rule.kind == "Water"]
    if not water:
        return
    crossing = [footprints[i.object_id] for i in objects if i.rule.kind in ("Bridge", "Roads", "Sidewalks", "Ground")]
    rest = shapely.difference(united(water), shapely.buffer(united(crossing), 0.05)) if crossing else united(water)
    _add_surface(boxes, "Water", rest)


def _add_trees(boxes: BoxList, item: CityObject, facets: list[Facet]) -> None:
    """Add a vegetation box for every patch of raster cells where the green rises over `canopy_m`."""
    if not facets:
        return
    heights, low = canopy_heights(item, facets, CANOPY_CELL_M)
    for x0, y0, x1, y1, top in crowns(heights, CANOPY_M, CROWN_CELLS):
        first, last = (np.array(corner) + low for corner in ((x0, y0), (x1, y1)))
        size = np.maximum((last - first) * CANOPY_CELL_M, CROWN_MIN_M)
        boxes.add("Vegetation", (first + last) / 2 * CANOPY_CELL_M, size, 0.0, min(top, CANOPY_MAX_M))


def canopy_heights(item: CityObject, facets: list[Facet], cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise the heights of a surface: the highest corner in each cell, and the surface over the cell's middle.

    Returns:
        heights (nx, ny) m, 0 where there is nothing; the indices (2,) of the first cell, whose low corner is at index *
        cell_m.
    """
    bounds = np.array([facet.polygon.bounds for facet in facets])
    corners = item.corners()
    low = np.floor(np.minimum(bounds[:, :2].min(axis=0), corners[:, :2].min(axis=0)) / cell_m).astype(int)
    high = np.floor(np.maximum(bounds[:, 2:].max(axis=0), corners[:, :2].max(axis=0)) / cell_m).astype(int)
    heights = np.zeros(high - low + 1)
    cells = np.floor(corners[:, :2] / cell_m).astype(int) - low
    np.maximum.at(heights, (cells[:, 0], cells[:, 1]), corners[:, 2])
    for facet, (x0, y0, x1, y1) in zip(facets, bounds, strict=True):
        first = np.ceil(np.array([x0, y0]) / cell_m - 0.5).astype(int)
        last = np.floor(np.array([x1, y1]) / cell_m - 0.5).astype(int)
        if (last < first).any():
            continue  # it lies between the middles
        ix, iy = (a.ravel() for a in np.meshgrid(*(np.arange(first[k], last[k] + 1) for k in (0, 1)), indexing="ij"))
        x, y = (ix + 0.5) * cell_m, (iy + 0.5) * cell_m
        inside = shapely.intersects_xy(facet.polygon, x, y)
        z = facet.plane[0] * x + facet.plane[1] * y + facet.plane[2]
        np.maximum.at(heights, (ix[inside] - low[0], iy[inside] - low[1]), z[inside])
    return heights, low


def crowns(heights: np.ndarray, min_height_m: float, max_cells: int) -> list[tuple[int, int, int, int, float]]:
    """Gather the cells of a canopy into trees, the highest first.

    Args:
        heights: (nx, ny) m. max_cells: cells along a tree's side at most.
    Returns:
        (x0, y0, x1, y1, height) in cells, ends excluded; every cell over `min_height_m` lies in exactly one.
    """
    free = heights > min_height_m
    trees = []
    for flat in np.argsort(-heights, axis=None, kind="stable"):
        x, y = (int(k) for k in np.unravel_index(flat, heights.shape))
        if not heights[x, y] > min_height_m:
            break
        if not free[x, y]:
            continue
        x0, y0, x1, y1 = x, y, x + 1, y + 1
        grows = True
        while grows:
            grows = False
            for nx0, ny0, nx1, ny1 in (
                (x0 - 1, y0, x1, y1),
                (x0, y0, x1 + 1, y1),
                (x0, y0 - 1, x1, y1),
                (x0, y0, x1, y1 + 1),
            ):
                fits = nx0 >= 0 and ny0 >= 0 and nx1 <= heights.shape[0] and ny1 <= heights.shape[1]
                if fits and nx1 - nx0 <= max_cells and ny1 - ny0 <= max_cells and free[nx0:nx1, ny0:ny1].all():
                    x0, y0, x1, y1, grows = nx0, ny0, nx1, ny1, True
        free[x0:x1, y0:y1] = False
        trees.append((x0, y0, x1, y1, float(heights[x0:x1, y0:y1].max())))
    return trees


# --- the ground -------------------------------------------------------------------------------------------------------


def ground_of(objects: list[CityObject], *, cell_m: float, flat_within_m: float) -> Ground:
    """Find the ground of a city model whose usual height is 0.

    Args:
        cell_m: of the grid; grown for vast models. flat_within_m: ground that rises by less is given as flat, at 0.
    """
    samples, origin = _samples(objects)
    low, high = np.percentile(samples[:, 2], RISE_SHARES)
    if high - low <= flat_within_m:
        if high - low > TOLD_RISE_M:
            log.warning(
                "the ground rises by %.1f m and is made flat (maps.cityjson.flat_within_m is %g)",
                high - low,
                flat_within_m,
            )
        return Ground.flat(0.0)
    bounds = np.concatenate([item.corners()[:, :2] for item in objects])
    ground = _gridded(samples, bounds.min(axis=0), bounds.max(axis=0), cell_m)
    log.info("the ground rises by %.1f m: heights every %g m from %s", high - low, ground.cell_m, origin)
    return GroundGrid.of(ground).ground()


def _samples(objects: list[CityObject]) -> tuple[np.ndarray, str]:
    """Places on the ground, (n, 3) m, and where they come from."""
    terrain = [item.corners() for item in objects if item.rule.form == "surface" and item.rule.kind in TERRAIN_KINDS]
    if terrain:
        return np.concatenate(terrain), "its terrain and streets"
    feet = [item.corners() for item in objects if item.rule.form == "solid"] or [item.corners() for item in objects]
    middles = [[*(c[:, :2].min(axis=0) + c[:, :2].max(axis=0)) / 2, c[:, 2].min()] for c in feet]
    return np.array(middles), "the feet of its buildings"


def _gridded(samples: np.ndarray, low: np.ndarray, high: np.ndarray, cell_m: float) -> Ground:
    """Lay a grid over a rectangle: linear between samples, beyond them as high as the nearest."""
    # Half a second, which every command would pay for the settings of the maps.
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    places, group = np.unique(np.round(samples[:, :2] / SAME_PLACE_M), axis=0, return_inverse=True)
    heights = np.bincount(group.ravel(), samples[:, 2]) / np.bincount(group.ravel())
    places *= SAME_PLACE_M
    while np.prod((high - low) / cell_m + 2) > MOST_NODES:
        cell_m *= 2.0
    west_south = np.floor(low / cell_m) * cell_m
    num_x, num_y = (np.ceil((high - west_south) / cell_m).astype(int) + 1).clip(2).tolist()
    x, y = np.meshgrid(west_south[0] + cell_m * np.arange(num_x), west_south[1] + cell_m * np.arange(num_y))
    nodes = np.column_stack([x.ravel(), y.ravel()])
    found = NearestNDInterpolator(places, heights)(nodes)
    try:
        linear = LinearNDInterpolator(places, heights)(nodes)
        found = np.where(np.isnan(linear), found, linear)
    except QhullError:  # too few samples, or all on one line: the nearest has to do
        log.warning("the ground has %d samples, which span no area: heights are those of the nearest", len(places))
    return Ground(found.reshape(num_y, num_x), float(west_south[0]), float(west_south[1]), cell_m)
