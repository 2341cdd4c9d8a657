"""The tables: from what was counted, and from what the record says of flights and captions that were left out."""

from __future__ import annotations

from collections import Counter, defaultdict

from cosfly.products.frames import LEVEL_NAMES
from cosfly.products.weather import TIMES, WEATHERS, preset_token
from cosfly.space.flight_metrics import ACCEL_RMS_MAX_MPS2, FIVE_RAY_MEAN_MIN, JERK_RMS_MAX_MPS3, smoothness_score
from release.card.numbers import bounded, spread_of
from release.columns import PICTURES
from release.record import ReleaseRecord
from release.stats import caption_tables
from release.stats.cells import (
    SPREAD,
    Absent,
    Cell,
    Stats,
    Table,
    mean_cell,
    mean_over,
    pairs,
    percent,
    ratio,
    rounded,
    spread_over,
    spread_row,
)
from release.stats.counting import ANNOTATIONS, Counts, FlightSums
from release.stats.pixels import Pixels


def weather(counts: Counts) -> list[Table]:
    """Frames by preset and time of day: no table where no frame names one, and sun and air where the frames tell these."""
    tables = []
    named = Counter(
        {
            (_token(weather), _token(time)): n
            for (weather, time), n in counts.weather.items()
            if weather is not None or time is not None
        }
    )
    if named:
        presets = list(WEATHERS)
        presets += sorted({weather for weather, _ in named} - set(presets))
        times = [*TIMES, *sorted({time for _, time in named} - set(TIMES))]
        rows: list[list[Cell]] = [[preset, *(named[preset, time] for time in times)] for preset in presets]
        note = f"Frames. Presets of the paper are all listed; {len(named)} of {len(presets) * len(times)} pairs are in this release."
        tables.append(
            Table(
                key="weather",
                title="Weather and time of day",
                paper="tab:weather_coverage",
                note=note,
                head=["preset", *times],
                rows=rows,
                plot="heat",
            )
        )
    if counts.looks:
        rows = [[look, count] for look, count in counts.looks.most_common(40)]
        tables.append(
            Table(
                key="looks",
                title="Sun and air",
                note="Of the renderer's own settings.",
                head=["look", "frames"],
                rows=rows,
            )
        )
    return tables


def _token(text: str | None) -> str:
    return "not told" if text is None else preset_token(text)


def perturbation(counts: Counts) -> list[Table]:
    tables = []
    total = counts.states.total()
    if total:
        order = ("unperturbed", "position only", "rotation only", "full")
        rows: list[list[Cell]] = [
            [state, counts.states[state], percent(counts.states[state], total)] for state in order
        ]
        note = "Frames of perturbed flights by what of their recorded offsets is not zero: after fallbacks, so fewer are perturbed than were drawn."
        tables.append(
            Table(
                key="augmentation_states",
                title="Perturbation",
                paper="tab:augmentation_states",
                note=note,
                head=["state", "frames", "%"],
                rows=rows,
                plot="bars",
            )
        )
        names = [name for name in counts.over_frames if name.endswith((", m", ", deg"))]
        spreads = [spread_row(name, counts.over_frames[name].spread()) for name in names]
        tables.append(
            Table(
                key="offsets", title="Size of the offsets", note="Where they are not zero.", head=SPREAD, rows=spreads
            )
        )
    if counts.events:
        rows = [[track, event, outcome, count] for (track, event, outcome), count in sorted(counts.events.items())]
        tables.append(
            Table(
                key="events",
                title="What became of each perturbation",
                paper="sec:exp_zoom",
                head=["track", "event", "outcome", "frames"],
                rows=rows,
            )
        )
    return tables


REVIEW_BELOW = 0.5  # of the smoothness score (sec:step6)


def make_stats(record: ReleaseRecord, counts: Counts, pixels: Pixels | None) -> Stats:
    """Put the tables together.

    Args:
        pixels: of some frames' pictures; None where nobody looked at them.
    """
    tables = [
        _release(record, counts), _annotations(record, counts), _dist(record, counts), _frames(counts), _quality(record, counts), _zoom(counts),
        _fovs(counts), *caption_tables.of_captions(record, counts), _towns(record, counts), _splits(record), *weather(counts),
        *perturbation(counts), _files(record), *_pixels(pixels),
    ]  # fmt: skip
    return Stats(
        name=record.name, content_digest=record.content_digest, tables=tables, absent=_absent(record, counts, pixels)
    )


def _release(record: ReleaseRecord, counts: Counts) -> Table:
    flights, history, numbers = counts.flights.values(), record.history, record.numbers
    tracks = Counter(flight.track for flight in flights)
    rendered = [flight.frames_available for flight in record.flights]
    released = [flight.frames for flight in flights]
    planned = history.trajectories
    steps: Cell = ", ".join(f"{step:g}" for step in sorted(counts.step_s)) or None
    if len(counts.step_s) == 1:
        steps = next(iter(counts.step_s))  # a number stands where numbers stand
    rows: list[list[Cell]] = [
        ["trajectories", numbers.trajectories],
        *pairs("flights, ", sorted(tracks.items())),
        ["walks", len({flight.walk for flight in flights})],
        ["frames", counts.frames],
        ["pictures (" + ", ".join(record.settings.modalities) + ")", counts.frames * len(record.settings.modalities)],
        ["frames of a flight as rendered, least", min(rendered, default=None)],
        ["frames of a flight as rendered, most", max(rendered, default=None)],
        ["frames of a flight as released, least", min(released, default=None)],
        ["frames of a flight as released, most", max(released, default=None)],
        ["time step, s", steps],
        *pairs("frames of ", counts.image_px.most_common()),
        ["captions", numbers.captions.frames_with],
        ["trajectories planned for one accepted", ratio(planned.planned, planned.accepted) if planned else None],
    ]
    note = f"Frames of a flight: {record.frame_selection}."
    return Table(
        key="release",
        title="The release",
        paper="sec:dataset_stats, sec:exp_release",
        note=note,
        head=["", "number"],
        rows=rows,
    )


def _annotations(record: ReleaseRecord, counts: Counts) -> Table:
    rows: list[list[Cell]] = [
        [f"picture: {PICTURES[file].name}", counts.frames, 100.0 if counts.frames else None]
        for file in record.settings.modalities
    ]
    rows += [[name, counts.annotated[name], percent(counts.annotated[name], counts.frames)] for name in ANNOTATIONS]
    return Table(
        key="annotations",
        title="Annotations of a frame",
        paper="sec:dataset_stats",
        head=["annotation", "frames", "%"],
        rows=rows,
    )


def _trajectories(counts: Counts) -> list[FlightSums]:
    """Give one flight of each trajectory: the clean one where it is released."""
    chosen: dict[tuple[str, ...], FlightSums] = {}
    for place, flight in counts.flights.items():
        held = chosen.get(place[:-1])
        if held is None or (flight.track == "clean") > (held.track == "clean"):
            chosen[place[:-1]] = flight
    return list(chosen.values())


def _five_ray(record: ReleaseRecord, counts: Counts) -> list[float]:
    """Give the five-ray visibility of the clean flights, of those that were inspected."""
    means = {flight.flight: flight.five_ray_mean for flight in record.flights}
    clean = (means.get("/".join(place)) for place, flight in counts.flights.items() if flight.track == "clean")
    return [bounded(mean) for mean in clean if mean is not None]


def _dist(record: ReleaseRecord, counts: Counts) -> Table:
    flights = _trajectories(counts)
    known = [flight for flight in flights if flight.is_known]
    rows = [
        spread_row("trajectory length, m", spread_of(flight.path_m for flight in known)),
        spread_row("altitude over the person's ground, m", spread_over(known, lambda flight: flight.height)),
        spread_row("target distance, m", spread_over(known, lambda flight: flight.distance)),
        spread_row("rendered visibility", spread_over(flights, lambda flight: flight.visibility)),
        spread_row("five-ray visibility, as inspected", spread_of(_five_ray(record, counts))),
    ]
    note = (
        "Means of each trajectory, as flown without perturbation: of its clean flight, else its perturbed one less the recorded offsets. "
        f"The length is that through the released frames: of {sum(f.frames for f in flights):,} frames."
    )
    return Table(
        key="dist_stats",
        title="Per-axis statistics over trajectories",
        paper="tab:dist_stats",
        note=note,
        head=SPREAD,
        rows=rows,
    )


def _frames(counts: Counts) -> Table:
    titles = {
        "altitude": "altitude over the person's ground, m",
        "distance": "target distance, m",
        "visibility": "rendered visibility",
    }
    rows = [spread_row(title, counts.over_frames[name].spread()) for name, title in titles.items()]
    note = "Both tracks, as the pictures show it, perturbation and all."
    return Table(
        key="dist_frames", title="The same over frames", paper="tab:dist_stats", note=note, head=SPREAD, rows=rows
    )


def _quality(record: ReleaseRecord, counts: Counts) -> Table:
    planned, flights = record.history.trajectories, record.history.flights
    rows: list[list[Cell]] = []
    if planned is not None:
        rows += [["trajectories generated", planned.planned]]
        rows += [[f"dropped before rendering: {reason}", count] for reason, count in planned.dropped.items()]
        rows += [["trajectories rendered", planned.rendered], ["of these accepted", planned.accepted]]
        rows += [["of these to review", planned.review], ["of these rejected", planned.rejected]]
    rows += [["flights found", flights.found]]
    rows += [[f"flights left out: {reason}", count] for reason, count in flights.left_out.items()]
    rows += [["flights released", flights.released]]
    dynamics = [(flight.accel_rms_mps2, flight.jerk_rms_mps3) for flight in _trajectories(counts)]
    known = [(accel, jerk) for accel, jerk in dynamics if accel is not None and jerk is not None]
    scores = [smoothness_score(*pair) for pair in known]
    within = sum(accel <= ACCEL_RMS_MAX_MPS2 and jerk <= JERK_RMS_MAX_MPS3 for accel, jerk in known)
    five_ray = _five_ray(record, counts)
    below = sum(mean < FIVE_RAY_MEAN_MIN for mean in five_ray) if five_ray else None
    rows += [
        ["mean five-ray visibility of clean flights, as inspected", mean_cell(five_ray)],
        [f"of these below {FIVE_RAY_MEAN_MIN:.0%}", below],
        ["mean RMS acceleration, m/s²", mean_cell(accel for accel, _ in known)],
        ["mean RMS jerk, m/s³", mean_cell(jerk for _, jerk in known)],
        ["mean smoothness score S", mean_cell(scores)],
        [f"trajectories within {ACCEL_RMS_MAX_MPS2:g} m/s² and {JERK_RMS_MAX_MPS3:g} m/s³", within],
        [f"trajectories with S below {REVIEW_BELOW:g}", sum(score < REVIEW_BELOW for score in scores)],
        ["trajectories whose motion is known", len(known)],
    ]
    note = "The way to the release is as the record tells it. Acceleration and jerk: of the motion without perturbation, over frames in a row."
    return Table(
        key="quality_stats",
        title="Funnel and smoothness",
        paper="tab:quality_stats",
        note=note,
        head=["", "value"],
        rows=rows,
    )


def _zoom(counts: Counts) -> Table:
    groups: dict[tuple[float | None, str], list[FlightSums]] = defaultdict(list)
    for flight in counts.flights.values():
        groups[None if flight.zooms else round(flight.fov_deg, 1), flight.track].append(flight)
    rows: list[list[Cell]] = []
    for (fov, track), flights in sorted(groups.items(), key=lambda pair: (-(pair[0][0] or 0.0), pair[0][1])):
        means = [
            mean_over(flights, of)
            for of in (lambda f: f.width_px, lambda f: f.height_px, lambda f: f.visibility, lambda f: f.iou)
        ]
        visibility = None if means[2] is None else 100.0 * means[2]
        level = "changing" if fov is None else LEVEL_NAMES.get(round(fov), "")
        focal_px = (
            None if fov is None else mean_cell(flight.focal_px for flight in flights if flight.focal_px is not None)
        )
        rows.append([level, fov, track, *rounded(focal_px), len(flights), *rounded(*means[:2], visibility, means[3])])
    here = {round(fov) for fov, _ in groups if fov is not None}
    missing = ", ".join(f"{name} ({fov} deg)" for fov, name in LEVEL_NAMES.items() if fov not in here)
    note = (
        "Means over the frames that show the person, then over flights. Size: of the projected box; IoU: of that box and the box of the person's pixels. "
        'A flight of one field of view is in its row, one that zooms under "changing", so rows are of different flights; the paper\'s study of the same flights at four is another matter.'
    )
    note += f" Not in this release: {missing}." if missing else ""
    head = [
        "level",
        "field of view, deg",
        "track",
        "focal length, px",
        "flights",
        "width, px",
        "height, px",
        "visibility, %",
        "IoU",
    ]
    return Table(key="zoom_eval", title="Zoom", paper="tab:zoom_eval", note=note, head=head, rows=rows)


def _fovs(counts: Counts) -> Table:
    frames, trajectories = Counter[float](), Counter[float]()
    for flight in counts.flights.values():
        frames[_fov_of(flight)] += flight.frames
    for flight in _trajectories(counts):
        trajectories[_fov_of(flight)] += 1
    rows: list[list[Cell]] = [
        [f"{fov:g}" if fov else "changing", trajectories[fov], frames[fov]] for fov in sorted(frames)
    ]
    head = ["degrees", "trajectories", "frames"]
    paper = "tab:zoom_config, sec:exp_release"
    return Table(key="fovs", title="Fields of view", paper=paper, head=head, rows=rows, plot="bars")


def _fov_of(flight: FlightSums) -> float:
    """Its field of view, degrees; 0 for one that zooms."""
    return 0.0 if flight.zooms else round(flight.fov_deg, 1)


def _towns(record: ReleaseRecord, counts: Counts) -> Table:
    frames, captions, trajectories = Counter[str](), Counter[str](), Counter[str]()
    for flight in counts.flights.values():
        frames[flight.town] += flight.frames
        captions[flight.town] += flight.captions
    for flight in _trajectories(counts):
        trajectories[flight.town] += 1
    maps = {shown.town: f"{shown.name} ({shown.licence})" for shown in record.maps}
    rows: list[list[Cell]] = [
        [town, trajectories[town], frames[town], captions[town], maps.get(town, "")] for town in sorted(frames)
    ]
    head = ["town", "trajectories", "frames", "captions", "map (licence)"]
    return Table(key="towns", title="Towns", paper="sec:exp_release", head=head, rows=rows, plot="bars")


def _splits(record: ReleaseRecord) -> Table:
    rows: list[list[Cell]] = [
        [split, own.frames, own.captions, own.flights, own.trajectories, len(own.walks), len(own.towns)]
        for split, own in record.splits.splits.items()
    ]
    head = ["split", "frames", "captions", "flights", "trajectories", "walks", "towns"]
    return Table(
        key="splits", title=f"Splits, by {record.splits.by}", note=record.splits.rule, head=head, rows=rows, plot="bars"
    )


def _files(record: ReleaseRecord) -> Table:
    files = record.numbers.files
    frames = max(1, record.numbers.frames)
    rows: list[list[Cell]] = [[name, size, round(size / frames, 1)] for name, size in files.bytes_by_modality.items()]
    rows.append(["all shards", files.bytes, round(files.bytes / frames, 1)])
    return Table(key="files", title="Bytes", note=f"{files.shards} shards.", head=["", "bytes", "a frame"], rows=rows)


def _pixels(pixels: Pixels | None) -> list[Table]:
    if pixels is None:
        return []
    tables = []
    note = f"Of {pixels.frames:,} frames, spread evenly over the release."
    depths: list[list[Cell]] = [[f"{100 * share:g} %", metres] for share, metres in pixels.percentiles_m()]
    if depths:
        seen = int(pixels.depths.sum()) + pixels.sky + pixels.invalid
        shares = f" Sky: {percent(pixels.sky, seen)} % of the pixels, invalid: {percent(pixels.invalid, seen)} %."
        tables.append(
            Table(
                key="depth",
                title="Depth, percentiles",
                paper="sec:step6",
                note=note + shares,
                head=["pixels nearer than", "m"],
                rows=depths,
                plot=None,
            )
        )
    kinds: list[list[Cell]] = [
        [kind, round(100 * share, 3), round(100 * shown, 1)] for kind, share, shown in pixels.by_kind()
    ]
    if kinds:
        tables.append(
            Table(
                key="semantics",
                title="Kinds in the pictures",
                paper="sec:step6",
                note=note,
                head=["kind", "% of pixels", "% of frames"],
                rows=kinds,
                plot="bars",
            )
        )
    return tables


def _absent(record: ReleaseRecord, counts: Counts, pixels: Pixels | None) -> list[Absent]:
    """Name what the paper has and this release cannot tell."""
    absent = [
        Absent(what="the same flights at four fields of view", paper="tab:zoom_eval", why="needs rendering: each flight of a release has one field of view"),
        Absent(what="boxes of the maps, before and after simplification", paper="sec:dataset_stats", why="a release holds no map: see simplify_report.json"),
        Absent(what="verdicts of first answers", paper="fig:consistency_verdict", why="a release holds accepted captions alone: see caption_report.json"),
    ]  # fmt: skip
    if not _five_ray(record, counts):
        why = "no flight of this release was inspected against its map"
        absent.append(
            Absent(what="five-ray visibility of the planner", paper="tab:dist_stats, tab:quality_stats", why=why)
        )
    if all(weather is None and time is None for weather, time in counts.weather):
        absent.append(
            Absent(
                what="weather and time of day, 15 x 4",
                paper="tab:weather_coverage",
                why="no frame of this release names a preset",
            )
        )
    if not counts.events:
        absent.append(
            Absent(
                what="fallbacks of the perturbation",
                paper="sec:exp_zoom",
                why="no frame of this release tells what became of it",
            )
        )
    if pixels is None:
        absent.append(
            Absent(
                what="percentiles of depth, kinds in the pictures",
                paper="sec:step6",
                why="the pictures were not looked at: --pixels",
            )
        )
    return absent
