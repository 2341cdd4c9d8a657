"""`cosfly release verify`: check a folder against its records and recompute what is cheap to recompute.

    structure   names, sizes, links, records against each other and against the shards' footers, the card
    rows        every row: schema, geometry, labels; splits and pairs; every number of the card
    pixels      checksums of all files; every picture: masks, boxes, and reprojection into the next frame

A release, or a playback tree, ours or the public one. `sha256sum -c checksums.sha256` checks an export.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosfly.formats.playback import ORIGINAL
from cosfly.formats.shown_captions import CaptionReader
from cosfly.geometry.splits import town_family
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import CHECKSUMS, open_file, read_bytes, read_checksums, sha256_file
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, Kept, StageFolder, flattened
from cosfly.runtime.tables import open_table
from cosfly.runtime.worker import Item
from release import columns
from release.card.ceilings import ceilings_of
from release.card.croissant import CROISSANT, render_croissant
from release.card.numbers import compute_numbers
from release.card.render import render_card
from release.columns import SPLIT_NAMES
from release.record import (
    FRAMES_FOLDER,
    POINTS_FOLDER,
    RECORD,
    ReleaseRecord,
    StoredDepth,
    digest_of,
    numbers_of_splits,
    read_record,
    release_folder,
    shard_paths,
)
from release.rules import RULES, SPLIT_RULE, select_frames, split_groups
from release.verify.across import Summary, check_across, frames_digest
from release.verify.findings import Findings, Verified
from release.verify.flights import SENSELESS, Context, Level, make_worker
from release.verify.sources import Entry, FlightSource, Shards, TreeFlights

CEILINGS_DIFFER = 0.03  # another machine rounds otherwise, and a network's fit goes another way


def check_record(record: ReleaseRecord, findings: Findings) -> None:
    """Check what release.json says against itself and against what every release says."""
    told = [*_contract(record), *_sums(record), *_shards(record), *_splits(record)]
    for code, name, got, expected in told:
        if got != expected:
            findings.error(code, f"release.json: {name}", got, str(expected))
    _check_split_rule(record, findings)


Comparison = tuple[str, str, object, object]  # code, name, got, expected


def _contract(record: ReleaseRecord) -> Iterator[Comparison]:
    """Return the convention of axes is one for all releases, and readers go by it."""
    for name in sorted(record.coordinates.keys() | columns.CONTRACT.keys()):
        yield "coordinates", f"coordinates.{name}", record.coordinates.get(name), columns.CONTRACT.get(name)
    yield "rule", "frame_selection", record.frame_selection, RULES[record.settings.selection]
    yield "depth_coding", "depth", record.depth is not None, "depth" in record.settings.modalities
    if record.depth is not None:
        yield "depth_coding", "depth", record.depth, StoredDepth()


def _sums(record: ReleaseRecord) -> Iterator[Comparison]:
    """What the shards cannot tell must at least add up."""
    flights, captions = record.history.flights, record.history.captions
    gone = captions.frame_not_selected + captions.flight_left_out
    sums = [
        ("flights.found", flights.found, flights.released + sum(flights.left_out.values())),
        ("flights.released", flights.released, record.numbers.flights),
        ("captions.read", captions.read, captions.accepted + sum(captions.dropped.values())),
        ("captions.accepted", captions.accepted, captions.released + gone),
        ("captions.released", captions.released, record.numbers.captions.frames_with),
        ("captions.frames_without", sum(captions.frames_without.values()), record.numbers.captions.frames_without),
    ]
    yield from (("sum", f"history.{name}", whole, parts) for name, whole, parts in sums)


def _shards(record: ReleaseRecord) -> Iterator[Comparison]:
    """Shards are named by the digest of their content and their number in their split."""
    yield "digest", "content_digest", record.content_digest, digest_of(record.shards)
    names = shard_paths([shard.split for shard in record.shards], record.content_digest)
    for shard, name in zip(record.shards, names, strict=True):
        yield "shard_name", shard.path, shard.path, f"{FRAMES_FOLDER}/{name}"
        yield "shard_name", shard.points.path, shard.points.path, f"{POINTS_FOLDER}/{name}"
    yield "sum", "numbers.frames", record.numbers.frames, sum(shard.rows for shard in record.shards)
    yield "sum", "numbers.frames", record.numbers.frames, sum(flight.frames for flight in record.flights)
    yield "sum", "numbers.flights", record.numbers.flights, len(record.flights)


def _splits(record: ReleaseRecord) -> Iterator[Comparison]:
    """Each split's numbers are those of the flights and shards that the record lists."""
    told = record.splits.splits
    counted = numbers_of_splits(record.flights, {name: own.captions for name, own in told.items()})
    for name in sorted(told.keys() | counted.keys()):
        yield "split", f"splits.{name}", told.get(name), counted.get(name)
        frames = told[name].frames if name in told else 0
        yield "split", f"splits.{name}.frames", frames, sum(s.rows for s in record.shards if s.split == name)
    for town in sorted(set(record.numbers.frames_by.town) - {one.town for one in record.maps}):
        yield "licence", f"maps: {town}", None, "name, licence and credits of the town's map"
    total = sum(split.captions for split in record.splits.splits.values())
    yield "split", "splits: captions", total, record.numbers.captions.frames_with


def _check_split_rule(record: ReleaseRecord, findings: Findings) -> None:
    """Hand out the splits again by the seed of the record."""
    asked, shares = record.splits, record.splits.fractions
    if asked.rule != SPLIT_RULE or shares.keys() != set(SPLIT_NAMES) or not all(0 <= x <= 1 for x in shares.values()):
        findings.error("rule", "release.json: splits", f"{asked.rule} {shares}", f"{SPLIT_RULE}, three fractions")
    elif record.flights:
        group_of = {one.flight: one.walk if asked.by == "walk" else town_family(one.town) for one in record.flights}
        splits = split_groups(group_of.values(), shares, asked.seed, f"{asked.by}s")
        for one in (one for one in record.flights if one.split != splits[group_of[one.flight]]):
            expected = f"{splits[group_of[one.flight]]}, by seed {asked.seed}"
            findings.error("split", f"{one.flight}: split", one.split, expected)


# --- the card and the shards ------------------------------------------------------------------------------------------


def check_card(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """The card must be the one that release.json gives, to the letter."""
    try:
        found = read_bytes(folder / "README.md", what="card", tree=folder).decode(errors="replace").split("\n")
    except InputError as error:
        findings.error("card", "README.md", error.got or error.what, "the card")
        return
    try:
        croissant = render_croissant(record).encode()
        if (folder / CROISSANT).is_file() and read_bytes(folder / CROISSANT, tree=folder) != croissant:
            findings.error("card", CROISSANT, "a different text", "the text that release.json determines")
        wanted = render_card(record).split("\n")
    except (InputError, KeyError, ValueError, IndexError) as error:  # a record whose numbers make no card
        findings.error(
            "card", "README.md", f"{type(error).__name__}: {error}", "a release.json that determines the card"
        )
        return
    for number, (line, expected) in enumerate(itertools.zip_longest(found, wanted, fillvalue="the end"), 1):
        if line != expected:
            findings.error("card", f"README.md:{number}", repr(line[:120]), repr(expected[:120]))


def check_footers(folder: Path, record: ReleaseRecord, names: list[str], findings: Findings) -> list[str]:
    """Open every shard; give those that have the release's columns and number of rows."""
    rows, good = {file.path: file.rows for file in record.files}, []
    schemas = {shard.path: columns.schema(record.settings.modalities) for shard in record.shards}
    for name in (name for name in names if name in rows):
        expected = schemas.get(name, columns.points_schema())
        try:
            with open_table(folder / name, tree=folder) as table:
                schema, num_rows = table.schema_arrow, table.metadata.num_rows
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a parquet file")
            continue
        if schema != expected or schema.metadata != expected.metadata:
            wrong = ", ".join(m.name for m in schema if m not in list(expected))
            got = wrong or "another order, or other features in the metadata"
            findings.error("columns", name, got, "the columns of the release")
        elif num_rows != rows[name]:
            findings.error("rows", name, num_rows, str(rows[name]))
        else:
            good.append(name)
    return good


def check_numbers(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """Compute every number again and compare."""
    paths = [folder / shard.path for shard in record.shards]
    computed = flattened(compute_numbers(paths, record.settings.num_frames).model_dump())
    written = flattened(record.numbers.model_dump())
    for name in sorted(computed.keys() | written.keys()):
        if computed.get(name) != written.get(name):
            findings.error("number", f"release.json: numbers.{name}", written.get(name), f"{computed.get(name)}")
    if record.ceilings is not None:
        told, again = (one.model_dump() for one in (record.ceilings, ceilings_of(folder, record)))
        for name in (n for n in told if not _is_near(told[n], again[n])):
            findings.error("number", f"release.json: ceilings.{name}", told[name], f"{again[name]}")
    findings.facts.append(f"{len(computed):,} numbers recomputed from {len(paths):,} shards")


def _is_near(told: Any, again: Any) -> bool:
    are_shares = isinstance(told, float) and isinstance(again, float)
    return told == again or (are_shares and abs(told - again) <= CEILINGS_DIFFER)


def check_flights(record: ReleaseRecord, flights: list[Summary], findings: Findings) -> None:
    """Compare the record's flights with those of the rows: which frames, which split, walk and pair."""
    listed, found = {entry.flight: entry for entry in record.flights}, {flight.name: flight for flight in flights}
    for name in sorted(listed.keys() ^ found.keys()):
        findings.error("flight", name, "an entry in only one of release.json and the shards", "the same tracks in both")
    for name in sorted(listed.keys() & found.keys()):
        entry, flight, asked = listed[name], found[name], record.settings
        for key in ("split", "walk", "pair"):
            got, told = getattr(flight, key), getattr(entry, key)
            if got != told:
                findings.error("flight", f"{name}: {key}", got, f"{told}, as in release.json")
        rule = select_frames(flight.num_points, asked.num_frames, asked.selection, asked.window_frames)
        is_right = len(rule) == entry.frames and flight.num_points == entry.frames_available
        if not is_right or flight.frames_digest != frames_digest(rule):
            got = f"{flight.num_rows} frames, {flight.num_points} points"
            expected = f"{len(rule)} of {entry.frames_available} frames, selected by the rule in release.json"
            findings.error("frames", name, got, expected)


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
            got = "an empty folder" if name.endswith("/") else "a file that no record lists"
            findings.error("unexpected", name, got, "only recorded files")
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
        findings.error("checksum", CHECKSUMS, error.got or error.what, "lines in the format of sha256sum")
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
    expected: dict[str, int | None] = dict.fromkeys(RECORDS) | {file.path: file.bytes for file in record.files}
    good = check_names(folder, expected, findings)
    digests = read_digests(folder, findings)
    _check_lists(record, digests, findings)
    small = [name for name in good if (folder / name).stat().st_size <= SMALL_BYTES and name in RECORDS]
    check_digests(folder, digests, small, findings)
    check_record(record, findings)
    readable = check_footers(folder, record, good, findings)
    check_card(folder, record, findings)
    findings.facts.append(
        f"structure: {len(record.shards):,} shards with {record.numbers.frames:,} frames in release.json"
    )
    if how.level != "structure" and len(readable) < len(record.files):
        findings.add(
            "note",
            "not_checked",
            "data",
            "shards that are missing or have other columns",
            "all shards, so that rows can be checked",
        )
    elif how.level != "structure":
        _verify_rows(folder, record, how, findings)
    if how.level == "pixels":
        check_digests(folder, digests, [name for name in good if name not in small], findings)


def _check_lists(record: ReleaseRecord, digests: dict[str, str], findings: Findings) -> None:
    """The list of checksums and release.json name the same files with the same digests."""
    listed = dict.fromkeys(set(RECORDS) - {CHECKSUMS}) | {file.path: file.sha256 for file in record.files}
    for name in sorted(listed.keys() | digests.keys()):
        if name not in listed or digests.get(name) != (listed[name] or digests.get(name, "")):
            got = f"{shown(digests.get(name))} in {CHECKSUMS}, {shown(listed.get(name))} in release.json"
            findings.error(
                "checksum", f"{CHECKSUMS}: {name}", got, "one line per file, with the digest in release.json"
            )


def _verify_rows(folder: Path, record: ReleaseRecord, how: _How, findings: Findings) -> None:
    """Check rows, and at level `pixels` pictures, of a release whose shards are all there and have its columns."""
    source = Shards(folder, tuple(record.settings.modalities))
    try:
        entries = source.entries(record.shards)
    except InputError as error:
        findings.error("unreadable", str(error.where).replace(f"{folder}/", ""), error.got or error.what, "rows")
        return
    flights = _check_all(source, entries, Context.of_record(record), how, findings)
    check_flights(record, flights, findings)
    split_of, splits = {shard.path: shard.split for shard in record.shards}, {one.name: one.split for one in flights}
    for name, shard in ((entry.name, part[0]) for entry in entries for part in entry.parts):
        if splits.get(name, split_of[shard]) != split_of[shard]:
            findings.error("leak", name, f"rows of {splits[name]} in {shard}", f"rows of {split_of[shard]}")
    try:
        check_numbers(folder, record, findings)
    except (InputError, *SENSELESS) as error:  # rows that no number comes of, which are found above
        findings.error(
            "number", "release.json: numbers", f"{type(error).__name__}: {error}", "rows whose numbers can be computed"
        )


# --- a playback tree --------------------------------------------------------------------------------------------------


def _verify_tree(folder: Path, how: _How, findings: Findings) -> None:
    try:
        source, entries = TreeFlights.found(folder)
    except InputError as error:
        findings.error("missing", folder, f"{error.what}: {error.got}" if error.got else error.what, ANYTHING)
        return
    findings.facts.append(f"structure: a playback tree of {len(entries):,} tracks, with {', '.join(source.files)}")
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
                findings.error("not_checked", record.id, record.message, "a track that can be checked")
        check_across(flights, by_town=context.by_town, both=context.both, findings=findings)
    words = f"labels and verdicts {'recomputed' if how.reader is not None else 'not recomputed'}"
    pictures = f", all their {', '.join(source.files)} pictures" if how.level == "pixels" else ""
    num_rows = sum(flight.num_rows for flight in flights)
    findings.facts.append(f"{num_rows:,} rows of {len(flights):,} tracks{pictures}; {words}")
    return flights
