"""What follows from a rule that `release.json` tells: splits, names of walks and towns, what stages read, who was
asked, the clock of walks."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import numpy as np

from cosfly.products.places import folder_name, town_folder
from cosfly.products.segments import FOLLOW
from cosfly.products.splits import town_family
from cosfly.space.flight_metrics import accel_rms, jerk_rms
from release.flight_rows import FlightRows
from release.record import ReleaseRecord
from release.rules import NAME_OF, SPLIT_RULE, split_groups
from release.verify.findings import Findings

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
CHANGING = ("weather", "time_of_day", "weather_mode", "weather_params")


def check_rules(record: ReleaseRecord, findings: Findings) -> None:
    """Make again what the record's own rules give."""
    _check_split_rule(record, findings)
    _check_names(record, findings)
    _check_stages(record, findings)
    _check_asks(record, findings)
    _check_rejected(record, findings)


def _check_split_rule(record: ReleaseRecord, findings: Findings) -> None:
    """Rank the walks, or families of towns, of all released flights by the told seed. A part of a release holds some of
    them alone."""
    told, shares = record.splits, record.splits.fractions
    if told.rule != SPLIT_RULE:
        findings.error("rule", "release.json: splits.rule", told.rule, SPLIT_RULE)
    is_whole = math.isclose(sum(shares.values()), 1.0, abs_tol=1e-6) and all(0 <= one <= 1 for one in shares.values())
    if shares.keys() != set(NAME_OF.values()) or not is_whole:
        findings.error("rule", "release.json: splits.fractions", shares, "three shares, together 1")
    elif record.flights:
        group_of = {f.flight: f.walk if told.by == "walk" else town_family(f.town) for f in record.flights}
        splits = split_groups(group_of.values(), shares, told.seed, f"{told.by}s")
        for flight in record.flights:
            group = group_of[flight.flight]
            if flight.split != splits[group]:
                expected = f"{splits[group]}, by the rank of {group} under seed {told.seed}"
                findings.error("split", f"{flight.flight}: split", flight.split, expected)


def _check_names(record: ReleaseRecord, findings: Findings) -> None:
    """A walk is called by its first trajectory in the alphabet: a released one, but where flights went for want of
    their twin. A town's folder that render made is named by its map, or by the setting
    `render.town`."""
    trajectories: dict[str, set[str]] = defaultdict(set)
    chosen: dict[str, set[str]] = {}
    for flight in record.flights:
        trajectories[flight.walk].add(flight.trajectory)
        for config in _configs(record, flight.flight, "render"):
            chosen.setdefault(flight.town, set()).add(str(config.get("town") or ""))
    may_be_gone = record.history.flights.left_out.get(WITHOUT_TWIN, 0) > 0
    for walk, own in trajectories.items():
        if walk > min(own) or (walk != min(own) and not may_be_gone):
            expected = f"{min(own)}, the first of its trajectories"
            findings.error("walk", f"release.json: flights: walk {walk}", walk, expected)
    for one in record.maps:
        names = {one.name, *chosen.get(one.town, ())} - {""}
        if one.town in chosen and one.town not in {
            form(name) for name in names for form in (str, folder_name, town_folder)
        }:
            findings.error("map", f"release.json: maps: {one.town}", one.name, f"the map that {one.town} is named by")


def _configs(record: ReleaseRecord, flight: str, stage: str) -> list[dict[str, Any]]:
    """Give the settings of a stage, of the sources that a flight may be of; folders above a town are part of its run's
    name."""
    own = (source for source in record.provenance.sources if source.has(flight.split("/")[0]))
    return [made.config for source in own for made in source.stages if made.stage == stage]


def _check_stages(record: ReleaseRecord, findings: Findings) -> None:
    """Captions and inspection were made of the released tree. Walks, flights, pictures and inspection go by one
    simplified map, which was made of the map that is drawn."""
    for source in record.provenance.sources:
        inputs = {stage.stage: stage.inputs for stage in source.stages}  # the last is the one whose product was given
        place = f"release.json: provenance: {source.run}"
        for name in ("caption", "inspect"):
            got = inputs.get(name, {}).get("data")
            if got not in (None, source.tree_sha256):
                findings.error("provenance", f"{place}: {name}: inputs.data", got, f"{source.tree_sha256}, the tree's")
        for name, readers in MAPS_BETWEEN.items():
            told = {f"{stage}.{key}": inputs[stage][key] for stage, key in readers if key in inputs.get(stage, {})}
            if len(set(told.values())) > 1:
                expected = f"one {name} in all of them, unless they were made of several on purpose"
                findings.warn("provenance", f"{place}: inputs", told, expected)


def _check_asks(record: ReleaseRecord, findings: Findings) -> None:
    """Every accepted caption is an answer; rules take no tokens. Who answered and how long windows are stands in the
    settings of the stage that made the captions."""
    told, accepted, place = record.provenance, record.history.captions.accepted, "release.json: provenance"
    kinds = {teacher.kind for teacher in told.teachers}
    if told.asks < accepted:
        findings.error("provenance", f"{place}.asks", told.asks, f"{accepted} or more, one for each accepted caption")
    if any(told.tokens.values()) and kinds <= {RULES}:
        findings.error("provenance", f"{place}.tokens", told.tokens, "none: the only teacher is rules")
    configs = [stage.config for source in told.sources for stage in source.stages if stage.stage == "caption"]
    if not configs or len(configs) < len(told.sources):
        return
    windows = {config["window"]["num_frames"] for config in configs if "num_frames" in config.get("window", {})}
    frames = record.settings.window_frames
    if windows and record.numbers.captions.frames_with and frames not in windows:
        expected = f"one of {sorted(windows)}, as captions were made"
        findings.error("provenance", "release.json: settings.window_frames", frames, expected)
    if {config.get("teacher") for config in configs} == {RULES} and not kinds <= {RULES}:
        expected = "rules, as the settings of the captions say"
        findings.error("provenance", f"{place}.teachers", sorted(kinds), expected)


def _check_rejected(record: ReleaseRecord, findings: Findings) -> None:
    """What the inspection left out says why, and a rejected flight makes a rejected trajectory; only one without a plan
    counts for none."""
    planned, left_out, place = record.history.trajectories, record.history.flights.left_out, "release.json: history"
    results = {reason: reason.partition(": ") for reason in left_out}
    rejected = sum(left_out[reason] for reason, (result, *_) in results.items() if result == "rejected")
    for reason, (result, _, why) in results.items():
        if result in ("rejected", "review") and not why:
            findings.error("sum", f"{place}.flights.left_out: {reason}", reason, "the result and its reason")
    if left_out.get(REVIEWED) and not any(source.review_sha256 for source in record.provenance.sources):
        expected = f"a digest of the decisions: {left_out[REVIEWED]} flights are {REVIEWED}"
        findings.warn("provenance", "release.json: provenance.sources: review_sha256", "null", expected)
    if planned is not None and rejected and not planned.rejected:
        expected = f"1 or more: {rejected} flights were rejected, unless nobody here planned them"
        findings.warn("sum", f"{place}.trajectories.rejected", 0, expected)
    if planned is not None and rejected < planned.rejected:
        expected = f"{rejected} or fewer, the flights that were left out for it"
        findings.error("sum", f"{place}.trajectories.rejected", planned.rejected, expected)


# --- rows against the settings of the stages that made them -----------------------------------------------------------


def check_settings(flight: FlightRows, settings: dict[str, dict[str, Any]], findings: Findings) -> None:
    """What stages were told is what the rows have. settings: by stage; nothing of those of which nobody tells."""
    row = flight.rows[0]

    def tell(column: str, got: object, expected: str, i: int = 0) -> None:
        findings.error("settings", flight.where(i, column), got, expected)

    if drawn := settings.get("render"):
        size, own = (drawn.get("width_px"), drawn.get("height_px")), (row.get("width_px"), row.get("height_px"))
        if None not in size and size != own:
            tell("width_px", f"{own[0]} x {own[1]} px", f"{size[0]} x {size[1]} px, as render was told")
        fovs, is_fixed = drawn.get("fovs_deg"), (drawn.get("zoom") or {}).get("mode", "fixed") == "fixed"
        if fovs and is_fixed and not any(abs(row.get("fov_deg", fov) - fov) < FOV_DEG for fov in fovs):
            tell("fov_deg", row.get("fov_deg"), f"one of {fovs}, as render was told")
        if drawn.get("weather_mode", "off") == "off":
            for name in (name for name in CHANGING if row.get(name) is not None):
                tell(name, row[name], "null: render was told of no weather")
            if drawn.get("look") and row.get("look") and row["look"] != drawn["look"]:
                tell("look", row["look"], f"{drawn['look']}, as render was told")
    shares = settings.get("plan", {}).get("styles")
    if isinstance(shares, dict):
        styles = {None, FOLLOW, *(name for name, share in shares.items() if share)}
        for i in (i for i, style in enumerate(flight.column("style")) if style not in styles):
            tell("style", flight.rows[i]["style"], f"one of {', '.join(sorted(styles - {None}))}, as plan was told", i)
    walk_s, stride = settings.get("pedestrians", {}).get("dt_s"), settings.get("render", {}).get("frame_stride", 1)
    if isinstance(walk_s, int | float) and walk_s > 0 and isinstance(stride, int):
        step_s = walk_s * stride
        findings.judge(flight, [(
            "time", "time_s", np.abs(flight.time_s - flight.index * step_s) > TIME_S,
            lambda i: f"{flight.time_s[i]:g} s",
            lambda i: f"{flight.index[i] * step_s:g} s, {flight.index[i]} frames of {stride} steps of {walk_s:g} s",
        )])  # fmt: skip
    inspected = settings.get("inspect", {})
    # Of a whole clean flight; of others the plan is not released.
    if len(flight) >= LEAST_POINTS and flight.num_frames == len(flight) and flight.is_clean:
        dt_s = float(np.median(np.diff(flight.time_s)))
        for name, rms in (("accel_rms_max_mps2", accel_rms), ("jerk_rms_max_mps3", jerk_rms)):
            most, found = inspected.get(name), rms(flight.pose[:, :3], dt_s)
            if isinstance(most, int | float) and found > most * (1.0 + RMS_SHARE) + RMS_ROUNDING:
                tell("pose", f"{found:.2f} of motion", f"at most {most:g}, as inspect was told of {name}")
