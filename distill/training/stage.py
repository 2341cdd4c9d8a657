"""Training of a student on a training set: LoRA beside frozen weights, or all weights, in one process or many.

The loss counts answer tokens only, and nothing is ever cut: a sample that does not fit is skipped and counted.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

from cosfly.formats.captions import Language, Place, Prompt
from cosfly.formats.predictions import Split
from cosfly.llm.student_chat import ChatFormat, FrameFormat, write_chat_format
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError
from cosfly.runtime.io import atomic_folder, read_text
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from distill.schema import Sample, decision_place, open_split, resolve_trees, tree_inputs
from distill.student.chat import AnswerWeights
from distill.student.features import PictureReader
from distill.student.model import Student, is_hub_name, load_student, pick_device, require, student_path, weight_files
from distill.student.random_student import make_random_student, random_student_settings
from distill.student.saving import write_adapter, write_model_folder
from distill.training.checkpoints import newest_checkpoint
from distill.training.checks import check_before_training
from distill.training.fit import CHECKPOINTS, LOG, fit, seeded
from distill.training.loading import (
    FeatureFiles,
    Tokenizer,
    TrainingContext,
    choose_over_all,
    num_workers,
    summarize,
)
from distill.training.settings import STAGE, TrainConfig

log = logging.getLogger(__name__)

TAUGHT: tuple[Split, ...] = ("train", "val")
ADAPTER, MODEL, STUDENT, FEATURES = "adapter", "model", "student", "features"
TOKENIZER_SAMPLES = 2000  # most samples that the tokenizer of a random student is trained on
PATIENCE = timedelta(minutes=30)  # for the slowest process: loading weights, counting tokens, validation
T = TypeVar("T")


def taught_by(samples: Iterable[Sample], max_pixels: int) -> ChatFormat:
    """Return the chat format of a training.

    Args:
        max_pixels: limit of a picture; 0: none.
    """
    prompts: dict[Language, Prompt] = {}
    looks: set[FrameFormat] = set()
    lengths: set[int] = set()
    decision: Place = "last"
    for sample in samples:
        decision = decision_place(sample.answer)
        prompts.setdefault(sample.language, sample.prompt)
        looks.add(FrameFormat(views=sample.views, size_px=sample.picture_px, depth_range_m=sample.depth_range_m))
        lengths.add(len(sample.frames))
    if len(lengths) != 1:
        raise InputError("the training set has windows of different lengths", got=f"{sorted(lengths)} frames")
    ordered = sorted(looks, key=lambda look: (look.views, look.size_px, look.depth_range_m))
    return ChatFormat(
        prompts=dict(sorted(prompts.items())),
        num_frames=lengths.pop(),
        looks=ordered,
        max_pixels=max_pixels or max(math.prod(look.size_px) for look in ordered),
        decision=decision,
    )


def add_adapter(student: Student, cfg: TrainConfig, seed: int) -> Student:
    """Wrap the student's model with a fresh LoRA adapter; only the adapter can be trained."""
    from peft import LoraConfig, get_peft_model

    lora = LoraConfig(
        r=cfg.lora_rank,
        lora_alpha=cfg.lora_alpha,  # type: ignore[arg-type]  # a plain number; the library says int
        target_modules=target_modules(student),
        task_type="CAUSAL_LM",
    )
    with seeded(student, seed, "adapter"):
        student.model = get_peft_model(student.model, lora)
    for module in student.model.modules():
        # peft would keep a float32 copy of the input of each adapted layer; autocast converts where it is used instead.
        if hasattr(module, "cast_input_dtype_enabled"):
            module.cast_input_dtype_enabled = False
    return student


def target_modules(student: Student) -> str:
    """Return the pattern of all linear layers of the language model, which an adapter changes.

    The vision tower and the output head are not among them: the features of a frozen tower are kept.
    """
    prefix, names = student.language_layers()
    last = sorted({name.rpartition(".")[2] for name in names})
    return rf"{re.escape(prefix)}\.(.*\.)?({'|'.join(map(re.escape, last))})"


def prepared_student(cfg: TrainConfig, base: Path, seed: int, device: str) -> Student:
    """Load a student and prepare it for training."""
    template = read_text(Path(cfg.chat_template), what="chat template") if cfg.chat_template else ""
    given: Any = {"device": device, "dtype": cfg.dtype, "template": template, "allow_code": cfg.allow_code}
    student = load_student(base, **given, is_trained=cfg.method == "full")
    if cfg.method == "lora":
        student = add_adapter(student, cfg, seed)
    else:
        student.model.requires_grad_(True)
        for module in () if cfg.train_vision else student.vision_modules():
            module.requires_grad_(False)
            module.to(student.dtype)
    if cfg.compile:
        for layer in student.core.get_decoder().layers:
            layer.compile(dynamic=True)
    if cfg.gradient_checkpointing:
        student.model.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    return student


def made_student(cfg: TrainConfig, samples: Sequence[Sample], folder: Path, seed: int) -> None:
    """Make a random student whose tokenizer is trained on the data, unless the folder exists."""
    if not folder.exists():
        every = max(1, len(samples) // TOKENIZER_SAMPLES)
        chosen = (samples[index] for index in range(0, len(samples), every))
        texts = (text for s in chosen for text in (s.prompt.system, s.prompt.user, s.answer))
        make_random_student(folder, cfg.random_student, seed, texts)


# --- processes --------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def processes(cfg: TrainConfig, out: Path) -> Iterator[Any]:
    """Join the processes that `torchrun` or `accelerate launch` started, as accelerate's `Accelerator`."""
    from accelerate import Accelerator, InitProcessGroupKwargs
    from accelerate.tracking import get_available_trackers

    available = [str(name) for name in get_available_trackers()]
    if missing := [name for name in cfg.report_to if name not in available]:
        words, fix = "a logger is not known to accelerate, or not installed", f"pip install {missing[0]}"
        where, expected = f"{STAGE}.report_to", ", ".join(available) or "none"
        raise EnvironmentMissing(words, where=where, got=missing[0], expected=expected, fix=fix)
    device = pick_device(cfg.device)
    accelerator = Accelerator(
        cpu=device == "cpu",
        log_with=list(cfg.report_to) or None,
        project_dir=out / "curves",
        kwargs_handlers=[InitProcessGroupKwargs(timeout=PATIENCE)],
    )
    if not accelerator.is_main_process:
        logging.getLogger("distill").setLevel(logging.WARNING)
    is_finished = False
    try:
        yield accelerator
        is_finished = True
    finally:
        # After an error, NCCL would wait for the other processes, and threads of gloo would abort the interpreter.
        if is_finished or device == "cpu":
            accelerator.end_training()


def first_does(accelerator: Any, action: Callable[[], T]) -> T:
    """Return in all processes the result of an action of the first one."""
    from accelerate.utils import broadcast_object_list

    return broadcast_object_list([action() if accelerator.is_main_process else None])[0]


@contextlib.contextmanager
def torch_errors(cfg: TrainConfig) -> Iterator[None]:
    """Convert what torch raises about full memory, killed workers and lost processes into one line with a fix."""
    import torch

    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error)
        got = text.splitlines()[0][:160] if text else type(error).__name__
        again = "run the same command again to resume from the last checkpoint"
        if isinstance(error, torch.OutOfMemoryError | MemoryError) or "DefaultCPUAllocator" in text:
            fix = "lower batch_size or max_tokens, or set gradient_checkpointing=true; then " + again
            got = f"batch_size {cfg.batch_size}: {got}"
            raise ConfigError("the memory is full", where=f"{STAGE}.batch_size", got=got, fix=fix) from error
        if "DataLoader worker" in text:
            fix = f"{again}; if memory (or --shm-size) is short, lower {STAGE}.data_workers"
            raise EnvironmentMissing("the system killed a process that reads samples", got=got, fix=fix) from error
        if isinstance(error, torch.distributed.DistError) or "gloo" in text or "Connection" in text:
            fix = f"read the message of that process, then {again}"
            raise EnvironmentMissing("another process of this training has ended", got=got, fix=fix) from error
        raise


# --- the stage --------------------------------------------------------------------------------------------------------


def run(
    cfg: TrainConfig,
    dataset: Path,
    data: Sequence[Path],
    student: str | Path,
    out: Path,
    *,
    seed: int = 0,
    resume: Resume = "if-same",
) -> Path:
    """Read a training set, its playback trees and a student; write `adapter/` or `model/`, `log.jsonl`, `checkpoints/`.

    Args:
        student: a folder, a GGUF file, the name of a repository, or `tiny` or `random`, which are made in `out`.

    Returns:
        The folder of the adapter, which peft loads, or of the model, which transformers loads.

    Raises:
        InputError: an input is missing or does not fit. ResumeError: another process is at work in `out`.
        EnvironmentMissing: torch, transformers or peft is missing, or another process of this training has ended.
        ConfigError: the memory is full, or the loss is not finite.
    """
    require("torch", "transformers", "peft", "accelerate")
    base_name = str(student) if is_hub_name(str(student)) else Path(student).absolute().name
    product = out / (ADAPTER if cfg.method == "lora" else MODEL)
    with torch_errors(cfg), processes(cfg, out) as accelerator:
        trees = resolve_trees(dataset, data)
        random_student = random_student_settings(str(student), cfg.random_student)
        base = out / STUDENT if random_student else student_path(str(student), allow_code=cfg.allow_code)
        if random_student is not None:
            cfg = cfg.model_copy(update={"random_student": random_student})
        inputs = {"dataset": dataset, **tree_inputs(trees), **({} if random_student else weight_files(base))}
        opened: list[StageFolder] = []

        def begin() -> bool:
            given: Any = {"config": cfg, "inputs": inputs, "seed": seed, "resume": resume}
            opened.append(StageFolder.open(out, STAGE, **given, begun=(LOG, STUDENT, FEATURES)))
            if not opened[0].is_complete and random_student is not None:
                made_student(cfg, open_split(dataset, "train"), base, seed)
            if newest_checkpoint(out / CHECKPOINTS) is None:
                shutil.rmtree(out / FEATURES, ignore_errors=True)  # they may be of other settings
            return opened[0].is_complete

        if first_does(accelerator, begin):
            return product
        accelerator.init_trackers(STAGE)
        context = _context(cfg, dataset, trees, base, out, seed, accelerator)
        taught = taught_by(context.train[0].samples, cfg.max_pixels)
        check_before_training(context)
        progress = fit(context, out)
        if accelerator.is_main_process:
            _write_product(context, taught, product, base, base_name)
            summary, path = context.train[1], opened[0].path
            tally = Tally(input=len(summary) + len(summary.skipped), kept=len(summary), dropped=summary.skip_reasons)
            parameters = list(context.student.model.parameters())
            shutil.rmtree(out / FEATURES)
            opened[0].finish(
                [file for file in (path / LOG, *product.iterdir()) if file.is_file()],
                tally,
                steps=progress.step,
                best_step=progress.best_step,
                tokens=sum(sample.num_tokens for sample in summary.used),
                answer_tokens=sum(sample.num_answer_tokens for sample in summary.used),
                trainable_parameters=sum(p.numel() for p in parameters if p.requires_grad),
                parameters=sum(p.numel() for p in parameters),
                device=context.student.device,
                versions=_versions(),
            )
    return product


def _context(
    cfg: TrainConfig, dataset: Path, trees: dict[str, Path], base: Path, out: Path, seed: int, accelerator: Any
) -> TrainingContext:
    student = prepared_student(cfg, base, seed, pick_device(cfg.device))
    samples, validation = (open_split(dataset, split, text_only=not student.has_pictures) for split in TAUGHT)
    chosen = choose_over_all(validation, cfg.validation_samples, rng_for(seed, STAGE, "validation"))
    if not samples:
        fix = "prepare the training set with more captions, or with other fractions"
        raise InputError("the training split is empty", where=dataset, fix=fix)
    if not student.has_pictures and open_split(dataset, "train")[0].views:
        log.warning("%s: the student takes no pictures: it is taught with the text state alone", STAGE)
    processor, workers, limit = student.processor, num_workers(cfg.data_workers), cfg.max_pixels
    weights = AnswerWeights(cfg.decision_weight, cfg.reason_weight)
    train, val = (Tokenizer(part, processor, limit, weights) for part in (samples, validation))
    counting: Any = {"workers": workers, "accelerator": accelerator, "label": f"{STAGE}: counting tokens"}
    summaries = [
        summarize(tokenizer, indices, cfg.max_tokens, **counting)
        for tokenizer, indices in ((train, range(len(samples))), (val, chosen))
    ]
    features = FeatureFiles(out / FEATURES, (p for part in summaries for one in part.used for p in one.pictures))
    reader = PictureReader(processor, trees, student.dtype, limit)
    features.write(student, reader, workers, accelerator, is_frozen=not cfg.train_vision)
    summary, asked = (part.without(features.unreadable) for part in summaries)
    if not len(summary):
        tally = Tally(input=len(summary.skipped), dropped=summary.skip_reasons)
        raise StageFolder(out, STAGE, False).nothing_kept(tally, expected="samples that can be used for training")
    return TrainingContext(student, cfg, seed, accelerator, workers, (train, summary), (val, asked), features)


def _write_product(context: TrainingContext, taught: ChatFormat, product: Path, base: Path, base_name: str) -> None:
    student = context.student
    with atomic_folder(product) as partial:
        if context.cfg.method == "lora":
            write_adapter(student, partial, base, base_name, taught.max_pixels)
        else:
            student.model.to(student.dtype)
            write_model_folder(student, partial, base)
        write_chat_format(partial, taught)


def _versions() -> dict[str, str]:
    import peft
    import torch
    import transformers

    return {"torch": torch.__version__, "transformers": transformers.__version__, "peft": peft.__version__}
