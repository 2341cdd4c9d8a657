"""Draw the styles of flights from above and from the side: how docs/images/style-*.png were made.

python docs/style_pictures.py docs/images
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from cosfly import plan
from cosfly.formats.boxes import MapHeader, make_box_map
from cosfly.formats.kinds import KINDS
from cosfly.planners.styles import NAMES, suits

WAY_M = [(0.5 * k, 0.0) for k in range(-80, 101)]  # a walker may stop at each
HOUSES = [((5.0, 12.0, 14.0), (16.0, 6.0, 14.0)), ((5.0, -12.0, 14.0), (16.0, 6.0, 14.0))]  # which hide the walker
WIDTH_PX, TOP_PX, SIDE_PX, PX_PER_M = 480, 190, 165, 2.6
WALKER, DRONE, SIGHT, GROUND, HOUSE = (60, 60, 220), (190, 90, 20), (205, 190, 175), (150, 150, 150), (225, 225, 225)


def flight_of(style):
    """A flight along a straight way, on open ground or, where a person is to be lost, between two houses; with stops
    where the style is for them."""
    centers, halves = zip(*(HOUSES if style == "reacquire" else [((400.0, 400.0, 2.0), (1.0, 1.0, 2.0))]), strict=True)
    kinds, header = [KINDS["Buildings"]] * len(centers), MapHeader(name="styles", ground_z_m=0.0)
    box_map = make_box_map(centers, halves, [(0.0, 0.0, 0.0)] * len(centers), kinds, header=header)
    walk = {"pace": {"fits_and_starts": 1}, "hurry_speed_mps": 2.4} if suits(style) == "uneven" else {}
    return next(
        trace
        for seed in range(40)
        if (trace := plan(box_map, WAY_M, seed=seed, walk=walk, planner="muco", styles={style: 1})).drop_reason is None
    )


def draw(style):
    """From above, the walker going to the right; below it from the side."""
    trace, picture = flight_of(style), np.full((TOP_PX + SIDE_PX, WIDTH_PX, 3), 255, np.uint8)

    def above(points):
        return np.column_stack([WIDTH_PX / 2 + PX_PER_M * points[:, 0], TOP_PX / 2 - PX_PER_M * points[:, 1]])

    def aside(points):
        return np.column_stack(
            [WIDTH_PX / 2 + PX_PER_M * points[:, 0], TOP_PX + SIDE_PX - 12 - PX_PER_M * points[:, 2]]
        )

    for (x, y, _), (half_x, half_y, _) in HOUSES if style == "reacquire" else []:
        corners = above(np.array([[x - half_x, y - half_y], [x + half_x, y + half_y]])).round().astype(int).tolist()
        cv2.rectangle(picture, corners[0], corners[1], HOUSE, -1)
    cv2.line(picture, (0, TOP_PX), (WIDTH_PX, TOP_PX), GROUND, 1)
    cv2.line(picture, (0, TOP_PX + SIDE_PX - 12), (WIDTH_PX, TOP_PX + SIDE_PX - 12), GROUND, 1)
    for view in (above, aside):
        drone, walker = view(trace.positions_m).round().astype(int), view(trace.targets_m).round().astype(int)
        for k in range(0, len(drone), 12):
            if trace.visibility[k] > 0:
                cv2.line(picture, drone[k].tolist(), walker[k].tolist(), SIGHT, 1, cv2.LINE_AA)
        for line, color in ((walker, WALKER), (drone, DRONE)):
            cv2.polylines(picture, [line], False, color, 2, cv2.LINE_AA)
            for k in range(0, len(line), 12):
                cv2.circle(picture, line[k].tolist(), 3, color, -1, cv2.LINE_AA)
            cv2.circle(picture, line[0].tolist(), 6, color, 1, cv2.LINE_AA)  # the beginning
    return picture


if __name__ == "__main__":
    for name in NAMES:
        cv2.imwrite(str(Path(sys.argv[1]) / f"style-{name}.png"), draw(name), [cv2.IMWRITE_PNG_COMPRESSION, 9])
