"""Evaluated students side by side: the trade-off table, and differences by paired bootstrap.

Reads the folders of `distill evaluate`; writes `comparison.json`, `comparison.md` and `comparison.html`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.escaping import for_markdown
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, Record, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from cosfly.viz.page import page
from distill.evaluation.measure import STUDENT, Evaluation, FigureSet, read_report
from distill.evaluation.pages import (
    COLORS,
    NOTHING,
    STYLE,
    column_name,
    decision_bars,
    figure_table,
    heat_map,
    histogram,
    score_bars,
    shown,
    table,
)
from distill.evaluation.scores import (
    CONFIDENCE,
    FIGURES,
    LESS_IS_BETTER,
    NEITHER,
    SCORES,
    Difference,
    Scores,
    differences_of,
    read_scores,
)

STAGE = "distill.report"
FLOORS = ("majority", "rule", "blind", "shuffled", "constant", "teacher")
Names = dict[str, Evaluation]
RESAMPLES = 5000  # draws of walks for the intervals


class Pairing(Record):
    """Of two students: on how many samples they are compared, and the first's figures less the second's."""

    first: str
    second: str
    samples: int
    differences: dict[str, Difference]


class StudentComparison(Record):
    """`comparison.json`. not_comparable: figures that were measured in another way, and why."""

    students: dict[str, FigureSet]
    models: dict[str, str]
    floors: dict[str, FigureSet]
    pairings: list[Pairing]
    not_comparable: list[str]
    confidence: float
    resamples: int


def run(folders: Sequence[Path], out: Path, *, seed: int = 0, resume: Resume = "if-same") -> Path:
    """Read the evaluations of several students; write their comparison.

    Returns:
        The path of `comparison.md`.
    Raises:
        InputError: two evaluations have one name, are of other splits, or of other references.
    """
    names = [folder.absolute().name for folder in folders]
    if len(set(names)) < len(names):
        fix = "rename one of the folders, because their names are the names of the rows"
        raise InputError("two evaluations have the same name", got=", ".join(names), fix=fix)
    inputs = {f"evaluation/{name}": folder for name, folder in zip(names, folders, strict=True)}
    stage = StageFolder.open(out, STAGE, config=Config(), inputs=inputs, seed=seed, resume=resume)
    path = out / "comparison.md"
    if stage.is_complete:
        return path
    of_names = dict(zip(names, folders, strict=True))
    reports = {name: read_report(folder) for name, folder in of_names.items()}
    splits = {report.split for report in reports.values()}
    if len(splits) > 1:
        raise InputError(
            "the evaluations are of different splits",
            got=", ".join(sorted(splits)),
            fix="pass evaluations of one split",
        )
    comparison = compare(reports, of_names, seed)
    record, page = out / "comparison.json", out / "comparison.html"
    write_model(record, comparison, FileFormat("cosfly.distill_comparison", "1.0"))
    write_bytes(path, markdown_of(comparison, reports).encode())
    write_bytes(page, page_of(comparison, reports).encode())
    stage.finish([record, path, page], Tally(input=len(reports), kept=len(reports)))
    return path


def compare(reports: Names, folders: Mapping[str, Path], seed: int) -> StudentComparison:
    """Put students side by side; of the floors those of the first."""
    scores = {name: read_scores(folder / SCORES) for name, folder in folders.items()}
    pairings, strangers = [], []
    for first, second in combinations(reports, 2):
        _check_references(first, scores[first], second, scores[second])
        rng = rng_for(seed, STAGE, f"{first}/{second}")
        given: Any = {"resamples": RESAMPLES, "confidence": CONFIDENCE, "rng": rng}
        count, found = differences_of(scores[first], scores[second], **given)
        if not count:
            strangers.append(f"{first} and {second} have no sample in common")
        pairings.append(Pairing(first=first, second=second, samples=count, differences=found))
    someone = next(iter(reports.values())).all
    return StudentComparison(
        students={name: report.all.who[STUDENT] for name, report in reports.items()},
        models={name: report.model for name, report in reports.items()},
        floors={name: someone.who[name] for name in FLOORS if name in someone.who},
        pairings=pairings,
        not_comparable=[*_mismatches(reports), *strangers],
        confidence=CONFIDENCE,
        resamples=RESAMPLES,
    )


def _check_references(first: str, one: Scores, second: str, other: Scores) -> None:
    """Check that the samples that two students share are held against the same answers.

    Training sets of other captions may call their samples alike. What was asked may differ, as in an ablation.
    """
    held = dict(zip(other.key, other.against, strict=True))
    differ = [key for key, digest in zip(one.key, one.against, strict=True) if held.get(key, digest) != digest]
    if differ:
        words, fix = "two evaluations have different references", "evaluate both students on the same training set"
        got = f"{len(differ)} samples, the first {differ[0]}"
        raise InputError(words, where=f"{first} and {second}", got=got, fix=fix)


def _mismatches(reports: Names) -> list[str]:
    """Return which scores were measured in different ways."""
    found = []
    for first, second in combinations(reports, 2):
        one, other = reports[first], reports[second]
        if one.metrics != other.metrics:
            found.append(f"BERTScore of {first} and {second}: different models, layers, versions or settings")
        if one.all.samples != other.all.samples:
            found.append(
                f"{first} has {one.all.samples} samples and {second} {other.all.samples}; compare them by pairs"
            )
    return found


# The paper's table, and what its text adds.
_TABLE = (
    *("parsed", "bertscore_precision", "bertscore_recall", "bertscore_f1", "accuracy", "accuracy_parsed", "macro_f1"),
    *("accuracy_settled", "drawn_ahead"),
    *("consistent", "hard_conflict", "values_matched", "values_contradicted", "tokens"),
)


def everyone_of(comparison: StudentComparison) -> dict[str, FigureSet]:
    """Return the students and the floors, by what they are called."""
    return comparison.students | {column_name(name): own for name, own in comparison.floors.items()}


def _rows(comparison: StudentComparison, reports: Names) -> tuple[list[str], list[list[str]]]:
    everyone = everyone_of(comparison)
    names = [name for name in _TABLE if any(own.figures[name].value is not None for own in everyone.values())]
    header = ["", *(FIGURES[name] for name in names), "samples/s"]
    rows = []
    for who, own in everyone.items():
        speed = reports[who].speed.samples_per_s if who in reports else None
        cells = [shown(name, own.figures[name], interval=who in reports) for name in names]
        rows.append([who, *cells, NOTHING if speed is None else f"{speed:.2f}"])
    return header, rows


def _difference(name: str, found: Difference) -> list[str]:
    if found.value is None:
        return [NOTHING, NOTHING, NOTHING]
    interval = NOTHING if found.low is None or found.high is None else f"{found.low:+.4f} to {found.high:+.4f}"
    return [f"{found.value:+.4f}", interval, NOTHING if found.p is None else f"{found.p:.4f}"]


def _said(pairing: Pairing) -> list[list[str]]:
    rows = []
    for name, found in pairing.differences.items():
        if found.value is not None:
            is_clear = found.low is not None and found.high is not None and (found.low > 0 or found.high < 0)
            first_leads = (found.value > 0) != (name in LESS_IS_BETTER)
            better = (pairing.first if first_leads else pairing.second) if is_clear else "not clear"
            better = NOTHING if name in NEITHER else better
            rows.append([FIGURES[name], *_difference(name, found), better])
    return rows


_HEADER = ["", "difference", "interval", "p", "better"]


def markdown_of(comparison: StudentComparison, reports: Names) -> str:
    """Return the comparison as a Markdown page."""
    header, rows = _rows(comparison, reports)
    lines = ["# Comparison of students", "", *table(header, [[for_markdown(cell) for cell in row] for row in rows]), ""]
    lines += [f"- {for_markdown(name)}: {for_markdown(model)}" for name, model in comparison.models.items()]
    lines += [f"- not comparable: {for_markdown(words)}" for words in comparison.not_comparable]
    for pairing in comparison.pairings:
        title = f"## {for_markdown(pairing.first)} minus {for_markdown(pairing.second)}"
        lines += ["", title, "", _how(comparison, pairing), ""]
        lines += table(_HEADER, [[for_markdown(cell) for cell in row] for row in _said(pairing)])
    return "\n".join(lines) + "\n"


def _how(comparison: StudentComparison, pairing: Pairing) -> str:
    how = f"{comparison.confidence:.0%} intervals from {comparison.resamples} paired draws of pedestrian trajectories"
    return f"On the {pairing.samples} samples that both students answered; {how}."


def page_of(comparison: StudentComparison, reports: Names) -> str:
    """Return the comparison as a page that needs nothing but itself."""
    header, rows = _rows(comparison, reports)
    charts = [("Accuracy by decision", decision_bars(comparison.students))]
    histograms = {name: found for name, report in reports.items() if (found := report.all.histogram_f1) is not None}
    if histograms:
        charts.append(("BERTScore F1 of parsed answers", histogram(histograms)))
        charts.append(("BERTScore, all answers", score_bars(comparison.students)))
    charts += [(f"{name}: reference against answer", heat_map(own)) for name, own in comparison.students.items()]
    pairings = [
        {"title": f"{one.first} minus {one.second}", "how": _how(comparison, one), "rows": _said(one)}
        for one in comparison.pairings
    ]
    everyone = everyone_of(comparison)
    return page(
        "distill/evaluation/comparison.html", title=", ".join(comparison.students), style=STYLE, colors=COLORS,
        comparison=comparison, header=header, rows=rows, figures=charts, pairings=pairings, difference_header=_HEADER,
        everyone=figure_table(everyone, intervals=[*everyone]),
    )  # fmt: skip
