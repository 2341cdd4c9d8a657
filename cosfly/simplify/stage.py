"""Stage `simplify`: the passes over one map, a report of the walkable ground that they cost, and a picture."""

import logging
from pathlib import Path

import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes, write_boxes
from cosfly.formats.kinds import KINDS, SURFACE_KINDS
from cosfly.geometry.grid import blocks_walking, connected_parts, empty_grid, inflate, occupancy
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.run_dir import StageFolder, Tally
from cosfly.simplify.passes import SimplifyConfig, simplify
from cosfly.viz.topview import TopView, add_caption, draw_map, png_bytes

PICTURE_PX = 1000  # longer side of each half of the picture
SAFETY_RADIUS_M = 0.5  # tab:ped_params; for the walkable area in the report
REPORT_FORMAT = FileFormat("cosfly.simplify_report", "1.0")

log = logging.getLogger(__name__)


def cross_validate(raw: BoxMap, simplified: BoxMap) -> dict:
    """Compare two maps on the pedestrian-height grid of Step 3: cell agreement, IoU, and the walkable area of each.

    The walkable area counts cells that stay free after the safety radius; its largest part is what paths are sampled
    from.
    """
    grid = empty_grid(raw)
    raw_grid = occupancy(raw, like=grid)
    simplified_grid = occupancy(simplified, like=grid)
    was_occupied, is_occupied = raw_grid.occupied, simplified_grid.occupied
    masks = {
        "free_in_both": ~was_occupied & ~is_occupied,
        "occupied_in_both": was_occupied & is_occupied,
        "raw_alone": was_occupied & ~is_occupied,
        "simplified_alone": is_occupied & ~was_occupied,
    }
    for kind in ("Vegetation", "Buildings"):
        is_under = np.zeros_like(was_occupied)
        for box_map in (raw, simplified):
            is_under |= occupancy(box_map.select(box_map.kinds == KINDS[kind]), like=grid).occupied
        masks[f"differ_under_{kind}"] = (was_occupied != is_occupied) & is_under
    counts = {name: int(mask.sum()) for name, mask in masks.items()}
    num_alike = counts["free_in_both"] + counts["occupied_in_both"]
    num_either = was_occupied.size - counts["free_in_both"]
    facts: dict = {
        "cells": list(grid.size),
        "cell_agreement": round(num_alike / was_occupied.size, 4),
        "iou": round(counts["occupied_in_both"] / num_either, 4) if num_either else 1.0,
        "agreement": counts,
    }
    for name, grid_of_map in (("raw", raw_grid), ("simplified", simplified_grid)):
        _, sizes = connected_parts(~inflate(grid_of_map, SAFETY_RADIUS_M).occupied, 8)
        cell_m2 = grid.resolution_m**2
        facts[f"{name}_walkable_m2"] = round(float(sizes.sum()) * cell_m2, 1)
        facts[f"{name}_largest_part_m2"] = round(float(sizes.max()) * cell_m2, 1)
    return facts


def report(raw: BoxMap, result: BoxMap) -> dict:
    """Return the content of `simplify_report.json`."""
    obstacles = {"raw": int(blocks_walking(raw).sum()), "simplified": int(blocks_walking(result).sum())}
    return {
        **REPORT_FORMAT.header,
        "name": raw.name,
        "num_boxes": {"raw": len(raw), "simplified": len(result)},
        "obstacles_at_walking_height": obstacles,
        "passes": [
            {"pass": done.name, "num_boxes": sum(done.counts.values()), "counts": done.counts}
            for done in result.header.passes
        ],
        "grid": cross_validate(raw, result),
    }


def _picture(raw: BoxMap, result: BoxMap, grid_facts: dict) -> bytes:
    """Draw the surfaces and the obstacles at walking height of both maps, side by side, as PNG bytes."""
    view = TopView.around(np.stack(raw.bounds()), PICTURE_PX)
    halves = []
    for title, box_map in (("raw", raw), ("simplified", result)):
        drawn = box_map.select(box_map.is_any_of(SURFACE_KINDS) | blocks_walking(box_map))
        area_m2 = grid_facts[f"{title}_walkable_m2"]
        text = f"{title}: {len(box_map)} boxes, {area_m2:.0f} m2 walkable (drawn: boxes below 2 m)"
        halves.append(add_caption(draw_map(drawn, view), text))
    return png_bytes(np.hstack(halves))


def run(cfg: SimplifyConfig, maps: Path, out: Path) -> Path:
    """Read `boxes_3d.json`; write `step2_simplified.json`, `simplify_report.json` and `simplify.png`."""
    stage = StageFolder.open(out, "simplify", config=cfg, inputs={"maps": maps}, seed=0)
    product = out / "step2_simplified.json"
    if stage.is_complete:
        return product
    raw = read_boxes(maps)
    result = simplify(raw, cfg)
    if len(result) == 0:
        what = "every box of the map lies below the ground"
        fix = "correct ground_z_m in the header of the map"
        raise InputError(what, where=maps, expected="boxes above the ground", fix=fix)
    write_boxes(product, result)
    facts = report(raw, result)
    write_json(out / "simplify_report.json", facts)
    write_bytes(out / "simplify.png", _picture(raw, result, facts["grid"]))
    num_new = len(np.setdiff1d(result.ids, raw.ids))
    log.info("%d boxes became %d, of which %d are stems and pieces of trees", len(raw), len(result), num_new)
    tally = Tally(input=1, kept=1)
    stage.finish([product, out / "simplify_report.json", out / "simplify.png"], tally, num_boxes=facts["num_boxes"])
    return product
