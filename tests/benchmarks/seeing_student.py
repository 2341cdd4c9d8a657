r"""A student that sees, of real parts: SmolLM2-135M as the language model of transformers' SmolVLM class, with a small
vision tower that is trained here to find the person in the frames of a run.

    python tests/benchmarks/seeing_student.py --language SmolLM2-135M-Instruct.Q4_1.gguf --without old_town market \
        --epochs 14 --out work/seeing runs/diverse/*/render
    cosfly distill prepare runs/diverse --out work/set-pictures --limit 17000 --set 'distill.prepare.languages=[en]' \
        --set distill.prepare.text_state=false --set distill.prepare.split_by=town \
        --set distill.prepare.test_fraction=0.2 --set distill.prepare.val_fraction=0
    trees=$(printf -- '--data %s ' runs/diverse/*/render)
    cosfly distill train --dataset work/set-pictures $trees --student work/seeing --out work/train-see \
        --set distill.train.method=full --set distill.train.train_vision=true --set distill.train.learning_rate=3e-4 \
        --set distill.train.max_steps=200 --set distill.train.samples_per_step=32 --set distill.train.batch_size=16 \
        --set distill.train.keep=last --set distill.train.validation_samples=0
    cosfly distill infer --dataset work/set-pictures $trees --out work/infer-see --model work/train-see/model \
        --set distill.infer.max_samples=400 --set distill.infer.batch_size=256

No package of the index has a vision tower for a vision-language model, and captions of a few towns do not teach one.
The tower learns which patch shows the target, and how far away it is. The share of frames whose patch it finds is
printed for the towns of the training and for those of --without. `cosfly distill train` then teaches the whole model.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scenes  # noqa: F401  # finds the specimens
import torch
from specimens_families import CHATML
from torch.nn import functional
from transformers import (
    AutoModelForCausalLM,
    AutoTokenizer,
    PreTrainedTokenizerFast,
    SmolVLMConfig,
    SmolVLMForConditionalGeneration,
)
from transformers.models.smolvlm.image_processing_pil_smolvlm import SmolVLMImageProcessorPil

from cosfly.formats.frames import FILE_NAMES, frame_name
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks

SIDE_PX, PATCH_PX, SCALE = 256, 16, 4  # pictures are squeezed into a square; SCALE x SCALE patches become a token
GRID = SIDE_PX // PATCH_PX
VISION = {"hidden_size": 384, "intermediate_size": 1536, "num_hidden_layers": 8, "num_attention_heads": 6,
    "image_size": SIDE_PX, "patch_size": PATCH_PX}  # fmt: skip
IMAGE, FAKE, GLOBAL, END = "<image>", "<fake_token_around_image>", "<global-img>", "<|im_end|>"
TEMPLATE = CHATML.replace("IMAGE", "{{ '<image>' }}")
FAR_M = 100.0


def frames_of(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the pictures of a track, (n, SIDE_PX, SIDE_PX, 3) uint8, and (n, 2): patch of the target, distance in m.

    The patch is GRID * GRID where the target is not to be seen.
    """
    track = read_track(folder)
    pictures, wanted = [], []
    for index in range(len(track)):
        path = folder / frame_name(index) / FILE_NAMES["rgb"]
        if not path.is_file():
            continue
        picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        pictures.append(cv2.resize(picture, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA))
        u, v = track.target.uv[index] / [track.camera.width_px, track.camera.height_px]
        is_seen = bool(track.target.visible[index]) and 0 <= u < 1 and 0 <= v < 1
        patch = int(v * GRID) * GRID + int(u * GRID) if is_seen else GRID * GRID
        wanted.append((patch, min(float(track.target.depth_m[index]), FAR_M) if is_seen else 0.0))
    return np.array(pictures, np.uint8), np.array(wanted, np.float32)


class Finder(torch.nn.Module):
    """The tower with a head: logits of each patch and of none, and the logarithm of the distance in each patch."""

    def __init__(self, tower: Any) -> None:
        super().__init__()
        self.tower = tower
        self.head, self.none = torch.nn.Linear(VISION["hidden_size"], 2), torch.nn.Parameter(torch.zeros(1))

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = self.head(self.tower(pixel_values=pictures).last_hidden_state)
        logits = torch.cat([found[..., 0], self.none.expand(len(found), 1)], 1)
        return logits, found[..., 1]


def as_pixels(pictures: torch.Tensor) -> torch.Tensor:
    return pictures.permute(0, 3, 1, 2).float() / 127.5 - 1.0


def train_tower(tower: Any, frames: np.ndarray, wanted: np.ndarray, epochs: int, device: str) -> Finder:
    finder = Finder(tower).to(device)
    pictures, targets = torch.from_numpy(frames).to(device), torch.from_numpy(wanted).to(device)
    batch, generator = min(256, len(frames)), torch.Generator().manual_seed(0)
    steps = max(1, epochs * len(frames) // batch)
    optimizer = torch.optim.AdamW(finder.parameters(), lr=5e-4, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-4, total_steps=steps, pct_start=0.1)
    for step in range(steps):
        chosen = torch.randint(len(frames), (batch,), generator=generator).to(device)
        pixels, (patch, distance_m) = as_pixels(pictures[chosen]), targets[chosen].T
        patch = patch.long()
        if step % 2:  # the mirror image
            pixels, seen = pixels.flip(-1), patch < GRID * GRID
            patch = torch.where(seen, patch // GRID * GRID + GRID - 1 - patch % GRID, patch)
        pixels = pixels * (0.8 + 0.4 * torch.rand(len(pixels), 1, 1, 1, device=device))
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            logits, far = finder(pixels)
        seen = patch < GRID * GRID
        there = far.float()[seen, patch[seen]]
        loss = functional.cross_entropy(logits.float(), patch)
        loss = loss + functional.smooth_l1_loss(there, distance_m[seen].clamp(min=1).log())
        loss.backward()
        torch.nn.utils.clip_grad_norm_(finder.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        schedule.step()
        if step % 100 == 0 or step == steps - 1:
            print(f"step {step} of {steps}: loss {float(loss.detach()):.3f}", flush=True)
    return finder


@torch.no_grad()
def found_share(finder: Finder, frames: np.ndarray, wanted: np.ndarray, device: str) -> float:
    """Return the share of frames whose patch is the right one or one beside it."""
    finder.eval()
    right = []
    for start in range(0, len(frames), 256):
        logits, _ = finder(as_pixels(torch.from_numpy(frames[start : start + 256]).to(device)))
        guess, real = logits.argmax(1).cpu().numpy(), wanted[start : start + 256, 0].astype(int)
        near = np.maximum(abs(guess // GRID - real // GRID), abs(guess % GRID - real % GRID)) <= 1
        right += np.where(real == GRID * GRID, guess == real, near & (guess < GRID * GRID)).tolist()
    return float(np.mean(right))


def assemble(language: Path, out: Path, tower: Any) -> None:
    """Write the model folder: the language model's weights, the tower's, and a projector that is not trained yet."""
    arguments = {"pretrained_model_name_or_path": language.parent, "gguf_file": language.name}
    tokenizer, small = AutoTokenizer.from_pretrained(**arguments), AutoModelForCausalLM.from_pretrained(**arguments)
    named = {"image_token": IMAGE, "fake_image_token": FAKE, "global_image_token": GLOBAL}
    named["end_of_utterance_token"] = END
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer.backend_tokenizer, eos_token=END, pad_token=END, bos_token="<|im_start|>",
        chat_template=TEMPLATE, extra_special_tokens=named,
    )  # fmt: skip
    small.resize_token_embeddings(len(tokenizer))
    text = small.config.to_dict() | {"vocab_size": len(tokenizer), "eos_token_id": tokenizer.eos_token_id}
    text.pop("quantization_config", None)
    config = SmolVLMConfig(
        text_config=text, vision_config=VISION, scale_factor=SCALE, tie_word_embeddings=True,
        image_token_id=tokenizer.convert_tokens_to_ids(IMAGE), pad_token_id=tokenizer.pad_token_id,
    )  # fmt: skip
    torch.manual_seed(0)
    model = SmolVLMForConditionalGeneration(config).float()
    model.model.text_model.load_state_dict(small.model.state_dict())
    model.model.vision_model.load_state_dict(tower.state_dict())
    model.tie_weights()
    model.save_pretrained(out)
    tokenizer.save_pretrained(out)
    edges: Any = {"size": {"longest_edge": SIDE_PX}, "max_image_size": {"longest_edge": SIDE_PX}}
    means: Any = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
    SmolVLMImageProcessorPil(**edges, **means, do_image_splitting=False).save_pretrained(out)
    own = {"processor_class": "SmolVLMProcessor", "image_seq_len": (GRID // SCALE) ** 2}
    (out / "processor_config.json").write_text(json.dumps(own))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trees", nargs="+", type=Path, help="playback trees")
    parser.add_argument("--language", type=Path, required=True, help="GGUF file of SmolLM2")
    parser.add_argument("--without", nargs="*", default=[], help="towns that are only tested")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    folders = [folder for tree in arguments.trees for folder in find_tracks(tree)]
    with ProcessPoolExecutor() as pool:
        read = list(pool.map(frames_of, folders))
    tracks: dict[str, list] = {"trained": [], "other towns": []}
    for folder, pair in zip(folders, read, strict=True):
        is_tested = any(name in str(folder.parent) for name in arguments.without)
        tracks["other towns" if is_tested else "trained"] += [pair] if len(pair[0]) else []
    parts = {name: [np.concatenate(arrays) for arrays in zip(*own, strict=True)] for name, own in tracks.items() if own}
    print(f"{len(parts['trained'][0])} frames", flush=True)
    torch.manual_seed(0)
    tower = SmolVLMForConditionalGeneration(
        SmolVLMConfig(text_config={"model_type": "llama", "num_hidden_layers": 1, "hidden_size": 64, "vocab_size": 8,
            "num_attention_heads": 1, "num_key_value_heads": 1, "intermediate_size": 64, "pad_token_id": 0},
            vision_config=VISION, image_token_id=1, pad_token_id=0)
    ).float().model.vision_model  # fmt: skip
    finder = train_tower(tower, *parts["trained"], arguments.epochs, device)
    shares = {name: found_share(finder, *part, device) for name, part in parts.items()}
    assemble(arguments.language, arguments.out, finder.tower.cpu())
    print(json.dumps({"target_found": {name: round(share, 3) for name, share in shares.items()}}))


if __name__ == "__main__":
    main()
