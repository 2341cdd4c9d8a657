"""The first pass of Step 2: clusters of neighbouring boxes become one box each.

Clusters come from union-find over the pairs that a sweep meets, never over all pairs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.work.compiled import njit

VEGETATION = KINDS["Vegetation"]
CLOSED_GAP_M = 1.0  # twice the safety radius of a person (tab:ped_params): nobody walks through
FILL_CELLS = 64  # a cluster's fill is measured on at most FILL_CELLS x FILL_CELLS cells: 1.6 % a cell along each axis


class MergeRule(NamedTuple):
    """How boxes of one kind are merged: largest gap on every axis, m, and least share of the merged footprint that is covered."""

    gap_m: float
    min_fill: float


def merge(
    box_map: BoxMap, rules: dict[int, MergeRule], groups: np.ndarray | None = None, *, by_center: bool = False
) -> BoxMap:
    """Replace clusters of neighbours of one kind by enclosing axis-aligned boxes; what is alone keeps its rotation.

    A cluster whose members, gaps of CLOSED_GAP_M between them closed, cover less than `min_fill` of the enclosing footprint is
    halved at the median of its longer side, again and again; a `min_fill` of 0 never halves.

    Args:
        rules: kind -> rule; other kinds stay.
        groups: (n,) bool, vegetation of different groups is no neighbour; None: one group.
        by_center: neighbours are boxes whose centres, not faces, lie within the gap on every axis.
    Source: sec:step2, "Merging adjacent boxes"; by centres: app:simworld:step3; the guard is ours.
    """
    mins, maxs = box_map.mins, box_map.maxs
    labels, min_fill = np.arange(len(box_map)), np.zeros(len(box_map))
    for kind, rule in sorted(rules.items()):
        of_kind = box_map.kinds == kind
        min_fill[of_kind] = rule.min_fill
        split = groups if groups is not None and kind == VEGETATION else np.zeros(len(box_map), dtype=bool)
        for group in np.unique(split[of_kind]):
            rows = np.flatnonzero(of_kind & (split == group))
            lows, highs = (box_map.centers, box_map.centers) if by_center else (mins, maxs)
            labels[rows] = rows[clusters(lows[rows], highs[rows], rule.gap_m)]
    labels = _halve_sparse(box_map, mins, maxs, labels, min_fill)
    order = np.lexsort((box_map.ids, labels))
    if len(order) == 0:
        return box_map
    first = np.flatnonzero(np.r_[True, labels[order][1:] != labels[order][:-1]])
    leaders = order[first]  # the smallest id of each cluster
    is_merged = np.diff(np.r_[first, len(order)]) > 1
    lows, highs = np.minimum.reduceat(mins[order], first), np.maximum.reduceat(maxs[order], first)
    alone = box_map.select(leaders)
    result = replace(
        alone,
        centers=np.where(is_merged[:, None], (lows + highs) / 2, alone.centers),
        half_extents=np.where(is_merged[:, None], (highs - lows) / 2, alone.half_extents),
        rotations_deg=np.where(is_merged[:, None], 0.0, alone.rotations_deg),
    )
    return result.select(np.argsort(leaders, kind="stable"))  # the order of the input


def clusters(mins: np.ndarray, maxs: np.ndarray, gap_m: float) -> np.ndarray:
    """Label boxes that hang together by gaps of at most `gap_m` on every axis.

    Args:
        mins, maxs: (n, 3) m.
    Returns:
        (n,) int64: the lowest row of each box's cluster.
    Raises:
        ValueError: the shapes differ, or the gap is negative.
    """
    if mins.shape != maxs.shape or mins.ndim != 2 or mins.shape[1] != 3:
        raise ValueError(f"mins and maxs must be (n, 3), got {mins.shape} and {maxs.shape}")
    if not gap_m >= 0:
        raise ValueError(f"gap_m must not be negative, got {gap_m}")
    if len(mins) == 0:
        return np.empty(0, dtype=np.int64)
    axis = int(np.argmax(maxs.max(axis=0)[:2] - mins.min(axis=0)[:2]))  # sweep along the longer side: fewer meet
    order = np.argsort(mins[:, axis], kind="stable")
    return _sweep_clusters(mins, maxs, order, axis, gap_m + 1e-9)  # micrometre files: 2.000000 m apart still counts


@njit(cache=True)
def _sweep_clusters(mins, maxs, order, axis, gap_m):  # pragma: no cover (compiled)
    """Union-find over the pairs that a sweep along one axis meets; the root is the lowest row."""
    parent = np.arange(len(order))
    for i in range(len(order)):
        a = order[i]
        reach = maxs[a, axis] + gap_m
        for j in range(i + 1, len(order)):
            b = order[j]
            if mins[b, axis] > reach:
                break
            near = True
            for k in range(3):
                if mins[b, k] - maxs[a, k] > gap_m or mins[a, k] - maxs[b, k] > gap_m:
                    near = False
                    break
            if near:
                root_a, root_b = a, b
                while parent[root_a] != root_a:
                    parent[root_a] = parent[parent[root_a]]
                    root_a = parent[root_a]
                while parent[root_b] != root_b:
                    parent[root_b] = parent[parent[root_b]]
                    root_b = parent[root_b]
                if root_a < root_b:
                    parent[root_b] = root_a
                else:
                    parent[root_a] = root_b
    for row in range(len(parent)):
        root = row
        while parent[root] != root:
            root = parent[root]
        parent[row] = root
    return parent


def _halve_sparse(
    box_map: BoxMap, mins: np.ndarray, maxs: np.ndarray, labels: np.ndarray, min_fill: np.ndarray
) -> np.ndarray:
    """Split clusters that fill too little of their enclosing footprint; a label is the lowest row of the part."""
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.r_[True, labels[order][1:] != labels[order][:-1], True]) if len(order) else order
    # Footprints as centre, unit axes and half sizes: a turned box covers its own rectangle, not its bounds.
    is_tilted = (box_map.rotations_deg[:, [0, 2]] != 0).any(axis=1)
    half = np.where(is_tilted[:, None], ((maxs - mins) / 2)[:, :2], box_map.half_extents[:, :2]) + CLOSED_GAP_M / 2
    yaw = np.where(is_tilted, 0.0, np.radians(box_map.rotations_deg[:, 1]))
    rectangles = np.column_stack([box_map.centers[:, :2], np.cos(yaw), np.sin(yaw), half])
    return _halve(order, starts, rectangles, mins[:, :2].copy(), maxs[:, :2].copy(), min_fill, labels.copy())


@njit(cache=True)
def _halve(order, starts, rectangles, mins, maxs, min_fill, labels):  # pragma: no cover (compiled)
    """Halve clusters, which are runs of `order`, and give the labels of the parts."""
    stack = np.empty((128, 2), dtype=np.int64)  # halves are at most 64 deep
    for cluster in range(len(starts) - 1):
        stack[0, 0], stack[0, 1] = starts[cluster], starts[cluster + 1]
        size = 1
        while size > 0:
            size -= 1
            start, stop = stack[size, 0], stack[size, 1]
            part = order[start:stop].copy()
            lowest = part.min()
            for row in part:
                labels[row] = lowest
            if len(part) == 1 or min_fill[part[0]] <= 0.0:
                continue
            low, high = mins[part[0]].copy(), maxs[part[0]].copy()
            members = np.empty((len(part), rectangles.shape[1]))
            for place, row in enumerate(part):
                for k in range(2):
                    low[k] = min(low[k], mins[row, k])
                    high[k] = max(high[k], maxs[row, k])
                for k in range(rectangles.shape[1]):
                    members[place, k] = rectangles[row, k]
            if fill_share(members, low, high) >= min_fill[part[0]]:
                continue
            axis = 0 if high[0] - low[0] >= high[1] - low[1] else 1
            ranks = np.argsort(members[:, axis], kind="mergesort")
            for place in range(len(part)):
                order[start + place] = part[ranks[place]]
            middle = (start + stop) // 2
            stack[size, 0], stack[size, 1] = start, middle
            stack[size + 1, 0], stack[size + 1, 1] = middle, stop
            size += 2
    return labels


@njit(cache=True)
def fill_share(rectangles, low, high):  # pragma: no cover (compiled)
    """Share of a rectangle's area that turned rectangles cover, by cell centres."""
    size = high - low
    if size[0] <= 0.0 or size[1] <= 0.0:
        return 1.0
    cell = max(size[0], size[1]) / FILL_CELLS
    num_x, num_y = max(1, round(size[0] / cell)), max(1, round(size[1] / cell))
    step_x, step_y = size[0] / num_x, size[1] / num_y
    covered = np.zeros((num_y, num_x), dtype=np.bool_)
    for x, y, cos, sin, half_x, half_y in rectangles:
        reach_x = abs(cos) * half_x + abs(sin) * half_y
        reach_y = abs(sin) * half_x + abs(cos) * half_y
        for row in range(
            max(0, int((y - reach_y - low[1]) / step_y)), min(num_y, int((y + reach_y - low[1]) / step_y) + 1)
        ):
            dy = low[1] + (row + 0.5) * step_y - y
            for column in range(
                max(0, int((x - reach_x - low[0]) / step_x)), min(num_x, int((x + reach_x - low[0]) / step_x) + 1)
            ):
                dx = low[0] + (column + 0.5) * step_x - x
                if abs(dx * cos + dy * sin) <= half_x and abs(dy * cos - dx * sin) <= half_y:
                    covered[row, column] = True
    return covered.sum() / covered.size
