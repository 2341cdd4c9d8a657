"""`cosfly release build`: flights and captions to a folder that `datasets.load_dataset` opens.

Reads the playback trees, captions and inspections of one run or several; writes `dataset/` (parquet shards, README.md,
release.json, checksums.sha256), which is published whole or not at all. The records of the stage are next to it: they
hold local paths and are not published.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from cosfly.formats.frames import FrameFile
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import CHECKSUMS, atomic_folder
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Failed, Resume, StageFolder, Tally, read_stage_record, result_of
from cosfly.runtime.worker import Item, Outcome, Work
from release.build.config import ReleaseConfig
from release.build.plan import ReleasePlan, make_plan
from release.build.records import (
    DATASET,
    PARTS,
    make_record,
    name_shards,
    provenance_of,
    write_records,
)
from release.build.shards import ShardResult, write_shard
from release.build.sources import Source, input_names, told_apart
from release.counting import count_release, numbers_of
from release.record import Shard
from release.verify.verify import verify


def part_path(parts: Path, name: str) -> Path:
    """Return the file of a shard while its release is being built."""
    return parts / f"{name}.parquet"


def make_worker(files: tuple[FrameFile, ...], row_group_bytes: int, parts: Path) -> Work:
    """Return the function that writes one shard."""

    def work(item: Item) -> Outcome:
        path = part_path(parts, item.item_id)
        return Outcome(write_shard(path, item.payload, files, row_group_bytes).model_dump())

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
    """Read the playback tree, the captions and, where there is one, the inspection of each run; write `dataset/` and
    return its path.

    Raises:
        InputError, VerifyError: The material has problems; nothing is published, and finished shards stay for the next
            run.
    """
    sources = told_apart(sources)
    names = input_names(sources)
    inputs = {
        name: source.files[role] for source, roles in zip(sources, names, strict=True) for role, name in roles.items()
    }
    stage = StageFolder.open(out, "release", config=cfg, inputs=inputs, seed=0, resume=resume)
    dataset, parts = out / DATASET, out / PARTS
    if stage.is_complete:
        shutil.rmtree(parts, ignore_errors=True)
        return dataset
    shutil.rmtree(dataset, ignore_errors=True)  # of another attempt: until this one is whole, nothing is published
    plan = make_plan(cfg, sources, stage)
    written = _write_parts(cfg, plan, stage, parts, workers, watch)
    with atomic_folder(dataset) as folder:
        shards = name_shards(written, folder)
        numbers = numbers_of(count_release(folder, shards), cfg.num_frames)
        provenance = provenance_of(sources, read_stage_record(out).inputs, plan.account)
        prompts = {source.run: source.questions for source in sources if source.questions}
        record = make_record(cfg, plan, shards, numbers, provenance, prompts)
        write_records(folder, record)
        _check_release(folder)
    # checksums.sha256 speaks for the shards: hashing them again would only cost time.
    outputs = [dataset / name for name in ("README.md", "release.json", CHECKSUMS)]
    history = record.history
    tally = Tally(input=history.flights.found, kept=history.flights.released, dropped=plan.dropped)
    stage.finish(outputs, tally, history=history.model_dump(mode="json"))
    shutil.rmtree(parts, ignore_errors=True)
    return dataset


def _write_parts(
    cfg: ReleaseConfig, plan: ReleasePlan, stage: StageFolder, parts: Path, workers: int, watch: Watch
) -> list[tuple[Path, Shard]]:
    """Write all shards that are not written yet; return all, and where they are until the release has its name."""
    items = [Item(shard.name, shard.tracks, sum(len(one.selected) for one in shard.tracks)) for shard in plan.shards]
    how = (cfg.modalities, cfg.row_group_bytes, parts)
    finished = run_items(stage, items, make_worker, how, workers=workers, watch=watch, label="release: frames")
    if failed := [record for record in finished.records if isinstance(record, Failed)]:
        kind = VerifyError if {one.code for one in failed} == {VerifyError.code} else InputError
        problems = ["nothing is released, because shards have problems", *(one.message for one in failed)]
        raise kind.of_all(problems, where=stage.path / "failures.jsonl")
    written = [result_of(record, ShardResult) for record in finished.kept]
    return [
        (part_path(parts, shard.name), Shard(split=shard.split, **vars(result.frames), points=result.points))
        for shard, result in zip(plan.shards, written, strict=True)
    ]


def _check_release(folder: Path) -> None:
    """Check the structure of a release before it has its name."""
    report = verify(folder, level="structure")
    if not report.is_ok:
        raise VerifyError(
            "the release does not pass its verification, so it is not published", where=folder, got=str(report)
        )
