"""Whether a flight can be drawn at all: nobody stands below the ground or looks out of a wall."""

from __future__ import annotations

import numpy as np

from cosfly.errors import RenderError
from cosfly.products.traces import DroneTrace
from cosfly.products.walks import TARGET_HEIGHT_M
from cosfly.render.perturbation import STEP_UP_M, Surroundings
from cosfly.space.kernels import signed_distances

TOUCH_M = 0.01  # so deep in a box a camera still counts as touching it


def check_flight(trace: DroneTrace, surroundings: Surroundings) -> None:
    """Check that the camera is outside every obstacle and the person on or over the ground, in all frames of a plan.

    Raises:
        RenderError: names the flight and the first frame where that is not so, and how many there are.
    """
    depths_m, _ = signed_distances(surroundings.obstacles, trace.positions_m, 0.0)
    inside = np.flatnonzero(depths_m < -TOUCH_M)
    if len(inside):
        i = int(inside[0])
        raise RenderError(
            "a camera inside a box", where=f"{trace.path_id}: frame {i}",
            got=f"{-depths_m[i]:.2f} m deep; {len(inside)} of {len(depths_m)} frames",
            expected="a camera in the open", fix="plan the flight again on this map",
        )  # fmt: skip
    feet_m = trace.targets_m - [0.0, 0.0, TARGET_HEIGHT_M]
    below_m = np.array([surroundings.below_ground_m(place) for place in feet_m])
    if (below_m > STEP_UP_M).any():
        i = int(np.argmax(below_m > STEP_UP_M))
        raise RenderError(
            "a target under ground", where=f"{trace.path_id}: frame {i}",
            got=f"feet {below_m[i]:.2f} m below; {int((below_m > STEP_UP_M).sum())} of {len(below_m)} frames",
            expected="somebody who stands on the ground", fix="walk the path again on this map",
        )  # fmt: skip
