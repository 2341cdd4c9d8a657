"""Baselines that predict a decision without pictures, from the geometry of the past frames.

The geometry is a row of numbers; a network and a rule are fitted on such rows. `is_drawn_ahead` reports labels that may
depend on a random event after these frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from cosfly.formats.playback import Track
from cosfly.geometry.axes import wrap_deg
from cosfly.geometry.motion import in_axes_of

LOOKS_BACK = 3  # frames; fewer contain no turn, and five predict no better
FITTED_ON = 20_000  # most windows that a baseline is fitted on
LEAST_WINDOWS = 100  # fewest windows that a network is fitted on
HIDDEN = 32  # units of the network's hidden layer
ROUNDS = 120  # iterations of its optimiser
PENALTY = 1e-3  # on the squares of its weights
STANDS_MPS = 0.2  # a slower target stands
TURNS_DEG = 45.0  # a target whose heading changes by more turns
DRAWN_AHEAD = (
    f"another part of the flight begins, or the walker stops, sets off or turns by more than {TURNS_DEG:g} degrees"
)
Decider = Callable[[np.ndarray], np.ndarray]  # pasts (n, d) -> numbers of decisions (n,)
# A decision's number; or a column, its threshold, the rule for values up to the threshold, and the rule above it.
Rule = int | tuple[int, float, "Rule", "Rule"]


def past_of(flight: Track, window: Sequence[int], is_ordered: bool) -> np.ndarray:
    """Return the geometry of the last LOOKS_BACK frames of a window as a row of numbers, (d,).

    The row does not depend on the window's place and time. Poses are exact: the perturbation is removed where it is
    known. Unknown values are 0. Axes are the level axes of the drone at the last frame; units are m, s, degrees, with
    bearings in radians. The row holds velocities and speeds of drone and target, yaw and pitch, position, distance,
    bearing and visibility of the target, and whether a mission's order is in force.
    """
    at = [window[0]] * (LOOKS_BACK - len(window)) + list(window[-LOOKS_BACK:])
    planned = flight.planned[0][at]
    walked_m = flight.walked_m[at]
    poses = np.where(np.isnan(planned), np.hstack([flight.positions_m[at], flight.rotations_deg[at]]), planned)
    targets_m = np.where(np.isnan(walked_m), flight.targets_m[at], walked_m)
    yaw_deg = float(poses[-1, 4])
    step_s = np.diff(flight.time_s[at])[:, None]
    step_s[step_s == 0] = np.nan  # a repeated frame
    drone_m, target_m = (in_axes_of(yaw_deg, places_m - poses[-1, :3]) for places_m in (poses[:, :3], targets_m))
    drone_mps = np.diff(drone_m, axis=0) / step_s
    target_mps = np.diff(target_m, axis=0) / step_s
    away = target_m - drone_m
    apart_m = np.hypot(away[:, 0], away[:, 1])
    speeds = np.linalg.norm(target_mps, axis=1)
    bearing = np.arctan2(away[-1, 1], away[-1, 0])
    seen_from = bearing - np.arctan2(target_mps[-1, 1], target_mps[-1, 0])
    moves = speeds[-1] > STANDS_MPS
    turned_deg = np.asarray(wrap_deg(poses[:-1, 4] - yaw_deg))
    last = [bearing, moves * np.cos(seen_from), moves * np.sin(seen_from), is_ordered]
    drone_speeds = np.linalg.norm(drone_mps, axis=1)
    parts = [drone_mps, drone_speeds, target_mps, speeds, away[-1], apart_m, np.diff(apart_m), turned_deg]
    parts += [poses[:, 3], flight.target.visible[at], np.array(last, dtype=float)]
    return np.nan_to_num(np.concatenate([part.ravel() for part in parts]))


def is_drawn_ahead(flight: Track, now: int, last: int, is_ordered: bool) -> bool | None:
    """Return whether DRAWN_AHEAD holds after frame `now`, up to frame `last`, the last one that the label depends on.

    Random events within a part, such as the times of hops, are not recorded and not counted. While a mission's order is
    in force there are no random events. None means that the target's exact positions are not known.
    """
    if is_ordered:
        return False
    span = slice(max(0, now - 1), last + 1)
    steps_m = np.diff(flight.walked_m[span, :2], axis=0)
    steps_s = np.diff(flight.time_s[span])
    if now < 1 or not np.isfinite(steps_m).all():
        return None
    moves = np.hypot(*steps_m.T) > STANDS_MPS * steps_s
    headings_deg = np.degrees(np.arctan2(steps_m[:, 1], steps_m[:, 0]))
    turns = moves & moves[0] & (np.abs(wrap_deg(headings_deg - float(headings_deg[0]))) > TURNS_DEG)
    begins = any(now < part.begin <= last for part in flight.segments)
    return bool(begins or (moves != moves[0]).any() or turns.any())


def fit_network(table: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> Decider:
    """Fit a network of one hidden layer by cross entropy with a small penalty on its weights.

    Args:
        table: (n, d). labels: (n,) numbers of decisions, weighted by their frequency.

    Source: L-BFGS, Liu and Nocedal 1989.
    """
    from scipy.optimize import minimize
    from scipy.special import logsumexp

    center = table.mean(axis=0)
    spread = table.std(axis=0)
    num = int(labels.max()) + 1
    spread[spread == 0] = 1.0
    sizes = [(table.shape[1], HIDDEN), (HIDDEN,), (HIDDEN, num), (num,)]
    ends = np.cumsum([math.prod(size) for size in sizes])[:-1]

    def layers(flat: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        first, bias, second, last = (part.reshape(s) for part, s in zip(np.split(flat, ends), sizes, strict=True))
        hidden = np.tanh(rows @ first + bias)
        return hidden, hidden @ second + last, second

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        hidden, scores, second = layers(flat, inputs)
        logs = scores - logsumexp(scores, axis=1, keepdims=True)
        score_gradient = (np.exp(logs) - is_label) / len(inputs)
        back = score_gradient @ second.T * (1.0 - hidden**2)
        gradients = [inputs.T @ back, back.sum(axis=0), hidden.T @ score_gradient, score_gradient.sum(axis=0)]
        gradient = np.concatenate([part.ravel() for part in gradients]) + PENALTY * flat
        return float(-(logs * is_label).sum() / len(inputs) + PENALTY / 2 * flat @ flat), gradient

    def scaled(rows: np.ndarray) -> np.ndarray:
        return np.clip((rows - center) / spread, -5.0, 5.0)

    inputs = scaled(table)
    is_label = np.eye(num)[labels]
    begin = np.concatenate([(rng.normal(size=s) / math.sqrt(s[0]) * (len(s) == 2)).ravel() for s in sizes])
    weights = minimize(cost, begin, jac=True, method="L-BFGS-B", options={"maxiter": ROUNDS}).x
    return lambda rows: layers(weights, scaled(rows))[1].argmax(axis=1)


def fit_deciders(table: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> dict[str, Decider]:
    """Fit the baselines on pasts: `rule`, and from LEAST_WINDOWS on the network `blind`."""
    rule = fit_rule(table, labels)
    deciders: dict[str, Decider] = {"rule": lambda rows: np.array([decide(rule, row) for row in rows])}
    if len(table) >= LEAST_WINDOWS:
        deciders["blind"] = fit_network(table, labels, rng)
    return deciders


def fit_rule(table: np.ndarray, labels: np.ndarray, depth: int = 2) -> Rule:
    """Fit a decision tree: at each node the threshold of the least Gini impurity; labels (n,): numbers of decisions."""
    counts = np.bincount(labels)
    best = (-1.0, 0, 0.0)  # purity, column, threshold
    if depth == 0 or (counts > 0).sum() < 2:
        return int(counts.argmax())
    is_label = np.eye(len(counts))[labels]
    sizes = np.arange(1, len(labels))[:, None]
    for column in range(table.shape[1]):
        order = np.argsort(table[:, column])
        values, below = table[order, column], np.cumsum(is_label[order], axis=0)[:-1]
        purity = (below**2 / sizes + (counts - below) ** 2 / (len(labels) - sizes)).sum(axis=1)
        purity[values[1:] == values[:-1]] = -1.0  # no threshold lies between equals
        split = int(purity.argmax())
        best = max(best, (float(purity[split]), column, float(values[split])))
    if best[0] < 0:
        return int(counts.argmax())
    _, column, threshold = best
    is_low = table[:, column] <= threshold
    low, high = (fit_rule(table[rows], labels[rows], depth - 1) for rows in (is_low, ~is_low))
    return column, threshold, low, high


def decide(rule: Rule, row: np.ndarray) -> int:
    """Apply a rule to a row of numbers, and return the number of its decision."""
    while isinstance(rule, tuple):
        column, threshold, low, high = rule
        rule = low if row[column] <= threshold else high
    return rule
