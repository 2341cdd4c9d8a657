"""The thresholds of the inspection, with their reasons."""

from typing import Annotated

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

POSE_TOLERANCE_M = 1e-3  # distance allowed between a track's pose and its plan
ROTATION_TOLERANCE_DEG = 0.01
YAW_RATE_TOLERANCE_DEGPS = 0.1  # of a plan above its limit, because files round angles
REPROJECTION_TOLERANCE_PX = 0.5  # distance allowed between the recorded and the projected target
DRONE_SPEED_MAX_MPS = 25.0  # a faster step between two frames is a teleport
TARGET_SPEED_MAX_MPS = 10.0
# Beyond these values a track goes to review.
TRACK_QUALITY_MIN = 0.25  # mean IoU of projected box and mask
INVALID_DEPTH_MAX = 0.01  # share of invalid depth pixels in a frame
FLAT_SURFACE_MAX = 0.01  # share of a picture of a surface of one colour (a missing texture); rendered ones have grain
MAGENTA_MAX = 1e-3  # share of a picture in the magenta of missing textures; renders have none
Z_FIGHTING_MAX = 1e-3  # share of pixels that alternate between surfaces of a plane; renders of three maps: 1.2e-4
JUMP_GONE_MAX = 0.02  # share of static surface that is missing in the next or previous frame; renders have 0

MASK_VISIBILITY_MIN = 0.5  # a frame at least this visible must show pedestrian pixels at the target's box
FLAT_PAIRS_MIN = 0.99  # share of equal neighbours in a surface of one colour; renders of three maps have at most 0.95
THUMBNAIL_PX = 240  # width of the pictures in report.html


class InspectConfig(Config):
    """Thresholds of the inspection. An error rejects a track, a warning sends it to review."""

    flights: TrackChoice = Field(TrackChoice(), description="tracks to inspect")
    accel_rms_max_mps2: float = Field(
        ACCEL_RMS_MAX_MPS2, gt=0, description="largest accepted RMS acceleration of a plan, m/s^2"
    )
    jerk_rms_max_mps3: float = Field(JERK_RMS_MAX_MPS3, gt=0, description="largest accepted RMS jerk of a plan, m/s^3")
    smoothness_min: Share = Field(0.5, description="smallest smoothness score S that needs no review; 0: no limit")
    five_ray_mean_min: Share = Field(
        FIVE_RAY_MEAN_MIN, description="smallest accepted mean five-ray visibility of the poses; 0: no limit"
    )
    clearance_min_m: float = Field(
        RELAXED_SAFETY_M,
        ge=0,
        description="smallest accepted distance of the drone to obstacles, m; 0: anywhere outside obstacles",
    )
    legible_min: Share = Field(
        0.2, description="smallest accepted share of frames in which the target can be recognized; 0: no limit"
    )
    check_checksums: bool = Field(True, description="read every file and compare it with checksums.sha256")
