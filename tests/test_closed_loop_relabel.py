"""`cosfly fly --relabel`: frames of the student's own mistakes, then the planner; a tree that is captioned as any other."""

import json

import cv2
import numpy as np
import pytest
from commands import invoke
from tables import each
from test_closed_loop_fly import TINY, fly, town  # noqa: F401

from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stepper import ClosedLoopTrajectory
from cosfly.formats.captions import read_captions
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import NothingKept
from cosfly.runtime.pool import run_items

STUDENT, FRAMES = "--workers 1 --student track_straight --set fly.tree=false", 5


def relabel(town, flown, out, more=""):  # noqa: F811
    boxes = f"--map {town}/maps/boxes_3d.json --simplified {town}/simplify/step2_simplified.json"
    return invoke(f"fly {TINY} {boxes} --relabel {flown} --workers 1 --out {out} --set fly.relabel.stride=8 {more}")


@pytest.mark.slow
def test_where_it_erred_the_planner_goes_on_and_what_is_made_is_captioned(town, tmp_path):  # noqa: F811
    flown = fly(town, tmp_path / "flown", STUDENT)
    done = relabel(town, tmp_path / "flown", tmp_path / "made", "--set fly.relabel.round=2")
    assert done.exit_code == 0, (done.output, done.exception)
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
def test_redrawn_frames_show_what_the_student_saw(town, tmp_path):  # noqa: F811
    weather = "--set render.weather_mode=random_per_path --set render.fovs_deg=[40,70]"
    fly(town, tmp_path / "flown", f"--workers 1 --student track_straight --set fly.most_decisions=20 {weather}")
    done = relabel(town, tmp_path / "flown", tmp_path / "made", weather)
    assert done.exit_code == 0, (done.output, done.exception)
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
            assert (
                np.abs(pictures[0] - pictures[1]).mean() < 2.0
            )  # shadows of a tree are as fine as its flight is short


@pytest.mark.slow
@each(("more", "reason"), [
    ("--set plan.safety_distance_m=25 --set plan.relaxed_safety_m=25", "too_near"),
    ("--set plan.speed_max_mps=0.2", "no_path"),
    ("", "crashes"),
])  # fmt: skip
def test_why_nothing_can_be_shown_there_is_counted(town, tmp_path, monkeypatch, more, reason):  # noqa: F811
    fly(town, tmp_path / "flown", f"{STUDENT} --set fly.most_decisions=12")
    if reason == "crashes":
        monkeypatch.setitem(ClosedLoopTrajectory.__init__.__kwdefaults__, "drone", Drone(radius_m=16.0))
        here = lambda *given, **how: run_items(*given, **how | {"workers": 0})  # noqa: E731  # in this process
        monkeypatch.setattr("cosfly.closed_loop.relabel.run_items", here)
    done = relabel(town, tmp_path / "flown", tmp_path / "made", more)
    assert isinstance(done.exception, NothingKept)
    assert f"({reason} 6) of 6" in str(done.exception)
