"""The folder that is published: finished shards under their names, and the records beside them, without anything of
this machine."""

from __future__ import annotations

import os
import platform
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

import cosfly
from cosfly.runtime.errors import VerifyError
from cosfly.runtime.io import sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.run_dir import StageInput, StageRecord, fingerprint, record_of
from release import columns
from release.build.captions import CaptionAccount, teacher_settings
from release.build.config import ReleaseConfig
from release.build.plan import ReleasePlan
from release.build.shards import ShardResult, points_part
from release.build.sources import Source, input_names
from release.card.render import render_card
from release.columns import published
from release.record import (
    FRAMES_FOLDER,
    POINTS_FOLDER,
    CaptionHistory,
    FlightHistory,
    History,
    MadeBy,
    Numbers,
    Provenance,
    ReleasedFlight,
    ReleasedTeacher,
    ReleaseRecord,
    Repairs,
    Settings,
    Shard,
    SourceRecord,
    Splits,
    StoredDepth,
    digest_of,
    numbers_of_splits,
    shard_paths,
    write_record,
)
from release.rules import RULES, SPLIT_RULE


def provenance_of(sources: list[Source], inputs: Mapping[str, StageInput], account: CaptionAccount) -> Provenance:
    """Return what the record says of the sources and of all their captions.

    Args:
        inputs: of the stage, by their names (`input_names`).
    """
    repaired = dict(sorted(account.repairs.items()))
    first = account.accepted - sum(repaired.values())
    return Provenance(
        versions={
            "cosfly": cosfly.__version__,
            "python": platform.python_version(),
            "pyarrow": pa.__version__,
            "numpy": np.__version__,
        },
        sources=[_source(source, names, inputs) for source, names in zip(sources, input_names(sources), strict=True)],
        teachers=[
            ReleasedTeacher(kind=kind, model=model, settings=published(teacher_settings(settings)), captions=count)
            for (kind, model, settings), count in sorted(account.teachers.items())
        ],
        repairs=Repairs(
            accepted=account.accepted,
            first_answers=first,
            repaired_by_rung=repaired,
        ),
        tokens=dict(sorted(account.tokens.items())),
        asks=account.asks,
    )


def _source(source: Source, names: dict[str, str], inputs: Mapping[str, StageInput]) -> SourceRecord:
    sha256 = {role: inputs[name].sha256 for role, name in names.items()}
    return SourceRecord(
        run=source.run,
        tree_sha256=sha256["data"],
        captions_sha256=sha256["captions"],
        inspect_sha256=sha256.get("inspect"),
        review_sha256=sha256.get("review"),
        stages=[
            MadeBy(
                stage=record.stage,
                code_version=record.code_version,
                seed=record.seed,
                config=published(record.config),
            )
            for record in stages_behind(source.files.values())
        ],
    )


def stages_behind(products: Iterable[Path]) -> list[StageRecord]:
    """Return the records of the stages that made some products, each after those of its inputs that are unchanged."""
    found: set[str] = set()
    ordered: list[StageRecord] = []

    def visit(record: StageRecord | None) -> None:
        if record is None:
            return
        made_of = sorted((name, entry.sha256) for name, entry in record.inputs.items())
        known = dump_json([record.stage, record.seed, record.config, made_of])  # without the place on disk
        if known in found:
            return
        found.add(known)
        for entry in record.inputs.values():
            before = Path(entry.path)
            if before.exists() and (earlier := record_of(before)) and fingerprint(before) == entry.sha256:
                visit(earlier)
        ordered.append(record)

    for path in products:
        visit(record_of(path))
    return ordered


def account_for(plan: ReleasePlan, written: list[ShardResult]) -> History:
    """Return where all flights and captions went; every sum is checked here and again by `release verify`."""
    flights = [flight for result in written for flight in result.flights]
    account = plan.account
    without = sum((Counter(flight.frames_without) for flight in flights), Counter[str]())
    captions = CaptionHistory(
        read=account.accepted + account.dropped.total(),
        dropped=dict(sorted(account.dropped.items())),
        accepted=account.accepted,
        released=sum(flight.captions for flight in flights),
        frame_not_selected=sum(flight.frame_not_selected for flight in flights),
        flight_left_out=account.of_no_flight,
        frames_without=dict(sorted(without.items())),
    )
    parts = captions.released + captions.frame_not_selected + captions.flight_left_out
    assert captions.accepted == parts, captions
    found = FlightHistory(
        found=len(plan.material.candidates),
        inspected=plan.material.num_inspected,
        released=len(flights),
        left_out=dict(sorted(plan.left_out.items())),
    )
    assert found.found == len(flights) + plan.left_out.total(), found
    return History(trajectories=plan.material.trajectories, flights=found, captions=captions)


def splits_of(
    cfg: ReleaseConfig, plan: ReleasePlan, written: list[ShardResult], flights: list[ReleasedFlight]
) -> Splits:
    """Return what the record says of its splits."""
    captions = Counter[str]()
    for flight in (flight for result in written for flight in result.flights):
        captions[plan.placements[flight.name].split] += flight.captions
    numbers = numbers_of_splits(flights, captions)
    return Splits(by=cfg.split_by, rule=SPLIT_RULE, seed=cfg.split_seed, fractions=cfg.fractions, splits=numbers)


def make_record(
    cfg: ReleaseConfig,
    plan: ReleasePlan,
    written: list[ShardResult],
    shards: list[Shard],
    numbers: Numbers,
    provenance: Provenance,
    prompts: dict[str, dict[str, str]],
) -> ReleaseRecord:
    """Return what release.json says of its shards. prompts: as the record has them."""
    five_ray = {flight.name: flight.candidate.five_ray_mean for flight, *_ in plan.flights}
    flights = [
        ReleasedFlight(
            flight=flight.name,
            frames=flight.frames,
            frames_available=flight.frames_available,
            split=plan.placements[flight.name].split,
            walk=plan.placements[flight.name].walk,
            pair=plan.placements[flight.name].pair,
            five_ray_mean=five_ray[flight.name],
        )
        for result in written
        for flight in result.flights
    ]
    return ReleaseRecord(
        name=cfg.name,
        licence=plan.licence,
        credits=cfg.credits,
        maps=plan.maps,
        made_by=f"cosfly {cosfly.__version__}",
        settings=Settings(
            selection=cfg.selection,
            num_frames=cfg.num_frames,
            window_frames=plan.window_frames,
            tracks=list(cfg.tracks),
            pairs=cfg.pairs,
            modalities=list(cfg.modalities),
        ),
        frame_selection=RULES[cfg.selection],
        depth=StoredDepth() if "depth" in cfg.modalities else None,
        coordinates=columns.CONTRACT,
        prompts=prompts,
        splits=splits_of(cfg, plan, written, flights),
        numbers=numbers,
        history=account_for(plan, written),
        provenance=provenance,
        flights=flights,
        content_digest=digest_of(shards),
        shards=shards,
    )


DATASET, PARTS = "dataset", "parts"  # in the folder of the stage: what gets published, and shards on the way there


def check_parts(parts: Sequence[tuple[Path, Shard]], out: Path) -> None:
    """See that what was finished, also by an earlier run, is there; `out` is the folder of the stage."""
    for path, shard in parts:
        for place, stored in ((path, shard), (points_part(path), shard.points)):
            if not place.is_file() or place.stat().st_size != stored.bytes:
                raise VerifyError(
                    "a finished shard is missing or has another size", where=place,
                    expected=f"{stored.bytes} bytes", fix=f"remove {out} and run the same command again",
                )  # fmt: skip


def name_shards(parts: Sequence[tuple[Path, Shard]], folder: Path) -> list[Shard]:
    """Put shards under their names in the release: linked, so that no byte moves and a kill costs nothing.

    Args:
        parts: where they stand until the release has its name, and what they are; their paths are not read.
    """
    digest = digest_of([shard for _, shard in parts])
    for place in (FRAMES_FOLDER, POINTS_FOLDER):
        (folder / place).mkdir()
    shards = []
    for (part, shard), name in zip(parts, shard_paths([shard.split for _, shard in parts], digest), strict=True):
        frames, points = f"{FRAMES_FOLDER}/{name}", f"{POINTS_FOLDER}/{name}"
        for source, path in ((part, frames), (points_part(part), points)):
            try:
                os.link(source, folder / path)
            except OSError:  # the file system has no links
                shutil.copyfile(source, folder / path)
        of_points = shard.points.model_copy(update={"path": points})
        shards.append(shard.model_copy(update={"path": frames, "points": of_points}))
    return shards


def write_records(folder: Path, record: ReleaseRecord) -> None:
    """Write release.json, the card and the checksums beside the shards."""
    write_record(folder / "release.json", record)
    write_bytes(folder / "README.md", render_card(record).encode())
    digests = {file.path: file.sha256 for file in record.files}
    for name in ("release.json", "README.md"):
        digests[name] = sha256_file(folder / name)
    write_checksums(folder, digests)
