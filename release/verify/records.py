"""`release.json`, the card and the shards' footers: do they agree with each other, and does what is counted twice give one number?"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.boxes import UNKNOWN_LICENCE
from cosfly.products.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.reading.files import read_bytes
from cosfly.reading.tables import open_table
from cosfly.work.stage_folder import flattened
from release import columns
from release.card.croissant import CROISSANT, render_croissant
from release.card.numbers import compute_numbers
from release.card.render import render_card
from release.depth import SKY_MM
from release.record import DepthCoding, ReleaseRecord, content_digest, shard_path
from release.rules import RULE, select_frames
from release.verify.across import Summary, frames_digest
from release.verify.findings import Findings

HALF_STEP = 2.0**-11  # of float16, of a number
MOST_FRAMES = 2**31  # of a flight: their indices are int32


def check_record(record: ReleaseRecord, findings: Findings) -> None:
    """Check what release.json says against itself and against what every release says."""
    _check_contract(record, findings)
    _check_sums(record, findings)
    _check_shards(record, findings)
    _check_splits(record, findings)
    _check_provenance(record, findings)
    _check_maps(record, findings)


def _differ(findings: Findings, code: str, name: str, got: object, expected: object) -> None:
    if got != expected:
        findings.error(code, f"release.json: {name}", got, str(expected))


def _check_contract(record: ReleaseRecord, findings: Findings) -> None:
    """The convention of axes is one for all releases, and readers go by it."""
    for name in sorted(record.coordinates.keys() | columns.CONTRACT.keys()):
        _differ(findings, "coordinates", f"coordinates.{name}", record.coordinates.get(name), columns.CONTRACT.get(name))  # fmt: skip
    _differ(findings, "rule", "frame_selection", record.frame_selection, RULE)
    if (record.depth is not None) != ("depth" in record.settings.modalities):
        findings.error("depth_coding", "release.json: depth", record.depth, "how depth is stored exactly where it is released")  # fmt: skip
    elif record.depth is not None:
        is_png = record.depth.coding == "millimetre_png"
        told = {
            "unit": "millimetre" if is_png else "metre",
            "sky": SKY_MM if is_png else SKY_DEPTH_M,
            "invalid": INVALID_DEPTH_M,
        }
        for name, value in told.items():
            _differ(findings, "depth_coding", f"depth.{name}", getattr(record.depth, name), value)
        _check_coding_error(record.depth, findings)


def _check_coding_error(depth: DepthCoding, findings: Findings) -> None:
    """The error of a coding is at most its rounding: none of float32, half a step of millimetres, of float16 a share of the greatest depth."""
    most_m = {"float32": 0.0, "millimetre_png": 0.5e-3, "float16": (depth.max_m or 0.0) * HALF_STEP}[depth.coding]
    if not 0.0 <= depth.max_error_m <= most_m * (1.0 + 1e-3) + 1e-5 * bool(most_m):
        findings.error("depth_coding", "release.json: depth.max_error_m", depth.max_error_m, f"at most {most_m:g} m")


def _check_sums(record: ReleaseRecord, findings: Findings) -> None:
    """What the shards cannot tell must at least add up."""
    planned, flights, captions = record.history.trajectories, record.history.flights, record.history.captions
    sums = [
        ("flights.found", flights.found, flights.released + sum(flights.left_out.values())),
        ("flights.released", flights.released, record.numbers.flights),
        ("captions.read", captions.read, captions.accepted + sum(captions.dropped.values())),
        ("captions.accepted", captions.accepted,
         captions.released + captions.frame_not_selected + captions.window_not_whole + captions.flight_left_out),
        ("captions.released", captions.released, record.numbers.captions.frames_with),
    ]  # fmt: skip
    if planned is not None:
        sums += [
            ("trajectories.planned", planned.planned, sum(planned.dropped.values()) + planned.not_rendered + planned.rendered),
            ("trajectories.rendered", planned.rendered, planned.accepted + planned.review + planned.rejected),
        ]  # fmt: skip
    for name, whole, parts in sums:
        if whole != parts:
            findings.error("sum", f"release.json: history.{name}", whole, f"{parts}, the sum of its parts")
    for name, value in flattened(record.history.model_dump()).items():
        if isinstance(value, int) and value < 0:
            findings.error("sum", f"release.json: history.{name}", value, "0 or more")


def _check_shards(record: ReleaseRecord, findings: Findings) -> None:
    """Shards are named by the digest of their content and their number in their split."""
    _differ(findings, "digest", "content_digest", record.content_digest, content_digest((s.split, s.sha256) for s in record.shards))  # fmt: skip
    counts = Counter(shard.split for shard in record.shards)
    numbers: Counter[str] = Counter()
    for shard in record.shards:
        expected = shard_path(shard.split, record.content_digest, numbers[shard.split], counts[shard.split])
        numbers[shard.split] += 1
        if shard.path != expected:
            findings.error("shard_name", f"release.json: {shard.path}", shard.path, f"{expected}, of split, digest and number")  # fmt: skip
    _differ(findings, "sum", "numbers.frames", record.numbers.frames, sum(shard.rows for shard in record.shards))
    _differ(findings, "sum", "numbers.frames", record.numbers.frames, sum(flight.frames for flight in record.flights))
    _differ(findings, "sum", "numbers.flights", record.numbers.flights, len(record.flights))


def _check_splits(record: ReleaseRecord, findings: Findings) -> None:
    """Each split's numbers are those of the flights and shards that the record lists."""
    for name in sorted({*record.splits.splits, *(flight.split for flight in record.flights)}):
        told = record.splits.splits.get(name)
        flights = [flight for flight in record.flights if flight.split == name]
        if told is None:
            findings.error("split", f"release.json: splits.{name}", "nothing", f"numbers of {len(flights)} flights")
            continue
        counted = {
            "frames": sum(flight.frames for flight in flights),
            "flights": len(flights),
            "trajectories": len({flight.flight.rpartition("/")[0] for flight in flights}),
            "walks": sorted({flight.walk for flight in flights}),
            "towns": sorted({flight.flight.split("/")[1] for flight in flights if flight.flight.count("/") == 3}),
        }
        for key, value in counted.items():
            own = getattr(told, key)
            _differ(findings, "split", f"splits.{name}.{key}", sorted(own) if isinstance(own, list) else own, value)
        _differ(findings, "split", f"splits.{name}.frames", told.frames, sum(s.rows for s in record.shards if s.split == name))  # fmt: skip
    total = sum(split.captions for split in record.splits.splits.values())
    _differ(findings, "split", "splits: captions", total, record.numbers.captions.frames_with)


def _check_provenance(record: ReleaseRecord, findings: Findings) -> None:
    """Who was asked and what was repaired agrees with the captions that are released."""
    told, captions, history = record.provenance, record.numbers.captions, record.history.captions
    repairs = told.repairs
    _differ(findings, "provenance", "provenance.repairs.accepted", repairs.accepted, history.accepted)
    _differ(findings, "provenance", "provenance.repairs", repairs.first_answers + sum(repairs.repaired_by_rung.values()), repairs.accepted)  # fmt: skip
    for name, share in repairs.shares.items():
        count = repairs.first_answers if name == "first_answers" else repairs.repaired_by_rung.get(name.removeprefix("repaired: "), 0)  # fmt: skip
        if abs(share - count / max(repairs.accepted, 1)) > 1e-3:
            findings.error("provenance", f"release.json: provenance.repairs.shares.{name}", share, f"{count / max(repairs.accepted, 1):.4f}")  # fmt: skip
    _differ(
        findings, "provenance", "provenance.teachers: captions", sum(t.captions for t in told.teachers), history.read
    )
    for column, attribute in (("teacher_kind", "kind"), ("teacher_model", "model")):
        known = {getattr(teacher, attribute) for teacher in told.teachers}
        for name, count in captions.frames_by[column].items():
            if name not in known:
                findings.error("provenance", f"release.json: numbers.captions.frames_by.{column}", f"{name}: {count}", f"a teacher of the provenance: {', '.join(sorted(known))}")  # fmt: skip
            elif count > sum(t.captions for t in told.teachers if getattr(t, attribute) == name):
                findings.error("provenance", f"release.json: provenance.teachers: {name}", f"{count} released", "no more than were read")  # fmt: skip
    runs = {source.run for source in told.sources}
    for flight in record.flights:
        run = flight.flight.split("/")[0]
        if not any(run == own or run.startswith(f"{own}_") for own in runs):
            findings.error("provenance", f"release.json: flights: {flight.flight}", run, f"a run of the sources: {', '.join(sorted(runs))}")  # fmt: skip
            break
    if any(count < 0 for count in (*told.tokens.values(), told.asks)):
        findings.error("provenance", "release.json: provenance.tokens", told.tokens, "0 or more")
    _differ(findings, "provenance", "made_by", record.made_by, f"cosfly {told.versions.get('cosfly')}")


def _check_maps(record: ReleaseRecord, findings: Findings) -> None:
    """Every town has a map, and what the stages that made the maps say of licence and credits stands there."""
    towns, shown = set(record.numbers.frames_by.town), {town.town for town in record.maps}
    for town in sorted(towns - shown):
        findings.error(
            "licence", f"release.json: maps: {town}", "no map", "name, licence and credits of each town's map"
        )
    for one in record.maps:
        if not one.licence or not one.name:
            findings.error("licence", f"release.json: maps: {one.town}", repr(one.licence), "a name and a licence")
    if not record.licence or record.licence == UNKNOWN_LICENCE:
        findings.error("licence", "release.json: licence", repr(record.licence), "the licence of the data set")
    named = " ".join((record.credits, *(f"{town.licence} {town.credits}" for town in record.maps)))
    for key, words in _said_of_maps(record):
        if words not in named:
            findings.error("licence", f"release.json: provenance: maps: {key}", words, f"the same {key} in `maps` or `credits`")  # fmt: skip


def _said_of_maps(record: ReleaseRecord) -> Iterator[tuple[str, str]]:
    """Yield licence and credits that the settings of the stages that made maps name, of the source that was used."""
    for source in record.provenance.sources:
        for stage in source.stages:
            chosen = stage.config.get(str(stage.config.get("source")))
            if stage.stage != "maps" or not isinstance(chosen, dict):
                continue
            for key in ("licence", "credits"):
                if isinstance(chosen.get(key), str) and chosen[key] and chosen[key] != UNKNOWN_LICENCE:
                    yield key, chosen[key]


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
        has_features = (schema.metadata or {}).get(b"huggingface") == expected.metadata[b"huggingface"]
        if not schema.equals(expected) or not has_features:
            wrong = ", ".join(m.name for m in schema if m not in list(expected))
            findings.error("columns", name, wrong or "the order, or the features in the metadata", "the columns of the release")  # fmt: skip
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
    findings.facts.append(f"{len(computed):,} numbers computed again from {len(paths):,} shards")


def check_flights(record: ReleaseRecord, flights: list[Summary], findings: Findings) -> None:
    """Compare the record's flights with those of the rows: which frames, which split, walk and pair."""
    listed, found = {entry.flight: entry for entry in record.flights}, {flight.name: flight for flight in flights}
    for name in sorted(listed.keys() ^ found.keys()):
        findings.error("flight", name, "only in one of release.json and the shards", "the same flights in both")
    for name in sorted(listed.keys() & found.keys()):
        entry, flight = listed[name], found[name]
        for key in ("split", "walk", "pair"):
            if getattr(entry, key) != getattr(flight, key):
                findings.error("flight", f"{name}: {key}", getattr(flight, key), f"{getattr(entry, key)}, as in release.json")  # fmt: skip
        asked, available = record.settings, entry.frames_available
        wanted = available if asked.num_frames is None else min(available, asked.num_frames)
        is_right = wanted == flight.num_rows == entry.frames and 0 < available <= MOST_FRAMES
        if is_right:
            rule = select_frames(available, asked.num_frames, asked.window_frames, asked.uniform_stride)
            is_right = flight.frames_digest == frames_digest(rule)
        if not is_right:
            got = f"{flight.num_rows} of {available} frames, first {flight.first_frames}"
            findings.error("frames", name, got, f"{wanted} frames by the rule of release.json")
