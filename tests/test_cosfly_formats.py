"""Products on disk: round trips, every error names file and field; episodes, goals in words."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from cosfly.formats.boxes import MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.formats.episodes import Episode, EpisodeFrame, episode_file, read_episode, write_episode
from cosfly.formats.frames import PERSON_ID
from cosfly.formats.pedestrian_paths import PedestrianTrajectory, read_paths, write_paths
from cosfly.formats.people import GOAL_TERMS, Appearance, Goal, People, read_goal
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.geometry.goals import SIDES, SLOTS, SeenFrame, find_says, meant, words_of
from cosfly.render.person import choose_appearance, choose_look_alike
from cosfly.runtime.errors import InputError
from specimens import change_json


def some_boxes(n=3, seed=0):
    rng = np.random.default_rng(seed)
    return make_box_map(
        rng.uniform(-100, 100, (n, 3)), rng.uniform(0, 5, (n, 3)), rng.uniform(-180, 180, (n, 3)),
        rng.integers(1, 28, n), header=MapHeader(name="T", ground_z_m=0.0),
    )  # fmt: skip


@given(st.integers(1, 20), st.integers(0, 5))
def test_boxes_round_trip(tmp_path_factory, n, seed):
    path = tmp_path_factory.mktemp("boxes") / "boxes_3d.json"
    boxes = some_boxes(n, seed)
    write_boxes(path, boxes)
    back = read_boxes(path)
    for name in ("centers", "half_extents", "rotations_deg"):
        assert_allclose(getattr(back, name), getattr(boxes, name), atol=1e-6)
    assert (back.kinds.tolist(), back.ids.tolist()) == (boxes.kinds.tolist(), boxes.ids.tolist())
    assert back.name == "T"
    first = path.read_bytes()
    write_boxes(path, back)
    assert path.read_bytes() == first  # idempotent


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda value: value.update(axes="y up"), r"axes: .*got y up; expected right-handed"),
        (lambda value: value["boxes"][2].update(semantic_id=99), r"box 3: semantic_id: .*got 99"),
        (lambda value: value["boxes"][1]["max"].__setitem__(0, 1e4), r"box 2: max: .*half the size in metres"),
        (lambda value: value["boxes"][1]["extent"].__setitem__(0, -1.0), r"box 2: extent: .*numbers from 0 to"),
        (lambda value: value["boxes"][1]["center"].__setitem__(0, 1e9), r"box 2: center: .*to 10,000,000"),
        (lambda value: value.pop("boxes"), r"boxes: .*missing"),
        (lambda value: value.update(boxes={}), r"boxes: .*list"),
        (lambda value: value.update(boxes=[]), "has no boxes"),
    ],
)
def test_fields_of_a_map_that_contradict_each_other_are_named(tmp_path, change, words):
    write_boxes(tmp_path / "boxes_3d.json", some_boxes(4, 0))
    change_json(tmp_path / "boxes_3d.json", change)
    with pytest.raises(InputError, match=words):
        read_boxes(tmp_path / "boxes_3d.json")


T_S = np.arange(4) * 0.5


def a_path():
    places = np.stack([T_S, T_S, 0 * T_S], axis=1)
    return PedestrianTrajectory("path_00000", np.array([[0.0, 0], [3, 4]]), T_S, places, np.ones(4))


def a_trace():
    m = np.stack([T_S, T_S + 1, T_S + 20], axis=1)
    return DroneTrace("path_00000", "muco", T_S, m, m, m, np.ones(4), np.full(4, 5.0), {"a": 1.0}, {"b": 2}, None)


@pytest.mark.parametrize("pace", ["walk", "hurry"])
@pytest.mark.parametrize(
    ("write", "read", "make", "group"),
    [(write_paths, read_paths, a_path, "paths"), (write_traces, read_traces, a_trace, "traces")],
)
def test_path_and_trace_round_trip(tmp_path, write, read, make, group, pace):
    path, one = tmp_path / "p.json", replace(make(), pace=pace)
    write(path, [one], {"map": "T", "seed": 0})
    back = read(path)[0]
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray):
            assert_allclose(getattr(back, name), value)
        else:
            assert getattr(back, name) == value
    for change, words in (
        (lambda record: record["t"].__setitem__(1, "x"), r"t"),
        (lambda one: one["t"].__setitem__(1, one["t"][0]), r"t: the times do not increase; got 0 s, th"),
        (lambda record: record.get("target", record)["y"].__setitem__(1, 1e9), r".*y: a place is too far from"),
    ):
        write(path, [one], {})
        change_json(path, lambda value, change=change, group=group: change(value[group][0]))
        with pytest.raises(InputError, match=rf"{group}\[0\].*{words}"):
            read(path)


def test_the_most_alike_differs_least_the_greatest_id_of_several():
    target = Appearance("man", "jacket", "red", "shorts", "blue")
    one, two = (Appearance("man", "jacket", color, "shorts", color) for color in ("red", "green"))
    people = People(
        target, {9: two, 8: one, 7: one, 6: Appearance("woman", "coat", "pink", "trousers", "pink", "cap", "red")}
    )
    assert people.most_alike([9, 8, 7, 6]) == (8, 1)
    assert people.most_alike([6, 9]) == (9, 2)
    assert people.most_alike([6]) == (6, 4)
    assert people.most_alike([]) == (None, None)


def frame(time_s: float, answer: str, **more) -> EpisodeFrame:
    told = {"answer": answer, "in_view": True, "visible": True, "visibility": 0.9, "num_pixels": 40}
    told |= {"distance_m": 20.0, "height_m": 20.0, "clearance_m": 12.0, "speed_mps": 1.2}
    told |= {"pose": (0, 0, 20, -43, 0, 0), "target_m": (20, 0, 0.9)}
    told["command"] = None if answer == "end" else (1.2, 0.0, 0.0, 0.0, -43.0)
    return EpisodeFrame(time_s=time_s, **told | more)


def record(answers=("lead", "lead", "ok", "late", "end"), **more) -> Episode:
    frames = tuple(frame(0.5 * i, answer) for i, answer in enumerate(answers))
    told = {"student": "rules-7", "engine": "rules", "town": "Town_7", "map_sha256": "ab" * 32, "walk": "path_00000"}
    told |= {"seed": 7, "dt_s": 0.5, "camera_px": (640, 360), "fov_deg": 90.0, "drone_radius_m": 0.5}
    told |= {"episode": "path_00000", "pace": "walk", "ended": "lost", "num_walk_frames": 9, "frames": frames}
    return Episode(**told | more)


def test_a_record_is_read_as_it_was_written_and_tells_lead_and_decisions_apart(tmp_path):
    path = episode_file(tmp_path, "path_00000")
    write_episode(path, record())
    found = read_episode(path)
    assert found == record()
    assert (found.num_lead, [f.answer for f in found.decisions]) == (2, ["ok", "late"])
    assert [f.time_s for f in found.flown] == [1.5, 2.0]  # what came of the two decisions


@pytest.mark.parametrize(("change", "words"), [
    ({"frames": [{"time_s": 0.5}]}, "missing|required"),
    ({"ended": "tired"}, "finished"),
    ({"colour": "red"}, "[Ee]xtra"),
])  # fmt: skip
def test_a_record_that_cannot_be_is_refused(tmp_path, change, words):
    path = tmp_path / "one.json"
    write_episode(path, record())
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=words):
        read_episode(path)


def picture_of(columns: dict[int, int]) -> SeenFrame:
    """Look at people in a row, 20 m away."""
    ids = np.zeros((40, 60), np.uint16)
    for number, column in columns.items():
        ids[20, column] = number
    return SeenFrame(ids, np.full((40, 60), 20.0, np.float32))


def crowd(rng: np.random.Generator) -> tuple[dict[int, Appearance], SeenFrame]:
    """Draw a target, look-alikes, strangers, and one that is out of view and looks just as the target."""
    target = choose_appearance(rng)
    others = [
        choose_look_alike(target, rng) if rng.random() < 0.5 else choose_appearance(rng)
        for _ in range(rng.integers(12))
    ]
    people = {PERSON_ID: target, 1: target} | {65533 - i: one for i, one in enumerate(others)}
    seen = [number for number in people if number != 1]
    return people, picture_of(dict(zip(seen, rng.permutation(np.arange(1, 59))[: len(seen)].tolist(), strict=True)))


def stands_apart(relation: str, picture: SeenFrame, number: int, rivals: list[int]) -> bool:
    where = {n: int(np.nonzero(picture.ids == n)[1][0]) for n in (number, *rivals)}
    sign = {"left": 1, "right": -1}[relation]
    return all(sign * where[number] < sign * where[n] for n in rivals)


def test_a_goal_is_true_of_the_target_alone_and_says_what_is_seen():
    rng = np.random.default_rng(3)
    relations = set()
    for _ in range(250):
        people, picture = crowd(rng)
        target, hidden = people[PERSON_ID], {slot for slot in ("figure", *SLOTS) if rng.random() < 0.4}
        says = find_says(people, picture, lambda slot, other, hidden=hidden: slot not in hidden)
        if says is None:
            continue
        assert [*says] == [one for one in GOAL_TERMS if one in says]
        assert not hidden & {*says}
        assert meant(says, target, people, picture) == {PERSON_ID}
        slots, relation = [s for s in says if s not in SIDES], [s for s in says if s in SIDES]
        rivals = [n for n in people if n not in (PERSON_ID, 1) and not {*slots} & {*target.differences(people[n])}]
        assert len(relation) == bool(rivals)  # a place is said where garments do not do
        assert all(stands_apart(relation[0], picture, PERSON_ID, rivals) for _ in relation)
        relations |= {*relation}
    assert {"left", "right"} <= relations


def test_what_the_picture_does_not_tell_apart_is_not_said_apart():
    red = Appearance("man", "jacket", "red", "shorts", "blue")
    shirt = Appearance("man", "t_shirt", "red", "shorts", "blue")
    people = {PERSON_ID: red, 5: shirt}

    def tells(slot, other):
        return other.top_color != "red" or slot != "top"

    assert find_says(people, picture_of({PERSON_ID: 20, 5: 21}), tells) is None
    assert find_says(people, picture_of({PERSON_ID: 20, 5: 30}), tells) == ("figure", "top", "left")
    assert find_says(people, picture_of({PERSON_ID: 20}), tells) == ("figure", "top")
    assert find_says(people, picture_of({PERSON_ID: 20}), lambda slot, other: False) is None


def test_both_languages_say_the_same_slots():
    looks = Appearance("woman", "jacket", "red", "skirt", "green", "cap", "white", "shoulder", "yellow")
    bare = Appearance("man", "coat", "red", "shorts", "green")
    assert words_of(("figure", "top", "bag", "hat"), looks) == {
        "en": "the woman in the red jacket with the yellow shoulder bag and the white cap",
        "zh": "穿红色夹克、背黄色挎包、戴白色鸭舌帽的女子",
    }
    assert words_of(("legs", "bag", "hat", "right"), bare) == {
        "en": "the rightmost person in the green shorts with no bag and no hat",
        "zh": "最右边的穿绿色短裤、不带包、不戴帽子的行人",
    }


def test_a_goal_is_read_back_and_nothing_else_is():
    goal = Goal(3, "the man in the red coat", "穿红色长大衣的男子", ("figure", "top"))
    record = asdict(goal) | {"says": list(goal.says)}
    assert read_goal(record, 4, "here") == goal
    for broken in ({"frame": 4}, {"zh": None}, {"says": ["figure"]}, {"says": ["top", "figure"]}):
        with pytest.raises(InputError):
            read_goal(record | broken, 4, "here")
