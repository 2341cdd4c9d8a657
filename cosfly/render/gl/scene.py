"""A map ready to be drawn: instance ids, the parts of every box, and a ground plane under everything."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosfly.geometry import rotation_matrices
from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import GROUND_KINDS, KINDS
from cosfly.render.gl import meshes
from cosfly.render.gl.parts import GRASS, Boxes, PartBuilder, Parts
from cosfly.render.gl.shapes import BUILDERS, plain

# Instance ids of the 16 bits that instance.png has: 0 is nobody (sky, ground plane).
PERSON_ID, SHARED_ID, MAX_BOX_ID = 65535, 65534, 65533
NO_INSTANCE = 0

GROUND_PLANE_HALF_M = 1500.0
GROUND_PLANE_DROP_M = 0.02  # under the lowest slab, so that the two never fight for a pixel

HAS_PAINT = 2.0  # seed of a road whose map brings its own lane markings; the shader draws none on it


@dataclass(frozen=True)
class InstanceIds:
    """Which 16-bit id each box got. `ids` (n,) uint16 in the map's order; `num_shared` boxes share SHARED_ID."""

    ids: np.ndarray
    num_shared: int
    are_box_ids: bool


@dataclass(frozen=True)
class Scene:
    """A map ready to be drawn. origin_m: (3,) world position of the parts' zero; ground_z_m: the ground plane, world."""

    parts: Parts
    origin_m: np.ndarray
    ground_z_m: float
    instances: InstanceIds


def instance_ids(box_map: BoxMap) -> InstanceIds:
    """Give every box its id for `instance.png`.

    The boxes' own ids are used if all of them lie in 1..MAX_BOX_ID. Otherwise ids are counted from 1, first through the boxes
    that are not vegetation, then through the vegetation, each in the map's order; boxes left over share SHARED_ID.
    """
    n = len(box_map)
    if n == 0 or (box_map.ids.min() >= 1 and box_map.ids.max() <= MAX_BOX_ID):
        return InstanceIds(box_map.ids.astype(np.uint16), 0, True)
    order = np.argsort(box_map.kinds == KINDS["Vegetation"], kind="stable")
    ids = np.empty(n, dtype=np.uint16)
    ids[order] = np.minimum(np.arange(1, n + 1), SHARED_ID)
    return InstanceIds(ids, max(0, n - MAX_BOX_ID), False)


def build_scene(box_map: BoxMap) -> Scene:
    """Turn a map into drawable parts, with a ground plane under everything."""
    low, high = box_map.bounds() if len(box_map) else (np.zeros(3), np.zeros(3))
    origin = np.round((low + high) / 2.0)
    instances = instance_ids(box_map)
    builder = PartBuilder()
    has_paint = bool((box_map.kinds == KINDS["RoadLines"]).any())
    for kind in np.unique(box_map.kinds):
        rows = np.flatnonzero(box_map.kinds == kind)
        boxes = Boxes(
            box_map.centers[rows] - origin,
            np.maximum(box_map.half_extents[rows], 1e-3),
            rotation_matrices(np.radians(box_map.rotations_deg[rows])),
            instances.ids[rows],
            seeds_of(box_map.ids[rows]),
            int(kind),
        )
        if kind == KINDS["Roads"] and has_paint:
            boxes = replace(boxes, seeds=np.full(len(boxes), HAS_PAINT))
        BUILDERS.get(int(kind), plain)(builder, boxes)
    ground_z = _ground_z(box_map)
    half = np.array([[GROUND_PLANE_HALF_M, GROUND_PLANE_HALF_M, 0.5]])
    center = np.array([[0.0, 0.0, ground_z - GROUND_PLANE_DROP_M - 0.5 - origin[2]]])
    ids, seeds = np.full(1, NO_INSTANCE, np.uint16), np.zeros(1)
    ground = Boxes(center, half, np.eye(3)[None], ids, seeds, KINDS["Terrain"])
    builder.add(ground, meshes.BOX, half, GRASS, np.array([0.105, 0.14, 0.045]), layer=0)
    return Scene(builder.finish(), origin, ground_z, instances)


def _ground_z(box_map: BoxMap) -> float:
    """Height of the ground plane: the map's own figure where it has one, but never above a slab that covers it."""
    ground = np.isin(box_map.kinds, list(GROUND_KINDS))
    tops = box_map.maxs[ground, 2]
    if len(tops):
        return float(tops.min())
    given = box_map.header.get("ground_z_m")
    if isinstance(given, int | float):
        return float(given)
    return float(box_map.mins[:, 2].min()) if len(box_map) else 0.0


def seeds_of(ids: np.ndarray) -> np.ndarray:
    """A fixed number in [0, 1) for each box id, so that a house keeps its colour between runs (splitmix64)."""
    with np.errstate(over="ignore"):
        x = np.asarray(ids, dtype=np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((x ^ (x >> np.uint64(31))) >> np.uint64(40)).astype(np.float64) / 2.0**24
