"""The places that the search may choose from: rings round the walker, counted from the wished place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from cosfly.planners.contract import Scenario

NUM_AZIMUTHS = 36
BETWEEN_KEYS_S, BETWEEN_KEYS_CLIMBING_S = 1.5, 3.0  # the latter lets the drone climb from one of CLIMBS to the next
# Azimuths between one key frame and the next, against those that the wish turns by: climbing, an orbit without room can stand still.
MAX_TURN, MAX_TURN_CLIMBING = 2, 6

# Rings as (steps outwards, steps up) from the wished place. Who is hidden below canopies is seen from farther off, who is hidden behind
# a house from above; CLIMBS lead over what blocks the way.
RINGS = ((-1, 0), (0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (-1, 1), (0, 1))
CLIMBS = ((0, 2), (1, 4), (2, 7), (2, 11))
# Of the wished distance; farther apart, the drone could not change rings between keys.
STEP_OUT_SHARE, STEP_OUT_MAX_M = 0.3, 8.0
STEP_UP_M = 7.0

# Costs of a place, in units of "the walker hidden for one key frame" = 1. Ways off are squared parts of the wished distance. Where the
# bearing and the altitude are what the flight is for, 64 degrees off are as dear as the hidden walker.
BEARING_COST, ANY_BEARING_COST = 0.8, 0.007  # per rad^2 off the wished bearing; where any will do
HIGH_COST, ANY_BEARING_HIGH_COST = 3.2, 0.8
NEAR_COST, FAR_COST = 0.1, 0.03


@dataclass(frozen=True)
class Lattice:
    """Where the drone may be at m key frames; r rings, `NUM_AZIMUTHS` places on each.

    frames: (m,) places in the walk. places_m: (m, r, azimuths, 3). costs: (m, r, azimuths) whatever is seen from there.
    links: (r, r) rings that can be reached from each, itself first, then -1. radius_max_m: of the largest ring.
    max_turn: azimuths between one key frame and the next.
    """

    frames: np.ndarray
    places_m: np.ndarray
    costs: np.ndarray
    links: np.ndarray
    radius_max_m: float
    max_turn: int


def make_lattice(scenario: Scenario, *, climbing: bool) -> Lattice:
    """Lay the rings round the walker.

    Args:
        climbing: with places far above the wished ones, at fewer key frames.
    """
    wish, targets, num = scenario.wish, scenario.targets_m, len(scenario.targets_m)
    stride = max(1, round((BETWEEN_KEYS_CLIMBING_S if climbing else BETWEEN_KEYS_S) / scenario.dt_s))
    frames = np.unique(np.append(np.arange(0, num, stride), num - 1))
    # Between key frames the flight is straight while the ground may rise and fall: a key frame keeps the bounds of all around it.
    around, ground_m = 2 * stride + 1, scenario.ground_m
    least_z = maximum_filter1d(ground_m + wish.altitude_min_m, around, mode="nearest")[frames, None]
    greatest_z = minimum_filter1d(ground_m + wish.altitude_max_m, around, mode="nearest")[frames, None]
    rings = np.array(RINGS + CLIMBS if climbing else RINGS, dtype=np.float64)
    distances_m, grounds_m = wish.distance_m[frames, None], wish.ground_distance_m[frames, None]
    steps_m = np.minimum(STEP_OUT_SHARE * distances_m, STEP_OUT_MAX_M)
    radii_m = np.maximum(grounds_m + rings[:, 0] * steps_m, grounds_m / 2.0)
    z = np.maximum((ground_m + wish.altitude_m)[frames, None] + STEP_UP_M * rings[:, 1], least_z)
    z = np.minimum(z, np.maximum(greatest_z, least_z))
    turns = np.arange(NUM_AZIMUTHS) * (2.0 * np.pi / NUM_AZIMUTHS)
    angles = wish.view_rad[frames, None, None] + np.pi + turns
    x = targets[frames, 0, None, None] + radii_m[:, :, None] * np.cos(angles)
    y = targets[frames, 1, None, None] + radii_m[:, :, None] * np.sin(angles)
    places_m = np.stack([x, y, np.broadcast_to(z[:, :, None], x.shape)], axis=-1)
    off = (radii_m - grounds_m) / distances_m
    turned, high = (ANY_BEARING_COST, ANY_BEARING_HIGH_COST) if wish.any_bearing else (BEARING_COST, HIGH_COST)
    aside = np.where(off > 0, FAR_COST, NEAR_COST) * off**2 + high * (STEP_UP_M * rings[:, 1] / distances_m) ** 2
    costs = aside[:, :, None] + turned * np.minimum(turns, 2.0 * np.pi - turns) ** 2
    max_turn = MAX_TURN_CLIMBING if climbing else MAX_TURN
    return Lattice(frames, places_m, costs, _links(rings), float(radii_m.max()), max_turn)


def _links(rings: np.ndarray) -> np.ndarray:
    """Give the rings next to each, outwards and up, (r, r): numbers, itself first, then -1."""
    levels = np.searchsorted(np.unique(rings[:, 1]), rings[:, 1])
    links = np.full((len(rings), len(rings)), -1)
    for ring in range(len(rings)):
        near = (abs(rings[:, 0] - rings[ring, 0]) <= 1) & (abs(levels - levels[ring]) <= 1)
        near[ring] = False
        found = [ring, *np.flatnonzero(near)]
        links[ring, : len(found)] = found
    return links
