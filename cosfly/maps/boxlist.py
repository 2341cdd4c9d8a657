"""What the map sources share: settings, the list of boxes that they fill, the origin of a map."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap, LicenceId, MapHeader, make_box_map
from cosfly.formats.kinds import KINDS
from cosfly.runtime.errors import MOST_NAMED, ConfigError, InputError, counts_text
from cosfly.runtime.io import over_limit

log = logging.getLogger(__name__)

# Settings of several sources.
MapName = Annotated[
    str, Field(min_length=1, description="name of the map, with which folder names in the playback tree begin")
]
MapLicence = Annotated[
    LicenceId, Field(description="licence, as spelled on the Hugging Face Hub (cc-by-4.0); copied to every release")
]
GroundHeight = Annotated[
    float | None, Field(description="height of the ground, m; null: the median height of road surfaces")
]
Pair = Sequence[float] | np.ndarray  # x and y
WIDEST_M = 20_000.0  # of a map
MOST_UNUSED = 600  # characters of a message
# Tops of the surfaces, m. At least two centimetres apart: a depth buffer separates them at 300 m.
PAVED_TOP_M, LAWN_TOP_M, ROAD_TOP_M = 0.0, -0.02, -0.06
PAINT_TOP_M, BASE_TOP_M = -0.03, -0.12  # over and below ROAD_TOP_M
TOPS_M = {"Sidewalks": PAVED_TOP_M, "Terrain": LAWN_TOP_M, "Roads": ROAD_TOP_M}
SLAB_M = 0.3
MOST_CUTS, MOST_CUTS_PER_CORNER = 30_000, 20  # of the polygons of a map; a city model needs 1 for each corner


@dataclass
class BoxList:
    """A growing list of upright boxes in world metres, with ids from 1 in the order of adding."""

    rows: list[tuple[float, ...]] = field(default_factory=list)  # center 3, half extent 3, yaw_deg
    kinds: list[int] = field(default_factory=list)
    num_cuts: float = 0.0  # see `reserve`
    most_cuts: float = MOST_CUTS
    # Positions refer to an origin, (2,) m, and the yaw of an x axis, degrees; None: those of the world.
    frame: tuple[Pair, float] | None = None

    def framed(self, origin: Pair, yaw_deg: float) -> BoxList:
        """Return the same list with positions relative to a place and a direction."""
        return BoxList(self.rows, self.kinds, frame=(origin, yaw_deg))

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, kind: str, center_xy: Pair, size_xy: Pair, low_m: float, high_m: float, yaw_deg: float = 0.0) -> None:
        """Add a box by its footprint (full sizes before turning, m) and its height interval."""
        if size_xy[0] <= 0 or size_xy[1] <= 0 or high_m <= low_m:
            footprint = f"footprint {size_xy[0]:g} x {size_xy[1]:g}"
            raise ValueError(f"the box has no volume: {kind}, {footprint} m, height {low_m:g} to {high_m:g} m")
        if self.frame is not None:
            origin, turn_deg = self.frame
            cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
            x, y = center_xy
            center_xy = np.add(origin, (cos * x - sin * y, sin * x + cos * y))
            yaw_deg += turn_deg
        center = (float(center_xy[0]), float(center_xy[1]), (low_m + high_m) / 2)
        self.rows.append((*center, size_xy[0] / 2, size_xy[1] / 2, (high_m - low_m) / 2, float(yaw_deg)))
        self.kinds.append(KINDS[kind])

    def reserve(self, num_cuts: float, num_corners: int) -> None:
        """Count the work for a polygon before it is done; raise InputError if it is out of proportion to the file."""
        self.num_cuts += num_cuts
        self.most_cuts += MOST_CUTS_PER_CORNER * num_corners
        if self.num_cuts > self.most_cuts:
            got = f"outlines that need {self.num_cuts:,.0f} cuts"
            fix = "cut out a part of the map, or simplify it"
            raise over_limit("map", got, f"{self.most_cuts:,.0f} cuts for this number of corners", fix)

    def span(self, kind: str, a: Pair, b: Pair, low_m: float, high_m: float) -> None:
        """Add an unturned box by two opposite corners of its footprint, in any order."""
        center = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2
        self.add(kind, center, (abs(b[0] - a[0]), abs(b[1] - a[1])), low_m, high_m)

    def lay(self, kind: str, a: Pair, b: Pair) -> None:
        """Add ground at the height of its kind between two opposite corners."""
        self.span(kind, a, b, TOPS_M[kind] - SLAB_M, TOPS_M[kind])

    def box_map(self, header: MapHeader | None = None) -> BoxMap:
        """Return the map of everything added so far."""
        rows = np.array(self.rows, dtype=np.float64).reshape(-1, 7)
        rotations_deg = np.zeros((len(rows), 3))
        rotations_deg[:, 1] = rows[:, 6]
        return make_box_map(rows[:, :3], rows[:, 3:6], rotations_deg, self.kinds, header=header)


class SkippedEntries:
    """The entries of a file that a reader does not use: bad ones with a problem, and others."""

    def __init__(self) -> None:
        self.counts = Counter[str]()  # by reason
        self.num_bad = 0
        self._places = defaultdict[str, list[str]](list)  # by problem, so that each problem is listed once
        self._unused = Counter[str]()  # why entries that are not bad are not used

    def add(self, reason: str, where: str = "", problem: str = "", *, is_bad: bool = True) -> None:
        """Count an entry; one with a problem is listed, and counts as bad unless `is_bad` is false."""
        self.counts[reason] += 1
        if not is_bad:
            self._unused[problem] += 1
        elif problem:
            self._places[problem].append(where)
            self.num_bad += 1

    def check(self, path: Path, num_entries: int, most_share: float, expected: str) -> None:
        """Raise InputError if more than a share of the entries is bad; log the problems."""
        problems = [listed(places, problem) for problem, places in self._places.items()]
        unused = [f"not used: {counts_text(self._unused)}"[:MOST_UNUSED]] if self._unused else []
        if self.num_bad > most_share * num_entries:
            raise InputError.of_all(problems + unused, where=path, expected=expected)
        for problem in problems[:MOST_NAMED]:
            log.warning("%s: skipped: %s", path.name, problem)
        if len(problems) > MOST_NAMED:
            log.warning("%s: skipped for %d other reasons", path.name, len(problems) - MOST_NAMED)
        for text in unused:
            log.info("%s: %s", path.name, text)


def listed(places: list[str], problem: str) -> str:
    """Return a problem with its first place, and the number of the others."""
    return f"{places[0]}: {problem}" + (f" (and {len(places) - 1} more)" if len(places) > 1 else "")


def origin_m(low: np.ndarray, high: np.ndarray, where: str | Path, ground_z_m: float = 0.0) -> np.ndarray:
    """Return the place that becomes a map's origin, (3,) m: the middle of its bounds, at the height of its ground."""
    if not (high - low <= WIDEST_M).all():
        got = " x ".join(f"{size:.6g}" for size in high - low) + " m"
        fix = "cut out a part of the map, or remove vertices that lie far outside"
        raise InputError("the map is too wide or too high", where=where, got=got, expected="at most 20,000 m", fix=fix)
    return np.array([*np.round((low + high)[:2] / 2), round(float(ground_z_m), 3)])


def check_not_empty(box_map: BoxMap, where: str, fix: str = "") -> None:
    """Raise InputError if a map has no boxes."""
    if not len(box_map):
        got = f"{box_map.header.num_objects} objects, dropped: {counts_text(box_map.header.dropped_objects)}"
        expected = "at least one object with a size"
        raise InputError("the map has no boxes", where=where, got=got, expected=expected, fix=fix or None)


def with_server_ground(box_map: BoxMap, ground_z_m: float | None, is_road: np.ndarray, where: str, fix: str) -> BoxMap:
    """Check and report the map of a server, and return it with the height of its ground.

    Args:
        ground_z_m: m; None: the median height of its roads.
        is_road: (n,) boxes that are roads of a known size.
        fix: What to do about a map without boxes.
    """
    check_not_empty(box_map, where, fix)
    if dropped := box_map.header.dropped_objects:
        log.warning("%s: dropped objects: %s", where, counts_text(dropped))
    tops_m = box_map.maxs[is_road, 2]
    if ground_z_m is None:
        ground_z_m = float(np.median(tops_m)) if len(tops_m) else 0.0
    return replace(box_map, header=box_map.header.model_copy(update={"ground_z_m": ground_z_m}))


def required(path: Path | None, setting: str) -> Path:
    """Return the path of a setting; raise ConfigError if it is not set."""
    if path is None:
        what = "the setting is required, but has no value"
        fix = f"pass --set {setting}=FILE"
        raise ConfigError(what, where=setting, expected="the path of a file", fix=fix)
    return path
