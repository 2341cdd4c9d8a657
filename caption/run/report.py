"""`report.html`: one self-contained page of a captioning run that a person can read. Made from the report's counts and some samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from caption.run.ledger import CaptionReport, Histogram
from cosfly.chat.budget import BudgetConfig
from cosfly.escaping import for_html, html_page
from cosfly.look.frame_views import thumbnail
from cosfly.products.actions import action_tokens
from cosfly.products.captions import Caption, Language
from cosfly.products.frames import frame_name
from cosfly.products.places import flight_of
from cosfly.products.sentences import sentences_of
from cosfly.reading.files import read_text
from cosfly.work.store import write_bytes

PICTURE_WIDTH_PX = 240
VERDICTS = {  # color, what it means
    "CONSISTENT": ("#2f855a", "the decision is the label"),
    "SOFT_CONFLICT": ("#d69e2e", "another decision, which the flight does not contradict"),
    "HARD_CONFLICT": ("#c53030", "the flight contradicts the decision"),
    "ABSTAIN": ("#718096", "geometry cannot tell"),
}
STATES = {"proved": "#2f855a", "contradicted": "#c53030", "unread": "#cbd5e0"}
LANGUAGE_NAMES = {"en": "English", "zh": "Chinese"}
STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))
DIFFERENT_TEACHER = (
    "The rule teacher is a deterministic baseline: it looks at the flight data of five frames and at no picture. It is a "
    "different teacher than the paper's, so these shares say nothing about the paper's 21.5 / 57.5 / 21.0 %."
)


def write_page(
    path: Path, report: CaptionReport, cards: Sequence[Caption], folders: Mapping[str, Path], budget: BudgetConfig
) -> None:
    """Write the page.

    Args:
        report: `caption_report.json`. cards: captions to show. folders: flight id -> its folder, for the pictures.
    """
    write_bytes(path, page_html(report, cards, folders, budget).encode())


def page_html(
    report: CaptionReport, cards: Sequence[Caption], folders: Mapping[str, Path], budget: BudgetConfig
) -> str:
    """Give the page's text."""
    teacher = report.teacher
    who = f"teacher: {teacher.kind}, model {teacher.model}" if teacher else "teacher: none, model unknown"
    note = f'<p class="note">{for_html(DIFFERENT_TEACHER)}</p>' if teacher and teacher.kind == "rules" else ""
    note = "".join(f'<p class="note bad">{for_html(warning)}</p>' for warning in report.warnings) + note
    shown = "".join(_card(caption, folders) for caption in cards)
    body = f"""<h1>Captions</h1>
<p class="lead">{for_html(who)}</p>
{_tiles(report)}
{note}
<h2>Verdicts</h2>
<div class="panel">{_verdicts(report)}</div>
<h2>Beside chance</h2>
<p class="lead">First answers, and what would come of decisions that were made without a look at the windows. What the share of the run
has above chance is what the teacher saw.</p>
<div class="panel">{_chance(report)}</div>
<h2>Label against the teacher's first decision</h2>
<p class="lead">Rows: the decision that the real flight implies. Columns: what the teacher decided before any repair. Framed: agreement.</p>
<div class="panel">{_confusion(report.confusion)}</div>
<h2>What was read of the texts</h2>
<p class="lead">Sentences of accepted captions. Proved: compared with the measurements of the flight, and all of it holds. Unread: nothing in it
that can be measured, or not sure enough to say; it is not verified.</p>
<div class="panel">{_sentences(report)}</div>
<h2>Length of the texts</h2>
<p class="lead">Accepted captions, characters.</p>
<div class="grid">{_histograms(report.lengths)}</div>
<h2>Re-generation, checks and cost</h2>
<div class="grid">{_repairs(report)}{_checks(report)}{_cost(report, budget)}</div>
<h2>{len(cards)} samples</h2>
<p class="lead">Chosen by the hash of their ids, the kinds of outcome taking turns. The last frame is the current one, the others are one time step apart.</p>
{shown}"""
    return html_page("cosfly: captions", STYLE, body)


def _tiles(report: CaptionReport) -> str:
    windows = report.windows
    dropped, repaired = sum(windows.dropped.values()), report.repair.rejected
    values = [
        ("windows", windows.input),
        ("accepted", windows.kept),
        ("dropped", dropped),
        ("unanswered", sum(windows.failed.values())),
        ("asked for again", repaired),
        ("asks in all", report.asks),
    ]
    keyframes = report.keyframes
    if keyframes:
        values += [("calls saved by keyframes", keyframes.calls_saved), ("changes missed", keyframes.changes_missed)]
    return (
        '<div class="tiles">' + "".join(f'<div class="tile"><b>{n:,}</b>{name}</div>' for name, n in values) + "</div>"
    )


def _verdicts(report: CaptionReport) -> str:
    first, last = report.verdicts_of_first_answers, report.verdicts_of_accepted
    rows = []
    for title, counts in (("First answers", first), ("Accepted captions", last)):
        total = sum(counts.values()) or 1
        bars = "".join(
            f'<i style="width:{100 * counts.get(name, 0) / total:.2f}%;background:{color}" title="{name}"></i>'
            for name, (color, _) in VERDICTS.items()
        )
        rows.append(f'<h3>{title} ({sum(counts.values()):,})</h3><div class="stack">{bars}</div>')
    lines = "".join(
        f'<tr><td><span class="key" style="background:{color}"></span>{name}</td><td>{meaning}</td>'
        f'<td class="n">{_share(first, name)}</td><td class="n">{_share(last, name)}</td></tr>'
        for name, (color, meaning) in VERDICTS.items()
    )
    head = '<tr><th>verdict</th><th></th><th class="n">first answers</th><th class="n">accepted</th></tr>'
    return f"{''.join(rows)}<table>{head}{lines}</table>"


def _share(counts: Mapping[str, int], name: str) -> str:
    total = sum(counts.values())
    return f"{counts.get(name, 0):,} ({100 * counts.get(name, 0) / total:.1f} %)" if total else "&ndash;"


def _chance(report: CaptionReport) -> str:
    chance = report.chance
    if chance is None:
        return "No answer."
    rows = {
        "this run": chance.first_answers,
        "every action equally often": chance.random_decisions,
        "the same decisions, dealt at random": chance.shuffled_decisions,
        f"always {_words(chance.decision)}": chance.one_decision,
    }
    head = "".join(f'<th class="n">{name}</th>' for name in VERDICTS)
    lines = "".join(
        f"<tr><td>{name}</td>"
        + "".join(f'<td class="n">{100 * getattr(shares, verdict.lower()):.1f} %</td>' for verdict in VERDICTS)
        + "</tr>"
        for name, shares in rows.items()
    )
    texts = ", ".join(f"{count:,} ({language})" for language, count in chance.distinct_texts.items())
    note = f"Texts that differ in more than their numbers: {texts}, of {chance.windows:,} windows; a constant text gives 1."
    return f'<table><tr><th></th>{head}</tr>{lines}</table><p class="small">{note}</p>'


def _sentences(report: CaptionReport) -> str:
    rows = ""
    for language, counts in report.sentences.items():
        total = sum(counts.values())
        bars = "".join(
            f'<i style="width:{100 * counts.get(state, 0) / total:.2f}%;background:{color}" title="{state}"></i>'
            for state, color in STATES.items()
        )
        shares = ", ".join(f"{state} {_share(counts, state)}" for state in STATES)
        rows += f'<h3>{LANGUAGE_NAMES[language]} ({total:,})</h3><div class="stack">{bars}</div><p class="small">{shares}</p>'
    written = ", ".join(f"{name} {count:,}" for name, count in report.writing.items())
    return f'{rows}<p class="small">written as: {written}</p>' if rows else "No sentence was judged."


def _confusion(confusion: Mapping[str, Mapping[str, int]]) -> str:
    labels = [name for name in (*action_tokens(), "none") if name in confusion]
    decisions = [name for name in action_tokens() if any(name in row for row in confusion.values())]
    if not labels:
        return "No answer."
    head = "".join(f'<th class="column"><span>{_words(name)}</span></th>' for name in decisions)
    rows = ""
    for label in labels:
        row, total = confusion[label], sum(confusion[label].values())
        cells = ""
        for decision in decisions:
            count = row.get(decision, 0)
            share = count / total
            ink = "#fff" if share > 0.55 else "#1a202c"
            mark = ' class="right"' if decision == label else ""
            cells += f'<td{mark} style="background:rgba(43,108,176,{share:.2f});color:{ink}">{count or ""}</td>'
        rows += f'<tr><th class="row">{_words(label)}</th>{cells}<td class="total">{total:,}</td></tr>'
    return f'<table class="confusion"><tr><th></th>{head}<th></th></tr>{rows}</table>'


def _words(token: str) -> str:
    return for_html(token.replace("_", " "))


def _histograms(lengths: Mapping[str, Mapping[str, Histogram]]) -> str:
    return "".join(
        f'<div class="panel"><h3>{LANGUAGE_NAMES[language]}, {_words(field)}</h3>{_histogram(histogram)}</div>'
        for language, fields in lengths.items()
        for field, histogram in fields.items()
    )


def _histogram(histogram: Histogram) -> str:
    counts, width = histogram.counts, histogram.bin_characters
    total = sum(counts)
    if not total:
        return "No text."
    first = next(i for i, count in enumerate(counts) if count)
    shown = counts[first:]
    # Never fewer than eight bins, else a single one fills the picture.
    step = 280.0 / max(8, len(shown))
    bars = "".join(
        f'<rect x="{i * step:.1f}" y="{100 - 92 * count / max(shown):.1f}" width="{max(1.0, step - 1.5):.1f}" '
        f'height="{92 * count / max(shown):.1f}" fill="#2b6cb0"><title>{(first + i) * width}&ndash;{(first + i + 1) * width - 1} '
        f"characters: {count}</title></rect>"
        for i, count in enumerate(shown)
    )
    end_x = len(shown) * step
    labels = f'<text x="0" y="115">{first * width}</text><text x="{end_x:.0f}" y="115" text-anchor="end">{len(counts) * width}</text>'
    middle = next(i for i in range(len(counts)) if 2 * sum(counts[: i + 1]) >= total)
    return (
        f'<svg viewBox="0 0 280 120" width="100%" font-size="11" fill="#4a5568"><line x1="0" y1="100" x2="280" y2="100" '
        f'stroke="#cbd5e0"/>{bars}{labels}</svg><div class="small">{total:,} texts, median {middle * width} to '
        f"{(middle + 1) * width - 1}</div>"
    )


def _table(title: str, rows: Sequence[tuple[str, str]], nothing: str) -> str:
    lines = "".join(f'<tr><td>{for_html(name)}</td><td class="n">{for_html(value)}</td></tr>' for name, value in rows)
    return f'<div class="panel"><h3>{title}</h3>{f"<table>{lines}</table>" if rows else for_html(nothing)}</div>'


def _repairs(report: CaptionReport) -> str:
    rows = [
        (f"{strategy}: {outcome.replace('_', ' ')}", f"{count:,}")
        for strategy, outcomes in report.repair.outcomes_by_strategy.items()
        for outcome, count in outcomes.items()
    ]
    rows += [(f"after {asks} more ask{'s' if asks != '1' else ''}", f"{n:,}") for asks, n in report.repair.asks.items()]
    judged = [(f"judge: {name.replace('_', ' ')}", f"{n:,}") for name, n in report.judgements.items()]
    return _table("Re-generation, by strategy and outcome", rows + judged, "No answer was rejected.")


def _checks(report: CaptionReport) -> str:
    rows = [(f"label from: {source}", f"{count:,}") for source, count in report.label_from.items()]
    rows += [(f"dropped: {reason}", f"{count:,}") for reason, count in report.windows.dropped.items()]
    rows += [(f"the server, {reason}", words) for reason, words in report.refusals.items()]
    rows += [(f"languages: {name}", f"{count:,}") for name, count in report.bilingual.items()]
    rows += [(f"evidence: {name}", f"{count:,}") for name, count in report.evidence_contradictions.items()]
    rows += [(f"mended: {name.replace('_', ' ')}", f"{count:,}") for name, count in report.recovered.items()]
    return _table("Checks", rows, "Nothing was checked.")


def _cost(report: CaptionReport, budget: BudgetConfig) -> str:
    prompt, answer = (report.tokens.get(name, 0) for name in ("prompt_tokens", "completion_tokens"))
    accepted, judge = report.windows.kept, report.judge_tokens
    rows = [("prompt tokens", f"{prompt:,}"), ("answer tokens", f"{answer:,}")]
    if judge is not None:
        rows.append(("the judge's tokens", f"{judge.prompt_tokens:,} in, {judge.completion_tokens:,} out"))
        prompt, answer = prompt + judge.prompt_tokens, answer + judge.completion_tokens
    if accepted:
        rows.append(("tokens per accepted caption", f"{(prompt + answer) / accepted:,.0f}"))
    cost = budget.cost(prompt, answer)
    priced = bool(budget.price_prompt or budget.price_completion)
    rows.append(("cost", f"{cost:,.2f}" if priced else "no prices set"))
    if priced and accepted:
        rows.append(("cost per 1,000 accepted", f"{1000 * cost / accepted:,.2f}"))
    return _table("Tokens and cost", rows, "")


# --- cards ------------------------------------------------------------------------------------------------------------


def _card(caption: Caption, folders: Mapping[str, Path]) -> str:
    tags = []
    if caption.verdict:
        tags.append(f'<span class="tag" style="background:{VERDICTS[caption.verdict][0]}">{caption.verdict}</span>')
    tags.append(f'<span class="tag plain">label: {_words(caption.label or "none")}</span>')
    if caption.repair:
        rung = caption.repair.rung or caption.repair.outcome
        first = f"{caption.repair.first_decision} ({caption.repair.first_verdict})"
        tags.append(f'<span class="tag plain">re-generated ({_words(rung)}); first: {_words(first)}</span>')
    if caption.judge:
        tags.append(f'<span class="tag plain">judge: {_words(caption.judge.verdict)}</span>')
    if caption.status == "dropped":
        tags.append(f'<span class="tag" style="background:#c53030">dropped: {_words(str(caption.drop_reason))}</span>')
    folder = folders.get(flight_of(caption.sample_id))
    pictures = "".join(_picture(folder, index) for index in caption.window[-5:])
    problems = caption.checks.evidence
    found = "" if not isinstance(problems, list) else "".join(f'<p class="bad">{for_html(p)}</p>' for p in problems)
    return (
        f'<article class="card"><header><b>{for_html(caption.sample_id)}</b>{"".join(tags)}</header>'
        f'<div class="frames">{pictures}</div>'
        f'<div class="texts">{_text(caption, "en")}{_text(caption, "zh")}</div>{found}</article>'
    )


def _picture(folder: Path | None, index: int) -> str:
    shown = None if folder is None else thumbnail(folder / frame_name(index), PICTURE_WIDTH_PX, jpeg_quality=75)
    image = (
        f'<img alt="frame {index}" src="data:image/jpeg;base64,{shown}">'
        if shown
        else '<div class="gone">no picture</div>'
    )
    return f"<figure>{image}<figcaption>frame {index}</figcaption></figure>"


def _text(caption: Caption, language: Language) -> str:
    coc = caption.en if language == "en" else caption.zh
    if coc is None:
        return f'<div><span class="what">{LANGUAGE_NAMES[language]}</span><p>&ndash;</p></div>'
    states = (caption.checks.sentences or {}).get(language, [])
    marked = {"C": "", "R": ""}
    for i, (name, text) in enumerate(sentences_of(coc)):
        color = STATES[states[i]] if i < len(states) else "transparent"
        marked[name[0]] += f'<span style="border-bottom:2px solid {color}">{for_html(text)}</span> '
    what = f"{LANGUAGE_NAMES[language]}: critical components"
    return (
        f'<div lang="{"en" if language == "en" else "zh-CN"}"><span class="what">{what}</span><p>{marked["C"]}</p>'
        f'<span class="what">reasoning</span><p>{marked["R"]}</p>'
        f'<span class="what">decision</span><p><code>{for_html(coc.flight_decision)}</code></p></div>'
    )
