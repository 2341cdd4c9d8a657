"""An evaluation as Markdown and as one self-contained HTML page, with the figures of the paper's appendix on captions' distillation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosfly.escaping import for_markdown
from cosfly.look.page import page
from cosfly.products.actions import action_tokens
from cosfly.products.captions import FIELDS
from cosfly.reading.files import read_text
from distill.evaluation.measure import STUDENT, UNPARSED_NAME, Measured, Measurement, Report
from distill.evaluation.scores import FIGURES, Figure

STYLE = "\n" + read_text(Path(__file__).with_name("pages.css"))
COLORS = ("#2b6cb0", "#c05621", "#2f855a", "#6b46c1", "#b83280", "#4a5568")
SHARES = {name for name in FIGURES if not name.startswith(("bertscore", "macro", "tokens"))}
NOTHING = "-"


def shown(name: str, figure: Figure, *, interval: bool = True) -> str:
    """Give a figure in words: its value and, in brackets, its interval."""
    if figure.value is None:
        return NOTHING
    digits = "{:.2%}" if name in SHARES or name in action_tokens() else "{:.1f}" if name == "tokens" else "{:.4f}"
    text = digits.format(figure.value)
    if not interval or figure.low is None or figure.high is None:
        return text
    return f"{text} ({digits.format(figure.low)} to {digits.format(figure.high)})"


def metric_lines(report: Report) -> list[str]:
    """Say what BERTScore was measured with."""
    lines = []
    for language, metric in report.metrics.items():
        if metric is None:
            lines.append(f"BERTScore of {language}: not computed, no model folder")
            continue
        weights = [digest for name, digest in metric.sha256.items() if name.endswith((".safetensors", ".bin"))]
        lines.append(
            f"BERTScore of {language}: {metric.model}, layer {metric.layer}, {'idf' if metric.idf else 'no idf'}, "
            f"{'rescaled' if metric.baseline_sha256 else 'not rescaled'}, weights {', '.join(d[:12] for d in weights)}, "
            + ", ".join(f"{name} {number}" for name, number in metric.versions.items())
            + (f"; {metric.cut} references longer than {metric.max_tokens} tokens" if metric.cut else "")
        )
    return lines


def _notes(report: Report) -> list[str]:
    speed = report.speed
    said = [f"intervals: {report.confidence:.0%}, {report.resamples} draws of {report.all.walks} walks", *report.notes]
    said += metric_lines(report)
    if "student" not in report.judged:
        said.append("sentences were not judged: give --judged what cosfly caption --teacher student: wrote")
    if speed.samples_per_s is not None:
        said.append(f"its last start answered for {speed.seconds:.1f} s, {speed.samples_per_s:.2f} samples/s")
    if speed.latency_s is not None:
        said.append("latency, s: " + ", ".join(f"{name} {value:.2f}" for name, value in speed.latency_s.items()))
    if report.not_asked:
        said.append(f"{report.not_asked} samples of the split were not asked")
    for what, reasons in (("no answer", report.all.failed), ("unparsed", report.all.unparsed)):
        if reasons:
            said.append(f"{what}: " + ", ".join(f"{reason} {count}" for reason, count in reasons.items()))
    return said


def _parts(report: Report) -> dict[str, Measurement]:
    parts: dict[str, Measurement] = dict(report.languages.items())
    return {"all": report.all, **parts} if len(parts) > 1 else parts


# --- Markdown ---------------------------------------------------------------------------------------------------------


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Give the lines of a Markdown table; its cells are Markdown."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def markdown_of(report: Report) -> str:
    """Give the report as a Markdown page."""
    lines = [f"# {for_markdown(report.model)} on {report.split}", ""]
    for title, part in _parts(report).items():
        lines += [f"## {title}: {part.samples} samples of {part.walks} walks", ""]
        header = ["", *(name if name == STUDENT else f"floor: {name}" for name in part.who)]
        lines += table(
            header,
            (
                [
                    words,
                    *(shown(name, who.figures[name], interval=who is part.who[STUDENT]) for who in part.who.values()),
                ]
                for name, words in FIGURES.items()
                if any(who.figures[name].value is not None for who in part.who.values())
            ),
        )
        lines += ["", *_decisions(part), ""]
    lines += ["## How it was measured", "", *(f"- {for_markdown(note)}" for note in _notes(report))]
    return "\n".join(lines) + "\n"


def _decisions(part: Measurement) -> list[str]:
    student = part.who[STUDENT]
    rows = []
    for token, figure in student.by_decision.items():
        answers = sorted(student.confusion.get(token, {}).items(), key=lambda item: -item[1])[:3]
        rows.append([token, str(figure.count), shown(token, figure), ", ".join(f"{name} {n}" for name, n in answers)])
    return table(["decision", "samples", "accuracy", "most frequent answers"], rows)


# --- HTML -------------------------------------------------------------------------------------------------------------

Chart = dict[str, Any]  # as charts.html draws it: view, width, names of its colours, lines, rects, texts


def page_of(report: Report) -> str:
    """Give the report as a page that needs nothing but itself."""
    parts = []
    for title, part in _parts(report).items():
        student = part.who[STUDENT]
        charts: list[tuple[str, Chart]] = [
            ("Accuracy by decision", decision_bars({STUDENT: student, **_beside(part, "majority")})),
            ("Reference against answer", heat_map(student)),
        ]
        if part.histogram_f1 is not None:
            beside = _beside(part, "shuffled", "constant")
            charts.append(("BERTScore F1 of parsed answers", histogram({STUDENT: part.histogram_f1})))
            charts.append(("BERTScore, all answers", score_bars({STUDENT: student, **beside})))
        parts.append(
            {"title": title, "samples": part.samples, "walks": part.walks, "charts": charts}
            | figure_table({STUDENT: student, **_beside(part, *part.who)})
        )
    return page(
        "distill/evaluation/evaluation.html", title=report.model, style=STYLE, report=report, parts=parts, notes=_notes(report),
        fields=FIELDS, colors=COLORS,
    )  # fmt: skip


def _beside(part: Measurement, *names: str) -> dict[str, Measured]:
    return {f"floor: {name}": part.who[name] for name in names if name in part.who and name != STUDENT}


def figure_table(who: Mapping[str, Measured]) -> dict[str, Any]:
    """Give the figures of those who answered, one a column: header and rows."""
    rows = [
        [words, *(shown(name, own.figures[name]) for own in who.values())]
        for name, words in FIGURES.items()
        if any(own.figures[name].value is not None for own in who.values())
    ]
    return {"header": ["", *who], "rows": rows}


def _rect(x: float, y: float, width: float, height: float, fill: str, title: str, opacity: float = 1.0, kind: str = "") -> dict:  # fmt: skip
    return {
        "x": round(x, 1), "y": round(y, 1), "width": round(width, 1), "height": round(height, 1), "fill": fill, "title": title,
        "opacity": round(opacity, 3), "kind": kind,
    }  # fmt: skip


def _line(x1: float, x2: float, y1: float, y2: float, kind: str = "axis") -> dict:
    return {"x1": round(x1, 1), "x2": round(x2, 1), "y1": round(y1, 1), "y2": round(y2, 1), "kind": kind}


def _text(x: float, y: float, words: str, anchor: str = "start", turned: int = 0, *, is_on: bool = False) -> dict:
    return {"x": round(x, 1), "y": round(y, 1), "words": words, "anchor": anchor, "turned": turned, "is_on": is_on}


def bars(groups: Mapping[str, Mapping[str, Figure]], low: float = 0.0) -> Chart:
    """Give grouped bars with their intervals; groups: label -> who -> figure, values from `low` to 1."""
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    width, height = 18, 200
    step = width * len(names) + 26
    total = 50 + step * len(groups)

    def y(value: float) -> float:
        return 20 + height * (1 - (min(1.0, max(low, value)) - low) / (1 - low))

    ticks = [low + (1 - low) * k / 5 for k in range(6)]
    lines, rects = [_line(46, total, y(v), y(v)) for v in ticks], []
    texts = [_text(40, y(v) + 4, f"{v:.2f}", "end") for v in ticks]
    for place, (label, group) in enumerate(groups.items()):
        left = 56 + place * step
        for number, name in enumerate(names):
            figure = group.get(name)
            if figure is None or figure.value is None:
                continue
            x, top = left + number * width, y(figure.value)
            title = f"{name}, {label}: {figure.value:.4f} of {figure.count}"
            rects.append(_rect(x, top, width - 3, y(low) - top, COLORS[number % 6], title))
            if figure.low is not None and figure.high is not None:
                middle = x + (width - 3) / 2
                lines.append(_line(middle, middle, y(figure.high), y(figure.low), "whisker"))
        texts.append(_text(left + width * len(names) / 2, 236, label, "end", -28))
    return {"names": names, "view": f"-60 0 {total + 70} 330", "width": total + 70, "lines": lines, "rects": rects, "texts": texts}  # fmt: skip


def decision_bars(who: Mapping[str, Measured]) -> Chart:
    """Give the accuracy by decision, the most frequent first."""
    counts: dict[str, int] = {}
    for own in who.values():
        for token, figure in own.by_decision.items():
            counts[token] = max(counts.get(token, 0), figure.count)
    order = sorted(counts, key=lambda token: (-counts[token], token))
    return bars({
        f"{token} ({counts[token]})": {name: own.by_decision[token] for name, own in who.items() if token in own.by_decision}
        for token in order
    })  # fmt: skip


def score_bars(who: Mapping[str, Measured]) -> Chart:
    """Give BERTScore's precision, recall and F1; the axis begins below the least of them."""
    names = {"precision": "bertscore_precision", "recall": "bertscore_recall", "F1": "bertscore_f1"}
    groups = {label: {n: own.figures[name] for n, own in who.items()} for label, name in names.items()}
    values = [figure.value for group in groups.values() for figure in group.values() if figure.value is not None]
    return bars(groups, low=min(0.8, int(max(0.0, min(values, default=0.0) - 0.02) * 20) / 20))


def histogram(who: Mapping[str, Sequence[int]]) -> Chart:
    """Give how often which F1 occurs; who -> counts in equal bins from 0 to 1. Empty bins at the low end are left out."""
    num_bins = len(next(iter(who.values())))
    first = min(next((k for k, count in enumerate(counts) if count), num_bins - 1) for counts in who.values())
    first = min(first, num_bins - 5)
    most = max(1, *(max(counts) for counts in who.values()))
    width, height, kinds = 600 / (num_bins - first), 180, len(who)
    rects = [
        _rect(
            46 + (k - first) * width + number * width / kinds, 200 - height * counts[k] / most, max(1.0, width / kinds - 1),
            height * counts[k] / most, COLORS[number % 6], f"{name}, {k / num_bins:.2f} to {(k + 1) / num_bins:.2f}: {counts[k]}",
        )
        for number, (name, counts) in enumerate(who.items())
        for k in range(first, num_bins)
    ]  # fmt: skip
    every = max(1, (num_bins - first) // 8)
    ticks = range(first, num_bins + 1, every)
    texts = [_text(46 + (k - first) * width, 218, f"{k / num_bins:.2f}", "middle") for k in ticks]
    texts.append(_text(40, 24, str(most), "end"))
    return {"names": list(who), "view": "0 0 670 230", "width": 670, "lines": [_line(46, 646, 200, 200)], "rects": rects, "texts": texts}  # fmt: skip


def heat_map(who: Measured) -> Chart:
    """Give the confusion of decisions: rows are references, columns answers, colours the share of the row."""
    rows = [token for token in action_tokens() if token in who.confusion]
    columns = [
        name
        for name in (*action_tokens(), UNPARSED_NAME)
        if name in rows or any(name in who.confusion[row] for row in rows)
    ]
    size, left, top = 44, 190, 150
    rects, texts = (
        [],
        [_text(left + j * size + size / 2, top - 8, name, "start", -40) for j, name in enumerate(columns)],
    )
    for i, row in enumerate(rows):
        total, y = sum(who.confusion[row].values()), top + i * size
        texts.append(_text(left - 8, y + 27, row, "end"))
        for j, name in enumerate(columns):
            count, x = who.confusion[row].get(name, 0), left + j * size
            share = count / total if total else 0.0
            title, kind = f"{row} answered as {name}: {count} of {total}", "same" if row == name else ""
            rects.append(_rect(x + 1, y + 1, size - 2, size - 2, "var(--accent)", title, share, kind))
            if count:
                words = f"{share:.0%}" if share >= 0.01 else "<1%"
                texts.append(_text(x + size / 2, y + 27, words, "middle", is_on=share > 0.55))
    width, height = left + len(columns) * size + 130, top + len(rows) * size + 10
    return {"names": [], "view": f"0 0 {width} {height}", "width": width, "lines": [], "rects": rects, "texts": texts}
