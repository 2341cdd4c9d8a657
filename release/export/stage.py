"""`cosfly release export`: a release in another format.

Reads a release folder; writes `<format>/` with the format's files, `export.json` (which release it came from, how things are stored),
README.md and checksums.sha256.
"""

from __future__ import annotations

import os
from pathlib import Path

from cosfly.errors import InputError, VerifyError
from cosfly.work.runner import Item, Outcome, Watch, Work, run_items
from cosfly.work.stage_folder import Resume, StageFolder, result_of
from cosfly.work.store import CHECKSUMS, inside, storage_errors, write_bytes, write_checksums
from release.export.contract import ExportConfig, Unit, Written, format_of
from release.export.manifest import describe, render_readme, write_export
from release.export.source import Release, open_release, scan

PARTS = "parts"


def make_worker(release: Release, parts: Path, cfg: ExportConfig) -> Work:
    """Worker factory: give the function that writes one unit."""
    format = format_of(cfg.format)

    def work(item: Item) -> Outcome:
        return Outcome(format.write(release, item.payload, parts, cfg).model_dump())

    return work


def run(
    cfg: ExportConfig,
    folder: Path,
    out: Path,
    *,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Read a release; write it in the format of the settings and give the folder it stands in."""
    release = open_release(folder)
    record = release.folder / "release.json"
    stage = StageFolder.open(out, "export", config=cfg, inputs={"release": record}, seed=0, resume=resume)
    product, parts = out / cfg.format, out / PARTS
    if stage.is_complete:
        return product
    if product.is_dir() and not parts.exists():  # a kill came between the last rename and the manifest
        with storage_errors(parts):
            os.replace(product, parts)
    format = format_of(cfg.format)
    units = format.plan(release, scan(release), cfg)
    items = [Item(unit.name, unit, unit.frames) for unit in units]
    finished = run_items(
        stage, items, make_worker, (release, parts, cfg), workers=workers, watch=watch, label="export: frames"
    )
    if finished.tally.failed:  # nothing half is published
        raise InputError(
            "parts of the release could not be exported", where=out / "failures.jsonl", got=str(finished.tally),
            fix="mend what that file names (`cosfly release verify`) and run the same command again: only those are done again",
        )  # fmt: skip
    written = [result_of(kept, Written) for kept in finished.kept]
    _check_parts(parts, written)
    _publish(release, units, written, parts, cfg)
    with storage_errors(product):
        os.replace(parts, product)
    stage.finish([product / name for name in ("export.json", "README.md", CHECKSUMS)], finished.tally)
    return product


def _publish(release: Release, units: list[Unit], written: list[Written], parts: Path, cfg: ExportConfig) -> None:
    """Write what speaks of the whole export."""
    facts = format_of(cfg.format).finish(release, units, written, parts, cfg)
    digests = {name: digest for one in written for name, digest in one.files.items()} | facts.files
    about = describe(
        release, facts, cfg, frames=sum(unit.frames for unit in units), num_bytes=sum(one.bytes for one in written)
    )
    digests["export.json"] = write_export(parts / "export.json", about)
    readme = render_readme(about).encode()
    write_bytes(parts / "README.md", readme)
    write_checksums(parts, digests)


def _check_parts(parts: Path, written: list[Written]) -> None:
    """See that what was finished by an earlier run is still there."""
    missing = [name for one in written for name in one.files if not inside(parts, name).is_file()]
    if missing:
        raise VerifyError(
            "files that were finished before are missing", where=parts, got=", ".join(missing[:5]),
            fix=f"remove {parts.parent} and run again",
        )  # fmt: skip
