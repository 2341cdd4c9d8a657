"""Pictures of frames on a page of limited size."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from cosfly.runtime.errors import InputError
from cosfly.viz.frame_views import View, small_jpeg

JPEG_QUALITY = 72


class PagePictures:
    """The encoder of a page's pictures: if not all fit, every n-th frame has some; `skipped` and `unreadable` count."""

    def __init__(self, room_bytes: float, num_frames: int, width_px: int) -> None:
        self.room, self.width_px = room_bytes, width_px
        self.num_frames, self.asked, self.every = max(1, num_frames), 0, 1
        self.skipped = self.unreadable = 0

    def of_frame(self, views: Mapping[View, Callable[[], np.ndarray]]) -> dict[View, str]:
        """Return a frame's pictures, JPEG in base64; an empty table if there is no room for them.

        Args:
            views: Readers of views as (h, w, 3) uint8 RGB; a damaged view is skipped.
        """
        number, self.asked = self.asked, self.asked + 1
        if number % self.every:
            self.skipped += 1
            return {}
        pictures: dict[View, str] = {}
        is_damaged = False
        for view, read in views.items():
            try:
                pictures[view] = small_jpeg(
                    read(), self.width_px if view == "rgb" else self.width_px // 2, JPEG_QUALITY
                )
            except InputError:
                is_damaged = True
        self.unreadable += is_damaged
        size = sum(map(len, pictures.values()))
        if number == 0 and size * self.num_frames > self.room:
            self.every = min(self.num_frames, -(-size * self.num_frames // max(1, int(self.room))))
        if size > self.room:
            self.skipped += 1
            return {}
        self.room -= size
        return pictures

    def notes(self) -> list[str]:
        """Return notes on frames without pictures."""
        notes = []
        if self.skipped:
            notes.append(f"{self.skipped:,} of {self.asked:,} shown frames have no pictures, to limit the page's size")
        if self.unreadable:
            notes.append(f"of {self.unreadable:,} frames a picture cannot be read")
        return notes
