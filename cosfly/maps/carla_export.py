"""The town of a running CARLA server: `get_environment_objects` of every label, as boxes (sec:step1).

Known defects of such exports are counted: labels without objects, repeated objects and ids, boxes without a size, and
one huge box around all of the terrain or the vegetation.
"""

import multiprocessing
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap, MapHeader, MapSource, make_box_map
from cosfly.formats.kinds import KINDS
from cosfly.maps.boxlist import GroundHeight, MapLicence, with_server_ground
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.io import sha256_bytes
from cosfly.simulators.carla_client import CarlaConfig, connect
from cosfly.simulators.conventions import world_pose

HUGE_KINDS = ("Terrain", "Vegetation")
SLAB_M = 2.0  # huge boxes that are lower are ground


class CarlaMapConfig(CarlaConfig):
    """The town of a running CARLA server."""

    name: str | None = Field(None, min_length=1, description="name of the map; null: the town's name")
    licence: MapLicence = "cc-by-4.0"
    credits: str = Field("CARLA Simulator, Computer Vision Center", description="attribution of the town's makers")
    ground_z_m: GroundHeight = None
    # terrain or vegetation longer than this both ways is dropped and counted, m; low slabs stay
    huge_m: ClassVar[float] = 150.0

    def inputs(self) -> dict:
        return {}


class CarlaObject(NamedTuple):
    """One object, in the server's axes."""

    label: str
    number: int  # its id, which is not unique
    name: str
    box: tuple[float, ...]  # centre, half sizes, and pitch, yaw, roll


@dataclass
class CarlaTown:
    """Answers of a server."""

    town: str
    version: str
    rows: list[CarlaObject] = field(default_factory=list)
    empty_labels: list[str] = field(default_factory=list)


def ask(cfg: CarlaConfig) -> CarlaTown:
    """Ask the server for all objects; runs in its own process, because the client can crash."""
    connection = connect(cfg, cfg.port)
    answers = CarlaTown(connection.town, connection.version)
    labels = connection.carla.CityObjectLabel.names.items()
    with connection.asking("CARLA did not return the objects of the town"):
        for name, label in sorted(labels, key=lambda pair: int(pair[1])):
            if name == "Any":
                continue
            objects = connection.world.get_environment_objects(label)
            if not objects:
                answers.empty_labels.append(name)
            for item in objects:
                center = item.bounding_box.location
                half = item.bounding_box.extent
                turn = item.bounding_box.rotation
                box = (center.x, center.y, center.z, half.x, half.y, half.z, turn.pitch, turn.yaw, turn.roll)
                answers.rows.append(CarlaObject(name, item.id, item.name, box))
    return answers


def load(cfg: CarlaMapConfig, seed: int) -> BoxMap:
    """Return the town's boxes; the seed changes nothing."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            answers = pool.submit(ask, cfg).result()
        except BrokenProcessPool:
            fix = "check that the server is CARLA 0.9.16, then run the same command again"
            raise EnvironmentMissing("the client of CARLA crashed", where=f"{cfg.host}:{cfg.port}", fix=fix) from None
    return box_map_of(answers, cfg)


def box_map_of(answers: CarlaTown, cfg: CarlaMapConfig) -> BoxMap:
    """Return a map of a server's answers; the header counts dropped objects."""
    where = f"{cfg.host}:{cfg.port} (CARLA {answers.version}), {answers.town}"
    dropped = Counter[str]()
    seen = set[tuple]()
    num_repeated = 0
    rows = dict[int, tuple]()  # by id: centre, half sizes, rotation, kind
    for label, number, name, box in answers.rows:
        key = (label, *np.round(box, 3).tolist())
        reason = _drop_reason(label, np.array(box), cfg)
        if not reason and key in seen:
            reason = "duplicate"
        if reason:
            dropped[reason] += 1
            continue
        seen.add(key)
        box_id = number
        if box_id in rows:
            num_repeated += 1
            box_id = int(sha256_bytes(f"{number} {name} {key}".encode())[:16], 16)
        position_m, rotation_deg = world_pose((*box[:3], *box[6:]))
        rows[box_id] = position_m, box[3:6], rotation_deg, KINDS[label]
    header = MapHeader(
        name=cfg.name or answers.town, source=MapSource(tool="CARLA", version=answers.version, file=answers.town),
        licence=cfg.licence, credits=cfg.credits, extent_sources={"engine": len(rows)}, num_objects=len(answers.rows),
        dropped_objects=dict(dropped), empty_labels=answers.empty_labels, repeated_ids=num_repeated,
    )  # fmt: skip
    centers, halves, turns, kinds = ([row[k] for row in rows.values()] for k in range(4))
    box_map = make_box_map(centers, halves, turns, kinds, list(rows), header)
    fix = "load a town whose objects have bounding boxes"
    return with_server_ground(box_map, cfg.ground_z_m, box_map.kinds == KINDS["Roads"], where, fix)


def _drop_reason(label: str, box: np.ndarray, cfg: CarlaMapConfig) -> str:
    """Return why a box is dropped; an empty text if it is kept."""
    if not np.isfinite(box).all():
        return "not finite"
    if (box[3:6] <= 0).sum() > 1 or (box[3:6] < 0).any():
        return "no size"
    is_huge = label in HUGE_KINDS and (2 * box[3:5] > cfg.huge_m).all() and 2 * box[5] > SLAB_M
    return "huge" if is_huge else ""
