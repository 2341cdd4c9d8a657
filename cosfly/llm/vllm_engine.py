"""Engine `vllm`: vLLM in this process, over a model folder (extra `vllm`).

Run with vLLM 0.26 (docs/teachers.md has the figures). vLLM has a thread of its own: a request joins while others are
answered (`LLM.enqueue_chat`, `LLMEngine.step`), and one that it refuses costs only itself.
"""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import os
import queue
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from cosfly.formats.captions import Usage
from cosfly.llm.client import EndpointConfig
from cosfly.llm.contract import NoAnswer, Reply, Request
from cosfly.runtime.config import Config
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError, TeacherError

INSTALL = 'pip install "cosfly[vllm]" on a machine with an accelerator'
ADDED_PER_STEP = 8  # requests handed over between two looks at what is finished
FINISHED = ("stop", "length")  # what the engine says of an answer; others are its own failures


class VllmConfig(Config):
    """The engine in this process, over a model folder."""

    batch: int = Field(256, ge=1, description="most requests in the engine at once")
    max_model_len: int | None = Field(None, ge=1024, description="context length; empty takes the model's")
    engine: dict[str, Any] = Field(default_factory=dict, description="further arguments of vllm.LLM")


class VllmEngine:
    """vLLM on its thread. Requests may come at any time; at most `batch` of them are in vLLM."""

    kind: Literal["vllm"] = "vllm"

    def __init__(
        self, folder: Path, cfg: VllmConfig, sampling: EndpointConfig, *, num_images: int, settings: str
    ) -> None:
        """
        Args:
            sampling: whether a schema is enforced, and the sampling that is tried before the model is loaded.
            num_images: most pictures of one request. settings: section that `vllm` and `endpoint` stand in, for
            messages.
        """
        if not (folder / "config.json").is_file():
            raise InputError(
                "not a model folder", where=folder, expected="a folder with config.json", fix="check --teacher"
            )
        self.folder, self.model, self.where = folder, folder.name, f"vllm:{folder}"
        self.cfg, self.sampling, self.num_images, self.settings = cfg, sampling, num_images, settings
        self._thread = ThreadPoolExecutor(1, "vllm")  # vLLM is called from one thread only
        self._new: queue.SimpleQueue[tuple[Request, Future[Reply]] | None] = queue.SimpleQueue()
        self._open: dict[str, Future[Reply]] = {}
        self._is_closing = False
        self._broken: TeacherError | None = None

    async def start(self) -> None:
        """Load vLLM and serve; see `load` for what it raises."""
        llm = await asyncio.get_running_loop().run_in_executor(self._thread, self.load)
        self._thread.submit(self._serve, llm)

    async def answer(self, request: Request) -> Reply:
        """
        Raises:
            NoAnswer: vLLM refuses this request. TeacherError: it is broken and will answer nothing.
        """
        answered: Future[Reply] = Future()
        self._new.put((request, answered))
        return await asyncio.wrap_future(answered)

    async def close(self) -> None:
        """End the thread and vLLM; what is still asked stays without an answer."""
        self._is_closing = True
        self._new.put(None)
        await asyncio.get_running_loop().run_in_executor(None, self._thread.shutdown)
        gc.collect()  # its processes and memory go with its last reference

    # --- on the thread ---

    def load(self) -> Any:
        """Start vLLM."""
        if importlib.util.find_spec("vllm") is None:
            raise EnvironmentMissing("the vLLM engine is not installed", where=self.where, fix=INSTALL)
        os.environ.setdefault("VLLM_NO_USAGE_STATS", "1")  # else it reports to its makers
        try:
            from vllm import LLM

            try:
                self.parameters(self.sampling.request([], [], {}, 0))
            except (TypeError, ValueError) as error:
                where = f"{self.settings}.endpoint"
                raise ConfigError("vLLM refuses the sampling settings", where=where, got=_one_line(error)) from None
            return LLM(**self.arguments())
        except TypeError as error:  # an argument that LLM does not have
            where = f"{self.settings}.vllm.engine"
            raise ConfigError("vLLM refuses an argument", where=where, got=_one_line(error)) from None
        except (ImportError, RuntimeError, ValueError, OSError) as error:
            reason = _one_line(error)
            raise EnvironmentMissing("the vLLM engine does not start", where=self.where, got=reason) from None

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of `vllm.LLM`."""
        cfg = self.cfg
        arguments: dict[str, Any] = {
            "model": str(self.folder),
            "limit_mm_per_prompt": {"image": self.num_images, "video": 0},  # without the 0, room is kept for a video
            "gpu_memory_utilization": 0.9,
            # Free whitespace between fields lets a model pad for ever and slows decoding several times. vLLM forbids it
            # only where the backend is named; "auto" is refused.
            "structured_outputs_config": {"backend": "xgrammar", "disable_any_whitespace": True},
        }
        if cfg.max_model_len is not None:
            arguments["max_model_len"] = cfg.max_model_len
        return arguments | cfg.engine

    def parameters(self, request: Request) -> Any:
        """Return vLLM's own parameters of a request."""
        from vllm import SamplingParams
        from vllm.sampling_params import StructuredOutputsParams

        is_structured = self.sampling.json_schema and request.schema
        structure = StructuredOutputsParams(json=request.schema) if is_structured else None
        sampling = {name: value for name, value in request.sampling.items() if name != "chat_template_kwargs"}
        return SamplingParams(**sampling, structured_outputs=structure)

    def _serve(self, llm: Any) -> None:
        while not self._is_closing:
            for request, answered in self._take():
                if answered.set_running_or_notify_cancel():
                    self._add(llm, request, answered)
            try:
                if self._open and not self._is_closing:
                    self._step(llm)
            except Exception as error:  # of this thread nobody else hears: who waits for an answer would wait for ever
                self._break(error)

    def _take(self) -> list[tuple[Request, Future[Reply]]]:
        """Return requests that came meanwhile; waits for one where there is nothing else to do."""
        taken: list[tuple[Request, Future[Reply]]] = []
        while len(taken) < min(ADDED_PER_STEP, self.cfg.batch - len(self._open)):
            try:
                found = self._new.get(block=not (self._open or taken))
            except queue.Empty:
                break
            if found is None:
                break
            taken.append(found)
        return taken

    def _add(self, llm: Any, request: Request, answered: Future[Reply]) -> None:
        if self._broken is not None:
            answered.set_exception(self._broken)
            return
        try:
            template = request.sampling.get("chat_template_kwargs")
            [name] = llm.enqueue_chat(
                [request.messages], [self.parameters(request)], use_tqdm=False, chat_template_kwargs=template
            )
            self._open[str(name).partition("-")[0]] = answered  # vLLM adds a random part that outputs do not have
        except (ValueError, RuntimeError) as error:  # what vLLM raises for a prompt that it cannot take
            answered.set_exception(NoAnswer("engine", _one_line(error), is_final=True))
        except Exception as error:  # the process behind vLLM is gone, or a bug: no request will be answered
            self._break(error, answered)

    def _step(self, llm: Any) -> None:
        structured = "json_schema" if self.sampling.json_schema else "plain"
        for output in [output for output in llm.llm_engine.step() if output.finished]:
            answered, reply = self._open.pop(output.request_id), read_output(output, structured)
            if reply.finish_reason in FINISHED:
                answered.set_result(reply)
            else:
                answered.set_exception(NoAnswer("engine", f"it ended with {reply.finish_reason!r}"))

    def _break(self, error: Exception, *more: Future[Reply]) -> None:
        self._broken = TeacherError(
            "the vLLM engine broke",
            where=self.where,
            got=f"{type(error).__name__}: {_one_line(error)}",
            fix="its messages above tell why; run the same command again: nothing answered is asked twice",
        )
        for answered in (*more, *self._open.values()):
            answered.set_exception(self._broken)
        self._open.clear()


def read_output(output: Any, structured: str) -> Reply:
    """Read a `vllm.RequestOutput`."""
    completion = output.outputs[0]
    usage = Usage(prompt_tokens=len(output.prompt_token_ids or ()), completion_tokens=len(completion.token_ids))
    return Reply(completion.text, usage, structured, completion.finish_reason)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
