"""The vLLM teacher without vLLM: what it asks of the engine, how it reads what the engine gives back, and its absence.

The engine's outputs are stand-ins of the documented shape (`RequestOutput.outputs[0].text`, `.token_ids`, `.finish_reason`,
`RequestOutput.prompt_token_ids`); whether a real engine accepts the requests is a matter for a machine with an accelerator.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from types import ModuleType, SimpleNamespace

import pytest
from teacher_server import CHINESE, ENGLISH, is_mirror

from caption.schema import CaptionConfig
from caption.stage import run
from caption.vllm_teacher import Request, build_request, chat, engine_arguments, load_engine, read_output
from cosfly.coc import read_captions
from cosfly.errors import EnvironmentMissing, InputError
from specimens import make_playback_tree


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "model-2b"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    return folder


def output(text: str, num_prompt: int = 1280, finish_reason: str = "stop") -> SimpleNamespace:
    completion = SimpleNamespace(text=text, token_ids=tuple(range(7)), finish_reason=finish_reason)
    return SimpleNamespace(outputs=[completion], prompt_token_ids=list(range(num_prompt)))


class Recorded:
    """Keeps its keyword arguments, as the documented parameter classes do."""

    def __init__(self, **values) -> None:
        self.values = values


@pytest.fixture
def stand_in(monkeypatch):
    """Modules with the two documented parameter classes and an engine that answers like an obedient model."""

    class Engine:
        batches: list = []  # noqa: RUF012
        refused = None

        def __init__(self, **arguments) -> None:
            self.arguments = arguments

        def chat(self, messages, sampling_params, use_tqdm=True):
            Engine.batches.append(list(zip(messages, sampling_params, strict=True)))
            found = []
            for conversation, parameters in Engine.batches[-1]:
                if conversation == Engine.refused:
                    raise ValueError("The decoder prompt is longer than the maximum model length")
                schema = parameters.values["structured_outputs"].values["json"]
                decision = schema["properties"]["flight_decision"]["enum"][0]
                answer = CHINESE if is_mirror({"messages": conversation}) else ENGLISH
                found.append(output(json.dumps({**answer, "flight_decision": decision})))
            return found

    Engine.batches = []
    package, parameters = ModuleType("vllm"), ModuleType("vllm.sampling_params")
    package.__spec__ = importlib.util.spec_from_loader("vllm", None)
    package.LLM, package.SamplingParams = Engine, Recorded  # type: ignore[attr-defined]
    parameters.StructuredOutputsParams = Recorded  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "vllm", package)
    monkeypatch.setitem(sys.modules, "vllm.sampling_params", parameters)
    return Engine


@pytest.mark.skipif(importlib.util.find_spec("vllm") is not None, reason="vllm is installed here")
def test_without_vllm_one_line_says_what_to_install(model, tmp_path):
    with pytest.raises(EnvironmentMissing, match=r"vLLM engine is not installed.*cosfly\[vllm\]"):
        load_engine(model, CaptionConfig())
    tree = make_playback_tree(tmp_path / "tree", 1, 12, with_augmented=False)
    with pytest.raises(EnvironmentMissing, match="not installed"):
        run(CaptionConfig(teacher=f"vllm:{model}"), tree, tmp_path / "out")


def test_a_folder_that_is_no_model(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 12, with_augmented=False)
    with pytest.raises(InputError, match="not a model folder"):
        run(CaptionConfig(teacher=f"vllm:{tmp_path}"), tree, tmp_path / "out")


def test_the_engine_gets_our_images_and_no_free_whitespace(model):
    cfg = CaptionConfig.model_validate({"vllm": {"max_model_len": 8192, "engine": {"gdn_prefill_backend": "triton"}}})
    arguments = engine_arguments(model, cfg)
    assert arguments["model"] == str(model)
    assert arguments["limit_mm_per_prompt"] == {"image": 15}
    assert arguments["structured_outputs_config"] == {"disable_any_whitespace": True}
    assert arguments["max_model_len"] == 8192
    assert arguments["gdn_prefill_backend"] == "triton"
    tiled = CaptionConfig.model_validate({"image": {"layout": "tiled"}})
    assert engine_arguments(model, tiled)["limit_mm_per_prompt"] == {"image": 5}
    assert "max_model_len" not in engine_arguments(model, tiled)


def test_a_request_holds_sampling_and_schema():
    messages, schema = [{"role": "user", "content": "x"}], {"type": "object"}
    cfg = CaptionConfig.model_validate({"endpoint": {"temperature": 0.3, "top_p": 0.8, "max_tokens": 99}})
    request = build_request(cfg, messages, schema, 5)
    assert request == Request(messages, {"temperature": 0.3, "top_p": 0.8, "max_tokens": 99, "seed": 5}, schema)
    free = CaptionConfig.model_validate({"endpoint": {"json_schema": False}})
    assert build_request(free, messages, schema, 5).schema is None


def test_an_output_is_read():
    found = read_output(output("{}", 10, "length"))
    assert found == {
        "text": "{}", "usage": {"prompt_tokens": 10, "completion_tokens": 7}, "finish_reason": "length",
    }  # fmt: skip


def test_chat_keeps_the_order_and_names_the_structure(stand_in):
    schemas = [{"properties": {"flight_decision": {"enum": [word]}}} for word in ("hover", "ascend")]
    requests = [
        Request([{"role": "user", "content": [{"type": "text", "text": "x"}]}], {"seed": 1}, s) for s in schemas
    ]
    found = chat(stand_in(), requests)
    assert [json.loads(answer["text"])["flight_decision"] for answer in found] == ["hover", "ascend"]
    assert {answer["structured"] for answer in found} == {"json_schema"}
    assert stand_in.batches[0][0][1].values["seed"] == 1


def test_a_run_gathers_windows_into_batches_and_keeps_every_answer(stand_in, model, tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 2, 16, with_augmented=False)
    cfg = CaptionConfig.model_validate(
        {"teacher": f"vllm:{model}", "image": {"max_side_px": 32}, "vllm": {"batch": 8}, "repair": {"verdicts": ()}}
    )
    path = run(cfg, tree, tmp_path / "out")
    captions = list(read_captions(path))
    assert len(captions) == 14
    assert {caption.teacher["kind"] for caption in captions} == {"vllm"}
    assert {caption.teacher["model"] for caption in captions} == {"model-2b"}
    assert all(caption.usage == {"prompt_tokens": 2560, "completion_tokens": 14} for caption in captions)
    sizes = [len(batch) for batch in stand_in.batches]
    assert sum(sizes) == 28
    assert max(sizes) <= 8 < sum(sizes) / len(sizes) * 2  # full batches, not one by one
    (tmp_path / "out" / "manifest.json").unlink()
    assert run(cfg, tree, tmp_path / "out").read_bytes() == path.read_bytes()
    assert sum(len(batch) for batch in stand_in.batches) == 28  # nothing was asked again


def test_a_prompt_that_the_engine_refuses_costs_only_its_window(stand_in, model, tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 14, with_augmented=False)
    cfg = CaptionConfig.model_validate(
        {"teacher": f"vllm:{model}", "image": {"max_side_px": 32}, "repair": {"verdicts": ()}}
    )
    run(cfg, tree, tmp_path / "first")
    asked = [conversation for batch in stand_in.batches for conversation, _ in batch]
    stand_in.refused = next(conversation for conversation in asked if not is_mirror({"messages": conversation}))
    run(cfg, tree, tmp_path / "second")
    windows = json.loads((tmp_path / "second" / "caption_report.json").read_text())["windows"]
    assert windows == {"input": 5, "kept": 4, "dropped": {"engine": 1}, "failed": {}}
