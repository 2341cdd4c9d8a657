"""The tables: from what was counted, and from what the record says of flights and captions that were left out."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from statistics import fmean
from typing import Literal

from pydantic import Field

from cosfly.formats.captions import ACTIONS, FIELDS, TOKENS
from cosfly.formats.frames import LEVEL_NAMES
from cosfly.formats.weather import TIMES, WEATHERS, preset_token
from cosfly.geometry.trajectory_metrics import (
    ACCEL_RMS_MAX_MPS2,
    FIVE_RAY_MEAN_MIN,
    JERK_RMS_MAX_MPS3,
    smoothness_score,
)
from cosfly.llm.answer_text import MIN_CHARACTERS, MIN_CHARACTERS_ZH
from cosfly.runtime.json_io import Record
from release.card.numbers import spread_of
from release.columns import LANGUAGE_NAMES, LANGUAGES
from release.counting import TAB, Sum, TrackCount, total_of
from release.reading import bounded
from release.record import ReleaseRecord, Spread
from release.stats.pixels import Pixels

Cell = str | int | float | None
Rows = list[list[Cell]]
Tracks = Sequence[TrackCount]
Plot = Literal["bars", "heat"]
FIRST_ANSWER = "none: the first answer was accepted"
REVIEW_BELOW = 0.5  # of the smoothness score (sec:step6)
VERDICTS = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")


class Table(Record):
    """One table. paper: the label of the paper's; rows: as long as `head`; plot: how the page draws it beside.

    bars: the second column as bars, named by the first. heat: the numbers of a row and column of names.
    """

    key: str
    title: str
    head: list[str]
    rows: Rows
    paper: str | None = None
    note: str = ""
    plot: Plot | None = None


class Absent(Record):
    """What the paper tells of its data and this release cannot: not in it, never made up."""

    what: str
    paper: str
    why: str


class Stats(Record):
    """The whole file. content_digest: of the release that was counted; runs: that it was made of;
    rules: what they are, by what they decide."""

    name: str
    runs: list[str]
    content_digest: str
    tables: list[Table]
    absent: list[Absent]
    rules: dict[str, str] = Field({})


SPREAD = "axis|mean|std|least|most|values"
SHAPES: dict[str, tuple[str, str, str, Plot | None]] = {  # of each table: title, of the paper, head, how it is drawn
    "release": ("The release", "sec:dataset_stats, sec:exp_release", "|number", None),
    "quality_stats": ("Funnel and smoothness", "tab:quality_stats", "|value", None),
    "dist_stats": ("Per-axis statistics over trajectories", "tab:dist_stats", SPREAD, None),
    "decisions": ("Decisions", "tab:coc_actions", "action|decisions|%|labels|% |group", "bars"),
    "confusion": ("Label (rows) against decision (columns)", "fig:confusion_patterns", "label", "heat"),
    "verdicts": ("Decision against the geometry", "fig:consistency_verdict", "verdict|captions|%", "bars"),
    "repairs": ("Repairs", "fig:regen_strategy", "strategy|captions|%", "bars"),
    "teachers": ("Teachers", "tab:caption_pipeline", "|number", None),
    "text_lengths": ("Length of the texts", "fig:coc_lengths", SPREAD.replace("axis", "text") + "|floor", None),
    "towns": ("Towns", "sec:exp_release", "town|trajectories|frames|captions|map (licence)", "bars"),
    "zoom_eval": ("Zoom", "tab:zoom_eval", "level|field of view, deg|track|focal length, px|flights|width, px|"
                  "height, px|visibility, %|IoU", None),
    "fovs": ("Fields of view", "tab:zoom_config, sec:exp_release", "degrees|trajectories|frames", "bars"),
    "weather": ("Weather and time of day", "tab:weather_coverage", "preset", "heat"),
    "augmentation_states": ("Perturbation", "tab:augmentation_states", "state|frames|%", "bars"),
    "events": ("Outcome of each perturbation", "sec:exp_render, app:dual_track", "track|event|outcome|frames", None),
    "depth": ("Depth, percentiles", "sec:step6", "pixels nearer than|m", None),
    "semantics": ("Kinds in the pictures", "sec:step6", "kind|% of pixels|% of frames", "bars"),
}  # fmt: skip


def make_stats(record: ReleaseRecord, tracks: Tracks, pixels: Pixels | None) -> Stats:
    """Put the tables together.

    Args:
        pixels: of some frames' pictures; None where nobody looked at them.
    """
    tables = [
        _release(record, tracks), _quality(record, tracks), _dist(record, tracks),
        *_captions(record, tracks), _towns(record, tracks), _zoom(tracks), _fovs(tracks), *weather(tracks),
        *_perturbation(tracks), *_pixels(pixels),
    ]  # fmt: skip
    return Stats(
        name=record.name, runs=[source.run for source in record.provenance.sources], tables=tables,
        content_digest=record.content_digest, absent=_absent(record, tracks, pixels),
        rules={"Frames of a flight": record.frame_selection, "Splits": record.splits.rule},
    )  # fmt: skip


def _table(key: str, rows: Rows, note: str = "", more: Iterable[str] = (), title: str = "") -> Table:
    """Return a table by its shape. more: of its head, behind what stands there."""
    name, paper, head, plot = SHAPES[key]
    heads = [*head.split("|"), *more]
    return Table(key=key, title=title or name, head=heads, rows=rows, paper=paper or None, note=note, plot=plot)


# --- cells ------------------------------------------------------------------------------------------------------------


def _pairs(front: str, counted: Iterable[tuple[str, int]]) -> Rows:
    return [[front + name, count] for name, count in counted]


def _shares(counted: Iterable[tuple[str, int]], total: int) -> Rows:
    return [[name, count, percent(count, total)] for name, count in counted]


def _spread_row(title: str, spread: Spread) -> list[Cell]:
    """Return a row under the head SPREAD."""
    return [title, spread.mean, spread.std, spread.min, spread.max, spread.count]


def _over(tracks: Iterable[TrackCount], name: str) -> Spread:
    """Return the spread over tracks of a track's mean, of those that have one."""
    means = (track.sums[name].mean for track in tracks)
    return spread_of(mean for mean in means if mean is not None)


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return round(fmean(known), 4) if known else None


def _rounded(*values: float | None) -> list[Cell]:
    return [None if value is None else round(value, 3) for value in values]


def percent(count: int, total: int) -> float | None:
    """Share of a total in percent, rounded; None of nothing."""
    return round(100.0 * count / total, 2) if total else None


# --- how much, how good -----------------------------------------------------------------------------------------------


def _release(record: ReleaseRecord, tracks: Tracks) -> Table:
    flights, numbers, planned = tracks, record.numbers, record.history.trajectories
    found = sorted(map(float, total_of(tracks, "step_s")))
    steps: Cell = found[0] if len(found) == 1 else ", ".join(f"{step:g}" for step in found) or None
    rows: Rows = [["trajectories", numbers.trajectories]]
    rows += _pairs("flights, ", sorted(Counter(flight.track for flight in flights).items()))
    kinds = record.settings.modalities
    rows += [["walks", len({flight.walk for flight in flights})], ["frames", numbers.frames]]
    rows += [[f"pictures ({', '.join(kinds)})", numbers.frames * len(kinds)]]
    for when, lengths in (
        ("rendered", [one.frames_available for one in record.flights]), ("released", [one.frames for one in flights]),
    ):  # fmt: skip
        rows += [[f"fewest frames of a track, {when}", min(lengths, default=None)]]
        rows += [[f"most frames of a track, {when}", max(lengths, default=None)]]
    rows += [
        ["time step, s", steps],
        *_pairs("frames of ", ((f"{size} px", n) for size, n in numbers.frames_by.image_px.items())),
    ]
    each = round(planned.planned / planned.accepted, 2) if planned and planned.accepted else None
    flags, why = total_of(tracks, "flags"), record.history.captions.frames_without
    rows += [["captions", numbers.captions.frames_with]]
    rows += [[f"captions in {LANGUAGE_NAMES[language]}", flags[language]] for language in LANGUAGES]
    rows += _pairs("frames without a caption: ", why.items())
    rows += [["tracks whose other track is released too (`pair`)", sum(one.pair is not None for one in tracks)]]
    rows += [["frames with an action (`action`, of the planned motion)", flags["action"]]]
    depth = record.depth and f"{record.depth.coding}, {record.depth.unit}, sky {record.depth.sky:g}"
    rows += [["depth", depth or "not released"], ["trajectories planned for one accepted", each]]
    return _table("release", rows)


def _quality(record: ReleaseRecord, tracks: Tracks) -> Table:
    planned, flights = record.history.trajectories, record.history.flights
    rows: Rows = []
    if planned is not None:
        rows += [["trajectories generated", planned.planned]]
        rows += _pairs("dropped before rendering: ", planned.dropped.items())
        rows += [["trajectories rendered", planned.rendered], ["of these accepted", planned.accepted]]
        rows += [["of these to review", planned.review], ["of these rejected", planned.rejected]]
    rows += [["tracks found", flights.found], *_pairs("tracks not released: ", flights.left_out.items())]
    known, within, scores = smoothness(tracks)
    five_ray = _five_ray(record, tracks)
    below = sum(mean < FIVE_RAY_MEAN_MIN for mean in five_ray) if five_ray else None
    rows += [
        ["tracks released", flights.released],
        ["mean five-ray visibility of clean tracks, from the inspection", _mean(five_ray)],
        [f"of these below {FIVE_RAY_MEAN_MIN:.0%}", below],
        ["mean RMS acceleration, m/s²", _mean(accel for accel, _ in known)],
        ["mean RMS jerk, m/s³", _mean(jerk for _, jerk in known)],
        ["mean smoothness score S", _mean(scores)],
        [f"trajectories within {ACCEL_RMS_MAX_MPS2:g} m/s² and {JERK_RMS_MAX_MPS3:g} m/s³", within],
        [f"trajectories with S below {REVIEW_BELOW:g}", sum(score < REVIEW_BELOW for score in scores)],
        ["trajectories whose motion is known", len(known)],
    ]
    note = "The funnel is that of release.json. Acceleration and jerk: of the motion without "
    return _table("quality_stats", rows, note + "perturbation, over frames in a row.")


def smoothness(tracks: Tracks) -> tuple[list[tuple[float, float]], int, list[float]]:
    """Return acceleration and jerk of the trajectories whose motion is known, how many are within the paper's
    bounds, and their scores."""
    dynamics = [(flight.accel_rms_mps2, flight.jerk_rms_mps3) for flight in _trajectories(tracks)]
    known = [(accel, jerk) for accel, jerk in dynamics if accel is not None and jerk is not None]
    within = sum(accel <= ACCEL_RMS_MAX_MPS2 and jerk <= JERK_RMS_MAX_MPS3 for accel, jerk in known)
    return known, within, [smoothness_score(*pair) for pair in known]


def _trajectories(tracks: Tracks) -> list[TrackCount]:
    """Return one track of each trajectory: the clean one where it is released."""
    chosen: dict[str, TrackCount] = {}
    for track in sorted(tracks, key=lambda track: track.track != "clean"):
        chosen.setdefault(track.trajectory, track)
    return list(chosen.values())


def _five_ray(record: ReleaseRecord, tracks: Tracks) -> list[float]:
    """Return the five-ray visibility of the clean tracks, of those that were inspected."""
    means = {flight.flight: flight.five_ray_mean for flight in record.flights}
    clean = (means.get(track.name) for track in tracks if track.track == "clean")
    return [bounded(mean) for mean in clean if mean is not None]


def _dist(record: ReleaseRecord, tracks: Tracks) -> Table:
    flights = _trajectories(tracks)
    rows = [
        _spread_row(
            "trajectory length, m", spread_of(flight.length_m for flight in flights if flight.length_m is not None)
        ),
        _spread_row("altitude above the ground under the person, m", _over(flights, "clean_altitude_m")),
        _spread_row("target distance, m", _over(flights, "clean_distance_m")),
        _spread_row("rendered visibility", _over(flights, "visibility")),
        _spread_row("five-ray visibility, from the inspection", spread_of(_five_ray(record, tracks))),
    ]
    note = (
        "Means of each trajectory without perturbation: of its clean track, or of its perturbed track minus the "
        "recorded offsets. The length is that over all points."
    )
    return _table("dist_stats", rows, note)


# --- captions ---------------------------------------------------------------------------------------------------------


def _captions(record: ReleaseRecord, tracks: Tracks) -> list[Table]:
    """What captions say: decisions, verdicts, repairs, lengths."""
    pairs, repaired = total_of(tracks, "confusion"), total_of(tracks, "repair_strategy")
    found = {name for pair in pairs for name in pair.split(TAB)}
    order = [name for name in (*TOKENS, "none") if name in found]
    confusion: Rows = [[label, *(pairs[f"{label}{TAB}{decision}"] for decision in order)] for label in order]
    repaired[FIRST_ANSWER] += repaired.pop("none", 0)
    repairs = _shares((+repaired).most_common(), repaired.total())
    return [
        _decisions(record, tracks), _table("confusion", confusion, more=order), _verdicts(tracks),
        _table("repairs", repairs), _teachers(record), _lengths(tracks),
    ]  # fmt: skip


def _decisions(record: ReleaseRecord, tracks: Tracks) -> Table:
    decisions, labels = total_of(tracks, "decision"), total_of(tracks, "label")
    total, labelled = decisions.total(), labels.total() - labels["none"]
    rows: Rows = []
    for name in (*TOKENS, *sorted(decisions.keys() - {*TOKENS, "none"})):
        group = ACTIONS[name].group if name in ACTIONS else ""
        shares = percent(decisions[name], total), percent(labels[name], labelled)
        rows.append([name, decisions[name], shares[0], labels[name], shares[1], group])
    note = f"Decisions of {total:,} captions, and the labels that the later positions imply for {labelled:,} of them."
    return _table("decisions", rows, note)


def _verdicts(tracks: Tracks) -> Table:
    kinds = sorted({track.track for track in tracks})
    by_kind = {kind: total_of((track for track in tracks if track.track == kind), "verdict") for kind in kinds}
    names = [*VERDICTS, *sorted({name for counts in by_kind.values() for name in counts} - set(VERDICTS))]
    own = {name: [by_kind[kind][name] for kind in kinds] for name in names}
    total = sum(map(sum, own.values()))
    rows: Rows = [[name, sum(each), percent(sum(each), total), *each] for name, each in own.items()]
    note = "Of accepted captions, after repair; the figure of the paper shows first answers, before repair."
    return _table("verdicts", rows, note, kinds)


def _teachers(record: ReleaseRecord) -> Table:
    made = record.provenance
    rows = _pairs("captions of ", [(f"{teacher.kind}: {teacher.model}", teacher.captions) for teacher in made.teachers])
    rows += [["asks", made.asks], *_pairs("", [(name.replace("_", " "), count) for name, count in made.tokens.items()])]
    rows += [["accepted first answers", made.repairs.first_answers]]
    rows += _pairs("repaired by ", made.repairs.repaired_by_rung.items())
    return _table("teachers", rows, "From release.json, over all captions that were read.")


def _lengths(tracks: Tracks) -> Table:
    rows = list[list[Cell]]()
    for language in LANGUAGES:
        for name in FIELDS[:2]:
            least = (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS)[name]
            title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}"
            rows.append(
                [
                    *_spread_row(title, Sum.all(track.sums[f"caption_{language}_{name}"] for track in tracks).spread()),
                    least,
                ]
            )
    return _table("text_lengths", rows, "Characters. The last column is the smallest accepted length.")


# --- frames -----------------------------------------------------------------------------------------------------------


def _towns(record: ReleaseRecord, tracks: Tracks) -> Table:
    frames, captions = Counter[str](), Counter[str]()
    for flight in tracks:
        frames[flight.town] += flight.frames
        captions[flight.town] += flight.captions
    trajectories = Counter(flight.town for flight in _trajectories(tracks))
    maps = {one.town: f"{one.name} ({one.licence})" for one in record.maps}
    rows: Rows = [
        [town, trajectories[town], frames[town], captions[town], maps.get(town, "")] for town in sorted(frames)
    ]
    return _table("towns", rows)


def _zoom(tracks: Tracks) -> Table:
    groups: dict[tuple[float, str], list[TrackCount]] = defaultdict(list)
    for flight in tracks:
        groups[_fov_of(flight), flight.track].append(flight)
    rows: Rows = []
    for (fov, track), flights in sorted(groups.items(), key=lambda pair: (-pair[0][0], pair[0][1])):
        *sizes, visibility, iou = (_over(flights, of).mean for of in ("width_px", "height_px", "visibility", "iou"))
        focal_px = _mean(flight.focal_px for flight in flights if flight.focal_px is not None) if fov else None
        level = LEVEL_NAMES.get(round(fov), "") if fov else "changing"
        seen = None if visibility is None else 100.0 * visibility
        rows.append([level, fov or None, track, *_rounded(focal_px), len(flights), *_rounded(*sizes, seen, iou)])
    here = {round(fov) for fov, _ in groups}
    missing = ", ".join(f"{name} ({fov} deg)" for fov, name in LEVEL_NAMES.items() if fov not in here)
    note = (
        "Means over the frames that show the person, then over tracks. Size: of the projected box; IoU: of this box "
        "and the box of the person's pixels. A track with one field of view is in its row, a track that zooms in "
        '"changing", so the rows are of different tracks; the study of the paper compares the same tracks.'
    )
    return _table("zoom_eval", rows, note + (f" Not in this release: {missing}." if missing else ""))


def _fovs(tracks: Tracks) -> Table:
    frames = Counter[float]()
    for flight in tracks:
        frames[_fov_of(flight)] += flight.frames
    trajectories = Counter(map(_fov_of, _trajectories(tracks)))
    rows: Rows = [[f"{fov:g}" if fov else "changing", trajectories[fov], frames[fov]] for fov in sorted(frames)]
    return _table("fovs", rows)


def _fov_of(flight: TrackCount) -> float:
    """Return its field of view, degrees; 0 for one that zooms."""
    return 0.0 if flight.zooms else round(flight.fov_deg, 1)


def weather(tracks: Tracks) -> list[Table]:
    """Return frames by preset and time of day, where a frame names one."""
    tables = []
    named = Counter[tuple[str, ...]]()
    for sky, count in total_of(tracks, "sky").items():
        named[tuple(map(_token, sky.split(TAB)))] += count
    if named:
        presets = [*WEATHERS, *sorted({weather for weather, _ in named} - set(WEATHERS))]
        times = [*TIMES, *sorted({time for _, time in named} - set(TIMES))]
        rows: Rows = [[preset, *(named[preset, time] for time in times)] for preset in presets]
        pairs = f"{len(named)} of {len(presets) * len(times)} pairs are in this release."
        tables += [_table("weather", rows, f"Frames. Presets of the paper are all listed; {pairs}", times)]
    return tables


def _token(text: str) -> str:
    return preset_token(text) if text else "not known"


def _perturbation(tracks: Tracks) -> list[Table]:
    tables, states, events = [], total_of(tracks, "states"), Counter[tuple[str, ...]]()
    if total := states.total():
        order = ("unperturbed", "position only", "rotation only", "full")
        rows: Rows = _shares(((state, states[state]) for state in order), total)
        note = "Frames of perturbed tracks by the kind of their recorded offsets, after fallbacks, so fewer "
        tables += [_table("augmentation_states", rows, note + "frames are perturbed than were drawn.")]
    for track in tracks:
        events.update({(track.track, *event.split(TAB)): count for event, count in track.counts["events"].items()})
    if events:
        tables += [_table("events", [[*names, count] for names, count in sorted(events.items())])]
    return tables


def _pixels(pixels: Pixels | None) -> list[Table]:
    if pixels is None:
        return []
    tables = []
    note = f"Of {pixels.frames:,} frames, spread evenly over the release."
    depths: Rows = [[f"{100 * share:g} %", metres] for share, metres in pixels.percentiles_m()]
    if depths:
        seen = int(pixels.depths.sum()) + pixels.sky + pixels.invalid
        sky, invalid = percent(pixels.sky, seen), percent(pixels.invalid, seen)
        tables += [_table("depth", depths, f"{note} Sky: {sky} % of the pixels, invalid: {invalid} %.")]
    kinds: Rows = [[kind, round(100 * share, 3), round(100 * shown, 1)] for kind, share, shown in pixels.by_kind()]
    return [*tables, *([_table("semantics", kinds, note)] if kinds else [])]


def _absent(record: ReleaseRecord, tracks: Tracks, pixels: Pixels | None) -> list[Absent]:
    """Name what the paper has and this release cannot tell."""
    no_weather = not total_of(tracks, "sky")
    table = [
        (True, "the same tracks at four fields of view", "tab:zoom_eval",
         "it needs rendering, because each track of a release has one field of view"),
        (True, "boxes of the maps, before and after simplification", "sec:dataset_stats",
         "a release contains no map; see simplify_report.json"),
        (True, "verdicts of first answers", "fig:consistency_verdict",
         "a release contains accepted captions only; see caption_report.json"),
        (not _five_ray(record, tracks), "five-ray visibility of the planner", "tab:dist_stats, tab:quality_stats",
         "no track of this release was inspected with its map"),
        (no_weather, "weather and time of day, 15 x 4", "tab:weather_coverage",
         "no frame of this release names a preset"),
        (not total_of(tracks, "events"), "fallbacks of the perturbation", "sec:exp_render, app:dual_track",
         "no frame of this release records the outcome"),
        (pixels is None, "percentiles of depth, kinds in the pictures", "sec:step6",
         "the pictures were not read; pass --pixels"),
    ]  # fmt: skip
    return [Absent(what=what, paper=paper, why=why) for is_absent, what, paper, why in table if is_absent]
