"""MuCO's loss, compiled: every term with its gradient and a positive semi-definite model of its curvature.

Loss of a trajectory p_0 .. p_{n-1} (subsec:appendix_planner_muco): sums over waypoints of seven weighted terms plus the
altitude and pitch regularisers. Choices that the paper leaves open are noted at the term. The curvature is
Gauss-Newton: a square w r^2 with dr/dp = a adds 2 w a a^T. It is a band matrix, because a term couples at most four
neighbours.
"""

from typing import NamedTuple

import numpy as np

from cosfly.geometry import kernels
from cosfly.geometry.kernels import RAY_OFFSETS_M, RAY_SPREAD_M, collect_hits, in_box_frame, nearest_box, normal_of_box
from cosfly.planners.muco.nearby import Nearby, hits_among, nearest_among, nothing_nearby, num_cached, remember
from cosfly.runtime.compiled import njit

# --- difference window: visibility from a waypoint and its neighbours half a metre away -------------------------------


@njit(cache=True)
def window_rays(rows, boxes, num_boxes, x, y, z, step_m, tx, ty, tz, free):
    """Write `free_rays` of a point and its six neighbours at +-step_m to `free`, (7,): middle, -x, +x, -y, +y, -z, +z.

    The rays go from (x, y, z) and its neighbours to (tx, ty, tz). The tests are those of seven calls of `free_rays`,
    but each of the twelve ends of the rays is converted to the frame of a box only once.
    """
    blocked = np.zeros((7, 5), dtype=np.bool_)
    ends, feet = np.empty((7, 3)), np.empty((5, 3))  # of the rays: at the window, and at the target
    for k in range(num_boxes):
        box = boxes[k]
        for place in range(7):
            axis = (place - 1) // 2  # -1 for the middle
            shift = step_m if place % 2 == 0 else -step_m
            u = x + shift if axis == 0 else x
            v = y + shift if axis == 1 else y
            w = z + shift if axis == 2 else z
            ends[place, 0], ends[place, 1], ends[place, 2] = in_box_frame(rows, box, u, v, w)
        for ray in range(5):
            feet[ray, 0], feet[ray, 1], feet[ray, 2] = in_box_frame(
                rows, box, tx + RAY_OFFSETS_M[ray, 0], ty + RAY_OFFSETS_M[ray, 1], tz + RAY_OFFSETS_M[ray, 2]
            )
        for place in range(7):
            for ray in range(5):
                if blocked[place, ray]:
                    continue
                enter, leave = 0.0, 1.0
                for axis in range(3):
                    foot, half = feet[ray, axis], rows[box, kernels.HALF_X + axis]
                    enter, leave = kernels.clip(foot, ends[place, axis] - foot, half, enter, leave)
                    if enter > leave:
                        break
                blocked[place, ray] = enter <= leave
    for place in range(7):
        free[place] = 1.0 - blocked[place].sum() / 5.0


TERM_NAMES = (
    "tracking", "smoothness", "jerk", "safety", "visibility", "view_angle", "path_length", "altitude", "pitch",
)  # fmt: skip
TRACKING, SMOOTHNESS, JERK, SAFETY, VISIBILITY, VIEW_ANGLE, PATH_LENGTH, ALTITUDE, PITCH = range(9)
LEAST, PREFERRED, GREATEST = range(3)  # altitudes
LOW_PITCH, PREFERRED_PITCH, HIGH_PITCH = range(3)
BELOW, ABOVE, SWING, BENEATH = range(4)  # altitude weights; the swing is the oscillation
BAND_ROWS = 10  # jerk couples x_i with x_{i+3}, nine places on in x_0 y_0 z_0 x_1 ...

SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])
THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])


class Problem(NamedTuple):
    """The constants of one optimisation; n waypoints."""

    targets: np.ndarray  # (n, 3) hip points, m
    views_rad: np.ndarray  # (n,) preferred azimuth of the view
    distances: np.ndarray  # (n,) preferred distance, m
    weights: np.ndarray  # (7,) in the order of TERM_NAMES
    altitudes: np.ndarray  # (n, 3) least, preferred, greatest z of each waypoint in the world, m
    keeps_sight: np.ndarray  # (n,) bool, whether a waypoint has a visibility term
    bearing_weight: float  # of the azimuth of the view
    altitude_weights: np.ndarray  # (4,) below the least, above the preferred, oscillation, beneath the preferred
    pitches_rad: np.ndarray  # (n, 3) lower edge of the band, preferred, upper edge
    influence_m: float  # obstacles nearer than this add to the safety term
    difference_m: float  # half width of the difference window
    pitch_weight: float  # of pitch outside the band
    safety_m: float  # nominal distance to obstacles
    floor_m: float  # distance to obstacles where the nominal one is impossible
    step_max_m: float  # between two waypoints
    pushes_max: int  # out of obstacles, per waypoint and projection
    dt_s: float  # between two waypoints


class State(NamedTuple):
    """The buffers that each evaluation overwrites; n waypoints."""

    terms: np.ndarray  # (9,) the loss by term
    gradient: np.ndarray  # (n, 3), without the gradient of visibility
    visibility_gradient: np.ndarray  # (n, 3)
    band: np.ndarray  # (BAND_ROWS, 3 n) lower band of the curvature H: band[k, j] = H[j + k, j], j = 3 waypoint + axis
    visibility: np.ndarray  # (n,) five-ray visibility
    rough: np.ndarray  # (n,) share of each waypoint in the terms that are not smooth: visibility and safety
    blockers: np.ndarray  # (k,) buffer of box numbers
    contacts: np.ndarray  # (n, 3) unit normal of the obstacle that a waypoint touches, or zero
    nearby: Nearby  # cached boxes from earlier evaluations; states may share them


def make_state(num_points: int, num_boxes: int) -> State:
    """Return buffers for evaluations."""
    return State(
        np.zeros(len(TERM_NAMES)), np.zeros((num_points, 3)), np.zeros((num_points, 3)),
        np.zeros((BAND_ROWS, 3 * num_points)), np.zeros(num_points), np.zeros(num_points),
        np.zeros(num_boxes, dtype=np.int64), np.zeros((num_points, 3)),
        nothing_nearby(num_points),
    )  # fmt: skip


@njit(cache=True)
def remember_boxes(points, problem, index, nearby):
    """Look up which boxes matter to each waypoint of a trajectory that will be evaluated and projected, in place."""
    reach = max(problem.influence_m, problem.safety_m)
    remember(nearby, index, points, problem.targets, reach, max(RAY_SPREAD_M, problem.difference_m))


@njit(cache=True)
def evaluate(points, problem, index, masked, state):
    """Fill `state` for a trajectory and return its loss.

    Args:
        points: (n, 3) m. masked: (n,) bool, waypoints in a low-visibility run: their visibility and view-angle terms
            count in the loss, but not in gradient and curvature.
    """
    state.terms.fill(0.0)
    state.gradient.fill(0.0)
    state.visibility_gradient.fill(0.0)
    state.contacts.fill(0.0)
    state.rough.fill(0.0)
    chain_curvature(problem, state)
    point_terms(points, problem, index, masked, state)
    visibility_terms(points, problem, index, masked, state)
    chain_terms(points, problem, state)
    return state.terms.sum()


# --- terms of one waypoint --------------------------------------------------------------------------------------------
# These functions loop over many waypoints and unpack arrays from their tuples first: passing a tuple of arrays costs an
# atomic count for each array, which for one waypoint is more than the arithmetic.


@njit(cache=True, inline="always")
def _add_square(terms, gradient, band, term, i, weight, residual, ax, ay, az, in_model):
    """Add weight * residual^2 of waypoint i, where (ax, ay, az) is the residual's derivative."""
    terms[term] += weight * residual * residual
    if in_model:
        slope = 2.0 * weight * residual
        k = 3 * i
        gradient[i, 0] += slope * ax
        gradient[i, 1] += slope * ay
        gradient[i, 2] += slope * az
        band[0, k] += 2.0 * weight * ax * ax
        band[0, k + 1] += 2.0 * weight * ay * ay
        band[0, k + 2] += 2.0 * weight * az * az
        band[1, k] += 2.0 * weight * ax * ay
        band[1, k + 1] += 2.0 * weight * ay * az
        band[2, k] += 2.0 * weight * ax * az


@njit(cache=True)
def point_terms(points, problem, index, masked, state):
    """Add tracking, safety, view angle, altitude bounds and pitch band."""
    terms, gradient, band, rough, contacts = state.terms, state.gradient, state.band, state.rough, state.contacts
    anchors, around, num_around, rows = state.nearby.anchors, state.nearby.around, state.nearby.num_around, index.rows
    targets, views, weights = problem.targets, problem.views_rad, problem.weights
    distances, pitches = problem.distances, problem.pitches_rad
    bearing_weight = problem.bearing_weight
    influence = problem.influence_m
    half_safety = 0.5 * weights[SAFETY]
    below, above = problem.altitude_weights[BELOW], problem.altitude_weights[ABOVE]
    beneath = problem.altitude_weights[BENEATH]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        least_z, preferred_z = problem.altitudes[i, LEAST], problem.altitudes[i, PREFERRED]
        dx, dy, dz = x - targets[i, 0], y - targets[i, 1], z - targets[i, 2]

        # Tracking: deviation of the slant distance.
        distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
        ax, ay, az = dx / distance, dy / distance, dz / distance
        excess = distance - distances[i]
        _add_square(terms, gradient, band, TRACKING, i, weights[TRACKING], excess, ax, ay, az, True)

        # Safety: intrusion into the influence distance of the nearest box, along its normal.
        count = num_cached(anchors, num_around, i, x, y, z)  # -1: unknown, ask the index; 0: no box is near
        if count != 0:
            if count > 0:
                gap, box = nearest_among(rows, around, i, count, x, y, z, influence)
            else:
                gap, box = nearest_box(index, x, y, z, influence)
            if box >= 0:
                nx, ny, nz = normal_of_box(rows, box, x, y, z)
                _add_square(terms, gradient, band, SAFETY, i, half_safety, gap - influence, nx, ny, nz, True)
                rough[i] += half_safety * (gap - influence) ** 2
                if gap < problem.safety_m + 0.01:
                    contacts[i, 0], contacts[i, 1], contacts[i, 2] = nx, ny, nz

        # View angle: deviations, in radians, of the downward pitch from the preferred one (the paper: 45 degrees) and
        # of the view's azimuth from the heading. Straight above the target both are undefined: a floor of one metre
        # keeps their derivatives finite.
        flat = max(np.sqrt(dx * dx + dy * dy), 1.0)
        pitch = np.arctan2(dz, flat)
        square = flat * flat + dz * dz
        px, py, pz = -dz * dx / flat / square, -dz * dy / flat / square, flat / square
        off = pitch - pitches[i, PREFERRED_PITCH]
        is_free = not masked[i]
        _add_square(terms, gradient, band, VIEW_ANGLE, i, weights[VIEW_ANGLE], off, px, py, pz, is_free)
        turn = np.arctan2(-dy, -dx) - views[i]
        turn -= 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
        tx, ty = -dy / flat / flat, dx / flat / flat
        _add_square(terms, gradient, band, VIEW_ANGLE, i, bearing_weight, turn, tx, ty, 0.0, is_free)
        outside = min(pitch - pitches[i, LOW_PITCH], 0.0) + max(pitch - pitches[i, HIGH_PITCH], 0.0)
        if outside != 0.0:
            _add_square(terms, gradient, band, PITCH, i, problem.pitch_weight, outside, px, py, pz, True)

        # Altitude: below the least, above the preferred, and for styles also beneath the preferred.
        if z < least_z:
            _add_square(terms, gradient, band, ALTITUDE, i, below, least_z - z, 0.0, 0.0, -1.0, True)
        if z > preferred_z:
            _add_square(terms, gradient, band, ALTITUDE, i, above, z - preferred_z, 0.0, 0.0, 1.0, True)
        elif beneath > 0.0:
            _add_square(terms, gradient, band, ALTITUDE, i, beneath, preferred_z - z, 0.0, 0.0, -1.0, True)


@njit(cache=True)
def visibility_terms(points, problem, index, masked, state):
    """Add (1 - V)^2 of every waypoint, V the five-ray fraction, averaged with that of six neighbours at +-difference_m.

    The raw fraction is a staircase; the average has steps of 1/35, and the central difference over the window is its
    slope.
    """
    spread = max(RAY_SPREAD_M, problem.difference_m)  # of any ray of the window from the middle one, at both ends
    weight = problem.weights[VISIBILITY]
    step = problem.difference_m
    free = np.empty(7)
    visible, blockers, band, rough, rows = state.visibility, state.blockers, state.band, state.rough, index.rows
    anchors, on_view, num_on_view = state.nearby.anchors, state.nearby.on_view, state.nearby.num_on_view
    gradient, targets = state.visibility_gradient, problem.targets
    slope = np.empty(3)  # of the visible share, per m
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        visible[i] = 1.0
        if not problem.keeps_sight[i]:
            continue
        tx, ty, tz = targets[i, 0], targets[i, 1], targets[i, 2]
        count = num_cached(anchors, num_on_view, i, x, y, z)
        if count > 0:
            count = hits_among(rows, on_view, i, count, tx, ty, tz, x, y, z, spread, blockers)
        elif count < 0:
            count = collect_hits(index, tx, ty, tz, x, y, z, spread, blockers)
        if count == 0:
            continue
        window_rays(rows, blockers, count, x, y, z, step, tx, ty, tz, free)
        visible[i] = free[0]
        hidden = 1.0 - free.sum() / 7.0
        rough[i] += weight * hidden * hidden
        state.terms[VISIBILITY] += weight * hidden * hidden
        if masked[i]:
            continue
        for axis in range(3):
            slope[axis] = (free[1 + 2 * axis] - free[2 + 2 * axis]) / (2.0 * step)
            gradient[i, axis] = 2.0 * weight * hidden * slope[axis]
        for a in range(3):
            for b in range(a + 1):
                band[a - b, 3 * i + b] += 2.0 * weight * slope[a] * slope[b]


# --- terms that couple neighbours -------------------------------------------------------------------------------------


@njit(cache=True)
def chain_curvature(problem, state):
    """Set the curvature to that of smoothness, jerk and altitude oscillation, which is the same for all positions."""
    band = state.band
    num_points = len(problem.targets)
    weights = problem.weights
    band.fill(0.0)
    for coefficients, weight in ((SECOND_DIFFERENCE, weights[SMOOTHNESS]), (THIRD_DIFFERENCE, weights[JERK])):
        for first in range(num_points - len(coefficients) + 1):
            for k in range(len(coefficients)):
                for m in range(k + 1):
                    value = 2.0 * weight * coefficients[k] * coefficients[m]
                    for axis in range(3):
                        band[3 * (k - m), 3 * (first + m) + axis] += value
    swing = 2.0 * problem.altitude_weights[SWING]
    for i in range(num_points - 1):
        band[0, 3 * i + 2] += swing
        band[0, 3 * i + 5] += swing
        band[3, 3 * i + 2] -= swing


@njit(cache=True)
def chain_terms(points, problem, state):
    """Add smoothness, jerk, path length and altitude oscillation.

    Adds to terms and gradient, and the path length's curvature to the band; the rest is `chain_curvature`.
    """
    num_points, weights, gradient = len(points), problem.weights, state.gradient
    smoothness, jerk, swing = weights[SMOOTHNESS], weights[JERK], problem.altitude_weights[SWING]
    bends, jerks, swings = 0.0, 0.0, 0.0
    for i in range(num_points - 1):
        for axis in range(3):
            p, q = points[i, axis], points[i + 1, axis]
            if i + 2 < num_points:
                r = points[i + 2, axis]
                bend = p - 2.0 * q + r
                bends += bend * bend
                gradient[i, axis] += 2.0 * smoothness * bend
                gradient[i + 1, axis] -= 4.0 * smoothness * bend
                gradient[i + 2, axis] += 2.0 * smoothness * bend
                if i + 3 < num_points:
                    third = points[i + 3, axis] - 3.0 * r + 3.0 * q - p
                    jerks += third * third
                    gradient[i, axis] -= 2.0 * jerk * third
                    gradient[i + 1, axis] += 6.0 * jerk * third
                    gradient[i + 2, axis] -= 6.0 * jerk * third
                    gradient[i + 3, axis] += 2.0 * jerk * third
        # Oscillation: the squared change of altitude from waypoint to waypoint.
        change = points[i + 1, 2] - points[i, 2]
        swings += change * change
        gradient[i, 2] -= 2.0 * swing * change
        gradient[i + 1, 2] += 2.0 * swing * change
    state.terms[SMOOTHNESS] += smoothness * bends
    state.terms[JERK] += jerk * jerks
    state.terms[ALTITUDE] += swing * swings
    _add_lengths(points, 0.1 * weights[PATH_LENGTH], state)


@njit(cache=True)
def _add_lengths(points, weight, state):
    """Add weight * |p_{i+1} - p_i|; its curvature is (1 - u u^T) / length, with a floor under the length."""
    gradient, band = state.gradient, state.band
    unit = np.empty(3)
    total = 0.0
    for i in range(len(points) - 1):
        for a in range(3):
            unit[a] = points[i + 1, a] - points[i, a]
        length = np.sqrt(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2])
        total += length
        if length < 1e-9:
            continue
        stiffness = weight / max(length, 0.1)
        for a in range(3):
            unit[a] /= length
            gradient[i, a] -= weight * unit[a]
            gradient[i + 1, a] += weight * unit[a]
        for a in range(3):
            for b in range(3):
                value = stiffness * ((1.0 if a == b else 0.0) - unit[a] * unit[b])
                if b <= a:
                    band[a - b, 3 * i + b] += value
                    band[a - b, 3 * i + 3 + b] += value
                band[3 + a - b, 3 * i + b] -= value  # row: axis a of waypoint i + 1, column: axis b of waypoint i
    state.terms[PATH_LENGTH] += weight * total
