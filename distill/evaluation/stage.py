"""Measure students: parse rate, decisions, verdicts, BERTScore and values, next to the baselines, with intervals.

The reference is the teacher's accepted answer, as in the paper. Agreement with the geometric label and the verdict on
the motion after the window are measured too.
"""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from cosfly.formats.captions import TOKENS, Language, ValueCounts, read_captions
from cosfly.formats.predictions import PREDICTIONS, Prediction, read_predictions
from cosfly.inspection.blind_baseline import FITTED_ON, fit_deciders
from cosfly.runtime.config import Config
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import write_model
from cosfly.runtime.run_dir import StageFolder, Tally, read_manifest
from cosfly.runtime.seeding import rng_for
from distill.evaluation.figures import TEACHER, Answers, Measurement, coc_of, decision_number, measure, text_of
from distill.evaluation.report import REPORT, REPORT_FORMAT, Evaluation, Example, Metric, StudentRecord, page_of
from distill.schema import Sample, open_split
from distill.student.model import pick_device, quiet_transformers, require

STAGE = "distill.evaluate"
BASELINES = ("majority", "rule", "blind")
BATCH_SIZE = 64  # texts embedded together
GROUP = 1024  # pairs of texts whose embeddings are in memory at the same time
UNLIMITED = 10**6  # a tokenizer without a limit of its own has a larger number
NUM_EXAMPLES = 12  # samples that the page shows with their answers
Predictions = Mapping[str, Mapping[str, Prediction]]  # student -> sample's key -> its prediction
# (run or None, window, language, text) -> values of this text
JudgedValues = dict[tuple[str | None, str, str, str], ValueCounts]


def run(
    predictions: Sequence[Path], dataset: Path, out: Path, *,
    encoders: Mapping[Language, Path] | None = None, judged: Sequence[Path] = (), seed: int = 0,
) -> Path:  # fmt: skip
    """Read the predictions of students and their training set; write `report.json`, whose path is returned, and a page.

    Args:
        predictions: `predictions.jsonl` of each student or its folder; the folder's name is the student's. Students are
            measured on the samples that all of them were asked.
        encoders: folders of the encoders of BERTScore; a language without one is not scored, and the report says so.
        judged: captions that `cosfly caption --teacher student:PATH` made of the answers.

    Raises:
        InputError: an input is missing, or predictions and training set do not belong together.
    """
    paths = [path / PREDICTIONS if path.is_dir() else path for path in predictions]
    files = {path.absolute().parent.name: path for path in paths}
    if len(files) < len(paths) or files.keys() & {TEACHER, *BASELINES}:
        fix = "rename a folder: each column has the name of the folder of a student"
        raise InputError("two columns of the table have the same name", got=", ".join(files), fix=fix)
    encoders = dict(encoders or {})
    inputs = {"dataset": dataset} | {f"judged/{n}": path for n, path in enumerate(judged, 1)}
    for n, (name, path) in enumerate(files.items(), 1):  # without dots, which would begin the name of another run
        inputs[f"predictions/{n}_{name.replace('.', '_')}"] = path
    for language, folder in encoders.items():
        inputs |= {f"bertscore/{language}/{path.name}": path for path in encoder_files(folder)}
    stage = StageFolder.open(out, STAGE, config=Config(), inputs=inputs, seed=seed)
    if stage.is_complete:
        return out / REPORT
    by_student = {name: {prediction.key: prediction for prediction in read_predictions(p)} for name, p in files.items()}
    splits = sorted({prediction.split for by_key in by_student.values() for prediction in by_key.values()})
    if len(splits) != 1:
        fix = "pass predictions of one split"
        raise InputError("the predictions are not of one split", got=f"splits: {', '.join(splits) or 'none'}", fix=fix)
    (split,) = splits
    samples, train, values = open_split(dataset, split), open_split(dataset, "train"), read_judged(judged)
    asked = asked_samples(samples, by_student)
    students = {
        name: _student_record(files[name].parent, [by_key[sample.key] for sample in asked], len(samples) - len(by_key))
        for name, by_key in by_student.items()
    }
    languages = sorted({sample.language for sample in asked})
    measurements: dict[Language, Measurement] = {}
    metrics: dict[Language, Metric | None] = {}
    examples: list[Example] = []
    for language in languages:
        part = [sample for sample in asked if sample.language == language]
        measurements[language], metrics[language] = measure_language(
            part, by_student, train, encoders.get(language), values, seed
        )
        examples += _examples(part, by_student, NUM_EXAMPLES // len(languages), seed)
    report = Evaluation(
        split=split, seed=seed, students=students, metrics=metrics, languages=measurements, examples=examples
    )
    write_model(out / REPORT, report, REPORT_FORMAT)
    write_bytes(out / "evaluation.html", page_of(report).encode())
    num_not_asked = len(samples) - len(asked)
    dropped = {"not_asked": num_not_asked} if num_not_asked else {}
    tally = Tally(input=len(samples), kept=len(asked), dropped=dropped)
    models = {name: student.model for name, student in students.items()}
    stage.finish([out / REPORT, out / "evaluation.html"], tally, split=split, models=models)
    return out / REPORT


def _student_record(folder: Path, answers: Sequence[Prediction], num_not_asked: int) -> StudentRecord:
    """Return the record of a student, whose folder may have the manifest of `distill infer`."""
    reasons = Counter(answer.reason or "unknown" for answer in answers if answer.coc is None)
    facts = read_manifest(folder).facts if (folder / "manifest.json").is_file() else {}
    speed = {"answers": 0, "seconds": 0.0} | (facts.get("speed") or {})  # of the last run
    return StudentRecord(
        model=", ".join(sorted({answer.model or "unknown" for answer in answers})),
        not_asked=num_not_asked,
        without_decision=dict(sorted(reasons.items())),
        samples_per_s=speed["answers"] / speed["seconds"] if speed["answers"] and speed["seconds"] else None,
    )


def asked_samples(samples: Sequence[Sample], predictions: Predictions) -> list[Sample]:
    """Return the samples that every student was asked, in the order of the split."""
    keys = {sample.key for sample in samples}
    for name, by_key in predictions.items():
        if unknown := by_key.keys() - keys:
            what = "the training set does not contain this sample, for which there is a prediction"
            fix = "pass the training set for which the predictions were made"
            raise InputError(what, where=f"{name}: {min(unknown)}", got=f"{len(unknown)} unknown samples", fix=fix)
    asked = [sample for sample in samples if all(sample.key in by_key for by_key in predictions.values())]
    if not asked:
        raise InputError("the students have no sample in common", got=f"predictions of {', '.join(predictions)}")
    return asked


def read_judged(paths: Sequence[Path]) -> JudgedValues:
    """Read the counts of values in students' texts from the captions that were made of them."""
    judged: JudgedValues = {}
    for path in paths:
        for caption in read_captions(path):
            for language, counts in (caption.checks.values or {}).items():
                text = text_of(caption.en if language == "en" else caption.zh)
                judged[caption.teacher.run, caption.sample_id, language, text] = counts
    return judged


def measure_language(
    samples: Sequence[Sample], predictions: Predictions, train: Collection[Sample], encoder: Path | None,
    judged: JudgedValues, seed: int,
) -> tuple[Measurement, Metric | None]:  # fmt: skip
    """Measure students, teacher and baselines on samples of one language that all students were asked."""
    everyone: dict[str, Answers] = {}
    for name, by_key in predictions.items():
        answers = [by_key[sample.key] for sample in samples]
        values: list[ValueCounts | None] = []
        for sample, answer in zip(samples, answers, strict=True):
            key = (sample.window_id, sample.language, text_of(answer.coc))
            values.append(judged.get((sample.run, *key)) or judged.get((None, *key)))
        everyone[name] = Answers.of_student(answers, values)
    everyone |= floors_of(train, samples, samples[0].language, seed)
    metric = None
    if encoder is not None:
        references = [text_of(coc_of(sample)) for sample in samples]
        scorer = Scorer(encoder, references)
        metric = scorer.metric
        written = {name: everyone[name].texts.tolist() for name in (*predictions, "majority") if name in everyone}
        for name, scores in scorer.score(written, references).items():
            everyone[name].scores[:] = np.where(everyone[name].is_answered[:, None], scores, np.nan)
    return measure(samples, everyone, predictions, rng_for(seed, STAGE, "draws")), metric


def _examples(samples: Sequence[Sample], predictions: Predictions, most: int, seed: int) -> Iterator[Example]:
    """Yield samples with everybody's answers, chosen by the seed."""
    for index in rng_for(seed, STAGE, "examples").permutation(len(samples))[:most].tolist():
        sample = samples[index]
        answers = {name: by_key[sample.key] for name, by_key in predictions.items()}
        yield Example(key=sample.key, walk=sample.walk, label=sample.label, reference=coc_of(sample), answers=answers)


# --- BERTScore --------------------------------------------------------------------------------------------------------

# Zhang et al. 2020, doi:10.48550/arXiv.1904.09675; settings of sec:appendix_f_caption_distillation.


def encoder_files(folder: Path) -> list[Path]:
    """Return the files that decide an encoder's scores: configuration, tokenizer, weights."""
    if not (folder / "config.json").is_file():
        what = "the folder has no encoder that the library transformers can load"
        raise InputError(what, where=folder, expected="a folder with config.json, tokenizer and weights")
    kinds = ("*.json", "*.txt", "*.safetensors", "*.bin", "*.model")
    return sorted({path for kind in kinds for path in folder.glob(kind) if path.is_file()})


class Scorer:
    """BERTScore with one encoder."""

    def __init__(self, folder: Path, references: Sequence[str]) -> None:
        """Load the encoder, and count the references that are too long for it.

        The layer is that of the library for the folder's name (17 for `roberta-large`, 8 for `bert-base-chinese`). For
        a name that the library does not know, or an encoder with fewer layers, it is the last one.
        """
        require("torch", "transformers", "bert_score")
        quiet_transformers()
        import bert_score
        import transformers

        if "t5" in str(folder) or str(folder).startswith("scibert"):
            what = "bert-score mistakes a path with `t5` for a T5 model, and a path `scibert...` for a download"
            raise InputError(what, where=folder, fix="rename the folder")
        encoder_files(folder)
        try:
            config = transformers.AutoConfig.from_pretrained(folder)
            layers = config.num_hidden_layers
            layer = min(bert_score.utils.model2layers.get(folder.name, layers), layers)
            self._library = bert_score.BERTScorer(
                model_type=str(folder), num_layers=layer, batch_size=BATCH_SIZE, nthreads=1, device=pick_device("auto")
            )
        except (OSError, ValueError, RuntimeError, AttributeError) as error:
            raise InputError("the encoder cannot be loaded", where=folder, got=str(error)[:300]) from error
        tokenizer = self._library._tokenizer
        if tokenizer.model_max_length > UNLIMITED:  # the library would overflow the positions; RoBERTa reserves two
            tokenizer.model_max_length = config.max_position_embeddings - 2
        limit = tokenizer.model_max_length
        self.metric = Metric(
            model="/".join(folder.absolute().parts[-2:]), layer=layer, max_tokens=limit,
            cut=sum(len(tokenizer(text, truncation=False)["input_ids"]) > limit for text in references),
            versions={name: version(name) for name in ("bert-score", "torch", "transformers")},
        )  # fmt: skip

    def score(self, candidates: Mapping[str, Sequence[str]], references: Sequence[str]) -> dict[str, np.ndarray]:
        """Score several authors' texts; return author -> precision, recall, F1, (n, 3), 0 for an empty text."""
        scores = {name: np.zeros((len(references), 3)) for name in candidates}
        pairs = [(k, name) for k, text in enumerate(references) for name in candidates if text and candidates[name][k]]
        with progress_bar(f"BERTScore, {self.metric.model}", total=len(pairs)) as advance:
            for first in range(0, len(pairs), GROUP):
                group = pairs[first : first + GROUP]
                texts = [candidates[name][k] for k, name in group]
                columns = self._library.score(texts, [references[k] for k, _ in group], batch_size=BATCH_SIZE)
                rows = np.stack([column.numpy() for column in columns], axis=1)
                for (k, name), row in zip(group, rows, strict=True):
                    scores[name][k] = row
                advance(len(group))
        return scores


# --- baselines --------------------------------------------------------------------------------------------------------

# They see no picture. majority: one answer of the training split, with its most frequent decision, for every sample.
# rule: a decision tree of depth two on the geometry of the past frames, fitted on the training split. blind: a small
# network on the same numbers (cosfly/inspection/blind_baseline.py).


def majority(decisions: Iterable[str]) -> str | None:
    """Return the most frequent decision; a tie goes to the first in the order of the action table."""
    counts = Counter(decisions)
    return max(TOKENS, key=lambda action: counts[action]) if counts else None


def floors_of(
    train: Collection[Sample], samples: Sequence[Sample], language: Language, seed: int
) -> dict[str, Answers]:
    """Return the answers of the teacher and of each baseline to samples of one language.

    Without a training sample in `language` there are no baselines; without the geometry of the past there is no rule
    and no network. A hash of each sample chooses the majority's text and the samples to fit to.
    """
    in_language = [sample for sample in train if sample.language == language]
    ranks = {s.key: hashlib.sha256(f"{seed}/distill.floor/{s.sample_id}".encode()).digest() for s in in_language}
    answers = {TEACHER: Answers.of(np.array([decision_number(s.decision, s.key) for s in samples]))}
    decision = majority(sample.decision for sample in in_language)
    if decision is not None:
        with_decision = [sample for sample in in_language if sample.decision == decision]
        typical = min(with_decision, key=lambda sample: ranks[sample.key])
        constant = np.full(len(samples), TOKENS.index(decision))
        answers["majority"] = Answers.of(constant, [text_of(coc_of(typical))] * len(samples))
    share = FITTED_ON / max(1, len(train))
    fitted = [sample for sample in in_language if int.from_bytes(ranks[sample.key][:8]) <= share * 2**64]
    if fitted and all(sample.past for sample in (*fitted, *samples)):
        pasts = np.array([sample.past for sample in fitted])
        decisions = np.array([decision_number(sample.decision, sample.key) for sample in fitted])
        deciders = fit_deciders(pasts, decisions, rng_for(seed, "distill.floor", "blind"))
        asked = np.array([sample.past for sample in samples])
        answers |= {name: Answers.of(decide(asked)) for name, decide in deciders.items()}
    return answers
