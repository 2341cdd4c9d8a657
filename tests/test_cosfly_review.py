"""The review queue and what the release makes of it; what decisions can be predicted without a picture."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import invoke
from hypothesis import given, settings
from hypothesis import strategies as st
from test_cosfly_inspection import CFG, plan_of, write_map

from cosfly.formats.inspection import REVIEW, Choice, add_decisions, read_decisions, read_inspection, read_settled
from cosfly.formats.traces import write_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import rotation_matrices
from cosfly.inspection.blind_baseline import past_of
from cosfly.inspection.stage import run
from cosfly.runtime.io import sha256_file
from release.build.sources import Source, gather
from specimens import make_flight, make_playback_tree


@pytest.fixture(scope="module")
def inspected(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("queue")
    tree = make_playback_tree(root / "tree", 2, 6, width_px=96, height_px=54)
    write_map(root)
    write_traces(root / "drone_trace.json", [plan_of(f) for f in find_tracks(tree) if f.name == "ORI"], {})
    cfg = CFG.model_copy(update={"smoothness_min": 1.0})  # the plan of every flight is less smooth than that
    return run(cfg, root / "map.json", root / "drone_trace.json", tree, root / "inspect")


@pytest.fixture
def product(inspected, tmp_path) -> Path:
    shutil.copytree(inspected.parent, tmp_path / "inspect")
    return tmp_path / "inspect/inspect.json"


def folders_of(product: Path) -> list[str]:
    return [flight.folder for flight in read_inspection(product).flights]


def decide(product: Path, verdict: str, *folders: str) -> None:
    add_decisions(product, [Choice(folder=f, verdict=verdict, reason="looked at it") for f in folders], "Ann")


def test_decisions_are_on_record_and_the_last_one_counts(product):
    first, second, *_ = folders_of(product)
    decide(product, "accepted", first, second)
    decide(product, "rejected", first)
    found = read_decisions(product)
    assert {folder: decision.verdict for folder, decision in found.items()} == {first: "rejected", second: "accepted"}
    one = found[second]
    assert (one.by, one.reason, one.inspection) == ("Ann", "looked at it", sha256_file(product))
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", one.at)
    assert len(product.with_name(REVIEW).read_text().splitlines()) == 3, "nothing is taken away"
    assert one.sha256 == read_inspection(product).flights[1].sha256


def test_results_funnel_and_release_are_those_after_review(product, inspected):
    before, flights = product.read_bytes(), folders_of(product)
    source = Source("run", inspected.parent.parent / "tree", product, product)  # captions are not read here
    take = lambda: [one.dropped for one in gather([source], include_review=False).candidates]  # noqa: E731
    assert take() == ["review: smoothness"] * 4
    decide(product, "accepted", *flights[:2])
    decide(product, "rejected", flights[2])
    assert take() == [None, None, "rejected: review", "review: smoothness"]
    settled = read_settled(product)
    assert [flight.result for flight in settled.flights] == ["accepted", "accepted", "rejected", "review"]
    assert settled.flights[2].reason == "review"
    counts = settled.funnel.trajectories
    assert (counts.accepted, counts.review, counts.rejected) == (1, 0, 1)
    assert product.read_bytes() == before
    assert "decided" not in json.dumps(settled.model_dump(mode="json")["flights"])
    assert source.files["review"] == product.with_name(REVIEW), "an input of the stage, as a later decision is another"


def test_the_command_decides_and_says_what_is_open(product):
    first, second, third, _ = folders_of(product)
    command = ["inspect", "review", "--inspect", str(product.parent)]
    ask = lambda *words: invoke([*command, *words])  # noqa: E731
    assert ask("--accept", first).exit_code == 2, "who, and why?"
    done = ask("--accept", first, "--accept", second, "--reject", third, "--by", "Bo", "--reason", "steady")
    assert done.exit_code == 0, done.output
    assert "4 tracks in review: 2 accepted, 1 rejected, 1 open" in done.output
    assert ask().output == done.output
    both = ask("--reject", first.rpartition("/")[0], "--by", "Bo", "--reason", "steady")
    assert "lists no track in this folder" in str(both.exception)


NUM = 12


def flight_of(walked_m, **changes):
    """A flight 20 m behind and 10 m above a walker at places (n, 2)."""
    flight, _ = make_flight(len(walked_m))
    targets = np.column_stack([walked_m, np.full(len(walked_m), 0.9)])
    still = replace(flight.perturbation, target_m=np.zeros_like(targets))
    positions = targets + np.array([-20.0, 3.0, 10.0])
    return replace(flight, targets_m=targets, positions_m=positions, perturbation=still, is_original=True, **changes)


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_a_past_is_the_same_wherever_and_whenever_it_was(seed):
    rng = np.random.default_rng(seed)
    flight = flight_of(rng.normal(size=(NUM, 2)).cumsum(axis=0), time_s=0.5 * np.arange(NUM))
    flight = replace(flight, rotations_deg=rng.uniform(-60, 60, (NUM, 3)))
    yaw_deg, moved_m = float(rng.uniform(-180, 180)), rng.uniform(-1e3, 1e3, 3)
    turn = rotation_matrices(np.radians(np.array([[0.0, yaw_deg, 0.0]])))[0]
    there = replace(
        flight, positions_m=flight.positions_m @ turn.T + moved_m, targets_m=flight.targets_m @ turn.T + moved_m,
        rotations_deg=flight.rotations_deg + np.array([0.0, yaw_deg, 0.0]), time_s=flight.time_s + 77.0,
    )  # fmt: skip
    here = past_of(flight, range(5), False)
    np.testing.assert_allclose(past_of(there, range(5), False), here, atol=1e-6)
    later = flight.positions_m.copy()
    later[5:] += 9.0
    assert np.array_equal(past_of(replace(flight, positions_m=later), range(5), False), here)  # nothing of the future
    assert not np.array_equal(past_of(flight, range(5), True), here)


def test_a_past_holds_what_a_prompt_may_tell():
    """Poses as they were drawn, with their perturbation, and no place of a target that nobody sees."""
    clean = flight_of(np.column_stack([0.6 * np.arange(1, NUM + 1), np.zeros(NUM)]))
    shifted_m = np.zeros((NUM, 3))
    shifted_m[3] = 0.5, -0.5, 0.2
    noisy = replace(
        clean, is_original=False, positions_m=clean.positions_m + shifted_m,
        perturbation=replace(clean.perturbation, drone_m=shifted_m, rotation_deg=np.zeros((NUM, 3))),
    )  # fmt: skip
    np.testing.assert_allclose(noisy.planned[0][:, :3], clean.positions_m, atol=1e-9)
    assert np.abs(past_of(noisy, range(5), False) - past_of(clean, range(5), False)).max() > 0.4
    hidden = replace(clean, target=replace(clean.target, visible=np.zeros(NUM, dtype=bool)))
    moved = replace(hidden, targets_m=hidden.targets_m + np.random.default_rng(0).normal(size=(NUM, 3)))
    assert np.array_equal(past_of(moved, range(5), False), past_of(hidden, range(5), False))
