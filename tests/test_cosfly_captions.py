"""What an answer must look like, and captions.jsonl."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from specimens_distill import make_caption
from tables import each

from cosfly.formats.captions import TOKENS, Caption, Coc, read_captions, write_captions
from cosfly.llm.answer_text import answer_schema, normalize_action, parse_answer
from cosfly.runtime.errors import InputError

GOOD = {
    "critical_components": "A pedestrian walks ahead on the pavement.",
    "reasoning_trace": "The person keeps to the middle of the image, so nothing has to change.",
    "flight_decision": "track_straight",
}


@given(st.text(max_size=30))
def test_nothing_else_is_an_action(text):
    assert normalize_action(text) in (None, *TOKENS)
    assert normalize_action(text + " quickly") is None


def changed(**fields):
    return json.dumps({k: v for k, v in {**GOOD, **fields}.items() if v is not None})


def test_what_the_reasoning_leads_to_stands_before_the_decision():
    schema = answer_schema("hover", more={"therefore": {"enum": list(TOKENS)}})
    assert list(schema["properties"]) == schema["required"] == [*list(GOOD)[:2], "therefore", "flight_decision"]
    assert schema["properties"]["flight_decision"]["enum"] == ["hover"]
    assert len(schema["properties"]["therefore"]["enum"]) == 17


@each(("fields", "outcome"), [
    ({"therefore": "Track straight"}, "track_straight"),
    ({}, "missing_field"),
    ({"therefore": "go on"}, "therefore_not_in_closed_set"),
    ({"therefore": ["hover"]}, "therefore_not_in_closed_set"),
    ({"therefore": "hover", "claims": []}, "extra_field"),
])  # fmt: skip
def test_further_fields_are_those_that_were_asked_for(fields, outcome):
    parsed = parse_answer(changed(**fields), more=("therefore",))
    assert outcome == (parsed.therefore if parsed.coc else parsed.reason)
    assert parse_answer(changed(**fields)).coc is None or not fields


def a_caption(number):
    prompt = {"en": {"system": "s", "user": "u"}}
    teacher = {"kind": "rules", "model": "rules-1", "settings": {"seed": 0}}
    return Caption(
        sample_id=f"t_ORI_frame_{number:05d}", town="T", trajectory="t", variant="ORI", frame_index=number, window=[0,
            1, 2, 3, 4],
        future=[5], prompt=prompt, prompt_hash="h", picture_px=(64, 36), teacher=teacher, usage={"prompt_tokens": 1},
        attempts=1,
        en=Coc(**GOOD), zh=Coc(**GOOD), label_from="flight", label="ascend",
        verdict="SOFT_CONFLICT", status="accepted",
    )  # fmt: skip


def test_captions_round_trip_and_errors_name_the_line(tmp_path):
    path = tmp_path / "captions.jsonl"
    captions = [a_caption(4), a_caption(5)]
    assert write_captions(path, captions) == 2
    assert list(read_captions(path)) == captions
    path.write_text(path.read_text().replace('"status":"accepted"', '"status":"maybe"'))
    with pytest.raises(InputError, match=r"captions\.jsonl:1: status"):
        list(read_captions(path))
    path.write_text("{")
    with pytest.raises(InputError, match=":1: this is not valid JSON"):
        list(read_captions(path))
    with pytest.raises(InputError, match="run cosfly caption"):
        list(read_captions(tmp_path / "nowhere.jsonl"))


@each(
    ("name", "value"), [("depth_range_m", float("nan")), ("depth_range_m", float("inf")), ("picture_px", (2**64, 36))]
)
def test_no_caption_holds_what_is_no_number(name, value):
    with pytest.raises(ValidationError, match=name):
        make_caption("Town01", "trajectory_1", "ORI", 4, **{name: value})
