"""The review queue: `review.html` to fill in, and decisions put on record (`cosfly/products/review.py`)."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from cosfly.errors import InputError
from cosfly.inspection.flight import InspectedFlight
from cosfly.inspection.report import cards
from cosfly.inspection.settings import PAGE_MB
from cosfly.inspection.view import FlightView
from cosfly.look.page import page, run_name, scripts
from cosfly.products.inspection import read_inspection
from cosfly.products.review import Choice, Decision, Verdict, add_decisions, read_decisions, undecided
from cosfly.reading.documents import FileFormat, read_model
from cosfly.reading.files import read_text, sha256_file
from cosfly.work.journal import Journal
from cosfly.work.stage_folder import Failed, read_item, result_of
from cosfly.work.store import write_bytes

FORMAT = FileFormat("cosfly.review", "1.0", "file of decisions")
FILLED = "decisions.json"  # as the page saves it
SCRIPT = scripts("tools.js") + read_text(Path(__file__).with_name("review.js"))


class ReviewForm(BaseModel):
    """What `review.html` saves: who decided what on which inspection (sha256 of `inspect.json`)."""

    model_config = ConfigDict(extra="forbid")

    inspection: str
    by: str = Field(min_length=1, max_length=200)
    choices: list[Choice]


def read_filled(path: Path) -> ReviewForm:
    """Read what `review.html` saved."""
    return read_model(path, ReviewForm, FORMAT)


def take(inspected: Path, filled: Path) -> list[Decision]:
    """Put on record what `review.html` saved."""
    found = read_filled(filled)
    if found.inspection != sha256_file(inspected):
        raise InputError(
            "decisions on another inspection",
            where=filled,
            got=found.inspection[:12],
            expected=f"{sha256_file(inspected)[:12]}, {inspected}",
            fix="make review.html again with cosfly inspect review, and decide again",
        )
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
    text = (
        f"{len(queue)} flights in review: {verdicts.count('accepted')} accepted, {verdicts.count('rejected')} "
        f"rejected, {len(waiting)} open"
    )
    text += f"; {others} others rejected" if others else ""
    return text + (f" ({', '.join(waiting[:3])}{', ...' if len(waiting) > 3 else ''})" if waiting else "")


def write_page(inspected: Path) -> Path:
    """Write `review.html` beside `inspect.json`: each flight in review is to be accepted or rejected; give its path."""
    path = inspected.with_name("review.html")
    write_bytes(path, page_html(inspected).encode())
    return path


def page_html(inspected: Path) -> str:
    """Give the page. It works without a network, and saves a file that `cosfly inspect review --decisions` takes."""
    inspection = read_inspection(inspected)
    queue = [flight for flight in inspection.flights if flight.result == "review"]
    rows = cards(queue, _views(inspected), PAGE_MB, read_decisions(inspected))
    data = {**FORMAT.header, "inspection": sha256_file(inspected), "file": FILLED}
    return page("cosfly/inspection/review.html", title=run_name(inspected.parent), script=SCRIPT, data=data, **rows)


def _views(inspected: Path) -> dict[str, FlightView]:
    """Give pictures and curves of flights, which the stage keeps beside its product; empty where they are not there."""
    journal = Journal(inspected.with_name("items.jsonl"))
    records = (record for record in journal.read_as(read_item) if not isinstance(record, Failed))
    return {record.id: result_of(record, InspectedFlight).view for record in records}
