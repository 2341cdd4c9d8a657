"""distill: the fused norms of Qwen3.5 against those of transformers."""

from __future__ import annotations

import pytest
from later import qwen, torch

from distill.student import qwen3_5


def norms(dtype) -> torch.nn.ModuleDict:
    torch.manual_seed(0)
    found = torch.nn.ModuleDict({"plain": qwen.Qwen3_5RMSNorm(48), "gated": qwen.Qwen3_5RMSNormGated(48)})
    with torch.no_grad():
        for parameter in found.parameters():
            parameter.add_(0.3 * torch.randn(48))
    return found.to(dtype)


def computed(found: torch.nn.ModuleDict, dtype, autocast: bool) -> list[torch.Tensor]:
    """Outputs, and gradients of inputs and weights."""
    torch.manual_seed(1)
    x, gate = (torch.randn(3, 7, 48, dtype=dtype).requires_grad_() for _ in range(2))
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        outputs = [found["plain"](5.0 * x), found["gated"](0.1 * x, gate)]
    sum((output.float() ** 3).sum() for output in outputs).backward()
    return [*outputs, x.grad, gate.grad, *(p.grad for p in found.parameters())]


@pytest.mark.parametrize(("dtype", "autocast", "tolerance"), [
    ("float32", False, 1e-5), ("float32", True, 1e-5), ("bfloat16", False, 0.03), ("bfloat16", True, 0.03),
])  # fmt: skip
def test_fused_norms_are_the_librarys_with_their_gradients(dtype, autocast, tolerance):
    dtype = getattr(torch, dtype)
    plain, fused = norms(dtype), norms(dtype)
    qwen3_5.fuse_norms(fused)
    assert {type(module).__name__ for module in fused.values()} == {"FusedNorm", "FusedGatedNorm"}
    assert fused.state_dict().keys() == plain.state_dict().keys()
    for found, wanted in zip(computed(fused, dtype, autocast), computed(plain, dtype, autocast), strict=True):
        assert found.dtype == wanted.dtype
        assert (found - wanted).float().norm() <= tolerance * wanted.float().norm()
