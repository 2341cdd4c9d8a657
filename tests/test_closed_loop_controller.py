"""What a decision is flown as and how a flight ends; figures of closed-loop flights, counted by hand; the leaderboard."""

import json

import numpy as np
import pytest
from commands import invoke, obeyed
from specimens_planning import CANYON, town_of, walk_along
from test_cosfly_formats import frame, record

from caption.schema import FutureMotion
from caption.verification.actions import TABLE, Motion, Thresholds, measure
from cosfly.closed_loop.controller import Controller, read_controls
from cosfly.closed_loop.engines import EngineDecision
from cosfly.closed_loop.measures import MEASURES, score_episodes
from cosfly.closed_loop.measures import measure as measure_episode
from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stage import OpenEpisode
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.formats.captions import TOKENS
from cosfly.formats.episodes import SCORE, SCORE_FORMAT, episode_file, read_score, write_episode
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.settings import RenderConfig
from cosfly.runtime.json_io import write_model


@pytest.fixture(scope="module")
def begin():
    town = town_of()
    airspace = Airspace(RenderConfig(width_px=320, height_px=180, fovs_deg=(90.0,)), town, town)
    walk = walk_along("path_00000", [(0, 0), (60, 0)])
    plan = plan_trajectory(walk, airspace.surroundings.obstacles, PlanConfig(), 0)

    def start(num_lead=40):
        flight = ClosedLoopTrajectory(airspace, plan, num_lead=num_lead)
        moment = flight.reset()[-1]
        return flight, Controller(read_controls(), Drone(), moment), moment

    yield start
    airspace.renderer.close()


def flown(begin, *tokens) -> Motion:
    flight, controller, moment = begin()
    before_mps = float(np.linalg.norm(moment.velocity_mps))
    moments = [moment]
    for token in tokens:
        moments.append(flight.step(controller.command(token, moments[-1])))
    future = FutureMotion(
        tuple(m.index for m in moments[1:]),
        *(np.array([getattr(m, name) for m in moments]) for name in ("time_s", "position_m")),
        np.array([m.rotation_deg[1] for m in moments]),
        np.array([m.target_m for m in moments]),
        np.array([m.target.visible for m in moments]),
        before_mps,
    )
    return measure(future)


@pytest.mark.slow
@pytest.mark.parametrize("token", [t for t in TOKENS if t != "search_to_reacquire_target"])
def test_a_decision_that_is_flown_for_its_horizon_shows_what_its_own_rule_asks_for(begin, token):
    motion = flown(begin, *[token] * 5)  # 2.5 s, as labels look ahead
    if token in ("break_off", "return_to_home"):  # orders of a mission; who leaves without one leaves the person
        assert motion.approach_m <= -Thresholds().approach_m
        return
    shown = TABLE.rules[token].shown
    assert shown(motion) >= 1.0, (token, shown(motion), motion)


@pytest.mark.parametrize("command", [(99.0, 0, 0, 0, 0), (0, 0, 0, float("nan"), 0), (0, 0)])
def test_a_command_that_cannot_be_flown_is_the_students_failure_and_the_drone_hovers(begin, command):
    flight, _, moment = begin()
    under_way = OpenEpisode("path_00000", flight, read_controls(), 1)
    under_way.step(EngineDecision("ok", command=np.array(command)))
    frame = under_way.frames[-1]
    assert (frame.answer, frame.action, frame.command[:4]) == ("invalid", None, (0, 0, 0, 0))
    assert under_way.moments[-1].index == moment.index + 1


@pytest.fixture(scope="module")
def airspace():
    town = town_of(*CANYON)
    airspace = Airspace(RenderConfig(width_px=160, height_px=90, fovs_deg=(90.0,)), town, town, seed=1)
    yield airspace
    airspace.renderer.close()


@pytest.fixture(scope="module")
def planned(airspace):
    walk = walk_along("path_00000", [(0, 0), (100, 0)])
    return plan_trajectory(walk, airspace.surroundings.obstacles, PlanConfig(), 1)


def after(flight: ClosedLoopTrajectory, *commands) -> list:
    moments = list(flight.reset())
    for command in commands:
        if flight.ended is None:
            moments.append(flight.step(np.array([*command, -44.0])))  # its pitch
    return moments


def test_a_held_command_is_reached_as_fast_as_the_drone_can_and_no_faster(airspace, planned):
    drone = Drone(accel_max_mps2=2.0, yaw_accel_max_degps2=20.0)
    flight = ClosedLoopTrajectory(airspace, planned, drone=drone)
    moments = after(flight, *[(0.0, 0.0, 1.0, 20.0)] * 6)[4:]
    velocities = np.array([m.velocity_mps for m in moments])
    assert np.linalg.norm(np.diff(velocities, axis=0), axis=1).max() <= 2.0 * flight.dt_s + 1e-9
    assert velocities[-1] == pytest.approx([0, 0, 1.0])
    yaws = np.unwrap([m.rotation_deg[1] for m in moments], period=360.0)
    assert yaws[-1] - yaws[-2] == pytest.approx(20.0 * flight.dt_s)
    assert moments[-1].position_m[2] - moments[-2].position_m[2] == pytest.approx(0.5)


def test_who_flies_into_the_ground_or_a_house_has_crashed_before_it_and_flies_no_more(airspace, planned):
    for command in ((0, 0, -4.0, 0), (0, 8.0, -2.0, 0)):
        flight = ClosedLoopTrajectory(airspace, planned)
        last = after(flight, *[command] * 40)[-1]
        assert flight.ended == "crashed"
        assert last.clearance_m < flight.drone.radius_m
        assert last.position_m[2] > 0
        assert abs(last.position_m[1]) < 8  # the houses begin there
        with pytest.raises(ValueError, match="reason: crashed"):
            flight.step(np.zeros(5))


def test_who_leaves_the_person_is_lost_and_who_leaves_the_map_has_left(airspace, planned, monkeypatch):
    flight = ClosedLoopTrajectory(airspace, planned, lost_s=2.0)
    after(flight, *[(0, 0, 0, 60.0)] * 3, *[(0, 0, 0, 0.0)] * 20)
    assert flight.ended == "lost"
    small = ClosedLoopTrajectory(airspace, planned)
    monkeypatch.setattr(small.airspace, "bounds_m", (np.full(3, 0.0), np.full(3, 1.0)))
    after(small, *[(-10.0, 0, 4.0, 0)] * 40)
    assert small.ended == "left"


def flight(seen="", *, walk="path_0", ended="finished", num_walk_frames=None, **columns):
    """A flight whose frames after the first decision show the person ("1") or not ("0")."""
    frames = [frame(0.0, "lead"), frame(0.5, **{"answer": "ok"} | {k: v[0] for k, v in columns.items()})]
    for i, one in enumerate(seen, 1):
        more = {k: v[i] for k, v in columns.items() if i < len(v)}
        answer = "end" if i == len(seen) else more.pop("answer", "ok")
        if answer == "end":
            more.pop("action", None), more.pop("answer", None)
        frames.append(frame(0.5 + 0.5 * i, answer, visible=one == "1", **more))
    num = num_walk_frames or len(seen)
    return record(frames=tuple(frames), walk=walk, episode=walk, ended=ended, num_walk_frames=num)


def of(one):
    return {name: a / b if b else None for name, (a, b) in measure_episode(one).sums.items()}


def test_flights_that_are_counted_by_hand():
    found = of(flight("1100001101", num_walk_frames=20, ended="left"))  # one loss of 4 frames, one blink
    assert found["visible"] == 5 / 20
    assert (found["tracked_frames"], found["lost"]) == (5, 1)
    assert (found["kept_s"], found["success"], found["left"], found["crashed"]) == (1.0, 0, 1, 0)
    answers, actions = ["ok", "late", "ok", "ok", "ok"], ["hover", None, "yaw_left", "yaw_left", "hover"]
    one = flight("11111", answer=answers, action=actions)
    assert of(one)["no_decision"] == 1 / 5
    assert sum(measure_episode(one).answers.values()) == len(one.decisions)


def test_success_is_what_stands_in_the_module():
    for seen, more, success in [
        ("1111", {}, 1),
        ("1000", {}, 1),  # hidden for 1.5 s: not lost yet
        ("10000", {}, 0),  # lost at the end
        ("10000001", {}, 1),  # lost and found again
        ("1111", {"ended": "crashed"}, 0),
        ("1111", {"distance_m": [20.0, 20.0, 20.0, 20.0, 41.0]}, 0),  # too far at the end
        ("1111", {"distance_m": [20.0, 60.0, 20.0, 20.0, 20.0]}, 1),
    ]:  # fmt: skip
        assert of(flight(seen, **more))["success"] == success


def test_a_score_adds_up_and_is_read_as_written(tmp_path):
    flights = [flight("11" * (k + 1), walk=f"path_{k}") for k in range(4)] + [flight("10000", walk="path_9")]
    score = score_episodes(flights)
    assert score.figures["success"].value == 4 / 5
    assert score.figures["visible"].value == (2 + 4 + 6 + 8 + 1) / (2 + 4 + 6 + 8 + 5)
    assert score.figures["success"].low <= 4 / 5 <= score.figures["success"].high
    assert score.figures["success"].count == len(flights)
    assert set(score.figures) == set(MEASURES)
    write_model(tmp_path / SCORE, score, SCORE_FORMAT)
    assert read_score(tmp_path) == score


GOOD, BAD = "1111111111", "1111100000"


def folder(root, name, seen, *, student=None, most_decisions=0, **columns):
    flights = [flight(one, walk=f"path_{k}", **columns) for k, one in enumerate(seen)]
    flights = [one.model_copy(update={"student": student or name}) for one in flights]
    for one in flights:
        write_episode(episode_file(root / name, one.episode), one)
    write_model(root / name / SCORE, score_episodes(flights, most_decisions=most_decisions), SCORE_FORMAT)
    return root / name


def board(out, *words):
    obeyed(f"leaderboard {' '.join(map(str, words))} --out {out}")
    return json.loads((out / "leaderboard.json").read_text())["tables"], (out / "leaderboard.html").read_text()


def test_the_best_is_first_and_foreign_words_are_escaped(tmp_path):
    worse = folder(tmp_path, "worse", [GOOD, BAD, BAD], student="<script>alert(1)</script>")
    better = folder(tmp_path, "better", [GOOD, GOOD, BAD])
    (table,), page = board(tmp_path / "out", worse, better)
    assert [one["name"] for one in table["standings"]] == ["better", "<script>alert(1)</script>"]
    assert [one["score"]["figures"]["success"]["value"] for one in table["standings"]] == [2 / 3, 1 / 3]
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_other_episodes_are_another_table_and_two_students_of_one_name_are_refused(tmp_path):
    one = folder(tmp_path, "one", [GOOD, BAD], student="s")
    other = folder(tmp_path, "other", [GOOD, BAD, GOOD], student="s")
    third = folder(tmp_path, "third", [GOOD, BAD, GOOD], most_decisions=10)
    tables, page = board(tmp_path / "a", f"x={one}", f"y={other}", third)
    assert [len(table["standings"]) for table in tables] == [1, 2]
    assert "different lists of episodes" in page
    assert page.count("shortened: at most 10 decisions") == 2  # in both tables of this student alone
    done = invoke(f"leaderboard {other} s={third} --out {tmp_path / 'b'}")
    assert "NAME=DIR" in str(done.exception)
