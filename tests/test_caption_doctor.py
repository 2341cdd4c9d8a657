"""The endpoint's doctor against servers with one defect each, and the plan against a server whose tokens are known."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import pytest
from commands import invoke
from specimens_captions import VOCABULARY, deciding, report_of, settings
from teacher_server import ENGLISH, TeacherServer, is_mirror, written_answer

from caption.run.forecast import estimate, make_forecast
from caption.run.stage import run
from caption.schema import CaptionConfig
from caption.teachers.doctor import ODD_WORD, Finding, examine_endpoint, largest_messages
from caption.teachers.images import pictures_of
from caption.teachers.trials import SCENES, TrialFrames, trial_window
from caption.truth.facts import measure_facts
from caption.writing.contract import WAYS
from cosfly.errors import NothingKept

TOKENS_PER_IMAGE, CONTEXT = 220, 8192


def parts_of(message: dict) -> list[dict]:
    return message["content"] if isinstance(message["content"], list) else []


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
    admits_cut: bool = True,
    poisons: bool = False,
    shortens: bool = False,
    empty: bool = False,
    status: int = 400,
    in_parts: bool = False,
    takes_null: bool = True,
    can: Collection[str] = ("slots", "claims", "prose"),
) -> Callable[[dict], tuple[int, dict]]:
    """A server's behaviour: what it answers to any request.

    poisons: after a prompt that was too long, 500 to any with a picture of it. shortens: the answer to fit the context,
    in silence.
    status: of a refusal for too many pictures. in_parts: the answer is a list of parts. takes_null: where a field may
    be null.
    """
    poisoned: set[str] = set()

    def respond(body: dict) -> tuple[int, dict]:
        num_images = images_of(body)
        if None in body.values() and not takes_null:
            return 400, {"error": {"message": "Input should be a valid number"}}
        tokens = prompt_tokens(body, min(num_images, sees_images))
        if num_images > max_images:
            return status, {"error": {"message": f"At most {max_images} image(s) may be provided in one prompt."}}
        pictures = {
            json.dumps(part) for message in body["messages"] for part in parts_of(message) if "image_url" in part
        }
        if pictures & poisoned:
            return 500, {"error": {"message": "Internal Server Error"}}
        if tokens + (0 if shortens else body["max_tokens"]) > context:
            if poisons:
                poisoned.update(pictures)
            return 400, {"error": {"message": f"This model's maximum context length is {context} tokens"}}
        wanted = body.get("response_format", {}).get("json_schema", {}).get("schema")
        if wanted and refuses_schema:
            return 400, {"error": {"message": "response_format is not supported"}}
        text = "I am fine, thank you."
        if wanted and obeys_schema:
            names = wanted["properties"]
            odd = {"animal": ODD_WORD, "legs": 7}
            plain = {**ENGLISH, **dict.fromkeys(("therefore", "flight_decision"), "hover")}
            text = json.dumps(odd if "animal" in names else plain if is_mirror(body) else written_answer(body, can))
        elif isinstance(body["messages"][-1]["content"], list) and body["messages"][0]["role"] == "system":
            text = "Here it is: " + json.dumps(written_answer(body, can))
        is_cut = body["max_tokens"] == 8 and admits_cut
        message: dict[str, Any] = {"role": "assistant", "content": text}
        if thinks:
            message["reasoning_content"] = "Let me think about that."
        if empty:
            message["content"] = ""
        if in_parts:
            message["content"] = [{"type": "text", "text": message["content"]}]
        is_cut |= shortens and tokens + body["max_tokens"] > context
        reply = {"choices": [{"message": message, "finish_reason": "length" if is_cut else "stop"}]}
        if counts:
            reply["usage"] = {"prompt_tokens": tokens, "completion_tokens": 5}  # type: ignore[assignment]
        return 200, reply

    return respond


def examine(behaviour: Callable, **changes) -> dict[str, Finding]:
    changes = {"writing": next(iter(WAYS)), **changes}
    with TeacherServer(respond=behaviour, model_facts={"max_model_len": CONTEXT}) as server:
        cfg = CaptionConfig.model_validate({"endpoint": {"backoff_s": 0.01, **changes.pop("endpoint", {})}, **changes})
        return {finding.name: finding for finding in examine_endpoint(server.url, cfg, VOCABULARY)}


def test_a_sound_endpoint_passes_every_check():
    findings = examine(patient())
    assert {finding.state for finding in findings.values()} == {"ok"}
    assert list(findings) == [
        "model", "answers", "token usage", "thinking", "finish reason", "JSON schema", "image input",
        "images per prompt",
        "largest prompt", "answer to it", *(f"writes {way}" for way in WAYS), "writing",
    ]  # fmt: skip
    assert f"{TOKENS_PER_IMAGE} tokens" in findings["image input"].detail
    assert "15" in findings["images per prompt"].detail


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
    ({"max_images": 5}, "images per prompt", "unusable", "5, our prompts hold 15"),
    ({"max_images": 5, "status": 200}, "images per prompt", "unusable", "5, our prompts hold 15"),
    ({"max_images": 0}, "image input", "unusable", "refused"),
    ({"sees_images": 0}, "image input", "unusable", "accepted and ignored"),
    ({"sees_images": 4}, "images per prompt", "warning", "some were dropped"),
    ({"thinks": True}, "thinking", "warning", "switch it off"),
    ({"counts": False}, "token usage", "warning", "not reported"),
    ({"context": 3800}, "largest prompt", "unusable", "context length is 3800"),
    ({"context": 3800}, "largest prompt", "unusable", "--max-model-len"),
    ({"context": 3000}, "largest prompt", "unusable", "15 pictures alone are too much: HTTP 400 This model's maximum"),
    ({"context": 3800, "poisons": True}, "largest prompt", "unusable", "context length is 3800"),
    ({"context": 3000, "poisons": True}, "largest prompt", "unusable", "context length is 3000"),
    ({"context": 6000, "shortens": True}, "largest prompt", "unusable", "cut after 5 of 1024 tokens"),
    ({"admits_cut": False}, "finish reason", "warning", "not 'length'"),
    ({"empty": True}, "answers", "unusable", "an empty answer, which ends with 'stop'"),
    ({"empty": True, "thinks": True}, "answers", "unusable", "enable_thinking: false"),
]


def test_an_answer_in_parts_is_read_and_a_null_field_is_left_out():
    findings = examine(patient(in_parts=True, takes_null=False), endpoint={"extra_body": {"temperature": None}})
    assert {finding.state for finding in findings.values()} == {"ok"}


@pytest.mark.parametrize(("defect", "name", "state", "words"), DEFECTS, ids=lambda value: str(value))
def test_a_defect_is_found(defect, name, state, words):
    findings = examine(patient(**defect))
    assert findings[name].state == state
    assert words in findings[name].detail


def test_an_endpoint_that_is_none_and_a_missing_model(tmp_path):
    with TeacherServer() as server:
        found = examine_endpoint(server.url, CaptionConfig.model_validate({"endpoint": {"model": "other"}}), VOCABULARY)
    assert [(finding.name, finding.state) for finding in found] == [("model", "unusable")]
    assert "does not have this model" in found[0].detail


@pytest.mark.parametrize(
    "can", [set(), {"prose"}, {"claims"}, {"claims", "prose"}, {"slots", "claims", "prose"}], ids=sorted
)
def test_the_doctor_finds_out_what_a_teacher_can_write(can):
    findings = examine(patient(can=can))
    able = [way for way in WAYS if way in can]
    for way in WAYS:
        state, count = ("ok", 3) if way in can else ("warning", 0)
        assert findings[f"writes {way}"].state == state
        assert findings[f"writes {way}"].detail.startswith(f"{count} of 3 answers passed")
    if not able:
        assert "no trial answer passed" in findings["writing"].detail
    elif able[0] == next(iter(WAYS)):
        assert findings["writing"].state == "ok"
    else:
        assert f"--set caption.writing={able[0]}" in findings["writing"].detail


def test_an_answer_that_is_cut_short_asks_for_more_tokens():
    whole = patient()

    def respond(body: dict) -> tuple[int, dict]:
        status, reply = whole(body)
        if body["messages"][0]["role"] == "system":
            choice = reply["choices"][0]
            choice["finish_reason"], choice["message"]["content"] = "length", choice["message"]["content"][:60]
            reply["usage"]["completion_tokens"] = body["max_tokens"]
        return status, reply

    detail = examine(respond)["writes claims"].detail
    assert "structure_cut_short" in detail
    assert "raise caption.endpoint.max_tokens" in detail


def test_a_server_without_schemas_may_write_all_the_same():
    findings = examine(patient(refuses_schema=True))
    assert findings["writes claims"].state == "ok"


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_trial_windows_are_consistent_flights(scene):
    window = trial_window(scene, 5)
    facts = measure_facts(window, (640, 360))
    assert facts.speed_mps[-1] == pytest.approx(np.hypot(scene.speed_mps, scene.climb_mps), abs=0.01)
    assert facts.visibility[-1] == "visible"
    assert None not in facts.box_height_px
    for left, top, right, bottom in (frame.target_bbox for frame in window.frames):
        assert 0 < left < right < 1280
        assert 0 < top < bottom < 720
    pictures = pictures_of(window, CaptionConfig().image)
    encoded = [TrialFrames(window, CaptionConfig().image).encode(folder, pictures) for folder in window.frame_folders]
    assert [len(images) for images in encoded] == [3] * 5


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
