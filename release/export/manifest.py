"""`export.json` and README.md of an export: which release it came from, how each thing is stored, whose it is, how to open it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import Field

import cosfly
from cosfly.escaping import for_markdown
from cosfly.products.actions import ActionSet
from cosfly.reading.documents import read_model
from cosfly.work.store import dump_json, sha256_bytes, write_bytes
from release.export.contract import ExportConfig, Facts
from release.export.source import Release
from release.record import DepthCoding, ReleasedMap, Strict

EXPORT_SCHEMA, EXPORT_VERSION = "cosfly.export", "1.1"


class CameFrom(Strict):
    """The release that was exported. digest: of its content; record_sha256: of its release.json."""

    name: str
    made_by: str
    digest: str
    record_sha256: str


class ExportRecord(Strict):
    """`export.json`. depth: how the release codes it; null where it has none. actions, prompts: the closed set of decisions (null: the one
    that ships) and the questions, as the release's record has them."""

    format: str
    format_version: str
    made_by: str
    release: CameFrom
    licence: str
    credits: str
    maps: list[ReleasedMap]
    coordinates: dict[str, Any]
    actions: ActionSet | None = None
    prompts: dict[str, dict[str, str]] = Field(default_factory=dict)
    settings: dict[str, Any]
    codings: dict[str, str]
    depth: DepthCoding | None
    notes: list[str]
    how_to_open: str
    frames: int
    bytes: int


def describe(release: Release, facts: Facts, cfg: ExportConfig, *, frames: int, num_bytes: int) -> ExportRecord:
    """Give the record of an export."""
    record = release.record
    return ExportRecord(
        format=cfg.format,
        format_version=facts.version,
        made_by=f"cosfly {cosfly.__version__}",
        release=CameFrom(
            name=record.name, made_by=record.made_by, digest=record.content_digest, record_sha256=release.record_sha256
        ),
        licence=record.licence,
        credits=record.credits,
        maps=record.maps,
        coordinates=facts.coordinates or record.coordinates,
        actions=record.actions,
        prompts=record.prompts,
        settings=cfg.recorded(),
        codings=facts.codings,
        depth=record.depth,
        notes=facts.notes,
        how_to_open=facts.how_to_open,
        frames=frames,
        bytes=num_bytes,
    )


def write_export(path: Path, record: ExportRecord) -> str:
    """Write `export.json`; give its sha256."""
    value = {"schema": EXPORT_SCHEMA, "schema_version": EXPORT_VERSION, **record.model_dump(mode="json")}
    data = (dump_json(value, indent=1) + "\n").encode()
    write_bytes(path, data)
    return sha256_bytes(data)


def read_export(path: Path) -> ExportRecord:
    """Read `export.json`.

    Raises:
        InputError: names the file and the field.
    """
    return read_model(
        path, ExportRecord, schema=EXPORT_SCHEMA, version=EXPORT_VERSION, what="record of an export", tree=path.parent
    )


def render_readme(record: ExportRecord) -> str:
    """Give README.md: front matter as the hub reads it, and what `export.json` says in words."""
    front: dict[str, Any] = {
        "license": record.licence,
        "pretty_name": record.release.name,
        "tags": ["cosfly", record.format.split("-")[0]],
    }
    if record.format.startswith("lerobot"):  # what the hub's own pages of these data sets look for
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
        f"{record.frames:,} frames of the release {for_markdown(record.release.name)} (content {record.release.digest}), "
        f"exported by {for_markdown(record.made_by)}. `export.json` says the same to programs; `checksums.sha256` lists the files.", "",
        "```python", record.how_to_open, "```", "",
        "## How things are stored", "",
        *(f"- {name}: {for_markdown(text)}" for name, text in record.codings.items()), "",
        *(f"- {for_markdown(note)}" for note in record.notes), "",
        "## Axes", "",
        *(f"- {for_markdown(name)}: {for_markdown(str(text))}" for name, text in record.coordinates.items()), "",
        "## Licence and credits", "",
        f"Licence: {for_markdown(record.licence)}. {for_markdown(record.credits)}".rstrip(), "",
        *maps,
    ]  # fmt: skip
    return "\n".join(lines).rstrip() + "\n"
