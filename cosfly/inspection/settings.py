"""The thresholds of the inspection, each with why it is where it is."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from cosfly.formats.places import TrackChoice
from cosfly.geometry.trajectory_metrics import (
    ACCEL_RMS_MAX_MPS2,
    FIVE_RAY_MEAN_MIN,
    JERK_RMS_MAX_MPS3,
    RELAXED_SAFETY_M,
)
from cosfly.runtime.config import Config

Share = Annotated[float, Field(ge=0, le=1)]


POSE_TOLERANCE_M = 1e-3  # distance allowed between a flight's pose and its plan, m
ROTATION_TOLERANCE_DEG = 0.01  # turn allowed between a flight's pose and its plan
REPROJECTION_TOLERANCE_PX = 0.5  # distance allowed between the recorded and the projected target, px
DRONE_SPEED_MAX_MPS = 25.0  # a faster step between two frames is a teleport, m/s
TARGET_SPEED_MAX_MPS = 10.0  # the same for the person, m/s
TRACK_QUALITY_MIN = 0.25  # mean IoU of projected box and mask below this goes to review
MASK_VISIBILITY_MIN = 0.5  # a frame at least this visible must show pedestrian pixels at the target's box
INVALID_DEPTH_MAX = 0.01  # share of invalid depth pixels above this in any frame goes to review
# a surface of one colour that fills more of a picture goes to review (a missing texture); drawn ones have grain,
# rounding and light
FLAT_SURFACE_MAX = 0.01
# a surface is of one colour where so many of its neighbouring pixels are equal; renders of three maps have at most
# 0.95
FLAT_PAIRS_MIN = 0.99
# share of a picture in the magenta that engines paint for a missing texture; more goes to review; renders have none
MAGENTA_MAX = 1e-3
# share of pixels that alternate every 3 px or less between two surfaces in one plane, of other kinds or colours; more
# goes to review; renders of three maps have at most 1.2e-4
Z_FIGHTING_MAX = 1e-3
# share of what stood still in this frame or the one before and is looked through in the other; more goes to review;
# renders have 0
JUMP_GONE_MAX = 0.02
THUMBNAIL_PX = 240  # width of the pictures in report.html, px
# size of report.html beyond which flights are listed without pictures, map and plots, accepted
# ones first, MB; a flight takes 0.06
PAGE_MB = 25.0


class InspectConfig(Config):
    """Thresholds of the inspection. An error rejects a flight, a warning routes it to manual review."""

    flights: TrackChoice = Field(TrackChoice(), description="which flights of the tree")
    accel_rms_max_mps2: float = Field(
        ACCEL_RMS_MAX_MPS2, gt=0, description="planned RMS acceleration above this rejects, m/s^2"
    )
    jerk_rms_max_mps3: float = Field(JERK_RMS_MAX_MPS3, gt=0, description="planned RMS jerk above this rejects, m/s^3")
    smoothness_min: Share = Field(0.5, description="smoothness score S below this goes to review; 0 turns the rule off")
    five_ray_mean_min: Share = Field(
        FIVE_RAY_MEAN_MIN,
        description="mean five-ray visibility of the flight's poses below this rejects; 0 turns the rule off",
    )
    clearance_min_m: float = Field(
        RELAXED_SAFETY_M, ge=0, description="a drone nearer than this to an obstacle rejects, m; 0: only one inside"
    )
    check_pixels: Literal["all", "sample", "none"] = Field(
        "all",
        description="decode every frame, an even sample, or none (then only names, headers and poses are checked)",
    )
    pixel_sample: ClassVar[int] = 16  # frames per flight that check_pixels: sample decodes
    check_checksums: bool = Field(True, description="read every file and compare it with checksums.sha256")
