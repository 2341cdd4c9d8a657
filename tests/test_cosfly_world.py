"""Text to world: plans by rules and by a model, layout, placement, the world file and back, validity."""

import csv
import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import shapely
from commands import obeyed
from pydantic import ValidationError
from teacher_server import TeacherServer

from cosfly.maps.footprints import footprints, rectangle_polygon
from cosfly.maps.simworld import SimWorldConfig
from cosfly.maps.stage import MapsConfig, load_map
from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.json_io import read_json
from cosfly.runtime.run_dir import read_manifest
from cosfly.worldgen.plan import OBJECTS, PATH_M, WorldPlan
from cosfly.worldgen.rules import plan_by_rules
from cosfly.worldgen.stage import WorldConfig, check_world, run
from cosfly.worldgen.streets import PATTERNS
from cosfly.worldgen.town import Town, build, of_kinds, trees_of

PROMPTS = list(csv.DictReader(Path(__file__).with_name("world_prompts.tsv").open(), delimiter="\t"))
COUNTS = {"two": 2, "three": 3, "twelve": 12}


def by_rules(prompt: str) -> WorldPlan:
    return plan_by_rules(prompt, 0)[0]


def assert_houses_stand_apart_at_pavements(town: Town) -> None:
    houses = footprints(town.layout.select(of_kinds(town.layout, "Buildings")))
    paved = shapely.union_all(footprints(town.boxes.select(of_kinds(town.boxes, "Sidewalks", "Roads"))))
    first, second = shapely.STRtree(houses).query(shapely.buffer(houses, -0.05), predicate="intersects")
    assert (first == second).all()
    objects = footprints(town.placement.select(of_kinds(town.placement, "Buildings")))
    assert not shapely.STRtree(houses).query(shapely.buffer(objects, -0.05), predicate="intersects").size
    assert (shapely.distance(houses, paved) < 2.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("row", PROMPTS, ids=[row["name"] for row in PROMPTS])
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
            "pattern": str(rng.choice(list(PATTERNS))), "size_m": [None, (170.0, 250.0)][rng.integers(2)],
            "blocks_along": int(rng.integers(2, 5)), "block_m": rng.uniform(36, 120), "street_m": rng.uniform(5, 40),
            "avenue_m": rng.uniform(5, 60), "unevenness": rng.uniform(0, 0.3), "gap_m": rng.uniform(0.5, 40),
            "setback_m": rng.uniform(0, 15), "heights_m": (low, low + span), "trees_per_ha": (0.0, rng.uniform(0, 200)),
            "footprint_m": (6.0, rng.uniform(6, 120)), "river_m": rng.choice([0.0, 30.0]), "bridges": int(rng.integers(4)),
            "plazas": int(rng.integers(2)),
            "objects": [{"name": str(name), "count": 2} for name in rng.choice(list(OBJECTS), 5, replace=False)],
        }  # fmt: skip
        try:
            plan = WorldPlan.model_validate(values)
        except ValidationError:
            continue
        town = build(plan, "W", 0)
        assert len(town.placed) + len(town.not_placed) == 10
        assert_houses_stand_apart_at_pavements(town)


def test_what_a_prompt_says_there_is_none_of_is_not_there():
    for prompt in ("a village with a well and no fountain or church", "a village without any fountain, with a well"):
        assert [one.name for one in by_rules(prompt).objects] == ["well"]
    plan, trace = plan_by_rules("a tiny ski resort, no high-rise towers, no cars and without trees", 0)
    assert (trace["settlement"], trace["without"]) == ("resort", "high-rise towers, ")
    assert plan.parked_share == 0.0 < by_rules("a tiny ski resort").parked_share
    assert plan.trees_per_ha == (0.0, 0.0)
    assert [one.name for one in by_rules("a village, no fountain but a well").objects] == ["well"]


@pytest.mark.parametrize("prompt", ["asdf qwer zxcv", "42", "棋盘式的城市", "a village, 村庄"])
def test_a_prompt_that_cannot_be_read_is_refused_and_a_chinese_one_in_chinese(prompt):
    english = r"rule-based planner recognises no word.*expected an English.*--planner URL"
    chinese = r"只读英文描述.*a small village.*用英文写这段描述, 或用 --planner URL"
    with pytest.raises(InputError, match=english if prompt.isascii() else chinese):
        by_rules(prompt)


@pytest.mark.parametrize(
    ("prompt", "pattern", "settlement"),
    [
        ("Manhattan with wide avenues", "grid", "downtown"),
        ("a city with 6 avenues that meet at a roundabout", "radial", "city"),
        ("an old town of narrow winding streets", "organic", "old town"),
        ("a hamlet along a country road", "linear", "hamlet"),
        ("a university with footpaths between lawns", "campus", "campus"),
    ],
)
def test_the_words_of_a_prompt_choose_the_street_pattern_and_the_settlement(prompt, pattern, settlement):
    plan, trace = plan_by_rules(prompt, 0)
    assert (plan.pattern, trace["settlement"]) == (pattern, settlement)


def test_numbers_and_sizes_of_a_prompt_are_respected():
    prompt = "a suburb of 12 detached houses with two fountains, 300 m x 200 m, no building higher than 8 m"
    plan, trace = plan_by_rules(prompt, 0)
    town = build(plan, "W", 0)
    assert town.built == {"house": 12}
    assert [one.name for one in town.placed] == ["fountain"] * 2
    assert town.size_m == (300.0, 200.0)
    assert np.ptp(town.boxes.bounds(), axis=0)[:2] == pytest.approx([300.0, 200.0], abs=0.5)
    assert town.boxes.maxs[of_kinds(town.boxes, "Buildings"), 2].max() <= 8.0
    assert (trace["not_used"], trace["not_respected"]) == ([], [])
    assert {"12 detached houses", "2 fountains", "300 m x 200 m (size)", "suburb"} <= set(trace["used"])
    assert all(one["is_met"] for one in check_world(town, plan) if one["check"].startswith(("number", "highest")))


def test_what_is_not_respected_is_named_in_the_report_and_in_one_line(tmp_path, caplog):
    prompt = "an airport with a control tower, 90 detached houses, 70 m x 400 m, streets 2 m wide, a purple windmill"
    run(WorldConfig(prompt=prompt), tmp_path / "w")
    checks = read_json(tmp_path / "w/checks.json", what="checks")
    assert checks["words_not_used"] == ["airport", "control tower", "purple"]
    width, size, number = checks["not_respected"]
    assert width == "width of a street, m: 2 is said, 5 is possible"
    assert size == "size of the town, m: 70 is said, 80 is possible"
    assert number.startswith("number of buildings (house)")
    assert [one["is_met"] for one in checks["checks"] if one["check"].startswith("number")] == [False]
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert all(
        name in line for name in ("airport, control tower", "width of a street", "size of the town", "number of build")
    )
    assert plan_by_rules(prompt, 0)[0].heights_m[1] < 20.0  # a control tower makes no city of towers


def test_patterns_and_seeds_give_different_plans():
    """The share of ground that is street in both of two towns, of that which is in one, stays below 0.6."""

    def streets_of(pattern: str | None, seed: int):
        plan = by_rules("a town") if pattern else plan_by_rules("a town", seed)[0]
        plan = plan.model_copy(update={"pattern": pattern or plan.pattern, "size_m": (300.0, 300.0)})
        town = build(plan, "W", seed)
        assert_houses_stand_apart_at_pavements(town)
        yaws = town.layout.rotations_deg[of_kinds(town.layout, "Buildings"), 1] % 90
        is_square = bool((np.minimum(yaws, 90 - yaws) < 1e-6).all())
        assert is_square == (plan.pattern == "grid")
        rectangles = (street.rectangle((0.0, street.length_m), (-8.0, 8.0)) for street in town.network.streets)
        return shapely.union_all([rectangle_polygon(rectangle) for rectangle in rectangles])

    areas = [streets_of(pattern, 0) for pattern in PATTERNS]
    areas += [streets_of("grid", seed) for seed in (1, 2)] + [streets_of(None, seed) for seed in range(3)]
    for one, other in combinations(areas[:-3], 2):
        assert one.intersection(other).area < 0.6 * one.union(other).area
    for one, other in combinations(areas[-3:], 2):
        assert one.intersection(other).area < 0.6 * one.union(other).area


PLANNED = {
    "blocks_along": 2, "block_m": 46.0, "objects": [{"name": "statue", "count": 1}, {"name": "unicorn", "count": 2}],
}  # fmt: skip


def test_a_models_plan_is_followed_and_its_trace_kept(tmp_path):
    out = tmp_path / "w"
    with TeacherServer() as server:
        server.text = lambda body: "<think>a town</think>```json\n" + json.dumps(PLANNED) + "\n```"
        run(WorldConfig(prompt="a small town with a statue", planner=server.url), out)
    assert WorldPlan.model_validate(read_yaml(out / "plan.yaml")) == WorldPlan.model_validate(PLANNED)
    trace = read_json(out / "trace.json", what="trace")
    assert trace["answer"].startswith("<think>")
    assert trace["model"] == "test-teacher"
    assert trace["usage"]
    placement = read_json(out / "placement.json", what="placement")
    assert [one["name"] for one in placement["placed"]] == ["statue"]
    assert [one["name"] for one in placement["not_placed"]] == ["unicorn", "unicorn"]
    body = json.loads(*server.bodies)
    assert "statue" in body["messages"][0]["content"]
    assert body["seed"] == 0
    assert body["response_format"]["json_schema"]["schema"]["properties"].keys() == WorldPlan.model_fields.keys()


@pytest.mark.slow
def test_worlds_go_on_to_releases_with_the_settings_that_are_told(tmp_path, in_this_process):
    small = (
        *("pedestrians.num_paths=1", "render.width_px=160", "render.height_px=90", "render.frame_stride=8"),
        "inspect.legible_min=0",
    )
    told = [word for setting in small for word in ("--set", setting)]
    obeyed("world", ["a small village"], "--count 2 --seed 5 --out", [tmp_path / "many"])
    for number in range(2):
        folder = tmp_path / f"many/world_{number:03}"
        run_folder = folder / "run"
        obeyed("run", [folder / "loop.yaml", *told], f"--seed {5 + number} --out", [run_folder])
        assert read_manifest(run_folder / "render").counts.kept == 2
        report = read_json(run_folder / "pedestrians/pedestrians_report.json", what="report")
        assert report["total"]["on_carriageway_share"] <= 0.02
        assert (run_folder / "release/dataset/README.md").is_file()
        assert (run_folder / "viewer.html").is_file()
        assert f"seed: {5 + number}\n" in (run_folder / "run.yaml").read_text()


def test_a_measure_is_of_what_its_noun_stands_for(tmp_path):
    plan, trace = plan_by_rules(
        "a town of 300 m x 200 m with streets of at most 12 m, two-storey houses, a 20 m tall factory, towers between 40 and "
        "60 m, a square 40 m across, a 30 m high church and a river 25 m wide", 0
    )  # fmt: skip
    assert (plan.size_m, plan.street_m, plan.river_m) == ((300.0, 200.0), 12.0, 25.0)
    assert {kind.name: kind.heights_m for kind in plan.buildings} == {
        "house": (6.0, 6.0), "factory": (20.0, 20.0), "tower": (40.0, 60.0),
    }  # fmt: skip
    assert plan.heights_m == by_rules("a town").heights_m
    assert trace["not_used"] == ["40 m across (of square)", "30 m high (of church)"]
    with pytest.raises(InputError, match=r"no room for a building.*80 m x 80 m"):
        run(WorldConfig(prompt="an old town of 80 m x 80 m with a castle"), tmp_path / "w")


def test_a_limit_of_height_is_for_buildings_not_for_objects():
    for prompt, houses_m in (("a town with houses, at most 12 m high, and a lighthouse", 12.0),
                             ("a town with houses of two or three storeys and a lighthouse", 9.0),
                             ("a town with a church. No building except the church is higher than 12 m", 12.0)):  # fmt: skip
        plan = by_rules(prompt)
        assert max(kind.heights_m[1] for kind in plan.kinds_of_buildings()) <= houses_m
        assert len(plan.objects) == 1


def test_positions_and_forms_are_not_used():
    prompt = "a village with a church in the middle, surrounded by houses with flat roofs, a harbour and no river"
    plan, trace = plan_by_rules(prompt, 0)
    assert trace["not_used"] == ["flat", "middle (position)", "surrounded (position)"]
    assert [kind.name for kind in plan.buildings] == ["house"]
    assert plan.is_shore  # a harbour is no river
    assert trace["not_respected"] == []
    for words in ("flats", "blocks of flats", "4 blocks of flats"):
        (kind,) = plan_by_rules(f"a town with {words}", 0)[0].buildings
        assert (kind.name, kind.count) == ("apartment block", 4 if "4" in words else None)


def test_words_after_no_are_used_only_if_they_change_something():
    for prompt, not_used in (
        ("a town without houses", ["without houses"]),
        ("a town without any sidewalks and no balconies", ["without any sidewalks", "no balconies"]),
        ("a town with no towers, no park, without traffic and without a church", []),
    ):
        trace = plan_by_rules(prompt, 0)[1]
        assert [words for words in trace["not_used"] if words.startswith(("no ", "without"))] == not_used
        assert not set(not_used) & set(trace["used"])


def test_a_few_counted_buildings_stand_among_others():
    for prompt, is_whole in (("an old town with a warehouse", False), ("a suburb with 2 apartment blocks", False),
                             ("a hamlet of 4 cottages", True), ("a port with 12 warehouses", False),
                             ("an industrial park of 12 warehouses", True)):  # fmt: skip
        assert by_rules(prompt).only_these == is_whole, prompt


def test_trees_leave_a_pitch_free_and_jetties_touch_a_bank():
    town = build(by_rules("a suburb with many trees, a football pitch, a river and 3 jetties"), "T", 1)
    places = {name: [obj for obj in town.placed if obj.name == name] for name in ("football pitch", "jetty")}
    (pitch,) = places["football pitch"]
    trees = footprints(town.layout.select(trees_of(town.layout)))
    assert (
        shapely.distance(trees, shapely.Point(pitch.xy)).min()
        > 0.5 * min(OBJECTS["football pitch"].size_m) * pitch.scale
    )
    assert len(places["jetty"]) == 3
    jetties = footprints(town.placement.select(of_kinds(town.placement, "Static") & (town.placement.maxs[:, 2] < 1.0)))
    at_bank = shapely.distance(jetties, town.network.water.boundary) < 0.1
    assert np.count_nonzero(at_bank) == 3


def test_cranes_stand_at_the_water_bridges_are_as_asked_for_and_houses_stand_inside_the_streets():
    plan = by_rules("a harbour with 2 cranes and a footbridge")
    town = build(plan, "W", 0)
    [bridge] = town.network.bridges
    assert (bridge.width_m, bridge.road_m) == (PATH_M, 0.0)
    places = [shapely.Point(one.xy) for one in town.placed if one.name == "crane"]
    assert len(places) == 2
    assert (shapely.distance(places, town.network.water.boundary) < 8.0).all()
    assert build(by_rules("a village by a river without bridges"), "W", 0).network.bridges == []
    shore = build(by_rules("a harbour"), "W", 0)  # along the southern edge; rivers are in the middle
    assert shore.network.water.bounds[1] < 0.01 - shore.size_m[1] / 2 < shore.network.water.bounds[3] < 0.0
    city = build(by_rules("a city with a ring road"), "W", 0)
    ring = shapely.convex_hull(shapely.multipoints([street.start for street in city.network.streets]))
    houses = footprints(city.layout.select(of_kinds(city.layout, "Buildings")))
    assert shapely.contains(ring, houses).all()
    assert by_rules("an industrial park").greens == 0


def test_a_height_of_one_building_is_not_that_of_all():
    for prompt, unused in (("a village with a church whose tower is 30 m tall", "30 m tall"),
                           ("a small town with a church with a 40 m tower", "40 m"),
                           ("a town with 25 buildings, some of them ten floors high", "10 floors high")):  # fmt: skip
        plan, trace = plan_by_rules(prompt, 0)
        assert max(kind.heights_m[1] for kind in plan.kinds_of_buildings()) < 20.0, prompt
        assert any(words.startswith(unused) for words in trace["not_used"])
    assert by_rules("a town with buildings 15-20 m tall").heights_m == (15.0, 20.0)
    assert [kind.count for kind in by_rules("a suburb of 40 single-family houses").buildings] == [40]
    assert by_rules("a large dense old town").blocks_along == 9.0  # the most that is possible
    empty = build(by_rules("a town with a lake and no buildings"), "W", 0)
    assert not of_kinds(empty.layout, "Buildings").any()
    check_world(empty, empty.plan)


def test_an_edited_plan_gives_the_same_town_with_the_change(tmp_path):
    first = run(WorldConfig(prompt="a small village with terraced houses"), tmp_path / "first").parent
    plan = WorldPlan.model_validate(read_yaml(first / "plan.yaml"))
    town = build(plan, "T", 0)
    houses = footprints(town.layout.select(of_kinds(town.layout, "Buildings")))
    distances_m = [shapely.distance(house, np.delete(houses, index)).min() for index, house in enumerate(houses)]
    assert np.median(distances_m) < 0.1  # in rows
    copy = tmp_path / "copy.yaml"
    copy.write_bytes((first / "plan.yaml").read_bytes())
    same = run(WorldConfig(plan=copy), tmp_path / "same")
    assert same.read_bytes() == (first / same.name).read_bytes()
    copy.write_text(copy.read_text().replace("river_m: 0.0", "river_m: 20.0"))
    obeyed("world", str(copy), "--out", str(tmp_path / "river"))
    assert read_yaml(tmp_path / "river/plan.yaml")["river_m"] == 20.0
    copy.write_text("pattern: square\nblok_m: 40\n")
    with pytest.raises(ConfigError, match=r"pattern: Input should be .*blok_m: .*did you mean 'block_m'"):
        run(WorldConfig(plan=copy), tmp_path / "wrong")


def test_an_adjective_changes_what_its_noun_stands_for():
    plan, trace = plan_by_rules("a small, dense town with tall offices, low houses, a large market and a wide river", 0)
    plain = by_rules("a town with offices, houses, a market and a river")
    heights_m, plain_m = (np.array([kind.heights_m for kind in one.buildings]) for one in (plan, plain))
    assert heights_m / plain_m == pytest.approx(np.array([[1.5] * 2, [0.75] * 2]), abs=0.01)  # offices, houses
    assert (plan.street_m, plan.heights_m, plan.plazas) == (plain.street_m, plain.heights_m, plain.plazas)
    assert (plan.blocks_along, plan.river_m) == pytest.approx((0.9 * plain.blocks_along, 1.6 * plain.river_m), abs=0.02)
    assert trace["not_used"] == ["large"]


def test_numbers_of_cars_are_not_used():
    plan, trace = plan_by_rules("a town with narrow houses and about 20 parked cars", 0)
    assert trace["not_used"] == ["20 parked cars", "narrow"]
    assert plan.parked_share == WorldPlan().parked_share
    for words in ("no parked cars", "without any parked cars", "no cars"):
        assert plan_by_rules(f"a town with {words}", 0)[0].parked_share == 0.0
    assert "parked cars (cars)" in plan_by_rules("a town with parked cars", 0)[1]["used"]
