"""What is known before the first step, in one list: samples, steps, memory, and what stands in the way."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import resource
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from cosfly.formats.captions import TOKENS
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.json_io import write_json
from distill.schema import Sample, Samples
from distill.student.chat import EncodedSample, Processor
from distill.student.features import VisionFeatures
from distill.student.model import FAST_FAMILIES, Student
from distill.training.loading import Census
from distill.training.loss import answer_loss, output_head
from distill.training.settings import LOGIT_CHUNK, Steps, TrainConfig

log = logging.getLogger(__name__)

GB = 1e9
PROBES = (64, 192)  # tokens; the fallback of linear attention works in pieces of 64
TABLES = 3  # of logits at a time: as computed, in float32, and their gradient
ADAM_COPIES = 2  # first and second moment


@dataclass(frozen=True)
class Memory:
    """Bytes by what they are for; `available` is what the device has for all of it."""

    _PARTS: ClassVar = ("weights", "gradients", "optimizer", "activations", "logits", "pictures", "program")

    weights: float
    gradients: float
    optimizer: float
    activations: float
    logits: float
    pictures: float
    program: float  # what the process takes already beside the weights: libraries, code
    available: float

    @property
    def needed(self) -> float:
        return sum(getattr(self, name) for name in self._PARTS)

    def __str__(self) -> str:
        told = ", ".join(f"{name} {getattr(self, name) / GB:.2f}" for name in self._PARTS)
        return f"{self.needed / GB:.2f} GB of {self.available / GB:.1f} ({told})"


def saved_bytes_per_token(student: Student, cfg: TrainConfig) -> float:
    """Measure what a forward pass keeps for its backward pass, bytes a token, by running two short texts.

    What is saved depends on the layers, on peft and on which kernels are there, and grows evenly with the tokens. With
    gradient checkpointing it is what stays; what one layer makes anew comes on top of it, once.
    """
    import torch

    found: list[int] = []
    student.model.train()
    own = {p.untyped_storage().data_ptr() for p in student.model.parameters()}
    for length in PROBES:
        storages: dict[int, Any] = {}  # held: of one that is let go on the way the next would take the place

        def count(tensor: Any, storages: dict[int, Any] = storages) -> Any:
            if (place := tensor.untyped_storage().data_ptr()) not in own:
                storages.setdefault(place, tensor.untyped_storage())
            return tensor

        half = np.full(length // 2, student.end_token_id, np.int64)
        row = EncodedSample("probe", half, half, np.ones(length // 2, np.float32))
        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            answer_loss(student, [row], (), LOGIT_CHUNK)
        found.append(sum(storage.nbytes() for storage in storages.values()))
    return (found[1] - found[0]) / (PROBES[1] - PROBES[0])


def estimate(student: Student, cfg: TrainConfig, longest: int, picture_bytes: float) -> Memory:
    """Estimate the peak of a training step.

    Args:
        longest: tokens of the longest sample. picture_bytes: of the features of the pictures of one sample.
    """
    parameters = list(student.model.parameters())
    learning = sum(p.numel() * p.element_size() for p in parameters if p.requires_grad)
    weights = float(sum(p.numel() * p.element_size() for p in parameters))
    config, rows = student.core.config.get_text_config(), cfg.batch_size
    return Memory(
        weights=weights,
        gradients=learning,
        optimizer=ADAM_COPIES * learning,
        # While a layer goes backward, the gradients of what it kept stand beside what all layers kept.
        activations=saved_bytes_per_token(student, cfg) * longest * rows * (1 + 1 / config.num_hidden_layers),
        logits=float(TABLES * LOGIT_CHUNK * config.vocab_size * 4),
        pictures=rows * picture_bytes,
        program=max(0.0, used_gb(student.device) * GB - weights),
        available=available_bytes(student.device),
    )


def available_bytes(device: str) -> float:
    """Return the memory of the device: the accelerator's, or the machine's."""
    import torch

    if device == "cuda":
        return float(torch.cuda.get_device_properties(torch.cuda.current_device()).total_memory)
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def used_gb(device: str) -> float:
    """Return the most memory used so far: of the accelerator, or of this process."""
    import torch

    if device == "cuda":
        return torch.cuda.max_memory_allocated() / GB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GB


@contextlib.contextmanager
def memory_errors(cfg: TrainConfig) -> Iterator[None]:
    """Return what helps where the memory was too small, on an accelerator or a CPU."""
    import torch

    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        is_full = isinstance(error, torch.OutOfMemoryError | MemoryError) or "DefaultCPUAllocator" in str(error)
        if not is_full:
            raise
        smaller = f"--set distill.train.batch_size={cfg.batch_size // 2}"
        less = "--set distill.train.gradient_checkpointing=true"
        advice = [smaller] * (cfg.batch_size > 1) + [less] * (not cfg.gradient_checkpointing)
        fix = f"run again with {' or '.join(advice) or 'smaller max_tokens'}; training resumes from the last checkpoint"
        got = f"batch_size {cfg.batch_size}: {str(error)[:120]}"
        raise ConfigError("the memory is full", where="distill.train.batch_size", got=got, fix=fix) from error


# Packages without which Qwen3.5 silently falls back to slow code, and what each is for.
FAST_KERNELS = {
    "fla": ("flash-linear-attention", "the linear attention of three layers of four"),
    "tilelang": ("tilelang", "its backward pass on Hopper, with Triton before 3.7.1"),
    "causal_conv1d": ("causal-conv1d", "the short convolution before it"),
}


@dataclass(frozen=True)
class Precheck:
    """A line of the list. warning: it may be meant so; error: training would not do what was asked for."""

    topic: str
    text: str
    level: Literal["fact", "warning", "error"] = "fact"


def findings(
    cfg: TrainConfig,
    student: Student,
    census: Census,
    validation: Census,
    features: VisionFeatures,
    samples: Samples,
    steps: Steps,
) -> list[Precheck]:
    """Look at everything that can be known beforehand.

    Args:
        samples: those that census counted.
    """
    tokens, answers, longest = (int(n) for n in (census.tokens.sum(), census.answer_tokens.sum(), census.tokens.max()))
    words = f"{tokens} tokens, {answers} of them answers; the longest has {longest} of {cfg.max_tokens}"
    return [
        Precheck("samples", f"{len(census)} of {census.num_samples}; {words}"),
        Precheck("steps", f"{steps.num_steps} of {cfg.samples_per_step} samples, {steps.steps_per_epoch} per epoch"),
        *(
            Precheck("skipped", f"{name}: {reason} {count}, first {part.examples[reason]}", "warning")
            for name, part in (("train", census), ("val", validation))
            for reason, count in sorted(part.skipped.items())
        ),
        Precheck("validation", f"{len(validation)} samples of {len(validation.decisions)} decisions"),
        *_about_decisions(census, validation),
        _about_chat(student, samples[int(census.indices[0])]),
        *_about_head(student),
        _about_memory(cfg, student, census, features),
        _about_features(census, validation, features),
        *_about_kernels(student),
    ]


def _about_decisions(census: Census, validation: Census) -> list[Precheck]:
    """Say once which decisions train never shows: a fact of most small sets, and of weight where val asks for them."""
    missing = [action for action in TOKENS if not census.decisions[action]]
    asked = {action: validation.decisions[action] for action in missing if validation.decisions[action]}
    if not asked:
        return [Precheck("decisions", f"no sample of {', '.join(missing)}")] if missing else []
    counts = ", ".join(f"{action} {count}" for action, count in asked.items())
    rest = ", ".join(action for action in missing if action not in asked)
    words = f"val has {sum(asked.values())} of {len(validation)} samples with decisions that train lacks: {counts}"
    more = f"; train also lacks {rest}" if rest else ""
    return [Precheck("decisions", f"{words}{more}", "warning")]


def _about_chat(processor: Processor, sample: Sample) -> Precheck:
    """Hold what a student is taught against what its own chat template makes of the whole chat."""
    prompt, whole = processor.prompt_text(sample), processor.chat_text(sample)
    taught = prompt + processor.lead + sample.answer + processor.end_of_answer
    thinking = "an empty thought" if "<think>" in prompt else "no thoughts"
    if taught == whole:
        return Precheck("chat template", f"the student's own; {thinking}; the prompt ends with {prompt[-32:]!r}")
    at = next((i for i, pair in enumerate(zip(taught, whole, strict=False)) if len(set(pair)) > 1), len(taught))
    words = f"at character {at}, {taught[at : at + 40]!r} instead of {whole[at : at + 40]!r}"
    return Precheck("chat template", f"the training text differs from that of the template: {words}", "error")


def _about_head(student: Student) -> list[Precheck]:
    """Check that logits are the product of the last hidden state and the head, from which the loss is computed."""
    import torch

    ids = torch.full((1, 4), student.end_token_id, device=student.device)
    with torch.no_grad(), student.computing():
        logits = student.core(input_ids=ids, use_cache=False).logits.float()
        hidden = student.core.base_model(input_ids=ids, use_cache=False).last_hidden_state
        plain = (hidden.to(student.dtype) @ output_head(student).to(student.dtype).T).float()
    if torch.allclose(logits, plain, rtol=0.05, atol=0.05 * float(logits.abs().max())):
        return []
    words = f"{type(student.core).__name__} changes its logits after the head, which the loss does not know"
    return [Precheck("head", words, "error")]


def _about_memory(cfg: TrainConfig, student: Student, census: Census, features: VisionFeatures) -> Precheck:
    of_pictures = sum(map(features.bytes_of, census.pictures_of(int(census.indices[0]))))
    memory = estimate(student, cfg, int(census.tokens.max()), of_pictures)
    level: Any = "warning" if memory.needed > memory.available else "fact"
    return Precheck("memory", f"about {memory} with batch_size {cfg.batch_size}", level)


def _about_features(census: Census, validation: Census, features: VisionFeatures) -> Precheck:
    pictures = dict.fromkeys([*census.pictures, *validation.pictures])
    if not pictures:
        return Precheck("pictures", "none, the prompts are text only")
    if not features.is_frozen:
        return Precheck(
            "pictures", f"{len(pictures)}; the vision tower is trained, so it encodes each picture at each use"
        )
    total = sum(features.bytes_of(picture) for picture in pictures)
    words = f"{len(pictures)}, features {total / GB:.3f} GB"
    if (rest := total - features.memory_bytes) > 0:
        return Precheck(
            "pictures",
            f"{words}, of which {rest / GB:.3f} GB do not fit into memory and are computed at each use",
            "warning",
        )
    return Precheck("pictures", words)


def _about_kernels(student: Student) -> list[Precheck]:
    if student.device == "cpu" or student.core.config.model_type not in FAST_FAMILIES:
        return [Precheck("kernels", "PyTorch's own")]
    return [
        Precheck("kernels", f"{package} is not installed, so {what} is slow; pip install {package}", "warning")
        for module, (package, what) in FAST_KERNELS.items()
        if importlib.util.find_spec(module) is None
    ]


def tell(found: Sequence[Precheck], path: Path) -> None:
    """Log the list and write it to `preflight.json`.

    Raises:
        InputError: it has an error in it.
    """
    write_json(path, [asdict(finding) for finding in found])
    log.info("checks before the first step:")
    for finding in found:
        log.log(logging.INFO if finding.level == "fact" else logging.WARNING, "  %-14s %s", finding.topic, finding.text)
    if errors := [f"{finding.topic}: {finding.text}" for finding in found if finding.level == "error"]:
        raise InputError("training cannot start, because a check failed", where=path, got="; ".join(errors))
