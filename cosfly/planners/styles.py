"""The table of manoeuvre styles: where the drone is relative to the target during a segment, and for which decisions.

A row is data: `reference_trajectory.py` makes a reference from it and `plan.style_ranges` can replace its ranges; a new
row needs no code. Labels come from the planned motion, not from the style. Two styles are more than a row: `reacquire`
needs a place where the target disappears, `return_home` ends with a mission.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from cosfly.formats.segments import FOLLOW

REACQUIRE, RETURN_HOME = "reacquire", "return_home"
ALTITUDE_LEAST_M = 8.0  # bound of every style but `follow`, unless its range begins lower
OTHER_SIDE = "~"  # before the name of a style: the mirror image

Range = tuple[float, float]  # a value is drawn uniformly from it for each segment


@dataclass(frozen=True)
class Style:
    """One row of the table. Distances are in the plane, altitudes above the ground under the target.

    Values with `end` are reached at the end of the segment; None: as at its start.
    """

    purpose: tuple[str, ...]  # labels of the decisions that the style is for
    ground_distance_m: Range
    altitude_m: Range
    # From the target to the drone, counter-clockwise from the heading: 0 in front, 180 behind; None: as before.
    bearing_deg: Range | None = None
    either_side: bool = False  # half of the segments are mirrored
    ground_distance_end_m: Range | None = None
    altitude_end_m: Range | None = None
    climb_m: Range = (0.0, 0.0)  # during a search
    round_mps: Range = (0.0, 0.0)  # speed around the target, positive counter-clockwise
    hop_s: Range | None = None  # time that the drone hovers between its moves to new positions
    pace_mps: Range = (4.0, 4.0)  # rate of change of the distance between segments
    suits: str = ""  # pedestrian: uneven (stops and hurries), straight (goes straight on); empty: any

    @property
    def altitude_range_m(self) -> Range:
        """Return the least and greatest altitude at start and end."""
        ends = (*self.altitude_m, *(self.altitude_end_m or ()))
        return min(ends), max(ends)


# Slant distances are 10 to 60 m. Below some 8 m in the plane, a low drone could not keep up around a bend.
TABLE: dict[str, Style] = {
    "orbit_left": Style(("circle_left",), (8.0, 17.0), (8.0, 22.0), round_mps=(-6.0, -4.0)),
    "orbit_right": Style(("circle_right",), (8.0, 17.0), (8.0, 22.0), round_mps=(4.0, 6.0)),
    "side": Style(
        ("strafe_left", "strafe_right"), (8.0, 10.5), (8.0, 10.0), (75.0, 105.0), either_side=True, suits="straight"
    ),
    "lead": Style(("move_backward",), (26.0, 44.0), (14.0, 32.0), (-25.0, 25.0)),
    "approach": Style(
        ("move_forward",), (40.0, 52.0), (15.0, 28.0), (150.0, 210.0),
        ground_distance_end_m=(8.0, 12.0), altitude_end_m=(8.0, 12.0),
    ),
    "retreat": Style(
        ("move_backward",), (8.0, 12.0), (8.0, 12.0), (-50.0, 50.0),
        ground_distance_end_m=(40.0, 52.0), altitude_end_m=(15.0, 28.0),
    ),
    "rise": Style(("ascend",), (14.0, 22.0), (8.0, 14.0), (135.0, 225.0), altitude_end_m=(51.0, 55.0)),
    "sink": Style(("descend",), (14.0, 22.0), (51.0, 55.0), (135.0, 225.0), altitude_end_m=(8.0, 14.0)),
    "hold": Style(("hover",), (10.0, 18.0), (8.0, 25.0), (-18.0, 18.0), hop_s=(9.0, 15.0), pace_mps=(1.5, 3.0)),
    "trail": Style(("speed_up", "slow_down", "hover"), (16.0, 34.0), (12.0, 20.0), (178.0, 182.0), suits="uneven"),
    "top": Style(("track_straight",), (20.0, 26.0), (50.0, 54.0), (150.0, 210.0)),
}  # fmt: skip

# Ranges of `reacquire`: where the target is lost, and from where the drone searches.
HIDING = Style(
    ("search_to_reacquire_target",), (18.0, 42.0), (8.0, 16.0), ground_distance_end_m=(8.0, 16.0), climb_m=(12.0, 26.0)
)

NAMES = (FOLLOW, *TABLE, REACQUIRE, RETURN_HOME)
WHOLE = (REACQUIRE, RETURN_HOME)  # styles of whole trajectories; the others are of segments
ROWS: dict[str, Style] = TABLE | {REACQUIRE: HIDING}


def suits(name: str) -> str:
    """Return what kind of pedestrian a style suits."""
    row = ROWS.get(name.removeprefix(OTHER_SIDE))
    return "" if row is None else row.suits


def with_ranges(row: Style, ranges: Mapping[str, Range]) -> Style:
    """Return a row with some of its ranges replaced.

    Raises:
        ValueError: If the row has no such range, its ends are not in ascending order, or it is not positive.
    """
    names = [field.name for field in fields(Style) if field.name != "purpose"]
    range_names = [name for name in names if isinstance(getattr(row, name), tuple)]
    for name, (low, high) in ranges.items():
        if name not in range_names:
            raise ValueError(f"the style has no adjustable range {name!r}; choose from {', '.join(range_names)}")
        if low > high:
            raise ValueError(f"the range {name} must be [least, greatest] in this order, got [{low:g}, {high:g}]")
        if low <= 0 and name not in ("bearing_deg", "round_mps", "climb_m"):
            raise ValueError(f"the lower end of the range {name} must be above 0, got {low:g}")
    replaced: dict[str, Any] = dict(ranges)
    return replace(row, **replaced)
