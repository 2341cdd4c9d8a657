"""A map ready to be drawn: the parts of every box, the ground plane, meshes, and lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import rotation_matrices
from cosfly.render import contract
from cosfly.render.contract import LAYER_STEP, NO_INSTANCE, STANDING_LAYER, seeds_of
from cosfly.render.gl import meshes, parts
from cosfly.render.gl.parts import LOOSE_VERTEX, Boxes, LooseTriangles, Parts
from cosfly.render.gl.shapes import BUILDING_COLORS, PLAIN_COLORS, TILE_COLORS, parts_of
from cosfly.render.surfaces import Solids, are_solids, layers_of, solids_of

# --- solids -----------------------------------------------------------------------------------------------------------
# The triangles of meshes. Buildings get walls with storeys and windows, flat roofs, and tiles on sloping roofs; meshes
# with colours of their own get plain paint. The shader draws patterns in the axes of a part, so each plane of a
# building is a part.

STEEP = 0.35  # largest z of a wall's normal
FLAT = 0.94  # least z of a flat roof's normal
SAME_ANGLE_RAD, SAME_PLACE_M = np.radians(1.0), 0.1  # surfaces that differ by less are one plane
THINNEST_M = 0.01  # half size of a flat part


def loose_solids(box_map: BoxMap, solids: Solids, origin_m: np.ndarray, ids: np.ndarray) -> LooseTriangles:
    """Return the triangles of solids for the shader, which draws both of their sides.

    ids: (n,) instance ids of the map's boxes.
    """
    if not len(solids):
        return LooseTriangles({}, {}, np.zeros((0, 3)), np.zeros(0))
    kinds = box_map.kinds[solids.rows]
    seeds = seeds_of(box_map.ids[solids.rows])
    normals = solids.normals
    is_house = kinds == KINDS["Buildings"]
    is_wall = is_house & (np.abs(normals[:, 2]) < STEEP)
    is_flat = is_house & (np.abs(normals[:, 2]) > FLAT)
    materials = np.where(is_house, np.where(is_wall | is_flat, parts.FACADE, parts.TILES), parts.PLAIN)
    axes, part_numbers = _planes(box_map, solids, is_wall, is_flat, is_house)
    low_m, high_m = _bounds_of_things(solids)
    middles_m = (low_m + high_m)[solids.things] / 2.0
    # Corners in the axes of their part, from the middle of their thing; center and half: bounds of the parts there.
    local_m = np.einsum("kij,kcj->kci", axes, solids.corners_m - middles_m[:, None])
    centers_m, halves_m = (bound[part_numbers] for bound in _bounds_of_parts(local_m, part_numbers))
    vertices = np.zeros((len(solids), 3), LOOSE_VERTEX)
    vertices["position"] = (local_m - centers_m[:, None]) / halves_m[:, None]
    for name, values in {
        "normal": np.einsum("kij,kj->ki", axes, normals) * halves_m,
        "center": np.einsum("kji,kj->ki", axes, centers_m) + middles_m - origin_m,
        "half": halves_m,
        "quaternion": Rotation.from_matrix(axes.transpose(0, 2, 1)).as_quat(),
        "color": np.column_stack([_painted(materials, seeds), seeds * 0.999]),
        "tag": parts.tags(kinds, materials, ids[solids.rows]),
    }.items():
        vertices[name] = values[:, None]
    vertices["bias"] = LAYER_STEP * STANDING_LAYER
    back_sides = vertices[:, ::-1].copy()
    back_sides["normal"] *= -1.0
    vertices = np.concatenate([vertices, back_sides])
    materials, things = np.tile(materials, 2), np.tile(solids.things, 2)
    rows_of = {
        int(material): np.lexsort((things, materials != material))[: np.count_nonzero(materials == material)]
        for material in np.unique(materials)
    }
    return LooseTriangles(
        {material: vertices[rows].reshape(-1) for material, rows in rows_of.items()},
        {material: things[rows] for material, rows in rows_of.items()},
        (low_m + high_m) / 2.0 - origin_m,
        np.linalg.norm(high_m - low_m, axis=1) / 2.0,
    )


def _bounds_of_things(solids: Solids) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner of each placed mesh, (n, 3) each, world."""
    first_rows = np.searchsorted(solids.things, np.arange(solids.things[-1] + 2))[:-1]
    low_m = np.minimum.reduceat(solids.corners_m.min(axis=1), first_rows)
    high_m = np.maximum.reduceat(solids.corners_m.max(axis=1), first_rows)
    return low_m, high_m


def _bounds_of_parts(local_m: np.ndarray, part_numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and half size of each part, (p, 3) each, from the corners (k, 3, 3) of its triangles."""
    low_m = np.full((part_numbers.max() + 1, 3), np.inf)
    high_m = -low_m
    np.minimum.at(low_m, part_numbers, local_m.min(axis=1))
    np.maximum.at(high_m, part_numbers, local_m.max(axis=1))
    return (low_m + high_m) / 2.0, np.maximum((high_m - low_m) / 2.0, THINNEST_M)


def _painted(materials: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return the colours of triangles from the palettes of their materials, (k, 3) linear RGB."""
    colors = np.zeros((len(materials), 3))
    for material, palette in ((parts.FACADE, BUILDING_COLORS), (parts.TILES, TILE_COLORS), (parts.PLAIN, PLAIN_COLORS)):
        picked = palette[(contract.chance(seeds, 0) * len(palette)).astype(int)]
        colors = np.where((materials == material)[:, None], picked, colors)
    return colors


def _planes(
    box_map: BoxMap, solids: Solids, is_wall: np.ndarray, is_flat: np.ndarray, is_house: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of the part of each triangle, (k, 3, 3) part_from_world, and the number of that part, (k,).

    Axes of a wall: x along it, y out, z up. Of a slope: x along its eaves, y out, z up the slope. Of a flat roof: those
    of the main direction of its house's walls, z up. Of other things: those of the box.
    """
    normals = solids.normals
    things = solids.things
    zero = np.zeros(len(solids))
    around = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / SAME_ANGLE_RAD).astype(np.int64)
    slope = np.round(np.arcsin(np.clip(normals[:, 2], -1.0, 1.0)) / SAME_ANGLE_RAD)
    tilt = np.where(is_wall, 0, slope).astype(np.int64)
    yaw, rise = around * SAME_ANGLE_RAD, tilt * SAME_ANGLE_RAD
    out = np.stack([np.cos(yaw) * np.cos(rise), np.sin(yaw) * np.cos(rise), np.sin(rise)], axis=1)
    along = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
    axes = np.stack([along, out, np.cross(along, out)], axis=1)
    # The main direction of the walls of each house, by area, in steps of SAME_ANGLE_RAD within a quarter turn.
    quarter = round(np.pi / 2 / SAME_ANGLE_RAD)
    edges = solids.corners_m[:, 1:] - solids.corners_m[:, :1]
    areas = np.zeros((int(things[-1]) + 1, quarter))
    np.add.at(areas, (things, around % quarter), np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) * is_wall)
    main = areas.argmax(axis=1)[things] * SAME_ANGLE_RAD
    level = [np.cos(main), np.sin(main), zero, -np.sin(main), np.cos(main), zero, zero, zero, zero + 1.0]
    axes[is_flat] = np.stack(level, axis=1).reshape(-1, 3, 3)[is_flat]
    turns = rotation_matrices(np.radians(box_map.rotations_deg[solids.rows])).transpose(0, 2, 1)
    axes[~is_house] = turns[~is_house]
    away = np.round(np.einsum("kj,kj->k", out, solids.corners_m.mean(axis=1)) / SAME_PLACE_M).astype(np.int64)
    level_z = np.round(solids.corners_m[..., 2].mean(axis=1) / SAME_PLACE_M).astype(np.int64)
    # The key of a part: direction, tilt and distance from the origin of a wall or slope; the height of a flat roof;
    # any other thing is one part.
    key = np.stack([things, 1 + is_wall + 2 * is_flat, around, tilt, away], axis=1)
    key[is_flat, 2:4] = 0
    key[is_flat, 4] = level_z[is_flat]
    key[~is_house, 1:] = 0
    return axes, np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)


# --- lamps ------------------------------------------------------------------------------------------------------------

# On a map without lamps, lamps along the streets give light. They are not drawn, since no box represents them.
STREETS = ("Roads", "Sidewalks")
ALONG_M = 16.0  # distance from one to the next along a street
APART_M = 12.0  # least distance of any two
HIGH_M = 6.5  # height over the street
FROM_EDGE_M = 0.5


def lamps_along_streets(box_map: BoxMap) -> np.ndarray:
    """Return positions of lamps along the streets of a map without lamps, (n, 3) m, world; the largest street first."""
    streets = box_map.select(box_map.is_any_of({KINDS[name] for name in STREETS}))
    half = streets.half_extents
    turns = rotation_matrices(np.radians(streets.rotations_deg))
    lamps = [np.zeros((0, 3))]
    for row in np.lexsort((streets.ids, -half[:, 0] * half[:, 1])):
        along, across = (0, 1) if half[row, 0] >= half[row, 1] else (1, 0)
        steps = np.arange(max(1, round(2.0 * half[row, along] / ALONG_M)))
        local = np.zeros((len(steps), 3))
        local[:, along] = half[row, along] * ((2.0 * steps + 1.0) / len(steps) - 1.0)
        local[:, across] = np.where(steps % 2, 1.0, -1.0) * max(half[row, across] - FROM_EDGE_M, 0.0)
        lamps.append(streets.centers[row] + local @ turns[row].T)
    places = np.concatenate(lamps)
    stays = np.ones(len(places), bool)
    pairs = cKDTree(places[:, :2]).query_pairs(APART_M, output_type="ndarray") if len(places) else []
    for first, second in sorted(map(tuple, pairs)):
        stays[second] &= not stays[first]
    places = places[stays]
    places[:, 2] = np.maximum(places[:, 2], box_map.ground_z_m) + HIGH_M
    return places


# --- scenes -----------------------------------------------------------------------------------------------------------

HAS_PAINT = 2.0  # seed of a road on a map with its own lane markings; the shader draws none on it


@dataclass(frozen=True)
class Scene:
    """A map ready to be drawn."""

    parts: Parts
    origin_m: np.ndarray  # (3,) world position of the origin of the parts
    plane_z_m: float  # height of the ground plane, world
    loose: LooseTriangles  # the meshes of boxes
    lamps: np.ndarray  # (n, 3) relative to the origin; only for a map without lamps among its parts

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest place of things on the ground plane, (3,) each, world."""
        centers = self.parts.object_centers[:-1] if len(self.parts) > 1 else self.parts.object_centers
        centers = np.concatenate([centers, self.loose.centers])
        return centers.min(axis=0) + self.origin_m, centers.max(axis=0) + self.origin_m


def build_scene(box_map: BoxMap, num_others: int = 0) -> Scene:
    """Convert a map to drawable parts, with a ground plane under everything."""
    origin = contract.scene_origin(box_map)
    all_ids = contract.instance_ids(box_map, num_others)
    are_meshes = are_solids(box_map)
    all_parts = list[Parts]()
    centers = box_map.centers - origin
    tiers = layers_of(box_map) % 1.0
    seeds = seeds_of(box_map.ids)
    turns = rotation_matrices(np.radians(box_map.rotations_deg))
    half = np.maximum(box_map.half_extents, 1e-3)
    if (box_map.kinds == KINDS["RoadLines"]).any():
        seeds[box_map.kinds == KINDS["Roads"]] = HAS_PAINT
    for kind in np.unique(box_map.kinds[~are_meshes]).tolist():
        rows = np.flatnonzero((box_map.kinds == kind) & ~are_meshes)
        boxes = Boxes(centers[rows], half[rows], turns[rows], all_ids[rows], seeds[rows], kind, tiers[rows])
        all_parts += parts_of(boxes)
    center, half_m = contract.ground_plane(box_map)
    ids = np.full(1, NO_INSTANCE, np.uint16)
    zero = np.zeros(1)  # seed and tier
    plane = Boxes((center - origin)[None], half_m[None], np.eye(3)[None], ids, zero, KINDS["Terrain"], zero)
    all_parts.append(plane.part(meshes.BOX, half_m[None], parts.GRASS, (0.105, 0.14, 0.045), layer=0))
    loose = loose_solids(box_map, solids_of(box_map), origin, all_ids)
    all_drawn = Parts.concatenate(all_parts)
    lamps = np.zeros((0, 3)) if len(all_drawn.lamps()) else lamps_along_streets(box_map) - origin
    return Scene(all_drawn, origin, contract.plane_z_m(box_map), loose, lamps)
