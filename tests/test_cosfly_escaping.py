"""Foreign text: the terminal obeys none of it, pages and cards show it as it is, and no length of it is too long."""

import copy
import io
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from pydantic import BaseModel, ValidationError
from rich.table import Table

from caption.schema import CaptionConfig
from caption.stage.report import page_html
from caption.stage.stage import run as caption
from cosfly.formats.captions import Caption, read_captions
from cosfly.formats.inspection import Inspection, read_inspection
from cosfly.inspection.report import report_html
from cosfly.inspection.stage import run as inspect
from cosfly.llm.answers import BudgetConfig
from cosfly.runtime import console as shared
from cosfly.runtime.errors import InputError
from cosfly.runtime.escaping import LONGEST, for_terminal
from cosfly.runtime.json_io import read_json
from release.card.render import render_card
from release.record import ReleaseRecord
from specimens import make_playback_tree

OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")  # by a terminal
HOSTILE = (
    "\x1b]0;owned\x07\x1b[31m\u202e</p><script>alert(1)</script><img src=x onerror='alert(2)'>`|[a](javascript:b)[/]"
)


@given(st.text(alphabet=st.characters(codec=None), max_size=200))
def test_a_terminal_is_given_nothing_that_it_obeys(text):
    assert not OBEYED.search(for_terminal(text))
    for_terminal(text).encode("utf-8")  # half of a surrogate pair would stop the stream


def printed(monkeypatch, *, is_terminal: bool = True, width: int = 400) -> io.StringIO:
    stream = io.StringIO()
    terminal = type(shared.console)(stderr=True)
    terminal.file, terminal._force_terminal, terminal.width, terminal.no_color = stream, is_terminal, width, True
    monkeypatch.setattr(shared, "console", terminal)
    return stream


def test_lines_and_cells_are_printed_and_not_obeyed(monkeypatch):
    stream = printed(monkeypatch)
    table = Table(title=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    shared.console.print(HOSTILE)
    shared.console.print(table)
    lines = stream.getvalue()
    assert "\x1b]0" not in lines
    assert "\x07" not in lines
    assert "\u202e" not in lines
    assert lines.count("\\x1b]0;owned\\x07") == 4
    assert lines.count("[/]") == 4  # and no MarkupError


def test_an_error_is_one_short_line_whatever_it_names():
    error = InputError("not a number", where=Path(HOSTILE), got=HOSTILE + "9" * 5_000_000, expected="one\nline")
    assert len(str(error)) < 5 * LONGEST
    assert not OBEYED.search(str(error))
    assert "\n" not in str(error)


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.seen: set[tuple[str, ...]] = set()
        self.links: list[str] = []
        self.policy = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.seen.add((tag, *sorted(name for name, _ in attrs)))
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if ("http-equiv", "Content-Security-Policy") in attrs:
            self.policy = dict(attrs)["content"] or ""

    handle_startendtag = handle_starttag


def texts_in(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Yield where texts stand in JSON."""
    if isinstance(value, str):
        yield path
    elif isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from texts_in(value[key], (*path, key))


def forged(model: type[BaseModel], honest: BaseModel, least: int) -> BaseModel:
    value = honest.model_dump(mode="json")
    count = 0
    for path in list(texts_in(value)):
        other = copy.deepcopy(value)
        place = other
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = HOSTILE
        try:
            model.model_validate(other)
        except ValidationError:
            continue  # one of a closed set
        value, count = other, count + 1
    assert count >= least
    return model.model_validate(value)


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 1, 12, width_px=64, height_px=36)


@pytest.fixture(scope="module")
def inspection(tree, tmp_path_factory) -> Path:
    from cosfly.inspection.settings import InspectConfig

    return inspect(InspectConfig(jerk_rms_max_mps3=1e6), None, None, tree, tmp_path_factory.mktemp("inspected"))


def check_page(page: str, honest: str) -> None:
    """Same tags as in the honest page, none of them the forger's; and a policy that would stop them."""
    found = Tags(page)
    assert found.seen <= Tags(honest).seen | {("ul", "class"), ("li", "class"), ("td", "colspan"), ("tr", "class")}
    assert "script" not in {tag for tag, *_ in found.seen}
    assert all(link.startswith("data:image/jpeg;base64,") for link in found.links)
    assert "default-src 'none'" in found.policy
    assert "script-src" not in found.policy
    assert HOSTILE[:8] not in page
    assert "&lt;script&gt;" in page  # shown, not left out


def test_the_page_of_an_inspection_shows_forged_records(inspection):
    honest = read_inspection(inspection)
    false = forged(Inspection, honest, 8)
    check_page(
        report_html(HOSTILE, false, {}, page_mb=25.0), (inspection.parent / "report.html").read_text(encoding="utf-8")
    )


def test_the_page_of_a_captioning_run_shows_forged_captions(tree, tmp_path):
    done = caption(CaptionConfig(), tree, tmp_path / "caption").parent
    from caption.stage.ledger import CaptionReport

    value = read_json(done / "caption_report.json")
    report = CaptionReport.model_validate({k: v for k, v in value.items() if k not in ("schema", "schema_version")})
    cards = [forged(Caption, card, 8) for card in list(read_captions(done / "captions.jsonl"))[:3]]
    page = page_html(forged(CaptionReport, report, 1), cards, {}, BudgetConfig(), HOSTILE)
    check_page(page, (done / "report.html").read_text(encoding="utf-8") + '<div class="gone"></div>')


markdown = MarkdownIt("commonmark", {"html": True}).enable("table")


def test_a_card_shows_forged_texts(tree, inspection, tmp_path):
    from release.package.config import ReleaseConfig
    from release.package.sources import Source
    from release.package.stage import run

    captions = caption(CaptionConfig(), tree, tmp_path / "caption")
    folder = run(ReleaseConfig(licence="mit"), [Source.of_files(tree, captions, inspection)], tmp_path / "release")
    folder = folder if folder.is_dir() else folder.parent
    value = read_json(folder / "release.json")
    record = ReleaseRecord.model_validate({k: v for k, v in value.items() if k not in ("schema", "schema_version")})
    card = render_card(forged(ReleaseRecord, record, 8))
    page = markdown.render(card.split("\n---\n", 1)[1])
    assert "alert(1)" in page
    assert not {"script", "img", "a"} & {tag for tag, *_ in Tags(page).seen}
    assert not OBEYED.search(card.replace("\n", ""))
