"""Who else moves: the product, lanes of a map, and the placing of people and cars about a walk."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosfly.formats.boxes import BoxMap, MapHeader, make_box_map, write_boxes
from cosfly.formats.bystanders import Bystander, Bystanders, read_bystanders, write_bystanders
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.pedestrians.bystanders import bystanders_of, gaps_m
from cosfly.pedestrians.lanes import lanes_of
from cosfly.pedestrians.stage import PedestriansConfig, make_pedestrian, run, walkable_ground
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for

PERSON, CAR = "Pedestrians", "Car"


def crossing_town(*more: tuple[str, tuple, tuple]) -> BoxMap:
    """Two carriageways of 8 m that cross at the origin, pavement all about; more: (kind, center, half_extents)."""
    rows = [
        ("Sidewalks", (0, 0, -0.2), (80, 80, 0.15)), ("Roads", (0, 0, -0.1), (80, 4, 0.1)),
        ("Roads", (0, 42, -0.1), (4, 38, 0.1)), ("Roads", (0, -42, -0.1), (4, 38, 0.1)), *more,
    ]  # fmt: skip
    kinds = [KINDS[row[0]] for row in rows]
    header = MapHeader(name="Crossing")
    return make_box_map(
        [row[1] for row in rows], [row[2] for row in rows], np.zeros((len(rows), 3)), kinds, header=header
    )


def standing(kind: str, x: float, y: float, heading_rad: float = 0.0, n: int = 2) -> Bystander:
    return Bystander(kind, np.tile([x, y, 0.0], (n, 1)), np.full(n, heading_rad))


def going(kind: str, start, end, n: int = 2) -> Bystander:
    start, end = np.array([*start, 0.0]), np.array([*end, 0.0])
    places = start + np.linspace(0.0, 1.0, n)[:, None] * (end - start)
    return Bystander(kind, places, np.full(n, np.arctan2(*(end - start)[1::-1])))


def test_others_round_trip_and_bad_files(tmp_path):
    path = tmp_path / "others.json"
    write_bystanders(
        path,
        [
            Bystanders("p", [going(CAR, (0, 0), (4, 3)), replace(standing(PERSON, 1, 1), is_look_alike=True)]),
            Bystanders("q", []),
        ],
        {"map": "T"},
    )
    first, second = read_bystanders(path)
    assert (first.path_id, second.path_id, second.others) == ("p", "q", [])
    assert [other.kind for other in first.others] == [CAR, PERSON]
    assert [other.is_look_alike for other in first.others] == [False, True]
    np.testing.assert_allclose(first.others[0].positions_m, [[0, 0, 0], [4, 3, 0]])
    np.testing.assert_allclose(first.others[0].headings_rad, np.arctan2(3, 4), atol=1e-5)
    for old, new, words in (
        ('"Car"', '"Tank"', r"paths\[0\]\.others\[0\]\.kind: .*'Tank'.*Pedestrians or Car"),
        ('"Car"', '["Car"]', r"paths\[0\]\.others\[0\]\.kind"),
        ('"x":[0.0,4.0]', '"x":[0.0]', r"paths\[0\]\.others\[0\]\.y"),
        ('"x":[0.0,4.0]', '"x":[0.0,null]', r"paths\[0\]\.others\[0\]\.x"),
        ('"id":"q"', '"id":7', r"paths\[1\]\.id"),
    ):
        text = path.read_text()
        assert old in text
        (tmp_path / "bad.json").write_text(text.replace(old, new, 1))
        with pytest.raises(InputError, match=words):
            read_bystanders(tmp_path / "bad.json")
    value = json.loads(path.read_text())
    for axis in ("x", "y", "z", "yaw"):
        value["paths"][0]["others"][1][axis].append(1.0)
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=r"paths\[0\]\.others.*|different lengths"):
        read_bystanders(path)


CFG = PedestriansConfig(others=6, look_alikes=2, traffic=6, pace={"walk": 1, "stop_and_look": 1, "turn_back": 1})


@pytest.fixture(scope="module")
def placed():
    box_map = crossing_town(("Buildings", (40, 40, 5), (20, 20, 5)), ("Buildings", (-40, 40, 5), (20, 20, 5)))
    ground, lanes = walkable_ground(box_map, CFG), lanes_of(box_map)
    made = []
    for k in range(4):
        walk = make_pedestrian(f"p{k}", ground, CFG, rng_for(0, "pedestrians", str(k))).trajectory
        made.append((walk, bystanders_of(walk, ground, lanes, CFG, rng_for(0, "others", str(k)))))
    return box_map, ground, lanes, made


def test_nobody_meets_anybody(placed):
    for walk, bystanders in placed[3]:
        everybody = [Bystander(PERSON, walk.positions_m, np.zeros(len(walk.time_s))), *bystanders.others]
        for k, one in enumerate(everybody):
            assert len(one.positions_m) == len(walk.time_s)
            for two in everybody[:k]:
                assert gaps_m(one, two).min() >= 0.0
                apart = np.linalg.norm(one.positions_m - two.positions_m, axis=1).min()
                assert apart >= 0.6


def test_people_walk_where_people_walk_and_cars_drive_on_the_road(placed):
    _, ground, _, made = placed
    kinds = [other.kind for _, bystanders in made for other in bystanders.others]
    assert kinds.count(PERSON) >= 20
    assert kinds.count(CAR) >= 12
    for walk, bystanders in made:
        for other in bystanders.others:
            step_mps = np.linalg.norm(np.diff(other.positions_m, axis=0), axis=1) / np.diff(walk.time_s)
            assert step_mps.max() <= (10.0 if other.kind == CAR else 2.0)
            assert step_mps.max() > 0.5, "somebody who moves"
            if other.kind == PERSON:
                x, y = ground.grid.cells_at(other.positions_m).T
                assert not ground.grid.occupied[y, x].any()
            else:
                x, y = np.abs(other.positions_m[:, :2]).T
                assert (np.minimum(x, y) < 4.0 + 1e-6).all()
                turn = np.abs(np.degrees(np.diff(np.unwrap(other.headings_rad))))
                assert turn.max() < 60.0, "a car turns along its way"
                moving = step_mps > 1.0
                along = np.diff(other.positions_m[:, :2], axis=0)[moving]
                heading = other.headings_rad[:-1][moving]
                ahead = (along * np.column_stack([np.cos(heading), np.sin(heading)])).sum(axis=1)
                assert (ahead > 0.5 * np.linalg.norm(along, axis=1)).all(), "forwards"


def test_the_same_numbers_give_the_same_company_and_more_keep_the_first(placed):
    _, ground, lanes, made = placed
    walk, bystanders = made[0]
    again = bystanders_of(walk, ground, lanes, CFG, rng_for(0, "others", "0"))
    assert dump_json(again.as_json()) == dump_json(bystanders.as_json())
    other = bystanders_of(walk, ground, lanes, CFG, rng_for(1, "others", "0"))
    assert dump_json(other.as_json()) != dump_json(bystanders.as_json())
    fewer = bystanders_of(
        walk, ground, lanes, CFG.model_copy(update={"others": 2, "traffic": 0}), rng_for(0, "others", "0")
    )
    assert [o.as_json() for o in fewer.others] == [o.as_json() for o in bystanders.others[:2]]
    assert {o.kind for o in bystanders_of(walk, ground, [], CFG, np.random.default_rng(0)).others} == {PERSON}, (
        "no road"
    )


@pytest.mark.slow
def test_the_stage_writes_others_only_where_they_are_wanted(tmp_path: Path, caplog):
    write_boxes(tmp_path / "map.json", crossing_town(("Terrain", (0, 0, -1.0), (90, 90, 0.5))))
    plain = PedestriansConfig(num_paths=3)
    run(plain, tmp_path / "map.json", tmp_path / "none")
    assert not (tmp_path / "none/others.json").exists()
    assert "others" not in json.loads((tmp_path / "none/pedestrians_report.json").read_text())
    cfg = plain.model_copy(update={"others": 3, "traffic": 2})
    for folder, workers in (("one", 1), ("two", 2)):
        run(cfg, tmp_path / "map.json", tmp_path / folder, workers=workers)
    one, two = ((tmp_path / folder / "others.json").read_bytes() for folder in ("one", "two"))
    assert one == two
    walks, companions = read_paths(tmp_path / "one/path.json"), read_bystanders(tmp_path / "one/others.json")
    assert [walk.path_id for walk in walks] == [bystanders.path_id for bystanders in companions]
    for before, walk in zip(read_paths(tmp_path / "none/path.json"), walks, strict=True):
        np.testing.assert_array_equal(before.positions_m, walk.positions_m)
    counts = json.loads((tmp_path / "one/pedestrians_report.json").read_text())["others"]
    placed = [
        sum(other.kind == kind for bystanders in companions for other in bystanders.others) for kind in (PERSON, CAR)
    ]
    assert counts == {PERSON: {"wanted": 9, "placed": placed[0]}, CAR: {"wanted": 6, "placed": placed[1]}}
