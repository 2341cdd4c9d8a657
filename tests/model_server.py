"""A real vision-language model behind a real chat-completions server: a locally made, random Qwen3.5 student, decoded under the
request's JSON schema by llguidance. Its text is noise; that is the point.

It honours messages with data-URL images, `response_format`, `temperature`, `top_p`, `seed`, `max_tokens` and `logit_bias`.
"""

from __future__ import annotations

import base64
import io
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import uvicorn
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from llguidance import LLMatcher
from llguidance.hf import from_tokenizer
from PIL import Image
from transformers import LogitsProcessor, LogitsProcessorList

from distill.student.encoding import Encoded, prompt_batch
from distill.student.model import IMAGE_TOKEN, Student, load_student

MODEL, CONTEXT = "random-qwen3.5", 16_384


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


class ModelServer:
    """Use as a context manager."""

    def __init__(self, folder: Path, max_pixels: int = 64 * 64) -> None:
        self.student: Student = load_student(folder, device="cpu", max_pixels=max_pixels)
        self.student.model.eval()
        self.num_answers = self.num_images = 0
        self.bodies: list[bytes] = []  # as they came
        self._grammar_tokenizer = from_tokenizer(
            self.student.tokenizer, n_vocab=self.student.model.config.text_config.vocab_size
        )
        self._lock = threading.Lock()  # one answer at a time
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = probe.getsockname()[1]
        config = uvicorn.Config(self._app(), host="127.0.0.1", port=self._port, log_level="error")
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._port}/v1"

    @property
    def quote_id(self) -> int:
        """The token of a double quote, which ends a string."""
        return int(self.student.tokenizer.convert_tokens_to_ids('"'))

    def __enter__(self) -> ModelServer:
        self._thread.start()
        while not self._server.started:
            time.sleep(0.01)
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.should_exit = True
        self._thread.join(timeout=10)

    def _app(self) -> FastAPI:
        app = FastAPI()

        @app.middleware("http")
        async def note(request: Request, answer: Any) -> Any:
            if request.method == "POST":
                self.bodies.append(await request.body())
            return await answer(request)

        @app.get("/v1/models")
        def models() -> dict:
            return {"object": "list", "data": [{"id": MODEL, "object": "model", "max_model_len": CONTEXT}]}

        @app.post("/v1/chat/completions")
        def completions(body: dict[str, Any]) -> JSONResponse:
            if body["model"] != MODEL:
                return JSONResponse({"error": {"message": f"no model {body['model']}"}}, 404)
            with self._lock:
                return self._complete(body)

        return app

    def _complete(self, body: dict[str, Any]) -> JSONResponse:
        row = self._encode(body["messages"])
        length, max_tokens = len(row.prompt_ids), int(body["max_tokens"])
        if length + max_tokens > CONTEXT:
            return JSONResponse({"error": {"message": f"{length} + {max_tokens} tokens, at most {CONTEXT}"}}, 400)
        inputs = prompt_batch(self.student, [row])
        if not len(row.image_grids):
            del inputs["pixel_values"], inputs["image_grid_thw"]
        bias = {(int(token),): float(value) for token, value in body.get("logit_bias", {}).items()}
        torch.manual_seed(int(body.get("seed", 0)))
        with torch.inference_mode():
            output = self.student.model.generate(
                **inputs,
                max_new_tokens=max_tokens,
                do_sample=body["temperature"] > 0,
                temperature=body["temperature"] or None,
                top_p=body.get("top_p", 1.0),
                top_k=0,
                eos_token_id=self.student.end_token_id,
                pad_token_id=self.student.pad_token_id,
                sequence_bias=bias or None,
                logits_processor=self._constraint(body, length),
            )
        ids = output[0, length:].tolist()
        is_finished = self.student.end_token_id in ids
        if is_finished:
            ids = ids[: ids.index(self.student.end_token_id)]
        self.num_answers += 1
        self.num_images += len(row.image_grids)
        message = {"role": "assistant", "content": self.student.tokenizer.decode(ids, skip_special_tokens=False)}
        choice = {"index": 0, "message": message, "finish_reason": "stop" if is_finished else "length"}
        usage = {"prompt_tokens": length, "completion_tokens": len(ids)}
        return JSONResponse({"object": "chat.completion", "model": MODEL, "choices": [choice], "usage": usage})

    def _constraint(self, body: dict[str, Any], length: int) -> LogitsProcessorList:
        wanted = body.get("response_format")
        if wanted is None:
            return LogitsProcessorList()
        grammar = LLMatcher.grammar_from_json_schema(
            wanted["json_schema"]["schema"], defaults={"whitespace_flexible": False}
        )
        return LogitsProcessorList([SchemaConstraint(LLMatcher(self._grammar_tokenizer, grammar), length)])

    def _encode(self, messages: list[dict]) -> Encoded:
        """Make token ids and patches of a chat: each image mark becomes as many tokens as its picture has patches."""
        images: list[Image.Image] = []
        chat = []
        for message in messages:
            content = message["content"]
            if not isinstance(content, str):
                parts = []
                for part in content:
                    if part["type"] == "image_url":
                        images.append(_decode(part["image_url"]["url"]))
                        parts.append({"type": "image"})
                    else:
                        parts.append(part)
                content = parts
            chat.append({"role": message["role"], "content": content})
        text = self.student.tokenizer.apply_chat_template(chat, tokenize=False, add_generation_prompt=True)
        processor = self.student.image_processor
        grids, patches = np.zeros((0, 3), np.int64), np.zeros((0, 1), np.float32)
        if images:
            vision = processor(images, return_tensors="np")
            grids = np.asarray(vision["image_grid_thw"], np.int64)
            patches = np.asarray(vision["pixel_values"], np.float32)
        for count in (grids.prod(axis=1) // processor.merge_size**2).tolist():
            text = text.replace(IMAGE_TOKEN, "\x00" * count, 1)
        ids = self.student.tokenizer(text.replace("\x00", IMAGE_TOKEN), add_special_tokens=False)["input_ids"]
        return Encoded("", np.array(ids, np.int64), np.zeros(0, np.int64), patches, grids, 1.0)


def _decode(url: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(url.split(",", 1)[1]))).convert("RGB")
