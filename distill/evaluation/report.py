"""The report of an evaluation: `report.json`, and its tables as a page."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosfly.formats.captions import FIELDS, TOKENS, Coc, Language
from cosfly.formats.episodes import Figure
from cosfly.formats.predictions import Prediction, Split
from cosfly.inspection.blind_baseline import LEAST_WINDOWS
from cosfly.runtime.json_io import FileFormat, Record, read_model
from cosfly.viz.page import page
from cosfly.viz.tables import TextTable
from distill.evaluation.figures import (
    BERTSCORE,
    CONFIDENCE,
    FIGURES,
    RESAMPLES,
    TEACHER,
    UNPARSED_NAME,
    FigureSet,
    Measurement,
)

REPORT, REPORT_FORMAT = "report.json", FileFormat("cosfly.distill_report", "5.0", "report")
SUMMARY = ("parsed", "accuracy", "accuracy_on_labels", "macro_f1", "bertscore_f1")  # figures for the terminal
LANGUAGES: dict[Language, str] = {"en": "English", "zh": "Chinese"}
# The paper's students: tab:distillation_summary, and the accuracies in the text of
# sec:appendix_f_caption_distillation.
PAPER_SAMPLES = 10_000
PAPER: dict[str, dict[str, float]] = {
    "paper: Qwen3.5-2B + LoRA": {
        "parsed": 1.0, "accuracy": 0.6870, "accuracy_parsed": 0.6870, "bertscore_precision": 0.9282,
        "bertscore_recall": 0.9217, "bertscore_f1": 0.9249, "track_straight": 0.836, "yaw_left_to_follow": 0.481,
        "yaw_right_to_follow": 0.452, "search_to_reacquire_target": 0.999,
    },
    "paper: Qwen3.5-4B + LoRA": {
        "parsed": 0.9999, "accuracy_parsed": 0.7007, "bertscore_precision": 0.9284, "bertscore_recall": 0.9231,
        "bertscore_f1": 0.9257, "track_straight": 0.781, "yaw_left_to_follow": 0.566, "yaw_right_to_follow": 0.575,
        "search_to_reacquire_target": 0.999,
    },
}  # fmt: skip
NOTES = [
    "The teacher's accepted answer is the reference. An answer that does not parse is wrong and scores 0 in BERTScore. "
    "A sample without an answer is not wrong; it counts in the first row only.",
    "Verdicts and the label come from the motion after the window, by the same rules as for captions.",
    "The majority gives one answer of the training split to every sample. The rule is a decision tree of depth two, "
    "and blind a small network, on the poses and positions of the last frames as they were drawn, which the prompt "
    "describes; both are fitted on the decisions of the training split and see no picture. "
    f"The network needs {LEAST_WINDOWS} training samples in a language.",
    "The paper's columns were measured on 10,000 samples of its own data, with layer 17 of roberta-large and another "
    "teacher, so only the distance to the baselines can be compared.",
]


class Metric(Record):
    """What a score was measured with; `stage.json` has the digests."""

    model: str
    layer: int
    max_tokens: int
    cut: int  # references longer than max_tokens
    versions: dict[str, str]


class StudentRecord(Record):
    """The predictions of a student."""

    model: str
    not_asked: int  # samples of the split without a prediction
    without_decision: dict[str, int]  # reason -> predictions
    samples_per_s: float | None  # of the last run of `distill infer`; None if unknown


class Example(Record):
    """A sample with its reference and the answer of each student."""

    key: str
    walk: str
    label: str | None
    reference: Coc
    answers: dict[str, Prediction]


class Evaluation(Record):
    """`report.json`."""

    split: Split
    seed: int
    confidence: float = CONFIDENCE
    resamples: int = RESAMPLES
    students: dict[str, StudentRecord]
    metrics: dict[Language, Metric | None]  # None if BERTScore was not computed
    languages: dict[Language, Measurement]
    examples: list[Example]


def _paper() -> dict[str, FigureSet]:
    """Return the figures of the paper's students, without intervals."""

    def figure(values: dict[str, float], name: str) -> Figure:
        return Figure(value=values.get(name), low=None, high=None, count=PAPER_SAMPLES)

    return {
        student: FigureSet(
            figures={name: figure(values, name) for name in FIGURES},
            by_decision={token: figure(values, token) for token in TOKENS},
            confusion={},
        )
        for student, values in PAPER.items()
    }


def _shown(name: str, figure: Figure | None, *, signed: bool = False) -> str:
    """Return the text of a figure of this name."""
    if figure is None:
        return "-"
    digits = ".1f" if name == "tokens" else ".1%"
    if name in (*BERTSCORE, "macro_f1"):
        digits = ".4f"
    return figure.shown(f"{'+' if signed else ''}{digits}")


def tables_of(report: Evaluation, language: Language) -> list[TextTable]:
    """Return the tables of one language: everybody's figures, accuracy by decision, and the differences of students.

    Columns are students, teacher, baselines, and the paper's students.
    """
    part, metric = report.languages[language], report.metrics[language]
    labels = {name: name if name in report.students or name == TEACHER else f"baseline: {name}" for name in part.who}
    columns = {label: part.who[name] for name, label in labels.items()} | _paper()
    encoder = f" ({metric.model} layer {metric.layer})" if metric else ""
    main = []
    for name, words in FIGURES.items():
        if any(figure_set.figures[name].value is not None for figure_set in part.who.values()):
            title = words + encoder if name in BERTSCORE else words
            main.append([title, *(_shown(name, figure_set.figures[name]) for figure_set in columns.values())])
    counts = {token: figure.count for token, figure in part.who[TEACHER].by_decision.items()}
    decisions = []
    for token in sorted(counts, key=lambda token: -counts[token]):
        cells = [_shown(token, figure_set.by_decision.get(token)) for figure_set in columns.values()]
        decisions.append([f"{token} ({counts[token]})", *cells])
    trajectories = "trajectory" if part.walks == 1 else "trajectories"
    heading = f"{LANGUAGES[language]}: {part.samples} samples of {part.walks} pedestrian {trajectories}"
    tables = [TextTable(heading, ["", *columns], main)]
    tables.append(TextTable("Accuracy by the teacher's decision", ["", *columns], decisions))
    for pairing in part.pairings:
        known = {name: figure for name, figure in pairing.differences.items() if figure.value is not None}
        rows = [[FIGURES[name], _shown(name, figure, signed=True)] for name, figure in known.items()]
        tables.append(TextTable(f"{pairing.first} minus {pairing.second}", ["", "difference"], rows))
    return tables


def summary_tables(product: Path) -> Iterator[TextTable]:
    """Yield the most important figures of a `report.json`, one table for each language."""
    report = read_model(product, Evaluation, REPORT_FORMAT)
    for language, part in report.languages.items():
        rows = [[name, *(_shown(key, own.figures[key]) for key in SUMMARY)] for name, own in part.who.items()]
        counts = f"samples: {part.samples}, pedestrian trajectories: {part.walks}"
        counts += f", decisions of the teacher: {len(part.who[TEACHER].by_decision)}"
        if "blind" not in part.who:
            counts += f", no blind network: it needs {LEAST_WINDOWS} training samples in this language"
        title = f"{LANGUAGES[language]} ({counts}); all figures are in evaluation.html"
        yield TextTable(title, ["", *(FIGURES[key] for key in SUMMARY)], rows)


def notes_of(report: Evaluation) -> list[str]:
    """Return how the figures were measured."""
    intervals = f"Intervals: {report.confidence:.0%}, bootstrap over pedestrian trajectories, {report.resamples} draws."
    if all(part.walks < 2 for part in report.languages.values()):
        intervals = "No intervals: they need the answers of two pedestrian trajectories."
    notes = [intervals, *NOTES]
    for language, metric in report.metrics.items():
        text = "was not computed, because no encoder was passed."
        if metric is not None:
            versions = ", ".join(f"{name} {number}" for name, number in metric.versions.items())
            text = f"by {metric.model}, layer {metric.layer}, not rescaled; {versions}; "
            text += f"{metric.cut} references are longer than {metric.max_tokens} tokens."
        notes.append(f"BERTScore of {language} {text}")
    for name, student in report.students.items():
        facts = [f"{reason}: {count}" for reason, count in student.without_decision.items()]
        if student.samples_per_s is not None:
            facts.append(f"{student.samples_per_s:.2f} answers per second")
        if student.not_asked:
            facts.append(f"{student.not_asked} samples of the split have no prediction")
        notes.append("; ".join([f"{name} is {student.model}", *facts]) + ".")
    everyone = [figure_set for part in report.languages.values() for figure_set in part.who.values()]
    if all(figure_set.figures["values_matched"].value is None for figure_set in everyone):
        notes.append("Values were not checked; pass the captions of cosfly caption --teacher student:PATH as --judged.")
    return notes


# --- the page ---------------------------------------------------------------------------------------------------------


def page_of(report: Evaluation) -> str:
    """Return the report as a self-contained page."""
    parts = []
    for language, part in report.languages.items():
        main, *tables = tables_of(report, language)
        parts.append({"main": main, "tables": tables, "plots": _confusions(report, part)})
    look = {
        "shown": lambda cell: f"{cell:.0%}" if isinstance(cell, float) else str(cell),
        "greatest": lambda table: table["most"],
    }
    return page(
        "distill/evaluation/evaluation.html", title=", ".join(report.students), report=report, parts=parts,
        notes=notes_of(report), fields=FIELDS, look=look,
    )  # fmt: skip


def _confusions(report: Evaluation, part: Measurement) -> list[dict[str, Any]]:
    """Return the confusion of decisions of each student: rows are the teacher's, in shares of the row."""
    plots = []
    for name in report.students:
        table = part.who[name].confusion
        given = {answer for row in table.values() for answer in row}
        answers = [answer for answer in (*TOKENS, UNPARSED_NAME) if answer in given or answer in table]
        rows = []
        for token, row in table.items():
            total = sum(row.values())
            rows.append([f"{token} ({total})", *(row.get(answer, 0) / total for answer in answers)])
        plots.append({
            "title": f"{name}: the teacher's decision (rows) against the answer", "head": ["", *answers], "rows": rows,
            "most": 1.0,
        })  # fmt: skip
    return plots
