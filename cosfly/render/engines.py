"""What renderers share that ask a running engine: a frame is asked for again, and an engine has one kind of lens."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from cosfly.formats.frames import Camera
from cosfly.geometry.axes import focal_px
from cosfly.render.contract import Frame
from cosfly.runtime.errors import EnvironmentMissing, RenderError

log = logging.getLogger(__name__)

WALK_MPS = 1.4  # of a person whose swing is full


class NoPictureError(Exception):
    """A camera did not send a picture."""


def keep_asking(draw: Callable[[], Frame], mend: Callable[[Exception], None], retries: int, device: str) -> Frame:
    """Draw a frame, again after `mend` where that fails."""
    problem: Exception | None = None
    for attempt in range(retries + 1):
        try:
            if problem is not None:
                mend(problem)
            return draw()
        except (NoPictureError, RuntimeError, EnvironmentMissing) as error:
            problem = error
            log.warning("%s: a frame failed (%d of %d): %s", device, attempt + 1, retries + 1, error)
    if isinstance(problem, EnvironmentMissing):
        raise problem
    fix = "see the server's log, then run the same command again: finished flights are kept"
    if isinstance(problem, NoPictureError):
        raise RenderError("a camera sends no picture", where=device, got=str(problem), fix=fix)
    raise EnvironmentMissing("the server does not answer any more", where=device, got=str(problem), fix=fix)


def fov_of(intrinsic: np.ndarray, size_px: tuple[int, int], device: str) -> float:
    """Return the horizontal field of view, degrees, which is all that an engine is told of a lens."""
    width, height = size_px
    fov_deg = round(Camera(width, height, intrinsic).fov_deg, 6)
    f = focal_px(width, fov_deg)
    if not np.allclose(intrinsic, [[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]], atol=1e-3):
        what, expected = "the engine has no such lens", "square pixels and the principal point in the middle"
        raise RenderError(what, where=device, got=str(intrinsic.tolist()), expected=expected)
    return fov_deg
