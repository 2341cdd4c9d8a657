"""`cosfly reproduce`: the paper's tables and figures from one run, next to the paper's own, on one page.

What the run recorded is read from its stages. The rest is measured again in folders below `out`: planners, TA*'s beam
and zoom are stages that resume after a kill; depth, weather and single pictures are made again. `paper.yaml` lists
where each figure is found, the paper's value, why they differ, and what is not reproduced.
"""

from __future__ import annotations

import base64
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, Field

import cosfly
import cosfly.pedestrians.stage
from cosfly.formats.boxes import read_boxes
from cosfly.formats.captions import FIELDS, read_captions
from cosfly.formats.segments import FOLLOW
from cosfly.pipeline import bench as benchmark
from cosfly.pipeline.runs import summarize
from cosfly.pipeline.settings import RunConfig
from cosfly.planners import compare
from cosfly.render.settings import RenderConfig
from cosfly.runtime.arrays import read_picture
from cosfly.runtime.config import build, read_yaml
from cosfly.runtime.errors import InputError
from cosfly.runtime.events import read_events
from cosfly.runtime.io import read_bytes, write_bytes
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import FileFormat, read_object, write_json
from cosfly.runtime.run_dir import Resume, read_manifest
from cosfly.studies import beam, depth, weather, zoom
from cosfly.viz.frame_views import small_jpeg
from cosfly.viz.gallery import four_panels
from cosfly.viz.page import page, run_name
from distill.prepare.dual_track import windows_of
from release.stats.stats import TABLE_LOOK
from release.stats.stats import run as release_stats
from release.stats.tables import Cell, Rows, Table

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.reproduction", "1.0")
STAGES = ("maps", "simplify", "pedestrians", "plan")  # of a run that can be compared
PLANNERS = ("track_astar", "muco", "foresight")  # the first is compared with the others, as in the paper
LENSES_DEG = (120, 110, 90, 70, 60, 45, 30)  # tab:zoom_conversion
ZOOM_DEG, ZOOM_EVERY = (110.0, 90.0, 60.0, 30.0), 12
UNEXPECTED = "the file is not as a stage writes it"
WIDTH_PX = 1500  # of pictures on the page
STYLE = """
.pair { display: flex; flex-wrap: wrap; gap: 12px 34px; align-items: flex-start; }
.pair img { flex: 1 1 420px; min-width: 0; max-width: min(100%, 860px); border-radius: 4px; }
.panel h2 { margin-top: 2px; } [id="muco_visibility"] img { flex-basis: 100%; max-width: 100%; }
"""
# Tables of `cosfly release stats` that are the paper's; the others come from plans here.
OF_RELEASE = ("release", "decisions", "confusion", "repairs", "text_lengths", "fovs", "weather")


class Part(Table):
    """A table of the paper with this run's figures. picture: JPEG in base64, on the page only."""

    source: Literal["recorded", "measured again"] = "recorded"
    picture: str | None = Field(None, exclude=True)


class Printed(BaseModel):
    """A table of `paper.yaml`. here: row -> place of its figures, or the argument of `from`; "*": all rows of it."""

    title: str
    head: str
    here: dict[str, str]
    why: str = ""
    paper: dict[str, Any] = {}
    also: str = ""
    picture: str | None = None
    place: str = Field("{}", alias="from")


class Paper(BaseModel):
    """`paper.yaml`. settings: label -> setting -> value; left_out: labels -> why."""

    settings: dict[str, dict[str, Any]]
    tables: dict[str, Printed]
    left_out: dict[str, str]


class MissingFile(Exception):
    """A file that a table needs does not exist."""


def read_paper() -> Paper:
    """Read the paper's figures, and the places of ours."""
    path = Path(__file__).with_name("paper.yaml")
    return build(Paper, read_yaml(path), path)


def run(
    cfg: RunConfig, folder: Path, out: Path, *, pedestrians: int = 20, seed: int = 0, resume: Resume, **pool: Any
) -> Path:
    """Read a run directory; write `reproduction.html` and `reproduction.json`, and return the page.

    Args:
        pedestrians: Number of pedestrians that planners are measured on.
        pool: `workers` and `watch` of stages.

    Raises:
        InputError: It is not a run directory, has several towns, or no drone trajectories yet.
    """
    done = [stage.name for stage in summarize(folder).stages if stage.state == "complete"]
    if missing := [name for name in STAGES if name not in done]:
        fix = f"one town at a time: {folder}/{next(iter(cfg.towns))}" if cfg.towns else f"cosfly run {folder}"
        what, got = "the run has no drone trajectories yet", f"no {', no '.join(missing)}"
        raise InputError(what, where=folder, got=got, fix=fix)
    printed = read_paper()
    places = Places(
        [folder, out], measure(cfg, folder, out, pedestrians, done, pool | {"seed": seed, "resume": resume})
    )
    places.made |= work(cfg, folder, places, done)
    parts, left_out = [settings(cfg, printed)], dict(printed.left_out)
    for label, table in printed.tables.items():
        try:
            parts.append(part(label, table, places))
        except MissingFile as absent:
            left_out[f"{label}, {table.also}".strip(", ")] = f"needs {absent}, which this run has not made"
    if "release" in done:
        tables = read_object(out / "release/stats.json", what="statistics")["tables"]
        parts += [Part(**one) for one in tables if one["key"] in OF_RELEASE]
    name, machine = run_name(folder / "plan"), f"cosfly {cosfly.__version__}, {len(os.sched_getaffinity(0))} cores"
    facts = {"run": name, "made_by": machine, "pedestrians": pedestrians, "left_out": left_out}
    listed = [one.model_dump(mode="json") for one in parts]
    write_json(out / "reproduction.json", {**FORMAT.header, **facts, "parts": listed})
    text = page("cosfly/pipeline/reproduce.html", title=name, style=STYLE, facts=facts, parts=parts, look=TABLE_LOOK)
    write_bytes(out / "reproduction.html", text.encode())
    return out / "reproduction.html"


# --- places of figures ----------------------------------------------------------------------------------------------

FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "mean": lambda values: float(np.mean(values)), "std": lambda values: float(np.std(values)), "min": min, "max": max,
    "p50": lambda values: float(np.percentile(values, 50)), "p95": lambda values: float(np.percentile(values, 95)),
    "count": len,
    "peak": lambda probes: max(sum(one.values()) for one in probes),  # memory of all workers
    "shares": lambda counts: {name: 100.0 * count / sum(counts.values()) for name, count in counts.items()},
}  # fmt: skip


@dataclass
class Places:
    """Reader of figures by their places. roots: the run, and further folders with files; made: `work`."""

    roots: Sequence[Path]
    made: dict[str, Any]
    _read: dict[str, Any] = field(default_factory=dict)

    def file(self, name: str) -> Path:
        found = next((root / name for root in self.roots if (root / name).is_file()), None)
        if found is None:
            raise MissingFile(name)
        return found

    def figures(self, place: str) -> list[Any]:
        """Return the figures of a place of `paper.yaml`; None where one does not exist."""
        found = list[Any]()
        for one in place.split(" + "):
            path, _, functions = one.partition("|")
            name, _, keys = path.partition(":")
            *way, last = keys.split(".")
            try:
                values = [_at(self._document(name), [*way, key]) for key in last.split(",")]
                if functions:
                    values = [FUNCTIONS[f](v) if v else None for v in values for f in functions.split(",")]
                found += values
            except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
                raise InputError(UNEXPECTED, where=f"{name}: {keys}", got=str(error)) from None
        return found

    def _document(self, name: str) -> Any:
        if name == "work":
            return self.made
        if name not in self._read:
            path = self.file(name)
            is_journal = path.suffix == ".jsonl"
            self._read[name] = list(Journal(path).read()) if is_journal else read_object(path, what="report")
        return self._read[name]


def _at(value: Any, way: list[str]) -> Any:
    """Follow keys; of a list a number, or an element's id or key, or * for all that have the rest."""
    for k, key in enumerate(way):
        if key == "*":
            found = [_at(one, way[k + 1 :]) for one in (value.values() if isinstance(value, dict) else value)]
            return [one for one in found if one is not None]
        if isinstance(value, list):
            by_id = {str(one.get("id", one.get("key"))): one for one in value if isinstance(one, dict)}
            index = int(key) if key.lstrip("-").isdecimal() else None
            value = by_id.get(key) if index is None else value[index] if -len(value) <= index < len(value) else None
        else:
            value = value.get(key) if isinstance(value, dict) else None
    return value


def part(label: str, printed: Printed, places: Places) -> Part:
    """Make a table of the paper: our figures, with the paper's next to or below them."""
    files, ours = {printed.picture} if printed.picture else set(), dict[str, list[Any]]()
    for name, row in printed.here.items():
        place = row if ":" in row else printed.place.format(row)
        files |= {one.partition(":")[0] for one in place.split(" + ")} - {"work"}
        found = places.figures(place)
        if name == "*" and not isinstance(found[0] or {}, dict):
            raise InputError(UNEXPECTED, where=place, got=str(found[0])[:80], expected="names with figures")
        ours |= {key: _values(row) for key, row in (found[0] or {}).items()} if name == "*" else {name: found}
    names, rows, theirs = printed.head.split("|"), Rows(), {name: _values(row) for name, row in printed.paper.items()}
    is_next, width = names[1] == "here", len(names) - 1  # ours is one column; else the paper's rows follow ours
    for name in dict.fromkeys([*ours, *theirs]):
        here, paper = ([*map(_cell, found.get(name, [])), *[None] * width][:width] for found in (ours, theirs))
        if is_next:
            rows.append([name, here[0], *paper[: width - 1]])
            continue
        rows += [[name, *(["here"] if theirs else []), *here]] if name in ours else []
        rows += [["" if name in ours else name, "paper", *paper]] if name in theirs else []
    if theirs and not is_next:
        names.insert(1, "")
    why = f"Differs: {printed.why}. " if theirs else f"{printed.why[:1].upper()}{printed.why[1:]}. "
    return Part(
        key=label, title=printed.title, head=names, rows=rows,
        paper=", ".join(name for name in (label, printed.also) if ":" in name),
        note=why * bool(printed.why) + (f"From {', '.join(sorted(files))}." if files else ""),
        source="recorded" if all((places.roots[0] / file).is_file() for file in files) else "measured again",
        picture=_jpeg(places.file(printed.picture)) if printed.picture else None,
    )  # fmt: skip


def _values(row: Any) -> list[Any]:
    return list(row.values()) if isinstance(row, dict) else row if isinstance(row, list) else [row]


def _cell(value: Any) -> Cell:
    """Return the content of a cell: numbers and words as they are, counts by name and lists as words."""
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
    picture = cv2.cvtColor(read_picture(path), cv2.COLOR_BGR2RGB)
    return small_jpeg(picture, min(WIDTH_PX, picture.shape[1]))


def settings(cfg: RunConfig, printed: Paper) -> Part:
    """Compare the settings of the run with the paper's."""
    data, rows = cfg.all_values(), Rows()
    for label, wanted in printed.settings.items():
        for name, theirs in wanted.items():
            own = _at(data, name.split("."))
            rows.append([name, str(_cell(own)), str(_cell(theirs)), "" if own == theirs else "other", label])
    note = "The paper's planner, trunks and SimWorld runs are settings here, not defaults."
    head, labels = ["setting", "here", "paper", "", "label"], ", ".join(printed.settings)
    return Part(key="settings", title="Settings", head=head, rows=rows, paper=labels, note=note)


# --- what is measured again -------------------------------------------------------------------------------------------


def measure(
    cfg: RunConfig, run: Path, out: Path, num_pedestrians: int, done: Sequence[str], how: dict[str, Any]
) -> dict[str, Any]:
    """Measure what the run has not recorded, in folders below `out`; return the facts that are in no file.

    Planners track the paper's reference trajectory, whatever styles the run has, after pedestrians that are drawn on
    its map with its settings; its own pedestrians are the first of them.
    """
    boxes, simplified = run / "maps/boxes_3d.json", run / "simplify/step2_simplified.json"
    traces, tree = run / "plan/drone_trace.json", run / "render"
    alone = {"num_paths": num_pedestrians, "others": 0, "traffic": 0, "look_alikes": 0}
    walking = cfg.pedestrians.model_copy(update=alone)
    paths = cosfly.pedestrians.stage.run(walking, simplified, out / "pedestrians", roi=cfg.roi, **how)
    plan = cfg.plan.model_copy(update={"styles": {FOLLOW: 1.0}})
    compared = build(compare.CompareConfig, plan.model_dump() | {"planners": PLANNERS}, "planners")
    compare.run(compared, simplified, paths, out / "compare", **how)
    beam.run(build(beam.BeamConfig, plan.model_dump(), "beams"), simplified, paths, out / "beam", **how)
    if "release" in done:
        release_stats(run / "release/dataset", out / "release", pixels=0)
    if "render" not in done:
        return {}
    log.info("reproduce: pictures")
    frame = four_panels(tree, out / "sample.png", box_map=read_boxes(boxes))
    depth.run(tree / frame, out / "depth")
    weather.run(cfg.render, boxes, traces, out / "weather", seed=cfg.seed)
    lenses = cfg.render.model_copy(update={"fovs_deg": ZOOM_DEG})
    zoom.run(lenses, boxes, simplified, traces, out / "zoom", every=ZOOM_EVERY, **how)
    return {"sample": frame}


def work(cfg: RunConfig, run: Path, places: Places, done: Sequence[str]) -> dict[str, Any]:
    """Return `work`: the figures that come from several files, or from none."""
    manifests = {name: read_manifest(run / name) for name in benchmark.STAGES if name in done}
    lens = RenderConfig(width_px=1280, height_px=720)
    lenses = {str(fov): zoom.camera_of(lens, fov) for fov in LENSES_DEG}
    points = places.figures("plan/drone_trace.json:traces.*.metrics.num_points")[0]
    found: dict[str, Any] = {
        "budget": {name: [m.seconds, m.counts.input, m.seconds / m.counts.input] for name, m in manifests.items()},
        "watchdog": {name: [*benchmark.watched(run / name)] for name in manifests},
        "lenses": {fov: [one.focal_px, one.focal_35mm_mm] for fov, one in lenses.items()},
        "samples": [len(windows_of(count, cfg.distill.dual_track)) for count in points],
    }
    if "render" in manifests:
        events = read_events(run / "render")
        workers = max((event.workers or 1 for event in events if event.event == "began"), default=1)
        row = benchmark.row_of(events, manifests["render"], workers, counts_frames=True)
        found["rendering"] = {
            f"{row.workers} workers": [
                row.seconds, row.attempted, row.successful, row.per_s, 1.0 if row.per_s else None, row.cores_used,
                row.peak_memory_mib, row.restarts, row.failed, row.gpu_percent, row.gpu_gib,
            ]
        }  # fmt: skip
    captions = read_captions(run / "caption/captions.jsonl") if {"caption", "render"} <= {*done} else iter(())
    if kept := [one for one in captions if one.en and one.zh and one.status == "accepted"]:
        *_, trajectory, _, _, name = places.made["sample"].split("/")
        near = min(kept, key=lambda c: (c.trajectory != trajectory, abs(c.frame_index - int(name.rpartition("_")[2]))))
        texts = {name: [getattr(near.en, name), getattr(near.zh, name)] for name in FIELDS}
        found["caption"] = {"sample id": [near.sample_id], **texts}
    return found
