"""Stage `caption`: reads a playback tree, writes `captions.jsonl` and `caption_report.json`.

Teachers that ask nobody work on flights in processes; who takes its time is asked from one process (asking.py). Each
finished flight is a part file; the parts are merged last, so that memory stays flat.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

from caption.schema import CaptionConfig, Window
from caption.stage.asking import ANSWERS, Asked, Asking, common_causes, read_quarantine
from caption.stage.flights import PARTS, Allotted, allot, named_flights, parts_of, restore_parts
from caption.stage.ledger import Ledger
from caption.stage.reasons import explained
from caption.stage.report import write_page
from caption.stage.window_loop import caption_prepared, prepare
from caption.teachers.foreign import given_samples
from caption.teachers.prompt_files import PROMPTS, keep_own_prompts, vocabulary_of
from caption.teachers.students import as_taught
from caption.teachers.teacher import EMBEDDED, Teacher, embedded_teacher
from caption.verification.glossary import GLOSSARY_FILE
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import caption_lines, line_of, write_caption_lines
from cosfly.formats.places import flight_of
from cosfly.llm.contract import run_until_interrupted
from cosfly.llm.student_chat import student_files
from cosfly.runtime.errors import ConfigError, ResumeError, TeacherError
from cosfly.runtime.json_io import write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, Tally, read_manifest
from cosfly.runtime.worker import Item, Outcome, Work, advance

log = logging.getLogger(__name__)

PRODUCT, REPORT, PAGE = "captions.jsonl", "caption_report.json", "report.html"
PACKAGE_FILES = {"glossary": GLOSSARY_FILE}  # one folder never holds captions of two glossaries, nor of two prompts
WINDOWS_AT_ONCE = 128  # that are prepared for a teacher that asks nobody


def run(
    cfg: CaptionConfig,
    data: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
    retry_failed: bool = False,
) -> Path:
    """Caption the flights of a playback tree.

    Args:
        data: playback tree, ours or of the public layout.
        workers: processes of a teacher that asks nobody, without a judge; requests in flight are
        `endpoint.concurrency`.
        retry_failed: ask only about the windows that stand in `quarantine.jsonl`: without an answer, or refused by the
        server.
    Returns:
        `captions.jsonl`.
    Raises:
        InputError: no flight. NothingKept: none is long enough, or no window gave a caption.
        ConfigError: `retry_failed` with a teacher that asks nobody.
        TeacherError: the endpoint cannot be used, a budget is used up, or windows stayed without an answer; what was
            answered is kept.
    """
    if cfg.teacher_kind in EMBEDDED and retry_failed:
        raise ConfigError(
            "this teacher never fails to answer", where="--retry-failed", got=cfg.teacher_kind, fix="leave it out"
        )
    vocabulary = vocabulary_of(cfg)
    cfg = as_taught(cfg, vocabulary)
    foreign = None if cfg.caption_file is None else given_samples(cfg, cfg.caption_file)
    stage = open_stage(cfg, data, out, seed, resume)
    was_whole = stage.is_complete and not _has_more(stage, cfg)
    if was_whole and not (retry_failed and _has_refused(stage, cfg)):
        if read_manifest(out).facts.get("limit") is None:
            shutil.rmtree(out / PARTS, ignore_errors=True)  # a kill came before they were gone
        return out / PRODUCT
    allotted, is_cut = allot(named_flights(data, cfg.flights), cfg)
    restore_parts(stage.path, out / PRODUCT, allotted)
    if cfg.teacher_kind in EMBEDDED and cfg.judge.url is None:
        items = [Item(flight.item_id, flight) for flight in allotted]
        args = (cfg, vocabulary, stage.path, seed)
        asked = Asked(run_items(stage, items, make_worker, args, workers=workers, watch=watch, label="caption").tally)
    else:
        if retry_failed:
            _take_back(stage, allotted)
        asking = Asking(stage, cfg, vocabulary, seed, retry_failed=retry_failed, was_whole=was_whole)
        asked = run_until_interrupted(asking.run(allotted))
    return _publish(stage, cfg, vocabulary, asked, allotted, foreign, is_cut=is_cut)


def _publish(
    stage: StageFolder, cfg: CaptionConfig, vocabulary: Vocabulary, asked: Asked, allotted: list[Allotted],
    foreign: set[str] | None, *, is_cut: bool,
) -> Path:  # fmt: skip
    """Put what was answered together, with report and page; the stage is finished where no window is left."""
    out = stage.path
    ledger = Ledger()
    _merge(stage, ledger, allotted, foreign, with_gaps=bool(asked.unanswered))
    tally = ledger.tally(len(asked.unanswered))
    is_whole = not (asked.unanswered or asked.num_flights_left)
    if tally.input == 0 and is_whole:
        num_frames = cfg.window.num_frames + cfg.window.future_frames
        raise stage.nothing_kept(asked.flights, expected=f"a flight of at least {num_frames} frames")
    report = ledger.report(asked.flights, tally, asked.judge_usage)
    write_json(stage.path / REPORT, report.as_json())
    for warning in report.warnings():
        log.warning("caption: %s", warning)
    if foreign and not is_cut:
        log.warning("caption: %d captions of %s are of no window of this tree", len(foreign), cfg.caption_file)
    folders = {flight.name: flight.folder for flight in allotted}
    write_page(stage.path / PAGE, report, ledger.shelf.cards(), folders, cfg.budget)
    if not is_whole:
        _tell_what_is_left(cfg, asked, tally)
        return out / PRODUCT
    if not tally.kept:
        fix = f"mend what is dropped ({explained(tally.dropped)}), or change the settings and choose another --out"
        raise stage.nothing_kept(tally, where=out / PRODUCT, fix=fix)
    outputs = [out / PRODUCT, out / REPORT, out / PAGE, *sorted((out / ANSWERS).glob("*.jsonl"))]
    outputs += keep_own_prompts(out, vocabulary)
    stage.finish(outputs, tally, flights=asked.flights.model_dump(), limit=cfg.limit if is_cut else None)
    if not is_cut:
        shutil.rmtree(out / PARTS, ignore_errors=True)  # a cut run keeps them, for the next with a larger limit
    return out / PRODUCT


def open_stage(cfg: CaptionConfig, data: Path, out: Path, seed: int, resume: Resume) -> StageFolder:
    """Open the stage's folder for these settings."""
    inputs = {"data": data} if cfg.caption_file is None else {"data": data, "captions": cfg.caption_file}
    if cfg.student.folder is not None:
        inputs |= student_files(cfg.student.folder)
    return StageFolder.open(
        out,
        "caption",
        config=cfg,
        inputs=inputs,
        seed=seed,
        resume=resume,
        package_files=PACKAGE_FILES | {"prompts": cfg.prompts or PROMPTS},
    )


def _has_more(stage: StageFolder, cfg: CaptionConfig) -> bool:
    """Return whether a complete folder was cut by a limit smaller than the one now; it is then open again."""
    limit = read_manifest(stage.path).facts.get("limit")
    if limit is None or (cfg.limit is not None and cfg.limit <= limit):
        return False
    stage.reopen()
    return True


def _has_refused(stage: StageFolder, cfg: CaptionConfig) -> bool:
    """Return whether the server refused windows of a complete folder; it is then open again."""
    if not read_quarantine(stage.path):
        return False
    num_windows = read_manifest(stage.path).counts.input
    if cfg.limit is not None and cfg.limit < num_windows:
        raise ResumeError(
            "the folder holds more windows than the limit allows, so it stays as it is", where=stage.path,
            got=f"{num_windows} windows", expected=f"at most {cfg.limit} (caption.limit)",
            fix="leave --limit out, or raise it",
        )  # fmt: skip
    stage.reopen()
    return True


def _take_back(stage: StageFolder, allotted: list[Allotted]) -> None:
    """Make the flights of windows in quarantine unfinished again."""
    names = {flight_of(sample_id) for sample_id in read_quarantine(stage.path)}
    for flight in allotted:
        if flight.name in names:
            flight.part(stage.path).unlink(missing_ok=True)


def _tell_what_is_left(cfg: CaptionConfig, asked: Asked, tally: Tally) -> None:
    """Return why the product is not whole."""
    missed = [failure for failure in asked.unanswered if failure.code != "not_asked"]
    if asked.stopped:
        raise TeacherError(
            "stopped before the budget was passed",
            where=cfg.teacher,
            got=f"{asked.stopped}; {tally.kept} windows accepted so far",
            fix="raise --max-cost or --max-tokens and run the same command again: nothing answered is asked twice",
        )
    if missed:
        raise TeacherError(
            f"{len(missed)} of {tally.input} windows got no answer",
            where=cfg.teacher,
            got=f"{common_causes(missed)}; the last: {missed[-1].message}",
            fix="run the same command again (what was answered is not asked twice), or --retry-failed for these alone",
        )
    log.info("caption: the whole quarantine was asked about; run again without --retry-failed for what was never asked")


# --- embedded teachers ------------------------------------------------------------------------------------------------


def make_worker(cfg: CaptionConfig, vocabulary: Vocabulary, stage_path: Path, seed: int) -> Work:
    """Make what a process does with one flight."""
    teacher = embedded_teacher(cfg, seed)

    def work(item: Item) -> Outcome:
        flight: Allotted = item.payload
        windows, part = flight.windows(cfg), flight.part(stage_path)
        num_windows = asyncio.run(caption_in_order(windows, teacher, cfg, vocabulary, part))
        if num_windows == 0:
            return Outcome({}, drop_reason="too_short")
        return Outcome({"windows": num_windows})

    return work


async def caption_in_order(
    windows: Iterable[Window], teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, part: Path
) -> int:
    """Caption the windows of a flight in order, and write their part; gives how many there are.

    A caption is kept as its line: a hundred times fewer objects, through which the garbage collector would go again and
    again.
    """
    lines: list[bytes] = []
    rest = iter(windows)
    while some := list(islice(rest, WINDOWS_AT_ONCE)):
        for prepared in prepare(some, teacher, cfg, vocabulary):
            lines.append(line_of(await caption_prepared(prepared, teacher, cfg)))
            advance()
    if lines:
        write_caption_lines(part, lines)
    return len(lines)


# --- the product ------------------------------------------------------------------------------------------------------


def _merge(
    stage: StageFolder, ledger: Ledger, allotted: list[Allotted], foreign: set[str] | None, *, with_gaps: bool
) -> None:
    """Join the parts to `captions.jsonl`, one at a time, and count on the way.

    Args:
        foreign: windows of a file of captions; those that are captioned are taken out.
        with_gaps: windows are still without an answer.
    """
    product = stage.path / PRODUCT
    parts = parts_of(stage.path, allotted, with_gaps)

    def lines() -> Iterator[str]:
        for part in parts:
            for line, caption in caption_lines(part):
                ledger.add(caption)
                if foreign:
                    foreign.discard(caption.sample_id)
                yield line

    write_caption_lines(product, (line.encode() for line in lines()))
