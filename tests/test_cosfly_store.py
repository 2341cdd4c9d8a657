"""Files that are never half written."""

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from cosfly.runtime import io as store
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import InputError, NothingKept, ResumeError, StorageError, VerifyError
from cosfly.runtime.io import inside, write_bytes
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import read_json, write_json
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, read_manifest, write_failures


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
        with pytest.raises(InputError, match=r"not a valid file name|invalid character"):
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


def _open(out, **changes):
    arguments = {"config": Demo(), "inputs": {}, "seed": 0, **changes}
    return StageFolder.open(out, "demo", **arguments)


def _finished(out, tally: Tally | None = None, **changes) -> StageFolder:
    stage = _open(out, **changes)
    write_json(out / "product.json", 1)
    stage.finish([out / "product.json"], tally or Tally(input=1, kept=1), extra_fact=7)
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
        with pytest.raises(ResumeError, match="already contains results"):
            _open(out, inputs=inputs, **changes, resume="never")
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


def test_a_folder_in_which_another_process_works_is_refused(tmp_path, held_by_another):
    out = tmp_path / "out"
    _open(out).journal.append({"id": "a", "status": "kept"})
    with held_by_another(out):
        with pytest.raises(ResumeError, match="another cosfly process uses"):
            _open(out)
        assert (out / ".lock").exists()
    assert not _open(out).is_complete  # the other was killed: what it left behind holds nobody up


def test_a_lock_leads_nowhere_else(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "private").write_text("mine")
    (tmp_path / "out/.lock").symlink_to(tmp_path / "private")
    with pytest.raises(StorageError, match=r"\.lock"):
        _open(tmp_path / "out")
    assert (tmp_path / "private").read_text() == "mine"


def test_a_stage_writes_through_no_link_in_its_folder(tmp_path):
    out, private = tmp_path / "out", tmp_path / "private"
    _open(out)
    (private / "ORI").mkdir(parents=True)
    (private / "ORI/mine").write_text("mine")
    for name in ("items.jsonl", "Town01", "Town01/trajectory_1", "Town01/.x.1.partial", "made.json"):
        link = out / name
        link.parent.mkdir(exist_ok=True)
        link.symlink_to(private)
        before = sorted(out.rglob("*"))
        with pytest.raises(StorageError, match=f"{name}.*a link to {private}"):
            _open(out)
        assert sorted(out.rglob("*")) == before, "nothing of the folder was touched"
        link.unlink()
    assert (private / "ORI/mine").read_text() == "mine"


def test_nothing_is_written_in_the_place_of_a_link(tmp_path):
    (tmp_path / "private").mkdir()
    (tmp_path / "private/mine").write_text("mine")
    (tmp_path / "file").symlink_to(tmp_path / "private/mine")
    (tmp_path / "folder").symlink_to(tmp_path / "private")
    partial = tmp_path / f".new.{os.getpid()}.partial"
    partial.symlink_to(tmp_path / "private/mine")
    with pytest.raises(StorageError, match="a link"):
        write_bytes(tmp_path / "file", b"other")
    with pytest.raises(StorageError, match="a link"), store.atomic_folder(tmp_path / "folder"):
        pass
    write_bytes(tmp_path / "new", b"other")
    assert (tmp_path / "private/mine").read_text() == "mine"
    assert (tmp_path / "folder").is_symlink()


def test_atomic_folder(tmp_path):
    with pytest.raises(ZeroDivisionError), store.atomic_folder(tmp_path / "f") as partial:
        write_bytes(partial / "a", bytes(1 // 0))
    assert list(tmp_path.iterdir()) == []
    with store.atomic_folder(tmp_path / "f") as partial:
        write_bytes(partial / "a", b"1")
        assert not (tmp_path / "f").exists()
    assert (tmp_path / "f/a").read_bytes() == b"1"


def test_checksums_round_trip(tmp_path):
    digests = {"b/c.txt": "0" * 64, "a.txt": "f" * 64}
    store.write_checksums(tmp_path, digests)
    assert store.read_checksums(tmp_path) == digests
    (tmp_path / store.CHECKSUMS).write_text(f"{'0' * 64}  ../../evil\n")
    with pytest.raises(InputError, match="leads out"):
        store.read_checksums(tmp_path)
