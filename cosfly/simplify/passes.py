"""The passes of Step 2: fewer boxes that keep the layout of obstacles (sec:step2).

Two rules of the paper lose more than they should on real maps, so each has a guard that a setting turns off: *merge*
halves clusters that fill too little of their enclosing box, or houses that stand askew would swallow the street between
them (`min_fill`, `min_canopy_fill`); *crop_tree* leaves stems below the cut, not full footprints, so that pedestrians
can walk below a tree (`trunk`). The variants of the paper's SimWorld runs (app:simworld:step3) are settings.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
import shapely
from pydantic import Field

from cosfly.formats.boxes import VECTORS, BoxMap, SimplifyPass
from cosfly.formats.kinds import KINDS, SURFACE_KINDS
from cosfly.formats.meshes import Meshes
from cosfly.geometry.axes import axis_aligned_half_extents, box_corners
from cosfly.geometry.grid import TOUCH_M, mark_hulls
from cosfly.runtime.config import Config

VEGETATION = KINDS["Vegetation"]
ROUNDING_M = 1e-9  # maps are written to a micrometre: boxes that are 2.000000 m apart are within 2 m
FOOT_M = 1.0  # a plant that begins higher over the ground hangs: it is a part of a crown, not a tree
CLOSED_GAP_M = 1.0  # twice the safety radius of a person (tab:ped_params): pedestrians cannot walk through
FILL_CELLS = 64  # a cluster's fill is measured on at most FILL_CELLS x FILL_CELLS cells: 1.6 % a cell along each axis


class SimplifyConfig(Config):
    """The four passes of Step 2."""

    merge: bool = Field(True, description="replace clusters of neighbouring boxes by one box")
    merge_by: Literal["gap", "center"] = Field(
        "gap", description="boxes are neighbours by the gap between them, or by their centres (SimWorld)"
    )
    # Largest gap on every axis between neighbours by kind, m; None: kinds that are not merged. Canopy parts of
    # simulators are closer than 2 m, wall segments of one building closer than 5 m.
    merge_gap_m: ClassVar[dict[str, float | None]] = {
        "Vegetation": 2.0, "Buildings": 5.0, "Walls": None, "Fences": None, "Static": None,
    }  # fmt: skip
    min_fill: float = Field(
        0.85,
        ge=0.0,
        le=1.0,
        description="smallest share of a merged footprint that its boxes cover; 0: the paper's rule",
    )
    min_canopy_fill: float = Field(0.5, ge=0.0, le=1.0, description="the same for vegetation, whose crowns are round")
    crop_tree: bool = Field(True, description="split vegetation into trunk and lifted canopy")
    crop_strategy: Literal["fixed", "adaptive"] = Field(
        "fixed", description="fixed: one cut; adaptive: low pieces (SimWorld)"
    )
    cut_height_m: ClassVar[float] = 2.0  # height over the ground of the split, m
    lift_m: ClassVar[float] = 0.5  # how far the canopy is lifted over the cut, m
    trunk: Literal["stem", "full"] = Field(
        "stem", description="box below the cut: a stem, or the full footprint (paper)"
    )
    stem_radius_m: ClassVar[float] = 0.25  # half width of a stem, m
    split_z_m: ClassVar[float] = 5.0  # adaptive: height over the ground of the lowest cut, m
    adaptive_height_m: ClassVar[float] = 5.0  # adaptive: higher vegetation is cut, m
    cell_size_m: ClassVar[float] = 0.5  # adaptive: width of the stem below the lowest cut, m
    crop_below_ground: bool = Field(True, description="drop boxes, except surfaces, with their top below the ground")
    below_ground: Literal["drop", "clip"] = Field("drop", description="clip: also cut boxes at the ground (SimWorld)")
    prune_nested: bool = Field(True, description="drop boxes inside another box of the same kind")
    nested_tolerance_m: float = Field(0.01, ge=0.0, description="length by which a nested box may stick out, m")


def simplify(box_map: BoxMap, cfg: SimplifyConfig) -> BoxMap:
    """Apply the passes in the paper's order.

    The result's header gains `passes`, with settings and counts. Ids: a merged box takes its smallest member's, a
    tree's canopy keeps its own, stems and trunks get the smallest numbers that the input does not use.
    """
    feet = _feet(box_map, cfg) if _has_stems(cfg) else None
    rules: dict[int, tuple[float, float]] = {}
    for name, gap_m in cfg.merge_gap_m.items():
        if gap_m is not None:
            rules[KINDS[name]] = (gap_m, cfg.min_canopy_fill if name == "Vegetation" else cfg.min_fill)
    ids = box_map.ids
    is_fixed = cfg.crop_strategy == "fixed"
    apply: dict[str, Callable[[BoxMap], BoxMap]] = {  # by the setting that turns a pass off
        "merge": lambda m: merge(m, rules, _merge_groups(box_map, cfg), by_center=cfg.merge_by == "center"),
        "crop_tree": lambda m: crop_tree(m, cfg, ids, feet) if is_fixed else crop_tree_adaptive(m, cfg, ids),
        "crop_below_ground": lambda m: crop_below_ground(m, clip=cfg.below_ground == "clip"),
        "prune_nested": lambda m: prune_nested(m, cfg.nested_tolerance_m),
    }
    result = box_map
    passes = [SimplifyPass(name="input", counts=box_map.counts())]
    for name, apply_pass in apply.items():
        if getattr(cfg, name):
            result = apply_pass(result)
            passes.append(SimplifyPass(name=name, counts=result.counts()))
    header = box_map.header.model_copy(update={"passes": passes, "simplify": cfg.all_values()})
    return replace(result, header=header, meshes=Meshes())


def _merge_groups(box_map: BoxMap, cfg: SimplifyConfig) -> np.ndarray:
    """Return two groups of boxes that never merge with each other, (n,) bool.

    True are trees with stems, but not bushes below the cut; and boxes over a passage or an arcade, but not boxes that
    stand on a box of their kind: a merge with the boxes next to a passage would close it.
    """
    cut_m = box_map.ground_z_m + cfg.cut_height_m
    mins, maxs = box_map.mins, box_map.maxs
    is_plant = box_map.kinds == VEGETATION
    is_low = mins[:, 2] <= cut_m
    outlines = shapely.box(*mins[:, :2].T, *maxs[:, :2].T)
    above, below = shapely.STRtree(outlines[is_low]).query(outlines, predicate="covered_by")
    is_same_kind = box_map.kinds[above] == box_map.kinds[is_low][below]
    is_over_passage = ~is_low & ~is_plant
    is_over_passage[above[is_same_kind]] = False
    return is_over_passage | (is_plant & (maxs[:, 2] > cut_m) & _has_stems(cfg))


def _has_stems(cfg: SimplifyConfig) -> bool:
    return cfg.crop_tree and cfg.crop_strategy == "fixed" and cfg.trunk == "stem"


# --- merge ------------------------------------------------------------------------------------------------------------


def merge(
    box_map: BoxMap, rules: dict[int, tuple[float, float]], groups: np.ndarray | None = None, *, by_center: bool = False
) -> BoxMap:
    """Replace clusters of neighbours of one kind by enclosing axis-aligned boxes; single boxes keep their rotation.

    If its members, with gaps of CLOSED_GAP_M closed, cover less than the least share of the enclosing footprint, a
    cluster is halved at the median of its longer side, repeatedly; a share of 0 never halves.

    Args:
        rules: kind -> largest gap on every axis, m, and least share; other kinds stay.
        groups: (n,) bool, boxes of different groups are not neighbours; None: one group.
        by_center: neighbours are boxes with centres, not faces, within the gap on every axis.
    Source: sec:step2, "Merging adjacent boxes"; by centres: app:simworld:step3; the guard is ours.
    """
    mins, maxs = box_map.mins, box_map.maxs
    groups = np.zeros(len(box_map), dtype=bool) if groups is None else groups
    lows, highs = (box_map.centers, box_map.centers) if by_center else (mins, maxs)
    half, turns = _upright(box_map, np.arange(len(box_map)))
    footprints = box_corners(box_map.centers, half + CLOSED_GAP_M / 2, np.radians(turns[:, 1]))[:, [0, 2, 6, 4], :2]
    merged = _copied(box_map)
    keep = np.ones(len(box_map), dtype=bool)
    for kind, (gap_m, min_fill) in rules.items():
        for group in np.unique(groups[box_map.kinds == kind]):
            rows = np.flatnonzero((box_map.kinds == kind) & (groups == group))
            labels = clusters(lows[rows], highs[rows], gap_m)
            for cluster in _rows_by_label(rows, labels):
                for part in _filled_parts(cluster, box_map.centers, footprints, mins, maxs, min_fill):
                    low = mins[part].min(axis=0)
                    high = maxs[part].max(axis=0)
                    leader = part[np.argmin(box_map.ids[part])]  # becomes the enclosing box
                    merged.centers[leader] = (low + high) / 2
                    merged.half_extents[leader] = (high - low) / 2
                    merged.rotations_deg[leader] = 0.0
                    keep[part] = part == leader
    return merged.select(keep)


def _copied(box_map: BoxMap) -> BoxMap:
    """Return a map with own centres, half extents and rotations, which may be changed."""
    return replace(box_map, **{name: getattr(box_map, name).copy() for name in VECTORS})


def _rows_by_label(rows: np.ndarray, labels: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each label, in the order of the labels."""
    order = np.argsort(labels, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(labels[order])) + 1)


def clusters(mins: np.ndarray, maxs: np.ndarray, gap_m: float) -> np.ndarray:
    """Return the lowest row of each box's cluster, (n,) int64; boxes in it have gaps of at most `gap_m` on every axis.

    mins, maxs: (n, 3) m.
    """
    # Imported here, because every command reads the settings of this module.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first, second = _near_pairs(mins, maxs, gap_m + ROUNDING_M)
    near = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(len(mins), len(mins)))
    _, labels = connected_components(near, directed=False)
    return np.unique(labels, return_index=True)[1][labels]


def _near_pairs(mins: np.ndarray, maxs: np.ndarray, gap_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of boxes, (n, 3) m, with gaps of at most `gap_m` on every axis, in both orders."""
    reach_m = gap_m + 1e-3  # more than rounding
    grown = shapely.box(*(mins[:, :2] - reach_m).T, *(maxs[:, :2] + reach_m).T)
    first, second = shapely.STRtree(grown).query(shapely.box(*mins[:, :2].T, *maxs[:, :2].T))
    is_near = ((mins[second] - maxs[first] <= gap_m) & (mins[first] - maxs[second] <= gap_m)).all(axis=1)
    return first[is_near], second[is_near]


def _filled_parts(
    cluster: np.ndarray, centers: np.ndarray, footprints: np.ndarray, mins: np.ndarray, maxs: np.ndarray,
    min_fill: float,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Halve the rows of a cluster until each part covers at least `min_fill` of the rectangle around it.

    Yield the parts, but no single boxes, which stay as they are.
    """
    waiting = [cluster]
    while waiting:
        part = waiting.pop()
        if len(part) == 1:
            continue
        low = mins[part, :2].min(axis=0)
        high = maxs[part, :2].max(axis=0)
        if min_fill <= 0.0 or _fill_share(footprints[part], low, high) >= min_fill:
            yield part
            continue
        axis = int(high[1] - low[1] > high[0] - low[0])
        waiting += np.split(part[np.argsort(centers[part, axis], kind="stable")], [len(part) // 2])


def _fill_share(footprints: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Return the share of a rectangle's area that turned rectangles, (n, 4, 2) m, cover, by cell centres."""
    size = high - low
    if size.min() <= 0.0:
        return 1.0
    num_cells = np.maximum(1, np.round(FILL_CELLS * size / size.max())).astype(int)
    covered = np.zeros(num_cells[::-1], dtype=np.uint8)
    num_corners = np.full(len(footprints), 4)
    marks = np.ones(len(footprints), dtype=np.uint8)
    mark_hulls((footprints - low) / (size / num_cells), num_corners, 0.5 - TOUCH_M, marks, covered)
    return float(covered.mean())


# --- crop -------------------------------------------------------------------------------------------------------------


def _spanning(box_map: BoxMap, cfg: SimplifyConfig) -> tuple[np.ndarray, float]:
    """Return the rows of vegetation that spans the cut, (k,), and the height of the cut, m."""
    cut_m = box_map.ground_z_m + cfg.cut_height_m
    spans_cut = (box_map.mins[:, 2] < cut_m) & (box_map.maxs[:, 2] > cut_m)
    return np.flatnonzero((box_map.kinds == VEGETATION) & spans_cut), cut_m


def _upright(box_map: BoxMap, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return half sizes and rotations of rows, (k, 3) each; of tilted boxes those of their bounds."""
    half = box_map.half_extents[rows]
    turns = box_map.rotations_deg[rows]
    is_tilted = (turns[:, [0, 2]] != 0).any(axis=1)[:, None]
    return np.where(is_tilted, axis_aligned_half_extents(half, turns), half), np.where(is_tilted, 0.0, turns)


def _feet(box_map: BoxMap, cfg: SimplifyConfig) -> np.ndarray:
    """Return x, y and half widths, (k, 4), of a stem for every vegetation box that spans the cut height.

    They are taken before the merge: a merged grove still has one stem for each of its trees.
    """
    rows, _ = _spanning(box_map, cfg)
    rows = rows[box_map.mins[rows, 2] <= box_map.ground_z_m + FOOT_M]
    half = np.minimum(box_map.half_extents[rows, :2].min(axis=1), cfg.stem_radius_m)
    return np.column_stack([box_map.centers[rows, :2], half, half])


def crop_tree(box_map: BoxMap, cfg: SimplifyConfig, used_ids: np.ndarray, feet: np.ndarray | None) -> BoxMap:
    """Split vegetation that spans the cut height into trunks on the ground and a lifted canopy.

    Boxes wholly below the cut (bushes, hedges) and wholly above it stay as they are, so a second pass changes nothing.

    Args:
        used_ids: ids that new boxes may not take.
        feet: (k, 4) stems below the canopies; None: full footprints.
    Source: sec:step2, "Crop tree operation"; stems are ours.
    """
    rows, cut_m = _spanning(box_map, cfg)
    half, turns = _upright(box_map, rows)
    tops = box_map.maxs[rows, 2]
    canopies = _copied(box_map)
    canopies.centers[rows, 2] = (cut_m + tops) / 2 + cfg.lift_m
    canopies.half_extents[rows] = np.column_stack([half[:, :2], (tops - cut_m) / 2])
    canopies.rotations_deg[rows] = turns
    if feet is None:
        feet = np.column_stack([box_map.centers[rows, :2], half[:, :2]])
    else:
        turns = np.zeros((len(feet), 3))
    num_trunks = len(feet)
    trunks = BoxMap(
        centers=np.column_stack([feet[:, :2], np.full(num_trunks, box_map.ground_z_m + cfg.cut_height_m / 2)]),
        half_extents=np.column_stack([feet[:, 2:], np.full(num_trunks, cfg.cut_height_m / 2)]),
        rotations_deg=turns,
        kinds=np.full(num_trunks, VEGETATION, dtype=np.uint8),
        ids=_free_ids(used_ids, num_trunks),
    )
    return canopies.joined(trunks)


def crop_tree_adaptive(box_map: BoxMap, cfg: SimplifyConfig, used_ids: np.ndarray) -> BoxMap:
    """Cut vegetation that is higher than `adaptive_height_m` into a stem and pieces no higher than that above it.

    The stem is one cell wide and ends at `split_z_m`. The lowest piece above it keeps the id, without one the stem;
    the others get ids that are not in `used_ids`.

    Source: app:simworld:step3, "crop_tree". The paper names three numbers and their purpose, tall trees in shorter
    pieces that do not block the walking grid from afar, but no rule; this one is ours.
    """
    ground_z_m = box_map.ground_z_m
    split_m = ground_z_m + cfg.split_z_m
    lows, highs = box_map.mins[:, 2], box_map.maxs[:, 2]
    is_tall = (box_map.kinds == VEGETATION) & (highs - np.maximum(lows, ground_z_m) > cfg.adaptive_height_m)
    row_of_piece: list[int] = []
    ends: list[tuple[float, float]] = []  # low and high end of each piece
    is_new: list[bool] = []  # whether a piece needs an id of its own
    for row in np.flatnonzero(is_tall).tolist():
        cuts = [float(lows[row])]
        if lows[row] < split_m < highs[row]:
            cuts.append(split_m)
        num_above = int(np.ceil((highs[row] - cuts[-1]) / cfg.adaptive_height_m - 1e-9))
        cuts += np.linspace(cuts[-1], highs[row], num_above + 1)[1:].tolist()
        num_pieces = len(cuts) - 1
        with_id = 1 if num_pieces > 1 and lows[row] < split_m else 0  # the piece above the stem, else the only or first
        row_of_piece += [row] * num_pieces
        ends += pairwise(cuts)
        is_new += [number != with_id for number in range(num_pieces)]
    rows = np.array(row_of_piece, dtype=np.int64)
    low_z, high_z = np.array(ends).reshape(-1, 2).T
    half, turns = _upright(box_map, rows)
    is_stem = ((low_z < split_m) & (low_z <= ground_z_m + FOOT_M))[:, None]
    half[:, :2] = np.where(is_stem, np.minimum(half[:, :2], cfg.cell_size_m / 2), half[:, :2])
    half[:, 2] = (high_z - low_z) / 2
    ids = box_map.ids[rows].copy()
    ids[np.array(is_new, dtype=bool)] = _free_ids(used_ids, sum(is_new))
    centers = np.column_stack([box_map.centers[rows, :2], (low_z + high_z) / 2])
    pieces = BoxMap(centers, half, turns, box_map.kinds[rows], ids)
    return box_map.select(~is_tall).joined(pieces)


def _free_ids(used: np.ndarray, count: int) -> np.ndarray:
    """Return the smallest positive numbers not in use, (count,) uint64. Not max + 1: CARLA's ids fill 64 bits."""
    candidates = np.arange(1, len(used) + count + 1, dtype=np.uint64)
    return candidates[~np.isin(candidates, used)][:count]


def crop_below_ground(box_map: BoxMap, *, clip: bool = False) -> BoxMap:
    """Drop boxes with their top face below the ground; surfaces stay (sec:step2, "Below-ground removal").

    Args:
        clip: also cut off the parts of upright boxes, except surfaces, below the ground, and drop boxes that only just
            reach it (app:simworld:step3). A tilted box has no lower part that is a box, and stays whole.
    """
    ground_z_m = box_map.ground_z_m
    is_surface = box_map.is_any_of(SURFACE_KINDS)
    lows, tops = box_map.mins[:, 2], box_map.maxs[:, 2]
    if not clip:
        return box_map.select((tops >= ground_z_m) | is_surface)
    is_upright = (box_map.rotations_deg[:, [0, 2]] == 0).all(axis=1)
    is_cut = (lows < ground_z_m) & (tops > ground_z_m) & is_upright & ~is_surface
    clipped = _copied(box_map)
    clipped.centers[is_cut, 2] = (tops[is_cut] + ground_z_m) / 2
    clipped.half_extents[is_cut, 2] = (tops[is_cut] - ground_z_m) / 2
    return clipped.select((tops > ground_z_m) | is_surface)


# --- prune ------------------------------------------------------------------------------------------------------------


def prune_nested(box_map: BoxMap, tolerance_m: float) -> BoxMap:
    """Drop boxes that lie inside another of the same kind; of equal boxes the one with the smallest id stays.

    Inside means: all corners of the axis-aligned bounds in the other box as it is turned. For unturned boxes that is
    the paper's rule (sec:step2); for turned ones it never drops a box that sticks out of a turned one's empty corners.
    """
    mins, maxs = box_map.mins, box_map.maxs
    # Bigger first, then the smaller id: a total order, so that two boxes can never drop each other.
    rank = np.empty(len(box_map), dtype=np.int64)
    rank[np.lexsort((box_map.ids, -np.prod(box_map.half_extents, axis=1)))] = np.arange(len(box_map))
    is_tilted = (box_map.rotations_deg[:, [0, 2]] != 0).any(axis=1)
    most_m = tolerance_m + ROUNDING_M
    inner, outer = _near_pairs(mins, maxs, most_m)
    may_hold = (rank[outer] < rank[inner]) & ~is_tilted[outer] & (box_map.kinds[inner] == box_map.kinds[outer])
    may_hold &= ((mins[inner] >= mins[outer] - most_m) & (maxs[inner] <= maxs[outer] + most_m)).all(axis=1)
    inner, outer = inner[may_hold], outer[may_hold]
    keep = np.ones(len(box_map), dtype=bool)
    keep[inner[_fits_inside(box_map, inner, outer, most_m)]] = False
    return box_map.select(keep)


def _fits_inside(box_map: BoxMap, inner: np.ndarray, outer: np.ndarray, most_m: float) -> np.ndarray:
    """Return whether the bounds of each inner box stick out of its turned outer box by at most `most_m`, (k,) bool.

    inner, outer: (k,) rows. Only the sides are compared, not the heights.
    """
    mins, maxs = box_map.mins, box_map.maxs
    yaw = np.radians(box_map.rotations_deg[outer, 1])
    cos, sin = np.cos(yaw), np.sin(yaw)
    half = box_map.half_extents[outer] + most_m
    is_inside = np.ones(len(inner), dtype=bool)
    for x in (mins[inner, 0], maxs[inner, 0]):
        for y in (mins[inner, 1], maxs[inner, 1]):
            dx = x - box_map.centers[outer, 0]
            dy = y - box_map.centers[outer, 1]
            is_inside &= np.abs(dx * cos + dy * sin) <= half[:, 0]
            is_inside &= np.abs(dy * cos - dx * sin) <= half[:, 1]
    return is_inside
