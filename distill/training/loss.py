"""The loss: weighted negative log-likelihood of answer tokens, without a table of logits for all of them at once.

With a vocabulary of 248,320 the logits of one token take a megabyte, and plain training keeps three such tables for
every token of a batch. Here they exist for a chunk of answer tokens at a time: loss and gradient of the chunk are
computed together, and only what has the width of the network is kept (fused linear cross-entropy, as in Hsu et al.
2024, Liger Kernel).
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

from cosfly.runtime.errors import ConfigError
from distill.student.chat import IGNORED, EncodedSample, padded
from distill.student.features import Tensors, with_encoded_pictures
from distill.student.model import Student


@cache
def _chunked_loss() -> Any:
    """Return the function of autograd; made on first use, because torch is imported where it is used."""
    import torch

    class ChunkedLoss(torch.autograd.Function):
        """weights @ nats of targets under softmax(hidden @ head.T)."""

        @staticmethod
        def forward(ctx: Any, hidden: Any, head: Any, targets: Any, weights: Any, chunk: int, dtype: Any) -> Any:
            wants_hidden, wants_head = ctx.needs_input_grad[:2]
            head_used = head.to(dtype)
            nats = torch.empty(len(targets), dtype=torch.float32, device=hidden.device)
            hidden_gradient = torch.empty_like(hidden) if wants_hidden else None
            head_gradient = torch.zeros_like(head, dtype=torch.float32) if wants_head else None
            for start in range(0, len(targets), chunk):
                part = slice(start, start + chunk)
                used = hidden[part].to(dtype)
                logits = (used @ head_used.T).float()
                normalizers = torch.logsumexp(logits, dim=-1)
                rows = torch.arange(len(logits), device=logits.device)
                nats[part] = normalizers - logits[rows, targets[part]]
                if not (wants_hidden or wants_head):
                    continue
                gradient = logits.sub_(normalizers[:, None]).exp_()  # softmax, in the place of the logits
                gradient[rows, targets[part]] -= 1.0
                gradient = gradient.mul_(weights[part, None]).to(dtype)
                if hidden_gradient is not None:
                    hidden_gradient[part] = (gradient @ head_used).to(hidden.dtype)
                if head_gradient is not None:
                    head_gradient += (gradient.T @ used).float()
            ctx.save_for_backward(hidden_gradient, head_gradient)
            ctx.head_dtype = head.dtype
            return (weights * nats).sum()

        @staticmethod
        def backward(ctx: Any, total_gradient: Any) -> tuple[Any, ...]:
            hidden_gradient, head_gradient = ctx.saved_tensors
            for_hidden = None if hidden_gradient is None else hidden_gradient * total_gradient
            for_head = None if head_gradient is None else (head_gradient * total_gradient).to(ctx.head_dtype)
            return for_hidden, for_head, None, None, None, None

    return ChunkedLoss


def chunked_loss(hidden: Any, head: Any, targets: Any, weights: Any, *, chunk: int, dtype: Any) -> Any:
    """Return the weighted negative log-likelihood of tokens, which can be differentiated by hidden and head.

    Args:
        hidden: (n, width), what the network says before its head. head: (vocabulary, width).
        targets: (n,) int64, the tokens. weights: (n,) float32.
        chunk: tokens whose logits exist at a time. dtype: what the products are computed in; the rest is float32.
    """
    return _chunked_loss().apply(hidden, head, targets, weights, chunk, dtype)


def answer_loss(student: Student, rows: Sequence[EncodedSample], features: Sequence[Tensors], chunk: int) -> Any:
    """Run samples forward, padded on the right, and return the sum over all answer tokens of weight times nats;
    `features` are those of the pictures of all rows, row after row."""
    import torch

    batch = {name: torch.from_numpy(array).to(student.device) for name, array in padded(student, rows).items()}
    labels, weights = batch.pop("labels")[:, 1:], batch.pop("weights")[:, 1:]
    with student.computing(), with_encoded_pictures(student, features) as picture_inputs:
        hidden = student.core.base_model(**batch, **picture_inputs, use_cache=False).last_hidden_state
    is_target = labels != IGNORED
    hidden = hidden[:, :-1][is_target]  # the token at i is predicted at i - 1
    head = student.core.get_output_embeddings().weight
    return chunked_loss(hidden, head, labels[is_target], weights[is_target], chunk=chunk, dtype=student.dtype)


def check_head(student: Student) -> None:
    """Check that logits are the product of the last hidden state and the head, from which the loss is computed."""
    import torch

    head, ids = student.core.get_output_embeddings(), torch.full((1, 4), student.end_token_id, device=student.device)
    if type(head) is not torch.nn.Linear or head.bias is not None:
        got = type(head).__name__
        raise ConfigError("the head is not a plain linear layer", where="student", got=got, fix="use another student")
    with torch.no_grad(), student.computing():
        logits = student.core(input_ids=ids, use_cache=False).logits.float()
        hidden = student.core.base_model(input_ids=ids, use_cache=False).last_hidden_state
        plain = (hidden.to(student.dtype) @ head.weight.to(student.dtype).T).float()
    if not torch.allclose(logits, plain, rtol=0.05, atol=0.05 * float(logits.abs().max())):
        words = "the loss cannot be computed, because the student changes its logits after the output head"
        raise ConfigError(words, where="student", got=type(student.core).__name__, fix="use another student")
