"""How fast a student of Qwen3.5's 2 B shape answers, with random weights and made-up samples, beside plain `generate`.

    python tests/benchmarks/bench_decoding.py --shape 2b --batch 16 64 128       on an accelerator python
    tests/benchmarks/bench_decoding.py                                    on a CPU: a tiny shape, to see that it runs
    python tests/benchmarks/bench_decoding.py --check                            tokens against `generate`, in float32
    python tests/benchmarks/bench_decoding.py --check --dtype bfloat16           recorded steps against plain ones

Pictures are noise in memory; what reading takes, and what frames that several samples share save, tells `cosfly distill
infer` on a playback tree (`speed` in its manifest). Ways: generate (the library's), decode (ours, looking at the
pictures), features (ours, the pictures looked at before), plain (the same, no step recorded; on a CPU none is).
flash-linear-attention does not compute in float32: `--check` has PyTorch's own functions do it.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import scenes
import torch
from bench_training import END, PAD, SHAPES, Words, make_rows, make_student, noise_of

from distill.student.decoding import decode
from distill.student.encoding import EncodedSample, prompt_batch
from distill.student.kernels import fuse_norms
from distill.student.model import Student, compute_dtype


class Numbers(Words):
    """Texts of tokens are their numbers."""

    def decode(self, ids: list[int], **_: Any) -> str:
        return " ".join(map(str, ids))


@dataclass(frozen=True)
class Batch:
    """Prompts, and the patches of their pictures, prompt by prompt."""

    rows: list[EncodedSample]
    patches: list[Any]

    def look(self, student: Student) -> Any:
        """What the tower makes of the pictures, one prompt after the other: all at once would be the most memory of
        all."""
        seen = []
        with torch.inference_mode():
            for row, patches in zip(self.rows, self.patches, strict=True):
                grids = torch.from_numpy(row.image_grids).to(student.device)
                given = patches.to(student.device, student.dtype)
                seen += student.core.model.get_image_features(given, grids).pooler_output
        return torch.cat(seen)


def make_batch(shape: str, count: int) -> Batch:
    rows = make_rows(shape, count, seed=1)
    noise = [torch.cat([noise_of(picture, torch.float32).patches for picture in pictures]) for _, pictures in rows]
    return Batch([row for row, _ in rows], noise)


def generate(student: Student, batch: Batch, num_tokens: int) -> list[str]:
    inputs = prompt_batch(student, batch.rows)
    inputs["pixel_values"] = torch.cat(batch.patches).to(student.device, student.dtype)
    with torch.inference_mode():
        output = student.model.generate(
            **inputs, max_new_tokens=num_tokens, do_sample=False, eos_token_id=END, pad_token_id=PAD
        )
    answers = output[:, inputs["input_ids"].shape[1] :].tolist()
    return [student.tokenizer.decode(ids[: ids.index(END)] if END in ids else ids) for ids in answers]


def seconds(work: Callable[[], Any], device: str, repeats: int) -> float:
    """Time a call, on a CPU in processor time: the shortest of several, after one that is not counted."""
    clock = time.perf_counter if device == "cuda" else time.process_time
    work()
    times = []
    for _ in range(repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        begin = clock()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(clock() - begin)
    return min(times)


def measure(student: Student, shape: str, count: int, options: argparse.Namespace) -> list[list[Any]]:
    batch = make_batch(shape, count)
    rows, features = batch.rows, batch.look(student)
    ways: dict[str, Callable[[int], Any]] = {
        "generate": lambda tokens: generate(student, batch, tokens),
        "decode": lambda tokens: decode(student, rows, batch.look(student), max_tokens=tokens),
        "features": lambda tokens: decode(student, rows, features, max_tokens=tokens),
        "plain": lambda tokens: decode(student, rows, features, max_tokens=tokens, is_recorded=False),
    }
    table = []
    for name in options.ways:
        if student.device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        first_s = seconds(lambda way=ways[name]: way(1), student.device, options.repeats)
        all_s = seconds(lambda way=ways[name]: way(options.tokens), student.device, options.repeats)
        peak = torch.cuda.max_memory_allocated() / 2**30 if student.device == "cuda" else float("nan")
        step_ms = 1e3 * (all_s - first_s) / max(1, options.tokens - 1)
        table.append([name, count, first_s, step_ms, count / all_s, count * options.tokens / all_s, peak])
    return table


def check(student: Student, shape: str, count: int, num_tokens: int) -> None:
    """Say how far the answers of all ways agree. In float32 they must.

    In bfloat16 a matrix product that is recorded may add in another order, and of random weights the two best tokens
    are often one rounding apart, after which answers go their own ways: how long they agree is told, no more.
    """
    batch = make_batch(shape, count)
    features = batch.look(student)

    def answers(given: Any, is_recorded: bool = True) -> list[str]:
        found = decode(student, batch.rows, given, max_tokens=num_tokens, is_recorded=is_recorded)
        return [answer.text for answer in found]

    plain = answers(features, is_recorded=False)
    expected, whose = plain, "plain steps"
    if student.dtype == torch.float32:
        expected, whose = generate(student, batch, num_tokens), "generate"
    ways = {"plain": answers(features, is_recorded=False), "features": answers(features)}
    ways["decode"] = answers(batch.look(student))
    for name, found in ways.items():
        pairs = [(a.split(), b.split()) for a, b in zip(found, expected, strict=True)]
        num_equal = sum(a == b for a, b in pairs)
        agreed = sum(len(list(takewhile(lambda two: two[0] == two[1], zip(a, b, strict=False)))) for a, b in pairs)
        print(
            f"{name}: {num_equal} of {count} answers of {num_tokens} tokens are those of {whose}; "
            f"they agree for {agreed / count:.1f} tokens",
            flush=True,
        )
    assert student.dtype != torch.float32 or all(found == expected for found in ways.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shape", choices=list(SHAPES), default="tiny")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--tokens", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--ways", nargs="+", default=["generate", "decode", "features", "plain"])
    parser.add_argument("--check", action="store_true", help="compare tokens instead of measuring")
    parser.add_argument("--dtype", choices=("auto", "float32", "bfloat16"), default="auto")
    options = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    scenes.one_thread_and_machine()
    dtype = compute_dtype("float32" if options.check and options.dtype == "auto" else options.dtype, device)
    student = make_student(options.shape, device, dtype)
    if device == "cuda" and not options.check:
        fuse_norms(student.core)
    student.tokenizer = Numbers()
    student.model.eval()
    if options.check:
        check(student, options.shape, max(options.batch), options.tokens)
        return
    table = [row for count in options.batch for row in measure(student, options.shape, count, options)]
    names = ["way", "batch", "first token, s", "ms a step", "answers/s", "tokens/s", "peak GiB"]
    scenes.print_table(f"{options.shape}, {options.tokens} tokens, {device}, {dtype}", names, table)


if __name__ == "__main__":
    main()
