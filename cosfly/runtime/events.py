"""`events.jsonl`: a log of a stage's workers for people and `cosfly bench`; nothing is decided by it."""

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
MOST_PROBES = 500  # of one e-fold of the time since the beginning: a week of work makes a few thousand lines
MEBIBYTE = 2**20
Loss = Literal["heartbeat_lost", "timed_out", "worker_died"]
LOSSES: dict[str, str] = {  # events of a worker that is of no use any more
    "heartbeat_lost": "its worker stood still",
    "timed_out": "it did not get on within its time limit",
    "worker_died": "its worker process died; it may need more memory than there is",
}
Kind = Loss | Literal["began", "worker_started", "restarted", "item_done", "retried", "given_up", "probe", "ended"]


class Event(BaseModel):
    """A line of `events.jsonl`; what each kind holds, and the units, are in docs/files.md.

    worker: its place, 0 and up; a restarted one keeps it. rss_mib: by worker, the most since the last probe.
    """

    model_config = ConfigDict(frozen=True)

    at_s: float
    event: Kind
    workers: int | None = None
    worker: int | None = None
    node: str | None = None
    pid: int | None = None
    item: str | None = None
    status: str | None = None
    seconds: float | None = None
    steps: int | None = None
    attempt: int | None = None
    rss_mib: dict[int, float] | None = None
    cores_used: float | None = None
    disk_free_mib: float | None = None
    gpu_percent: float | None = None
    gpu_mib: float | None = None


class Vitals(NamedTuple):
    """The processor time of a worker process with all its threads, and its resident memory."""

    cpu_s: float
    rss_mib: float

    @classmethod
    def of(cls, pid: int) -> Vitals:
        """Return the vitals of a process of this machine; zeros where it is gone or the system does not tell."""
        if not (fields := process_stat(pid)):
            return cls(0.0, 0.0)
        cpu_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime, stime: proc(5)
        return cls(cpu_s, round(int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / MEBIBYTE, 1))


class EventLog:
    """Appends to a stage's `events.jsonl`. A kill costs the last line."""

    def __init__(self, folder: Path) -> None:
        self._journal, self._folder = Journal(folder / EVENTS), folder
        self._begun_s = self._probed_s = time.monotonic()
        self._peaks_mib: dict[int, float] = {}
        self._cpu_s: dict[int, float] = {}  # by worker, at the last probe
        self._used_s = 0.0  # by all workers since the last line

    def write(self, event: Kind, **fields: object) -> None:
        line = {"at_s": round(time.time(), 3), "event": event, **fields}
        self._journal.append({name: value for name, value in line.items() if value is not None}, sync=False)

    def probe(self, workers: Mapping[int, Vitals]) -> None:
        """Measure memory and time of the workers (by place) and the disk; not every measurement is written."""
        for worker, (cpu_s, mib) in workers.items():
            self._peaks_mib[worker] = max(self._peaks_mib.get(worker, 0.0), mib)
            before_s = self._cpu_s.get(worker, 0.0)
            self._used_s += cpu_s - before_s if cpu_s >= before_s else cpu_s  # of one that replaces another
            self._cpu_s[worker] = cpu_s
        now_s = time.monotonic()
        elapsed_s = now_s - self._probed_s
        if elapsed_s < (now_s - self._begun_s) / MOST_PROBES:
            return
        cores = round(self._used_s / elapsed_s, 2) if elapsed_s else 0.0
        free = shutil.disk_usage(self._folder).free / MEBIBYTE
        self.write("probe", rss_mib=self._peaks_mib, cores_used=cores, disk_free_mib=round(free, 1), **gpu_use())
        self._peaks_mib, self._used_s, self._probed_s = {}, 0.0, now_s

    def close(self) -> None:
        self._journal.close()


def read_events(folder: Path) -> list[Event]:
    """Read the events of a stage folder in order; damaged lines and those of a later cosfly are skipped."""
    events = list[Event]()
    for line in Journal(folder / EVENTS).read():
        with contextlib.suppress(ValidationError):
            events.append(Event.model_validate(line))
    return events


def lost_steps(folder: Path) -> int:
    """Return the number of steps, as frames, of items that then failed or were lost with their worker."""
    events = read_events(folder)
    return sum(event.steps or 0 for event in events if event.event in LOSSES or event.status == "failed")


# --- processes and devices --------------------------------------------------------------------------------------------


def process_stat(pid: int) -> list[bytes]:
    """Read the fields of /proc/PID/stat from the state on; empty where there are none."""
    try:
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return []


def gpu_use() -> dict[str, float]:
    """Return `gpu_percent`, the mean load of the machine's NVIDIA devices, and `gpu_mib`, their memory in use; empty
    where there is none."""
    import pynvml as nvml

    loads, used_mib = list[float](), 0.0
    with contextlib.suppress(nvml.NVMLError, nvml.NVMLLibraryMismatchError):
        nvml.nvmlInit()  # only the first has something to do
        for index in range(nvml.nvmlDeviceGetCount()):
            with contextlib.suppress(nvml.NVMLError):  # a virtual device, or a missing right
                device = nvml.nvmlDeviceGetHandleByIndex(index)
                used_mib += nvml.nvmlDeviceGetMemoryInfo(device).used / MEBIBYTE
                loads.append(nvml.nvmlDeviceGetUtilizationRates(device).gpu)
    return {"gpu_percent": round(sum(loads) / len(loads), 1), "gpu_mib": round(used_mib, 1)} if loads else {}
