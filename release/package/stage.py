"""`cosfly release build`: accepted flights and captions to a folder that `datasets.load_dataset` opens.

Reads the playback tree, `captions.jsonl` and `inspect.json` of one run or several; writes `dataset/` (parquet shards, README.md, release.json,
checksums.sha256), which is what gets published. Around it stand the stage's own records, which hold local paths and do not.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, Field, field_validator

import cosfly
from cosfly.config import Config
from cosfly.errors import InputError, VerifyError
from cosfly.products.boxes import LicenceId
from cosfly.products.frames import FILE_NAMES, FrameFile, frame_name
from cosfly.products.playback import read_flight
from cosfly.provenance import digest_of, folder_digests
from cosfly.reading.files import sha256_file
from cosfly.reading.tables import num_rows, row_groups
from cosfly.runner import Finished, Item, Outcome, Watch, Work, advance, run_items
from cosfly.stage_folder import Resume, StageFolder, Tally, result_of
from cosfly.store import CHECKSUMS, atomic_file, atomic_folder, sha256_bytes, write_bytes, write_checksums
from release import columns
from release.card.numbers import compute_numbers
from release.card.render import render_card
from release.package.sources import Chosen, Material, Source, Track, choose_licence, gather
from release.record import (
    CaptionHistory,
    FlightHistory,
    History,
    ReleasedFlight,
    ReleasedMap,
    ReleaseRecord,
    Settings,
    Shard,
    write_record,
)
from release.subsample import RULE, select_frames

MB = 1024 * 1024
DATASET, PARTS = "dataset", "parts"
ANEW = "put the file back, or inspect and caption the tree as it is now"


class ReleaseConfig(Config):
    """What is published, and how it is cut into files."""

    name: str = Field("CosFly flights", min_length=1, description="title of the data-set card")
    licence: LicenceId | None = Field(
        None, description="licence of the data set, as the hub spells it (cc-by-4.0); null: its maps', if they agree"
    )
    credits: str = Field("", description="who else must be named; the maps' own licences and credits always are")
    num_frames: int = Field(
        400, ge=1, description="frames per flight by stride selection; shorter flights are kept whole, never padded"
    )
    tracks: tuple[Track, ...] = Field(("clean", "perturbed"), min_length=1, description="which flights of a trajectory")
    include_review: bool = Field(False, description="also release flights that the inspection routed to manual review")
    modalities: tuple[FrameFile, ...] = Field(
        tuple(FILE_NAMES), min_length=1, description="pictures to include: rgb, depth (lossless float32), instance"
    )
    shard_mb: int = Field(500, ge=1, description="size that a parquet file should not pass by more than one flight, MB")
    row_group_mb: int = Field(
        64, ge=1, description="size of a row group before compression, MB; viewers load one at a time"
    )

    @field_validator("tracks", "modalities")
    @classmethod
    def _distinct(cls, values: tuple) -> tuple:
        if len(set(values)) != len(values):
            raise ValueError("an entry is listed twice")
        return values


# --- one flight -------------------------------------------------------------------------------------------------------


def part_name(item_id: str) -> str:
    return item_id.replace("/", "__") + ".parquet"


class Packaged(BaseModel):
    """What was packaged of a flight: counts of frames and captions, and the size of its part."""

    frames: int
    frames_available: int
    captions: int
    captions_not_selected: int
    bytes: int


def write_part(path: Path, chosen: Chosen, cfg: ReleaseConfig) -> Packaged:
    """Write one flight's selected frames as parquet, in row groups; give its counts.

    Raises:
        InputError: the flight or a file of it cannot be read, or a caption belongs to no frame of it.
        VerifyError: a file is not the one that was inspected.
    """
    folder, captions = chosen.folder, chosen.captions
    digests = _digests(chosen)
    flight = replace(read_flight(folder), run=chosen.place.run, given_id=chosen.flight_id)
    beyond = [index for index in captions if not 0 <= index < len(flight)]
    if beyond:
        expected = f"0 to {len(flight) - 1}: make the captions again from this tree"
        raise InputError("a caption belongs to no frame", where=folder, got=f"frame {beyond[0]}", expected=expected)
    selected = select_frames(len(flight), cfg.num_frames).tolist()
    schema = columns.schema(cfg.modalities)
    rows = (_checked(columns.row(flight, i, cfg.modalities, captions.get(i)), folder, digests, cfg) for i in selected)
    with atomic_file(path) as file, open_writer(file, schema) as writer:
        for batch in _batches(rows, cfg):
            writer.write_table(pa.Table.from_pylist(batch, schema=schema), row_group_size=len(batch))
    num_captions = sum(i in captions for i in selected)
    return Packaged(
        frames=len(selected),
        frames_available=len(flight),
        captions=num_captions,
        captions_not_selected=len(captions) - num_captions,
        bytes=path.stat().st_size,
    )


def _digests(chosen: Chosen) -> dict[str, str]:
    """Give the sha256 of each file of a flight, once it is clear that they are those that were inspected.

    Raises:
        VerifyError: they are not.
    """
    digests = folder_digests(chosen.folder)
    if chosen.sha256 not in (None, digest_of(digests)):
        got, expected = digest_of(digests), f"{chosen.sha256}, as in the inspection"
        raise VerifyError(
            "the flight is not the one that was inspected", where=chosen.folder, got=got, expected=expected, fix=ANEW
        )
    name = "trajectory.json"
    _compare(chosen.folder / name, sha256_file(chosen.folder / name), digests.get(name))
    return digests


def _compare(path: Path, got: str, expected: str | None) -> None:
    if got != expected:
        raise VerifyError("a file is not the one that was inspected", where=path, got=got, expected=expected, fix=ANEW)


def _checked(row: dict[str, Any], folder: Path, digests: dict[str, str], cfg: ReleaseConfig) -> dict[str, Any]:
    """Give a row whose pictures are those of the digests."""
    for file in cfg.modalities:
        name = f"{frame_name(row['frame_index'])}/{FILE_NAMES[file]}"
        _compare(folder / name, sha256_bytes(columns.picture_bytes(row, file)), digests.get(name))
    return row


def _batches(rows: Iterator[dict[str, Any]], cfg: ReleaseConfig) -> Iterator[list[dict[str, Any]]]:
    """Cut rows into groups of about `row_group_mb`."""
    batch: list[dict[str, Any]] = []
    num_bytes = 0
    for row in rows:
        advance()
        batch.append(row)
        for file in cfg.modalities:
            num_bytes += len(columns.picture_bytes(row, file))
        if num_bytes >= cfg.row_group_mb * MB:
            yield batch
            batch, num_bytes = [], 0
    if batch:
        yield batch


def open_writer(file: Path | IO[bytes], schema: pa.Schema) -> pq.ParquetWriter:
    """Open a parquet file whose bytes depend on the rows alone.

    PNG files do not compress, so they are stored as they are; everything else is zstd. Statistics of pictures would only
    repeat their first bytes.
    """
    leaves: list[str] = []  # parquet's paths of the primitive columns
    for member in schema:
        inner = [child.name for child in member.type] if pa.types.is_struct(member.type) else []
        inner = ["list.element"] if pa.types.is_list(member.type) else inner
        leaves += [f"{member.name}.{name}" for name in inner] or [member.name]
    compression = {name: "none" if name.endswith(".bytes") else "zstd" for name in leaves}
    small = [name for name in leaves if name != "depth" and not name.endswith(".bytes")]
    repeated = [name for name in small if name in schema.names and schema.field(name).type == pa.string()]
    return pq.ParquetWriter(
        file, schema, compression=compression, use_dictionary=repeated, write_statistics=small, version="2.6"
    )


# --- the shards -------------------------------------------------------------------------------------------------------


def plan_shards(sizes: list[int], target_bytes: int) -> list[list[int]]:
    """Group consecutive parts: a shard is closed as soon as it reaches the target."""
    groups: list[list[int]] = []
    total = 0
    for index, size in enumerate(sizes):
        if not groups or total >= target_bytes:
            groups.append([])
            total = 0
        groups[-1].append(index)
        total += size
    return groups


def assemble_shards(parts: list[Path], folder: Path, cfg: ReleaseConfig) -> list[Path]:
    """Copy the parts' row groups into `data/train-i-of-n.parquet`; memory holds one row group.

    A part that fills a shard alone is linked, not copied.
    """
    groups = plan_shards([part.stat().st_size for part in parts], cfg.shard_mb * MB)
    schema = columns.schema(cfg.modalities)
    shards = []
    (folder / "data").mkdir()
    for number, group in enumerate(groups):
        shard = folder / "data" / f"train-{number:05d}-of-{len(groups):05d}.parquet"
        shards.append(shard)
        if len(group) == 1:
            try:
                os.link(parts[group[0]], shard)
            except OSError:  # the file system has no links
                shutil.copyfile(parts[group[0]], shard)
            continue
        with open_writer(shard, schema) as writer:
            for index in group:
                for table in row_groups(parts[index], tree=parts[index].parent):
                    writer.write_table(table, row_group_size=table.num_rows)
    return shards


# --- the stage --------------------------------------------------------------------------------------------------------


def make_worker(cfg: ReleaseConfig, parts: Path) -> Work:
    """Worker factory: give the function that packages one flight."""

    def work(item: Item) -> Outcome:
        return Outcome(write_part(parts / part_name(item.item_id), item.payload, cfg).model_dump())

    return work


def run(
    cfg: ReleaseConfig,
    sources: list[Source],
    out: Path,
    *,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Read the playback tree, the captions and the inspection of each run; write `dataset/` and give its path."""
    inputs = {
        f"{number}.{name}" if len(sources) > 1 else name: getattr(source, name)
        for number, source in enumerate(sources, 1)
        for name in ("data", "captions", "inspect")
    }
    stage = StageFolder.open(out, "release", config=cfg, inputs=inputs, seed=0, resume=resume)
    dataset, parts = out / DATASET, out / PARTS
    if stage.is_complete:
        shutil.rmtree(parts, ignore_errors=True)
        return dataset
    material = gather(sources, cfg.tracks, include_review=cfg.include_review)
    if not material.chosen:
        tally = Tally(input=material.inspected, dropped=material.left_out)
        raise stage.nothing_kept(tally, expected="an inspected flight that passed: see report.html of the inspection")
    maps = [(shown.town, shown.licence) for shown in material.maps]
    licence = choose_licence(cfg.licence, maps)  # before the work, not after it
    items = [Item(chosen.name, chosen) for chosen in material.chosen]
    finished = run_items(stage, items, make_worker, (cfg, parts), workers=workers, watch=watch, label="release")
    results = {record.id: result_of(record, Packaged) for record in finished.kept}
    if not results:
        raise stage.nothing_kept(finished.tally)
    _check_parts(parts, results)
    history = account(material, finished)
    with atomic_folder(dataset) as folder:
        shards = assemble_shards([parts / part_name(item_id) for item_id in results], folder, cfg)
        write_records(folder, make_record(shards, results, history, licence, material.maps, cfg))
    # checksums.sha256 speaks for the shards: hashing them again would only cost time.
    outputs = [dataset / name for name in ("README.md", "release.json", CHECKSUMS)]
    stage.finish(outputs, finished.tally, history=history.model_dump(mode="json"))
    if not finished.tally.failed:  # or the next run, which does the failed flights again, would miss the others' parts
        shutil.rmtree(parts, ignore_errors=True)
    return dataset


def _check_parts(parts: Path, results: dict[str, Packaged]) -> None:
    for item_id, result in results.items():
        path = parts / part_name(item_id)
        if not path.is_file() or path.stat().st_size != result.bytes:
            expected, fix = f"{result.bytes} bytes", f"remove {parts.parent} and run again"
            what = "a part that was finished before is missing or has another size"
            raise VerifyError(what, where=path, expected=expected, fix=fix)


def account(material: Material, finished: Finished) -> History:
    """Say where all flights and captions went; every sum is checked here and again by `release verify`."""
    results = [result_of(record, Packaged) for record in finished.kept]
    gone = material.left_out | {f"failed: {code}": count for code, count in finished.tally.failed.items()}
    accepted = sum(len(frames) for captions in material.captions for frames in captions.values())
    released = sum(result.captions for result in results)
    not_selected = sum(result.captions_not_selected for result in results)
    history = History(
        trajectories=material.trajectories,
        flights=FlightHistory(inspected=material.inspected, released=len(results), left_out=gone),
        captions=CaptionHistory(
            read=accepted + material.dropped.total(),
            dropped=dict(sorted(material.dropped.items())),
            accepted=accepted,
            released=released,
            frame_not_selected=not_selected,
            flight_left_out=accepted - released - not_selected,
        ),
    )
    assert history.flights.inspected == len(results) + sum(gone.values()), history
    assert history.captions.flight_left_out >= 0, history
    return history


def make_record(
    shards: list[Path],
    results: dict[str, Packaged],
    history: History,
    licence: str,
    maps: list[ReleasedMap],
    cfg: ReleaseConfig,
) -> ReleaseRecord:
    """Give what release.json says of its shards."""
    listed = [
        Shard(
            path=f"data/{shard.name}",
            rows=num_rows(shard),
            bytes=shard.stat().st_size,
            sha256=sha256_file(shard),
        )
        for shard in shards
    ]
    return ReleaseRecord(
        name=cfg.name,
        licence=licence,
        credits=cfg.credits,
        maps=maps,
        made_by=f"cosfly {cosfly.__version__}",
        settings=Settings(num_frames=cfg.num_frames, tracks=list(cfg.tracks), modalities=list(cfg.modalities)),
        frame_selection=RULE,
        coordinates=columns.CONTRACT,
        numbers=compute_numbers(shards, cfg.num_frames),
        history=history,
        flights=[
            ReleasedFlight(flight=item_id, frames=result.frames, frames_available=result.frames_available)
            for item_id, result in results.items()
        ],
        shards=listed,
    )


def write_records(folder: Path, record: ReleaseRecord) -> None:
    """Write release.json, the card and the checksums beside the shards."""
    write_record(folder / "release.json", record)
    write_bytes(folder / "README.md", render_card(record).encode())
    digests = {shard.path: shard.sha256 for shard in record.shards}
    for name in ("release.json", "README.md"):
        digests[name] = sha256_file(folder / name)
    write_checksums(folder, digests)
