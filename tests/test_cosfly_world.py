"""Text to world: plans by rules and by a model, layout, placement, the world file and back, validity."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import invoke
from pydantic import ValidationError
from teacher_server import TeacherServer
from test_renderers_contract import circling

from cosfly.errors import CosflyError, InputError, TeacherError
from cosfly.geometry import rotation_matrices
from cosfly.maps.boxlist import BoxList
from cosfly.products.kinds import KINDS
from cosfly.reading.documents import read_json, read_model
from cosfly.work.stage_folder import read_manifest
from cosfly.worlds.checks import check_world, compare, unlikeness, ways_apart
from cosfly.worlds.objects import OBJECTS, assets
from cosfly.worlds.plan import PLAN_FORMAT, NamedObject, WorldPlan
from cosfly.worlds.rules import WORDS, check_prompt, plan_by_rules
from cosfly.worlds.settings import WorldConfig
from cosfly.worlds.stage import read_world, run
from cosfly.worlds.town import Town, build, footprints, of_kinds

PROMPTS = list(csv.DictReader(Path(__file__).with_name("world_prompts.tsv").open(), delimiter="\t"))
SIMWORLD = Path(__file__).resolve().parents[2] / "shared/data"
SMALL = WorldPlan(blocks_along=2, block_m=46.0, objects=[NamedObject(name="fountain")])
COUNTS = {"two": 2, "three": 3, "twelve": 12}


def by_rules(prompt: str) -> WorldPlan:
    return plan_by_rules(prompt, 0)[0]


@pytest.mark.parametrize("row", PROMPTS, ids=[row["name"] for row in PROMPTS])
def test_a_prompt_gives_a_valid_world_with_each_named_object(row):
    plan = by_rules(row["prompt"])
    town = build(plan, "W", 0)
    assert [one for one in check_world(town, plan) if not one["is_met"]] == []
    assert town.left_out == []
    named = set(filter(None, row["objects"].split(",")))
    assert {one.name for one in town.placed} == named
    for name in named:
        word = next((word for word in COUNTS if f"{word} {name}" in row["prompt"]), None)
        found = [one.number for one in town.placed if one.name == name]
        assert len(found) == len(set(found)) == (COUNTS[word] if word else 4 if f"{name}s" in row["prompt"]
                                                 or f"{name}es" in row["prompt"] else 1)  # fmt: skip


def test_a_world_read_by_the_importer_is_the_one_that_was_laid_out(tmp_path):
    cfg = WorldConfig(prompt="a small village with a hospital, a church and a lawn")
    found, town = read_world(run(cfg, tmp_path / "w", seed=3)), build(plan_by_rules(cfg.prompt, 3)[0], cfg.name, 3)
    expected = town.boxes
    assert len(found) == len(expected) > 500
    assert (found.kinds == expected.kinds).all()
    for one, other in ((found.centers, expected.centers), (found.half_extents, expected.half_extents)):
        assert np.abs(one - other).max() < 1e-5
    turned = found.rotations_deg[:, 1] - expected.rotations_deg[:, 1]
    assert np.abs((turned + 180) % 360 - 180).max() < 1e-6


def test_what_simworld_has_is_named_as_there(tmp_path):
    product = run(WorldConfig(prompt="a small town with a hospital"), tmp_path / "w")
    names = [node["instance_name"] for node in read_json(product, what="world")["nodes"]]
    assert "BP_Building_87_C" in names  # its table of words calls it a hospital
    known = {name for name in names if name.startswith("BP_Building") or name.startswith("BP_Tree")}
    assert len(known) > 3
    assert known <= assets().keys()
    assert names.count("BP_Road1_C") == 24  # 4 streets of 3 stretches, each way


def test_the_same_prompt_and_seed_give_the_same_bytes_and_another_seed_another_world(tmp_path):
    cfg = WorldConfig(prompt="a small village with a well")
    one, two, other = (run(cfg, tmp_path / name, seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    assert one.read_bytes() == two.read_bytes() != other.read_bytes()
    assert unlikeness([read_world(one), read_world(two)]) == [0.0]
    assert unlikeness([read_world(one), read_world(other)])[0] > 0.2


def test_every_word_of_the_table_gives_a_plan():
    changing = [word for group in WORDS["groups"].values() for one in group.values() for word in one["words"].split()]
    for settlement in (word for one in WORDS["settlements"].values() for word in one["words"].split()):
        for seed, word in enumerate(
            ("", *changing, *WORDS["open"], *(f"{word}s" for word in WORDS["open"]), *WORDS["water"])
        ):
            plan, _ = plan_by_rules(
                f"a {word.replace('-trees', ' trees')} {settlement}, with a {word}, lawns and squares", seed
            )
            assert plan.plazas + plan.greens < plan.blocks_along**2


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
        assert len(town.placed) + len(town.left_out) == 10
        checks = {one["check"]: one["is_met"] for one in check_world(town, plan)}
        assert checks["overlapping buildings"]


def test_a_plan_alone_decides_the_world():
    one, two = (build(SMALL, "W", 5) for _ in range(2))
    assert np.array_equal(one.boxes.centers, two.boxes.centers)
    assert {one.name for one in one.placed} == {"fountain"}


def test_what_a_prompt_says_there_is_none_of_is_not_there():
    for prompt in ("a village with a well and no fountain or church", "a village without any fountain, with a well"):
        assert [one.name for one in by_rules(prompt).objects] == ["well"]
    plan, trace = plan_by_rules("a tiny ski resort, no high-rise towers, no cars and without trees", 0)
    assert (trace["settlement"], trace["without"]) == ("resort", "high-rise towers cars ")
    assert plan.parked_share == 0.0 < by_rules("a tiny ski resort").parked_share
    assert plan.trees_per_ha == (0.0, 0.0)
    assert [one.name for one in by_rules("a village, no fountain but a well").objects] == ["well"]


@pytest.mark.parametrize("prompt", ["asdf qwer zxcv", "一个带喷泉的小村庄", "42"])
def test_a_prompt_of_which_nothing_can_be_read_is_refused_in_words(prompt):
    with pytest.raises(InputError, match=r"nothing that the rules can read.*expected English.*--planner URL"):
        by_rules(prompt)


def test_what_is_refused_leaves_the_folder_to_the_next_try(tmp_path):
    out, broken = tmp_path / "w", tmp_path / "other.json"
    broken.write_text('{"nodes": [')
    for prompt, against in (
        ("a tiny large village", ()),
        ("a tiny village", (broken,)),
        ("a tiny village", (tmp_path,)),
    ):
        with pytest.raises(InputError):
            run(WorldConfig(prompt=prompt), out, against=against)
    run(WorldConfig(prompt="a tiny village"), out)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_towers_of_a_campus_are_higher_than_its_halls(seed):
    plans = [plan_by_rules(f"a campus {more}", seed)[0] for more in ("with towers", "")]
    highest = [
        max(one["got"] for one in check_world(build(plan, "W", seed), plan) if one["check"].startswith("highest"))
        for plan in plans
    ]
    assert highest[0] > 35.0 > 23.0 > highest[1]


def test_words_that_change_nothing_are_told():
    read = {prompt: plan_by_rules(prompt, 0)[1]["not_read"] for prompt in (
        "a tiny ski resort: chalets and a fountain, with three dragons", "a large village with many trees and a river")}  # fmt: skip
    assert list(read.values()) == [["chalets", "ski"], []]


def test_what_no_table_has_is_said_and_counted(tmp_path):
    out = tmp_path / "w"
    run(WorldConfig(prompt="a small town with a fountain, a dragon and three volcanoes"), out)
    placement, counts = read_json(out / "placement.json", what="placement"), read_manifest(out).counts
    assert [one["name"] for one in placement["left_out"]] == ["dragon", "volcanoes"]
    assert counts.dropped == {"not_in_the_object_table": 2}
    assert counts.kept == 2


def test_nothing_overlaps_an_object_and_it_stands_in_the_open():
    town = build(by_rules(next(row["prompt"] for row in PROMPTS if row["name"] == "castle")), "W", 0)
    layout, placed = footprints(town.layout), footprints(town.placement)
    standing = of_kinds(town.layout, "Buildings", "Walls", "Vegetation", "Static")
    walls = of_kinds(town.placement, "Buildings")
    assert walls.sum() == 6
    assert not any(layout[standing][k].intersection(wall).area > 0.01
                   for wall in placed[walls] for k in range(int(standing.sum())))  # fmt: skip


@pytest.mark.parametrize(
    ("prompt", "word"),
    [("", "0 characters"), ("  \n ", "0 characters"), ("?!", "2 characters"), ("x" * 2001, "2001 characters")],
)
def test_a_prompt_that_says_nothing_is_refused(prompt, word):
    with pytest.raises(InputError, match="cannot be planned") as caught:
        check_prompt(prompt)
    assert word in str(caught.value)


@pytest.mark.parametrize(
    ("prompt", "word"),
    [
        ("a small large city", "words of size"),
        ("a dense and sparse town", "words of density"),
        ("a town with no trees and many trees", "words of vegetation"),
        ("towers between 120 and 60 m", "heights"),
        ("a town with houses of at least 50 m and at most 20 m", "heights"),
    ],
)
def test_what_contradicts_itself_is_refused_in_one_line(prompt, word, tmp_path):
    with pytest.raises(InputError, match=f"contradictory {word}"):
        by_rules(prompt)
    result = invoke("world", [prompt], "--out", [tmp_path / "w"])
    assert isinstance(result.exception, CosflyError)
    assert "\n" not in str(result.exception)


def test_each_check_can_fail():
    plan = SMALL.model_copy(
        update={"trees_per_ha": (300.0, 400.0), "heights_m": (3.0, 4.0), "building_share": (0.7, 0.8)}
    )
    town = build(SMALL, "W", 0)
    more = BoxList()
    roof = np.argmax(town.layout.maxs[:, 2] * of_kinds(town.layout, "Buildings"))
    more.add("Buildings", town.layout.centers[roof][:2] + 1.0, (6.0, 6.0), 0.0, 5.0)  # into another
    more.add("Buildings", (500.0, 500.0), (6.0, 6.0), 0.0, 2.0)  # beyond all pavements
    broken = Town(town.settings, town.layout.joined(more.box_map()), town.placement)
    failed = {one["check"] for one in check_world(broken, plan) if not one["is_met"]}
    assert failed == {
        "overlapping buildings", "buildings without a pavement", "building share", "lowest building, m",
        "highest building, m", "trees per hectare",
    }  # fmt: skip
    paved = town.layout.select(np.flatnonzero(~of_kinds(town.layout, "Sidewalks", "Roads")))
    failed = {
        one["check"] for one in check_world(Town(town.settings, paved, town.placement), SMALL) if not one["is_met"]
    }
    assert {"length of the largest walkable component, m", "walkable ground in it"} <= failed


# --- a language model plans -------------------------------------------------------------------------------------------

PLANNED = {
    "blocks_along": 2,
    "block_m": 46.0,
    "objects": [{"name": "statue", "count": 1}, {"name": "unicorn", "count": 2}],
}


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
    assert [one["name"] for one in placement["left_out"]] == ["unicorn", "unicorn"]
    (body,) = planned_by.bodies
    assert "statue" in body["messages"][0]["content"]
    assert body["seed"] == 0
    assert body["response_format"]["json_schema"]["schema"]["properties"].keys() == WorldPlan.model_fields.keys()


def test_nothing_is_asked_twice_for_the_same_prompt_and_seed(tmp_path):
    with TeacherServer() as server:
        server.text = lambda body: json.dumps(PLANNED)
        cfg = WorldConfig(prompt="a small town", planner=server.url)
        one, two = run(cfg, tmp_path / "a"), run(cfg, tmp_path / "b")
        assert len(server.bodies) == 1
        assert one.read_bytes() == two.read_bytes()
        run(cfg, tmp_path / "c", seed=1)
        assert len(server.bodies) == 2


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("What a lovely town! I would start with a square.", ("holds no plan", "no_json_object", "What a lovely")),
        ("", ("planner", "empty")),
        (json.dumps({"heights_m": [30, 10]}), ("heights_m", "30 to 10")),
        (json.dumps({"blocks_along": 400}), ("blocks_along", "400")),
        (json.dumps({"blocks_along": 2, "plazas": 3, "greens": 1}), ("leave no block",)),
        (json.dumps({"blocks_along": 2, "dragons": 3}), ("dragons",)),
    ],
)
def test_an_answer_that_is_no_plan_is_one_line(tmp_path, answer, words):
    cfg = {"endpoint": {"max_tries": 1}}
    with pytest.raises((TeacherError, InputError)) as caught:
        planned_by(answer, tmp_path / "w", **cfg)
    assert all(word in str(caught.value) for word in words)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "w/manifest.json").exists()


def test_a_budget_that_is_spent_asks_nothing(tmp_path):
    with pytest.raises(TeacherError, match="tokens are used"):
        planned_by(json.dumps(PLANNED), tmp_path / "w", budget={"max_tokens": 10})
    assert planned_by.bodies == []


def test_ways_are_apart_by_their_shape_alone():
    bent = [circling(40), circling(60)]
    turn = rotation_matrices(np.radians([[0.0, 70.0, 0.0]]))[0]
    moved = [
        replace(one, targets_m=one.targets_m @ turn.T + 9.0, positions_m=one.positions_m @ turn.T + 9.0) for one in bent
    ]
    higher = [replace(one, positions_m=one.positions_m + np.array([0.0, 0.0, 8.0])) for one in bent]
    same, up, up_again = ways_apart([bent, moved, higher])
    assert same < 1e-6
    assert up == pytest.approx(4.0, abs=0.01)
    assert up_again == pytest.approx(up, abs=0.01)


# --- the command ------------------------------------------------------------------------------------------------------


def test_several_worlds_are_unlike(tmp_path):
    out = tmp_path / "many"
    result = invoke("world", ["a small village"], "--count 3 --out", [out])
    assert result.exit_code == 0, result.output
    found = read_json(out / "diversity.json", what="diversity")
    assert found["worlds"] == 3
    assert len(found["pairs"]) == 3
    assert found["least_unlike"] > 0.2


@pytest.mark.slow
def test_worlds_go_on_to_releases_with_the_settings_that_are_told(tmp_path):
    small = ("pedestrians.num_paths=1", "render.width_px=160", "render.height_px=90", "render.frame_stride=8")
    told = [word for setting in small for word in ("--set", setting)]
    result = invoke("world", ["a small village", *told], "--count 2 --run --seed 5 --out", [tmp_path / "many"])
    assert result.exit_code == 0, result.output
    assert read_json(tmp_path / "many/diversity.json", what="diversity")["ways_apart_m"][0] > 1.0
    for number in range(2):
        run_folder = tmp_path / f"many/world_{number:03}/run"
        assert read_json(run_folder / "roi_polygon.json", what="region")["points_world"]
        assert read_manifest(run_folder / "render").counts.kept == 2
        assert (run_folder / "release/dataset/README.md").is_file()
        assert (run_folder / "preview.gif").is_file()
        assert f"seed: {5 + number}\n" in (run_folder / "run.yaml").read_text()


@pytest.mark.skipif(not SIMWORLD.is_dir(), reason="the shared data are not here")
def test_distributions_are_compared_with_a_city_of_simworld():
    city = read_world(SIMWORLD / "simworld-progen/progen_world.json")
    assert [row["distance"] for row in compare(city, city)] == [0.0, 0.0, 0.0]
    heights = compare(build(SMALL, "W", 0).boxes, city)[2]
    assert heights["other"][1] > 50 > heights["ours"][1]
    assert heights["distance"] > 0.5


def test_the_table_of_objects_can_be_placed():
    assert len(OBJECTS) >= 35
    for one in OBJECTS.values():
        assert min(one.size_m) > 0, one.name
        assert {part[0] for part in one.parts} <= KINDS.keys(), one.name
