"""Figures of closed-loop flights: records that can be counted by hand, sums that add up, and the leaderboard of them."""

import json

import numpy as np
import pytest
from commands import invoke
from test_cosfly_formats import frame, record

from cosfly.closed_loop.measures import MEASURES, measure, score_episodes
from cosfly.formats.episodes import SCORE, SCORE_FORMAT, episode_file, read_score, write_episode
from cosfly.runtime.json_io import write_model


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
    return {name: a / b if b else None for name, (a, b) in measure(one).sums.items()}


def test_a_flight_that_is_counted_by_hand():
    found = of(flight("1100001101", num_walk_frames=20, ended="left"))  # one loss of 4 frames, one blink
    assert found["in_view"] == 5 / 20
    assert (found["tracked_frames"], found["lost"], found["reacquired"], found["reacquire_s"]) == (5, 1, 1, 2.0)
    assert (found["kept_s"], found["success"], found["left"], found["crashed"]) == (1.0, 0, 1, 0)


@pytest.mark.parametrize(("seen", "more", "success"), [
    ("1111", {}, 1),
    ("1000", {}, 1),  # hidden for 1.5 s: not lost yet
    ("10000", {}, 0),  # lost at the end
    ("10000001", {}, 1),  # lost and found again
    ("1111", {"ended": "crashed"}, 0),
    ("1111", {"distance_m": [20.0, 20.0, 20.0, 20.0, 41.0]}, 0),  # too far at the end
    ("1111", {"distance_m": [20.0, 60.0, 20.0, 20.0, 20.0]}, 1),
])  # fmt: skip
def test_success_is_what_stands_in_the_module(seen, more, success):
    assert of(flight(seen, **more))["success"] == success


def test_decisions_near_misses_and_failures_are_counted():
    answers, actions = ["ok", "late", "ok", "ok", "ok"], ["hover", None, "yaw_left", "yaw_left", "hover"]
    one = flight("11111", answer=answers, action=actions, clearance_m=[9.0, 2.0, 2.4, 9.0, 1.0], answer_s=[1.0, 3.0])
    found = of(one)
    assert found["no_decision"] == 1 / 5
    assert found["changes_pmin"] == pytest.approx(2 / (5 * 0.5 / 60), rel=1e-3)
    assert found["near_misses_pmin"] == pytest.approx(2 / (5 * 0.5 / 60), rel=1e-3)
    assert found["decision_s"] == 2.0
    assert sum(measure(one).answers.values()) == len(one.decisions)
    crash = of(one.model_copy(update={"ended": "crashed"}))
    assert crash["near_misses_pmin"] == pytest.approx(1 / (5 * 0.5 / 60), rel=1e-3)  # the last one was no miss


def test_even_motion_has_no_jerk_and_a_turn_across_north_none_of_yaw():
    poses = [(float(i), 0, 20, -43, (170 + 5 * i + 180) % 360 - 180, 0) for i in range(9)]
    frames = tuple(frame(0.5 * i, "end" if i == 8 else "ok", pose=pose) for i, pose in enumerate(poses))
    found = of(record(frames=frames, num_walk_frames=8))
    assert found["jerk_rms_mps3"] == pytest.approx(0, abs=1e-6)
    assert found["yaw_jerk_rms_degps3"] == pytest.approx(0, abs=1e-6)
    poses[4] = (5.0, *poses[4][1:])  # one pose is 1 m ahead: third differences 1, -3, 3, -1 of six
    frames = tuple(frame(0.5 * i, "end" if i == 8 else "ok", pose=pose) for i, pose in enumerate(poses))
    jerk = of(record(frames=frames, num_walk_frames=8))["jerk_rms_mps3"]
    assert jerk == pytest.approx(np.sqrt(20 / 6) / 0.5**3, rel=1e-3)


def test_a_score_adds_up_is_read_as_written_and_marks_towns_that_were_trained_on(tmp_path):
    flights = [flight("11" * (k + 1), walk=f"path_{k}") for k in range(4)] + [flight("10000", walk="path_9")]
    score = score_episodes(flights, trained_on=["Town_8"])
    assert score.figures["success"].value == 4 / 5
    assert score.figures["in_view"].value == (2 + 4 + 6 + 8 + 1) / (2 + 4 + 6 + 8 + 5)
    assert score.figures["success"].low <= 4 / 5 <= score.figures["success"].high
    for kind, groups in score.by.items():
        assert sum(figures["success"].count for figures in groups.values()) == len(flights), kind
    assert list(score.by["training"]) == ["never trained on"]
    assert list(score_episodes(flights, trained_on=["Town_7"]).by["training"]) == ["trained on"]
    assert set(score.figures) == set(MEASURES)
    write_model(tmp_path / SCORE, score, SCORE_FORMAT)
    assert read_score(tmp_path) == score


GOOD, BAD = "1111111111", "1111100000"


def folder(root, name, seen, *, student=None, **columns):
    flights = [flight(one, walk=f"path_{k}", **columns) for k, one in enumerate(seen)]
    flights = [one.model_copy(update={"student": student or name}) for one in flights]
    for one in flights:
        write_episode(episode_file(root / name, one.episode), one)
    write_model(root / name / SCORE, score_episodes(flights), SCORE_FORMAT)
    return root / name


def board(out, *words):
    done = invoke(f"leaderboard {' '.join(map(str, words))} --out {out}")
    assert done.exit_code == 0, (done.output, done.exception)
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
    third = folder(tmp_path, "third", [GOOD, BAD, GOOD])
    tables, page = board(tmp_path / "a", f"x={one}", f"y={other}", third)
    assert [len(table["standings"]) for table in tables] == [1, 2]
    assert "different lists of episodes" in page
    done = invoke(f"leaderboard {other} s={third} --out {tmp_path / 'b'}")
    assert "NAME=DIR" in str(done.exception)
