"""A teacher in this process: the vLLM engine over a model folder (`--teacher vllm:MODEL_DIR`, extra `vllm`).

Written against the documented interface of vLLM 0.26: `LLM.chat` over a list of conversations with one `SamplingParams` each,
`StructuredOutputsParams(json=...)`, and `RequestOutput` with `outputs[0].text` and `finish_reason`. The engine likes many requests
at once: windows that wait for an answer are gathered into one batch.
"""

from __future__ import annotations

import asyncio
import importlib.util
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from caption.answers import AnswerBook
from caption.budget import Budget
from caption.client import NoAnswer
from caption.prompts import Question, answer_schema, mirror_messages, mirror_schema
from caption.schema import CaptionConfig, Reply
from caption.teacher import KeptAnswers, SharedFrames, sampling_seed
from cosfly.coc import Coc
from cosfly.errors import EnvironmentMissing, InputError

log = logging.getLogger(__name__)

PREFIX = "vllm:"
INSTALL = 'pip install "cosfly[vllm]" on a machine with an accelerator'
GATHER_S = 0.05  # how long a batch waits for more requests once one is there


@dataclass(frozen=True)
class Request:
    """One conversation and how it is sampled, in plain values."""

    messages: list[dict]
    sampling: dict[str, Any]  # keyword arguments of SamplingParams, without structured_outputs
    schema: dict | None


class VllmTeacher:
    """Asks the engine. Use as an async context manager; the engine is loaded on entry."""

    def __init__(self, cfg: CaptionConfig, answers: AnswerBook, seed: int, budget: Budget) -> None:
        self.cfg, self.seed = cfg, seed
        self.folder = model_folder(cfg.teacher)
        self.record: dict[str, Any] = {}
        self.frames = SharedFrames(cfg.image)
        self.kept = KeptAnswers(answers, budget, str(self.folder))
        self._thread = ThreadPoolExecutor(1, "vllm")  # the engine is called from one thread only
        self._waiting: list[tuple[Request, asyncio.Future]] = []
        self._working: asyncio.Task | None = None
        self._engine: Any = None

    async def __aenter__(self) -> VllmTeacher:
        loop = asyncio.get_running_loop()
        self._engine = await loop.run_in_executor(self._thread, load_engine, self.folder, self.cfg)
        c = self.cfg.endpoint
        settings = {"temperature": c.temperature, "top_p": c.top_p, "max_tokens": c.max_tokens, "seed": self.seed}
        self.record = {"kind": "vllm", "model": self.folder.name, "settings": settings}
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.frames.close()
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._engine = None

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
        identity = {"sample_id": sample_id, "purpose": purpose}
        return await self.kept.give(identity, body, digests, schema, lambda: self._generate(request))

    # --- batches ---

    async def _generate(self, request: Request) -> dict:
        answered: asyncio.Future[dict] = asyncio.get_running_loop().create_future()
        self._waiting.append((request, answered))
        if self._working is None or self._working.done():
            self._working = asyncio.create_task(self._work())
        return await answered

    async def _work(self) -> None:
        loop = asyncio.get_running_loop()
        while self._waiting:
            await asyncio.sleep(GATHER_S)
            most = self.cfg.vllm.batch
            batch, self._waiting = self._waiting[:most], self._waiting[most:]
            try:
                found: list[dict | NoAnswer] = list(
                    await loop.run_in_executor(self._thread, chat, self._engine, [request for request, _ in batch])
                )
            except (ValueError, RuntimeError) as error:  # what the engine raises for a prompt it cannot take
                found = await self._one_by_one(batch, str(error))
            for (_, answered), result in zip(batch, found, strict=True):
                if answered.done():
                    continue
                if isinstance(result, NoAnswer):
                    answered.set_exception(result)
                else:
                    answered.set_result(result)

    async def _one_by_one(self, batch: list[tuple[Request, asyncio.Future]], problem: str) -> list[dict | NoAnswer]:
        """Ask each alone, so that one prompt that is too long does not cost the others their answer."""
        if len(batch) == 1:
            return [NoAnswer("engine", " ".join(problem.split())[:200], is_final=True)]
        log.warning("vllm: a batch of %d failed (%s); asking each alone", len(batch), " ".join(problem.split())[:200])
        loop = asyncio.get_running_loop()
        results: list[dict | NoAnswer] = []
        for request, _ in batch:
            try:
                results += await loop.run_in_executor(self._thread, chat, self._engine, [request])
            except (ValueError, RuntimeError) as error:
                results.append(NoAnswer("engine", " ".join(str(error).split())[:200], is_final=True))
        return results


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
    return Request(messages, sampling, schema if c.json_schema else None)


def engine_arguments(folder: Path, cfg: CaptionConfig) -> dict[str, Any]:
    """Give the keyword arguments of `vllm.LLM`."""
    frames = cfg.window.num_frames
    num_images = frames if cfg.image.layout == "tiled" else frames * len(cfg.image.modalities)
    arguments: dict[str, Any] = {
        "model": str(folder),
        "limit_mm_per_prompt": {"image": num_images},
        "gpu_memory_utilization": cfg.vllm.gpu_memory_utilization,
        "tensor_parallel_size": cfg.vllm.tensor_parallel_size,
        # Free whitespace between fields lets a model pad for ever and slows decoding several times.
        "structured_outputs_config": {"disable_any_whitespace": True},
    }
    if cfg.vllm.max_model_len is not None:
        arguments["max_model_len"] = cfg.vllm.max_model_len
    return arguments | cfg.vllm.engine


def load_engine(folder: Path, cfg: CaptionConfig) -> Any:
    """Start the engine.

    Raises:
        EnvironmentMissing: vllm is not installed, or the engine does not start here.
    """
    if importlib.util.find_spec("vllm") is None:
        raise EnvironmentMissing("the vLLM engine is not installed", where=f"vllm:{folder}", fix=INSTALL)
    from vllm import LLM

    try:
        return LLM(**engine_arguments(folder, cfg))
    except (RuntimeError, ValueError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise EnvironmentMissing("the vLLM engine does not start", where=f"vllm:{folder}", got=reason) from None


def chat(engine: Any, requests: list[Request]) -> list[dict]:
    """Answer requests in one call of the engine, in their order."""
    from vllm import SamplingParams
    from vllm.sampling_params import StructuredOutputsParams

    parameters = [
        SamplingParams(
            **request.sampling,
            structured_outputs=None if request.schema is None else StructuredOutputsParams(json=request.schema),
        )
        for request in requests
    ]
    outputs = engine.chat([request.messages for request in requests], parameters, use_tqdm=False)
    return [
        read_output(output) | {"structured": "plain" if request.schema is None else "json_schema"}
        for request, output in zip(requests, outputs, strict=True)
    ]


def read_output(output: Any) -> dict:
    """Give text, usage and finish_reason of a `vllm.RequestOutput`."""
    completion = output.outputs[0]
    usage = {
        "prompt_tokens": len(output.prompt_token_ids or ()),
        "completion_tokens": len(completion.token_ids),
    }
    return {"text": completion.text, "usage": usage, "finish_reason": completion.finish_reason}
