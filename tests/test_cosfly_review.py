"""The review queue: who decides, what is refused, and what the release makes of it."""

import json
import re
import shutil
from pathlib import Path

import pytest
from test_cosfly_inspection import CFG, plan_of, write_map
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.inspection import REVIEW, Choice, add_decisions, read_decisions, read_inspection, read_settled
from cosfly.formats.traces import write_traces
from cosfly.formats.tracks import find_tracks
from cosfly.inspection.stage import run
from cosfly.runtime.io import sha256_file
from release.build.sources import Source, gather
from specimens import make_playback_tree

QUEUE = CFG.model_copy(update={"smoothness_min": 1.0})  # the plan of every flight is less smooth than that


@pytest.fixture(scope="module")
def inspected(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("queue")
    tree = make_playback_tree(root / "tree", 2, 6, width_px=96, height_px=54)
    write_map(root)
    write_traces(root / "drone_trace.json", [plan_of(f) for f in find_tracks(tree) if f.name == "ORI"], {})
    return run(QUEUE, root / "map.json", root / "drone_trace.json", tree, root / "inspect")


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


def test_results_and_funnel_are_those_after_review(product):
    before = product.read_bytes()
    flights = folders_of(product)
    decide(product, "accepted", *flights[:3])
    decide(product, "rejected", flights[3])
    settled = read_settled(product)
    assert [flight.result for flight in settled.flights] == ["accepted"] * 3 + ["rejected"]
    assert settled.flights[3].reason == "review"
    counts = settled.funnel.trajectories
    assert (counts.accepted, counts.review, counts.rejected) == (1, 0, 1)
    assert product.read_bytes() == before
    assert "decided" not in json.dumps(settled.model_dump(mode="json")["flights"])


def test_the_release_takes_what_was_accepted(product, inspected, monkeypatch):
    tree = inspected.parent.parent / "tree"
    source = Source("run", tree, product, product)  # captions are not read here
    take = lambda: gather([source], include_review=False)  # noqa: E731
    assert {one.dropped for one in take().candidates} == {"review: smoothness"}
    flights = folders_of(product)
    decide(product, "accepted", *flights[:2])
    decide(product, "rejected", flights[2])
    assert [one.dropped for one in take().candidates] == [None, None, "rejected: review", "review: smoothness"]
    assert source.files["review"] == product.with_name(REVIEW), (
        "an input of the stage: a later decision is another input"
    )


def test_the_command_decides_and_says_what_is_open(product):
    first, second, third, _ = folders_of(product)
    command = ["inspect", "review", "--inspect", str(product.parent)]
    ask = lambda *words: CliRunner().invoke(app, [*command, *words])  # noqa: E731
    assert ask("--accept", first).exit_code == 2, "who, and why?"
    done = ask("--accept", first, "--accept", second, "--reject", third, "--by", "Bo", "--reason", "steady")
    assert done.exit_code == 0, done.output
    assert "4 tracks in review: 2 accepted, 1 rejected, 1 open" in done.output
    assert ask().output == done.output
