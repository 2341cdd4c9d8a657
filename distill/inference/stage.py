"""Let a student answer the samples of a split.

The engine `transformers` runs the student in this process. `vllm` does too, and `endpoint` is a server: both are asked
as teachers are, with the prompts and pictures of the training.
"""

import asyncio
import contextlib
import logging
import signal
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from cosfly.formats.predictions import PREDICTIONS
from cosfly.llm.answers import AnswerBook
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import Engine, started
from cosfly.llm.vllm_engine import VllmEngine
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import ConfigError, InputError, TeacherError, counts_text
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, read_manifest, read_stage_record, write_failures
from cosfly.runtime.seeding import random_bytes
from distill.inference.answers import EngineAnswers, LocalAnswers
from distill.inference.samples import STAGE, InferConfig, Inputs, SampleOutcome
from distill.schema import open_split, resolve_trees, tree_inputs
from distill.student.model import require, student_path, weight_files
from distill.student.saving import check_adapter

ANSWERS = "answers"  # the folder of journals

log = logging.getLogger(__name__)


def _with_model_name(cfg: InferConfig, url: str, out: Path) -> InferConfig:
    """Return the settings with the name of the model that a server serves: a folder has the answers of one student.

    The server of a complete folder may be gone: its record has the name.
    """

    async def ask() -> str:
        client = ChatClient(url, cfg.sampling)
        async with started(client):
            return client.model

    is_complete = (out / "manifest.json").is_file() and not read_manifest(out).counts.failed
    name = cfg.endpoint.model if is_complete else None
    try:
        name = name or asyncio.run(ask())
    except TeacherError:
        if not is_complete:
            raise
        name = read_stage_record(out).config.get("endpoint", {}).get("model")
    return cfg.model_copy(update={"endpoint": cfg.endpoint.model_copy(update={"model": name})})


def run(
    cfg: InferConfig, dataset: Path, data: Sequence[Path], model: str | Path, out: Path, *, adapter: Path | None = None
) -> Path:
    """Read a split, its playback trees `data`, the model and (if given) its adapter; write `predictions.jsonl`.

    Every answer is recorded in a journal in `answers/` first, so nothing answered is asked twice.

    The model is a folder, the name of a repository, or with engine `endpoint` a URL.

    Returns:
        The path of `predictions.jsonl`: one line per sample, in the order of the split. A sample without an answer has
        a line with the reason, and the manifest counts it as failed; a later run tries it again.

    Raises:
        InputError: an input is missing or does not fit. EnvironmentMissing: a package is missing.
        ConfigError: the engine takes no adapter, or the memory is full.
        TeacherError: the engine does not answer. NothingKept: no sample was answered.
    """
    if cfg.engine == "transformers":
        require("torch", "transformers", "peft")
    trees = resolve_trees(dataset, data)
    files: dict[str, Path] = {"dataset": dataset, **tree_inputs(trees.values())}
    if adapter is not None and cfg.engine != "transformers":
        fix = "merge the adapter into its model with cosfly distill merge, or pass --engine transformers"
        words = "only the engine `transformers` can load an adapter"
        raise ConfigError(words, where=f"{STAGE}.engine", got=cfg.engine, fix=fix)
    if cfg.engine == "endpoint":
        cfg = _with_model_name(cfg, str(model), out)
    else:
        model = student_path(str(model), allow_code=cfg.allow_code)
        files |= weight_files(model)
    if adapter is not None:
        files |= check_adapter(adapter, Path(model))
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=files, seed=0)
    if stage.is_complete:
        return out / PREDICTIONS
    in_split = open_split(dataset, cfg.split)
    if not in_split:
        fix = "set distill.infer.split to another split, or prepare more pedestrian trajectories"
        raise InputError("the split is empty", where=dataset, got=f"the split `{cfg.split}`", fix=fix)
    # By the hash of a window, so that its languages are chosen together.
    ranked = sorted(in_split, key=lambda sample: random_bytes(0, STAGE, sample.sample_id))
    chosen = {sample.key for sample in ranked[: cfg.max_samples or None]}
    samples = [sample for sample in in_split if sample.key in chosen]
    log.info("%s: %d of %d samples of the split %s", STAGE, len(samples), len(in_split), cfg.split)
    inputs = Inputs(samples, trees, model, adapter)
    start_s = time.monotonic()
    name = str(cfg.endpoint.model) if cfg.engine == "endpoint" else inputs.name
    outcomes, totals = asyncio.run(_answer_all(cfg, inputs, out))
    speed = {"seconds": round(time.monotonic() - start_s, 3), **totals}
    predictions = [outcome.prediction(cfg.split, name) for outcome in outcomes]
    lines = (dump_json(prediction.model_dump(mode="json")) + "\n" for prediction in predictions)
    write_bytes(out / PREDICTIONS, "".join(lines).encode())
    failures = [outcome.result for outcome in outcomes if isinstance(outcome.result, Failed)]
    write_failures(out / "failures.jsonl", failures)
    failed = Counter(failure.code for failure in failures)
    tally = Tally(input=len(outcomes), kept=len(outcomes) - len(failures), failed=failed)
    num_parsed = sum(prediction.coc is not None for prediction in predictions)
    reasons = Counter(prediction.reason for prediction in predictions if prediction.reason)
    causes = f" ({counts_text(reasons)})" if reasons else ""
    log.info("%d of %d answers parse%s", num_parsed, len(predictions), causes)
    facts = {"split": cfg.split, "has_adapter": adapter is not None, "model": name, "parsed": num_parsed}
    outputs = [out / PREDICTIONS, *sorted((out / ANSWERS).glob("*.jsonl"))]
    stage.finish(outputs, tally, **facts, speed=speed)
    return out / PREDICTIONS


async def _answer_all(cfg: InferConfig, inputs: Inputs, out: Path) -> tuple[list[SampleOutcome], Counter[str]]:
    """Answer all samples; return their outcomes, and the numbers of answers and tokens of this run."""
    async with contextlib.AsyncExitStack() as stack:
        book = stack.enter_context(AnswerBook(out / ANSWERS))
        before = book.totals.copy()
        advance = stack.enter_context(progress_bar(STAGE, total=len(inputs.samples)))
        answering: LocalAnswers | EngineAnswers
        if cfg.engine == "transformers":
            with contextlib.suppress(ValueError):  # not in the main thread, which gets no Ctrl-C
                if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as of a command in the background
                    signal.signal(signal.SIGINT, signal.default_int_handler)  # asyncio's waits for the end of a batch
            answering = LocalAnswers(cfg, inputs, book)
        else:
            engine: Engine
            if cfg.engine == "endpoint":
                engine = ChatClient(str(inputs.model), cfg.sampling)
            else:
                most = max(len(sample.images) for sample in inputs.samples)
                engine = VllmEngine(Path(inputs.model), cfg.vllm, cfg.sampling, num_images=most, settings=STAGE)
            await stack.enter_async_context(started(engine))
            answering = EngineAnswers(engine, book, inputs, cfg)
        outcomes = [outcome async for outcome in answering.answers(inputs.samples, advance)]
        return outcomes, book.totals - before
