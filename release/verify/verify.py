"""`cosfly release verify`: check a release against its records and recompute what is cheap to recompute.

    structure   names, sizes, links, records against each other and against the shards' footers, the card
    rows        every row: schema, geometry, labels, values; splits and pairs; every number of the card
    pixels      checksums of all files; every picture: masks, boxes, and reprojection into the next frame

`cosfly inspect` checks a playback tree, `sha256sum -c checksums.sha256` an export.
"""

import itertools
import os
import tempfile
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from cosfly.formats.shown_captions import CaptionReader
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, open_file, read_bytes, read_checksums, sha256_file
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, Kept, StageFolder, flattened
from cosfly.runtime.tables import open_table
from cosfly.runtime.worker import Item
from release import columns
from release.card.render import render_card
from release.columns import SPLIT_NAMES
from release.counting import TrackCount, frames_digest, numbers_of
from release.record import RECORD, ReleaseRecord, numbers_of_splits, read_record, release_folder, shard_paths
from release.rules import SPLIT_RULE, select_frames, split_flights, stated_rules
from release.verify.findings import Findings, Kind
from release.verify.tracks import SENSELESS, Context, Level, make_worker

ALLOWED = (".git", ".gitattributes", ".cache", ".huggingface")  # what the hub and its client put next to a data set
# Files that may be there and are in no list: the text of a licence, and a signature over the list itself.
UNLISTED = ("LICENSE", "LICENSE.txt", "LICENSE.md", f"{CHECKSUMS}.sig")
RECORDS = ("README.md", RECORD)


def verify(
    folder: Path, *,
    level: Level = "pixels", workers: int = 0, reader: CaptionReader | None = None, watch: Watch = Watch(),
) -> Findings:  # fmt: skip
    """Check a release, also of a release stage or a run.

    Args:
        workers: Processes; 0 works in this one. reader: Recomputes labels, verdicts and values; None: they are not
            recomputed.
    """
    findings = Findings(level=level)
    folder = release_folder(folder)
    try:
        record = read_record(folder / RECORD)
    except InputError as error:
        where = str(error.where).replace(f"{folder}/", "")
        findings.error("record", where, error.got or error.what, error.expected or "a release record")
        return findings
    usable = check_names(folder, record, findings)
    digests = check_checksums(folder, record, usable, findings)
    check_record(record, findings)
    check_card(folder, record, findings)
    findings.facts.append(f"structure: {len(record.shards):,} shards, {record.numbers.frames:,} frames in release.json")
    if level != "pixels":
        findings.facts.append("the bytes of the shards are not compared with their checksums; --level pixels does")
    is_whole = check_footers(folder, record, usable, findings)
    if level == "structure" or not is_whole:  # the rows of a release that is not whole are not checked
        return findings
    context = Context(folder, record, level, reader, digests)
    tracks = _check_shards(context, record, workers, watch, findings)
    check_tracks(record, tracks, findings)
    try:
        check_numbers(record, tracks, findings)
    except (InputError, *SENSELESS) as error:  # from rows that are reported above
        got = f"{type(error).__name__}: {error}"
        findings.error("number", f"{RECORD}: numbers", got, "rows whose numbers can be computed")
    return findings


def _check_shards(
    context: Context, record: ReleaseRecord, workers: int, watch: Watch, findings: Findings
) -> list[TrackCount]:
    """Check the tracks of every shard by several processes; return their counts in the order of the shards."""
    has_pictures = context.level == "pixels"
    items = [Item(shard.path, shard, shard.rows if has_pictures else None) for shard in record.shards]
    tracks: list[TrackCount] = []
    with tempfile.TemporaryDirectory(prefix="cosfly-verify-") as temporary:
        stage = StageFolder.open(Path(temporary) / "verify", "verify", config=Config(), inputs={}, seed=0)
        done = run_items(stage, items, make_worker, (context,), workers=workers, watch=watch, label="verify")
        for shard_record in done.records:
            if isinstance(shard_record, Kept):
                findings.merge(map(Kind.model_validate, shard_record.result["findings"]))
                tracks += map(TrackCount.model_validate, shard_record.result["counts"])
            elif isinstance(shard_record, Failed):
                findings.error("not_checked", shard_record.id, shard_record.message, "tracks that can be checked")
    words = f"labels, verdicts and values of captions {'' if context.reader else 'not '}recomputed"
    pictures = ", all their pictures" if has_pictures else ""
    num_rows = sum(track.frames for track in tracks)
    findings.facts.append(f"{num_rows:,} rows of {len(tracks):,} tracks{pictures}; {words}")
    return tracks


# --- files ------------------------------------------------------------------------------------------------------------


def check_names(folder: Path, record: ReleaseRecord, findings: Findings) -> set[str]:
    """Compare the files with those of the record, following no link to a folder; return those of the right size."""
    expected: dict[str, int | None] = dict.fromkeys((*RECORDS, CHECKSUMS))  # name -> size, None: any
    expected |= {file.path: file.bytes for file in record.files}
    sizes = dict[str, int]()
    present = set[str]()
    usable = set[str]()
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.split("/")[0] in ALLOWED or (path.is_dir() and not path.is_symlink()):
            continue
        present.add(name)
        if name not in (*expected, *UNLISTED):
            findings.error("unexpected", name, "a file that no record lists", "only recorded files")
            continue
        try:
            with open_file(path, tree=folder) as file:
                sizes[name] = os.fstat(file.fileno()).st_size
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a regular file of the folder")
            continue
        if expected.get(name) in (None, sizes[name]):
            usable.add(name)
        else:
            findings.error("size", name, f"{sizes[name]:,} bytes", f"{expected[name]:,} bytes")
    for name in sorted(expected.keys() - present):
        findings.error("missing", name, "no such file", "a file of the release")
    findings.facts.append(f"{len(sizes):,} files, {sum(sizes.values()):,} bytes")
    return usable


def check_checksums(folder: Path, record: ReleaseRecord, usable: Collection[str], findings: Findings) -> dict[str, str]:
    """Compare the list of checksums with release.json, and with the records, which are hashed; return it."""
    try:
        listed = read_checksums(folder)
        expected = {file.path: file.sha256 for file in record.files}
        expected |= {name: sha256_file(folder / name, tree=folder) for name in RECORDS if name in usable}
    except InputError as error:
        findings.error("checksum", CHECKSUMS, error.got or error.what, "lines in the format of sha256sum")
        return {}
    findings.compare("checksum", CHECKSUMS, listed, expected)
    return listed


def check_footers(folder: Path, record: ReleaseRecord, usable: Collection[str], findings: Findings) -> bool:
    """Open every usable parquet file; return whether all files of the record have the columns and number of rows of the
    release, and each is listed once."""
    schemas = dict.fromkeys((shard.points.path for shard in record.shards), columns.points_schema())
    schemas |= dict.fromkeys((shard.path for shard in record.shards), columns.schema(record.settings.modalities))
    num_right = 0
    for file in record.files:
        if file.path not in usable:
            continue
        expected = schemas[file.path]
        try:
            with open_table(folder / file.path, tree=folder) as table:
                schema, num_rows = table.schema_arrow, table.metadata.num_rows
        except InputError as error:
            findings.error("unreadable", file.path, error.got or error.what, "a parquet file")
            continue
        if schema != expected or schema.metadata != expected.metadata:
            wrong = ", ".join(column.name for column in schema if column not in list(expected))
            got = wrong or "another order, or other features in the metadata"
            findings.error("columns", file.path, got, "the columns of the release")
        elif num_rows != file.rows:
            findings.error("rows", file.path, num_rows, str(file.rows))
        else:
            num_right += 1
    return num_right == len(record.files) == len({file.path for file in record.files})


def check_card(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """Check that the card is the one that release.json gives, to the letter."""
    try:
        lines = read_bytes(folder / "README.md", what="card", tree=folder).decode(errors="replace").split("\n")
        expected_lines = render_card(record).split("\n")
    except (InputError, KeyError, ValueError, IndexError) as error:  # also a record whose numbers make no card
        findings.error("card", "README.md", f"{type(error).__name__}: {error}", "the card that release.json gives")
        return
    for number, (got, expected) in enumerate(itertools.zip_longest(lines, expected_lines, fillvalue="the end"), 1):
        if got != expected:
            findings.error("card", f"README.md:{number}", repr(got[:120]), repr(expected[:120]))


# --- release.json against itself and against the rows -----------------------------------------------------------------


def check_record(record: ReleaseRecord, findings: Findings) -> None:
    """Compare release.json with what every release states, and with what follows from its other parts."""
    shards, flights, history, stated = record.shards, record.flights, record.history, record.splits
    captions, num_captions = history.captions, record.numbers.of("flags")["has_caption"]
    paths = shard_paths([shard.split for shard in shards], record.content_digest)
    num_accepted = captions.released + captions.frame_not_selected + captions.flight_left_out
    by_split = {name: split.captions for name, split in stated.splits.items()}
    # What is compared -> the value in the record, the value that follows from the rest.
    values: dict[str, tuple[Any, Any]] = {
        **{name: (getattr(record, name), rule) for name, rule in stated_rules(record.settings, shards).items()},
        "shards": ([(shard.path, shard.points.path) for shard in shards], paths),
        "flights found": (history.flights.found, len(flights) + sum(history.flights.left_out.values())),
        "flights released": (history.flights.released, len(flights)),
        "captions read": (captions.read, num_accepted + sum(captions.dropped.values())),
        "captions released": (captions.released, num_captions),
        "frames without": (sum(captions.frames_without.values()), record.numbers.frames - num_captions),
        "splits": (stated.splits, numbers_of_splits(flights, by_split)),
        "captions of splits": (sum(by_split.values()), num_captions),
        "maps": ({town_map.town for town_map in record.maps} >= {*record.numbers.counts.get("town", ())}, True),
        "rule of splits": (stated.rule, SPLIT_RULE),
    }  # fmt: skip
    for name, (got, expected) in values.items():
        findings.compare("record", f"{RECORD}: {name}", got, expected)
    shares = stated.fractions
    if shares.keys() != {*SPLIT_NAMES} or not all(0 <= share <= 1 for share in shares.values()):
        findings.error("record", f"{RECORD}: fractions of splits", shares, "three fractions")
    elif flights:
        walk_and_town = {track.flight: (track.walk, track.town) for track in flights}
        splits = split_flights(walk_and_town, stated.by, shares, stated.seed)
        findings.compare("split", RECORD, {track.flight: track.split for track in flights}, splits)


def check_tracks(record: ReleaseRecord, tracks: Sequence[TrackCount], findings: Findings) -> None:
    """Compare the tracks of the rows with release.json, whose splits are checked, and with each other in pairs."""
    by_name, settings = {track.name: track for track in tracks}, record.settings
    num_tracks = Counter(track.trajectory for track in by_name.values())  # of each trajectory
    if len(by_name) < len(tracks):
        findings.error("flight", RECORD, f"{len(tracks) - len(by_name)} tracks in two places", "each track once")
    findings.compare("flight", RECORD, sorted(by_name), sorted(entry.flight for entry in record.flights))
    for entry in record.flights:
        if (track := by_name.get(entry.flight)) is None:
            continue
        for key in ("split", "walk", "pair"):
            findings.compare("flight", f"{track.name}: {key}", getattr(track, key), getattr(entry, key))
        twin = by_name.get(track.pair or "")
        if track.pair is None:
            may_be_alone = settings.pairs == "any" or len(settings.tracks) < 2
            is_right = num_tracks[track.trajectory] == 1 and may_be_alone
            expected = "both tracks, each the pair of the other, or one track where settings.pairs is any"
        else:
            is_right = twin is not None and _is_pair(track, twin)
            expected = "the other track of the trajectory, of the same split, whose pair is this track"
        if not is_right:
            findings.error("pair", track.name, track.pair, expected)
        indices = select_frames(track.points, settings.num_frames, settings.selection, settings.window_frames)
        is_right = (len(indices), track.points) == (entry.frames, entry.frames_available)
        if not is_right or track.frames_digest != frames_digest(indices):
            expected = f"{len(indices)} of {entry.frames_available} frames, selected by the rule in release.json"
            findings.error("frames", track.name, f"{track.frames} frames, {track.points} points", expected)


def _is_pair(track: TrackCount, twin: TrackCount) -> bool:
    """Return whether two tracks are those of one trajectory, in one split, and `twin` names the other as its pair."""
    is_same = (track.trajectory, track.split, track.walk) == (twin.trajectory, twin.split, twin.walk)
    return is_same and twin.pair == track.name and twin.track != track.track


def check_numbers(record: ReleaseRecord, tracks: Sequence[TrackCount], findings: Findings) -> None:
    """Compute every number of the card again and compare."""
    computed = flattened(numbers_of(tracks, record.settings.num_frames).model_dump())
    findings.compare("number", f"{RECORD}: numbers", flattened(record.numbers.model_dump()), computed)
    findings.facts.append(f"{len(computed):,} numbers recomputed from {len(record.shards):,} shards")
