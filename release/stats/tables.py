"""The tables: from what was counted, and from what the record says of flights and captions that were left out."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from statistics import fmean

from cosfly.flight_metrics import ACCEL_RMS_MAX_MPS2, FIVE_RAY_MEAN_MIN, JERK_RMS_MAX_MPS3, smoothness_score
from cosfly.products.captions import ACTION_GROUPS, ACTIONS, FIELDS, MIN_CHARACTERS, MIN_CHARACTERS_ZH
from release.card.numbers import Sum, spread_of
from release.columns import PICTURES
from release.record import ReleaseRecord, Spread
from release.stats.counting import ANNOTATIONS, LANGUAGES, STATES, TEXT_BIN, Counts, FlightSums
from release.stats.pixels import Pixels
from release.stats.schema import Absent, Cell, Stats, Table

LANGUAGE_NAMES = {"en": "English", "zh": "Chinese"}
ZOOM_LEVELS = {110: "wide-angle", 90: "standard", 60: "narrow", 30: "telephoto"}  # tab:zoom_config
REVIEW_BELOW = 0.5  # of the smoothness score (sec:step6)
# tab:weather_presets, tab:tod_presets
WEATHER = {
    "sky": ("clear", "fair", "partly_cloudy", "cloudy", "overcast"), "rain": ("drizzle", "light_rain", "medium_rain", "heavy_rain"),
    "fog": ("thin_fog", "mist", "dense_fog"), "haze": ("smog", "dust_haze", "snow_haze"),
}  # fmt: skip
TIMES = ("morning", "noon", "dusk", "night")


def make_stats(record: ReleaseRecord, counts: Counts, pixels: Pixels | None) -> Stats:
    """Put the tables together.

    Args:
        pixels: of some frames' pictures; None where nobody looked at them.
    """
    tables = [
        _release(record, counts), _annotations(record, counts), _dist(counts), _frames(counts), _quality(record, counts), _zoom(counts),
        *_fovs(counts), _decisions(counts), _confusion(counts), _verdicts(counts), _repairs(counts), *_teachers(record), *_evidence(counts),
        _lengths(counts), *_length_bins(counts), _towns(record, counts), _splits(record), *_weather(counts), *_perturbation(counts), _files(record),
        *_pixels(pixels),
    ]  # fmt: skip
    return Stats(name=record.name, content_digest=record.content_digest, tables=tables, absent=_absent(counts, pixels))


def _release(record: ReleaseRecord, counts: Counts) -> Table:
    flights, history, numbers = counts.flights.values(), record.history, record.numbers
    tracks = Counter(flight.track for flight in flights)
    rendered = [flight.frames_available for flight in record.flights]
    released = [flight.frames for flight in flights]
    planned = history.trajectories
    steps = ", ".join(f"{step:g}" for step in sorted(counts.step_s))
    rows: list[list[Cell]] = [
        ["trajectories", numbers.trajectories],
        *_pairs("flights, ", sorted(tracks.items())),
        ["walks", len({flight.walk for flight in flights})],
        ["frames", counts.frames],
        ["pictures (" + ", ".join(record.settings.modalities) + ")", counts.frames * len(record.settings.modalities)],
        ["frames of a flight as rendered, least", min(rendered, default=None)],
        ["frames of a flight as rendered, most", max(rendered, default=None)],
        ["frames of a flight as released, least", min(released, default=None)],
        ["frames of a flight as released, most", max(released, default=None)],
        ["time step, s", steps or None],
        *_pairs("frames of ", counts.image_px.most_common()),
        ["captions", numbers.captions.frames_with],
        ["trajectories planned for one accepted", _ratio(planned.planned, planned.accepted) if planned else None],
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
    rows += [[name, counts.annotated[name], _percent(counts.annotated[name], counts.frames)] for name in ANNOTATIONS]
    return Table(
        key="annotations",
        title="Annotations of a frame",
        paper="sec:dataset_stats",
        head=["annotation", "frames", "%"],
        rows=rows,
    )


def _trajectories(counts: Counts) -> list[FlightSums]:
    """Give one flight of each trajectory: the clean one, else one whose plan is known."""
    chosen: dict[tuple[str, ...], FlightSums] = {}
    for place, flight in counts.flights.items():
        held = chosen.get(place[:-1])
        if held is None or (flight.track == "clean") > (held.track == "clean"):
            chosen[place[:-1]] = flight
    return list(chosen.values())


def _dist(counts: Counts) -> Table:
    flights = _trajectories(counts)
    known = [flight for flight in flights if flight.is_known]
    rows = [
        _spread_row("trajectory length, m", spread_of(flight.path_m for flight in known)),
        _spread_row("altitude over the person's ground, m", _means(known, lambda flight: flight.height)),
        _spread_row("target distance, m", _means(known, lambda flight: flight.distance)),
        _spread_row("rendered visibility", _means(flights, lambda flight: flight.visibility)),
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


SPREAD = ["axis", "mean", "std", "least", "most", "values"]


def _frames(counts: Counts) -> Table:
    titles = {
        "altitude": "altitude over the person's ground, m",
        "distance": "target distance, m",
        "visibility": "rendered visibility",
    }
    rows = [_spread_row(title, counts.over_frames[name].spread()) for name, title in titles.items()]
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
    rows += [
        ["mean RMS acceleration, m/s²", _mean(accel for accel, _ in known)],
        ["mean RMS jerk, m/s³", _mean(jerk for _, jerk in known)],
        ["mean smoothness score S", _mean(scores)],
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
    groups: dict[tuple[float, str], list[FlightSums]] = defaultdict(list)
    for flight in counts.flights.values():
        groups[round(flight.fov_deg, 1), flight.track].append(flight)
    rows: list[list[Cell]] = []
    for (fov, track), flights in sorted(groups.items(), key=lambda pair: (-pair[0][0], pair[0][1])):
        means = [
            _mean_of(flights, of)
            for of in (lambda f: f.width_px, lambda f: f.height_px, lambda f: f.visibility, lambda f: f.iou)
        ]
        visibility = None if means[2] is None else 100.0 * means[2]
        level = ZOOM_LEVELS.get(round(fov), "")
        focal_px = _mean(flight.focal_px for flight in flights if flight.focal_px is not None)
        rows.append([level, fov, track, *_rounded(focal_px), len(flights), *_rounded(*means[:2], visibility, means[3])])
    here = {round(fov) for fov, _ in groups}
    missing = ", ".join(f"{name} ({fov} deg)" for fov, name in ZOOM_LEVELS.items() if fov not in here)
    note = (
        "Means over the frames that show the person, then over flights. Size: of the projected box; IoU: of that box and the box of the person's pixels. "
        "Each flight has one field of view, so rows are of different flights; the paper's study of the same flights at four is another matter."
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


def _fovs(counts: Counts) -> list[Table]:
    frames, trajectories = Counter[float](), Counter[float]()
    for flight in counts.flights.values():
        frames[round(flight.fov_deg, 1)] += flight.frames
    for flight in _trajectories(counts):
        trajectories[round(flight.fov_deg, 1)] += 1
    rows: list[list[Cell]] = [[f"{fov:g}", trajectories[fov], frames[fov]] for fov in sorted(frames)]
    head = ["degrees", "trajectories", "frames"]
    return [
        Table(
            key="fovs",
            title="Fields of view",
            paper="tab:zoom_config, sec:exp_release",
            head=head,
            rows=rows,
            plot="bars",
        )
    ]


# --- captions ---------------------------------------------------------------------------------------------------------


def _decisions(counts: Counts) -> Table:
    groups = {action: group for group, actions in ACTION_GROUPS.items() for action in actions}
    total, labelled = counts.decisions.total(), counts.labels.total() - counts.labels["none"]
    rows: list[list[Cell]] = [
        [
            name,
            counts.decisions[name],
            _percent(counts.decisions[name], total),
            counts.labels[name],
            _percent(counts.labels[name], labelled),
            groups.get(name, ""),
        ]
        for name in (*ACTIONS, *sorted(counts.decisions.keys() - {*ACTIONS, "none"}))
    ]
    note = f"Decisions of {total:,} captions, and the labels that the later positions imply for {labelled:,} of them."
    head = ["action", "decisions", "%", "labels", "% ", "group"]
    return Table(
        key="decisions", title="Decisions", paper="tab:coc_actions", note=note, head=head, rows=rows, plot="bars"
    )


def _confusion(counts: Counts) -> Table:
    order = [name for name in (*ACTIONS, "none") if counts.labels[name] or counts.decisions[name]]
    rows: list[list[Cell]] = [[label, *(counts.confusion[label, decision] for decision in order)] for label in order]
    return Table(
        key="confusion",
        title="Label (rows) against decision (columns)",
        paper="fig:confusion_patterns",
        head=["label", *order],
        rows=rows,
        plot="heat",
    )


def _verdicts(counts: Counts) -> Table:
    tracks = sorted({track for _, track in counts.verdicts})
    names = ["CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN"]
    names += sorted({name for name, _ in counts.verdicts} - set(names))
    total = counts.verdicts.total()
    rows: list[list[Cell]] = []
    for name in names:
        own = [counts.verdicts[name, track] for track in tracks]
        rows.append([name, sum(own), _percent(sum(own), total), *own])
    note = "Of accepted captions, after repair: what the paper's figure shows is of first answers, before it."
    head = ["verdict", "captions", "%", *tracks]
    return Table(
        key="verdicts",
        title="Decision against the geometry",
        paper="fig:consistency_verdict",
        note=note,
        head=head,
        rows=rows,
        plot="bars",
    )


def _repairs(counts: Counts) -> Table:
    total = counts.repairs.total()
    rows: list[list[Cell]] = [[name, count, _percent(count, total)] for name, count in counts.repairs.most_common()]
    return Table(
        key="repairs",
        title="Repairs",
        paper="fig:regen_strategy",
        head=["strategy", "captions", "%"],
        rows=rows,
        plot="bars",
    )


def _teachers(record: ReleaseRecord) -> list[Table]:
    made = record.provenance
    rows: list[list[Cell]] = [
        [f"captions of {teacher.kind}: {teacher.model}", teacher.captions] for teacher in made.teachers
    ]
    rows += [["asks", made.asks], *_pairs("", [(name.replace("_", " "), count) for name, count in made.tokens.items()])]
    rows += [["first answers that stood", made.repairs.first_answers]]
    rows += [[f"repaired by {rung}", count] for rung, count in made.repairs.repaired_by_rung.items()]
    note = "As the record tells it, of all captions that were read."
    return [
        Table(key="teachers", title="Teachers", paper="tab:caption_pipeline", note=note, head=["", "number"], rows=rows)
    ]


def _evidence(counts: Counts) -> list[Table]:
    tables = []
    kinds = ("all proved", "a contradicted one", "some unread")
    by_state: list[list[Cell]] = [
        [LANGUAGE_NAMES[language], *(counts.sentences[language, state] for state in STATES)] for language in LANGUAGES
    ]
    by_caption: list[list[Cell]] = [
        [LANGUAGE_NAMES[language], *(counts.whole[language, kind] for kind in kinds)] for language in LANGUAGES
    ]
    if counts.sentences:
        note = "Sentences of the captions against the geometry of their flight."
        tables.append(
            Table(
                key="evidence",
                title="Evidence of sentences",
                note=note,
                head=["language", *STATES],
                rows=by_state,
                plot="stacked",
            )
        )
        tables.append(
            Table(
                key="evidence_captions",
                title="Evidence of captions",
                head=["language", *kinds],
                rows=by_caption,
                plot="stacked",
            )
        )
    return tables


def _lengths(counts: Counts) -> Table:
    rows = []
    for language in LANGUAGES:
        least = MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS
        for name in FIELDS[:2]:
            title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}"
            rows.append([*_spread_row(title, counts.lengths[language, name].spread()), least[name]])
    note = "Characters. The last column is the least that an answer may have."
    return Table(
        key="text_lengths",
        title="Length of the texts",
        paper="fig:coc_lengths",
        note=note,
        head=["text", *SPREAD[1:], "floor"],
        rows=rows,
    )


def _length_bins(counts: Counts) -> list[Table]:
    tables = []
    for language in LANGUAGES:
        for name in FIELDS[:2]:
            bins = [number for own, field, number in counts.length_bins if (own, field) == (language, name)]
            width = TEXT_BIN[language]
            rows: list[list[Cell]] = [
                [f"{number * width} to {number * width + width - 1}", counts.length_bins[language, name, number]]
                for number in range(min(bins, default=0), max(bins, default=-1) + 1)
            ]
            if rows:
                title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}: characters"
                tables.append(
                    Table(
                        key=f"lengths_{language}_{name}",
                        title=title,
                        paper="fig:coc_lengths",
                        head=["characters", "captions"],
                        rows=rows,
                        plot="bars",
                    )
                )
    return tables


# --- where, when, how -------------------------------------------------------------------------------------------------


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


def _weather(counts: Counts) -> list[Table]:
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
        presets = [preset for group in WEATHER.values() for preset in group]
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
    return "not told" if text is None else text.strip().lower().replace(" ", "_").replace("-", "_")


def _perturbation(counts: Counts) -> list[Table]:
    tables = []
    total = counts.states.total()
    if total:
        order = ("unperturbed", "position only", "rotation only", "full")
        rows: list[list[Cell]] = [
            [state, counts.states[state], _percent(counts.states[state], total)] for state in order
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
        spreads = [_spread_row(name, counts.over_frames[name].spread()) for name in names]
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
        shares = f" Sky: {_percent(pixels.sky, seen)} % of the pixels, invalid: {_percent(pixels.invalid, seen)} %."
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


def _absent(counts: Counts, pixels: Pixels | None) -> list[Absent]:
    """Name what the paper has and this release cannot tell."""
    absent = [
        Absent(
            what=f"five-ray visibility of the planner, and who was rejected below {FIVE_RAY_MEAN_MIN:.0%} of it", paper="tab:dist_stats, tab:quality_stats",
            why="a release holds what its pictures show, not what the planner computed: see inspect.json of the runs",
        ),
        Absent(what="the same flights at four fields of view", paper="tab:zoom_eval", why="needs rendering: each flight of a release has one field of view"),
        Absent(what="boxes of the maps, before and after simplification", paper="sec:dataset_stats", why="a release holds no map: see simplify_report.json"),
        Absent(what="verdicts of first answers", paper="fig:consistency_verdict", why="a release holds accepted captions alone: see caption_report.json"),
    ]  # fmt: skip
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


# --- cells ------------------------------------------------------------------------------------------------------------


def _pairs(front: str, counted: Iterable[tuple[str, int]]) -> list[list[Cell]]:
    """Give a row for each name and its count."""
    return [[front + name, count] for name, count in counted]


def _spread_row(title: str, spread: Spread) -> list[Cell]:
    return [title, spread.mean, spread.std, spread.min, spread.max, spread.count]


def _mean_of(flights: Iterable[FlightSums], of: Callable[[FlightSums], Sum]) -> float | None:
    """Mean over flights of a flight's mean, of those that have one."""
    return _means(flights, of).mean


def _means(flights: Iterable[FlightSums], of: Callable[[FlightSums], Sum]) -> Spread:
    means = (of(flight).spread().mean for flight in flights)
    return spread_of(mean for mean in means if mean is not None)


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return round(fmean(known), 4) if known else None


def _rounded(*values: float | None) -> list[Cell]:
    return [None if value is None else round(value, 3) for value in values]


def _percent(count: int, total: int) -> float | None:
    return round(100.0 * count / total, 2) if total else None


def _ratio(whole: int, part: int) -> float | None:
    return round(whole / part, 2) if part else None
