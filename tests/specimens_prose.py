"""Windows made by hand.

FOLLOW: a climbing, accelerating drone turns right after a walker who bends right and is partly covered at the end.
HOLD: a drone hovers over somebody who stood and is hidden in the last two frames.
"""

from __future__ import annotations

import dataclasses

from caption.truth.facts import Facts

FOLLOW = Facts(
    speed_mps=(None, 2.0, 2.4, 2.9, 3.4),
    altitude_m=(18.0, 18.3, 18.9, 19.6, 20.4),
    yaw_deg=(0.0, -2.0, -4.5, -7.0, -9.6),
    pitch_deg=(-40.0, -40.5, -41.2, -42.0, -42.9),
    distance_m=(21.5, 21.2, 20.8, 20.3, 19.7),
    slant_m=(27.5, 27.4, 27.5, 27.6, 27.7),
    target_speed_mps=1.45,
    target_turn_deg=-20.0,
    box_width_px=(20, 20, 21, 22, 23),
    box_height_px=(50, 51, 53, 55, 58),
    offset_x_px=(5, 12, 25, 38, 52),
    offset_y_px=(0, 2, -3, -8, -14),
    visibility=("visible", "visible", "visible", "partly_occluded", "partly_occluded"),
    width_px=640,
    height_px=360,
    heading_deg=(30.0, 28.0, 25.5, 23.0, 20.4),
    travelled_m=(0.0, 1.0, 2.2, 3.7, 5.4),
    displacement_m=(0.0, 1.0, 2.2, 3.6, 5.2),
    target_speeds_mps=(None, 1.5, 1.5, 1.4, 1.4),
    target_headings_deg=(None, 10.0, 4.0, -3.0, -10.0),
    target_travelled_m=(0.0, 0.8, 1.5, 2.2, 2.9),
    height_over_target_m=(17.1, 17.4, 18.0, 18.7, 19.5),
    bearing_deg=(-0.4, -1.0, -2.2, -3.4, -4.6),
    depression_deg=(38.5, 39.4, 40.9, 42.7, 44.7),
)
HOLD = Facts(
    speed_mps=(None, 0.3, 0.2, 0.1, 0.1),
    altitude_m=(25.0,) * 5,
    yaw_deg=(0.0, 0.1, 0.0, -0.1, 0.0),
    pitch_deg=(-58.0,) * 5,
    distance_m=(15.0, 15.0, 15.1, 15.1, 15.1),
    slant_m=(28.4, 28.4, 28.4, 28.4, 28.4),
    target_speed_mps=0.05,
    target_turn_deg=None,
    box_width_px=(18, 18, 18, None, None),
    box_height_px=(44, 44, 44, None, None),
    offset_x_px=(0, 0, 1, None, None),
    offset_y_px=(0, 1, 0, None, None),
    visibility=("visible", "visible", "visible", "occluded", "occluded"),
    width_px=640,
    height_px=360,
    heading_deg=(-90.0, -89.9, -90.0, -90.1, -90.0),
    travelled_m=(0.0, 0.2, 0.2, 0.3, 0.3),
    displacement_m=(0.0, 0.2, 0.2, 0.2, 0.3),
    target_speeds_mps=(None, 0.1, 0.0, 0.1, 0.0),
    target_headings_deg=(None,) * 5,
    target_travelled_m=(0.0, 0.0, 0.0, 0.1, 0.1),
    height_over_target_m=(24.1,) * 5,
    bearing_deg=(0.0,) * 5,
    depression_deg=(58.1,) * 5,
)

# Dives, brakes and turns left after somebody who runs, bends left and is hidden for one frame.
DIVE = dataclasses.replace(
    FOLLOW,
    speed_mps=(None, 6.1, 5.2, 4.0, 3.1),
    altitude_m=(30.0, 28.8, 27.4, 26.1, 25.0),
    yaw_deg=(0.0, 3.0, 7.5, 11.0, 13.2),
    pitch_deg=(-50.0, -49.0, -47.5, -46.0, -45.0),
    distance_m=(22.0, 22.6, 23.1, None, 24.2),
    slant_m=(36.5, 36.0, 35.1, None, 34.1),
    target_speed_mps=3.2,
    target_turn_deg=35.0,
    box_width_px=(14, 14, 15, None, 15),
    box_height_px=(33, 33, 34, None, 35),
    offset_x_px=(-40, -30, -22, None, -12),
    offset_y_px=(10, 9, 6, None, 4),
    visibility=("visible", "visible", "partly_occluded", "occluded", "visible"),
    heading_deg=(100.0, 103.0, 107.5, 111.0, 113.2),
    travelled_m=(0.0, 3.1, 5.7, 7.7, 9.2),
    displacement_m=(0.0, 3.1, 5.6, 7.5, 8.9),
    target_speeds_mps=(None, 3.0, 3.2, 3.3, 3.4),
    target_headings_deg=(None, 80.0, 92.0, 103.0, 115.0),
    target_travelled_m=(0.0, 1.5, 3.1, 4.8, 6.5),
    height_over_target_m=(29.1, 27.9, 26.5, None, 24.1),
    bearing_deg=(3.5, 2.6, 1.9, None, 1.1),
    depression_deg=(52.9, 51.0, 48.9, None, 44.9),
)
# Circles to the right round somebody who hardly moves, first hidden, then seen.
ORBIT = dataclasses.replace(
    FOLLOW,
    speed_mps=(None, 4.2, 4.3, 4.2, 4.4),
    altitude_m=(12.0, 12.0, 12.1, 12.0, 12.0),
    yaw_deg=(0.0, 9.0, 18.4, 27.0, 36.2),
    pitch_deg=(-30.0, -30.1, -29.9, -30.0, -30.0),
    distance_m=(18.0, 18.1, 18.0, 17.9, 18.0),
    slant_m=(21.2, 21.3, 21.3, 21.1, 21.2),
    target_speed_mps=0.4,
    target_turn_deg=5.0,
    box_width_px=(40, 38, 35, 32, 30),
    box_height_px=(90, 90, 91, 90, 90),
    offset_x_px=(-3, 2, 0, -2, 1),
    offset_y_px=(0, 1, 0, 0, -1),
    visibility=("occluded", "partly_occluded", "visible", "visible", "visible"),
    width_px=1920,
    height_px=1080,
    heading_deg=(-170.0, -161.0, -151.6, -143.0, -133.8),
    travelled_m=(0.0, 2.1, 4.3, 6.4, 8.6),
    displacement_m=(0.0, 2.1, 4.2, 6.2, 8.2),
    target_speeds_mps=(None, 0.5, 0.4, 0.4, 0.3),
    target_headings_deg=(None, 60.0, 62.0, 63.0, 65.0),
    target_travelled_m=(0.0, 0.3, 0.5, 0.7, 0.8),
    height_over_target_m=(11.1, 11.1, 11.2, 11.1, 11.1),
    bearing_deg=(0.1, -0.1, 0.0, 0.1, 0.0),
    depression_deg=(31.7, 31.5, 31.9, 31.8, 31.7),
)
WINDOWS = {"follow": FOLLOW, "hold": HOLD, "dive": DIVE, "orbit": ORBIT}
