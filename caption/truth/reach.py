"""Which actions of a set win their label: tried on motions that are made up, before anything is captioned."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from caption.schema import FutureMotion, LabelConfig
from caption.truth.actions import ActionTable, Motion, measure, table_of
from cosfly.products.actions import ActionSet

NUM_MOTIONS = 3000
STEPS, STEP_S = 5, 0.5
# Of the motions that imply an action: less is next to never. Of the set that ships the least is 6 % (track_straight).
LEAST_SHARE = 0.005


def never_labels(actions: ActionSet, cfg: LabelConfig, rng: np.random.Generator) -> list[str]:
    """Say of each action that a motion can imply, and that is next to never the label, what stands in its way; orders
    are left out."""
    motions = [measure(_made_up(rng)) for _ in range(NUM_MOTIONS)]
    implied, wins = Counter[str](), Counter[str]()
    taken: dict[str, Counter[str]] = defaultdict(Counter)
    table = table_of(actions, cfg)
    for motion in motions:
        label, found = table.label_of(motion), _implied(motion, table)
        wins[str(label)] += 1
        implied.update(found)
        if len(found) == 2 and label in found:  # but for this one it would have been the other
            taken[found[label == found[0]]][str(label)] += 1
    return [
        _told(token, implied[token], wins[token], taken[token])
        for token, action in actions.actions.items()
        if action.implied is not None and not action.is_order and wins[token] <= LEAST_SHARE * implied[token]
    ]


def _implied(motion: Motion, table: ActionTable) -> list[str]:
    return [token for line in table.implied for token, size in line if size(motion) >= 1.0]


def _told(token: str, num_implied: int, num_wins: int, taken: Counter[str]) -> str:
    if not num_implied:
        return f"{token}: none of {NUM_MOTIONS:,} made-up motions implies it; see its thresholds and conditions"
    others = ", ".join(token for token, _ in taken.most_common(3))
    others = (
        f", since others come first (above all {others}): put its line of precedence before theirs" if others else ""
    )
    return (
        f"{token}: {num_implied:,} of {NUM_MOTIONS:,} made-up motions imply it, and it is the label of "
        f"{num_wins:,}{others}"
    )


def _made_up(rng: np.random.Generator) -> FutureMotion:
    """Give a steady motion, of which each part is missing as often as not, and a person who walks along, elsewhere, or
    stands."""
    forward, left, up, turn_deg = rng.uniform((-3.0, -6.0, -4.0, -40.0), (8.0, 6.0, 4.0, 40.0)) * (rng.random(4) < 0.5)
    part = np.linspace(0.0, 1.0, STEPS + 1)[:, None]
    walked = ((forward, left), rng.uniform(-4.0, 4.0, 2), (0.0, 0.0))[rng.integers(3)]
    positions_m = part * [forward, left, up] + [0.0, 0.0, 20.0]
    speed_mps = float(np.linalg.norm([forward, left, up])) / (STEPS * STEP_S)
    is_seen = rng.random() < 0.9
    return FutureMotion(
        indices=tuple(range(1, STEPS + 1)),
        time_s=np.arange(STEPS + 1) * STEP_S,
        positions_m=positions_m,
        yaw_deg=part[:, 0] * turn_deg,
        targets_m=part * [*walked, 0.0] + [rng.uniform(5.0, 30.0), 0.0, 0.9],
        visible=np.full(STEPS + 1, is_seen),
        speed_before_mps=speed_mps if rng.random() < 0.5 else float(rng.uniform(0.0, 4.0)),
    )
