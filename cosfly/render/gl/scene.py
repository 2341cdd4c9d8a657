"""A map ready to be drawn: the parts of every box, the ground plane, meshes, and lamps."""

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
# The triangles of meshes, each an object. Buildings get walls with storeys and windows, flat roofs, and tiles on
# sloping roofs; other objects get plain paint. The shader draws patterns in the axes of a part, so each plane of a
# building is a part; any other object is one part.

OTHER, SLOPE, WALL, FLAT_ROOF = range(4)  # surfaces: those of buildings, and OTHER for all other objects
MATERIAL_OF_SURFACE = np.array([parts.PLAIN, parts.TILES, parts.FACADE, parts.FACADE])
WALL_Z_MAX = 0.35  # of a wall's normal
FLAT_ROOF_Z_MIN = 0.94  # of a flat roof's normal
SAME_ANGLE_RAD, SAME_PLACE_M = np.radians(1.0), 0.1  # surfaces that differ by less are one plane
NUM_QUARTER_STEPS = round(np.pi / 2 / SAME_ANGLE_RAD)  # steps of SAME_ANGLE_RAD in a quarter turn
THINNEST_M = 0.01  # half size of a flat part
SEED_SHARE = 0.999  # of seeds: in the shader, 1 or more asks for the rim of a roof (shapes.HAS_RIM)


def loose_solids(box_map: BoxMap, solids: Solids, origin_m: np.ndarray, ids: np.ndarray) -> LooseTriangles:
    """Return the triangles of solids for the shader, which draws both of their sides.

    Args:
        ids: (n,) instance ids of the map's boxes.
    """
    if not len(solids):
        return LooseTriangles({}, {}, np.zeros((0, 3)), np.zeros(0))
    upright = np.abs(solids.normals[:, 2])
    surfaces = np.where(upright < WALL_Z_MAX, WALL, np.where(upright > FLAT_ROOF_Z_MIN, FLAT_ROOF, SLOPE))
    surfaces[box_map.kinds[solids.rows] != KINDS["Buildings"]] = OTHER
    low_m, high_m = _bounds(solids.corners_m, solids.objects)
    middles_m = (low_m + high_m) / 2.0
    front_sides = _vertices(box_map, solids, surfaces, middles_m[solids.objects], origin_m, ids)
    back_sides = front_sides[:, ::-1].copy()
    back_sides["normal"] *= -1.0
    vertices = np.concatenate([front_sides, back_sides])
    materials = np.tile(MATERIAL_OF_SURFACE[surfaces], 2)
    objects = np.tile(solids.objects, 2)
    rows_of = {}
    for material in np.unique(materials).tolist():
        rows = np.flatnonzero(materials == material)
        rows_of[material] = rows[np.argsort(objects[rows], kind="stable")]  # both sides of an object are together
    return LooseTriangles(
        vertices={material: vertices[rows].reshape(-1) for material, rows in rows_of.items()},
        objects={material: objects[rows] for material, rows in rows_of.items()},
        centers=middles_m - origin_m,
        radii=np.linalg.norm(high_m - low_m, axis=1) / 2.0,
    )


def _vertices(
    box_map: BoxMap, solids: Solids, surfaces: np.ndarray, middles_m: np.ndarray, origin_m: np.ndarray, ids: np.ndarray
) -> np.ndarray:
    """Return the vertices of the triangles, (k, 3) LOOSE_VERTEX; middles_m: (k, 3) of the object of each triangle."""
    materials = MATERIAL_OF_SURFACE[surfaces]
    seeds = seeds_of(box_map.ids[solids.rows])
    axes, part_numbers = _planes(box_map, solids, surfaces)
    # Corners in the axes of their part, from the middle of their object; center and half: bounds of the parts there.
    local_m = np.einsum("kij,kcj->kci", axes, solids.corners_m - middles_m[:, None])
    part_low_m, part_high_m = (bound[part_numbers] for bound in _bounds(local_m, part_numbers))
    centers_m = (part_low_m + part_high_m) / 2.0
    halves_m = np.maximum((part_high_m - part_low_m) / 2.0, THINNEST_M)
    vertices = np.zeros((len(solids), 3), LOOSE_VERTEX)
    # The shader scales `position` by `half`, so positions lie within -1 to 1. Normals scale inversely.
    vertices["position"] = (local_m - centers_m[:, None]) / halves_m[:, None]
    for name, values in {
        "normal": np.einsum("kij,kj->ki", axes, solids.normals) * halves_m,
        "center": np.einsum("kji,kj->ki", axes, centers_m) + middles_m - origin_m,
        "half": halves_m,
        "quaternion": Rotation.from_matrix(axes.transpose(0, 2, 1)).as_quat(),
        "color": np.column_stack([_painted(materials, seeds), seeds * SEED_SHARE]),
        "tag": parts.tags(box_map.kinds[solids.rows], materials, ids[solids.rows]),
    }.items():
        vertices[name] = values[:, None]
    vertices["bias"] = LAYER_STEP * STANDING_LAYER
    return vertices


def _bounds(corners_m: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner of the triangles (k, 3, 3) with each number (k,), (n, 3) each."""
    low_m = np.full((numbers.max() + 1, 3), np.inf)
    high_m = -low_m
    np.minimum.at(low_m, numbers, corners_m.min(axis=1))
    np.maximum.at(high_m, numbers, corners_m.max(axis=1))
    return low_m, high_m


def _painted(materials: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return the colours of triangles from the palettes of their materials, (k, 3) linear RGB."""
    colors = np.zeros((len(materials), 3))
    for material, palette in ((parts.FACADE, BUILDING_COLORS), (parts.TILES, TILE_COLORS), (parts.PLAIN, PLAIN_COLORS)):
        picked = palette[(contract.chance(seeds, 0) * len(palette)).astype(int)]
        colors = np.where((materials == material)[:, None], picked, colors)
    return colors


def _planes(box_map: BoxMap, solids: Solids, surfaces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of the part of each triangle, (k, 3, 3) part_from_world, and the number of that part, (k,).

    Axes by surface:
        wall: x along it, y out, z up
        slope: x along its eaves, y out, z up the slope
        flat roof: those of the main direction of its house's walls, z up
        other: those of the box
    """
    normals = solids.normals
    # Directions of normals in whole steps of SAME_ANGLE_RAD: equal numbers are one direction.
    yaw_steps = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / SAME_ANGLE_RAD).astype(np.int64)
    tilt_steps = np.round(np.arcsin(np.clip(normals[:, 2], -1.0, 1.0)) / SAME_ANGLE_RAD).astype(np.int64)
    tilt_steps[surfaces == WALL] = 0
    yaws_rad = yaw_steps * SAME_ANGLE_RAD
    tilts_rad = tilt_steps * SAME_ANGLE_RAD
    sine, cosine = np.sin(yaws_rad), np.cos(yaws_rad)
    out = np.stack([cosine * np.cos(tilts_rad), sine * np.cos(tilts_rad), np.sin(tilts_rad)], axis=1)
    along = np.stack([sine, -cosine, np.zeros_like(sine)], axis=1)
    axes = np.stack([along, out, np.cross(along, out)], axis=1)
    is_flat = surfaces == FLAT_ROOF
    is_other = surfaces == OTHER
    axes[is_flat] = _main_axes(solids, surfaces == WALL, yaw_steps)[is_flat]
    box_axes = rotation_matrices(np.radians(box_map.rotations_deg[solids.rows])).transpose(0, 2, 1)
    axes[is_other] = box_axes[is_other]
    middles_m = solids.corners_m.mean(axis=1)
    # Distance of the plane from the origin. A flat roof counts by its height, since it is not quite level.
    away_m = np.where(is_flat, middles_m[:, 2], np.einsum("kj,kj->k", out, middles_m))
    away_steps = np.round(away_m / SAME_PLACE_M).astype(np.int64)
    key = np.stack([solids.objects, surfaces, yaw_steps, tilt_steps, away_steps], axis=1)
    key[is_flat, 2:4] = 0  # all directions of a flat roof are one
    key[is_other, 2:] = 0  # any other object is one part
    return axes, np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)


def _main_axes(solids: Solids, is_wall: np.ndarray, yaw_steps: np.ndarray) -> np.ndarray:
    """Return level axes along the walls of each triangle's house, by the direction of most wall area, (k, 3, 3)."""
    edges = solids.corners_m[:, 1:] - solids.corners_m[:, :1]
    wall_areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) * is_wall  # twice the areas
    areas = np.zeros((int(solids.objects[-1]) + 1, NUM_QUARTER_STEPS))  # walls at right angles have one direction
    np.add.at(areas, (solids.objects, yaw_steps % NUM_QUARTER_STEPS), wall_areas)
    yaws_rad = areas.argmax(axis=1)[solids.objects] * SAME_ANGLE_RAD
    sine, cosine, zero = np.sin(yaws_rad), np.cos(yaws_rad), np.zeros(len(solids))
    return np.stack([cosine, sine, zero, -sine, cosine, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)


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
        k = np.arange(max(1, round(2.0 * half[row, along] / ALONG_M)))
        local = np.zeros((len(k), 3))
        local[:, along] = half[row, along] * ((2.0 * k + 1.0) / len(k) - 1.0)
        local[:, across] = np.where(k % 2, 1.0, -1.0) * max(half[row, across] - FROM_EDGE_M, 0.0)  # alternating sides
        lamps.append(streets.centers[row] + local @ turns[row].T)
    places = np.concatenate(lamps)
    is_kept = np.ones(len(places), bool)
    near_pairs = cKDTree(places[:, :2]).query_pairs(APART_M, output_type="ndarray") if len(places) else []
    for first, second in sorted(map(tuple, near_pairs)):
        is_kept[second] &= not is_kept[first]
    places = places[is_kept]
    places[:, 2] = np.maximum(places[:, 2], box_map.ground_z_m) + HIGH_M
    return places


# --- scenes -----------------------------------------------------------------------------------------------------------

HAS_PAINT = 2.0  # seed of a road on a map with its own lane markings; the shader draws none on it
PLANE_COLOR = (0.105, 0.14, 0.045)


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
    has_mesh = are_solids(box_map)
    all_parts = list[Parts]()
    centers = box_map.centers - origin
    tiers = layers_of(box_map) % 1.0
    seeds = seeds_of(box_map.ids)
    turns = rotation_matrices(np.radians(box_map.rotations_deg))
    half = np.maximum(box_map.half_extents, parts.LEAST_HALF_M)
    if (box_map.kinds == KINDS["RoadLines"]).any():
        seeds[box_map.kinds == KINDS["Roads"]] = HAS_PAINT
    for kind in np.unique(box_map.kinds[~has_mesh]).tolist():
        rows = np.flatnonzero((box_map.kinds == kind) & ~has_mesh)
        boxes = Boxes(centers[rows], half[rows], turns[rows], all_ids[rows], seeds[rows], kind, tiers[rows])
        all_parts += parts_of(boxes)
    plane_center, plane_half = contract.ground_plane(box_map)
    plane = Boxes(
        centers=(plane_center - origin)[None], half=plane_half[None], turns=np.eye(3)[None],
        ids=np.full(1, NO_INSTANCE, np.uint16), seeds=np.zeros(1), kind=KINDS["Terrain"], tiers=np.zeros(1),
    )  # fmt: skip
    all_parts.append(plane.part(meshes.BOX, plane.half, parts.GRASS, PLANE_COLOR, layer=0))
    scene_parts = Parts.concatenate(all_parts)
    loose = loose_solids(box_map, solids_of(box_map), origin, all_ids)
    lamps = np.zeros((0, 3)) if len(scene_parts.lamps()) else lamps_along_streets(box_map) - origin
    return Scene(scene_parts, origin, contract.plane_z_m(box_map), loose, lamps)
