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
    """The tokens of a sample.

    prompt_ids (n,), answer_ids (m,) int32, the end token included in the answer. weights (m,) float32: in the loss.
    kinds (n,) int8: which tokens of the prompt are pictures, for families that want to know; 0 for others.
    """

    prompt_ids: np.ndarray
    answer_ids: np.ndarray
    weights: np.ndarray
    kinds: np.ndarray

    def __len__(self) -> int:
        return len(self.prompt_ids) + len(self.answer_ids)

    @property
    def weight(self) -> float:
        return float(self.weights.sum())


class _BySize:
    """An image processor that processes one blank picture per (number, size) and remembers the result.

    How many tokens a picture takes depends on its size alone, so prompts can be written before pictures are read.
    """

    def __init__(self, images: Any) -> None:
        self.images, self._known = images, dict[Any, Any]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.images, name)

    def __call__(self, images: Any, **settings: Any) -> Any:
        flat = [image for entry in images for image in (entry if isinstance(entry, list) else [entry])]
        key = tuple(image.size for image in flat), tuple(len(e) if isinstance(e, list) else 0 for e in images)
        if key not in self._known:
            self._known[key] = self.images(images, **settings)
        return type(self._known[key])(dict(self._known[key]))

    def fetch_images(self, images: Any) -> Any:
        return images


@dataclass
class Processor:
    """Turns texts and pictures into tensors; it has no model, so worker processes can hold it.

    library: transformers' processor of a family with pictures; None: a text-only student. template: chat template
    that replaces the student's own; empty: none.
    """

    tokenizer: Any
    library: Any
    template: str = ""

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
        """The token that ends an answer: the first that the template writes after one, or the tokenizer's own."""
        tokens, (_, after) = self.tokenizer.added_tokens_decoder, self._around_answer
        ends = [i for i, t in tokens.items() if t.special and after.startswith(t.content)]
        own = self.tokenizer.eos_token_id
        return int(ends[0]) if ends else -1 if own is None else int(own)

    @property
    def end_of_answer(self) -> str:
        """What is taught after an answer, and the rest of what the chat template writes after this token."""
        end, (_, after) = self.tokenizer.decode([self.end_token_id]), self._around_answer
        return after if after.startswith(end) else end

    @property
    def pad_token_id(self) -> int:
        found = self.tokenizer.pad_token_id
        return self.end_token_id if found is None else int(found)

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
        """Return the tokens of a sample.

        Args:
            max_pixels: limit of a picture, as in `limited_size`; 0: none.
            decision_weight: of the tokens of the decision in the loss; others have 1.
        """
        size_px = limited_size(sample.picture_px, max_pixels)
        try:
            found = self._tokens(self.prompt_text(sample), size_px, len(sample.images))
        except ValueError as error:
            fix = "remove special tokens for pictures from the text of the prompt"
            raise InputError("the prompt cannot be encoded", where=sample.key, got=str(error)[:200], fix=fix) from error
        text = self.lead + sample.answer
        answer = self.tokenizer(text, add_special_tokens=False, return_offsets_mapping=self.tokenizer.is_fast)
        ids = np.array(found["input_ids"][0], dtype=np.int32)
        kinds = found.get(self.kinds_name) if sample.images else None
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
        found = self._tokens(self._picture_text, (64, 64), 1)
        return next((name for name in found if name.endswith("token_type_ids")), "")

    @cached_property
    def _picture_text(self) -> str:
        return self._render([{"role": "user", "content": [IMAGE_PART, {"type": "text", "text": "x"}]}])

    def picture_inputs(self, picture: np.ndarray, *, is_alone: bool) -> dict[str, np.ndarray]:
        """Return a picture, (h, w, 3) uint8, as the inputs that the model takes of it.

        Args:
            is_alone: it is the only picture of its sample. LLaVA-OneVision cuts such a picture into tiles.
        """
        image = Image.fromarray(picture)
        found: dict[str, Any] = dict(self.library(text=[self._picture_text], images=[[image]], return_tensors="np"))
        if "batch_num_images" in found and not is_alone:
            twice = self.library(text=[self._picture_text * 2], images=[[image, image]], return_tensors="np")
            found = {name: value[:1] for name, value in twice.items()}
        of_text = ("input_ids", "attention_mask", self.kinds_name)
        return {name: np.asarray(value) for name, value in found.items() if name not in of_text}


def _token_weights(text: str, tokens: Mapping[str, Any], decision_weight: float) -> np.ndarray:
    """Return the weight of each token of an answer and of its end token, (m,) float32."""
    found = np.ones(len(tokens["input_ids"]) + 1, dtype=np.float32)
    key = re.search(rf'"{FIELDS[-1]}"\s*:\s*"', text)
    if key is not None and "offset_mapping" in tokens:
        _, end = json.JSONDecoder().raw_decode(text, key.end() - 1)  # behind the closing quotation mark
        begins, ends = np.array(tokens["offset_mapping"]).reshape(-1, 2).T
        found[:-1][(ends > key.end()) & (begins < end - 1)] = decision_weight
    return found


def special_token_in(processor: Processor, sample: Sample) -> str | None:
    """Return a token of the chat that a text of the sample contains; None: there is none."""
    texts = (sample.prompt.system, sample.prompt.user, sample.answer)
    return next((t for t in processor.chat_tokens if any(t in text for text in texts)), None)


def check_template(processor: Processor, sample: Sample) -> None:
    """Check that prompt, answer and end are, character by character, what the chat template writes for the chat."""
    whole = processor.chat_text(sample)
    taught = processor.prompt_text(sample) + processor.lead + sample.answer + processor.end_of_answer
    if taught != whole:
        at = next((i for i, pair in enumerate(zip(taught, whole, strict=False)) if len(set(pair)) > 1), len(taught))
        expected, got = (f"{text[at : at + 40]!r} at character {at}" for text in (taught, whole))
        words = "the chat template does not write the text that the student is trained on"
        raise InputError(words, where="student", got=got, expected=expected, fix="correct the chat template")


def padded(processor: Processor, rows: Sequence[EncodedSample]) -> dict[str, np.ndarray]:
    """Pad samples on the right, (b, n): the model's inputs, `labels` with IGNORED outside the answers, and `weights`.

    Causal attention never sees what is on the right, so no mask is needed.
    """
    ids = _stacked([np.append(row.prompt_ids, row.answer_ids) for row in rows], processor.pad_token_id)
    labels = [np.append(np.full_like(row.prompt_ids, IGNORED), row.answer_ids) for row in rows]
    weights = [np.append(np.zeros(len(row.prompt_ids), np.float32), row.weights) for row in rows]
    found = {"input_ids": ids, "labels": _stacked(labels, IGNORED), "weights": _stacked(weights, 0)}
    kinds = [np.append(row.kinds, np.zeros_like(row.answer_ids)) for row in rows]
    return found | ({processor.kinds_name: _stacked(kinds, 0)} if any(map(np.any, kinds)) else {})


def prompt_batch(processor: Processor, rows: Sequence[EncodedSample]) -> dict[str, np.ndarray]:
    """Pad prompts on the left, (b, n), so that all continue at the same place: the model's inputs without pictures."""
    ids = _stacked([row.prompt_ids for row in rows], processor.pad_token_id, is_left=True)
    mask = _stacked([np.ones_like(row.prompt_ids) for row in rows], 0, is_left=True)
    kinds = _stacked([row.kinds for row in rows], 0, is_left=True)
    found = {"input_ids": ids, "attention_mask": mask}
    return found | ({processor.kinds_name: kinds} if kinds.any() else {})


def _stacked(rows: Sequence[np.ndarray], fill: int, *, is_left: bool = False) -> np.ndarray:
    """Pad rows to the longest one; whole numbers become int64, as PyTorch wants them."""
    counts = [max(map(len, rows)) - len(row) for row in rows]
    pads = [(count, 0) if is_left else (0, count) for count in counts]
    found = np.stack([np.pad(row, pad, constant_values=fill) for row, pad in zip(rows, pads, strict=True)])
    return found if found.dtype == np.float32 else found.astype(np.int64)
