"""The vLLM engine without vLLM: what it asks of the engine, how it reads what the engine gives back, and its absence.

The stand-in behaves as vLLM 0.26 did on one H200: `enqueue_chat` gives an id with a random part that the output lacks
and raises ValueError for a prompt that is too long, `step` gives what is finished in any order, a dead engine raises an
Exception of its own, and `disable_any_whitespace` is refused unless a backend is named.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from types import ModuleType, SimpleNamespace

import pytest
from specimens_distill import make_captions, prepared
from teacher_server import CHINESE, ENGLISH, is_mirror

from caption.run.stage import run
from caption.schema import CaptionConfig
from caption.teachers.teacher import make_engine
from cosfly.chat.vllm_engine import VllmEngine
from cosfly.errors import ConfigError, EnvironmentMissing, TeacherError
from cosfly.products.captions import Usage, read_captions
from cosfly.products.predictions import read_predictions
from distill.inference import stage as infer
from distill.schema import open_split
from distill.student.model import MODEL_TYPE
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
    """Keeps its keyword arguments, as the parameter classes do."""

    def __init__(self, **values) -> None:
        self.values = values
        if "top_kk" in values:
            raise TypeError("Unexpected keyword argument 'top_kk'")


class EngineDeadError(Exception):
    """As in vLLM: neither a RuntimeError nor a ValueError."""


@pytest.fixture
def stand_in(monkeypatch):
    """Modules with the classes that we use and an engine that answers like an obedient model."""

    class Engine:
        asked: list = []  # noqa: RUF012  # conversations, in the order of their coming
        templates: list = []  # noqa: RUF012
        open_at_step: list = []  # noqa: RUF012
        refused = None
        dies_after = None
        finish_reason = "stop"
        num_loaded = 0

        def __init__(self, **arguments) -> None:
            structured = arguments["structured_outputs_config"]
            if structured.get("disable_any_whitespace") and structured.get("backend") not in ("xgrammar", "guidance"):
                raise ValueError("disable_any_whitespace is only supported for xgrammar and guidance backends.")
            if "gdn_prefil" in arguments:
                raise TypeError("EngineArgs.__init__() got an unexpected keyword argument 'gdn_prefil'")
            Engine.num_loaded += 1
            self.llm_engine = self
            self.open: list = []

        def enqueue_chat(self, messages, sampling_params, use_tqdm=True, chat_template_kwargs=None):
            [conversation], [parameters] = messages, sampling_params
            if conversation == Engine.refused:
                raise ValueError("The decoder prompt (length 4096) is longer than the maximum model length of 2500.")
            name = str(len(Engine.asked))
            Engine.asked.append(conversation)
            Engine.templates.append(chat_template_kwargs)
            schema = parameters.values["structured_outputs"].values["json"]
            is_chinese = is_mirror({"messages": conversation}) or not str(conversation[0]["content"]).isascii()
            answer = CHINESE if is_chinese else ENGLISH
            decision = schema["properties"]["flight_decision"]["enum"][0]
            decisions = {name: decision for name in schema["properties"] if name not in answer}
            found = output(json.dumps({**answer, **decisions}), finish_reason=Engine.finish_reason)
            found.request_id, found.finished = name, True
            self.open.append(found)
            return [f"{name}-89abcdef"]

        def step(self):
            if Engine.dies_after is not None and len(Engine.asked) > Engine.dies_after:
                raise EngineDeadError("EngineCore encountered an issue. See stack trace (above) for the root cause.")
            Engine.open_at_step.append(len(self.open))
            ended = self.open[1:][::-1] or self.open  # all but the oldest, youngest first
            self.open = [waiting for waiting in self.open if waiting not in ended]
            return ended

    package, parameters = ModuleType("vllm"), ModuleType("vllm.sampling_params")
    package.__spec__ = importlib.util.spec_from_loader("vllm", None)
    package.LLM, package.SamplingParams = Engine, Recorded  # type: ignore[attr-defined]
    parameters.StructuredOutputsParams = Recorded  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "vllm", package)
    monkeypatch.setitem(sys.modules, "vllm.sampling_params", parameters)
    return Engine


def settings(model, **sections) -> CaptionConfig:
    shared = {"teacher": f"vllm:{model}", "image": {"max_side_px": 32}, "repair": {"hard_conflict": "keep"}}
    return CaptionConfig.model_validate(shared | sections)


def engine_of(model, **sections) -> VllmEngine:
    engine = make_engine(CaptionConfig.model_validate({"teacher": f"vllm:{model}", **sections}))
    assert isinstance(engine, VllmEngine)
    return engine


@pytest.mark.skipif(importlib.util.find_spec("vllm") is not None, reason="vllm is installed here")
def test_without_vllm_one_line_says_what_to_install(tree, model, tmp_path):
    with pytest.raises(EnvironmentMissing, match=r"vLLM engine is not installed.*cosfly\[vllm\]"):
        engine_of(model).load()
    with pytest.raises(EnvironmentMissing, match="not installed"):
        run(CaptionConfig(teacher=f"vllm:{model}"), tree, tmp_path / "out")


def test_the_engine_gets_our_images_and_no_free_whitespace(model):
    own = {"max_model_len": 8192, "engine": {"gdn_prefill_backend": "triton"}}
    arguments = engine_of(model, vllm=own).arguments()
    assert arguments["model"] == str(model)
    assert arguments["limit_mm_per_prompt"] == {"image": 15, "video": 0}
    assert arguments["structured_outputs_config"] == {"backend": "xgrammar", "disable_any_whitespace": True}
    assert arguments["max_model_len"] == 8192
    assert arguments["gdn_prefill_backend"] == "triton"
    tiled = engine_of(model, image={"layout": "tiled"}).arguments()
    assert tiled["limit_mm_per_prompt"] == {"image": 5, "video": 0}
    assert "max_model_len" not in tiled


def test_a_request_holds_sampling_and_schema(stand_in, model):
    messages, schema = [{"role": "user", "content": "x"}], {"type": "object"}

    def parameters_of(**endpoint) -> dict:
        engine = engine_of(model, endpoint=endpoint)
        return engine.parameters(engine.sampling.request(messages, [], schema, 5)).values

    plain = parameters_of(temperature=0.3, top_p=0.8, max_tokens=99)
    assert plain.pop("structured_outputs").values == {"json": schema}
    assert plain == {"temperature": 0.3, "top_p": 0.8, "max_tokens": 99, "seed": 5}
    assert parameters_of(json_schema=False)["structured_outputs"] is None
    more = parameters_of(extra_body={"top_k": 20, "chat_template_kwargs": {"enable_thinking": False}})
    assert more["top_k"] == 20
    assert "chat_template_kwargs" not in more  # goes to the call itself: see the templates below


def test_what_vllm_does_not_know_is_a_setting_not_a_crash(stand_in, model):
    with pytest.raises(ConfigError, match=r"caption.vllm.engine.*gdn_prefil"):
        engine_of(model, vllm={"engine": {"gdn_prefil": "triton"}}).load()
    with pytest.raises(ConfigError, match="top_kk"):
        engine_of(model, endpoint={"extra_body": {"top_kk": 3}}).load()
    whitespace = {"structured_outputs_config": {"disable_any_whitespace": True}}
    with pytest.raises(EnvironmentMissing, match=r"does not start.*only supported for xgrammar"):
        engine_of(model, vllm={"engine": whitespace}).load()


def test_requests_join_while_others_are_answered_and_every_answer_is_kept(stand_in, tree, model, tmp_path):
    template = {"enable_thinking": False}
    cfg = settings(model, vllm={"batch": 6}, endpoint={"extra_body": {"chat_template_kwargs": template}})
    path = run(cfg, tree, tmp_path / "out")
    captions = list(read_captions(path))
    assert len(captions) == 5
    assert {caption.teacher.kind for caption in captions} == {"vllm"}
    assert {caption.teacher.model for caption in captions} == {"model-2b"}
    assert all(caption.usage == Usage(prompt_tokens=2560, completion_tokens=14) for caption in captions)
    assert len(stand_in.asked) == 10
    assert stand_in.templates == [template] * 10
    assert 2 <= max(stand_in.open_at_step) <= 6  # together, and never more than were allowed
    (tmp_path / "out" / "manifest.json").unlink()
    assert run(cfg, tree, tmp_path / "out").read_bytes() == path.read_bytes()
    assert len(stand_in.asked) == 10  # nothing was asked again


def test_a_prompt_that_the_engine_refuses_costs_only_its_window(stand_in, tree, model, tmp_path):
    cfg = settings(model)
    run(cfg, tree, tmp_path / "first")
    assert len(stand_in.asked) == 10
    stand_in.refused = next(asked for asked in stand_in.asked if not is_mirror({"messages": asked}))
    run(cfg, tree, tmp_path / "second")
    assert len(stand_in.asked) == 19  # the others once each, and a trial prompt that shows whose fault it is
    windows = json.loads((tmp_path / "second" / "caption_report.json").read_text())["windows"]
    assert windows == {"input": 5, "kept": 4, "dropped": {"engine": 1}, "failed": {}}


@pytest.mark.timeout(60)
def test_an_engine_that_dies_ends_the_run_in_one_line_and_the_next_goes_on(stand_in, tree, model, tmp_path):
    cfg = settings(model, vllm={"batch": 2})
    stand_in.dies_after = 4
    with pytest.raises(TeacherError, match=r"engine broke.*EngineDeadError"):
        run(cfg, tree, tmp_path / "out")
    num_asked = len(stand_in.asked)
    stand_in.dies_after = None
    run(cfg, tree, tmp_path / "out")
    assert num_asked < 10
    assert 10 < len(stand_in.asked) <= 10 + 2  # those that were in the engine when it died are asked once more
    windows = json.loads((tmp_path / "out" / "caption_report.json").read_text())["windows"]
    assert windows == {"input": 5, "kept": 5, "dropped": {}, "failed": {}}


def test_an_answer_that_the_engine_gave_up_is_none(stand_in, tree, model, tmp_path):
    stand_in.finish_reason = "abort"
    with pytest.raises(TeacherError, match=r"5 of 5 windows got no answer.*engine 5"):
        run(settings(model), tree, tmp_path / "out")
    stand_in.finish_reason = "stop"
    assert len(list(read_captions(run(settings(model), tree, tmp_path / "out")))) == 5


def test_a_student_answers_in_the_same_engine(stand_in, tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 3, 8, with_augmented=False)
    make_captions(tmp_path / "captions.jsonl", tree)
    training_set = prepared(tree, tmp_path / "captions.jsonl", tmp_path / "set")
    student = tmp_path / "student"
    student.mkdir()
    (student / "config.json").write_text(json.dumps({"model_type": MODEL_TYPE}))
    (student / "model.safetensors").touch()
    cfg = infer.InferConfig(split="train", engine="vllm", constrained=True)
    predictions = read_predictions(infer.run(cfg, training_set, [tree], student, tmp_path / "out"))
    assert len(predictions) == len(stand_in.asked) == len(list(open_split(training_set, "train")))
    assert all(prediction.coc is not None for prediction in predictions)
    assert stand_in.templates == [{"enable_thinking": False}] * len(predictions)
