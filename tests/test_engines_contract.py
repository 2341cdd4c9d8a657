"""The engines of models: what they answer, how they refuse, and that one of one's own works as it is.

The vLLM engine is tested without vLLM. The stand-in behaves as vLLM 0.26 did on one H200: `enqueue_chat` gives an id
with a random part that the output lacks and raises ValueError for a prompt that is too long, `step` gives what is
finished in any order, a dead engine raises an Exception of its own, and `disable_any_whitespace` is refused unless a
backend is named.
"""

import asyncio
import errno
import importlib.util
import json
import os
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from specimens_captions import deciding, settings
from teacher_server import USAGE, is_mirror, kept_answers, obedient_answer

from caption.schema import CaptionConfig
from caption.stage import window_loop
from caption.stage.stage import run
from caption.teachers import teacher
from caption.teachers.teacher import make_engine
from cosfly.formats.captions import Usage, read_captions
from cosfly.formats.predictions import read_predictions
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import Answer, AnswerBook, KeptAnswers
from cosfly.llm.client import EndpointConfig
from cosfly.llm.contract import Reply, Request, started
from cosfly.llm.vllm_engine import VllmEngine
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, StorageError, TeacherError
from cosfly.runtime.journal import Journal
from distill.inference import stage as infer
from distill.schema import open_split


def obedient(messages: list[dict], schema: dict) -> str:
    body = {"messages": messages, "response_format": {"json_schema": {"schema": schema}}}
    return json.dumps(obedient_answer(deciding(), body))


class PlainEngine:
    kind, where, model = "endpoint", "plain", ""

    def __init__(self) -> None:
        self.num_answers = self.num_closed = 0

    async def start(self) -> None:
        self.model = "plain-1"

    async def answer(self, request: Request) -> Reply:
        self.num_answers += 1
        await asyncio.sleep(0)
        return Reply(obedient(request.messages, request.schema), Usage(**USAGE), "json_schema", "stop")

    async def close(self) -> None:
        self.num_closed += 1


def test_what_is_kept_or_asked_by_another_is_not_asked_again(tmp_path):
    engine, messages = PlainEngine(), [{"role": "user", "content": [{"type": "text", "text": "go"}]}]
    request = EndpointConfig().request(messages, [], answer_schema(), 0)

    async def ask() -> list[Reply]:
        async with started(engine):
            replies = []
            for _ in range(2):
                with AnswerBook(tmp_path / "answers") as book:
                    kept = KeptAnswers(engine, book)
                    asked = [kept.ask(request, "flight", f"flight_frame_{i:05d}", "judge") for i in range(5)]
                    replies += await asyncio.gather(*asked)
            return replies

    assert len(set(asyncio.run(ask()))) == 1
    [record] = kept_answers(tmp_path)
    assert (record["model"], record["sample_id"], record["purpose"]) == ("plain-1", "flight_frame_00000", "judge")
    assert engine.num_answers == 1


def answer_of(key: str) -> Answer:
    return Answer(key=key, sample_id="flight_frame_00004", purpose="free/0", text="{}", usage={"prompt_tokens": 10})


def test_answers_that_wait_for_the_disk_share_one_sync(tmp_path, monkeypatch):
    synced, all_wait = [], threading.Event()
    monkeypatch.setattr(os, "fsync", synced.append)

    async def put_all() -> None:
        with AnswerBook(tmp_path) as book:
            book._disk.submit(all_wait.wait, 60)
            puts = [asyncio.create_task(book.put("flight", answer_of(str(i)))) for i in range(20)]
            await asyncio.sleep(0)
            assert not book.totals
            puts[0].cancel()  # it is written, too
            all_wait.set()
            await asyncio.gather(*puts, return_exceptions=True)
            assert book.totals == {"answers": 20, "prompt_tokens": 200}

    asyncio.run(put_all())
    assert len(synced) == 1
    assert sum(1 for _ in Journal(tmp_path / "flight.jsonl").read()) == 20


def test_an_answer_that_is_not_on_the_disk_is_not_counted(tmp_path, monkeypatch):
    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)

    async def put_all() -> None:
        with AnswerBook(tmp_path) as book:
            puts = [book.put("flight", answer_of(str(i))) for i in range(3)]
            failures = await asyncio.gather(*puts, return_exceptions=True)
            assert [type(failure) for failure in failures] == [StorageError] * 3
            assert book.get("flight", "0") is None
            assert not book.totals

    asyncio.run(put_all())


def test_an_engine_is_closed_whatever_came_of_its_start():
    class Broken(PlainEngine):
        async def start(self) -> None:
            raise TeacherError("cannot start", where="here")

    async def open_it(engine) -> None:
        async with started(engine):
            pytest.fail("it has not started")

    broken = Broken()
    with pytest.raises(TeacherError):
        asyncio.run(open_it(broken))
    assert broken.num_closed == 1


def test_the_engine_of_the_recipe_captions_a_flight(tree, tmp_path: Path, monkeypatch):
    engine = PlainEngine()
    monkeypatch.setattr(teacher, "make_engine", lambda cfg: engine)
    monkeypatch.setattr(window_loop, "MIRROR_ASKS", 1)
    cfg = settings("http://plain")
    captions = list(read_captions(run(cfg, tree, tmp_path / "out")))
    assert len(captions) == 5
    for caption in captions:
        teacher_told = caption.teacher.kind, caption.teacher.model, caption.teacher.structured
        assert teacher_told == ("endpoint", "plain-1", "json_schema")
        assert caption.usage.prompt_tokens == 1000 * caption.attempts
    assert engine.num_answers == len(kept_answers(tmp_path / "out")) == sum(caption.attempts for caption in captions)
    assert engine.num_closed == 1


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "model-2b"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    return folder


class Recorded:
    def __init__(self, **values) -> None:
        self.values = values
        if "top_kk" in values:
            raise TypeError("Unexpected keyword argument 'top_kk'")
        if values.get("top_k") == -5:
            raise ValueError("top_k must be 0 (disable), or at least 1, got -5.")


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
        awaited = 0  # nothing is finished until so many were asked, or half a minute is over
        finish_reason = "stop"

        def __init__(self, **arguments) -> None:
            structured = arguments["structured_outputs_config"]
            if structured.get("disable_any_whitespace") and structured.get("backend") not in ("xgrammar", "guidance"):
                raise ValueError("disable_any_whitespace is only supported for xgrammar and guidance backends.")
            if "gdn_prefil" in arguments:
                raise TypeError("EngineArgs.__init__() got an unexpected keyword argument 'gdn_prefil'")
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
            text, tokens = obedient(conversation, schema), tuple(range(7))
            completion = SimpleNamespace(text=text, token_ids=tokens, finish_reason=Engine.finish_reason)
            found = SimpleNamespace(outputs=[completion], prompt_token_ids=[0] * 1280, request_id=name, finished=True)
            self.open.append(found)
            return [f"{name}-89abcdef"]

        def step(self):
            if Engine.dies_after is not None and len(Engine.asked) > Engine.dies_after:
                raise EngineDeadError("EngineCore encountered an issue. See stack trace (above) for the root cause.")
            Engine.open_at_step.append(len(self.open))
            if len(Engine.asked) < Engine.awaited and len(Engine.open_at_step) < 3000:
                time.sleep(0.01)
                return []
            ended = self.open[1:][::-1] or self.open  # all but the oldest, youngest first
            self.open = [waiting for waiting in self.open if waiting not in ended]
            return ended

    package, parameters = ModuleType("vllm"), ModuleType("vllm.sampling_params")
    package.__spec__ = importlib.util.spec_from_loader("vllm", None)
    package.LLM, package.SamplingParams = Engine, Recorded  # type: ignore[attr-defined]
    parameters.StructuredOutputsParams = Recorded  # type: ignore[attr-defined]
    monkeypatch.setattr("gc.collect", lambda: None)  # of all that the tests of this process have made
    monkeypatch.setitem(sys.modules, "vllm", package)
    monkeypatch.setitem(sys.modules, "vllm.sampling_params", parameters)
    return Engine


def vllm_settings(model, **sections) -> CaptionConfig:
    shared = {"teacher": f"vllm:{model}", "image": {"max_side_px": 32}, "repair": {"hard_conflict": "keep"}}
    return CaptionConfig.model_validate(shared | sections)


def engine_of(model, **sections) -> VllmEngine:
    engine = make_engine(CaptionConfig.model_validate({"teacher": f"vllm:{model}", **sections}))
    assert isinstance(engine, VllmEngine)
    return engine


@pytest.mark.skipif(importlib.util.find_spec("vllm") is not None, reason="vllm is installed here")
def test_without_vllm_one_line_says_what_to_install(tree, model, tmp_path):
    with pytest.raises(EnvironmentMissing, match=r"vLLM engine is not installed.*\.\[vllm\]"):
        engine_of(model).load()
    with pytest.raises(EnvironmentMissing, match="not installed"):
        run(CaptionConfig(teacher=f"vllm:{model}"), tree, tmp_path / "out")


def test_the_engine_gets_our_images_and_no_free_whitespace(model):
    own = {"max_model_len": 8192, "engine": {"gdn_prefill_backend": "triton"}}
    arguments = engine_of(model, vllm=own).arguments()
    assert arguments["model"] == str(model)
    assert arguments["limit_mm_per_prompt"] == {"image": 15, "video": 0}
    assert arguments["structured_outputs_config"] == {"backend": "xgrammar", "disable_any_whitespace": True}
    assert (arguments["max_model_len"], arguments["gdn_prefill_backend"]) == (8192, "triton")
    tiled = engine_of(model, image={"layout": "tiled"}).arguments()
    assert tiled["limit_mm_per_prompt"] == {"image": 5, "video": 0}
    assert "max_model_len" not in tiled


def test_a_request_holds_sampling_and_schema(stand_in, model):
    messages, schema = [{"role": "user", "content": "x"}], {"type": "object"}

    def parameters_of(**endpoint) -> dict:
        engine = engine_of(model, endpoint=endpoint)
        return engine.parameters(engine.sampling.request(messages, [], schema, 5)).values

    plain = parameters_of(temperature=0.3, max_tokens=99)
    assert plain.pop("structured_outputs").values == {"json": schema}
    assert plain == {"temperature": 0.3, "top_p": 0.95, "max_tokens": 99, "seed": 5}
    assert parameters_of(json_schema=False)["structured_outputs"] is None
    more = parameters_of(extra_body={"top_k": 20, "chat_template_kwargs": {"enable_thinking": False}})
    assert more["top_k"] == 20
    assert "chat_template_kwargs" not in more  # goes to the call itself: see the templates below


def test_what_vllm_does_not_know_is_a_setting_not_a_crash(stand_in, model):
    with pytest.raises(ConfigError, match=r"caption.vllm.engine.*gdn_prefil"):
        engine_of(model, vllm={"engine": {"gdn_prefil": "triton"}}).load()
    for extra in ({"top_kk": 3}, {"top_k": -5}):
        with pytest.raises(ConfigError, match=rf"caption\.endpoint: vLLM rejects a setting.*{next(iter(extra))}"):
            engine_of(model, endpoint={"extra_body": extra}).load()
    whitespace = {"structured_outputs_config": {"disable_any_whitespace": True}}
    with pytest.raises(EnvironmentMissing, match=r"does not start.*only supported for xgrammar"):
        engine_of(model, vllm={"engine": whitespace}).load()


def test_requests_join_while_others_are_answered_and_every_answer_is_kept(stand_in, tree, model, tmp_path):
    stand_in.awaited = 2  # on a busy machine the second may come when the first could long be answered
    template = {"enable_thinking": False}
    cfg = vllm_settings(model, vllm={"batch": 6}, endpoint={"extra_body": {"chat_template_kwargs": template}})
    path = run(cfg, tree, tmp_path / "out")
    captions = list(read_captions(path))
    assert (len(captions), {caption.teacher.kind for caption in captions}) == (5, {"vllm"})
    assert {caption.teacher.model for caption in captions} == {"model-2b"}
    assert all(caption.usage == Usage(prompt_tokens=2560, completion_tokens=14) for caption in captions)
    assert (len(stand_in.asked), stand_in.templates) == (10, [template] * 10)
    assert 2 <= max(stand_in.open_at_step) <= 6  # together, and never more than were allowed
    (tmp_path / "out" / "manifest.json").unlink()
    assert run(cfg, tree, tmp_path / "out").read_bytes() == path.read_bytes()
    assert len(stand_in.asked) == 10  # nothing was asked again


def test_a_prompt_that_the_engine_refuses_costs_only_its_window(stand_in, tree, model, tmp_path):
    cfg = vllm_settings(model)
    run(cfg, tree, tmp_path / "first")
    assert len(stand_in.asked) == 10
    stand_in.refused = next(asked for asked in stand_in.asked if not is_mirror({"messages": asked}))
    run(cfg, tree, tmp_path / "second")
    assert len(stand_in.asked) == 18  # the others once each
    windows = json.loads((tmp_path / "second" / "caption_report.json").read_text())["windows"]
    assert windows == {"input": 5, "kept": 4, "dropped": {}, "failed": {"refused": 1}}


@pytest.mark.timeout(60)
def test_an_engine_that_dies_ends_the_run_in_one_line_and_the_next_goes_on(stand_in, tree, model, tmp_path):
    cfg = vllm_settings(model, vllm={"batch": 2})
    stand_in.dies_after = 4
    with pytest.raises(TeacherError, match=r"engine failed.*EngineDeadError"):
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
        run(vllm_settings(model), tree, tmp_path / "out")
    stand_in.finish_reason = "stop"
    assert len(list(read_captions(run(vllm_settings(model), tree, tmp_path / "out")))) == 5


def test_a_student_answers_in_the_same_engine(stand_in, place, tmp_path):
    student = tmp_path / "student"
    student.mkdir()
    (student / "config.json").write_text(json.dumps({"model_type": "qwen3_5"}))
    (student / "model.safetensors").touch()
    cfg = infer.InferConfig(split="train", engine="vllm", constrained=True)
    predictions = read_predictions(infer.run(cfg, place / "set", [place / "tree"], student, tmp_path / "out"))
    assert len(predictions) == len(stand_in.asked) == len(list(open_split(place / "set", "train")))
    assert all(prediction.coc is not None for prediction in predictions)
    assert stand_in.templates == [{"enable_thinking": False}] * len(predictions)
