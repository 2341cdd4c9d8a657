"""MuCO's loss, compiled: every term with its gradient and a positive semi-definite model of its curvature.

Loss of a trajectory p_0 .. p_{n-1} (subsec:appendix_planner_muco): sums over waypoints of seven weighted terms plus the altitude
and pitch regularisers. Where the paper leaves a choice, it is made here and said at the term. The curvature is Gauss-Newton:
a square w r^2 with dr/dp = a adds 2 w a a^T. It is kept as a band matrix, because a term couples at most four neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from cosfly.kernels import collect_hits, nearest_box, normal_of_box, window_rays

TERM_NAMES = (
    "tracking",
    "smoothness",
    "jerk",
    "safety",
    "visibility",
    "view_angle",
    "path_length",
    "altitude",
    "pitch",
)
TRACKING, SMOOTHNESS, JERK, SAFETY, VISIBILITY, VIEW_ANGLE, PATH_LENGTH, ALTITUDE, PITCH = range(9)
BAND_ROWS = 10  # jerk couples x_i with x_{i+3}, nine places on in x_0 y_0 z_0 x_1 ...

SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])
THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])


class Problem(NamedTuple):
    """What stays fixed during one optimisation; n waypoints.

    targets: (n, 3) m, hip points. headings_rad: (n,) smoothed walking direction. weights: (7,) in the order of TERM_NAMES.
    altitudes: (3,) least, preferred, greatest z in the world, m. altitude_weights: (3,) below, above, oscillation.
    """

    targets: np.ndarray
    headings_rad: np.ndarray
    weights: np.ndarray
    altitudes: np.ndarray
    altitude_weights: np.ndarray
    distance_m: float
    influence_m: float
    difference_m: float
    pitch_rad: float
    pitch_low_rad: float
    pitch_high_rad: float
    pitch_weight: float
    safety_m: float
    floor_m: float
    step_max_m: float
    pushes_max: int


class State(NamedTuple):
    """What one evaluation writes; made once, used again.

    terms: (9,) the loss by term. gradient, visibility_gradient: (n, 3), the first without the second.
    band: (BAND_ROWS, 3 n) the lower band of the curvature. visibility: (n,) five-ray visibility. rough: (n,) share of each
    waypoint in the terms that have kinks and stairs, visibility and safety.
    blockers: (k,) room for box numbers. contacts: (n, 3) unit normal of the obstacle that a waypoint touches, else zero.
    """

    terms: np.ndarray
    gradient: np.ndarray
    visibility_gradient: np.ndarray
    band: np.ndarray
    visibility: np.ndarray
    rough: np.ndarray
    blockers: np.ndarray
    contacts: np.ndarray


def make_state(num_points: int, num_boxes: int) -> State:
    """Give empty room for evaluations."""
    return State(
        np.zeros(len(TERM_NAMES)), np.zeros((num_points, 3)), np.zeros((num_points, 3)), np.zeros((BAND_ROWS, 3 * num_points)),
        np.zeros(num_points), np.zeros(num_points), np.zeros(num_boxes, dtype=np.int64), np.zeros((num_points, 3)),
    )  # fmt: skip


@njit(cache=True)
def evaluate(points, problem, index, masked, state):
    """Fill `state` for a trajectory and give its loss.

    Args:
        points: (n, 3) m. masked: (n,) bool, waypoints in a low-visibility run: their visibility and view-angle terms stay in
            the loss but out of gradient and curvature.
    """
    state.terms[:] = 0.0
    state.gradient[:] = 0.0
    state.visibility_gradient[:] = 0.0
    state.band[:] = 0.0
    state.contacts[:] = 0.0
    state.rough[:] = 0.0
    for i in range(len(points)):
        point_terms(points, i, problem, index, masked[i], state)
        visibility_term(points, i, problem, index, masked[i], state)
    chain_terms(points, 0, len(points), problem, state)
    return state.terms.sum()


# --- terms of one waypoint --------------------------------------------------------------------------------------------


@njit(cache=True)
def _add_square(state, term, i, weight, residual, ax, ay, az, in_model):
    """Add weight * residual^2 of waypoint i, where (ax, ay, az) is the residual's derivative."""
    state.terms[term] += weight * residual * residual
    if not in_model:
        return
    slope, k = 2.0 * weight * residual, 3 * i
    state.gradient[i, 0] += slope * ax
    state.gradient[i, 1] += slope * ay
    state.gradient[i, 2] += slope * az
    state.band[0, k] += 2.0 * weight * ax * ax
    state.band[0, k + 1] += 2.0 * weight * ay * ay
    state.band[0, k + 2] += 2.0 * weight * az * az
    state.band[1, k] += 2.0 * weight * ax * ay
    state.band[1, k + 1] += 2.0 * weight * ay * az
    state.band[2, k] += 2.0 * weight * ax * az


@njit(cache=True)
def point_terms(points, i, problem, index, masked, state):
    """Tracking, safety, view angle, altitude bounds and pitch band of waypoint i."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    dx, dy, dz = x - problem.targets[i, 0], y - problem.targets[i, 1], z - problem.targets[i, 2]
    weights = problem.weights
    distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    _add_square(
        state, TRACKING, i, weights[TRACKING], distance - problem.distance_m, dx / distance, dy / distance, dz / distance, True
    )  # fmt: skip

    gap, box = nearest_box(index, x, y, z, problem.influence_m)
    if box >= 0:
        nx, ny, nz = normal_of_box(index.rows, box, x, y, z)
        _add_square(state, SAFETY, i, 0.5 * weights[SAFETY], gap - problem.influence_m, nx, ny, nz, True)
        state.rough[i] += 0.5 * weights[SAFETY] * (gap - problem.influence_m) ** 2
        if gap < problem.safety_m + 0.01:
            state.contacts[i, 0], state.contacts[i, 1], state.contacts[i, 2] = nx, ny, nz

    # View angle: deviations, in radians, of the downward pitch from 45 degrees and of the view's azimuth from the walking
    # direction. Straight above the target both lose their meaning: a floor of one metre keeps their derivatives finite.
    flat = max(np.sqrt(dx * dx + dy * dy), 1.0)
    pitch, square = np.arctan2(dz, flat), flat * flat + dz * dz
    px, py, pz = -dz * dx / flat / square, -dz * dy / flat / square, flat / square
    _add_square(state, VIEW_ANGLE, i, weights[VIEW_ANGLE], pitch - problem.pitch_rad, px, py, pz, not masked)
    turn = np.arctan2(-dy, -dx) - problem.headings_rad[i]
    turn -= 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
    _add_square(state, VIEW_ANGLE, i, weights[VIEW_ANGLE], turn, -dy / flat / flat, dx / flat / flat, 0.0, not masked)
    outside = min(pitch - problem.pitch_low_rad, 0.0) + max(pitch - problem.pitch_high_rad, 0.0)
    if outside != 0.0:
        _add_square(state, PITCH, i, problem.pitch_weight, outside, px, py, pz, True)

    below, above = problem.altitudes[0] - z, z - problem.altitudes[1]
    if below > 0.0:
        _add_square(state, ALTITUDE, i, problem.altitude_weights[0], below, 0.0, 0.0, -1.0, True)
    if above > 0.0:
        _add_square(state, ALTITUDE, i, problem.altitude_weights[1], above, 0.0, 0.0, 1.0, True)


@njit(cache=True)
def visibility_term(points, i, problem, index, masked, state):
    """(1 - V)^2 of waypoint i, V the five-ray fraction averaged over the difference window: the waypoint and its six
    neighbours at +-difference_m. The raw fraction is a staircase; the average rises in steps of 1/35 and the central
    difference over the same window is its slope.
    """
    x, y, z, target = points[i, 0], points[i, 1], points[i, 2], problem.targets[i]
    # Any ray of the window stays within this of the middle ray, at its foot and at its head.
    spread = max(0.8, problem.difference_m)
    count = collect_hits(index, target[0], target[1], target[2], x, y, z, spread, state.blockers)
    state.visibility[i] = 1.0
    if count == 0:
        return
    weight, step, free = problem.weights[VISIBILITY], problem.difference_m, np.empty(7)
    window_rays(index, state.blockers, count, x, y, z, step, target, free)
    state.visibility[i] = free[0]
    slope = state.visibility_gradient[i]
    for axis in range(3):
        slope[axis] = (free[1 + 2 * axis] - free[2 + 2 * axis]) / (2.0 * step)
    hidden = 1.0 - free.sum() / 7.0
    state.rough[i] += weight * hidden * hidden
    state.terms[VISIBILITY] += weight * hidden * hidden
    for a in range(3):
        for b in range(a + 1 if not masked else 0):
            state.band[a - b, 3 * i + b] += 2.0 * weight * slope[a] * slope[b]
    slope *= 0.0 if masked else 2.0 * weight * hidden


# --- terms that couple neighbours -------------------------------------------------------------------------------------


@njit(cache=True)
def _add_difference(state, term, points, first, axis, coefficients, weight):
    """Add weight * (sum_k c_k p_{first + k})^2 for one axis."""
    residual = 0.0
    for k in range(len(coefficients)):
        residual += coefficients[k] * points[first + k, axis]
    state.terms[term] += weight * residual * residual
    for k in range(len(coefficients)):
        state.gradient[first + k, axis] += 2.0 * weight * residual * coefficients[k]
        for m in range(k + 1):
            state.band[3 * (k - m), 3 * (first + m) + axis] += 2.0 * weight * coefficients[k] * coefficients[m]


@njit(cache=True)
def chain_terms(points, begin, end, problem, state):
    """Smoothness, jerk, path length and altitude oscillation of the differences that start in [begin, end)."""
    num_points, weights = len(points), problem.weights
    for i in range(max(begin, 0), min(end, num_points - 1)):
        for axis in range(3):
            if i + 2 < num_points:
                _add_difference(state, SMOOTHNESS, points, i, axis, SECOND_DIFFERENCE, weights[SMOOTHNESS])
            if i + 3 < num_points:
                _add_difference(state, JERK, points, i, axis, THIRD_DIFFERENCE, weights[JERK])
        _add_length(state, points, i, 0.1 * weights[PATH_LENGTH])
        # Oscillation: the squared change of altitude from waypoint to waypoint.
        change, weight, k = points[i + 1, 2] - points[i, 2], problem.altitude_weights[2], 3 * i + 2
        state.terms[ALTITUDE] += weight * change * change
        state.gradient[i, 2] -= 2.0 * weight * change
        state.gradient[i + 1, 2] += 2.0 * weight * change
        state.band[0, k] += 2.0 * weight
        state.band[0, k + 3] += 2.0 * weight
        state.band[3, k] -= 2.0 * weight


@njit(cache=True)
def _add_length(state, points, i, weight):
    """Add weight * |p_{i+1} - p_i|; its curvature is (1 - u u^T) / length, with a floor under the length."""
    step = points[i + 1] - points[i]
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    state.terms[PATH_LENGTH] += weight * length
    if length < 1e-9:
        return
    unit, stiffness = step / length, weight / max(length, 0.1)
    for a in range(3):
        state.gradient[i, a] -= weight * unit[a]
        state.gradient[i + 1, a] += weight * unit[a]
        for b in range(3):
            value = stiffness * ((1.0 if a == b else 0.0) - unit[a] * unit[b])
            if b <= a:
                state.band[a - b, 3 * i + b] += value
                state.band[a - b, 3 * i + 3 + b] += value
            state.band[3 + a - b, 3 * i + b] -= value  # row: axis a of waypoint i + 1, column: axis b of waypoint i


@njit(cache=True)
def difference_gradient(points, problem, index, masked, state, gradient):
    """The paper's gradient: central differences of +-difference_m of the terms that a waypoint takes part in.

    Altitudes stay within their bounds, or the penalty below the least altitude would lift every waypoint that flies at it.
    Writes `gradient` (n, 3), without the visibility term, whose own gradient is a difference already; `state` is overwritten.
    """
    state.contacts[:] = 0.0
    for i in range(len(points)):
        for axis in range(3):
            losses, places = np.zeros(2), np.zeros(2)
            middle = points[i, axis]
            for side in range(2):
                places[side] = middle + (2 * side - 1) * problem.difference_m
                if axis == 2:
                    places[side] = min(max(places[side], problem.altitudes[0]), problem.altitudes[2])
                points[i, axis] = places[side]
                state.terms[:] = 0.0
                point_terms(points, i, problem, index, masked[i], state)
                chain_terms(points, i - 3, i + 1, problem, state)
                losses[side] = state.terms.sum() - (state.terms[VIEW_ANGLE] if masked[i] else 0.0)
            points[i, axis] = middle
            gradient[i, axis] = (losses[1] - losses[0]) / max(places[1] - places[0], 1e-9)


# --- constraints ------------------------------------------------------------------------------------------------------


@njit(cache=True)
def hold_bounds(points, problem, contacts, band, gradient):
    """Take out of gradient and curvature, in place, what would lead straight out of the feasible region.

    A waypoint at the least or greatest altitude that is drawn beyond it keeps its z; one that touches an obstacle and is
    drawn into it may only slide along it. Ends of the trajectory are for the caller to leave out.
    """
    for i in range(len(points)):
        normal = contacts[i]
        into = gradient[i, 0] * normal[0] + gradient[i, 1] * normal[1] + gradient[i, 2] * normal[2]
        if into > 0.0:  # the step is against the gradient
            for a in range(3):
                gradient[i, a] -= into * normal[a]
                for b in range(a + 1):
                    band[a - b, 3 * i + b] += 1e5 * normal[a] * normal[b]
        at_floor = points[i, 2] <= problem.altitudes[0] + 1e-9 and gradient[i, 2] > 0.0
        at_ceiling = points[i, 2] >= problem.altitudes[2] - 1e-9 and gradient[i, 2] < 0.0
        if at_floor or at_ceiling:
            gradient[i, 2] = 0.0
            band[0, 3 * i + 2] += 1e7


@njit(cache=True)
def push_out(point, problem, index):
    """Move one waypoint in place out of obstacles, within the altitude bounds; give its clearance, at most safety_m.

    Up to pushes_max times along the outward normal of the nearest box. If the nominal distance is not reached, the best
    place seen remains (the relaxed floor is for the caller to judge).
    """
    best, bx, by, bz = -np.inf, point[0], point[1], point[2]
    last_x, last_y, last_z, share = 0.0, 0.0, 0.0, 1.0
    for push in range(problem.pushes_max + 1):
        point[2] = min(max(point[2], problem.altitudes[0]), problem.altitudes[2])
        gap, box = nearest_box(index, point[0], point[1], point[2], problem.safety_m)
        if gap > best:
            best, bx, by, bz = gap, point[0], point[1], point[2]
        if box < 0 or push == problem.pushes_max:
            break
        nx, ny, nz = normal_of_box(index.rows, box, point[0], point[1], point[2])
        if nx * last_x + ny * last_y + nz * last_z < 0.0:
            share *= 0.5  # pushed to and fro between two obstacles: settle in the middle
        last_x, last_y, last_z = nx, ny, nz
        shift = share * (problem.safety_m - gap + 1e-6)
        point[0] += shift * nx
        point[1] += shift * ny
        point[2] += shift * nz
    point[0], point[1], point[2] = bx, by, bz
    return best


@njit(cache=True)
def project(points, problem, index, begin, end):
    """Bring waypoints [begin, end) into the feasible region in place and tell whether the whole trajectory is feasible.

    Order as in the paper: altitude clamp, cap of the step from the waypoint before, push-out. Feasible means: no step
    longer than the cap, every clearance at least the relaxed floor, and no segment between waypoints that touches a box.
    """
    for i in range(begin, end):
        points[i, 2] = min(max(points[i, 2], problem.altitudes[0]), problem.altitudes[2])
        if i > 0:
            step = points[i] - points[i - 1]
            length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if length > problem.step_max_m:
                points[i] = points[i - 1] + step * (problem.step_max_m / length)
        push_out(points[i], problem, index)
    return is_feasible(points, problem, index)


@njit(cache=True)
def is_feasible(points, problem, index):
    """Tell whether a trajectory keeps altitude bounds, step cap, relaxed floor, and hits nothing between waypoints."""
    one, before = np.empty(1, dtype=np.int64), 0.0
    for i in range(len(points)):
        p = points[i]
        if p[2] < problem.altitudes[0] - 1e-6 or p[2] > problem.altitudes[2] + 1e-6:
            return False
        gap, _ = nearest_box(index, p[0], p[1], p[2], problem.safety_m)
        if gap < problem.floor_m:
            return False
        if i > 0:
            q = points[i - 1]
            length = np.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
            if length > problem.step_max_m * (1.0 + 1e-9):
                return False
            # A segment shorter than the clearances at its ends together reaches no box.
            if length >= gap + before and collect_hits(index, q[0], q[1], q[2], p[0], p[1], p[2], 0.0, one) > 0:
                return False
        before = gap
    return True
