"""A posed figure as drawable parts: what a renderer needs to know of the person, and nothing of how one walks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Body:
    """One person in one moment, k parts and b bones.

    records: (k,) parts.PART without centers; mesh: (k,); centers_m: (k, 3) world; bones_m: (b, 2, 3) world, the ends of the
    capsules that cast the shadow; bone_radii_m: (b,); center_m: (3,) the hip point.
    """

    records: np.ndarray
    mesh: np.ndarray
    centers_m: np.ndarray
    bones_m: np.ndarray
    bone_radii_m: np.ndarray
    center_m: np.ndarray
