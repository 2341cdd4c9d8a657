"""Ground for a map of buildings without streets: pavement along facades, asphalt between near buildings, lawn
elsewhere. The map's header counts its boxes (`derived_ground`), and its credits, that every release repeats, say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS, PAVED_KINDS
from cosfly.geometry.grid import blocks_walking
from cosfly.maps.boxlist import BoxList
from cosfly.maps.footprints import Rectangle, cover, polygons_of, rectangle_polygon, united

PAVEMENT_M = 2.5  # pedestrians keep half a metre from walls
NEAR_M = 25.0  # asphalt lies between facades up to this far apart
NARROW_M = 4.0  # narrower asphalt is a leftover of corners
VERGE_M = 10.0  # of lawn around the map
SLAB_M, LAWN_TOP_M = 0.3, -0.1  # asphalt and pavement lie in the ground's plane
CREDITS = "Streets, pavements and lawn are derived by cosfly from the buildings, not mapped."


def with_derived_ground(box_map: BoxMap) -> BoxMap:
    """Return a map with derived ground; the same map if it has streets, pavements or squares, or no buildings."""
    standing = box_map.select(blocks_walking(box_map) & (box_map.kinds == KINDS["Buildings"]))
    if len(standing) == 0 or box_map.is_any_of(PAVED_KINDS).any():
        return box_map
    boxes = BoxList()
    if not (box_map.kinds == KINDS["Terrain"]).any():
        low, high = box_map.bounds()
        boxes.span("Terrain", low[:2] - VERGE_M, high[:2] + VERGE_M, LAWN_TOP_M - SLAB_M, LAWN_TOP_M)
    houses = [
        Rectangle((center[0], center[1]), (2 * half[0], 2 * half[1]), turn[1])
        for center, half, turn in zip(standing.centers, standing.half_extents, standing.rotations_deg, strict=True)
    ]
    built = united([rectangle_polygon(house) for house in houses])
    between = shapely.buffer(shapely.buffer(built, NEAR_M / 2), -NEAR_M / 2)
    free = shapely.difference(between, shapely.buffer(built, PAVEMENT_M, join_style="mitre"))
    streets = shapely.buffer(shapely.buffer(free, -NARROW_M / 2), NARROW_M / 2 + 0.5).simplify(0.5)
    for polygon in polygons_of(streets):
        for piece in cover(polygon, min_fill=0.9, min_size_m=6.0, max_size_m=60.0):
            boxes.add("Roads", piece.center, piece.size, -SLAB_M, 0.0, piece.yaw_deg)
    for house in houses:  # one slab under each, so that pavements have the facades' directions and no seams
        size = house.size[0] + 2 * PAVEMENT_M, house.size[1] + 2 * PAVEMENT_M
        boxes.add("Sidewalks", house.center, size, -SLAB_M, 0.0, house.yaw_deg)
    derived = boxes.box_map()
    derived.centers[:, 2] += box_map.ground.height_at(derived.centers)
    derived.ids[:] = np.setdiff1d(np.arange(1, len(box_map) + len(derived) + 1), box_map.ids)[: len(derived)]
    header = box_map.header
    update = {
        "derived_ground": len(derived), "added_boxes": header.added_boxes + len(derived),
        "credits": f"{header.credits.rstrip('. ')}. {CREDITS}".removeprefix(". "),
    }  # fmt: skip
    return replace(box_map.joined(derived), header=header.model_copy(update=update))
