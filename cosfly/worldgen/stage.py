"""`cosfly world PROMPT`: from a prompt to a world that SimWorld and our importer load.

Source: app:simworld:step1.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import shapely
import yaml

import cosfly
from cosfly.formats.boxes import OUR_LICENCE, BoxMap
from cosfly.formats.kinds import GROUND_KINDS
from cosfly.llm.answers import AnswerBook, KeptAnswers
from cosfly.llm.budget import Budget, BudgetConfig
from cosfly.llm.client import ChatClient, EndpointConfig
from cosfly.llm.contract import NoAnswer, Reply, started
from cosfly.maps.simworld import PLACEHOLDER_CM
from cosfly.runtime.config import read_yaml, shipped
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.io import sha256_bytes, write_bytes
from cosfly.runtime.json_io import FileFormat, validated, write_json, write_model
from cosfly.runtime.model_json import find_object
from cosfly.runtime.run_dir import Resume, StageFolder, Tally, hold_folder
from cosfly.viz.topview import TopView, draw_map, png_bytes
from cosfly.worldgen.objects import OBJECTS, assets
from cosfly.worldgen.plan import PLAN_FORMAT, WorldPlan
from cosfly.worldgen.rules import check_prompt, plan_by_rules
from cosfly.worldgen.settings import WorldConfig
from cosfly.worldgen.town import CM_PER_M, Town, build, footprints, land_m2, of_kinds, road_nodes, trees_of, world_nodes

CELL_M = 0.5
HEAD_M = 2.0  # what is higher does not stand in a walker's way
STEP_M = 0.25  # what is lower does not either
AT_THE_DOOR_M = 2.0  # from a building to the pavement it is reached by
WALK_M = 100.0  # the longest walk that must find room: app:simworld:step4 samples 50 to 100 m
OVERLAP_M = 0.05


class Buildings(NamedTuple):
    """Buildings as they are seen from above: boxes that touch are one. polygons (n,), tops_m (n,)."""

    polygons: np.ndarray
    tops_m: np.ndarray


def buildings_of(box_map: BoxMap) -> Buildings:
    rows = np.flatnonzero(of_kinds(box_map, "Buildings"))
    boxes = box_map.select(rows)
    outlines = footprints(boxes)
    joined = shapely.get_parts(shapely.union_all(shapely.buffer(outlines, 0.02, join_style="mitre")))
    tops = np.zeros(len(joined))
    part, box = shapely.STRtree(outlines).query(joined, predicate="intersects")
    np.maximum.at(tops, part, boxes.maxs[box, 2])
    return Buildings(joined, tops)


def check_world(town: Town, plan: WorldPlan) -> list[dict[str, Any]]:
    """Return each check of a world: its name, what was found, what is expected, whether it holds."""
    world, buildings = town.boxes, buildings_of(town.boxes)
    own = buildings_of(town.layout)
    reached, component_m, share = _reach(world, buildings)
    low, high = plan.heights_m
    extra = 3.0 if plan.lanes else 0.0  # ridges of old houses stand on their walls
    heights_m = own.tops_m if len(own.tops_m) else np.array([low])
    trees = trees_of(world).sum() / land_m2(town) * 1e4
    covered = shapely.area(own.polygons).sum() / land_m2(town)

    def check(name: str, got: float, least: float, most: float) -> dict[str, Any]:
        is_met = bool(least - 1e-6 <= got <= most + 1e-6)
        return {"check": name, "got": round(float(got), 4), "least": least, "most": most, "is_met": is_met}

    return [
        check("overlapping buildings", _num_overlaps(world), 0, 0),
        check("buildings without a pavement", len(buildings.polygons) - reached, 0, 0),
        check("length of the largest walkable component, m", component_m, WALK_M, 1e5),
        check("walkable ground in it", share, 0.8, 1.0),
        check("building share", covered, *plan.building_share),
        check("lowest building, m", heights_m.min(), low, high + extra),
        check("highest building, m", heights_m.max(), low, high + extra),
        check("trees per hectare", trees, *plan.trees_per_ha),
    ]


def _num_overlaps(box_map: BoxMap) -> int:
    """Count pairs of boxes of buildings that share more than a sliver of space."""
    boxes = box_map.select(np.flatnonzero(of_kinds(box_map, "Buildings")))
    outlines = shapely.buffer(footprints(boxes), -OVERLAP_M / 2, join_style="mitre")
    one, other = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    above = np.minimum(boxes.maxs[one, 2], boxes.maxs[other, 2]) - np.maximum(boxes.mins[one, 2], boxes.mins[other, 2])
    return int(((one < other) & (above > OVERLAP_M)).sum())


def _reach(box_map: BoxMap, buildings: Buildings) -> tuple[int, float, float]:
    """Return how many buildings stand at the largest walkable component, its length, its share of all that is walkable.

    Walkable is what is paved, roads with it, and free up to a walker's head.
    """
    low = box_map.bounds()[0][:2]
    shape = np.ceil((box_map.bounds()[1][:2] - low) / CELL_M).astype(int)[::-1] + 1
    blocked = (box_map.maxs[:, 2] > STEP_M) & (box_map.mins[:, 2] < HEAD_M) & ~box_map.is_any_of(GROUND_KINDS)
    outlines = footprints(box_map)
    walkable = _drawn(outlines[of_kinds(box_map, "Sidewalks", "Roads")], low, shape, CELL_M)
    walkable[
        _drawn(outlines[blocked | of_kinds(box_map, "Water") & (box_map.maxs[:, 2] > 0)], low, shape, CELL_M) > 0
    ] = 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(walkable)
    if count < 2:
        return 0, 0.0, 0.0
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    length_m = CELL_M * float(np.hypot(*stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]))
    near = cv2.dilate(
        (labels == largest).astype(np.uint8), np.ones((2 * int(AT_THE_DOOR_M / CELL_M) + 1,) * 2, np.uint8)
    )
    reached = sum(
        bool((near & _drawn(np.array([polygon]), low, shape, CELL_M)).any()) for polygon in buildings.polygons
    )
    return reached, length_m, stats[largest, cv2.CC_STAT_AREA] / stats[1:, cv2.CC_STAT_AREA].sum()


def _drawn(polygons: np.ndarray, low: np.ndarray, shape: np.ndarray, cell_m: float) -> np.ndarray:
    picture = np.zeros(shape, np.uint8)
    for polygon in polygons:
        corners = np.round((np.asarray(polygon.exterior.coords)[:, :2] - low) / cell_m - 0.5).astype(np.int32)
        cv2.fillPoly(picture, [corners], 1)
    return picture


TASK = """You plan a town for a generator that lays out streets, blocks and buildings. The user says what it shall be.
Answer with one JSON object and nothing else. It has these fields, each of them optional:
{fields}
In `objects`, list once, with its count, everything that the user names and this table holds: {objects}.
What the user names and neither the table nor a field holds goes into `not_in_table`, by its name.
Choose ranges wide enough that a town drawn at random meets them, and as narrow as what the user says."""


def plan_by_model(
    prompt: str, seed: int, url: str, endpoint: EndpointConfig, budget: BudgetConfig, cache: Path
) -> tuple[WorldPlan, dict[str, Any]]:
    """Ask a model for the plan of a prompt, or take the answer that it gave before to the same prompt and seed.

    Returns:
        the plan, and the trace: what was asked and answered, to the letter.
    """
    schema = WorldPlan.model_json_schema()
    fields = "\n".join(
        f"- {name}: {one.description}; else {one.default!r}" for name, one in WorldPlan.model_fields.items()
    )
    task = TASK.format(fields=fields, objects=", ".join(OBJECTS))
    messages = [{"role": "system", "content": task}, {"role": "user", "content": prompt}]
    request = endpoint.request(messages, [], schema, seed)
    model, reply = asyncio.run(_ask(request, url, endpoint, budget, cache, sha256_bytes(prompt.encode())[:16]))
    trace = {
        "planner": "model", "url": url, "model": model, "seed": seed, "messages": messages, "answer": reply.text,
        "finish_reason": reply.finish_reason, "usage": reply.usage.model_dump() if reply.usage else None,
    }  # fmt: skip
    return plan_of(reply.text, reply.finish_reason, f"{url}: plan"), trace


def plan_of(text: str, finish_reason: str | None, where: str) -> WorldPlan:
    """Read the plan out of a model's answer; raises TeacherError where there is none, InputError for one that cannot
    be."""
    found = find_object(text, WorldPlan.model_fields.keys(), finish_reason)
    if found.value is None:
        raise TeacherError(
            "the planner's answer holds no plan",
            where=where,
            got=f"{found.reason}: {' '.join(text.split())[:80]!r}",
            expected="a JSON object",
            fix="try another --seed, prompt or model, or leave out --planner: the rules need no model",
        )
    return validated(WorldPlan, found.value, where)


async def _ask(
    request: Any, url: str, endpoint: EndpointConfig, budget: BudgetConfig, cache: Path, name: str
) -> tuple[str, Reply]:
    client = ChatClient(url, endpoint)
    with hold_folder(cache), AnswerBook(cache) as book:
        async with started(client):
            limit = Budget(budget, book.totals, first_prompt=1500, first_completion=endpoint.max_tokens)
            try:
                return client.model, await KeptAnswers(client, book, limit).ask(request, name, name, "plan")
            except NoAnswer as error:
                raise TeacherError(
                    "the planner gave no answer", where=url, got=str(error), fix=error.fix or None
                ) from None


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
    """Return the settings of a run on the world: those that ship for SimWorld (the appendix's), with this world."""
    settings = read_yaml(shipped("simworld.yaml"))
    world = {
        "name": cfg.name, "world": str((out / WORLD_FILE).resolve()), "tool": f"cosfly world {cosfly.__version__}",
        "licence": OUR_LICENCE, "credits": CREDITS, "stand_m": 0.0,
    }  # fmt: skip
    settings["maps"] = {"source": "simworld", "simworld": world}
    return "# cosfly run THIS_FILE --out DIR\n" + yaml.safe_dump(settings | {"name": "world"}, sort_keys=False)
