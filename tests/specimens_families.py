"""Tiny students of random weights in the families that must work, made from transformers' own configuration classes.

Each has the special tokens of its family and a chat template that branches where the public one does.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

TEXTS = (
    '{"critical_components":"The pedestrian is centred in the view, about 14 m ahead.","reasoning_trace":"turns left"',
    '"flight_decision":"track_straight"} yaw_left_to_follow slow_down Five frames end at. Answer. You fly the drone.',
    "行人位于画面中央并继续前行，距离约十米。你驾驶无人机。五帧，最后一帧为请回答。",
)
CHATML = (
    "{% for m in messages %}{{ '<|im_start|>' + m.role + '\n' }}{% if m.content is string %}{{ m.content }}{% else %}"
    "{% for c in m.content %}{% if c.type == 'image' %}IMAGE{% else %}{{ c.text }}{% endif %}{% endfor %}{% endif %}"
    "{{ '<|im_end|>\n' }}{% endfor %}{% if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{% endif %}"
)
# As the public one of Qwen3.8 does: texts are trimmed, thoughts come from their own field, and the system text begins
# with how much to think unless thinking is off.
THINKING = (
    "{% for m in messages %}{% set text %}{% if m.content is string %}{{ m.content }}{% else %}{% for c in m.content %}"
    "{% if c.type == 'image' %}IMAGE{% else %}{{ c.text }}{% endif %}{% endfor %}{% endif %}{% endset %}"
    "{{ '<|im_start|>' + m.role + '\n' }}"
    "{% if m.role == 'system' and (enable_thinking is undefined or enable_thinking) %}"
    "{{ 'Reasoning effort is set to xhigh.\n\n' }}{% elif m.role == 'assistant' %}"
    "{{ '<think>\n' + (m.reasoning_content or '') | trim + '\n</think>\n\n' }}{% endif %}"
    "{{ text | trim + '<|im_end|>\n' }}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<|im_start|>assistant\n<think>\n' }}"
    "{% if enable_thinking is defined and not enable_thinking %}{{ '\n</think>\n\n' }}{% endif %}{% endif %}"
)
# Content is a list of parts, roles are words, and the end has a token of its own.
SMOLVLM = (
    "<|im_start|>{% for m in messages %}{{ m['role'] | capitalize }}"
    "{% if m['content'][0]['type'] == 'image' %}{{ ':' }}{% else %}{{ ': ' }}{% endif %}"
    "{% for c in m['content'] %}{% if c['type'] == 'text' %}{{ c['text'] }}"
    "{% elif c['type'] == 'image' %}{{ '<image>' }}{% endif %}{% endfor %}<end_of_utterance>\n{% endfor %}"
    "{% if add_generation_prompt %}{{ 'Assistant:' }}{% endif %}"
)
# The system text becomes part of the first question, and texts are trimmed.
GEMMA = (
    "{{ bos_token }}{% if messages[0]['role'] == 'system' %}{% if messages[0]['content'] is string %}"
    "{% set first = messages[0]['content'] + '\n\n' %}{% else %}"
    "{% set first = messages[0]['content'][0]['text'] + '\n\n' %}{% endif %}{% set loop_messages = messages[1:] %}"
    "{% else %}{% set first = '' %}{% set loop_messages = messages %}"
    "{% endif %}{% for m in loop_messages %}{{ '<start_of_turn>' + ('model' if m['role'] == 'assistant' else m['role'])"
    " + '\n' + (first if loop.first else '') }}{% if m['content'] is string %}{{ m['content'] | trim }}{% else %}"
    "{% for c in m['content'] %}{% if c['type'] == 'image' %}{{ '<start_of_image>' }}{% else %}{{ c['text'] | trim }}"
    "{% endif %}{% endfor %}{% endif %}{{ '<end_of_turn>\n' }}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<start_of_turn>model\n' }}{% endif %}"
)
LLAMA = (
    "{{ bos_token }}{% for m in messages %}{{ '<|start_header_id|>' + m['role'] + '<|end_header_id|>\n\n' }}"
    "{{ m['content'] | trim }}{{ '<|eot_id|>' }}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<|start_header_id|>assistant<|end_header_id|>\n\n' }}{% endif %}"
)
QWEN_PICTURE = "<|vision_start|><|image_pad|><|vision_end|>"
TEXT = {
    "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4,
    "num_key_value_heads": 2, "head_dim": 8, "max_position_embeddings": 4096, "tie_word_embeddings": True,
}  # fmt: skip
SIGLIP = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2}
SIGLIP_32 = {**SIGLIP, "image_size": 32, "patch_size": 8}


def make_tokenizer(special: list[str], template: str, eos: str, **named: str) -> Any:
    """Return a byte-level tokenizer with the special tokens of a family; `named` are attributes for processors."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    bpe = Tokenizer(models.BPE())
    bpe.pre_tokenizer, bpe.decoder = pre_tokenizers.ByteLevel(add_prefix_space=False), decoders.ByteLevel()
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    trainer = trainers.BpeTrainer(
        vocab_size=600, special_tokens=special, initial_alphabet=alphabet, show_progress=False
    )
    bpe.train_from_iterator(TEXTS, trainer)
    return PreTrainedTokenizerFast(
        tokenizer_object=bpe, eos_token=eos, pad_token=special[0], bos_token=special[0], chat_template=template,
        extra_special_tokens=named,
    )  # fmt: skip


def _text(tokenizer: Any, **changes: Any) -> dict[str, Any]:
    ids = {"eos_token_id": tokenizer.eos_token_id, "pad_token_id": tokenizer.pad_token_id}
    return {**TEXT, "vocab_size": len(tokenizer), **ids, "bos_token_id": tokenizer.bos_token_id, **changes}


def _qwen(kind: str) -> tuple[Any, Any, Any, dict[str, Any]]:
    import transformers
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    marks = ["<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>"]
    template = THINKING if kind == "Qwen3_5" else CHATML
    template = template.replace("IMAGE", f"{{{{ '{QWEN_PICTURE}' }}}}")
    tokenizer = make_tokenizer(["<|endoftext|>", *marks], template, "<|im_end|>")
    ids = {f"{name}_token_id": tokenizer.convert_tokens_to_ids(f"<|{mark}|>") for name, mark in (
        ("image", "image_pad"), ("video", "video_pad"), ("vision_start", "vision_start"), ("vision_end", "vision_end")
    )}  # fmt: skip
    is_old = kind == "Qwen2_5_VL"
    rope: dict[str, Any] = {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [2, 1, 1]}
    text = _text(tokenizer, head_dim=8, rope_parameters=rope)
    if kind == "Qwen3_5":
        linear = {"linear_num_key_heads": 2, "linear_num_value_heads": 2}
        rope |= {"partial_rotary_factor": 1.0, "mrope_interleaved": True}
        text |= {**linear, "linear_key_head_dim": 8, "linear_value_head_dim": 8, "num_hidden_layers": 4}
        text["layer_types"] = (["linear_attention"] * 3) + ["full_attention"]
    widths = {"hidden_size": 32, "intermediate_size": 48, "out_hidden_size": 32}
    vision: dict[str, Any] = {**widths, "depth": 2, "num_heads": 2}
    vision |= {"patch_size": 14} if is_old else {"num_position_embeddings": 16}
    if kind == "Qwen3_VL":
        vision["deepstack_visual_indexes"] = [0]
        rope["mrope_interleaved"] = True
    vision |= {"fullatt_block_indexes": [1], "window_size": 56} if is_old else {}
    config = getattr(transformers, f"{kind.replace('Qwen3_VL', 'Qwen3VL')}Config")(
        text_config=text, vision_config=vision, tie_word_embeddings=True, **ids
    )
    side = 14 if is_old else 16
    areas = {"shortest_edge": (2 * side) ** 2, "longest_edge": 1280 * 1280}
    sizes: Any = {"patch_size": side, "merge_size": 2, "temporal_patch_size": 2, "size": areas}
    return config, tokenizer, Qwen2VLImageProcessorPil(**sizes), {}


def _smolvlm() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import SmolVLMConfig
    from transformers.models.smolvlm.image_processing_pil_smolvlm import SmolVLMImageProcessorPil

    rows = [f"<row_{row}_col_{column}>" for row in range(1, 4) for column in range(1, 4)]
    special = ["<|endoftext|>", "<|im_start|>", "<end_of_utterance>", "<image>", "<fake_token_around_image>"]
    named = {"image_token": "<image>", "global_image_token": "<global-img>"}
    named |= {"fake_image_token": "<fake_token_around_image>", "end_of_utterance_token": "<end_of_utterance>"}
    tokenizer = make_tokenizer([*special, "<global-img>", *rows], SMOLVLM, "<end_of_utterance>", **named)
    text = _text(tokenizer) | {"model_type": "llama"}
    image_token = tokenizer.convert_tokens_to_ids("<image>")
    config = SmolVLMConfig(
        text_config=text, vision_config=SIGLIP_32, scale_factor=2, image_token_id=image_token, tie_word_embeddings=True,
        pad_token_id=tokenizer.pad_token_id,
    )  # fmt: skip
    edges: Any = {"size": {"longest_edge": 64}, "max_image_size": {"longest_edge": 32}}
    return config, tokenizer, SmolVLMImageProcessorPil(**edges), {"image_seq_len": 4}


def _gemma3() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import Gemma3Config
    from transformers.models.gemma3.image_processing_pil_gemma3 import Gemma3ImageProcessorPil

    marks = ["<eos>", "<start_of_turn>", "<end_of_turn>", "<start_of_image>", "<end_of_image>", "<image_soft_token>"]
    named = {"boi_token": marks[3], "eoi_token": marks[4], "image_token": marks[5]}
    tokenizer = make_tokenizer(["<bos>", *marks], GEMMA, "<eos>", **named)
    ids = {name: tokenizer.convert_tokens_to_ids(mark) for name, mark in (
        ("boi_token_index", marks[3]), ("eoi_token_index", marks[4]), ("image_token_id", marks[5])
    )}  # fmt: skip
    layers = ["sliding_attention", "full_attention"]
    text = _text(tokenizer, sliding_window=64, layer_types=layers, query_pre_attn_scalar=8)
    config = Gemma3Config(text_config=text, vision_config=SIGLIP_32, mm_tokens_per_image=4, **ids)
    images = Gemma3ImageProcessorPil(size={"height": 32, "width": 32}, do_pan_and_scan=False)
    return config, tokenizer, images, {"image_seq_length": 4}


def _internvl() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import InternVLConfig
    from transformers.models.got_ocr2.image_processing_pil_got_ocr2 import GotOcr2ImageProcessorPil

    marks = ["<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>", "<video>"]
    named = {"start_image_token": "<img>", "end_image_token": "</img>", "context_image_token": "<IMG_CONTEXT>"}
    template = CHATML.replace("IMAGE", "{{ '<IMG_CONTEXT>\n' }}")
    tokenizer = make_tokenizer(["<|endoftext|>", *marks], template, "<|im_end|>", **named, video_token="<video>")
    vision = {**SIGLIP, "image_size": [32, 32], "patch_size": [8, 8]}
    text = _text(tokenizer) | {"model_type": "qwen2"}
    token = tokenizer.convert_tokens_to_ids("<IMG_CONTEXT>")
    config = InternVLConfig(text_config=text, vision_config=vision, image_token_id=token, image_seq_length=4)
    images = GotOcr2ImageProcessorPil(size={"height": 32, "width": 32}, crop_to_patches=False)
    return config, tokenizer, images, {"image_seq_length": 4}


def _llava_onevision() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import LlavaOnevisionConfig
    from transformers.models.llava_onevision.image_processing_pil_llava_onevision import LlavaOnevisionImageProcessorPil

    marks = ["<|im_start|>", "<|im_end|>", "<image>", "<video>"]
    template = CHATML.replace("IMAGE", "{{ '<image>\n' }}")
    named = {"image_token": "<image>", "video_token": "<video>"}
    tokenizer = make_tokenizer(["<|endoftext|>", *marks], template, "<|im_end|>", **named)
    vision = {**SIGLIP_32, "model_type": "siglip_vision_model", "vision_use_head": False}
    text = _text(tokenizer) | {"model_type": "qwen2"}
    ids = {f"{kind}_token_id": tokenizer.convert_tokens_to_ids(f"<{kind}>") for kind in ("image", "video")}
    pins: Any = [[32, 32], [32, 64], [64, 32]]
    config = LlavaOnevisionConfig(
        text_config=text, vision_config=vision, image_grid_pinpoints=pins, vision_feature_layer=-1,
        vision_feature_select_strategy="full", **ids,
    )  # fmt: skip
    images = LlavaOnevisionImageProcessorPil(size={"height": 32, "width": 32}, image_grid_pinpoints=pins)
    own = {"num_image_tokens": 16, "vision_feature_select_strategy": "full", "vision_aspect_ratio": "anyres_max_9"}
    return config, tokenizer, images, own


def _llama() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import LlamaConfig

    marks = ["<|eot_id|>", "<|start_header_id|>", "<|end_header_id|>"]
    tokenizer = make_tokenizer(["<|begin_of_text|>", *marks], LLAMA, "<|eot_id|>")
    return LlamaConfig(**_text(tokenizer)), tokenizer, None, {}


def _gemma3_text() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import Gemma3TextConfig

    tokenizer = make_tokenizer(["<bos>", "<eos>", "<start_of_turn>", "<end_of_turn>"], GEMMA, "<eos>")
    layers = ["sliding_attention", "full_attention"]
    config = Gemma3TextConfig(**_text(tokenizer, sliding_window=64, layer_types=layers, query_pre_attn_scalar=8))
    return config, tokenizer, None, {}


def _qwen3() -> tuple[Any, Any, Any, dict[str, Any]]:
    from transformers import Qwen3Config

    tokenizer = make_tokenizer(["<|endoftext|>", "<|im_start|>", "<|im_end|>"], CHATML, "<|im_end|>")
    return Qwen3Config(**_text(tokenizer)), tokenizer, None, {}


Make = Callable[[], tuple[Any, Any, Any, dict[str, Any]]]
WITH_PICTURES: dict[str, Make] = {
    "qwen3_5": lambda: _qwen("Qwen3_5"), "qwen2_5_vl": lambda: _qwen("Qwen2_5_VL"),
    "qwen3_vl": lambda: _qwen("Qwen3_VL"),
    "smolvlm": _smolvlm, "gemma3": _gemma3, "internvl": _internvl, "llava_onevision": _llava_onevision,
}  # fmt: skip
TEXT_ONLY: dict[str, Make] = {"llama": _llama, "gemma3_text": _gemma3_text, "qwen3": _qwen3}
FAMILIES = WITH_PICTURES | TEXT_ONLY


def make_family(name: str, folder: Path, seed: int = 0) -> Path:
    """Write a student of a family, as a hub keeps one."""
    import torch
    from transformers import AutoModelForCausalLM, AutoModelForImageTextToText

    config, tokenizer, images, own = FAMILIES[name]()
    auto = AutoModelForCausalLM if images is None else AutoModelForImageTextToText
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = auto.from_config(config)
    model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    if images is not None:
        images.save_pretrained(folder)
    if own:
        (folder / "processor_config.json").write_text(json.dumps(own))
    return folder
