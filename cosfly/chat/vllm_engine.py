"""A teacher in this process: the vLLM engine over a model folder (`--teacher vllm:MODEL_DIR`, extra `vllm`).

Run with vLLM 0.26 (docs/teachers.md has the figures). The engine has a thread of its own: a request joins while others are
answered (`LLM.enqueue_chat`, `LLMEngine.step`), and one that the engine refuses costs only itself.
"""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import os
import queue
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from caption.schema import CaptionConfig, Reply
from caption.teachers.answers import AnswerBook
from caption.teachers.budget import Budget
from caption.teachers.prompts import Question, answer_schema, mirror_messages, mirror_schema
from caption.teachers.teacher import KeptAnswers, SharedFrames, sampling_seed
from cosfly.chat.client import NoAnswer
from cosfly.errors import ConfigError, EnvironmentMissing, InputError, TeacherError
from cosfly.products.captions import Coc

PREFIX = "vllm:"
INSTALL = 'pip install "cosfly[vllm]" on a machine with an accelerator'
ADDED_PER_STEP = 8  # requests handed over between two looks at what is finished
FINISHED = ("stop", "length")  # what the engine says of an answer; others are its own failures


@dataclass(frozen=True)
class Request:
    """One conversation and how it is sampled, in plain values."""

    messages: list[dict]
    sampling: dict[str, Any]  # keyword arguments of SamplingParams, without structured_outputs
    schema: dict | None
    template: dict[str, Any] = field(default_factory=dict)  # chat_template_kwargs


class VllmTeacher:
    """Asks the engine. Use as an async context manager; the engine is loaded on entry."""

    def __init__(self, cfg: CaptionConfig, answers: AnswerBook, seed: int, budget: Budget) -> None:
        self.cfg, self.seed = cfg, seed
        self.folder = model_folder(cfg.teacher)
        self.record: dict[str, Any] = {}
        self.frames = SharedFrames(cfg.image)
        self.kept = KeptAnswers(answers, budget, str(self.folder))
        self._engine = EngineThread(self.folder, cfg)

    async def __aenter__(self) -> VllmTeacher:
        await self._engine.start()
        c = self.cfg.endpoint
        settings = {"temperature": c.temperature, "top_p": c.top_p, "max_tokens": c.max_tokens, "seed": self.seed}
        extra = {"extra_body": dict(c.extra_body)}
        self.record = {"kind": "vllm", "model": self.folder.name, "settings": settings | extra}
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.frames.close()
        await self._engine.stop()

    async def ask(self, question: Question) -> Reply:
        messages, digests = await self.frames.messages(question)
        schema = answer_schema(question.decision)
        return await self._complete(question.window.sample_id, question.purpose, messages, digests, schema)

    async def mirror(self, question: Question, english: Coc, ask: int) -> Reply:
        schema = mirror_schema(english.flight_decision)
        return await self._complete(question.window.sample_id, f"mirror/{ask}", mirror_messages(english), [], schema)

    async def _complete(
        self, sample_id: str, purpose: str, messages: list[dict], digests: list[str], schema: dict
    ) -> Reply:
        request = build_request(self.cfg, messages, schema, sampling_seed(self.seed, sample_id, purpose))
        body = {"model": self.record["model"], "messages": messages, **request.sampling}
        if request.template:
            body["chat_template_kwargs"] = request.template
        identity = {"sample_id": sample_id, "purpose": purpose}
        return await self.kept.give(identity, body, digests, schema, lambda: self._engine.answer(request))


class EngineThread:
    """The engine on its thread. Requests may come at any time; at most `vllm.batch` of them are in the engine."""

    def __init__(self, folder: Path, cfg: CaptionConfig) -> None:
        self.folder, self.cfg = folder, cfg
        self._thread = ThreadPoolExecutor(1, "vllm")  # the engine is called from one thread only
        self._new: queue.SimpleQueue[tuple[Request, Future[dict]] | None] = queue.SimpleQueue()
        self._open: dict[str, tuple[Request, Future[dict]]] = {}
        self._is_closing = False
        self._broken: TeacherError | None = None

    async def start(self) -> None:
        """Load the engine and serve.

        Raises:
            EnvironmentMissing, ConfigError: see load_engine.
        """
        try:
            engine = await asyncio.get_running_loop().run_in_executor(self._thread, load_engine, self.folder, self.cfg)
        except BaseException:
            self._thread.shutdown(wait=False)
            raise
        self._thread.submit(self._serve, engine)

    async def answer(self, request: Request) -> dict:
        """Give text, usage, structured and finish_reason.

        Raises:
            NoAnswer: the engine refuses this request. TeacherError: it is broken and will answer nothing.
        """
        answered: Future[dict] = Future()
        self._new.put((request, answered))
        return await asyncio.wrap_future(answered)

    async def stop(self) -> None:
        """End the thread and the engine; what is still asked stays without an answer."""
        self._is_closing = True
        self._new.put(None)
        await asyncio.get_running_loop().run_in_executor(None, self._thread.shutdown)
        gc.collect()  # the engine's processes and memory go with its last reference

    # --- on the thread ---

    def _serve(self, engine: Any) -> None:
        while not self._is_closing:
            for request, answered in self._take():
                if answered.set_running_or_notify_cancel():
                    self._add(engine, request, answered)
            try:
                if self._open and not self._is_closing:
                    self._step(engine)
            except Exception as error:
                self._break(error)

    def _take(self) -> list[tuple[Request, Future[dict]]]:
        """Give requests that came meanwhile; waits for one where there is nothing else to do."""
        taken: list[tuple[Request, Future[dict]]] = []
        while len(taken) < min(ADDED_PER_STEP, self.cfg.vllm.batch - len(self._open)):
            try:
                found = self._new.get(block=not (self._open or taken))
            except queue.Empty:
                break
            if found is None:
                break
            taken.append(found)
        return taken

    def _add(self, engine: Any, request: Request, answered: Future[dict]) -> None:
        if self._broken is not None:
            answered.set_exception(self._broken)
            return
        try:
            self._open[enqueue(engine, request)] = (request, answered)
        except (ValueError, RuntimeError) as error:  # what the engine raises for a prompt that it cannot take
            answered.set_exception(NoAnswer("engine", _one_line(error), is_final=True))
        except Exception as error:  # the process behind the engine is gone, or a bug: no request will be answered
            self._break(error, answered)

    def _step(self, engine: Any) -> None:
        for output in [output for output in engine.llm_engine.step() if output.finished]:
            request, answered = self._open.pop(output.request_id)
            found = read_output(output)
            if found["finish_reason"] in FINISHED:
                answered.set_result(found | {"structured": "plain" if request.schema is None else "json_schema"})
            else:
                answered.set_exception(NoAnswer("engine", f"it ended with {found['finish_reason']!r}"))

    def _break(self, error: Exception, *more: Future[dict]) -> None:
        self._broken = TeacherError(
            "the vLLM engine broke",
            where=f"{PREFIX}{self.folder}",
            got=f"{type(error).__name__}: {_one_line(error)}",
            fix="its messages above tell why; run the same command again: nothing answered is asked twice",
        )
        for answered in (*more, *(answered for _, answered in self._open.values())):
            answered.set_exception(self._broken)
        self._open.clear()


# --- the engine's interface -------------------------------------------------------------------------------------------


def model_folder(teacher: str) -> Path:
    """Give the folder of `vllm:MODEL_DIR`.

    Raises:
        InputError: it is not a model folder.
    """
    folder = Path(teacher.removeprefix(PREFIX))
    if not (folder / "config.json").is_file():
        raise InputError(
            "not a model folder", where=folder, expected="a folder with config.json", fix="check --teacher"
        )
    return folder


def build_request(cfg: CaptionConfig, messages: list[dict], schema: dict, seed: int) -> Request:
    """Give one request in plain values. `image_uuid` gives no id here: in one process the engine hashes pictures itself."""
    c = cfg.endpoint
    sampling = {"temperature": c.temperature, "top_p": c.top_p, "max_tokens": c.max_tokens, "seed": seed}
    more = dict(c.extra_body)
    template = more.pop("chat_template_kwargs", {})
    return Request(messages, sampling | more, schema if c.json_schema else None, template)


def engine_arguments(folder: Path, cfg: CaptionConfig) -> dict[str, Any]:
    """Give the keyword arguments of `vllm.LLM`."""
    frames = cfg.window.num_frames
    num_images = frames if cfg.image.layout == "tiled" else frames * len(cfg.image.modalities)
    arguments: dict[str, Any] = {
        "model": str(folder),
        "limit_mm_per_prompt": {"image": num_images, "video": 0},  # without the 0, room is kept for a video
        "gpu_memory_utilization": cfg.vllm.gpu_memory_utilization,
        "tensor_parallel_size": cfg.vllm.tensor_parallel_size,
        # Free whitespace between fields lets a model pad for ever and slows decoding several times. The engine forbids it
        # only where the backend is named; "auto" is refused.
        "structured_outputs_config": {"backend": "xgrammar", "disable_any_whitespace": True},
    }
    if cfg.vllm.max_model_len is not None:
        arguments["max_model_len"] = cfg.vllm.max_model_len
    return arguments | cfg.vllm.engine


def load_engine(folder: Path, cfg: CaptionConfig) -> Any:
    """Start the engine.

    Raises:
        EnvironmentMissing: vllm is not installed, or the engine does not start here.
        ConfigError: it does not know a setting.
    """
    if importlib.util.find_spec("vllm") is None:
        raise EnvironmentMissing("the vLLM engine is not installed", where=f"{PREFIX}{folder}", fix=INSTALL)
    os.environ.setdefault("VLLM_NO_USAGE_STATS", "1")  # else it reports to its makers
    try:
        from vllm import LLM

        try:
            sampling_parameters(build_request(cfg, [], {}, 0))
        except (TypeError, ValueError) as error:
            where = "caption.endpoint"
            raise ConfigError("vLLM refuses the sampling settings", where=where, got=_one_line(error)) from None
        return LLM(**engine_arguments(folder, cfg))
    except TypeError as error:  # an argument that LLM does not have
        raise ConfigError("vLLM refuses an argument", where="caption.vllm.engine", got=_one_line(error)) from None
    except (ImportError, RuntimeError, ValueError, OSError) as error:
        reason = _one_line(error)
        raise EnvironmentMissing("the vLLM engine does not start", where=f"{PREFIX}{folder}", got=reason) from None


def sampling_parameters(request: Request) -> Any:
    """Give vLLM's own parameters of a request."""
    from vllm import SamplingParams
    from vllm.sampling_params import StructuredOutputsParams

    structure = StructuredOutputsParams(json=request.schema) if request.schema else None
    return SamplingParams(**request.sampling, structured_outputs=structure)


def enqueue(engine: Any, request: Request) -> str:
    """Hand one request to the engine; gives the id that its output will have."""
    [name] = engine.enqueue_chat(
        [request.messages],
        [sampling_parameters(request)],
        use_tqdm=False,
        chat_template_kwargs=request.template or None,
    )
    return str(name).partition("-")[0]  # the engine adds a random part that outputs do not have


def read_output(output: Any) -> dict:
    """Give text, usage and finish_reason of a `vllm.RequestOutput`."""
    completion = output.outputs[0]
    usage = {
        "prompt_tokens": len(output.prompt_token_ids or ()),
        "completion_tokens": len(completion.token_ids),
    }
    return {"text": completion.text, "usage": usage, "finish_reason": completion.finish_reason}


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
