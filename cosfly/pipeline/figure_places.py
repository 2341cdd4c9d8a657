"""The query language of `paper.yaml`: a place says where in the files of a run the figures of a table are stored.

    place  = query {" + " query}                        the figures of all queries, one after the other
    query  = file ":" keys ["|" function {"," function}]
    keys   = {key "."} key {"," key}                    keys to follow; the last step may take several, one figure each
    key    = name | index | id | "*"

In an object a key is a name. In a list it is an index (-1 is the last), or the `id` or `key` of an element. `*` takes
all elements and makes a list of what the remaining keys find in each; elements without it are skipped. A function of
FUNCTIONS is applied to each value; several functions make several figures. What does not exist gives None.

Example: `compare/items.jsonl:*.result.times_ms.muco|mean,max + compare/compare.json:means.muco.length_m,five_ray_mean`
gives four figures: mean and maximum of the planning times in all lines of `items.jsonl`, then two means of
`compare.json`. The file `work` is not on disk: it stands for the figures that `reproduce` derives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.runtime.errors import InputError
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import read_object

DERIVED = "work"
MAKE_AGAIN = "run the stage that writes the file again"
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "mean": lambda values: float(np.mean(values)),
    "std": lambda values: float(np.std(values)),
    "min": min,
    "max": max,
    "p50": lambda values: float(np.percentile(values, 50)),
    "p95": lambda values: float(np.percentile(values, 95)),
    "count": len,
    "peak": lambda probes: max(sum(probe.values()) for probe in probes),  # memory of all workers together
    "shares": lambda counts: {name: 100.0 * count / sum(counts.values()) for name, count in counts.items()},
}


class MissingFile(Exception):
    """A file that a table needs does not exist."""


@dataclass
class FigureReader:
    """Reads figures by their places."""

    roots: Sequence[Path]  # folders that files are searched in, the run directory first
    derived: dict[str, Any]  # the figures of the file `work`
    _documents: dict[str, Any] = field(default_factory=dict)

    def file(self, name: str) -> Path:
        """Return the path of a file in the first root that has it; raise MissingFile if none has."""
        for root in self.roots:
            if (root / name).is_file():
                return root / name
        raise MissingFile(name)

    def figures(self, place: str) -> list[Any]:
        """Return the figures of a place; None for each that does not exist.

        Raises:
            MissingFile: No root has the file.
            InputError: A function cannot be applied to the value.
        """
        figures = list[Any]()
        for query in place.split(" + "):
            target, _, functions = query.partition("|")
            file, _, keys = target.partition(":")
            *parents, last = keys.split(".")
            try:
                values = [follow(self._document(file), [*parents, key]) for key in last.split(",")]
                if functions:
                    names = functions.split(",")
                    values = [FUNCTIONS[name](value) if value else None for value in values for name in names]
            except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
                expected = f"a value for {functions}" if functions else "an object or a list where the key has `*`"
                raise InputError(
                    "the number for the comparison with the paper cannot be computed from this field",
                    where=f"{file}: {keys}",
                    got=str(error),
                    expected=expected,
                    fix=MAKE_AGAIN,
                ) from None
            figures += values
        return figures

    def _document(self, file: str) -> Any:
        if file == DERIVED:
            return self.derived
        if file not in self._documents:
            path = self.file(file)
            is_journal = path.suffix == ".jsonl"
            self._documents[file] = list(Journal(path).read()) if is_journal else read_object(path, what="report")
        return self._documents[file]


def files_of(place: str) -> set[str]:
    """Return the files on disk that a place reads."""
    return {query.partition(":")[0] for query in place.split(" + ")} - {DERIVED}


def follow(value: Any, keys: Sequence[str]) -> Any:
    """Return the value that the keys lead to, or None if it does not exist."""
    for k, key in enumerate(keys):
        if key == "*":
            elements = value.values() if isinstance(value, dict) else value
            results = [follow(element, keys[k + 1 :]) for element in elements]
            return [result for result in results if result is not None]
        if isinstance(value, list):
            value = _element(value, key)
        elif isinstance(value, dict):
            value = value.get(key)
        else:
            value = None
    return value


def _element(elements: list[Any], key: str) -> Any:
    """Return the element with an index, an `id` or a `key`; None if there is none."""
    if key.lstrip("-").isdecimal():
        index = int(key)
        return elements[index] if -len(elements) <= index < len(elements) else None
    by_id = {str(element.get("id", element.get("key"))): element for element in elements if isinstance(element, dict)}
    return by_id.get(key)
