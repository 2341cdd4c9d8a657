"""Products against the records of who made them: what is noticed when a stage begins, and what when all is read."""

import os
import shutil
from pathlib import Path

import pytest

from cosfly.runtime import run_dir
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import sha256_bytes, sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import dump_json, read_json, write_json
from cosfly.runtime.run_dir import StageFolder, Tally


def begin(out: Path, name: str, **inputs: Path) -> StageFolder:
    return StageFolder.open(out, name, config=Config(), inputs=inputs, seed=0)


def make(out: Path, name: str, files: dict[str, str], **inputs: Path) -> Path:
    stage = begin(out, name, **inputs)
    for file, text in files.items():
        write_bytes(out / file, text.encode())
    stage.finish([out / file for file in files], Tally(input=1, kept=1))
    return out


def make_tree(out: Path, text: str = "", **inputs: Path) -> Path:
    stage = begin(out, "render", **inputs)
    outputs = []
    for flight in ("Town1/trajectory_1/ORI", "Town1/trajectory_2/ORI"):
        folder = out / flight
        files = {"trajectory.json": f"{flight}{text}", "frames_playback/frame_00000/rgb.png": f"picture of {flight}"}
        for name, content in files.items():
            write_bytes(folder / name, content.encode())
        write_checksums(folder, {name: sha256_file(folder / name) for name in files})
        outputs += [folder / "trajectory.json", folder / "checksums.sha256"]
    stage.finish(outputs, Tally(input=2, kept=2))
    return out


@pytest.fixture
def run(tmp_path) -> Path:
    boxes = make(tmp_path / "simplify", "simplify", {"map.json": "boxes"}) / "map.json"
    traces = make(tmp_path / "plan", "plan", {"traces.json": "flights"}, map=boxes) / "traces.json"
    tree = make_tree(tmp_path / "render", simplified=boxes, traces=traces)
    make(tmp_path / "caption", "caption", {"captions.jsonl": "a\nb\n"}, data=tree)
    return tmp_path


def inputs_of(run: Path) -> dict[str, Path]:
    files = {"simplified": "simplify/map.json", "traces": "plan/traces.json", "data": "render"}
    return {name: run / path for name, path in (files | {"captions": "caption/captions.jsonl"}).items()}


def test_what_belongs_together_is_taken(run):
    found = run_dir.checked_inputs(inputs_of(run))
    assert found["simplified"].sha256 == sha256_bytes(b"boxes")
    listed = read_json(run / "render/manifest.json")["outputs"]
    assert found["data"].sha256 == sha256_bytes(dump_json(listed).encode()), "as in the records of earlier runs"


def test_captions_of_another_tree_are_refused(run):
    other = make_tree(run / "other", "of another seed")
    with pytest.raises(
        VerifyError, match=r"captions\.jsonl: captions.jsonl was made with another input .data.*got .*other"
    ):
        run_dir.checked_inputs(inputs_of(run) | {"data": other})
    captions = make(run / "c2", "caption", {"captions.jsonl": "c"}, data=other) / "captions.jsonl"
    two = {"0.data": run / "render", "0.captions": run / "caption/captions.jsonl"}
    two |= {"1.data": other, "1.captions": captions}
    run_dir.checked_inputs(two)
    with pytest.raises(VerifyError, match="was made with another input"):
        run_dir.checked_inputs(two | {"0.captions": captions})


@pytest.mark.parametrize("name", ["manifest.json", "stage.json"])
def test_a_stage_without_its_records_is_not_finished(run, name):
    (run / "caption" / name).unlink()
    with pytest.raises(VerifyError, match=f"not finished, or its records are missing; got no {name}"):
        run_dir.checked_inputs(inputs_of(run))
    alone = run / "alone/captions.jsonl"
    alone.parent.mkdir()
    shutil.copy(run / "caption/captions.jsonl", alone)
    run_dir.checked_inputs(inputs_of(run) | {"captions": alone})


def test_a_name_that_no_record_can_hold(tmp_path):
    path = tmp_path / os.fsdecode(b"bad\xff.json")
    write_json(path, [])
    with pytest.raises(InputError, match=r"bad\\udcff.json: the path of an input contains a name that is not UTF-8"):
        begin(tmp_path / "out", "simplify", map=path)
    assert not (tmp_path / "out").exists()


def test_records_of_others_are_not_ours(tmp_path):
    write_json(tmp_path / "manifest.json", {"name": "an app"})
    write_json(tmp_path / "map.json", [])
    run_dir.checked_inputs({"map": tmp_path / "map.json"})


def test_a_tree_of_others_with_a_manifest_of_theirs_is_known_by_its_flights(tmp_path):
    write_json(tmp_path / "manifest.json", {"name": "a data set"})
    write_json(tmp_path / "flight/trajectory.json", 1)
    before = run_dir.fingerprint(tmp_path)
    write_json(tmp_path / "flight/trajectory.json", 2)
    assert run_dir.fingerprint(tmp_path) != before


def test_a_folder_without_checksums_is_as_good_as_one_with_them(run):
    folder = run / "render/Town1/trajectory_1/ORI"
    whole = run_dir.folder_digests(folder)
    lines = (folder / "checksums.sha256").read_text().splitlines(keepends=True)
    assert run_dir.digest_of(whole) == sha256_file(folder / "checksums.sha256")
    (folder / "checksums.sha256").write_text(lines[0])
    assert run_dir.folder_digests(folder) == whole, "what it leaves out is read"
    (folder / "checksums.sha256").unlink()
    assert run_dir.folder_digests(folder) == whole
