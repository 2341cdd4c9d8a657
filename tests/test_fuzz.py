"""Hostile inputs to every reader: each ends in success or one clear line, in bounded time and memory."""

from __future__ import annotations

import json
import random
import re
import shutil
from pathlib import Path

import pytest
from fuzz import CPU_S, run
from fuzz_readers import READERS, make_specimens
from fuzzing import mutated
from toy_readers import HONEST

INPUTS = 50  # of each reader whose share is 1
NAMES = list(READERS)


@pytest.fixture(scope="module")
def specimens(tmp_path_factory) -> Path:
    root = make_specimens(tmp_path_factory.mktemp("fuzz") / "specimens")
    shutil.copytree(root, root.with_name("honest"))
    return root


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_reader_refuses_in_one_line_what_it_cannot_read(specimens):
    numbers = {name: range(max(1, round(INPUTS * READERS[name].share))) for name in NAMES}
    summary = run("fuzz_readers", specimens, numbers, cpu_s=4 * CPU_S)  # a slow machine is no finding
    assert summary.inputs.total() == sum(map(len, numbers.values()))
    assert not summary.found, str(summary)


def test_an_input_is_the_same_each_time():
    honest = json.dumps({"a": [1, 2.5, "x"], "b": {"c": None}}).encode()

    def inputs():
        return [mutated("x.json", honest, random.Random(f"x/0/{k}")) for k in range(200)]

    assert inputs() == inputs()
    assert len({str(content) for content in inputs()}) > 150


@pytest.mark.parametrize("suffix", ["json", "jsonl", "yaml", "npy", "png", "json.gz", "parquet", "sha256", "md"])
def test_what_a_mutator_makes_of_an_empty_or_foreign_file_is_a_file(suffix):
    for k in range(100):
        rng = random.Random(k)
        assert isinstance(
            mutated(f"x.{suffix}", rng.choice((b"", b"\x89PNG", b"[1", rng.randbytes(200))), rng), bytes | str
        )


def test_every_file_that_is_documented_is_read_by_one_of_them_or_by_nobody():
    documented = Path(__file__).parents[1].joinpath("docs/files.md").read_text(encoding="utf-8")
    named = set(re.findall(r"[` ]([a-z_0-9]+\.(?:jsonl?|yaml|npy|png|sha256|parquet))(?=[` ])", documented))
    fuzzed = {file.rpartition("/")[2] for reader in READERS.values() for file in reader.files}
    assert sorted(named - fuzzed - {*ALIKE, *FOR_PEOPLE}) == []


# The same format as one that is fuzzed, under another name.
ALIKE = ["combined_world.json", "debug.png", "loop.yaml", "roi_polygon.json", "step2_simplified.json", "test.parquet"]
# Written, and read by no command.
FOR_PEOPLE = [
    "checks.json", "diversity.json", "layout.json", "placement.json", "trace.json",
    "axes_bars.png", "axes_pairs.png", "axes_radar.png", "boxes_meta.json", "deltas.png", "flights_3d.png",
    "bench.json", "caption_report.json", "comparison.json", "compare_overlay.png", "compare_radar.png",
    "compare_series.png", "compare_strategies.json",
    "contact_sheet.png", "depth_study.json", "depth_study.png", "map.png", "paths.png", "pedestrians_report.json",
    "perturbation_report.json",
    "plan.png", "preflight.json", "report.json", "simplify.png", "zoom_fidelity.png",
    "zoom_levels.png", "zoom_study.json", "reproduction.json", "variants.json", "variants.png",
]  # fmt: skip


# --- the fuzzer itself finds what it is for ---------------------------------------------------------------------------


WORDS = {
    "traceback": "ZeroDivisionError in _divide of toy_readers.py", "hang": "CPU time", "blocked": "blocked",
    "memory": "memory", "two lines": "that is no line", "killed": "ended with -9",
    "recursion": "RecursionError in _recurse",
}  # fmt: skip


@pytest.mark.slow
def test_bad_readers_are_found_and_their_other_inputs_are_read(tmp_path):
    for name in ("specimens", "honest"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.json").write_bytes(HONEST)
    numbers = {reader: range(20) for reader in ("good", *WORDS)}
    summary = run("toy_readers", tmp_path / "specimens", numbers, cpu_s=4.0, silent_s=3.0)
    assert summary.inputs == dict.fromkeys(numbers, 20)
    assert (tmp_path / "specimens/x.json").read_bytes() == HONEST
    found = {finding.reader: finding for finding in summary.found}
    assert len(summary.found) == len(found)
    assert {reader: words for reader, words in WORDS.items() if words in found[reader].place} == WORDS
    assert found["traceback"].smallest == "b'9'"
