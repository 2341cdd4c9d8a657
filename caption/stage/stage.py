"""Stage `caption`: reads a playback tree, writes `captions.jsonl`, `caption_report.json` and `report.html`.

Teachers that ask no model work on tracks in several processes; models are asked from one process (asking.py). Each
finished track is a part file; the parts are merged at the end, so that memory stays flat.
"""

import asyncio
import logging
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

from caption.schema import CaptionConfig, Window
from caption.stage.asking import ANSWERS, Asking, AskingOutcome, read_quarantine
from caption.stage.ledger import REPORT_FORMAT, CaptionReport, SampleCards, explain_drops, page_html
from caption.stage.tracks import PARTS, TrackInput, find_inputs, parts_of
from caption.stage.window_loop import caption_window
from caption.teachers.foreign import read_given
from caption.teachers.prompt_files import PROMPTS, Vocabulary, keep_own_prompts, vocabulary_of
from caption.teachers.students import student_settings
from caption.teachers.teacher import EMBEDDED, embedded_teacher
from caption.verification.glossary import GLOSSARY_FILE
from cosfly.formats.captions import caption_lines, line_of, write_caption_lines
from cosfly.llm.contract import run_until_interrupted
from cosfly.llm.student_chat import student_files
from cosfly.runtime.errors import ConfigError, TeacherError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import write_model
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import StageFolder, read_manifest
from cosfly.runtime.worker import Item, Outcome, Work, advance
from cosfly.viz.page import run_name

log = logging.getLogger(__name__)

PRODUCT, REPORT, PAGE = "captions.jsonl", "caption_report.json", "report.html"
PACKAGE_FILES = {"glossary": GLOSSARY_FILE}  # a directory never mixes captions of two glossaries or two prompts


def run(
    cfg: CaptionConfig, data: Path, out: Path, *,
    seed: int = 0, workers: int = 0, watch: Watch = Watch(), retry_failed: bool = False,
) -> Path:  # fmt: skip
    """Write captions of the tracks of a playback tree; return the path of `captions.jsonl`.

    Args:
        data: Playback tree, ours or of the public layout.
        workers: Processes of a built-in teacher without a judge; a model takes `endpoint.concurrency` requests.
        retry_failed: Ask again about the windows that the server refused, which are in `quarantine.jsonl`.

    Raises:
        InputError: There is no track. NothingKept: No track is long enough, or no window got a caption.
        ConfigError: `retry_failed` with a built-in teacher.
        TeacherError: The endpoint cannot be used, a budget is used up, or windows got no answer. Answers are kept.
    """
    if cfg.teacher_kind in EMBEDDED and retry_failed:
        what, fix = "this teacher asks no server, so no window has to be retried", "remove --retry-failed"
        raise ConfigError(what, where="--retry-failed", got=f"the teacher `{cfg.teacher_kind}`", fix=fix)
    vocabulary = vocabulary_of(cfg)
    cfg = student_settings(cfg, vocabulary)
    unused = set[str]()  # sample ids of a file of captions that no window has used
    if cfg.caption_file is not None:
        answers, _ = read_given(cfg)
        unused = {sample_id for sample_id, _ in answers}
    stage = open_stage(cfg, data, out, seed)
    if stage.is_complete and not _continues(stage, cfg, retry_failed):
        if retry_failed:
            log.warning("caption: nothing to retry within --limit: other dropped windows would get the same answers")
        _remove_parts(stage)  # the process may have been killed before it removed them
        return out / PRODUCT
    tracks, is_cut = find_inputs(cfg, data)
    if stage.is_complete:
        stage.reopen()
    if cfg.teacher_kind in EMBEDDED and cfg.judge.url is None:
        finished = run_items(
            stage, [Item(track.item_id, track) for track in tracks], make_worker, (cfg, vocabulary, stage.path, seed),
            workers=workers, watch=watch, label="caption",
            has_product=lambda item: item.payload.part(stage.path).exists(),
        )  # fmt: skip
        outcome = AskingOutcome(finished.tally)
    else:
        asking = Asking(stage, cfg, vocabulary, seed, retry_failed=retry_failed)
        outcome = asking.outcome
        try:
            run_until_interrupted(asking.run(tracks))
        except (TeacherError, KeyboardInterrupt, SystemExit):
            if outcome.tracks.input:  # the report shows what was reached
                _write_report(stage, cfg, tracks, outcome, unused)
            raise
    report = _write_report(stage, cfg, tracks, outcome, unused)
    if unused and not is_cut:
        log.warning("caption: %d captions of %s match no window of this tree", len(unused), cfg.caption_file)
    for warning in report.warnings():
        log.warning("caption: %s", warning)
    _finish(stage, cfg, vocabulary, outcome, report, is_cut)
    return out / PRODUCT


def _write_report(
    stage: StageFolder, cfg: CaptionConfig, tracks: list[TrackInput], outcome: AskingOutcome, unused: set[str]
) -> CaptionReport:
    """Join the parts so far to `captions.jsonl`, one at a time, and write the report and its page; remove from `unused`
    the windows that have a caption."""
    report, cards = CaptionReport(), SampleCards()

    def lines() -> Iterator[bytes]:
        for part in parts_of(stage.path, tracks):
            for line, caption in caption_lines(part):
                report.add(caption)
                cards.add(caption)
                unused.discard(caption.sample_id)
                yield line.encode()

    write_caption_lines(stage.path / PRODUCT, lines())
    report.finish(outcome.tracks, len(outcome.unanswered), outcome.judge_usage)
    write_model(stage.path / REPORT, report, REPORT_FORMAT)
    folders = {track.name: track.folder for track in tracks}
    html = page_html(report, cards.chosen(), folders, stage.path / ANSWERS, cfg.budget, run_name(stage.path))
    write_bytes(stage.path / PAGE, html.encode())
    return report


def _finish(
    stage: StageFolder, cfg: CaptionConfig, vocabulary: Vocabulary, outcome: AskingOutcome, report: CaptionReport,
    is_cut: bool,
) -> None:  # fmt: skip
    """Finish the stage if every window has an outcome; TeacherError if one should have got an answer."""
    out, tally = stage.path, report.windows
    if outcome.stopped:
        got = f"{outcome.stopped}; {tally.kept} windows accepted so far"
        fix = "raise --max-cost or --max-tokens and run the same command again; answered windows are not asked again"
        raise TeacherError("captioning stopped, because the budget is spent", where=cfg.teacher, got=got, fix=fix)
    if outcome.unanswered:
        what = f"{len(outcome.unanswered)} of {tally.input} windows got no answer"
        fix = "run the same command again; answered windows are not asked again"
        raise TeacherError(what, where=cfg.teacher, got=outcome.causes, fix=fix)
    if tally.input == 0:
        num_frames = cfg.window.num_frames + cfg.window.future_frames
        raise stage.nothing_kept(outcome.tracks, expected=f"a track of at least {num_frames} frames")
    if not tally.kept:
        causes = explain_drops(tally.dropped + tally.failed, report.rejected_answers)
        fix = f"{causes}; see {out / PAGE}; use another model or other settings, and another --out"
        raise stage.nothing_kept(tally, where=out / PRODUCT, fix=fix)
    outputs = [out / PRODUCT, out / REPORT, out / PAGE, *sorted((out / ANSWERS).glob("*.jsonl"))]
    outputs += keep_own_prompts(out, vocabulary)
    log.info("caption: examples and counts are in %s", out / PAGE)
    stage.finish(outputs, tally, flights=outcome.tracks.model_dump(), limit=cfg.limit if is_cut else None)
    _remove_parts(stage)


def _remove_parts(stage: StageFolder) -> None:
    """Remove the part files of a complete stage that no later run continues, for a larger limit or a refused window."""
    if read_manifest(stage.path).facts.get("limit") is None and not read_quarantine(stage.path):
        shutil.rmtree(stage.path / PARTS, ignore_errors=True)


def open_stage(cfg: CaptionConfig, data: Path, out: Path, seed: int) -> StageFolder:
    """Open the output directory for these settings."""
    inputs = {"data": data} if cfg.caption_file is None else {"data": data, "captions": cfg.caption_file}
    if cfg.student.folder is not None:
        inputs |= student_files(cfg.student.folder)
    files = PACKAGE_FILES | {"prompts": cfg.prompts or PROMPTS}
    return StageFolder.open(out, "caption", config=cfg, inputs=inputs, seed=seed, package_files=files, retries=False)


def _continues(stage: StageFolder, cfg: CaptionConfig, retry_failed: bool) -> bool:
    """Return whether a complete directory is continued: its limit was smaller, or refused windows are asked again."""
    manifest = read_manifest(stage.path)
    limit, limit_before = cfg.limit or math.inf, manifest.facts.get("limit")
    is_retried = retry_failed and bool(read_quarantine(stage.path)) and limit >= manifest.counts.input
    return is_retried or (limit_before is not None and limit > limit_before)


# --- built-in teachers ------------------------------------------------------------------------------------------------


def make_worker(cfg: CaptionConfig, vocabulary: Vocabulary, stage_path: Path, seed: int) -> Work:
    """Return the function that captions one track in a process."""
    teacher = embedded_teacher(cfg, seed)

    async def caption_in_order(windows: Iterator[Window]) -> list[bytes]:
        """Return the lines of captions; a line takes far less time in garbage collection than a caption."""
        lines: list[bytes] = []
        for window in windows:
            lines.append(line_of(await caption_window(window, teacher, cfg, vocabulary)))
            advance()
        return lines

    def work(item: Item) -> Outcome:
        track: TrackInput = item.payload
        lines = asyncio.run(caption_in_order(track.windows(cfg)))
        if not lines:
            return Outcome({}, drop_reason="too_short")
        write_caption_lines(track.part(stage_path), lines)
        return Outcome({"windows": len(lines)})

    return work
