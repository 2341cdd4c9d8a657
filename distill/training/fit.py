"""The loop: steps, validations, checkpoints, and their log.

Every random choice derives from (seed, epoch) or (seed, step, process), so a run that was killed and continued takes
the same steps as one that was not; the checkpoint needs no generator state.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import storage_errors
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for
from distill.schema import Sample, Samples
from distill.student.checkpoint import (
    Progress,
    check_whole,
    checkpoint_path,
    cut_log,
    drop_old_checkpoints,
    learning_weights,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from distill.student.model import Student
from distill.training.loading import Census, ReadyStep, Supply
from distill.training.loss import answer_loss
from distill.training.preflight import used_gb
from distill.training.ranks import Ranks
from distill.training.settings import (
    LOGIT_CHUNK,
    MAX_GRADIENT_NORM,
    STAGE,
    Steps,
    TrainConfig,
    learning_rate_at,
    share_of,
)
from distill.training.trackers import Track
from distill.training.validation import Validation, validate

log = logging.getLogger(__name__)

LOG, CHECKPOINTS = "log.jsonl", "checkpoints"


@dataclass
class Lesson:
    """A student, what it learns from, and what it is asked about."""

    student: Student
    samples: Sequence[Sample]
    census: Census
    validation_samples: Samples
    validation_census: Census
    supply: Supply
    cfg: TrainConfig
    ranks: Ranks
    seed: int

    def __post_init__(self) -> None:
        self.steps = Steps.make(self.cfg, len(self.census), self.seed)

    def validate(self) -> Validation | None:
        if not len(census := self.validation_census):
            return None
        return validate(self.student, self.validation_samples, census, self.supply, self.cfg, self.ranks)

    def is_validated(self, done: int) -> bool:
        """Return whether there is a validation after so many steps."""
        every = self.cfg.validate_every_steps or self.steps.steps_per_epoch
        return done == self.steps.num_steps or done % every == 0

    def steps_from(self, first: int) -> Iterator[ReadyStep]:
        """Yield this process's rows of each step from one on, longest first."""
        lengths, ranks = self.census.tokens, self.ranks
        shares = (
            (step, self.census.indices[share_of(self.steps.samples_of(step), lengths, ranks.rank, ranks.size)].tolist())
            for step in range(first, self.steps.num_steps)
        )
        return self.supply.steps(self.samples, self.census.pictures_of, shares)


@contextlib.contextmanager
def seeded(student: Student, seed: int, item_id: str) -> Iterator[None]:
    """Let torch's generators start from (seed, item), and be as before after it."""
    import torch

    devices = [torch.cuda.current_device()] if student.device == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(int(rng_for(seed, STAGE, item_id).integers(2**31)))
        yield


def make_optimizer(student: Student, cfg: TrainConfig) -> Any:
    """Make AdamW of the weights that learn."""
    import torch

    parameters = list(learning_weights(student).values())
    is_fused = student.device == "cuda"
    return torch.optim.AdamW(parameters, lr=cfg.learning_rate, weight_decay=cfg.weight_decay, fused=is_fused)


def train_step(lesson: Lesson, optimizer: Any, ready: ReadyStep, rate: float) -> dict[str, Any]:
    """Take one optimizer step over what all processes have ready, `batch_size` samples at a time.

    Returns:
        loss (nats an answer token, weighted), gradient_norm, answer_tokens, tokens, samples: of all processes.
    """
    import torch

    cfg, student, rows = lesson.cfg, lesson.student, ready.rows
    student.model.train()
    parameters = list(learning_weights(student).values())
    own_nats = 0.0
    for start in range(0, len(rows), cfg.batch_size):
        batch = rows[start : start + cfg.batch_size]
        features = lesson.supply.features.of([picture for row in batch for picture in row.pictures])
        nats, _ = answer_loss(student, [row.encoded for row in batch], features, LOGIT_CHUNK)
        nats.backward()
        own_nats += float(nats.detach())
    encoded = [row.encoded for row in rows]
    weights, answers = sum(float(row.weights.sum()) for row in encoded), sum(len(row.answer_ids) for row in encoded)
    own = weights, answers, sum(map(len, encoded)), len(rows)
    lesson.ranks.add_gradients(parameters)
    total, weight, answer_tokens, tokens, samples = lesson.ranks.total([own_nats, *map(float, own)])
    if not weight:
        raise InputError("no sample of a step can be read", where=STAGE, fix="restore the pictures that the log names")
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad /= weight
    norm = float(torch.nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT_NORM))
    if not math.isfinite(total) or not math.isfinite(norm):
        words, got = "the loss or its gradient is not finite", f"{cfg.learning_rate}"
        fix = "lower learning_rate and choose another --out; the last checkpoint is still usable"
        raise ConfigError(words, where="learning_rate", got=got, fix=fix)
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    counts = {"answer_tokens": answer_tokens, "tokens": tokens, "samples": samples}
    return {"loss": total / weight, "gradient_norm": norm, **{name: int(count) for name, count in counts.items()}}


def fit(lesson: Lesson, out: Path, track: Track = lambda record: None) -> Progress:
    """Train, from the newest checkpoint of `out` if there is one, and leave the student with the weights that are the
    product.

    Writes `log.jsonl` and `checkpoints/` in `out`; `track` is given each record of the log.
    """
    ranks, cfg, folder = lesson.ranks, lesson.cfg, out / CHECKPOINTS
    optimizer = make_optimizer(lesson.student, cfg)
    newest = ranks.first_does(lambda: newest_checkpoint(folder))
    progress = load_checkpoint(newest, lesson.student, optimizer) if newest else Progress()
    if progress.step:
        log.info("%s: resumed after step %d of %d", STAGE, progress.step, lesson.steps.num_steps)
    ranks.first_does(partial(cut_log, out / LOG, progress.step if newest else -1))
    with _notebook(out / LOG if ranks.is_first else None, track) as note:
        if newest is None and (found := lesson.validate()) is not None:
            note({"step": 0, "validation": found.model_dump()})
            log.info("%s: before the first step: %s", STAGE, found)
        if not progress.has_ended:
            progress = _run_steps(lesson, optimizer, progress, out, note)
    # Once more: a kill may have come between the last checkpoint and the end of those before it.
    ranks.first_does(partial(drop_old_checkpoints, folder, cfg.keep_checkpoints, progress.best_step))
    best = checkpoint_path(folder, progress.best_step)
    if cfg.keep == "best" and progress.best_step not in (0, progress.step):
        ranks.first_does(partial(check_whole, best))
        load_checkpoint(best, lesson.student)
        log.info("%s: the weights after step %d, which have the best validation, are kept", STAGE, progress.best_step)
    return progress


def _run_steps(
    lesson: Lesson, optimizer: Any, progress: Progress, out: Path, note: Callable[[dict[str, Any]], None]
) -> Progress:
    cfg, ranks, num_steps, folder = lesson.cfg, lesson.ranks, lesson.steps.num_steps, out / CHECKPOINTS
    begun_s, first = time.monotonic(), progress.step
    step_begun_s = begun_s
    with progress_bar(STAGE, total=num_steps, done=first) as advance:
        for ready in lesson.steps_from(first):
            step, rate = ready.step, learning_rate_at(cfg, ready.step, num_steps)
            with seeded(lesson.student, lesson.seed, f"step_{step}_{ranks.rank}"):
                facts = train_step(lesson, optimizer, ready, rate)
            done, now_s = step + 1, time.monotonic()
            speed = _speed(lesson, facts, now_s - step_begun_s, (now_s - begun_s) / (done - first) * (num_steps - done))
            record = {"step": done, "epoch": step // lesson.steps.steps_per_epoch, "learning_rate": rate, **facts}
            note({**record, "speed": speed})
            left_out = {key: why for part in ranks.gathered(ready.left_out) for key, why in part.items()}
            for key in left_out.keys() - progress.unreadable.keys():
                log.warning("the sample %s is skipped: %s", key, left_out[key])
            progress = progress.model_copy(update={"step": done, "unreadable": progress.unreadable | left_out})
            is_asked = lesson.is_validated(done)
            if is_asked and (found := lesson.validate()) is not None:
                note({"step": done, "validation": found.model_dump()})
                progress = judged(progress, found, cfg)
                log.info("%s: after step %d: %s", STAGE, done, found)
            is_last = done == num_steps or progress.has_ended
            if is_last or is_asked or done % cfg.save_every_steps == 0:
                ranks.first_does(partial(_save, lesson.student, optimizer, progress, folder, cfg))
            advance(1, f"loss {facts['loss']:.4f}, {speed['tokens_per_s']:.0f} tokens/s, {speed['memory_gb']:.1f} GB")
            if is_last:
                break
            step_begun_s = time.monotonic()
    return progress


def judged(progress: Progress, found: Validation, cfg: TrainConfig) -> Progress:
    """Take a validation into account: is it the best, and has there been none better for too long."""
    score, stale = found.score(), progress.stale + 1
    if progress.best_score is None or score > progress.best_score:
        return progress.model_copy(update={"best_step": progress.step, "best_score": score, "stale": 0})
    has_ended = bool(cfg.patience) and stale >= cfg.patience
    if has_ended:
        log.info(
            "%s: training ends, because %d validations are not better than the one after step %d",
            STAGE,
            stale,
            progress.best_step,
        )
    return progress.model_copy(update={"stale": stale, "has_ended": has_ended})


def _save(student: Student, optimizer: Any, progress: Progress, folder: Path, cfg: TrainConfig) -> None:
    save_checkpoint(checkpoint_path(folder, progress.step), student, optimizer, progress)
    drop_old_checkpoints(folder, cfg.keep_checkpoints, progress.best_step)


def _speed(lesson: Lesson, facts: dict[str, Any], seconds: float, left_s: float) -> dict[str, float]:
    """Return what a step took: seconds with the wait for its data, rates over all processes, memory of this one."""
    seconds = max(seconds, 1e-9)
    return {
        "seconds": round(seconds, 4),
        "waited_share": round(min(1.0, lesson.supply.waited_s / seconds), 4),
        "tokens_per_s": round(facts["tokens"] / seconds, 1),
        "samples_per_s": round(facts["samples"] / seconds, 3),
        "memory_gb": round(used_gb(lesson.student.device), 3),
        "left_s": round(left_s, 1),
    }


@contextlib.contextmanager
def _notebook(path: Path | None, track: Track) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Return a function that appends a record to the log; None: it keeps nothing, as in all processes but the first."""
    if path is None:
        yield lambda record: None
        return
    with storage_errors(path), open(path, "a", encoding="utf-8") as file:

        def note(record: dict[str, Any]) -> None:
            file.write(dump_json(record) + "\n")
            file.flush()
            track(record)

        yield note
