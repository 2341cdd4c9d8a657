"""An evaluation as Markdown and as one HTML page that stands alone, with the paper's figures of students."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosfly.formats.captions import FIELDS, TOKENS
from cosfly.formats.episodes import Figure
from cosfly.runtime.escaping import for_markdown
from cosfly.runtime.io import read_text
from cosfly.viz.page import page
from distill.evaluation.measure import STUDENT, UNPARSED_NAME, Evaluation, FigureSet, Measurement
from distill.evaluation.scores import FIGURES

STYLE = "\n" + read_text(Path(__file__).with_name("pages.css"))
COLORS = (
    *("#2b6cb0", "#c05621", "#2f855a", "#6b46c1", "#b83280", "#4a5568"),
    *("#00a3c4", "#e0a800", "#7cb518", "#e53e3e", "#b794f4", "#8c6d46"),
)  # fmt: skip
SHARES = {name for name in FIGURES if not name.startswith(("bertscore", "macro", "tokens"))}
NOTHING = "-"
CELL_PX = 58  # of a confusion table


def shown(name: str, figure: Figure, *, interval: bool = True) -> str:
    """Return a figure in words: its value and, in brackets, its interval."""
    digits = "{:.2%}" if name in SHARES or name not in FIGURES else "{:.1f}" if name == "tokens" else "{:.4f}"
    return shown_as(digits, figure, interval=interval)


def shown_as(digits: str, figure: Figure, *, interval: bool = True) -> str:
    """Return a figure in words, its numbers as `digits` has them ("{:.1%}")."""
    if figure.value is None:
        return NOTHING
    text = digits.format(figure.value)
    if not interval or figure.low is None or figure.high is None:
        return text
    return f"{text} ({digits.format(figure.low)} to {digits.format(figure.high)})"


def color_of(number: int) -> str:
    """Return the colour of one of several who stand side by side."""
    return COLORS[number % len(COLORS)]


def metric_lines(report: Evaluation) -> list[str]:
    """Return what BERTScore was measured with."""
    lines = []
    for language, metric in report.metrics.items():
        if metric is None:
            lines.append(f"BERTScore of {language}: not computed, because no model folder was passed")
            continue
        weights = [d[:12] for name, d in metric.sha256.items() if name.endswith((".safetensors", ".bin"))]
        words = [metric.model, f"layer {metric.layer}", "not rescaled", f"weights {', '.join(weights)}"]
        words += [f"{name} {number}" for name, number in metric.versions.items()]
        cut = f"; {metric.cut} references longer than {metric.max_tokens} tokens" if metric.cut else ""
        lines.append(f"BERTScore of {language}: {', '.join(words)}{cut}")
    return lines


def _notes(report: Evaluation) -> list[str]:
    speed = report.speed
    notes = [
        f"intervals: {report.confidence:.0%}, {report.resamples} draws of {report.all.walks} pedestrian trajectories",
        *report.notes,
    ]
    notes += metric_lines(report)
    if not report.judged:
        notes.append(
            "no values were checked; to check them, pass captions of cosfly caption --teacher student:PATH as --judged"
        )
    if speed.samples_per_s is not None:
        notes.append(f"the last run of the student took {speed.seconds:.1f} s, {speed.samples_per_s:.2f} samples/s")
    if speed.latency_s is not None:
        notes.append("latency, s: " + ", ".join(f"{name} {value:.2f}" for name, value in speed.latency_s.items()))
    if report.not_asked:
        notes.append(f"{report.not_asked} samples of the split have no prediction")
    for what, reasons in (("no answer", report.all.failed), ("unparsed", report.all.unparsed)):
        if reasons:
            notes.append(f"{what}: " + ", ".join(f"{reason} {count}" for reason, count in reasons.items()))
    return notes


def _parts(report: Evaluation) -> dict[str, Measurement]:
    parts: dict[str, Measurement] = dict(report.languages.items())
    return {"all": report.all, **parts} if len(parts) > 1 else parts


def column_name(name: str) -> str:
    """Name a column: the student, the teacher, or a floor."""
    return name if name in (STUDENT, "teacher") else f"baseline: {name}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table; its cells are Markdown."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def figure_table(who: Mapping[str, FigureSet], *, intervals: Collection[str]) -> dict[str, Any]:
    """Return the figures of those who answered, one a column, of some with their intervals: header and rows."""
    rows = [
        [words, *(shown(name, own.figures[name], interval=called in intervals) for called, own in who.items())]
        for name, words in FIGURES.items()
        if any(own.figures[name].value is not None for own in who.values())
    ]
    return {"header": ["", *who], "rows": rows}


def markdown_of(report: Evaluation) -> str:
    """Return the report as a Markdown page."""
    lines = [f"# {for_markdown(report.model)} on {report.split}", ""]
    for title, part in _parts(report).items():
        lines += [f"## {title}: {part.samples} samples of {part.walks} pedestrian trajectories", ""]
        lines += [*table(**figure_table(_beside(part), intervals=[STUDENT])), "", *_decisions(part), ""]
    lines += ["## How it was measured", "", *(f"- {for_markdown(note)}" for note in _notes(report))]
    return "\n".join(lines) + "\n"


def _decisions(part: Measurement) -> list[str]:
    student = part.who[STUDENT]
    rows = []
    for token, figure in student.by_decision.items():
        answers = sorted(student.confusion.get(token, {}).items(), key=lambda item: -item[1])[:3]
        rows.append([token, str(figure.count), shown(token, figure), ", ".join(f"{name} {n}" for name, n in answers)])
    return table(["decision", "samples", "accuracy", "most frequent answers"], rows)


def page_of(report: Evaluation, pictures: Mapping[str, Sequence[str]]) -> str:
    """Return the report as a page that needs nothing but itself.

    Args:
        pictures: key of an example -> the frames of its window, JPEG in base64.
    """
    parts = []
    for title, part in _parts(report).items():
        student = part.who[STUDENT]
        charts = [
            ("Accuracy by decision", decision_bars({STUDENT: student, **_beside(part, "majority", "blind")})),
            ("Reference (rows) against answer", heat_map(student)),
        ]
        if part.histogram_f1 is not None:
            beside = _beside(part, "shuffled", "constant")
            charts.append(("BERTScore F1 of parsed answers", histogram({STUDENT: part.histogram_f1})))
            charts.append(("BERTScore, all answers", score_bars({STUDENT: student, **beside})))
        own = {"title": title, "samples": part.samples, "walks": part.walks, "charts": charts}
        parts.append(own | figure_table(_beside(part), intervals=[*_beside(part)]))
    return page(
        "distill/evaluation/evaluation.html", title=report.model, style=STYLE, report=report, tiles=_tiles(report.all),
        parts=parts, notes=_notes(report), fields=FIELDS, colors=COLORS, pictures=pictures,
    )  # fmt: skip


def _tiles(part: Measurement) -> list[tuple[str, str]]:
    """Return what a person asks first: how much was asked, how good the answers are, and how good those of floors."""
    tiles = [(f"{part.samples:,}", "samples"), (f"{part.walks:,}", "pedestrian trajectories")]
    for figure, who, words in (
        ("accuracy", STUDENT, "decisions are right"),
        ("accuracy", "blind", "right by a network without pictures"),
        ("accuracy", "rule", "right by a rule on two numbers"),
        ("accuracy", "majority", "right by the most frequent decision"),
        ("accuracy_on_labels", STUDENT, "decisions are the geometric label"),
        ("accuracy_on_labels", "teacher", "teacher's decisions are the label"),
        ("drawn_ahead", STUDENT, "labels may depend on later draws"),
        ("parsed", STUDENT, "answers parse"),
    ):
        if who in part.who and (value := part.who[who].figures[figure].value) is not None:
            tiles.append((f"{value:.0%}", words))
    return tiles


def _beside(part: Measurement, *names: str) -> dict[str, FigureSet]:
    """Return those who answered, all or some, by what their columns are called."""
    return {column_name(name): own for name, own in part.who.items() if name in names or not names}


Chart = dict[str, Any]  # as charts.html draws it: view, width, names of its colours, lines, rects, texts


def _shape(**values: Any) -> dict[str, Any]:
    """Return a line, rectangle or text of a chart, its numbers rounded."""
    return {name: round(value, 3) if isinstance(value, float) else value for name, value in values.items()}


def bars(groups: Mapping[str, Mapping[str, Figure]], low: float = 0.0) -> Chart:
    """Return grouped bars with their intervals; groups: label -> who -> figure, values from `low` to 1."""
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    width, height = 18, 200
    step = max(60, width * len(names) + 26)
    total = 50 + step * len(groups)

    def y(value: float) -> float:
        return 20 + height * (1 - (min(1.0, max(low, value)) - low) / (1 - low))

    ticks = [low + (1 - low) * k / 5 for k in range(6)]
    lines = [_shape(x1=46, x2=total, y1=y(v), y2=y(v), kind="axis") for v in ticks]
    texts, rects = [_shape(x=40, y=y(v) + 4, words=f"{v:.2f}", anchor="end") for v in ticks], []
    for place, (label, group) in enumerate(groups.items()):
        left = 56 + place * step
        for number, name in enumerate(names):
            figure = group.get(name)
            if figure is None or figure.value is None:
                continue
            x, top = left + number * width, y(figure.value)
            title, fill = f"{name}, {label}: {figure.value:.4f} of {figure.count}", color_of(number)
            rects.append(_shape(x=x, y=top, width=width - 3, height=y(low) - top, fill=fill, title=title))
            if figure.low is not None and figure.high is not None:
                middle = x + (width - 3) / 2
                lines.append(_shape(x1=middle, x2=middle, y1=y(figure.high), y2=y(figure.low), kind="whisker"))
        texts.append(_shape(x=left + width * len(names) / 2, y=236, words=label, anchor="end", turned=-28))
    places = {"view": f"-60 0 {total + 70} 330", "width": total + 70}
    return {"names": names, "lines": lines, "rects": rects, "texts": texts, **places}


def decision_bars(who: Mapping[str, FigureSet]) -> Chart:
    """Return the accuracy by decision, the most frequent first."""
    counts: dict[str, int] = {}
    for own in who.values():
        for token, figure in own.by_decision.items():
            counts[token] = max(counts.get(token, 0), figure.count)
    groups = {}
    for token in sorted(counts, key=lambda token: (-counts[token], token)):
        found = {name: own.by_decision[token] for name, own in who.items() if token in own.by_decision}
        groups[f"{token} ({counts[token]})"] = found
    return bars(groups)


def score_bars(who: Mapping[str, FigureSet]) -> Chart:
    """Return BERTScore's precision, recall and F1; the axis begins below the least of them."""
    names = {"precision": "bertscore_precision", "recall": "bertscore_recall", "F1": "bertscore_f1"}
    groups = {label: {n: own.figures[name] for n, own in who.items()} for label, name in names.items()}
    values = [figure.value for group in groups.values() for figure in group.values() if figure.value is not None]
    return bars(groups, low=min(0.8, int(max(0.0, min(values, default=0.0) - 0.02) * 20) / 20))


def histogram(who: Mapping[str, Sequence[int]]) -> Chart:
    """Return how often which F1 occurs; who -> counts in equal bins from 0 to 1. Empty low bins are left out."""
    num_bins, kinds = len(next(iter(who.values()))), len(who)
    first = min(next((k for k, count in enumerate(counts) if count), num_bins - 1) for counts in who.values())
    first = min(first, num_bins - 5)
    most, width, rects = max(1, *(max(counts) for counts in who.values())), 600 / (num_bins - first), []
    for number, (name, counts) in enumerate(who.items()):
        for k in range(first, num_bins):
            x, height = 46 + (k - first) * width + number * width / kinds, 180 * counts[k] / most
            title = f"{name}, {k / num_bins:.2f} to {(k + 1) / num_bins:.2f}: {counts[k]}"
            size = {"width": max(1.0, width / kinds - 1), "height": height}
            rects.append(_shape(x=x, y=200 - height, **size, fill=color_of(number), title=title))
    ticks = range(first, num_bins + 1, max(1, (num_bins - first) // 8))
    places = [(46 + (k - first) * width, f"{k / num_bins:.2f}") for k in ticks]
    texts = [_shape(x=x, y=218, words=words, anchor="middle") for x, words in places]
    texts.append(_shape(x=40, y=24, words=str(most), anchor="end"))
    line = _shape(x1=46, x2=646, y1=200, y2=200, kind="axis")
    return {"names": list(who), "lines": [line], "rects": rects, "texts": texts, "view": "0 0 670 230", "width": 670}


def heat_map(who: FigureSet) -> Chart:
    """Return the confusion of decisions: rows are references, columns answers, colours the share of the row."""
    rows = [token for token in TOKENS if token in who.confusion]
    answers = {name for row in rows for name in who.confusion[row]}
    columns = [name for name in (*TOKENS, UNPARSED_NAME) if name in rows or name in answers]
    size, left, top = CELL_PX, 205, 160
    texts = [
        _shape(x=left + j * size + size / 2, y=top - 8, words=name, anchor="start", turned=-40)
        for j, name in enumerate(columns)
    ]
    rects = []
    for i, row in enumerate(rows):
        total, y = sum(who.confusion[row].values()), top + i * size
        texts.append(_shape(x=left - 8, y=y + size / 2 + 4, words=f"{row} ({total})", anchor="end"))
        for j, name in enumerate(columns):
            count, x = who.confusion[row].get(name, 0), left + j * size
            share = count / total
            look = {"fill": "var(--accent)", "opacity": share, "kind": "same" if row == name else "cell"}
            title = f"{row} answered as {name}: {count} of {total}"
            rects.append(_shape(x=x + 1, y=y + 1, width=size - 2, height=size - 2, title=title, **look))
            if count:
                words = f"{share:.0%}" if share >= 0.01 else "<1%"
                place = {"x": x + size / 2, "y": y + size / 2 + 4, "anchor": "middle"}
                texts.append(_shape(words=words, is_on=share > 0.55, **place))
    width, height = left + len(columns) * size + 110, top + len(rows) * size + 10
    places = {"view": f"0 0 {width} {height}", "width": width}
    return {"names": [], "lines": [], "rects": rects, "texts": texts, **places}
