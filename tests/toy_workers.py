"""Workers for tests that do wrong on purpose. Apart from the tests: every worker process imports this."""

import logging
import os
import signal
import time
from pathlib import Path

from cosfly.runtime.config import Config
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.run_dir import StageFolder
from cosfly.runtime.worker import Heartbeat, Item, Outcome, advance


def stage_in(path: Path) -> StageFolder:
    return StageFolder.open(path / "s", "demo", config=Config(), inputs={}, seed=0)


def items_of(*kinds: str) -> list[Item]:
    return [Item(f"i{k}", (kind, bytes(1_000_000))) for k, kind in enumerate(kinds)]  # more than a pipe holds


def make_faulty(folder: Path):
    def work(item: Item) -> Outcome:
        what = item.payload[0]
        mark = folder / f"{item.item_id}.begun"
        if what.startswith("once-") and mark.exists():
            what = "nothing"
        mark.touch()
        with atomic_folder(folder / item.item_id) as unfinished:
            (unfinished / "frame").write_text(item.item_id)
            _go_wrong(what.removeprefix("once-"))
        return Outcome({"name": item.item_id})

    return work


def _go_wrong(what: str) -> None:
    if what == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "stop":
        os.kill(os.getpid(), signal.SIGSTOP)
    while what == "loop":
        pass
    if what == "sleep":
        time.sleep(600)
    if what == "slow":  # more than its limit in all, but it gets on
        for _ in range(80):
            time.sleep(0.05)
            advance()


def make_counting_worker(folder: Path):
    def work(item: Item) -> Outcome:
        for _ in range(item.num_steps or 3):
            advance()
        mark = folder / item.item_id
        if item.payload == "once-die" and not mark.exists():
            mark.touch()
            (sender,) = logging.getLogger().handlers
            sender.send(Heartbeat(item.item_id, 3))  # with the steps that will be lost
            os.kill(os.getpid(), signal.SIGKILL)
        return Outcome()

    return work


def make_idle_worker(folder: Path):
    def work(item: Item) -> Outcome:
        partial = folder / f"{item.item_id}.writing"
        partial.write_text(str(os.getpid()))
        partial.rename(folder / f"{item.item_id}.pid")
        if item.item_id == "1":
            os.kill(os.getpid(), signal.SIGSTOP)  # not even a stopped one stays
        time.sleep(600)
        return Outcome()

    return work


def make_talking_worker():
    def work(item: Item) -> Outcome:
        logging.getLogger("cosfly.demo").info("%s speaks of %d", item.item_id, 7)
        return Outcome()

    return work
