"""Curves of a training through the loggers of accelerate: TensorBoard, Weights & Biases, MLflow and others."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from cosfly.runtime.errors import ConfigError, EnvironmentMissing
from distill.training.settings import STAGE, TrainConfig

Track = Callable[[Mapping[str, Any]], None]


@contextlib.contextmanager
def trackers(cfg: TrainConfig, out: Path, *, is_first: bool) -> Iterator[Track]:
    """Yield a function that sends a record of the log, with its numbers by name, to the loggers of `report_to`.

    Loggers that write files get the folder `curves` in `out`.
    """
    if not cfg.report_to or not is_first:
        yield lambda record: None
        return
    from accelerate.tracking import LOGGER_TYPE_TO_CLASS, get_available_trackers

    available, opened = {str(name) for name in get_available_trackers()}, []
    for name in cfg.report_to:
        if name not in LOGGER_TYPE_TO_CLASS:
            expected = ", ".join(LOGGER_TYPE_TO_CLASS)
            raise ConfigError("accelerate has no such logger", where=f"{STAGE}.report_to", got=name, expected=expected)
        if name not in available:
            raise EnvironmentMissing("the package of a logger is not installed", got=name, fix=f"pip install {name}")
        kind = LOGGER_TYPE_TO_CLASS[name]
        folder = {"logging_dir": out / "curves"} if kind.requires_logging_directory else {}
        opened.append(kind(STAGE, **folder))

    def track(record: Mapping[str, Any]) -> None:
        for one in opened:
            one.log(numbers_of(record), step=int(record["step"]))

    for one in opened:
        one.start()
    try:
        yield track
    finally:
        for one in opened:
            one.finish()


def numbers_of(record: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return the numbers of a record by name, those of inner records as `outer/inner`."""
    found: dict[str, float] = {}
    for name, value in record.items():
        if isinstance(value, Mapping):
            found |= numbers_of(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and name != "step":
            found[f"{prefix}{name}"] = float(value)
    return found
