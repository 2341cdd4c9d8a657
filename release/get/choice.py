"""Which part of a release is wanted, and what its record says of itself that can be trusted before a byte of data is read."""

from __future__ import annotations

from collections import Counter

from pydantic import Field

from cosfly.errors import InputError, nearest
from cosfly.products.frames import FrameFile
from cosfly.reading.documents import check_schema, parse_document, validation_errors
from cosfly.work.config import Config
from cosfly.work.store import CHECKSUMS, sha256_bytes
from release.columns import SplitName
from release.get.remote import Remote
from release.record import (
    RECORD,
    RELEASE_SCHEMA,
    RELEASE_VERSION,
    ReleasedFlight,
    ReleaseRecord,
    content_digest,
    shard_path,
)

MOST_RECORD_BYTES = 256_000_000  # some 400 bytes a flight


class Choice(Config):
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
    Raises:
        InputError: it is none, names other files than a release has, or is not the one that is expected.
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
    value = check_schema(parse_document(data, where, each_key_once=True), RELEASE_SCHEMA, RELEASE_VERSION, where)
    with validation_errors(where):
        record = ReleaseRecord.model_validate({k: v for k, v in value.items() if k not in ("schema", "schema_version")})
    _check_shards(record, where)
    if expected is not None and not record.content_digest.startswith(expected):
        raise InputError("not the release that is expected", where=where, got=record.content_digest, expected=expected)
    return record, data


def _small_file(remote: Remote, name: str) -> bytes:
    size = remote.size(name)
    if size > MOST_RECORD_BYTES:
        raise InputError(
            "too large a record",
            where=f"{remote.shown}/{name}",
            got=f"{size} bytes",
            expected=f"at most {MOST_RECORD_BYTES}",
        )
    return remote.read(name, 0, size)


def _check_shards(record: ReleaseRecord, where: str) -> None:
    """See that the names of shards are those that their digests give: no other name is ever asked for or written."""
    digest = content_digest((shard.split, shard.sha256) for shard in record.shards)
    counts = Counter(shard.split for shard in record.shards)
    numbers: Counter[str] = Counter()
    wrong = [] if digest == record.content_digest else [f"content_digest {record.content_digest} and not {digest}"]
    for shard in record.shards:
        named = shard_path(shard.split, record.content_digest, numbers[shard.split], counts[shard.split])
        numbers[shard.split] += 1
        if shard.path != named:
            wrong.append(f"{shard.path} and not {named}")
        if shard.bytes < 0 or shard.rows < 0 or len(shard.sha256) != 64:
            wrong.append(f"{shard.path}: {shard.bytes} bytes, {shard.rows} rows")
    if wrong:
        raise InputError("the record contradicts itself", where=f"{where}: shards", got="; ".join(wrong[:10]))


def chosen_flights(record: ReleaseRecord, choice: Choice) -> list[ReleasedFlight]:
    """Give the flights that are wanted, each with its twin.

    Raises:
        InputError: a name that the release does not have, or nothing is left; says what there is.
    """
    known: dict[str, set[str]] = {
        "towns": {flight.flight.split("/")[1] for flight in record.flights if flight.flight.count("/") == 3},
        "splits": set(map(str, record.splits.splits)),
        "flights": {flight.flight for flight in record.flights} | {f.flight.rpartition("/")[0] for f in record.flights},
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
        if (not choice.towns or flight.flight.split("/")[1] in choice.towns)
        and (not choice.splits or flight.split in choice.splits)
        and (not choice.flights or {flight.flight, flight.flight.rpartition("/")[0]} & set(choice.flights))
    }
    found |= {flight.pair for flight in record.flights if flight.flight in found and flight.pair is not None}
    if not found:
        raise InputError("no flight is all of that", got=choice.model_dump_json(exclude_defaults=True))
    return [flight for flight in record.flights if flight.flight in found]
