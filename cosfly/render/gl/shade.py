"""Where those who move may darken a picture: the person's and the others' shadows, as rectangles of pixels.

Every pixel of a program that knows of shadows of movers pays for its loops, a third of a frame on a CPU, though they
darken a hundredth of it. So the scene is drawn without them, and these rectangles once more with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.geometry.axes import box_corners
from cosfly.render.gl.view import CameraView

PERSON_REACH_M = 30.0**0.5  # the shader follows the person's shadow so far from the hip
SHORTEST_CAR_M, HEADLIGHT_M, HEADLIGHT_ASIDE_M = 0.5, 26.0, 9.0  # as the shader has them: who is shorter walks
EDGE = 1.25  # radii of a capsule where its shadow ends
SKY_RADII, PERSON_SKY_M = 4.5, 1.0  # how far aside a capsule, in its radii, and the person take light of the sky
BELOW_M, LONGEST_M = 1.5, 60.0  # a shadow is followed down to here under the feet, and no farther than this


@dataclass(frozen=True, eq=False)
class Shade:
    """One rectangle, low and high corner in px, and what may darken it.

    rectangle_px: x0, y0, x1, y1; points: (k, 3) relative to the scene's origin, whose hull holds all that is darkened;
    capsules: (c, 2, 4) as `moving.capsules_of` gives them; has_person: whether the person is among them.
    """

    rectangle_px: tuple[int, int, int, int]
    points: np.ndarray
    capsules: np.ndarray
    has_person: bool

    def sphere(self) -> tuple[np.ndarray, float]:
        """Center (3,) and radius of a sphere that holds the points."""
        center = (self.points.min(axis=0) + self.points.max(axis=0)) / 2.0
        return center, float(np.linalg.norm(self.points - center, axis=1).max())


def shades_of(
    bones: np.ndarray, capsules: np.ndarray, sun: np.ndarray, view: CameraView, has_headlights: bool = False
) -> list[Shade]:
    """Return the rectangles of a frame; no two of them overlap.

    Args:
        bones: (b, 2, 4) capsules of the person, as of others, none without a person; capsules: (c, 2, 4) of others.
        sun: (3,) unit vector towards it. has_headlights: cars among the others light what lies before them.
    """
    shades: list[Shade] = []
    found = []
    for own in capsules[:, None]:
        points = _darkened(own, sun, SKY_RADII * float(own[0, 0, 3]), LONGEST_M)
        found.append((own, np.concatenate([points, _lit(own)]) if has_headlights else points, False))
    if len(bones):
        found.append((capsules[:0], _darkened(bones, sun, PERSON_SKY_M, PERSON_REACH_M), True))
    for own, points, is_person in found:
        rectangle = view.rectangle_px(points)
        if rectangle is not None:
            shades = _joined(shades, Shade(rectangle, points, own, is_person))
    return shades


def _darkened(capsules: np.ndarray, sun: np.ndarray, aside_m: float, longest_m: float) -> np.ndarray:
    """Corners round some capsules and round their shadows down to BELOW_M under them, (24, 3)."""
    ends, radii = capsules[..., :3], capsules[:, :1, 3:]
    low, high = (ends - EDGE * radii).min(axis=(0, 1)), (ends + EDGE * radii).max(axis=(0, 1))
    length_m = min((high[2] - low[2] + BELOW_M) / max(float(sun[2]), 1e-3), longest_m)
    body = _corners(low, high)
    wide_low, wide_high = low - np.array([aside_m, aside_m, BELOW_M]), high + np.array([aside_m, aside_m, 0.0])
    return np.concatenate([body, body - length_m * sun, _corners(wide_low, wide_high)])


def _lit(car: np.ndarray) -> np.ndarray:
    """Corners of what a car's headlights may light, (8, 3), none of a person; car: (1, 2, 4), back and front end."""
    back, front = car[0, :, :3]
    along = front - back
    if np.linalg.norm(along) < SHORTEST_CAR_M:
        return np.zeros((0, 3))
    end = front + along / np.linalg.norm(along) * HEADLIGHT_M
    aside = np.array([HEADLIGHT_ASIDE_M, HEADLIGHT_ASIDE_M, 3.0])
    return _corners(np.minimum(front, end) - aside, np.maximum(front, end) + aside)


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return box_corners((low + high) / 2.0, (high - low) / 2.0)


def _joined(shades: list[Shade], new: Shade) -> list[Shade]:
    """Add a rectangle; those that it overlaps become one with it."""
    while touching := [shade for shade in shades if _overlap(shade.rectangle_px, new.rectangle_px)]:
        shades = [shade for shade in shades if shade not in touching]
        for shade in touching:
            (ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1) = shade.rectangle_px, new.rectangle_px
            new = Shade(
                (min(ax0, bx0), min(ay0, by0), max(ax1, bx1), max(ay1, by1)),
                np.concatenate([shade.points, new.points]),
                np.concatenate([shade.capsules, new.capsules]),
                shade.has_person or new.has_person,
            )
    return [*shades, new]


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
