"""The endpoint's doctor against servers with one defect each, and the plan against a server whose tokens are known."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from commands import invoke
from specimens_captions import VOCABULARY, deciding, report_of, settings
from teacher_server import ENGLISH, TeacherServer

from caption.run.forecast import estimate, make_forecast
from caption.run.stage import run
from caption.schema import CaptionConfig
from caption.teachers.doctor import ODD_WORD, Finding, examine_endpoint, largest_messages
from cosfly.errors import NothingKept

TOKENS_PER_IMAGE, CONTEXT = 220, 8192


def images_of(body: dict) -> int:
    contents = [message["content"] for message in body["messages"]]
    return sum(part["type"] == "image_url" for content in contents if isinstance(content, list) for part in content)


def prompt_tokens(body: dict, seen_images: int) -> int:
    """Words of the text, and a fixed number for each image that the model sees."""
    contents = [message["content"] for message in body["messages"]]
    texts = [part.get("text", "") for content in contents if isinstance(content, list) for part in content]
    texts += [content for content in contents if isinstance(content, str)]
    return sum(len(text.split()) for text in texts) + TOKENS_PER_IMAGE * seen_images


def patient(
    *,
    obeys_schema: bool = True,
    refuses_schema: bool = False,
    max_images: int = 15,
    sees_images: int = 99,
    thinks: bool = False,
    counts: bool = True,
    context: int = CONTEXT,
    shortens: bool = False,
    empty: bool = False,
    status: int = 400,
    in_parts: bool = False,
    takes_null: bool = True,
) -> Callable[[dict], tuple[int, dict]]:
    """A server's behaviour: what it answers to any request.

    shortens: the answer to fit the context, in silence.
    status: of a refusal for too many pictures. in_parts: the answer is a list of parts. takes_null: where a field may
    be null.
    """

    def respond(body: dict) -> tuple[int, dict]:
        num_images = images_of(body)
        if None in body.values() and not takes_null:
            return 400, {"error": {"message": "Input should be a valid number"}}
        tokens = prompt_tokens(body, min(num_images, sees_images))
        if num_images > max_images:
            return status, {"error": {"message": f"At most {max_images} image(s) may be provided in one prompt."}}
        if tokens + (0 if shortens else body["max_tokens"]) > context:
            return 400, {"error": {"message": f"This model's maximum context length is {context} tokens"}}
        wanted = body.get("response_format", {}).get("json_schema", {}).get("schema")
        if wanted and refuses_schema:
            return 400, {"error": {"message": "response_format is not supported"}}
        text = "I am fine, thank you."
        if wanted and obeys_schema:
            names = wanted["properties"]
            odd = {"animal": ODD_WORD, "legs": 7}
            plain = {**ENGLISH, **dict.fromkeys(("therefore", "flight_decision"), "hover")}
            text = json.dumps(odd if "animal" in names else plain)
        elif isinstance(body["messages"][-1]["content"], list) and body["messages"][0]["role"] == "system":
            text = "Here it is: " + json.dumps(dict.fromkeys(ENGLISH, "hover"))
        message: dict[str, Any] = {"role": "assistant", "content": text}
        if thinks:
            message["reasoning_content"] = "Let me think about that."
        if empty:
            message["content"] = ""
        if in_parts:
            message["content"] = [{"type": "text", "text": message["content"]}]
        is_cut = shortens and tokens + body["max_tokens"] > context
        reply = {"choices": [{"message": message, "finish_reason": "length" if is_cut else "stop"}]}
        if counts:
            reply["usage"] = {"prompt_tokens": tokens, "completion_tokens": 5}  # type: ignore[assignment]
        return 200, reply

    return respond


def examine(behaviour: Callable, context: int = CONTEXT, **changes) -> dict[str, Finding]:
    with TeacherServer(respond=behaviour, model_facts={"max_model_len": context}) as server:
        cfg = CaptionConfig.model_validate({"endpoint": {"backoff_s": 0.01, **changes.pop("endpoint", {})}, **changes})
        return {finding.name: finding for finding in examine_endpoint(server.url, cfg, VOCABULARY)}


def test_a_sound_endpoint_passes_every_check():
    findings = examine(patient())
    assert {finding.state for finding in findings.values()} == {"ok"}
    assert list(findings) == ["model", "answers", "thinking", "JSON schema", "image input", "context length"]
    assert f"{15 * TOKENS_PER_IMAGE} tokens" in findings["image input"].detail


def test_the_doctor_samples_as_a_run_does():
    endpoint = {"temperature": 0.7, "top_p": 0.9, "max_tokens": 300, "extra_body": {"min_p": 0.1}}
    with TeacherServer(respond=patient(), model_facts={"max_model_len": CONTEXT}) as server:
        examine_endpoint(server.url, CaptionConfig.model_validate({"endpoint": endpoint}), VOCABULARY)
    for body in map(json.loads, server.bodies):
        assert {name: body[name] for name in ("temperature", "top_p", "min_p")} == {
            "temperature": 0.7,
            "top_p": 0.9,
            "min_p": 0.1,
        }
        assert type(body["seed"]) is int


# defect, the finding it must show in, its state, words of the detail
DEFECTS = [
    ({"obeys_schema": False}, "JSON schema", "warning", "accepted and ignored"),
    ({"refuses_schema": True}, "JSON schema", "warning", "refused"),
    ({"max_images": 5}, "image input", "unusable", "At most 5 image(s)"),
    ({"max_images": 5, "status": 200}, "image input", "unusable", "--limit-mm-per-prompt"),
    ({"sees_images": 0}, "image input", "unusable", "accepted and ignored"),
    ({"counts": False}, "image input", "warning", "without token usage"),
    ({"thinks": True}, "thinking", "warning", "switch it off"),
    ({"context": 5000}, "context length", "unusable", "context length is 5000"),
    ({"context": 5000}, "context length", "unusable", "--max-model-len"),
    ({"context": 6000, "shortens": True}, "context length", "unusable", "more than 6000"),
    ({"empty": True}, "answers", "unusable", "an empty answer"),
    ({"empty": True, "thinks": True}, "answers", "unusable", "enable_thinking: false"),
]


def test_an_answer_in_parts_is_read_and_a_null_field_is_left_out():
    findings = examine(patient(in_parts=True, takes_null=False), endpoint={"extra_body": {"temperature": None}})
    assert {finding.state for finding in findings.values()} == {"ok"}


@pytest.mark.parametrize(("defect", "name", "state", "words"), DEFECTS, ids=lambda value: str(value))
def test_a_defect_is_found(defect, name, state, words):
    findings = examine(patient(**defect), defect.get("context", CONTEXT))
    assert findings[name].state == state
    assert words in findings[name].detail


def test_an_endpoint_that_is_none_and_a_missing_model(tmp_path):
    with TeacherServer() as server:
        found = examine_endpoint(server.url, CaptionConfig.model_validate({"endpoint": {"model": "other"}}), VOCABULARY)
    assert [(finding.name, finding.state) for finding in found] == [("model", "unusable")]
    assert "does not have this model" in found[0].detail


def test_the_command_exits_with_1_when_unusable():
    with TeacherServer(respond=patient()) as server:
        assert invoke("caption doctor", server.url).exit_code == 0
    with TeacherServer(respond=patient(max_images=0)) as server:
        assert invoke("caption doctor", server.url).exit_code == 1


# --- the plan ---------------------------------------------------------------------------------------------------------


def test_estimate_is_students_interval():
    found = estimate([8.0, 10.0, 12.0])
    assert found.expected == 10.0
    half = 2.919986 * 2.0 / np.sqrt(3)  # t(0.95, 2 degrees of freedom), standard deviation 2
    assert (found.low, found.high) == pytest.approx((10 - half, 10 + half), rel=1e-5)
    assert estimate([5.0]).low == 0.0
    assert estimate([4.0, 4.0]).low == estimate([4.0, 4.0]).high == 4.0


def test_the_plan_is_what_the_run_then_takes(tree, tmp_path):
    budget = {"price_prompt": 2.0, "price_completion": 10.0}
    with deciding(delay_s=0.1) as server:
        cfg = settings(server.url, budget=budget)
        forecast = make_forecast(cfg, tree, tmp_path / "out")
        num_trial_requests = len(server.bodies)
        run(cfg, tree, tmp_path / "out")
        asked = len(server.bodies) - 2  # two requests measured the pictures' tokens
    report = report_of(tmp_path / "out")
    assert forecast.num_windows == report["windows"]["input"] == 5
    assert forecast.calls.expected == asked == 10
    assert forecast.prompt_tokens.expected == report["tokens"]["prompt_tokens"] == 10_000
    assert forecast.completion_tokens.low == report["tokens"]["completion_tokens"] == 1_000
    assert forecast.cost.expected == pytest.approx((10_000 * 2.0 + 1_000 * 10.0) / 1e6)
    assert num_trial_requests == 2 * forecast.num_trials + 2  # and the run did not ask about these windows again
    assert 0 < forecast.seconds.low <= forecast.seconds.expected <= forecast.seconds.high
    assert ("cost", "0.03 (0.03 to 0.03)") in forecast.rows()


def test_the_plan_knows_the_images_share(tree, tmp_path):
    with TeacherServer(respond=patient(max_images=99)) as server:
        forecast = make_forecast(settings(server.url), tree, tmp_path / "out")
    assert forecast.image_tokens is not None
    asks = forecast.image_tokens.expected / (15 * TOKENS_PER_IMAGE * forecast.num_windows)
    assert asks == round(asks)  # whole asks of 15 pictures


@pytest.mark.parametrize("writing", ["slots", "claims", "prose"])
def test_the_largest_prompt_bounds_real_ones_with_their_corrections(tree, tmp_path, writing):
    with deciding("ascend", lambda number, body: "wrong_therefore") as server:
        cfg = CaptionConfig.model_validate({"teacher": server.url, "writing": writing, "limit": 2})
        with pytest.raises(NothingKept):
            run(cfg, tree, tmp_path / "out")
        bodies = [json.loads(body) for body in server.bodies]

    def size(messages: list[dict]) -> int:
        contents = [message["content"] for message in messages]
        return sum(len(part.get("text", "")) if isinstance(part, dict) else len(part) for c in contents for part in c)

    assert len(bodies) >= 2
    assert max(size(body["messages"]) for body in bodies) <= size(largest_messages(cfg, VOCABULARY, []))
