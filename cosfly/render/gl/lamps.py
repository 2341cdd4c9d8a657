"""Street lamps of a map: their places, and their light on the ground as a map from above.

A map without lamps is lit along its streets by lamps that are not drawn, since no box represents them.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import rotation_matrices
from cosfly.render.gl.parts import LAMP, Parts

MAP_PX = 384
REACH_M = 45.0  # a lamp lights nothing beyond
CROWDED = 0.4  # several lamps in one place give less than their sum
BRIGHT = 0.5  # red of a lamp's glass; its housing is darker
FALL_M = 5.5  # height that the fall of the light is computed for, whatever the pole's
# Of lamps without a pole: along a street, on alternate sides.
STREETS = ("Roads", "Sidewalks")
ALONG_M, APART_M, HIGH_M = 16.0, 12.0, 6.5  # from one to the next; least distance of any two; over the street
FROM_EDGE_M = 0.5
MOST_NEAR = 16  # lamps that puddles mirror, as in the shader


def lamps_of(parts: Parts) -> np.ndarray:
    """Return the places of the lit lamps, (n, 3) relative to the scene's origin."""
    records = parts.records
    is_lamp = (((records["tag"] >> 8) & 0xFF) == LAMP) & (records["color"][:, 0] > BRIGHT)
    return records["center"][is_lamp].astype(np.float64)


def lamps_along_streets(box_map: BoxMap) -> np.ndarray:
    """Return places of lamps along the streets of a map without any, (n, 3) m, world: the largest street's first."""
    streets = box_map.select(box_map.is_any_of({KINDS[name] for name in STREETS}))
    half = streets.half_extents
    turns = rotation_matrices(np.radians(streets.rotations_deg))
    found = [np.zeros((0, 3))]
    for row in np.lexsort((streets.ids, -half[:, 0] * half[:, 1])):
        along, across = (0, 1) if half[row, 0] >= half[row, 1] else (1, 0)
        steps = np.arange(max(1, round(2.0 * half[row, along] / ALONG_M)))
        own = np.zeros((len(steps), 3))
        own[:, along] = half[row, along] * ((2.0 * steps + 1.0) / len(steps) - 1.0)
        own[:, across] = np.where(steps % 2, 1.0, -1.0) * max(half[row, across] - FROM_EDGE_M, 0.0)
        found.append(streets.centers[row] + own @ turns[row].T)
    places = np.concatenate(found)
    stays = np.ones(len(places), bool)
    pairs = cKDTree(places[:, :2]).query_pairs(APART_M, output_type="ndarray") if len(places) else []
    for first, second in sorted(map(tuple, pairs)):
        stays[second] &= not stays[first]
    places = places[stays]
    places[:, 2] = np.maximum(places[:, 2], box_map.ground.height_at(places)) + HIGH_M
    return places


def lamp_map(lamps: np.ndarray, middle: np.ndarray, half_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the light of lamps over a square.

    Args:
        lamps: (n, 3) m; middle: (2,) m; half_m: half the square's side.
    Returns:
        (MAP_PX, MAP_PX, 2) float32: light on the ground, about 1 under a lamp, and the height of the lamps that give
        it; (4,) low x, low y, 1 / side, 1 / side. The outermost pixels are dark, so that nothing beyond is lit.
    """
    low, pixel_m = middle[:2] - half_m, 2.0 * half_m / MAP_PX
    light = np.zeros((MAP_PX, MAP_PX))
    height = np.zeros((MAP_PX, MAP_PX))
    reach_px = int(np.ceil(REACH_M / pixel_m))
    for x, y, z in lamps:
        column, row = (x - low[0]) / pixel_m - 0.5, (y - low[1]) / pixel_m - 0.5
        rows = slice(max(0, int(row) - reach_px), max(0, int(row) + reach_px + 1))
        columns = slice(max(0, int(column) - reach_px), max(0, int(column) + reach_px + 1))
        v, u = np.ogrid[rows.start : min(rows.stop, MAP_PX), columns.start : min(columns.stop, MAP_PX)]
        away = ((u - column) ** 2 + (v - row) ** 2) * pixel_m**2
        share = np.maximum((FALL_M**2 / (FALL_M**2 + away)) ** 1.5 - (FALL_M / REACH_M) ** 3, 0.0)
        light[rows, columns] += share
        height[rows, columns] += share * z
    known = np.where(light > 0.0, height / np.maximum(light, 1e-12), 0.0)
    light /= 1.0 + CROWDED * light
    light[[0, -1]] = light[:, [0, -1]] = 0.0
    side = 0.5 / half_m
    return np.stack([light, known], axis=-1).astype(np.float32), np.array([*low, side, side])


def nearest_lamps(lamps: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the lamps nearest to the camera, (MOST_NEAR, 4) places and strength, and their number; far ones fade
    out."""
    away = np.linalg.norm(lamps - eye, axis=1)
    rows = np.argsort(away, kind="stable")[:MOST_NEAR]
    rows = rows[away[rows] < 120.0]
    found = np.zeros((MOST_NEAR, 4), np.float32)
    found[: len(rows), :3] = lamps[rows]
    found[: len(rows), 3] = np.clip(1.6 - away[rows] / 75.0, 0.0, 1.0)
    return found, len(rows)
