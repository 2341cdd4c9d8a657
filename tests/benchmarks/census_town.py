"""A seeded town with the box census of a large simulator town: as many boxes of each kind, over the same ground.

It exists to measure with: a crown is a cloud of about 148 boxes and a house some touching parts, as simulators export
them, so that simplification and planning meet the numbers that the paper reports. It does not imitate the place.
Streets run on a grid of 6 x 5 blocks; four blocks are parks, two are squares, the others hold three by three houses
with alleys between.
"""

import itertools

import numpy as np

from cosfly.formats.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.maps.boxlist import BoxList
from cosfly.runtime.seeding import rng_for

# tab:box_categories: boxes of each kind before simplification, 65,614 together.
CENSUS = {
    "Vegetation": 62_581, "Poles": 880, "Buildings": 781, "Static": 667, "Other": 287, "Fences": 148,
    "TrafficSigns": 147, "TrafficLight": 62, "Walls": 34, "Terrain": 23, "RailTrack": 4,
}  # fmt: skip
SIZE_M = (619.0, 506.0)
NUM_BLOCKS = (6, 5)
STREET_M, SIDEWALK_M, EDGE_M = 22.0, 4.5, 10.0
ALLEY_M = 7.0  # wider than the gap by which buildings are merged
NUM_PARKS, NUM_SQUARES = 4, 2
NUM_TREES, TREES_PER_PARK = 420, 30
NUM_LAMPS, NUM_SIGNALS, NUM_BENCHES, NUM_KIOSKS = 240, 31, 180, 40
NUM_SIGN_POLES = CENSUS["Poles"] - 3 * NUM_LAMPS - NUM_SIGNALS
HOUSES_PER_SIDE = 3

Block = tuple[np.ndarray, np.ndarray]  # low and high corner, (2,) each
Place = tuple[float, float, int]  # x, y, and the axis along which the kerb runs


def census_town(name: str, seed: int) -> BoxMap:
    boxes = BoxList()
    columns, rows = _streets(0), _streets(1)
    blocks = [
        (np.array([a + STREET_M, c + STREET_M]), np.array([b, d]))
        for c, d in itertools.pairwise(rows)
        for a, b in itertools.pairwise(columns)
    ]
    order = rng_for(seed, "maps", "census plan").permutation(len(blocks))
    parks = [blocks[k] for k in order[:NUM_PARKS]]
    squares = [blocks[k] for k in order[NUM_PARKS : NUM_PARKS + NUM_SQUARES]]
    built = [blocks[k] for k in order[NUM_PARKS + NUM_SQUARES :]]
    _ground(boxes, rows)
    _houses(boxes, built, rng_for(seed, "maps", "census houses"))
    _walls(boxes, built)
    _park_fences(boxes, parks)
    kerbs = _kerb_places(columns, rows, rng_for(seed, "maps", "census kerbs"))
    kerbs = _street_furniture(boxes, kerbs, rng_for(seed, "maps", "census furniture"))
    _kiosks(boxes, squares, rng_for(seed, "maps", "census kiosks"))
    _trees(boxes, parks, kerbs, rng_for(seed, "maps", "census trees"))
    source = MapSource(tool="cosfly maps synthetic, preset town10", version="1", seed=seed)
    box_map = boxes.box_map(MapHeader(name=name, source=source, licence=OUR_LICENCE, ground_z_m=0.0))
    assert box_map.counts() == CENSUS, "the town misses its census"
    return box_map


def _streets(axis: int) -> np.ndarray:
    half, count = SIZE_M[axis] / 2 - EDGE_M, NUM_BLOCKS[axis]
    return np.linspace(-half, half - STREET_M, count + 1)


def _ground(boxes: BoxList, rows: np.ndarray) -> None:
    edges = np.linspace(-SIZE_M[0] / 2, SIZE_M[0] / 2, CENSUS["Terrain"] + 1)
    for low, high in itertools.pairwise(edges):
        boxes.span("Terrain", (low, -SIZE_M[1] / 2), (high, SIZE_M[1] / 2), -0.5, 0.0)
    middle = rows[len(rows) // 2] + STREET_M / 2
    for side, half in itertools.product((-0.75, 0.75), (-1, 1)):
        low_x, high_x = sorted((0.0, half * (SIZE_M[0] / 2 - EDGE_M)))
        boxes.span("RailTrack", (low_x, middle + side - 0.05), (high_x, middle + side + 0.05), -0.15, 0.02)


def _houses(boxes: BoxList, built: list[Block], rng: np.random.Generator) -> None:
    num_wings = CENSUS["Buildings"] - 3 * HOUSES_PER_SIDE**2 * len(built)
    houses = [(block, ix, iy) for block in built for ix in range(HOUSES_PER_SIDE) for iy in range(HOUSES_PER_SIDE)]
    with_wing = set(rng.permutation(len(houses))[:num_wings].tolist())
    for number, ((low, high), ix, iy) in enumerate(houses):
        size = (high - low - (HOUSES_PER_SIDE - 1) * ALLEY_M) / HOUSES_PER_SIDE
        corner = low + np.array([ix, iy]) * (size + ALLEY_M)
        height = rng.uniform(6.0, 16.0) if rng.random() < 0.8 else rng.uniform(16.0, 34.0)
        depth = size[1] * 0.7 if number in with_wing else size[1]
        body = np.array([size[0], depth])
        center = corner + body / 2
        boxes.add("Buildings", center, body, -0.5, height)
        boxes.add("Buildings", center + rng.uniform(-2, 2, 2), (4.5, 4.0), height, height + rng.uniform(2.0, 3.0))
        boxes.add("Buildings", center, body * 0.6, 0.1, height - 0.5)
        if number in with_wing:
            boxes.span("Buildings", (corner[0], corner[1] + depth), corner + size, -0.5, height * 0.9)


def _walls(boxes: BoxList, built: list[Block]) -> None:
    for number in range(CENSUS["Walls"]):
        low, high = built[number % len(built)]
        size = (high - low - (HOUSES_PER_SIDE - 1) * ALLEY_M) / HOUSES_PER_SIDE
        alley = low[0] + size[0] + (number // len(built)) * (size[0] + ALLEY_M)
        boxes.add("Walls", (alley + ALLEY_M / 4, low[1] + 1.0), (ALLEY_M / 2, 0.25), -0.2, 1.8)


def _park_fences(boxes: BoxList, parks: list[Block]) -> None:
    per_park = CENSUS["Fences"] // len(parks)
    for low, high in parks:
        center, half = (low + high) / 2, (high - low) / 2 - 0.5
        places = [(axis, side) for axis in (0, 1) for side in (-1, 1)]
        for number in range(per_park):
            axis, side = places[number % 4]
            along = -half[axis] + 4.0 + 7.4 * (number // 4)
            if number // 4 == 9:
                along = half[axis] - 2.0  # the odd panel stands in the last corner
            shift = (along, side * half[1]) if axis == 0 else (side * half[0], along)
            boxes.add("Fences", center + np.array(shift), (6.0, 0.1) if axis == 0 else (0.1, 6.0), -0.1, 1.2)


def _kiosks(boxes: BoxList, squares: list[Block], rng: np.random.Generator) -> None:
    """Kiosks with crates inside, in rows on the squares."""
    for number in range(NUM_KIOSKS):
        low, high = squares[number % len(squares)]
        row, column = divmod(number // len(squares), 5)
        center = low + (high - low) * np.array([0.14 + 0.18 * column, 0.16 + 0.22 * row]) + rng.uniform(-1, 1, 2)
        boxes.add("Static", center, (3.0, 2.6), 0.0, 2.7, yaw_deg=rng.uniform(-12, 12))
        boxes.add("Static", center, (1.2, 1.0), 0.1, 1.5)


def _kerb_places(columns: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> list[Place]:
    """Places every 6.5 m along all kerbs, a metre off the carriageway, crossings left out; in random order."""
    places: list[Place] = []
    for axis, (across, along) in enumerate(((rows, columns), (columns, rows))):
        sides = SIDEWALK_M - 1.0, STREET_M - SIDEWALK_M + 1.0
        for street, side, (a, b) in itertools.product(across, sides, itertools.pairwise(along)):
            for at in np.arange(a + STREET_M + 3.0, b - 2.0, 6.5):
                places.append((at, street + side, axis) if axis == 0 else (street + side, at, axis))
    return [places[k] for k in rng.permutation(len(places))]


def _street_furniture(boxes: BoxList, kerbs: list[Place], rng: np.random.Generator) -> list[Place]:
    """Lamps, signals, signs, benches with bins, cabinets; gives the kerb places that stay free."""
    rest = iter(kerbs)
    for number, (x, y, axis) in zip(range(NUM_LAMPS), rest, strict=False):
        arm = (0.16, 2.0) if axis == 0 else (2.0, 0.16)
        boxes.add("Poles", (x, y), (0.24, 0.24), 0.0, 7.6)
        boxes.add("Poles", (x, y), (0.12, 0.12), 0.1, 7.4)  # the cable inside
        boxes.add("Poles", (x, y), arm, 7.6, 7.75)
        if number < CENSUS["TrafficSigns"] - NUM_SIGN_POLES:
            boxes.add("TrafficSigns", (x, y + 0.16), (0.6, 0.06), 2.3, 2.9)
    for _, (x, y, _axis) in zip(range(NUM_SIGNALS), rest, strict=False):
        boxes.add("Poles", (x, y), (0.16, 0.16), 0.0, 3.4)
        boxes.add("TrafficLight", (x, y + 0.3), (0.36, 0.34), 2.5, 3.5)
        boxes.add("TrafficLight", (x, y + 0.3), (0.3, 0.3), 2.6, 3.4)
    for _, (x, y, _axis) in zip(range(NUM_SIGN_POLES), rest, strict=False):
        boxes.add("Poles", (x, y), (0.08, 0.08), 0.0, 2.9)
        boxes.add("TrafficSigns", (x, y + 0.07), (0.65, 0.06), 2.2, 2.85)
    for _, (x, y, axis) in zip(range(NUM_BENCHES), rest, strict=False):
        boxes.add("Static", (x, y), (1.8, 0.55) if axis == 0 else (0.55, 1.8), 0.0, 0.48)
        bin_xy = (x + 1.5, y) if axis == 0 else (x, y + 1.5)
        boxes.add("Static", bin_xy, (0.5, 0.5), 0.0, 0.95)
        boxes.add("Static", bin_xy, (0.4, 0.4), 0.05, 0.9)
    num_planters = CENSUS["Static"] - 3 * NUM_BENCHES - 2 * NUM_KIOSKS
    for _, (x, y, _axis) in zip(range(num_planters), rest, strict=False):
        boxes.add("Static", (x, y), (1.2, 1.2), 0.0, rng.uniform(0.5, 0.9))
    num_cabinets = (CENSUS["Other"] + 1) // 2
    for number, (x, y, _axis) in zip(range(num_cabinets), rest, strict=False):
        boxes.add("Other", (x, y), (0.7, 0.7), 0.0, 1.3)
        if 2 * number + 1 < CENSUS["Other"]:
            boxes.add("Other", (x, y), (0.5, 0.5), 0.1, 1.2)
    return list(rest)


def _trees(boxes: BoxList, parks: list[Block], kerbs: list[Place], rng: np.random.Generator) -> None:
    """A trunk and a cloud of small boxes for each tree, in groves and along the kerbs."""
    places = [
        low + (high - low) * np.array([0.1 + 0.16 * (k % 6), 0.12 + 0.19 * (k // 6)]) + rng.uniform(-1.5, 1.5, 2)
        for low, high in parks
        for k in range(TREES_PER_PARK)
    ]
    places += [np.array([x, y]) for x, y, _ in kerbs[: NUM_TREES - len(places)]]
    num_leaves, extra = divmod(CENSUS["Vegetation"] - NUM_TREES, NUM_TREES)
    for number, place in enumerate(places):
        height, radius = rng.uniform(6.0, 10.0), rng.uniform(1.6, 2.4)
        boxes.add("Vegetation", place, (0.4, 0.4), 0.0, height * 0.6)
        num = num_leaves + (number < extra)
        directions = rng.normal(size=(num, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        shares = directions * np.cbrt(rng.uniform(0.0, 1.0, (num, 1)))
        sizes = rng.uniform(0.3, 0.9, num)
        low, high = 2.6, height - 0.9
        for (u, v, w), size in zip(shares, sizes, strict=True):
            base = (low + high) / 2 + w * (high - low) / 2
            boxes.add("Vegetation", place + radius * np.array([u, v]), (size, size), base, base + size)
