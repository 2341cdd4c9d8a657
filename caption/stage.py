"""Stage `caption`: reads a playback tree, writes `captions.jsonl` and `caption_report.json`.

The rule teacher works on flights in processes. An endpoint is asked from one process: windows go out in order of flight and
time, a bounded number at once, across the borders of flights. Each finished flight is a part file; the parts are merged last,
so that memory stays flat.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from caption.answers import AnswerBook
from caption.ledger import Ledger
from caption.regenerate import caption_window
from caption.schema import CaptionConfig, Sample
from caption.teacher import EndpointTeacher, NoAnswer, RuleTeacher, Teacher, shown_url
from caption.windows import current_frames, iterate_samples
from cosfly.coc import Caption, read_captions, write_captions
from cosfly.console import progress_bar
from cosfly.errors import CosflyError, InputError, TeacherError
from cosfly.playback import find_flights, read_flight
from cosfly.runner import Item, Outcome, Work, run_items
from cosfly.store import Resume, StageFolder, Tally, dump_json, write_bytes, write_json

log = logging.getLogger(__name__)

PRODUCT, REPORT, ANSWERS = "captions.jsonl", "caption_report.json", "answers.jsonl"
PARTS = "parts"
Allotted = list[tuple[str, Path, int | None]]  # flight id, folder, most windows (None: all)
# Settings that change how an endpoint is asked, not what is asked: a run may be continued with others.
MANNERS = ("concurrency", "timeout_s", "max_tries", "backoff_s", "max_backoff_s", "stop_after_failures")


def run(
    cfg: CaptionConfig, data: Path, out: Path, *, seed: int = 0, workers: int = 1, resume: Resume = "if-same"
) -> Path:
    """Caption the flights of a playback tree.

    Args:
        data: playback tree, ours or of the public layout.
        workers: processes of the rule teacher; an endpoint's requests in flight are `endpoint.concurrency`.
    Returns:
        `captions.jsonl`.
    Raises:
        InputError: no flight, or no flight that is long enough.
        TeacherError: the endpoint cannot be used, or windows stayed without an answer; what was answered is kept.
    """
    stage = StageFolder.open(out, "caption", config=_recorded(cfg), inputs={"data": data}, seed=seed, resume=resume)
    if stage.is_complete:
        return out / PRODUCT
    flights = _named_flights(data)
    allotted = _allot(flights, cfg)
    unanswered: list[dict] = []
    if cfg.teacher == "rules":
        flight_tally = _run_rules(stage, allotted, cfg, seed, workers)
    else:
        flight_tally, unanswered = asyncio.run(_Endpoint(stage, cfg, seed).run(allotted))
    ledger = _merge(stage, unanswered)
    tally = ledger.tally(len(unanswered))
    if tally.num_input == 0:
        failures = (stage.path / "failures.jsonl").read_text(encoding="utf-8").splitlines()
        raise InputError(
            "no window to caption",
            where=data,
            got=f"flights: {flight_tally}" + (f", first failure {failures[0]}" if failures else ""),
            expected=f"a flight of at least {cfg.window.num_frames + cfg.window.future_frames} frames",
        )
    write_json(stage.path / REPORT, ledger.report(flight_tally, tally))
    if unanswered:
        causes = ", ".join(f"{cause} {count}" for cause, count in _count(unanswered)[:3])
        raise TeacherError(
            f"{len(unanswered)} of {tally.num_input} windows got no answer",
            where=shown_url(cfg.teacher),
            got=causes,
            fix="run the same command again: what was answered is kept and not asked twice",
        )
    outputs = [path for path in (out / PRODUCT, out / REPORT, out / ANSWERS) if path.exists()]
    stage.finish(outputs, tally, flights=flight_tally.as_dict())
    shutil.rmtree(out / PARTS, ignore_errors=True)
    return out / PRODUCT


def _recorded(cfg: CaptionConfig) -> dict:
    """Give the settings that decide the product: without the endpoint's address, which may hold a password, and manners."""
    config = cfg.model_dump(mode="json")
    config["teacher"] = "rules" if cfg.teacher == "rules" else "endpoint"
    config["endpoint"] = {name: value for name, value in config["endpoint"].items() if name not in MANNERS}
    return config


def _named_flights(data: Path) -> list[tuple[str, Path]]:
    """Give (flight id, folder) in the order of the product.

    Raises:
        InputError: two flights have one name, so their samples could not be told apart.
    """
    named: dict[str, Path] = {}
    for folder in find_flights(data):
        name = f"{folder.resolve().parent.name}_{folder.resolve().name}"
        if name in named:
            raise InputError(
                "two flights of one name", where=data, got=f"{named[name]} and {folder}", fix="give the tree of one run"
            )
        named[name] = folder
    return sorted(named.items(), key=lambda pair: f"{pair[0]}_frame_")  # the order of their sample ids


def _allot(flights: list[tuple[str, Path]], cfg: CaptionConfig) -> Allotted:
    """Say how many windows each flight may give (None: all), so that `limit` does not depend on the order of work."""
    if cfg.limit is None:
        return [(name, folder, None) for name, folder in flights]
    left = cfg.limit
    allotted: Allotted = []
    for name, folder in flights:
        if left == 0:
            break
        try:
            count = len(current_frames(len(read_flight(folder, strict=False)), cfg.window))
        except InputError:
            count = 0  # the work itself records the failure
        allotted.append((name, folder, min(count, left)))
        left -= min(count, left)
    return allotted


def _samples(folder: Path, cfg: CaptionConfig, most: int | None) -> Iterator[Sample]:
    flight = read_flight(folder, strict=False)
    for number, sample in enumerate(iterate_samples(flight, cfg.window)):
        if number == most:
            return
        yield sample


def _part(stage_path: Path, name: str) -> Path:
    return stage_path / PARTS / f"{name}.jsonl"


# --- rules ------------------------------------------------------------------------------------------------------------


def _run_rules(stage: StageFolder, allotted: Allotted, cfg: CaptionConfig, seed: int, workers: int) -> Tally:
    items = [Item(name, (folder, most)) for name, folder, most in allotted]
    args = (cfg, stage.path, seed)
    return run_items(stage, items, start_rules, args, workers=workers, label="caption").tally


def start_rules(cfg: CaptionConfig, stage_path: Path, seed: int) -> Work:
    """Worker factory of run_items: one item is one flight."""
    teacher = RuleTeacher(seed)

    def work(item: Item) -> Outcome:
        folder, most = item.payload
        num_windows = asyncio.run(
            _caption_in_order(_samples(folder, cfg, most), teacher, cfg, stage_path, item.item_id)
        )
        if num_windows == 0:
            return Outcome({}, drop_reason="too_short")
        return Outcome({"windows": num_windows})

    return work


async def _caption_in_order(
    samples: Iterator[Sample], teacher: Teacher, cfg: CaptionConfig, stage_path: Path, name: str
) -> int:
    captions = [await caption_window(sample, teacher, cfg) for sample in samples]
    if captions:
        write_captions(_part(stage_path, name), captions)
    return len(captions)


# --- endpoint ---------------------------------------------------------------------------------------------------------


class _OpenFlight:
    """A flight whose windows are being asked."""

    def __init__(self) -> None:
        self.captions: list[Caption] = []
        self.pending = 0
        self.is_read = False
        self.has_gap = False


class _Endpoint:
    """Asks an endpoint about all flights."""

    def __init__(self, stage: StageFolder, cfg: CaptionConfig, seed: int) -> None:
        self.stage, self.cfg, self.seed = stage, cfg, seed
        self.open: dict[str, _OpenFlight] = {}
        self.unanswered: list[dict] = []
        self.failures: list[dict] = []
        self.failed_in_row = 0

    async def run(self, allotted: Allotted) -> tuple[Tally, list[dict]]:
        tally = Tally(num_input=len(allotted))
        book = AnswerBook(self.stage.path / ANSWERS, lambda name: _part(self.stage.path, name).exists())
        if book.num_damaged:
            log.warning("%s: %d damaged lines are left out", self.stage.path / ANSWERS, book.num_damaged)
        with book, progress_bar("caption", total=len(allotted)) as advance:
            self.book = book
            async with EndpointTeacher(self.cfg.teacher, self.cfg.endpoint, self.cfg.image, book, self.seed) as teacher:
                await self._ask_all(allotted, teacher, tally, advance)
        records = self.failures + self.unanswered
        write_bytes(self.stage.path / "failures.jsonl", "".join(dump_json(r) + "\n" for r in records).encode())
        return tally, self.unanswered

    async def _ask_all(
        self, allotted: Allotted, teacher: EndpointTeacher, tally: Tally, advance: Callable[[int], None]
    ) -> None:
        """Keep `concurrency` windows in flight, whatever flight they belong to."""
        running: set[asyncio.Task] = set()
        try:
            for name, folder, most in allotted:
                if _part(self.stage.path, name).exists():
                    tally.kept += 1
                    advance(1)
                    continue
                flight = self.open[name] = _OpenFlight()
                num_windows = 0
                try:
                    for sample in _samples(folder, self.cfg, most):
                        num_windows += 1
                        flight.pending += 1
                        running.add(asyncio.create_task(self._one(name, sample, teacher, advance)))
                        if len(running) >= self.cfg.endpoint.concurrency:
                            running = await _some_done(running)
                except InputError as error:
                    self.failures.append({"id": name, "code": error.code, "message": str(error)})
                    tally.failed[error.code] = tally.failed.get(error.code, 0) + 1
                    log.error("caption: %s: %s", name, error)
                else:
                    _count_flight(tally, num_windows)
                flight.is_read = True
                self._close_if_done(name, advance)
            while running:
                running = await _some_done(running)
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)

    async def _one(self, name: str, sample: Sample, teacher: Teacher, advance: Callable[[int], None]) -> None:
        flight = self.open[name]
        sample_id = sample.observed.sample_id
        try:
            flight.captions.append(await caption_window(sample, teacher, self.cfg))
            self.failed_in_row = 0
        except NoAnswer as error:
            self._record_gap(flight, {"id": sample_id, "code": error.cause, "message": str(error)})
        except CosflyError as error:
            if error.fatal:
                raise
            self._record_gap(flight, {"id": sample_id, "code": error.code, "message": str(error)})
        flight.pending -= 1
        self._close_if_done(name, advance)

    def _record_gap(self, flight: _OpenFlight, failure: dict) -> None:
        flight.has_gap = True
        self.unanswered.append(failure)
        self.failed_in_row += 1
        if self.failed_in_row >= self.cfg.endpoint.stop_after_failures:
            causes = ", ".join(f"{cause} {count}" for cause, count in _count(self.unanswered)[:3])
            raise TeacherError(
                f"{self.failed_in_row} windows in a row got no answer",
                where=shown_url(self.cfg.teacher),
                got=f"{causes}; the last: {failure['message']}",
                fix="see to the server, then run the same command again: nothing answered is asked twice",
            )

    def _close_if_done(self, name: str, advance: Callable[[int], None]) -> None:
        """Write a flight's part once its last window is done. One with a gap stays unfinished, for the next run."""
        flight = self.open[name]
        if not flight.is_read or flight.pending:
            return
        del self.open[name]
        if flight.captions:
            flight.captions.sort(key=lambda caption: caption.frame_index)
            part = _part(self.stage.path, name)
            write_captions(part.with_suffix(".gap") if flight.has_gap else part, flight.captions)
        if not flight.has_gap:
            part_with_gap = _part(self.stage.path, name).with_suffix(".gap")
            part_with_gap.unlink(missing_ok=True)
        self.book.forget(name)
        advance(1)


async def _some_done(running: set[asyncio.Task]) -> set[asyncio.Task]:
    done, pending = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()  # raises what ends the run
    return pending


def _count_flight(tally: Tally, num_windows: int) -> None:
    if num_windows:
        tally.kept += 1
    else:
        tally.dropped["too_short"] = tally.dropped.get("too_short", 0) + 1


def _count(failures: list[dict]) -> list[tuple[str, int]]:
    counts: dict[str, int] = {}
    for failure in failures:
        counts[failure["code"]] = counts.get(failure["code"], 0) + 1
    return sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))


# --- the product ------------------------------------------------------------------------------------------------------


def _merge(stage: StageFolder, unanswered: list[dict]) -> Ledger:
    """Join the parts to `captions.jsonl`, one at a time, and count on the way."""
    ledger = Ledger()
    folder = stage.path / PARTS
    found = [*folder.glob("*.jsonl"), *(folder.glob("*.gap") if unanswered else ())]
    parts = sorted(found, key=lambda path: f"{path.stem}_frame_")

    def stream() -> Iterator[Caption]:
        for part in parts:
            for caption in read_captions(part):
                ledger.add(caption)
                yield caption

    write_captions(stage.path / PRODUCT, stream())
    return ledger
