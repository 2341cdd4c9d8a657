"""`cosfly release verify`: check a folder against its records and recompute what is cheap to recompute.

    structure   names, sizes, links, records against each other and against the shards' footers, the card
    rows        every row: schema, geometry, labels; splits and pairs; every number of the card
    pixels      checksums of all files; every picture: masks, boxes, and reprojection into the next frame

A release, or a playback tree, ours or the public one. `sha256sum -c checksums.sha256` checks an export.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.playback import ORIGINAL
from cosfly.products.shown_captions import CaptionReader
from cosfly.reading.files import open_file, sha256_file
from cosfly.work.config import Config
from cosfly.work.items import Item
from cosfly.work.runner import Watch, run_items
from cosfly.work.stage_folder import Failed, Kept, StageFolder
from cosfly.work.store import CHECKSUMS, read_checksums
from release.card.croissant import CROISSANT
from release.record import RECORD, ReleaseRecord, read_record, release_folder
from release.verify import records
from release.verify.across import Summary, check_across
from release.verify.findings import Findings, Verified
from release.verify.flights import SENSELESS, Context, Level, make_worker
from release.verify.sources import Entry, FlightSource, Shards, TreeFlights

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


RECORDS = ("README.md", RECORD, CROISSANT, CHECKSUMS)
LEVELS: tuple[Level, ...] = ("structure", "rows", "pixels")
ANYTHING = "a release or a playback tree"


@dataclass(frozen=True)
class _How:
    """What `verify` was asked for."""

    level: Level
    reader: CaptionReader | None
    workers: int
    watch: Watch


def verify(
    folder: Path,
    *,
    level: Level = "pixels",
    workers: int = 0,
    reader: CaptionReader | None = None,
    watch: Watch = Watch(),
) -> Verified:
    """Check a release (also of a release stage or a run) or a playback tree. workers: processes; 0 works in this one.
    reader: recomputes labels and verdicts; None: they are not recomputed."""
    findings, how = Findings(), _How(level, reader, workers, watch)
    folder = release_folder(folder)
    is_release = (folder / RECORD).is_file()
    if not folder.is_dir():
        findings.error("missing", folder, "no such folder", ANYTHING)
    elif is_release or ((folder / CHECKSUMS).is_file() and next(folder.rglob("trajectory.json"), None) is None):
        _verify_release(folder, how, findings)
    else:
        _verify_tree(folder, how, findings)
    return findings.report(level)


# --- a release --------------------------------------------------------------------------------------------------------


def _verify_release(folder: Path, how: _How, findings: Findings) -> None:
    try:
        record = read_record(folder / RECORD)
    except InputError as error:
        where = str(error.where).replace(f"{folder}/", "")
        findings.error("record", where, error.got or error.what, error.expected or "a release record")
        return
    expected: dict[str, int | None] = dict.fromkeys(RECORDS) | {shard.path: shard.bytes for shard in record.shards}
    good = check_names(folder, expected, findings)
    digests = read_digests(folder, findings)
    _check_lists(record, digests, findings)
    small = [name for name in good if (folder / name).stat().st_size <= SMALL_BYTES and name in RECORDS]
    check_digests(folder, digests, small, findings)
    records.check_record(record, findings)
    readable = records.check_footers(folder, record, good, findings)
    records.check_card(folder, record, findings)
    findings.facts.append(f"structure: {len(record.shards):,} shards, {record.numbers.frames:,} frames by their record")
    if how.level != "structure" and len(readable) < len(record.shards):
        findings.add("note", "not_checked", "data", "shards that are missing or of other columns", "rows of all shards")
    elif how.level != "structure":
        _verify_rows(folder, record, how, findings)
    if how.level == "pixels":
        check_digests(folder, digests, [name for name in good if name not in small], findings)


def _check_lists(record: ReleaseRecord, digests: dict[str, str], findings: Findings) -> None:
    """The list of checksums and release.json name the same files with the same digests."""
    listed = dict.fromkeys(set(RECORDS) - {CHECKSUMS}) | {shard.path: shard.sha256 for shard in record.shards}
    for name in sorted(listed.keys() | digests.keys()):
        if name not in listed or digests.get(name) != (listed[name] or digests.get(name, "")):
            got = f"{digests.get(name)} there, {listed.get(name)} in release.json"
            findings.error("checksum", f"{CHECKSUMS}: {name}", got, "one line per file, the same digest in both")


def _verify_rows(folder: Path, record: ReleaseRecord, how: _How, findings: Findings) -> None:
    """Check rows, and at level `pixels` pictures, of a release whose shards are all there and have its columns."""
    source = Shards(folder, tuple(record.settings.modalities))
    try:
        entries = source.entries([shard.path for shard in record.shards])
    except InputError as error:
        findings.error("unreadable", str(error.where).replace(f"{folder}/", ""), error.got or error.what, "rows")
        return
    flights = _check_all(source, entries, Context.of_record(record), how, findings)
    records.check_flights(record, flights, findings)
    split_of, splits = {shard.path: shard.split for shard in record.shards}, {one.name: one.split for one in flights}
    for name, shard in ((entry.name, part[0]) for entry in entries for part in entry.parts):
        if splits.get(name, split_of[shard]) != split_of[shard]:
            findings.error("leak", name, f"rows of {splits[name]} in {shard}", f"{split_of[shard]}, the shard's split")
    try:
        records.check_numbers(folder, record, findings)
    except (InputError, *SENSELESS) as error:  # rows that no number comes of, which are found above
        findings.error("number", "release.json: numbers", f"{type(error).__name__}: {error}", "numbers of the rows")


# --- a playback tree --------------------------------------------------------------------------------------------------


def _verify_tree(folder: Path, how: _How, findings: Findings) -> None:
    try:
        source, entries = TreeFlights.found(folder)
    except InputError as error:
        findings.error("missing", folder, f"{error.what}: {error.got}" if error.got else error.what, ANYTHING)
        return
    findings.facts.append(f"structure: a playback tree of {len(entries):,} flights, with {', '.join(source.files)}")
    if how.level != "structure":
        _check_all(source, entries, Context(), replace(how, reader=None), findings)
    for flight in (folder / entry.parts[0] for entry in entries):
        if how.level == "pixels" and (flight / CHECKSUMS).is_file():
            digests = read_digests(flight, findings)
            check_digests(flight, digests, list(digests), findings)


# --- all flights ------------------------------------------------------------------------------------------------------


def _check_all(
    source: FlightSource, entries: list[Entry], context: Context, how: _How, findings: Findings
) -> list[Summary]:
    """Check every flight by several processes, then all against each other; return a summary of each."""
    clean = {e.name.rpartition("/")[0]: e for e in entries if e.name.rpartition("/")[2] == ORIGINAL}
    items = []
    for entry in entries:
        twin = clean.get(entry.name.rpartition("/")[0])
        job = (entry, None if twin is entry else twin)
        items.append(Item(entry.name, job, entry.num_rows if how.level == "pixels" and entry.num_rows else None))
    flights = []
    with tempfile.TemporaryDirectory(prefix="cosfly-verify-") as place:
        stage = StageFolder.open(Path(place) / "verify", "verify", config=Config(), inputs={}, seed=0)
        started = (source, how.level, context, how.reader)
        done = run_items(stage, items, make_worker, started, workers=how.workers, watch=how.watch, label="verify")
        for record in done.records:
            if isinstance(record, Kept):
                findings.merge(record.result["findings"])
                if record.result["summary"] is not None:
                    flights.append(Summary(**record.result["summary"]))
            elif isinstance(record, Failed):
                findings.error("not_checked", record.id, record.message, "a flight that can be checked")
        check_across(flights, by_town=context.by_town, both=context.both, findings=findings)
    words = f"labels and verdicts {'recomputed' if how.reader is not None else 'not recomputed'}"
    pictures = f", all their {', '.join(source.files)} pictures" if how.level == "pixels" else ""
    num_rows = sum(flight.num_rows for flight in flights)
    findings.facts.append(f"{num_rows:,} rows of {len(flights):,} flights{pictures}; {words}")
    return flights
