"""A real vision-language model behind the test server: a random Qwen3.5 student, decoded under the request's JSON
schema by llguidance.

Its text is noise; that is the point. It honours data-URL images, `response_format`, `temperature`, `top_p`, `seed`,
`max_tokens`, `logit_bias`.
"""

from __future__ import annotations

import base64
import io
import threading
from pathlib import Path
from typing import Any

import numpy as np
import torch
from llguidance import LLMatcher
from llguidance.hf import from_tokenizer
from PIL import Image
from teacher_server import TeacherServer, refusal
from transformers import LogitsProcessor, LogitsProcessorList

from distill.student.encoding import EncodedSample, prompt_batch
from distill.student.model import IMAGE_TOKEN, load_student

CONTEXT = 16_384


class SchemaConstraint(LogitsProcessor):
    """Forbids every token that the grammar does not allow next."""

    def __init__(self, matcher: LLMatcher, prompt_length: int) -> None:
        self.matcher, self.position = matcher, prompt_length

    def __call__(self, input_ids: torch.LongTensor, scores: torch.FloatTensor) -> torch.FloatTensor:
        for token in input_ids[0, self.position :].tolist():
            assert self.matcher.consume_token(token), self.matcher.get_error()
        self.position = input_ids.shape[1]
        bits = np.frombuffer(self.matcher.compute_bitmask(), dtype=np.uint8)
        allowed = np.unpackbits(bits, bitorder="little")[: scores.shape[1]].astype(bool)
        return scores.masked_fill(~torch.from_numpy(allowed)[None], float("-inf"))


class ModelServer(TeacherServer):
    """Use as a context manager."""

    def __init__(self, folder: Path, max_pixels: int = 64 * 64) -> None:
        super().__init__(models=("random-qwen3.5",), model_facts={"max_model_len": CONTEXT}, respond=self._respond)
        self.student = load_student(folder, device="cpu", max_pixels=max_pixels)
        self.student.model.eval()
        self.num_answers = self.num_images = 0
        self.quote_id = int(self.student.tokenizer.convert_tokens_to_ids('"'))  # ends a string
        vocabulary = self.student.model.config.text_config.vocab_size
        self._grammar_tokenizer = from_tokenizer(self.student.tokenizer, n_vocab=vocabulary)
        self._one_at_a_time = threading.Lock()

    def _respond(self, body: dict[str, Any]) -> tuple[int, dict]:
        with self._one_at_a_time:
            return self._complete(body)

    def _complete(self, body: dict[str, Any]) -> tuple[int, dict]:
        own, (row, patches) = self.student, self._encode(body["messages"])
        length, max_tokens = len(row.prompt_ids), int(body["max_tokens"])
        if length + max_tokens > CONTEXT:
            return refusal(400, f"{length} + {max_tokens} tokens, at most {CONTEXT}")
        inputs = prompt_batch(own, [row]) | {"pixel_values": torch.from_numpy(patches)}
        processors = LogitsProcessorList()
        if not len(row.image_grids):
            del inputs["pixel_values"], inputs["image_grid_thw"]
        if wanted := body.get("response_format"):
            schema = wanted["json_schema"]["schema"]
            grammar = LLMatcher.grammar_from_json_schema(schema, defaults={"whitespace_flexible": False})
            processors.append(SchemaConstraint(LLMatcher(self._grammar_tokenizer, grammar), length))
        bias = {(int(token),): float(value) for token, value in body.get("logit_bias", {}).items()}
        torch.manual_seed(int(body.get("seed", 0)))
        with torch.inference_mode():
            output = own.model.generate(
                **inputs, max_new_tokens=max_tokens, do_sample=body["temperature"] > 0,
                temperature=body["temperature"] or None, top_p=body.get("top_p", 1.0), top_k=0,
                eos_token_id=own.end_token_id, pad_token_id=own.pad_token_id,
                sequence_bias=bias or None, logits_processor=processors,
            )  # fmt: skip
        ids = output[0, length:].tolist()
        is_finished = own.end_token_id in ids
        ids = ids[: ids.index(own.end_token_id)] if is_finished else ids
        self.num_answers += 1
        self.num_images += len(row.image_grids)
        message = {"role": "assistant", "content": own.tokenizer.decode(ids, skip_special_tokens=False)}
        choice = {"index": 0, "message": message, "finish_reason": "stop" if is_finished else "length"}
        usage = {"prompt_tokens": length, "completion_tokens": len(ids)}
        return 200, {"object": "chat.completion", "model": body["model"], "choices": [choice], "usage": usage}

    def _encode(self, messages: list[dict]) -> tuple[EncodedSample, np.ndarray]:
        """Make token ids and patches of a chat: each image mark becomes as many tokens as its picture has patches."""
        images: list[Image.Image] = []
        for message in messages:
            for part in message["content"] if isinstance(message["content"], list) else ():
                if part["type"] == "image_url":
                    data = base64.b64decode(part.pop("image_url")["url"].split(",", 1)[1])
                    images.append(Image.open(io.BytesIO(data)).convert("RGB"))
                    part["type"] = "image"
        text = self.student.tokenizer.apply_chat_template(messages, tokenize=False, add_generation_prompt=True)
        grids, patches = np.zeros((0, 3), np.int64), np.zeros((0, 1), np.float32)
        if images:
            seen = self.student.image_processor(images, return_tensors="np")
            grids, patches = np.asarray(seen["image_grid_thw"], np.int64), np.asarray(seen["pixel_values"], np.float32)
        for count in (grids.prod(axis=1) // self.student.image_processor.merge_size**2).tolist():
            text = text.replace(IMAGE_TOKEN, "\x00" * count, 1)
        ids = self.student.tokenizer(text.replace("\x00", IMAGE_TOKEN), add_special_tokens=False)["input_ids"]
        return EncodedSample("", np.array(ids, np.int64), np.zeros(0, np.int64), grids, 1.0), patches
