"""What a camera shows: zoom, weather and time of day, a target that can be made out."""

import hashlib
import json
import random

import numpy as np
import pytest
from test_renderers_contract import WALKER, circling, opened, pose_towards, street, write_inputs

from cosfly.formats.frames import (
    LEGIBLE_CONTRAST,
    TargetMeta,
    frame_name,
    read_depth,
    read_instance,
    read_meta,
    read_rgb,
)
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.formats.weather import TIMES, WEATHERS, WeatherParams, resolved
from cosfly.geometry.axes import intrinsic_matrix
from cosfly.pipeline.runs import caveats
from cosfly.pipeline.settings import RunConfig
from cosfly.render.camera import ZoomConfig, legibility, zoomed_deg
from cosfly.render.contract import PERSON_ID
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.render.weather import path_seed, read_pools, weather_of
from cosfly.runtime.config import build
from cosfly.runtime.errors import ConfigError
from cosfly.runtime.json_io import read_json
from release.columns import INTRINSICS, Placement, matrices_of, scalar_row
from specimens import change_json, make_playback_tree

LEVELS = (110.0, 90.0, 60.0, 30.0)
SMALL = {"width_px": 160, "height_px": 90, "town": "Street", "first_timestamp": 1776000000}


def test_a_flight_goes_from_level_to_level():
    zoom = ZoomConfig(mode="dynamic", part_s=10.0, ramp_s=2.0)
    fovs = zoomed_deg(110.0, LEVELS, zoom, np.arange(60) * 0.5, (), np.random.default_rng(0))
    assert np.allclose(fovs[:21], 110.0)
    for begin in (24, 44):
        held = fovs[begin : begin + 16]
        assert np.allclose(held, held[0])
        assert round(held[0], 6) in LEVELS
    assert fovs[20] != pytest.approx(fovs[24])
    assert fovs[24] != pytest.approx(fovs[44])
    focal = 1.0 / np.tan(np.radians(fovs) / 2.0)
    assert focal[22] == pytest.approx(np.sqrt(focal[20] * focal[24])), "halfway the picture is halfway larger"


def test_every_frame_tells_the_camera_it_was_drawn_with(tmp_path):
    cfg = RenderConfig.model_validate({**SMALL, "zoom": {"mode": "dynamic", "part_s": 2.0, "ramp_s": 1.0}})
    tree = run(cfg, *write_inputs(tmp_path / "inputs", [circling(16)]), tmp_path / "render", seed=2)
    flights = [read_track(folder) for folder in find_tracks(tree)]
    clean, shaken = flights
    np.testing.assert_array_equal(clean.intrinsics, shaken.intrinsics)
    assert len(np.unique(clean.intrinsics[:, 0, 0])) > 4
    for flight in flights:
        for i in range(len(flight)):
            meta = read_meta(flight.frame_folder(i)).camera
            camera = flight.camera_at(i)
            assert meta.intrinsic == camera.intrinsic.tolist()
            assert meta.fov_deg == pytest.approx(camera.fov_deg, abs=1e-6)
            assert meta.focal_length_35mm_mm == pytest.approx(camera.focal_35mm_mm, abs=1e-6)
    row = scalar_row(clean, 7, None, Placement("", "walk", "train"))
    released = matrices_of(np.array([row["intrinsics"][name] for name in INTRINSICS])[None])
    np.testing.assert_array_equal(released[0], clean.intrinsics[7])
    assert row["fov_deg"] == pytest.approx(clean.camera_at(7).fov_deg, abs=1e-6)
    points = clean.folder / "trajectory.json"
    change_json(points, lambda raw: raw["points"][3]["camera"].update(intrinsic=[[0, 0, 0]] * 3))
    assert any("points[3].camera.intrinsic" in str(issue) for issue in read_track(clean.folder).issues)
    one_camera, _ = find_tracks(make_playback_tree(tmp_path / "plain", 1, 4, with_images=False))
    assert all("camera" not in point for point in read_json(one_camera / "trajectory.json")["points"])
    assert read_track(one_camera).intrinsics is None


SIZE = (320, 180)
RANDOM = {"weather_mode": "random_per_path"}


def config(**settings) -> RenderConfig:
    return build(RenderConfig, settings, "test")


def test_the_presets_are_those_of_the_paper():
    assert len(WEATHERS) * len(TIMES) == 60
    knobs = {name: tuple(preset.model_dump().values()) for name, preset in WEATHERS.items()}
    assert (knobs["heavy_rain"], knobs["dust_haze"]) == ((95, 90, 25, 20), (70, 0, 70, 12))
    assert sum(map(sum, knobs.values())) == 530 + 685 + 370 + 437  # of the table's four columns
    times = {name: tuple(time.model_dump().values()) for name, time in TIMES.items()}
    assert times == {"morning": (15, 90), "noon": (75, 180), "dusk": (0, 270), "night": (-30, 0)}


def test_a_draw_is_that_of_the_formula_and_uniform():
    for seed, index, wanted in ((0, 0, 11), (1, 0, 1_000_014), (20260423, 7, 20260483836713)):
        assert path_seed(seed, index) == wanted == seed * 1_000_003 + index * 7_919 + 11
    cfg = config(**RANDOM)
    pools = read_pools(cfg)
    drawn = [weather_of(cfg, pools, index) for index in range(3000)]
    assert drawn == [weather_of(cfg, pools, index) for index in range(3000)]
    rng = random.Random(20260423 * 1_000_003 + 5 * 7_919 + 11)
    wanted = list(WEATHERS)[int(rng.random() * 15)], list(TIMES)[int(rng.random() * 4)]
    assert (drawn[5].weather_name, drawn[5].tod_name) == wanted
    counts = {name: sum(one.weather_name == name for one in drawn) for name in WEATHERS}
    assert 130 < min(counts.values()) <= max(counts.values()) < 280, "200 each, give or take five deviations"
    assert len({(one.weather_name, one.tod_name) for one in drawn}) == 60
    assert weather_of(config(**RANDOM, weather_seed=1), pools, 5) != drawn[5]


def test_off_is_the_default_and_leaves_no_trace():
    cfg = config()
    assert weather_of(cfg, read_pools(cfg), 0) is None
    assert not {name for name in cfg.recorded() if "weather" in name or "tod" in name}
    assert config(weather_mode=False) == cfg, "YAML reads off as false"
    assert config(weather_mode="random-per-path") == config(**RANDOM)
    assert config(**RANDOM).recorded()["weather_seed"] == 20260423


def test_fixed_takes_the_named_presets():
    params = {
        "cloudiness": 95, "precipitation": 90, "fog_density": 25, "fog_distance": 20, "sun_altitude_angle": -30,
        "sun_azimuth_angle": 0,
    }  # fmt: skip
    wanted = {"mode": "fixed", "weather_name": "heavy_rain", "tod_name": "night", "params": params}
    for name in ("heavy_rain", "heavy rain", "Heavy-Rain"):
        cfg = config(weather_mode="fixed", weather_name=name, tod_name="night")
        assert weather_of(cfg, read_pools(cfg), 3).model_dump() == wanted


def test_a_bad_pool_is_one_error_with_all_its_problems(tmp_path):
    sky, tod = tmp_path / "sky.yaml", tmp_path / "tod.yaml"
    rest = "precipitation: 0, fog_density: 0, fog_distance: 9}"
    many = ["a.cloudiness", "presets.a.precipitation", "finite", "a.fog_density", "a.fog_distance", "4 to fix"]
    outside = "cloudiness: 101, precipitation: .nan, fog_density: -1, fog_distance: 0"
    for text, words in (
        (f"presets: {{a: {{{outside}}}}}", many),
        ("presets: {}", ["presets"]),
        (f"presets: {{a b: &x {{cloudiness: 1, {rest}, a_b: *x}}", ["two presets have the same name"]),
    ):  # fmt: skip
        sky.write_text(text)
        with pytest.raises(ConfigError) as caught:
            read_pools(config(**RANDOM, weather_pool=str(sky)))
        assert [word for word in [*words, "sky.yaml"] if word not in str(caught.value)] == []
    tod.write_text("presets: {late: {sun_altitude_angle: 91, sun_azimuth_angle: 360}}")
    with pytest.raises(ConfigError) as caught:
        read_pools(config(**RANDOM, tod_pool=str(tod)))
    assert all(word in str(caught.value) for word in ("tod.yaml", "sun_altitude_angle", "sun_azimuth_angle"))


def params(weather: str = "clear", time: str = "noon", **knobs: float) -> WeatherParams:
    return resolved(WEATHERS[weather], TIMES[time]).model_copy(update=knobs)


def town():
    """The street of the renderers' tests with lamps along it, a car and a tree."""
    lamps = [("Poles", (x, -5.4, 3.0), (1.2, 0.15, 3.0)) for x in (-20.0, 0.0, 20.0)]
    car, tree = ("Car", (8.0, -3.0, 0.75), (2.2, 0.9, 0.75)), ("Vegetation", (-4.0, -12.0, 3.0), (2.0, 2.0, 3.0))
    return street(more=(*lamps, car, tree))


POSE = pose_towards((-14.0, -16.0, 8.0), (12.0, 2.0, 2.0))


@pytest.fixture(scope="module")
def renderer():
    renderer = opened("gl", town())
    yield renderer
    renderer.close()


def drawn(renderer, knobs: WeatherParams | None, pose: np.ndarray = POSE):
    renderer.prepare(np.array([-60.0, -60.0, 0.0]), np.array([60.0, 60.0, 20.0]), knobs)
    return renderer.render(pose, intrinsic_matrix(*SIZE, 70.0), {PERSON_ID: WALKER})


def labels(frame) -> str:
    return hashlib.sha256(frame.depth.tobytes() + frame.kinds.tobytes() + frame.ids.tobytes()).hexdigest()


@pytest.mark.slow
def test_labels_never_change_and_every_pair_of_presets_is_another_picture(renderer):
    plain = drawn(renderer, None)
    pictures = {}
    for weather in WEATHERS:
        for time in TIMES:
            frame = drawn(renderer, params(weather, time))
            assert labels(frame) == labels(plain), (weather, time)
            pictures[weather, time] = frame.rgb
    assert len({rgb.tobytes() for rgb in pictures.values()}) == 60
    again = drawn(renderer, None)
    np.testing.assert_array_equal(again.rgb, plain.rgb, err_msg="fair weather is what it was before")
    np.testing.assert_array_equal(drawn(renderer, params("heavy_rain", "night")).rgb, pictures["heavy_rain", "night"])


@pytest.mark.slow
def test_records_stand_in_every_file_and_labels_are_those_of_fair_weather(tmp_path):
    """Three flights of both tracks: without weather, and drawn by seed."""
    inputs = write_inputs(tmp_path / "in", [circling(3, f"path_{k:03d}") for k in range(3)])
    off, drawn_tree = (
        run(config(**SMALL, fovs_deg=[60.0], **settings), *inputs, tmp_path / name, seed=5)
        for name, settings in (("off", {}), ("random", RANDOM))
    )
    cfg = config(**RANDOM)
    for folder in find_tracks(off):
        plain, flight = read_track(folder), read_track(drawn_tree / folder.relative_to(off))
        wanted = weather_of(cfg, read_pools(cfg), flight.source["path_index"])
        assert flight.raw["weather"] == wanted.model_dump() == read_json(flight.folder / "trajectory.json")["weather"]
        assert flight.weather_record == wanted
        assert "weather" not in plain.raw
        for i in range(len(flight)):
            frame, before = flight.frame_folder(i), plain.frame_folder(i)
            meta, told = read_meta(frame), read_json(frame / "meta.json")
            assert meta.weather == wanted
            assert meta.look is None
            assert list(told["weather"]) == ["mode", "weather_name", "tod_name", "params"]
            assert "weather" not in read_json(before / "meta.json")
            for name in ("depth_float32.png", "instance.png"):
                assert (frame / name).read_bytes() == (before / name).read_bytes()
            assert (read_rgb(frame) != read_rgb(before)).any()
            assert read_depth(frame).dtype == np.float32
            assert read_instance(frame)[0].shape == (90, 160)
            fair = read_meta(before)
            target = meta.target.model_copy(update={k: getattr(fair.target, k) for k in ("contrast", "legible")})
            fair_again = meta.model_copy(update={"weather": None, "look": fair.look, "target": target})
            assert fair_again.model_dump() == fair.model_dump()


def test_the_towns_of_a_run_have_weather_seeds_of_their_own():
    towns = {"a": {}, "b": {"render": {"weather_seed": 5}}, "c": {}}
    cfg = RunConfig.model_validate({"towns": towns, "render": {"weather_mode": "random_per_path", "weather_seed": 70}})
    assert [cfg.of_town(name).render.weather_seed for name in towns] == [70, 5, 72]
    drawn = cfg.model_copy(update={"render": cfg.render.model_copy(update={"weather_seed": -1})})
    assert drawn.of_town("c").render.weather_seed == -1


def test_a_configuration_in_which_the_target_is_small_is_remarked_on():
    assert caveats(RunConfig()) == []
    [line] = caveats(RunConfig.model_validate({"render": {"width_px": 320, "height_px": 180}}))
    assert "lower than 16 px in pictures (follow " in line
    mostly = {"plan": {"styles": {"follow": 90, "top": 10}}, "render": {"width_px": 640, "height_px": 360}}
    assert caveats(RunConfig.model_validate(mostly)) == []


def test_legible_is_what_the_bounds_say():
    for change, is_legible in [
        ({}, True), ({"visible": False}, False), ({"visibility": 0.2}, False), ({"contrast": 3.0}, False),
        ({"contrast": None}, False), ({"bbox_2d": [0.0, 0.0, 6.0, 15.0]}, False), ({"bbox_2d": None}, False),
    ]:  # fmt: skip
        change = {"visible": True, "visibility": 0.9, "bbox_2d": [0.0, 0.0, 8.0, 20.0], "contrast": 20.0} | change
        target = TargetMeta.model_construct(**change)
        told = legibility(target, change["contrast"])
        assert told["legible"] == is_legible
        assert told["height_px"] == (0.0 if target.bbox_2d is None else target.bbox_2d[3])


def test_legibility_is_of_the_picture_as_written(tmp_path):
    boxes, simplified, traces = write_inputs(tmp_path, [circling(3)])
    size = {"width_px": 320, "height_px": 180, "fovs_deg": [60], "tracks": ["clean"]}
    fog = {"thickest": {"cloudiness": 90.0, "precipitation": 0.0, "fog_density": 100.0, "fog_distance": 1.0}}
    (tmp_path / "fog.yaml").write_text(json.dumps({"presets": fog}))
    dim = {"weather_mode": "fixed", "weather_name": "thickest", "tod_name": "noon",
           "weather_pool": str(tmp_path / "fog.yaml")}  # fmt: skip
    found = {}
    for name, more in (("plain", {}), ("fog", dim)):
        tree = run(build(RenderConfig, size | more, "test"), boxes, simplified, traces, tmp_path / name)
        (folder,) = find_tracks(tree)
        flight = read_track(folder)
        found[name] = flight.legibility_at(1)
        told = read_meta(folder / frame_name(1)).target
        assert found[name] == told.model_dump(include=set(found[name]))
        assert flight.target.visible.all()
    assert found["plain"]["legible"] is True
    assert found["fog"]["legible"] is False
    assert float(found["fog"]["contrast"]) < LEGIBLE_CONTRAST
