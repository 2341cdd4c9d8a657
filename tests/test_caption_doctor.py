"""The endpoint's doctor against servers with one defect each, and the plan against a server whose tokens are known."""

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from commands import invoke
from specimens_captions import VOCABULARY
from tables import each
from teacher_server import ENGLISH, TeacherServer, refusal

from caption.schema import CaptionConfig
from caption.teachers.doctor import ODD_WORD, Finding, examine_endpoint

TOKENS_PER_IMAGE, CONTEXT = 220, 8192


def images_of(body: dict) -> int:
    contents = [message["content"] for message in body["messages"]]
    return sum(part["type"] == "image_url" for content in contents if isinstance(content, list) for part in content)


def prompt_tokens(body: dict, seen_images: int) -> int:
    contents = [message["content"] for message in body["messages"]]
    texts = [part.get("text", "") for content in contents if isinstance(content, list) for part in content]
    texts += [content for content in contents if isinstance(content, str)]
    return sum(len(text.split()) for text in texts) + TOKENS_PER_IMAGE * seen_images


# A sound endpoint. cuts: prompts to so many tokens, in silence. shortens: the answer to fit the context, in silence. status: of a refusal for too many pictures.
# in_parts: the answer is a list of parts. takes_null: where a field may be null.
SOUND = {
    "obeys_schema": True, "refuses_schema": False, "max_images": 15, "sees_images": 99, "thinks": False, "counts": True,
    "context": CONTEXT, "shortens": False, "empty": False, "status": 400, "in_parts": False, "takes_null": True,
    "cuts": 10**6, "has_system": True, "most_bytes": 10**9,
}  # fmt: skip


def patient(**defects: Any) -> Callable[[dict], tuple[int, dict]]:
    """A server's behaviour: what it answers to any request."""
    own = SimpleNamespace(**SOUND | defects)

    def respond(body: dict) -> tuple[int, dict]:
        num_images = images_of(body)
        if None in body.values() and not own.takes_null:
            return refusal(400, "Input should be a valid number")
        if body["messages"][0]["role"] == "system" and not own.has_system:
            return refusal(400, "System role not supported")
        if len(json.dumps(body)) > own.most_bytes:
            return refusal(413, "Request Entity Too Large")
        tokens = min(prompt_tokens(body, min(num_images, own.sees_images)), own.cuts)
        if num_images > own.max_images:
            return refusal(own.status, f"At most {own.max_images} image(s) may be provided in one prompt.")
        if tokens + (0 if own.shortens else body["max_tokens"]) > own.context:
            return refusal(400, f"This model's maximum context length is {own.context} tokens")
        wanted = body.get("response_format", {}).get("json_schema", {}).get("schema")
        if wanted and own.refuses_schema:
            return refusal(400, "response_format is not supported")
        text = "I am fine, thank you."
        if wanted and own.obeys_schema:
            plain = {**ENGLISH, **dict.fromkeys(("therefore", "flight_decision"), "hover")}
            text = json.dumps({"animal": ODD_WORD, "legs": 7} if "animal" in wanted["properties"] else plain)
        elif isinstance(body["messages"][-1]["content"], list) and body["messages"][0]["role"] == "system":
            text = "Here it is: " + json.dumps(dict.fromkeys(ENGLISH, "hover"))
        text = "" if own.empty else text
        message: dict[str, Any] = {"role": "assistant", "content": text}
        if own.thinks:
            message["reasoning_content"] = "Let me think about that."
        if own.in_parts:
            message["content"] = [{"type": "text", "text": text}]
        is_cut = own.shortens and tokens + body["max_tokens"] > own.context
        usage = {"usage": {"prompt_tokens": tokens, "completion_tokens": 5}} if own.counts else {}
        return 200, {"choices": [{"message": message, "finish_reason": "length" if is_cut else "stop"}], **usage}

    return respond


def examine(behaviour: Callable, context: int = CONTEXT, **changes) -> dict[str, Finding]:
    with TeacherServer(respond=behaviour, model_facts={"max_model_len": context}) as server:
        cfg = CaptionConfig.model_validate(changes)
        return {finding.name: finding for finding in examine_endpoint(server.url, cfg, VOCABULARY)}


def test_a_sound_endpoint_passes_every_check():
    findings = examine(patient())
    assert {finding.state for finding in findings.values()} == {"ok"}
    assert list(findings) == ["model", "answers", "thinking", "JSON schema", "image input", "context length", "speed"]
    assert f"{15 * TOKENS_PER_IMAGE} tokens" in findings["image input"].detail


# defect, the finding it must show in, its state, words of the detail
DEFECTS = [
    ({"obeys_schema": False}, "JSON schema", "warning", "accepted but ignored"),
    ({"refuses_schema": True}, "JSON schema", "warning", "refused"),
    ({"max_images": 5}, "image input", "unusable", "At most 5 image(s)"),
    ({"max_images": 5, "status": 200}, "image input", "unusable", "--limit-mm-per-prompt"),
    ({"sees_images": 0}, "image input", "unusable", "accepted but ignored"),
    ({"counts": False}, "image input", "warning", "token usage is not reported"),
    ({"thinks": True}, "thinking", "warning", "switch thinking off"),
    ({"context": 5000}, "context length", "unusable", "context length is 5000"),
    ({"context": 5000}, "context length", "unusable", "--max-model-len"),
    ({"cuts": 4096}, "context length", "unusable", "drops the rest without an error"),
    ({"has_system": False}, "system role", "warning", "sent with the question"),
    ({"most_bytes": 300_000}, "image input", "unusable", "the request has 0.9 MB"),
    ({"context": 6000, "shortens": True}, "context length", "unusable", "more than 6000"),
    ({"empty": True}, "answers", "unusable", "an empty answer"),
    ({"empty": True, "thinks": True}, "answers", "unusable", "enable_thinking: false"),
]


def test_an_answer_in_parts_is_read_and_a_null_field_is_left_out():
    findings = examine(patient(in_parts=True, takes_null=False), endpoint={"extra_body": {"temperature": None}})
    assert {finding.state for finding in findings.values()} == {"ok"}


def test_a_schema_that_is_switched_off_is_not_sent():
    findings = examine(patient(refuses_schema=True), endpoint={"json_schema": False})
    assert {finding.state for finding in findings.values()} == {"ok"}
    assert "switched off" in findings["JSON schema"].detail


@each(("defect", "name", "state", "words"), DEFECTS, ids=lambda value: str(value))
def test_a_defect_is_found(defect, name, state, words):
    findings = examine(patient(**defect), defect.get("context", CONTEXT))
    assert findings[name].state == state
    assert words in findings[name].detail


def test_an_examination_without_pictures():
    findings = examine(patient(max_images=0), image={"modalities": []})
    assert {finding.state for finding in findings.values()} == {"ok"}


@each("defect", [{}, {"refuses_schema": True}], ids=str)  # a refused schema is a request, too
def test_an_examination_with_a_limit(defect):
    for limit in (2, 3):
        with TeacherServer(respond=patient(**defect)) as server:
            findings = examine_endpoint(server.url, CaptionConfig(), VOCABULARY, limit)
            assert len(server.bodies) == limit
        assert findings[-1].name == "limit"
        assert findings[-1].detail.startswith(f"stopped after {limit} requests")


def test_the_command_exits_with_1_when_unusable():
    with TeacherServer(respond=patient()) as server:
        assert invoke("caption doctor", server.url).exit_code == 0
    with TeacherServer(respond=patient(max_images=0)) as server:
        assert invoke("caption doctor", server.url).exit_code == 1
