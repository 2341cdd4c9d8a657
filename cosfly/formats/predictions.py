"""`predictions.jsonl`, a student's answers: written by `distill infer`, read by `distill evaluate` and `caption`."""

from pathlib import Path
from typing import Literal

from cosfly.formats.captions import Coc, Language
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import Record, model_lines

Split = Literal["train", "val", "test"]
PREDICTIONS = "predictions.jsonl"
FAILED = "failed_"  # prefix of the reason of a failed prediction


class Prediction(Record):
    """One line of `predictions.jsonl`. `coc` is None if the answer has a wrong structure, which `reason` names."""

    schema_version: Literal["1.0"] = "1.0"
    sample_id: str
    language: Language
    run: str = ""  # the tree of its window; empty in older files
    window_id: str = ""  # of the window in that tree; empty: sample_id
    split: Split
    model: str | None = None  # None in older files
    raw: str
    num_tokens: int
    is_finished: bool  # False: cut at max_new_tokens, or where the context was full
    coc: Coc | None
    reason: str | None
    recovered: list[str]  # kinds of text around the object that were removed

    @property
    def key(self) -> str:
        return f"{self.sample_id}/{self.language}"


def read_predictions(path: Path) -> list[Prediction]:
    """Read `predictions.jsonl`."""
    predictions: dict[str, Prediction] = {}
    lines = model_lines(path, Prediction, what="predictions", fix="run cosfly distill infer first")
    for number, (_, prediction) in enumerate(lines, 1):
        if prediction.key in predictions:
            what = "the file has two predictions for one sample in one language"
            fix = "remove one of the two lines"
            raise InputError(what, where=f"{path}:{number}", got=prediction.key, fix=fix)
        predictions[prediction.key] = prediction
    return list(predictions.values())
