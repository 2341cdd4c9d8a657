"""The review queue: `review.html` to look at and fill in, and what was decided put on record (`cosfly/products/review.py`)."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from cosfly.errors import InputError
from cosfly.escaping import for_html, html_page, json_block
from cosfly.inspection.flight import Inspected
from cosfly.inspection.report import HEAD, LEGEND, STYLE, cards
from cosfly.inspection.settings import InspectConfig
from cosfly.inspection.view import FlightView
from cosfly.products.inspection import FlightInspection, read_inspection
from cosfly.products.review import Choice, Decision, Verdict, add_decisions, read_decisions, undecided
from cosfly.reading.documents import read_model
from cosfly.reading.files import read_text, sha256_file
from cosfly.work.journal import Journal
from cosfly.work.stage_folder import Failed, read_item, result_of
from cosfly.work.store import dump_json, write_bytes

SCHEMA, VERSION = "cosfly.review", "1.0"
FILLED = "decisions.json"  # as the page saves it
SCRIPT = read_text(Path(__file__).with_name("review.js"))


class Filled(BaseModel):
    """What `review.html` saves: who decided what on which inspection (sha256 of `inspect.json`)."""

    model_config = ConfigDict(extra="forbid")

    inspection: str
    by: str = Field(min_length=1, max_length=200)
    choices: list[Choice]


def read_filled(path: Path) -> Filled:
    """Read what `review.html` saved.

    Raises:
        InputError: names the file and the field.
    """
    return read_model(path, Filled, schema=SCHEMA, version=VERSION, what="file of decisions")


def take(inspected: Path, filled: Path) -> list[Decision]:
    """Put on record what `review.html` saved.

    Raises:
        InputError: it was made of another inspection, or cannot be used.
    """
    found = read_filled(filled)
    if found.inspection != sha256_file(inspected):
        raise InputError(
            "decisions on another inspection", where=filled, got=found.inspection[:12], expected=f"{sha256_file(inspected)[:12]}, {inspected}",
            fix="make review.html again with cosfly inspect review, and decide again",
        )  # fmt: skip
    return add_decisions(inspected, found.choices, found.by)


def decide(inspected: Path, chosen: list[tuple[Verdict, str]], by: str, reason: str) -> None:
    """Put single decisions on record: verdict and folder of each flight."""
    add_decisions(inspected, [Choice(folder=folder, verdict=verdict, reason=reason) for verdict, folder in chosen], by)


def summary(inspected: Path) -> str:
    """Say in a line how far the review is, and name flights that are open."""
    queue = [flight.folder for flight in read_inspection(inspected).flights if flight.result == "review"]
    decisions = read_decisions(inspected)
    verdicts = [decisions[folder].verdict for folder in queue if folder in decisions]
    waiting = undecided(inspected)
    others = len(decisions.keys() - set(queue))
    text = f"{len(queue)} flights in review: {verdicts.count('accepted')} accepted, {verdicts.count('rejected')} rejected, {len(waiting)} open"
    text += f"; {others} others rejected" if others else ""
    return text + (f" ({', '.join(waiting[:3])}{', ...' if len(waiting) > 3 else ''})" if waiting else "")


def write_page(inspected: Path) -> Path:
    """Write `review.html` beside `inspect.json`: the flights in review, each to be accepted or rejected; give its path."""
    path = inspected.with_name("review.html")
    write_bytes(path, page_html(inspected).encode())
    return path


def page_html(inspected: Path) -> str:
    """Give the page's text. It works without a network, and saves a file that `cosfly inspect review --decisions` takes."""
    inspection, decisions = read_inspection(inspected), read_decisions(inspected)
    queue = [flight for flight in inspection.flights if flight.result == "review"]
    page_mb = float(inspection.settings.get("page_mb", InspectConfig().page_mb))
    rows, left_out = cards(
        queue, _views(inspected), page_mb, lambda flight: _choice(flight, decisions.get(flight.folder))
    )
    about = f"{len(queue)} flights are in review." + (
        f" {left_out} of them without pictures: the page is held to {page_mb:g} MB." if left_out else ""
    )
    body = f"""<h1>Review</h1>
<p class="lead">{for_html(about)} Accept or reject each, say why, and save: the file goes to <code>cosfly inspect review --inspect ... --decisions FILE</code>.
Flights that are left open stay in review.</p>
<p><label>decided by <input id="by" maxlength="200" placeholder="your name"></label> <button id="save" type="button">save decisions</button> <span id="state"></span></p>
<p class="lead">{LEGEND}</p>
{HEAD}
{rows}
<p><textarea id="text" readonly hidden rows="8"></textarea></p>
{json_block("data", dump_json({"schema": SCHEMA, "schema_version": VERSION, "inspection": sha256_file(inspected), "file": FILLED}))}"""
    return html_page("cosfly: review", STYLE, body, SCRIPT)


def _choice(flight: FlightInspection, decision: Decision | None) -> str:
    """Give the fields of one flight; a decision that stands is told, and filled in."""
    verdict = decision.verdict if decision else None
    name = for_html(flight.folder)
    radios = "".join(
        f'<label><input type="radio" name="{name}" value="{value}"{" checked" if value == verdict else ""}> {word}</label> '
        for value, word in (("accepted", "accept"), ("rejected", "reject"))
    )
    told = f"<small>{decision.verdict} by {for_html(decision.by)}, {for_html(decision.at)}</small>" if decision else ""
    reason = for_html(decision.reason) if decision else ""
    return f'<p class="choice" data-folder="{name}">{radios}<input class="reason" maxlength="2000" placeholder="why" value="{reason}"> {told}</p>'


def _views(inspected: Path) -> dict[str, FlightView]:
    """Give pictures and curves of flights, which the stage keeps beside its product; empty where that was copied without."""
    journal = Journal(inspected.with_name("items.jsonl"))
    records = (record for record in journal.read_as(read_item) if not isinstance(record, Failed))
    return {record.id: result_of(record, Inspected).view for record in records}
