"""The statistics of a release as tables: those of the paper (sec:dataset_stats) that it supports.

All of it is in release.json, which `release verify` compares with the rows. The card prints these tables, and
`cosfly release stats` draws them.
"""

from __future__ import annotations

from collections.abc import Iterable
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
OF_THEIR_OWN = ("decision", "label", "verdict", "repair_strategy")  # columns of captions that have a table
VERDICTS = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")


class Table(Record):
    """One table. paper: The label of the paper's. rows: As long as `head`. plot: How a page draws it: the second column
    as bars, or the numbers of a row and column of names as heat."""

    key: str
    title: str
    head: list[str]
    rows: Rows
    paper: str | None = None
    note: str = ""
    plot: Plot | None = None


SPREAD = "mean|std|least|most|values"
SHAPES: dict[str, tuple[str, str, str, Plot | None]] = {  # of each table: title, of the paper, head, how it is drawn
    "release": ("The release", "sec:dataset_stats, sec:exp_release", "|number", None),
    "quality_stats": ("From plan to release", "tab:quality_stats", "|number", None),
    "dist_stats": ("Tracks and trajectories", "tab:dist_stats", f"axis|{SPREAD}", None),
    "fovs": ("Fields of view", "tab:zoom_config, sec:exp_release", "degrees|tracks|frames|level", "bars"),
    "weather": ("Weather and time of day", "tab:weather_coverage", "preset", "heat"),
    "augmentation_states": ("Perturbation", "tab:augmentation_states", "state|frames|%", "bars"),
    "events": ("Outcome of each perturbation", "sec:exp_render, app:dual_track", "track|event|outcome|frames", None),
    "actions": ("Actions", "", "class|frames|%", "bars"),
    "decisions": ("Decisions", "tab:coc_actions", "action|decisions|%|labels|% |group", "bars"),
    "confusion": ("Label (rows) against decision (columns)", "fig:confusion_patterns", "label", "heat"),
    "verdicts": ("Decision against the geometry", "fig:consistency_verdict", "verdict|captions|%", "bars"),
    "repairs": ("Repairs", "fig:regen_strategy", "strategy|captions|%", "bars"),
    "origin": ("Origin of the captions", "tab:caption_pipeline", "||number", None),
    "text_lengths": ("Length of the texts", "fig:coc_lengths", f"text|{SPREAD}|floor", None),
}  # fmt: skip
SPREADS = {
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
NOTES = {
    "dist_stats": "Of trajectories without perturbation: of the clean track, or the perturbed one minus its offsets.",
    "weather": "Frames. The presets of the paper are all listed.",
    "augmentation_states": "Frames of perturbed tracks by their recorded offsets, after fallbacks.",
    "actions": "Frames by their column action, of the planned motion: the greatest velocity until the next frame; "
    "below 0.3 m/s a turn of at least 5 degrees/s, else hover.",
    "verdicts": "Of accepted captions, after repair; the figure of the paper shows first answers, before repair.",
    "origin": "Values of slots are filled in from the measured facts, those of prose are compared with them: a "
    "number that equals a fact of its unit is matched (it may be the wrong quantity), one that equals none is "
    "contradicted. Words without numbers are not checked. Asks, tokens and teachers: of all captions that were read.",
    "text_lengths": "Characters. The last column is the smallest accepted length.",
}


def tables_of(record: ReleaseRecord) -> list[Table]:
    """Return the tables of a release; those without rows are skipped."""
    numbers = record.numbers
    times = [*TIMES, *sorted({sky.partition(TAB)[2] for sky in numbers.of("sky")} - {*TIMES})]
    found = {name for pair in numbers.of("confusion") for name in pair.split(TAB)}
    order = [name for name in (*TOKENS, "none") if name in found]
    repairs = numbers.of("repair_strategy")
    rows: dict[str, Rows] = {
        "release": _release(record), "quality_stats": _quality(record), "dist_stats": _dist(record),
        "fovs": _fovs(numbers), "weather": _weather(numbers, times),
        "augmentation_states": _shares(numbers, "states", STATES),
        "events": [
            [*(event + 2 * TAB).split(TAB)[:3], count] for event, count in sorted(numbers.of("events").items())
        ],
        "actions": _shares(numbers, "action", ACTION_CLASSES),
        "decisions": _decisions(numbers),
        "confusion": [[own, *(numbers.of("confusion")[f"{own}{TAB}{other}"] for other in order)] for own in order],
        "verdicts": _shares(numbers, "verdict", VERDICTS), "repairs": _shares(numbers, "repair_strategy", repairs),
        "origin": _origin(record), "text_lengths": _lengths(numbers),
    }  # fmt: skip
    more = {"weather": times, "confusion": order}
    return [_table(key, own, more.get(key, [])) for key, own in rows.items() if own]


def _table(key: str, rows: Rows, more: list[str]) -> Table:
    """Return a table by its shape. more: Of its head, after that of the shape."""
    title, paper, head, plot = SHAPES[key]
    heads = [*head.split("|"), *more]
    return Table(key=key, title=title, head=heads, rows=rows, paper=paper or None, note=NOTES.get(key, ""), plot=plot)


def percent(count: int, total: int) -> float | None:
    """Return a share of a total in percent, rounded; None of nothing."""
    return round(100.0 * count / total, 2) if total else None


def _shares(numbers: Numbers, name: str, values: Iterable[str]) -> Rows:
    """Return counts and shares of values; nothing where none was counted."""
    counts = numbers.of(name)
    total = counts.total()
    known = list(values)
    return [[value, counts[value], percent(counts[value], total)] for value in (*known, *sorted({*counts} - {*known}))
            if total]  # fmt: skip


def _spread(title: str, spread: Spread) -> list[Cell]:
    return [title, spread.mean, spread.std, spread.min, spread.max, spread.count]


def _release(record: ReleaseRecord) -> Rows:
    numbers, flags = record.numbers, record.numbers.of("flags")
    pictures = record.settings.modalities
    by_track = ((f"tracks, {name}", count) for name, count in numbers.of("tracks_by_track").items())
    without = record.history.captions.frames_without.items()
    depth = record.depth and f"{record.depth.coding}, {record.depth.unit}, sky {record.depth.sky:g}"
    rows = {
        "trajectories": numbers.trajectories, **dict(by_track),
        "tracks whose other track is released too (column pair)": sum(one.pair is not None for one in record.flights),
        "walks": len({one.walk for one in record.flights}),
        **{f"frames of {town}": count for town, count in numbers.of("town").items()}, "frames": numbers.frames,
        f"pictures ({', '.join(pictures)})": numbers.frames * len(pictures),
        "fewest frames of a track, rendered": min((one.frames_available for one in record.flights), default=None),
        "most frames of a track, rendered": max((one.frames_available for one in record.flights), default=None),
        "time step, s": ", ".join(sorted(numbers.of("step_s"))) or None,
        **{f"frames of {size} px": count for size, count in numbers.of("image_px").items()},
        "frames that show the target": flags["target_visible"],
        "frames that show the target legibly (column target_legible)":
            flags["target_legible"] if flags["legibility_known"] == numbers.frames else None,
        "frames with a perturbation": flags["is_perturbed"],
        "frames with an action (column action)": numbers.of("action").total(),
        "depth": depth or "not released", "frames with a caption": flags["has_caption"],
        **{f"captions in {LANGUAGE_NAMES[language]}": flags[language] for language in LANGUAGES},
        **{f"frames without a caption: {reason}": count for reason, count in without},
    }  # fmt: skip
    return [[name, value] for name, value in rows.items()]


def _quality(record: ReleaseRecord) -> Rows:
    """Return what became of the trajectories, tracks and captions, and how smooth the motion is."""
    planned, tracks, captions = record.history.trajectories, record.history.flights, record.history.captions
    motion = record.numbers.of("motion")
    five_ray = [one.five_ray_mean for one in record.flights if one.five_ray_mean is not None]
    rows = dict[str, Cell]()
    if planned is not None:
        rows = {
            "trajectories planned": planned.planned,
            **{f"dropped before rendering: {reason}": count for reason, count in planned.dropped.items()},
            "trajectories not rendered": planned.not_rendered, "trajectories rendered": planned.rendered,
            "of these accepted": planned.accepted, "of these to review": planned.review,
            "of these rejected": planned.rejected,
            "planned for one accepted": planned.accepted and round(planned.planned / planned.accepted, 2),
        }  # fmt: skip
    rows |= {
        "tracks found": tracks.found, "of these inspected": tracks.inspected,
        **{f"tracks not released: {reason}": count for reason, count in tracks.left_out.items()},
        "tracks released": tracks.released,
        "mean five-ray visibility of the tracks, from the inspection": round(fmean(five_ray), 4) if five_ray else None,
        f"tracks below {FIVE_RAY_MEAN_MIN:.0%}": sum(mean < FIVE_RAY_MEAN_MIN for mean in five_ray),
        "trajectories whose motion is known": motion["known"],
        f"of these within {ACCEL_RMS_MAX_MPS2:g} m/s² and {JERK_RMS_MAX_MPS3:g} m/s³": motion["within"],
        f"of these with S below {REVIEW_BELOW:g}": motion["score_below"],
        "captions read": captions.read,
        **{f"captions dropped: {reason}": count for reason, count in captions.dropped.items()},
        "captions accepted, but frame not selected": captions.frame_not_selected,
        "captions accepted, but track not released": captions.flight_left_out,
        "captions released": captions.released,
    }  # fmt: skip
    return [[name, value] for name, value in rows.items()]


def _dist(record: ReleaseRecord) -> Rows:
    spreads = record.numbers.spreads
    return [_spread(title, spreads.get(name, Spread())) for name, title in SPREADS.items()]


def _fovs(numbers: Numbers) -> Rows:
    tracks, rows = numbers.of("tracks_by_fov"), Rows()
    for fov, frames in sorted(numbers.of("fov").items()):
        level = next((name for lens_deg, name in LEVEL_NAMES.items() if fov == f"{lens_deg:g}"), "")
        rows.append([fov, tracks[fov], frames, level])
    return rows


def _weather(numbers: Numbers, times: list[str]) -> Rows:
    """Return frames by preset and time of day, where a frame names one."""
    skies = numbers.of("sky")
    presets = [*WEATHERS, *sorted({sky.partition(TAB)[0] for sky in skies} - {*WEATHERS})] if skies else []
    return [[preset, *(skies[f"{preset}{TAB}{time}"] for time in times)] for preset in presets]


def _decisions(numbers: Numbers) -> Rows:
    decisions, labels = numbers.of("decision"), numbers.of("label")
    total, labelled = decisions.total(), labels.total() - labels["none"]
    return [
        [name, decisions[name], percent(decisions[name], total), labels[name], percent(labels[name], labelled),
         ACTIONS[name].group if name in ACTIONS else ""]
        for name in TOKENS if total
    ]  # fmt: skip


def _origin(record: ReleaseRecord) -> Rows:
    numbers, made = record.numbers, record.provenance
    columns = [one for one in CAPTION if one.title and one.name not in OF_THEIR_OWN]
    rows: Rows = [[one.title, value, count] for one in columns for value, count in numbers.of(one.name).items()]
    rows += [["values of the texts", name, count] for name, count in numbers.of("values").items()]
    rows += [["captions read", f"{one.kind}: {one.model}", one.captions] for one in made.teachers]
    rows += [["tokens", name.replace("_", " "), count] for name, count in made.tokens.items()]
    return [*rows, ["asks", "", made.asks]]


def _lengths(numbers: Numbers) -> Rows:
    rows = Rows()
    for language in LANGUAGES if numbers.of("flags")["has_caption"] else ():
        for name in FIELDS[:2]:
            least = (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS)[name]
            title = f"{LANGUAGE_NAMES[language]}, {name.replace('_', ' ')}"
            rows.append([*_spread(title, numbers.spreads.get(f"caption_{language}_{name}", Spread())), least])
    return rows


# --- the page ---------------------------------------------------------------------------------------------------------

STYLE = """
.tables { columns: 560px 2; column-gap: 12px; } .tables .panel { break-inside: avoid; }
.tables .wide { column-span: all; margin-top: 12px; }
"""


def run(dataset: Path, out: Path) -> Path:
    """Read the record of a release; write `stats.json` and `stats.html`, and return the page.

    The numbers are those of the record; `release verify` compares them with the rows.

    Raises:
        InputError: If the folder is not a release.
    """
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
