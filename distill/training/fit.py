"""The training loop: steps, validations, checkpoints, and their log.

Every random choice derives from (seed, epoch) or (seed, step, process), so a training that was killed and resumed takes
the same steps as one that was not; a checkpoint needs no generator state.
"""

import contextlib
import logging
import math
import os
import resource
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import ConfigError, InputError, ResumeError
from cosfly.runtime.io import sha256_bytes, storage_errors
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import LEFT_TO_THE_PARENT
from distill.student.model import Student
from distill.training.checkpoints import (
    Progress,
    checkpoint_path,
    cut_log,
    drop_old_checkpoints,
    learning_weights,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from distill.training.loading import TrainingContext, TrainingSample
from distill.training.loss import answer_loss
from distill.training.settings import STAGE, TrainConfig

log = logging.getLogger(__name__)

LOG, CHECKPOINTS = "log.jsonl", "checkpoints"
LOGIT_CHUNK = 512  # answer tokens whose logits exist at a time
MAX_GRADIENT_NORM = 1.0  # gradients are scaled down to this norm
WARMUP_FRACTION = 0.03  # share of the steps with a rising learning rate
SAVE_EVERY_S = 600.0  # most time between checkpoints, for steps that take minutes
STOPPING = b"\ndistill.train: saves a checkpoint after this step, then ends; a second signal ends it at once\n"
Note = Callable[[dict[str, Any]], None]


def count_steps(cfg: TrainConfig, num_samples: int) -> tuple[int, int]:
    """Return the number of steps, and of those of an epoch."""
    per_epoch = math.ceil(num_samples / cfg.samples_per_step)
    return min(cfg.epochs * per_epoch, cfg.max_steps or cfg.epochs * per_epoch), per_epoch


def steps_from(cfg: TrainConfig, num_samples: int, seed: int, first: int) -> Iterator[list[int]]:
    """Yield the sample indices of each step from one on: an epoch is a permutation, cut into steps."""
    size = cfg.samples_per_step
    num_steps, per_epoch = count_steps(cfg, num_samples)
    for epoch in range(first // per_epoch, cfg.epochs):
        order = rng_for(seed, STAGE, f"epoch_{epoch}").permutation(num_samples).tolist()
        for step in range(max(first, epoch * per_epoch), min(num_steps, (epoch + 1) * per_epoch)):
            start = step % per_epoch * size
            yield order[start : start + size]


def share_of(chosen: Sequence[int], lengths: np.ndarray, rank: int, num_ranks: int) -> list[int]:
    """Return a process's samples of a step, longest first: they are dealt out by their `lengths`, (n,) tokens of every
    sample, so that all processes have about the same to do."""
    return sorted(chosen, key=lambda index: (-int(lengths[index]), index))[rank::num_ranks]


def learning_rate_at(cfg: TrainConfig, step: int, num_steps: int) -> float:
    """Return the learning rate of a step: a linear rise, then a half cosine to zero."""
    warmup = math.ceil(WARMUP_FRACTION * num_steps)
    if step < warmup:
        return cfg.learning_rate * (step + 1) / warmup
    share = (step - warmup) / max(1, num_steps - warmup)
    return cfg.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))


@contextlib.contextmanager
def first_signal() -> Iterator[list[int]]:
    """Collect the first Ctrl-C or SIGTERM instead of raising its exception; a second one is handled as before."""
    received = list[int]()

    def receive(number: int, _: object) -> None:
        handlers.close()
        received.append(number)
        os.write(2, STOPPING)

    with contextlib.ExitStack() as handlers:
        if threading.current_thread() is threading.main_thread():
            for number in LEFT_TO_THE_PARENT:
                handlers.callback(signal.signal, number, signal.signal(number, receive))
        yield received


@contextlib.contextmanager
def seeded(student: Student, seed: int, item_id: str) -> Iterator[None]:
    """Set torch's generators from (seed, item), and restore them afterwards."""
    import torch

    devices = [torch.cuda.current_device()] if student.device == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(int(rng_for(seed, STAGE, item_id).integers(2**31)))
        yield


def make_optimizer(student: Student, cfg: TrainConfig) -> Any:
    """Make AdamW of the weights that learn."""
    import torch

    settings: Any = {"lr": cfg.learning_rate, "weight_decay": 0.0, "fused": student.device == "cuda"}
    return torch.optim.AdamW(learning_weights(student).values(), **settings)


def add_gradients(parameters: Sequence[Any], accelerator: Any) -> None:
    """Add up the gradients of all processes, of which some may have no sample in the step."""
    if accelerator.num_processes > 1:
        for parameter in parameters:
            gradient = parameter.new_zeros(parameter.shape) if parameter.grad is None else parameter.grad
            parameter.grad = accelerator.reduce(gradient, "sum")


def train_step(
    context: TrainingContext, optimizer: Any, chosen: Sequence[TrainingSample], rate: float
) -> dict[str, Any]:
    """Take one optimizer step over the samples of all processes, `batch_size` samples at a time.

    Returns:
        Facts of all processes: loss (weighted nats per answer token), gradient_norm, answer_tokens, tokens, samples.
    """
    import torch

    cfg, student = context.cfg, context.student
    student.model.train()
    parameters = list(learning_weights(student).values())
    nats = 0.0
    for start in range(0, len(chosen), cfg.batch_size):
        batch = chosen[start : start + cfg.batch_size]
        loss = answer_loss(student, [sample.row for sample in batch], context.features_of(batch), LOGIT_CHUNK)
        loss.backward()
        nats += float(loss.detach())
    add_gradients(parameters, context.accelerator)
    rows = [sample.row for sample in chosen]
    weight, num_answer_tokens = sum(row.weight for row in rows), sum(len(row.answer_ids) for row in rows)
    of_this_process = [nats, weight, num_answer_tokens, sum(map(len, rows)), len(rows)]
    nats, weight, *counts = context.total([float(value) for value in of_this_process])
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad /= weight
    norm = float(torch.nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT_NORM))
    if not math.isfinite(nats) or not math.isfinite(norm):
        words, got = "the loss or the gradient became infinite or NaN", f"{cfg.learning_rate}"
        fix = "lower learning_rate and choose another --out; the last checkpoint is still usable"
        raise ConfigError(words, where="learning_rate", got=got, fix=fix)
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    answer_tokens, tokens, samples = map(int, counts)
    facts = {"answer_tokens": answer_tokens, "tokens": tokens, "samples": samples}
    return {"loss": nats / weight, "gradient_norm": norm, **facts}


def fit(context: TrainingContext, out: Path) -> Progress:
    """Train, from the newest checkpoint of `out` if there is one; leave the student with the weights of the product.

    Writes `log.jsonl` and `checkpoints/` in `out`.
    """
    from accelerate.utils import gather_object

    student, cfg, accelerator = context.student, context.cfg, context.accelerator
    folder = out / CHECKPOINTS
    indices = [[sample.sample_index for sample in split.used] for split in (context.train, context.val)]
    used_digest = sha256_bytes(dump_json(indices).encode())  # the order of the steps depends on the samples used
    if len(set(gather_object([used_digest]))) > 1:
        fix = "check that all processes can read the same pictures, then run the same command again"
        raise InputError("the processes of this training find different samples", where=STAGE, fix=fix)
    optimizer = make_optimizer(student, cfg)
    newest = newest_checkpoint(folder)
    progress = load_checkpoint(newest, student, optimizer) if newest else Progress(samples=used_digest)
    if progress.samples != used_digest:
        fix = "restore the pictures as they were, or choose another --out"
        raise ResumeError("the usable samples have changed since the training began", where=out, fix=fix)
    if accelerator.is_main_process:
        cut_log(out / LOG, progress.step if newest else -1)
    note = partial(_note, context, out / LOG)
    if newest is None:
        validate(context, progress, note)
    if not progress.has_ended:
        progress = _take_steps(context, optimizer, progress, folder, note)
    if accelerator.is_main_process:  # again, because a kill may have come in the middle of it
        drop_old_checkpoints(folder, progress, cfg.keep_checkpoints)
    accelerator.wait_for_everyone()
    if cfg.keep == "best" and progress.best_step not in (0, progress.step):
        load_checkpoint(checkpoint_path(folder, progress.best_step), student)
        log.info("%s: the weights after step %d, which have the best validation, are kept", STAGE, progress.best_step)
    return progress


def _take_steps(context: TrainingContext, optimizer: Any, progress: Progress, folder: Path, note: Note) -> Progress:
    """Take the steps after those of `progress`, with validations and checkpoints; return the progress at the end."""
    cfg, accelerator, lengths = context.cfg, context.accelerator, context.train.lengths
    rank, num_ranks = accelerator.process_index, accelerator.num_processes
    num_steps, per_epoch = count_steps(cfg, len(lengths))
    first = progress.step
    words = f"{'resumes' if first else 'begins'} with step %d of %d, %d samples each; %d steps are one pass over them"
    log.info(f"%s: {words}", STAGE, first + 1, num_steps, cfg.samples_per_step, per_epoch)
    start_s = time.monotonic()
    step_start_s = saved_s = start_s
    with progress_bar(STAGE, total=num_steps, done=first) as advance, first_signal() as received:
        for step, indices in enumerate(steps_from(cfg, len(lengths), context.seed, first), first):
            chosen = [context.train.used[i] for i in share_of(indices, lengths, rank, num_ranks)]
            rate = learning_rate_at(cfg, step, num_steps)
            with seeded(context.student, context.seed, f"step_{step}_{rank}"):
                facts = train_step(context, optimizer, chosen, rate)
            done, now_s = step + 1, time.monotonic()
            seconds = max(now_s - step_start_s, 1e-9)
            speed = {
                "seconds": round(seconds, 4), "tokens_per_s": round(facts["tokens"] / seconds, 1),
                "memory_gb": round(used_gb(context.student.device), 3),
                "left_s": round((now_s - start_s) / (done - first) * (num_steps - done), 1),
            }  # fmt: skip
            record = {"step": done, "epoch": step // per_epoch, "learning_rate": rate}
            note({**record, **facts, "speed": speed})
            progress = progress.model_copy(update={"step": done})
            is_validated = done == num_steps or done % (cfg.validate_every_steps or per_epoch) == 0
            if is_validated:
                progress = validate(context, progress, note)
            is_last = done == num_steps or progress.has_ended
            is_stopped = context.total([len(received)]) != [0.0]  # all processes take the same steps
            is_due = done % cfg.save_every_steps == 0 or now_s - saved_s > SAVE_EVERY_S
            if accelerator.is_main_process and (is_last or is_validated or is_stopped or is_due):
                save_checkpoint(folder, context.student, optimizer, progress)
                drop_old_checkpoints(folder, progress, cfg.keep_checkpoints)
                saved_s = now_s
            advance(1, f"loss {facts['loss']:.4f}, {speed['tokens_per_s']:.0f} tokens/s, {speed['memory_gb']:.1f} GB")
            if is_stopped and not is_last:
                log.info("%s: stopped after step %d, with a checkpoint", STAGE, done)
                raise KeyboardInterrupt if signal.SIGINT in received else SystemExit(128 + signal.SIGTERM)
            if is_last:
                log.info("%s: the last step, %d of %d, has loss %.4f", STAGE, done, num_steps, facts["loss"])
                break
            step_start_s = time.monotonic()
    return progress


def validate(context: TrainingContext, progress: Progress, note: Note) -> Progress:
    """Measure the loss on the samples of val, each process on its share; return the progress with the result."""
    import torch

    cfg, split, accelerator = context.cfg, context.val, context.accelerator
    if not split.used:
        return progress
    # By length, so that little is padded, and dealt out so that all processes have about the same to do.
    order = share_of(range(len(split.used)), split.lengths, accelerator.process_index, accelerator.num_processes)
    nats, weight = 0.0, 0.0
    context.student.model.eval()
    with torch.no_grad(), progress_bar(f"{STAGE}: validation", total=len(order)) as advance:
        for start in range(0, len(order), cfg.batch_size):
            batch = [split.used[i] for i in order[start : start + cfg.batch_size]]
            rows = [sample.row for sample in batch]
            nats += float(answer_loss(context.student, rows, context.features_of(batch), LOGIT_CHUNK))
            weight += sum(row.weight for row in rows)
            advance(len(batch))
    nats, weight = context.total([nats, weight])
    note({"step": progress.step, "validation": {"samples": len(split.used), "loss": nats / weight}})
    log.info("%s: after step %d: validation loss %.4f", STAGE, progress.step, nats / weight)
    return judged(progress, nats / weight, cfg) if progress.step else progress


def judged(progress: Progress, loss: float, cfg: TrainConfig) -> Progress:
    """Return the progress after a validation: the best step has the lowest loss; `patience` may end the training."""
    if progress.best_loss is None or loss < progress.best_loss:
        return progress.model_copy(update={"best_step": progress.step, "best_loss": loss, "stale": 0})
    stale = progress.stale + 1
    has_ended = bool(cfg.patience) and stale >= cfg.patience
    if has_ended:
        log.info("%s: ends, because %d validations are not better than the best one", STAGE, stale)
    return progress.model_copy(update={"stale": stale, "has_ended": has_ended})


def used_gb(device: str) -> float:
    """Return the most memory used so far: of the accelerator, or of this process."""
    import torch

    if device == "cuda":
        return torch.cuda.max_memory_allocated() / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def _note(context: TrainingContext, path: Path, record: dict[str, Any]) -> None:
    """Append a record to the log, and send its numbers to the loggers of `report_to`."""
    if not context.accelerator.is_main_process:
        return
    with storage_errors(path), open(path, "a", encoding="utf-8") as file:
        file.write(dump_json(record) + "\n")
    numbers: dict[str, Any] = {}  # flat: {"speed": {"seconds": 1}} becomes {"speed/seconds": 1}
    for name, value in record.items():
        if isinstance(value, dict):
            numbers |= {f"{name}/{inner}": number for inner, number in value.items()}
        elif name != "step":
            numbers[name] = value
    context.accelerator.log(numbers, step=record["step"])
