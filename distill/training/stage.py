"""Training of a student on a training set: LoRA beside frozen weights, or all of them, in one process or many.

The loss counts answer tokens only, and nothing is ever cut: a sample that does not fit is left out and counted.
"""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cosfly.formats.captions import Language, Place, Prompt
from cosfly.formats.predictions import Split
from cosfly.llm.student_chat import ChatFormat, FrameFormat, write_chat_format
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_folder, read_text
from cosfly.runtime.json_io import write_json
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from distill.schema import Sample, decision_place, open_split, resolve_trees, tree_inputs
from distill.student.chat import AnswerWeights
from distill.student.checkpoint import ADAPTER_FACTS, Progress, adapter_facts, write_adapter_folder, write_model_folder
from distill.student.features import PictureReader, VisionFeatures
from distill.student.model import Student, is_hub_name, load_student, require, student_path, weight_files
from distill.student.random_student import make_random_student, random_student_settings
from distill.training.fit import LOG, Lesson, fit, seeded
from distill.training.loading import Census, Supply, choose_over_all, num_workers, reader_errors, take_census
from distill.training.preflight import GB, findings, memory_errors, tell
from distill.training.ranks import Ranks, joined
from distill.training.settings import FEATURE_MEMORY_GB, STAGE, TrainConfig
from distill.training.trackers import trackers


def taught_by(samples: Iterable[Sample], max_pixels: int) -> ChatFormat:
    """Return what samples teach.

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


log = logging.getLogger(__name__)

TAUGHT: tuple[Split, ...] = ("train", "val")
ADAPTER, MODEL, STUDENT, PREFLIGHT = "adapter", "model", "student", "preflight.json"
UNREADABLE = "unreadable_picture"
TOKENIZER_SAMPLES = 2000  # what the tokenizer of a student of random weights is trained on, at most


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
        # peft would keep a float32 copy of what each adapted layer is given; autocast converts where it is used
        # instead.
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


def free_weights(student: Student, cfg: TrainConfig) -> Student:
    """Let all weights learn but those of the vision tower, which stays as it is unless `train_vision`."""
    student.model.requires_grad_(True)
    for module in () if cfg.train_vision else student.vision_modules():
        module.requires_grad_(False)
        module.to(student.dtype)
    return student


def prepared_student(cfg: TrainConfig, base: Path, seed: int, device: str) -> Student:
    """Load a student and prepare it for training."""
    template = read_text(Path(cfg.chat_template), what="chat template") if cfg.chat_template else ""
    given: Any = {"device": device, "dtype": cfg.dtype, "template": template, "allow_code": cfg.allow_code}
    if cfg.method == "lora":
        student = add_adapter(load_student(base, **given), cfg, seed)
    else:
        student = free_weights(load_student(base, **given, is_trained=True), cfg)
    if cfg.compile:
        for layer in student.core.get_decoder().layers:
            layer.compile(dynamic=True)
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
        base = out / STUDENT if preset else student_path(str(student), allow_code=cfg.allow_code)
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
            with trackers(cfg, out, is_first=ranks.is_first) as track:
                progress = fit(lesson, out, track)
        ranks.first_does(lambda: _write_product(lesson, progress, taught, product, base, base_name, opened[0]))
    return product


def _lesson(
    cfg: TrainConfig, dataset: Path, trees: dict[str, Path], base: Path, out: Path, seed: int, ranks: Ranks
) -> tuple[Lesson, ChatFormat]:
    student = prepared_student(cfg, base, seed, ranks.device)
    samples, validation = (open_split(dataset, split, text_only=not student.has_pictures) for split in TAUGHT)
    chosen = choose_over_all(validation, cfg.validation_samples, rng_for(seed, STAGE, "validation"))
    if not samples:
        fix = "prepare the training set with more captions, or with other fractions"
        raise InputError("the training split is empty", where=dataset, fix=fix)
    if not student.has_pictures and open_split(dataset, "train")[0].views:
        log.warning("%s: the student takes no pictures: it is taught with the text state alone", STAGE)
    taught = taught_by(samples, cfg.max_pixels)
    processor = student.processor
    workers, max_pixels = num_workers(cfg.data_workers), cfg.max_pixels
    counting: Any = {"max_tokens": cfg.max_tokens, "max_pixels": max_pixels, "workers": workers, "ranks": ranks}
    census = take_census(samples, range(len(samples)), processor, trees, **counting, label=f"{STAGE}: counting tokens")
    asked = take_census(validation, chosen, processor, trees, **counting, label=f"{STAGE}: counting tokens of val")
    if not len(census):
        raise _nothing_to_learn(out, census)
    memory_bytes = int(FEATURE_MEMORY_GB * GB)
    kept: Any = {"memory_bytes": memory_bytes, "is_frozen": not cfg.train_vision, "max_pixels": max_pixels}
    features = VisionFeatures(student, **kept)
    reader = PictureReader(processor, trees, student.dtype, max_pixels)
    weights = AnswerWeights(cfg.decision_weight, cfg.reason_weight)
    supply = Supply(features, reader, workers, weights)
    lesson = Lesson(student, samples, census, validation, asked, supply, cfg, ranks, seed)
    found = findings(cfg, student, census, asked, features, samples, lesson.steps)
    ranks.first_does(lambda: tell(found, out / PREFLIGHT))
    return lesson, taught


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
    facts = adapter_facts(student, taught.max_pixels, base)
    with atomic_folder(product) as partial:
        if cfg.method == "lora":
            write_adapter_folder(student, partial, base_name)
            write_json(partial / ADAPTER_FACTS, facts)
        else:
            student.model.to(student.dtype)
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
