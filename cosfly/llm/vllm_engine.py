"""Engine `vllm`: vLLM in this process, over a model folder (extra `vllm`).

Tested with vLLM 0.26 (docs/benchmarks.md has the figures). vLLM runs in its own thread: requests join while others are
answered (`LLM.enqueue_chat`, `LLMEngine.step`), and a refused request does not affect others.
"""

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

INSTALL = 'pip install -e ".[vllm]" on a machine with an accelerator'
ADDED_PER_STEP = 8  # requests added between two steps
FINISHED = ("stop", "length")  # finish reasons of an answer; others are failures of the engine


class VllmConfig(Config):
    """The engine in this process, over a model folder."""

    batch: int = Field(256, ge=1, description="most requests that the engine processes at once")
    max_model_len: int | None = Field(
        None, ge=1024, description="context length, tokens; empty: the model's context length"
    )
    engine: dict[str, Any] = Field(default_factory=dict, description="further arguments of vllm.LLM")


class VllmEngine:
    """vLLM in its own thread. Requests may arrive at any time; at most `batch` of them are in vLLM."""

    kind: Literal["vllm"] = "vllm"

    def __init__(
        self, folder: Path, cfg: VllmConfig, sampling: EndpointConfig, *, num_images: int, settings: str
    ) -> None:
        """
        Args:
            sampling: sampling settings, checked before the model is loaded.
            num_images: most pictures of one request.
            settings: section of `vllm` and `endpoint`, for messages.
        """
        if not (folder / "config.json").is_file():
            fix = "pass vllm:MODEL_DIR with the folder of a model"
            raise InputError("the folder contains no model", where=folder, got="no config.json", fix=fix)
        self.folder = folder
        self.model = folder.name
        self.where = f"vllm:{folder}"
        self.cfg = cfg
        self.sampling = sampling
        self.num_images = num_images
        self.settings = settings
        self._thread = ThreadPoolExecutor(1, "vllm")  # vLLM is called from one thread only
        self._new: queue.SimpleQueue[tuple[Request, Future[Reply]] | None] = queue.SimpleQueue()
        self._open: dict[str, Future[Reply]] = {}
        self._is_closing = False
        self._broken: TeacherError | None = None

    async def start(self) -> None:
        """Load vLLM and serve; raises as `load`."""
        llm = await asyncio.get_running_loop().run_in_executor(self._thread, self.load)
        self._thread.submit(self._serve, llm)

    async def answer(self, request: Request) -> Reply:
        """Answer one request; raises NoAnswer if vLLM refuses it, and TeacherError if vLLM is broken."""
        answered: Future[Reply] = Future()
        self._new.put((request, answered))
        return await asyncio.wrap_future(answered)

    async def close(self) -> None:
        """End the thread and vLLM; open requests stay unanswered."""
        self._is_closing = True
        self._new.put(None)
        await asyncio.get_running_loop().run_in_executor(None, self._thread.shutdown)
        gc.collect()  # its processes and memory are freed with its last reference

    # --- on the thread ---

    def load(self) -> Any:
        """Start vLLM; raises EnvironmentMissing or ConfigError if it cannot be used."""
        if importlib.util.find_spec("vllm") is None:
            raise EnvironmentMissing("the vLLM engine is not installed", where=self.where, fix=INSTALL)
        os.environ.setdefault("VLLM_NO_USAGE_STATS", "1")  # no telemetry
        try:
            from vllm import LLM

            try:
                self.parameters(self.sampling.request([], [], {}, 0))
            except (TypeError, ValueError) as error:
                raise self._rejected("endpoint", error) from None
            return LLM(**self.arguments())
        except TypeError as error:
            raise self._rejected("vllm.engine", error) from None
        except (ImportError, RuntimeError, ValueError, OSError) as error:
            raise EnvironmentMissing("the vLLM engine does not start", where=self.where, got=_one_line(error)) from None

    def _rejected(self, section: str, error: Exception) -> ConfigError:
        what = f"vLLM rejects a setting in the section {section}"
        fix = "correct or remove this setting"
        return ConfigError(what, where=f"{self.settings}.{section}", got=_one_line(error), fix=fix)

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of `vllm.LLM`."""
        length = {} if self.cfg.max_model_len is None else {"max_model_len": self.cfg.max_model_len}
        return {
            "model": str(self.folder),
            "limit_mm_per_prompt": {"image": self.num_images, "video": 0},  # otherwise it reserves memory for a video
            "gpu_memory_utilization": 0.9,
            # Free whitespace lets a model pad without end and slows decoding several times. vLLM forbids it only for a
            # named backend; "auto" is refused.
            "structured_outputs_config": {"backend": "xgrammar", "disable_any_whitespace": True},
            **length,
            **self.cfg.engine,
        }

    def parameters(self, request: Request) -> Any:
        """Return a request's parameters for vLLM."""
        from vllm import SamplingParams
        from vllm.sampling_params import StructuredOutputsParams

        is_structured = self.sampling.json_schema and request.schema
        structure = StructuredOutputsParams(json=request.schema) if is_structured else None
        sampling = {name: value for name, value in request.sampling.items() if name != "chat_template_kwargs"}
        return SamplingParams(**sampling, structured_outputs=structure)

    def _serve(self, llm: Any) -> None:
        while not self._is_closing:
            try:
                self._add_new(llm)
                if self._open and not self._is_closing:
                    self._step(llm)
            except Exception as error:  # otherwise open requests would wait forever
                self._break(error)

    def _add_new(self, llm: Any) -> None:
        """Add new requests to vLLM; wait for one if there is nothing else to do."""
        for num_added in range(min(ADDED_PER_STEP, self.cfg.batch - len(self._open))):
            has_work = bool(self._open) or num_added > 0
            try:
                entry = self._new.get(block=not has_work)
            except queue.Empty:
                return
            if entry is None:  # the engine closes
                return
            request, answered = entry
            if answered.set_running_or_notify_cancel():
                self._add(llm, request, answered)

    def _add(self, llm: Any, request: Request, answered: Future[Reply]) -> None:
        if self._broken is not None:
            answered.set_exception(self._broken)
            return
        options = {"use_tqdm": False, "chat_template_kwargs": request.sampling.get("chat_template_kwargs")}
        try:
            [name] = llm.enqueue_chat([request.messages], [self.parameters(request)], **options)
            self._open[str(name).partition("-")[0]] = answered  # vLLM adds a random suffix that outputs lack
        except (ValueError, RuntimeError) as error:  # vLLM cannot process the prompt
            answered.set_exception(NoAnswer("engine", _one_line(error), is_final=True))
        except Exception as error:  # the process of vLLM has ended, or a bug: no request will be answered
            self._break(error, answered)

    def _step(self, llm: Any) -> None:
        structured = "json_schema" if self.sampling.json_schema else "plain"
        for output in [output for output in llm.llm_engine.step() if output.finished]:
            answered = self._open.pop(output.request_id)
            completion = output.outputs[0]
            num_prompt = len(output.prompt_token_ids or ())
            usage = Usage(prompt_tokens=num_prompt, completion_tokens=len(completion.token_ids))
            if completion.finish_reason in FINISHED:
                answered.set_result(Reply(completion.text, usage, structured, completion.finish_reason))
            else:
                answered.set_exception(NoAnswer("engine", f"the request ended with {completion.finish_reason!r}"))

    def _break(self, error: Exception, *unopened: Future[Reply]) -> None:
        got = f"{type(error).__name__}: {_one_line(error)}"
        fix = "read the messages of vLLM above, then run the same command again: recorded answers are reused"
        self._broken = TeacherError("the vLLM engine failed", where=self.where, got=got, fix=fix)
        for answered in (*unopened, *self._open.values()):
            answered.set_exception(self._broken)
        self._open.clear()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
