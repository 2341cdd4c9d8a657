"""Items to work: resume, tally, failures, dying workers."""

import os
import signal
from pathlib import Path

import pytest

from cosfly.runtime.config import Config
from cosfly.runtime.errors import EnvironmentMissing, InputError, StorageError
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.pool import run_items
from cosfly.runtime.run_dir import Failed, Kept, StageFolder
from cosfly.runtime.seeding import random_bytes, rng_for
from cosfly.runtime.worker import Item, Outcome


def make_worker(log: Path):
    """A stand-in stage: the payload says what happens; every call leaves a line."""

    def work(item: Item) -> Outcome:
        with open(log, "a") as file:
            file.write(item.item_id + "\n")
        action, value = item.payload
        if action == "drop":
            return Outcome(drop_reason=value)
        if action == "fail":
            raise InputError("broken", where=item.item_id, got=value)
        if action == "bug":
            raise KeyError(value)
        if action == "full":
            raise StorageError("disk full", where="there")
        if action == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        return Outcome({"square": value**2, "draw": float(rng_for(1, "demo", item.item_id).random())})

    return work


def _stage(path: Path) -> StageFolder:
    return StageFolder.open(path, "demo", config=Config(), inputs={}, seed=0)


def _items(*payloads):
    return [Item(f"i{k}", payload) for k, payload in enumerate(payloads)]


MIXED = (("keep", 2), ("drop", "short"), ("fail", "x"), ("keep", 3), ("bug", "y"), ("drop", "short"))


def test_everything_is_counted(tmp_path):
    finished = run_items(_stage(tmp_path / "s"), _items(*MIXED), make_worker, (tmp_path / "log",))
    found = finished.tally.model_dump()
    assert found == {"input": 6, "kept": 2, "dropped": {"short": 2}, "failed": {"bug": 1, "input": 1}}
    assert [record.id for record in finished.kept] == ["i0", "i3"]
    failures = (tmp_path / "s/failures.jsonl").read_text()
    assert "got x" in failures
    assert "KeyError" in failures


def test_a_record_is_the_last_of_its_item_and_a_failure_undoes_nothing(tmp_path):
    stage = _stage(tmp_path / "s")
    with stage.journal as journal:
        for record in (
            Failed(id="i0", code="input", message="at first"), Kept(id="i0", result={"square": 4}),
            Failed(id="i0", code="input", message="of somebody else"), Kept(id="another"),
            Failed(id="i1", code="input", message="at first"),
        ):  # fmt: skip
            journal.append(record.model_dump())
    finished = run_items(stage, _items(("keep", 9), ("fail", "x")), make_worker, (tmp_path / "log",))
    kept, failed = finished.records
    assert (kept.result, failed.message.partition(";")[2]) == ({"square": 4}, " got x")
    assert (finished.tally.kept, finished.tally.failed) == (1, {"input": 1})
    (tmp_path / "s/items.jsonl").write_text("damaged meanwhile\n")
    with pytest.raises(InputError, match=r"changed while the command.*same command again"):
        list(finished.records)


def test_worker_count_does_not_matter(tmp_path):
    def products(workers: int):
        stage = _stage(tmp_path / f"s{workers}")
        finished = run_items(stage, _items(*MIXED), make_worker, (tmp_path / "log",), workers=workers)
        return dump_json([r.model_dump(exclude={"seconds"}) for r in finished.records]), finished.tally

    assert products(1) == products(2)


def test_finished_items_are_not_done_again_and_failed_ones_are(tmp_path):
    stage, log = _stage(tmp_path / "s"), tmp_path / "log"
    first = run_items(stage, _items(*MIXED), make_worker, (log,))
    log.unlink()
    second = run_items(stage, _items(*MIXED), make_worker, (log,))
    assert log.read_text().split() == ["i2", "i4"]
    assert second.tally == first.tally


def test_a_dying_worker_loses_no_other_item_and_leaves_the_stage_open(tmp_path):
    payloads = [("keep", k) for k in range(5)]
    payloads[2] = ("die", 0)
    stage = _stage(tmp_path / "s")
    with pytest.raises(EnvironmentMissing, match=r"1 of 5 items without an outcome.*fewer --workers"):
        run_items(stage, _items(*payloads), make_worker, (tmp_path / "log",), workers=2)
    assert sorted(r["id"] for r in stage.journal.read() if r["status"] == "kept") == ["i0", "i1", "i3", "i4"]
    assert not _stage(tmp_path / "s").is_complete


def test_a_fatal_error_stops_and_keeps_what_was_done(tmp_path):
    stage = _stage(tmp_path / "s")
    items = _items(("keep", 1), ("keep", 2), *[("full", 0)] * 4)
    with pytest.raises(StorageError, match="disk full"):
        run_items(stage, items, make_worker, (tmp_path / "log",), workers=2)
    assert all(r["status"] == "kept" for r in stage.journal.read())


def make_broken_worker(error: Exception):
    raise error


@pytest.mark.parametrize("error", [InputError("no such map", where="map.json"), KeyError("no such map")])
def test_an_error_in_the_factory_is_the_stages_error(tmp_path, error):
    arguments = _stage(tmp_path / "s"), _items(("keep", 1), ("keep", 2)), make_broken_worker, (error,)
    with pytest.raises(type(error), match="no such map"):
        run_items(*arguments, workers=2)


def test_rng_depends_on_all_three_and_zero_is_a_seed():
    draws = {rng_for(*key).random() for key in ((0, "a", "x"), (1, "a", "x"), (0, "b", "x"), (0, "a", "y"))}
    assert len(draws) == 4
    assert rng_for(0, "a", "x").random() == rng_for(0, "a", "x").random()
    assert len({random_bytes(*key) for key in ((0, "a", "x"), (1, "a", "x"), (0, "b", "x"), (0, "a", "y"))}) == 4
