"""What became of one sample, and the files that it goes to: predictions, failures."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cosfly.formats.places import flight_of
from cosfly.formats.predictions import FAILED, PREDICTIONS, Prediction, Split
from cosfly.llm.answer_text import parse_answer
from cosfly.llm.answers import Answer, AnswerBook
from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.model_json import CONTEXT_FULL
from cosfly.runtime.run_dir import Failed, Tally, write_failures
from distill.schema import Sample

ANSWERS = "answers"  # the folder of journals
MOST_FLIGHTS = 32  # whose answers stay in memory when nothing is asked about them


@dataclass(frozen=True)
class SampleOutcome:
    """A sample with its answer, or with why there is none."""

    sample: Sample
    found: Answer | Failed
    is_new: bool = False  # made by this run, not kept from an earlier one


def failed(sample: Sample, code: str, error: Exception) -> SampleOutcome:
    """Return what became of a sample that got no answer."""
    return SampleOutcome(sample, Failed(id=sample.key, code=code, message=str(error)))


def make_prediction(sample: Sample, split: Split, text: str, num_tokens: int, is_finished: bool) -> Prediction:
    """Check an answer and give its record."""
    parsed = parse_answer(text, sample.language, finish_reason=None if is_finished else "length")
    return Prediction(
        sample_id=sample.sample_id,
        language=sample.language,
        run=sample.run,
        window_id=sample.window_id,
        split=split,
        raw=text,
        num_tokens=num_tokens,
        is_finished=is_finished,
        coc=parsed.coc,
        reason=parsed.reason,
        recovered=list(parsed.recovered),
    )


def failed_prediction(sample: Sample, split: Split, code: str) -> Prediction:
    """Return the record of a sample without an answer: empty, and its reason says that it is no wrong one."""
    return make_prediction(sample, split, "", 0, False).model_copy(update={"reason": f"{FAILED}{code}"})


def prediction_of(answered: SampleOutcome, split: Split) -> Prediction:
    """Return the record of a sample."""
    found = answered.found
    if isinstance(found, Failed):
        return failed_prediction(answered.sample, split, found.code)
    is_finished = found.finish_reason not in ("length", CONTEXT_FULL)
    num_tokens = found.usage.get("completion_tokens", 0)
    return make_prediction(answered.sample, split, found.text, num_tokens, is_finished)


class Results:
    """Writes what came of the samples one by one; the file appears when all are there. Holds counts and failures."""

    def __init__(self, split: Split, model: str, file: IO[bytes]) -> None:
        self.split, self.model, self._file = split, model, file
        self.tally, self.failures = Tally(), list[Failed]()
        self.num_parsed = 0
        self.new = Counter[str]()  # answers of this run and their tokens
        self.speed: dict[str, float] = {}

    def add(self, answered: SampleOutcome) -> None:
        found = answered.found
        own = {"model": self.model}
        prediction = prediction_of(answered, self.split).model_copy(update=own)
        self._file.write((dump_json(prediction.model_dump(mode="json")) + "\n").encode())
        self.tally.input += 1
        if isinstance(found, Failed):
            self.tally.failed[found.code] += 1
            self.failures.append(found)
            return
        self.tally.kept += 1
        self.num_parsed += prediction.coc is not None
        if answered.is_new:
            self.new.update(found.usage, answers=1)


@contextlib.contextmanager
def writing_results(out: Path, split: Split, model: str) -> Iterator[Results]:
    """Open the files of a run's results."""
    with atomic_file(out / PREDICTIONS) as file:
        results = Results(split, model, file)
        yield results
        write_failures(out / "failures.jsonl", results.failures)


class OpenFlights:
    """Lets the answers of flights go that nobody asks about any more. `begun` and `done` are told of every sample."""

    def __init__(self, book: AnswerBook) -> None:
        self._book = book
        self._pending = Counter[str]()
        self._idle: dict[str, None] = {}  # in the order in which they became idle

    def begun(self, sample: Sample) -> str:
        """Return the flight of a sample that is worked on from now on."""
        flight = flight_of(sample.sample_id)
        self._pending[flight] += 1
        self._idle.pop(flight, None)
        return flight

    def done(self, sample: Sample) -> None:
        flight = flight_of(sample.sample_id)
        self._pending[flight] -= 1
        if not self._pending[flight]:
            del self._pending[flight]
            self._idle[flight] = None
        while len(self._idle) > MOST_FLIGHTS:
            oldest = next(iter(self._idle))
            del self._idle[oldest]
            self._book.forget(oldest)
