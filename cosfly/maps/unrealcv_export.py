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
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap, MapHeader, MapSource, make_box_map
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.maps.boxlist import GroundHeight, MapLicence, served
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
    # objects longer than this both ways and higher than 2 m, landscapes, are dropped and counted, m
    huge_m: ClassVar[float] = 150.0

    def inputs(self) -> dict[str, Path]:
        return {f"sizes_{k}": path for k, path in enumerate(self.sizes)}


@dataclass(frozen=True)
class LevelMap(BoxMap):
    """A map, and for each box its object: name, class, and source of its size."""

    objects: tuple[tuple[str, str, str], ...] = ()


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
    names = str(*connection.ask("vget /objects")).split()
    answers = iter(connection.ask(*(f"vget /object/{name}/{what}" for name in names for what in QUESTIONS)))
    for name in names:
        class_name = str(next(answers))
        yield _Object(name, class_name, *(connection.numbers(next(answers), num) for num in QUESTIONS.values() if num))


def level_map(objects: list[_Object], cfg: UnrealCvMapConfig, where: str, version: str, level: str) -> LevelMap:
    """Return a map of a server's answers; the header counts dropped objects."""
    sizes = read_sizes(cfg.sizes) if cfg.sizes else {}
    dropped = Counter[str]()
    rows: list[np.ndarray] = []  # centre, half sizes, rotation and kind
    used: list[tuple[str, str, str]] = []  # name, class, and source of the size
    for item in objects:
        kind = kind_of(item.class_name)
        box, source = _box(item, kind, sizes, cfg)
        if reason := _unfit(item, kind, box, source, cfg):
            dropped[reason] += 1
            continue
        assert box is not None
        rows.append(np.append(box, KINDS[kind or "Other"]))
        used.append((item.name, item.class_name, source))
    sources = [source for _, _, source in used]
    counts = {source: sources.count(source) for source in SOURCES}
    header = MapHeader(
        name=cfg.name or level or "Unreal", source=MapSource(tool="UnrealCV", version=version, file=level),
        licence=cfg.licence, credits=cfg.credits, extent_sources=counts,
        num_objects=len(objects), dropped_objects=dict(dropped),
    )  # fmt: skip
    log.info("%s: sources of sizes: %s", where, counts_text(counts))
    centers, half_extents, turns, kinds = np.split(np.reshape(rows, (-1, 10)), [3, 6, 9], axis=1)
    ids = [id_of(name) for name, _, _ in used]
    box_map = make_box_map(centers, half_extents, turns, kinds, ids, header)
    fix = "load another level, or add a table with the sizes of the assets to maps.unrealcv.sizes"
    box_map = served(box_map, cfg.ground_z_m, np.array(sources) == "road", where, fix)
    return LevelMap(**vars(box_map), objects=tuple(used))


def _unfit(item: _Object, kind: str | None, box: np.ndarray | None, source: str, cfg: UnrealCvMapConfig) -> str:
    """Return why an object is dropped; an empty text if it is kept."""
    if kind is None and is_no_part_of_town(item.class_name):
        return "not of the town"
    if box is None or (kind is None and source == "default"):
        return "no body"
    is_huge = (2 * box[3:5] > cfg.huge_m).all() and 2 * box[5] > 2.0
    return "huge" if is_huge and kind != "Roads" else ""


def _box(
    item: _Object, kind: str | None, sizes: dict[str, np.ndarray], cfg: UnrealCvMapConfig
) -> tuple[np.ndarray | None, str]:
    """Return centre, half sizes and rotation, (9,) in world axes, of an object, and the source of its size."""
    turn = item.rotation or (0.0, 0.0, 0.0)
    if item.bounds is not None and item.class_name not in sizes:
        low, high = np.reshape(item.bounds, (2, 3)) / cfg.coord_scale
        if (high - low >= 0).all() and (high - low >= LEAST_M).sum() >= 2:
            half, yaw_deg = _unturned((high - low) / 2, turn)
            center, rotation_deg = world_pose([*(low + high) / 2, 0.0, yaw_deg, 0.0])
            return np.concatenate([center, half, rotation_deg]), "road" if kind == "Roads" else "engine"
    if item.location is None:
        return None, "default"
    asset = asset_of(item.class_name)
    size_cm = sizes.get(item.class_name)
    plausible_m = (asset and asset.size_m) or (CUBE_M,) * 3
    size_m = np.array(plausible_m) if size_cm is None else size_cm / CM_PER_M
    half = size_m * (item.scale or (1.0,) * 3) / 2
    foot, rotation_deg = world_pose([*(part / cfg.coord_scale for part in item.location), *turn])
    center = foot + np.array([0.0, 0.0, half[2]])
    return np.concatenate([center, half, rotation_deg]), "default" if size_cm is None else "bbox"


def _unturned(half_m: np.ndarray, rotation_deg: tuple[float, ...]) -> tuple[np.ndarray, float]:
    """Return half sizes and yaw of the upright box with these bounds; without one, the bounds themselves and 0."""
    pitch, yaw, roll = rotation_deg
    c, s = abs(np.cos(np.radians(yaw))), abs(np.sin(np.radians(yaw)))
    if max(abs(pitch), abs(roll)) > 1e-3 or abs(c * c - s * s) < SKEWED:
        return half_m, 0.0
    x, y = np.linalg.solve([[c, s], [s, c]], half_m[:2])
    if min(x, y) <= LEAST_M / 2:
        return half_m, 0.0
    return np.array([x, y, half_m[2]]), yaw


def write_objects(box_map: BoxMap, out: Path) -> list[Path]:
    """Write the object of each box, and the page that shows the map; return both paths."""
    from cosfly.viz import scene_page  # imported here: it also reads trajectories and frames

    assert isinstance(box_map, LevelMap)
    header = box_map.header
    objects = [
        {"id": int(number), "name": name, "class": class_name, "type": KIND_NAMES[int(kind)], "extent_source": source}
        for number, kind, (name, class_name, source) in zip(box_map.ids, box_map.kinds, box_map.objects, strict=True)
    ]
    sidecar = {
        "schema": "cosfly.boxes_meta", "schema_version": "1.0", "map": header.name,
        "source": header.source.model_dump(mode="json"), "extent_sources": header.extent_sources,
        "counts_by_kind": box_map.counts(), "num_objects": header.num_objects,
        "dropped_objects": header.dropped_objects, "objects": objects,
    }  # fmt: skip
    write_json(out / OBJECTS_FILE, sidecar, indent=None)
    return [out / OBJECTS_FILE, scene_page.run(out / "boxes_3d.json", out / VIEWER)]
