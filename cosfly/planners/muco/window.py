"""What the five rays see from a waypoint and its neighbours half a metre away: the difference window of MuCO's visibility term."""

from __future__ import annotations

import numpy as np

from cosfly.space.kernels import HALF_X, RAY_OFFSETS_M, clip, in_box_frame
from cosfly.work.compiled import njit


@njit(cache=True)
def window_rays(rows, boxes, num_boxes, x, y, z, step_m, tx, ty, tz, free):
    """Put `free_rays` of a point and of its six neighbours at +-step_m into `free`, (7,): middle, -x, +x, -y, +y, -z, +z.

    From (x, y, z) to (tx, ty, tz): the same tests as seven calls of `free_rays`, but each box sees each of the twelve ends of the rays once.
    """
    blocked = np.zeros((7, 5), dtype=np.bool_)
    ends, feet = np.empty((7, 3)), np.empty((5, 3))
    for k in range(num_boxes):
        box = boxes[k]
        for place in range(7):
            shift, axis = step_m * (2 * (place % 2 == 0) - 1), (place - 1) // 2
            ends[place, 0], ends[place, 1], ends[place, 2] = in_box_frame(
                rows,
                box,
                x + (shift if place > 0 and axis == 0 else 0.0),
                y + (shift if place > 0 and axis == 1 else 0.0),
                z + (shift if place > 0 and axis == 2 else 0.0),
            )
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
                    foot = feet[ray, axis]
                    enter, leave = clip(foot, ends[place, axis] - foot, rows[box, HALF_X + axis], enter, leave)
                    if enter > leave:
                        break
                blocked[place, ray] = enter <= leave
    for place in range(7):
        free[place] = 1.0 - blocked[place].sum() / 5.0
