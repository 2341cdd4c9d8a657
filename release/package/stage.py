"""`cosfly release build`: flights and captions to a folder that `datasets.load_dataset` opens.

Reads the playback trees, captions and inspections of one run or several; writes `dataset/` (parquet shards, README.md, release.json,
croissant.json, checksums.sha256), which is what gets published: all of it, or nothing. Around it stand the stage's own records, which hold local paths and do not.
"""

from __future__ import annotations

import shutil
from collections import Counter, defaultdict
from pathlib import Path

from pydantic import BaseModel, Field, field_validator, model_validator

import cosfly
from cosfly.config import Config
from cosfly.errors import CosflyError, InputError, VerifyError
from cosfly.products.boxes import LicenceId
from cosfly.products.frames import FILE_NAMES, FrameFile
from cosfly.provenance import read_stage_record
from cosfly.runner import Item, Outcome, Watch, Work, run_items
from cosfly.stage_folder import Failed, Resume, StageFolder, Tally, result_of, write_failures
from cosfly.store import CHECKSUMS, atomic_folder
from release import columns
from release.card.numbers import compute_numbers
from release.columns import SPLIT_NAMES, SplitName
from release.package.captions import CaptionAccount, FlightCaptions, FlightKey, index_captions
from release.package.depth import depth_record
from release.package.folder import DATASET, PARTS, Finished, check_parts, name_shards, write_records
from release.package.origin import provenance_of
from release.package.plan import PlannedShard, selected_bytes, shards_of
from release.package.rows import ShardPlan
from release.package.shards import Written, write_shard
from release.package.sources import Material, Source, Track, choose_licence, gather, input_names, maps_of
from release.package.survey import Placing, Surveyed, check_alike, keep_pairs, place_flights, survey
from release.record import (
    CaptionHistory,
    DepthCodingName,
    FlightHistory,
    History,
    Pairs,
    ReleasedFlight,
    ReleasedMap,
    ReleaseRecord,
    Settings,
    Shard,
    SplitBy,
    SplitNumbers,
    Splits,
    content_digest,
)
from release.splits import SPLIT_RULE
from release.subsample import RULE
from release.verify.verify import verify

MB = 1024 * 1024
NUM_NAMED = 10  # things that are wrong, in a message; failures.jsonl has all


class ReleaseConfig(Config):
    """What is published, and how it is cut into files."""

    name: str = Field("CosFly flights", min_length=1, description="title of the data-set card")
    licence: LicenceId | None = Field(
        None, description="licence of the data set, as the hub spells it (cc-by-4.0); null: its maps', if they agree"
    )
    credits: str = Field("", description="who else must be named; the maps' own licences and credits always are")
    num_frames: int | None = Field(
        400,
        ge=1,
        description="frames per flight, in evenly spread runs that keep captions' windows whole; shorter flights are whole, never padded; null: all",
    )
    tracks: tuple[Track, ...] = Field(("clean", "perturbed"), min_length=1, description="which flights of a trajectory")
    pairs: Pairs = Field(
        "both",
        description="both: of two wanted tracks neither flight without the other; any: also flights whose twin is left out",
    )
    include_review: bool = Field(False, description="also release flights that the inspection routed to manual review")
    unbound: str = Field(
        "refuse",
        pattern="^(refuse|accept)$",
        description="captions of which no record says from which tree they were made: refuse or accept",
    )
    split_by: SplitBy = Field("walk", description="what two splits may not share: a walk, or a town in all its builds")
    validation_fraction: float = Field(0.1, ge=0, lt=1, description="share of walks (towns) for validation; 0: none")
    test_fraction: float = Field(0.1, ge=0, lt=1, description="share of walks (towns) for the test; 0: none")
    split_seed: int = Field(0, ge=0, description="seed of the division into splits")
    modalities: tuple[FrameFile, ...] = Field(
        tuple(FILE_NAMES), min_length=1, description="pictures to include: rgb, depth, instance"
    )
    depth: DepthCodingName = Field(
        "float32",
        description="float32: lossless; float16, or millimetre_png (16 bits, up to 65.5 m): smaller, the error is measured and stands in the record",
    )
    shard_mb: int = Field(
        500, ge=1, description="size that a parquet file should not pass by more than one flight, MB before compression"
    )
    row_group_mb: int = Field(
        64, ge=1, le=1024, description="size of a row group before compression, MB; viewers load one at a time"
    )

    @field_validator("tracks", "modalities")
    @classmethod
    def _distinct(cls, values: tuple) -> tuple:
        if len(set(values)) != len(values):
            raise ValueError("an entry is listed twice")
        return values

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> ReleaseConfig:
        if self.validation_fraction + self.test_fraction >= 1.0:
            raise ValueError("validation_fraction + test_fraction must stay below 1, or nothing is left to train on")
        return self

    @property
    def fractions(self) -> dict[SplitName, float]:
        train = round(1.0 - self.validation_fraction - self.test_fraction, 9)
        return {"train": train, "validation": self.validation_fraction, "test": self.test_fraction}


# --- what is wrong with the material ----------------------------------------------------------------------------------


class _Findings:
    """What is wrong with the material: all of it is looked for before the stage gives up."""

    def __init__(self, stage: StageFolder) -> None:
        self._stage, self.failures = stage, list[Failed]()

    def tell(self, item_id: str, error: CosflyError) -> None:
        self.failures.append(Failed(id=item_id, code=error.code, message=str(error)))

    def check(self) -> None:
        """Refuse to go on if anything is wrong.

        Raises:
            InputError, VerifyError: names the first findings; `failures.jsonl` has all.
        """
        if not self.failures:
            return
        path = self._stage.path / "failures.jsonl"
        write_failures(path, self.failures)
        listed = [failure.message for failure in self.failures[:NUM_NAMED]]
        more = f" | and {len(self.failures) - NUM_NAMED} more, see {path}" if len(self.failures) > NUM_NAMED else ""
        kind = VerifyError if all(failure.code == VerifyError.code for failure in self.failures) else InputError
        raise kind(
            f"nothing is released: {len(self.failures)} things are wrong with the material", where=self._stage.path,
            got=" | ".join(listed) + more, fix="mend them, or leave the flights out, and run the same command again: finished shards are kept",
        )  # fmt: skip


# --- the material -----------------------------------------------------------------------------------------------------


class _Plan(BaseModel):
    """All that is decided before the first byte is written."""

    model_config = {"arbitrary_types_allowed": True}

    flights: list[tuple[Surveyed, FlightCaptions, int, int]]
    placings: dict[str, Placing]
    shards: list[PlannedShard]
    account: CaptionAccount
    material: Material
    left_out: Counter[str]
    window_frames: int


def make_plan(cfg: ReleaseConfig, sources: list[Source], stage: StageFolder) -> _Plan:
    """Look at all of the material, and decide what goes where.

    Raises:
        InputError: it cannot be released; names everything that is wrong. NothingKept: there is no flight.
    """
    findings = _Findings(stage)
    material = gather(sources, include_review=cfg.include_review, accept_unbound=cfg.unbound == "accept")
    flights, walks, left_out = survey(material.candidates, cfg.tracks, findings.tell)
    flights, without_twin = keep_pairs(flights, cfg.pairs, cfg.tracks, findings.tell)
    left_out = left_out + without_twin
    check_alike(flights, findings.tell)
    captions, account = _index(sources, material, flights, findings)
    findings.check()
    if not flights:
        tally = Tally(input=len(material.candidates), dropped=left_out)
        raise stage.nothing_kept(tally, expected="an inspected flight that passed: see report.html of the inspection")
    sized = [
        (
            flight,
            captions[flight.name],
            *selected_bytes(flight, cfg.modalities, cfg.num_frames, account.window_frames, findings.tell),
        )
        for flight in flights
    ]
    findings.check()
    placings = place_flights(flights, walks, cfg.split_by, cfg.fractions, cfg.split_seed)
    return _Plan(
        flights=sized,
        placings=placings,
        shards=shards_of(sized, placings, cfg.shard_mb * MB),
        account=account,
        material=material,
        left_out=left_out,
        window_frames=account.window_frames,
    )


def _index(
    sources: list[Source], material: Material, flights: list[Surveyed], findings: _Findings
) -> tuple[dict[str, FlightCaptions], CaptionAccount]:
    """Find the captions of each flight, by its name."""
    total, found = CaptionAccount(), dict[str, FlightCaptions]()
    for number, source in enumerate(sources):
        own = _by_key([flight for flight in flights if flight.candidate.source == number])
        others: set[FlightKey] = {one.key for one in material.candidates if one.source == number} - own.keys()
        lengths = {key: min(flight.num_frames for flight in group) for key, group in own.items()}
        captions, account = index_captions(source.captions, lengths, others, findings.tell)
        for key, of_flight in captions.items():
            if len(own[key]) > 1 and of_flight.count:
                names = ", ".join(flight.name for flight in own[key])
                what = "captions that may be of any of several flights"
                findings.tell(
                    names, InputError(what, where=source.captions, got=names, fix="release their trees apart")
                )
            found |= {flight.name: of_flight for flight in own[key]}
        total = total + account
    return found, total


def _by_key(flights: list[Surveyed]) -> dict[FlightKey, list[Surveyed]]:
    """Group flights by what their captions call them: of a tree with several towns of one name more than one."""
    groups: dict[FlightKey, list[Surveyed]] = defaultdict(list)
    for flight in flights:
        groups[flight.candidate.key].append(flight)
    return groups


# --- the stage --------------------------------------------------------------------------------------------------------


def part_path(parts: Path, name: str) -> Path:
    return parts / f"{name}.parquet"


def make_worker(plan: ShardPlan, parts: Path) -> Work:
    """Worker factory: give the function that writes one shard."""

    def work(item: Item) -> Outcome:
        return Outcome(write_shard(part_path(parts, item.item_id), item.payload, plan).model_dump())

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
    """Read the playback tree, the captions and, where there is one, the inspection of each run; write `dataset/` and give its path.

    Raises:
        InputError, VerifyError: something is wrong with the material; nothing is published, and what was finished stays for the next run.
    """
    names = input_names(sources)
    inputs = {
        name: source.files[role] for source, roles in zip(sources, names, strict=True) for role, name in roles.items()
    }
    stage = StageFolder.open(out, "release", config=cfg, inputs=inputs, seed=0, resume=resume)
    dataset, parts = out / DATASET, out / PARTS
    if stage.is_complete:
        shutil.rmtree(parts, ignore_errors=True)
        return dataset
    shutil.rmtree(
        dataset, ignore_errors=True
    )  # of another attempt: until this one is whole, there is nothing to publish
    plan = make_plan(cfg, sources, stage)
    maps = maps_of([flight.candidate for flight, *_ in plan.flights])
    licence = choose_licence(
        cfg.licence, [(shown.town, shown.licence) for shown in maps]
    )  # before the work, not after it
    written = _write_parts(cfg, plan, stage, parts, workers, watch)
    history = account_for(plan, written)
    with atomic_folder(dataset) as folder:
        shards = name_shards(_finished(plan, written, parts), folder)
        record = make_record(cfg, sources, plan, written, shards, history, licence, maps, folder, out)
        write_records(folder, record)
        _check_release(folder)
    # checksums.sha256 speaks for the shards: hashing them again would only cost time.
    outputs = [dataset / name for name in ("README.md", "release.json", CHECKSUMS)]
    tally = Tally(input=history.flights.found, kept=history.flights.released, dropped=plan.left_out)
    stage.finish(outputs, tally, history=history.model_dump(mode="json"))
    shutil.rmtree(parts, ignore_errors=True)
    return dataset


def _write_parts(
    cfg: ReleaseConfig, plan: _Plan, stage: StageFolder, parts: Path, workers: int, watch: Watch
) -> list[Written]:
    """Write all shards that are not written yet.

    Raises:
        InputError, VerifyError: a flight cannot be released.
    """
    how = ShardPlan(
        num_frames=cfg.num_frames,
        window_frames=plan.window_frames,
        files=cfg.modalities,
        depth=cfg.depth,
        row_group_bytes=cfg.row_group_mb * MB,
    )
    items = [Item(shard.name, shard.parts, num_steps=shard.num_frames) for shard in plan.shards]
    finished = run_items(stage, items, make_worker, (how, parts), workers=workers, watch=watch, label="release")
    findings = _Findings(stage)
    findings.failures += [record for record in finished.records if isinstance(record, Failed)]
    findings.check()
    written = [result_of(record, Written) for record in finished.kept]
    check_parts(_finished(plan, written, parts), stage.path)
    return written


def _finished(plan: _Plan, written: list[Written], parts: Path) -> list[Finished]:
    return [
        Finished(shard.split, part_path(parts, shard.name), result.rows, result.bytes, result.sha256)
        for shard, result in zip(plan.shards, written, strict=True)
    ]


def _check_release(folder: Path) -> None:
    """See that a release is one, before it has its name.

    Raises:
        VerifyError: names what is wrong.
    """
    report = verify(folder, level="structure")
    if not report.is_ok:
        raise VerifyError("what was built does not verify, so it is not published", where=folder, got=str(report))


# --- the records ------------------------------------------------------------------------------------------------------


def account_for(plan: _Plan, written: list[Written]) -> History:
    """Say where all flights and captions went; every sum is checked here and again by `release verify`."""
    flights = [flight for result in written for flight in result.flights]
    account = plan.account
    captions = CaptionHistory(
        read=account.accepted + account.dropped.total(),
        dropped=dict(sorted(account.dropped.items())),
        accepted=account.accepted,
        released=sum(flight.captions for flight in flights),
        frame_not_selected=sum(flight.frame_not_selected for flight in flights),
        window_not_whole=sum(flight.window_not_whole for flight in flights),
        flight_left_out=account.of_no_flight,
    )
    parts = captions.released + captions.frame_not_selected + captions.window_not_whole + captions.flight_left_out
    assert captions.accepted == parts, captions
    found = FlightHistory(
        found=len(plan.material.candidates),
        inspected=plan.material.num_inspected,
        released=len(flights),
        left_out=dict(sorted(plan.left_out.items())),
    )
    assert found.found == len(flights) + plan.left_out.total(), found
    return History(trajectories=plan.material.trajectories, flights=found, captions=captions)


def splits_of(cfg: ReleaseConfig, plan: _Plan, written: list[Written]) -> Splits:
    """Give what the record says of its splits."""
    surveyed = {flight.name: flight for flight, *_ in plan.flights}
    numbers: dict[SplitName, SplitNumbers] = {}
    for split in SPLIT_NAMES:
        own = [f for result in written for f in result.flights if plan.placings[f.name].split == split]
        if own:
            numbers[split] = SplitNumbers(
                frames=sum(flight.frames for flight in own),
                captions=sum(flight.captions for flight in own),
                flights=len(own),
                trajectories=len({surveyed[flight.name].candidate.trajectory for flight in own}),
                walks=sorted({plan.placings[flight.name].walk for flight in own}),
                towns=sorted({surveyed[flight.name].candidate.place.town for flight in own}),
            )
    return Splits(by=cfg.split_by, rule=SPLIT_RULE, seed=cfg.split_seed, fractions=cfg.fractions, splits=numbers)


def make_record(
    cfg: ReleaseConfig,
    sources: list[Source],
    plan: _Plan,
    written: list[Written],
    shards: list[Shard],
    history: History,
    licence: str,
    maps: list[ReleasedMap],
    folder: Path,
    out: Path,
) -> ReleaseRecord:
    """Give what release.json says of its shards."""
    five_ray = {flight.name: flight.candidate.five_ray_mean for flight, *_ in plan.flights}
    return ReleaseRecord(
        name=cfg.name,
        licence=licence,
        credits=cfg.credits,
        maps=maps,
        made_by=f"cosfly {cosfly.__version__}",
        settings=Settings(
            num_frames=cfg.num_frames,
            window_frames=plan.window_frames,
            tracks=list(cfg.tracks),
            pairs=cfg.pairs,
            modalities=list(cfg.modalities),
        ),
        frame_selection=RULE,
        depth=depth_record(cfg.depth, [result.depth for result in written]) if "depth" in cfg.modalities else None,
        coordinates=columns.CONTRACT,
        splits=splits_of(cfg, plan, written),
        numbers=compute_numbers([folder / shard.path for shard in shards], cfg.num_frames),
        history=history,
        provenance=provenance_of(sources, read_stage_record(out).inputs, plan.account),
        flights=[
            ReleasedFlight(
                flight=flight.name,
                frames=flight.frames,
                frames_available=flight.frames_available,
                split=plan.placings[flight.name].split,
                walk=plan.placings[flight.name].walk,
                pair=plan.placings[flight.name].pair,
                five_ray_mean=five_ray[flight.name],
            )
            for result in written
            for flight in result.flights
        ],
        content_digest=content_digest((shard.split, shard.sha256) for shard in shards),
        shards=shards,
    )
