"""`cosfly world PROMPT`: from a prompt to a world that SimWorld and our importer load.

Source: app:simworld:step1.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import cosfly
from cosfly.look.topview import TopView, draw_map, png_bytes
from cosfly.maps.simworld import PLACEHOLDER_CM
from cosfly.products.boxes import OUR_LICENCE
from cosfly.reading.documents import FileFormat
from cosfly.work.config import read_yaml, shipped
from cosfly.work.stage_folder import Resume, StageFolder, Tally
from cosfly.work.store import write_bytes, write_json, write_model
from cosfly.worlds.checks import check_world
from cosfly.worlds.objects import OBJECTS, assets
from cosfly.worlds.plan import PLAN_FORMAT
from cosfly.worlds.planner import plan_by_model
from cosfly.worlds.rules import check_prompt, plan_by_rules
from cosfly.worlds.settings import WorldConfig
from cosfly.worlds.town import CM_PER_M, Town, build, road_nodes, world_nodes

log = logging.getLogger(__name__)

WORLD_FILE, SIZES_FILE, LOOP_FILE = "combined_world.json", "Bbox.json", "loop.yaml"
CHECKS_FORMAT = FileFormat("cosfly.world_checks", "1.0", "checks of a world")
CREDITS = "cosfly; sizes of assets by SimWorld, maitrix-org and contributors"


def run(cfg: WorldConfig, out: Path, *, seed: int = 0, resume: Resume = "if-same") -> Path:
    """Reads a prompt; writes trace.json, plan.json, layout.json, placement.json, combined_world.json with Bbox.json,
    checks.json, map.png, and loop.yaml: settings for `cosfly run` on it.

    Raises:
        InputError: the prompt cannot be planned. TeacherError: the language model gives no plan.
    """
    prompt = check_prompt(cfg.prompt)
    stage = StageFolder.open(out, "world", config=cfg, inputs={}, seed=seed, resume=resume)
    product = out / WORLD_FILE
    if stage.is_complete:
        return product
    if cfg.planner:
        plan, trace = plan_by_model(
            prompt, seed, cfg.planner, cfg.endpoint, cfg.budget, cfg.cache or out.parent / "answers"
        )
    else:
        plan, trace = plan_by_rules(prompt, seed)
    write_json(out / "trace.json", {"prompt": prompt, **trace})
    if trace.get("not_read"):
        log.info("words that changed nothing: %s", ", ".join(trace["not_read"]))
    write_model(out / "plan.json", plan, PLAN_FORMAT)
    town = build(plan, cfg.name, seed)
    _write_world(town, out, seed)
    checks = check_world(town, plan)
    write_json(out / "checks.json", {**CHECKS_FORMAT.header, "checks": checks})
    view = TopView.around(np.stack(town.boxes.bounds()), 1000)
    write_bytes(out / "map.png", png_bytes(draw_map(town.boxes, view)))
    write_bytes(out / LOOP_FILE, _loop_settings(cfg, out).encode())
    for one in checks:
        if not one["is_met"]:
            log.warning("%(check)s: %(got)g, expected %(least)g to %(most)g", one)
    for name, why in town.left_out:
        log.warning("not placed: %s (%s)", name, why)
    num_kept = 1 + len(town.placed)
    dropped = Counter(why.replace(" ", "_") for _, why in town.left_out)
    files = [
        "trace.json",
        "plan.json",
        "layout.json",
        "placement.json",
        WORLD_FILE,
        SIZES_FILE,
        "checks.json",
        "map.png",
    ]
    tally = Tally(input=num_kept + len(town.left_out), kept=num_kept, dropped=dropped)
    outputs = [out / name for name in (*files, LOOP_FILE)]
    stage.finish(outputs, tally, num_boxes=len(town.boxes), is_valid=all(one["is_met"] for one in checks))
    return product


def _write_world(town: Town, out: Path, seed: int) -> None:
    """Write layout, placement, both merged, and the sizes of the assets that they use."""
    layout = road_nodes(town.settings, seed) + world_nodes(town.layout)
    ids, named = ["way"] * len(town.placement), list[str | None]([None]) * len(town.placement)
    for one in town.placed:
        for row in range(*one.rows):
            ids[row], named[row] = f"OBJ_{one.name.replace(' ', '_')}_{one.number}", OBJECTS[one.name].asset
    placed = world_nodes(town.placement, ids, named)
    write_json(out / "layout.json", {"nodes": layout}, indent=None)
    write_json(
        out / "placement.json",
        {"nodes": placed, "placed": [one._asdict() for one in town.placed],
         "left_out": [{"name": name, "why": why} for name, why in town.left_out]},
    )  # fmt: skip
    side = round(town.settings.size_m)
    base = {"name": town.settings.name, "env_bin": "", "width": side, "height": side}
    write_json(out / WORLD_FILE, {"base_map": base, "nodes": layout + placed}, indent=None)
    used = sorted({node["instance_name"] for node in layout + placed} - {"BP_Road1_C"})
    groups: dict[str, dict[str, Any]] = {"buildings": {}, "elements": {}}
    for name in used:
        if name in assets():
            size = [CM_PER_M * side for side in assets()[name]]
        else:
            size = [PLACEHOLDER_CM if name.startswith("BP_") else CM_PER_M] * 3
        group = groups["buildings" if name.startswith("BP_Building") else "elements"]
        group[name] = {"bbox": dict(zip("xyz", size, strict=True))}
    write_json(out / SIZES_FILE, {name: group for name, group in groups.items() if group})


def _loop_settings(cfg: WorldConfig, out: Path) -> str:
    """Give the settings of a run on the world: those that ship for SimWorld (the appendix's), with this world."""
    settings = read_yaml(shipped("simworld.yaml"))
    world = {
        "name": cfg.name, "world": str((out / WORLD_FILE).resolve()), "tool": f"cosfly world {cosfly.__version__}",
        "licence": OUR_LICENCE, "credits": CREDITS, "stand_m": 0.0,
    }  # fmt: skip
    settings["maps"] = {"source": "simworld", "simworld": world}
    return "# cosfly run THIS_FILE --out DIR\n" + yaml.safe_dump(settings | {"name": "world"}, sort_keys=False)
