"""What is known before the first step, in one list: what will be learnt from, what it will take, and what stands in the way."""

from __future__ import annotations

import importlib.util
import logging
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from cosfly.errors import InputError
from cosfly.products.actions import action_tokens
from cosfly.work.store import write_json
from distill.schema import Sample
from distill.student.encoding import END_OF_ANSWER, chat_text, prompt_text
from distill.student.features import VisionFeatures
from distill.student.model import Processor, Student
from distill.training.census import Census
from distill.training.memory import GB, estimate
from distill.training.settings import TrainConfig
from distill.training.steps import Steps

log = logging.getLogger(__name__)

# Packages without which Qwen3.5 silently falls back to slow code, and what each is for.
FAST_KERNELS = {
    "fla": ("flash-linear-attention", "the linear attention of three layers of four"),
    "tilelang": ("tilelang", "its backward pass on Hopper, with Triton before 3.7.1"),
    "causal_conv1d": ("causal-conv1d", "the short convolution before it"),
}


@dataclass(frozen=True)
class Finding:
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
    sample: Sample,
    steps: Steps,
) -> list[Finding]:
    """Look at everything that can be known beforehand.

    Args:
        sample: any sample that is learnt from.
    """
    return [
        *_about_data(cfg, census, validation, steps),
        *_about_decisions(cfg, census, validation),
        _about_chat(student, sample),
        *_about_memory(cfg, student, census, features),
        *_about_features(cfg, census, validation, features),
        *_about_kernels(student),
    ]


def _about_data(cfg: TrainConfig, census: Census, validation: Census, steps: Steps) -> list[Finding]:
    tokens, answers = int(census.tokens.sum()), int(census.answer_tokens.sum())
    found = [
        Finding(
            "samples",
            f"{len(census)} of {census.num_samples}; {tokens} tokens, {answers} of them answers; the longest has "
            f"{int(census.tokens.max())} of {cfg.max_tokens}",
        ),
        Finding("steps", f"{steps.num_steps} of {cfg.samples_per_step} samples, {steps.steps_per_epoch} an epoch"),
    ]
    for name, part in (("train", census), ("val", validation)):
        for reason, count in sorted(part.skipped.items()):
            found.append(Finding("left out", f"{name}: {reason} {count}, first {part.examples[reason]}", "warning"))
    return [*found, Finding("validation", f"{len(validation)} samples of {len(validation.decisions)} decisions")]


def _about_decisions(cfg: TrainConfig, census: Census, validation: Census) -> list[Finding]:
    """Say once which decisions train never shows: a fact of most small sets, and of weight where val asks for them."""
    missing = [action for action in action_tokens() if not census.decisions[action]]
    asked = {action: validation.decisions[action] for action in missing if validation.decisions[action]}
    if not asked:
        return [Finding("decisions", f"no sample of {', '.join(missing)}")] if missing else []
    level: Any = "error" if cfg.empty_decision == "refuse" else "warning"
    told = ", ".join(f"{action} {count}" for action, count in asked.items())
    never = (
        f"; nor does it show {', '.join(rest)}"
        if (rest := [action for action in missing if action not in asked])
        else ""
    )
    count = sum(asked.values())
    return [
        Finding(
            "decisions",
            f"val asks for what train never shows, and {count} of its {len(validation)} samples will be wrong: {told}{never}; "
            "more walks or towns in train have them, another seed splits otherwise",
            level,
        )
    ]


def _about_chat(processor: Processor, sample: Sample) -> Finding:
    """Hold what a student is taught against what its own chat template makes of the whole chat."""
    prompt = prompt_text(processor, sample, [1] * len(sample.images))
    taught, whole = prompt + sample.answer + END_OF_ANSWER, chat_text(processor, sample)
    thinking = "an empty thought, so it answers at once" if "<think>" in prompt else "no thoughts"
    if taught != whole:
        differs = next(
            (i for i, (a, b) in enumerate(zip(taught, whole, strict=False)) if a != b), min(len(taught), len(whole))
        )
        return Finding(
            "chat template",
            f"prompt, answer and end are not what the template writes: at character {differs} {taught[differs : differs + 40]!r} for "
            f"{whole[differs : differs + 40]!r}",
            "error",
        )
    return Finding("chat template", f"the student's own; {thinking}; the prompt ends with {prompt[-32:]!r}")


def _about_memory(cfg: TrainConfig, student: Student, census: Census, features: VisionFeatures) -> list[Finding]:
    memory = estimate(
        student, cfg, int(census.tokens.max()), sum(map(features.bytes_of, census.pictures_of(int(census.indices[0]))))
    )
    level: Any = "warning" if memory.needed > memory.available else "fact"
    return [Finding("memory", f"about {memory} with batch_size {cfg.batch_size}", level)]


def _about_features(cfg: TrainConfig, census: Census, validation: Census, features: VisionFeatures) -> list[Finding]:
    pictures = dict.fromkeys([*census.pictures, *validation.pictures])
    if not pictures:
        return [Finding("pictures", "none: the student sees texts only")]
    total = sum(features.bytes_of(picture) for picture in pictures)
    if not features.is_frozen:
        return [Finding("pictures", f"{len(pictures)}; the vision tower learns and looks at each whenever it is shown")]
    if not cfg.feature_cache:
        return [
            Finding("pictures", f"{len(pictures)}; each is looked at in every step that shows it (feature_cache=false)")
        ]
    in_memory = min(total, features.memory_bytes)
    on_disk = min(total - in_memory, features.disk_bytes)
    told = f"{len(pictures)}, features {total / GB:.3f} GB: {in_memory / GB:.3f} in memory, {on_disk / GB:.3f} on disk"
    found = []
    if (rest := total - in_memory - on_disk) > 0:
        found.append(
            Finding("pictures", f"{told}; {rest / GB:.3f} GB have no room and are looked at each time", "warning")
        )
    else:
        found.append(Finding("pictures", told))
    if features.folder is not None and on_disk > (free := shutil.disk_usage(_existing(features.folder)).free):
        found.append(
            Finding("pictures", f"the disk has {free / GB:.1f} GB for {on_disk / GB:.1f} GB of features", "error")
        )
    return found


def _existing(folder: Path) -> Path:
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def _about_kernels(student: Student) -> list[Finding]:
    if student.device == "cpu":
        return [Finding("kernels", "PyTorch's, as on every CPU")]
    return [
        Finding("kernels", f"{package} is missing: {what} runs as slow PyTorch code; pip install {package}", "warning")
        for module, (package, what) in FAST_KERNELS.items()
        if importlib.util.find_spec(module) is None
    ]


def tell(found: Sequence[Finding], path: Path) -> None:
    """Log the list and write it to `preflight.json`.

    Raises:
        InputError: it has an error in it.
    """
    write_json(path, [asdict(finding) for finding in found])
    log.info("before the first step:")
    for finding in found:
        log.log(logging.INFO if finding.level == "fact" else logging.WARNING, "  %-14s %s", finding.topic, finding.text)
    errors = [f"{finding.topic}: {finding.text}" for finding in found if finding.level == "error"]
    if errors:
        raise InputError("training cannot begin", where=path, got="; ".join(errors))
