"""Libraries of students, each imported when a test first uses it: a worker without such a test loads none of them."""

import importlib
import importlib.util
from typing import Any

import pytest

if not all(map(importlib.util.find_spec, ("torch", "transformers", "peft"))):
    pytest.skip("needs the extra distill", allow_module_level=True)


class Later:
    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._module), name)


safetensors, torch, transformers = Later("safetensors.torch"), Later("torch"), Later("transformers")
qwen = Later("transformers.models.qwen3_5.modeling_qwen3_5")
