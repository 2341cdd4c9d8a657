"""An export beside the release that it was made of: it is made again, and every file held against the new one."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cosfly
from cosfly.errors import CosflyError, InputError
from cosfly.reading.documents import validated
from cosfly.reading.files import sha256_file
from cosfly.reading.tables import open_table
from cosfly.work.runner import Watch
from cosfly.work.store import CHECKSUMS
from release.export.contract import ExportConfig
from release.export.source import open_release
from release.export.stage import ExportRecord
from release.export.stage import run as export
from release.verify.findings import Findings
from release.verify.folder import LICENCES, files_below

WRITTEN_ANEW = ("export.json", "README.md", CHECKSUMS)  # these name the version of cosfly


def check_made_again(
    folder: Path, record: ExportRecord, source: Path, *, workers: int, watch: Watch, findings: Findings
) -> None:
    """Compare the files of an export with those that its release gives.

    Args:
        source: the release; it should be verified itself.
    """
    try:
        release = open_release(source)
        cfg = validated(ExportConfig, record.settings, "export.json: settings")
    except InputError as error:
        findings.error("source", error.where, error.got or error.what, "the release of the export")
        return
    if release.record_sha256 != record.release.record_sha256:
        findings.error("source", source, release.record_sha256, f"{record.release.record_sha256}, the release.json that export.json names")  # fmt: skip
        return
    with tempfile.TemporaryDirectory(prefix="cosfly-export-") as place:
        try:
            again = export(cfg, source, Path(place) / "export", workers=workers, watch=watch)
        except CosflyError as error:
            findings.error("source", source, f"{error.what}: {error.got}", "a release that can be exported")
            return
        for name in sorted({*files_below(folder), *files_below(again)} - {*WRITTEN_ANEW, *LICENCES}):
            _compare(folder, again, name, findings)
        num_files = sum(1 for _ in files_below(again))
    findings.facts.append(f"{num_files:,} files made again of {record.release.name} by cosfly {cosfly.__version__}")


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
        findings.note("not_checked", name, f"written by {writers[0]}", f"{writers[1]}, which packs the same rows otherwise")  # fmt: skip
    else:
        findings.error("source", name, digests[0], f"{digests[1]}, as the release gives it")
