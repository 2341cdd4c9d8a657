"""Check an export: its record, and its files against its list of checksums."""

from __future__ import annotations

from pathlib import Path

from cosfly.errors import InputError
from cosfly.reading.files import read_bytes
from cosfly.work.store import CHECKSUMS
from release.export.stage import ExportRecord, read_export, render_readme
from release.verify.findings import Findings
from release.verify.folder import check_digests, check_names, read_digests

EXPORT = "export.json"


def check_export(folder: Path, with_digests: bool, findings: Findings) -> ExportRecord | None:
    """Check an export and return its record."""
    try:
        record = read_export(folder / EXPORT)
    except InputError as error:
        findings.error("record", EXPORT, error.got or error.what, error.expected or "a record of an export")
        return None
    is_tree, digests = record.format == "tree", read_digests(folder, findings)
    own: list[str] = []
    for path in folder.rglob("trajectory.json") if is_tree else ():  # each flight lists its own files
        inner = path.relative_to(folder).parent
        own += [(inner / name).as_posix() for name in (*read_digests(folder / inner, findings), CHECKSUMS)]
    good = check_names(folder, dict.fromkeys((*digests, *own, "README.md", CHECKSUMS)), findings)
    if EXPORT not in digests:
        findings.error("checksum", f"{CHECKSUMS}: {EXPORT}", "no line", "one line per file")
    _check_readme(folder, record, findings)
    if with_digests:
        check_digests(folder, digests, good, findings)
    if not is_tree:
        findings.note("not_checked", EXPORT, "rows and pictures of another format", "verify the release itself")
    return record


def _check_readme(folder: Path, record: ExportRecord, findings: Findings) -> None:
    """README.md is what export.json gives, to the letter."""
    try:
        got: object = "other words"
        if read_bytes(folder / "README.md", what="README", tree=folder) == render_readme(record).encode():
            return
    except InputError as error:
        got = error.got or error.what
    findings.error("card", "README.md", got, "what export.json says, in words")
