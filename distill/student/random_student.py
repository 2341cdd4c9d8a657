"""A student of 0.3 million random weights in Qwen3.5's structure, with a tokenizer trained on the training set: for a
try on a laptop."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cosfly.formats.captions import FIELDS, TOKENS
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.seeding import rng_for
from distill.student.model import quiet_transformers, require
from distill.student.saving import writing_errors

TINY = "tiny"  # value of `--student`, as folders and names of repositories are
VOCABULARY = 800  # tokens
WIDTH, LAYERS = 64, 4  # of the language model; the vision tower has half of both
START, END_OF_TURN, PAD = "<|im_start|>", "<|im_end|>", "<|endoftext|>"
VISION_START, VISION_END, IMAGE, VIDEO = "<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>"
_CHAT_TEMPLATE = (
    "{%- for m in messages %}{{ '<|im_start|>' + m.role + '\n' }}"
    "{%- if m.content is string %}{{ m.content }}"
    "{%- else %}{%- for c in m.content %}"
    "{%- if c.type == 'image' %}{{ '<|vision_start|><|image_pad|><|vision_end|>' }}{%- else %}{{ c.text }}{%- endif %}"
    "{%- endfor %}{%- endif %}{{ '<|im_end|>\n' }}{%- endfor %}"
    "{%- if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{%- endif %}"
)
# Enough text for a small vocabulary whose longer pieces are words of drone captions.
_TOKENIZER_TEXT = (
    '{"critical_components":"the pedestrian is visible in the image at a distance of metres ahead of the drone",',
    '"reasoning_trace":"the target turns left so the drone should turn left to keep it in the centre of the view",',
    '{"critical_components":"目标行人在画面中央，无人机保持距离，左侧有建筑物","reasoning_trace":"行人向右转弯，因此无人机应右转跟随",',
    "frame position velocity visibility true false drone target world depth camera yaw pitch roll five frames",
    " ".join((*FIELDS, *TOKENS)),
)


def make_random_student(folder: Path, seed: int = 0, texts: Iterable[str] = ()) -> Path:
    """Write a randomly initialised student as a model folder; it overfits a handful of captions within minutes on a
    CPU. Its byte-level tokenizer is trained on the texts, besides a few lines of our own."""
    require("torch", "transformers")
    import torch
    from transformers import Qwen3_5ForConditionalGeneration
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
    from transformers.models.qwen3_5.tokenization_qwen3_5 import Qwen3_5Tokenizer

    quiet_transformers()
    empty: Any = {"vocab": {}, "merges": [], "eos_token": END_OF_TURN, "pad_token": PAD, "model_max_length": 32768}
    lines = (*_TOKENIZER_TEXT, *texts)
    tokenizer = Qwen3_5Tokenizer(**empty).train_new_from_iterator(lines, VOCABULARY, show_progress=False)
    tokenizer.add_special_tokens({"extra_special_tokens": [START, VISION_START, VISION_END, IMAGE, VIDEO]})
    tokenizer.chat_template = _CHAT_TEMPLATE
    sizes: Any = {"patch_size": 16, "merge_size": 2, "temporal_patch_size": 2}
    areas: Any = {"shortest_edge": 32 * 32, "longest_edge": 1280 * 1280}  # in pixels
    image_processor = Qwen2VLImageProcessorPil(**sizes, image_mean=[0.5] * 3, image_std=[0.5] * 3, size=areas)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng_for(seed, "distill.tiny_student", "weights").integers(2**31)))
        model = Qwen3_5ForConditionalGeneration(model_config(tokenizer))
        # Final norm and tied embeddings stay frozen under LoRA and bound the logits by |hidden| |embedding|, which is
        # sqrt(width), hence the loss by 0.29 nats; twice the length lets it be sure of an answer.
        with torch.no_grad():
            model.model.language_model.embed_tokens.weight.mul_(2.0)
    with atomic_folder(folder) as partial, writing_errors(partial):
        for part in (model, tokenizer, image_processor):
            part.save_pretrained(partial)
    return folder


def model_config(tokenizer: Any) -> Any:
    """Return the library's configuration of a student."""
    from transformers import Qwen3_5Config

    head, heads = 16, WIDTH // 16
    rope = {"rope_type": "default", "rope_theta": 1e4, "partial_rotary_factor": 0.5, "mrope_interleaved": True}
    rope["mrope_section"] = [2, 1, 1]  # of half of the rotary half of a head: time, height, width
    text = {
        "vocab_size": len(tokenizer), "hidden_size": WIDTH, "intermediate_size": 2 * WIDTH,
        "num_hidden_layers": LAYERS, "num_attention_heads": heads, "num_key_value_heads": heads // 2,
        "head_dim": head, "linear_key_head_dim": head, "linear_value_head_dim": head,
        "linear_num_key_heads": heads // 2, "linear_num_value_heads": heads,
        "layer_types": ["linear_attention"] * 3 + ["full_attention"],
        "tie_word_embeddings": True, "rope_parameters": rope,
        "initializer_range": WIDTH**-0.5,  # the usual 0.02 is for wide models
        "eos_token_id": tokenizer.eos_token_id, "pad_token_id": tokenizer.pad_token_id,
    }  # fmt: skip
    vision = {
        "depth": LAYERS // 2, "hidden_size": WIDTH // 2, "intermediate_size": WIDTH, "num_heads": 2,
        "out_hidden_size": WIDTH, "num_position_embeddings": 64,
    }  # fmt: skip
    names = {"image": IMAGE, "video": VIDEO, "vision_start": VISION_START, "vision_end": VISION_END}
    marks: Any = {f"{name}_token_id": tokenizer.convert_tokens_to_ids(token) for name, token in names.items()}
    return Qwen3_5Config(text_config=text, vision_config=vision, tie_word_embeddings=True, **marks)
