"""What stands on the viewer's page, and what of much goes on it: flights, frames, pictures, paths, boxes. The page's
script reads these names.
"""

from __future__ import annotations

import base64
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.captions import Coc, Language
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES
from cosfly.geometry.axes import box_corners
from cosfly.llm.answer_text import sentences_of
from cosfly.runtime.config import Config
from cosfly.viz.frame_views import View, spread
from cosfly.viz.page_pictures import PagePictures
from release.columns import BOX, CAPTION, FIELDS, FRAME, LANGUAGES, POINT, TARGET_PICTURE, Column

Point2 = tuple[float, float]  # x, y, m
MB = 1024 * 1024


class ViewerConfig(Config):
    """How much of a release or run a page holds."""

    flights: int = Field(
        100, ge=1, description="most flights on a page; of more, trajectories spread evenly, both tracks of each"
    )
    frames: int = Field(16, ge=1, description="most frames of a flight, among them one of each verdict and decision")
    picture_px: int = Field(
        320, ge=32, le=1280, description="width of a colour picture, px; depth and mask have half of it"
    )
    max_mb: int = Field(
        64, ge=1, description="size of the page, MB; what would make it larger loses its pictures, which the page says"
    )


class PageSentence(BaseModel):
    """A sentence of a caption and what the geometry says of it; None: nobody judged it."""

    field: str
    text: str
    state: str | None


class PageCaption(BaseModel):
    """A caption. facts: what the columns say of it; repair: how a rejected answer was mended; problems: what was found
    wrong; dropped: why it is not accepted."""

    decision: str | None
    label: str | None
    verdict: str | None
    repair: str | None
    facts: dict[str, str]
    texts: dict[Language, list[PageSentence]]
    problems: list[str] = []
    dropped: str | None = None


class PageFrame(BaseModel):
    """A frame. drone: x, y, z, m, and yaw, degrees; target: x, y, z, m; events: what became of its perturbation; facts:
    what else the columns say; box: of the person, xmin, ymin, xmax, ymax as shares of the picture; pictures: JPEG in
    base64; target_picture: PNG, at the goal's frame."""

    index: int
    time_s: float
    drone: tuple[float, float, float, float]
    target: tuple[float, float, float] | None
    visibility: float | None
    is_perturbed: bool
    events: dict[str, str | None] | None
    facts: dict[str, str]
    fov_deg: float
    box: tuple[float, float, float, float] | None = None
    pictures: dict[View, str] = {}
    target_picture: str | None = None
    caption: PageCaption | None = None


class PageFlight(BaseModel):
    """A flight. fovs_deg: the least and the greatest of its frames. group: what both tracks of a trajectory share; map:
    key of its map; result: of the inspection; paths from above."""

    name: str
    group: str
    map: str
    town: str
    track: str
    split: str | None
    result: str | None
    fovs_deg: tuple[float, float]
    num_frames: int
    num_captions: int
    drone_path: list[Point2]
    target_path: list[Point2]
    frames: list[PageFrame]


class PageBox(BaseModel):
    """A box of the map from above: its kind and the corners of its footprint."""

    kind: str
    corners: list[Point2]


class ViewerPage(BaseModel):
    """The whole page. notes: what it leaves out, and where it comes from."""

    title: str
    kind: Literal["release", "run"]
    notes: list[str]
    maps: dict[str, list[PageBox]]
    flights: list[PageFlight]


# --- rows -------------------------------------------------------------------------------------------------------------

TEXTS = {"C": "critical_components", "R": "reasoning_trace"}  # by the letter of a sentence's name


def frame_of(row: Mapping[str, Any], pictures: dict[View, str], caption: PageCaption | None) -> PageFrame:
    """Return a frame of its row."""
    pose, target, seen = row["pose"], row["target"], row["visibility"]
    x, y, z, yaw = (round(float(pose[name]), 2) for name in (*POINT, "yaw_deg"))
    return PageFrame(
        index=row["frame_index"],
        time_s=round(row["time_s"], 3),
        drone=(x, y, z, yaw),
        target=None if target is None else (round(target["x_m"], 2), round(target["y_m"], 2), round(target["z_m"], 2)),
        visibility=None if seen is None else round(seen, 3),
        is_perturbed=bool(row["is_perturbed"]),
        events=row["perturbation"] or None,
        facts=_facts(FRAME, row),
        fov_deg=round(row["fov_deg"], 1),
        box=box_of(row["target_bbox"], row["width_px"], row["height_px"]),
        pictures=pictures,
        target_picture=base64.b64encode(cell["bytes"]).decode() if (cell := row[TARGET_PICTURE]) else None,
        caption=caption,
    )


def caption_of(row: Mapping[str, Any]) -> PageCaption:
    """Return a caption of its columns."""
    texts = {}
    for language in LANGUAGES:
        coc = Coc(**{name: row[f"caption_{language}_{name}"] or "" for name in FIELDS})
        texts[language] = page_sentences(coc, row[f"sentence_states_{language}"])
    return PageCaption(
        decision=row["decision"],
        label=row["label"],
        verdict=row["verdict"],
        repair=row["repair_strategy"],
        facts=_facts(CAPTION, row),
        texts=texts,
    )


def _facts(columns: Sequence[Column], row: Mapping[str, Any]) -> dict[str, str]:
    values = {column.title: row[column.name] for column in columns if column.shown}
    return {
        title: ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        for title, value in values.items()
        if value is not None
    }


def page_sentences(coc: Coc, states: Sequence[str] | None) -> list[PageSentence]:
    """Return the sentences of an answer, each with its state; None where the states are those of another number of
    sentences.
    """
    named = list(sentences_of(coc))
    known: Sequence[str | None] = states if states is not None and len(states) == len(named) else [None] * len(named)
    return [
        PageSentence(field=TEXTS[name[0]], text=text, state=state)
        for (name, text), state in zip(named, known, strict=True)
    ]


def box_of(box: Mapping[str, Any] | None, width_px: int, height_px: int) -> tuple[float, float, float, float] | None:
    """Return a box, px, as shares of the picture; None where it is not known."""
    corners = np.array([(box or {}).get(name) for name in BOX], np.float64) / np.maximum(1, (width_px, height_px) * 2)
    xmin, ymin, xmax, ymax = corners.round(4).tolist()
    return (xmin, ymin, xmax, ymax) if np.isfinite(corners).all() else None


# --- pictures ---------------------------------------------------------------------------------------------------------

FRAME_BYTES, FLIGHT_BYTES = 7_000, 14_000  # a frame without pictures, and a track with its paths


def page_pictures(cfg: ViewerConfig, num_flights: int, num_frames: int) -> PagePictures:
    """Return the encoder of a page's pictures."""
    room = cfg.max_mb * MB - FRAME_BYTES * num_frames - FLIGHT_BYTES * num_flights
    return PagePictures(room, num_frames, cfg.picture_px)


# --- choice ---------------------------------------------------------------------------------------------------------

PATH_POINTS = 240
MOST_BOXES, MARGIN_M = 2_500, 30.0  # of one map
Track = TypeVar("Track")


def choose_flights(flights: Sequence[Track], groups: Sequence[Hashable], most: int) -> list[Track]:
    """Choose whole groups (the tracks of a trajectory), spread evenly, as many as give no more than `most` flights, and
    one at least.
    """
    by_group: dict[Hashable, list[Track]] = defaultdict(list)
    for flight, group in zip(flights, groups, strict=True):
        by_group[group].append(flight)
    named = list(by_group.values())
    for count in range(len(named), 0, -1):
        chosen = [flight for k in spread(len(named), count) for flight in named[k]]
        if len(chosen) <= most or count == 1:
            return chosen
    return []


def choose_frames(frames: Sequence[int], kinds: Mapping[int, Hashable], most: int) -> list[int]:
    """Choose frames of a flight, in order.

    Args:
        frames: all, ascending. kinds: of those with a caption what it says, such as (verdict, decision).
    Returns:
        first one of each kind, until half of them; then evenly of those with captions, then of the others.
    """
    firsts: dict[Hashable, int] = {}
    for frame in frames:
        if frame in kinds:
            firsts.setdefault(kinds[frame], frame)
    chosen = set(list(firsts.values())[: max(1, most // 2)])
    for wanted in (kinds, set(frames) - set(kinds)):
        others = [frame for frame in frames if frame not in chosen and frame in wanted]
        chosen |= {others[k] for k in spread(len(others), most - len(chosen))}
    return sorted(chosen)


def path_of(points_m: np.ndarray) -> list[Point2]:
    """Return a path from above, (n, 2 or 3) m, by at most PATH_POINTS of its points; those that are not known are left
    out.
    """
    known = points_m[~np.isnan(points_m).any(axis=1)]
    return [(round(float(known[k, 0]), 1), round(float(known[k, 1]), 1)) for k in spread(len(known), PATH_POINTS)]


def boxes_of(box_map: BoxMap, near: Sequence[Point2]) -> list[PageBox]:
    """Return the footprints of the boxes of a map round some places, the largest ones, those that lie below others
    first.
    """
    places = np.array(near, dtype=np.float64).reshape(-1, 2)
    if not len(places):
        return []
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    is_near = ((box_map.maxs[:, :2] >= low) & (box_map.mins[:, :2] <= high)).all(axis=1)
    rows = np.flatnonzero(is_near)
    areas = box_map.half_extents[rows, 0] * box_map.half_extents[rows, 1]
    rows = rows[np.argsort(-areas, kind="stable")[:MOST_BOXES]]
    is_ground = np.isin(box_map.kinds[rows], list(GROUND_KINDS))
    tops = box_map.centers[rows, 2] + box_map.half_extents[rows, 2]
    return [_box(box_map, row) for row in rows[np.lexsort((tops, ~is_ground))]]


def _box(box_map: BoxMap, row: int) -> PageBox:
    corners = box_corners(box_map.centers[row], box_map.half_extents[row], np.radians(box_map.rotations_deg[row, 1]))
    footprint = corners[[0, 2, 6, 4], :2].round(1).tolist()  # box_corners varies z fastest, then y, then x
    return PageBox(kind=KIND_NAMES[int(box_map.kinds[row])], corners=[(x, y) for x, y in footprint])
