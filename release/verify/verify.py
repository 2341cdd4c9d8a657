"""`cosfly release verify`: check a folder against its records and recompute what is cheap to recompute.

    structure   names, sizes, links, records against each other and against the shards' footers, the card
    rows        every row: schema, geometry, labels, values; splits and pairs; every number of the card
    pixels      checksums of all files; every picture: masks, boxes, and reprojection into the next frame

A release, or a playback tree, ours or the public one. `sha256sum -c checksums.sha256` checks an export.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosfly.formats.shown_captions import CaptionReader
from cosfly.geometry.splits import town_family
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, open_file, read_bytes, read_checksums, sha256_file
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, Kept, StageFolder, flattened
from cosfly.runtime.tables import open_table
from cosfly.runtime.worker import Item
from release import columns
from release.card.ceilings import ceilings_of
from release.card.numbers import numbers_of
from release.card.render import render_card
from release.columns import SPLIT_NAMES
from release.counting import TrackCount, frames_digest
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
from release.verify.findings import Findings, Verified
from release.verify.sources import ShardTracks, TrackSource, sample_prefixes, tracks_of_tree
from release.verify.tracks import SENSELESS, Context, Level, make_worker

CEILINGS_DIFFER = 0.03  # another machine rounds otherwise, and a network's fit goes another way
ALLOWED = (".git", ".gitattributes", ".cache", ".huggingface")  # what the hub and its client put next to a data set
# Files that may be there and are in no list: the text of a licence, and a signature over the list itself.
UNLISTED = ("LICENSE", "LICENSE.txt", "LICENSE.md", f"{CHECKSUMS}.sig")
RECORDS = ("README.md", RECORD, CHECKSUMS)
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
    reader: recomputes labels, verdicts and values; None: they are not recomputed."""
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


# --- files ------------------------------------------------------------------------------------------------------------


def files_below(folder: Path) -> Iterator[str]:
    """Yield the names of everything that is no folder, and of empty folders, relative; links to folders are not
    followed."""
    for place, folders, names in os.walk(folder, followlinks=False):
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
    """Compare the files that are there with those that should be; return those of the right size.

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
                found[name] = os.fstat(file.fileno()).st_size
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a regular file of the folder")
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


def _check_checksums(folder: Path, record: ReleaseRecord, good: Sequence[str], findings: Findings) -> dict[str, str]:
    """Compare the list of checksums with release.json and with the records; return it."""
    try:
        digests = read_checksums(folder)
        for name in {*RECORDS, *digests} & {*good} - {CHECKSUMS} - {file.path for file in record.files}:
            _compare(findings, "checksum", name, sha256_file(folder / name, tree=folder), digests.get(name))
    except InputError as error:
        findings.error("checksum", CHECKSUMS, error.got or error.what, "lines in the format of sha256sum")
        return {}
    listed = {file.path: file.sha256 for file in record.files}
    listed |= {name: digests.get(name, "a digest") for name in RECORDS if name != CHECKSUMS}
    _compare_all(findings, "checksum", CHECKSUMS, digests, listed)
    return digests


def _compare(findings: Findings, code: str, where: str, got: Any, expected: Any) -> None:
    if got != expected:
        findings.error(code, where, got, str(expected))


def _compare_all(findings: Findings, code: str, where: str, got: Mapping, expected: Mapping) -> None:
    for name in sorted({*got, *expected}):
        _compare(findings, code, f"{where}: {name}", got.get(name), expected.get(name))


def check_footers(folder: Path, record: ReleaseRecord, names: list[str], findings: Findings) -> list[str]:
    """Open every parquet file; return those that have the columns and number of rows of the release."""
    frames, points = columns.schema(record.settings.modalities), columns.points_schema()
    expected = {shard.path: (shard.rows, frames) for shard in record.shards}
    expected |= {shard.points.path: (shard.points.rows, points) for shard in record.shards}
    good = []
    for name in (name for name in names if name in expected):
        rows, wanted = expected[name]
        try:
            with open_table(folder / name, tree=folder) as table:
                schema, num_rows = table.schema_arrow, table.metadata.num_rows
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a parquet file")
            continue
        if schema != wanted or schema.metadata != wanted.metadata:
            wrong = ", ".join(m.name for m in schema if m not in list(wanted))
            got = wrong or "another order, or other features in the metadata"
            findings.error("columns", name, got, "the columns of the release")
        elif num_rows != rows:
            findings.error("rows", name, num_rows, str(rows))
        else:
            good.append(name)
    return good


def check_card(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """Check that the card is the one that release.json gives, to the letter."""
    try:
        found = read_bytes(folder / "README.md", what="card", tree=folder).decode(errors="replace").split("\n")
        wanted = render_card(record).split("\n")
    except (InputError, KeyError, ValueError, IndexError) as error:  # also a record whose numbers make no card
        findings.error("card", "README.md", f"{type(error).__name__}: {error}", "the card that release.json gives")
        return
    for number, (line, expected) in enumerate(itertools.zip_longest(found, wanted, fillvalue="the end"), 1):
        if line != expected:
            findings.error("card", f"README.md:{number}", repr(line[:120]), repr(expected[:120]))


# --- release.json against itself and against the rows -----------------------------------------------------------------


def check_record(record: ReleaseRecord, findings: Findings) -> None:
    """Compare release.json with what every release says, and with what follows from its other parts."""
    shards, flights, history, told = record.shards, record.flights, record.history, record.splits
    captions, of_captions = history.captions, record.numbers.captions
    names = shard_paths([shard.split for shard in shards], record.content_digest)
    frames_of = {split: sum(s.rows for s in shards if s.split == split) for split in told.splits}
    expected: dict[str, tuple[Any, Any]] = {
        "frame_selection": (record.frame_selection, RULES[record.settings.selection]),
        "depth": (record.depth, StoredDepth() if "depth" in record.settings.modalities else None),
        "content_digest": (record.content_digest, digest_of(shards)),
        "shards": ([shard.path for shard in shards], [f"{FRAMES_FOLDER}/{name}" for name in names]),
        "points": ([shard.points.path for shard in shards], [f"{POINTS_FOLDER}/{name}" for name in names]),
        "numbers.frames": (record.numbers.frames, sum(flight.frames for flight in flights)),
        "numbers.flights": (record.numbers.flights, len(flights)),
        "history.flights.found": (
            history.flights.found, history.flights.released + sum(history.flights.left_out.values())
        ),
        "history.flights.released": (history.flights.released, len(flights)),
        "history.captions.read": (captions.read, captions.accepted + sum(captions.dropped.values())),
        "history.captions.accepted": (
            captions.accepted, captions.released + captions.frame_not_selected + captions.flight_left_out
        ),
        "history.captions.released": (captions.released, of_captions.frames_with),
        "history.captions.frames_without": (sum(captions.frames_without.values()), of_captions.frames_without),
        "splits": (told.splits, numbers_of_splits(flights, {name: own.captions for name, own in told.splits.items()})),
        "splits.frames": ({name: own.frames for name, own in told.splits.items()}, frames_of),
        "splits.captions": (sum(own.captions for own in told.splits.values()), of_captions.frames_with),
        "maps": ({one.town for one in record.maps} >= {*record.numbers.frames_by.town}, True),
    }  # fmt: skip
    for name, (got, wanted) in expected.items():
        _compare(findings, "record", f"{RECORD}: {name}", got, wanted)
    _compare_all(findings, "record", f"{RECORD}: coordinates", record.coordinates, columns.CONTRACT)
    shares = told.fractions
    if told.rule != SPLIT_RULE or shares.keys() != set(SPLIT_NAMES) or not all(0 <= x <= 1 for x in shares.values()):
        findings.error("rule", f"{RECORD}: splits", f"{told.rule} {shares}", f"{SPLIT_RULE}, three fractions")
    elif flights:
        group_of = {one.flight: one.walk if told.by == "walk" else town_family(one.town) for one in flights}
        splits = split_groups(group_of.values(), shares, told.seed, f"{told.by}s")
        for one in flights:
            _compare(findings, "split", f"{one.flight}: split", one.split, splits[group_of[one.flight]])


def check_tracks(record: ReleaseRecord, tracks: Sequence[TrackCount], findings: Findings) -> None:
    """Compare the tracks of the rows with release.json and with each other: frames, splits, pairs."""
    listed, found = {entry.flight: entry for entry in record.flights}, {track.name: track for track in tracks}
    if len(found) < len(tracks):
        findings.error("flight", RECORD, f"{len(tracks) - len(found)} tracks in two places", "each track once")
    for name in sorted(listed.keys() ^ found.keys()):
        findings.error("flight", name, "an entry in only one of release.json and the shards", "the same tracks in both")
    asked, groups = record.settings, defaultdict[tuple[str, str], set[str]](set)
    for name, track in found.items():
        town = town_family(track.town) if record.splits.by == "town" else None
        for kind, own in (("walk", track.walk), ("trajectory", track.trajectory), ("town", town)):
            if own is not None:
                groups[kind, own].add(str(track.split))
        twin = found.get(track.pair or "")
        is_pair = twin is not None and (twin.pair, twin.trajectory) == (name, track.trajectory)
        if track.pair is not None and (twin is None or not is_pair or twin.track == track.track):
            findings.error("pair", name, track.pair, "the other track of the trajectory, whose pair is this track")
        elif track.pair is None and asked.pairs == "both" and len(asked.tracks) == 2:
            findings.error("pair", name, "no other track", "both tracks (settings.pairs)")
        if (entry := listed.get(name)) is None:
            continue
        for key in ("split", "walk", "pair"):
            _compare(findings, "flight", f"{name}: {key}", getattr(track, key), getattr(entry, key))
        rule = select_frames(track.points, asked.num_frames, asked.selection, asked.window_frames)
        is_right = (len(rule), track.points) == (entry.frames, entry.frames_available)
        if not is_right or track.frames_digest != frames_digest(rule):
            expected = f"{len(rule)} of {entry.frames_available} frames, selected by the rule in release.json"
            findings.error("frames", name, f"{track.frames} frames, {track.points} points", expected)
    for (kind, own), splits in groups.items():
        if len(splits) > 1:
            findings.error("leak", f"{kind} {own}", f"in {', '.join(sorted(splits))}", f"each {kind} in one split")


def check_numbers(folder: Path, record: ReleaseRecord, tracks: Sequence[TrackCount], findings: Findings) -> None:
    """Compute every number of the card again and compare."""
    computed = flattened(numbers_of(tracks, folder, record.shards, record.settings.num_frames).model_dump())
    _compare_all(findings, "number", f"{RECORD}: numbers", flattened(record.numbers.model_dump()), computed)
    if record.ceilings is not None:
        told, again = (one.model_dump() for one in (record.ceilings, ceilings_of(folder, record)))
        for name, value in again.items():
            is_near = isinstance(value, float) and abs((told[name] or 0.0) - value) <= CEILINGS_DIFFER
            if not is_near:
                _compare(findings, "number", f"{RECORD}: ceilings.{name}", told[name], value)
    findings.facts.append(f"{len(computed):,} numbers recomputed from {len(record.shards):,} shards")


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
    digests = _check_checksums(folder, record, good, findings)
    check_record(record, findings)
    readable = check_footers(folder, record, good, findings)
    check_card(folder, record, findings)
    findings.facts.append(
        f"structure: {len(record.shards):,} shards with {record.numbers.frames:,} frames in release.json"
    )
    if how.level == "structure":
        return
    if len(readable) < len(record.files):
        expected_shards = "all shards, so that rows can be checked"
        findings.add("note", "not_checked", "data", "shards that are missing or have other columns", expected_shards)
        return
    ids, files = sample_prefixes([one.flight for one in record.flights]), tuple(record.settings.modalities)
    sources = {shard.path: ShardTracks(folder, shard, files, ids) for shard in record.shards}
    rows = {shard.path: shard.rows for shard in record.shards}
    by_shard = _check_all(sources, rows, Context.of_record(record), digests, how, findings)
    tracks = [track for shard in record.shards for track in by_shard.get(shard.path, [])]
    for shard in record.shards:
        for track in by_shard.get(shard.path, []):
            if track.split != shard.split:
                findings.error("leak", track.name, f"rows of {track.split} in {shard.path}", f"rows of {shard.split}")
    check_tracks(record, tracks, findings)
    try:
        check_numbers(folder, record, tracks, findings)
    except (InputError, *SENSELESS) as error:  # rows that no number comes of, which are found above
        got = f"{type(error).__name__}: {error}"
        findings.error("number", f"{RECORD}: numbers", got, "rows whose numbers can be computed")


# --- a playback tree --------------------------------------------------------------------------------------------------


def _verify_tree(folder: Path, how: _How, findings: Findings) -> None:
    try:
        sources = tracks_of_tree(folder)
    except InputError as error:
        findings.error("missing", folder, f"{error.what}: {error.got}" if error.got else error.what, ANYTHING)
        return
    files = ", ".join(sources[0].files)
    findings.facts.append(f"structure: a playback tree of {len(sources):,} tracks, with {files}")
    if how.level != "structure":
        without_labels = _How(how.level, None, how.workers, how.watch)
        _check_all({source.name: source for source in sources}, {}, Context(), {}, without_labels, findings)
    for track in (folder / source.folder for source in sources) if how.level == "pixels" else ():
        if (track / CHECKSUMS).is_file():
            _check_track_files(track, findings)


def _check_track_files(track: Path, findings: Findings) -> None:
    """Compare the files of a track of a tree with its list of checksums."""
    try:
        for name, digest in read_checksums(track).items():
            _compare(findings, "checksum", f"{track.name}/{name}", sha256_file(track / name, tree=track), digest)
    except InputError as error:
        findings.error("checksum", str(error.where or track), error.got or error.what, "files as in the list")


# --- all tracks -------------------------------------------------------------------------------------------------------


def _check_all(
    sources: Mapping[str, TrackSource],
    rows: Mapping[str, int],
    context: Context,
    digests: Mapping[str, str],
    how: _How,
    findings: Findings,
) -> dict[str, list[TrackCount]]:
    """Check the tracks of every source by several processes; return their counts by the name of the source."""
    items = [Item(name, source, rows.get(name) if how.level == "pixels" else None) for name, source in sources.items()]
    counts: dict[str, list[TrackCount]] = {}
    with tempfile.TemporaryDirectory(prefix="cosfly-verify-") as place:
        stage = StageFolder.open(Path(place) / "verify", "verify", config=Config(), inputs={}, seed=0)
        started = (how.level, context, how.reader, digests)
        done = run_items(stage, items, make_worker, started, workers=how.workers, watch=how.watch, label="verify")
        for record in done.records:
            if isinstance(record, Kept):
                findings.merge(record.result["findings"])
                counts[record.id] = [TrackCount.model_validate(one) for one in record.result["counts"]]
            elif isinstance(record, Failed):
                findings.error("not_checked", record.id, record.message, "tracks that can be checked")
    tracks = [track for own in counts.values() for track in own]
    words = f"labels, verdicts and values of captions {'recomputed' if how.reader is not None else 'not recomputed'}"
    pictures = ", all their pictures" if how.level == "pixels" else ""
    findings.facts.append(
        f"{sum(track.frames for track in tracks):,} rows of {len(tracks):,} tracks{pictures}; {words}"
    )
    return counts
