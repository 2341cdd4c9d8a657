"""Items to work: worker processes with resume, progress, a tally that adds up and a record per failure.

`run_items` is the whole interface. A stage hands it items (an id and a payload that pickles) and `make_worker`, a
module-level function that is called once in each worker process with `worker_args` and returns the function that does
one item. Load maps and open GL contexts in it. `watch` says where: in processes of this machine, or of a Ray cluster.
"""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from cosfly.errors import CosflyError, EnvironmentMissing
from cosfly.work.console import progress_bar
from cosfly.work.items import Item, Outcome, Work, advance, attempt, counted_steps
from cosfly.work.ray_engine import ALL_ROOM, Cluster
from cosfly.work.stage_events import EventLog, HowFar
from cosfly.work.stage_folder import Dropped, Failed, ItemRecord, Kept, StageFolder, Tally, write_failures
from cosfly.work.store import remove_partials
from cosfly.work.worker_pool import LocalPost, StartPost, Watch, WorkerPool

__all__ = ["Item", "ItemOutcomes", "Outcome", "Watch", "Work", "advance", "run_items"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ItemOutcomes:
    """All outcomes of a stage, in the order of the items."""

    records: list[ItemRecord]
    tally: Tally

    @property
    def kept(self) -> list[Kept]:
        return [record for record in self.records if isinstance(record, Kept)]


def run_items(
    stage: StageFolder,
    items: Sequence[Item],
    make_worker: Callable[..., Work],
    worker_args: tuple = (),
    *,
    workers: int = 0,
    watch: Watch = Watch(),
    label: str | None = None,
) -> ItemOutcomes:
    """Do all items that the stage's journal does not hold yet.

    An item whose work raises is recorded as failed and counted; a fatal CosflyError (full disk, no GL) stops the stage,
    and what was finished stays. A worker that dies (out of memory, kill) or stalls costs only its item, which gets two
    more tries, the last one alone. An item that stalls again has failed; if one's worker dies again, the others are
    finished first and the stage then stops, unfinished. On a later run kept and dropped items are taken from the
    journal and failed ones are tried again.

    Args:
        make_worker: module-level function; `make_worker(*worker_args)` returns the work function, once in each process.
        workers: processes; 0 works in this process, where nothing can end an item that hangs.
        watch: where workers work, and when one counts as stalled.
    Returns:
        Records and tally, in the order of `items` whatever the order of work.
    """
    ids = [item.item_id for item in items]
    assert len(set(ids)) == len(ids), "item ids must be unique"
    known = set(ids)
    records: dict[str, ItemRecord] = {}
    records |= {r.id: r for r in stage.items() if r.id in known and not isinstance(r, Failed)}
    todo = [item for item in items if item.item_id not in records]
    if records:
        log.info("%s: %d of %d items were finished before", stage.stage, len(records), len(items))
    progress = _Progress(items, records.keys())
    if workers and todo:
        outcomes = _in_processes(stage, todo, (make_worker, worker_args), workers, watch, progress)
    else:
        outcomes = _in_this_process(todo, (make_worker, worker_args), progress.move)
    # Closed at once, also while an error is on its way: no worker goes on behind it.
    with stage.journal as journal, progress.shown(label or stage.stage), contextlib.closing(outcomes):
        for record in outcomes:
            records[record.id] = record
            journal.append(record.model_dump())
            _tell(stage.stage, record)
            progress.finish(record.id)
    ordered = [records[item_id] for item_id in ids]
    tally = _tally(stage, ordered)
    if "worker_died" in tally.failed:
        # That is the machine's doing, not the item's: it must not become a result. The stage stays open.
        raise EnvironmentMissing(
            "worker processes were killed, three times for the same item",
            where=stage.path,
            got=f"{tally.failed['worker_died']} of {len(ordered)} items without an outcome",
            fix="free some memory or use fewer --workers, then run the same command again: finished items are kept",
        )
    return ItemOutcomes(ordered, tally)


def _tell(stage: str, record: ItemRecord) -> None:
    if isinstance(record, Failed):
        named = "" if record.id in record.message else f"{record.id}: "
        log.error("%s: %s%s", stage, named, record.message)
    else:
        reason = f" ({record.reason})" if isinstance(record, Dropped) else ""
        log.debug("%s: %s: %s%s, %.2f s", stage, record.id, record.status, reason, record.seconds)


def _tally(stage: StageFolder, records: list[ItemRecord]) -> Tally:
    failures = [record for record in records if isinstance(record, Failed)]
    write_failures(stage.path / "failures.jsonl", failures)
    dropped = Counter(record.reason for record in records if isinstance(record, Dropped))
    kept = len(records) - dropped.total() - len(failures)
    return Tally(input=len(records), kept=kept, dropped=dropped, failed=Counter(failure.code for failure in failures))


_Start = tuple[Callable[..., Work], tuple]  # make_worker, worker_args


def _in_this_process(
    items: Sequence[Item], start: _Start, on_steps: Callable[[str, int], None]
) -> Generator[ItemRecord, None, None]:
    if not items:
        return
    make_worker, worker_args = start
    work = make_worker(*worker_args)
    for item in items:
        with counted_steps(partial(on_steps, item.item_id)):
            record = attempt(work, item)
        yield record


def _in_processes(
    stage: StageFolder, items: Sequence[Item], start: _Start, workers: int, watch: Watch, progress: _Progress
) -> Generator[ItemRecord, None, None]:
    start_post: StartPost = LocalPost
    if watch.ray is not None:
        cluster = Cluster(watch.ray, stage.path)
        start_post, workers = cluster.start_post, cluster.room if workers == ALL_ROOM else workers
    events = EventLog(stage.path, progress.how_far)
    pool = WorkerPool(*start, min(workers, len(items)), watch, events, progress.move, start_post)
    try:
        yield from pool.outcomes(items)
    except CosflyError:
        remove_partials(stage.path)  # on a full disk they hold the space that is needed
        raise
    finally:
        events.close()
    if pool.num_lost:
        remove_partials(stage.path)  # what the lost workers had in hand


class _Progress:
    """How far a stage is: in steps, as frames, where every item says how many it has, else in items."""

    def __init__(self, items: Sequence[Item], done: Collection[str]) -> None:
        sizes = {item.item_id: item.num_steps for item in items}
        self._in_steps = all(sizes.values())
        self._sizes = {item_id: size or 1 if self._in_steps else 1 for item_id, size in sizes.items()}
        self._at = {item_id: self._sizes[item_id] for item_id in done}
        self._advance: Callable[[int], None] = lambda count: None

    @contextlib.contextmanager
    def shown(self, label: str) -> Iterator[None]:
        with progress_bar(label, total=sum(self._sizes.values()), done=sum(self._at.values())) as self._advance:
            yield

    def how_far(self) -> HowFar:
        return HowFar(sum(self._at.values()), sum(self._sizes.values()), "steps" if self._in_steps else "items")

    def move(self, item_id: str, num_steps: int) -> None:
        """Note how many steps of an item are done; fewer than before where it is begun again."""
        if self._in_steps:
            self._set(item_id, min(num_steps, self._sizes[item_id]))

    def finish(self, item_id: str) -> None:
        self._set(item_id, self._sizes[item_id])

    def _set(self, item_id: str, count: int) -> None:
        self._advance(count - self._at.get(item_id, 0))
        self._at[item_id] = count
