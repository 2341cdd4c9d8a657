"""The page of a captioning run: complete, self-contained, small, and true to the counts."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest

from caption.run.ledger import NUM_CARDS, CaptionReport
from caption.run.report import page_html
from caption.run.stage import run
from caption.schema import CaptionConfig
from cosfly.chat.budget import BudgetConfig
from cosfly.products.captions import read_captions
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    tree = make_playback_tree(tmp_path_factory.mktemp("tree"), 3, 18)
    return run(CaptionConfig(), tree, tmp_path_factory.mktemp("done") / "caption").parent


class Tags(HTMLParser):
    """Collects tags and checks that they nest."""

    VOID = ("meta", "img", "br", "line", "rect", "hr")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict]] = []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_the_page_is_whole_self_contained_and_small(done):
    text = (done / "report.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    assert len(text.encode()) < 6e6
    sources = [attrs["src"] for tag, attrs in tags.seen if tag == "img"]
    assert len(sources) == NUM_CARDS * 5
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert not [tag for tag, attrs in tags.seen if tag in ("script", "link", "iframe")]
    assert not re.search(r"https?://", text)
    assert sum(tag == "article" for tag, _ in tags.seen) == NUM_CARDS
    for words in ("21.5 / 57.5 / 21.0 %", "different teacher", "Tokens and cost", "anchored: anchored"):
        assert words in text


def report_of(done):
    return CaptionReport.model_validate_json((done / "caption_report.json").read_text())


def test_its_numbers_are_the_reports(done):
    report = json.loads((done / "caption_report.json").read_text())
    text = (done / "report.html").read_text(encoding="utf-8")
    assert f"<b>{report['windows']['input']}</b>windows" in text
    first = report["verdicts_of_first_answers"]
    share = f"{first['HARD_CONFLICT']} ({100 * first['HARD_CONFLICT'] / sum(first.values()):.1f} %)"
    assert share in text
    captions = list(read_captions(done / "captions.jsonl"))
    lengths = report["lengths"]["en"]["reasoning_trace"]
    assert sum(lengths["counts"]) == len(captions)
    longest = max(len(caption.en.reasoning_trace) for caption in captions)
    assert len(lengths["counts"]) == longest // lengths["bin_characters"] + 1
    assert sum(report["repair"]["outcomes_by_strategy"]["anchored"].values()) == report["repair"]["rejected"]


def test_text_of_a_teacher_cannot_become_markup(done):
    report = report_of(done)
    caption = next(read_captions(done / "captions.jsonl"))
    evil = caption.en.model_copy(update={"reasoning_trace": "<script>alert(1)</script> & so on"})
    page = page_html(report, [caption.model_copy(update={"en": evil})], {}, BudgetConfig(), "x")
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert page.count(">no picture<") == 5


def test_cost_is_told_when_there_are_prices(done):
    used = {"prompt_tokens": 2_000_000, "completion_tokens": 100_000}
    report = report_of(done).model_copy(update={"tokens": used})
    page = page_html(report, [], {}, BudgetConfig(price_prompt=0.5, price_completion=3.0), "x")
    assert ">1.30<" in page
    assert "no prices set" in page_html(report, [], {}, BudgetConfig(), "x")


def test_sentences_are_marked_by_what_was_read_of_them(done):
    caption = next(caption for caption in read_captions(done / "captions.jsonl") if caption.status == "accepted")
    answer = caption.en.model_copy(
        update={"critical_components": "It is near. It is <red>!", "reasoning_trace": "So be it."}
    )
    checks = caption.checks.model_copy(update={"sentences": {"en": ["proved", "unread", "contradicted"]}})
    page = page_html(
        report_of(done), [caption.model_copy(update={"en": answer, "checks": checks})], {}, BudgetConfig(), "x"
    )
    for text, state in (("It is near.", "proved"), ("It is &lt;red&gt;!", "unread"), ("So be it.", "contradicted")):
        assert f'class="sentence {state}">{text}</span>' in page
