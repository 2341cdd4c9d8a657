"""`cosfly release export`: a release in another format.

Reads a release folder; writes `<format>/` with the format's files, `export.json` (which release it came from, how
things are stored), README.md and checksums.sha256.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml
from pydantic import Field

import cosfly
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.escaping import for_markdown
from cosfly.runtime.io import CHECKSUMS, inside, sha256_bytes, storage_errors, write_bytes, write_checksums
from cosfly.runtime.json_io import FileFormat, dump_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.worker import Item, Outcome, Work
from release.export.contract import ExportConfig, ExportUnit, FormatFacts, UnitFiles, format_of
from release.export.source import Release, open_release, scan
from release.record import ReleasedMap, Strict

EXPORT_FORMAT = FileFormat("cosfly.export", "1.1", "record of an export")


class SourceRelease(Strict):
    """The release that was exported. digest: of its content; record_sha256: of its release.json."""

    name: str
    made_by: str
    digest: str
    record_sha256: str


class ExportRecord(Strict):
    """`export.json`. prompts: the questions, as the release's record has them."""

    format: str
    format_version: str
    made_by: str
    release: SourceRelease
    licence: str
    credits: str
    maps: list[ReleasedMap]
    coordinates: dict[str, Any]
    prompts: dict[str, dict[str, str]] = Field(default_factory=dict)
    codings: dict[str, str]
    notes: list[str]
    how_to_open: str
    frames: int
    bytes: int


def describe(release: Release, facts: FormatFacts, cfg: ExportConfig, *, frames: int, num_bytes: int) -> ExportRecord:
    """Return the record of an export."""
    record = release.record
    return ExportRecord(
        format=cfg.format,
        format_version=facts.version,
        made_by=f"cosfly {cosfly.__version__}",
        release=SourceRelease(
            name=record.name, made_by=record.made_by, digest=record.content_digest, record_sha256=release.record_sha256
        ),
        licence=record.licence,
        credits=record.credits,
        maps=record.maps,
        coordinates=facts.coordinates or record.coordinates,
        prompts=record.prompts,
        codings=facts.codings,
        notes=facts.notes,
        how_to_open=facts.how_to_open,
        frames=frames,
        bytes=num_bytes,
    )


def write_export(path: Path, record: ExportRecord) -> str:
    """Write `export.json`; give its sha256."""
    value = {**EXPORT_FORMAT.header, **record.model_dump(mode="json")}
    data = (dump_json(value, indent=1) + "\n").encode()
    write_bytes(path, data)
    return sha256_bytes(data)


def render_readme(record: ExportRecord) -> str:
    """Return README.md: front matter as the hub reads it, and what `export.json` says in words."""
    front: dict[str, Any] = {
        "license": record.licence,
        "pretty_name": record.release.name,
        "tags": ["cosfly", record.format],
    }
    if record.format == "lerobot":  # what the hub's own pages of these data sets look for
        front |= {
            "tags": ["cosfly", "LeRobot"],
            "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
        }
    maps = [
        f"- {for_markdown(m.town)}: {for_markdown(m.name)}, {for_markdown(m.licence)}. {for_markdown(m.credits)}"
        for m in record.maps
    ]
    lines = [
        "---", yaml.safe_dump(front, sort_keys=True, allow_unicode=True).rstrip(), "---", "",
        f"# {for_markdown(record.release.name)}: {record.format} {record.format_version}", "",
        f"{record.frames:,} frames of the release {for_markdown(record.release.name)} "
        f"(content {record.release.digest}), exported by {for_markdown(record.made_by)}. `export.json` has these facts "
        "for programs; `checksums.sha256` lists the files.", "",
        "```python", record.how_to_open, "```", "",
        "## How data are stored", "",
        *(f"- {name}: {for_markdown(text)}" for name, text in record.codings.items()), "",
        *(f"- {for_markdown(note)}" for note in record.notes), "",
        "## Axes", "",
        *(f"- {for_markdown(name)}: {for_markdown(str(text))}" for name, text in record.coordinates.items()), "",
        "## Licence and credits", "",
        f"Licence: {for_markdown(record.licence)}. {for_markdown(record.credits)}".rstrip(), "",
        *maps,
    ]  # fmt: skip
    return "\n".join(lines).rstrip() + "\n"


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
            fix="fix what this file lists (see cosfly release verify) and run the same command again, which repeats "
            "only these parts",
        )  # fmt: skip
    written = [result_of(kept, UnitFiles) for kept in finished.kept]
    _check_parts(parts, written)
    _publish(release, units, written, parts, cfg)
    with storage_errors(product):
        os.replace(parts, product)
    stage.finish([product / name for name in ("export.json", "README.md", CHECKSUMS)], finished.tally)
    return product


def _publish(
    release: Release, units: list[ExportUnit], written: list[UnitFiles], parts: Path, cfg: ExportConfig
) -> None:
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


def _check_parts(parts: Path, written: list[UnitFiles]) -> None:
    """See that what was finished by an earlier run is still there."""
    missing = [name for one in written for name in one.files if not inside(parts, name).is_file()]
    if missing:
        raise VerifyError(
            "finished files are missing", where=parts, got=", ".join(missing[:5]),
            fix=f"remove {parts.parent} and run the same command again",
        )  # fmt: skip
