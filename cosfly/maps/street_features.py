"""Features of OpenStreetMap and Overture to what a street is for pedestrians.

Such data draw streets as lines: without pavements, with footways that end in the middle of the carriageway, crossings
as nodes or lines, rivers that run through bridges, and squares over their fountains. Here streets get pavements and
crossings get stripes, footways end at the kerb, water is open below bridges and is not covered elsewhere. Woods and
rows of trees become trees, passages open buildings, and closed walls stay lines.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely import LineString, Point

from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.maps.footprints import Rectangle, polygons_of, rectangle_polygon
from cosfly.runtime.io import over_limit

PAVEMENT_CREDITS = "Pavements are derived by cosfly from the streets, not mapped."
PAVEMENT_M = 2.0  # width
WITHOUT_PAVEMENT = ("no", "none", "separate")  # values of `sidewalk`; separate: mapped as a way of its own
BRIDGE_EDGE_M = 0.5  # at each side: the default of pedestrians.safety_radius_m
BRIDGE_NEAR_M = 15.0  # water so near to a bridge is covered apart: a long rectangle would reach into the opening
NARROW_WATER = ("stream", "ditch", "drain")  # which a street crosses on a culvert, without a tag
CROSSING_M = 3.0  # width of a crossing
STRIPE_M = 0.5  # of paint, and as much between two stripes
NODE_M = 1.0  # from a node of a crossing to its street
SHORTEST_M = 1.0  # a shorter crossing has no stripes
LONGEST_CROSSING_M = 20.0  # a longer piece of a footway within a carriageway runs along it
TREE_STEP_M = 8.0  # between the trees of a row or a wood
MOST_TREES = 50_000
MOST_CROSSINGS, MOST_CROSSINGS_PER_STREET = 10_000, 50  # of the streets of a map


class Feature(NamedTuple):
    """A feature: its geometry in metres, and what its tags mean."""

    kind: str  # empty: no boxes
    shape: Any
    value: str = ""  # of the tag that gives the kind
    width_m: float = 0.0  # of a line
    tags: Mapping[str, Any] = {}

    @property
    def is_line(self) -> bool:
        return "Line" in self.shape.geom_type

    @property
    def is_tree_row(self) -> bool:
        return self.value == "tree_row" and self.is_line

    @property
    def is_wood(self) -> bool:
        return self.value in ("wood", "forest") and "Polygon" in self.shape.geom_type

    @property
    def is_bridge(self) -> bool:
        return str(self.tags.get("bridge") or "no") != "no"

    @property
    def is_unmarked(self) -> bool:
        """Whether it is a crossing without stripes."""
        return self.tags.get("crossing") in ("no", "unmarked")

    @property
    def is_crossing(self) -> bool:
        if self.is_unmarked:
            return False
        is_way = self.tags.get("footway") == "crossing" and self.is_line
        return is_way or (self.tags.get("highway") == "crossing" and isinstance(self.shape, Point))

    def area(self, edge_m: float = 0.0) -> Any:
        """Return its outline; that of a line is wider by an edge at each side."""
        if not self.is_line:
            return self.shape.buffer(edge_m, cap_style="flat")
        return self.shape.buffer(self.width_m / 2 + edge_m, cap_style="flat")


def is_underground(tags: Mapping[str, Any]) -> bool:
    """Return whether a feature is below the ground: in a tunnel, or marked so. A passage through a house is not."""
    is_in_tunnel = (tags.get("tunnel") or "no") not in ("no", "building_passage")
    is_below = str(tags.get("layer") or "").startswith("-") and tags.get("building") not in (None, "no")
    return is_in_tunnel or is_below or tags.get("location") == "underground"


def completed(features: Sequence[Feature], with_pavements: Sequence[str]) -> tuple[list[Feature], list[Feature]]:
    """Return the features as pedestrians and drones meet them, in their order, and surfaces to add.

    Args:
        with_pavements: Values of the tag of a street that has pavements unless its other tags deny them.
    Raises:
        InputError: The work is out of proportion to the file.
    """
    roads = [feature for feature in features if feature.kind == "Roads" and feature.is_line]
    tree = shapely.STRtree([road.shape for road in roads])
    _check_work(features, tree)
    passages = shapely.union_all([one.area() for one in features if one.tags.get("tunnel") == "building_passage"])
    changed = [_with_plain_shape(feature, passages) for feature in features]
    carriageways = shapely.union_all([road.area() for road in roads])
    shapely.prepare(carriageways)
    woods = [_trees_in(feature.area()) for feature in features if feature.is_wood]
    added = [Feature("Vegetation", trees, "tree") for trees in woods if not trees.is_empty]
    crossings: list[LineString] = []
    for index, feature in sorted(enumerate(changed), key=lambda pair: not pair[1].is_line):  # nodes after ways
        if feature.is_crossing:
            lines = list(_crossing_lines(feature, roads, tree, carriageways, crossings))
            if not lines:
                continue
            crossings += lines
            paint = Feature("RoadLines", shapely.MultiPolygon([stripe for line in lines for stripe in _stripes(line)]))
            rest = feature.shape.difference(carriageways)
            if rest.is_empty or not feature.is_line:
                changed[index] = paint
            else:
                changed[index] = feature._replace(shape=rest)
                added.append(paint)
        elif feature.kind == "Sidewalks" and feature.is_line and not (feature.is_bridge or feature.is_unmarked):
            changed[index] = _up_to_kerbs(feature, carriageways)
    added += _pavements(changed, roads, carriageways, with_pavements)
    return _uncovered(_open_below_bridges(changed, added)), added


def _check_work(features: Sequence[Feature], streets: shapely.STRtree) -> None:
    """Raise InputError if rows have too many trees, or streets cross each other too often."""
    fix = "cut out a part of the map"
    num_trees = sum(feature.shape.length for feature in features if feature.is_tree_row) / TREE_STEP_M
    num_trees += sum(feature.shape.area for feature in features if feature.is_wood) / TREE_STEP_M**2
    if num_trees > MOST_TREES:
        raise over_limit("map", f"{num_trees:,.0f} trees of rows and woods", f"{MOST_TREES:,} trees", fix)
    num_crossings, most = 0, MOST_CROSSINGS + MOST_CROSSINGS_PER_STREET * len(streets)
    for street in streets.geometries:
        num_crossings += len(streets.query(street, predicate="intersects"))
        if num_crossings > most:
            raise over_limit("map", f"streets with more than {most:,} crossings", f"{most:,} for their number", fix)


def _with_plain_shape(feature: Feature, passages: Any) -> Feature:
    """Return a feature with a row of trees as points, a closed barrier, which is exported as an area, as a line, and a
    building without its passages."""
    if feature.is_tree_row:
        lines = shapely.get_parts(feature.shape)
        trees = [
            line.interpolate(along_m) for line in lines for along_m in np.arange(0.0, line.length + 1e-6, TREE_STEP_M)
        ]
        return feature._replace(shape=shapely.MultiPoint(trees))
    if feature.kind in ("Walls", "Fences", "GuardRail") and "Polygon" in feature.shape.geom_type:
        return feature._replace(shape=feature.shape.boundary)
    if feature.kind == "Buildings" and feature.area().intersects(passages):
        return feature._replace(shape=feature.area().difference(passages))
    return feature


def _trees_in(wood: Any) -> Any:
    """Return the trees of a wood as points."""
    low_x, low_y, high_x, high_y = np.nan_to_num(wood.bounds) + TREE_STEP_M / 2  # NaN: of an outline without area
    x, y = np.meshgrid(np.arange(low_x, high_x, TREE_STEP_M), np.arange(low_y, high_y, TREE_STEP_M))
    trees = shapely.points(x.ravel(), y.ravel())
    return shapely.multipoints(trees[shapely.contains(wood, trees)])


# --- crossings --------------------------------------------------------------------------------------------------------


def _crossing_lines(
    feature: Feature, roads: Sequence[Feature], tree: shapely.STRtree, carriageways: Any, others: Sequence[LineString]
) -> Iterator[LineString]:
    """Yield the lines of a crossing from kerb to kerb: of a way what lies on carriageways, of a node a perpendicular.

    A node on another crossing has none.
    """
    if feature.is_line:
        for line in shapely.get_parts(feature.shape.intersection(carriageways)):
            if SHORTEST_M < line.length <= LONGEST_CROSSING_M and _chord_m(line) > SHORTEST_M:
                yield line
        return
    if np.any(shapely.distance(others, feature.shape) < CROSSING_M):
        return
    for index in tree.query(feature.shape, predicate="dwithin", distance=NODE_M):
        road = roads[index]
        along_m = road.shape.project(feature.shape)
        before, after = (road.shape.interpolate(max(0.0, along_m + step_m)) for step_m in (-1.0, 1.0))
        street_m = before.distance(after)
        if road.width_m <= LONGEST_CROSSING_M and street_m > SHORTEST_M:
            direction = np.array([after.x - before.x, after.y - before.y]) / street_m
            across = np.array([-direction[1], direction[0]]) * road.width_m / 2
            middle = np.array(feature.shape.coords[0])
            yield LineString([middle - across, middle + across])
            return


def _chord_m(line: LineString) -> float:
    """Return the distance between the ends of a line."""
    return float(np.hypot(*(np.array(line.coords[-1]) - line.coords[0])))


def _stripes(line: LineString) -> Iterator[Any]:
    """Yield the outlines of the stripes of a crossing along a line."""
    start, length_m = np.array(line.coords[0]), _chord_m(line)
    direction = (np.array(line.coords[-1]) - start) / length_m
    yaw_deg = float(np.degrees(np.arctan2(direction[1], direction[0])))
    for along_m in np.arange(STRIPE_M, length_m - STRIPE_M / 2, 2 * STRIPE_M):
        yield rectangle_polygon(Rectangle(tuple(start + along_m * direction), (STRIPE_M, CROSSING_M), yaw_deg))


# --- pavements --------------------------------------------------------------------------------------------------------


def _up_to_kerbs(feature: Feature, carriageways: Any) -> Feature:
    """Return a footway without its pieces in carriageways, but for those that run along them."""
    if not carriageways.intersects(feature.shape):
        return feature
    inside = shapely.get_parts(feature.shape.intersection(carriageways))
    outside = shapely.get_parts(feature.shape.difference(carriageways))
    rest = [line for line in inside if line.length > LONGEST_CROSSING_M] + outside.tolist()
    return feature._replace(shape=shapely.multilinestrings(rest)) if rest else feature


def _pavements(
    features: Sequence[Feature], roads: Sequence[Feature], carriageways: Any, with_pavements: Sequence[str]
) -> list[Feature]:
    """Return pavements along streets that have none, where no carriageway and no other pavement lies."""
    streets = defaultdict[tuple[float, float, str], list[Any]](list)  # by width, side (1: left), and value of `bridge`
    for road in roads:
        if road.value in with_pavements:
            for side in _pavement_sides(road.tags):
                key = road.width_m, side, str(road.tags.get("bridge") or "no")
                streets[key] += shapely.get_parts(road.shape).tolist()
    mapped = [feature.area() for feature in features if feature.kind == "Sidewalks"]
    # The boxes of a line are longer than it by half of their width.
    paved = shapely.union_all([carriageways, *mapped]).buffer(PAVEMENT_M / 4, join_style="mitre")
    pavements: list[Feature] = []
    for (street_m, side, bridge), lines in streets.items():
        merged = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines), directed=True))
        edges = shapely.offset_curve(merged, side * (street_m + PAVEMENT_M) / 2, join_style="mitre")
        # All at once, which is much faster than one by one; lines are cut where they cross, and merged again.
        free = shapely.line_merge(shapely.difference(shapely.multilinestrings(shapely.get_parts(edges)), paved))
        if not free.is_empty:
            pavements.append(Feature("Sidewalks", free, "", PAVEMENT_M, {"bridge": bridge}))
    return pavements


def _pavement_sides(tags: Mapping[str, Any]) -> list[float]:
    """Return the sides of a street that may have a pavement: 1 for the left one, -1 for the right one."""
    both = tags.get("sidewalk") or tags.get("sidewalk:both") or "both"
    sides = {"left": 1.0, "right": -1.0}
    if both in sides:
        return [sides[both]]
    default = "no" if both in WITHOUT_PAVEMENT else "yes"
    found = {name: tags.get(f"sidewalk:{name}") or default for name in sides}
    return [sides[name] for name in sides if found[name] not in WITHOUT_PAVEMENT]


# --- bridges ----------------------------------------------------------------------------------------------------------


def _open_below_bridges(features: Sequence[Feature], added: Sequence[Feature]) -> list[Feature]:
    """Return the features with water cut out below bridges, and streams below streets: nobody walks over water."""
    surfaces = [one for one in (*features, *added) if KINDS.get(one.kind) in GROUND_KINDS]
    bridges = shapely.union_all([one.area(BRIDGE_EDGE_M) for one in surfaces if one.is_bridge])
    streets = shapely.union_all([one.area(BRIDGE_EDGE_M) for one in surfaces if one.is_line])  # above culverts
    openings = {False: bridges, True: shapely.union(bridges, streets)}  # by whether water is narrow
    near = {key: opening.buffer(BRIDGE_NEAR_M, cap_style="flat") for key, opening in openings.items()}
    opened = list(features)
    for index, feature in enumerate(features):
        is_narrow = feature.value in NARROW_WATER
        if feature.kind == "Water" and (area := feature.area()).intersects(openings[is_narrow]):
            water = area.difference(openings[is_narrow])
            parts = [*polygons_of(water.intersection(near[is_narrow])), *polygons_of(water.difference(near[is_narrow]))]
            opened[index] = feature._replace(shape=shapely.MultiPolygon(parts))
    return opened


def _uncovered(features: Sequence[Feature]) -> list[Feature]:
    """Return the features with surfaces cut out where they cover water: a fountain in a square, a path into a pond."""
    water = shapely.union_all([feature.area() for feature in features if feature.kind == "Water"])
    shapely.prepare(water)
    uncovered = list(features)
    for index, feature in enumerate(features):
        if feature.kind in ("Roads", "Sidewalks", "Ground"):
            shape = feature.shape if feature.is_line else feature.area()  # valid
            if water.intersects(shape) and not (rest := shape.difference(water)).is_empty:
                uncovered[index] = feature._replace(shape=rest)
    return uncovered
