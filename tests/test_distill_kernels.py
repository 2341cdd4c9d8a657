"""distill: faster code for parts of a student against the library's, and which code is chosen when."""

from __future__ import annotations

import pytest
from later import qwen, torch
from tables import each

from distill.student import kernels


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
    kernels.fuse_norms(fused)
    assert {type(module).__name__ for module in fused.values()} == {"FusedNorm", "FusedGatedNorm"}
    assert fused.state_dict().keys() == plain.state_dict().keys()
    for found, wanted in zip(computed(fused, dtype, autocast), computed(plain, dtype, autocast), strict=True):
        assert found.dtype == wanted.dtype
        assert (found - wanted).float().norm() <= tolerance * wanted.float().norm()


@each("grids", [[[1, 4, 6]] * 5, [[1, 4, 6], [1, 2, 8], [1, 4, 6]]])
def test_a_tower_attends_to_pictures_of_one_size_at_once_and_gives_the_same(grids):
    cfg = qwen.Qwen3_5VisionConfig(depth=2, hidden_size=32, intermediate_size=64, num_heads=2, out_hidden_size=48)
    cfg._attn_implementation = "sdpa"
    torch.manual_seed(0)
    towers = [qwen.Qwen3_5VisionModel(cfg), qwen.Qwen3_5VisionModel(cfg)]
    towers[1].load_state_dict(towers[0].state_dict())
    kernels.look_at_equal_sizes_at_once(towers[1])
    assert type(towers[1].blocks[0].attn).__name__ == "JoinedAttention"
    found = []
    for tower in towers:
        for seed in (1, 2):  # borders of another call are not those of the one before
            patches = torch.randn(sum(h * w for _, h, w in grids), 1536, generator=torch.Generator().manual_seed(seed))
            output = tower(patches, torch.tensor(grids)).pooler_output
            output.square().sum().backward()
        found.append([output, *(p.grad for p in tower.parameters())])
    for ours, wanted in zip(*found, strict=True):
        assert torch.allclose(ours, wanted, atol=1e-5, rtol=1e-4)
