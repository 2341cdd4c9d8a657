"""An export: its record, its files against its list of checksums, and beside the release that it was made of every
file, made again."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cosfly
from cosfly.errors import CosflyError, InputError
from cosfly.reading.documents import validated
from cosfly.reading.files import read_bytes, sha256_file
from cosfly.reading.tables import open_table
from cosfly.work.runner import Watch
from cosfly.work.store import CHECKSUMS
from release.export.contract import ExportConfig
from release.export.source import open_release
from release.export.stage import ExportRecord, read_export, render_readme
from release.export.stage import run as export
from release.verify.findings import Findings
from release.verify.folder import LICENCES, check_digests, check_names, files_below, read_digests

EXPORT = "export.json"
WRITTEN_ANEW = (EXPORT, "README.md", CHECKSUMS)  # these name the version of cosfly


def check_export(
    folder: Path, with_digests: bool, source: Path | None, workers: int, watch: Watch, findings: Findings
) -> ExportRecord | None:
    """Check an export and give its record. source: the release that it was made of; it should be verified itself."""
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
    if source is not None:
        _check_made_again(folder, record, source, workers, watch, findings)
    elif not is_tree:
        expected = "--source RELEASE, to make it again and compare every file"
        findings.note("not_checked", EXPORT, "rows and pictures of another format", expected)
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


def _check_made_again(
    folder: Path, record: ExportRecord, source: Path, workers: int, watch: Watch, findings: Findings
) -> None:
    """Compare the files of an export with those that its release gives."""
    try:
        release = open_release(source)
        cfg = validated(ExportConfig, record.settings, "export.json: settings")
    except InputError as error:
        findings.error("source", error.where, error.got or error.what, "the release of the export")
        return
    if release.record_sha256 != record.release.record_sha256:
        expected = f"{record.release.record_sha256}, the release.json that export.json names"
        findings.error("source", source, release.record_sha256, expected)
        return
    with tempfile.TemporaryDirectory(prefix="cosfly-export-") as place:
        try:
            again = export(cfg, source, Path(place) / "export", workers=workers, watch=watch)
        except CosflyError as error:
            findings.error("source", source, f"{error.what}: {error.got}", "a release that can be exported")
            return
        made = set(files_below(again))
        for name in sorted({*files_below(folder), *made} - {*WRITTEN_ANEW, *LICENCES}):
            _compare(folder, again, name, findings)
    findings.facts.append(f"{len(made):,} files made again of {record.release.name} by cosfly {cosfly.__version__}")


def _compare(folder: Path, again: Path, name: str, findings: Findings) -> None:
    try:
        digests = [sha256_file(place / name, tree=place) for place in (folder, again)]
        if digests[0] == digests[1]:
            return
        writers = []
        for place in (folder, again) if name.endswith(".parquet") else ():
            with open_table(place / name, tree=place) as table:
                writers.append(table.metadata.created_by)
    except InputError as error:
        findings.error("source", name, error.got or error.what, "the file that the release gives")
        return
    if len(set(writers)) > 1:
        expected = f"{writers[1]}, which packs the same rows otherwise"
        findings.note("not_checked", name, f"written by {writers[0]}", expected)
    else:
        findings.error("source", name, digests[0], f"{digests[1]}, as the release gives it")
