"""The objects of a running UnrealCV server's level as boxes (app:simworld, step 2).

The sources of sizes are counted, as in the paper: `road`, bounds of a road; `bbox`, a table of asset sizes; `engine`,
bounds of any other object; `default`, without an answer: the plausible size of the asset or a cube of 1 m. Bounds are
aligned with the world's axes; for a turned object the turned box with these bounds is computed. Ids are derived from
names (`id_of`).
"""

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap, MapHeader, MapSource, make_box_map
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.maps.boxlist import GroundHeight, MapLicence, with_server_ground
from cosfly.maps.simworld import read_sizes
from cosfly.runtime.errors import counts_text
from cosfly.runtime.json_io import write_json
from cosfly.simulators.assets import asset_of, id_of, is_no_part_of_town, kind_of
from cosfly.simulators.conventions import CM_PER_M, world_pose
from cosfly.simulators.unrealcv_client import UnrealCvConfig, UnrealCvConnection, connect

log = logging.getLogger(__name__)

QUESTIONS = {"uclass_name": 0, "location": 3, "rotation": 3, "bounds": 6, "scale": 3}  # number of values of each answer
SOURCES = ("road", "bbox", "engine", "default")
LEAST_M = 0.01  # smaller bounds count as missing
CUBE_M = 1.0
SLAB_M = 2.0  # huge objects that are lower are ground
SKEWED = 0.2  # cosine of twice a yaw, below which the sides of a turned box do not follow from its bounds
OBJECTS_FILE = "boxes_meta.json"
VIEWER = "boxes.html"


class UnrealCvMapConfig(UnrealCvConfig):
    """The level of a running UnrealCV server."""

    name: str | None = Field(None, min_length=1, description="name of the map; null: the level's name")
    licence: MapLicence = "apache-2.0"
    credits: str = Field("SimWorld, maitrix-org and contributors", description="attribution of the level's makers")
    sizes: list[Path] = Field([], description="asset size tables of SimWorld, of which the first with an asset applies")
    ground_z_m: GroundHeight = None
    # objects longer than this both ways and higher than SLAB_M, landscapes, are dropped and counted, m
    huge_m: ClassVar[float] = 150.0

    def inputs(self) -> dict[str, Path]:
        return {f"sizes_{k}": path for k, path in enumerate(self.sizes)}


class LevelObject(NamedTuple):
    """The object of a box."""

    name: str
    class_name: str
    extent_source: str  # of its size: one of SOURCES


@dataclass(frozen=True)
class LevelMap(BoxMap):
    """A map, and the object of each box."""

    objects: tuple[LevelObject, ...] = ()


@dataclass(frozen=True)
class _Object:
    """Answers about one object; numbers in the server's units and axes, None without an answer."""

    name: str
    class_name: str
    location: tuple[float, ...] | None
    rotation: tuple[float, ...] | None
    bounds: tuple[float, ...] | None
    scale: tuple[float, ...] | None


def load(cfg: UnrealCvMapConfig, seed: int) -> BoxMap:
    """Return the level's boxes; the seed changes nothing."""
    connection = connect(cfg, cfg.port)
    try:
        with connection.asking("the server did not return the objects of the level"):
            objects = list(_asked(connection))
    finally:
        connection.close()
    return level_map(objects, cfg, connection.where, connection.version, connection.level)


def _asked(connection: UnrealCvConnection) -> Iterator[_Object]:
    """Ask about all objects of the level in one request."""
    [text] = connection.ask("vget /objects")
    names = str(text).split()
    answers = iter(connection.ask(*(f"vget /object/{name}/{question}" for name in names for question in QUESTIONS)))
    _, *counts = QUESTIONS.values()
    for name in names:
        class_name, *texts = islice(answers, len(QUESTIONS))
        yield _Object(name, str(class_name), *map(connection.numbers, texts, counts))


def level_map(objects: list[_Object], cfg: UnrealCvMapConfig, where: str, version: str, level: str) -> LevelMap:
    """Return a map of a server's answers; the header counts dropped objects."""
    sizes_cm = read_sizes(cfg.sizes) if cfg.sizes else {}
    dropped = Counter[str]()
    rows: list[np.ndarray] = []  # centre, half sizes, rotation and kind
    used: list[LevelObject] = []  # the object of each row
    for item in objects:
        kind = kind_of(item.class_name)
        box, source = _box(item, kind, sizes_cm, cfg)
        reason = _drop_reason(item, kind, box, source, cfg)
        if reason:
            dropped[reason] += 1
            continue
        assert box is not None
        rows.append(np.append(box, KINDS[kind or "Other"]))
        used.append(LevelObject(item.name, item.class_name, source))
    sources = [item.extent_source for item in used]
    counts = {source: sources.count(source) for source in SOURCES}
    header = MapHeader(
        name=cfg.name or level or "Unreal", source=MapSource(tool="UnrealCV", version=version, file=level),
        licence=cfg.licence, credits=cfg.credits, extent_sources=counts,
        num_objects=len(objects), dropped_objects=dict(dropped),
    )  # fmt: skip
    log.info("%s: sources of sizes: %s", where, counts_text(counts))
    centers, half_extents, turns, kinds = np.split(np.reshape(rows, (-1, 10)), [3, 6, 9], axis=1)
    ids = [id_of(item.name) for item in used]
    box_map = make_box_map(centers, half_extents, turns, kinds, ids, header)
    fix = "load another level, or add a table with the sizes of the assets to maps.unrealcv.sizes"
    box_map = with_server_ground(box_map, cfg.ground_z_m, np.array(sources) == "road", where, fix)
    return LevelMap(**vars(box_map), objects=tuple(used))


def _drop_reason(item: _Object, kind: str | None, box: np.ndarray | None, source: str, cfg: UnrealCvMapConfig) -> str:
    """Return why an object is dropped; an empty text if it is kept."""
    if kind is None and is_no_part_of_town(item.class_name):
        return "not of the town"
    if box is None or (kind is None and source == "default"):
        return "no body"
    is_huge = (2 * box[3:5] > cfg.huge_m).all() and 2 * box[5] > SLAB_M
    return "huge" if is_huge and kind != "Roads" else ""


def _box(
    item: _Object, kind: str | None, sizes_cm: dict[str, np.ndarray], cfg: UnrealCvMapConfig
) -> tuple[np.ndarray | None, str]:
    """Return centre, half sizes and rotation, (9,) in world axes, of an object, and the source of its size.

    The bounds of the engine are used, unless a table has the size of the asset or the bounds are empty.
    """
    turn_deg = item.rotation or (0.0, 0.0, 0.0)
    if item.bounds is not None and item.class_name not in sizes_cm:
        low, high = np.reshape(item.bounds, (2, 3)) / cfg.coord_scale
        if (high - low >= 0).all() and (high - low >= LEAST_M).sum() >= 2:
            half, yaw_deg = _unturned((high - low) / 2, turn_deg)
            center, rotation_deg = world_pose([*(low + high) / 2, 0.0, yaw_deg, 0.0])
            return np.concatenate([center, half, rotation_deg]), "road" if kind == "Roads" else "engine"
    if item.location is None:
        return None, "default"
    asset = asset_of(item.class_name)
    if item.class_name in sizes_cm:
        size_m, source = sizes_cm[item.class_name] / CM_PER_M, "bbox"
    elif asset is not None and asset.size_m:
        size_m, source = np.array(asset.size_m), "default"
    else:
        size_m, source = np.full(3, CUBE_M), "default"
    half = size_m * (item.scale or (1.0, 1.0, 1.0)) / 2
    foot, rotation_deg = world_pose([*(part / cfg.coord_scale for part in item.location), *turn_deg])
    center = foot + np.array([0.0, 0.0, half[2]])
    return np.concatenate([center, half, rotation_deg]), source


def _unturned(half_m: np.ndarray, rotation_deg: tuple[float, ...]) -> tuple[np.ndarray, float]:
    """Return half sizes and yaw of the upright box with these bounds; without one, the bounds themselves and 0."""
    pitch, yaw, roll = rotation_deg
    cos, sin = np.abs([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
    if max(abs(pitch), abs(roll)) > 1e-3 or abs(cos * cos - sin * sin) < SKEWED:
        return half_m, 0.0
    x, y = np.linalg.solve([[cos, sin], [sin, cos]], half_m[:2])
    if min(x, y) <= LEAST_M / 2:
        return half_m, 0.0
    return np.array([x, y, half_m[2]]), yaw


def write_objects(box_map: BoxMap, out: Path) -> list[Path]:
    """Write the object of each box, and the page that shows the map; return both paths."""
    from cosfly.viz import scene_page  # imported here: it also reads trajectories and frames

    assert isinstance(box_map, LevelMap)
    header = box_map.header
    objects = []
    for box_id, kind, item in zip(box_map.ids.tolist(), box_map.kinds.tolist(), box_map.objects, strict=True):
        fields = {"id": box_id, "name": item.name, "class": item.class_name, "type": KIND_NAMES[kind]}
        objects.append(fields | {"extent_source": item.extent_source})
    sidecar = {
        "schema": "cosfly.boxes_meta", "schema_version": "1.0", "map": header.name,
        "source": header.source.model_dump(mode="json"), "extent_sources": header.extent_sources,
        "counts_by_kind": box_map.counts(), "num_objects": header.num_objects,
        "dropped_objects": header.dropped_objects, "objects": objects,
    }  # fmt: skip
    write_json(out / OBJECTS_FILE, sidecar, indent=None)
    return [out / OBJECTS_FILE, scene_page.run(out / "boxes_3d.json", out / VIEWER)]
