"""The CPUs and the memory that this process may use: a job or a container has less than its machine."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")


def num_cpus() -> int:
    """Return the number of CPUs of this process: those of its affinity mask, fewer under a CFS quota."""
    quotas = [_quota_cpus(folder) for folder in _folders("cpu")]
    return max(1, math.ceil(min([len(os.sched_getaffinity(0)), *quotas])))


def memory_bytes() -> int:
    """Return the memory of this process: that of the machine, less under a limit of its control groups."""
    names = ("memory.max", "memory.limit_in_bytes")
    limits = [_number(folder / name) for folder in _folders("memory") for name in names]
    return int(min([os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *limits]))


def _folders(controller: str) -> Iterator[Path]:
    """Yield the folders of the control groups of this process and of their parents, of version 1 and 2.

    In a container the path of the group may be that of the host, so that only a parent exists.
    """
    for line in _lines(MEMBERSHIP):
        _, controllers, path = line.split(":", 2)
        names = controllers.split(",")
        if controllers and controller not in names:
            continue
        root = CGROUPS / (controller if controllers else "")
        group = root / path.lstrip("/")
        yield from (folder for folder in (group, *group.parents) if folder.is_relative_to(root))


def _quota_cpus(folder: Path) -> float:
    """Return the number of CPUs that a group's quota allows; inf without one."""
    if (folder / "cpu.max").exists():
        quota, period = _lines(folder / "cpu.max")[0].split()
        return math.inf if quota == "max" else int(quota) / int(period)
    quota_us, period_us = _number(folder / "cpu.cfs_quota_us"), _number(folder / "cpu.cfs_period_us")
    return quota_us / period_us if 0 < quota_us < math.inf and 0 < period_us < math.inf else math.inf


def _number(file: Path) -> float:
    """Return the number in a file; inf if there is no file or no number, for instance `max`."""
    number = "".join(_lines(file)).strip()
    return float(number) if number.lstrip("-").isdigit() else math.inf


def _lines(file: Path) -> list[str]:
    """Return the lines of a file of the kernel, whose reported size is 0; none if there is no such file."""
    try:
        return file.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
