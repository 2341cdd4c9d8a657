"""MuCO's step, compiled: the feasible region, the projection onto it, and the search for a step that lowers the loss.

The whole search is one compiled call, because a call from Python unpacks some forty arrays, which takes a third of the
time of an evaluation. Loops replace NumPy's whole-array forms, because each shape check takes the compiler seconds.
Literals are passed as `int64(1)` and `boolean(False)`, so that a function is compiled for one signature only.

Arguments that all functions share, for n waypoints: points: (n, 3) m. problem: loss.Problem. index: kernels.BoxIndex of
the obstacles. state, now, spare: loss.State. nearby: nearby.Nearby, the cache of boxes. rules: Rules. masked: (n,)
bool, waypoints in low-visibility runs.
"""

from typing import NamedTuple

import numpy as np

from cosfly.geometry.kernels import collect_hits, nearest_box, normal_of_box
from cosfly.planners.muco.loss import BAND_ROWS, GREATEST, LEAST, evaluate, remember_boxes
from cosfly.planners.muco.nearby import nearest_among, nearest_of, num_cached
from cosfly.runtime.compiled import boolean, int64, njit

TRIES, TRIES_WITH_VISIBILITY = 10, 3  # trial steps per iteration, without and with the visibility slope
VISIBILITY_PAUSE_MAX = 8  # iterations without the visibility slope, from the one whose loss it did not lower
DAMPING_LEAST = 1e-3  # keeps the band system positive definite where no term has curvature
# Damping of a waypoint whose rough terms rise: its first value, and its factors after a failed and a successful trial.
DAMPING_FIRST, DAMPING_RISE, DAMPING_FALL = 5.0, 10.0, 0.5
DAMPING_ENDS = DAMPING_FIRST / 10  # a smaller one becomes 0 after a successful trial
STEP_FALL = 0.25  # factor on the length of a step after a failed trial
PUSH_EXTRA_M = 1e-6  # beyond the safety distance, so that rounding does not leave a waypoint within it
CONTACT_CURVATURE = 1e5  # across the face of a touched obstacle: allows only steps along the face
ALTITUDE_CURVATURE = 1e7  # in z at an altitude bound: keeps the waypoint at the bound

STOP_REASONS = ("converged", "iteration_limit", "no_step")  # no_step: no step of any tried length lowers the loss
CONVERGED, ITERATION_LIMIT, NO_STEP = range(3)


class Rules(NamedTuple):
    """Settings of the search: the fields of MucoConfig with the same names."""

    step_cap_m: float
    tolerance: float
    low_visibility: float
    low_visibility_frames: int


@njit(cache=True)
def hold_bounds(points, problem, contacts, band, gradient):
    """Restrict gradient and curvature, in place, so that a step does not leave the feasible region directly.

    A waypoint at an altitude bound keeps its z if the step would cross the bound. A waypoint that touches an obstacle
    slides along the face if the step would enter the obstacle. The caller ignores the ends of the trajectory.

    band: (BAND_ROWS, 3 n), band[k, j] = H[j + k, j], where 3 i + axis is the row of a coordinate of waypoint i.
    """
    for i in range(len(points)):
        normal = contacts[i]
        # A step against the gradient, which points away from the obstacle, enters the obstacle.
        outward = gradient[i, 0] * normal[0] + gradient[i, 1] * normal[1] + gradient[i, 2] * normal[2]
        if outward > 0.0:
            for row in range(3):
                gradient[i, row] -= outward * normal[row]
                for column in range(row + 1):
                    band[row - column, 3 * i + column] += CONTACT_CURVATURE * normal[row] * normal[column]
        at_floor = points[i, 2] <= problem.altitudes[i, LEAST] + 1e-9 and gradient[i, 2] > 0.0
        at_ceiling = points[i, 2] >= problem.altitudes[i, GREATEST] - 1e-9 and gradient[i, 2] < 0.0
        if at_floor or at_ceiling:
            gradient[i, 2] = 0.0
            band[0, 3 * i + 2] += ALTITUDE_CURVATURE


@njit(cache=True)
def solve_band(band, damping, gradient):
    """Solve (H + damping) step = -g for the interior waypoints by a banded Cholesky factorization.

    Args:
        band: (BAND_ROWS, 3 n) lower band of H. damping: (n,) per waypoint. gradient: (n, 3).
    Returns:
        (n - 2, 3) m. If rounding has made H indefinite, its diagonal replaces it.
    """
    size = 3 * len(gradient) - 6
    rows = BAND_ROWS
    factor = np.empty((size + rows, rows))  # factor[j, k]: row j + k, column j
    step = np.empty(size)
    factor[size:].fill(0.0)
    for j in range(size):
        for k in range(rows):
            factor[j, k] = band[k, j + 3] if j + k < size else 0.0
        factor[j, 0] += damping[j // 3 + 1]
        step[j] = -gradient[j // 3 + 1, j % 3]
    for j in range(size):
        if factor[j, 0] <= 0.0:
            for m in range(size):
                step[m] = -gradient[m // 3 + 1, m % 3] / (band[0, m + 3] + damping[m // 3 + 1])
            return step.reshape(-1, 3)
        pivot = 1.0 / np.sqrt(factor[j, 0])
        for k in range(rows):
            factor[j, k] *= pivot
        for k in range(1, rows):
            share = factor[j, k]
            for m in range(k, rows):
                factor[j + k, m - k] -= share * factor[j, m]
        step[j] /= factor[j, 0]
        for k in range(1, min(rows, size - j)):
            step[j + k] -= factor[j, k] * step[j]
    for j in range(size - 1, -1, -1):
        for k in range(1, min(rows, size - j)):
            step[j] -= factor[j, k] * step[j + k]
        step[j] /= factor[j, 0]
    return step.reshape(-1, 3)


@njit(cache=True)
def try_step(points, steps, scale, cap_m, as_a_whole, problem, index, masked, state, trial):
    """Evaluate one trial step of the interior waypoints.

    Args:
        points: (n, 3) m, unchanged. steps: (n - 2, 3) m. scale: factor on the steps. cap_m: longest step of a waypoint.
            as_a_whole: shorten all steps by the same factor, not only the steps that are too long.
        state: written by `evaluate`. trial: (n, 3), written, the projected trajectory.
    Returns:
        The loss of the trial, infinity if it is not feasible, and whether any step was longer than the cap.
    """
    lengths = np.empty(len(steps))
    longest = 0.0
    last = len(points) - 1
    for i in range(len(steps)):
        lengths[i] = np.sqrt(steps[i, 0] ** 2 + steps[i, 1] ** 2 + steps[i, 2] ** 2)
        longest = max(longest, lengths[i])
    for axis in range(3):
        trial[0, axis], trial[last, axis] = points[0, axis], points[last, axis]
    for i in range(len(steps)):
        length = longest if as_a_whole else lengths[i]
        share = scale * min(1.0, cap_m / max(length, 1e-12))
        for axis in range(3):
            trial[i + 1, axis] = points[i + 1, axis] + share * steps[i, axis]
    loss = np.inf
    if project(trial, problem, index, int64(1), last, state.nearby):
        loss = evaluate(trial, problem, index, masked, state)
    return loss, longest > cap_m


@njit(cache=True)
def newton_step(points, loss, gradient, damping, num_tries, rules, problem, index, masked, now, spare, trial):
    """Search for a step against `gradient` that lowers the loss.

    If only the rough terms (visibility, safety) of some waypoints raise the loss of a trial, the damping of these
    waypoints grows and the system is solved again. Otherwise the step is shortened. The first time, if the cap
    shortened single waypoints, all steps are shortened by the same factor instead: a step that is capped per waypoint
    moves neighbours apart, and may not be a descent.

    Args:
        points: (n, 3) m, unchanged. loss, now: loss and state of `points`. gradient: (n, 3), changed. damping: (n,)
            Levenberg damping per waypoint, changed if a step is found. spare, trial: written, state and points of the
            last trial.
    Returns:
        The loss of the trial, infinity if no trial lowers the loss, and the number of trials.
    """
    band = now.band.copy()
    raised = damping.copy()
    for column in range(band.shape[1]):
        band[0, column] += DAMPING_LEAST
    hold_bounds(points, problem, now.contacts, band, gradient)
    steps = solve_band(band, raised, gradient)
    scale = 1.0
    as_a_whole = boolean(False)
    for tried in range(1, num_tries + 1):
        trial_loss, is_capped = try_step(
            points, steps, scale, rules.step_cap_m, as_a_whole, problem, index, masked, spare, trial
        )
        if trial_loss < loss:
            for i in range(len(damping)):
                damping[i] = raised[i] * DAMPING_FALL if raised[i] > DAMPING_ENDS else 0.0
            return trial_loss, tried
        rough_rise = 0.0
        for i in range(len(raised)):
            rough_rise += max(spare.rough[i] - now.rough[i], 0.0)
        if trial_loss < np.inf and rough_rise > trial_loss - loss:
            for i in range(len(raised)):
                if spare.rough[i] > now.rough[i]:
                    raised[i] = max(DAMPING_RISE * raised[i], DAMPING_FIRST)
            steps = solve_band(band, raised, gradient)
        elif not as_a_whole and is_capped:
            as_a_whole = True
        else:
            scale *= STEP_FALL
    return np.inf, num_tries


@njit(cache=True)
def descend(points, problem, index, rules, states, history):
    """Optimize a feasible trajectory; its ends do not move.

    The visibility term is piecewise constant, and its curvature is unknown. If a step along its slope does not lower
    the loss, the step is tried without it, and the slope is ignored for the next 0, 1, 3 ... iterations.

    Args:
        points: (n, 3) m, n >= 3, overwritten by intermediate trajectories: only the returned one is the result.
            states: two of `make_state`, written. history: (iterations_max + 1,), written, the loss before each
            iteration and after the last one.
    Returns:
        The best trajectory (n, 3), its state, the masked waypoints (n,) bool, the number of iterations, the number of
        trial steps, and an index into STOP_REASONS.
    """
    now, spare = states
    damping = np.zeros(len(points))
    trial = np.empty_like(points)
    masked = np.zeros(len(points), dtype=np.bool_)
    remember_boxes(points, problem, index, now.nearby)
    loss = evaluate(points, problem, index, masked, now)
    masked = update_mask(points, problem, index, rules, masked, now)
    history[0] = loss
    visibility_pause = 0
    next_pause = 1
    num_small_changes = 0
    num_tried = 0
    for iteration in range(1, len(history)):
        trial_loss = np.inf
        if visibility_pause == 0 and now.visibility_gradient.any():
            gradient = _sum_of(now.gradient, now.visibility_gradient)
            trial_loss, tried = newton_step(
                points, loss, gradient, damping, int64(TRIES_WITH_VISIBILITY), rules, problem, index, masked, now,
                spare, trial,
            )  # fmt: skip
            num_tried += tried
            if trial_loss < np.inf:
                next_pause = 1
            else:
                visibility_pause = next_pause
                next_pause = min(2 * next_pause, VISIBILITY_PAUSE_MAX)
        if trial_loss == np.inf:
            trial_loss, tried = newton_step(
                points, loss, now.gradient.copy(), damping, int64(TRIES), rules, problem, index, masked, now, spare,
                trial,
            )  # fmt: skip
            num_tried += tried
        visibility_pause = max(visibility_pause - 1, 0)
        if trial_loss == np.inf:
            return points, now, masked, iteration - 1, num_tried, NO_STEP
        change = abs(trial_loss - loss)
        loss = trial_loss
        history[iteration] = loss
        points, trial = trial, points
        now, spare = spare, now
        remember_boxes(points, problem, index, now.nearby)
        masked = update_mask(points, problem, index, rules, masked, now)
        num_small_changes = num_small_changes + 1 if change < rules.tolerance * max(abs(loss), 1.0) else 0
        if num_small_changes == 2:  # a single small change can come from one step of the piecewise visibility term
            return points, now, masked, iteration, num_tried, CONVERGED
    return points, now, masked, len(history) - 1, num_tried, ITERATION_LIMIT


@njit(cache=True)
def update_mask(points, problem, index, rules, masked, state):
    """Return which waypoints are in low-visibility runs, (n,) bool; evaluate `state` again where `masked` differs.

    The mask changes the gradients only, so the loss of `points` stays valid.
    """
    new_mask = low_visibility_runs(state.visibility, rules.low_visibility, rules.low_visibility_frames)
    for i in range(len(new_mask)):
        if new_mask[i] != masked[i]:
            evaluate(points, problem, index, new_mask, state)
            break
    return new_mask


@njit(cache=True)
def _sum_of(left, right):
    """Return left + right, (n, 3)."""
    total = np.empty_like(left)
    for i in range(len(left)):
        for axis in range(3):
            total[i, axis] = left[i, axis] + right[i, axis]
    return total


@njit(cache=True)
def low_visibility_runs(fractions, threshold, frames):
    """Return which waypoints are in a run of at least `frames` with visibility below `threshold`, (n,) bool."""
    marked = np.zeros(len(fractions), dtype=np.bool_)
    begin = 0
    for i in range(len(fractions) + 1):
        if i == len(fractions) or fractions[i] >= threshold:
            for k in range(begin, i):
                marked[k] = i - begin >= frames
            begin = i + 1
    return marked


# --- the feasible region ----------------------------------------------------------------------------------------------


@njit(cache=True)
def push_out(point, problem, index, nearby, i):
    """Move waypoint i out of obstacles, in place and within the altitude bounds.

    The waypoint moves along the outward normal of the nearest box, at most pushes_max times. If it does not reach
    safety_m, it ends where its clearance was greatest; the caller checks the relaxed distance.

    Returns:
        The clearance, m, at most safety_m.
    """
    best = -np.inf
    best_x, best_y, best_z = point[0], point[1], point[2]
    last_x, last_y, last_z = 0.0, 0.0, 0.0  # the normal of the previous push
    share = 1.0
    for push in range(problem.pushes_max + 1):
        point[2] = min(max(point[2], problem.altitudes[i, LEAST]), problem.altitudes[i, GREATEST])
        gap, box = nearest_of(nearby, i, index, point[0], point[1], point[2], problem.safety_m)
        if gap > best:
            best = gap
            best_x, best_y, best_z = point[0], point[1], point[2]
        if box < 0 or push == problem.pushes_max:
            break
        nx, ny, nz = normal_of_box(index.rows, box, point[0], point[1], point[2])
        if nx * last_x + ny * last_y + nz * last_z < 0.0:
            share *= 0.5  # between two obstacles: converge to the middle
        last_x, last_y, last_z = nx, ny, nz
        shift = share * (problem.safety_m - gap + PUSH_EXTRA_M)
        point[0] += shift * nx
        point[1] += shift * ny
        point[2] += shift * nz
    point[0], point[1], point[2] = best_x, best_y, best_z
    return best


@njit(cache=True)
def project(points, problem, index, begin, end, nearby):
    """Move waypoints [begin, end) into the feasible region, in place; return whether the whole trajectory is feasible.

    The order is that of the paper: altitude clamp, cap of the distance from the previous waypoint, push-out.
    """
    step_max = problem.step_max_m
    anchors, around, num_around, rows = nearby.anchors, nearby.around, nearby.num_around, index.rows
    for i in range(begin, end):
        points[i, 2] = min(max(points[i, 2], problem.altitudes[i, LEAST]), problem.altitudes[i, GREATEST])
        if i > 0:
            u, v, w = points[i - 1, 0], points[i - 1, 1], points[i - 1, 2]
            dx, dy, dz = points[i, 0] - u, points[i, 1] - v, points[i, 2] - w
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            if length > step_max:
                share = step_max / length
                points[i, 0], points[i, 1], points[i, 2] = u + share * dx, v + share * dy, w + share * dz
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        count = num_cached(anchors, num_around, i, x, y, z)  # -1: unknown, ask the index; 0: no box is near
        if count > 0:
            _, box = nearest_among(rows, around, i, count, x, y, z, problem.safety_m)
            if box < 0:
                count = 0  # no box is too near
        if count != 0:  # a box is too near, or the cache has no answer
            push_out(points[i], problem, index, nearby, i)
    return is_feasible(points, problem, index, nearby)


@njit(cache=True)
def is_feasible(points, problem, index, nearby):
    """Return whether a trajectory keeps altitude bounds, step length and relaxed distance, and hits no box between."""
    first_hit = np.empty(1, dtype=np.int64)
    gap_before = 0.0
    step_max = problem.step_max_m
    anchors, around, num_around, rows = nearby.anchors, nearby.around, nearby.num_around, index.rows
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z < problem.altitudes[i, LEAST] - 1e-6 or z > problem.altitudes[i, GREATEST] + 1e-6:
            return False
        count = num_cached(anchors, num_around, i, x, y, z)
        if count >= 0:
            gap, _ = nearest_among(rows, around, i, count, x, y, z, problem.safety_m)
        else:
            gap, _ = nearest_box(index, x, y, z, problem.safety_m)
        if gap < problem.floor_m:
            return False
        if i > 0:
            u, v, w = points[i - 1, 0], points[i - 1, 1], points[i - 1, 2]
            length = np.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2)
            if length > step_max * (1.0 + 1e-9):
                return False
            # A segment that is shorter than the sum of the clearances at its ends reaches no box.
            if length >= gap + gap_before and collect_hits(index, u, v, w, x, y, z, 0.0, first_hit) > 0:
                return False
        gap_before = gap
    return True
