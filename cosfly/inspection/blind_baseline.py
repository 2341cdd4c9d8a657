"""Baselines that predict a decision without pictures, from the geometry of the past frames.

`past_of` makes a row of numbers from a window; a network and a decision tree (the rule) are fitted on such rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

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
STANDS_MPS = 0.2  # below this speed the target stands
Decider = Callable[[np.ndarray], np.ndarray]  # pasts (n, d) -> numbers of decisions (n,)


class Split(NamedTuple):
    """A node of a decision tree; a leaf is the number of a decision."""

    column: int
    threshold: float
    low: Split | int  # the rule for values up to the threshold
    high: Split | int


def past_of(track: Track, window: Sequence[int], is_ordered: bool) -> np.ndarray:
    """Return the geometry of the last LOOKS_BACK frames of a window as a row of numbers, (d,).

    The row does not depend on the window's place and time. It holds what a prompt may tell: poses as they were drawn,
    with their perturbation, and the target where it is visible. Unknown values are 0. Axes are the level axes of the
    drone at the last frame; units are m, s, degrees, with bearings in radians. The row holds velocities and speeds of
    drone and target, yaw and pitch, position, distance, bearing and visibility of the target, and whether a mission's
    order is in force.
    """
    frames = [window[0]] * (LOOKS_BACK - len(window)) + list(window[-LOOKS_BACK:])
    positions_m, rotations_deg = track.positions_m[frames], track.rotations_deg[frames]
    yaw_deg = float(rotations_deg[-1, 1])
    drone_m = in_axes_of(yaw_deg, positions_m - positions_m[-1])
    is_seen = (track.target.visible & track.target.in_view)[frames]
    seen_targets_m = np.where(is_seen[:, None], track.targets_m[frames], np.nan)
    target_m = in_axes_of(yaw_deg, seen_targets_m - positions_m[-1])
    step_s = np.diff(track.time_s[frames])[:, None]
    step_s[step_s == 0] = np.nan  # a repeated frame
    drone_mps = np.diff(drone_m, axis=0) / step_s
    target_mps = np.diff(target_m, axis=0) / step_s
    target_speeds = np.linalg.norm(target_mps, axis=1)
    offsets_m = target_m - drone_m
    distances_m = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    bearing = np.arctan2(offsets_m[-1, 1], offsets_m[-1, 0])
    aspect = bearing - np.arctan2(target_mps[-1, 1], target_mps[-1, 0])  # between the view and the target's heading
    moves = target_speeds[-1] > STANDS_MPS
    parts = [drone_mps, np.linalg.norm(drone_mps, axis=1), target_mps, target_speeds]
    parts += [offsets_m[-1], distances_m, np.diff(distances_m)]
    parts += [np.asarray(wrap_deg(rotations_deg[:-1, 1] - yaw_deg)), rotations_deg[:, 0], is_seen]
    parts.append(np.array([bearing, moves * np.cos(aspect), moves * np.sin(aspect), is_ordered], dtype=float))
    return np.nan_to_num(np.concatenate([part.ravel() for part in parts]))


def fit_network(table: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> Decider:
    """Fit a network of one hidden layer by cross entropy with a small penalty on its weights.

    Args:
        table: (n, d) pasts.
        labels: (n,) numbers of decisions.

    Source: L-BFGS, Liu and Nocedal 1989.
    """
    from scipy.optimize import minimize
    from scipy.special import logsumexp

    center = table.mean(axis=0)
    spread = table.std(axis=0)
    spread[spread == 0] = 1.0
    num_decisions = int(labels.max()) + 1
    shapes = [(table.shape[1], HIDDEN), (HIDDEN,), (HIDDEN, num_decisions), (num_decisions,)]
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]

    def scaled(rows: np.ndarray) -> np.ndarray:
        return np.clip((rows - center) / spread, -5.0, 5.0)

    inputs = scaled(table)
    is_label = np.eye(num_decisions)[labels]

    def apply(weights: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the hidden layer, the scores of the decisions, and the weights of the second layer."""
        parts = zip(np.split(weights, ends), shapes, strict=True)
        first, first_bias, second, second_bias = (part.reshape(shape) for part, shape in parts)
        hidden = np.tanh(rows @ first + first_bias)
        return hidden, hidden @ second + second_bias, second

    def cost(weights: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cross entropy with the penalty, and its gradient."""
        hidden, scores, second = apply(weights, inputs)
        logs = scores - logsumexp(scores, axis=1, keepdims=True)
        by_score = (np.exp(logs) - is_label) / len(inputs)  # softmax minus one-hot
        by_hidden = by_score @ second.T * (1.0 - hidden**2)  # tanh' = 1 - tanh^2
        gradients = [inputs.T @ by_hidden, by_hidden.sum(axis=0), hidden.T @ by_score, by_score.sum(axis=0)]
        gradient = np.concatenate([part.ravel() for part in gradients]) + PENALTY * weights
        return float(-(logs * is_label).sum() / len(inputs) + PENALTY / 2 * weights @ weights), gradient

    start = []
    for shape in shapes:
        values = rng.normal(size=shape) / math.sqrt(shape[0])
        start.append((values if len(shape) == 2 else 0.0 * values).ravel())  # a bias starts at 0
    fitted = minimize(cost, np.concatenate(start), jac=True, method="L-BFGS-B", options={"maxiter": ROUNDS}).x
    return lambda rows: apply(fitted, scaled(rows))[1].argmax(axis=1)


def fit_deciders(table: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> dict[str, Decider]:
    """Fit the baselines on pasts: `rule`, and from LEAST_WINDOWS on the network `blind`."""
    rule = fit_rule(table, labels)
    deciders: dict[str, Decider] = {"rule": lambda rows: np.array([decide(rule, row) for row in rows])}
    if len(table) >= LEAST_WINDOWS:
        deciders["blind"] = fit_network(table, labels, rng)
    return deciders


def fit_rule(table: np.ndarray, labels: np.ndarray, depth: int = 2) -> Split | int:
    """Fit a decision tree, as `fit_network`, with the threshold of the least Gini impurity at each node."""
    counts = np.bincount(labels)
    if depth == 0 or (counts > 0).sum() < 2:
        return int(counts.argmax())
    best = (-1.0, 0, 0.0)  # purity, column, threshold
    is_label = np.eye(len(counts))[labels]
    sizes = np.arange(1, len(labels))[:, None]
    for column in range(table.shape[1]):
        order = np.argsort(table[:, column])
        values = table[order, column]
        below = np.cumsum(is_label[order], axis=0)[:-1]
        # The Gini impurity of both sides, weighted by size, is 1 - purity / len(labels).
        purity = (below**2 / sizes + (counts - below) ** 2 / (len(labels) - sizes)).sum(axis=1)
        purity[values[1:] == values[:-1]] = -1.0  # no threshold lies between equal values
        split = int(purity.argmax())
        best = max(best, (float(purity[split]), column, float(values[split])))
    if best[0] < 0:
        return int(counts.argmax())
    _, column, threshold = best
    is_low = table[:, column] <= threshold
    low, high = (fit_rule(table[rows], labels[rows], depth - 1) for rows in (is_low, ~is_low))
    return Split(column, threshold, low, high)


def decide(rule: Split | int, row: np.ndarray) -> int:
    """Apply a rule to a row of numbers, and return the number of its decision."""
    while isinstance(rule, Split):
        rule = rule.low if row[rule.column] <= rule.threshold else rule.high
    return rule
