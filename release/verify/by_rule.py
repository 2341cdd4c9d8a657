"""What follows from a rule that `release.json` tells: splits, names of walks and towns, what stages read, who was asked, the clock of walks."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.products.places import folder_name, town_folder
from cosfly.products.segments import FOLLOW
from cosfly.products.splits import town_family
from cosfly.reading.tables import row_groups
from cosfly.space.flight_metrics import accel_rms, jerk_rms
from release.columns import PLACE
from release.record import ReleasedFlight, ReleaseRecord, SourceRecord
from release.rules import NAME_OF, SPLIT_RULE, split_groups
from release.verify.findings import Findings
from release.verify.rows import FlightRows

WITHOUT_TWIN = "its twin is not released"  # of flights that were left out after walks had their names
TIME_S = 1e-3  # times are written with three digits at least
FOV_DEG = 0.01
LEAST_POINTS = 10
# Files keep tenths of millimetres, which three differences over half a second make a hundredth of a m/s^3.
RMS_SHARE, RMS_ROUNDING = 0.02, 0.01
REVIEWED = "rejected: review"  # by people: docs/files.md, "Decisions"
RULES = "rules"  # the kind of teacher that asks nobody

# Which stages read the same map, and under which name of their inputs.
MAPS_BETWEEN = {
    "simplified map": (("pedestrians", "map"), ("plan", "map"), ("render", "simplified"), ("inspect", "simplified")),
    "map": (("simplify", "maps"), ("render", "boxes")),
}


def check_rules(record: ReleaseRecord, findings: Findings) -> None:
    """Make again what the record's own rules give."""
    _check_split_rule(record, findings)
    _check_walk_names(record, findings)
    _check_towns(record, findings)
    _check_inputs(record, findings)
    _check_maps_between(record, findings)
    _check_asks(record, findings)
    _check_rejected(record, findings)
    _check_caption_settings(record, findings)


def _check_split_rule(record: ReleaseRecord, findings: Findings) -> None:
    """Rank the walks, or families of towns, of all released flights by the told seed. A part of a release holds some of them alone."""
    told = record.splits
    if told.rule != SPLIT_RULE:
        findings.error("rule", "release.json: splits.rule", told.rule, SPLIT_RULE)
    shares = told.fractions
    if shares.keys() != set(NAME_OF.values()) or not all(0 <= share <= 1 for share in shares.values()) or not math.isclose(sum(shares.values()), 1.0, abs_tol=1e-6):  # fmt: skip
        findings.error("rule", "release.json: splits.fractions", shares, "three shares, together 1")
        return
    if record.part_of is not None or not record.flights:
        return
    group_of = {f.flight: f.walk if told.by == "walk" else town_family(_town(f)) for f in record.flights}
    splits = split_groups(group_of.values(), shares, told.seed, f"{told.by}s")
    for flight in record.flights:
        if flight.split != splits[group_of[flight.flight]]:
            expected = (
                f"{splits[group_of[flight.flight]]}, by the rank of {group_of[flight.flight]} under seed {told.seed}"
            )
            findings.error("split", f"{flight.flight}: split", flight.split, expected)


def _town(flight: ReleasedFlight) -> str:
    return f"{flight.flight}//".split("/")[1]


def _check_walk_names(record: ReleaseRecord, findings: Findings) -> None:
    """A walk is called by its first trajectory in the alphabet: a released one, but where flights went for want of their twin, or were not asked for."""
    trajectories: dict[str, set[str]] = defaultdict(set)
    for flight in record.flights:
        trajectories[flight.walk].add(flight.flight.rpartition("/")[0])
    may_be_gone = record.part_of is not None or record.history.flights.left_out.get(WITHOUT_TWIN, 0) > 0
    for walk, own in trajectories.items():
        first = min(own)
        if walk > first or (walk != first and not may_be_gone):
            findings.error(
                "walk", f"release.json: flights: walk {walk}", walk, f"{first}, the first of its trajectories"
            )


def _check_towns(record: ReleaseRecord, findings: Findings) -> None:
    """A town's folder that render made is named by its map, or by the setting `render.town`; older ones lack `Town_` in front."""
    chosen: dict[str, set[str]] = {}
    for flight in record.flights:
        stages = [stage for source in _sources_of(record, flight.flight) for stage in source.stages if stage.stage == "render"]  # fmt: skip
        if stages:
            names = {str(stage.config["town"]) for stage in stages if stage.config.get("town")}
            chosen.setdefault(_town(flight), set()).update(names)
    for one in record.maps:
        names = {one.name} | chosen.get(one.town, set())
        if one.town in chosen and one.town not in {form for name in names for form in (name, folder_name(name), town_folder(name))}:  # fmt: skip
            findings.error("map", f"release.json: maps: {one.town}", one.name, f"the map that {one.town} is named by")


def _sources_of(record: ReleaseRecord, flight: str) -> list[SourceRecord]:
    """Give the sources that a flight may be of; folders above a town are part of its run's name."""
    run = flight.split("/")[0]
    return [source for source in record.provenance.sources if run == source.run or run.startswith(f"{source.run}_")]


def _check_inputs(record: ReleaseRecord, findings: Findings) -> None:
    """Captions and inspection were made of the released tree."""
    for source in record.provenance.sources:
        last = {stage.stage: stage for stage in source.stages}  # the one whose product was given
        for name in ("caption", "inspect"):
            got = last[name].inputs.get("data") if name in last else None
            if got is not None and got != source.tree_sha256:
                findings.error("provenance", f"release.json: provenance: {source.run}: {name}: inputs.data", got, f"{source.tree_sha256}, the tree's")  # fmt: skip


def _check_maps_between(record: ReleaseRecord, findings: Findings) -> None:
    """Walks, flights, pictures and inspection go by one simplified map, which was made of the map that is drawn."""
    for source in record.provenance.sources:
        inputs = {stage.stage: stage.inputs for stage in source.stages}
        for name, readers in MAPS_BETWEEN.items():
            told = {f"{stage}.{key}": inputs[stage][key] for stage, key in readers if key in inputs.get(stage, {})}
            if len(set(told.values())) > 1:
                findings.warn("provenance", f"release.json: provenance: {source.run}: inputs", told, f"one {name} in all of them, unless they were made of several on purpose")  # fmt: skip


def _check_asks(record: ReleaseRecord, findings: Findings) -> None:
    """Every accepted caption is an answer; rules take no tokens."""
    told, accepted = record.provenance, record.history.captions.accepted
    if told.asks < accepted:
        findings.error("provenance", "release.json: provenance.asks", told.asks, f"{accepted} or more, one for each accepted caption")  # fmt: skip
    if any(told.tokens.values()) and {teacher.kind for teacher in told.teachers} <= {RULES}:
        findings.error("provenance", "release.json: provenance.tokens", told.tokens, "none: the only teacher is rules")


def _check_rejected(record: ReleaseRecord, findings: Findings) -> None:
    """What the inspection left out says why, and a rejected flight makes a rejected trajectory; only one without a plan counts for none."""
    planned, left_out = record.history.trajectories, record.history.flights.left_out
    rejected = 0
    for reason, count in left_out.items():
        result, _, why = reason.partition(": ")
        rejected += count if result == "rejected" else 0
        if result in ("rejected", "review") and not why:
            findings.error(
                "sum", f"release.json: history.flights.left_out: {reason}", reason, "the result and its reason"
            )
    if left_out.get(REVIEWED) and not any(source.review_sha256 for source in record.provenance.sources):
        findings.warn("provenance", "release.json: provenance.sources: review_sha256", "null", f"a digest of the decisions: {left_out[REVIEWED]} flights are {REVIEWED}")  # fmt: skip
    if planned is not None and rejected and not planned.rejected:
        findings.warn("sum", "release.json: history.trajectories.rejected", 0, f"1 or more: {rejected} flights were rejected, unless nobody here planned them")  # fmt: skip
    if planned is not None and rejected < planned.rejected:
        findings.error("sum", "release.json: history.trajectories.rejected", planned.rejected, f"{rejected} or fewer, the flights that were left out for it")  # fmt: skip


def _check_caption_settings(record: ReleaseRecord, findings: Findings) -> None:
    """Who answered and how long windows are stands in the settings of the stage that made the captions."""
    configs = [stage.config for source in record.provenance.sources for stage in source.stages if stage.stage == "caption"]  # fmt: skip
    if not configs or len(configs) < len(record.provenance.sources):
        return
    windows = {config["window"]["num_frames"] for config in configs if "num_frames" in config.get("window", {})}
    if windows and record.numbers.captions.frames_with and record.settings.window_frames not in windows:
        findings.error("provenance", "release.json: settings.window_frames", record.settings.window_frames, f"one of {sorted(windows)}, as captions were made")  # fmt: skip
    kinds = {teacher.kind for teacher in record.provenance.teachers}
    if {config.get("teacher") for config in configs} == {RULES} and not kinds <= {RULES}:
        findings.error("provenance", "release.json: provenance.teachers", sorted(kinds), "rules, as the settings of the captions say")  # fmt: skip


def check_drawn(flight: FlightRows, settings: dict[str, Any], findings: Findings) -> None:
    """What `render` was told is what the rows have: size, field of view, light, weather.

    Args:
        settings: of the stage `render`; empty where nobody tells.
    """
    row = flight.rows[0]
    size = (settings.get("width_px"), settings.get("height_px"))
    if None not in size and size != (row.get("width_px"), row.get("height_px")):
        findings.error("settings", flight.where(0, "width_px"), f"{row.get('width_px')} x {row.get('height_px')} px", f"{size[0]} x {size[1]} px, as render was told")  # fmt: skip
    fovs, zoom = settings.get("fovs_deg"), settings.get("zoom") or {}
    if fovs and zoom.get("mode", "fixed") == "fixed" and not any(abs(row.get("fov_deg", fov) - fov) < FOV_DEG for fov in fovs):  # fmt: skip
        findings.error("settings", flight.where(0, "fov_deg"), row.get("fov_deg"), f"one of {fovs}, as render was told")
    if not settings or settings.get("weather_mode", "off") != "off":
        return
    for name in ("weather", "time_of_day", "weather_mode", "weather_params"):
        if row.get(name) is not None:
            findings.error("settings", flight.where(0, name), row[name], "null: render was told of no weather")
    look = settings.get("look")
    if look and row.get("look") and row["look"] != look:
        findings.error("settings", flight.where(0, "look"), row["look"], f"{look}, as render was told")


def check_style(flight: FlightRows, settings: dict[str, Any], findings: Findings) -> None:
    """What a flight is flown as is one of the styles that `plan` was told to draw from, or `follow`. settings: of the stage."""
    shares = settings.get("styles")
    drawn = {FOLLOW, *(name for name, share in shares.items() if share)} if isinstance(shares, dict) else None
    for i, style in enumerate(flight.column("style")):
        if drawn is not None and style is not None and style not in drawn:
            findings.error("settings", flight.where(i, "style"), style, f"one of {sorted(drawn)}, as plan was told")


def check_inspected(flight: FlightRows, settings: dict[str, Any], findings: Findings) -> None:
    """A whole clean flight keeps the bounds of motion that its inspection was told; of others the plan is not released.

    Args:
        settings: of the stage `inspect`; empty where nobody tells.
    """
    if not settings or len(flight) < LEAST_POINTS or flight.num_frames != len(flight) or flight.rows[0].get("track") != "clean":  # fmt: skip
        return
    dt_s = float(np.median(np.diff(flight.time_s)))
    for name, rms in (("accel_rms_max_mps2", accel_rms), ("jerk_rms_max_mps3", jerk_rms)):
        most, found = settings.get(name), rms(flight.pose[:, :3], dt_s)
        if isinstance(most, int | float) and found > most * (1.0 + RMS_SHARE) + RMS_ROUNDING:
            findings.error("settings", flight.name, f"{found:.2f} of motion", f"at most {most:g}, as inspect was told of {name}")  # fmt: skip


def check_clock(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """Walks that `pedestrians` made are sampled from 0 s on, every `dt_s`: so are their flights.

    Raises:
        InputError: a shard cannot be read.
    """
    steps_of: dict[str, list[float]] = {}
    for flight in record.flights:
        configs = [stage.config for source in _sources_of(record, flight.flight) for stage in source.stages if stage.stage == "pedestrians"]  # fmt: skip
        told = {config.get("dt_s") for config in configs}
        steps_of[flight.flight] = [float(step) for step in told if isinstance(step, int | float) and step > 0]
    if not any(steps_of.values()):
        return
    wrong: set[str] = set()
    for shard in record.shards:
        for group in row_groups(folder / shard.path, [*PLACE, "frame_index", "time_s"], tree=folder):
            rows = group.to_pydict()
            places = ("/".join(map(str, place)) for place in zip(*(rows[name] for name in PLACE), strict=True))
            for name, index, time_s in zip(places, rows["frame_index"], rows["time_s"], strict=True):
                steps = steps_of.get(name)
                if name in wrong or not steps or index is None or time_s is None:
                    continue
                if not min(abs(time_s - index * step) for step in steps) <= TIME_S:
                    wrong.add(name)
                    expected = f"{index * steps[0]:g} s, {index} steps of the walk's {steps[0]:g} s"
                    findings.error("time", f"{name} frame {index}: time_s", f"{time_s:g} s", expected)
