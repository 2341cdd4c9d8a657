"""`report.html`: one self-contained page of a captioning run that a person can read. Made from the report's counts and
some samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from caption.stage.ledger import CaptionReport
from cosfly.formats.captions import TOKENS, Caption, Language, ValueCounts
from cosfly.formats.frames import frame_name
from cosfly.formats.places import flight_of
from cosfly.llm.answers import BudgetConfig
from cosfly.runtime.io import read_text, write_bytes
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page, run_name

PICTURE_WIDTH_PX = 240
VERDICTS = {  # what it means
    "CONSISTENT": "the decision is the label",
    "SOFT_CONFLICT": "another decision, which the flight does not contradict",
    "HARD_CONFLICT": "the flight contradicts the decision",
    "ABSTAIN": "geometry cannot tell",
}
VALUES = tuple(ValueCounts.model_fields)
LANGUAGE_NAMES = {"en": "English", "zh": "Chinese"}
STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))


def write_page(
    path: Path,
    report: CaptionReport,
    cards: Sequence[Caption],
    folders: Mapping[str, Path],
    budget: BudgetConfig,
) -> None:
    """Write the page.

    Args:
        report: `caption_report.json`. cards: captions to show. folders:
            flight id -> its folder, for the pictures.
    """
    write_bytes(path, page_html(report, cards, folders, budget, run_name(path.parent)).encode())


def page_html(
    report: CaptionReport,
    cards: Sequence[Caption],
    folders: Mapping[str, Path],
    budget: BudgetConfig,
    name: str,
) -> str:
    """Return the page's text; name: of the run."""
    teacher = report.teacher
    verdicts = [("First answers", report.verdicts_of_first_answers), ("Accepted captions", report.verdicts_of_accepted)]
    return page(
        "caption/stage/report.html", title=name, style=STYLE, report=report, meanings=VERDICTS, values=VALUES,
        who=f"teacher: {teacher.kind}, model {teacher.model}" if teacher else "teacher: none, model unknown",
        is_rules=teacher is not None and teacher.kind == "rules", tiles=_tiles(report), verdicts=verdicts, share=_share,
        language_names=LANGUAGE_NAMES,
        confusion=_confusion(report.confusion, TOKENS), warnings=report.warnings(),
        repairs=_repairs(report), checks=_checks(report),
        cost=_cost(report, budget),
        cards=[_card(caption, folders) for caption in cards],
    )  # fmt: skip


def _tiles(report: CaptionReport) -> list[tuple[str, int]]:
    windows, keyframes = report.windows, report.keyframes
    values = [
        ("windows", windows.input),
        ("accepted", windows.kept),
        ("dropped", sum(windows.dropped.values())),
        ("unanswered", sum(windows.failed.values())),
        ("asked for again", report.repair.rejected),
        ("asks in all", report.asks),
    ]
    if keyframes:
        values += [("calls saved by keyframes", keyframes.calls_saved), ("changes missed", keyframes.changes_missed)]
    return values


def _share(counts: Mapping[str, int], name: str) -> str:
    total = sum(counts.values())
    return f"{counts.get(name, 0):,} ({100 * counts.get(name, 0) / total:.1f} %)" if total else "-"


def _confusion(confusion: Mapping[str, Mapping[str, int]], tokens: Sequence[str]) -> dict[str, list[str]]:
    return {
        "labels": [name for name in (*tokens, "none") if name in confusion],
        "decisions": [name for name in tokens if any(name in row for row in confusion.values())],
    }


Rows = list[tuple[str, str]]


def _repairs(report: CaptionReport) -> Rows:
    rows = [
        (f"{strategy}: {outcome.replace('_', ' ')}", f"{count:,}")
        for strategy, outcomes in report.repair.outcomes_by_strategy.items()
        for outcome, count in outcomes.items()
    ]
    rows += [(f"after {asks} more ask{'s' if asks != '1' else ''}", f"{n:,}") for asks, n in report.repair.asks.items()]
    judged = [(f"judge: {name.replace('_', ' ')}", f"{n:,}") for name, n in report.judgements.items()]
    return rows + judged


def _checks(report: CaptionReport) -> Rows:
    rows = [(f"label from: {source}", f"{count:,}") for source, count in report.label_from.items()]
    rows += [(f"dropped: {reason}", f"{count:,}") for reason, count in report.windows.dropped.items()]
    rows += [(f"the server, {reason}", words) for reason, words in report.refusals.items()]
    rows += [(f"structure: {name}", f"{count:,}") for name, count in report.structure.items()]
    rows += [(f"languages: {name}", f"{count:,}") for name, count in report.bilingual.items()]
    rows += [("captions with a contradicted value", f"{report.contradicted_captions:,}")]
    rows += [(f"recovered: {name.replace('_', ' ')}", f"{count:,}") for name, count in report.recovered.items()]
    return rows


def _cost(report: CaptionReport, budget: BudgetConfig) -> Rows:
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
    return rows


def _card(caption: Caption, folders: Mapping[str, Path]) -> dict[str, Any]:
    folder = folders.get(flight_of(caption.sample_id))
    pictures = [
        (index, None if folder is None else thumbnail(folder / frame_name(index), PICTURE_WIDTH_PX, jpeg_quality=75))
        for index in caption.window[-5:]
    ]
    return {
        "caption": caption,
        "pictures": pictures,
        "problems": caption.checks.contradictions or [],
        "texts": {"en": _texts(caption, "en"), "zh": _texts(caption, "zh")},
    }


def _texts(caption: Caption, language: Language) -> dict[str, Any] | None:
    """Return the texts and the decision; None where there is no text."""
    coc = caption.en if language == "en" else caption.zh
    if coc is None:
        return None
    return {"critical": coc.critical_components, "reasoning": coc.reasoning_trace, "decision": coc.flight_decision}
