"""What each picture of a release is measured by, compiled: every pixel of mask and depth, rays to the person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.products.frames import SKY_DEPTH_M
from cosfly.products.kinds import KINDS
from cosfly.space.reprojection import COLUMNS, GRID_ROWS
from cosfly.work.compiled import njit

PERSON_ID = 65535  # the person in `instance.png`: docs/files.md
SHARED_ID, NOBODY = 65534, 0  # ids that stand for several things, or for none
NUM_IDS = 65536
PERSON, SKY = KINDS["Pedestrians"], KINDS["Sky"]
NEAR_M = 0.3  # where rays begin: the renderers' near plane
SURFACE_SLACK_M = 0.05  # how far before a person's box what is drawn may lie and not hide it
# Numbers of a float's bits are ordered as floats above 0 are, and compared several at once, as no bits are not a number.
FAR_BITS = np.float32(SKY_DEPTH_M).view(np.int32)
INFINITE_BITS = np.float32(np.inf).view(np.int32)


class Survey(NamedTuple):
    """A frame's mask and depth. low_m, high_m: least and greatest depth, NaN where one is not finite; num_odd_sky: pixels of sky by one of
    depth and kind alone; num_person: of the person; num_odd_person: of the person's id with another kind; most_kind: the greatest there is;
    box: (4,) of the person's pixels, edges at pixel borders."""

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
    kinds_alone = np.zeros(instance.shape[1] * 3, np.uint8)
    kinds_alone[::3] = 255
    bits = depth.view(np.int32)
    counts, box = _survey(bits, np.ascontiguousarray(instance).reshape(len(instance), len(kinds_alone)), kinds_alone)
    low, high = counts[:2].tolist()
    if 0 <= low <= high < INFINITE_BITS:
        limits = counts[:2].astype(np.int32).view(np.float32).tolist()
    else:  # not positive, not finite, or nothing
        limits = [float(depth.min()), float(depth.max())] if depth.size else [0.0, 0.0]
    if not np.isfinite(limits).all():
        limits = [np.nan, np.nan]
    num_odd_sky, num_person, num_odd_person, most_kind = counts[2:].tolist()
    return Survey(limits[0], limits[1], num_odd_sky, num_person, num_odd_person, most_kind, box)


def new_kinds(instance: np.ndarray, known: np.ndarray) -> list[int]:
    """Give id * 256 + kind of things at the grid's points that have another kind than is known of them, each once.

    Args:
        known: (NUM_IDS,) int16, -1: not seen yet.
    """
    return np.unique(_new_kinds(instance, known)).tolist()


@njit(cache=True, nogil=True)
def _survey(bits, mask, kinds_alone):  # type: ignore[no-untyped-def]
    """Row by row: what most rows have not is looked for in all their bytes at once, and pixel by pixel only where it is. Give the numbers of
    a `Survey`, the first two as bits, and its box."""
    most, least = np.int32(2147483647), np.int32(-2147483648)
    low, high, most_kind = most, least, np.uint8(0)
    num_odd_sky, num_person, num_odd_person = np.int64(0), np.int64(0), np.int64(0)
    box = np.array([1 << 30, 1 << 30, -1, -1], np.int64)
    for y in range(max(len(bits), len(mask))):
        num_far = np.int32(0)
        if len(bits) > 0:
            row = bits[y]
            for x in range(len(row)):
                low, high = min(low, row[x]), max(high, row[x])
            for x in range(len(row)):
                num_far = np.int32(num_far + np.int32(row[x] == FAR_BITS))
        if len(mask) == 0:
            continue
        own, after = mask[y, :-1], mask[y, 1:]  # the last byte is no kind
        of_person, of_sky = np.uint8(0), np.uint8(0)
        # Numba makes each result 64 bits wide, so that fewer are computed at once, where nothing says that it is a byte.
        for k in range(len(own)):
            kind = np.uint8(own[k] & kinds_alone[k])
            most_kind = np.uint8(max(most_kind, kind))
            of_sky = np.uint8(of_sky | np.uint8(kind == SKY))
            of_person = np.uint8(max(of_person, np.uint8(own[k] & after[k])))  # 255 only where both bytes of an id are
        if len(bits) > 0 and (of_sky > 0 or num_far > 0):
            for x in range(len(bits[y])):
                num_odd_sky += (own[3 * x] == SKY) != (bits[y, x] == FAR_BITS)
        if of_person == 255:
            for x in range(len(mask[y]) // 3):
                if after[3 * x] == 255 and after[3 * x + 1] == 255:
                    num_person += 1
                    num_odd_person += own[3 * x] != PERSON
                    box[0], box[1] = min(box[0], x), min(box[1], y)
                    box[2], box[3] = max(box[2], x + 1), max(box[3], y + 1)
    return np.array([low, high, num_odd_sky, num_person, num_odd_person, np.int64(most_kind)]), box


@njit(cache=True, nogil=True)
def _new_kinds(instance, known):  # type: ignore[no-untyped-def]
    height, width = instance.shape[:2]
    found, num = np.empty(COLUMNS * GRID_ROWS, np.int64), 0
    for j in range(GRID_ROWS):
        for i in range(COLUMNS):
            pixel = instance[int((j + 0.5) * height / GRID_ROWS), int((i + 0.5) * width / COLUMNS)]
            own = np.int64(pixel[1]) | np.int64(pixel[2]) << 8
            if own != NOBODY and own != SHARED_ID and known[own] != pixel[0]:
                found[num] = own << 8 | np.int64(pixel[0])
                num += 1
    return found[:num]


@njit(cache=True, nogil=True)
def depths_of_person(depth, instance, box, is_ours):  # type: ignore[no-untyped-def]
    """Give the depths, (k,) float32 m, of the person's pixels in a box (4,) of whole pixels. is_ours: those of the person's id alone."""
    x0, y0, x1, y1 = box
    found, num = np.empty((y1 - y0) * (x1 - x0), np.float32), 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            kind, low, high = instance[y, x, 0], instance[y, x, 1], instance[y, x, 2]
            if kind == PERSON and (not is_ours or (low == 255 and high == 255)):
                found[num] = depth[y, x]
                num += 1
    return found[:num]


@njit(cache=True, nogil=True)
def rays_to_person(depth, instance, columns, rows, intrinsics, world_from_camera, away_m, half_m):  # type: ignore[no-untyped-def]
    """Cast rays through the middles of pixels (columns, rows), also beyond the picture, to a box that stands upright, `away_m` (3,) from the
    camera with `half_m` (3,) to each side: how many hit it, and how many of these nothing hides."""
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
