"""What became of one sample, and its record in `predictions.jsonl`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from cosfly.formats.predictions import FAILED, Prediction, Split
from cosfly.llm.answer_text import parse_answer
from cosfly.llm.answers import Answer
from cosfly.runtime.model_json import CONTEXT_FULL
from cosfly.runtime.run_dir import Failed, Tally
from distill.schema import Sample


@dataclass(frozen=True)
class SampleOutcome:
    """A sample with its answer, or with the reason why there is none."""

    sample: Sample
    found: Answer | Failed
    is_new: bool = False  # of this run, not recorded by an earlier one


def failed(sample: Sample, code: str, error: object) -> SampleOutcome:
    """Return the outcome of a sample that got no answer."""
    return SampleOutcome(sample, Failed(id=sample.key, code=code, message=str(error)))


def make_prediction(sample: Sample, split: Split, text: str, num_tokens: int, is_finished: bool) -> Prediction:
    """Parse an answer and return its record."""
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
    """Return the record of a sample without an answer: empty, with a reason that counts as no wrong answer."""
    return make_prediction(sample, split, "", 0, False).model_copy(update={"reason": f"{FAILED}{code}"})


@dataclass
class Results:
    """Counts of the outcomes of a run. new: answers of this run and their tokens."""

    split: Split
    model: str
    tally: Tally = field(default_factory=Tally)
    failures: list[Failed] = field(default_factory=list)
    num_parsed: int = 0
    new: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: SampleOutcome) -> Prediction:
        """Count an outcome and return its record."""
        found = outcome.found
        self.tally.input += 1
        if isinstance(found, Failed):
            self.tally.failed[found.code] += 1
            self.failures.append(found)
            prediction = failed_prediction(outcome.sample, self.split, found.code)
        else:
            self.tally.kept += 1
            if outcome.is_new:
                self.new.update(found.usage, answers=1)
            is_finished = found.finish_reason not in ("length", CONTEXT_FULL)
            num_tokens = found.usage.get("completion_tokens", 0)
            prediction = make_prediction(outcome.sample, self.split, found.text, num_tokens, is_finished)
        self.num_parsed += prediction.coc is not None
        return prediction.model_copy(update={"model": self.model})
