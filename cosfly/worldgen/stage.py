"""`cosfly world PROMPT`: from a prompt to a world that SimWorld and our importer load (app:simworld:step1)."""

import asyncio
import logging
import re
from collections import Counter
from pathlib import Path
from typing import Any, ClassVar, TypedDict

import numpy as np
import shapely
import yaml
from pydantic import Field

from cosfly.formats.boxes import OUR_LICENCE
from cosfly.llm.answers import AnswerBook, KeptAnswers
from cosfly.llm.client import ChatClient, EndpointConfig
from cosfly.llm.contract import NoAnswer, Reply, started
from cosfly.maps.footprints import footprints
from cosfly.maps.simworld import PLACEHOLDER_CM
from cosfly.runtime.config import Config, read_yaml, shipped
from cosfly.runtime.config import build as build_config
from cosfly.runtime.errors import InputError, TeacherError, counts_text, nearest
from cosfly.runtime.io import sha256_bytes, write_bytes
from cosfly.runtime.json_io import FileFormat, validated, write_json
from cosfly.runtime.model_json import find_object
from cosfly.runtime.run_dir import StageFolder, Tally, hold_folder
from cosfly.viz.topview import TopView, draw_labels, draw_map, draw_scale, png_bytes
from cosfly.worldgen.plan import OBJECTS, WorldPlan, assets
from cosfly.worldgen.rules import plan_by_rules
from cosfly.worldgen.town import CM_PER_M, MOST_OF_BLOCK, Town, build, layout_nodes, of_kinds, placement_nodes, trees_of

log = logging.getLogger(__name__)

WORLD_FILE, SIZES_FILE, LOOP_FILE = "combined_world.json", "Bbox.json", "loop.yaml"
CHECKS_FORMAT = FileFormat("cosfly.world_checks", "1.0", "checks of a world")
CREDITS = "cosfly; sizes of assets by SimWorld, maitrix-org and contributors"
MOST_CHARACTERS = 2000  # of a prompt
PICTURE_PX = 1000  # longer side of the picture
MOST_LABELS = 12  # objects or buildings of a name that the picture labels
CARS = ("Car", "Truck")
ROAD_COST = 20  # a metre of carriageway away from crossings costs as much as 20 m of pavement

TASK = """You plan a town for a generator that lays out streets, blocks and buildings. The user describes the town.
Answer with one JSON object and nothing else. It has these fields, each of them optional:
{fields}
In `buildings`, list the kinds of buildings that the user names, with their number if it is said.
Words of the user that no field holds go into `not_used`.
Choose ranges wide enough that a random town meets them, and as narrow as the user's description."""


class PlannerEndpointConfig(EndpointConfig):
    """Sampling of a planner, whose answers are longer."""

    own_names: ClassVar[dict[str, str]] = {"caption.endpoint": "world.endpoint"}
    max_tokens: int = Field(2048, ge=64, description="longest plan, tokens")


class WorldConfig(Config):
    """A world from text."""

    prompt: str = Field("", description="description of the world, in plain English; a language model may take others")
    plan: Path | None = Field(None, description="plan.yaml of another world, edited or not, in place of a prompt")
    name: str = Field("TextWorld", min_length=1, max_length=60, description="name of the world's map")
    planner: str | None = Field(
        None, description="URL of the language model that plans the world; empty: built-in rules plan it"
    )
    endpoint: PlannerEndpointConfig = Field(PlannerEndpointConfig(), description="requests to the language model")


class WorldCheck(TypedDict):
    """A check of a world, as in `checks.json`."""

    check: str
    got: float
    least: float
    most: float
    is_met: bool


def _check(name: str, got: float, least: float, most: float) -> WorldCheck:
    is_met = bool(least - 1e-6 <= got <= most + 1e-6)
    return {"check": name, "got": round(float(got), 4), "least": least, "most": most, "is_met": is_met}


def check_world(town: Town, plan: WorldPlan) -> list[WorldCheck]:
    """Compare a world with the ranges of its plan."""
    world = town.boxes
    houses = town.layout.select(of_kinds(town.layout, "Buildings"))
    kinds = plan.kinds_of_buildings()
    low = min((kind.heights_m[0] for kind in kinds), default=0.0)
    high = max((kind.heights_m[1] for kind in kinds), default=0.0)
    heights_m = houses.maxs[:, 2] if len(houses) else [low]
    checks = [
        _check("building share", shapely.area(footprints(houses)).sum() / town.land_m2, *plan.building_share),
        _check("lowest building, m", min(heights_m), low, high),
        _check("highest building, m", max(heights_m), low, high),
        _check("trees per hectare", trees_of(world).sum() / town.land_m2 * 1e4, *plan.trees_per_ha),
    ]
    for kind in kinds:
        if kind.count is not None:
            checks.append(_check(f"number of buildings ({kind.name})", town.built[kind.name], kind.count, kind.count))
    num_planned, num_open = plan.plazas + plan.greens, len(_open_blocks(town, plan))
    checks.append(_check("plazas and green blocks", num_open, num_planned, max(num_planned, num_open)))
    return checks


def _not_respected(checks: list[WorldCheck], town: Town, trace: dict[str, Any]) -> list[str]:
    """Return what of a plan the world does not respect."""
    unmet = [
        f"{check['check']} ({check['got']:g}, expected {check['least']:g} to {check['most']:g})"
        for check in checks if not check["is_met"]
    ]  # fmt: skip
    if trace.get("choices", {}).get("town", {}).get("cars") == "many" and not of_kinds(town.layout, *CARS).any():
        unmet.append("parked cars (the streets are too narrow)")
    return trace.get("not_respected", []) + unmet


def _problems(not_respected: list[str], town: Town, trace: dict[str, Any]) -> str:
    """Return one line that names what of a prompt the world does not respect; empty where it respects all."""
    missing = Counter(
        f"{name} ({reason}{'' if name in OBJECTS else nearest(name, list(OBJECTS))})"
        for name, reason in town.not_placed
    )
    lists = {
        "not respected": not_respected,
        "not placed": [f"{count} x {name}" if count > 1 else name for name, count in missing.items()],
        "words not used": trace["not_used"],
    }
    parts = [f"{title}: {', '.join(phrases)}" for title, phrases in lists.items() if phrases]
    if not trace.get("settlement_is_named", True):
        parts.insert(0, f"no kind of place that the generator has is named, so this is a {trace['settlement']}")
    return "; ".join(parts)


def plan_by_model(cfg: WorldConfig, prompt: str, seed: int, answers: Path) -> tuple[WorldPlan, dict[str, Any]]:
    """Return a model's plan of a prompt, asked for or recorded, and the trace: the question and the answer."""
    fields = "\n".join(
        f"- {name}: {field.description}; else {field.default!r}" for name, field in WorldPlan.model_fields.items()
    )
    task = TASK.format(fields=fields)
    messages = [{"role": "system", "content": task}, {"role": "user", "content": prompt}]
    request = cfg.endpoint.request(messages, [], WorldPlan.model_json_schema(), seed)
    client = ChatClient(cfg.planner or "", cfg.endpoint)
    name = sha256_bytes(prompt.encode())[:16]

    async def ask() -> Reply:
        with hold_folder(answers), AnswerBook(answers) as book:
            async with started(client):
                return await KeptAnswers(client, book).ask(request, name, name, "plan")

    try:
        reply = asyncio.run(ask())
    except NoAnswer as error:
        fix = error.fix or "check the server of --planner"
        raise TeacherError("the language model gave no answer", where=client.url, got=str(error), fix=fix) from None
    trace = {
        "planner": "model", "url": cfg.planner, "model": client.model, "seed": seed, "messages": messages,
        "answer": reply.text, "finish_reason": reply.finish_reason,
        "usage": reply.usage.model_dump() if reply.usage else None,
    }  # fmt: skip
    where = f"{cfg.planner}: plan"
    answer = find_object(reply.text, WorldPlan.model_fields.keys(), reply.finish_reason)
    if answer.value is None:
        raise TeacherError(
            "the answer of the language model contains no plan", where=where,
            got=f"{answer.reason}: {' '.join(reply.text.split())[:80]!r}", expected="a JSON object",
            fix="try another --seed, prompt or model, or omit --planner to plan by rules without a model",
        )  # fmt: skip
    plan = validated(WorldPlan, answer.value, where)
    return plan, trace | {"not_used": plan.not_used}


def run(cfg: WorldConfig, out: Path, *, seed: int = 0) -> Path:
    """Make a world from a prompt or a plan; return the path of `combined_world.json`, which has Bbox.json next to it.

    The other products: trace.json, plan.yaml, layout.json, placement.json, checks.json, map.png, and loop.yaml, the
    settings for `cosfly run` on the world.
    """
    prompt = " ".join(cfg.prompt.split())
    if not cfg.plan and (not re.search(r"\w", prompt) or len(prompt) > MOST_CHARACTERS):
        expected = f"1 to {MOST_CHARACTERS} characters, such as 'a small village with a church'"
        got = f"{len(prompt)} characters"
        raise InputError("the prompt is empty or too long", where="PROMPT", got=got, expected=expected)
    inputs = {"plan": cfg.plan} if cfg.plan else {}
    stage = StageFolder.open(out, "world", config=cfg, inputs=inputs, seed=seed)
    product = out / WORLD_FILE
    if stage.is_complete:
        return product
    if cfg.plan:
        plan, trace = build_config(WorldPlan, read_yaml(cfg.plan), cfg.plan), {"planner": "file", "not_used": []}
    elif cfg.planner:
        plan, trace = plan_by_model(cfg, prompt, seed, out.parent / "answers")
    else:
        plan, trace = plan_by_rules(prompt, seed)
    write_json(out / "trace.json", {"prompt": prompt, **trace})
    write_bytes(out / "plan.yaml", plan.to_yaml().encode())
    if "used" in trace:
        log.info("words used: %s", ", ".join(trace["used"]))
    town = build(plan, cfg.name, seed)
    if plan.kinds_of_buildings() and not town.built:
        size = " x ".join(f"{side_m:.0f} m" for side_m in town.size_m)
        what = "the town has no room for a building"
        fix = (
            f"make the town larger, or its blocks and streets smaller, in the text or in a copy of {out / 'plan.yaml'}"
        )
        raise InputError(what, where=cfg.plan or "PROMPT", got=f"{size}, blocks of {plan.block_m:.0f} m", fix=fix)
    _write_world(town, out)
    checks = check_world(town, plan)
    not_respected = _not_respected(checks, town, trace)
    unread = {"not_respected": not_respected, "words_not_used": trace["not_used"]}
    write_json(out / "checks.json", {**CHECKS_FORMAT.header, "checks": checks, **unread})
    write_bytes(out / "map.png", _picture(town, plan))
    _write_settings(cfg.name, product, out / LOOP_FILE)
    if problems := _problems(not_respected, town, trace):
        log.warning("%s", problems)
    by_seed = "" if trace.get("pattern_is_named", True) else " (chosen by the seed)"
    water = f" and water {plan.river_m:g} m wide" if plan.river_m else ""
    counts = Counter([name for name, _ in _open_blocks(town, plan)] + [obj.name for obj in town.placed])
    counts.update({kind.name: town.built[kind.name] for kind in plan.kinds_of_buildings()})
    counts["parked car"] = int(of_kinds(town.layout, *CARS).sum())
    place = f"the {trace['settlement']}" if "settlement" in trace else "a town"
    size = " x ".join(f"{side_m:.0f} m" for side_m in town.size_m)
    log.info("%s of %s has %s streets%s%s; placed: %s", place, size, plan.pattern, by_seed, water, counts_text(counts))
    num_kept = 1 + len(town.placed)
    dropped = Counter(reason.replace(" ", "_") for _, reason in town.not_placed)
    tally = Tally(input=num_kept + len(town.not_placed), kept=num_kept, dropped=dropped)
    files = ("trace.json", "plan.yaml", "layout.json", "placement.json", WORLD_FILE, SIZES_FILE, "checks.json")
    outputs = [out / name for name in (*files, "map.png", LOOP_FILE)]
    stage.finish(outputs, tally, num_boxes=len(town.boxes), is_valid=all(check["is_met"] for check in checks))
    log.info("the town from above: %s", out / "map.png")
    log.info("to change the town, edit a copy of %s, then: cosfly world COPY --out NEW", out / "plan.yaml")
    few = "--set pedestrians.num_paths=2"  # 20 take ten times as long
    log.info("make a small data set of it with: cosfly run %s %s --out %s", out / LOOP_FILE, few, out / "run")
    return product


def _open_blocks(town: Town, plan: WorldPlan) -> list[tuple[str, shapely.Polygon]]:
    """Return the open blocks that were asked for, with their names, but for those that objects fill."""
    objects = shapely.union_all(footprints(town.placement.select(of_kinds(town.placement, "Buildings"))))
    named = zip(["plaza"] * plan.plazas + ["green"] * plan.greens, town.open_blocks, strict=False)
    return [(name, block) for name, block in named if objects.intersection(block).area < MOST_OF_BLOCK * block.area]


def _picture(town: Town, plan: WorldPlan) -> bytes:
    """Draw a town from above, with the names of its open blocks and objects, as PNG bytes."""
    view = TopView.around(np.stack(town.boxes.bounds()), PICTURE_PX)
    picture = draw_map(town.boxes, view)
    labels = [
        (obj.name, obj.xy)
        for obj in town.placed if obj.number < MOST_LABELS and OBJECTS[obj.name].where != "layout"
    ]  # fmt: skip
    labels += [place for place in town.counted if town.built[place[0]] <= MOST_LABELS]
    for name, block in _open_blocks(town, plan):
        if not any(block.covers(shapely.Point(xy)) for _, xy in labels):
            labels.append((name, block.centroid.coords[0]))
    draw_labels(picture, [(name, view.pixels(np.array([xy]))[0]) for name, xy in labels])
    draw_scale(picture, view)
    return png_bytes(picture)


def _write_settings(name: str, world_file: Path, path: Path) -> None:
    """Write settings for `cosfly run` on a world: those of the paper's appendix."""
    settings = read_yaml(shipped("simworld.yaml")) | {"name": "world"}
    world = {"name": name, "world": str(world_file.resolve()), "licence": OUR_LICENCE, "credits": CREDITS}
    settings["pedestrians"]["road_cost"] = ROAD_COST
    settings["maps"] = {"source": "simworld", "simworld": world}
    text = "# cosfly run THIS_FILE --out DIR\n" + yaml.safe_dump(settings, sort_keys=False)
    write_bytes(path, text.encode())


def _write_world(town: Town, out: Path) -> None:
    """Write layout, placement, both merged, and the sizes of the assets that they use."""
    layout = layout_nodes(town)
    placed = placement_nodes(town)
    write_json(out / "layout.json", {"nodes": layout}, indent=None)
    missing = [{"name": name, "reason": reason} for name, reason in town.not_placed]
    placement = {"nodes": placed, "placed": [obj._asdict() for obj in town.placed], "not_placed": missing}
    write_json(out / "placement.json", placement)
    width, height = map(round, town.size_m)
    base = {"name": town.name, "env_bin": "", "width": width, "height": height}
    write_json(out / WORLD_FILE, {"base_map": base, "nodes": layout + placed}, indent=None)
    groups: dict[str, dict[str, Any]] = {"buildings": {}, "elements": {}}
    for name in sorted({node["instance_name"] for node in layout + placed} - {"BP_Road1_C"}):
        size = [PLACEHOLDER_CM if name.startswith("BP_") else CM_PER_M] * 3
        if name in assets():
            size = [CM_PER_M * length_m for length_m in assets()[name]]
        group = groups["buildings" if name.startswith("BP_Building") else "elements"]
        group[name] = {"bbox": dict(zip("xyz", size, strict=True))}
    write_json(out / SIZES_FILE, {name: group for name, group in groups.items() if group})
