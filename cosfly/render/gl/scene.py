"""A map ready to be drawn: the parts of every box, a ground plane under everything, the surfaces on ground that slopes, and meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.geometry import rotation_matrices
from cosfly.products.boxes import BoxMap
from cosfly.products.ground import Ground
from cosfly.products.kinds import KINDS
from cosfly.render.contract import NO_INSTANCE, ground_plane, instance_ids, plane_z_m, scene_origin, seeds_of
from cosfly.render.draping import Draped, drape, is_draped
from cosfly.render.gl import meshes
from cosfly.render.gl.lamps import lamps_along_streets, lamps_of
from cosfly.render.gl.loose import Loose
from cosfly.render.gl.parts import GRASS, LOOSE_VERTEX, PART, Boxes, PartBuilder, Parts
from cosfly.render.gl.shapes import BUILDERS, plain
from cosfly.render.gl.solids import loose_solids
from cosfly.render.layers import layers_of
from cosfly.render.solids import are_solids, solids_of

HAS_PAINT = 2.0  # seed of a road whose map brings its own lane markings; the shader draws none on it


@dataclass(frozen=True)
class Scene:
    """A map ready to be drawn. origin_m: (3,) world position of the parts' zero; plane_z_m: the ground plane, world.

    draped: the surfaces on `ground`, nothing where that is flat; solids: what stands for boxes that name meshes. lamps: (n, 3) relative to
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
        """Lowest and highest place of what stands on the ground plane, (3,) each, world."""
        centers = self.parts.object_centers[:-1] if len(self.parts) > 1 else self.parts.object_centers
        centers = np.concatenate([centers, self.solids.centers])
        return centers.min(axis=0) + self.origin_m, centers.max(axis=0) + self.origin_m


def build_scene(box_map: BoxMap, num_others: int = 0) -> Scene:
    """Turn a map into drawable parts, with a ground plane under everything; the ids of others stay free."""
    origin, all_ids = scene_origin(box_map), instance_ids(box_map, num_others)
    solids, are_meshes = solids_of(box_map), are_solids(box_map)
    builder, lies = PartBuilder(), is_draped(box_map) & ~are_meshes
    # Surfaces on a slope are made as on a plain, so that they know their neighbours, and lifted afterwards.
    centers = box_map.centers - origin
    centers[lies, 2] -= box_map.ground.height_at(box_map.centers[lies])
    lying = np.zeros(len(box_map), PART)
    tiers = layers_of(box_map) % 1.0
    has_paint = bool((box_map.kinds == KINDS["RoadLines"]).any())
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
            boxes = replace(boxes, seeds=np.full(len(boxes), HAS_PAINT))
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
    center, half = ground_plane(box_map)
    ids, seeds = np.full(1, NO_INSTANCE, np.uint16), np.zeros(1)
    ground = Boxes((center - origin)[None], half[None], np.eye(3)[None], ids, seeds, KINDS["Terrain"], np.zeros(1))
    plane.add(ground, meshes.BOX, half[None], GRASS, np.array([0.105, 0.14, 0.045]), layer=0)
    bare = plane.finish()
    builder.add_parts(bare)
    loose = {} if box_map.ground.is_flat else _loose(drape(box_map), origin, np.append(lying, bare.records))
    standing = loose_solids(box_map, solids, origin, all_ids)
    parts = builder.finish()
    lamps = np.zeros((0, 3)) if len(lamps_of(parts)) else lamps_along_streets(box_map) - origin
    return Scene(parts, origin, plane_z_m(box_map), box_map.ground, Loose.all_of(loose), standing, lamps)


def _loose(draped: Draped, origin: np.ndarray, records: np.ndarray) -> dict[int, np.ndarray]:
    """Vertices of draped triangles by material: each is placed in its own box's axes, which shaders draw lanes and kerbs in.

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
