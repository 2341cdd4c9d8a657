"""The list of upright boxes that every map source fills, and that becomes a BoxMap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosfly.formats.boxes import BoxMap, MapHeader, make_box_map
from cosfly.formats.kinds import KINDS

Pair = Sequence[float] | np.ndarray  # x and y


class BoxList:
    """A growing list of upright boxes in world metres, with ids from 1 in the order of adding."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []  # center 3, half extent 3, yaw_deg
        self._kinds: list[int] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, kind: str, center_xy: Pair, size_xy: Pair, low_m: float, high_m: float, yaw_deg: float = 0.0) -> None:
        """Add a box by its footprint (full sizes before turning, m) and its height interval."""
        if size_xy[0] <= 0 or size_xy[1] <= 0 or high_m <= low_m:
            raise ValueError(f"the box is empty: {kind}, {size_xy}, {low_m} to {high_m} m")
        center = (float(center_xy[0]), float(center_xy[1]), (low_m + high_m) / 2)
        self._rows.append((*center, size_xy[0] / 2, size_xy[1] / 2, (high_m - low_m) / 2, float(yaw_deg)))
        self._kinds.append(KINDS[kind])

    def add_span(self, kind: str, low_xy: Pair, high_xy: Pair, low_m: float, high_m: float) -> None:
        """Add an unturned box by the corners of its footprint."""
        center = ((low_xy[0] + high_xy[0]) / 2, (low_xy[1] + high_xy[1]) / 2)
        self.add(kind, center, (high_xy[0] - low_xy[0], high_xy[1] - low_xy[1]), low_m, high_m)

    def box_map(self, header: MapHeader | None = None) -> BoxMap:
        """Return the map of everything added so far."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 7)
        rotations_deg = np.zeros((len(rows), 3))
        rotations_deg[:, 1] = rows[:, 6]
        return make_box_map(rows[:, :3], rows[:, 3:6], rotations_deg, self._kinds, header=header)
