"""Files of a run: never half written, checked against the records of who made them; the PNG reader and writer."""

import errno
import io
import os
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pydantic import Field

from cosfly.runtime import io as store
from cosfly.runtime import run_dir
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import InputError, NothingKept, ResumeError, StorageError, VerifyError
from cosfly.runtime.io import inside, sha256_bytes, sha256_file, write_bytes, write_checksums
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import dump_json, read_json, write_json
from cosfly.runtime.png import areas_png, colours_png, floats_of, floats_png, pixels_of
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, read_manifest, write_failures
from specimens import png_around


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_json(path, {"old": 1})

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"a\.json.*No space left.*free some space"):
        write_json(path, {"new": 2})
    assert read_json(path) == {"old": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]  # no litter


def test_nan_is_never_a_value(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    (tmp_path / "b.json").write_text('{"x": NaN}')
    with pytest.raises(InputError, match=r"b\.json: the text is not valid JSON"):
        read_json(tmp_path / "b.json")


def test_names_stay_inside(tmp_path):
    assert inside(tmp_path, "a/b") == tmp_path.resolve() / "a/b"
    for name in ("../x", "/etc/passwd", "a/../../x"):
        with pytest.raises(InputError, match="leads out"):
            inside(tmp_path, name)
    assert inside(tmp_path, "a" * 255)
    for name in ("a" * 256, "b/" + "行" * 86 + "/c", "a\0b", "\ud800"):
        with pytest.raises(InputError, match=r"is not valid|invalid character"):
            inside(tmp_path, name)


@given(st.lists(st.dictionaries(st.text(max_size=5), st.text(max_size=20), max_size=3), max_size=6), st.data())
def test_a_journal_cut_anywhere_keeps_its_whole_lines(tmp_path_factory, records, data):
    path = tmp_path_factory.mktemp("journal") / "j.jsonl"
    with Journal(path) as journal:
        for record in records:
            journal.append(record, sync=False)
    whole = path.read_bytes() if records else b""
    cut = data.draw(st.integers(0, len(whole)))
    path.write_bytes(whole[:cut])
    expected = records[: whole[:cut].count(b"\n")]
    assert list(Journal(path).read()) == expected
    with Journal(path) as journal:  # and it can be continued
        journal.append({"next": 1})
    assert list(Journal(path).read()) == [*expected, {"next": 1}]


def test_a_damaged_line_is_counted(tmp_path):
    path = tmp_path / "j.jsonl"
    with Journal(path) as journal:
        for i in range(3):
            journal.append({"i": i})
    text = path.read_bytes().replace(b'{"i":1}', b'{"i":7}')
    path.write_bytes(text)
    journal = Journal(path)
    assert list(journal.read()) == [{"i": 0}, {"i": 2}]
    assert journal.num_damaged == 1


class Demo(Config):
    a: dict[str, int] = Field({"b": 1})
    threads: MayDiffer[int] = 1


def _open(out: Path, name: str = "demo", **changes) -> StageFolder:
    return StageFolder.open(out, name, **{"config": Demo(), "inputs": {}, "seed": 0, **changes})


def _finished(out: Path, tally=Tally(input=1, kept=1), name: str = "demo", file: str = "product.json", **changes):
    stage = _open(out, name, **changes)
    write_json(out / file, f"of {name}")
    stage.finish([out / file], tally, extra_fact=7)
    return stage


def test_stage_life(tmp_path):
    source, out = tmp_path / "in.json", tmp_path / "out"
    write_json(source, {"x": 1})
    assert not _finished(out, inputs={"map": source}).is_complete
    assert _open(out, inputs={"map": source}).is_complete
    assert read_manifest(out).facts == {"extra_fact": 7}
    assert read_json(out / "manifest.json")["counts"] == {"input": 1, "kept": 1, "dropped": {}, "failed": {}}
    (out / "product.json").unlink()
    with pytest.raises(VerifyError, match=r"product\.json"):
        _open(out, inputs={"map": source})
    failed = _finished(tmp_path / "failed", Tally(input=2, kept=1, failed={"input": 1}))
    assert not _open(failed.path).is_complete, "failed items are tried again"
    assert not (failed.path / "manifest.json").exists()


def test_other_settings_and_inputs_are_named(tmp_path):
    source, out = tmp_path / "in.json", tmp_path / "out"
    write_json(source, 1)
    inputs = {"map": source}
    _open(out, inputs=inputs).journal.append({"id": "a", "status": "kept"})
    _open(out, inputs=inputs, config=Demo(threads=2))  # may differ, and is not on record
    assert read_json(out / "stage.json")["config"] == {"a": {"b": 1}}
    for changes, words in (
        ({"config": Demo(a={"b": 2})}, "a.b was 1, is 2"),
        ({"seed": 5}, "seed was 0, is 5"),
        ({"config": Demo(a={})}, "a.b was 1"),
    ):
        with pytest.raises(ResumeError, match=words):
            _open(out, inputs=inputs, **changes)
    write_json(source, 2)
    with pytest.raises(ResumeError, match="the input map"):
        _open(out, inputs=inputs)


def test_a_stage_that_kept_nothing_is_one_error_and_not_complete(tmp_path):
    stage = _open(tmp_path / "out")
    write_failures(stage.path / "failures.jsonl", [Failed(id="i7", code="input", message="the disk is round")])
    with pytest.raises(NothingKept, match=r"out: demo kept nothing.*4 dropped \(short 4\).* of 5.*the disk is round"):
        stage.finish([], Tally(input=5, dropped={"short": 4}, failed={"input": 1}))
    assert not (tmp_path / "out/manifest.json").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_under_a_journal_is_one_error():
    with pytest.raises(StorageError, match="No space left"), Journal(Path("/dev/full")) as journal:
        journal.append({"id": "a"})


def test_foreign_files_are_not_touched(tmp_path):
    for name in ("thesis.txt", ".thesis.txt.1.partial"):
        (tmp_path / name).write_text("x")
        with pytest.raises(ResumeError, match="cosfly did not write"):
            _open(tmp_path)
        (tmp_path / name).unlink()


HOLDER = """
import sys, time
from pathlib import Path
from cosfly.runtime.run_dir import hold_folder
lock = hold_folder(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""


def test_a_folder_in_which_another_process_works_is_refused(tmp_path):
    out = tmp_path / "out"
    _open(out).journal.append({"id": "a", "status": "kept"})
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(out)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ResumeError, match="another cosfly process uses"):
            _open(out)
        assert (out / ".lock").exists()
        other.kill()
    assert not _open(out).is_complete  # the other was killed: what it left behind holds nobody up


def test_a_lock_leads_nowhere_else(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "private").write_text("mine")
    (tmp_path / "out/.lock").symlink_to(tmp_path / "private")
    with pytest.raises(StorageError, match=r"\.lock"):
        _open(tmp_path / "out")
    assert (tmp_path / "private").read_text() == "mine"


def test_a_link_is_replaced_and_what_it_points_to_is_kept(tmp_path):
    (tmp_path / "private").mkdir()
    (tmp_path / "private/mine").write_text("mine")
    (tmp_path / "file").symlink_to(tmp_path / "private/mine")
    (tmp_path / "folder").symlink_to(tmp_path / "private")
    (tmp_path / f".new.{os.getpid()}.partial").symlink_to(tmp_path / "private/mine")
    with pytest.raises(StorageError, match="the journal is a link"):
        Journal(tmp_path / "file").append({})
    write_bytes(tmp_path / "file", b"other")
    with store.atomic_folder(tmp_path / "folder"):
        pass
    write_bytes(tmp_path / "new", b"other")
    assert (tmp_path / "private/mine").read_text() == "mine"
    assert not any((tmp_path / name).is_symlink() for name in ("file", "folder", "new"))


def test_checksums_round_trip(tmp_path):
    digests = {"b/c.txt": "0" * 64, "a.txt": "f" * 64}
    store.write_checksums(tmp_path, digests)
    assert store.read_checksums(tmp_path) == digests
    (tmp_path / store.CHECKSUMS).write_text(f"{'0' * 64}  ../../evil\n")
    with pytest.raises(InputError, match="leads out"):
        store.read_checksums(tmp_path)


def make(folder: Path, file: str, **inputs: Path) -> Path:
    """Finish a stage with the name of its folder; give its product."""
    return _finished(folder, name=folder.name, file=file, inputs=inputs).path / file


def make_tree(out: Path, text: str = "", **inputs: Path) -> Path:
    stage = _open(out, "render", inputs=inputs)
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
    boxes = make(tmp_path / "simplify", "map.json")
    tree = make_tree(tmp_path / "render", simplified=boxes, traces=make(tmp_path / "plan", "traces.json", map=boxes))
    make(tmp_path / "caption", "captions.jsonl", data=tree)
    return tmp_path


def inputs_of(run: Path) -> dict[str, Path]:
    files = {"simplified": "simplify/map.json", "traces": "plan/traces.json", "data": "render"}
    return {name: run / path for name, path in (files | {"captions": "caption/captions.jsonl"}).items()}


def test_what_belongs_together_is_taken(run):
    found = run_dir.checked_inputs(inputs_of(run))
    assert found["simplified"].sha256 == sha256_file(run / "simplify/map.json")
    listed = read_json(run / "render/manifest.json")["outputs"]
    assert found["data"].sha256 == sha256_bytes(dump_json(listed).encode()), "as in the records of earlier runs"


def test_captions_of_another_tree_are_refused(run):
    other = make_tree(run / "other", "of another seed")
    with pytest.raises(
        VerifyError, match=r"captions\.jsonl: captions.jsonl was made with another input .data.*got .*other"
    ):
        run_dir.checked_inputs(inputs_of(run) | {"data": other})
    captions = make(run / "second/caption", "captions.jsonl", data=other)
    two = {"0.data": run / "render", "0.captions": run / "caption/captions.jsonl"}
    two |= {"1.data": other, "1.captions": captions}
    run_dir.checked_inputs(two)
    with pytest.raises(VerifyError, match="was made with another input"):
        run_dir.checked_inputs(two | {"0.captions": captions})


@pytest.mark.parametrize("name", ["manifest.json", "stage.json"])
def test_a_stage_without_its_records_is_not_finished(run, name):
    (run / "caption" / name).unlink()
    with pytest.raises(VerifyError, match=f"not finished or kept nothing, or its records are missing; got no {name}"):
        run_dir.checked_inputs(inputs_of(run))
    alone = run / "alone/captions.jsonl"
    alone.parent.mkdir()
    shutil.copy(run / "caption/captions.jsonl", alone)
    run_dir.checked_inputs(inputs_of(run) | {"captions": alone})


def test_a_name_that_no_record_can_hold(tmp_path):
    path = tmp_path / os.fsdecode(b"bad\xff.json")
    write_json(path, [])
    with pytest.raises(InputError, match=r"bad\\udcff.json: the path of an input contains a name that is not UTF-8"):
        _open(tmp_path / "out", inputs={"map": path})
    assert not (tmp_path / "out").exists()


def test_records_of_others_are_not_ours(tmp_path):
    write_json(tmp_path / "manifest.json", {"name": "an app"})
    write_json(tmp_path / "map.json", [])
    checked = run_dir.checked_inputs({"map": tmp_path / "map.json"})
    assert checked["map"].sha256 == sha256_file(tmp_path / "map.json")


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


def test_a_picture_that_is_not_what_its_header_says_is_refused():
    """Cut, too short, damaged, and a filter that does not exist."""
    picture = drawn(np.random.default_rng(0), 20, 20)
    whole = colours_png(picture)
    np.testing.assert_array_equal(pixels_of(whole, "x"), picture)
    lines = np.zeros((20, 61), np.uint8)
    packed = [zlib.compress(lines.tobytes()[:-1]), zlib.compress(bytes(lines + np.uint8(5))), b""]
    refused = [whole[:cut] for cut in (0, 7, 20, 33, 60, -20)] + [png_around(p, 20, 20) for p in packed]
    middle = len(whole) // 2
    refused.append(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    for data in refused:
        with pytest.raises(InputError):
            pixels_of(data, "x")


def drawn(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Areas of one colour, some with texture, some of one row repeated."""
    picture = np.repeat(rng.integers(0, 256, (height, 1 + width // 9, 3), dtype=np.uint8), 9, axis=1)[:, :width]
    if rng.random() < 0.7:
        picture[height // 3 :] = picture[height // 3]
    if rng.random() < 0.7:
        noise = rng.normal(0.0, float(rng.choice([0.5, 3.0, 60.0])), (height - height // 2, width, 3))
        picture[height // 2 :] = np.clip(picture[height // 2 :] + noise, 0, 255).astype(np.uint8)
    return picture


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 50), st.integers(1, 300))
def test_what_is_written_is_read_by_libraries(seed, height, width):
    rng = np.random.default_rng(seed)
    picture = drawn(rng, height, width)
    for data in (colours_png(picture), areas_png(*np.moveaxis(picture, 2, 0))):
        np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], picture)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), picture)
        np.testing.assert_array_equal(pixels_of(data, "x"), picture)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (72, 128)])
def test_floats_come_back_to_the_bit_and_any_library_finds_their_bytes(shape):
    values = np.random.default_rng(0).integers(0, 2**32, shape, dtype=np.uint32).view(np.float32)
    data = floats_png(values)
    assert floats_of(data, "x").tobytes() == values.tobytes(), "also what is no number"
    with Image.open(io.BytesIO(data)) as image:
        assert np.asarray(image).view("<f4")[..., 0].tobytes() == values.tobytes()
