"""Samples as tokens, through the chat template and the processor of the student itself.

Prompt and answer are tokenized apart and joined, as in inference: no token spans the border, so the mask that keeps the
loss on the answer is exact.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cosfly.formats.captions import FIELDS
from cosfly.llm.student_chat import IMAGE_PART, chat_messages, limited_size
from cosfly.runtime.errors import InputError
from distill.schema import Sample

IGNORED = -100  # label of tokens without a loss, the convention of PyTorch's cross entropy
MARKUP = re.compile(r"[<\[|].+[>\]|]")  # tokens such as <think>, [INST], <|im_end|>


@dataclass(frozen=True)
class EncodedSample:
    """The tokens of a sample."""

    prompt_ids: np.ndarray  # (n,) int32
    answer_ids: np.ndarray  # (m,) int32, with the end token
    weights: np.ndarray  # (m,) float32, of the answer's tokens in the loss
    kinds: np.ndarray  # (n,) int8, which tokens of the prompt are pictures; 0 for families that take no kinds

    def __len__(self) -> int:
        return len(self.prompt_ids) + len(self.answer_ids)

    @property
    def weight(self) -> float:
        return float(self.weights.sum())


class _BySize:
    """An image processor that processes blank pictures of the same number and sizes once, and remembers the result.

    How many tokens a picture takes depends only on its size, so prompts can be written before pictures are read.
    """

    def __init__(self, image_processor: Any) -> None:
        self.image_processor = image_processor
        self._results: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.image_processor, name)

    def __call__(self, images: Any, **settings: Any) -> Any:
        # The sizes as the pictures are nested: one alone, or a list of them for each text.
        key = tuple(tuple(p.size for p in entry) if isinstance(entry, list) else entry.size for entry in images)
        if key not in self._results:
            self._results[key] = self.image_processor(images, **settings)
        return type(self._results[key])(dict(self._results[key]))

    def fetch_images(self, images: Any) -> Any:
        return images


@dataclass
class Processor:
    """Turns texts and pictures into tensors; it has no model, so worker processes can hold it."""

    tokenizer: Any
    library: Any  # transformers' processor of a family with pictures; None for a text-only student
    template: str = ""  # chat template that replaces the student's own; empty: none

    @property
    def has_pictures(self) -> bool:
        return self.library is not None

    @cached_property
    def chat_template(self) -> Any:
        own = getattr(self.library, "chat_template", None) or self.tokenizer.chat_template
        return self.template or own

    @cached_property
    def _around_answer(self) -> tuple[str, str]:
        """What the chat template writes between a prompt and its answer, such as a blank, and after the answer."""
        messages = [{"role": "user", "content": self._content("x")}]
        answered = [*messages, {"role": "assistant", "content": self._content("y")}]
        begin, whole = self._render(messages, add_generation_prompt=True), self._render(answered)
        lead, _, after = whole.removeprefix(begin).partition("y")
        return (lead, after) if whole.startswith(begin) and not lead.strip() else ("", "")

    @property
    def lead(self) -> str:
        """White space that an answer begins with."""
        return self._around_answer[0]

    @cached_property
    def end_token_id(self) -> int:
        """The first token that the template writes after an answer, or the tokenizer's own end token, or -1."""
        _, after = self._around_answer
        for token_id, token in self.tokenizer.added_tokens_decoder.items():
            if token.special and after.startswith(token.content):
                return int(token_id)
        return -1 if self.tokenizer.eos_token_id is None else int(self.tokenizer.eos_token_id)

    @property
    def end_of_answer(self) -> str:
        """The end token, and the rest of what the chat template writes after it."""
        _, after = self._around_answer
        end = self.tokenizer.decode([self.end_token_id])
        return after if after.startswith(end) else end

    @property
    def pad_token_id(self) -> int:
        pad = self.tokenizer.pad_token_id
        return self.end_token_id if pad is None else int(pad)

    @cached_property
    def chat_tokens(self) -> tuple[str, ...]:
        """Tokens that texts may not contain, because they mean turns, pictures, thoughts or calls."""
        tokens = self.tokenizer.added_tokens_decoder.values()
        return tuple(sorted({t.content for t in tokens if t.special or MARKUP.fullmatch(t.content)}))

    @cached_property
    def _sized(self) -> Any:
        """The family's processor, with an image processor that knows blank pictures by their size."""
        import copy

        sized = copy.copy(self.library)
        sized.image_processor = _BySize(self.library.image_processor)
        return sized

    def check(self, where: Path) -> None:
        """Check what a student needs of its tokenizer."""
        if not self.chat_template:
            fix = "set distill.train.chat_template to a file with the template of this family of models"
            raise InputError("the tokenizer has no chat template", where=where, expected="chat_template.jinja", fix=fix)
        if self.end_token_id < 0:
            words = "the tokenizer has no end token, and the chat template does not end an answer with one"
            raise InputError(words, where=where, fix='name an "eos_token" in tokenizer_config.json')

    def _content(self, content: str | list[dict[str, Any]]) -> Any:
        """Return the content of a message: parts for templates of families with pictures, otherwise text."""
        parts = [{"type": "text", "text": content}] if isinstance(content, str) else content
        return parts if self.has_pictures else "".join(part["text"] for part in parts)

    def _render(self, messages: list[dict[str, Any]], **more: Any) -> str:
        given: dict[str, Any] = {"tokenize": False, "enable_thinking": False, **more}
        return self.tokenizer.apply_chat_template(messages, chat_template=self.chat_template, **given)

    def _messages(self, sample: Sample) -> list[dict[str, Any]]:
        """Return the chat of a sample, with a mark for each picture."""
        messages = chat_messages(sample.prompt, [[IMAGE_PART] * len(sample.views) for _ in sample.frames])
        return [message | {"content": self._content(message["content"])} for message in messages]

    def prompt_text(self, sample: Sample) -> str:
        """Return the prompt as the chat template writes it, without thinking, with one mark for each picture."""
        return self._render(self._messages(sample), add_generation_prompt=True)

    def chat_text(self, sample: Sample) -> str:
        """Return the whole chat as the chat template writes it: prompt, answer and end must add up to it."""
        return self._render([*self._messages(sample), {"role": "assistant", "content": self._content(sample.answer)}])

    def _tokens(self, text: str, size_px: tuple[int, int], count: int) -> Mapping[str, Any]:
        """Return the inputs of a text with the marks of `count` pictures, as the family's processor makes them."""
        if not count:
            return self.tokenizer([text], add_special_tokens=False)
        blank = Image.new("RGB", size_px)
        return self._sized(text=[text], images=[[blank] * count], add_special_tokens=False)

    def encode(self, sample: Sample, max_pixels: int = 0, decision_weight: float = 1.0) -> EncodedSample:
        """Return the tokens of a sample; `decision_weight` is that of the decision in the loss, others have 1."""
        size_px = limited_size(sample.picture_px, max_pixels)
        try:
            prompt = self._tokens(self.prompt_text(sample), size_px, len(sample.images))
        except ValueError as error:
            fix = "remove special tokens for pictures from the text of the prompt"
            raise InputError("the prompt cannot be encoded", where=sample.key, got=str(error)[:200], fix=fix) from error
        text = self.lead + sample.answer
        answer = self.tokenizer(text, add_special_tokens=False, return_offsets_mapping=self.tokenizer.is_fast)
        ids = np.array(prompt["input_ids"][0], dtype=np.int32)
        kinds = prompt.get(self.kinds_name) if sample.images else None
        return EncodedSample(
            prompt_ids=ids,
            answer_ids=np.array([*answer["input_ids"], self.end_token_id], dtype=np.int32),
            weights=_token_weights(text, answer, decision_weight),
            kinds=np.zeros(len(ids), np.int8) if kinds is None else np.array(kinds[0], dtype=np.int8),
        )

    @cached_property
    def kinds_name(self) -> str:
        """The name under which the model takes `kinds`; empty: it takes none."""
        if not self.has_pictures:
            return ""
        inputs = self._tokens(self._picture_text, (64, 64), 1)
        return next((name for name in inputs if name.endswith("token_type_ids")), "")

    @cached_property
    def _picture_text(self) -> str:
        return self._render([{"role": "user", "content": [IMAGE_PART, {"type": "text", "text": "x"}]}])

    def picture_inputs(self, picture: np.ndarray, *, is_alone: bool) -> dict[str, np.ndarray]:
        """Return a picture, (h, w, 3) uint8, as the inputs that the model takes of it."""
        image = Image.fromarray(picture)
        inputs: dict[str, Any] = dict(self.library(text=[self._picture_text], images=[[image]], return_tensors="np"))
        if "batch_num_images" in inputs and not is_alone:  # LLaVA-OneVision cuts the only picture of a text into tiles
            twice = self.library(text=[self._picture_text * 2], images=[[image, image]], return_tensors="np")
            inputs = {name: value[:1] for name, value in twice.items()}
        of_text = ("input_ids", "attention_mask", self.kinds_name)
        return {name: np.asarray(value) for name, value in inputs.items() if name not in of_text}


def _token_weights(text: str, tokens: Mapping[str, Any], decision_weight: float) -> np.ndarray:
    """Return the weights of an answer's tokens and end token, (m,) float32: 1, or that of the decision."""
    weights = np.ones(len(tokens["input_ids"]) + 1, dtype=np.float32)
    key = re.search(rf'"{FIELDS[-1]}"\s*:\s*"', text)
    if key is not None and "offset_mapping" in tokens:
        _, end = json.JSONDecoder().raw_decode(text, key.end() - 1)  # behind the closing quotation mark
        begins, ends = np.array(tokens["offset_mapping"]).reshape(-1, 2).T
        weights[:-1][(ends > key.end()) & (begins < end - 1)] = decision_weight
    return weights


def check_template(processor: Processor, sample: Sample) -> None:
    """Check that prompt, answer and end are, character by character, what the chat template writes for the chat."""
    written = processor.chat_text(sample)
    taught = processor.prompt_text(sample) + processor.lead + sample.answer + processor.end_of_answer
    if taught != written:
        differs = (i for i, (a, b) in enumerate(zip(taught, written, strict=False)) if a != b)
        at = next(differs, min(len(taught), len(written)))
        expected = f"{taught[at : at + 40]!r} at character {at}"
        got = f"{written[at : at + 40]!r} at character {at}"
        words = "the chat template does not write the text that the student is trained on"
        raise InputError(words, where="student", got=got, expected=expected, fix="correct the chat template")


def padded(processor: Processor, rows: Sequence[EncodedSample]) -> dict[str, np.ndarray]:
    """Pad samples on the right, (b, n): the model's inputs, `labels` with IGNORED outside the answers, and `weights`.

    Causal attention never sees what is on the right, so no mask is needed.
    """
    ids = _stacked([np.append(row.prompt_ids, row.answer_ids) for row in rows], processor.pad_token_id)
    labels = [np.append(np.full_like(row.prompt_ids, IGNORED), row.answer_ids) for row in rows]
    weights = [np.append(np.zeros(len(row.prompt_ids), np.float32), row.weights) for row in rows]
    batch = {"input_ids": ids, "labels": _stacked(labels, IGNORED), "weights": _stacked(weights, 0)}
    kinds = _stacked([np.append(row.kinds, np.zeros_like(row.answer_ids)) for row in rows], 0)
    return batch | ({processor.kinds_name: kinds} if kinds.any() else {})


def prompt_batch(processor: Processor, rows: Sequence[EncodedSample]) -> dict[str, np.ndarray]:
    """Pad prompts on the left, (b, n), so that all continue at the same place: the model's inputs without pictures."""
    ids = _stacked([row.prompt_ids for row in rows], processor.pad_token_id, is_left=True)
    mask = _stacked([np.ones_like(row.prompt_ids) for row in rows], 0, is_left=True)
    kinds = _stacked([row.kinds for row in rows], 0, is_left=True)
    batch = {"input_ids": ids, "attention_mask": mask}
    return batch | ({processor.kinds_name: kinds} if kinds.any() else {})


def _stacked(rows: Sequence[np.ndarray], fill: int, *, is_left: bool = False) -> np.ndarray:
    """Pad rows to the longest one, on the right or the left; whole numbers become int64, as PyTorch needs them."""
    dtype = np.float32 if rows[0].dtype == np.float32 else np.int64
    stacked = np.full((len(rows), max(map(len, rows))), fill, dtype)
    for i, row in enumerate(rows):
        start = stacked.shape[1] - len(row) if is_left else 0
        stacked[i, start : start + len(row)] = row
    return stacked
