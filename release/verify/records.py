"""`release.json`, the card and the shards' footers: do they agree with each other, and does what is counted twice give
one number?"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cosfly.errors import InputError
from cosfly.products.boxes import UNKNOWN_LICENCE
from cosfly.products.frames import FILE_NAMES
from cosfly.reading.files import read_bytes
from cosfly.reading.tables import arrow_errors, open_table, read_row_group
from cosfly.work.stage_folder import flattened
from release import columns
from release.card.ceilings import ceilings_of
from release.card.croissant import CROISSANT, render_croissant
from release.card.numbers import compute_numbers
from release.card.render import render_card
from release.columns import PICTURES, SCALAR_NAMES
from release.depth import depth_record
from release.record import DepthCoding, ReleaseRecord, content_digest, numbers_of_splits, shard_paths
from release.rules import RULE, select_frames
from release.verify.across import Summary, frames_digest
from release.verify.findings import Findings

MOST_FRAMES = 2**31  # of a flight: their indices are int32
HALF_STEP = 2.0**-11  # of float16, of a number
SHARE = 1e-3  # of captions: rounded to four digits
CEILINGS_DIFFER = 0.03  # another machine rounds otherwise, and a network's fit goes another way


def check_record(record: ReleaseRecord, findings: Findings) -> None:
    """Check what release.json says against itself and against what every release says."""
    told = [*_contract(record), *_sums(record), *_shards(record), *_splits(record), *_provenance(record)]
    for code, name, got, expected in told:
        if got != expected:
            findings.error(code, f"release.json: {name}", got, str(expected))
    _check_signs(record, findings)
    if record.depth is not None:
        _check_coding_error(record.depth, findings)
    _check_teachers(record, findings)
    _check_maps(record, findings)


Comparison = tuple[str, str, object, object]  # code, name, got, expected


def _contract(record: ReleaseRecord) -> Iterator[Comparison]:
    """The convention of axes is one for all releases, and readers go by it."""
    for name in sorted(record.coordinates.keys() | columns.CONTRACT.keys()):
        yield "coordinates", f"coordinates.{name}", record.coordinates.get(name), columns.CONTRACT.get(name)
    yield "rule", "frame_selection", record.frame_selection, RULE
    yield "depth_coding", "depth", record.depth is not None, "depth" in record.settings.modalities
    if record.depth is not None:
        coded = depth_record(record.depth.coding, ())
        for name in ("unit", "sky", "invalid"):
            yield "depth_coding", f"depth.{name}", getattr(record.depth, name), getattr(coded, name)


def _check_coding_error(depth: DepthCoding, findings: Findings) -> None:
    """The error of a coding is at most its rounding: none of float32, half a step of millimetres, of float16 a share of
    the greatest depth."""
    most_m = {"float32": 0.0, "millimetre_png": 0.5e-3, "float16": (depth.max_m or 0.0) * HALF_STEP}[depth.coding]
    if not 0.0 <= depth.max_error_m <= most_m * (1.0 + 1e-3) + 1e-5 * bool(most_m):
        findings.error("depth_coding", "release.json: depth.max_error_m", depth.max_error_m, f"at most {most_m:g} m")


def _sums(record: ReleaseRecord) -> Iterator[Comparison]:
    """What the shards cannot tell must at least add up."""
    planned, flights, captions = record.history.trajectories, record.history.flights, record.history.captions
    gone = captions.frame_not_selected + captions.window_not_whole + captions.flight_left_out
    sums = [
        ("flights.found", flights.found, flights.released + sum(flights.left_out.values())),
        ("flights.released", flights.released, record.numbers.flights),
        ("captions.read", captions.read, captions.accepted + sum(captions.dropped.values())),
        ("captions.accepted", captions.accepted, captions.released + gone),
        ("captions.released", captions.released, record.numbers.captions.frames_with),
    ]
    if planned is not None:
        not_planned = sum(planned.dropped.values()) + planned.not_rendered
        sums.append(("trajectories.planned", planned.planned, not_planned + planned.rendered))
        results = planned.accepted + planned.review + planned.rejected
        sums.append(("trajectories.rendered", planned.rendered, results))
    yield from (("sum", f"history.{name}", whole, parts) for name, whole, parts in sums)


def _check_signs(record: ReleaseRecord, findings: Findings) -> None:
    counts = {
        "history": record.history.model_dump(),
        "provenance": {"tokens": record.provenance.tokens, "asks": record.provenance.asks},
    }
    for name, value in flattened(counts).items():
        if isinstance(value, int) and value < 0:
            findings.error("sum", f"release.json: {name}", value, "0 or more")


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
        one, other = (vars(numbers[name]) if name in numbers else {} for numbers in (told, counted))
        for key in sorted(one.keys() | other.keys()):
            got = one.get(key)
            yield "split", f"splits.{name}.{key}", sorted(got) if isinstance(got, list) else got, other.get(key)
        rows = sum(shard.rows for shard in record.shards if shard.split == name)
        yield "split", f"splits.{name}.frames", one.get("frames", 0), rows
    total = sum(split.captions for split in record.splits.splits.values())
    yield "split", "splits: captions", total, record.numbers.captions.frames_with


def _provenance(record: ReleaseRecord) -> Iterator[Comparison]:
    """What was repaired and asked agrees with the captions that are released."""
    told, history, repairs = record.provenance, record.history.captions, record.provenance.repairs
    counts = {
        "first_answers": repairs.first_answers,
        **{f"repaired: {k}": n for k, n in repairs.repaired_by_rung.items()},
    }
    yield "provenance", "provenance.repairs.accepted", repairs.accepted, history.accepted
    yield "provenance", "provenance.repairs", sum(counts.values()), repairs.accepted
    for name, share in repairs.shares.items():
        own = counts.get(name, 0) / max(repairs.accepted, 1)
        yield "provenance", f"provenance.repairs.shares.{name}", share, share if abs(share - own) <= SHARE else own
    yield "provenance", "provenance.teachers: captions", sum(t.captions for t in told.teachers), history.read
    yield "provenance", "made_by", record.made_by, f"cosfly {told.versions.get('cosfly')}"


def _check_teachers(record: ReleaseRecord, findings: Findings) -> None:
    """Whoever made a released caption was asked, and every flight is of a source."""
    told, captions = record.provenance, record.numbers.captions
    for column, attribute in (("teacher_kind", "kind"), ("teacher_model", "model")):
        asked = Counter[str]()
        for teacher in told.teachers:
            asked[getattr(teacher, attribute)] += teacher.captions
        for name, count in captions.frames_by[column].items():
            if name not in asked or count > asked[name]:
                expected = f"no more than the provenance's teachers read: {dict(sorted(asked.items()))}"
                where = f"release.json: numbers.captions.frames_by.{column}"
                findings.error("provenance", where, f"{name}: {count}", expected)
    for flight in record.flights:
        run = flight.flight.split("/")[0]
        if not any(source.has(run) for source in told.sources):
            expected = f"a run of the sources: {', '.join(sorted(source.run for source in told.sources))}"
            findings.error("provenance", f"release.json: flights: {flight.flight}", run, expected)
            break


def _check_maps(record: ReleaseRecord, findings: Findings) -> None:
    """Every town has a map, and what the stages that made the maps say of licence and credits stands there."""
    for town in sorted(set(record.numbers.frames_by.town) - {one.town for one in record.maps}):
        expected = "name, licence and credits of each town's map"
        findings.error("licence", f"release.json: maps: {town}", "no map", expected)
    for one in record.maps:
        if not one.licence or not one.name:
            findings.error("licence", f"release.json: maps: {one.town}", repr(one.licence), "a name and a licence")
    if record.licence in ("", UNKNOWN_LICENCE):
        findings.error("licence", "release.json: licence", repr(record.licence), "the licence of the data set")
    named = " ".join((record.credits, *(f"{town.licence} {town.credits}" for town in record.maps)))
    stages = (stage for source in record.provenance.sources for stage in source.stages if stage.stage == "maps")
    for config in (stage.config for stage in stages):
        chosen = config.get(str(config.get("source")))  # of the source that was used
        for key in ("licence", "credits"):
            words = chosen.get(key) if isinstance(chosen, dict) else None
            if isinstance(words, str) and words != UNKNOWN_LICENCE and words not in named:
                expected = f"the same {key} in `maps` or `credits`"
                findings.error("licence", f"release.json: provenance: maps: {key}", words, expected)


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
        if (
            not schema.equals(expected)
            or (schema.metadata or {}).get(b"huggingface") != expected.metadata[b"huggingface"]
        ):
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
    asked, num_cut, num_absent = record.settings, 0, 0
    for name in sorted(listed.keys() & found.keys()):
        entry, flight = listed[name], found[name]
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
            w = asked.window_frames - 1
            num_whole = np.count_nonzero(rule[w:] - rule[: len(rule) - w] == w)
            num_cut += int(np.count_nonzero(rule >= w)) - int(num_whole)
            num_absent += available - len(rule)
        if not is_right:
            got = f"{flight.num_rows} of {available} frames, first {flight.first_frames}"
            findings.error("frames", name, got, f"{wanted} frames by the rule of release.json")
    captions = record.history.captions
    for name, most in (("window_not_whole", num_cut), ("frame_not_selected", num_absent)):
        if (told := getattr(captions, name)) > most:
            expected = f"at most {most}, the frames that a caption could have lost by the choice of frames"
            findings.error("sum", f"release.json: history.captions.{name}", told, expected)


def check_shards(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """Check what a shard says of its rows beside them: the least and greatest value of each column, the names of
    pictures, who wrote it.

    Programs go by these without a look at the rows: a filter skips what the statistics exclude, a viewer shows the
    name.

    Raises:
        InputError: a shard cannot be read.
    """
    named = {PICTURES[file].name: FILE_NAMES[file] for file in record.settings.modalities if file != "depth"}
    writers = set()
    for shard in record.shards:
        path = folder / shard.path
        with open_table(path, tree=folder) as table:
            writers.add(str(table.metadata.created_by))
            for k in range(table.num_row_groups):
                rows = read_row_group(path, table, k, [*SCALAR_NAMES, *(f"{column}.path" for column in named)])
                with arrow_errors(path):
                    about = table.metadata.row_group(k)
                    for j in range(about.num_columns):
                        _check_statistics(f"{shard.path}: row group {k}", about.column(j), rows, findings)
                    ids = rows.column("sample_id").to_pylist()
                    for column, file in named.items():
                        paths = pc.struct_field(rows.column(column), ["path"]).to_pylist()
                        for own, found in zip(ids, paths, strict=True):  # a picture is called by its row's id
                            if found != f"{own}_{file}":
                                findings.error("name", f"{own}: {column}.path", repr(found), f"{own}_{file}")
    told = record.provenance.versions.get("pyarrow")
    if told and writers and not any(f"version {told}" in one for one in writers):
        # A build that was broken off may have gone on with another version.
        expected = f"that of the shards, {', '.join(sorted(writers))}"
        findings.warn("provenance", "release.json: provenance.versions.pyarrow", told, expected)


def _check_statistics(where: str, chunk: pq.ColumnChunkMetaData, rows: pa.Table, findings: Findings) -> None:
    """All values lie between the footer's least and greatest: rows beyond them would be skipped. Wider bounds cost time
    alone."""
    first, *members = chunk.path_in_schema.split(".")  # `decision`, `pose.x_m`, `caption_window.list.element`
    told = chunk.statistics if chunk.is_stats_set else None
    if told is None or not told.has_min_max or first not in rows.column_names or len(members) > 2:
        return
    values = rows.column(first)
    if members:
        values = pc.list_flatten(values) if members[0] == "list" else pc.struct_field(values, members)
    found = pc.min_max(values).as_py()
    if found["min"] is not None and not told.min <= found["min"] <= found["max"] <= told.max:
        got, expected = (
            f"{told.min!r} to {told.max!r} in the footer",
            f"{found['min']!r} to {found['max']!r}, of the rows",
        )
        findings.error("statistics", f"{where}: {chunk.path_in_schema}", got, expected)
