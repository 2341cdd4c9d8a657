"""Step 6, `cosfly inspect`: measure every flight, accept it, route it to a person, or reject it (sec:step6).

Reads `step2_simplified.json`, `drone_trace.json` and the playback tree, writes `inspect.json` and a self-contained
`report.html`. Changes nothing in the tree. The folder is not called `inspect`: a file of that name would hide the
standard library's.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

from cosfly.formats.boxes import read_boxes
from cosfly.formats.frames import FRAMES_DIR
from cosfly.formats.inspection import (
    Funnel,
    Inspection,
    TrackFunnel,
    TrackInspection,
    TrajectoryFunnel,
    count_trajectories,
    write_inspection,
)
from cosfly.formats.issues import Report
from cosfly.formats.playback import read_track
from cosfly.formats.review import how_to_decide
from cosfly.formats.traces import DroneTrace, read_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.coverage import Coverage
from cosfly.inspection.report import report_html
from cosfly.inspection.settings import PAGE_MB, InspectConfig
from cosfly.inspection.track import InspectedTrack, inspect_track, trace_id
from cosfly.inspection.view import TrackView
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.pool import ItemOutcomes, Watch, run_items
from cosfly.runtime.run_dir import Failed, Resume, StageFolder, recorded_digests, result_of
from cosfly.runtime.worker import Item, Outcome, Work
from cosfly.viz.page import run_name

log = logging.getLogger(__name__)


def make_worker(cfg: InspectConfig, simplified: Path | None, traces: Path | None, data: Path) -> Work:
    """Worker factory: give the function that inspects one flight folder."""
    from cosfly.geometry.kernels import obstacle_index

    box_map = None if simplified is None else read_boxes(simplified)
    obstacles = None if box_map is None else obstacle_index(box_map)
    by_id = None if traces is None else {trace.path_id: trace for trace in read_traces(traces)}
    recorded = recorded_digests(data)

    def work(item: Item) -> Outcome:
        inspected = inspect_track(data / item.payload, data, by_id, box_map, obstacles, cfg, recorded)
        record = inspected.record
        return Outcome(
            inspected.model_dump(mode="json"), drop_reason=record.reason if record.result == "rejected" else None
        )

    return work


def run(
    cfg: InspectConfig,
    simplified: Path | None,
    traces: Path | None,
    data: Path,
    out: Path,
    *,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Read the simplified map, the plans and the playback tree, write `inspect.json` and `report.html`; give the
    former's path.

    Args:
        simplified, traces: `step2_simplified.json`, `drone_trace.json`; None for a tree of somebody else: nothing is
            held against them.
    Raises:
        NothingKept: every flight was rejected; both files are there and say why.
    """
    given = {"simplified": simplified, "traces": traces, "data": data}
    inputs = {name: path for name, path in given.items() if path is not None}
    # Flights of the tree that were changed since are found one by one, and rejected.
    stage = StageFolder.open(out, "inspect", config=cfg, inputs=inputs, seed=0, resume=resume, audited=("data",))
    product = out / "inspect.json"
    if stage.is_complete:
        return product
    planned = None if traces is None else read_traces(traces)
    names = [folder.relative_to(data).as_posix() for folder in find_tracks(data, cfg.flights)]
    every = cfg.check_pixels == "all"  # then a frame is a step
    items = [Item(name, name, num_steps=_num_frames(data / name) if every else None) for name in names]
    arguments, label = (cfg, simplified, traces, data), "inspect: frames" if every else "inspect: flights"
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label=label)
    inspection, views = assemble(finished, planned, cfg, data)
    write_inspection(product, inspection)
    write_bytes(out / "report.html", report_html(run_name(out), inspection, views, PAGE_MB).encode())
    stage.finish([product, out / "report.html"], finished.tally, funnel=inspection.funnel.model_dump(mode="json"))
    _tell_review(inspection.funnel.flights, out)
    return product


def _tell_review(flights: TrackFunnel, out: Path) -> None:
    """Return which flights wait for a person: loudly where no other is left, so that a release would be empty."""
    if flights.review:
        level = logging.INFO if flights.accepted else logging.WARNING
        reasons = ", ".join(f"{code} {count}" for code, count in flights.reasons.items())
        log.log(
            level,
            "inspect: %d of %d flights wait for a person (%s): %s",
            flights.review,
            flights.inspected,
            reasons,
            how_to_decide(out),
        )


def _num_frames(folder: Path) -> int:
    """About how many frames a flight has, for the progress bar: its folders are counted, nothing is read."""
    return max(1, sum(1 for _ in (folder / FRAMES_DIR).glob("frame_*")))


def assemble(
    finished: ItemOutcomes, planned: list[DroneTrace] | None, cfg: InspectConfig, data: Path
) -> tuple[Inspection, dict[str, TrackView]]:
    """Put the outcomes of all flights together: the inspection, and the report's material by flight folder."""
    flights: list[TrackInspection] = []
    views: dict[str, TrackView] = {}
    covered: list[Coverage] = []
    for outcome in finished.records:
        if isinstance(outcome, Failed):
            flights.append(_unreadable(outcome, planned or [], data))
        else:
            inspected = result_of(outcome, InspectedTrack)
            flights.append(inspected.record)
            views[outcome.id] = inspected.view
            if inspected.record.result == "accepted":
                covered.append(inspected.coverage)
    flights = _with_twins_trace(flights)
    funnel = Funnel(trajectories=_trajectory_funnel(flights, planned), flights=_flight_funnel(flights))
    funnel.trajectories.check()
    settings, coverage = cfg.model_dump(mode="json"), Coverage.total(covered)
    return Inspection(settings=settings, funnel=funnel, coverage=coverage, flights=flights), views


def _unreadable(outcome: Failed, planned: list[DroneTrace], data: Path) -> TrackInspection:
    """Return the record of a flight whose inspection failed: rejected, for the reason that the error names."""
    town, trajectory, variant = ("", "", *outcome.id.split("/"))[-3:]
    report = Report()
    report.error("unreadable", outcome.id, outcome.message.replace(f"{data}/", ""), "a flight that can be read")
    return TrackInspection(
        town=town, trajectory=trajectory, variant=variant, folder=outcome.id,
        trace_id=_planned_id(data / outcome.id, planned), result="rejected", issues=report.issues, metrics={},
    )  # fmt: skip


def _planned_id(folder: Path, planned: list[DroneTrace]) -> str | None:
    """Name the plan of a flight whose inspection failed; None where it cannot be read."""
    try:
        found = trace_id(read_track(folder, strict=False))
    except InputError:
        return None
    return found if any(trace.path_id == found for trace in planned) else None


def _with_twins_trace(flights: list[TrackInspection]) -> list[TrackInspection]:
    """Return an unreadable flight the trace of its twin, so that the funnel counts it there."""
    known = {Path(flight.folder).parent: flight.trace_id for flight in flights if flight.trace_id is not None}
    return [
        flight.model_copy(update={"trace_id": flight.trace_id or known.get(Path(flight.folder).parent)})
        for flight in flights
    ]


def _trajectory_funnel(flights: list[TrackInspection], planned: list[DroneTrace] | None) -> TrajectoryFunnel:
    """Count planned trajectories on their way; of an original and its perturbed twin the worse one decides.

    Without plans those that are there count as planned.
    """
    counts = count_trajectories(flights, planned=planned is not None)
    rendered = {flight.trace_id for flight in flights}
    dropped = Counter(
        str(t.drop_reason) for t in planned or [] if t.drop_reason is not None and t.path_id not in rendered
    )
    num_planned = counts["rendered"] if planned is None else len(planned)
    return TrajectoryFunnel(
        planned=num_planned,
        dropped=dict(sorted(dropped.items())),
        not_rendered=num_planned - sum(dropped.values()) - counts["rendered"],
        **counts,
    )


def _flight_funnel(flights: list[TrackInspection]) -> TrackFunnel:
    results = Counter(flight.result for flight in flights)
    reasons = Counter(flight.reason for flight in flights if flight.reason is not None)
    return TrackFunnel(
        inspected=len(flights),
        accepted=results["accepted"],
        review=results["review"],
        rejected=results["rejected"],
        without_trace=sum(flight.trace_id is None for flight in flights),
        reasons=dict(sorted(reasons.items())),
    )
