"""Items to work: resume, tally, failures, dying workers."""

import os
import signal
import tracemalloc
from collections import Counter
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from cosfly.errors import EnvironmentMissing, InputError, StorageError
from cosfly.work.chance import BLOCK, draw_by_share, draw_to_quota, draws_for, rng_for
from cosfly.work.config import Config
from cosfly.work.runner import Item, Outcome, run_items
from cosfly.work.stage_folder import Failed, Kept, StageFolder
from cosfly.work.store import dump_json


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


def make_wordy_worker(num_bytes: int):
    return lambda item: Outcome({"words": num_bytes * "x"})


def _stage(path: Path) -> StageFolder:
    return StageFolder.open(path, "demo", config=Config(), inputs={}, seed=0)


def _items(*payloads):
    return [Item(f"i{k}", payload) for k, payload in enumerate(payloads)]


MIXED = (("keep", 2), ("drop", "short"), ("fail", "x"), ("keep", 3), ("bug", "y"), ("drop", "short"))


def test_everything_is_counted(tmp_path):
    finished = run_items(_stage(tmp_path / "s"), _items(*MIXED), make_worker, (tmp_path / "log",))
    assert finished.tally.model_dump() == {
        "input": 6,
        "kept": 2,
        "dropped": {"short": 2},
        "failed": {"bug": 1, "input": 1},
    }
    assert [record.id for record in finished.kept] == ["i0", "i3"]
    failures = (tmp_path / "s/failures.jsonl").read_text()
    assert "got x" in failures
    assert "KeyError" in failures


@pytest.mark.parametrize("workers", [0, 1])
def test_results_are_not_held(tmp_path, workers):
    """A driver of a hundred thousand items has the memory for one."""
    num, megabyte = 40, 1_000_000
    tracemalloc.start()
    items = [Item(f"i{k}", k) for k in range(num)]
    finished = run_items(_stage(tmp_path / "s"), items, make_wordy_worker, (megabyte,), workers=workers)
    assert [len(record.result["words"]) for record in finished.kept] == [megabyte] * num
    assert [record.id for record in finished.records] == [item.item_id for item in items]
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 15 * megabyte


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
    with pytest.raises(InputError, match=r"damaged meanwhile.*same command again"):
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
    """A bug as well: it must not pass for a worker that was killed for want of memory."""
    arguments = _stage(tmp_path / "s"), _items(("keep", 1), ("keep", 2)), make_broken_worker, (error,)
    with pytest.raises(type(error), match="no such map"):
        run_items(*arguments, workers=2)


def test_rng_depends_on_all_three_and_zero_is_a_seed():
    draws = {rng_for(*key).random() for key in ((0, "a", "x"), (1, "a", "x"), (0, "b", "x"), (0, "a", "y"))}
    assert len(draws) == 4
    assert rng_for(0, "a", "x").random() == rng_for(0, "a", "x").random()
    assert len({draws_for(*key) for key in ((0, "a", "x"), (1, "a", "x"), (0, "b", "x"), (0, "a", "y"))}) == 4


def test_an_item_is_named_once_in_the_log(tmp_path, caplog):
    run_items(_stage(tmp_path / "s"), _items(("fail", "x"), ("bug", "y")), make_worker, (tmp_path / "log",))
    assert "demo: i0: broken" in caplog.text
    assert "demo: i1: KeyError" in caplog.text


def test_names_are_drawn_by_their_shares():
    shares = {"b": 3.0, "none": 0.0, "a": 1.0}
    rng = np.random.default_rng(0)
    drawn = [draw_by_share(shares, rng) for _ in range(4000)]
    assert set(drawn) == {"a", "b"}
    assert 0.22 < drawn.count("a") / 4000 < 0.28
    turned = dict(reversed(shares.items()))
    assert [draw_by_share(turned, np.random.default_rng(k)) for k in range(20)] == [
        draw_by_share(shares, np.random.default_rng(k)) for k in range(20)
    ]
    assert draw_by_share({"a": 0.0, "b": 1.0, "c": 0.0}, rng) == "b"


def test_what_is_drawn_to_a_quota_has_its_share_of_any_number():
    shares = {"a": 5.0, "b": 3.0, "c": 1.0, "d": 1.0, "e": 0.0}
    for seed in range(30):
        drawn = list(islice(draw_to_quota(shares, np.random.default_rng(seed)), 200))
        for num in range(1, 201):
            counts = Counter(drawn[:num])
            off = max(abs(counts[name] - num * share / 10) for name, share in shares.items())
            assert off < (3.5 if num % BLOCK else 2.5)
        assert drawn[:50] == list(islice(draw_to_quota(shares, np.random.default_rng(seed)), 50))
    assert len(set(pairwise(drawn))) > 10  # in random order
    with pytest.raises(ValueError, match="something positive"):
        next(draw_to_quota({"a": 0.0}, np.random.default_rng(0)))


@pytest.mark.parametrize("shares", [{}, {"a": 0.0}, {"a": 2.0, "b": -1.0}], ids=["none", "zero", "negative"])
def test_shares_that_add_up_to_nothing_are_a_value_error(shares):
    with pytest.raises(ValueError, match="shares"):
        draw_by_share(shares, np.random.default_rng(0))
