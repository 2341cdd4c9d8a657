"""Bystanders around a pedestrian trajectory, clear of the target and of each other.

They are placed one after the other. Each passes the target at a different time, the first at the start. A new one that
would collide waits a little before that place. If waiting does not help, it is drawn again, and skipped after some
tries, so there may be fewer than requested.
"""

from dataclasses import replace

import numpy as np

from cosfly.formats.bystanders import PERSON_RADIUS_M, Bystander, Bystanders
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.axes import headings_of
from cosfly.pedestrians.speed_model import PACES, STOP_GAP_MIN, TimedRoute, timed_route
from cosfly.pedestrians.walkable import PedestriansConfig, WalkableGround
from cosfly.runtime.seeding import draw_by_share

MOST_WAITS = 10  # after this many waits a bystander is drawn again
WAIT_S = 3.0  # duration of one wait
KEEP_BACK_M = 1.5  # distance from the place of waiting to that of the collision
TURN_S = 2.0  # stop of bystanders at the end of their route, before they walk back
PASS_M = (1.5, 7.0)  # distance from the target when it is passed
OPPOSITE_TRIES = 6  # second ends of a route that are drawn, for the one most opposite to the first end
GOLDEN = 0.618034  # moments k * GOLDEN % 1 are spread evenly for any number of them
SPEED_FACTORS = (0.8, 1.2)  # bounds of the factor on the speeds of a pace


def _waiting(route: TimedRoute, before_m: float) -> TimedRoute:
    """Return a route with a stop of WAIT_S, or a longer one, at least KEEP_BACK_M before a place of it."""
    stop_m = before_m - KEEP_BACK_M
    waypoint = max(0, int(np.searchsorted(route.along_m, stop_m, side="right")) - 1)
    stops_s = route.stops_s.copy()
    near = _waypoints_near(waypoint)
    if stops_s[near].any():  # a stop nearby becomes longer instead
        waypoint = near.start + int(np.argmax(stops_s[near]))
    stops_s[waypoint] += WAIT_S
    return replace(route, stops_s=stops_s)


def _with_return(route: TimedRoute) -> TimedRoute:
    """Return a route with the way back to its start, after a stop at its end or just before."""
    columns = route.polyline_m, route.limits_mps, route.stops_s
    both_ways = TimedRoute(*(np.concatenate([values, values[-2::-1]]) for values in columns))
    end = len(route.stops_s) - 1
    if not route.stops_s[:end][_waypoints_near(end)].any():
        both_ways.stops_s[end] = TURN_S
    return both_ways


def _waypoints_near(waypoint: int) -> slice:
    """Return the waypoints that are too near to have a stop too: a piece between two stops would have no speed."""
    return slice(max(0, waypoint - STOP_GAP_MIN + 1), waypoint + STOP_GAP_MIN)


def bystanders_of(
    target: PedestrianTrajectory, ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator
) -> Bystanders:
    """Place the bystanders around one pedestrian trajectory."""
    bystanders: list[Bystander] = []
    placed_m = [target.positions_m[:, :2]]
    for index in range(cfg.others):
        positions_m = _place(target, index, np.stack(placed_m), ground, cfg, rng)
        if positions_m is not None:
            headings_rad = headings_of(positions_m, target.time_s)
            on_ground_m = np.insert(positions_m, 2, ground.z_m, axis=1)
            bystanders.append(Bystander(on_ground_m, headings_rad, is_look_alike=index < cfg.look_alikes))
            placed_m.append(positions_m)
    return Bystanders(target.path_id, bystanders)


def _place(
    target: PedestrianTrajectory, index: int, placed_m: np.ndarray, ground: WalkableGround, cfg: PedestriansConfig,
    rng: np.random.Generator,
) -> np.ndarray | None:  # fmt: skip
    """Return the positions of a bystander, (n, 2) m, clear of people already placed; None after too many tries."""
    for _ in range(cfg.num_retries + 1):
        trip = _draw_trip(target, index, ground, cfg, rng)
        positions_m = None if trip is None else avoid_collisions(*trip, placed_m)
        if positions_m is not None:
            return positions_m
    return None


def avoid_collisions(route: TimedRoute, time_s: np.ndarray, placed_m: np.ndarray) -> np.ndarray | None:
    """Return the positions, (n, 2) m, on a route with waits for people already placed; None if these do not help.

    Args:
        time_s: (n,) on the route.
        placed_m: (e, n, 2), the positions of the others at these times.
    """
    for _ in range(MOST_WAITS + 1):
        along_m, _ = route.sample(time_s)
        positions_m = route.positions_at(along_m)
        collisions = np.flatnonzero(gaps_m(positions_m, placed_m) < 0.0)
        if len(collisions) == 0:
            return positions_m
        end_of_step_m = float(along_m[collisions[0] + 1])
        if collisions[0] == 0 and end_of_step_m < KEEP_BACK_M:
            return None
        route = _waiting(route, end_of_step_m)
    return None


def gaps_m(positions_m: np.ndarray, placed_m: np.ndarray) -> np.ndarray:
    """Return the least gap between one person and others in each time step, (n - 1,) m; it is negative at an overlap.

    All move straight within a step, so that a distance of two people is that of the origin from a segment of offsets.

    Args:
        positions_m: (n, 2).
        placed_m: (e, n, 2), the others at the same times.
    """
    # (2, e, n): reductions over an axis of two numbers are slow where it is the last.
    offsets_m = np.ascontiguousarray(np.moveaxis(positions_m - placed_m, 2, 0))
    start_m, along_m = offsets_m[..., :-1], np.diff(offsets_m)
    squared_m2 = np.maximum((along_m**2).sum(axis=0), 1e-12)
    share = np.clip(-(start_m * along_m).sum(axis=0) / squared_m2, 0.0, 1.0)
    distances_m = np.linalg.norm(start_m + share * along_m, axis=0)  # (e, n - 1)
    return distances_m.min(axis=0) - 2.0 * PERSON_RADIUS_M


def _draw_trip(
    target: PedestrianTrajectory, index: int, ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator
) -> tuple[TimedRoute, np.ndarray] | None:
    """Draw a bystander's route that passes the target, back and forth for the duration; None if there is none.

    Return it with its time, (n,) s, at each time of the target. The route begins before the target's trajectory if the
    pass would be too late otherwise.
    """
    duration_s = float(target.time_s[-1])
    pass_time_s = index * GOLDEN % 1.0 * duration_s
    target_cell = ground.grid.cells_at(target.positions_m[int(np.searchsorted(target.time_s, pass_time_s))])
    low_cells, high_cells = np.array(PASS_M) / cfg.resolution_m
    places = ground.sample_goals((int(target_cell[0]), int(target_cell[1])), low_cells, high_cells, rng)
    if not places:
        return None
    waypoints_m = _route_through(places[0], ground, cfg, rng)
    if waypoints_m is None:
        return None
    pace = PACES[draw_by_share(cfg.pace, rng)]
    route = timed_route(waypoints_m, pace, cfg, rng, rng)
    route = replace(route, limits_mps=route.limits_mps * rng.uniform(*SPEED_FACTORS))
    # The trajectory after a head start of at most its duration needs two durations; 3 leave a margin.
    while route.sample(3.0 * target.time_s[-1:])[0][0] >= route.along_m[-1]:
        route = _with_return(route)
    # The head start moves the nearest pass to the time of this bystander.
    step_s = float(target.time_s[1])
    times_s = pass_time_s + np.arange(0.0, duration_s, step_s)
    offsets_m = route.positions_at(route.sample(times_s)[0]) - ground.grid.centers_of(np.array(places[0]))
    nearest_s = float(times_s[np.argmin(np.linalg.norm(offsets_m, axis=1))])
    return route, target.time_s + (nearest_s - pass_time_s)


def _route_through(
    place: tuple[int, int], ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator
) -> np.ndarray | None:
    """Return waypoints, (k, 2) m, of a route through a cell between ends on opposite sides; None without any end."""
    reach_cells = cfg.others_reach_m / cfg.resolution_m
    ends = ground.sample_goals(place, 0.5 * reach_cells, reach_cells, rng, 1 + OPPOSITE_TRIES)
    if not ends:
        return None
    offsets = np.subtract(ends, place)
    candidates = offsets[1:]
    # Cosines of the angles to the first end, times its distance.
    cosines = candidates @ offsets[0] / np.linalg.norm(candidates, axis=1)
    far_ends = ends[0], ends[1 + int(np.argmin(cosines))]
    leg_back, leg_ahead = (ground.waypoints_m(ground.route(place, end)) for end in far_ends)
    return np.concatenate([leg_back[:0:-1], leg_ahead])
