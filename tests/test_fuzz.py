"""Hostile inputs to every reader: each ends in success or one clear line, in bounded time and memory."""

from __future__ import annotations

import json
import random
import re
import shutil
from pathlib import Path

import pytest
from fuzz import CPU_S, Summary, outcome_of, run
from fuzz_readers import READERS, make_specimens
from fuzzing import mutated
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_readers import HONEST

from cosfly.app.settings import RunConfig
from cosfly.chat.contract import Request
from cosfly.chat.protocol import base_url, read_completion, read_models
from cosfly.chat.refusals import kind_of
from cosfly.chat.wire import Response, retry_after_s
from cosfly.products.answer_text import parse_answer
from cosfly.products.captions import FIELDS
from cosfly.reading.documents import parse_document
from cosfly.reading.objects import find_object
from cosfly.work.config import apply_overrides, build
from cosfly.work.store import CHECKSUMS, read_checksums

INPUTS = 50  # of each reader whose share is 1
EXAMPLES = 60
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
ALIKE = ["debug.png", "roi_polygon.json", "step2_simplified.json", "test.parquet"]
# Written, and read by no command.
FOR_PEOPLE = [
    "bench.json", "caption_report.json", "comparison.json", "compare_overlay.png", "compare_radar.png",
    "compare_series.png", "compare_strategies.json",
    "contact_sheet.png", "depth_study.json", "depth_study.png", "map.png", "paths.png", "pedestrians_report.json",
    "perturbation_report.json",
    "plan.png", "preflight.json", "report.json", "simplify.png", "simplify_report.json", "zoom_fidelity.png",
    "zoom_levels.png", "zoom_study.json",
]  # fmt: skip


# --- the fuzzer itself finds what it is for ---------------------------------------------------------------------------


def toy_run(folder: Path, reader: str, cpu_s: float = 60.0) -> Summary:
    for name in ("specimens", "honest"):
        (folder / name).mkdir()
        (folder / name / "x.json").write_bytes(HONEST)
    summary = run("toy_readers", folder / "specimens", {reader: range(20)}, cpu_s=cpu_s, silent_s=3.0)
    assert summary.inputs[reader] == 20
    assert (folder / "specimens/x.json").read_bytes() == HONEST
    return summary


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        ("hang", "CPU time"), ("blocked", "blocked"), ("memory", "memory"), ("two lines", "that is no line"),
        ("killed", "ended with -9"),
        ("recursion", "RecursionError in _recurse"),
    ],
)  # fmt: skip
def test_a_bad_reader_is_found_and_its_other_inputs_are_read(tmp_path, reader, words):
    (finding,) = toy_run(tmp_path, reader, 0.5 if reader == "hang" else 60.0).found
    assert words in finding.place


def test_a_failing_input_is_made_smaller(tmp_path):
    (finding,) = toy_run(tmp_path, "traceback").found
    assert finding.place == "ZeroDivisionError in _divide of toy_readers.py"
    assert finding.smallest == "b'9'"


def test_one_clear_line_is_no_finding(tmp_path):
    assert toy_run(tmp_path, "good").found == []


# --- texts ------------------------------------------------------------------------------------------------------------

ODD = st.sampled_from([
    "\0", "\ud800", "{", "}", '"', "\\", "<think>", "</think>", "```", "NaN", "1e999", "7" * 400, "[" * 100, "：", "“",
    "//", "/*", "\ufffd", *FIELDS,
])  # fmt: skip
TEXTS = st.lists(st.one_of(st.text(max_size=20), ODD), max_size=30).map("".join)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text(max_size=8) | st.sampled_from(FIELDS), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@settings(max_examples=EXAMPLES, derandomize=True)
@given(TEXTS, st.sampled_from(["en", "zh"]), st.none() | st.text(max_size=12))
def test_an_answer_is_an_object_or_a_reason(text, language, finish_reason):
    found = find_object(text, FIELDS, finish_reason)
    assert (found.value is None) == (found.reason is not None)
    parsed = parse_answer(text, language, (), finish_reason)
    assert (parsed.coc is None) == (parsed.reason is not None)


@settings(max_examples=EXAMPLES, derandomize=True)
@given(
    VALUES
    | st.fixed_dictionaries({"choices": st.lists(VALUES, max_size=2), "usage": VALUES, "data": VALUES, "error": VALUES})
)
def test_a_reply_is_read_or_told_what_is_wrong_with_it(value):
    response = Response(200, json.dumps(value).encode())
    assert read_completion(response, Request([{"role": "user", "content": "x"}], [], {}, {}), "native")
    read_models(response)


@settings(max_examples=EXAMPLES, derandomize=True)
@given(st.binary(max_size=200), st.sampled_from([400, 404, 429, 500]))
def test_any_body_is_some_refusal(body, status):
    assert isinstance(read_completion(Response(200, body), Request([], [], {}, {}), "plain"), str)
    assert kind_of(status, body.decode("latin-1"))


@settings(max_examples=EXAMPLES, derandomize=True)
@given(st.text(max_size=40) | st.floats().map(str) | st.integers().map(str))
def test_a_wait_is_a_time_or_nothing(header):
    wait_s = retry_after_s(header, 0.0)
    assert wait_s is None or 0.0 <= wait_s < float("inf")


@settings(max_examples=EXAMPLES, derandomize=True)
@given(
    st.sampled_from(["seed", "caption.teacher", "maps", "release.licence", "a.b.c", "towns"]), TEXTS | VALUES.map(str)
)
def test_any_setting_is_taken_or_refused_in_one_line(key, text):
    assert outcome_of(lambda: build(RunConfig, apply_overrides({}, [f"{key}={text}"]), "--set")) is None


@settings(max_examples=EXAMPLES, derandomize=True)
@given(
    st.sampled_from(["", "http://", "https://", "HTTP://["]),
    st.text(max_size=30) | st.sampled_from(["h:99999", "[::1", "h:-1", "a@b", "xn--0"]),
)
def test_any_url_is_taken_or_refused_in_words(scheme, rest):
    url = scheme + rest
    assert (
        outcome_of(lambda: build(RunConfig, {"caption": {"teacher": url, "judge": {"url": url}}}, "--teacher")) is None
    )
    assert base_url(url)


@settings(max_examples=EXAMPLES, derandomize=True)
@given(TEXTS | VALUES.map(json.dumps), st.booleans())
def test_any_text_is_a_document_or_refused(text, once):
    data = text.encode("utf-8", "surrogatepass")
    assert outcome_of(lambda: parse_document(data, "x.json", each_key_once=once)) is None


@settings(max_examples=EXAMPLES, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["0" * 64, "0" * 63, "A" * 64, ""]),
            st.sampled_from(["  ", " *", " ", ""]),
            st.text(max_size=12) | st.sampled_from(["../x", "/x", "."]),
        )
    )
)
def test_any_checksums_name_files_below_their_folder(tmp_path_factory, lines):
    folder = tmp_path_factory.getbasetemp()
    (folder / CHECKSUMS).write_bytes("\n".join(map("".join, lines)).encode("utf-8", "surrogatepass"))
    names: list[str] = []
    assert outcome_of(lambda: names.extend(read_checksums(folder))) is None
    assert all((folder / name).resolve().is_relative_to(folder.resolve()) for name in names)
