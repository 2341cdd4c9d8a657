"""Check the files of a folder: names, sizes, links and checksums. No link is followed out of the folder but those of
the hub client's cache into its blobs.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from cosfly.errors import InputError
from cosfly.reading.files import open_file, sha256_file
from cosfly.work.store import CHECKSUMS, read_checksums
from release.verify.findings import Findings

ALLOWED = (".git", ".gitattributes", ".cache", ".huggingface")  # what the hub and its client put beside a data set
# Files that may be there and are in no list: the text of a licence, and a signature over the list itself.
UNLISTED = ("LICENSE", "LICENSE.txt", "LICENSE.md", f"{CHECKSUMS}.sig")
SMALL_BYTES = 64_000_000  # a file whose checksum is compared with the cheap checks


def files_below(folder: Path) -> Iterator[str]:
    """Yield the names of everything that is no folder, and of empty folders, relative, without following links to
    folders."""
    for place, folders, names in os.walk(folder, onerror=None, followlinks=False):
        here = Path(place)
        relative = here.relative_to(folder)
        if not relative.parts:
            folders[:] = [name for name in folders if name not in ALLOWED]
            names = [name for name in names if name not in ALLOWED]
        if relative.parts and not names and not folders:
            yield f"{relative.as_posix()}/"
        for name in sorted([*names, *(name for name in folders if (here / name).is_symlink())]):
            yield (relative / name).as_posix()
        folders[:] = sorted(name for name in folders if not (here / name).is_symlink())


def check_names(folder: Path, expected: Mapping[str, int | None], findings: Findings) -> list[str]:
    """Compare the files that are there with those that should be, by name and size; give those that are as they should.

    Args:
        expected: name -> size in bytes, None where nobody says.
    """
    found: dict[str, int] = {}
    for name in files_below(folder):
        if name not in expected and name not in UNLISTED:
            got = "an empty folder" if name.endswith("/") else "a file"
            findings.error("unexpected", name, got, "nothing that no record knows")
            continue
        try:
            with open_file(folder / name, tree=folder) as file:
                size = os.fstat(file.fileno()).st_size
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a regular file of the folder")
            continue
        if name in expected:
            found[name] = size
    good = []
    for name, wanted in expected.items():
        if name not in found and not os.path.lexists(folder / name):
            findings.error("missing", name, "no such file", "a file of the release")
        elif name in found and wanted not in (None, found[name]):
            findings.error("size", name, f"{found[name]:,} bytes", f"{wanted:,} bytes")
        elif name in found:
            good.append(name)
    findings.facts.append(f"{len(found):,} files, {sum(found.values()):,} bytes")
    return good


def read_digests(folder: Path, findings: Findings) -> dict[str, str]:
    """Read the list of checksums; empty, with a finding, where there is none that can be read."""
    try:
        return read_checksums(folder)
    except InputError as error:
        findings.error("checksum", CHECKSUMS, error.got or error.what, "lines of sha256sum")
        return {}


def check_digests(folder: Path, digests: Mapping[str, str], names: Collection[str], findings: Findings) -> None:
    """Read files and compare their checksums with the list."""
    for name in names:
        try:
            if name in digests and (found := sha256_file(folder / name, tree=folder)) != digests[name]:
                findings.error("checksum", name, found, digests[name])
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a file that can be read")
