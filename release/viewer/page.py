"""`cosfly view`: one self-contained page of a release or run, for a browser without a network.

The page holds its data as JSON; its one script (`viewer.js`) writes every foreign text as text, never as markup, and
the page's policy lets no other script run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa

from cosfly.formats.frames import FrameFile, depth_values
from cosfly.runtime.arrays import parse_picture
from cosfly.runtime.console import progress_bar
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import read_text, write_bytes
from cosfly.runtime.tables import arrow_errors, row_groups
from cosfly.viz.frame_views import View, depth_colors, segmentation_colors
from cosfly.viz.page import page, scripts
from cosfly.viz.page_pictures import PagePictures
from release.card.numbers import bounded, check_columns, check_rows, row_lists
from release.columns import PICTURES as COLUMNS
from release.columns import PLACE, POINT, SHORT_NAMES
from release.record import ReleaseRecord, read_record
from release.viewer.content import (
    PageFlight,
    PageFrame,
    ViewerConfig,
    ViewerPage,
    caption_of,
    choose_flights,
    choose_frames,
    frame_of,
    page_pictures,
    path_of,
)
from release.viewer.of_run import show_run

Place = tuple[str, ...]  # PLACE
VIEW_OF: dict[FrameFile, View] = {"rgb": "rgb", "depth": "depth", "instance": "segmentation"}
SCAN = [
    *PLACE, "sample_id", "track", "split", "frame_index", "time_s", "width_px", "height_px", "fov_deg", "pose",
    "target", "visibility", "has_caption", "verdict", "decision",
]  # fmt: skip


class FlightScan:
    """What the first pass keeps of a flight that is shown: its places, the captions' kinds, and where its rows
    stand.
    """

    def __init__(self, row: Mapping[str, Any]) -> None:
        self.row = row
        self.fovs_deg = set[float]()
        self.places: dict[int, tuple[list[float], list[float]]] = {}
        self.kinds: dict[int, tuple] = {}
        self.groups: dict[int, tuple[Path, int]] = {}
        self.frames = list[PageFrame]()

    def add(self, row: Mapping[str, Any], shard: Path, group: int) -> None:
        """Take a row of the flight."""
        index, target = row["frame_index"], row["target"]
        numbers = [row["time_s"], row["fov_deg"], *row["pose"].values(), *(target or {}).values()]
        for value in (*numbers, row["visibility"] or 0.0):
            bounded(value)
        self.fovs_deg.add(round(row["fov_deg"], 1))
        drone = [row["pose"][axis] for axis in POINT[:2]]
        self.places[index] = (drone, [np.nan] * 2 if target is None else [target[axis] for axis in POINT[:2]])
        self.groups[index] = (shard, group)
        if row["has_caption"]:
            self.kinds[index] = (row["verdict"], row["decision"])


def show_release(dataset: Path, cfg: ViewerConfig) -> ViewerPage:
    """Reads a release folder, gives what the page shows of it."""
    record = read_record(dataset / "release.json")
    names = [flight.flight for flight in record.flights]
    chosen = set(choose_flights(names, [name.rpartition("/")[0] for name in names], cfg.flights))
    notes = [] if len(chosen) == len(names) else [f"{len(chosen):,} of {len(names):,} flights are shown"]
    notes.append("a release holds no map: the tracks are drawn without one")
    scanned = _scan(dataset, record, chosen)
    frames = {place: choose_frames(sorted(one.places), one.kinds, cfg.frames) for place, one in scanned.items()}
    pictures = page_pictures(cfg, len(scanned), sum(map(len, frames.values())))
    with progress_bar("viewer: frames", pictures.num_frames) as advance:
        for row in _rows(dataset, record, scanned, frames):
            scanned[place_of(row)].frames.append(_frame(row, record, pictures))
            advance(1)
    flights = [_flight(one) for one in scanned.values()]
    return ViewerPage(title=record.name, kind="release", notes=[*notes, *pictures.notes()], maps={}, flights=flights)


def place_of(row: Mapping[str, Any]) -> Place:
    return tuple(row[name] for name in PLACE)


def _scan(dataset: Path, record: ReleaseRecord, chosen: set[str]) -> dict[Place, FlightScan]:
    """Read the places of all rows, keep those of the chosen flights, in the rows' order."""
    scanned: dict[Place, FlightScan] = {}
    with progress_bar("viewer: rows", sum(shard.rows for shard in record.shards)) as advance:
        for shard in record.shards:
            path = dataset / shard.path
            check_rows(path, shard.rows)
            for group, rows in enumerate(row_lists(path, SCAN)):
                for row in rows:
                    if "/".join(place_of(row)) in chosen:
                        scanned.setdefault(place_of(row), FlightScan(row)).add(row, path, group)
                advance(len(rows))
    return scanned


def _rows(
    dataset: Path, record: ReleaseRecord, scanned: Mapping[Place, FlightScan], frames: Mapping[Place, list[int]]
) -> Iterator[dict[str, Any]]:
    """Read the chosen rows with their pictures; of the row groups those alone that hold one."""
    columns = [*SHORT_NAMES, *(COLUMNS[file].name for file in record.settings.modalities)]
    wanted: dict[Path, set[int]] = {}
    for place, indices in frames.items():
        for index in indices:
            path, group = scanned[place].groups[index]
            wanted.setdefault(path, set()).add(group)
    for shard in record.shards:
        path = dataset / shard.path
        for table in row_groups(path, columns, tree=dataset, wanted=wanted.get(path, ())):
            check_columns(table, columns, path)
            with arrow_errors(path):
                places = table.select([*PLACE, "frame_index"]).to_pylist()
                kept = [row["frame_index"] in frames.get(place_of(row), ()) for row in places]
                rows = table.filter(pa.array(kept)).to_pylist()
            yield from rows


def _frame(row: Mapping[str, Any], record: ReleaseRecord, pictures: PagePictures) -> PageFrame:
    views: Mapping[View, Callable[[], np.ndarray]] = {
        VIEW_OF[file]: partial(picture, row, file, record) for file in record.settings.modalities
    }
    return frame_of(row, pictures.of_frame(views), caption_of(row) if row["has_caption"] else None)


def picture(row: Mapping[str, Any], file: FrameFile, record: ReleaseRecord) -> np.ndarray:
    """Return a picture of a row as colours, (h, w, 3) uint8 RGB."""
    where, cell = f"{row['sample_id']}: {COLUMNS[file].name}", row[COLUMNS[file].name]
    if file == "depth":
        return depth_colors(depth_values(cell or b"", Path(where)))
    data = (cell or {}).get("bytes") or b""
    if file == "rgb":
        return cv2.cvtColor(parse_picture(data, where), cv2.COLOR_BGR2RGB)
    coded = parse_picture(data, where)  # B the high, G the low byte of the id, R the kind
    return segmentation_colors(coded[..., 2], coded[..., 1].astype(np.uint16) | coded[..., 0].astype(np.uint16) << 8)


def _flight(scanned: FlightScan) -> PageFlight:
    row, order = scanned.row, sorted(scanned.places)
    return PageFlight(
        name="/".join(place_of(row)),
        group="/".join(place_of(row)[:-1]),
        map=f"{row['run']}/{row['town']}",
        town=row["town"],
        track=row["track"],
        split=row["split"],
        result=None,
        fovs_deg=(min(scanned.fovs_deg), max(scanned.fovs_deg)),
        num_frames=len(order),
        num_captions=len(scanned.kinds),
        drone_path=path_of(np.array([scanned.places[index][0] for index in order])),
        target_path=path_of(np.array([scanned.places[index][1] for index in order])),
        frames=sorted(scanned.frames, key=lambda frame: frame.index),
    )


PICTURES = "pictures"


def run(folder: Path, out: Path, cfg: ViewerConfig, captions: Path | None = None) -> Path:
    """Reads a release (or the folder round it), a run folder or a playback tree; writes one page and gives its path.

    Args:
        captions: `captions.jsonl` of a playback tree; a run has its own.
    Raises:
        InputError: the folder is none of these, or something in it cannot be read.
    """
    dataset = next((place for place in (folder, folder / "dataset") if (place / "release.json").exists()), None)
    shown = show_run(folder, cfg, captions) if dataset is None else show_release(dataset, cfg)
    write_bytes(out, page_html(shown).encode())
    return out


def page_html(shown: ViewerPage) -> str:
    """Return the page's text."""
    style, script = (read_text(Path(__file__).with_name(name)) for name in ("viewer.css", "viewer.js"))
    script = scripts("tools.js", "canvas.js") + script
    data = _printable(shown.model_dump(mode="json", exclude_defaults=False))
    return page(
        "release/viewer/viewer.html", title=shown.title, style=style, script=script, notes=shown.notes, data=data
    )


def _printable(value: Any) -> Any:
    """Return a value whose texts are cut and free of control characters; pictures, which are ours, stay."""
    if isinstance(value, str):
        return for_terminal(value)
    if isinstance(value, list):
        return [_printable(one) for one in value]
    if isinstance(value, dict):
        return {_printable(key): one if key == PICTURES else _printable(one) for key, one in value.items()}
    return value
