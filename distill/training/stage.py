"""LoRA training of a student: a plain PyTorch loop whose loss counts answer tokens only.

Every random choice derives from (seed, epoch) or (seed, step), so a run that was killed and continued takes the same steps as
one that was not; the checkpoint needs no generator state. One process, one device.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from cosfly.chance import rng_for
from cosfly.config import Config
from cosfly.console import progress_bar
from cosfly.errors import ConfigError, InputError
from cosfly.reading.documents import parse_json
from cosfly.reading.files import read_lines
from cosfly.stage_folder import Resume, StageFolder, Tally
from cosfly.store import atomic_folder, dump_json, inside, storage_errors, write_json
from cosfly.student_chat import write_taught
from distill.schema import Sample, open_split, resolve_trees, tree_inputs
from distill.student.checkpoint import (
    ADAPTER_FACTS,
    adapter_facts,
    cut_log,
    drop_old_checkpoints,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from distill.student.encoding import IGNORED, Encoded, count_tokens, encode, image_size, most_pixels, training_batch
from distill.student.model import Device, Student, load_student, require, weight_files
from distill.student.taught import taught_by

log = logging.getLogger(__name__)

STAGE = "distill.train"
# All linear layers of the language model. Three of four Qwen3.5 layers are linear attention, so q, k, v, o alone would leave
# most of the network untouched; the vision tower stays frozen.
TARGET_MODULES = (
    r".*language_model\.layers\.\d+\.(self_attn\.(q|k|v|o)_proj"
    r"|linear_attn\.(in_proj_qkv|in_proj_z|in_proj_a|in_proj_b|out_proj)"
    r"|mlp\.(gate|up|down)_proj)"
)


class TrainConfig(Config):
    """Settings of `distill train`."""

    lora_rank: int = Field(16, ge=1, description="rank of the LoRA update")
    lora_alpha: float = Field(32.0, gt=0, description="LoRA scale; the update is multiplied by alpha / rank")
    lora_dropout: float = Field(0.05, ge=0, lt=1, description="dropout in front of the LoRA matrices; 0: off")
    target_modules: str = Field(
        TARGET_MODULES, description="regular expression over the full names of the adapted layers"
    )
    epochs: int = Field(3, ge=1, description="passes over the training split")
    max_steps: int = Field(0, ge=0, description="stop after this many optimizer steps; 0: only by epochs")
    learning_rate: float = Field(1e-4, gt=0, description="peak learning rate of AdamW")
    schedule: Literal["cosine", "constant"] = Field("cosine", description="learning rate after the warm-up")
    warmup_fraction: float = Field(0.03, ge=0, lt=1, description="share of the steps with a rising rate; 0: none")
    weight_decay: float = Field(0.0, ge=0, description="AdamW's decoupled weight decay")
    max_gradient_norm: float = Field(1.0, ge=0, description="gradients are scaled down to this norm; 0: off")
    batch_size: int = Field(1, ge=1, description="samples in one forward pass")
    accumulate: int = Field(8, ge=1, description="forward passes in one optimizer step")
    gradient_checkpointing: bool = Field(
        False, description="recompute activations: less memory, about 30 percent slower"
    )
    max_pixels: int = Field(
        0,
        ge=0,
        description="most pixels kept of a picture; 0: all. Fewer than it has, and pixel values of the texts fit it no more",
    )
    max_tokens: int = Field(
        4096, ge=16, description="longest sample, images and answer included; a longer one is an error"
    )
    save_every_steps: int = Field(50, ge=1, description="steps between checkpoints")
    keep_checkpoints: int = Field(2, ge=1, description="newest checkpoints that stay")
    validation_samples: int = Field(
        64, ge=0, description="samples of val for the loss before and after training; 0: none"
    )
    device: Device = Field("auto", description="auto, cpu or cuda; bfloat16 on cuda, float32 on a CPU")

    @field_validator("target_modules")
    @classmethod
    def _is_expression(cls, value: str) -> str:
        try:
            re.compile(value)
        except re.error as error:
            raise ValueError(f"not a regular expression: {error}") from None
        return value


# --- steps -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Steps:
    """Which samples each step sees: steps of one epoch follow a permutation of their own."""

    num_samples: int
    samples_per_step: int
    num_steps: int
    seed: int

    @classmethod
    def make(cls, cfg: TrainConfig, num_samples: int, seed: int) -> Steps:
        samples_per_step = cfg.batch_size * cfg.accumulate
        num_steps = cfg.epochs * math.ceil(num_samples / samples_per_step)
        return cls(num_samples, samples_per_step, min(num_steps, cfg.max_steps or num_steps), seed)

    @property
    def steps_per_epoch(self) -> int:
        return math.ceil(self.num_samples / self.samples_per_step)

    def samples_of(self, step: int) -> list[int]:
        """Give the sample indices of a step; the last step of an epoch may be smaller."""
        epoch, position = divmod(step, self.steps_per_epoch)
        order = rng_for(self.seed, STAGE, f"epoch_{epoch}").permutation(self.num_samples)
        return order[position * self.samples_per_step : (position + 1) * self.samples_per_step].tolist()


def learning_rate_at(cfg: TrainConfig, step: int, num_steps: int) -> float:
    """Give the rate of a step: a linear rise, then a half cosine to zero or a constant."""
    warmup = math.ceil(cfg.warmup_fraction * num_steps)
    if step < warmup:
        return cfg.learning_rate * (step + 1) / warmup
    if cfg.schedule == "constant":
        return cfg.learning_rate
    share = (step - warmup) / max(1, num_steps - warmup)
    return cfg.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))


def preflight(
    student: Student, samples: Sequence[Sample], trees: Mapping[str, Path], max_tokens: int
) -> dict[str, int]:
    """Count the real tokens of every sample, images included, so that nothing is ever cut off, and look at every image's size.

    Returns:
        totals: samples, tokens, answer_tokens, longest.
    Raises:
        InputError: names the longest sample that does not fit, or an image of another size than its prompt says.
    """
    checked: set[tuple[str, str]] = set()
    totals = {"samples": len(samples), "tokens": 0, "answer_tokens": 0, "longest": 0}
    longest = ""
    with progress_bar(f"{STAGE}: counting tokens", total=len(samples)) as advance:
        for sample in samples:
            for name in sample.images:
                if (sample.run, name) not in checked:
                    sample.pictures.check_size(path := inside(trees[sample.run], name), image_size(path))
                    checked.add((sample.run, name))
            prompt, answer = count_tokens(student, sample)
            if prompt + answer > totals["longest"]:
                totals["longest"], longest = prompt + answer, f"{sample.key} ({prompt} prompt + {answer} answer)"
            totals["tokens"] += prompt + answer
            totals["answer_tokens"] += answer
            advance(1)
    if totals["longest"] > max_tokens:
        raise InputError(
            "a sample is longer than max_tokens",
            where=longest,
            got=f"{totals['longest']} tokens",
            expected=f"<= {max_tokens}",
            fix=f"set max_tokens={totals['longest']}, or lower max_pixels",
        )
    return totals


# --- model ------------------------------------------------------------------------------------------------------------


def add_adapter(student: Student, cfg: TrainConfig, seed: int) -> Student:
    """Wrap the student's model with a fresh LoRA adapter; only the adapter can be trained.

    Raises:
        ConfigError: no layer matches `target_modules`.
    """
    import torch
    from peft import LoraConfig, get_peft_model

    pattern = re.compile(cfg.target_modules)
    names = [name for name, module in student.model.named_modules() if isinstance(module, torch.nn.Linear)]
    if not any(pattern.fullmatch(name) for name in names):
        raise ConfigError("no layer of the student matches", where="target_modules", got=cfg.target_modules)
    lora = LoraConfig(
        r=cfg.lora_rank,
        lora_alpha=cfg.lora_alpha,  # type: ignore[arg-type]  # a plain number; the library says int
        lora_dropout=cfg.lora_dropout,
        target_modules=cfg.target_modules,
        task_type="CAUSAL_LM",
    )
    with seeded(student, seed, "adapter"):
        student.model = get_peft_model(student.model, lora)
    return student


@contextlib.contextmanager
def seeded(student: Student, seed: int, item_id: str) -> Iterator[None]:
    """Let torch's generators start from (seed, item), and be as before after it."""
    import torch

    devices = [torch.cuda.current_device()] if student.device == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(int(rng_for(seed, STAGE, item_id).integers(2**31)))
        yield


def answer_loss(student: Student, rows: Sequence[Encoded]) -> tuple[Any, float]:
    """Run a batch forward.

    Returns:
        The weighted sum of the negative log-likelihoods (nats) of the answer tokens, and the sum of their weights.
    """
    import torch

    inputs, labels, weights = training_batch(student, rows)
    # Logits for answer positions only: with a vocabulary of 250,000 they would otherwise be most of the memory.
    first = min(len(row.prompt_ids) for row in rows) - 1
    keep = torch.arange(first, labels.shape[1] - 1, device=labels.device)
    logits = student.model(**inputs, logits_to_keep=keep, use_cache=False).logits.float()
    targets = labels[:, first + 1 :]  # the logits at i tell token i + 1
    nats = torch.nn.functional.cross_entropy(
        logits.transpose(1, 2), targets, ignore_index=IGNORED, reduction="none"
    )  # (b, n), zero where ignored
    counted = (targets != IGNORED).float() * weights[:, None]
    return (nats * counted).sum(), float(counted.sum())


def mean_loss(student: Student, samples: Sequence[Sample], trees: Mapping[str, Path], batch_size: int) -> float:
    """Give the mean loss (nats per answer token) without dropout or gradients."""
    import torch

    student.model.eval()
    total, weight = 0.0, 0.0
    with torch.inference_mode(), progress_bar(f"{STAGE}: validation loss", total=len(samples)) as advance:
        for start in range(0, len(samples), batch_size):
            rows = [encode(student, sample, trees) for sample in samples[start : start + batch_size]]
            nats, count = answer_loss(student, rows)
            total, weight = total + float(nats), weight + count
            advance(len(rows))
    return total / weight


# --- training ---------------------------------------------------------------------------------------------------------


def train_step(
    student: Student,
    optimizer: Any,
    samples: Sequence[Sample],
    trees: Mapping[str, Path],
    cfg: TrainConfig,
    rate: float,
) -> dict[str, Any]:
    """Take one optimizer step over `samples` in forward passes of `batch_size`.

    Returns:
        loss (nats per answer token, weighted), gradient_norm, answer_tokens, tokens.
    """
    import torch

    rows = [encode(student, sample, trees) for sample in samples]
    weight = sum(len(row.answer_ids) * row.weight for row in rows)
    student.model.train()
    total = 0.0
    for start in range(0, len(rows), cfg.batch_size):
        nats, _ = answer_loss(student, rows[start : start + cfg.batch_size])
        (nats / weight).backward()
        total += float(nats.detach())
    parameters = [p for p in student.model.parameters() if p.requires_grad]
    norm = float(torch.nn.utils.clip_grad_norm_(parameters, cfg.max_gradient_norm or math.inf))
    if not math.isfinite(total) or not math.isfinite(norm):
        raise ConfigError(
            "the loss or its gradient is not finite",
            where="learning_rate",
            got=f"{cfg.learning_rate}",
            fix="lower learning_rate; the last checkpoint stays usable",
        )
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    return {
        "loss": total / weight,
        "gradient_norm": norm,
        "answer_tokens": sum(len(row.answer_ids) for row in rows),
        "tokens": sum(len(row) for row in rows),
    }


def fit(
    student: Student, samples: Sequence[Sample], trees: Mapping[str, Path], out: Path, cfg: TrainConfig, *, seed: int
) -> list[dict[str, Any]]:
    """Train the student's adapter, from the newest checkpoint of `out` if there is one, and give the log.

    Writes `log.jsonl` and `checkpoints/` in `out`.
    """
    import torch

    steps = Steps.make(cfg, len(samples), seed)
    parameters = [p for p in student.model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(parameters, lr=cfg.learning_rate, weight_decay=cfg.weight_decay)
    log_path, checkpoints = out / "log.jsonl", out / "checkpoints"
    newest = newest_checkpoint(checkpoints)
    first = load_checkpoint(newest, student, optimizer) if newest else 0
    if first:
        log.info("%s: continuing after step %d of %d", STAGE, first, steps.num_steps)
    cut_log(log_path, first)
    with (
        storage_errors(log_path),
        open(log_path, "a", encoding="utf-8") as file,
        progress_bar(STAGE, total=steps.num_steps, done=first) as advance,
    ):
        for step in range(first, steps.num_steps):
            rate = learning_rate_at(cfg, step, steps.num_steps)
            chosen = [samples[i] for i in steps.samples_of(step)]
            with seeded(student, seed, f"step_{step}"):
                facts = train_step(student, optimizer, chosen, trees, cfg, rate)
            record = {"step": step + 1, "epoch": step // steps.steps_per_epoch, "learning_rate": rate, **facts}
            file.write(dump_json(record) + "\n")
            file.flush()
            if (step + 1) % cfg.save_every_steps == 0 or step + 1 == steps.num_steps:
                save_checkpoint(checkpoints / f"step_{step + 1:08d}", student, optimizer, step + 1)
                drop_old_checkpoints(checkpoints, cfg.keep_checkpoints)
            advance(1)
    return [parse_json(line) for line in read_lines(log_path, what="log")]


def run(
    cfg: TrainConfig,
    dataset: Path,
    data: Sequence[Path],
    model: Path,
    out: Path,
    *,
    seed: int = 0,
    resume: Resume = "if-same",
) -> Path:
    """Read the training set, its playback trees `data` and the model folder; write `adapter/`, `log.jsonl`, `checkpoints/`.

    Returns:
        The adapter's folder, which peft loads.
    Raises:
        InputError: an input is missing, does not fit, or a sample is longer than `max_tokens`.
        EnvironmentMissing: torch, transformers or peft is missing.
    """
    require("torch", "transformers", "peft")
    weights = weight_files(model)
    trees = resolve_trees(dataset, data)
    inputs = {"dataset": dataset, **tree_inputs(trees), **weights}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed, resume=resume)
    adapter = out / "adapter"
    if stage.is_complete:
        return adapter
    samples = open_split(dataset, "train")
    if not samples:
        raise InputError("the training split is empty", where=dataset)
    validation = open_split(dataset, "val")[: cfg.validation_samples]
    max_pixels = cfg.max_pixels or most_pixels([*samples, *validation])
    student = load_student(model, device=cfg.device, max_pixels=max_pixels)
    totals = preflight(student, [*samples, *validation], trees, cfg.max_tokens)
    student = add_adapter(student, cfg, seed)
    if cfg.gradient_checkpointing:
        student.model.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    # A fresh adapter changes nothing (its second matrix is zero), so this is the bare model's loss, resumed or not.
    before = mean_loss(student, validation, trees, cfg.batch_size) if validation else None
    records = _fit_or_explain(student, samples, trees, out, cfg, seed)
    after = mean_loss(student, validation, trees, cfg.batch_size) if validation else None
    facts = adapter_facts(student, max_pixels, model)
    with atomic_folder(adapter) as partial:
        student.model.save_pretrained(partial)
        write_json(partial / ADAPTER_FACTS, facts)
        write_taught(partial, taught_by(samples, max_pixels))
    stage.finish(
        [path for path in (out / "log.jsonl", *adapter.iterdir()) if path.is_file()],
        Tally(input=len(samples), kept=len(samples)),
        steps=len(records),
        first_loss=records[0]["loss"],
        last_loss=records[-1]["loss"],
        validation_loss_before=before,
        validation_loss_after=after,
        tokens=totals,
        **{name: facts[name] for name in ("trainable_parameters", "parameters", "device", "versions")},
    )
    return adapter


def _fit_or_explain(
    student: Student, samples: Sequence[Sample], trees: Mapping[str, Path], out: Path, cfg: TrainConfig, seed: int
) -> list[dict[str, Any]]:
    import torch

    try:
        return fit(student, samples, trees, out, cfg, seed=seed)
    except torch.OutOfMemoryError as error:
        raise ConfigError(
            "the accelerator's memory is full",
            where="batch_size",
            got=f"{cfg.batch_size}: {str(error)[:120]}",
            fix="lower batch_size (raise accumulate as much) or max_pixels, or set gradient_checkpointing=true",
        ) from error
