"""What `release.json` says of a release: where all flights and captions went, its splits, and the whole record."""

from __future__ import annotations

import cosfly
from cosfly.work import in_place
from release import columns
from release.columns import SPLIT_NAMES, SplitName
from release.package.config import ReleaseConfig
from release.package.depth import depth_record
from release.package.plan import Plan
from release.package.shards import Written
from release.record import (
    CaptionHistory,
    FlightHistory,
    History,
    Numbers,
    Provenance,
    ReleasedFlight,
    ReleaseRecord,
    Settings,
    Shard,
    SplitNumbers,
    Splits,
    content_digest,
)
from release.splits import SPLIT_RULE
from release.subsample import RULE


def account_for(plan: Plan, written: list[Written]) -> History:
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


def splits_of(cfg: ReleaseConfig, plan: Plan, written: list[Written]) -> Splits:
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
    plan: Plan,
    written: list[Written],
    shards: list[Shard],
    numbers: Numbers,
    provenance: Provenance,
    prompts: dict[str, dict[str, str]],
) -> ReleaseRecord:
    """Give what release.json says of its shards. prompts: as the record has them."""
    five_ray = {flight.name: flight.candidate.five_ray_mean for flight, *_ in plan.flights}
    return ReleaseRecord(
        name=cfg.name,
        licence=plan.licence,
        credits=cfg.credits,
        maps=plan.maps,
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
        actions=in_place.given("actions"),
        prompts=prompts,
        splits=splits_of(cfg, plan, written),
        numbers=numbers,
        history=account_for(plan, written),
        provenance=provenance,
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
