"""What can be told of a decision without a picture: the past's geometry as numbers, a network and a rule that decide by
them, and whether something that the decision may hang on was drawn only after that past."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from cosfly.formats.playback import Track
from cosfly.geometry.axes import wrap_deg
from cosfly.geometry.motion import in_axes_of

LOOKS_BACK = 3  # frames: of fewer nothing turns, of five it tells no more
FITTED_ON, LEAST_WINDOWS = 20_000, 100  # windows that a network is fitted on: at most, and at least
HIDDEN, ROUNDS, PENALTY = 32, 120, 1e-3  # of the network
STANDS_MPS, TURNS_DEG = 0.2, 45.0  # a walker who is slower stands; who turns by more turns
DRAWN_AHEAD = (
    f"another part of the flight begins, or the walker stops, sets off or turns by more than {TURNS_DEG:g} degrees"
)
Decider = Callable[[np.ndarray], np.ndarray]  # pasts (n, d) -> numbers of decisions (n,)
# A decision's number, or column, threshold, and the rules up to it and above.
Rule = int | tuple[int, float, "Rule", "Rule"]


def past_of(flight: Track, window: Sequence[int], is_ordered: bool) -> np.ndarray:
    """Return what the last LOOKS_BACK frames of a window tell, (d,), wherever and whenever they were: no place, no
    time.

    Exact, and without perturbation where that is known; 0 where something is not. In the level axes of the drone at the
    last frame: velocities and speeds of drone and walker, yaw and pitch, where the walker is and how far; from where it
    is seen, whether it is visible, and whether an order of the mission stands. m, s, degrees; bearings in radians.
    """
    at = [window[0]] * (LOOKS_BACK - len(window)) + list(window[-LOOKS_BACK:])
    planned, walked_m = flight.planned[0][at], flight.walked_m[at]
    poses = np.where(np.isnan(planned), np.hstack([flight.positions_m[at], flight.rotations_deg[at]]), planned)
    targets_m = np.where(np.isnan(walked_m), flight.targets_m[at], walked_m)
    yaw_deg, step_s = float(poses[-1, 4]), np.diff(flight.time_s[at])[:, None]
    step_s[step_s == 0] = np.nan  # a repeated frame
    drone, walker = (in_axes_of(yaw_deg, places_m - poses[-1, :3]) for places_m in (poses[:, :3], targets_m))
    flown, walked, away = np.diff(drone, axis=0) / step_s, np.diff(walker, axis=0) / step_s, walker - drone
    apart_m, speeds = np.hypot(away[:, 0], away[:, 1]), np.linalg.norm(walked, axis=1)
    bearing = np.arctan2(away[-1, 1], away[-1, 0])
    seen_from, moves = bearing - np.arctan2(walked[-1, 1], walked[-1, 0]), speeds[-1] > STANDS_MPS
    turned_deg = np.asarray(wrap_deg(poses[:-1, 4] - yaw_deg))
    last = [bearing, moves * np.cos(seen_from), moves * np.sin(seen_from), is_ordered]
    parts = [flown, np.linalg.norm(flown, axis=1), walked, speeds, away[-1], apart_m, np.diff(apart_m), turned_deg]
    parts += [poses[:, 3], flight.target.visible[at], np.array(last, dtype=float)]
    return np.nan_to_num(np.concatenate([part.ravel() for part in parts]))


def is_drawn_ahead(flight: Track, now: int, last: int, is_ordered: bool) -> bool | None:
    """Return whether DRAWN_AHEAD holds after frame `now`, within the frames up to `last` of which a label is made.

    What is drawn within a part (when a drone that hops does) is on no record and not counted. Where an order stands
    nothing is drawn; None where the walker's way is not known.
    """
    span = slice(max(0, now - 1), last + 1)
    steps_m, steps_s = np.diff(flight.walked_m[span, :2], axis=0), np.diff(flight.time_s[span])
    if is_ordered:
        return False
    if now < 1 or not np.isfinite(steps_m).all():
        return None
    moves = np.hypot(*steps_m.T) > STANDS_MPS * steps_s
    headings_deg = np.degrees(np.arctan2(steps_m[:, 1], steps_m[:, 0]))
    turns = moves & moves[0] & (np.abs(wrap_deg(headings_deg - float(headings_deg[0]))) > TURNS_DEG)
    begins = any(now < part.begin <= last for part in flight.segments)
    return bool(begins or (moves != moves[0]).any() or turns.any())


def fit_network(table: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> Decider:
    """Fit a network of one hidden layer by cross entropy with a small penalty on its weights, by L-BFGS (Liu and
    Nocedal 1989). table: (n, d). labels: (n,) numbers of decisions, which count as often as they occur."""
    from scipy.optimize import minimize
    from scipy.special import logsumexp

    center, spread, num = table.mean(axis=0), table.std(axis=0), int(labels.max()) + 1
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
        off = (np.exp(logs) - wanted) / len(inputs)
        back = off @ second.T * (1.0 - hidden**2)
        slopes = [inputs.T @ back, back.sum(axis=0), hidden.T @ off, off.sum(axis=0)]
        slope = np.concatenate([part.ravel() for part in slopes]) + PENALTY * flat
        return float(-(logs * wanted).sum() / len(inputs) + PENALTY / 2 * flat @ flat), slope

    def scaled(rows: np.ndarray) -> np.ndarray:
        return np.clip((rows - center) / spread, -5.0, 5.0)

    inputs, wanted = scaled(table), np.eye(num)[labels]
    begin = np.concatenate([(rng.normal(size=s) / math.sqrt(s[0]) * (len(s) == 2)).ravel() for s in sizes])
    weights = minimize(cost, begin, jac=True, method="L-BFGS-B", options={"maxiter": ROUNDS}).x
    return lambda rows: layers(weights, scaled(rows))[1].argmax(axis=1)


def fit_deciders(table: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> dict[str, Decider]:
    """Fit what decides by pasts: `rule`, and `blind` where there are LEAST_WINDOWS."""
    rule = fit_rule(table, labels)
    found: dict[str, Decider] = {"rule": lambda rows: np.array([decide(rule, row) for row in rows])}
    return found | ({"blind": fit_network(table, labels, rng)} if len(table) >= LEAST_WINDOWS else {})


def fit_rule(table: np.ndarray, labels: np.ndarray, depth: int = 2) -> Rule:
    """Fit a decision tree: at each node the threshold of the least Gini impurity; labels (n,): numbers of decisions."""
    counts, best = np.bincount(labels), (-1.0, 0, 0.0)
    if depth == 0 or (counts > 0).sum() < 2:
        return int(counts.argmax())
    is_label, sizes = np.eye(len(counts))[labels], np.arange(1, len(labels))[:, None]
    for column in range(table.shape[1]):
        order = np.argsort(table[:, column])
        values, below = table[order, column], np.cumsum(is_label[order], axis=0)[:-1]
        purity = (below**2 / sizes + (counts - below) ** 2 / (len(labels) - sizes)).sum(axis=1)
        purity[values[1:] == values[:-1]] = -1.0  # no threshold lies between equals
        place = int(purity.argmax())
        best = max(best, (float(purity[place]), column, float(values[place])))
    if best[0] < 0:
        return int(counts.argmax())
    _, column, threshold = best
    low = table[:, column] <= threshold
    below_it, above_it = (fit_rule(table[rows], labels[rows], depth - 1) for rows in (low, ~low))
    return column, threshold, below_it, above_it


def decide(rule: Rule, row: np.ndarray) -> int:
    """Return the number of the decision that a rule makes of a row of numbers."""
    while isinstance(rule, tuple):
        column, threshold, low, high = rule
        rule = low if row[column] <= threshold else high
    return rule
