"""Pictures of frames, small and in base64, as many as the page has room for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cosfly.errors import InputError
from cosfly.look.frame_views import View, small_jpeg
from release.viewer.schema import ViewerConfig

MB = 1024 * 1024
FRAME_BYTES, FLIGHT_BYTES = 7_000, 14_000  # what a frame takes without pictures, and a flight with its paths


class Pictures:
    """Encodes pictures until the page is full, then every frame goes without; `left_out` and `unreadable` count frames."""

    def __init__(self, cfg: ViewerConfig, num_flights: int, num_frames: int) -> None:
        self.cfg = cfg
        self.left = cfg.max_mb * MB - FRAME_BYTES * num_frames - FLIGHT_BYTES * num_flights
        self.num_frames, self.asked, self.every = max(1, num_frames), 0, 1
        self.left_out = self.unreadable = 0

    def of_frame(self, views: Mapping[View, Callable[[], np.ndarray]]) -> dict[View, str]:
        """Give a frame's pictures; none where there is no room for them.

        Args:
            views: what reads each view as (h, w, 3) uint8 RGB; a view that cannot be read is left out.
        """
        number, self.asked = self.asked, self.asked + 1
        if number % self.every:
            self.left_out += 1
            return {}
        pictures: dict[View, str] = {}
        is_damaged = False
        for view, read in views.items():
            try:
                width_px = self.cfg.picture_px if view == "rgb" else self.cfg.picture_px // 2
                pictures[view] = small_jpeg(read(), width_px, self.cfg.jpeg_quality)
            except InputError:
                is_damaged = True
        self.unreadable += is_damaged
        size = sum(map(len, pictures.values()))
        if number == 0 and size * self.num_frames > self.left:  # then every so many frames have pictures, everywhere
            self.every = min(self.num_frames, -(-size * self.num_frames // max(1, self.left)))
        if size > self.left:
            self.left_out += 1
            return {}
        self.left -= size
        return pictures

    def notes(self) -> list[str]:
        """Say what the page lacks."""
        notes = []
        if self.left_out:
            notes.append(
                f"{self.left_out:,} of {self.asked:,} shown frames have no pictures, to keep the page below {self.cfg.max_mb} MB"
            )
        if self.unreadable:
            notes.append(f"of {self.unreadable:,} frames a picture cannot be read")
        return notes


def box_of(corners_px: Sequence[float], width_px: int, height_px: int) -> tuple[float, float, float, float] | None:
    """Give a box, xmin, ymin, xmax, ymax px, as shares of the picture; None where it is not known."""
    xmin, ymin, xmax, ymax = (
        round(float(v) / max(1, size), 4) for v, size in zip(corners_px, (width_px, height_px) * 2, strict=True)
    )
    return None if not np.isfinite((xmin, ymin, xmax, ymax)).all() else (xmin, ymin, xmax, ymax)
