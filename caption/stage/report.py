"""`report.html`: one self-contained page about a captioning run, made from its report and some samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from caption.stage.ledger import CaptionReport, most_common
from cosfly.formats.captions import TOKENS, Caption, ValueCounts
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


def page_html(
    report: CaptionReport, cards: Sequence[Caption], folders: Mapping[str, Path], budget: BudgetConfig, name: str
) -> str:
    """Return the text of the page of a run with this name.

    Args:
        cards: Captions to show. folders: Track id -> its folder, for the pictures.
    """
    return page(
        "caption/stage/report.html", title=name, style=STYLE, report=report, meanings=VERDICTS,
        values=tuple(ValueCounts.model_fields), language_names=LANGUAGE_NAMES, share=_share, most_common=most_common,
        tokens=TOKENS, cost=_cost(report, budget), cards=[_card(caption, folders) for caption in cards],
    )  # fmt: skip


def _share(counts: Mapping[str, int], name: str) -> str:
    total, count = sum(counts.values()), counts.get(name, 0)
    return f"{count:,} ({100 * count / total:.1f} %)" if total else "-"


def _cost(report: CaptionReport, budget: BudgetConfig) -> list[tuple[str, str]]:
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
    return {"caption": caption, "pictures": pictures}
