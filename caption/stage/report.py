"""`report.html`: one self-contained page about a captioning run, made from its report and some samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from caption.stage.ledger import CaptionReport, most_common
from cosfly.formats.captions import TOKENS, Caption, Coc, ValueCounts
from cosfly.formats.frames import frame_name
from cosfly.formats.places import flight_of
from cosfly.llm.answers import BudgetConfig
from cosfly.runtime.io import read_text
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page

PICTURE_WIDTH_PX = 240
VERDICTS = {  # with their meanings
    "CONSISTENT": "the decision is the label",
    "SOFT_CONFLICT": "another decision, which the trajectory does not contradict",
    "HARD_CONFLICT": "the trajectory contradicts the decision",
    "ABSTAIN": "geometry cannot decide",
}
LANGUAGE_NAMES = {"en": "English", "zh": "Chinese"}
STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))

Rows = list[tuple[str, str]]


def page_html(
    report: CaptionReport, cards: Sequence[Caption], folders: Mapping[str, Path], budget: BudgetConfig, name: str
) -> str:
    """Return the text of the page of a run with this name.

    Args:
        cards: Captions to show. folders: Track id -> its folder, for the pictures.
    """
    teacher = report.teacher
    verdicts = [("First answers", report.verdicts_of_first_answers), ("Accepted captions", report.verdicts_of_accepted)]
    return page(
        "caption/stage/report.html", title=name, style=STYLE, report=report, meanings=VERDICTS,
        values=tuple(ValueCounts.model_fields), language_names=LANGUAGE_NAMES, share=_share,
        who=f"teacher: {teacher.kind}, model {teacher.model}" if teacher else "teacher: none, model unknown",
        is_rules=teacher is not None and teacher.kind == "rules", tiles=_tiles(report), verdicts=verdicts,
        confusion=_confusion(report.confusion), warnings=report.warnings(), repairs=_repairs(report),
        checks=_checks(report), cost=_cost(report, budget), cards=[_card(caption, folders) for caption in cards],
    )  # fmt: skip


def _tiles(report: CaptionReport) -> list[tuple[str, int]]:
    windows, keyframes = report.windows, report.keyframes
    tiles = [
        ("windows", windows.input),
        ("accepted", windows.kept),
        ("dropped", sum(windows.dropped.values())),
        ("unanswered", sum(windows.failed.values())),
        ("regenerated", report.repair.rejected),
        ("requests", report.asks),
    ]
    if keyframes:
        tiles += [("calls saved by keyframes", keyframes.calls_saved), ("changes missed", keyframes.changes_missed)]
    return tiles


def _share(counts: Mapping[str, int], name: str) -> str:
    total, count = sum(counts.values()), counts.get(name, 0)
    return f"{count:,} ({100 * count / total:.1f} %)" if total else "-"


def _confusion(confusion: Mapping[str, Mapping[str, int]]) -> dict[str, list[str]]:
    return {
        "labels": [name for name in (*TOKENS, "none") if name in confusion],
        "decisions": [name for name in TOKENS if any(name in row for row in confusion.values())],
    }


def _rows(kind: str, counts: Mapping[str, int]) -> Rows:
    return [(f"{kind}: {name.replace('_', ' ')}", f"{count:,}") for name, count in most_common(counts).items()]


def _repairs(report: CaptionReport) -> Rows:
    rows: Rows = []
    for strategy, outcomes in sorted(report.repair.outcomes_by_strategy.items()):
        rows += _rows(strategy, outcomes)
    for asks, count in sorted(report.repair.asks.items()):
        rows.append((f"after {asks} more ask{'s' if asks != '1' else ''}", f"{count:,}"))
    return rows + _rows("judge", report.judgements)


def _checks(report: CaptionReport) -> Rows:
    return [
        *_rows("label from", report.label_from),
        *_rows("dropped", report.windows.dropped),
        *((f"refused by the server, {reason}", message) for reason, message in report.refusals.items()),
        *_rows("structure", report.structure),
        *_rows("languages", report.bilingual),
        ("captions with a contradicted value", f"{report.contradicted_captions:,}"),
        *_rows("recovered", report.recovered),
    ]


def _cost(report: CaptionReport, budget: BudgetConfig) -> Rows:
    prompt, answer = (report.tokens.get(name, 0) for name in ("prompt_tokens", "completion_tokens"))
    accepted, judge = report.windows.kept, report.judge_tokens
    rows = [("prompt tokens", f"{prompt:,}"), ("answer tokens", f"{answer:,}")]
    if judge is not None:
        rows.append(("the judge's tokens", f"{judge.prompt_tokens:,} in, {judge.completion_tokens:,} out"))
        prompt += judge.prompt_tokens
        answer += judge.completion_tokens
    if accepted:
        rows.append(("tokens per accepted caption", f"{(prompt + answer) / accepted:,.0f}"))
    if not (budget.price_prompt or budget.price_completion):
        return [*rows, ("cost", "no prices set")]
    cost = budget.cost(prompt, answer)
    rows.append(("cost", f"{cost:,.2f}"))
    if accepted:
        rows.append(("cost per 1,000 accepted", f"{1000 * cost / accepted:,.2f}"))
    return rows


def _card(caption: Caption, folders: Mapping[str, Path]) -> dict[str, Any]:
    folder = folders.get(flight_of(caption.sample_id))
    pictures = [
        (index, None if folder is None else thumbnail(folder / frame_name(index), PICTURE_WIDTH_PX, jpeg_quality=75))
        for index in caption.window[-5:]
    ]
    texts: dict[str, Coc | None] = {"en": caption.en, "zh": caption.zh}
    return {"caption": caption, "pictures": pictures, "problems": caption.checks.contradictions or [], "texts": texts}
