"""`cosfly fly`: students after walkers, whatever a student answers and after a kill; `--relabel`: frames of its mistakes."""

import itertools
import json
import shutil
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import invoke, obeyed, working_here
from specimens_distill import prepared
from teacher_server import TeacherServer

from caption.schema import CaptionConfig
from caption.stage.stage import run as caption_tree
from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stepper import ClosedLoopTrajectory
from cosfly.formats.bystanders import read_bystanders
from cosfly.formats.captions import read_captions
from cosfly.formats.episodes import EPISODES, Episode, read_episode
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.llm.student_chat import read_chat_format, write_chat_format
from cosfly.runtime.errors import NothingKept
from distill.inference.answers import Completion
from distill.prepare.stage import PrepareConfig, make_sample
from distill.schema import Sample, open_split
from distill.student.random_student import make_random_student
from distill.training.stage import chat_format_of
from release.verify.verify import verify
from specimens import make_playback_tree

TINY = (
    "--set maps.synthetic.size_m=110 --set maps.synthetic.num_blocks=1 --set pedestrians.num_paths=3 "
    "--set pedestrians.min_distance_m=25 --set pedestrians.max_distance_m=35 --set render.width_px=160 "
    "--set render.height_px=90 --set render.fovs_deg=[70] --seed 4"
)
LONG = "--set fly.tree=false --set fly.most_decisions=30 --set fly.lead_frames=6"
SHORT = "--workers 1 --set fly.most_decisions=6 --set fly.tree=false"


@pytest.fixture(scope="module")
def town(built_once) -> Path:
    def make(root: Path) -> None:
        for words in (
            f"maps {TINY} --out {root}/maps",
            f"simplify {TINY.replace('--seed 4', '')} --map {root}/maps/boxes_3d.json --out {root}/simplify",
            f"pedestrians {TINY} --workers 1 --map {root}/simplify/step2_simplified.json --out {root}/pedestrians",
        ):
            with working_here():
                obeyed(words)

    return built_once("town_to_fly_in", make)


def fly(town: Path, out: Path, more: str, after: str = "") -> dict[str, Episode]:
    done = attempt(town, out, more, after)
    assert done.exit_code == 0, (done.output, done.exception)
    return {path.stem: read_episode(path) for path in sorted((out / EPISODES).glob("*.json"))}


def attempt(town: Path, out: Path, more: str, after: str = ""):
    given = f"--map {town}/maps/boxes_3d.json --simplified {town}/simplify/step2_simplified.json"
    return invoke(f"fly {TINY} {given} {after or f'--paths {town}/pedestrians/path.json'} --out {out} {more}")


@pytest.mark.slow
def test_what_is_flown_is_inspected_captioned_and_released_as_any_other_flight(town, tmp_path, in_this_process):
    flown = fly(town, tmp_path, "--workers 1 --set fly.most_decisions=12 --student rules")
    assert len(flown) == 3
    for record in flown.values():
        assert (record.engine, record.num_lead, len(record.decisions)) == ("rules", 20, 12)
        assert all(frame.answer == "ok" and frame.words and frame.action for frame in record.decisions)
    simple, traces = f"{town}/simplify/step2_simplified.json", f"{tmp_path}/drone_trace.json"
    for words in (
        f"inspect {TINY} --workers 1 --map {simple} --traces {traces} --data {tmp_path}/render --out {tmp_path}/inspect "
        "--set inspect.legible_min=0",
        f"caption {TINY} --workers 1 --data {tmp_path}/render --out {tmp_path}/caption",
        f"release build {TINY} --workers 1 --data {tmp_path}/render --captions {tmp_path}/caption/captions.jsonl "
        f"--inspect {tmp_path}/inspect/inspect.json --out {tmp_path}/release --set release.licence=cc-by-4.0 "
        "--set release.pairs=any",
    ):
        obeyed(words if words.startswith("caption") else words.replace("--seed 4", ""))
    assert verify(tmp_path / "release/dataset").is_ok
    captions = list(read_captions(tmp_path / "caption/captions.jsonl"))
    assert captions
    decided = {}  # the rule teacher says of the tree what it said while it flew
    for folder in find_tracks(tmp_path / "render"):
        flight = read_track(folder)
        assert flight.source["algorithm"].startswith("flown by rules")
        record = flown[flight.source["scenario_id"]]
        assert np.allclose(flight.positions_m, [frame.pose[:3] for frame in record.frames], atol=1e-3)
        assert list(flight.target.visible) == [frame.visible for frame in record.frames]
        decided |= {f"{flight.flight_id}_frame_{i:05d}": frame.action for i, frame in enumerate(record.frames)}
    asked = [caption for caption in captions if decided[caption.sample_id] is not None and caption.repair is None]
    assert asked
    same = [caption.en.flight_decision == decided[caption.sample_id] for caption in asked if caption.en]
    assert np.mean(same) == 1.0


@pytest.mark.slow
def test_bystanders_walk_as_long_as_an_episode_lasts(town, tmp_path, in_this_process):
    made = tmp_path / "pedestrians"
    obeyed(
        f"pedestrians {TINY} --workers 1 --map {town}/simplify/step2_simplified.json --out {made} "
        "--set pedestrians.others=2 --set pedestrians.num_paths=1"
    )
    lost, after = "--student random --workers 1 --set fly.most_decisions=12", f"--others {made}/others.json"
    (record,) = fly(town, tmp_path / "fly", lost, f"--paths {made}/path.json {after}").values()
    (bystanders,) = read_bystanders(made / "others.json")
    num_frames = len(record.frames)
    assert all(num_frames < len(bystander.positions_m) for bystander in bystanders.others)
    (folder,) = find_tracks(tmp_path / "fly/render")
    assert len(read_track(folder).positions_m) == num_frames


@pytest.mark.slow
def test_the_ceiling_sees_more_than_chance_and_all_is_the_same_however_many_fly_at_once(town, tmp_path):
    seen = {}
    for student, alone in (("planner", False), ("random", True)):
        with working_here():
            flown = fly(town, tmp_path / student, f"--student {student} {LONG} --workers 1")
        seen[student] = np.mean([sum(f.in_view for f in p.flown) / p.num_walk_frames for p in flown.values()])
        if alone:
            one = f"--student {student} {LONG} --workers 2 --set fly.side_by_side=1"
            assert fly(town, tmp_path / f"{student}_alone", one) == flown
    assert seen["planner"] >= 0.95
    assert seen["random"] < seen["planner"]


@pytest.mark.slow
def test_a_policy_of_ones_own_flies_as_a_student_that_decides_the_same(town, tmp_path, in_this_process, monkeypatch):
    code = "class Ahead:\n    def reset(self, goal, seed): pass\n    def act(self, seen): return 'track_straight'\n"
    (tmp_path / "ahead_policy.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    flown = fly(town, tmp_path / "policy", f"{SHORT} --student policy:ahead_policy:Ahead")
    same = fly(town, tmp_path / "floor", f"{SHORT} --student track_straight")
    for one, other in zip(flown.values(), same.values(), strict=True):
        assert (one.engine, one.student) == ("policy", "ahead_policy:Ahead")
        assert [f.command for f in one.frames] == [f.command for f in other.frames]
    wrong = attempt(town, tmp_path / "none", f"{SHORT} --student policy:ahead_policy:Missing")
    assert "ahead_policy:Missing" in str(wrong.exception)


ONE = "--set caption.endpoint.max_tries=1 --set fly.side_by_side=3"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "answer"), [("wrong_decision", "invalid"), ("wrong_shape", "unreadable"), ("empty_choices", "none")]
)
def test_what_a_model_answers_wrong_ends_no_flight(town, tmp_path, in_this_process, fault, answer):
    with TeacherServer(lambda number, body: fault) as server:
        flown = fly(town, tmp_path, f"{SHORT} {ONE} --student {server.url}")
    for record in flown.values():
        assert {frame.answer for frame in record.decisions} == {answer}
        assert len(record.decisions) == 6
        assert all(frame.command[:4] == (0, 0, 0, 0) and frame.action is None for frame in record.decisions)
        assert all(frame.words for frame in record.decisions)
        assert record.engine == "endpoint"


@pytest.mark.slow
def test_a_model_is_asked_about_all_flights_at_once_and_nothing_twice(town, tmp_path, in_this_process):
    together = threading.Barrier(3)

    def wait(number, body):  # after the first decisions no answer comes before all three flights have asked
        if number >= 3:
            together.wait(60)

    with TeacherServer(wait) as server:
        flown = fly(town, tmp_path, f"{SHORT} {ONE} --student {server.url}")
        assert (server.most_at_once, len(server.bodies)) == (3, 3 * 6)
        first = server.bodies[0]
        assert json.loads(first)["messages"][1]["content"][1]["type"] == "image_url"
        for path in (tmp_path / "manifest.json", tmp_path / "items.jsonl", *(tmp_path / EPISODES).glob("*.json")):
            path.unlink()
        again = fly(town, tmp_path, f"{SHORT} {ONE} --student {server.url}")
        assert len(server.bodies) == 3 * 6
    for one, two in zip(flown.values(), again.values(), strict=True):
        assert [f.command for f in one.frames] == [f.command for f in two.frames]
        assert all(f.answer == "ok" and f.answer_s > 0 for f in one.decisions)


@pytest.fixture(scope="module")
def student(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("student")
    tree = make_playback_tree(root / "tree", num_flights=3, num_points=11, width_px=160, height_px=90)
    captions = caption_tree(CaptionConfig(), tree, root / "captions")
    prepared(tree, captions, root / "set", modalities=("rgb",))
    make_random_student(root / "model")
    write_chat_format(root / "model", chat_format_of(open_split(root / "set", "train"), 64 * 64))
    return root / "model"


@pytest.mark.slow
def test_a_student_in_this_process_answers_all_flights_as_one_batch(town, tmp_path, in_this_process, student):
    few = "--set distill.infer.max_new_tokens=4 --set distill.infer.device=cpu --set fly.most_decisions=2"
    flown = fly(town, tmp_path, f"{SHORT} {few} --student transformers:{student}")
    for record in flown.values():
        assert record.engine == "transformers"
        assert {frame.answer for frame in record.decisions} == {"unreadable"}  # of four tokens
        assert all(frame.words is not None and frame.answer_s > 0 for frame in record.decisions)


@pytest.mark.slow
def test_a_student_can_answer_with_its_decision_alone(town, tmp_path, in_this_process, student, monkeypatch):
    few = "--set distill.infer.device=cpu --set fly.most_decisions=4 --set fly.reasons=false"
    chat_format = read_chat_format(student)
    assert chat_format.decision == "first"
    last = shutil.copytree(student, tmp_path / "last")
    write_chat_format(last, chat_format.model_copy(update={"decision": "last"}))
    refused = attempt(town, tmp_path / "rules", f"{SHORT} {few} --student rules")
    assert "works only with fly.student=transformers" in str(refused.exception)
    refused = attempt(town, tmp_path / "refused", f"{SHORT} {few} --student transformers:{last}")
    assert "writes its reasons before its decision" in str(refused.exception)
    begin = '{"flight_decision": "'
    texts = itertools.cycle([f"{begin}move_forward", "{'flight_decision': \"Hover", f"{begin}up", "?"])

    def answers(student, rows, pictures, *, max_tokens, stop, advance):
        assert stop == '",'
        return [Completion(next(texts), 9, True) for _ in rows]

    monkeypatch.setattr("distill.inference.answers.generate", answers)
    flown = fly(town, tmp_path / "flown", f"{SHORT} {few} --student transformers:{student}")
    found = {(frame.answer, frame.action) for record in flown.values() for frame in record.decisions}
    assert found == {("ok", "move_forward"), ("unreadable", None), ("invalid", None)}


@pytest.mark.slow
def test_a_student_is_asked_with_the_very_prompts_that_it_was_taught_with(town, tmp_path, in_this_process, student):
    with TeacherServer() as server:
        more = f"--workers 1 --set fly.most_decisions=8 --student {server.url} --as-student {student}"
        flown = fly(town, tmp_path, more)
        bodies = [json.loads(body) for body in server.bodies]
    assert {frame.answer for record in flown.values() for frame in record.decisions} == {"ok"}
    asked = {(body["messages"][0]["content"], body["messages"][1]["content"][-1]["text"]) for body in bodies}
    assert len(asked) == 24
    assert {len([c for c in body["messages"][1]["content"] if c["type"] == "image_url"]) for body in bodies} == {5}
    # As a training set that is made of what was flown has them.
    captions = caption_tree(CaptionConfig(), tmp_path / "render", tmp_path / "captions")
    every: tuple = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")
    cfg = PrepareConfig(modalities=("rgb",), verdicts=every)
    samples = [make_sample(caption, "en", cfg) for caption in read_captions(captions)]
    taught = {(one.prompt.system, one.prompt.user) for one in samples if isinstance(one, Sample)}
    # Of each flight the first four at most: the others have no future there, and some have no reason.
    assert 8 <= len(taught & asked) <= 12


STUDENT, FRAMES = "--workers 1 --student track_straight --set fly.tree=false", 5


def relabel(town, flown, out, more=""):
    return fly(town, out, f"--workers 1 --set fly.relabel.stride=8 {more}", f"--relabel {flown}")


@pytest.mark.slow
def test_where_it_erred_the_planner_goes_on_and_what_is_made_is_captioned(town, tmp_path, in_this_process):
    flown = fly(town, tmp_path / "flown", STUDENT)
    relabel(town, tmp_path / "flown", tmp_path / "made", "--set fly.relabel.round=2")
    counts = json.loads((tmp_path / "made/manifest.json").read_text())["counts"]
    looked_at = sum(len(range(0, len(record.decisions), 8)) for record in flown.values())
    assert counts["input"] == looked_at
    assert counts["kept"] + sum(counts["dropped"].values()) + sum(counts["failed"].values()) == looked_at
    assert counts["kept"] >= 1
    flights = [read_track(folder) for folder in find_tracks(tmp_path / "made/render")]
    assert len(flights) == counts["kept"]
    for flight in flights:
        name, _, number = flight.source["scenario_id"].rpartition("_f")
        i, record = int(number), flown[name]
        assert flight.source["algorithm"] == f"replanned from frame {i} of {record.student}, round 2"
        assert len(flight) == FRAMES + 10
        own = [frame.pose[:3] for frame in record.frames[i - FRAMES + 1 : i + 1]]
        assert np.allclose(flight.positions_m[:FRAMES], own, atol=1e-3)  # what it saw; then the planner
        assert np.linalg.norm(np.diff(flight.positions_m, axis=0), axis=1).max() <= 10 * 0.5 * 1.2
    captions = list(read_captions(tmp_path / "made/caption/captions.jsonl"))
    assert {max(caption.window) for caption in captions} >= {FRAMES - 1}
    assert all(max(caption.window) < min(caption.future) for caption in captions)


@pytest.mark.slow
def test_redrawn_frames_show_what_the_student_saw(town, tmp_path, in_this_process):
    weather = "--set render.weather_mode=random_per_path --set render.fovs_deg=[40,70]"
    fly(town, tmp_path / "flown", f"--workers 1 --student track_straight --set fly.most_decisions=20 {weather}")
    relabel(town, tmp_path / "flown", tmp_path / "made", weather)
    whole = {flight.source["scenario_id"]: flight for flight in map(read_track, find_tracks(tmp_path / "flown/render"))}
    flights = [read_track(folder) for folder in find_tracks(tmp_path / "made/render")]
    assert len(flights) >= 2
    for flight in flights:
        name, _, number = flight.source["scenario_id"].rpartition("_f")
        assert (flight.goal, flight.raw["weather"]) == (whole[name].goal, whole[name].raw["weather"])
        for k in range(FRAMES):
            a, b = (one.frame_folder(i) for one, i in ((flight, k), (whole[name], int(number) - FRAMES + 1 + k)))
            for name_of_file in ("depth_float32.png", "instance.png"):
                assert (a / name_of_file).read_bytes() == (b / name_of_file).read_bytes()
            pictures = [cv2.imread(str(folder / "rgb.png")).astype(int) for folder in (a, b)]
            # Shadows of a tree are as fine as its flight is short.
            assert np.abs(pictures[0] - pictures[1]).mean() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("more", "reason"), [
    ("--set plan.safety_distance_m=25 --set plan.relaxed_safety_m=25", "too_near"),
    ("--set plan.speed_max_mps=0.2", "no_path"),
    ("", "crashes"),
])  # fmt: skip
def test_why_nothing_can_be_shown_there_is_counted(town, tmp_path, in_this_process, monkeypatch, more, reason):
    fly(town, tmp_path / "flown", f"{STUDENT} --set fly.most_decisions=12")
    if reason == "crashes":
        monkeypatch.setitem(ClosedLoopTrajectory.__init__.__kwdefaults__, "drone", Drone(radius_m=16.0))
    more = f"--workers 1 --set fly.relabel.stride=8 {more}"
    done = attempt(town, tmp_path / "made", more, f"--relabel {tmp_path / 'flown'}")
    assert isinstance(done.exception, NothingKept)
    assert f"({reason} 6) of 6" in str(done.exception)
