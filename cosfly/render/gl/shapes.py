"""The shapes of houses, trees, cars and lamps: the parts of each kind of box.

All parts stay inside their box, so that the planners' collision and visibility checks hold.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cosfly.formats.kinds import KINDS, LAYERS
from cosfly.render import contract
from cosfly.render.gl import meshes, parts
from cosfly.render.gl.parts import FAR_PX, Boxes, Parts

HAS_RIM = 1.0  # added to the seeds of boxes whose roofs have a rim

BUILDING_COLORS = np.array([
    [0.46, 0.23, 0.16], [0.55, 0.31, 0.21], [0.66, 0.59, 0.47], [0.60, 0.57, 0.52], [0.73, 0.68, 0.58],
    [0.42, 0.40, 0.38], [0.70, 0.54, 0.36], [0.50, 0.45, 0.40], [0.62, 0.46, 0.36], [0.78, 0.75, 0.69],
    [0.38, 0.43, 0.47], [0.52, 0.28, 0.20],
])  # fmt: skip
TILE_COLORS = np.array([
    [0.34, 0.12, 0.065], [0.28, 0.11, 0.07], [0.10, 0.105, 0.115], [0.30, 0.15, 0.09], [0.15, 0.14, 0.135],
    [0.38, 0.16, 0.08],
])  # fmt: skip
PLAIN_COLORS = np.array(
    [[0.35, 0.33, 0.30], [0.22, 0.27, 0.22], [0.40, 0.30, 0.20], [0.28, 0.29, 0.31], [0.45, 0.42, 0.36]]
)
BARK_COLOR = (0.16, 0.11, 0.075)
CAR_COLORS = np.array([
    [0.62, 0.63, 0.65], [0.05, 0.05, 0.06], [0.80, 0.80, 0.79], [0.36, 0.03, 0.03], [0.04, 0.09, 0.26],
    [0.23, 0.25, 0.27], [0.10, 0.17, 0.13], [0.48, 0.40, 0.28],
])  # fmt: skip
SIGN_COLORS = np.array([[0.55, 0.03, 0.03], [0.04, 0.12, 0.45], [0.75, 0.75, 0.72], [0.60, 0.42, 0.02]])
LEAF_COLORS = np.array(
    [[0.085, 0.165, 0.035], [0.11, 0.19, 0.045], [0.065, 0.135, 0.035], [0.15, 0.20, 0.05], [0.075, 0.155, 0.055]]
)


Shape = Callable[[Boxes], list[Parts]]


def _box(material: int, color: tuple[float, float, float], layer: int | None = None) -> Shape:
    """Return the shape of the box itself: a ground surface in its layer, or a standing thing."""
    return lambda boxes: [boxes.part(meshes.BOX, boxes.half, material, color, layer=layer)]


def _plain(boxes: Boxes) -> list[Parts]:
    return [boxes.part(meshes.BOX, boxes.half, parts.PLAIN, boxes.pick(PLAIN_COLORS))]


def _buildings(boxes: Boxes) -> list[Parts]:
    """Return houses; the shader draws storeys, windows and the rim of a roof."""
    rimmed = replace(boxes, seeds=boxes.seeds * 0.999 + HAS_RIM)
    return [rimmed.part(meshes.BOX, boxes.half, parts.FACADE, boxes.pick(BUILDING_COLORS))]


def _vegetation(boxes: Boxes) -> list[Parts]:
    """Return trees, bushes, hedges and lawns, by the shape of the box."""
    forms, crown_low = contract.plants_of(boxes.centers, boxes.half, boxes.seeds)
    leaf = boxes.pick(LEAF_COLORS) * (0.85 + 0.35 * boxes.variation(3))[:, None]
    by_form = {form: (boxes.select(forms == form), leaf[forms == form]) for form in range(contract.BROADLEAF + 1)}
    lawns, grass = by_form[contract.LAWN]
    hedges, green = by_form[contract.HEDGE]
    trunks, _ = by_form[contract.TRUNK]
    trees, tree_leaf = by_form[contract.BROADLEAF]
    low = crown_low[forms == contract.BROADLEAF]
    return [
        lawns.part(meshes.BOX, lawns.half, parts.GRASS, grass, layer=LAYERS["RoadLines"]),
        hedges.part(meshes.BOX, hedges.half, parts.LEAVES, green),
        *_bushes(*by_form[contract.BUSH]),
        trunks.part(meshes.CYLINDER, trunks.half, parts.BARK, BARK_COLOR),
        *_crowns(*by_form[contract.CROWN], crown_low[forms == contract.CROWN]),
        *_conifers(*by_form[contract.CONIFER]),
        _stems(trees, low + 0.75),
        *_crowns(trees, tree_leaf, low),
    ]


def _bushes(boxes: Boxes, leaf: np.ndarray) -> list[Parts]:
    h = boxes.half
    blobs = [
        boxes.part(meshes.BLOB_COARSE, h, parts.LEAVES, leaf, max_px=FAR_PX),
        boxes.part(meshes.BLOB, h * [0.72, 0.72, 0.98], parts.LEAVES, leaf, min_px=FAR_PX),
    ]
    for side in (-1.0, 1.0):
        offset = h * [0.42 * side, 0.25 * side, -0.25]
        shade = leaf * (1.0 + 0.12 * side)
        size = h * [0.56, 0.6, 0.72]
        blobs.append(boxes.part(meshes.BLOB, size, parts.LEAVES, shade, offset=offset, min_px=FAR_PX))
    return blobs


def _crowns(boxes: Boxes, leaf: np.ndarray, crown_low: np.ndarray) -> list[Parts]:
    """Return foliage from `crown_low` (n,), in half heights, to the top: blobs inside the inscribed ellipsoid."""
    h = boxes.half
    ones = np.ones(len(boxes))
    half = h * np.column_stack([ones, ones, (1.0 - crown_low) / 2.0])
    center = h * np.column_stack([0.0 * ones, 0.0 * ones, (1.0 + crown_low) / 2.0])
    blobs = [
        boxes.part(meshes.BLOB_COARSE, half, parts.LEAVES, leaf, offset=center, max_px=FAR_PX),
        boxes.part(meshes.BLOB_FINE, half * 0.74, parts.LEAVES, leaf, offset=center, min_px=FAR_PX),
    ]
    for number in range(7):
        radius = (0.40 + 0.13 * boxes.variation(10 + number))[:, None]
        angle = 2.0 * np.pi * (number / 6.0 + boxes.variation(30)) + 0.5 * boxes.variation(20 + number)
        lift = np.where(number == 6, 0.9, 0.62 * np.sin(2.6 * number + 6.28 * boxes.variation(31)))
        flat = np.sqrt(np.maximum(0.0, 1.0 - lift**2))
        offset = center + half * np.column_stack([flat * np.cos(angle), flat * np.sin(angle), lift]) * (1.0 - radius)
        shade = leaf * (0.86 + 0.3 * boxes.variation(40 + number))[:, None]
        blobs.append(boxes.part(meshes.BLOB, half * radius, parts.LEAVES, shade, offset=offset, min_px=FAR_PX))
    return blobs


def _conifers(boxes: Boxes, leaf: np.ndarray) -> list[Parts]:
    h = boxes.half
    dark = leaf * [0.6, 0.75, 0.85]
    far = boxes.part(meshes.CONE, h * [1, 1, 0.92], parts.LEAVES, dark, offset=h * [0, 0, 0.08], max_px=FAR_PX)
    tree = [far, _stems(boxes, np.full(len(h), -0.5))]
    for low, top, radius in ((contract.CONIFER_LOW, 0.1, 1.0), (-0.35, 0.55, 0.78), (0.1, 1.0, 0.55)):
        size = h * [radius, radius, (top - low) / 2.0]
        offset = h * [0, 0, (low + top) / 2.0]
        tree.append(boxes.part(meshes.CONE, size, parts.LEAVES, dark, offset=offset, min_px=FAR_PX))
    return tree


def _stems(boxes: Boxes, top: np.ndarray) -> Parts:
    """Return a stem from each box's bottom to `top` (n,), in units of the half height."""
    h = boxes.half
    radius = contract.stem_radius_m(h)
    size = np.column_stack([radius, radius, h[:, 2] * (top + 1.0) / 2.0])
    offset = np.column_stack([0 * radius, 0 * radius, h[:, 2] * (top - 1.0) / 2.0])
    return boxes.part(meshes.CYLINDER, size, parts.BARK, BARK_COLOR, offset=offset, min_px=FAR_PX)


_WHEEL_TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # the cylinder's axis along the car's y


def _wheels(boxes: Boxes, high: float, long: float, along: float) -> list[Parts]:
    """Return four wheels; their largest radius is a share of the half height, and of the half length."""
    h = boxes.half
    radius = np.minimum(high * h[:, 2], long * h[:, 0])
    thick = 0.16 * h[:, 1]
    size = np.column_stack([radius, radius, thick])
    look = (parts.RUBBER, (0.02, 0.02, 0.022))
    wheels = []
    for front, side in ((-along, -1.0), (-along, 1.0), (along, -1.0), (along, 1.0)):
        offset = np.column_stack([front * h[:, 0], side * (0.97 * h[:, 1] - thick), radius - h[:, 2]])
        wheels.append(boxes.part(meshes.CYLINDER, size, *look, offset=offset, turn=_WHEEL_TURN, min_px=FAR_PX))
    return wheels


def _cars(boxes: Boxes) -> list[Parts]:
    h = boxes.half
    paint = boxes.pick(CAR_COLORS)
    return [
        boxes.part(meshes.ROUNDED, h * [1, 0.97, 0.36], parts.CAR_PAINT, paint, offset=h * [0, 0, -0.36]),
        boxes.part(meshes.CABIN, h * [0.56, 0.84, 0.37], parts.CABIN, paint, offset=h * [-0.08, 0, 0.3]),
        boxes.part(meshes.CABIN, h * [0.36, 0.69, 0.19], parts.CAR_PAINT, paint, offset=h * [-0.08, 0, 0.81]),
        *_wheels(boxes, 0.43, 0.2, 0.6),
    ]


def _trucks(boxes: Boxes) -> list[Parts]:
    h = boxes.half
    paint = boxes.pick(CAR_COLORS)
    return [
        boxes.part(meshes.BOX, h * [0.7, 1, 0.83], parts.PLAIN, paint * 0.6 + 0.3, offset=h * [-0.3, 0, 0.17]),
        boxes.part(meshes.ROUNDED, h * [0.27, 0.94, 0.46], parts.CAR_PAINT, paint, offset=h * [0.72, 0, -0.3]),
        boxes.part(meshes.CABIN, h * [0.26, 0.92, 0.3], parts.CABIN, paint, offset=h * [0.68, 0, 0.3]),
        *_wheels(boxes, 0.28, 0.14, 0.68),
    ]


def _buses(boxes: Boxes) -> list[Parts]:
    h = boxes.half
    paint = boxes.pick(CAR_COLORS[3:6])
    body = boxes.part(meshes.BOX, h * [1, 1, 0.9], parts.BUS, paint, offset=h * [0, 0, 0.1])
    return [body, *_wheels(boxes, 0.28, 0.14, 0.62)]


def _two_wheelers(boxes: Boxes) -> list[Parts]:
    h = boxes.half
    rubber = (0.03, 0.03, 0.03)
    paint = boxes.pick(CAR_COLORS)
    radius = np.minimum(0.4 * h[:, 0], 0.62 * h[:, 2])
    size = np.column_stack([radius, radius, np.minimum(0.05, h[:, 1])])
    places = (np.column_stack([side * (h[:, 0] - radius), 0 * radius, radius - h[:, 2]]) for side in (-1.0, 1.0))
    return [
        *(boxes.part(meshes.CYLINDER, size, parts.RUBBER, rubber, offset=at, turn=_WHEEL_TURN) for at in places),
        boxes.part(meshes.ROUNDED, h * [0.5, 0.25, 0.22], parts.CAR_PAINT, paint, offset=h * [0, 0, 0.1]),
        boxes.part(meshes.BOX, h * [0.06, 0.95, 0.06], parts.METAL, (0.1, 0.1, 0.1), offset=h * [0.45, 0, 0.9]),
    ]


def _pole(boxes: Boxes, most_m: float = 0.1) -> Parts:
    h = boxes.half
    radius = np.minimum(np.minimum(h[:, 0], h[:, 1]), most_m)
    size = np.column_stack([radius, radius, 0.985 * h[:, 2]])
    return boxes.part(meshes.CYLINDER, size, parts.METAL, (0.17, 0.18, 0.18), offset=h * [0, 0, -0.015])


def _poles(boxes: Boxes) -> list[Parts]:
    """Return poles; tall ones have lamps at the ends of an arm, if the box is wide enough for one."""
    is_head = boxes.half[:, 2] < boxes.half[:, 0]  # maps that keep arm and head apart from the pole
    heads, boxes = boxes.select(is_head), boxes.select(~is_head)
    lamps = boxes.select(boxes.half[:, 2] > 1.2)
    h = lamps.half
    arm = np.column_stack([h[:, 0], np.minimum(h[:, 1], 0.06), np.minimum(0.03 * h[:, 2], 0.05)])
    head = np.minimum(h * [0.9, 1.0, 0.04], [0.35, 0.16, 0.1])
    glass = (0.75, 0.74, 0.68)
    ends = (np.column_stack([side * (h[:, 0] - head[:, 0]), 0 * h[:, 1], 0.93 * h[:, 2]]) for side in (-1.0, 1.0))
    return [
        heads.part(meshes.ROUNDED, heads.half, parts.LAMP, (0.17, 0.17, 0.17)),
        _pole(boxes),
        lamps.part(meshes.BOX, arm, parts.METAL, (0.2, 0.2, 0.2), offset=h * [0, 0, 0.96], min_px=FAR_PX),
        *(lamps.part(meshes.ROUNDED, head, parts.LAMP, glass, offset=end) for end in ends),
    ]


def _traffic_lights(boxes: Boxes) -> list[Parts]:
    h = boxes.half
    head = np.minimum(h * [1.0, 1.0, 0.35], [0.22, 0.2, 0.55])
    arm = np.column_stack([h[:, 0], np.minimum(h[:, 1], 0.05), np.minimum(0.05 * h[:, 2], 0.05)])
    return [
        _pole(boxes),
        boxes.part(meshes.BOX, arm, parts.METAL, (0.14, 0.14, 0.14), offset=h * [0, 0, 0.9]),
        boxes.part(meshes.BOX, head, parts.SIGNAL, (0.03, 0.035, 0.03), offset=(h - head) * [1, 0, 1]),
    ]


def _signs(boxes: Boxes) -> list[Parts]:
    h = boxes.half
    size = np.column_stack([h[:, 0], np.minimum(h[:, 1], 0.03), np.minimum(h[:, 0], 0.5 * h[:, 2])])
    board = boxes.part(meshes.BOX, size, parts.METAL, boxes.pick(SIGN_COLORS), offset=(h - size) * [0, 0, 1])
    return [_pole(boxes, 0.04), board]


SHAPES: dict[int, Shape] = {
    KINDS[name]: build
    for name, build in {
        "Roads": _box(parts.ROAD, (0.095, 0.095, 0.1), LAYERS["Roads"]),
        "Sidewalks": _box(parts.SIDEWALK, (0.36, 0.345, 0.32), LAYERS["Sidewalks"]),
        "Terrain": _box(parts.GRASS, (0.105, 0.14, 0.045), LAYERS["Terrain"]),
        "Ground": _box(parts.GRAVEL, (0.30, 0.275, 0.235), LAYERS["Ground"]),
        "RoadLines": _box(parts.ROAD_LINE, (0.62, 0.62, 0.6), LAYERS["RoadLines"]),
        "RailTrack": _box(parts.GRAVEL, (0.20, 0.18, 0.165), LAYERS["RailTrack"]),
        "Water": _box(parts.WATER, (0.03, 0.07, 0.09), LAYERS["Water"]),
        "Buildings": _buildings,
        "Walls": _box(parts.BRICK, (0.42, 0.24, 0.18)),
        "Fences": _box(parts.FENCE, (0.30, 0.23, 0.16)),
        "GuardRail": _box(parts.METAL, (0.42, 0.43, 0.44)),
        "Bridge": _box(parts.CONCRETE, (0.42, 0.41, 0.39)),
        "Poles": _poles,
        "TrafficLight": _traffic_lights,
        "TrafficSigns": _signs,
        "Vegetation": _vegetation,
        "Car": _cars,
        "Truck": _trucks,
        "Bus": _buses,
        "Train": _buses,
        "Motorcycle": _two_wheelers,
        "Bicycle": _two_wheelers,
        "Rider": _two_wheelers,
    }.items()
}
_AS_THEY_LIE = (_plain, _buildings, _vegetation)


def parts_of(boxes: Boxes) -> list[Parts]:
    """Return the parts of boxes of one kind."""
    shape = SHAPES.get(boxes.kind, _plain)
    return shape(boxes if shape in _AS_THEY_LIE else boxes.lengthwise())
