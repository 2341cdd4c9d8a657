"""`events.jsonl`: a log of the workers of a stage, for people and `cosfly reproduce`; no stage reads it."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError

from cosfly.runtime.journal import Journal

EVENTS = "events.jsonl"
# A probe is written once the time since the last one exceeds this fraction of the time since the beginning: 500 lines
# whenever that time grows by the factor e, a few thousand lines in a week.
PROBE_SPACING = 1 / 500
MEBIBYTE = 2**20
# Indices into `process_stat`: proc(5) numbers the fields from 1, and the state is number 3.
STAT_UTIME, STAT_STIME, STAT_RSS = 14 - 3, 15 - 3, 24 - 3
Loss = Literal["heartbeat_lost", "timed_out", "worker_died"]
# Events that end a worker, as a message says them.
LOSSES: dict[str, str] = {
    "heartbeat_lost": "its worker process sent no heartbeat and used no CPU time",
    "timed_out": "the item finished no step within its time limit",
    "worker_died": "its worker process died, perhaps because memory ran out",
}
Kind = Loss | Literal["began", "worker_started", "restarted", "item_done", "retried", "given_up", "probe", "ended"]


class Event(BaseModel):
    """A line of `events.jsonl`; docs/files.md lists the fields of each kind and their units."""

    model_config = ConfigDict(frozen=True)

    at_s: float
    event: Kind
    workers: int | None = None
    worker: int | None = None  # its index from 0; a replacement keeps it
    node: str | None = None
    pid: int | None = None
    item: str | None = None
    status: str | None = None
    seconds: float | None = None
    steps: int | None = None
    attempt: int | None = None
    rss_mib: dict[int, float] | None = None  # by worker, the maximum since the last probe
    cores_used: float | None = None
    disk_free_mib: float | None = None


class Vitals(NamedTuple):
    """The processor time of a process with all its threads, s, and its resident memory, MiB."""

    cpu_s: float
    rss_mib: float

    @classmethod
    def of(cls, pid: int) -> Vitals:
        """Return the vitals of a process of this machine; zeros if it is gone or has no `/proc/PID/stat`."""
        fields = process_stat(pid)
        if not fields:
            return cls(0.0, 0.0)
        cpu_s = (int(fields[STAT_UTIME]) + int(fields[STAT_STIME])) / os.sysconf("SC_CLK_TCK")
        return cls(cpu_s, round(int(fields[STAT_RSS]) * os.sysconf("SC_PAGE_SIZE") / MEBIBYTE, 1))


class EventLog:
    """Appends to the `events.jsonl` of a stage without syncing: a kill may lose the last line."""

    def __init__(self, folder: Path) -> None:
        self._journal = Journal(folder / EVENTS)
        self._folder = folder
        self._begun_s = time.monotonic()
        self._probed_s = self._begun_s  # time of the last written probe
        self._peaks_mib: dict[int, float] = {}  # by worker, since the last written probe
        self._cpu_s: dict[int, float] = {}  # by worker, at the last measurement
        self._used_s = 0.0  # processor time of all workers since the last written probe

    def write(self, event: Kind, **fields: object) -> None:
        line = {"at_s": round(time.time(), 3), "event": event, **fields}
        self._journal.append({name: value for name, value in line.items() if value is not None}, sync=False)

    def probe(self, workers: Mapping[int, Vitals]) -> None:
        """Add up the vitals of the workers, by index; write them with the free disk space if a probe is due."""
        for worker, (cpu_s, mib) in workers.items():
            self._peaks_mib[worker] = max(self._peaks_mib.get(worker, 0.0), mib)
            previous_s = self._cpu_s.get(worker, 0.0)
            is_replaced = cpu_s < previous_s  # a new process counts from zero
            self._used_s += cpu_s if is_replaced else cpu_s - previous_s
            self._cpu_s[worker] = cpu_s
        now_s = time.monotonic()
        elapsed_s = now_s - self._probed_s
        if elapsed_s < (now_s - self._begun_s) * PROBE_SPACING:
            return
        cores = round(self._used_s / elapsed_s, 2) if elapsed_s else 0.0
        free = shutil.disk_usage(self._folder).free / MEBIBYTE
        self.write("probe", rss_mib=self._peaks_mib, cores_used=cores, disk_free_mib=round(free, 1))
        self._peaks_mib = {}
        self._used_s = 0.0
        self._probed_s = now_s

    def close(self) -> None:
        self._journal.close()


def read_events(folder: Path) -> list[Event]:
    """Read the events of a stage folder in order; skip damaged lines and those of a later version of cosfly."""
    events = list[Event]()
    for line in Journal(folder / EVENTS).read():
        with contextlib.suppress(ValidationError):
            events.append(Event.model_validate(line))
    return events


# --- processes --------------------------------------------------------------------------------------------------------


def process_stat(pid: int) -> list[bytes]:
    """Read the fields of /proc/PID/stat from the process state on; an empty list if there is no such file."""
    try:
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return []
