"""`cosfly release build`: tracks and captions to a folder that `datasets.load_dataset` opens.

Reads the playback trees, captions and inspections of one run or several; writes `dataset/` (parquet shards, README.md,
release.json, checksums.sha256), which is published whole or not at all and holds nothing of this machine. The records
of the stage are next to it: they hold local paths and are not published.
"""

import logging
import os
import platform
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

import cosfly
from cosfly.formats.frames import FrameFile
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import CHECKSUMS, atomic_folder, sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import dump_json, parse_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import (
    Failed,
    StageFolder,
    StageInput,
    StageRecord,
    Tally,
    fingerprint,
    read_stage_record,
    record_of,
    result_of,
)
from cosfly.runtime.worker import Item, Outcome, Work
from release.build.captions import CaptionAccount
from release.build.config import ReleaseConfig
from release.build.plan import Chosen, ReleasePlan, make_plan
from release.build.shards import ShardResult, points_part, write_shard
from release.build.sources import Source, input_names, with_unique_names
from release.card.render import render_card
from release.columns import SplitName, published
from release.counting import count_release, numbers_of
from release.record import (
    FRAMES_FOLDER,
    POINTS_FOLDER,
    CaptionHistory,
    FlightHistory,
    History,
    Numbers,
    Provenance,
    ReleasedFlight,
    ReleasedTeacher,
    ReleaseRecord,
    Settings,
    Shard,
    SourceRecord,
    SourceStage,
    Splits,
    digest_of,
    numbers_of_splits,
    shard_paths,
    write_record,
)
from release.rules import SPLIT_RULE, stated_rules
from release.verify.verify import verify

log = logging.getLogger(__name__)

DATASET, PARTS = "dataset", "parts"  # in the folder of the stage: what gets published, and shards on the way there
SOURCE_FILES = ("data", "captions", "inspect", "review")  # roles whose digests the record has


# --- shards -----------------------------------------------------------------------------------------------------------


def part_path(parts: Path, name: str) -> Path:
    """Return the file of a shard while its release is being built."""
    return parts / f"{name}.parquet"


def make_worker(files: tuple[FrameFile, ...], row_group_bytes: int, parts: Path) -> Work:
    """Return the function that writes one shard."""

    def work(item: Item) -> Outcome:
        path = part_path(parts, item.item_id)
        return Outcome(write_shard(path, item.payload, files, row_group_bytes).model_dump())

    return work


def _write_parts(
    cfg: ReleaseConfig, plan: ReleasePlan, stage: StageFolder, parts: Path, workers: int, watch: Watch
) -> list[tuple[Path, Shard]]:
    """Write all shards that are not written yet; return all, with their files until the release has its name."""
    items = [Item(part.name, part.tracks, sum(len(track.selected) for track in part.tracks)) for part in plan.shards]
    arguments = (cfg.modalities, cfg.row_group_bytes, parts)
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="release: frames")
    if failed := [record for record in finished.records if isinstance(record, Failed)]:
        error_class = VerifyError if {failure.code for failure in failed} == {VerifyError.code} else InputError
        problems = ["nothing is released, because shards have problems", *(failure.message for failure in failed)]
        raise error_class.of_all(problems, where=stage.path / "failures.jsonl")
    written = [result_of(record, ShardResult) for record in finished.kept]
    return [
        (part_path(parts, shard.name), Shard(split=shard.split, **vars(result.frames), points=result.points))
        for shard, result in zip(plan.shards, written, strict=True)
    ]


def name_shards(parts: Sequence[tuple[Path, Shard]], folder: Path) -> list[Shard]:
    """Link the files of shards under their names in the release, so that no byte moves; return the named shards."""
    digest = digest_of([shard for _, shard in parts])
    for name in (FRAMES_FOLDER, POINTS_FOLDER):
        (folder / name).mkdir()
    shards = []
    paths = shard_paths([shard.split for _, shard in parts], digest)
    for (part, shard), (frames, points) in zip(parts, paths, strict=True):
        for source, path in ((part, frames), (points_part(part), points)):
            if not source.is_file():
                fix = f"remove {source.parent.parent} and run the same command again"
                raise VerifyError("a finished shard is missing", where=source, fix=fix)
            try:
                os.link(source, folder / path)
            except OSError:  # the file system has no links
                shutil.copyfile(source, folder / path)
        of_points = shard.points.model_copy(update={"path": points})
        shards.append(shard.model_copy(update={"path": frames, "points": of_points}))
    return shards


# --- release.json -----------------------------------------------------------------------------------------------------


def provenance_of(sources: list[Source], inputs: Mapping[str, StageInput], account: CaptionAccount) -> Provenance:
    """Return the provenance in the record: of the sources, inputs of the stage (`input_names`), and their captions."""
    versions = {"cosfly": cosfly.__version__, "python": platform.python_version()}
    return Provenance(
        versions=versions | {"pyarrow": pa.__version__, "numpy": np.__version__},
        sources=[_source(source, names, inputs) for source, names in zip(sources, input_names(sources), strict=True)],
        teachers=[
            ReleasedTeacher(kind=kind, model=model, settings=published(parse_json(settings)), captions=count)
            for (kind, model, settings), count in sorted(account.teachers.items())
        ],
        tokens=dict(sorted(account.tokens.items())),
        asks=account.asks,
    )


def _source(source: Source, names: dict[str, str], inputs: Mapping[str, StageInput]) -> SourceRecord:
    sha256 = {f"{role}_sha256": inputs[names[role]].sha256 for role in SOURCE_FILES if role in names}
    stages = [
        SourceStage(stage=made.stage, code_version=made.code_version, seed=made.seed, config=published(made.config))
        for made in stages_behind(source.files.values())
    ]
    return SourceRecord(run=source.run, stages=stages, **sha256)


def stages_behind(products: Iterable[Path]) -> list[StageRecord]:
    """Return the records of the stages that made some products, each after those of its inputs that are unchanged."""
    visited: set[str] = set()
    ordered: list[StageRecord] = []

    def visit(product: Path) -> None:
        record = record_of(product)
        if record is None:
            return
        digests = sorted((name, stage_input.sha256) for name, stage_input in record.inputs.items())
        key = dump_json([record.stage, record.seed, record.config, digests])  # the same wherever it is on disk
        if key in visited:
            return
        visited.add(key)
        for stage_input in record.inputs.values():
            path = Path(stage_input.path)
            if path.exists() and record_of(path) and fingerprint(path) == stage_input.sha256:
                visit(path)
        ordered.append(record)

    for product in products:
        visit(product)
    return ordered


def make_record(
    cfg: ReleaseConfig, plan: ReleasePlan, shards: list[Shard], numbers: Numbers, provenance: Provenance
) -> ReleaseRecord:
    """Return the content of release.json."""
    tracks = [track for shard in plan.shards for track in shard.tracks]
    flights = [
        ReleasedFlight(
            flight=track.name, frames=len(track.selected), frames_available=track.num_frames,
            **vars(track.placement), five_ray_mean=track.candidate.five_ray_mean,
        )
        for track in tracks
    ]  # fmt: skip
    captions = Counter[SplitName]()
    for track in tracks:
        captions[track.placement.split] += len(track.captioned)
    settings = Settings(
        selection=cfg.selection, num_frames=cfg.num_frames, window_frames=plan.account.window_frames, pairs=cfg.pairs,
        tracks=[*cfg.tracks], modalities=[*cfg.modalities],
    )  # fmt: skip
    splits = Splits(
        by=cfg.split_by, rule=SPLIT_RULE, seed=cfg.split_seed, fractions=cfg.fractions,
        splits=numbers_of_splits(flights, captions),
    )  # fmt: skip
    return ReleaseRecord(
        name=cfg.name, licence=plan.licence, credits=cfg.credits, maps=plan.maps,
        made_by=f"cosfly {cosfly.__version__}", settings=settings, splits=splits, numbers=numbers,
        history=_history(plan, tracks), provenance=provenance, flights=flights, shards=shards,
        **stated_rules(settings, shards),
    )  # fmt: skip


def _history(plan: ReleasePlan, tracks: list[Chosen]) -> History:
    """Return what became of all tracks and captions; `release verify` checks that it adds up."""
    account = plan.account
    without_caption = Counter[str]()
    for track in tracks:
        without_caption.update(track.captions.why_none(i) for i in {*track.selected} - {*track.captioned})
    num_released = sum(len(track.captioned) for track in tracks)
    captions = CaptionHistory(
        read=account.accepted + account.dropped.total(), dropped=dict(sorted(account.dropped.items())),
        released=num_released, frame_not_selected=sum(len(track.captions.spans) for track in tracks) - num_released,
        flight_left_out=account.of_other_tracks, frames_without=dict(sorted(without_caption.items())),
    )  # fmt: skip
    flights = FlightHistory(
        found=len(plan.material.candidates), inspected=plan.material.num_inspected, released=len(tracks),
        left_out=dict(sorted(plan.dropped.items())),
    )  # fmt: skip
    return History(trajectories=plan.material.trajectories, flights=flights, captions=captions)


def write_records(folder: Path, record: ReleaseRecord) -> None:
    """Write release.json, the card and the checksums."""
    write_record(folder / "release.json", record)
    write_bytes(folder / "README.md", render_card(record).encode())
    digests = {file.path: file.sha256 for file in record.files}
    for name in ("release.json", "README.md"):
        digests[name] = sha256_file(folder / name)
    write_checksums(folder, digests)


# --- the stage --------------------------------------------------------------------------------------------------------


def run(cfg: ReleaseConfig, sources: list[Source], out: Path, *, workers: int = 0, watch: Watch = Watch()) -> Path:
    """Read the playback tree, the captions and the inspection, if there is one, of each run; write `dataset/` and
    return its path.

    Raises:
        InputError, VerifyError: The material has problems; nothing is published, and finished shards stay for the next
            run.
    """
    sources = with_unique_names(sources)
    names = input_names(sources)
    inputs = {
        name: source.files[role] for source, roles in zip(sources, names, strict=True) for role, name in roles.items()
    }
    stage = StageFolder.open(out, "release", config=cfg, inputs=inputs, seed=0)
    dataset, parts = out / DATASET, out / PARTS
    if stage.is_complete:
        shutil.rmtree(parts, ignore_errors=True)
        return dataset
    shutil.rmtree(dataset, ignore_errors=True)  # of another attempt: until this one is whole, nothing is published
    plan = make_plan(cfg, sources, stage)
    if without_caption := [track.name for track in plan.tracks if not track.captioned]:
        what = "release: %d of %d tracks have no caption of a released frame, such as %s; the card has the reasons"
        log.warning(what, len(without_caption), len(plan.tracks), without_caption[0])
    written = _write_parts(cfg, plan, stage, parts, workers, watch)
    with atomic_folder(dataset) as folder:
        shards = name_shards(written, folder)
        numbers = numbers_of(count_release(folder, shards), cfg.num_frames)
        provenance = provenance_of(sources, read_stage_record(out).inputs, plan.account)
        record = make_record(cfg, plan, shards, numbers, provenance)
        write_records(folder, record)
        report = verify(folder, level="structure")  # before the release has its name
        if not report.is_ok:
            what = "the release does not pass its verification, so it is not published"
            raise VerifyError(what, where=folder, got=str(report))
    # checksums.sha256 speaks for the shards: hashing them again would only cost time.
    outputs = [dataset / name for name in ("README.md", "release.json", CHECKSUMS)]
    history = record.history
    tally = Tally(input=history.flights.found, kept=history.flights.released, dropped=plan.dropped)
    stage.finish(outputs, tally, history=history.model_dump(mode="json"))
    shutil.rmtree(parts, ignore_errors=True)
    return dataset
