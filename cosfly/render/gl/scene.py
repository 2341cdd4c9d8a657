"""A map ready to be drawn: the parts of every box, the ground plane, surfaces on sloping ground, and meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import rotation_matrices
from cosfly.geometry.ground import Ground
from cosfly.render.contract import (
    LAYER_STEP,
    NO_INSTANCE,
    STANDING_LAYER,
    chance,
    ground_plane,
    plane_z_m,
    scene_origin,
    seeds_of,
    with_rim,
)
from cosfly.render.gl import meshes, parts
from cosfly.render.gl.lamps import lamps_along_streets, lamps_of
from cosfly.render.gl.parts import GRASS, LOOSE_VERTEX, PART, Boxes, Loose, PartBuilder, Parts
from cosfly.render.gl.shapes import BUILDERS, BUILDING_COLORS, PLAIN_COLORS, TILE_COLORS, plain
from cosfly.render.surfaces import DrapedSurfaces, Solids, are_solids, drape, is_draped, layers_of, solids_of

# --- solids -----------------------------------------------------------------------------------------------------------
# Meshes have walls with storeys and windows, flat roofs, tiles on sloping roofs; plain paint if a file has colours. The
# shader draws patterns in the axes of a part, so every plane of a building is a part of its own.

STEEP, FLAT = 0.35, 0.94  # how far up the normal of a wall points at most, and of a flat roof at least
SAME_ANGLE_RAD, SAME_PLACE_M = np.radians(1.0), 0.1  # surfaces as near to one plane as this are one wall
THINNEST_M = 0.01


def loose_solids(box_map: BoxMap, solids: Solids, origin_m: np.ndarray, ids: np.ndarray) -> Loose:
    """Return the triangles of solids, both sides, for the shader. ids: (n,) of the map's boxes."""
    if not len(solids):
        return Loose.all_of({})
    normals, rows, kinds = solids.normals, solids.rows, box_map.kinds[solids.rows]
    is_house = (kinds == KINDS["Buildings"]) & np.isnan(solids.colors).any(axis=1)
    is_wall, is_flat = is_house & (np.abs(normals[:, 2]) < STEEP), is_house & (np.abs(normals[:, 2]) > FLAT)
    materials = np.where(is_house, np.where(is_wall | is_flat, parts.FACADE, parts.TILES), parts.PLAIN)
    axes, planes = _planes(box_map, solids, is_wall, is_flat, is_house)
    firsts = np.searchsorted(solids.things, np.arange(solids.things[-1] + 2))[:-1]
    low = np.minimum.reduceat(solids.corners_m.min(axis=1), firsts)
    high = np.maximum.reduceat(solids.corners_m.max(axis=1), firsts)
    middles = (low + high)[solids.things] / 2.0
    local = np.einsum("kij,kcj->kci", axes, solids.corners_m - middles[:, None])
    center, half = _spans(local, planes)
    vertices = np.zeros((len(solids), 3), LOOSE_VERTEX)
    vertices["position"] = (local - center[:, None]) / half[:, None]
    vertices["normal"] = (np.einsum("kij,kj->ki", axes, normals) * half)[:, None]
    vertices["center"] = (np.einsum("kji,kj->ki", axes, center) + middles - origin_m)[:, None]
    vertices["half"] = half[:, None]
    vertices["quaternion"] = Rotation.from_matrix(axes.transpose(0, 2, 1)).as_quat()[:, None]
    vertices["color"] = _paint(solids, materials, seeds_of(box_map.ids[rows]))[:, None]
    tags = kinds.astype(np.uint32) | (materials << 8).astype(np.uint32) | (ids[rows].astype(np.uint32) << np.uint32(16))
    vertices["tag"] = tags[:, None]
    vertices["bias"] = LAYER_STEP * STANDING_LAYER
    backs = vertices[:, ::-1].copy()
    backs["normal"] *= -1.0
    both, things = np.concatenate([vertices, backs]), np.tile(solids.things, 2)
    of = np.tile(materials, 2)
    order = {
        int(m): (chosen := np.flatnonzero(of == m))[np.argsort(things[chosen], kind="stable")] for m in np.unique(of)
    }
    return Loose(
        {m: both[chosen].reshape(-1) for m, chosen in order.items()},
        {m: things[chosen] for m, chosen in order.items()},
        (low + high) / 2.0 - origin_m,
        np.linalg.norm(high - low, axis=1) / 2.0,
    )


def _planes(
    box_map: BoxMap, solids: Solids, is_wall: np.ndarray, is_flat: np.ndarray, is_house: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of the part of each triangle, (k, 3, 3) part_from_world, and the number of that part, (k,).

    A wall: x along it, y out, z up. A slope: x along its eaves, y out, z up the slope. A flat roof: turned like its
    house's largest wall, z up. Other things: the axes of the box.
    """
    normals, things = solids.normals, solids.things
    around = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / SAME_ANGLE_RAD).astype(np.int64)
    tilt = np.where(is_wall, 0, np.round(np.arcsin(np.clip(normals[:, 2], -1.0, 1.0)) / SAME_ANGLE_RAD)).astype(
        np.int64
    )
    yaw, rise = around * SAME_ANGLE_RAD, tilt * SAME_ANGLE_RAD
    zero = np.zeros(len(solids))
    out = np.stack([np.cos(yaw) * np.cos(rise), np.sin(yaw) * np.cos(rise), np.sin(rise)], axis=1)
    along = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
    axes = np.stack([along, out, np.cross(along, out)], axis=1)
    main = _main_yaws(solids, is_wall, around)[things] * SAME_ANGLE_RAD
    level = np.stack([np.cos(main), np.sin(main), zero], axis=1), np.stack([-np.sin(main), np.cos(main), zero], axis=1)
    axes[is_flat] = np.stack([*level, np.tile([0.0, 0.0, 1.0], (len(solids), 1))], axis=1)[is_flat]
    turns = rotation_matrices(np.radians(box_map.rotations_deg[solids.rows])).transpose(0, 2, 1)
    axes[~is_house] = turns[~is_house]
    away = np.round(np.einsum("kj,kj->k", out, solids.corners_m.mean(axis=1)) / SAME_PLACE_M).astype(np.int64)
    level_z = np.round(solids.corners_m[..., 2].mean(axis=1) / SAME_PLACE_M).astype(np.int64)
    key = np.stack([things, 1 + is_wall + 2 * is_flat, around, tilt, away], axis=1)
    key[is_flat] = np.stack([things, 3 + 0 * things, 0 * things, 0 * things, level_z], axis=1)[is_flat]
    key[~is_house, 1:] = 0
    return axes, np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)


def _main_yaws(solids: Solids, is_wall: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Return the main direction of each thing's walls, (n,) in steps of SAME_ANGLE_RAD within a quarter turn."""
    quarter = round(np.pi / 2 / SAME_ANGLE_RAD)
    edges = solids.corners_m[:, 1:] - solids.corners_m[:, :1]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) * is_wall
    table = np.zeros((int(solids.things[-1]) + 1, quarter))
    np.add.at(table, (solids.things, around % quarter), areas)
    return table.argmax(axis=1)


def _spans(local: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half size, (k, 3) each, of the part of each triangle; local: (k, 3, 3) corners in its axes."""
    low = np.full((planes.max() + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, planes, local.min(axis=1))
    np.maximum.at(high, planes, local.max(axis=1))
    return ((low + high) / 2.0)[planes], np.maximum((high - low) / 2.0, THINNEST_M)[planes]


def _paint(solids: Solids, materials: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return linear RGB and seed, (k, 4): the file's colour, or the kind's."""

    def picked(palette: np.ndarray) -> np.ndarray:
        return palette[(chance(seeds, 0) * len(palette)).astype(int)]

    of = (materials == parts.FACADE)[:, None], (materials == parts.TILES)[:, None]
    own = np.where(of[0], picked(BUILDING_COLORS), np.where(of[1], picked(TILE_COLORS), picked(PLAIN_COLORS)))
    return np.column_stack([np.where(np.isnan(solids.colors), own, solids.colors), seeds * 0.999])


HAS_PAINT = 2.0  # seed of a road on a map with its own lane markings; the shader draws none on it


@dataclass(frozen=True)
class Scene:
    """A map ready to be drawn. origin_m: (3,) world position of the parts' zero; plane_z_m: the ground plane, world.

    draped: the surfaces on `ground`, empty where that is flat; solids: the meshes of boxes. lamps: (n, 3) relative to
    the parts' zero, lamps of a map that has none among its parts.
    """

    parts: Parts
    origin_m: np.ndarray
    plane_z_m: float
    ground: Ground
    draped: Loose
    solids: Loose
    lamps: np.ndarray

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest place of things on the ground plane, (3,) each, world."""
        centers = self.parts.object_centers[:-1] if len(self.parts) > 1 else self.parts.object_centers
        centers = np.concatenate([centers, self.solids.centers])
        return centers.min(axis=0) + self.origin_m, centers.max(axis=0) + self.origin_m


def build_scene(town: BoxMap, num_others: int = 0, rim: BoxMap | None = None) -> Scene:
    """Convert a map and its rim to drawable parts, with a ground plane under everything."""
    origin, (box_map, all_ids) = scene_origin(town), with_rim(town, num_others, rim)
    solids, are_meshes = solids_of(box_map), are_solids(box_map)
    builder, lies = PartBuilder(), is_draped(box_map) & ~are_meshes
    # Surfaces on a slope are built on a plane, so that they find their neighbours, and lifted afterwards.
    centers = box_map.centers - origin
    centers[lies, 2] -= box_map.ground.height_at(box_map.centers[lies])
    lying = np.zeros(len(box_map), PART)
    tiers = layers_of(box_map) % 1.0
    has_paint = bool((town.kinds == KINDS["RoadLines"]).any())
    for kind in np.unique(box_map.kinds[~are_meshes]):
        rows = np.flatnonzero((box_map.kinds == kind) & ~are_meshes)
        boxes = Boxes(
            centers[rows],
            np.maximum(box_map.half_extents[rows], 1e-3),
            rotation_matrices(np.radians(box_map.rotations_deg[rows])),
            all_ids[rows],
            seeds_of(box_map.ids[rows]),
            int(kind),
            tiers[rows],
        )
        if kind == KINDS["Roads"] and has_paint:
            boxes = replace(boxes, seeds=np.where(boxes.ids == NO_INSTANCE, boxes.seeds, HAS_PAINT))
        build = BUILDERS.get(int(kind), plain)
        if not lies[rows].any():
            build(builder, boxes)
            continue
        surfaces = PartBuilder()
        build(surfaces, boxes)
        parts = surfaces.finish()  # surfaces have one part each
        lying[rows] = parts.records
        builder.add_parts(parts.select(~lies[rows]))
    plane = PartBuilder()
    center, half = ground_plane(town, rim)
    ids, seeds = np.full(1, NO_INSTANCE, np.uint16), np.zeros(1)
    ground = Boxes((center - origin)[None], half[None], np.eye(3)[None], ids, seeds, KINDS["Terrain"], np.zeros(1))
    plane.add(ground, meshes.BOX, half[None], GRASS, np.array([0.105, 0.14, 0.045]), layer=0)
    bare = plane.finish()
    builder.add_parts(bare)
    loose = {} if box_map.ground.is_flat else _loose(drape(box_map), origin, np.append(lying, bare.records))
    standing = loose_solids(box_map, solids, origin, all_ids)
    parts = builder.finish()
    lamps = np.zeros((0, 3)) if len(lamps_of(parts)) else lamps_along_streets(town) - origin
    return Scene(parts, origin, plane_z_m(town), town.ground, Loose.all_of(loose), standing, lamps)


def _loose(draped: DrapedSurfaces, origin: np.ndarray, records: np.ndarray) -> dict[int, np.ndarray]:
    """Return the vertices of draped triangles by material, in the axes of their boxes, in which shaders draw lanes.

    Args:
        records: (n + 1,) PART of the map's boxes; the last is the bare ground's.
    """
    parts = records[draped.rows]  # BARE_GROUND is -1, the last
    axes = Rotation.from_quat(parts["quaternion"].astype(np.float64)).inv().as_matrix()
    half = parts["half"].astype(np.float64)
    local = np.einsum("kij,kcj->kci", axes, draped.corners_m - origin - parts["center"][:, None])
    vertices = np.zeros((len(parts), 3), LOOSE_VERTEX)
    vertices["position"] = local / half[:, None]
    vertices["normal"] = (np.einsum("kij,kj->ki", axes, draped.normals) * half)[:, None]
    for name in PART.names or ():
        vertices[name] = parts[name][:, None]
    materials = (parts["tag"] >> 8) & 0xFF
    return {int(material): vertices[materials == material].reshape(-1) for material in np.unique(materials)}
