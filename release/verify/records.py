"""Check `release.json`, the card and the shards' footers against each other, and compute the numbers again."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosfly.errors import InputError
from cosfly.products.splits import town_family
from cosfly.reading.files import read_bytes
from cosfly.reading.tables import open_table
from cosfly.work.stage_folder import flattened
from release import columns
from release.card.ceilings import ceilings_of
from release.card.croissant import CROISSANT, render_croissant
from release.card.numbers import compute_numbers
from release.card.render import render_card
from release.columns import SPLIT_NAMES
from release.record import ReleaseRecord, StoredDepth, content_digest, numbers_of_splits, shard_paths
from release.rules import RULE, SPLIT_RULE, select_frames, split_groups
from release.verify.across import Summary, frames_digest
from release.verify.findings import Findings

CEILINGS_DIFFER = 0.03  # another machine rounds otherwise, and a network's fit goes another way
MOST_FRAMES = 2**31  # of a flight: their indices are int32


def check_record(record: ReleaseRecord, findings: Findings) -> None:
    """Check what release.json says against itself and against what every release says."""
    told = [*_contract(record), *_sums(record), *_shards(record), *_splits(record)]
    for code, name, got, expected in told:
        if got != expected:
            findings.error(code, f"release.json: {name}", got, str(expected))
    _check_split_rule(record, findings)


Comparison = tuple[str, str, object, object]  # code, name, got, expected


def _contract(record: ReleaseRecord) -> Iterator[Comparison]:
    """The convention of axes is one for all releases, and readers go by it."""
    for name in sorted(record.coordinates.keys() | columns.CONTRACT.keys()):
        yield "coordinates", f"coordinates.{name}", record.coordinates.get(name), columns.CONTRACT.get(name)
    yield "rule", "frame_selection", record.frame_selection, RULE
    yield "depth_coding", "depth", record.depth is not None, "depth" in record.settings.modalities
    if record.depth is not None:
        yield "depth_coding", "depth", record.depth, StoredDepth()


def _sums(record: ReleaseRecord) -> Iterator[Comparison]:
    """What the shards cannot tell must at least add up."""
    flights, captions = record.history.flights, record.history.captions
    gone = captions.frame_not_selected + captions.window_not_whole + captions.flight_left_out
    sums = [
        ("flights.found", flights.found, flights.released + sum(flights.left_out.values())),
        ("flights.released", flights.released, record.numbers.flights),
        ("captions.read", captions.read, captions.accepted + sum(captions.dropped.values())),
        ("captions.accepted", captions.accepted, captions.released + gone),
        ("captions.released", captions.released, record.numbers.captions.frames_with),
    ]
    yield from (("sum", f"history.{name}", whole, parts) for name, whole, parts in sums)


def _shards(record: ReleaseRecord) -> Iterator[Comparison]:
    """Shards are named by the digest of their content and their number in their split."""
    digest = content_digest((shard.split, shard.sha256) for shard in record.shards)
    yield "digest", "content_digest", record.content_digest, digest
    names = shard_paths([shard.split for shard in record.shards], record.content_digest)
    for shard, name in zip(record.shards, names, strict=True):
        yield "shard_name", shard.path, shard.path, name
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
            findings.error("card", CROISSANT, "other words", "what release.json gives")
        wanted = render_card(record).split("\n")
    except (InputError, KeyError, ValueError, IndexError) as error:  # a record whose numbers make no card
        findings.error("card", "README.md", f"{type(error).__name__}: {error}", "a card that release.json gives")
        return
    for number, (line, expected) in enumerate(itertools.zip_longest(found, wanted, fillvalue="the end"), 1):
        if line != expected:
            findings.error("card", f"README.md:{number}", repr(line[:120]), repr(expected[:120]))


def check_footers(folder: Path, record: ReleaseRecord, names: list[str], findings: Findings) -> list[str]:
    """Open every shard; give those that have the release's columns and number of rows."""
    rows = {entry.path: entry.rows for entry in record.shards}
    expected = columns.schema(record.settings.modalities)
    good = []
    for name in (name for name in names if name in rows):
        try:
            with open_table(folder / name, tree=folder) as table:
                schema, num_rows = table.schema_arrow, table.metadata.num_rows
        except InputError as error:
            findings.error("unreadable", name, error.got or error.what, "a parquet file")
            continue
        if not schema.equals(expected, check_metadata=True):
            wrong = ", ".join(m.name for m in schema if m not in list(expected))
            got = wrong or "the order, or the features in the metadata"
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
    findings.facts.append(f"{len(computed):,} numbers computed again from {len(paths):,} shards")


def _is_near(told: Any, again: Any) -> bool:
    are_shares = isinstance(told, float) and isinstance(again, float)
    return told == again or (are_shares and abs(told - again) <= CEILINGS_DIFFER)


def check_flights(record: ReleaseRecord, flights: list[Summary], findings: Findings) -> None:
    """Compare the record's flights with those of the rows: which frames, which split, walk and pair."""
    listed, found = {entry.flight: entry for entry in record.flights}, {flight.name: flight for flight in flights}
    for name in sorted(listed.keys() ^ found.keys()):
        findings.error("flight", name, "only in one of release.json and the shards", "the same flights in both")
    for name in sorted(listed.keys() & found.keys()):
        entry, flight, asked = listed[name], found[name], record.settings
        for key in ("split", "walk", "pair"):
            got, told = getattr(flight, key), getattr(entry, key)
            if got != told:
                findings.error("flight", f"{name}: {key}", got, f"{told}, as in release.json")
        available = entry.frames_available
        wanted = available if asked.num_frames is None else min(available, asked.num_frames)
        is_right = wanted == flight.num_rows == entry.frames and 0 < available <= MOST_FRAMES
        if is_right:
            rule = select_frames(available, asked.num_frames, asked.window_frames, asked.uniform_stride)
            is_right = flight.frames_digest == frames_digest(rule)
        if not is_right:
            got = f"{flight.num_rows} of {available} frames"
            findings.error("frames", name, got, f"{wanted} frames by the rule of release.json")
