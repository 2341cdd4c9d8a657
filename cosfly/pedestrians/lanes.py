"""The lanes of a map's straight roads, and the curves from lane to lane at its junctions.

A box of Roads that is longer than wide is a street; streets that cross, or that reach each other over road, meet in a
junction. Maps whose roads are patches have no lanes and no cars.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS

LONG = 1.5  # least ratio of length to width of a street's box; others are crossings and patches
REACH = 2.0  # widths that a street extends beyond its box, over other boxes of road, to the next junction
NARROWEST_M = 5.0  # of a carriageway with two lanes
STEP_M = 1.0  # between points along lanes and curves
CLEAR_M = 1.1  # from the middle of a lane to obstacles: half a car, and a margin
CAR_MIDDLE_M = 1.2  # height above the ground at which obstacles are looked for
LANE_SHARES = (0.25, 0.15, 0.08)  # of the width, from the middle line to the lane; smaller where cars are parked
SHORTEST_LANE_M = 8.0
BEFORE_CURVE_M = 1.5  # from the start of a curve to the crossing carriageway
BEFORE_DEAD_END_M = 3.0  # from the end of a lane to the end of its street
CROSSING_SINE_MIN = 0.2  # of the angle of streets that cross, 12 degrees; others can only be in one line
SAME_PLACE_M = 3.0
DEAD_END = -1  # in place of a junction's number

IsFree = Callable[[np.ndarray], bool]  # whether a car can pass all of these positions, (n, 2) m


class Station(NamedTuple):
    along_m: float  # from the start of its street
    junction: int  # its number, or DEAD_END


@dataclass(frozen=True)
class Street:
    """A straight carriageway from start_m along a unit direction, both (2,); its box ends at 0 and length_m."""

    start_m: np.ndarray
    direction: np.ndarray
    length_m: float
    width_m: float
    reach_m: tuple[float, float]  # how far the road extends before 0 and after length_m

    def position_m(self, along_m: float) -> np.ndarray:
        return self.start_m + along_m * self.direction

    def has_road_at(self, along_m: float) -> bool:
        return -self.reach_m[0] <= along_m <= self.length_m + self.reach_m[1]


@dataclass
class Lane:
    """A lane between two stations of a street: points_m (k, 2); onward: next lanes, and curves to them, (j, 2)."""

    points_m: np.ndarray
    street: Street
    first: Station
    last: Station
    onward: list[tuple[int, np.ndarray]] = field(default_factory=list)

    def distance_m(self, place_m: np.ndarray) -> float:
        """Return the distance from a position, (2,), to the nearest point."""
        return float(np.linalg.norm(self.points_m - place_m, axis=1).min())


def lanes_of(box_map: BoxMap) -> list[Lane]:
    """Return the lanes of a map without obstacles; empty where it has no straight roads."""
    from cosfly.geometry.kernels import obstacle_index, signed_distances

    roads = box_map.select(box_map.kinds == KINDS["Roads"])
    streets = _streets(roads)
    obstacles = obstacle_index(box_map)

    def is_free(points_m: np.ndarray) -> bool:
        places = np.insert(points_m, 2, box_map.ground_z_m + CAR_MIDDLE_M, axis=1)
        is_clear = signed_distances(obstacles, places, CLEAR_M)[0] >= CLEAR_M
        return bool(_on_road(roads, points_m).all() and is_clear.all())

    widths_m, stations_of_streets = _junctions(streets)
    lanes: list[Lane] = []
    for street, stations in zip(streets, stations_of_streets, strict=True):
        for low, high in pairwise(stations):
            lanes += filter(None, (_lane(street, *ends, widths_m, is_free) for ends in ((low, high), (high, low))))
    for lane in lanes:
        for number, after in enumerate(lanes):
            is_back = after.street is lane.street and after.last == lane.first  # cars do not turn on the spot
            if after.first.junction == lane.last.junction != DEAD_END and not is_back:
                curve = _curve(lane.points_m, after.points_m)
                if is_free(curve):
                    lane.onward.append((number, curve))
    return lanes


def _streets(roads: BoxMap) -> list[Street]:
    streets = []
    for center, half, rotation in zip(
        roads.centers[:, :2], roads.half_extents[:, :2], roads.rotations_deg, strict=True
    ):
        yaw = np.radians(rotation[1]) + (np.pi / 2.0 if half[1] > half[0] else 0.0)
        direction = np.array([np.cos(yaw), np.sin(yaw)])
        long, short = half.max(), half.min()
        if long >= LONG * short and 2.0 * short >= NARROWEST_M:
            before_m, after_m = (
                _reach_m(roads, center + sign * long * direction, sign * direction, REACH * 2.0 * short)
                for sign in (-1.0, 1.0)
            )
            streets.append(Street(center - long * direction, direction, 2.0 * long, 2.0 * short, (before_m, after_m)))
    return streets


def _reach_m(roads: BoxMap, end_m: np.ndarray, direction: np.ndarray, most_m: float) -> float:
    """Return how far the road extends from the end of a street."""
    steps = np.arange(STEP_M, most_m, STEP_M)
    is_road = _on_road(roads, end_m + steps[:, None] * direction)
    return float(np.argmin(is_road) if not is_road.all() else len(steps)) * STEP_M


def _on_road(roads: BoxMap, points_m: np.ndarray) -> np.ndarray:
    """Return which points lie on a box of road, (n,) bool."""
    yaws = np.radians(roads.rotations_deg[:, 1])
    offset = points_m[:, None] - roads.centers[None, :, :2]
    x = offset[..., 0] * np.cos(yaws) + offset[..., 1] * np.sin(yaws)
    y = offset[..., 1] * np.cos(yaws) - offset[..., 0] * np.sin(yaws)
    half = roads.half_extents + 1e-6
    return ((np.abs(x) <= half[:, 0]) & (np.abs(y) <= half[:, 1])).any(axis=1)


def _junctions(streets: list[Street]) -> tuple[list[float], list[list[Station]]]:
    """Return the width of the widest street of each junction, m, and the stations of each street in order."""
    places_m: list[np.ndarray] = []
    widths_m: list[float] = []
    along_of_streets: list[dict[int, float]] = [{} for _ in streets]  # m by junction
    for (i, street), (j, other) in combinations(enumerate(streets), 2):
        meeting_m = _meeting(street, other)
        if meeting_m is not None:
            place_m = street.position_m(meeting_m[0])
            near = (k for k, known_m in enumerate(places_m) if np.linalg.norm(known_m - place_m) < SAME_PLACE_M)
            junction = next(near, len(places_m))
            if junction == len(places_m):
                places_m.append(place_m)
                widths_m.append(0.0)
            widths_m[junction] = max(widths_m[junction], street.width_m, other.width_m)
            along_of_streets[i].setdefault(junction, meeting_m[0])
            along_of_streets[j].setdefault(junction, meeting_m[1])
    ordered_stations = []
    for street, along_of in zip(streets, along_of_streets, strict=True):
        stations = sorted(Station(along_m, junction) for junction, along_m in along_of.items())
        if not stations or stations[0].along_m > street.width_m:
            stations.insert(0, Station(0.0, DEAD_END))
        if stations[-1].along_m < street.length_m - street.width_m:
            stations.append(Station(street.length_m, DEAD_END))
        ordered_stations.append(stations)
    return widths_m, ordered_stations


def _lane(street: Street, first: Station, last: Station, widths_m: list[float], is_free: IsFree) -> Lane | None:
    """Return the lane on the right between two stations, as far from the middle as it is free; None if blocked."""
    sign = np.sign(last.along_m - first.along_m)
    after_first_m, before_last_m = (
        BEFORE_DEAD_END_M if junction == DEAD_END else widths_m[junction] / 2.0 + BEFORE_CURVE_M
        for junction in (first.junction, last.junction)
    )
    start, end = first.along_m + sign * after_first_m, last.along_m - sign * before_last_m
    if sign * (end - start) < SHORTEST_LANE_M:
        return None
    direction = sign * street.direction
    right = np.array([direction[1], -direction[0]])
    steps = np.linspace(start, end, int(abs(end - start) / STEP_M) + 2)
    middle = street.start_m + steps[:, None] * street.direction
    lines = (middle + share * street.width_m * right for share in LANE_SHARES)
    return next((Lane(line, street, first, last) for line in lines if is_free(line)), None)


def _meeting(street: Street, other: Street) -> tuple[float, float] | None:
    """Return where two streets meet, m along each; None if they do not meet."""
    sine = _cross(street.direction, other.direction)
    offset_m = other.start_m - street.start_m
    if abs(sine) > CROSSING_SINE_MIN:
        meeting_m = _cross(offset_m, other.direction) / sine, _cross(offset_m, street.direction) / sine
    else:
        meeting_m = _in_line(street, other)
    return meeting_m if street.has_road_at(meeting_m[0]) and other.has_road_at(meeting_m[1]) else None


def _in_line(street: Street, other: Street) -> tuple[float, float]:
    """Return the middle of the gap between two streets in one line, m along each; else infinity."""
    ends_m = np.array([(other.position_m(m) - street.start_m) @ street.direction for m in (0.0, other.length_m)])
    aside_m = abs(_cross(street.direction, other.start_m - street.start_m))
    if aside_m > SAME_PLACE_M or (ends_m.min() < street.length_m and ends_m.max() > 0.0):
        return np.inf, np.inf
    is_after = ends_m.min() >= street.length_m
    middle_m = float(street.length_m + ends_m.min() if is_after else ends_m.max()) / 2.0
    return middle_m, float((street.position_m(middle_m) - other.start_m) @ other.direction)


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _curve(lane_m: np.ndarray, next_m: np.ndarray) -> np.ndarray:
    """Return a curve from the end of a lane to the start of another, tangent to both, (j, 2) m without its two ends.

    A cubic Bezier: its inner points lie on the lanes' lines, at 0.55 of the radius of the quarter circle of this chord.
    """
    start, end = lane_m[-1], next_m[0]
    leave, arrive = lane_m[-1] - lane_m[-2], next_m[1] - next_m[0]
    gap_m = float(np.linalg.norm(end - start))
    pull = 0.55 * gap_m / np.sqrt(2.0)
    a, b = start + pull * leave / np.linalg.norm(leave), end - pull * arrive / np.linalg.norm(arrive)
    t = np.linspace(0.0, 1.0, max(4, int(1.2 * gap_m / STEP_M)))[1:-1, None]  # an arc is up to 1.2 chords
    u = 1.0 - t
    return u**3 * start + 3 * u**2 * t * a + 3 * u * t**2 * b + t**3 * end
