"""What the perturbed track draws for each frame: who knows the seed and the settings can draw it again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from cosfly.runtime.seeding import rng_for

PERTURBED = "aug_001"  # the variant of the perturbed track


@dataclass(frozen=True)
class ShiftDraw:
    """One frame's draws. events: (2,) of position and rotation, below their probability; person_m, drone_m, view_m:
    (3,); roll: share of the largest, -1 to 1."""

    events: np.ndarray
    person_m: np.ndarray
    drone_m: np.ndarray
    view_m: np.ndarray
    roll: float


def shift_draws(
    rng: np.random.Generator, *, person_radius_m: float, drone_radius_m: float, view_radius_m: float, is_cubic: bool
) -> Iterator[ShiftDraw]:
    """Yield the draws of one frame after the other, without end; each takes the same number of the generator's."""
    of_roll = rng.spawn(1)[0]  # the paper's track has none, and draws the same with and without
    for _ in repeat(None):
        yield ShiftDraw(
            rng.random(2),
            _offset(rng, person_radius_m, 2, is_cubic),
            _offset(rng, drone_radius_m, 3, is_cubic),
            _offset(rng, view_radius_m, 3, is_cubic),
            of_roll.uniform(-1.0, 1.0),
        )


def rng_of_shifts(seed: int, path_id: str) -> np.random.Generator:
    """Return the generator of the perturbed flight of a walk."""
    return rng_for(seed, "render", f"{path_id}/{PERTURBED}")


def _offset(rng: np.random.Generator, radius_m: float, num_axes: int, is_cubic: bool) -> np.ndarray:
    """Return an offset evenly distributed in a cube or a ball, (3,); z is 0 for two axes."""
    in_cube = radius_m * rng.uniform(-1.0, 1.0, num_axes)
    direction, share = rng.normal(size=num_axes), rng.random()
    in_ball = radius_m * direction / np.linalg.norm(direction) * share ** (1.0 / num_axes)
    return np.append(in_cube if is_cubic else in_ball, np.zeros(3 - num_axes))
