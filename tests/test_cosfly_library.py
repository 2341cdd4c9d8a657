"""cosfly as a library: the same results as the commands give, and what is wrong said in their words."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tables import each

import cosfly
from cosfly.formats.boxes import BoxMap
from cosfly.formats.traces import DroneTrace, read_traces
from cosfly.maps import stage as maps_stage
from cosfly.maps.stage import MapsConfig
from cosfly.pedestrians import stage as pedestrians_stage
from cosfly.pedestrians.walkable import PedestriansConfig
from cosfly.pipeline import library
from cosfly.planners import stage as plan_stage
from cosfly.planners.contract import PLANNERS, PlanConfig
from cosfly.render.contract import PERSON_ID
from cosfly.render.settings import RenderConfig
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError
from cosfly.simplify import stage as simplify_stage
from cosfly.simplify.passes import SimplifyConfig

NOTEBOOK = Path(__file__).parents[1] / "docs/first_flight.ipynb"
TOWN = {"size_m": 120.0, "num_blocks": 1}
WALK = {"min_distance_m": 15, "max_distance_m": 25}


@pytest.fixture(scope="module")
def town() -> BoxMap:
    return cosfly.load_map(seed=4, **TOWN)


@pytest.fixture(scope="module")
def flight(town) -> DroneTrace:
    return cosfly.plan(town, planner="muco", pedestrian=WALK, seed=4)


def test_a_wrong_name_is_named():
    with pytest.raises(AttributeError, match="no attribute 'load_mop'"):
        cosfly.load_mop  # noqa: B018


def test_a_flight_is_the_one_of_the_stages(town, flight, tmp_path):
    boxes = maps_stage.run(MapsConfig(synthetic=TOWN), tmp_path / "maps", seed=4)  # type: ignore[arg-type]
    simplified = simplify_stage.run(SimplifyConfig(), boxes, tmp_path / "simplify")
    walking = PedestriansConfig.model_validate({"num_paths": 1, **WALK})
    walks = pedestrians_stage.run(walking, simplified, tmp_path / "walks", seed=4)
    (made,) = read_traces(plan_stage.run(PlanConfig(planner="muco"), simplified, walks, tmp_path / "plan", seed=4))
    for name in ("time_s", "positions_m", "targets_m", "rotations_deg"):
        assert_allclose(getattr(flight, name), getattr(made, name), atol=1e-3)
    assert flight.drop_reason == made.drop_reason


def test_a_way_of_ones_own_is_flown(town):
    walk = cosfly.plan(town, planner="muco", pedestrian=WALK, seed=4).targets_m[:, :2]
    own = cosfly.plan(town, walk[::6], planner="muco", altitude_max_m=25)
    assert_allclose(own.targets_m[0, :2], walk[0], atol=1e-3)
    assert own.positions_m[:, 2].max() < 26
    with pytest.raises(InputError, match=r"route_m: the route is invalid; got an array of shape \(3,\)"):
        cosfly.plan(town, [1, 2, 3])


def test_a_pose_is_drawn_and_its_depth_is_the_distance(town, flight):
    i = len(flight.time_s) // 2
    frames = cosfly.render_frames(
        town, flight.positions_m[i : i + 2], target_m=flight.targets_m[i : i + 2], size_px=(320, 180)
    )
    assert [frame.rgb.shape for frame in frames] == [(180, 320, 3)] * 2
    turned = cosfly.render_frames(
        town, flight.positions_m[i], flight.rotations_deg[i], target_m=flight.targets_m[i], size_px=(320, 180)
    )[0]
    is_town = (turned.ids != PERSON_ID) & (frames[0].ids != PERSON_ID)  # a place alone has no stride
    assert_allclose(turned.depth[is_town], frames[0].depth[is_town], atol=1e-4)  # the flight looks at the target too
    distance_m = np.linalg.norm(flight.targets_m[i] - flight.positions_m[i])
    assert abs(float(np.median(turned.depth[turned.ids == PERSON_ID])) - distance_m) < 0.5
    empty = cosfly.render_frames(town, flight.positions_m[i], flight.rotations_deg[i], size_px=(320, 180))[0]
    assert not (empty.ids == PERSON_ID).any()


def test_what_is_wrong_is_said_as_on_the_command_line(town):
    for call, error, words in (
        (lambda: cosfly.load_map(sise_m=3), ConfigError, "sise_m: unknown setting.*'size_m'"),
        (lambda: cosfly.load_map(source="gta"), ConfigError, "no map source of this name; got gta; expected one of"),
        (lambda: cosfly.load_map(source="carla", port=1), EnvironmentMissing, r"127\.0\.0\.1:1 .*no CARLA server"),
        (lambda: cosfly.load_map("a.json", source="synthetic"), ConfigError, "reads no file"),
        (lambda: cosfly.load_map("nowhere.json"), InputError, r"nowhere\.json"),
        (lambda: cosfly.load_map(**TOWN | {"seed": "x"}), ConfigError, "the seed is invalid; got 'x'"),
        (lambda: cosfly.plan(town, "abc"), InputError, "route_m: the route is invalid"),
        (lambda: cosfly.plan(town, [[0, 0, 0]]), InputError, "route_m: the route is invalid"),
        (lambda: cosfly.plan(town, [[0, "a"], [1, 2]]), InputError, "route_m: the route is invalid"),
        (lambda: cosfly.plan(town, [[0, 0], [9, 9], [9, 9]]), InputError, "route_m: the route is invalid"),
        (lambda: cosfly.plan(town, planer="muco"), ConfigError, "plan: planer: unknown setting"),
        (lambda: cosfly.render_frames(town, [0, 0, 9]), InputError, "the camera has no direction"),
        (
            lambda: cosfly.render_frames(town, [0, 9], [0, 0, 0]),
            InputError,
            "position_m: the array has the wrong shape",
        ),
        (
            lambda: cosfly.load_map("a", source="simworld", world="b"),
            ConfigError,
            "load_map: some settings have no effect here; got world",
        ),
        (
            lambda: cosfly.plan(town, track_astar={"beam": 9}),
            ConfigError,
            "plan: some settings have no effect here; got track_astar",
        ),
    ):
        with pytest.raises(error, match=words):
            call()


WITHOUT_EFFECT = {
    "walk": (PedestriansConfig, library.PEDESTRIAN_SETTINGS, lambda town, /, **more: cosfly.plan(town, pedestrian=more)),
    "walk on a way": (
        PedestriansConfig, library.PACE_SETTINGS,
        lambda town, /, **more: cosfly.plan(town, [[0, 0], [9, 0]], pedestrian=more),
    ),
    "render": (
        RenderConfig, library.PICTURE_SETTINGS,
        lambda town, /, **more: cosfly.render_frames(town, [0, 0, 60], [-30, 0, 0], **more),
    ),
}  # fmt: skip


@each("section", WITHOUT_EFFECT)
def test_a_setting_without_effect_is_refused(town, section):
    model, taken, call = WITHOUT_EFFECT[section]
    others = model.model_fields.keys() - taken
    assert others
    for name in others:
        with pytest.raises(ConfigError, match=f"some settings have no effect here; got {name};"):
            call(town, **{name: dict(model())[name]})


VIEW = {"rotation_deg": [-30, 0, 0], "size_px": (32, 18)}
FIXED = {"weather_mode": "fixed", "weather_name": "clear", "tod_name": "night"}
PATH, HURRY = [[0, 0], [9, 0]], {"pace": {"hurry": 1}}
# Of each section: what takes its settings, and calls that together read all that are taken.
TAKING = {
    "plan": (
        PlanConfig,
        PlanConfig.model_fields.keys(),
        [lambda the_map, n=n: cosfly.plan(the_map, pedestrian=WALK, planner=n, styles={"side": 1}) for n in PLANNERS],
    ),
    "walk": (
        PedestriansConfig,
        library.PEDESTRIAN_SETTINGS,
        [lambda the_map, p=p, **more: cosfly.plan(the_map, pedestrian=WALK | p | more) for p in ({}, HURRY)],
    ),
    "walk on a way": (
        PedestriansConfig,
        library.PACE_SETTINGS,
        [lambda the_map, p=p, **more: cosfly.plan(the_map, PATH, pedestrian=p | more) for p in ({}, HURRY)],
    ),
    "render": (
        RenderConfig,
        library.PICTURE_SETTINGS,
        [
            lambda the_map, **more: cosfly.render_frames(the_map, [0, 0, 60], **VIEW, **more or FIXED),
            lambda the_map: cosfly.render_frames(the_map, [0, 0, 60], **VIEW, weather_mode="random_per_path"),
            lambda the_map: cosfly.render_frames(the_map, [0, 0, 60], **VIEW, weather_mode="by_weight"),
        ],
    ),
}


@pytest.mark.slow
@each("section", TAKING)
def test_no_setting_is_ignored(town, monkeypatch, section):
    (model, taken, calls), read, is_built = TAKING[section], set(), False

    def get(self, name):
        if is_built and name in model.model_fields:
            read.add(name)
        return super(watched, self).__getattribute__(name)

    def build(*given):
        nonlocal is_built
        is_built = False  # validators read them all
        cfg = real_build(*given)
        is_built = True
        return cfg

    watched, real_build = type(model.__name__, (model,), {"__getattribute__": get}), library.build
    with monkeypatch.context() as patch:
        patch.setattr(library, "build", build)
        patch.setattr(library, model.__name__, watched)
        for call in calls:
            call(town)
    assert set(taken) - read == set(), "taken, and never read"


def test_the_notebook_runs_and_its_numbers_fit():
    names: dict = {}
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec("".join(cell["source"]), names)
    assert names["flight"].drop_reason is None
    assert names["plot"].shape[2] == 3
    assert abs(names["depth_m"] - names["distance_m"]) < 0.5
