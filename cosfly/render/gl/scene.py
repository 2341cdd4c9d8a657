"""A map ready to be drawn: the parts of every box, and a ground plane under everything."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosfly.geometry import rotation_matrices
from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.render.contract import NO_INSTANCE, ground_plane, instance_ids, plane_z_m, scene_origin, seeds_of
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import GRASS, Boxes, PartBuilder, Parts
from cosfly.render.gl.shapes import BUILDERS, plain

HAS_PAINT = 2.0  # seed of a road whose map brings its own lane markings; the shader draws none on it


@dataclass(frozen=True)
class Scene:
    """A map ready to be drawn. origin_m: (3,) world position of the parts' zero; plane_z_m: the ground plane, world."""

    parts: Parts
    origin_m: np.ndarray
    plane_z_m: float


def build_scene(box_map: BoxMap) -> Scene:
    """Turn a map into drawable parts, with a ground plane under everything."""
    origin, all_ids = scene_origin(box_map), instance_ids(box_map)
    builder = PartBuilder()
    has_paint = bool((box_map.kinds == KINDS["RoadLines"]).any())
    for kind in np.unique(box_map.kinds):
        rows = np.flatnonzero(box_map.kinds == kind)
        boxes = Boxes(
            box_map.centers[rows] - origin,
            np.maximum(box_map.half_extents[rows], 1e-3),
            rotation_matrices(np.radians(box_map.rotations_deg[rows])),
            all_ids[rows],
            seeds_of(box_map.ids[rows]),
            int(kind),
        )
        if kind == KINDS["Roads"] and has_paint:
            boxes = replace(boxes, seeds=np.full(len(boxes), HAS_PAINT))
        BUILDERS.get(int(kind), plain)(builder, boxes)
    center, half = ground_plane(box_map)
    ids, seeds = np.full(1, NO_INSTANCE, np.uint16), np.zeros(1)
    ground = Boxes((center - origin)[None], half[None], np.eye(3)[None], ids, seeds, KINDS["Terrain"])
    builder.add(ground, meshes.BOX, half[None], GRASS, np.array([0.105, 0.14, 0.045]), layer=0)
    return Scene(builder.finish(), origin, plane_z_m(box_map))
