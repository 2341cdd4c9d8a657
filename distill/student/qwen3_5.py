"""Faster code for students of Qwen3.5's structure (3.5, 3.6, 3.8) on an accelerator; no other family is known here."""

import importlib.util
import logging
import sys
import types
from functools import cache
from importlib.machinery import ModuleSpec
from typing import Any

log = logging.getLogger(__name__)

CONVOLUTION = "causal_conv1d"  # a package with a short convolution, which transformers calls if it is installed
LINEAR_ATTENTION = "fla"


def choose_kernels(dtype: Any, device: str) -> None:
    """Decide which kernels transformers finds on an accelerator. Call this before it first loads the model's code.

    - In float32 it uses PyTorch's own functions, because the fast kernels of linear attention round to fewer digits or
      do not support float32.
    - Otherwise it uses the fast kernels that are installed. If only causal-conv1d is missing, which has to be compiled,
      the short convolution of flash-linear-attention replaces it.
    """
    import torch

    if device != "cuda":
        return
    if missing := [name for name in (LINEAR_ATTENTION, CONVOLUTION) if importlib.util.find_spec(name) is None]:
        words = "Qwen3.5 is slow without %s: pip install flash-linear-attention tilelang causal-conv1d"
        log.warning(words, " and ".join(missing))
    if dtype == torch.float32:
        for package in (LINEAR_ATTENTION, CONVOLUTION):
            # None makes an import fail; a package that is already imported stays.
            sys.modules.setdefault(package, None)  # type: ignore[arg-type]
    elif missing == [CONVOLUTION]:
        module = types.ModuleType(CONVOLUTION)
        module.__spec__ = ModuleSpec(CONVOLUTION, None)
        module.causal_conv1d_fn = _convolution  # type: ignore[attr-defined]
        sys.modules[CONVOLUTION] = module


def _convolution(x: Any, weight: Any, bias: Any = None, activation: str | None = None) -> Any:
    """Convolve along time, as causal-conv1d's function: x (b, d, t), weight (d, width) -> (b, d, t)."""
    from fla.modules.causal_conv1d import causal_conv1d

    convolved, _ = causal_conv1d(x.transpose(1, 2).contiguous(), weight, bias, activation=activation)
    return convolved.transpose(1, 2)


# --- norms ------------------------------------------------------------------------------------------------------------


def fuse_norms(model: Any) -> None:
    """Compute each norm of a language model by one kernel, which stores its input and one number per row for the
    backward pass.

    The library computes them step by step in float32 and stores the input of each step. In float32 the results are the
    same; in bfloat16 the normed values are rounded once more before they are scaled.
    """
    fused = _fused_norms()
    for module in model.modules():
        if type(module) in fused:
            module.__class__ = fused[type(module)]  # it has the same attributes; only `forward` differs


@cache
def _fused_norms() -> dict[type, type]:
    """Return the library's classes of norms -> those that replace them. As in the library, the plain norm scales by
    1 + weight, the gated one by its weight."""
    import torch
    from transformers.models.qwen3_5.modeling_qwen3_5 import Qwen3_5RMSNorm, Qwen3_5RMSNormGated

    def normed(x: Any, eps: float) -> Any:
        with torch.autocast(x.device.type, enabled=False):  # which would have it in float32
            return torch.nn.functional.rms_norm(x, x.shape[-1:], None, eps)

    class FusedNorm(Qwen3_5RMSNorm):
        def forward(self, x: Any) -> Any:
            return (normed(x, self.eps) * (1.0 + self.weight.float())).type_as(x)

    class FusedGatedNorm(Qwen3_5RMSNormGated):
        def forward(self, hidden_states: Any, gate: Any) -> Any:
            scaled = self.weight * normed(hidden_states, self.variance_epsilon)
            return (scaled * torch.nn.functional.silu(gate.float())).type_as(hidden_states)

    return {Qwen3_5RMSNorm: FusedNorm, Qwen3_5RMSNormGated: FusedGatedNorm}
