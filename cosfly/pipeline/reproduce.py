"""`cosfly reproduce`: the paper's tables and figures from one run, next to the paper's own, on one page.

Figures that the run recorded are read from its stages. The others are measured again in folders below `out`: planners
and zoom are stages that resume after a kill; depth, weather and single pictures are computed each time.
`paper.yaml` lists the place of each figure, the paper's value, the reason for a difference, and what is not reproduced.

A place says where in the files of a run the figures of a table are stored:

    place  = query {" + " query}                        the figures of all queries, one after the other
    query  = file ":" keys ["|" function {"," function}]
    keys   = {key "."} key {"," key}                    keys to follow; the last step may take several, one figure each
    key    = name | index | id | "*"

In an object a key is a name. In a list it is an index (-1 is the last), or the `id` or `key` of an element. `*` takes
all elements and makes a list of what the remaining keys find in each; elements without it are skipped. A function of
FUNCTIONS is applied to each value; several functions make several figures. What does not exist gives None.

Example: `compare/items.jsonl:*.result.times_ms.muco|mean,max + compare/compare.json:means.muco.length_m,five_ray_mean`
gives four figures: mean and maximum of the planning times in all lines of `items.jsonl`, then two means of
`compare.json`. The file `work` is not on disk: it stands for the figures that this module derives.
"""

from __future__ import annotations

import base64
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field

import cosfly
import cosfly.pedestrians.stage
from cosfly.formats.boxes import read_boxes
from cosfly.formats.captions import FIELDS, Caption, read_captions
from cosfly.formats.segments import FOLLOW
from cosfly.pipeline.runs import summarize
from cosfly.pipeline.settings import RunConfig
from cosfly.planners import compare
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import camera_of
from cosfly.runtime.config import build, read_yaml
from cosfly.runtime.errors import InputError, json_type
from cosfly.runtime.events import LOSSES, Event, read_events
from cosfly.runtime.io import read_bytes, write_bytes
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import FileFormat, read_object, write_json
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.png import read_picture
from cosfly.runtime.run_dir import Manifest, read_manifest
from cosfly.studies import depth, weather, zoom
from cosfly.viz.frame_views import small_jpeg
from cosfly.viz.gallery import four_panels
from cosfly.viz.page import page, run_name
from distill.prepare.dual_track import windows_of
from release.card.tables import TABLE_LOOK, Cell, Rows, Table
from release.card.tables import run as release_stats

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.reproduction", "1.0")
STAGES = ("maps", "simplify", "pedestrians", "plan")  # complete in every run that can be compared
WITH_ITEMS = ("pedestrians", "plan", "render", "inspect", "caption", "release")  # stages with a time per item
PLANNERS = ("track_astar", "muco", "foresight")  # the first is compared with the others, as in the paper
LENSES_DEG = (120, 110, 90, 70, 60, 45, 30)  # tab:zoom_conversion
ZOOM_DEG = (110.0, 90.0, 60.0, 30.0)
ZOOM_EVERY = 12  # frames
ALL_ROWS = "*"  # a row of `paper.yaml` for all rows that its place names
WIDTH_PX = 1500  # of pictures on the page
DERIVED = "work"
MAKE_AGAIN = "run the stage that writes the file again"
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "mean": lambda values: float(np.mean(values)),
    "std": lambda values: float(np.std(values)),
    "min": min,
    "max": max,
    "p50": lambda values: float(np.percentile(values, 50)),
    "p95": lambda values: float(np.percentile(values, 95)),
    "count": len,
    "peak": lambda probes: max(sum(probe.values()) for probe in probes),  # memory of all workers together
    "shares": lambda counts: {name: 100.0 * count / sum(counts.values()) for name, count in counts.items()},
}
STYLE = """
.pair { display: flex; flex-wrap: wrap; gap: 12px 34px; align-items: flex-start; }
.pair img { flex: 1 1 420px; min-width: 0; max-width: min(100%, 860px); border-radius: 4px; }
.panel h2 { margin-top: 2px; } [id="muco_visibility"] img { flex-basis: 100%; max-width: 100%; }
"""
# Tables of `cosfly release stats` that are shown; the paper's others come from the plans of the run.
OF_RELEASE = ("release", "decisions", "confusion", "repairs", "text_lengths", "fovs", "weather")


class Part(Table):
    """A table of the paper with this run's figures."""

    source: Literal["recorded", "measured again"] = "recorded"
    picture: str | None = Field(None, exclude=True)  # JPEG in base64, on the page only


class PaperTable(BaseModel):
    """A table of `paper.yaml`."""

    title: str
    head: str  # names of the columns, separated by `|`
    places: dict[str, str] = Field(alias="here")  # row: place of our figures, or the text for `{}` in template
    template: str = Field("{}", alias="from")
    reason: str = Field("", alias="why")  # why our figures differ
    paper_rows: dict[str, Any] = Field({}, alias="paper")  # row: the paper's figures
    more_labels: str = Field("", alias="also")  # further labels of the paper that the table covers
    picture: str | None = None

    def labels(self, label: str) -> str:
        """Return all labels of the table, separated by commas."""
        return f"{label}, {self.more_labels}" if self.more_labels else label


class Paper(BaseModel):
    """`paper.yaml`."""

    settings: dict[str, dict[str, Any]]  # label: setting: value
    tables: dict[str, PaperTable]
    left_out: dict[str, str]  # labels: reason why they are not compared


def read_paper() -> Paper:
    """Read the paper's figures, and the places of ours."""
    path = Path(__file__).with_name("paper.yaml")
    return build(Paper, read_yaml(path), path)


def run(cfg: RunConfig, folder: Path, out: Path, *, pedestrians: int = 20, seed: int = 0, **pool: Any) -> Path:
    """Read a run directory; write `reproduction.html` and `reproduction.json`, and return the page."""
    done = [stage.name for stage in summarize(folder).stages if stage.state == "complete"]
    _check_finished(cfg, folder, done)
    sample = measure(cfg, folder, out, pedestrians, done, pool | {"seed": seed})
    reader = FigureReader([folder, out], {} if sample is None else {"sample": sample})
    reader.derived |= derived_figures(cfg, folder, reader, done)
    paper = read_paper()
    parts = [compare_settings(cfg, paper)]
    left_out = dict(paper.left_out)
    for label, table in paper.tables.items():
        try:
            parts.append(make_part(label, table, reader))
        except MissingFile as missing_file:
            left_out[table.labels(label)] = f"needs {missing_file}, which this run did not write"
    if "release" in done:
        tables = read_object(out / "release/stats.json", what="statistics")["tables"]
        parts += [Part(**table) for table in tables if table["key"] in OF_RELEASE]
    return _write_page(out, run_name(folder / "plan"), pedestrians, parts, left_out)


def _check_finished(cfg: RunConfig, folder: Path, done: Sequence[str]) -> None:
    missing = [name for name in STAGES if name not in done]
    if missing:
        what = "the run is not finished"
        fix = f"finish it with cosfly run {folder}"
        if cfg.towns:
            what = "the run has several towns, and its directory itself has no drone trajectories"
            fix = f"pass the directory of one town, such as {folder}/{next(iter(cfg.towns))}"
        raise InputError(what, where=folder, got=f"no results of the stages {', '.join(missing)}", fix=fix)


def _write_page(out: Path, name: str, pedestrians: int, parts: list[Part], left_out: dict[str, str]) -> Path:
    """Write the page and the JSON file; return the page. left_out: what is not compared, and why."""
    facts = {
        "run": name,
        "made_by": f"cosfly {cosfly.__version__}, {num_cpus()} cores",
        "pedestrians": pedestrians,
        "left_out": left_out,
    }
    records = [part.model_dump(mode="json") for part in parts]
    write_json(out / "reproduction.json", {**FORMAT.header, **facts, "parts": records})
    text = page("cosfly/pipeline/reproduce.html", title=name, style=STYLE, facts=facts, parts=parts, look=TABLE_LOOK)
    write_bytes(out / "reproduction.html", text.encode())
    return out / "reproduction.html"


# --- tables -----------------------------------------------------------------------------------------------------------


def make_part(label: str, table: PaperTable, reader: FigureReader) -> Part:
    """Make a table of the paper: our figures, with the paper's next to or below them."""
    our_rows, sources = our_figures(table, reader)
    paper_rows = {name: _as_list(figures) for name, figures in table.paper_rows.items()}
    head, rows = lay_out(table.head.split("|"), our_rows, paper_rows)
    is_recorded = all((reader.roots[0] / file).is_file() for file in sources)
    return Part(
        key=label,
        title=table.title,
        head=head,
        rows=rows,
        paper=table.labels(label),
        note=note_of(table.reason, sources, has_paper_rows=bool(paper_rows)),
        source="recorded" if is_recorded else "measured again",
        picture=_jpeg(reader.file(table.picture)) if table.picture else None,
    )


def our_figures(table: PaperTable, reader: FigureReader) -> tuple[dict[str, list[Any]], set[str]]:
    """Return our figures by row, and the files that they and the picture come from."""
    rows = dict[str, list[Any]]()
    sources = {table.picture} if table.picture else set()
    for name, entry in table.places.items():
        place = entry if ":" in entry else table.template.format(entry)
        sources |= files_of(place)
        figures = reader.figures(place)
        if name != ALL_ROWS:
            rows[name] = figures
            continue
        named_rows = figures[0] or {}
        if not isinstance(named_rows, dict):
            what = "the field of the file is not a table of rows"
            expected = "an object with one entry for each row name"
            raise InputError(what, where=place, got=json_type(named_rows), expected=expected, fix=MAKE_AGAIN)
        rows |= {key: _as_list(row) for key, row in named_rows.items()}
    return rows, sources


def lay_out(
    head: list[str], our_rows: Mapping[str, list[Any]], paper_rows: Mapping[str, list[Any]]
) -> tuple[list[str], Rows]:
    """Return the head and the rows of a table.

    With `here` as the second column our figures are one column, and the paper's follow in the same row. Else a row of
    the paper follows ours.
    """
    rows = Rows()
    num_figures = len(head) - 1
    names = dict.fromkeys([*our_rows, *paper_rows])
    if head[1] == "here":
        for name in names:
            ours = _cells(our_rows.get(name, []), 1)
            rows.append([name, *ours, *_cells(paper_rows.get(name, []), num_figures - 1)])
        return head, rows
    if not paper_rows:
        return head, [[name, *_cells(figures, num_figures)] for name, figures in our_rows.items()]
    for name in names:
        if name in our_rows:
            rows.append([name, "here", *_cells(our_rows[name], num_figures)])
        if name in paper_rows:
            rows.append(["" if name in our_rows else name, "paper", *_cells(paper_rows[name], num_figures)])
    return [head[0], "", *head[1:]], rows


def note_of(reason: str, sources: set[str], *, has_paper_rows: bool) -> str:
    """Return the note below a table: the reason for differences, and the files of our figures."""
    note = ""
    if reason:
        note = f"Differs: {reason}. " if has_paper_rows else f"{reason[0].upper()}{reason[1:]}. "
    if sources:
        note += f"From {', '.join(sorted(sources))}."
    return note


def _as_list(row: Any) -> list[Any]:
    if isinstance(row, dict):
        return list(row.values())
    return row if isinstance(row, list) else [row]


def _cells(figures: list[Any], width: int) -> list[Cell]:
    """Return cells of `width` columns, the missing ones empty."""
    cells: list[Cell] = [_cell(figure) for figure in figures[:width]]
    return cells + [None] * (width - len(cells))


def _cell(value: Any) -> Cell:
    """Return the content of a cell: numbers and texts as they are, counts by name and lists as text."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    if isinstance(value, float):
        return round(value, 1) if abs(value) >= 1000.0 else float(f"{value:.4g}")
    return value


def _jpeg(path: Path) -> str:
    if path.suffix == ".jpg":
        return base64.b64encode(read_bytes(path)).decode("ascii")
    picture = read_picture(path)
    return small_jpeg(picture, min(WIDTH_PX, picture.shape[1]))


def compare_settings(cfg: RunConfig, paper: Paper) -> Part:
    """Compare the settings of the run with the paper's."""
    values = cfg.all_values()
    rows = Rows()
    for label, paper_values in paper.settings.items():
        for name, paper_value in paper_values.items():
            value = follow(values, name.split("."))
            remark = "" if value == paper_value else "other"
            rows.append([name, str(_cell(value)), str(_cell(paper_value)), remark, label])
    return Part(
        key="settings",
        title="Settings",
        head=["setting", "here", "paper", "", "label"],
        rows=rows,
        paper=", ".join(paper.settings),
        note="The paper's planner, trunks and SimWorld runs are settings here, not defaults.",
    )


# --- places of figures ------------------------------------------------------------------------------------------------


class MissingFile(Exception):
    """A file that a table needs does not exist."""


@dataclass
class FigureReader:
    """Reads figures by their places."""

    roots: Sequence[Path]  # folders that files are searched in, the run directory first
    derived: dict[str, Any]  # the figures of the file `work`
    _documents: dict[str, Any] = field(default_factory=dict)

    def file(self, name: str) -> Path:
        """Return the path of a file in the first root that has it; raise MissingFile if none has."""
        for root in self.roots:
            if (root / name).is_file():
                return root / name
        raise MissingFile(name)

    def figures(self, place: str) -> list[Any]:
        """Return the figures of a place; None for each that does not exist.

        Raises:
            MissingFile: No root has the file.
            InputError: A function cannot be applied to the value.
        """
        return [figure for query in place.split(" + ") for figure in self._figures_of_query(query)]

    def _figures_of_query(self, query: str) -> list[Any]:
        target, _, functions = query.partition("|")
        file, _, keys = target.partition(":")
        *parents, last = keys.split(".")
        try:
            values = [follow(self._document(file), [*parents, key]) for key in last.split(",")]
            if not functions:
                return values
            names = functions.split(",")
            return [FUNCTIONS[name](value) if value else None for value in values for name in names]
        except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
            expected = f"a value for {functions}" if functions else "an object or a list where the key has `*`"
            what = "the number for the comparison with the paper cannot be computed from this field"
            raise InputError(what, where=f"{file}: {keys}", got=str(error), expected=expected, fix=MAKE_AGAIN) from None

    def _document(self, file: str) -> Any:
        if file == DERIVED:
            return self.derived
        if file not in self._documents:
            path = self.file(file)
            is_journal = path.suffix == ".jsonl"
            self._documents[file] = list(Journal(path).read()) if is_journal else read_object(path, what="report")
        return self._documents[file]


def files_of(place: str) -> set[str]:
    """Return the files on disk that a place reads."""
    return {query.partition(":")[0] for query in place.split(" + ")} - {DERIVED}


def follow(value: Any, keys: Sequence[str]) -> Any:
    """Return the value that the keys lead to, or None if it does not exist."""
    for k, key in enumerate(keys):
        if key == "*":
            elements = value.values() if isinstance(value, dict) else value
            results = [follow(element, keys[k + 1 :]) for element in elements]
            return [result for result in results if result is not None]
        if isinstance(value, list):
            value = _element(value, key)
        elif isinstance(value, dict):
            value = value.get(key)
        else:
            value = None
    return value


def _element(elements: list[Any], key: str) -> Any:
    """Return the element with an index, an `id` or a `key`; None if there is none."""
    if key.lstrip("-").isdecimal():
        index = int(key)
        return elements[index] if -len(elements) <= index < len(elements) else None
    by_id = {str(element.get("id", element.get("key"))): element for element in elements if isinstance(element, dict)}
    return by_id.get(key)


# --- figures that are measured again ----------------------------------------------------------------------------------


def measure(
    cfg: RunConfig, folder: Path, out: Path, num_pedestrians: int, done: Sequence[str], options: dict[str, Any]
) -> str | None:
    """Measure what the run has not recorded, in folders below `out`; return the frame that is shown, if it renders.

    Planners track the paper's reference trajectory, whatever styles the run has. The pedestrians are sampled on the
    run's map with its settings; the run's own pedestrians are the first of them.

    Args:
        done: Complete stages of the run.
        options: `seed`, `workers` and `watch` of stages.
    """
    boxes = folder / "maps/boxes_3d.json"
    simplified = folder / "simplify/step2_simplified.json"
    traces = folder / "plan/drone_trace.json"
    only_targets = {"num_paths": num_pedestrians, "others": 0, "look_alikes": 0}
    walking = cfg.pedestrians.model_copy(update=only_targets)
    paths = cosfly.pedestrians.stage.run(walking, simplified, out / "pedestrians", roi=cfg.roi, **options)
    plan = cfg.plan.model_copy(update={"styles": {FOLLOW: 1.0}})
    compared = build(compare.CompareConfig, plan.model_dump() | {"planners": PLANNERS}, "planners")
    compare.run(compared, simplified, paths, out / "compare", **options)
    if "release" in done:
        release_stats(folder / "release/dataset", out / "release")
    if "render" not in done:
        return None
    log.info("reproduce: pictures")
    tree = folder / "render"
    frame = four_panels(tree, out / "sample.png", box_map=read_boxes(boxes))
    depth.run(tree / frame, out / "depth")
    weather.run(cfg.render, boxes, traces, out / "weather", seed=cfg.seed)
    lenses = cfg.render.model_copy(update={"fovs_deg": ZOOM_DEG})
    zoom.run(lenses, boxes, simplified, traces, out / "zoom", every=ZOOM_EVERY, **options)
    return frame


def derived_figures(cfg: RunConfig, folder: Path, reader: FigureReader, done: Sequence[str]) -> dict[str, Any]:
    """Return the figures that come from several files, or from none."""
    manifests = {name: read_manifest(folder / name) for name in WITH_ITEMS if name in done}
    lens = RenderConfig(width_px=1280, height_px=720)
    cameras = {str(fov): camera_of(lens, fov) for fov in LENSES_DEG}
    track_lengths = reader.figures("plan/drone_trace.json:traces.*.metrics.num_points")[0]
    figures: dict[str, Any] = {
        "budget": {name: [m.seconds, m.counts.input, m.seconds / m.counts.input] for name, m in manifests.items()},
        "watchdog": {name: watchdog_figures(read_events(folder / name), manifests[name]) for name in manifests},
        "lenses": {fov: [camera.focal_px, camera.focal_35mm_mm] for fov, camera in cameras.items()},
        "samples": [len(windows_of(length, cfg.distill.dual_track)) for length in track_lengths],
    }
    if "render" in manifests:
        figures["rendering"] = rendering_figures(read_events(folder / "render"), manifests["render"])
    if "render" in manifests and "caption" in manifests:
        caption = _caption_near(folder / "caption/captions.jsonl", reader.derived["sample"])
        if caption is not None:
            figures["caption"] = caption
    return figures


def watchdog_figures(events: list[Event], manifest: Manifest) -> list[Any]:
    """Return the row of tab:watchdog_reliability of a stage: worker processes, restarts, seconds, losses by kind."""
    counts = Counter(event.event for event in events)
    losses = {kind: count for kind, count in counts.items() if kind in LOSSES}
    return [counts["worker_started"] + counts["restarted"], counts["restarted"], manifest.seconds, losses]


def rendering_figures(events: list[Event], manifest: Manifest) -> dict[str, list[Any]]:
    """Return the row of tab:render_scaling of a rendering, from its events and its manifest.

    Frames are attempted if they are finished, or lost with a worker.
    """
    num_workers = max((event.workers or 1 for event in events if event.event == "began"), default=1)
    done = [event for event in events if event.event == "item_done"]
    lost = [event for event in events if event.event in LOSSES]
    probes = [event for event in events if event.event == "probe"]
    num_attempted = sum(event.steps or 0 for event in [*done, *lost])
    num_successful = sum(event.steps or 0 for event in done if event.status == "kept")
    row = [
        manifest.seconds,
        num_attempted,
        num_successful,
        num_successful / manifest.seconds,
        1.0 if num_successful else None,  # the speed-up against itself
        round(float(np.mean([probe.cores_used or 0.0 for probe in probes] or [0.0])), 2),
        max((sum((probe.rss_mib or {}).values()) for probe in probes), default=0.0),
        sum(event.event == "restarted" for event in events),
        manifest.counts.failed.total(),
    ]
    return {f"{num_workers} workers": row}


def _caption_near(captions: Path, frame: str) -> dict[str, list[Any]] | None:
    """Return the accepted caption in both languages that is nearest to a frame, by field; None if there is none."""
    # town/trajectory/variant/frames_playback/frame_00000
    *_, trajectory, _, _, name = frame.split("/")
    frame_index = int(name.rpartition("_")[2])
    accepted = [
        caption for caption in read_captions(captions) if caption.en and caption.zh and caption.status == "accepted"
    ]
    if not accepted:
        return None

    def distance(caption: Caption) -> tuple[bool, int]:
        return caption.trajectory != trajectory, abs(caption.frame_index - frame_index)

    nearest = min(accepted, key=distance)
    texts = {field: [getattr(nearest.en, field), getattr(nearest.zh, field)] for field in FIELDS}
    return {"sample id": [nearest.sample_id], **texts}
