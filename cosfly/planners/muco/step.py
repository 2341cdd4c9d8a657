"""MuCO's step, compiled: the feasible region, the projection onto it, and the search for a step that lowers the loss.

All of it is one compiled call: a call from Python unpacks some forty arrays, which takes a third of the time of an
evaluation. Loops replace NumPy's whole-array forms, because the compiler takes seconds for each one that checks shapes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.geometry.kernels import collect_hits, nearest_box, normal_of_box
from cosfly.planners.muco.loss import BAND_ROWS, GREATEST, LEAST, difference_gradient, evaluate, remember_boxes
from cosfly.planners.muco.nearby import known, nearest_among, nearest_of
from cosfly.runtime.compiled import boolean, int64, njit

TRIES, TRIES_WITH_VISIBILITY = 10, 3  # of one step
REST_MAX = 8  # iterations at most without the visibility slope after it has not lowered the loss
DAMPING_LEAST = 1e-3  # keeps the band system positive definite where no term has curvature
DAMPING_FIRST, DAMPING_RISE, DAMPING_FALL = 5.0, 10.0, 0.5  # of a waypoint whose rough terms rise

# no_step: no step of any tried length lowers the loss. infeasible: at rest, but on a trajectory that breaks a bound.
STOP_REASONS = ("converged", "iteration_limit", "no_step", "infeasible")
CONVERGED, ITERATION_LIMIT, NO_STEP, INFEASIBLE = range(4)


class Rules(NamedTuple):
    """How to step and when to stop: the fields of MucoConfig of the same names."""

    learning_rate: float
    step_cap_m: float
    tolerance: float
    low_visibility: float
    low_visibility_frames: int


@njit(cache=True)
def hold_bounds(points, problem, contacts, band, gradient):
    """Remove from gradient and curvature, in place, what would lead straight out of the feasible region.

    A waypoint at the least or greatest altitude that is pulled beyond it keeps its z; one that touches an obstacle and
    is pulled into it may only slide along it. The caller skips the ends of the trajectory.
    """
    for i in range(len(points)):
        normal = contacts[i]
        into = gradient[i, 0] * normal[0] + gradient[i, 1] * normal[1] + gradient[i, 2] * normal[2]
        if into > 0.0:  # the step is against the gradient
            for a in range(3):
                gradient[i, a] -= into * normal[a]
                for b in range(a + 1):
                    band[a - b, 3 * i + b] += 1e5 * normal[a] * normal[b]
        at_floor = points[i, 2] <= problem.altitudes[i, LEAST] + 1e-9 and gradient[i, 2] > 0.0
        at_ceiling = points[i, 2] >= problem.altitudes[i, GREATEST] - 1e-9 and gradient[i, 2] < 0.0
        if at_floor or at_ceiling:
            gradient[i, 2] = 0.0
            band[0, 3 * i + 2] += 1e7


@njit(cache=True)
def solve_band(band, damping, gradient):
    """Return the step -(H + damping)^-1 g of the interior waypoints, (n - 2, 3), by Cholesky's factors of a band.

    Args:
        band: (BAND_ROWS, 3 n) lower band of H. damping: (n,) per waypoint. gradient: (n, 3).
    Returns:
        each waypoint's step by its own curvature alone, should rounding have made the model indefinite.
    """
    size, rows = 3 * len(gradient) - 6, BAND_ROWS
    factor, step = np.empty((size + rows, rows)), np.empty(size)  # factor[j, k]: row j + k, column j
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
    """Return the loss of one trial step of the interior waypoints, infinite if not feasible, and if it was capped.

    Args:
        points: (n, 3) m, kept. steps: (n - 2, 3) m. scale: share of it that is taken. cap_m: longest move of a
            waypoint; longer ones are shortened each on its own, or all by the same factor (as_a_whole).
        state, trial: written, what `evaluate` fills and the projected trajectory.
    """
    longest = move(points, steps, scale, cap_m, as_a_whole, trial)
    loss = np.inf
    if project(trial, problem, index, int64(1), len(trial) - 1, state.nearby):
        loss = evaluate(trial, problem, index, masked, state)
    return loss, longest > cap_m


@njit(cache=True)
def move(points, steps, scale, cap_m, as_a_whole, trial):
    """Put the capped step of `try_step` into `trial`, (n, 3); return the longest of the uncapped steps, m."""
    lengths, longest, last = np.empty(len(steps)), 0.0, len(points) - 1
    for i in range(len(steps)):
        lengths[i] = np.sqrt(steps[i, 0] ** 2 + steps[i, 1] ** 2 + steps[i, 2] ** 2)
        longest = max(longest, lengths[i])
    for axis in range(3):
        trial[0, axis], trial[last, axis] = points[0, axis], points[last, axis]
    for i in range(len(steps)):
        share = scale * min(1.0, cap_m / max(longest if as_a_whole else lengths[i], 1e-12))
        for axis in range(3):
            trial[i + 1, axis] = points[i + 1, axis] + share * steps[i, axis]
    return longest


@njit(cache=True)
def descend(points, problem, index, rules, states, history):
    """Optimize a feasible trajectory in place; its ends stay.

    The visibility term is a staircase that the model does not see: where its slope does not lower the loss, the step is
    tried without it, and for 1, 2, 4 ... REST_MAX iterations it is not tried again.

    Args:
        points: (n, 3) m, n >= 3. states: two of `make_state`, written. history: (iterations_max + 1,) the loss before
            each iteration and after the last, written.
    Returns:
        the best trajectory (n, 3), its state, which waypoints are masked (n,), how many iterations and evaluations it
        took, and a number in STOP_REASONS.
    """
    now, spare = states
    damping, trial = np.zeros(len(points)), np.empty_like(points)
    masked = np.zeros(len(points), dtype=np.bool_)
    remember_boxes(points, problem, index, now.nearby)
    loss = evaluate(points, problem, index, masked, now)
    masked = mask(points, problem, index, rules, masked, now)
    history[0] = loss
    rest, next_rest, small_changes, num_tried = 0, 1, 0, 0
    for iteration in range(1, len(history)):
        smooth, found = now.gradient.copy(), np.inf
        if rest == 0 and now.visibility_gradient.any():
            slope = _scaled_sum(smooth, now.visibility_gradient, 1.0)
            found, tried = newton_step(
                points, loss, slope, damping, int64(TRIES_WITH_VISIBILITY), rules, problem, index, masked, now, spare,
                trial,
            )  # fmt: skip
            num_tried += tried
            rest, next_rest = (next_rest, min(2 * next_rest, REST_MAX)) if found == np.inf else (0, 1)
        rest = max(rest - 1, 0)
        if found == np.inf:
            found, tried = newton_step(
                points, loss, smooth, damping, int64(TRIES), rules, problem, index, masked, now, spare, trial
            )
            num_tried += tried
        if found == np.inf:
            return points, now, masked, iteration - 1, num_tried, NO_STEP
        change, loss, history[iteration] = abs(found - loss), found, found
        points, trial, now, spare = trial, points, spare, now
        remember_boxes(points, problem, index, now.nearby)
        masked = mask(points, problem, index, rules, masked, now)
        small_changes = small_changes + 1 if change < rules.tolerance * max(abs(loss), 1.0) else 0
        if small_changes == 2:  # one small change may be a graze of the staircase that visibility is
            return points, now, masked, iteration, num_tried, CONVERGED
    return points, now, masked, len(history) - 1, num_tried, ITERATION_LIMIT


@njit(cache=True)
def descend_as_the_paper(points, problem, index, rules, states, history):
    """Run the paper's optimizer: plain steps along finite differences, capped per waypoint and projected.

    The loss may rise. A projection that cannot make the trajectory feasible stops nothing; later steps may. Converged
    when |change of the loss| is less than the tolerance, which is absolute here. Arguments and results as of `descend`;
    the trajectory is the last feasible one.
    """
    now, spare = states
    best, trial, gradient = points.copy(), points.copy(), np.empty_like(points)
    masked, is_free, reason = np.zeros(len(points), dtype=np.bool_), True, ITERATION_LIMIT
    remember_boxes(points, problem, index, now.nearby)
    history[0] = evaluate(points, problem, index, masked, now)
    num_done = 0
    for iteration in range(1, len(history)):
        masked = mask(points, problem, index, rules, masked, now)
        difference_gradient(points, problem, index, masked, spare, gradient)
        steps = _scaled_sum(gradient, now.visibility_gradient, -rules.learning_rate)[1:-1]
        move(points, steps, 1.0, rules.step_cap_m, boolean(False), trial)
        is_free = project(trial, problem, index, int64(1), len(trial) - 1, now.nearby)
        points, trial, num_done = trial, points, iteration
        remember_boxes(points, problem, index, now.nearby)
        history[iteration] = evaluate(points, problem, index, masked, now)
        if is_free:
            best = points.copy()
        if abs(history[iteration] - history[iteration - 1]) < rules.tolerance:
            reason = CONVERGED if is_free else INFEASIBLE
            break
    if not is_free:
        remember_boxes(best, problem, index, now.nearby)
        evaluate(best, problem, index, masked, now)
    return best, now, masked, num_done, num_done, reason


@njit(cache=True)
def mask(points, problem, index, rules, masked, state):
    """Return the waypoints in low-visibility runs, (n,); gradient and model in `state` change with them."""
    found = low_visibility_runs(state.visibility, rules.low_visibility, rules.low_visibility_frames)
    for i in range(len(found)):
        if found[i] != masked[i]:
            evaluate(points, problem, index, found, state)
            break
    return found


@njit(cache=True)
def _scaled_sum(one, other, factor):
    """Return factor * (one + other), (n, 3)."""
    total = np.empty_like(one)
    for i in range(len(one)):
        for axis in range(3):
            total[i, axis] = factor * (one[i, axis] + other[i, axis])
    return total


@njit(cache=True)
def low_visibility_runs(fractions, threshold, frames):
    """Mark the waypoints in runs of at least `frames` neighbours that all see less than `threshold`, (n,) bool."""
    marked, begin = np.zeros(len(fractions), dtype=np.bool_), 0
    for i in range(len(fractions) + 1):
        if i == len(fractions) or fractions[i] >= threshold:
            for k in range(begin, i):
                marked[k] = i - begin >= frames
            begin = i + 1
    return marked


@njit(cache=True)
def newton_step(points, loss, gradient, damping, num_tries, rules, problem, index, masked, now, spare, trial):
    """Look for a step against `gradient` that lowers the loss.

    A trial that fails only for what the rough terms of some waypoints rose by is solved again with these damped; any
    other failure shortens the step, first as a whole where single waypoints were capped: a capped step may be no
    descent, because neighbours move apart.

    Args:
        points: (n, 3) m, kept. loss, now: its loss and state. gradient: (n, 3), changed. damping: (n,) of single
            waypoints, Levenberg's way, changed if a step is found. spare, trial: written, of the last trial.
    Returns:
        the loss of the trial, infinity if none lowers it, and how many were tried.
    """
    band, raised = now.band.copy(), damping.copy()
    for column in range(band.shape[1]):
        band[0, column] += DAMPING_LEAST
    hold_bounds(points, problem, now.contacts, band, gradient)
    steps, scale, as_a_whole = solve_band(band, raised, gradient), 1.0, boolean(False)
    for tried in range(1, num_tries + 1):
        found, is_capped = try_step(
            points, steps, scale, rules.step_cap_m, as_a_whole, problem, index, masked, spare, trial
        )
        if found < loss:
            for i in range(len(damping)):
                damping[i] = raised[i] * DAMPING_FALL if raised[i] > DAMPING_FIRST / 10 else 0.0
            return found, tried
        rise = 0.0
        for i in range(len(raised)):
            rise += max(spare.rough[i] - now.rough[i], 0.0)
        if found < np.inf and rise > found - loss:
            for i in range(len(raised)):
                if spare.rough[i] > now.rough[i]:
                    raised[i] = max(DAMPING_RISE * raised[i], DAMPING_FIRST)
            steps = solve_band(band, raised, gradient)
        elif not as_a_whole and is_capped:
            as_a_whole = True
        else:
            scale *= 0.25
    return np.inf, num_tries


# --- the feasible region ----------------------------------------------------------------------------------------------


@njit(cache=True)
def push_out(point, problem, index, nearby, i):
    """Move waypoint i in place out of obstacles, within the altitude bounds; return its clearance, at most safety_m.

    Up to pushes_max times along the outward normal of the nearest box. If the nominal distance is not reached, the best
    place seen remains (the caller checks the relaxed floor).
    """
    best, bx, by, bz = -np.inf, point[0], point[1], point[2]
    last_x, last_y, last_z, share = 0.0, 0.0, 0.0, 1.0
    for push in range(problem.pushes_max + 1):
        point[2] = min(max(point[2], problem.altitudes[i, LEAST]), problem.altitudes[i, GREATEST])
        gap, box = nearest_of(nearby, i, index, point[0], point[1], point[2], problem.safety_m)
        if gap > best:
            best, bx, by, bz = gap, point[0], point[1], point[2]
        if box < 0 or push == problem.pushes_max:
            break
        nx, ny, nz = normal_of_box(index.rows, box, point[0], point[1], point[2])
        if nx * last_x + ny * last_y + nz * last_z < 0.0:
            share *= 0.5  # between two obstacles: settle in the middle
        last_x, last_y, last_z = nx, ny, nz
        shift = share * (problem.safety_m - gap + 1e-6)
        point[0] += shift * nx
        point[1] += shift * ny
        point[2] += shift * nz
    point[0], point[1], point[2] = bx, by, bz
    return best


@njit(cache=True)
def project(points, problem, index, begin, end, nearby):
    """Bring waypoints [begin, end) into the feasible region in place; return whether the whole trajectory is feasible.

    Order as in the paper: altitude clamp, cap of the step from the waypoint before, push-out.
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
        count = known(anchors, num_around, i, x, y, z)
        if count > 0:
            _, box = nearest_among(rows, around, i, count, x, y, z, problem.safety_m)
            count = count if box >= 0 else 0  # nothing too near
        if count != 0:
            push_out(points[i], problem, index, nearby, i)
    return is_feasible(points, problem, index, nearby)


@njit(cache=True)
def is_feasible(points, problem, index, nearby):
    """Return whether a trajectory keeps altitude bounds, step cap and relaxed floor, and hits nothing on its way."""
    one, before, step_max = np.empty(1, dtype=np.int64), 0.0, problem.step_max_m
    anchors, around, num_around, rows = nearby.anchors, nearby.around, nearby.num_around, index.rows
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z < problem.altitudes[i, LEAST] - 1e-6 or z > problem.altitudes[i, GREATEST] + 1e-6:
            return False
        count = known(anchors, num_around, i, x, y, z)
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
            # A segment shorter than the clearances at its ends together reaches no box.
            if length >= gap + before and collect_hits(index, u, v, w, x, y, z, 0.0, one) > 0:
                return False
        before = gap
    return True
