"""distill merge: an adapter in its base's weights, against the base with the adapter beside it."""

import shutil
from pathlib import Path

import pytest
from later import safetensors, torch
from specimens_distill import make_adapter

from distill.inference import merge
from distill.student.model import load_student
from distill.student.random_student import make_random_student

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    folder = make_random_student(tmp_path_factory.mktemp("base") / "student", seed=2)
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
