"""Training of a student on a training set: LoRA next to frozen weights, or all weights, in one process or many.

The loss counts answer tokens only, and nothing is ever cut: a sample that does not fit is skipped and counted.
"""

import contextlib
import logging
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import timedelta
from importlib import metadata
from pathlib import Path
from typing import Any

from cosfly.llm.student_chat import ChatFormat, FrameFormat, write_chat_format
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError
from cosfly.runtime.io import atomic_folder, read_text
from cosfly.runtime.run_dir import StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from distill.schema import Sample, decision_place, open_split, resolve_trees, tree_inputs
from distill.student.chat import check_template
from distill.student.features import PictureReader
from distill.student.model import Student, is_hub_name, load_student, pick_device, require, student_path, weight_files
from distill.student.random_student import TINY, make_random_student
from distill.student.saving import write_student
from distill.training.checkpoints import learning_weights
from distill.training.fit import LOG, fit, seeded
from distill.training.loading import TrainingContext, TrainingSplit
from distill.training.loss import check_head
from distill.training.settings import STAGE, TrainConfig

log = logging.getLogger(__name__)

ADAPTER, MODEL, STUDENT = "adapter", "model", "student"
TOKENIZER_SAMPLES = 2000  # most samples that the tokenizer of a random student is trained on
PATIENCE = timedelta(minutes=30)  # for the slowest process: loading weights, encoding texts, validation


def chat_format_of(samples: Sequence[Sample], max_pixels: int) -> ChatFormat:
    """Return the chat format of a training on samples, with a limit of the pixels of a picture, 0 for none."""
    lengths = {len(sample.frames) for sample in samples}
    if len(lengths) != 1:
        fix = "prepare the training set from captions with the same caption.window.num_frames"
        raise InputError("the training set has windows of different lengths", got=f"{sorted(lengths)} frames", fix=fix)
    looks = {FrameFormat(views=s.views, size_px=s.picture_px, depth_range_m=s.depth_range_m) for s in samples}
    prompts = {sample.language: sample.prompt for sample in reversed(samples)}  # the first of each language
    return ChatFormat(
        prompts=dict(sorted(prompts.items())),
        num_frames=lengths.pop(),
        looks=sorted(looks, key=lambda look: (look.views, look.size_px, look.depth_range_m)),
        max_pixels=max_pixels or max(math.prod(look.size_px) for look in looks),
        decision=decision_place(samples[-1].answer),
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
    import torch

    decoder, head = student.core.get_decoder(), student.core.get_output_embeddings()
    prefix = next(name for name, module in student.core.named_modules() if module is decoder)
    linear = [name for name, m in decoder.named_modules() if isinstance(m, torch.nn.Linear) and m is not head]
    names = {name.rpartition(".")[2] for name in linear}
    return rf"{re.escape(prefix)}\.(.*\.)?({'|'.join(map(re.escape, sorted(names)))})"


def prepared_student(cfg: TrainConfig, base: Path, seed: int, device: str) -> Student:
    """Load a student and prepare it for training."""
    template = read_text(Path(cfg.chat_template), what="chat template") if cfg.chat_template else ""
    given: Any = {"device": device, "dtype": cfg.dtype, "template": template, "allow_code": cfg.allow_code}
    student = load_student(base, **given, is_trained=cfg.method == "full")
    if cfg.method == "lora":
        add_adapter(student, cfg, seed)
    else:
        student.model.requires_grad_(True)
        if student.has_pictures and not cfg.train_vision:
            language_model = {*student.core.get_decoder().modules(), student.core.get_output_embeddings()}
            for module in student.core.base_model.children():
                if module not in language_model:
                    module.requires_grad_(False)  # in float32 as the rest: SmolVLM computes in the type of its tower
    if cfg.compile:
        for layer in student.core.get_decoder().layers:
            layer.compile(dynamic=True)
    if cfg.gradient_checkpointing:
        student.model.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    return student


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
        cpu=device == "cpu", log_with=list(cfg.report_to) or None, project_dir=out / "curves",
        kwargs_handlers=[InitProcessGroupKwargs(timeout=PATIENCE)],
    )  # fmt: skip
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
            raise ConfigError("a batch needs too much memory", where=f"{STAGE}.batch_size", got=got, fix=fix) from error
        if "DataLoader worker" in text:
            fix = f"{again}; if memory (or --shm-size) is short, lower {STAGE}.data_workers"
            raise EnvironmentMissing("the system killed a process that reads samples", got=got, fix=fix) from error
        if isinstance(error, torch.distributed.DistError) or "gloo" in text or "Connection" in text:
            fix = f"read the last message of the other process, then {again}"
            raise EnvironmentMissing("another process of this training has ended", got=got, fix=fix) from error
        raise


# --- the stage --------------------------------------------------------------------------------------------------------


def run(
    cfg: TrainConfig, dataset: Path, data: Sequence[Path], student: str | Path, out: Path, *, seed: int = 0
) -> Path:
    """Read a training set, its playback trees and a student; write `adapter/` or `model/`, `log.jsonl`, `checkpoints/`.

    Args:
        student: a folder, a GGUF file, the name of a repository, or `tiny`, which is made in `out`.

    Returns:
        The folder `adapter/`, which peft loads, or `model/`, which transformers loads.

    Raises:
        InputError: an input is missing or does not fit. ResumeError: another process is at work in `out`.
        EnvironmentMissing: torch, transformers or peft is missing, or another process of this training has ended.
        ConfigError: the memory is full, or the loss is not finite.
    """
    require("torch", "transformers", "peft", "accelerate")
    log.info("%s: loading packages", STAGE)
    from accelerate.utils import broadcast_object_list

    base_name = str(student) if is_hub_name(str(student)) else Path(student).absolute().name
    product = out / (ADAPTER if cfg.method == "lora" else MODEL)
    with torch_errors(cfg), processes(cfg, out) as accelerator:
        trees = resolve_trees(dataset, data)
        is_tiny = str(student) == TINY
        inputs = {"dataset": dataset, **tree_inputs(trees.values())}
        base = out / STUDENT if is_tiny else student_path(str(student), allow_code=cfg.allow_code)
        inputs |= {} if is_tiny else weight_files(base)
        folder: StageFolder | None = None
        if accelerator.is_main_process:  # its error ends all
            given: Any = {"config": cfg, "inputs": inputs, "seed": seed}
            folder = StageFolder.open(out, STAGE, **given, begun=(LOG, STUDENT))
            if is_tiny and not folder.is_complete and not base.exists():
                samples = open_split(dataset, "train")
                chosen = samples[:: max(1, len(samples) // TOKENIZER_SAMPLES)]
                texts = (text for s in chosen for text in (s.prompt.system, s.prompt.user, s.answer))
                make_random_student(base, seed, texts)
        is_complete = folder is not None and folder.is_complete
        if broadcast_object_list([is_complete])[0]:  # all processes know what the main one knows
            return product
        accelerator.init_trackers(STAGE)
        context, chat_format = _context(cfg, dataset, trees, base, seed, accelerator)
        progress = fit(context, out)
        if folder is not None:
            num_used = len(context.train.used)
            skipped = Counter({reason: len(samples) for reason, samples in context.train.skipped.items()})
            if num_left := len(context.train.samples) - num_used - skipped.total():
                skipped["beyond_max_steps"] = num_left
            tally = Tally(input=num_used + skipped.total(), kept=num_used, dropped=skipped)
            if cfg.method == "full":
                context.student.model.to(context.student.dtype)
            with atomic_folder(product) as partial:
                write_student(context.student, partial, base, base_name)
                write_chat_format(partial, chat_format)
            folder.finish(
                [out / LOG, *sorted(product.iterdir())], tally, steps=progress.step, best_step=progress.best_step,
                tokens=int(context.train.lengths.sum()),
                parameters=sum(p.numel() for p in context.student.model.parameters()),
                trainable_parameters=sum(p.numel() for p in learning_weights(context.student).values()),
                device=context.student.device,
                versions={name: metadata.version(name) for name in ("torch", "transformers", "peft")},
            )  # fmt: skip
    return product


def _context(
    cfg: TrainConfig, dataset: Path, trees: dict[str, Path], base: Path, seed: int, accelerator: Any
) -> tuple[TrainingContext, ChatFormat]:
    """Load the student and the data, check them, and log what will be trained; return also the chat format."""
    student = prepared_student(cfg, base, seed, pick_device(cfg.device))
    samples, validation = (open_split(dataset, split, text_only=not student.has_pictures) for split in ("train", "val"))
    if not samples:
        fix = "prepare the training set with more captions, or with lower val_fraction and test_fraction"
        raise InputError("the training split is empty", where=dataset, fix=fix)
    if trees and not student.has_pictures:
        log.warning("%s: the student takes no pictures: it is taught with the text state alone", STAGE)
    check_template(student, samples[0])
    check_head(student)
    chat_format = chat_format_of(samples, cfg.max_pixels)  # its errors come before the training
    train = TrainingSplit(samples, student, cfg.max_pixels, cfg.decision_weight)
    most = cfg.max_steps * cfg.samples_per_step or len(samples)
    train.encode(rng_for(seed, STAGE, "train"), most, cfg.max_tokens, cfg.data_workers)
    val = TrainingSplit(validation, student, cfg.max_pixels, cfg.decision_weight)
    val.encode(rng_for(seed, STAGE, "validation"), cfg.validation_samples, cfg.max_tokens, cfg.data_workers)
    reader = PictureReader(student, trees, cfg.max_pixels)
    context = TrainingContext(student, cfg, seed, accelerator, train, val, reader)
    context.read_pictures()
    _log_split("train", train)
    if cfg.validation_samples:
        _log_split("val", val)
    if not train.used:
        words, got = "no sample can be used for training", ", ".join(train.skipped)
        raise InputError(words, where=dataset, got=got, fix="change the settings that cause the warnings above")
    return context, chat_format


def _log_split(name: str, split: TrainingSplit) -> None:
    """Log how many samples are used, and warn of those that are skipped."""
    words = "%s: %s: %d of %d samples are used; they have %d tokens, %d of them in answers"
    num_answer = sum(len(sample.row.answer_ids) for sample in split.used)
    log.info(words, STAGE, name, len(split.used), len(split.samples), split.lengths.sum(), num_answer)
    for reason, skipped in sorted(split.skipped.items()):
        words = "%s: %d samples of %s are skipped as %s; the first: %s"
        log.warning(words, STAGE, len(skipped), name, reason, skipped[0])
