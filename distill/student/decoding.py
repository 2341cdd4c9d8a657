"""Greedy decoding of a batch of prompts over state of a fixed size: what `generate` gives, in less time.

All tensors of a step stand at fixed places, sizes change only when rows leave. Positions, mask and caches are handed to
the language model as they are, so it derives nothing of its own. On an accelerator a step is recorded once for a size
and played again: most of what a step of a small batch takes is the host's telling it what to do.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from distill.student.encoding import EncodedSample, prompt_batch
from distill.student.model import Student

log = logging.getLogger(__name__)

Play = Callable[[], None]
Record = Callable[[Callable[[], None]], Play | None]


def recorder_for(student: Student) -> Record | None:
    """Return what records the steps of a student; None where nothing can be recorded, as on a CPU."""
    return record_graph if student.device == "cuda" else None


def record_graph(step: Callable[[], None]) -> Play | None:
    """Record a step as a CUDA graph. Recording computes nothing; playing it moves the very tensors that the step named.

    Args:
        step: has run once with tensors of these sizes. It may neither ask for a value nor wait, and writes in place
            what it keeps; a tensor that it makes anew stays where it is and gets new values each time it is played.
    Returns:
        What plays it; None where it cannot be recorded, which is logged: it is then computed plainly.
    """
    import torch

    graph = torch.cuda.CUDAGraph()
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads read pictures meanwhile
            step()
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:
        log.warning("CUDA graphs are not used for decoding, which is slower: %s", str(error).splitlines()[0][:120])
        return None
    return graph.replay


# Rows that ended leave together, once they are this share of the batch: each leaving copies the state of those that
# stay, and has a recorded step recorded anew, which takes as long as some ten steps that are played.
LEAVING_SHARE, LEAVING_SHARE_RECORDED = 0.25, 0.5


@dataclass(frozen=True)
class Completion:
    """An answer. num_tokens: its end token is not counted. is_finished: it ended by itself."""

    text: str
    num_tokens: int
    is_finished: bool


class Constraint(Protocol):
    """Says which tokens may come next; rows are counted as they were given to `decode`."""

    def allowed(self, rows: Sequence[int], num_tokens: int) -> np.ndarray:
        """Return (len(rows), num_tokens / 8, rounded up) uint8, a bit a token, the lowest first; each row allows
        one."""

    def consume(self, row: int, token: int) -> None:
        """Note the token that a row was continued with."""


def decode(
    student: Student,
    rows: Sequence[EncodedSample],
    features: Any,
    *,
    max_tokens: int,
    constraint: Constraint | None = None,
    is_recorded: bool = True,
) -> list[Completion]:
    """Answer a batch of prompts greedily; their answers in `rows` are not looked at.

    Args:
        features: (image tokens of all rows, width), what the vision tower made of the pictures, row after row.
        max_tokens: longest answer, the end token included.
        is_recorded: on an accelerator, play steps from a recording: the same tokens in float32; bfloat16 may round
            otherwise.
    Returns:
        One for each row, in their order.
    """
    import torch

    with _evaluating(student), torch.inference_mode():
        batch = _Batch(student, rows, max_tokens, features, recorder_for(student) if is_recorded else None)
        ended: dict[int, list[int]] = {}
        for count in range(1, max_tokens + 1):
            chosen = _choose(batch, constraint)
            for place, token in enumerate(chosen):
                if token == student.end_token_id and batch.is_live[place]:
                    ended[batch.rows[place]] = batch.tokens_of(place)[: count - 1]
                    batch.is_live[place] = False
            if not any(batch.is_live) or count == max_tokens:
                break
            batch.drop_ended()
            batch.step()
        cut = {batch.rows[place]: batch.tokens_of(place) for place in batch.live}
    texts = ended | cut
    return [
        Completion(student.tokenizer.decode(texts[row], skip_special_tokens=False), len(texts[row]), row in ended)
        for row in range(len(rows))
    ]


@contextlib.contextmanager
def _evaluating(student: Student) -> Iterator[None]:
    """Switch dropout off, and on again where it was."""
    was_training = student.model.training
    student.model.eval()
    try:
        yield
    finally:
        student.model.train(was_training)


def _choose(batch: _Batch, constraint: Constraint | None) -> list[int]:
    """Choose the next token of every place, keep it, and give all of them."""
    import torch

    logits = batch.logits
    if constraint is not None:
        live = batch.live
        bits = np.full((len(batch.rows), -(-logits.shape[1] // 8)), 255, np.uint8)
        bits[live] = constraint.allowed([batch.rows[place] for place in live], logits.shape[1])
        packed = torch.from_numpy(bits).to(logits.device)[:, :, None]
        allowed = (packed >> torch.arange(8, dtype=torch.uint8, device=logits.device)) & 1
        logits = logits.masked_fill(allowed.flatten(1)[:, : logits.shape[1]] == 0, float("-inf"))
    chosen = batch.take(logits.argmax(dim=-1))
    if constraint is not None:
        for place in live:
            constraint.consume(batch.rows[place], chosen[place])
    return chosen


class _Batch:
    """The state of rows that are being answered: b places, prompts padded on the left to n tokens, room for n +
    max_tokens.

    rows: which row each place works on. is_live: whether it has not ended. logits: (b, vocabulary) float32 of the next
    token. All other tensors keep their place while no row leaves: tokens (b, 1), positions (3, b, 1), mask (b, 1, 1, n
    + max_tokens) bool, caches.
    """

    def __init__(
        self, student: Student, rows: Sequence[EncodedSample], max_tokens: int, features: Any, record: Record | None
    ) -> None:
        import torch
        from transformers import StaticCache

        self._record, self._is_warm = record, False
        self._play: Play | None = None
        self._head, self._core, self._dtype = student.core.lm_head, student.core.model, student.dtype
        self.rows, self.is_live = list(range(len(rows))), [True] * len(rows)
        inputs = prompt_batch(student, rows)
        ids, mask, grids = inputs["input_ids"], inputs["attention_mask"], inputs["image_grid_thw"]
        self._num_prompt, self._room = ids.shape[1], ids.shape[1] + max_tokens
        embedded = student.embedded(ids, features)
        positions, deltas = self._core.get_rope_index(ids, inputs["mm_token_type_ids"], grids, attention_mask=mask)
        self._cache = StaticCache(config=self._core.config, max_cache_len=self._room)
        hidden = self._run(embedded, positions, _prompt_mask(mask, self._room), mask)
        self.logits = self._logits(hidden)

        # What a step reads and moves on.
        device = ids.device
        self._tokens = torch.zeros((len(rows), 1), dtype=torch.int64, device=device)
        first = mask.sum(dim=1, keepdim=True) + deltas
        self._positions = first.expand(3, -1, 1).clone(memory_format=torch.contiguous_format)
        self._mask = torch.zeros((len(rows), 1, 1, self._room), dtype=torch.bool, device=device)
        self._mask[:, 0, 0, : self._num_prompt] = mask.bool()
        self._place = torch.tensor([self._num_prompt], device=device)  # where the next token goes
        self._chosen = torch.zeros((len(rows), max_tokens), dtype=torch.int64, device=device)

    @property
    def live(self) -> list[int]:
        """The places whose rows have not ended."""
        return [place for place, is_live in enumerate(self.is_live) if is_live]

    def tokens_of(self, place: int) -> list[int]:
        """Return the tokens chosen so far."""
        return self._chosen[place, : int(self._place) - self._num_prompt + 1].tolist()

    def drop_ended(self) -> None:
        """Take ended rows out, once there are enough of them."""
        import torch

        share = LEAVING_SHARE if self._record is None else LEAVING_SHARE_RECORDED
        stay = self.live
        if len(self.rows) - len(stay) < share * len(self.rows):
            return
        index = torch.tensor(stay, device=self._tokens.device)
        self._tokens, self._mask, self._chosen = self._tokens[index], self._mask[index], self._chosen[index]
        self._positions = self._positions[:, index]
        self._cache.reorder_cache(index)  # type: ignore[arg-type]  # the library says LongTensor of any tensor of int64
        self.rows, self.is_live = [self.rows[place] for place in stay], [True] * len(stay)
        self._play, self._is_warm = None, False  # what was recorded moves the state that was left behind

    def take(self, chosen: Any) -> list[int]:
        """Keep what was chosen, (b,) int64, as the tokens to go on with."""
        self._tokens.copy_(chosen[:, None])
        self._chosen.index_copy_(1, self._place - self._num_prompt, self._tokens)
        return chosen.tolist()

    def step(self) -> None:
        """Read the tokens taken last and compute the logits of the next.

        The first step of a size is computed plainly, so that libraries choose and compile their kernels; then one is
        recorded.
        """
        if self._record is not None and self._play is None and self._is_warm:
            self._play = self._record(self._advance)
            if self._play is None:
                self._record = None
        (self._play or self._advance)()
        self._is_warm = True

    def _advance(self) -> None:
        """Take one step; nothing in it asks the host, and all that stays is written in place, but `logits`."""
        self._mask.index_fill_(3, self._place, True)
        embedded = self._core.get_input_embeddings()(self._tokens).to(self._dtype)
        self.logits = self._logits(self._run(embedded, self._positions, self._mask, None))
        self._place.add_(1)
        self._positions.add_(1)

    def _run(self, embedded: Any, positions: Any, mask: Any, linear_mask: Any) -> Any:
        return self._core.language_model(
            inputs_embeds=embedded,
            position_ids=positions,
            attention_mask={"full_attention": mask, "linear_attention": linear_mask},
            past_key_values=self._cache,
            use_cache=True,
        ).last_hidden_state

    def _logits(self, hidden: Any) -> Any:
        return self._head(hidden[:, -1]).float()


def _prompt_mask(mask: Any, room: int) -> Any:
    """Return what each token of the prompts may look at, (b, 1, n, room) bool, from the mask of their tokens, (b, n).

    A token of the padding looks at itself, since attention to nothing at all is not a number.
    """
    import torch

    length = mask.shape[1]
    causal = torch.ones((length, length), dtype=torch.bool, device=mask.device).tril()
    itself = torch.eye(length, dtype=torch.bool, device=mask.device)
    seen = (causal & mask[:, None, :].bool()) | itself
    return torch.nn.functional.pad(seen, (0, room - length))[:, None]
