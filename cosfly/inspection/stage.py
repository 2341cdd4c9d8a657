"""Step 6, `cosfly inspect`: measures every track and accepts it, sends it to review, or rejects it (sec:step6).

Changes nothing in the tree. The package is not called `inspect`, which would hide the standard library's module.
"""

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
    how_to_decide,
    write_inspection,
)
from cosfly.formats.issues import Report
from cosfly.formats.playback_file import read_track
from cosfly.formats.traces import DroneTrace, read_traces, read_yaw_rate_max
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.trajectory_metrics import YAW_RATE_MAX_DEGPS
from cosfly.inspection.report import ReportPicture, report_html
from cosfly.inspection.settings import InspectConfig
from cosfly.inspection.track import InspectedTrack, inspect_track, trace_id
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.pool import ItemOutcomes, Watch, run_items
from cosfly.runtime.run_dir import Failed, StageFolder, result_of
from cosfly.runtime.worker import Item, Outcome, Work
from cosfly.viz.page import run_name

log = logging.getLogger(__name__)


def make_worker(cfg: InspectConfig, simplified: Path | None, traces: Path | None, data: Path) -> Work:
    """Open map and plans in this process; return the function that inspects one track."""
    from cosfly.geometry.kernels import obstacle_index

    obstacles = None if simplified is None else obstacle_index(read_boxes(simplified))
    by_id = None if traces is None else {trace.path_id: trace for trace in read_traces(traces)}
    limit_degps = YAW_RATE_MAX_DEGPS if traces is None else read_yaw_rate_max(traces, YAW_RATE_MAX_DEGPS)

    def work(item: Item) -> Outcome:
        inspected = inspect_track(data / item.payload, data, by_id, obstacles, cfg, limit_degps)
        record = inspected.record
        return Outcome(
            inspected.model_dump(mode="json"), drop_reason=record.reason if record.result == "rejected" else None
        )

    return work


def run(
    cfg: InspectConfig, simplified: Path | None, traces: Path | None, data: Path, out: Path, *, workers: int = 0,
    watch: Watch = Watch(),
) -> Path:  # fmt: skip
    """Read the simplified map, the plans and the playback tree; write `inspect.json` and `report.html`. Return the path
    of `inspect.json`.

    Args:
        simplified, traces: `step2_simplified.json`, `drone_trace.json`; None for a tree of another program.

    Raises:
        NothingKept: Every track was rejected; both files are written and give the reasons.
    """
    optional_inputs = {"simplified": simplified, "traces": traces, "data": data}
    inputs = {name: path for name, path in optional_inputs.items() if path is not None}
    # A track that was changed after rendering does not stop the stage: it is rejected.
    stage = StageFolder.open(out, "inspect", config=cfg, inputs=inputs, seed=0, audited=("data",))
    product = out / "inspect.json"
    if stage.is_complete:
        return product
    planned = None if traces is None else read_traces(traces)
    names = [folder.relative_to(data).as_posix() for folder in find_tracks(data, cfg.flights)]
    # About as many steps as frames, for the progress bar.
    frames = [sum(1 for _ in (data / name / FRAMES_DIR).glob("frame_*")) for name in names]
    items = [Item(name, name, num_steps=max(1, count)) for name, count in zip(names, frames, strict=True)]
    arguments = (cfg, simplified, traces, data)
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="inspect: frames")
    inspection, pictures = assemble(finished, planned, cfg, data)
    write_inspection(product, inspection)
    write_bytes(out / "report.html", report_html(run_name(out), inspection, pictures).encode())
    stage.finish([product, out / "report.html"], finished.tally, funnel=inspection.funnel.model_dump(mode="json"))
    _log_review(inspection.funnel.flights, out)
    return product


def _log_review(counts: TrackFunnel, out: Path) -> None:
    """Log how many tracks wait for review, as a warning if none is accepted, since a release would be empty."""
    reasons = ", ".join(f"{code} {count}" for code, count in counts.reasons.items())
    if counts.review:
        log.log(
            logging.INFO if counts.accepted else logging.WARNING,
            "inspect: %d of %d tracks need a decision by a person (%s): %s",
            counts.review, counts.inspected, reasons, how_to_decide(out),
        )  # fmt: skip


def assemble(
    finished: ItemOutcomes, planned: list[DroneTrace] | None, cfg: InspectConfig, data: Path
) -> tuple[Inspection, dict[str, list[ReportPicture]]]:
    """Merge the outcomes of all tracks: the inspection, and the report's pictures by track folder."""
    tracks = list[TrackInspection]()
    pictures = dict[str, list[ReportPicture]]()
    for outcome in finished.records:
        if isinstance(outcome, Failed):
            tracks.append(_unreadable(outcome, planned or [], data))
            continue
        inspected = result_of(outcome, InspectedTrack)
        tracks.append(inspected.record)
        pictures[outcome.id] = inspected.pictures
    # An unreadable track gets the plan of the other track of its trajectory.
    trace_ids = {Path(track.folder).parent: track.trace_id for track in tracks if track.trace_id is not None}
    planned_as = [track.trace_id or trace_ids.get(Path(track.folder).parent) for track in tracks]
    tracks = [track.model_copy(update={"trace_id": i}) for track, i in zip(tracks, planned_as, strict=True)]
    funnel = Funnel(trajectories=_trajectory_funnel(tracks, planned), flights=_track_funnel(tracks))
    funnel.trajectories.check()
    return Inspection(settings=cfg.model_dump(mode="json"), funnel=funnel, flights=tracks), pictures


def _unreadable(outcome: Failed, planned: list[DroneTrace], data: Path) -> TrackInspection:
    """Return the record of a track whose inspection failed: rejected, for the reason of the error."""
    # The id is the track's folder, town/trajectory/variant; a folder less deep in the tree has the last parts only.
    town, trajectory, variant = ("", "", *outcome.id.split("/"))[-3:]
    report = Report()
    report.error("unreadable", outcome.id, outcome.message.replace(f"{data}/", ""), "a track that can be read")
    try:
        plan_id = trace_id(read_track(data / outcome.id))
    except InputError:
        plan_id = ""
    return TrackInspection(
        town=town, trajectory=trajectory, variant=variant, folder=outcome.id, result="rejected", metrics={},
        trace_id=plan_id if any(trace.path_id == plan_id for trace in planned) else None, issues=report.issues,
    )  # fmt: skip


def _trajectory_funnel(tracks: list[TrackInspection], planned: list[DroneTrace] | None) -> TrajectoryFunnel:
    """Count planned trajectories by outcome; the worse track of a trajectory decides. Without plans all are planned."""
    counts = count_trajectories(tracks, planned=planned is not None)
    rendered = {track.trace_id for track in tracks}
    reasons = [trace.drop_reason for trace in planned or [] if trace.path_id not in rendered]
    dropped = dict(sorted(Counter(reason for reason in reasons if reason is not None).items()))
    num_planned = counts["rendered"] if planned is None else len(planned)
    not_rendered = num_planned - sum(dropped.values()) - counts["rendered"]
    return TrajectoryFunnel(planned=num_planned, dropped=dropped, not_rendered=not_rendered, **counts)


def _track_funnel(tracks: list[TrackInspection]) -> TrackFunnel:
    results = Counter(track.result for track in tracks)
    reasons = Counter(track.reason for track in tracks if track.reason is not None)
    return TrackFunnel(
        inspected=len(tracks), accepted=results["accepted"], review=results["review"], rejected=results["rejected"],
        without_trace=sum(track.trace_id is None for track in tracks), reasons=dict(sorted(reasons.items())),
    )  # fmt: skip
