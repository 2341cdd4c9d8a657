"""The statistics of a release as tables: those of the paper (sec:dataset_stats) that it supports.

All of it is in release.json, which `release verify` compares with the rows. The card prints these tables, and
`cosfly release stats` draws them.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from statistics import fmean
from typing import Literal

from cosfly.formats.captions import ACTIONS, FIELDS, TOKENS
from cosfly.formats.frames import LEVEL_NAMES
from cosfly.formats.weather import TIMES, WEATHERS
from cosfly.geometry.trajectory_metrics import ACCEL_RMS_MAX_MPS2, FIVE_RAY_MEAN_MIN, JERK_RMS_MAX_MPS3
from cosfly.llm.answer_text import MIN_CHARACTERS, MIN_CHARACTERS_ZH
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import Record, write_json
from cosfly.viz.page import page
from release.columns import CAPTION, LANGUAGE_NAMES, LANGUAGES
from release.counting import ACTION_CLASSES, REVIEW_BELOW, STATES, TAB
from release.record import RECORD, Numbers, ReleaseRecord, Spread, read_record, release_folder

Cell = str | int | float | None
Rows = list[list[Cell]]
Plot = Literal["bars", "heat"]
WITH_TABLE = ("decision", "label", "verdict", "repair_strategy")  # columns of captions that have a table of their own
VERDICTS = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")


class Table(Record):
    """One table of a release."""

    key: str
    title: str
    head: list[str]
    rows: Rows  # each as long as `head`
    paper: str | None = None  # labels of the tables, figures or sections of the paper that it corresponds to
    note: str = ""
    plot: Plot | None = None  # how a page draws it: the second column as bars, or all numbers as a heat map


SPREAD = ["mean", "std", "least", "most", "values"]  # the columns of `_spread`, after its title
SPREADS = {  # name in the record -> title
    "track_frames": "frames per track",
    "track_duration_s": "duration of a track, s",
    "trajectory_length_m": "length of a trajectory, m",
    "trajectory_clean_altitude_m": "altitude above the ground under the person, mean of a trajectory, m",
    "trajectory_clean_distance_m": "target distance, mean of a trajectory, m",
    "trajectory_visibility": "rendered visibility, mean of a trajectory",
    "trajectory_accel_rms_mps2": "RMS acceleration of a trajectory, m/s²",
    "trajectory_jerk_rms_mps3": "RMS jerk of a trajectory, m/s³",
    "smoothness": "smoothness score S of a trajectory",
    "height_m": "height over the target's hip, of a frame, m",
    "distance_m": "distance to the target, of a frame, m",
    "visibility": "rendered visibility of the target, of a frame",
}
ORIGIN_NOTE = (
    "Values of slots are filled in from the measured facts, those of prose are compared with them: a number that "
    "equals a fact of its unit is matched (it may be the wrong quantity), one that equals none is contradicted. Words "
    "without numbers are not checked. Asks, tokens and teachers: of all captions that were read."
)


def tables_of(record: ReleaseRecord) -> list[Table]:
    """Return the tables of a release; those without rows are skipped."""
    return [table for table in all_tables(record) if table.rows]


def all_tables(record: ReleaseRecord) -> list[Table]:
    """Return all tables in the order of the card, also those without rows."""
    numbers = record.numbers
    weather_head, weather_rows = _weather(numbers)
    confusion_head, confusion_rows = _confusion(numbers)
    return [
        Table(key="release", title="The release", paper="sec:dataset_stats, sec:exp_release", head=["", "number"],
              rows=_content_rows(record)),
        Table(key="quality_stats", title="From plan to release", paper="tab:quality_stats", head=["", "number"],
              rows=[*_planned_rows(record), *_outcome_rows(record)]),
        Table(key="dist_stats", title="Tracks and trajectories", paper="tab:dist_stats", head=["axis", *SPREAD],
              rows=[_spread(title, numbers.spreads.get(name, Spread())) for name, title in SPREADS.items()],
              note="Of trajectories without perturbation: of the clean track, or the perturbed one minus its offsets."),
        Table(key="fovs", title="Fields of view", paper="tab:zoom_config, sec:exp_release",
              head=["degrees", "tracks", "frames", "level"], rows=_fovs(numbers), plot="bars"),
        Table(key="weather", title="Weather and time of day", paper="tab:weather_coverage", head=weather_head,
              rows=weather_rows, plot="heat", note="Frames. The presets of the paper are all listed."),
        Table(key="augmentation_states", title="Perturbation", paper="tab:augmentation_states", plot="bars",
              head=["state", "frames", "%"], rows=_shares(numbers, "states", STATES),
              note="Frames of perturbed tracks by their recorded offsets, after fallbacks."),
        Table(key="events", title="Outcome of each perturbation", paper="sec:exp_render, app:dual_track",
              head=["track", "event", "outcome", "frames"], rows=_events(numbers)),
        Table(key="actions", title="Actions", plot="bars",
              head=["class", "frames", "%"], rows=_shares(numbers, "action", ACTION_CLASSES),
              note="Frames by their column action, of the planned motion: the greatest velocity until the next frame; "
              "below 0.3 m/s a turn of at least 5 degrees/s, else hover."),
        Table(key="decisions", title="Decisions", paper="tab:coc_actions", plot="bars", rows=_decisions(numbers),
              head=["action", "decisions", "%", "labels", "% ", "group"]),  # "% ": no two columns have one name
        Table(key="confusion", title="Label (rows) against decision (columns)", paper="fig:confusion_patterns",
              head=confusion_head, rows=confusion_rows, plot="heat"),
        Table(key="verdicts", title="Decision against the geometry", paper="fig:consistency_verdict", plot="bars",
              head=["verdict", "captions", "%"], rows=_shares(numbers, "verdict", VERDICTS),
              note="Of accepted captions, after repair; the figure of the paper shows first answers, before repair."),
        Table(key="repairs", title="Repairs", paper="fig:regen_strategy", head=["strategy", "captions", "%"],
              rows=_shares(numbers, "repair_strategy", numbers.of("repair_strategy")), plot="bars"),
        Table(key="origin", title="Origin of the captions", paper="tab:caption_pipeline", head=["", "", "number"],
              rows=_origin(record), note=ORIGIN_NOTE),
        Table(key="text_lengths", title="Length of the texts", paper="fig:coc_lengths", head=["text", *SPREAD, "floor"],
              rows=_text_lengths(numbers), note="Characters. The last column is the smallest accepted length."),
    ]  # fmt: skip


def percent(count: int, total: int) -> float | None:
    """Return a share of a total in percent, rounded; None of nothing."""
    return round(100.0 * count / total, 2) if total else None


def _shares(numbers: Numbers, name: str, values: Collection[str]) -> Rows:
    """Return counts and shares of `values`, then of other values that were counted; nothing if none was counted."""
    counts = numbers.of(name)
    total = counts.total()
    names = [*values, *sorted({*counts} - {*values})] if total else []
    return [[value, counts[value], percent(counts[value], total)] for value in names]


def _spread(title: str, spread: Spread) -> list[Cell]:
    return [title, spread.mean, spread.std, spread.min, spread.max, spread.count]


def _counted(title: str, counts: Mapping[str, int]) -> Rows:
    """Return a row for each name that was counted; the title of a row has the name in place of {}."""
    return [[title.format(name), count] for name, count in counts.items()]


def _content_rows(record: ReleaseRecord) -> Rows:
    """Return what the release holds: tracks, frames, and frames with a caption."""
    numbers, flags = record.numbers, record.numbers.of("flags")
    tracks, pictures, depth = record.flights, record.settings.modalities, record.depth
    num_rendered = [track.frames_available for track in tracks]
    # Where legibility is not known of every frame, a count of the others would be too low.
    num_legible = flags["target_legible"] if flags["legibility_known"] == numbers.frames else None
    return [
        ["trajectories", numbers.trajectories], *_counted("tracks, {}", numbers.of("tracks_by_track")),
        ["tracks whose other track is released too (column pair)", sum(track.pair is not None for track in tracks)],
        ["walks", len({track.walk for track in tracks})],

        *_counted("frames of {}", numbers.of("town")), ["frames", numbers.frames],
        [f"pictures ({', '.join(pictures)})", numbers.frames * len(pictures)],
        ["fewest frames of a track, rendered", min(num_rendered, default=None)],
        ["most frames of a track, rendered", max(num_rendered, default=None)],
        ["time step, s", ", ".join(sorted(numbers.of("step_s"))) or None],
        *_counted("frames of {} px", numbers.of("image_px")),
        ["frames that show the target", flags["target_visible"]],
        ["frames that show the target legibly (column target_legible)", num_legible],
        ["frames with a perturbation", flags["is_perturbed"]],
        ["frames with an action (column action)", numbers.of("action").total()],
        ["depth", f"{depth.coding}, {depth.unit}, sky {depth.sky:g}" if depth else "not released"],

        ["frames with a caption", flags["has_caption"]],
        *_counted("captions in {}", {LANGUAGE_NAMES[language]: flags[language] for language in LANGUAGES}),
        *_counted("frames without a caption: {}", record.history.captions.frames_without),
    ]  # fmt: skip


def _planned_rows(record: ReleaseRecord) -> Rows:
    """Return what became of the planned trajectories; nothing if no source was inspected."""
    funnel = record.history.trajectories
    if funnel is None:
        return []
    return [
        ["trajectories planned", funnel.planned],
        *_counted("dropped before rendering: {}", funnel.dropped),
        ["trajectories not rendered", funnel.not_rendered], ["trajectories rendered", funnel.rendered],
        ["of these accepted", funnel.accepted], ["of these to review", funnel.review],
        ["of these rejected", funnel.rejected],
        ["planned for one accepted", funnel.accepted and round(funnel.planned / funnel.accepted, 2)],
    ]  # fmt: skip


def _outcome_rows(record: ReleaseRecord) -> Rows:
    """Return what became of tracks and captions, how well tracks see the target, and how smooth their motion is."""
    tracks, captions, motion = record.history.flights, record.history.captions, record.numbers.of("motion")
    visibilities = [track.five_ray_mean for track in record.flights if track.five_ray_mean is not None]
    mean_visibility = round(fmean(visibilities), 4) if visibilities else None
    return [
        ["tracks found", tracks.found], ["of these inspected", tracks.inspected],
        *_counted("tracks not released: {}", tracks.left_out), ["tracks released", tracks.released],
        ["mean five-ray visibility of the tracks, from the inspection", mean_visibility],
        [f"tracks below {FIVE_RAY_MEAN_MIN:.0%}", sum(mean < FIVE_RAY_MEAN_MIN for mean in visibilities)],

        ["trajectories whose motion is known", motion["known"]],
        [f"of these within {ACCEL_RMS_MAX_MPS2:g} m/s² and {JERK_RMS_MAX_MPS3:g} m/s³", motion["within"]],
        [f"of these with S below {REVIEW_BELOW:g}", motion["score_below"]],

        ["captions read", captions.read], *_counted("captions dropped: {}", captions.dropped),
        ["captions accepted, but frame not selected", captions.frame_not_selected],
        ["captions accepted, but track not released", captions.flight_left_out],
        ["captions released", captions.released],
    ]  # fmt: skip


def _fovs(numbers: Numbers) -> Rows:
    levels = {f"{fov_deg:g}": name for fov_deg, name in LEVEL_NAMES.items()}
    num_tracks = numbers.of("tracks_by_fov")
    num_frames = sorted(numbers.of("fov").items())
    return [[fov, num_tracks[fov], count, levels.get(fov, "")] for fov, count in num_frames]


def _weather(numbers: Numbers) -> tuple[list[str], Rows]:
    """Return head and rows: frames by preset and time of day, where a frame names one; the paper's first."""
    skies = numbers.of("sky")
    presets = {sky.partition(TAB)[0] for sky in skies}
    times = {sky.partition(TAB)[2] for sky in skies}
    columns = [*TIMES, *sorted(times - {*TIMES})]
    names = [*WEATHERS, *sorted(presets - {*WEATHERS})] if skies else []
    rows: Rows = [[name, *(skies[f"{name}{TAB}{time}"] for time in columns)] for name in names]
    return ["preset", *columns], rows


def _events(numbers: Numbers) -> Rows:
    # A name has three parts, joined by TAB; two more tabs make three of any name that a changed record may have.
    return [[*(event + 2 * TAB).split(TAB)[:3], count] for event, count in sorted(numbers.of("events").items())]


def _decisions(numbers: Numbers) -> Rows:
    decisions, labels = numbers.of("decision"), numbers.of("label")
    total, num_labelled = decisions.total(), labels.total() - labels["none"]
    return [
        [name, decisions[name], percent(decisions[name], total), labels[name], percent(labels[name], num_labelled),
         ACTIONS[name].group]
        for name in TOKENS if total
    ]  # fmt: skip


def _confusion(numbers: Numbers) -> tuple[list[str], Rows]:
    """Return head and rows, one of each for what occurs as a label or as a decision."""
    counts = numbers.of("confusion")
    counted = {name for pair in counts for name in pair.split(TAB)}
    names = [name for name in (*TOKENS, "none") if name in counted]
    rows: Rows = [[label, *(counts[f"{label}{TAB}{decision}"] for decision in names)] for label in names]
    return ["label", *names], rows


def _origin(record: ReleaseRecord) -> Rows:
    numbers, provenance = record.numbers, record.provenance
    columns = [column for column in CAPTION if column.title and column.name not in WITH_TABLE]
    rows: Rows = [[column.title, *pair] for column in columns for pair in numbers.of(column.name).items()]
    rows += [["values of the texts", name, count] for name, count in numbers.of("values").items()]
    rows += [["captions read", f"{teacher.kind}: {teacher.model}", teacher.captions] for teacher in provenance.teachers]
    rows += [["tokens", name.replace("_", " "), count] for name, count in provenance.tokens.items()]
    return [*rows, ["asks", "", provenance.asks]]


def _text_lengths(numbers: Numbers) -> Rows:
    if not numbers.of("flags")["has_caption"]:
        return []
    rows = Rows()
    for language in LANGUAGES:
        floors = MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS
        for name in FIELDS[:2]:  # the texts; the last field is the decision, a token
            title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}"
            spread = numbers.spreads.get(f"caption_{language}_{name}", Spread())
            rows.append([*_spread(title, spread), floors[name]])
    return rows


# --- the page ---------------------------------------------------------------------------------------------------------

STYLE = """
.tables { columns: 560px 2; column-gap: 12px; } .tables .panel { break-inside: avoid; }
.tables .wide { column-span: all; margin-top: 12px; }
"""


def run(dataset: Path, out: Path) -> Path:
    """Read the record of a release (InputError if there is none); write `stats.json` and `stats.html`; return this."""
    record = read_record(release_folder(dataset) / RECORD)
    tables, runs = tables_of(record), [source.run for source in record.provenance.sources]
    write_json(out / "stats.json", {
        "name": record.name, "runs": runs, "content_digest": record.content_digest,
        "tables": [table.model_dump(mode="json") for table in tables],
    })  # fmt: skip
    text = page(
        "release/card/stats.html", title=", ".join(runs) or record.name, style=STYLE, record=record, tables=tables,
        look=TABLE_LOOK,
    )  # fmt: skip
    write_bytes(out / "stats.html", text.encode())
    return out / "stats.html"


def _numeric_columns(table: Table) -> list[bool]:
    return [all(isinstance(row[k], int | float | None) for row in table.rows) for k in range(len(table.head))]


def _greatest(table: Table) -> float:
    """Return the value of a full bar, or of a cell in full colour: the greatest number; 1 if there is none."""
    cells = [cell for row in table.rows for cell in (row[1:] if table.plot == "heat" else row[1:2])]
    return max((float(cell) for cell in cells if isinstance(cell, int | float)), default=0.0) or 1.0


def shown(cell: Cell) -> str:
    """Return a cell for people: numbers without digits that say nothing."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:,}" if isinstance(cell, int) else f"{cell:,.4f}".rstrip("0").rstrip(".")


TABLE_LOOK = {"shown": shown, "numeric_columns": _numeric_columns, "greatest": _greatest}  # of macros of tables.html
