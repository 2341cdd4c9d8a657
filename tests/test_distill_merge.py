"""distill merge: an adapter in its base's weights, against the base with the adapter beside it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra distill")
pytest.importorskip("peft", reason="needs the extra distill")

from safetensors import safe_open  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402
from specimens_distill import TEACHING, make_adapter  # noqa: E402
from specimens_students import inputs_of, samples_of, trees_of  # noqa: E402

from cosfly.chat.student_chat import TAUGHT, read_taught  # noqa: E402
from cosfly.errors import InputError  # noqa: E402
from cosfly.work.store import write_json  # noqa: E402
from distill.inference import merge  # noqa: E402
from distill.inference.merge import MergeConfig  # noqa: E402
from distill.student.checkpoint import ADAPTER_FACTS, base_digests  # noqa: E402
from distill.student.model import Student, load_student  # noqa: E402
from distill.student.random_student import make_tiny_student  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")

PIXELS = 64 * 64


def make_calm_student(folder: Path) -> Path:
    """A random student whose layers change little, as those of a trained one: else a rounding grows from layer to
    layer."""
    path = make_tiny_student(folder, seed=2) / "model.safetensors"
    tensors = {n: t * 0.25 if ".layers." in n and t.ndim == 2 else t for n, t in load_file(path).items()}
    save_file(tensors, path, {"format": "pt"})
    return folder


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    folder = make_calm_student(tmp_path_factory.mktemp("base") / "student")
    # Any file that servers need.
    shutil.copy(folder / "generation_config.json", folder / "video_preprocessor_config.json")
    return folder


@pytest.fixture(scope="module")
def adapter(base, tmp_path_factory) -> Path:
    return make_adapter(base, tmp_path_factory.mktemp("adapter") / "adapter")


@pytest.fixture(scope="module")
def inputs(place, base) -> dict:
    student = load_student(base, device="cpu", max_pixels=PIXELS)
    return inputs_of(student, samples_of(place)[:3], trees_of(place))


def logits(student: Student, inputs: dict) -> torch.Tensor:
    student.model.eval()
    with torch.inference_mode():
        return student.model(**inputs).logits


def test_merged_weights_give_the_logits_of_base_and_adapter(base, adapter, inputs, tmp_path):
    model = merge.run(MergeConfig(), base, adapter, tmp_path / "out")
    alone = logits(load_student(base, device="cpu", max_pixels=PIXELS), inputs)
    beside = logits(load_student(base, device="cpu", max_pixels=PIXELS, adapter=adapter), inputs)
    merged = logits(load_student(model, device="cpu", max_pixels=PIXELS), inputs)
    seen = inputs["attention_mask"].bool()
    torch.testing.assert_close(merged[seen], beside[seen], rtol=1e-5, atol=1e-5)
    assert float((merged - alone)[seen].abs().max()) > 0.1
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"]["kept"] == len(load_file(adapter / "adapter_model.safetensors")) // 2


@pytest.mark.parametrize("changes", [{"r": 3, "use_rslora": True}, {"target_modules": ["q_proj", "up_proj"]}])
def test_merged_as_peft_merges(base, tmp_path, changes):
    folder = make_adapter(base, tmp_path / "adapter", **changes)
    expected = load_student(base, device="cpu", max_pixels=PIXELS, adapter=folder).model.merge_and_unload().state_dict()
    found = load_file(merge.run(MergeConfig(), base, folder, tmp_path / "out") / "model.safetensors")
    before = load_file(base / "model.safetensors")
    changed = {name for name in found if not torch.equal(found[name], before[name])}
    assert changed
    assert not any("visual" in name for name in changed)
    for name, tensor in found.items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-6, atol=1e-6)


def test_a_model_folder_is_whole(base, adapter, tmp_path):
    model = merge.run(MergeConfig(), base, adapter, tmp_path / "out")
    assert {path.name for path in model.iterdir()} == {path.name for path in base.iterdir()} | {TAUGHT}
    for name in {path.name for path in base.iterdir()} - {"model.safetensors"}:
        assert (model / name).read_bytes() == (base / name).read_bytes()
    with safe_open(model / "model.safetensors", "pt") as file:
        assert file.metadata() == {"format": "pt"}
    assert read_taught(model) == read_taught(tmp_path / "out") == TEACHING
    from transformers import AutoModelForImageTextToText

    _, told = AutoModelForImageTextToText.from_pretrained(model, output_loading_info=True)
    assert not any(told[f"{kind}_keys"] for kind in ("missing", "unexpected", "mismatched"))


def sharded(base: Path, folder: Path) -> Path:
    """The base in bfloat16 and two files, with a tensor that transformers does not load, and as links as in a hub's
    cache."""
    folder.mkdir()
    (blobs := folder.parent / "blobs").mkdir()
    for path in base.iterdir():
        if path.suffix != ".safetensors":
            shutil.copy(path, blobs / path.name)
    tensors = {name: t.to(torch.bfloat16) for name, t in load_file(base / "model.safetensors").items()}
    names = sorted(tensors)
    parts = [names[: len(names) // 2], names[len(names) // 2 :]]
    files = [f"model-0000{i}-of-00002.safetensors" for i in (1, 2)]
    extra = {"mtp.layers.0.weight": torch.arange(6, dtype=torch.bfloat16)}
    for file, part in zip(files, parts, strict=True):
        save_file(
            {name: tensors[name] for name in part} | (extra if file is files[1] else {}), blobs / file, {"format": "pt"}
        )
    weight_map = {name: file for file, part in zip(files, parts, strict=True) for name in part}
    weight_map["mtp.layers.0.weight"] = files[1]
    write_json(blobs / "model.safetensors.index.json", {"metadata": {"total_size": 1}, "weight_map": weight_map})
    for path in blobs.iterdir():
        (folder / path.name).symlink_to(Path("..") / "blobs" / path.name)
    return folder


@pytest.mark.parametrize(("dtype", "expected"), [("base", torch.bfloat16), ("float32", torch.float32)])
def test_several_files_of_bfloat16_out_of_a_hubs_cache(base, tmp_path, dtype, expected):
    model = sharded(base, tmp_path / "snapshot")
    adapter = make_adapter(model, tmp_path / "adapter")
    merged = merge.run(MergeConfig(dtype=dtype), model, adapter, tmp_path / "out")
    assert not any(path.is_symlink() for path in merged.iterdir())
    found = {name: t for path in sorted(merged.glob("*.safetensors")) for name, t in load_file(path).items()}
    before = {name: t for path in sorted(model.glob("*.safetensors")) for name, t in load_file(path).items()}
    assert found.keys() == before.keys()
    updates = merge.Updates(adapter)
    for name, tensor in found.items():
        if name in updates:
            assert torch.equal(tensor, updates.add_to(name, before[name]).to(expected))
        else:
            assert torch.equal(tensor, before[name])
            assert tensor.dtype == before[name].dtype
    index = json.loads((merged / "model.safetensors.index.json").read_text())
    assert index["metadata"]["total_size"] == sum(t.numel() * t.element_size() for t in found.values())
    assert all(name in load_file(merged / file) for name, file in index["weight_map"].items())
    inputs = {"input_ids": torch.tensor([[5, 6, 7]])}
    assert torch.isfinite(logits(load_student(merged, device="cpu", max_pixels=PIXELS), inputs)).all()


def test_an_adapter_of_another_base_is_refused(adapter, tmp_path):
    other = make_tiny_student(tmp_path / "other", seed=9)
    with pytest.raises(InputError, match="trained on another model"):
        merge.run(MergeConfig(), other, adapter, tmp_path / "out")
    assert not (tmp_path / "out" / "model").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"use_dora": True}, "use_dora"), ({"rank_pattern": {"q_proj": 2}}, "rank_pattern"), ({"bias": "all"}, "bias")],
)
def test_another_kind_of_adapter_is_refused(base, adapter, tmp_path, changes, words):
    shutil.copytree(adapter, tmp_path / "adapter")
    path = tmp_path / "adapter" / "adapter_config.json"
    write_json(path, json.loads(path.read_text()) | changes)
    with pytest.raises(InputError, match=words):
        merge.run(MergeConfig(), base, tmp_path / "adapter", tmp_path / "out")
    assert not (tmp_path / "out" / "model").exists()


def test_damaged_adapters_are_refused(base, adapter, tmp_path):
    tensors = load_file(adapter / "adapter_model.safetensors")
    name = sorted(tensors)[0]
    stranger = name.replace("layers.0", "layers.77")
    pair = {stranger: tensors[name].clone(), stranger.replace("lora_A", "lora_B"): torch.ones(8, 4)}
    for number, (changed, words) in enumerate([
        ({n: t for n, t in tensors.items() if n != name}, "half an update"),
        (tensors | pair, "no layer that the adapter changes"),
        (tensors | {name.replace(".lora_A", ".other"): torch.ones(2)}, "not a tensor of a LoRA"),
        (tensors | {name: torch.ones(4, 7)}, "another shape"),
        (tensors | {name: tensors[name] * np.nan}, "not finite"),
    ]):  # fmt: skip
        folder = tmp_path / f"adapter_{number}"
        shutil.copytree(adapter, folder)
        save_file(changed, folder / "adapter_model.safetensors")
        with pytest.raises(InputError, match=words):
            merge.run(MergeConfig(), base, folder, tmp_path / f"out_{number}")
        assert [path.name for path in (tmp_path / f"out_{number}").iterdir() if path.is_dir()] == []


def test_damaged_files_are_named(base, adapter, tmp_path):
    shutil.copytree(adapter, tmp_path / "adapter")
    path = tmp_path / "adapter" / "adapter_model.safetensors"
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(InputError, match=r"adapter_model.*a damaged file of weights"):
        merge.run(MergeConfig(), base, tmp_path / "adapter", tmp_path / "out")
    broken = tmp_path / "base"
    shutil.copytree(base, broken)
    (broken / "model.safetensors").write_bytes((base / "model.safetensors").read_bytes()[:-7])
    fitting = shutil.copytree(adapter, tmp_path / "fitting")
    facts = json.loads((fitting / ADAPTER_FACTS).read_text())
    write_json(fitting / ADAPTER_FACTS, facts | {"base_sha256": base_digests(broken)})
    with pytest.raises(InputError, match="a damaged file of weights"):
        merge.run(MergeConfig(), broken, fitting, tmp_path / "other")
    assert not list((tmp_path / "other").glob("*.safetensors"))


def test_whole_weights_need_no_merge(base, tmp_path):
    with pytest.raises(InputError, match="whole weights already"):
        merge.run(MergeConfig(), base, base, tmp_path / "out")
    with pytest.raises(InputError, match="not an adapter"):
        merge.run(MergeConfig(), base, tmp_path, tmp_path / "out")


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_leaves_nothing_half(base, adapter, tmp_path):
    """By a real limit on the size of files, in a process of its own."""
    program = (
        "import resource, signal, sys\nfrom cosfly.cli import main\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, resource.RLIM_INFINITY))\nmain()\n"
    )
    assert (base / "model.safetensors").stat().st_size > 500_000
    merging = ["merge", "--model", str(base), "--adapter", str(adapter), "--out", str(tmp_path / "out")]
    command = [sys.executable, "-c", program, "distill", *merging]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: "), done.stderr
    assert "File too large; free some space" in done.stderr
    assert "Traceback" not in done.stderr
    assert not [*tmp_path.rglob("*.partial"), *tmp_path.rglob("*.safetensors")]
    merge.run(MergeConfig(), base, adapter, tmp_path / "out")
    assert (tmp_path / "out" / "model" / "model.safetensors").exists()
