"""What a flight would have been without its perturbation: the motion that labels come from.

Offsets that are drawn anew for every frame are no manoeuvre, so a label made of them is noise. The clean motion of a perturbed
flight is that of its twin (`ORI`); without one, what was recorded is taken off: the shifts of drone and person, the turn of the
view, and the aim that followed the shifts (cosfly/render/perturbation.py). Visibility is no part of it: what was seen was seen
from where the camera really was.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cosfly.geometry import look_at
from cosfly.products.captions import LabelFrom
from cosfly.products.playback import Flight


@dataclass(frozen=True)
class LabelMotion:
    """Poses of n frames and where they come from. positions_m, targets_m (n, 3); yaw_deg (n,). NaN where not known."""

    label_from: LabelFrom
    positions_m: np.ndarray
    yaw_deg: np.ndarray
    targets_m: np.ndarray

    @cached_property
    def is_known(self) -> list[bool]:
        """Tell of each frame whether its pose is known; a list, as each window asks for a few."""
        return (~(np.isnan(self.positions_m).any(axis=1) | np.isnan(self.yaw_deg))).tolist()


def as_flown(flight: Flight, label_from: LabelFrom) -> LabelMotion:
    """Give the motion of a flight as it was flown, perturbation and all."""
    return LabelMotion(label_from, flight.positions_m, flight.rotations_deg[:, 1], flight.targets_m)


def label_motion(flight: Flight, twin: Flight | None = None) -> LabelMotion:
    """Give a flight's motion without perturbation, in the best way there is.

    Args:
        twin: the clean flight of the same frames (`read_twin`), None where there is none.
    Returns:
        Rows are NaN where a frame was perturbed and nobody recorded by how much.
    """
    if flight.is_original:
        return as_flown(flight, "flight")
    if twin is not None:
        return as_flown(twin, "twin")
    positions_m = flight.positions_m - flight.drone_offsets_m
    targets_m = flight.targets_m - flight.target_offsets_m
    # A frame without a shift was not aimed anew, whether or not its target is known. An unknown shift (NaN) counts as one.
    is_shifted = (flight.drone_offsets_m != 0).any(axis=1) | (flight.target_offsets_m != 0).any(axis=1)
    aimed_deg = np.degrees(look_at(flight.positions_m, flight.targets_m)[1] - look_at(positions_m, targets_m)[1])
    yaw_deg = flight.rotations_deg[:, 1] - flight.rotation_offsets_deg[:, 1] - np.where(is_shifted, aimed_deg, 0.0)
    return LabelMotion("offsets", positions_m, yaw_deg, targets_m)
