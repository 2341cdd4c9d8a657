"""What servers and models really send: the tables of shapes and of refusals (refusals.tsv). The next one that is met goes
there.

Each case names the kind of server or model that sends it, as public issue threads and manuals show it.
"""

import json
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from specimens_distill import make_caption

from cosfly.formats.captions import TOKENS, Coc, read_captions, write_captions
from cosfly.llm.answer_text import answer_schema, normalize_action, parse_answer
from cosfly.llm.contract import Reply
from cosfly.llm.protocol import (
    MEANINGS,
    MOST_CHARACTERS,
    THOUGHT_FIELDS,
    BadReply,
    Refusal,
    Response,
    error_words,
    kind_of,
    read_body,
    read_completion,
    read_models,
)
from cosfly.runtime.errors import InputError
from cosfly.runtime.model_json import find_object

GOOD = {
    "critical_components": "A pedestrian walks ahead on the pavement.",
    "reasoning_trace": "The person keeps to the middle of the image, so nothing has to change.",
    "flight_decision": "track_straight",
}
CHINESE = {
    "critical_components": "目标行人在前方的人行道上行走。",
    "reasoning_trace": "行人保持在画面中央，因此无需改变动作。",
    "flight_decision": "track_straight",
}
TEXT, ZH = json.dumps(GOOD), json.dumps(CHINESE, ensure_ascii=False)
DRAFT = json.dumps(GOOD | {"flight_decision": "hover"})
HALF = TEXT[:60]


def changed(**fields: object) -> str:
    return json.dumps(GOOD | fields, ensure_ascii=False)


def completed(body: bytes) -> Reply | str:
    try:
        return read_completion(Response(200, body), "plain")
    except (BadReply, Refusal) as problem:
        return str(problem)


def completion(message: object, **choice: object) -> bytes:
    return json.dumps({"object": "chat.completion", "choices": [{"index": 0, "message": message, **choice}]}).encode()


def assistant(**message: object) -> bytes:
    return completion({"role": "assistant", **message}, finish_reason="stop")


# Who sends it, what; the text of its final message, or (word) what is said of it: then the request is sent again.
BODIES: list[tuple[str, bytes, str | tuple[str]]] = [
    ("any server", assistant(content=TEXT), TEXT),
    ("a reasoning parser", assistant(content=TEXT, tool_calls=[], **dict.fromkeys(THOUGHT_FIELDS, "Draft: {}")), TEXT),
    *((f"the JSON in {name}", assistant(content=None, **{name: TEXT}), "") for name in THOUGHT_FIELDS),
    ("proxies: empty content", assistant(content=""), ""),
    ("proxies: a number", assistant(content=17), ("no text",)),
    ("OpenAI SDK servers: parts", assistant(content=[{"type": "text", "text": TEXT[:9]}, {"type": "text",
        "text": TEXT[9:]}]), TEXT),
    ("gateways: a reasoning part that has a text", assistant(content=[{"type": "reasoning", "text": "{}"},
        {"type": "output_text", "text": TEXT}]), TEXT),
    ("gateways: parts of other kinds", assistant(content=[{"type": "image_url"}, None, 3, {"type": "text", "text": 3}]),
        ""),
    ("LiteLLM: a schema served by a function", assistant(content=None, tool_calls=[{"function":
        {"arguments": TEXT}}]), ("no text",)),
    ("OpenAI: refusal", assistant(content=None, refusal="I'm sorry, I can't help with that."),
        "I'm sorry, I can't help with that."),
    ("gateways: leading white space to keep the line open", b"\n\n  \n" + assistant(content=TEXT), TEXT),
    ("gateways on Windows: BOM", b"\xef\xbb\xbf" + assistant(content=TEXT), TEXT),
    ("llama.cpp: half a pair of surrogates", assistant(content="on \ud83d"), "on \ufffd"),
    ("OpenRouter: raw bytes of half a pair", assistant(content="on Q").replace(b"Q", b"\xed\xa0\xbd"), "on \ufffd"),
    ("any server: a whole pair", assistant(content="on \U0001f6b6"), "on \U0001f6b6"),
    ("any server: an escaped escape", assistant(content='{"a": "\\ud83d"}'), '{"a": "\\ud83d"}'),
    ("OpenRouter: an error with status 200", b'{"error": {"message": "Provider returned error", "code": 502}}',
        ("Provider returned error",)),
    ("routers: no choices, an error", b'{"choices": null, "error": "ResourceExhausted"}', ("ResourceExhausted",)),
    ("OpenRouter: an error in the choice", completion({"content": TEXT}, error={"message": "Upstream idle"}),
        ("Upstream idle",)),
    ("Gemini behind a gateway: finish_reason error", completion({"content": TEXT}, finish_reason="error"), ("an error",
    )),
    ("routers: choices null", b'{"choices": null}', ("no choices",)),
    ("routers: a choice that is null", b'{"choices": [null]}', ("no choices",)),
    ("routers: no message", completion(None), ("no text",)),
    ("vLLM: thoughts that use up all tokens", completion({"role": "assistant"}, finish_reason="length"), ""),
    ("proxies: a page", b"<html><body>502 Bad Gateway</body></html>", ("not JSON",)),
    ("proxies: events though none were asked for", b'data: {"choices": []}\n\n', ("not JSON",)),
    ("proxies: events without a choice", b'data: {"choices": [null]}\n\ndata: [DONE]\n', ("no text",)),
    ("proxies: events without a delta", b'data: {"choices": [{"delta": ["x"]}]}\n\ndata: [DONE]\n', ("no text",)),
    ("vLLM: NaN among the logprobs", completion({"content": TEXT}, logprobs=[float("nan")]), ("not JSON",)),
    ("nobody yet: nested 100,000 deep", b"[" * 100_000, ("not JSON",)),
]  # fmt: skip


def test_bodies(subtests):
    for name, body, outcome in BODIES:
        with subtests.test(name=name):
            found = completed(body)
            if isinstance(outcome, str):
                assert isinstance(found, Reply), found
                assert found.text == outcome
                found.text.encode()  # can stand in a journal
            else:
                assert isinstance(found, str), found
                assert outcome[0] in found


def test_a_count_that_cannot_be_is_none():
    for usage in [None, [1], "many", {}, {"prompt_tokens": None}, *({"prompt_tokens": count, "completion_tokens": 3}
        for count in (-1, 10**30, True))]:  # fmt: skip
        body = json.dumps({"choices": [{"message": {"content": TEXT}}], "usage": usage}).encode()
        assert completed(body) == Reply(TEXT, None, "plain", None)


def test_names_that_no_record_can_hold_are_left_out():
    for name in ("", "x" * 300, "a\x1b[31m", "a\nb", 7, None, ["gpt"]):
        body = json.dumps({"model": name, "choices": [{"message": {"content": TEXT}, "finish_reason": name}]}).encode()
        assert completed(body) == Reply(TEXT, None, "plain", None)
        assert read_models(Response(200, json.dumps({"data": [{"id": name}, {"id": "m"}]}).encode())) == {"m": None}


def json_values(integers, characters):
    simple = integers | st.floats(allow_nan=False, allow_infinity=False) | st.text(characters)
    return st.recursive(
        st.none() | st.booleans() | simple,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=8,
    )


@settings(max_examples=40)
@given(json_values(st.integers(), st.characters(codec=None)))
def test_whatever_json_a_server_sends_can_be_written(value):
    read = read_body(json.dumps(value).encode())
    assert json.loads(json.dumps(read, ensure_ascii=False).encode()) == read
    words = [error_words(read)]
    for name in ("content", "tool_calls", "refusal", "reasoning", "finish_reason", "error"):
        body = completion({name: value}, **({name: value} if name in ("finish_reason", "error") else {}))
        found = completed(body)
        words.append(found.text if isinstance(found, Reply) else found)
    assert [text.encode().decode() for text in words] == words  # no half of a surrogate pair, which no file takes


# Who writes it, what; what was taken off it to get GOOD, or the reason why it is refused.
THINK, FENCE, PROSE = "thinking_tags", "code_fence", "prose_around"
TEXTS: list[tuple[str, str, tuple[str, ...] | str]] = [
    # whole and clean
    ("any model with a schema", TEXT, ()),
    # thoughts
    ("Qwen3: a draft among the thoughts", f"<think>I would say {DRAFT} but no</think>{TEXT}", (THINK,)),
    ("DeepSeek R1, Qwen3-Thinking: the opener is in the prompt", f"So I would say {DRAFT}, hm.\n</think>\n\n{TEXT}",
        (THINK,)),
    ("R1: speaks of the tag", f"<think>I must close with </think> in the end. {DRAFT}</think>{TEXT}", (THINK,)),
    ("any model: thoughts between two drafts", f"<think>a</think>{DRAFT}<think>no</think>{TEXT}", (THINK,)),
    ("DeepSeek: thoughts after the answer", f"{TEXT}\n<think>that should do</think>", "only_thinking"),
    ("R1, cut off: thoughts that never end", f"<think>So I would say {DRAFT} but", "only_thinking"),
    *((f"tags {begins}", f"{begins}{DRAFT}{ends}{TEXT}", (THINK,)) for begins, ends in (
        ("<thinking>", "</thinking>"), ("<reasoning>", "</reasoning>"), ("<thought>", "</thought>"),
        ("<THINK>", "</Think>"), ("[THINK]", "[/THINK]"), ("<|channel>thought\n", "<channel|>"))),
    ("InternVL, R1-V: think and answer", f"<think>x</think>\n<answer>\n{TEXT}\n</answer>", (THINK, PROSE)),
    ("Hunyuan: tags in the text of a field", changed(reasoning_trace=GOOD["reasoning_trace"] + " <think>"),
        GOOD["reasoning_trace"] + " <think>"),
    # channels
    ("gpt-oss raw",
        f"<|channel|>analysis<|message|>{DRAFT}<|end|><|start|>assistant<|channel|>final<|message|>{TEXT}<|return|>",
        (THINK, PROSE)),
    ("gpt-oss: never gets to the final channel", f"<|channel|>analysis<|message|>{DRAFT}<|end|>", "only_thinking"),
    ("gpt-oss: calls a function in the commentary",
        f"<|channel|>commentary to=functions.answer <|constrain|>json<|message|>{TEXT}<|call|>", "only_thinking"),
    # fences, prose, drafts
    ("most models without a schema: a fence", f"```json\n{json.dumps(GOOD, indent=2)}\n```", (FENCE,)),
    ("any model: a fence in a fence", f"````markdown\n```json\n{TEXT}\n```\n````", (FENCE, PROSE)),
    ("any model: a fence in the text of a field",
        changed(reasoning_trace="As ```json {}``` shows, nothing has to change."),
        "As ```json {}``` shows, nothing has to change."),
    ("any model: prose round it", f"Sure! Here it is:\n{TEXT}\nI hope this helps.", (PROSE,)),
    ("any model: braces in the prose", f"The set {{left, right}} and {{}} {TEXT} as in {{t0..t4}}.", (PROSE,)),
    ("any model: two drafts, the last counts", f"{DRAFT}\n{TEXT}", (PROSE,)),
    ("vLLM, Qwen3 with thinking off: a brace too many", f"{{\n{TEXT}", (PROSE,)),
    # wrapped
    ("Llama 3, Ollama: a function call as text", f'{{"name": "chain_of_cause", "parameters": {TEXT}}}', ("wrapped",)),
    ("OpenAI shape: arguments as a text", json.dumps({"name": "answer", "arguments": TEXT}), ("wrapped",)),
    ("small models: the schema itself", json.dumps({"properties": {name: {"type": "string"} for name in GOOD}}),
        "field_not_text"),
    ("any model: two of them in one", f'{{"draft": {DRAFT}, "final": {TEXT}}}', "missing_field"),
    # as models write JSON
    ("any model: curly quotes in a text", changed(reasoning_trace="The “person” keeps to the middle of the image."),
        "The “person” keeps to the middle of the image."),
    ("small models: a key twice", TEXT[:-1] + ', "flight_decision": "hover"}', "duplicate_key"),
    ("small models: a key twice in a draft", f'{DRAFT[:-1]}, "flight_decision": "ascend"}}\n{TEXT}', (PROSE,)),
    ("vLLM 0.26, a random model: raw control characters", TEXT.replace("walks", "wal\x0fks"), ("control_characters",)),
    ("any model: an escaped zero", TEXT.replace("walks", "walks\\u0000"), ("control_characters",)),
    # broken
    ("any server", "", "empty"),
    ("any model refuses", "I'm sorry, but I can't help with that.", "no_json_object"),
    ("any model: a draft, then cut off", f"{DRAFT}\nNo: {HALF}", "broken_json"),
    ("any model: quotes in a text", TEXT.replace("person", 'person "in red"'), "broken_json"),
    ("numpy habits: NaN", TEXT[:-1] + ', "claims": [NaN]}', "not_finite"),
    ("nobody yet: an integer of 5,000 digits", TEXT[:-1] + ', "claims": ' + "9" * 5000 + "}", "not_finite"),
    ("nobody yet: nested 10,000 deep", '{"a":' * 10_000 + "1" + "}" * 10_000, "broken_json"),
    ("random models: longer than anybody reads", TEXT + " " * 100_000, "too_long"),
    ("any model: half a surrogate pair", TEXT.replace("person", "person \\ud83d"), "unreadable_character"),
    ("any model: a whole pair", TEXT.replace("person", "person \\ud83d\\udeb6"),
        GOOD["reasoning_trace"].replace("person", "person \U0001f6b6")),
    ("vLLM, TGI: bytes that are no character", TEXT.replace("person", "person \ufffd"), "unreadable_character"),
    # of the right shape
    ("small models: a field is missing", json.dumps({name: GOOD[name] for name in list(GOOD)[1:]}), "missing_field"),
    ("any model without a schema: another field", changed(confidence="high"), "extra_field"),
    ("any model: a list for a text", changed(critical_components=["a person", "a road", "a tree", "a house"]),
        "field_not_text"),
    ("any model: the schema's minimum", changed(reasoning_trace="ok"), "reasoning_trace_too_short"),
    ("small models: dots in the end", changed(reasoning_trace="The person keeps to the middle of the image ..."),
        "reasoning_trace_placeholder"),
    ("small models: the prompt's words", changed(critical_components="<what is seen in the five frames>"),
        "critical_components_placeholder"),
    ("DeepSeek, Qwen: answers in Chinese", json.dumps(CHINESE | {"critical_components": "目标行人在前方的人行道上行走，速度保持不变，没有遮挡。"}),
        "critical_components_wrong_language"),
    ("any model: another decision", changed(flight_decision="do a barrel roll"), "decision_not_in_closed_set"),
]  # fmt: skip


# The same of Chinese answers.
CHINESE_TEXTS: list[tuple[str, str, tuple[str, ...] | str]] = [
    ("any model", ZH, ()),
    ("Qwen: Chinese prose round it", f"好的，以下是翻译结果：\n```json\n{ZH}\n```\n希望对您有帮助！", (FENCE, PROSE)),
    ("small models: one field left in English", json.dumps(CHINESE | {"reasoning_trace": GOOD["reasoning_trace"]}),
        "reasoning_trace_wrong_language"),
    ("slots: names of facts are no English",
        json.dumps(CHINESE | {"reasoning_trace": "速度为{speed@t4}，距离{distance@t4}，{trend:speed}。"}),
        "速度为{speed@t4}，距离{distance@t4}，{trend:speed}。"),
]  # fmt: skip


@pytest.mark.parametrize(("language", "cases", "whole"), [("en", TEXTS, GOOD), ("zh", CHINESE_TEXTS, CHINESE)])
def test_texts(language, cases, whole, subtests):
    for name, text, outcome in cases:
        with subtests.test(name=name):
            parsed = parse_answer(text, language)
            if isinstance(outcome, tuple):
                assert parsed.coc == Coc(**whole) or "control_characters" in outcome, parsed
                assert parsed.recovered == outcome
            elif parsed.coc is None:
                assert parsed.reason == outcome
            else:
                assert parsed.coc.reasoning_trace == outcome


# How decisions are spelled; what they are read as.
DECISIONS: list[tuple[str, str | None]] = [
    ("track_straight", "track_straight"), ("Track-Straight", "track_straight"), ("TRACK STRAIGHT.", "track_straight"),
    ("trackStraight", "track_straight"), ('"track straight"', "track_straight"), ("`track_straight`", "track_straight"),
    ("**track_straight**", "track_straight"), ("track_straight...", "track_straight"),
    ("track_straight()", None), ("Decision: hover", None), ("4. hover", None), ("", None), ("hover?", None),
    ("hover or ascend", None), ("hover quickly", None), ("悬停", None), ("hov" * 50, None), ("-hover-", None),
    ("hover\ud83d", None),
]  # fmt: skip


def test_decisions():
    for text, token in DECISIONS:
        assert normalize_action(text) == token


# Why the server says that the text ended; what comes of it.
CUT = [
    (TEXT, "length", None), (f"```json\n{TEXT}\n```\n\n\n", "length", None), (HALF, "length", "cut_short"),
    ("", "length", "cut_short"), (f"So I would say {DRAFT}, but then the", "length", "cut_short"),
    (f"So I would say {DRAFT}, but then the", "MAX_TOKENS", "cut_short"),
    (changed(reasoning_trace="ok"), "length", "reasoning_trace_too_short"), ("", "content_filter", "content_filter"),
    (TEXT, "stop", None), (HALF, "stop", "broken_json"), (HALF, "tool_calls", "broken_json"),
]  # fmt: skip


def test_an_answer_that_was_cut_off_is_no_draft():
    for text, finish_reason, reason in CUT:
        assert parse_answer(text, finish_reason=finish_reason).reason == reason


BEFORE = ["", "\ufeff", "Sure {or not}: ", "<think>left {or} right?</think>", "hm " + DRAFT + "</think>", "```json\n",
    "assistant\n", DRAFT, HALF + "\n"]  # fmt: skip
AFTER = [
    "", "\n```", " I hope this {helps}.", "<|im_end|>", "\u200b", '\n{"confidence": 1}',
]  # fmt: skip
WRITERS = [
    lambda value: json.dumps(value),
    lambda value: json.dumps(value, ensure_ascii=False, indent=1),
    lambda value: json.dumps({"name": "answer", "arguments": value}),
    lambda value: json.dumps({"response": json.dumps(value)}),
]
VALUES = json_values(st.integers(-(10**17), 10**17), st.characters(codec="utf-8", exclude_characters="\ufffd"))


@given(VALUES, VALUES, st.sampled_from(BEFORE), st.sampled_from(AFTER), st.sampled_from(WRITERS))
def test_the_very_object_comes_back_from_any_noise(first, second, before, after, write):
    value = {"critical_components": first, "flight_decision": second}
    found = find_object(before + write(value) + after, ("critical_components", "flight_decision"))
    assert found.value is not None, found.reason
    assert json.dumps(found.value) == json.dumps(value)


@pytest.mark.parametrize("text", [
    '{"a":' * 19_999, '{"' * 49_999, "<think>" * 14_000, '{"a":[{},' * 11_000, "<|" + "a:" * 49_000,
    '{"a":"' + '\\"{' * 30_000,
])  # fmt: skip
def test_no_text_takes_long(text):
    start_s = time.process_time()
    find_object(text, GOOD)
    assert time.process_time() - start_s < 8.0  # they take below 2 s; a quadratic one took 40


def test_what_the_reasoning_leads_to_stands_before_the_decision():
    schema = answer_schema("hover", more={"therefore": {"enum": list(TOKENS)}})
    assert list(schema["properties"]) == schema["required"] == [*list(GOOD)[:2], "therefore", "flight_decision"]
    assert schema["properties"]["flight_decision"]["enum"] == ["hover"]
    assert len(schema["properties"]["therefore"]["enum"]) == 17


@pytest.mark.parametrize(("fields", "outcome"), [
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


def test_captions_round_trip_and_errors_name_the_line(tmp_path):
    path = tmp_path / "captions.jsonl"
    captions = [make_caption("Town01", "trajectory_1", "ORI", frame) for frame in (4, 5)]
    assert write_captions(path, captions) == 2
    assert list(read_captions(path)) == captions
    path.write_text(path.read_text().replace('"status":"accepted"', '"status":"maybe"'))
    with pytest.raises(InputError, match=r"captions\.jsonl:1: status"):
        list(read_captions(path))
    path.write_text("{")
    with pytest.raises(InputError, match=":1: the text is not valid JSON"):
        list(read_captions(path))
    with pytest.raises(InputError, match="run cosfly caption"):
        list(read_captions(tmp_path / "nowhere.jsonl"))


@pytest.mark.parametrize(("name", "value"), [("depth_range_m", float("nan")), ("picture_px", (2**64, 36))])
def test_no_caption_holds_what_is_no_number(name, value):
    with pytest.raises(ValidationError, match=name):
        make_caption("Town01", "trajectory_1", "ORI", 4, **{name: value})


ROWS = Path(__file__).with_name("refusals.tsv").read_text(encoding="utf-8").splitlines()
REFUSALS = [row.replace("\\n", "\n").split("\t") for row in ROWS if not row.startswith("#")]
REFUSAL_BODIES = {
    "openai": lambda text, status: json.dumps({"error": {"message": text, "type": "invalid_request", "code": None}}),
    "vllm": lambda text, status: json.dumps({"object": "error", "message": text, "type": "BadRequest", "code": status}),
    "detail": lambda text, status: json.dumps({"detail": text}),
    "list": lambda text, status: json.dumps([{"error": {"code": status, "message": text}}]),
    "plain": lambda text, status: text,
}


def test_a_refusal_is_read_as_what_it_means():
    for body in REFUSAL_BODIES.values():
        for server, status, kind, text in REFUSALS:
            assert kind_of(int(status), body(text, int(status))) == kind, server
    assert {kind for _, _, kind, _ in REFUSALS} == set(MEANINGS)
    assert len({server for server, *_ in REFUSALS}) == len(REFUSALS)


def test_a_request_that_is_sent_back_does_not_name_its_own_fault():
    sent = "x" * MOST_CHARACTERS + "maximum context length, json_schema"
    assert kind_of(400, json.dumps({"detail": "Bad Request", "input": sent})) == "unknown"


def test_a_server_that_is_away_may_come_back_and_a_request_that_is_refused_stays_refused():
    for status in (408, 424, 429, 500, 502, 503, 504, 520, 522, 524, 529, 530, 599):
        assert Refusal(status, kind_of(status, "<html>Error</html>"), "").may_pass
    for status in (400, 401, 403, 404, 413, 422, 451):
        assert not Refusal(status, "unknown", "").may_pass
