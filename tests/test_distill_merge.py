"""distill merge: an adapter in its base's weights, against the base with the adapter beside it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from later import safetensors, torch
from specimens_distill import make_adapter

from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import write_json
from distill.inference import merge
from distill.student.model import load_student
from distill.student.random_student import make_tiny_student

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    folder = make_tiny_student(tmp_path_factory.mktemp("base") / "student", seed=2)
    # Any file that servers need.
    shutil.copy(folder / "generation_config.json", folder / "video_preprocessor_config.json")
    return folder


@pytest.fixture(scope="module")
def adapter(base, tmp_path_factory) -> Path:
    return make_adapter(base, tmp_path_factory.mktemp("adapter") / "adapter")


@pytest.mark.parametrize("changes", [{}, {"r": 3, "use_rslora": True}, {"target_modules": ["q_proj", "up_proj"]}])
def test_merged_as_peft_merges(base, tmp_path, changes):
    folder = make_adapter(base, tmp_path / "adapter", **changes)
    expected = load_student(base, device="cpu", adapter=folder).model.merge_and_unload().state_dict()
    found = safetensors.load_file(merge.run(base, folder, tmp_path / "out") / "model.safetensors")
    before = safetensors.load_file(base / "model.safetensors")
    changed = {name for name in found if not torch.equal(found[name], before[name])}
    assert changed
    assert not any("visual" in name for name in changed)
    for name, tensor in found.items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-6, atol=1e-6)
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"]["kept"] == len(safetensors.load_file(folder / "adapter_model.safetensors")) // 2


def test_damaged_adapters_are_refused(base, adapter, tmp_path):
    tensors = safetensors.load_file(adapter / "adapter_model.safetensors")
    name = sorted(tensors)[0]
    stranger = name.replace("layers.0", "layers.77")
    pair = {stranger: tensors[name].clone(), stranger.replace("lora_A", "lora_B"): torch.ones(8, 4)}
    for number, (changed, words) in enumerate([
        ({n: t for n, t in tensors.items() if n != name}, "an update of the adapter is incomplete"),
        (tensors | pair, "lacks a layer that the adapter changes"),
        (tensors | {name.replace(".lora_A", ".other"): torch.ones(2)}, "not of a LoRA adapter"),
        (tensors | {name: torch.ones(4, 7)}, "size mismatch"),
        (tensors | {name: tensors[name] * np.nan}, "not finite"),
    ]):  # fmt: skip
        folder = tmp_path / f"adapter_{number}"
        shutil.copytree(adapter, folder)
        safetensors.save_file(changed, folder / "adapter_model.safetensors")
        with pytest.raises(InputError, match=words):
            merge.run(base, folder, tmp_path / f"out_{number}")
        assert [path.name for path in (tmp_path / f"out_{number}").iterdir() if path.is_dir()] == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"use_dora": True}, "use_dora"), ({"rank_pattern": {"q_proj": 2}}, "rank_pattern"), ({"bias": "all"}, "bias")],
)
def test_another_kind_of_adapter_is_refused(base, adapter, tmp_path, changes, words):
    shutil.copytree(adapter, tmp_path / "adapter")
    path = tmp_path / "adapter" / "adapter_config.json"
    write_json(path, json.loads(path.read_text()) | changes)
    with pytest.raises(InputError, match=words):
        merge.run(base, tmp_path / "adapter", tmp_path / "out")
    assert not (tmp_path / "out" / "model").exists()
