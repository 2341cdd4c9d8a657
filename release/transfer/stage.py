"""`cosfly release get`: a release, or a part of it, from another place.

Reads release.json and the shards of a release that lies somewhere else; writes `dataset/`, which is a release: all of
it byte for byte, or a part with a record of its own. Of a part only the wanted rows and columns travel.

What is checked: release.json against checksums.sha256 and against itself, and with `expected` against a digest that the
user has from elsewhere; the sha256 of shards that are taken whole; of others the sizes, columns, rows and flights that
the record tells of, and then, as of every release, all that `cosfly release verify` finds in rows. The pictures of a
shard of which a part is taken are bound by no digest.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.compute as pc
from pydantic import BaseModel, Field

from cosfly.errors import InputError, VerifyError, nearest
from cosfly.products.frames import FrameFile
from cosfly.reading.documents import model_of, parse_document
from cosfly.reading.files import open_file, sha256_file
from cosfly.reading.tables import arrow_errors, open_stream, read_row_group, row_groups
from cosfly.work.config import Config
from cosfly.work.runner import Item, Outcome, Watch, Work, advance, run_items
from cosfly.work.stage_folder import Resume, StageFolder, result_of
from cosfly.work.store import (
    CHECKSUMS,
    atomic_file,
    atomic_folder,
    refuse_link,
    sha256_bytes,
    storage_errors,
    write_bytes,
    write_json,
)
from release.card.numbers import compute_numbers
from release.columns import PLACE, SplitName, flight_name, flight_spans, schema
from release.package.records import DATASET, OF_SHARD, PARTS, check_parts, name_shards, write_records
from release.package.rows import open_writer
from release.record import (
    RECORD,
    RELEASE_FORMAT,
    PartOf,
    ReleasedFlight,
    ReleaseRecord,
    Shard,
    content_digest,
    numbers_of_splits,
    shard_paths,
)
from release.sign import MOST_SIGNATURE_BYTES, SIGNATURE
from release.transfer.remote import CHUNK, Remote, RemoteFile, open_remote, published_address
from release.verify.findings import Verified
from release.verify.verify import verify

MOST_RECORD_BYTES = 64_000_000  # some 400 bytes a flight


class Selection(Config):
    """What is wanted of a release; everything by default."""

    towns: tuple[str, ...] = Field((), description="towns; none named: all")
    splits: tuple[SplitName, ...] = Field((), description="train, validation, test; none named: all")
    flights: tuple[str, ...] = Field(
        (), description="flights (run/town/trajectory/variant) or trajectories (run/town/trajectory); none named: all"
    )
    modalities: tuple[FrameFile, ...] | None = Field(
        None, description="pictures: rgb, depth, instance; null: all that the release has; none: rows alone"
    )
    expected: str | None = Field(
        None,
        pattern="^[0-9a-f]{12,64}$",
        description="the content digest that the release must have, 12 characters of it or more",
    )


def fetch_record(remote: Remote, expected: str | None) -> tuple[ReleaseRecord, bytes]:
    """Read `release.json` of a release that lies somewhere else, and see that it can be one.

    Returns:
        the record, and its bytes.
    """
    where = f"{remote.shown}/{RECORD}"
    data = _small_file(remote, RECORD)
    lines = _small_file(remote, CHECKSUMS).decode(errors="replace").splitlines()
    listed = [line[:64] for line in lines if line[64:] == f"  {RECORD}"]
    if listed != [sha256_bytes(data)]:
        raise InputError(
            "release.json is not the one of the checksums",
            where=where,
            got=sha256_bytes(data),
            expected=str(listed)[:80],
        )
    record = model_of(parse_document(data, where, each_key_once=True), ReleaseRecord, RELEASE_FORMAT, where)
    _check_shards(record, where)
    if expected is not None and not record.content_digest.startswith(expected):
        raise InputError("not the release that is expected", where=where, got=record.content_digest, expected=expected)
    return record, data


def _small_file(remote: Remote, name: str) -> bytes:
    size = remote.size(name)
    if size > MOST_RECORD_BYTES:
        where, got = f"{remote.shown}/{name}", f"{size} bytes"
        raise InputError("too large a record", where=where, got=got, expected=f"at most {MOST_RECORD_BYTES}")
    return RemoteFile(remote, name, size).read()


def _check_shards(record: ReleaseRecord, where: str) -> None:
    """See that the names of shards are those that their digests give: no other name is ever asked for or written."""
    digest = content_digest((shard.split, shard.sha256) for shard in record.shards)
    wrong = [] if digest == record.content_digest else [f"content_digest {record.content_digest} and not {digest}"]
    names = shard_paths([shard.split for shard in record.shards], record.content_digest)
    for shard, named in zip(record.shards, names, strict=True):
        if shard.path != named:
            wrong.append(f"{shard.path} and not {named}")
        if shard.bytes < 0 or shard.rows < 0 or len(shard.sha256) != 64:
            wrong.append(f"{shard.path}: {shard.bytes} bytes, {shard.rows} rows")
    if wrong:
        raise InputError("the record contradicts itself", where=f"{where}: shards", got="; ".join(wrong[:10]))


def chosen_flights(record: ReleaseRecord, choice: Selection) -> list[ReleasedFlight]:
    """Give the flights that are wanted, each with its twin."""
    known: dict[str, set[str]] = {
        "towns": {flight.town for flight in record.flights if flight.town},
        "splits": set(map(str, record.splits.splits)),
        "flights": {flight.flight for flight in record.flights} | {f.trajectory for f in record.flights},
        "modalities": set(map(str, record.settings.modalities)),
    }
    for what, names in known.items():
        for name in getattr(choice, what) or ():
            if name not in names:
                there = ", ".join(sorted(names)[:20])
                raise InputError(
                    f"the release has no such {what[:-1]}{nearest(name, names)}", where=what, got=name, expected=there
                )
    found = {
        flight.flight
        for flight in record.flights
        if (not choice.towns or flight.town in choice.towns)
        and (not choice.splits or flight.split in choice.splits)
        and (not choice.flights or {flight.flight, flight.trajectory} & set(choice.flights))
    }
    found |= {flight.pair for flight in record.flights if flight.flight in found and flight.pair is not None}
    if not found:
        raise InputError("no flight is all of that", got=choice.model_dump_json(exclude_defaults=True))
    return [flight for flight in record.flights if flight.flight in found]


log = logging.getLogger(__name__)

Span = tuple[str, int, int]  # a flight, its first row in a row group, and the one after its last
NOT_ASKED_FOR = "not asked for"
ONE_FILE_EACH = ("README.md", "croissant.json", RECORD, CHECKSUMS)  # of a release that is taken whole


class _Asked(Config):
    """What decides the result: the choice, and which release it is of."""

    source: str
    record_sha256: str
    choice: Selection


class _Got(BaseModel):
    """A shard that is here: its rows, captions, flights in their order, and whether it is the whole remote one."""

    rows: int
    captions: int
    flights: dict[str, int]
    bytes: int
    sha256: str


class _Plan(BaseModel):
    """What a worker must know. flights: name -> frames."""

    address: str
    shown: str
    columns: list[str]
    modalities: list[str]
    flights: dict[str, int]


# --- one shard --------------------------------------------------------------------------------------------------------


def make_worker(plan: _Plan, parts: Path) -> Work:
    """Worker factory: give the function that fetches one shard."""
    remote = open_remote(plan.address)

    def work(item: Item) -> Outcome:
        got = fetch_shard(remote, item.payload, parts / Path(item.payload.path).name, plan)
        return Outcome(got.model_dump(), drop_reason=None if got.rows else NOT_ASKED_FOR)

    return work


def fetch_shard(remote: Remote, shard: Shard, path: Path, plan: _Plan) -> _Got:
    """Fetch the wanted part of one shard."""
    where = f"{remote.shown}/{shard.path}"
    if (size := remote.size(shard.path)) != shard.bytes:
        raise InputError(
            "a shard of another size", where=where, got=f"{size} bytes", expected=f"{shard.bytes}, as in release.json"
        )
    wanted = schema(plan.modalities)  # type: ignore[arg-type]
    with open_stream(RemoteFile(remote, shard.path, size), where) as table:
        found = table.schema_arrow
        if found.names != plan.columns or any(found.field(member.name).type != member.type for member in wanted):
            raise InputError("a shard with other columns", where=where, got=", ".join(found.names)[:200])
        if table.metadata.num_rows != shard.rows:
            raise InputError(
                "a shard with other rows", where=where, got=f"{table.metadata.num_rows}", expected=f"{shard.rows}"
            )
        groups = [_spans_in(table, k, where) for k in range(table.num_row_groups)]
        flights = _counted(groups)
        is_whole = wanted.names == found.names and flights.keys() <= plan.flights.keys()
        if not is_whole and flights.keys() & plan.flights.keys():
            return _write_part(table, groups, path, wanted, plan, where)
    if not is_whole:
        return _Got(rows=0, captions=0, flights={}, bytes=0, sha256="")
    digest = _copy(remote, shard, path)
    captions = sum(_captions(group) for group in row_groups(path, ["has_caption"]))
    return _checked(
        _Got(rows=shard.rows, captions=captions, flights=dict(flights), bytes=shard.bytes, sha256=digest), plan, where
    )


def _spans_in(table: pa.parquet.ParquetFile, k: int, where: str) -> list[Span]:
    """Give the flights of a row group, with their rows; reads the columns of their places alone."""
    group = read_row_group(where, table, k, list(PLACE))
    with arrow_errors(where):
        return [(flight_name(place), begin, end) for place, begin, end in flight_spans(group)]


def _write_part(
    table: pa.parquet.ParquetFile, groups: list[list[Span]], path: Path, wanted: pa.Schema, plan: _Plan, where: str
) -> _Got:
    """Read the wanted rows and columns, and write them as a release does."""
    captions = 0
    with atomic_file(path) as file, open_writer(file.name, wanted) as writer:
        for k, spans in enumerate(groups):
            mask = [name in plan.flights for name, begin, end in spans for _ in range(begin, end)]
            if not any(mask):
                continue
            rows = read_row_group(where, table, k, wanted.names)
            with arrow_errors(where):
                rows = rows.filter(pa.array(mask)).select(wanted.names).replace_schema_metadata(wanted.metadata)
                writer.write_table(rows, row_group_size=len(rows))
            captions += _captions(rows)
            advance(len(rows))
    flights = {name: rows for name, rows in _counted(groups).items() if name in plan.flights}
    return _checked(
        _Got(
            rows=sum(flights.values()),
            captions=captions,
            flights=flights,
            bytes=path.stat().st_size,
            sha256=sha256_file(path),
        ),
        plan,
        where,
    )


def _counted(groups: list[list[Span]]) -> Counter[str]:
    """Count the rows of each flight, in the order in which they first stand."""
    flights = Counter[str]()
    for name, begin, end in (span for spans in groups for span in spans):
        flights[name] += end - begin
    return flights


def _captions(rows: pa.Table) -> int:
    return pc.sum(rows.column("has_caption")).as_py() or 0


def _checked(got: _Got, plan: _Plan, where: str) -> _Got:
    wrong = [
        f"{name}: {count} rows and not {plan.flights[name]}"
        for name, count in got.flights.items()
        if count != plan.flights[name]
    ]
    if wrong:
        raise InputError("flights with other rows than the record says", where=where, got="; ".join(wrong[:10]))
    return got


def _copy(remote: Remote, shard: Shard, path: Path) -> str:
    """Copy a whole shard; give its sha256, which is the record's. One that was broken off goes on with the bytes that
    are here.
    """
    begun = path.with_name(f"{path.name}.begun")
    refuse_link(begun)
    here = begun.stat().st_size if begun.is_file() else 0
    for first in sorted({min(here, shard.bytes), 0}, reverse=True):  # anew where what is here is not of this shard
        digest = _copy_from(first, remote, shard, begun)
        if digest == shard.sha256:
            os.replace(begun, path)
            advance(shard.rows)
            return digest
    begun.unlink()
    where = f"{remote.shown}/{shard.path}"
    raise VerifyError("a shard is not the one of the record", where=where, got=digest, expected=shard.sha256)


def _copy_from(first: int, remote: Remote, shard: Shard, begun: Path) -> str:
    """Copy the bytes of a shard from `first` on behind those that are here; give the sha256 of all."""
    digest = hashlib.sha256()
    with storage_errors(begun):
        begun.parent.mkdir(parents=True, exist_ok=True)
        with open(begun, "ab") as file:
            file.truncate(first)
            if first:
                with open_file(begun) as known:
                    digest = hashlib.file_digest(known, "sha256")
            for start in range(first, shard.bytes, CHUNK):
                data = remote.read(shard.path, start, min(CHUNK, shard.bytes - start))
                digest.update(data)
                file.write(data)
                advance(0)
            file.flush()
            os.fsync(file.fileno())
    return digest.hexdigest()


# --- the stage --------------------------------------------------------------------------------------------------------


def run(
    choice: Selection,
    address: str,
    out: Path,
    *,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
    findings: Literal["refuse", "accept"] = "refuse",
) -> Path:
    """Fetch a release or a part of it from a folder or an address; give the folder that holds it.

    Args:
        findings: of what `release verify` finds in its rows. accept: the release is kept as it is, and `findings.json`
        beside it says what.
    """
    remote = open_remote(address)
    record, data = fetch_record(remote, choice.expected)
    flights = chosen_flights(record, choice)
    asked = _Asked(source=remote.shown, record_sha256=sha256_bytes(data), choice=choice)
    stage = StageFolder.open(out, "get", config=asked, inputs={}, seed=0, resume=resume)
    dataset, parts = out / DATASET, out / PARTS
    if stage.is_complete:
        shutil.rmtree(parts, ignore_errors=True)  # a kill came before they were gone
        return dataset
    plan = _plan_of(record, choice, flights, address, remote.shown)
    splits = {flight.split for flight in flights}
    shards = [shard for shard in record.shards if shard.split in splits]
    items = [Item(shard.path, shard, shard.rows) for shard in shards]
    if address.startswith("memory:"):  # of this process alone
        workers = 0
    finished = run_items(stage, items, make_worker, (plan, parts), workers=workers, watch=watch, label="get")
    if finished.tally.failed:
        raise InputError(
            "parts of the release could not be fetched", where=out / "failures.jsonl", got=str(finished.tally),
            fix="mend what that file names and run the same command again: only those are fetched again",
        )  # fmt: skip
    taken = _taken(shards, {kept.id: result_of(kept, _Got) for kept in finished.kept}, flights)
    done = [
        (parts / Path(shard.path).name, shard.model_copy(update=one.model_dump(include=OF_SHARD)))
        for shard, one in taken
    ]
    check_parts(done, out)
    is_whole = len(taken) == len(record.shards) and all(shard.sha256 == one.sha256 for shard, one in taken)
    with atomic_folder(dataset) as folder:
        named = name_shards(done, folder)
        if is_whole:
            _copy_records(remote, folder, data)
            _copy_signature(remote, folder)
        else:
            part = _part_of(record, choice, published_address(remote.shown))
            write_records(folder, part_record(record, part, flights, plan.modalities, named, taken, folder))
        report = verify(folder, level="rows", workers=workers, watch=watch)
        if not report.is_ok and findings == "refuse":
            raise _not_kept(report, remote.shown)
    outputs = [dataset / name for name in ("README.md", RECORD, CHECKSUMS)]
    if not report.is_ok:
        log.warning("%s is kept, and does not verify: %s", dataset, report)
        write_json(out / "findings.json", report.as_json())
        outputs.append(out / "findings.json")
    stage.finish(outputs, finished.tally, whole=is_whole)
    shutil.rmtree(parts, ignore_errors=True)
    return dataset


def _plan_of(
    record: ReleaseRecord, choice: Selection, flights: list[ReleasedFlight], address: str, shown: str
) -> _Plan:
    there = record.settings.modalities
    return _Plan(
        address=address,
        shown=shown,
        columns=schema(there).names,
        modalities=[name for name in there if choice.modalities is None or name in choice.modalities],
        flights={flight.flight: flight.frames for flight in flights},
    )


def _taken(shards: Sequence[Shard], got: Mapping[str, _Got], flights: list[ReleasedFlight]) -> list[tuple[Shard, _Got]]:
    """Put shards beside what is here of them, and see that all flights are."""
    taken = [(shard, got[shard.path]) for shard in shards if shard.path in got]
    found = {name for _, one in taken for name in one.flights}
    if missing := [flight.flight for flight in flights if flight.flight not in found]:
        raise InputError("flights of the record that no shard holds", got=", ".join(missing[:10]))
    return taken


def _not_kept(report: Verified, where: str) -> VerifyError:
    return VerifyError(
        "what was fetched does not verify, so it is not kept", where=where, got=str(report),
        fix="ask who made it; to keep it as it is, with what was found beside it: --findings accept "
        "(nothing is fetched again)",
    )  # fmt: skip


def _copy_records(remote: Remote, folder: Path, record: bytes) -> None:
    for name in ONE_FILE_EACH:
        write_bytes(folder / name, record if name == RECORD else _small_file(remote, name))


def _copy_signature(remote: Remote, folder: Path) -> None:
    """Take the signature along, where there is one; who signed is asked by `release verify --public-key`."""
    try:
        size = remote.size(SIGNATURE)
    except InputError:
        return
    if size <= MOST_SIGNATURE_BYTES:
        write_bytes(folder / SIGNATURE, remote.read(SIGNATURE, 0, size))


def _part_of(record: ReleaseRecord, choice: Selection, source: str) -> PartOf:
    """Say of which release something is a part. The digest that was asked for is of that release, and no part of the
    choice.
    """
    chosen = choice.model_dump(mode="json", exclude={"expected"})
    return PartOf(name=record.name, content_digest=record.content_digest, source=source, choice=chosen)


def part_record(
    record: ReleaseRecord,
    part: PartOf,
    flights: list[ReleasedFlight],
    modalities: list,
    shards: list[Shard],
    taken: Sequence[tuple[Shard, _Got]],
    folder: Path,
) -> ReleaseRecord:
    """Give the record of a part: numbers of what is here; where the rest went is on the account as well."""
    numbers = compute_numbers([folder / shard.path for shard in shards], record.settings.num_frames)
    history = record.history.model_copy(deep=True)
    gone = history.flights.released - len(flights)
    history.flights.released = len(flights)
    if gone:
        history.flights.left_out[NOT_ASKED_FOR] = history.flights.left_out.get(NOT_ASKED_FOR, 0) + gone
    history.captions.flight_left_out += history.captions.released - numbers.captions.frames_with
    history.captions.released = numbers.captions.frames_with
    captions = Counter[str]()
    for shard, got in taken:
        captions[shard.split] += got.captions
    return record.model_copy(
        update={
            "settings": record.settings.model_copy(update={"modalities": modalities}),
            "depth": record.depth if "depth" in modalities else None,
            "splits": record.splits.model_copy(update={"splits": numbers_of_splits(flights, captions)}),
            "numbers": numbers,
            "history": history,
            "flights": flights,
            "content_digest": content_digest((shard.split, shard.sha256) for shard in shards),
            "shards": shards,
            "part_of": part,
            "ceilings": None,
        }
    )
