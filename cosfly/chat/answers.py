"""`answers.jsonl`: every answer of a teacher, kept before anything is derived from it; nothing answered is asked twice.

One process writes it. An answer is handed to the system as it arrives, so a killed process loses none; a thread waits for the disk,
once for all answers that arrived meanwhile. In memory are only the answers of flights that are not finished. `answers.index.jsonl` tells, for each flight that
was worked on, which bytes of the journal hold its answers, so that a later start reads the tail and the unfinished flights
instead of a week of answers. The index is a help, not a truth: without it the whole journal is read.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cosfly.errors import CosflyError
from cosfly.journal import Journal

COUNTED = ("prompt_tokens", "completion_tokens")


def flight_of(sample_id: str) -> str:
    """Give the flight id of a sample id."""
    return sample_id.rpartition("_frame_")[0]


class AnswerBook:
    """The journal with an index by key. Use as a context manager."""

    def __init__(self, path: Path, is_finished: Callable[[str], bool]) -> None:
        """Read what is needed of the journal of an earlier run.

        Args:
            is_finished: tells whether a flight needs no more answers; those are not kept in memory.
        """
        self.totals: Counter[str] = Counter()  # answers, prompt_tokens, completion_tokens: of all runs into this folder
        self.num_read = 0  # lines read at the start
        self._journal = Journal(path)
        self._index = Journal(path.with_name("answers.index.jsonl"))
        self._by_flight: dict[str, dict[str, dict]] = {}
        self._flights: dict[str, str] = {}
        self._spans: dict[str, tuple[int, int]] = {}  # this run's bytes of each open flight
        self._size = self._journal.start()
        self._is_finished = is_finished
        self._finished: dict[str, bool] = {}
        self.num_damaged = 0
        self._read_earlier()
        self.num_found = len(self._flights)
        self._waiting: list[asyncio.Future] = []  # for the disk
        self._disk = ThreadPoolExecutor(1, "journal")
        self._syncing: asyncio.Task | None = None

    # --- what is known ---

    def get(self, key: str) -> dict | None:
        flight = self._flights.get(key)
        return None if flight is None else self._by_flight[flight][key]

    def latency_s(self, sample_id: str) -> float:
        """Give the time that the answers about one window took, one after the other."""
        kept = self._by_flight.get(flight_of(sample_id), {}).values()
        return sum(record["latency_s"] for record in kept if record["sample_id"] == sample_id)

    def forget(self, flight: str) -> None:
        """Drop a flight that was worked on from memory; its answers stay on the disk, and the index says where."""
        for key in self._by_flight.pop(flight, {}):
            del self._flights[key]
        start, end = self._spans.pop(flight, (0, 0))
        # Lines before `open_from` belong to flights that the index names; a start need not read them again.
        open_from = min((first for first, _ in self._spans.values()), default=self._size)
        line = {"flight": flight, "start": start, "end": end, "open_from": open_from, "size": self._size}
        self._index.append(line | {"totals": dict(self.totals)}, sync=False)

    def _read_earlier(self) -> None:
        spans: dict[str, list[tuple[int, int]]] = {}
        scan_from = counted_to = 0
        for line in self._index.read():
            if line["size"] > self._size:  # the journal was cut or replaced: its index is worth nothing
                spans, scan_from, counted_to = {}, 0, 0
                self.totals.clear()
                break
            spans.setdefault(line["flight"], []).append((line["start"], line["end"]))
            scan_from, counted_to, self.totals = line["open_from"], line["size"], Counter(line["totals"])
        for flight, found in spans.items():
            if not self._needs_no_more(flight):
                for start, end in found:
                    self._scan(start, min(end, scan_from), flight, counted_to)
        self._scan(scan_from, None, None, counted_to)
        for flight in [name for name in self._spans if self._needs_no_more(name)]:
            self.forget(flight)  # finished just before a kill, so the index does not name it yet

    def _scan(self, start: int, end: int | None, wanted: str | None, counted_to: int) -> None:
        if end is not None and end <= start:
            return
        for first, after, record in self._journal.lines(start, end):
            self.num_read += 1
            flight = flight_of(record["sample_id"])
            if first >= counted_to:
                self._count(record)
            if wanted is None:
                self._extend(flight, first, after)
            if wanted in (None, flight) and not self._needs_no_more(flight):
                self._remember(flight, record)
        self.num_damaged += self._journal.num_damaged

    def _needs_no_more(self, flight: str) -> bool:
        if flight not in self._finished:
            self._finished[flight] = self._is_finished(flight)
        return self._finished[flight]

    def _remember(self, flight: str, record: dict) -> None:
        self._by_flight.setdefault(flight, {})[record["key"]] = record
        self._flights[record["key"]] = flight

    def _extend(self, flight: str, first: int, after: int) -> None:
        start, end = self._spans.get(flight, (first, after))
        self._spans[flight] = (min(start, first), max(end, after))

    def _count(self, record: dict) -> None:
        self.totals["answers"] += 1
        self.totals.update({name: record["usage"].get(name, 0) for name in COUNTED})

    # --- what is new ---

    async def put(self, record: dict) -> None:
        """Write an answer to the disk; it is there when this returns.

        Raises:
            StorageError: the disk is full or not writable.
        """
        first, self._size = self._size, self._journal.append(record, sync=False)
        flight = flight_of(record["sample_id"])
        self._remember(flight, record)
        self._extend(flight, first, self._size)
        self._count(record)
        on_disk = asyncio.get_running_loop().create_future()
        self._waiting.append(on_disk)
        if self._syncing is None or self._syncing.done():
            self._syncing = asyncio.create_task(self._sync())
        await on_disk

    async def _sync(self) -> None:
        loop = asyncio.get_running_loop()
        while self._waiting:
            batch, self._waiting = self._waiting, []
            error: CosflyError | None = None
            try:
                await loop.run_in_executor(self._disk, self._journal.sync)
            except CosflyError as found:  # a full disk: every window that waits for it is told
                error = found
            for on_disk in batch:
                if on_disk.done():
                    continue
                if error is None:
                    on_disk.set_result(None)
                else:
                    on_disk.set_exception(error)

    def __enter__(self) -> AnswerBook:
        return self

    def __exit__(self, *exc: object) -> None:
        self._disk.shutdown(wait=True)
        self._journal.close()
        self._index.close()
