"""Training of a student on a training set: LoRA beside frozen weights, or all of them, in one process or many.

The loss counts answer tokens only, and nothing is ever cut: a sample that does not fit is left out and counted.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cosfly.formats.captions import Language, Prompt
from cosfly.llm.student_chat import ChatFormat, FrameFormat, write_chat_format
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.json_io import write_json
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from distill.schema import Sample, open_split, resolve_trees, tree_inputs
from distill.student.checkpoint import ADAPTER_FACTS, Progress, adapter_facts, write_adapter_folder, write_model_folder
from distill.student.features import PictureReader, VisionFeatures
from distill.student.model import Processor, Student, is_hub_name, load_student, require, student_folder, weight_files
from distill.student.random_student import make_random_student, random_student_settings
from distill.training.fit import LOG, Lesson, fit, seeded
from distill.training.loading import Census, Supply, choose_over_all, num_workers, reader_errors, take_census
from distill.training.preflight import GB, findings, memory_errors, tell
from distill.training.ranks import Ranks, joined
from distill.training.settings import FEATURE_MEMORY_GB, STAGE, TrainConfig


def taught_by(samples: Iterable[Sample], max_pixels: int) -> ChatFormat:
    """Return what samples teach.

    Args:
        max_pixels: most that the student's image processor keeps of a picture.
    """
    prompts: dict[Language, Prompt] = {}
    looks: set[FrameFormat] = set()
    lengths: set[int] = set()
    for sample in samples:
        prompts.setdefault(sample.language, sample.prompt)
        looks.add(FrameFormat(views=sample.views, size_px=sample.picture_px, depth_range_m=sample.depth_range_m))
        lengths.add(len(sample.frames))
    if len(lengths) != 1:
        raise InputError("the training set has windows of different lengths", got=f"{sorted(lengths)} frames")
    ordered = sorted(looks, key=lambda look: (look.views, look.size_px, look.depth_range_m))
    return ChatFormat(
        prompts=dict(sorted(prompts.items())), num_frames=lengths.pop(), looks=ordered, max_pixels=max_pixels
    )


ADAPTER, MODEL, STUDENT, PREFLIGHT = "adapter", "model", "student", "preflight.json"
UNREADABLE = "unreadable_picture"
TOKENIZER_SAMPLES = 2000  # what the tokenizer of a student of random weights is trained on, at most


def add_adapter(student: Student, cfg: TrainConfig, seed: int) -> Student:
    """Wrap the student's model with a fresh LoRA adapter; only the adapter can be trained."""
    import torch
    from peft import LoraConfig, get_peft_model

    pattern = re.compile(cfg.target_modules)
    names = [name for name, module in student.model.named_modules() if isinstance(module, torch.nn.Linear)]
    if not any(pattern.fullmatch(name) for name in names):
        raise ConfigError("no layer of the student matches the pattern", where="target_modules", got=cfg.target_modules)
    lora = LoraConfig(
        r=cfg.lora_rank,
        lora_alpha=cfg.lora_alpha,  # type: ignore[arg-type]  # a plain number; the library says int
        target_modules=cfg.target_modules,
        task_type="CAUSAL_LM",
    )
    with seeded(student, seed, "adapter"):
        student.model = get_peft_model(student.model, lora)
    for module in student.model.modules():
        # peft would keep a float32 copy of what each adapted layer is given; autocast converts where it is used
        # instead.
        if hasattr(module, "cast_input_dtype_enabled"):
            module.cast_input_dtype_enabled = False
    return student


def free_weights(student: Student, cfg: TrainConfig) -> Student:
    """Let all weights learn but those of the vision tower, which stays as it is unless `train_vision`."""
    student.model.requires_grad_(True)
    if not cfg.train_vision:
        student.tower.requires_grad_(False)
        student.tower.to(student.dtype)
    return student


def prepared_student(cfg: TrainConfig, base: Path, max_pixels: int, seed: int, device: str) -> Student:
    """Load a student and make it ready to learn."""
    given: Any = {"device": device, "dtype": cfg.dtype, "max_pixels": max_pixels}
    if cfg.method == "lora":
        student = add_adapter(load_student(base, **given), cfg, seed)
    else:
        student = free_weights(load_student(base, **given, is_trained=True), cfg)
    if cfg.gradient_checkpointing:
        student.model.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    return student


def made_student(cfg: TrainConfig, samples: Sequence[Sample], folder: Path, seed: int) -> Path:
    """Make a student of random weights whose tokenizer is trained on the data, unless it is there already."""
    if not folder.exists():
        every = max(1, len(samples) // TOKENIZER_SAMPLES)
        chosen = (samples[index] for index in range(0, len(samples), every))
        texts = (text for s in chosen for text in (s.prompt.system, s.prompt.user, s.answer))
        make_random_student(folder, cfg.random_student, seed, texts)
    return folder


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
    """Read a training set, its playback trees and a student; write `adapter/` or `model/`, `log.jsonl`,
    `preflight.json`, `checkpoints/`.

    Args:
        student: a folder, the name of a repository, or `tiny`, `tiny:small`, `tiny:medium`, `random`, which are made in
            `out`.
    Returns:
        The folder of the adapter, which peft loads, or of the model, which transformers loads.
    Raises:
        InputError: an input is missing or does not fit. ResumeError: another process is at work in `out`.
        EnvironmentMissing: torch, transformers or peft is missing, or another process of this training has ended.
        ConfigError: the memory is full, or the loss is not finite.
    """
    require("torch", "transformers", "peft")
    base_name = str(student) if is_hub_name(str(student)) else Path(student).absolute().name
    product = out / (ADAPTER if cfg.method == "lora" else MODEL)
    with joined(cfg.device) as ranks:
        trees = resolve_trees(dataset, data)
        preset = random_student_settings(str(student), cfg.random_student)
        base = student_folder(str(student)) if preset is None else out / STUDENT
        if preset is not None:
            cfg = cfg.model_copy(update={"random_student": preset})
        inputs = {"dataset": dataset, **tree_inputs(trees), **({} if preset else weight_files(base))}
        opened: list[StageFolder] = []

        def begin() -> bool:
            given: Any = {"config": cfg, "inputs": inputs, "seed": seed, "resume": resume}
            opened.append(StageFolder.open(out, STAGE, **given, begun=(LOG, STUDENT)))
            return opened[0].is_complete

        if ranks.first_does(begin):
            return product
        if preset is not None:
            ranks.first_does(lambda: str(made_student(cfg, open_split(dataset, "train"), base, seed)))
        with memory_errors(cfg), reader_errors():
            lesson, taught = _lesson(cfg, dataset, trees, base, out, seed, ranks)
            progress = fit(lesson, out)
        ranks.first_does(lambda: _write_product(lesson, progress, taught, product, base, base_name, opened[0]))
    return product


def _lesson(
    cfg: TrainConfig, dataset: Path, trees: dict[str, Path], base: Path, out: Path, seed: int, ranks: Ranks
) -> tuple[Lesson, ChatFormat]:
    samples, validation = open_split(dataset, "train"), open_split(dataset, "val")
    chosen = choose_over_all(validation, cfg.validation_samples, rng_for(seed, STAGE, "validation"))
    if not samples:
        fix = "prepare the training set with more captions, or with other fractions"
        raise InputError("the training split is empty", where=dataset, fix=fix)
    taught = taught_by(samples, max(1, cfg.max_pixels))
    sizes_px = [*(look.size_px for look in taught.looks), *(validation[index].picture_px for index in chosen)]
    max_pixels = cfg.max_pixels or max(width_px * height_px for width_px, height_px in sizes_px)
    student = prepared_student(cfg, base, max_pixels, seed, ranks.device)
    processor = Processor(student.tokenizer, student.image_processor)
    workers = num_workers(cfg.data_workers)
    counting: Any = {"max_tokens": cfg.max_tokens, "workers": workers, "ranks": ranks}
    census = take_census(samples, range(len(samples)), processor, trees, **counting, label=f"{STAGE}: counting tokens")
    asked = take_census(validation, chosen, processor, trees, **counting, label=f"{STAGE}: counting tokens of val")
    if not len(census):
        raise _nothing_to_learn(out, census)
    memory_bytes = int(FEATURE_MEMORY_GB * GB)
    features = VisionFeatures(student, memory_bytes=memory_bytes, is_frozen=not cfg.train_vision)
    reader = PictureReader(processor, trees, student.dtype)
    lesson = Lesson(student, samples, census, validation, asked, Supply(features, reader, workers), cfg, ranks, seed)
    found = findings(cfg, student, census, asked, features, samples, lesson.steps)
    ranks.first_does(lambda: tell(found, out / PREFLIGHT))
    most = int(student.image_processor.size["longest_edge"])
    return lesson, taught.model_copy(update={"max_pixels": most})


def _nothing_to_learn(out: Path, census: Census) -> Exception:
    return StageFolder(out, STAGE, False).nothing_kept(
        Tally(input=census.num_samples, dropped=census.skipped), expected="samples that can be used for training"
    )


def _write_product(
    lesson: Lesson,
    progress: Progress,
    taught: ChatFormat,
    product: Path,
    base: Path,
    base_name: str,
    stage: StageFolder,
) -> None:
    student, cfg, census = lesson.student, lesson.cfg, lesson.census
    facts = adapter_facts(student, int(student.image_processor.size["longest_edge"]), base)
    with atomic_folder(product) as partial:
        if cfg.method == "lora":
            write_adapter_folder(student, partial, base_name)
            write_json(partial / ADAPTER_FACTS, facts)
        else:
            write_model_folder(student, partial, base)
        write_chat_format(partial, taught)
    num_unreadable = len(progress.unreadable)
    dropped = census.skipped + Counter({UNREADABLE: num_unreadable})
    tally = Tally(input=census.num_samples, kept=len(census) - num_unreadable, dropped=dropped)
    tokens = {"samples": len(census), "tokens": census.tokens.sum(), "answer_tokens": census.answer_tokens.sum()}
    stage.finish(
        [path for path in (stage.path / LOG, stage.path / PREFLIGHT, *product.iterdir()) if path.is_file()],
        tally,
        steps=progress.step,
        best_step=progress.best_step,
        tokens={name: int(count) for name, count in tokens.items()},
        **{name: facts[name] for name in ("trainable_parameters", "parameters", "device", "versions")},
    )
