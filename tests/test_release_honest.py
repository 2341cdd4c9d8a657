"""Honest releases verify: maps, sizes, weather, zoom, renderers, perturbations and captions of every kind; and what a
release tells of lies about them.

Real maps stand first: a check of looks that holds in a synthetic town alone is found here. Each kind is a run of a few
short flights that shares maps, walks and plans with the kinds of its map. Simulators send poses and depth in less than
double precision, so their town lies kilometres from the origin, where that shows.
"""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from commands import working_here
from conftest import SHARED_DATA
from release_lies import LIES, Row, box_moved, captioned, change, everything, ids_of_things_exchanged, with_depth
from release_tampering import errors_in, forge
from simulator_serving import serving
from teacher_server import TeacherServer

from caption.stage.released import read_released
from cosfly.maps import synthetic
from cosfly.pipeline import run as pipeline
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load
from release.verify.verify import verify

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SHARED_STAGES = ("maps", "simplify", "pedestrians", "plan")
SHORT = [
    "pedestrians.num_paths=2", "pedestrians.min_distance_m=14", "pedestrians.max_distance_m=22",
    "caption.window.stride=2",
    "render.width_px=320", "render.height_px=180", "inspect.legible_min=0", "release.licence=cc-by-4.0",
]  # fmt: skip
# name -> shipped configuration, or none, and what it is told; DATA is the folder of real maps
MAPS = {
    "simworld": ("simworld", ["maps.simworld.world=DATA/simworld-progen/progen_world.json"]),
    "simworld_towers": (None, [
        "maps.source=simworld", "maps.simworld.world=DATA/simworld-robotics/sample_task_dist_11/progen_world.json",
        "maps.simworld.sizes=[DATA/simworld-robotics/Bbox_total.json, DATA/simworld-progen/Bbox.json]",
    ]),
    "delft": ("delft", ["maps.cityjson.path=DATA/delft-bgt-lod1/delft.json.gz"]),
    "campus_3dbag": (None,
        ["maps.source=cityjson", "maps.cityjson.path=DATA/tudelft-3dbag/extension.city.jsonl.gz",
            "pedestrians.ground=anywhere"]),
    "town": (None, []),
    "uneven": (None, ["maps.synthetic.preset=village"]),
    "river": (None, ["maps.synthetic.preset=river"]),
    "towers": (None, ["maps.synthetic.preset=towers"]),
    "park_styles": (None,
        ["maps.synthetic.preset=park", "plan.planner=muco", "plan.styles={orbit_left: 1, rise: 1}",
            "pedestrians.pace={hurry: 1, stop_and_look: 1}"]),
    "crowd": (None, ["maps.synthetic.preset=market", "pedestrians.others=6"]),
    "one": (None, ["pedestrians.num_paths=1"]),
    "carla": (None, ["maps.source=carla", "maps.carla.port=CARLA_PORT"]),
    "unrealcv": (None, ["maps.source=unrealcv", "maps.unrealcv.port=UNREALCV_PORT"]),
}  # fmt: skip


def weather(name: str, time_of_day: str) -> list[str]:
    return [
        "render.look={}", "render.weather_mode=fixed", f"render.weather_name={name}", f"render.tod_name={time_of_day}",
    ]  # fmt: skip


SMALL, HD = ["render.width_px=160", "render.height_px=90"], ["render.width_px=1280", "render.height_px=720"]
NARROW, WIDE = ["render.fovs_deg=[30]"], ["render.fovs_deg=[110]"]
ZOOM = ["render.fovs_deg=[30, 60, 90]", "render.zoom.mode=dynamic", "render.zoom.part_s=5", "render.zoom.ramp_s=2"]
FAR = [
    "render.perturbation.pedestrian_radius_m=6", "render.perturbation.drone_radius_m=6",
    "render.perturbation.max_view_deg=20", "render.perturbation.max_roll_deg=8",
    "render.perturbation.view_radius_m=6",
]  # fmt: skip
TEACHER = "caption.teacher=TEACHER"
CARLA = [*SMALL, "render.backend=carla", "render.carla.port=CARLA_PORT"]
UNREALCV = [
    *SMALL, "render.backend=unrealcv", "render.unrealcv.port=UNREALCV_PORT", "render.unrealcv.animate=false",
    "render.unrealcv.settle_delay_s=0",
]  # fmt: skip
# kind -> map, what its run is told
KINDS = {
    "simworld as shipped": ("simworld", []),
    "delft as shipped": ("delft", []),
    "simworld 160 px": ("simworld", SMALL),
    "simworld night rain": ("simworld", weather("heavy_rain", "night")),
    "simworld zoom": ("simworld", ZOOM),
    "simworld far perturbation": ("simworld", FAR),
    "simworld robotics towers": ("simworld_towers", []),
    "delft 160 px": ("delft", SMALL),
    "delft 1280 px": ("delft", [*HD, "render.tracks=[clean]", "release.tracks=[clean]"]),
    "delft 110 degrees": ("delft", [*SMALL, *WIDE]),
    "delft far perturbation": ("delft", [*SMALL, *FAR]),
    "3D BAG campus": ("campus_3dbag", []),
    "town": ("town", []),
    "town second renderer": ("town", ["render.backend=pyrender"]),
    "town 1280 px": ("one", HD),
    "town random weather": ("town", ["render.look={}", "render.weather_mode=random_per_path"]),
    "town fog at night": ("town", [*SMALL, *weather("dense_fog", "night")]),
    "town cubic perturbation": ("town",
        [*FAR, "render.perturbation.sampling=cubic", "render.perturbation.position_probability=1"]),
    "town colours alone": ("town", ["release.modalities=[rgb]"]),
    "town few frames": ("town", ["release.num_frames=12"]),
    "town slots of a teacher": ("town", [TEACHER, "caption.writing=slots"]),
    "town prose": ("town", [TEACHER, "caption.writing=prose"]),
    "uneven town": ("uneven", []),
    "river narrow": ("river", NARROW),
    "towers haze": ("towers", weather("smog", "morning")),
    "park of styles": ("park_styles", []),
    "crowd": ("crowd", []),
    "single flight": ("one", ["render.tracks=[clean]", "release.tracks=[clean]"]),
    "CARLA": ("carla", CARLA),
    "CARLA zoom": ("carla", [*CARLA, *ZOOM]),
    "UnrealCV": ("unrealcv", UNREALCV),
}  # fmt: skip


def work(stages: list[pipeline.Stage]) -> None:
    with working_here():
        for stage in stages:
            stage.work()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Iterator[Callable[[str], Path]]:
    """Return a function that makes the release of a kind once."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real maps are not here: {SHARED_DATA}")
    town, root = synthetic.load(synthetic.SyntheticConfig(), 0), tmp_path_factory.mktemp("honest")
    town = replace(town, centers=town.centers + np.array([4000.137, -3000.291, 0.0]))
    names = {"DATA": str(SHARED_DATA)}

    def settings(map_name: str, told: list[str]) -> RunConfig:
        config, own = MAPS[map_name]
        texts = [*SHORT, *own, *told]
        for name, value in names.items():
            texts = [text.replace(name, value) for text in texts]
        return load(RunConfig, None if config is None else CONFIGS / f"{config}.yaml", texts)

    @cache
    def make(kind: str) -> Path:
        map_name, told = KINDS[kind]
        shared, out = root / f"map_{map_name}", root / kind.replace(" ", "_")
        if not shared.exists():
            work(pipeline.stages(settings(map_name, []), shared)[: len(SHARED_STAGES)])
        for name in SHARED_STAGES:
            shutil.copytree(shared / name, out / name, copy_function=os.link)
        work(pipeline.stages(settings(map_name, told), out))
        return out / "release/dataset"

    with (
        TeacherServer() as teacher,
        serving(town, root / "carla") as carla,
        serving(town, root / "unrealcv", protocol="unrealcv") as unrealcv,
    ):
        names |= {"CARLA_PORT": str(carla), "UNREALCV_PORT": str(unrealcv), "TEACHER": teacher.url}
        yield make


@pytest.mark.parametrize("kind", KINDS)
def test_an_honest_release_verifies(made, kind):
    report = verify(made(kind), reader=read_released)
    assert report.is_ok, str(report)


def labels_mirrored(rows: list[Row]) -> None:
    """Left for right in decisions, labels and texts of every caption, so that all of a row agrees."""
    for row in captioned(rows):
        for name in ("decision", "label", "caption_en_flight_decision", "caption_zh_flight_decision"):
            row[name] = re.sub("left|right", lambda side: "right" if side[0] == "left" else "left", row[name])


SEALED = {
    "depth 2 % farther": change(everything, with_depth(lambda depth, _: depth * 1.02)),
    "depth 0.3 m farther": LIES["depth_set_off"][0], "a box moved": box_moved,
    "ids exchanged": ids_of_things_exchanged, "labels mirrored": labels_mirrored,
}  # fmt: skip


def test_sealed_lies_about_real_maps_are_found(made, tmp_path):
    """The lies of release_lies.py are about a synthetic town; these are about cities, and of depths that are wrong
    everywhere by little."""
    missed = [
        f"{kind}: {name}"
        for kind in ("simworld 160 px", "delft 160 px", "town", "CARLA", "UnrealCV")
        for name, lie in SEALED.items()
        if not errors_in(forge(made(kind), tmp_path / "forged", lie))
    ]
    assert missed == []
