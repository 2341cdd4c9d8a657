"""What each picture of a release is measured by: every pixel of mask and depth, rays to the person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.products.frames import SKY_DEPTH_M
from cosfly.products.kinds import KINDS
from cosfly.space.reprojection import COLUMNS, GRID_ROWS
from cosfly.work.compiled import njit

SHARED_ID, NOBODY = 65534, 0  # ids of `instance.png` that stand for several things, or for none
NUM_IDS = 65536
PERSON, SKY = KINDS["Pedestrians"], KINDS["Sky"]
NEAR_M = 0.3  # where rays begin: the renderers' near plane
SURFACE_SLACK_M = 0.05  # how far before a person's box what is drawn may lie and not hide it


class Survey(NamedTuple):
    """A frame's mask and depth. low_m, high_m: least and greatest depth, NaN where one is not finite; num_odd_sky:
    pixels of sky by one of depth and kind alone; num_person: of the person; num_odd_person: of the person's id with
    another kind; most_kind: the greatest there is; box: (4,) of the person's pixels, edges at pixel borders."""

    low_m: float
    high_m: float
    num_odd_sky: int
    num_person: int
    num_odd_person: int
    most_kind: int
    box: np.ndarray


def survey(depth: np.ndarray, instance: np.ndarray) -> Survey:
    """Look at every pixel of a frame once.

    Args:
        depth: (h, w) float32, or (0, 0) where there is none; instance: (h, w, 3) uint8, or (0, 0, 3).
    """
    limits = np.array([depth.min(initial=np.inf), depth.max(initial=-np.inf)]) if depth.size else np.zeros(2)
    low, high = limits.tolist() if np.isfinite(limits).all() else (np.nan, np.nan)
    counts, box = _survey(depth, np.ascontiguousarray(instance))
    num_odd_sky, num_person, num_odd_person, most_kind = counts.tolist()
    return Survey(low, high, num_odd_sky, num_person, num_odd_person, most_kind, box)


def new_kinds(instance: np.ndarray, known: np.ndarray) -> list[int]:
    """Give id * 256 + kind of things at the grid's points that have another kind than is known of them, each once.

    Args:
        known: (NUM_IDS,) int16, -1: not seen yet.
    """
    height, width = instance.shape[:2]
    rows = ((np.arange(GRID_ROWS) + 0.5) * height / GRID_ROWS).astype(int)
    columns = ((np.arange(COLUMNS) + 0.5) * width / COLUMNS).astype(int)
    kinds, low, high = np.moveaxis(instance[np.ix_(rows, columns)].astype(np.int64), 2, 0)
    ids = low | high << 8
    is_new = (ids != NOBODY) & (ids != SHARED_ID) & (known[ids] != kinds)
    return np.unique((ids << 8 | kinds)[is_new]).tolist()


def depths_of_person(depth: np.ndarray, instance: np.ndarray, box: np.ndarray, is_ours: bool) -> np.ndarray:
    """Give the depths, (k,) float32 m, of the person's pixels in a box (4,) of whole pixels. is_ours: those of the
    person's id alone."""
    x0, y0, x1, y1 = box
    part = instance[y0:y1, x0:x1]
    is_person = part[..., 0] == PERSON
    return depth[y0:y1, x0:x1][is_person & (part[..., 1:] == 255).all(axis=-1) if is_ours else is_person]


@njit(cache=True, nogil=True)
def _survey(depth, instance):  # type: ignore[no-untyped-def]
    """Give the counts of a `Survey` (4,), and its box."""
    num_odd_sky, num_person, num_odd_person, most_kind = 0, 0, 0, 0
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    for y in range(len(instance)):
        for x in range(instance.shape[1]):
            kind = instance[y, x, 0]
            most_kind = max(most_kind, kind)
            if len(depth) > 0:
                num_odd_sky += (kind == SKY) != (depth[y, x] == SKY_DEPTH_M)
            if instance[y, x, 1] == 255 and instance[y, x, 2] == 255:
                num_person += 1
                num_odd_person += kind != PERSON
                box[0], box[1] = min(box[0], x), min(box[1], y)
                box[2], box[3] = max(box[2], x + 1), max(box[3], y + 1)
    return np.array([num_odd_sky, num_person, num_odd_person, most_kind], np.int64), box


@njit(cache=True, nogil=True)
def rays_to_person(  # type: ignore[no-untyped-def]
    depth, instance, columns, rows, intrinsics, world_from_camera, away_m, half_m
):
    """Cast rays through the middles of pixels (columns, rows), also beyond the picture, to a box that stands upright,
    `away_m` (3,) from the camera with `half_m` (3,) to each side: how many hit it, and how many of these nothing
    hides."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    num_hits, num_seen = np.int64(0), np.int64(0)
    for v in rows:
        for u in columns:
            x, y = (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy
            enter, leave = NEAR_M, np.inf
            for axis in range(3):
                ray = world_from_camera[axis, 0] * x + world_from_camera[axis, 1] * y + world_from_camera[axis, 2]
                if abs(ray) < 1e-12:
                    ray = 1e-12
                one, other = (away_m[axis] - half_m[axis]) / ray, (away_m[axis] + half_m[axis]) / ray
                enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
            if leave <= enter:
                continue
            num_hits += 1
            if 0 <= u < width and 0 <= v < height:
                column, row = int(u), int(v)
                is_person = instance[row, column, 1] == 255 and instance[row, column, 2] == 255
                num_seen += is_person or depth[row, column] > enter - SURFACE_SLACK_M
    return num_hits, num_seen
