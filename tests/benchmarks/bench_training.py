"""How fast a student of Qwen3.5's 2 B shape is trained, and in how much memory, with random weights and made-up
samples.

    P=tests/benchmarks/bench_training.py
    python $P --shape 2b --batch 16              on an accelerator
    python $P --batch 2 --steps 3                on a CPU: a tiny shape, to see that it runs
    torchrun --nproc-per-node 4 $P --shape 2b --batch 64 --micro 16
    python $P --shape smollm2 --batch 64 --micro 32              SmolLM2-135M, text alone; `--plain` is the same with
                                                                 plain transformers and peft

Steps are the project's own: features of pictures kept, logits for a few answer tokens at a time, rows by
length. Pictures are noise in memory: reading them is not measured. The first steps compile kernels and are not counted.
"""

import argparse
import json
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from peft import LoraConfig, get_peft_model

from cosfly.viz.frame_views import Pictures
from distill.student.chat import EncodedSample, padded
from distill.student.features import FramePicture, Tensors, encode
from distill.student.model import Student, compute_dtype, pick_device
from distill.student.qwen3_5 import choose_kernels, fuse_norms
from distill.training.fit import add_gradients, make_optimizer, used_gb
from distill.training.loss import answer_loss
from distill.training.settings import TrainConfig
from distill.training.stage import add_adapter, target_modules

SHAPES: dict[str, dict[str, Any]] = {
    "2b": {
        "hidden_size": 2048, "num_hidden_layers": 24, "num_attention_heads": 8, "num_key_value_heads": 2,
        "head_dim": 256, "linear_num_key_heads": 16, "linear_num_value_heads": 16, "linear_key_head_dim": 128,
        "linear_value_head_dim": 128, "intermediate_size": 6144, "vocab_size": 248_320,
    },
    "smollm2": {
        "hidden_size": 576, "num_hidden_layers": 30, "num_attention_heads": 9, "num_key_value_heads": 3, "head_dim": 64,
        "intermediate_size": 1536, "vocab_size": 49_152, "max_position_embeddings": 8192,
    },
    "tiny": {
        "hidden_size": 64, "num_hidden_layers": 4, "num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 16,
        "linear_num_key_heads": 2, "linear_num_value_heads": 4, "linear_key_head_dim": 16,
        "linear_value_head_dim": 16, "intermediate_size": 128, "vocab_size": 5000,
    },
}  # fmt: skip
TOWERS = {"2b": (1024, 24, 4096), "tiny": (32, 2, 64)}  # width, layers, MLP
SIZES_PX = {"2b": (640, 352), "tiny": (64, 64)}
WORDS = {"2b": (660, 250), "tiny": (80, 40), "smollm2": (1120, 250)}  # of prompt and answer
PICTURES = 5
IMAGE, END, PAD, FIRST_WORD = 3, 1, 0, 10  # token numbers of the made-up vocabulary
WARM_UP = 3
ANSWER_TOKENS = 512  # whose logits exist at a time
NUMBERS = SimpleNamespace(pad_token_id=PAD)  # stands where a tokenizer stands; texts are numbers from the start


class MadeUp(Student):
    """A student of made-up tokens: it has a model, and neither a tokenizer nor a processor."""

    end_token_id, kinds_name = END, "mm_token_type_ids"


def make_student(shape: str, device: str, dtype: Any, seed: int = 0) -> Student:
    choose_kernels(dtype, device)
    if shape not in TOWERS:
        return make_text_student(shape, device, dtype, seed)
    from transformers import Qwen3_5Config, Qwen3_5ForConditionalGeneration

    sizes, (width, depth, inner) = SHAPES[shape], TOWERS[shape]
    head = sizes["head_dim"]
    rope = {
        "rope_type": "default", "rope_theta": 1e7, "partial_rotary_factor": 0.25 if head > 16 else 0.5,
        "mrope_section": [11, 11, 10] if head == 256 else [4, 0, 0], "mrope_interleaved": True,
    }  # fmt: skip
    text = sizes | {
        "layer_types": (["linear_attention"] * 3 + ["full_attention"]) * (sizes["num_hidden_layers"] // 4),
        "tie_word_embeddings": True, "eos_token_id": END, "pad_token_id": PAD, "rope_parameters": rope,
    }  # fmt: skip
    vision = {"depth": depth, "hidden_size": width, "intermediate_size": inner, "num_heads": max(2, width // 64)}
    config = Qwen3_5Config(
        text_config=text, vision_config=vision | {"out_hidden_size": sizes["hidden_size"]}, image_token_id=IMAGE,
        video_token_id=4, vision_start_token_id=5, vision_end_token_id=6, tie_word_embeddings=True,
    )  # fmt: skip
    torch.manual_seed(seed)
    with torch.device(device):
        model = Qwen3_5ForConditionalGeneration(config).to(dtype)
    return MadeUp(NUMBERS, "made up", model=model, device=device, dtype=dtype)


def make_text_student(shape: str, device: str, dtype: Any, seed: int) -> Student:
    from transformers import LlamaConfig, LlamaForCausalLM

    ends: Any = {"eos_token_id": END, "pad_token_id": PAD, "bos_token_id": END}
    torch.manual_seed(seed)
    with torch.device(device):
        model = LlamaForCausalLM(LlamaConfig(**SHAPES[shape], **ends, tie_word_embeddings=True)).to(dtype)
    return MadeUp(NUMBERS, None, model=model, device=device, dtype=dtype)


def make_rows(shape: str, count: int, seed: int) -> list[tuple[EncodedSample, list[FramePicture]]]:
    rng, size_px, vocabulary = np.random.default_rng(seed), SIZES_PX.get(shape), SHAPES[shape]["vocab_size"]
    rows = []
    for number in range(count):
        prompt, answer = (int(length * rng.uniform(0.9, 1.1)) for length in WORDS[shape])
        pictures = [5, *[IMAGE] * (size_px[0] * size_px[1] // 1024), 6] * PICTURES if size_px else []
        ids = np.array(pictures + rng.integers(FIRST_WORD, vocabulary, prompt).tolist())
        answers = np.append(rng.integers(FIRST_WORD, vocabulary, answer), END)
        kinds = (ids == IMAGE).astype(np.int64)
        encoded = EncodedSample(ids, answers, np.ones(len(answers), np.float32), kinds)
        frames = [str(seed * count + number + i) for i in range(PICTURES)] if size_px else []
        rows.append((encoded, [FramePicture("run", frame, Pictures(("rgb",), size_px)) for frame in frames]))
    return rows


def noise_of(picture: FramePicture, dtype: Any) -> Tensors:
    width_px, height_px = picture.view.size_px
    values = np.random.default_rng(int(picture.frame)).standard_normal((height_px * width_px // 256, 1536), np.float32)
    grid = torch.tensor([[1, height_px // 16, width_px // 16]])
    return {"pixel_values": torch.from_numpy(values).to(dtype), "image_grid_thw": grid}


def plain_loss(student: Student, rows: list[EncodedSample], read: list[Tensors]) -> Any:
    """What plain transformers does: every token's logits, the tower in every step, a padding mask."""
    arrays = {name: array for name, array in padded(student, rows).items() if name != "weights"}
    lengths = np.array([[len(row)] for row in rows])
    arrays["attention_mask"] = (np.arange(arrays["input_ids"].shape[1]) < lengths).astype(np.int64)
    inputs = {name: torch.from_numpy(array).to(student.device) for name, array in arrays.items()}
    names = read[0] if read else ()
    pictures = {name: torch.cat([one[name] for one in read]).to(student.device) for name in names}
    count = sum(len(row.answer_ids) for row in rows)
    return student.model(**inputs, **pictures, use_cache=False).loss * count


def backward(student: Student, way: str, rows: list, features: dict[FramePicture, Tensors]) -> float:
    encoded, pictures = [row for row, _ in rows], [picture for _, found in rows for picture in found]
    if way == "plain":
        with student.computing():
            loss = plain_loss(student, encoded, [noise_of(picture, student.dtype) for picture in pictures])
    else:
        new = [picture for picture in dict.fromkeys(pictures) if picture not in features]
        with torch.no_grad():
            found = encode(student, [noise_of(picture, student.dtype) for picture in new])
        features |= {p: {n: t.cpu() for n, t in one.items()} for p, one in zip(new, found, strict=True)}
        loss = answer_loss(student, encoded, [features[picture] for picture in pictures], ANSWER_TOKENS)
    loss.backward()
    return float(loss.detach())


def measure(arguments: argparse.Namespace, accelerator: Accelerator, device: str) -> dict[str, Any]:
    shape, dtype = arguments.shape, compute_dtype("auto", device)
    cfg = TrainConfig(batch_size=arguments.micro or arguments.batch, samples_per_step=arguments.batch)
    student, way = make_student(shape, device, dtype), "plain" if arguments.plain else "ours"
    if arguments.plain:
        lora = LoraConfig(r=cfg.lora_rank, lora_alpha=32, target_modules=target_modules(student), task_type="CAUSAL_LM")
        student.model = get_peft_model(student.model, lora)
    else:
        student = add_adapter(student, cfg, 0)
        if shape in TOWERS:
            fuse_norms(student.core)
    for layer in student.core.get_decoder().layers if arguments.compile else ():
        layer.compile(dynamic=True)
    student.model.train()
    optimizer = make_optimizer(student, cfg)
    parameters = [p for p in student.model.parameters() if p.requires_grad]
    features: dict[FramePicture, Tensors] = {}
    seconds, tokens = 0.0, 0
    for step in range(WARM_UP + arguments.steps):
        rows = make_rows(shape, arguments.batch, 0 if arguments.same else step)
        rows = rows if arguments.plain else sorted(rows, key=lambda row: -len(row[0]))
        rows = rows[accelerator.process_index :: accelerator.num_processes]
        accelerator.wait_for_everyone()
        begun_s = time.perf_counter()
        for start in range(0, len(rows), cfg.batch_size):
            backward(student, way, rows[start : start + cfg.batch_size], features)
        add_gradients(parameters, accelerator)
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        if device == "cuda":
            torch.cuda.synchronize()
        if step >= WARM_UP:
            seconds += time.perf_counter() - begun_s
            tokens += sum(len(row) for row, _ in rows)
    all_tokens = float(accelerator.reduce(torch.tensor(float(tokens), device=device), "sum"))
    return {
        "shape": shape, "way": way, "parameters": sum(p.numel() for p in student.model.parameters()),
        "processes": accelerator.num_processes, "samples_per_step": arguments.batch, "batch_size": cfg.batch_size,
        "dtype": str(dtype), "step_s": round(seconds / arguments.steps, 4),
        "tokens_per_s": round(all_tokens / seconds, 1), "memory_gb": round(used_gb(device), 2),
        "pictures_encoded": len(features),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shape", choices=SHAPES, default="tiny")
    parser.add_argument("--batch", type=int, default=4, help="samples of a step, over all processes")
    parser.add_argument("--micro", type=int, default=0, help="samples of a forward pass; 0: all of the step")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--same", action="store_true", help="the same samples in every step: all features are kept")
    parser.add_argument("--plain", action="store_true", help="plain transformers and peft, for comparison")
    parser.add_argument("--compile", action="store_true", help="compile the layers of the language model")
    arguments = parser.parse_args()
    device = pick_device("auto")
    accelerator = Accelerator(cpu=device == "cpu")
    found = measure(arguments, accelerator, device)
    if accelerator.is_main_process:
        print(json.dumps(found))
    accelerator.end_training()


if __name__ == "__main__":
    main()
