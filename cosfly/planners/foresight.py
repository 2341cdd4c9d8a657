"""Foresight: search positions that see the target over the whole trajectory at once, then smooth them.

MuCO improves a trajectory locally, so it stays on the hidden side of a row of trees; TA*+Smooth sees both sides, but
moves from voxel to voxel. Here dynamic programming over rings around the reference position finds the side, with a
tenth of the places, and a least-squares trajectory follows them as closely as visibility and safety require.
"""

from dataclasses import dataclass

import numpy as np

from cosfly.geometry import kernels
from cosfly.geometry.kernels import BoxIndex, collect_hits, distance_to_box, squared_gap
from cosfly.planners.contract import Plan, PlanConfig, Scenario
from cosfly.planners.line_of_sight import LOWEST_END_M, five_ray_visibility, make_horizon
from cosfly.planners.smoothing import smooth_trajectory, unsafe
from cosfly.runtime.compiled import njit


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one trajectory (the signature of `planners.contract`); nothing here is random."""
    raw, start, clearance_m = _raw_trajectory(scenario, obstacles, cfg)
    points, facts = smooth_trajectory(raw, scenario, obstacles, cfg, clearance_m)
    return Plan(points, {"start": start, "clearance_m": clearance_m, **facts})


def _raw_trajectory(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig) -> tuple[np.ndarray, str, float]:
    """Return the trajectory to smooth, its kind (`wished`, `search` or `climbing search`), and its clearance, m.

    Where the reference is free and sees the target wherever it must, it is the trajectory (`wished`).
    """
    reference_m = scenario.with_past(scenario.reference.places_m(scenario.targets_m, scenario.ground_m))
    ahead = slice(scenario.start, None)
    step_m = cfg.speed_max_mps * scenario.dt_s
    safety_m, relaxed_m = cfg.safety_distance_m, cfg.relaxed_safety_m
    seen = ~scenario.reference.keeps_sight | (kernels.visibility(obstacles, reference_m, scenario.targets_m) == 1.0)
    if seen[ahead].all() and not unsafe(reference_m[ahead], obstacles, safety_m, SPEED_SHARE * step_m).any():
        return reference_m, "wished", safety_m
    for climbing, clearance_m in ((False, safety_m), (True, safety_m), (True, relaxed_m)):
        raw = search_trajectory(scenario, make_lattice(scenario, climbing=climbing), obstacles, cfg, clearance_m)
        if raw is not None:
            return raw, "climbing search" if climbing else "search", clearance_m
    raise scenario.no_path_error("no collision-free path connects the start with the end", relaxed_m)


# --- candidate places: rings around the target, counted from the reference position -----------------------------------

NUM_AZIMUTHS = 36
BETWEEN_KEYS_S = 1.5
BETWEEN_KEYS_CLIMBING_S = 3.0  # lets the drone climb from one of CLIMBS to the next
# Greatest change of azimuth index between key frames, relative to the turn of the reference. When climbing it is large
# enough that a blocked orbit can stop.
MAX_TURN, MAX_TURN_CLIMBING = 2, 6

# Rings as (steps outwards, steps up) from the reference position. A target below canopies is seen from farther away,
# one behind a house from above; CLIMBS lead over obstacles.
RINGS = ((-1, 0), (0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (-1, 1), (0, 1))
CLIMBS = ((0, 2), (1, 4), (2, 7), (2, 11))
# One step outwards is this share of the reference distance, at most STEP_OUT_MAX_M: with larger steps the drone could
# not change rings between key frames.
STEP_OUT_SHARE, STEP_OUT_MAX_M = 0.3, 8.0
STEP_UP_M = 7.0

# Costs of a place, in units of "the target hidden for one key frame" = 1. Deviations are squared shares of the
# reference distance. Where bearing and altitude are the purpose, a deviation of 64 degrees costs as much as a hidden
# target.
BEARING_COST, ANY_BEARING_COST = 0.8, 0.007  # per rad^2 off the reference bearing; the second where any is allowed
HIGH_COST, ANY_BEARING_HIGH_COST = 3.2, 0.8  # above the reference altitude; the second where any bearing is allowed
NEAR_COST, FAR_COST = 0.1, 0.03  # nearer and farther than the reference distance


@dataclass(frozen=True)
class Lattice:
    """Candidate positions at m key frames: r rings with NUM_AZIMUTHS (a) positions on each."""

    frames: np.ndarray  # (m,)
    places_m: np.ndarray  # (m, r, a, 3)
    costs: np.ndarray  # (m, r, a), without visibility
    links: np.ndarray  # (r, r) rings that can be reached from each, itself first, then -1
    radius_max_m: float  # of the largest ring
    max_turn: int  # most azimuths between one key frame and the next


def make_lattice(scenario: Scenario, *, climbing: bool) -> Lattice:
    """Return the rings around the target. climbing: add places far above the reference, at fewer key frames."""
    stride = max(1, round((BETWEEN_KEYS_CLIMBING_S if climbing else BETWEEN_KEYS_S) / scenario.dt_s))
    frames, least_z, _, greatest_z = scenario.key_frames(stride)
    rings = np.array(RINGS + CLIMBS if climbing else RINGS, dtype=np.float64)
    distances_m = scenario.reference.distance_m[frames, None]
    ground_distances_m = scenario.reference.ground_distance_m[frames, None]
    steps_m = np.minimum(STEP_OUT_SHARE * distances_m, STEP_OUT_MAX_M)
    radii_m = np.maximum(ground_distances_m + rings[:, 0] * steps_m, ground_distances_m / 2.0)
    heights_m = scenario.ground_m + scenario.reference.altitude_m
    z = np.maximum(heights_m[frames, None] + STEP_UP_M * rings[:, 1], least_z[:, None])
    z = np.minimum(z, np.maximum(greatest_z, least_z)[:, None])
    turns_rad = np.arange(NUM_AZIMUTHS) * (2.0 * np.pi / NUM_AZIMUTHS)
    places_m = places_on_rings(scenario, frames, radii_m, z, turns_rad)
    distance_errors = (radii_m - ground_distances_m) / distances_m
    height_errors = STEP_UP_M * rings[:, 1] / distances_m
    costs = _costs(distance_errors, height_errors, turns_rad, any_bearing=scenario.reference.any_bearing)
    if len(scenario.past_m):  # all places of the first key frame are the drone's position
        places_m[0] = scenario.past_m[-1]
        costs[0] = 0.0
    max_turn = MAX_TURN_CLIMBING if climbing else MAX_TURN
    return Lattice(frames, places_m, costs, _links(rings), float(radii_m.max()), max_turn)


def places_on_rings(
    scenario: Scenario, frames: np.ndarray, radii_m: np.ndarray, z: np.ndarray, turns_rad: np.ndarray
) -> np.ndarray:
    """Return the places on the rings, (m, r, a, 3) m; radii_m, z: (m, r). turns_rad: (a,) from the reference."""
    targets_m = scenario.targets_m[frames, :, None, None]
    angles_rad = scenario.reference.view_rad[frames, None, None] + np.pi + turns_rad
    x = targets_m[:, 0] + radii_m[:, :, None] * np.cos(angles_rad)
    y = targets_m[:, 1] + radii_m[:, :, None] * np.sin(angles_rad)
    return np.stack([x, y, np.broadcast_to(z[:, :, None], x.shape)], axis=-1)


def _costs(
    distance_errors: np.ndarray, height_errors: np.ndarray, turns_rad: np.ndarray, *, any_bearing: bool
) -> np.ndarray:
    """Return the costs of the places, (m, r, a); errors: (m, r) shares of the reference distance. turns_rad: (a,)."""
    bearing_cost, height_cost = (ANY_BEARING_COST, ANY_BEARING_HIGH_COST) if any_bearing else (BEARING_COST, HIGH_COST)
    distance_cost = np.where(distance_errors > 0, FAR_COST, NEAR_COST)
    ring_costs = distance_cost * distance_errors**2 + height_cost * height_errors**2
    return ring_costs[:, :, None] + bearing_cost * np.minimum(turns_rad, 2.0 * np.pi - turns_rad) ** 2


def _links(rings: np.ndarray) -> np.ndarray:
    """Return the numbers of the rings next to each, outwards and up, (r, r): itself first, then -1."""
    outwards = rings[:, 0]
    levels = np.searchsorted(np.unique(rings[:, 1]), rings[:, 1])
    near = (abs(outwards[:, None] - outwards) <= 1) & (abs(levels[:, None] - levels) <= 1)
    np.fill_diagonal(near, False)
    links = np.full(near.shape, -1)
    for ring in range(len(rings)):
        linked = [ring, *np.flatnonzero(near[ring]).tolist()]
        links[ring, : len(linked)] = linked
    return links


# --- search -----------------------------------------------------------------------------------------------------------
# Visibility is computed once per place and key frame, so the path is the optimum, and it leaves a place before the
# target is hidden from there. A metre costs the same in one step as in several: smoothing turns a jump from ring to
# ring into a gentle change.

WAY_COST = 0.02  # cost of a metre, where "the target hidden for one key frame" = 1
NEIGHBOUR_SHARE = 0.3  # weight of the visibility at the previous key frame and of that at the next one
SPEED_SHARE = 0.9  # of the speed limit, so that smoothing can catch up
REACH_M = 12.0  # boxes farther away are ignored: two places with this clearance have nothing between them


def search_trajectory(
    scenario: Scenario, lattice: Lattice, obstacles: BoxIndex, cfg: PlanConfig, clearance_m: float
) -> np.ndarray | None:
    """Return the raw trajectory, (n, 3), straight between key frames; None if no sequence of places is free.

    Args:
        obstacles: at least the boxes of the map that can be near the lattice or hide the target.
        clearance_m: least distance of points and of the lines between them to boxes.
    """
    frames = lattice.frames
    num_azimuths = lattice.places_m.shape[2]
    places = lattice.places_m.reshape(len(frames), -1, 3)
    aloft = boxes_aloft(obstacles, scenario.targets_m, lattice)
    gaps_m, hidden = np.empty((2, *places.shape[:2]))
    _survey(places, scenario.targets_m[frames], obstacles, aloft.rows, clearance_m, REACH_M, gaps_m, hidden)
    hidden_before, hidden_after = np.roll(hidden, 1, axis=0), np.roll(hidden, -1, axis=0)
    hidden_before[0], hidden_after[-1] = hidden[0], hidden[-1]
    place_costs = (1.0 - 2.0 * NEIGHBOUR_SHARE) * hidden + NEIGHBOUR_SHARE * (hidden_before + hidden_after)
    place_costs[~scenario.reference.keeps_sight[frames]] = 0.0
    place_costs += lattice.costs.reshape(place_costs.shape)
    longest_m = SPEED_SHARE * cfg.speed_max_mps * scenario.dt_s * np.diff(frames, prepend=frames[0])
    chosen = _cheapest(
        places, place_costs, gaps_m, longest_m, aloft, clearance_m, lattice.links, num_azimuths, lattice.max_turn,
        WAY_COST,
    )  # fmt: skip
    return None if chosen[0] < 0 else scenario.between(frames, places[np.arange(len(frames)), chosen])


def boxes_aloft(obstacles: BoxIndex, targets_m: np.ndarray, lattice: Lattice) -> BoxIndex:
    """Index the boxes that may be within REACH_M of a place: most boxes end far below a drone."""
    rows = obstacles.rows
    aside_m = lattice.radius_max_m + REACH_M
    low_xy = targets_m[:, :2].min(axis=0) - aside_m
    high_xy = targets_m[:, :2].max(axis=0) + aside_m
    is_aloft = rows[:, kernels.HIGH_Z] >= lattice.places_m[:, :, 0, 2].min() - REACH_M
    is_aloft &= (rows[:, [kernels.HIGH_X, kernels.HIGH_Y]] >= low_xy).all(axis=1)
    is_aloft &= (rows[:, [kernels.LOW_X, kernels.LOW_Y]] <= high_xy).all(axis=1)
    rows = rows[is_aloft]
    return kernels.index_boxes(rows[:, :3], rows[:, 3:6], rows[:, 6:15].reshape(-1, 3, 3), cell_m=2.0 * REACH_M)


@njit(cache=True)
def _survey(places, targets, index, aloft_rows, clearance_m, reach_m, gaps_m, hidden):
    """Write the distance of each place to the nearest box, at most `reach_m`, and the hidden share of the target.

    Places nearer than `clearance_m` to a box count as hidden.

    Args:
        aloft_rows: the boxes of `index` within `reach_m` of places.
        gaps_m, hidden: (m, c), written.
    """
    near_rows = np.empty(len(aloft_rows), dtype=np.int64)
    for key in range(len(places)):
        target = targets[key]
        farthest_m = 0.0
        least_slope = np.inf
        for c in range(places.shape[1]):
            away_m = np.sqrt((places[key, c, 0] - target[0]) ** 2 + (places[key, c, 1] - target[1]) ** 2)
            farthest_m = max(farthest_m, away_m)
            least_slope = min(least_slope, (places[key, c, 2] - target[2] - LOWEST_END_M) / max(away_m, 1.0))
        horizon = make_horizon(index, target, farthest_m, least_slope)
        num_near = 0
        for box in range(len(aloft_rows)):
            gap_squared = squared_gap(aloft_rows, box, target[0], target[1], aloft_rows[box, kernels.LOW_Z])
            if gap_squared <= (farthest_m + reach_m) ** 2:
                near_rows[num_near] = box
                num_near += 1
        for c in range(places.shape[1]):
            x, y, z = places[key, c, 0], places[key, c, 1], places[key, c, 2]
            gap_m = reach_m
            for k in range(num_near):
                if gap_m >= clearance_m and squared_gap(aloft_rows, near_rows[k], x, y, z) < gap_m * gap_m:
                    gap_m = min(gap_m, distance_to_box(aloft_rows, near_rows[k], x, y, z))
            gaps_m[key, c] = gap_m
            hidden[key, c] = 1.0
            if gap_m >= clearance_m:
                hidden[key, c] = 1.0 - five_ray_visibility(index, horizon, target, x, y, z)


@njit(cache=True)
def _cheapest(places, place_costs, gaps_m, longest_m, aloft, clearance_m, links, num_azimuths, max_turn, way_cost):
    """Return the chosen place of each key frame, (m,), all -1 if no sequence of places is free.

    Args:
        places: (m, c, 3), c = rings * azimuths. place_costs, gaps_m: (m, c) of each place.
        longest_m: (m,) longest move into each key frame.
        aloft: index of the boxes within REACH_M of places.
        links: (rings, r) previous rings of each ring; the first -1 ends the list.
    """
    num_keys, num_places = len(places), places.shape[1]
    first_hit = np.empty(1, dtype=np.int64)
    cost = np.full((num_keys, num_places), np.inf)
    came_from = np.full((num_keys, num_places), -1, dtype=np.int64)
    for key in range(num_keys):
        for c in range(num_places):
            if gaps_m[key, c] < clearance_m:
                continue
            if key == 0:
                cost[key, c] = place_costs[key, c]
                continue
            x, y, z = places[key, c, 0], places[key, c, 1], places[key, c, 2]
            ring, azimuth = c // num_azimuths, c % num_azimuths
            best = np.inf
            for trial in range(2 * max_turn + 1):  # turns 0, -1, 1, -2, 2: the nearest first excludes most others
                turn = (trial + 1) // 2 * (1 - 2 * (trial % 2))
                column = (azimuth + turn) % num_azimuths
                for link in range(links.shape[1]):
                    if links[ring, link] < 0:
                        break
                    before = links[ring, link] * num_azimuths + column
                    if cost[key - 1, before] >= best:
                        continue
                    x0, y0, z0 = places[key - 1, before, 0], places[key - 1, before, 1], places[key - 1, before, 2]
                    length_m = np.sqrt((x - x0) ** 2 + (y - y0) ** 2 + (z - z0) ** 2)
                    total = cost[key - 1, before] + way_cost * length_m
                    if total >= best or length_m > longest_m[key]:
                        continue
                    # Distance changes by at most a metre per metre: with more clearance at both ends the line is free.
                    is_close = gaps_m[key, c] + gaps_m[key - 1, before] - length_m < 2.0 * clearance_m
                    if is_close and collect_hits(aloft, x0, y0, z0, x, y, z, clearance_m, first_hit) > 0:
                        continue
                    best = total
                    came_from[key, c] = before
            cost[key, c] = best + place_costs[key, c]
    return cheapest_way(cost, came_from)


@njit(cache=True)
def cheapest_way(cost, came_from):
    """Return the place of each of m key frames on the way of least cost, (m,), all -1 if no cost is finite.

    cost: (m, c) of the cheapest way to each place. came_from: (m, c) place at the previous key frame on that way.
    """
    last = int(np.argmin(cost[-1]))
    chosen = np.full(len(cost), -1, dtype=np.int64)
    if cost[-1, last] < np.inf:
        chosen[-1] = last
        for key in range(len(cost) - 1, 0, -1):
            chosen[key - 1] = came_from[key, chosen[key]]
    return chosen
