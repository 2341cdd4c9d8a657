"""Text to world: plans by rules and by a model, layout, placement, the world file and back, validity."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from commands import invoke
from pydantic import ValidationError
from tables import each
from teacher_server import TeacherServer

from cosfly.maps.simworld import SimWorldConfig
from cosfly.maps.stage import MapsConfig, load_map
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import read_json, read_model
from cosfly.runtime.run_dir import read_manifest
from cosfly.worldgen.plan import OBJECTS, PLAN_FORMAT, WorldPlan
from cosfly.worldgen.rules import plan_by_rules
from cosfly.worldgen.stage import WorldConfig, check_world, run
from cosfly.worldgen.town import build

PROMPTS = list(csv.DictReader(Path(__file__).with_name("world_prompts.tsv").open(), delimiter="\t"))
COUNTS = {"two": 2, "three": 3, "twelve": 12}


def by_rules(prompt: str) -> WorldPlan:
    return plan_by_rules(prompt, 0)[0]


@pytest.mark.slow
@each("row", PROMPTS, ids=[row["name"] for row in PROMPTS])
def test_a_prompt_gives_a_valid_world_with_each_named_object(row):
    plan = by_rules(row["prompt"])
    town = build(plan, "W", 0)
    assert [one for one in check_world(town, plan) if not one["is_met"]] == []
    assert town.not_placed == []
    named = set(filter(None, row["objects"].split(",")))
    assert {one.name for one in town.placed} == named
    for name in named:
        word = next((word for word in COUNTS if f"{word} {name}" in row["prompt"]), None)
        found = [one.number for one in town.placed if one.name == name]
        assert len(found) == len(set(found)) == (COUNTS[word] if word else 4 if f"{name}s" in row["prompt"]
                                                 or f"{name}es" in row["prompt"] else 1)  # fmt: skip


@pytest.mark.slow
def test_a_world_read_by_the_importer_is_the_one_that_was_laid_out(tmp_path):
    cfg = WorldConfig(prompt="a small village with a hospital, a church and a lawn")
    world = SimWorldConfig(world=run(cfg, tmp_path / "w", seed=3))
    found = load_map(MapsConfig(source="simworld", simworld=world))
    town = build(plan_by_rules(cfg.prompt, 3)[0], cfg.name, 3)
    expected = town.boxes
    assert len(found) == len(expected) > 500
    assert (found.kinds == expected.kinds).all()
    for one, other in ((found.centers, expected.centers), (found.half_extents, expected.half_extents)):
        assert np.abs(one - other).max() < 1e-5
    turned = found.rotations_deg[:, 1] - expected.rotations_deg[:, 1]
    assert np.abs((turned + 180) % 360 - 180).max() < 1e-6


def test_the_same_prompt_and_seed_give_the_same_bytes_and_another_seed_another_world(tmp_path):
    cfg = WorldConfig(prompt="a small village with a well")
    one, two, other = (run(cfg, tmp_path / name, seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    assert one.read_bytes() == two.read_bytes() != other.read_bytes()


@pytest.mark.slow
def test_any_plan_that_can_be_gives_a_world_and_says_what_it_lacks():
    rng = np.random.default_rng(0)
    for _ in range(25):
        low, span = rng.uniform(3, 200), rng.uniform(0, 100)
        values = {
            "blocks_along": int(rng.integers(2, 5)), "block_m": rng.uniform(36, 120), "street_m": rng.uniform(12, 40),
            "avenue_m": rng.uniform(12, 60), "unevenness": rng.uniform(0, 0.3), "gap_m": rng.uniform(0.5, 40),
            "setback_m": rng.uniform(0, 15), "heights_m": (low, low + span), "trees_per_ha": (0.0, rng.uniform(0, 200)),
            "footprint_m": (6.0, rng.uniform(6, 120)), "river_m": rng.choice([0.0, 30.0]), "bridges": int(rng.integers(4)),
            "shore_m": rng.choice([0.0, 60.0]), "lanes": bool(rng.integers(2)), "plazas": int(rng.integers(2)),
            "objects": [{"name": str(name), "count": 2} for name in rng.choice(list(OBJECTS), 5, replace=False)],
        }  # fmt: skip
        try:
            plan = WorldPlan.model_validate(values)
        except ValidationError:
            continue
        town = build(plan, "W", 0)
        assert len(town.placed) + len(town.not_placed) == 10
        checks = {one["check"]: one["is_met"] for one in check_world(town, plan)}
        assert checks["overlapping buildings"]


def test_what_a_prompt_says_there_is_none_of_is_not_there():
    for prompt in ("a village with a well and no fountain or church", "a village without any fountain, with a well"):
        assert [one.name for one in by_rules(prompt).objects] == ["well"]
    plan, trace = plan_by_rules("a tiny ski resort, no high-rise towers, no cars and without trees", 0)
    assert (trace["settlement"], trace["without"]) == ("resort", "high-rise towers cars ")
    assert plan.parked_share == 0.0 < by_rules("a tiny ski resort").parked_share
    assert plan.trees_per_ha == (0.0, 0.0)
    assert [one.name for one in by_rules("a village, no fountain but a well").objects] == ["well"]


@each("prompt", ["asdf qwer zxcv", "一个带喷泉的小村庄", "42"])
def test_a_prompt_of_which_nothing_can_be_read_is_refused_in_words(prompt):
    with pytest.raises(InputError, match=r"rule-based planner recognises no word.*expected an English.*--planner URL"):
        by_rules(prompt)


PLANNED = {
    "blocks_along": 2, "block_m": 46.0, "objects": [{"name": "statue", "count": 1}, {"name": "unicorn", "count": 2}],
}  # fmt: skip


def planned_by(answer: str, out: Path, seed: int = 0, **more):
    with TeacherServer() as server:
        server.text = lambda body: answer
        try:
            run(WorldConfig(prompt="a small town with a statue", planner=server.url, **more), out, seed=seed)
        finally:
            planned_by.bodies = [json.loads(body) for body in server.bodies]
    return out


def test_a_models_plan_is_followed_and_its_trace_kept(tmp_path):
    out = planned_by("<think>a town</think>```json\n" + json.dumps(PLANNED) + "\n```", tmp_path / "w")
    assert read_model(out / "plan.json", WorldPlan, PLAN_FORMAT) == WorldPlan.model_validate(PLANNED)
    trace = read_json(out / "trace.json", what="trace")
    assert trace["answer"].startswith("<think>")
    assert trace["model"] == "test-teacher"
    assert trace["usage"]
    placement = read_json(out / "placement.json", what="placement")
    assert [one["name"] for one in placement["placed"]] == ["statue"]
    assert [one["name"] for one in placement["not_placed"]] == ["unicorn", "unicorn"]
    (body,) = planned_by.bodies
    assert "statue" in body["messages"][0]["content"]
    assert body["seed"] == 0
    assert body["response_format"]["json_schema"]["schema"]["properties"].keys() == WorldPlan.model_fields.keys()


@pytest.mark.slow
def test_worlds_go_on_to_releases_with_the_settings_that_are_told(tmp_path, in_this_process):
    small = ("pedestrians.num_paths=1", "render.width_px=160", "render.height_px=90", "render.frame_stride=8")
    told = [word for setting in small for word in ("--set", setting)]
    result = invoke("world", ["a small village"], "--count 2 --seed 5 --out", [tmp_path / "many"])
    assert result.exit_code == 0, result.output
    for number in range(2):
        folder = tmp_path / f"many/world_{number:03}"
        run_folder = folder / "run"
        result = invoke("run", [folder / "loop.yaml", *told], f"--seed {5 + number} --out", [run_folder])
        assert result.exit_code == 0, result.output
        assert read_manifest(run_folder / "render").counts.kept == 2
        assert (run_folder / "release/dataset/README.md").is_file()
        assert (run_folder / "viewer.html").is_file()
        assert f"seed: {5 + number}\n" in (run_folder / "run.yaml").read_text()
