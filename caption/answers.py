"""`answers.jsonl`: every answer of a teacher, kept before anything is derived from it; nothing answered is asked twice.

One process writes it. In memory are only the answers of flights that are not finished.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cosfly.store import Journal


def flight_of(sample_id: str) -> str:
    """Give the flight id of a sample id."""
    return sample_id.rpartition("_frame_")[0]


class AnswerBook:
    """The journal with an index by key. Use as a context manager."""

    def __init__(self, path: Path, is_finished: Callable[[str], bool]) -> None:
        """Read the journal of an earlier run.

        Args:
            is_finished: tells whether a flight needs no more answers; those are not kept in memory.
        """
        self._journal = Journal(path)
        self._by_flight: dict[str, dict[str, dict]] = {}
        self._flights: dict[str, str] = {}
        finished: dict[str, bool] = {}
        for record in self._journal.read():
            flight = flight_of(record["sample_id"])
            if flight not in finished:
                finished[flight] = is_finished(flight)
            if not finished[flight]:
                self._remember(flight, record)
        self.num_damaged = self._journal.num_damaged
        self.num_found = len(self._flights)

    def _remember(self, flight: str, record: dict) -> None:
        self._by_flight.setdefault(flight, {})[record["key"]] = record
        self._flights[record["key"]] = flight

    def get(self, key: str) -> dict | None:
        flight = self._flights.get(key)
        return None if flight is None else self._by_flight[flight][key]

    def put(self, record: dict) -> None:
        """Write an answer to the disk; it is there when this returns."""
        self._journal.append(record)
        self._remember(flight_of(record["sample_id"]), record)

    def forget(self, flight: str) -> None:
        """Drop a finished flight's answers from memory; they stay on the disk."""
        for key in self._by_flight.pop(flight, {}):
            del self._flights[key]

    def __enter__(self) -> AnswerBook:
        return self

    def __exit__(self, *exc: object) -> None:
        self._journal.close()
