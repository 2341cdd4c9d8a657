"""Claims as a way of writing: what is refused and why, the mirror, the record; and answers that are too long, too deep
or no list."""

from __future__ import annotations

import dataclasses
import json
import time
from contextlib import nullcontext

import pytest
from specimens_captions import FACTS, VOCABULARY, deciding, settings
from tables import each

from caption.run.stage import run
from caption.teachers.prompts import way_prompt
from caption.truth.facts import Facts
from caption.writing.claims import MAX_CLAIMS, read_claims
from caption.writing.contract import Draft, Refused, more_fields, way_of
from cosfly.errors import NothingKept
from cosfly.products.actions import shipped_actions
from cosfly.products.answer_text import parse_answer
from cosfly.products.captions import read_captions

WAY = way_of("claims", VOCABULARY)
MORE = tuple(more_fields(WAY))
ANSWER = {
    "critical_components": "The walker is 18.0 m away and left of the middle.",
    "reasoning_trace": "The nose has swung 10.0 deg to the right. So hover.",
    "claims": [
        dict(zip(("sentence", "quantity", "at", "value", "unit", "modality"), row, strict=True))
        for row in (
            ("C1", "distance", "t4", 18, "m", "observed"), ("C1", "side:offset_x", "t4", "left", "", "observed"),
            ("R1", "yaw", "t4", -10.0, "deg", "observed"), ("R2", "decision", "", "hover", "", "predicted"),
        )
    ],
    "therefore": "hover",
    "flight_decision": "hover",
}  # fmt: skip


def read(answer: dict, facts: Facts = FACTS) -> Draft | Refused:
    parsed = parse_answer(json.dumps(answer), shipped_actions(), "en", MORE)
    assert parsed.coc is not None, parsed.reason
    return WAY.read(parsed, facts)


def changed(index: int, **fields) -> dict:
    claims = [claim | (fields if number == index else {}) for number, claim in enumerate(ANSWER["claims"])]
    return ANSWER | {"claims": claims}


def test_a_true_answer_is_taken_with_its_claims():
    draft = read(ANSWER)
    assert isinstance(draft, Draft), draft
    assert [claim.value for claim in draft.claims] == [18.0, "left", -10.0, "hover"]
    assert draft.claims[1].unit is None
    states = [one.state for one in WAY.judge(draft, FACTS, settings("http://x").evidence, "en")]
    assert states == ["proved", "proved", "unread"]

    # Without claims it is taken where it is true, and proves nothing.
    draft = read(ANSWER | {"claims": []})
    assert isinstance(draft, Draft), draft
    assert {one.state for one in WAY.judge(draft, FACTS, settings("http://x").evidence, "en")} == {"unread"}


@each(
    ("fields", "found"),
    [
        ({"unit": "metres"}, {"unit": "m"}),
        ({"unit": "m/s"}, {"unit": "mps"}),
        ({"unit": "km"}, {"unit": "km"}),  # not ours: judged as it is
        ({"value": "18.0"}, {"value": 18.0}),
        ({"value": "about 18"}, {"value": "about 18"}),
        ({"at": "t1..t4"}, {"at": "t1-t4"}),
        ({"at": "t1, t2, t3"}, {"at": "t1-t3"}),
        ({"at": "T4 "}, {"at": "t4"}),
        ({"at": "now at t4"}, {"at": "now at t4"}),
        ({"at": None}, {"at": None}),
    ],
)
def test_spellings_of_a_claim_are_read_in_one_way(fields, found):
    (claim,) = read_claims([ANSWER["claims"][0] | fields])
    assert {name: getattr(claim, name) for name in found} == found


@each(
    ("answer", "reason", "words"),
    [
        (changed(0, value=21), "claims_false", "C1 false: distance@t4 = 21 m"),
        (changed(0, at="t9"), "claims_unobserved_frame", "distance@t9"),
        (changed(0, quantity="range"), "claims_unknown_quantity", "range@t4"),
        (changed(0, quantity="height_over_target"), "claims_unknown_fact", "height_over_target@t4"),
        (changed(0, sentence="C7"), "claims_no_sentence", "claim of no sentence: C7"),
        (changed(1, value="right"), "claims_false", "side:offset_x@t4 = right"),
        (changed(3, value="ascend"), "claims_against_decision", "decision = ascend"),
        (ANSWER | {"critical_components": "The walker is 19.2 m away.", "claims": []}, "claims_uncovered", "19.2 m"),
        (ANSWER | {"claims": "none"}, "claims_malformed", "list"),
        (ANSWER | {"claims": [7]}, "claims_malformed", "Claim 1: it must be an object"),
        (changed(0, modality="seen"), "claims_malformed", "modality"),
        (changed(0, value=None), "claims_malformed", "value"),
        (changed(0, value=True), "claims_malformed", "value"),
        (changed(0, colour="red"), "claims_malformed", "colour"),
        (changed(0, quantity="x" * 60), "claims_malformed", "longer than"),
        (changed(0, value=10**400), "claims_malformed", "value"),
        (ANSWER | {"claims": ANSWER["claims"] * 40}, "claims_too_many", str(MAX_CLAIMS)),
    ],
)
def test_what_is_wrong_is_refused_for_a_reason_and_named(answer, reason, words):
    found = read(answer)
    assert isinstance(found, Refused)
    assert (found.reason, words in found.complaint) == (reason, True), found.complaint


def test_the_mirror_is_held_against_the_same_claims():
    english = read(ANSWER)
    assert isinstance(english, Draft)
    chinese = {
        "critical_components": "行人距离 18.0 米，位于中间偏左。",
        "reasoning_trace": "机头向右转了 10.0 度。因此悬停。",
        "flight_decision": "hover",
    }

    def mirrored(**texts: str) -> Draft | Refused:
        return WAY.read_mirror(parse_answer(json.dumps(chinese | texts), shipped_actions(), "zh"), english, FACTS)

    good = mirrored()
    assert isinstance(good, Draft), good
    assert good.claims == english.claims
    for texts in (
        {"critical_components": "行人距离 18.0 米，位于中间偏右。"},
        {"reasoning_trace": "机头向右转了 10.0 度，因此悬停。"},
        {"reasoning_trace": "机头向右转了 12.0 度。因此悬停。"},
    ):
        assert isinstance(mirrored(**texts), Refused), texts


def test_the_example_of_the_prompt_is_an_answer_that_is_taken():
    text = way_prompt(WAY).partition("Example, of another flight:\n")[2].splitlines()[0]
    series = {"speed_mps": (None, 1.0, 1.1, 1.1, 1.2), "distance_m": (14.0, 14.5, 15.0, 16.0, 16.5)}
    facts = dataclasses.replace(FACTS, offset_x_px=(0, -10, -20, -30, -40), **series)
    assert isinstance(read(json.loads(text), facts), Draft), read(json.loads(text), facts)


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(ANSWER | {"claims": ANSWER["claims"] * 3000}),
        json.dumps(ANSWER | {"critical_components": "a 1 " * 250_000}),
        "{" * 1_000_000,
        '{"a":' * 20_000,
        '{"claims":' + "[" * 90_000,
        "<think>" * 150_000,
        "```" * 300_000,
    ],
    ids=["claims", "text", "braces", "objects", "lists", "thoughts", "fences"],
)
def test_a_huge_or_deep_answer_is_refused_quickly(text):
    begun_s = time.thread_time()
    assert parse_answer(text, shipped_actions(), "en", MORE).coc is None
    assert time.thread_time() - begun_s < 1.0


def test_a_run_writes_claims_and_the_record_keeps_them(tree, tmp_path):
    with deciding() as server:
        captions = list(read_captions(run(settings(server.url, writing="claims"), tree, tmp_path / "out")))
    accepted = [caption for caption in captions if caption.status == "accepted"]
    assert accepted
    for caption in accepted:
        assert (caption.writing, caption.therefore) == ("claims", "hover")
        assert [claim.quantity for claim in caption.claims or ()] == ["visibility", "target_motion"]
        assert (caption.checks.sentences or {})["en"] == ["proved", "unread"]


def test_wrong_claims_are_asked_for_once_more_and_then_drop_the_window(tree, tmp_path):

    def at_first(number: int, body: dict) -> str | None:
        return None if "This answer was refused" in json.dumps(body) else "wrong_claims"

    for fault, status, reasons in ((lambda *_: "wrong_claims", "dropped", 2), (at_first, "accepted", 1)):
        with deciding(fault=fault) as server:
            out = tmp_path / status
            with pytest.raises(NothingKept) if status == "dropped" else nullcontext():
                run(settings(server.url, writing="claims"), tree, out)
        captions = list(read_captions(out / "captions.jsonl"))
        ended = [caption for caption in captions if caption.status == status]
        assert ended
        assert {tuple(caption.checks.refused or ()) for caption in ended} == {("claims_unobserved_frame",) * reasons}
        assert {caption.drop_reason for caption in ended} == {
            "claims_unobserved_frame" if status == "dropped" else None
        }
