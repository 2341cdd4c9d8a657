"""The passes of Step 2: fewer boxes that keep the layout of obstacles (sec:step2): merge, crop_tree, crop_below_ground,
prune_nested.

Two rules of the paper lose more than they should on real maps, so each has a guard, on by default, that a setting turns
off. *merge* replaces a cluster by its enclosing axis-aligned box: rows of houses that stand askew would swallow the
street between them, so a cluster that fills too little of that box is halved until its parts fill enough (`min_fill`,
`min_canopy_fill`; 0 is the paper's rule). *crop_tree* keeps the full footprint below the cut, so that
pedestrians cannot walk below a tree, which is the purpose of the cut: `trunk: stem` leaves stems instead (`trunk: full`
is the paper's rule). The report holds the walkable area of both.

The paper's SimWorld runs simplify otherwise (app:simworld:step3); its variants are settings: `merge_by: center`,
`crop_strategy: adaptive`, `below_ground: clip`, `nested_tolerance_m: 1e-6`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import shapely
from pydantic import Field

from cosfly.formats.boxes import BoxMap, SimplifyPass
from cosfly.formats.kinds import KINDS, SURFACE_KINDS
from cosfly.formats.meshes import Meshes
from cosfly.geometry.axes import axis_aligned_half_extents
from cosfly.runtime.compiled import njit
from cosfly.runtime.config import Config

# --- the first pass of Step 2: clusters of neighbouring boxes become one box each -------------------------------------
# Clusters come from union-find over the pairs that a sweep meets, never over all pairs.


CLOSED_GAP_M = 1.0  # twice the safety radius of a person (tab:ped_params): pedestrians cannot walk through
FILL_CELLS = 64  # a cluster's fill is measured on at most FILL_CELLS x FILL_CELLS cells: 1.6 % a cell along each axis


class MergeRule(NamedTuple):
    """How boxes of a kind are merged: largest gap on every axis, m; least share of the merged footprint covered."""

    gap_m: float
    min_fill: float


def merge(
    box_map: BoxMap, rules: dict[int, MergeRule], groups: np.ndarray | None = None, *, by_center: bool = False
) -> BoxMap:
    """Replace clusters of neighbours of one kind by enclosing axis-aligned boxes; single boxes keep their rotation.

    A cluster whose members, gaps of CLOSED_GAP_M between them closed, cover less than `min_fill` of the enclosing
    footprint is halved at the median of its longer side, again and again; a `min_fill` of 0 never halves.

    Args:
        rules: kind -> rule; other kinds stay.
        groups: (n,) bool, boxes of different groups are not neighbours; None: one group.
        by_center: neighbours are boxes with centres, not faces, within the gap on every axis.
    Source: sec:step2, "Merging adjacent boxes"; by centres: app:simworld:step3; the guard is ours.
    """
    mins, maxs = box_map.mins, box_map.maxs
    labels, min_fill = np.arange(len(box_map)), np.zeros(len(box_map))
    for kind, rule in sorted(rules.items()):
        of_kind = box_map.kinds == kind
        min_fill[of_kind] = rule.min_fill
        split = np.zeros(len(box_map), dtype=bool) if groups is None else groups
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
    """Return clusters of boxes with gaps of at most `gap_m` on every axis.

    Args:
        mins, maxs: (n, 3) m.
    Returns:
        (n,) int64: the lowest row of each box's cluster.
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
    """Return the lowest row of each box's cluster, by union-find over the pairs that a sweep along one axis meets."""
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
    """Return labels after halving clusters, which are runs of `order`."""
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
    """Return the share of a rectangle's area that turned rectangles cover, by cell centres."""
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


VEGETATION = KINDS["Vegetation"]


class SimplifyConfig(Config):
    """The four passes of Step 2."""

    merge: bool = Field(True, description="replace clusters of neighbouring boxes by one box")
    merge_by: Literal["gap", "center"] = Field(
        "gap", description="neighbours: boxes with gaps below merge_gap_m on every axis, or centres so near (SimWorld)"
    )
    # Largest gap on every axis between neighbours by kind, m; None: kinds that are not merged. Canopy parts of
    # simulators are closer than 2 m, wall segments of one building closer than 5 m.
    merge_gap_m: ClassVar[dict[str, float | None]] = {
        "Vegetation": 2.0, "Buildings": 5.0, "Walls": None, "Fences": None, "Static": None,
    }  # fmt: skip
    min_fill: float = Field(
        0.85, ge=0.0, le=1.0, description="least share of a merged footprint that members cover; 0: the paper's rule"
    )
    min_canopy_fill: float = Field(
        0.5, ge=0.0, le=1.0, description="the same for vegetation: round crowns never fill a box; 0: the paper's rule"
    )
    crop_tree: bool = Field(True, description="split vegetation into trunk and lifted canopy")
    crop_strategy: Literal["fixed", "adaptive"] = Field(
        "fixed", description="fixed: split at cut_height_m; adaptive: cut tall vegetation into low pieces (SimWorld)"
    )
    cut_height_m: ClassVar[float] = 2.0  # height over the ground of the split, m
    lift_m: ClassVar[float] = 0.5  # how far the canopy is lifted over the cut, m
    trunk: Literal["stem", "full"] = Field("stem", description="below the cut: stems, or full footprints (paper)")
    stem_radius_m: ClassVar[float] = 0.25  # half width of a stem, m
    split_z_m: ClassVar[float] = 5.0  # adaptive: height over the ground of the lowest cut, m
    adaptive_height_m: ClassVar[float] = 5.0  # adaptive: higher vegetation is cut, m
    cell_size_m: ClassVar[float] = 0.5  # adaptive: width of the stem below the lowest cut, m
    crop_below_ground: bool = Field(True, description="drop boxes, except surfaces, with their top below the ground")
    below_ground: Literal["drop", "clip"] = Field(
        "drop", description="clip: also cut off the part of a box below the ground (SimWorld); drop: leave boxes whole"
    )
    prune_nested: bool = Field(True, description="drop boxes inside another of the same kind")
    nested_tolerance_m: float = Field(0.01, ge=0.0, description="how far a nested box may stick out, m")


@dataclass(frozen=True)
class Simplification:
    """A simplified map and what each pass left: (name of the pass, boxes by kind), the first entry is the input."""

    box_map: BoxMap
    passes: list[tuple[str, dict[str, int]]]


def simplify(box_map: BoxMap, cfg: SimplifyConfig) -> Simplification:
    """Apply the passes in the paper's order.

    The result's header gains `passes`, with settings and counts. Ids: a merged box takes its smallest member's, a
    tree's canopy keeps its own, stems and trunks get the smallest numbers that the input does not use.
    """
    passes = [("input", box_map.counts())]
    feet = _feet(box_map, cfg) if _has_stems(cfg) else None
    used_ids = box_map.ids
    result = box_map
    if cfg.merge:
        result = merge(result, _merge_rules(cfg), _merge_groups(box_map, cfg), by_center=cfg.merge_by == "center")
        passes.append(("merge", result.counts()))
    if cfg.crop_tree:
        fixed = cfg.crop_strategy == "fixed"
        result = crop_tree(result, cfg, used_ids, feet) if fixed else crop_tree_adaptive(result, cfg, used_ids)
        passes.append(("crop_tree", result.counts()))
    if cfg.crop_below_ground:
        result = crop_below_ground(result, clip=cfg.below_ground == "clip")
        passes.append(("crop_below_ground", result.counts()))
    if cfg.prune_nested:
        result = prune_nested(result, cfg.nested_tolerance_m)
        passes.append(("prune_nested", result.counts()))
    records = [SimplifyPass(name=name, counts=counts) for name, counts in passes]
    header = box_map.header.model_copy(update={"passes": records, "simplify": cfg.all_values()})
    return Simplification(replace(result, header=header, meshes=Meshes()), passes)


def _merge_rules(cfg: SimplifyConfig) -> dict[int, MergeRule]:
    gaps = {KINDS[name]: gap for name, gap in cfg.merge_gap_m.items() if gap is not None}
    return {
        kind: MergeRule(gap, cfg.min_canopy_fill if kind == VEGETATION else cfg.min_fill) for kind, gap in gaps.items()
    }


def _merge_groups(box_map: BoxMap, cfg: SimplifyConfig) -> np.ndarray:
    """Return groups that never merge, (n,) bool: with stems, bushes and hedges must not vanish below the cut of a tree;
    a box over a passage or an arcade, and not on a box below, must not close it."""
    cut_m = _ground_z_m(box_map) + cfg.cut_height_m
    mins, maxs = box_map.mins, box_map.maxs
    is_plant, is_low = box_map.kinds == VEGETATION, mins[:, 2] <= cut_m
    outlines = shapely.box(*mins[:, :2].T, *maxs[:, :2].T)
    above, below = shapely.STRtree(outlines[is_low]).query(outlines, predicate="covered_by")
    is_built_over = ~is_low & ~is_plant
    is_built_over[above[box_map.kinds[above] == box_map.kinds[is_low][below]]] = False
    return is_built_over | (is_plant & (maxs[:, 2] > cut_m) & _has_stems(cfg))


def _ground_z_m(box_map: BoxMap) -> np.ndarray:
    """Return the height of the ground under the middle of each box, (n,) m."""
    return box_map.ground.height_at(box_map.centers)


def _has_stems(cfg: SimplifyConfig) -> bool:
    return cfg.crop_tree and cfg.crop_strategy == "fixed" and cfg.trunk == "stem"


# --- crop_tree --------------------------------------------------------------------------------------------------------


def _feet(box_map: BoxMap, cfg: SimplifyConfig) -> np.ndarray:
    """Return (k, 4): x, y and half widths of a stem for every vegetation box that spans the cut height.

    Taken before the merge, because a merged grove still has one stem for each of its trees.
    """
    mins, maxs = box_map.mins[:, 2], box_map.maxs[:, 2]
    ground_z_m = _ground_z_m(box_map)
    cut = ground_z_m + cfg.cut_height_m
    rows = np.flatnonzero((box_map.kinds == VEGETATION) & (mins < cut) & (maxs > cut))
    # A box that hangs above the ground is a part of a crown, not a tree, unless it comes down to a metre.
    rows = rows[mins[rows] <= ground_z_m[rows] + 1.0]
    half = np.minimum(box_map.half_extents[rows, :2].min(axis=1), cfg.stem_radius_m)
    return np.column_stack([box_map.centers[rows, :2], half, half])


def crop_tree(box_map: BoxMap, cfg: SimplifyConfig, used_ids: np.ndarray, feet: np.ndarray | None) -> BoxMap:
    """Split vegetation that spans the cut height into trunks on the ground and a lifted canopy.

    Boxes wholly below the cut (bushes, hedges) and wholly above it stay as they are, so a second pass changes nothing.

    Args:
        used_ids: ids that new boxes may not take. feet: (k, 4) stems below the canopies; None: full
            footprints.
    Source: sec:step2, "Crop tree operation"; stems are ours.
    """
    ground_z_m = _ground_z_m(box_map)
    cut = ground_z_m + cfg.cut_height_m
    rows = np.flatnonzero((box_map.kinds == VEGETATION) & (box_map.mins[:, 2] < cut) & (box_map.maxs[:, 2] > cut))
    is_tilted = (box_map.rotations_deg[rows][:, [0, 2]] != 0).any(axis=1)
    rotations = np.where(is_tilted[:, None], 0.0, box_map.rotations_deg[rows])
    bounds = axis_aligned_half_extents(box_map.half_extents[rows], box_map.rotations_deg[rows])
    half = np.where(is_tilted[:, None], bounds, box_map.half_extents[rows])
    tops = box_map.centers[rows, 2] + bounds[:, 2]

    centers, half_extents, all_rotations = (
        a.copy() for a in (box_map.centers, box_map.half_extents, box_map.rotations_deg)
    )
    centers[rows, 2] = (cut[rows] + tops) / 2 + cfg.lift_m
    half_extents[rows] = np.column_stack([half[:, :2], (tops - cut[rows]) / 2])
    all_rotations[rows] = rotations
    canopies = replace(box_map, centers=centers, half_extents=half_extents, rotations_deg=all_rotations)

    if feet is None:
        places, widths, turns = box_map.centers[rows, :2], half[:, :2], rotations
    else:
        places, widths, turns = feet[:, :2], feet[:, 2:], np.zeros((len(feet), 3))
    count = len(places)
    trunks = BoxMap(
        np.column_stack([places, box_map.ground.height_at(places) + cfg.cut_height_m / 2]),
        np.column_stack([widths, np.full(count, cfg.cut_height_m / 2)]),
        turns,
        np.full(count, VEGETATION, dtype=np.uint8),
        _free_ids(used_ids, count),
    )
    return canopies.joined(trunks)


def crop_tree_adaptive(box_map: BoxMap, cfg: SimplifyConfig, used_ids: np.ndarray) -> BoxMap:
    """Cut vegetation that is higher than `adaptive_height_m` into a stem below `split_z_m` and pieces no higher than
    that above.

    The paper names three numbers and their purpose, tall trees in shorter pieces that do not block the walking grid
    from afar, but no rule; this is ours. The stem is one cell wide. The lowest piece above the cut keeps the id;
    without one, the stem does.

    Args:
        used_ids: ids that new boxes may not take.
    Source: app:simworld:step3, "crop_tree".
    """
    ground_z_m = _ground_z_m(box_map)
    split = ground_z_m + cfg.split_z_m
    low, high = box_map.mins[:, 2], box_map.maxs[:, 2]
    is_tall = (box_map.kinds == VEGETATION) & (high - np.maximum(low, ground_z_m) > cfg.adaptive_height_m)
    rows, is_first, lows, highs = [], [], [], []
    for row in np.flatnonzero(is_tall):
        cuts = [float(low[row])]
        if low[row] < split[row] < high[row]:
            cuts.append(float(split[row]))
        num_pieces = int(np.ceil((high[row] - cuts[-1]) / cfg.adaptive_height_m - 1e-9))
        cuts += np.linspace(cuts[-1], high[row], num_pieces + 1)[1:].tolist()
        rows += [row] * (len(cuts) - 1)
        is_first += [piece == int(len(cuts) > 2 and low[row] < split[row]) for piece in range(len(cuts) - 1)]
        lows += cuts[:-1]
        highs += cuts[1:]
    pieces = np.array(rows, dtype=np.int64)
    low_z, high_z = np.array(lows), np.array(highs)
    is_tilted = (box_map.rotations_deg[pieces][:, [0, 2]] != 0).any(axis=1)[:, None]
    bounds = axis_aligned_half_extents(box_map.half_extents[pieces], box_map.rotations_deg[pieces])
    half = np.where(is_tilted, bounds, box_map.half_extents[pieces])
    is_stem = ((low_z < split[pieces]) & (low_z <= ground_z_m[pieces] + 1.0))[:, None]
    half[:, :2] = np.where(is_stem, np.minimum(half[:, :2], cfg.cell_size_m / 2), half[:, :2])
    half[:, 2] = (high_z - low_z) / 2
    keeps_id = np.array(is_first, dtype=bool)
    ids = box_map.ids[pieces].copy()
    ids[~keeps_id] = _free_ids(used_ids, int((~keeps_id).sum()))
    cut = BoxMap(
        np.column_stack([box_map.centers[pieces, :2], (low_z + high_z) / 2]),
        half,
        np.where(is_tilted, 0.0, box_map.rotations_deg[pieces]),
        box_map.kinds[pieces],
        ids,
    )
    return box_map.select(~is_tall).joined(cut)


def _free_ids(used: np.ndarray, count: int) -> np.ndarray:
    """Return the smallest positive numbers that are not used, (count,) uint64. Not max + 1: CARLA's ids fill 64
    bits."""
    candidates = np.arange(1, len(used) + count + 1, dtype=np.uint64)
    return candidates[~np.isin(candidates, used)][:count]


# --- removal ----------------------------------------------------------------------------------------------------------


def crop_below_ground(box_map: BoxMap, *, clip: bool = False) -> BoxMap:
    """Drop boxes with their top face below the ground; surfaces stay (sec:step2, "Below-ground removal").

    Args:
        clip: also cut off the parts of upright boxes, except surfaces, below the ground, and drop boxes that only just
            reach it (app:simworld:step3). A tilted box has no lower part that is a box, and stays whole.
    """
    ground_z_m = _ground_z_m(box_map)
    is_surface = box_map.is_any_of(SURFACE_KINDS)
    lows, tops = box_map.mins[:, 2], box_map.maxs[:, 2]
    if not clip:
        return box_map.select((tops >= ground_z_m) | is_surface)
    is_upright = (box_map.rotations_deg[:, [0, 2]] == 0).all(axis=1)
    is_cut = (lows < ground_z_m) & (tops > ground_z_m) & is_upright & ~is_surface
    centers, half_extents = box_map.centers.copy(), box_map.half_extents.copy()
    centers[is_cut, 2] = (tops[is_cut] + ground_z_m[is_cut]) / 2
    half_extents[is_cut, 2] = (tops[is_cut] - ground_z_m[is_cut]) / 2
    clipped = replace(box_map, centers=centers, half_extents=half_extents)
    return clipped.select((tops > ground_z_m) | is_surface)


def prune_nested(box_map: BoxMap, tolerance_m: float) -> BoxMap:
    """Drop boxes that lie inside another of the same kind; of equal boxes the one with the smallest id stays.

    Inside means: all corners of the axis-aligned bounds in the other box as it is turned. For unturned boxes that is
    the paper's rule (sec:step2); for turned ones it never drops a box that sticks out of a turned one's empty corners.
    """
    keep = np.ones(len(box_map), dtype=bool)
    mins, maxs = box_map.mins, box_map.maxs
    # Bigger first, then the smaller id: a total order, so that two boxes can never drop each other.
    volumes = np.prod(box_map.half_extents, axis=1)
    rank = np.empty(len(box_map), dtype=np.int64)
    rank[np.lexsort((box_map.ids, -volumes))] = np.arange(len(box_map))
    is_tilted = (box_map.rotations_deg[:, [0, 2]] != 0).any(axis=1)
    yaw = np.radians(box_map.rotations_deg[:, 1])
    for kind in np.unique(box_map.kinds):
        rows = np.flatnonzero(box_map.kinds == kind)
        axis = int(np.argmax(maxs[rows].max(axis=0)[:2] - mins[rows].min(axis=0)[:2]))
        order = rows[np.argsort(mins[rows, axis], kind="stable")]
        _sweep_nested(
            mins, maxs, box_map.centers, box_map.half_extents, np.cos(yaw), np.sin(yaw), is_tilted, rank, order, axis,
            tolerance_m + 1e-9, keep,
        )  # fmt: skip
    return box_map.select(keep)


@njit(cache=True)
def _sweep_nested(
    mins, maxs, centers, halves, cos, sin, is_tilted, rank, order, axis, tolerance, keep
):  # pragma: no cover (compiled)
    for i in range(len(order)):
        a = order[i]
        reach = maxs[a, axis] + tolerance
        for j in range(i + 1, len(order)):
            b = order[j]
            if mins[b, axis] > reach:
                break
            outer, inner = (a, b) if rank[a] < rank[b] else (b, a)
            if is_tilted[outer] or not keep[inner]:
                continue
            inside = True
            for k in range(3):
                if mins[inner, k] < mins[outer, k] - tolerance or maxs[inner, k] > maxs[outer, k] + tolerance:
                    inside = False
                    break
            if inside:
                for x in (mins[inner, 0], maxs[inner, 0]):
                    for y in (mins[inner, 1], maxs[inner, 1]):
                        dx, dy = x - centers[outer, 0], y - centers[outer, 1]
                        if (
                            abs(dx * cos[outer] + dy * sin[outer]) > halves[outer, 0] + tolerance
                            or abs(dy * cos[outer] - dx * sin[outer]) > halves[outer, 1] + tolerance
                        ):
                            inside = False
            if inside:
                keep[inner] = False
