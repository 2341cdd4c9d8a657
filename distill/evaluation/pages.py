"""An evaluation as Markdown and as one self-contained HTML page, with the figures of the paper's appendix on captions' distillation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from cosfly.escaping import for_html, for_markdown, html_page
from cosfly.products.actions import action_tokens
from cosfly.products.captions import FIELDS, Coc
from cosfly.reading.files import read_text
from distill.evaluation.measure import STUDENT, UNPARSED_NAME, Example, Measured, Measurement, Report
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


def page_of(report: Report) -> str:
    """Give the report as a page that needs nothing but itself."""
    body = [f"<h1>{for_html(report.model)}</h1>", f'<p class="lead">answers to the split {report.split}</p>']
    for title, part in _parts(report).items():
        student = part.who[STUDENT]
        body.append(f"<h2>{for_html(title)}: {part.samples} samples of {part.walks} walks</h2>")
        body.append(figure_table({STUDENT: student, **_beside(part, *part.who)}))
        panels = [
            ("Accuracy by decision", decision_bars({STUDENT: student, **_beside(part, "majority")})),
            ("Reference against answer", heat_map(student)),
        ]
        if part.histogram_f1 is not None:
            panels.append(("BERTScore F1 of parsed answers", histogram({STUDENT: part.histogram_f1})))
            panels.append(
                ("BERTScore, all answers", score_bars({STUDENT: student, **_beside(part, "shuffled", "constant")}))
            )
        body += [f'<div class="panel"><h3>{title}</h3>{drawn}</div>' for title, drawn in panels]
    if report.examples:
        body.append(f"<h2>{len(report.examples)} samples side by side</h2>")
        body.append('<p class="lead">Drawn by the seed; no answer, unparsed, wrong and right ones take turns.</p>')
        body += [_example(example) for example in report.examples]
    body.append("<h2>How it was measured</h2><ul>")
    body += [f"<li>{for_html(note)}</li>" for note in _notes(report)]
    body.append("</ul>")
    return html_page(f"cosfly: {report.model}", STYLE, "\n".join(body))


def _beside(part: Measurement, *names: str) -> dict[str, Measured]:
    return {f"floor: {name}": part.who[name] for name in names if name in part.who and name != STUDENT}


def figure_table(who: Mapping[str, Measured]) -> str:
    """Give the figures of those who answered, one a column."""
    heads = "".join(f"<th>{for_html(name)}</th>" for name in who)
    rows = []
    for name, words in FIGURES.items():
        if any(own.figures[name].value is not None for own in who.values()):
            cells = "".join(f"<td>{for_html(shown(name, own.figures[name]))}</td>" for own in who.values())
            rows.append(f"<tr><th>{for_html(words)}</th>{cells}</tr>")
    return f'<table class="figures"><tr><th></th>{heads}</tr>{"".join(rows)}</table>'


def _legend(names: Iterable[str]) -> str:
    marks = (
        f'<span><i style="background:{color}"></i>{for_html(name)}</span>'
        for name, color in zip(names, COLORS, strict=False)
    )
    return f'<p class="legend">{"".join(marks)}</p>'


def bars(groups: Mapping[str, Mapping[str, Figure]], low: float = 0.0) -> str:
    """Draw grouped bars with their intervals; groups: label -> who -> figure, values from `low` to 1."""
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    width, height = 18, 200
    step = width * len(names) + 26
    total = 50 + step * len(groups)

    def y(value: float) -> float:
        return 20 + height * (1 - (min(1.0, max(low, value)) - low) / (1 - low))

    parts = [
        f'<line class="grid" x1="46" x2="{total}" y1="{y(v):.1f}" y2="{y(v):.1f}"/>'
        f'<text x="40" y="{y(v) + 4:.1f}" text-anchor="end">{v:.2f}</text>'
        for v in (low + (1 - low) * k / 5 for k in range(6))
    ]
    for place, (label, group) in enumerate(groups.items()):
        left = 56 + place * step
        for number, name in enumerate(names):
            figure = group.get(name)
            if figure is None or figure.value is None:
                continue
            x = left + number * width
            value = y(figure.value)
            parts.append(
                f'<rect x="{x}" y="{value:.1f}" width="{width - 3}" height="{y(low) - value:.1f}" fill="{COLORS[number % 6]}">'
                f"<title>{for_html(f'{name}, {label}: {figure.value:.4f} of {figure.count}')}</title></rect>"
            )
            if figure.low is not None and figure.high is not None:
                middle = x + (width - 3) / 2
                parts.append(
                    f'<line class="whisker" x1="{middle}" x2="{middle}" y1="{y(figure.high):.1f}" y2="{y(figure.low):.1f}"/>'
                )
        middle = left + width * len(names) / 2
        parts.append(
            f'<text transform="translate({middle:.0f},236) rotate(-28)" text-anchor="end">{for_html(label)}</text>'
        )
    return f'{_legend(names)}<svg viewBox="-60 0 {total + 70} 330" width="{total + 70}">{"".join(parts)}</svg>'


def decision_bars(who: Mapping[str, Measured]) -> str:
    """Draw the accuracy by decision, the most frequent first."""
    counts: dict[str, int] = {}
    for own in who.values():
        for token, figure in own.by_decision.items():
            counts[token] = max(counts.get(token, 0), figure.count)
    order = sorted(counts, key=lambda token: (-counts[token], token))
    return bars({
        f"{token} ({counts[token]})": {name: own.by_decision[token] for name, own in who.items() if token in own.by_decision}
        for token in order
    })  # fmt: skip


def score_bars(who: Mapping[str, Measured]) -> str:
    """Draw BERTScore's precision, recall and F1; the axis begins below the least of them."""
    names = {"precision": "bertscore_precision", "recall": "bertscore_recall", "F1": "bertscore_f1"}
    groups = {label: {n: own.figures[name] for n, own in who.items()} for label, name in names.items()}
    values = [figure.value for group in groups.values() for figure in group.values() if figure.value is not None]
    return bars(groups, low=min(0.8, int(max(0.0, min(values, default=0.0) - 0.02) * 20) / 20))


def histogram(who: Mapping[str, Sequence[int]]) -> str:
    """Draw how often which F1 occurs; who -> counts in equal bins from 0 to 1. Empty bins at the low end are left out."""
    num_bins = len(next(iter(who.values())))
    first = min(next((k for k, count in enumerate(counts) if count), num_bins - 1) for counts in who.values())
    first = min(first, num_bins - 5)
    most = max(1, *(max(counts) for counts in who.values()))
    width, height, kinds = 600 / (num_bins - first), 180, len(who)
    parts = []
    for number, (name, counts) in enumerate(who.items()):
        for k in range(first, num_bins):
            tall = height * counts[k] / most
            x = 46 + (k - first) * width + number * width / kinds
            parts.append(
                f'<rect x="{x:.1f}" y="{200 - tall:.1f}" width="{max(1.0, width / kinds - 1):.1f}" height="{tall:.1f}" '
                f'fill="{COLORS[number % 6]}"><title>{for_html(name)}, {k / num_bins:.2f} to {(k + 1) / num_bins:.2f}: '
                f"{counts[k]}</title></rect>"
            )
    every = max(1, (num_bins - first) // 8)
    for k in range(first, num_bins + 1, every):
        parts.append(f'<text x="{46 + (k - first) * width:.1f}" y="218" text-anchor="middle">{k / num_bins:.2f}</text>')
    parts.append(
        f'<text x="40" y="24" text-anchor="end">{most}</text><line class="grid" x1="46" x2="646" y1="200" y2="200"/>'
    )
    return f'{_legend(who)}<svg viewBox="0 0 670 230" width="670">{"".join(parts)}</svg>'


def heat_map(who: Measured) -> str:
    """Draw the confusion of decisions: rows are references, columns answers, colours the share of the row."""
    rows = [token for token in action_tokens() if token in who.confusion]
    columns = [
        name
        for name in (*action_tokens(), UNPARSED_NAME)
        if name in rows or any(name in who.confusion[row] for row in rows)
    ]
    size, left, top = 44, 190, 150
    parts = []
    for j, name in enumerate(columns):
        x = left + j * size + size / 2
        parts.append(f'<text transform="translate({x:.0f},{top - 8}) rotate(-40)">{for_html(name)}</text>')
    for i, row in enumerate(rows):
        total = sum(who.confusion[row].values())
        y = top + i * size
        parts.append(f'<text x="{left - 8}" y="{y + 27}" text-anchor="end">{for_html(row)}</text>')
        for j, name in enumerate(columns):
            count = who.confusion[row].get(name, 0)
            share = count / total if total else 0.0
            frame = ' class="same"' if row == name else ""
            x = left + j * size
            parts.append(
                f'<rect{frame} x="{x + 1}" y="{y + 1}" width="{size - 2}" height="{size - 2}" fill="{_shade(share)}">'
                f"<title>{for_html(f'{row} answered as {name}: {count} of {total}')}</title></rect>"
            )
            if count:
                ink = "#fff" if share > 0.55 else "#1a202c"
                parts.append(
                    f'<text x="{x + size / 2}" y="{y + 27}" text-anchor="middle" style="fill:{ink}">{_percent(share)}</text>'
                )
    width, height = left + len(columns) * size + 130, top + len(rows) * size + 10
    return f'<svg viewBox="0 0 {width} {height}" width="{width}">{"".join(parts)}</svg>'


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else "&lt;1%"


def _shade(share: float) -> str:
    red, green, blue = (round(white + (ink - white) * share) for white, ink in ((247, 43), (250, 108), (252, 176)))
    return f"#{red:02x}{green:02x}{blue:02x}"


def _example(example: Example) -> str:
    facts = [f"walk {example.walk}", f"geometric label: {example.label or 'none'}"]
    if example.f1 is not None:
        facts.append(f"BERTScore F1 {example.f1:.4f}")
    answer = _coc(example.answer) if example.answer else f"<pre>{for_html(example.raw) or '(no answer)'}</pre>"
    is_same = example.answer is not None and example.answer.flight_decision == example.reference.flight_decision
    return (
        f'<div class="pair {"right" if is_same else "wrong"}"><h3>{for_html(example.key)}</h3>'
        f'<p class="lead">{for_html("; ".join(facts))}</p>'
        f'<div class="sides"><div><h4>reference</h4>{_coc(example.reference)}</div><div><h4>answer</h4>{answer}</div></div></div>'
    )


def _coc(coc: Coc) -> str:
    return "".join(f"<p><b>{name.replace('_', ' ')}</b> {for_html(getattr(coc, name))}</p>" for name in FIELDS)
