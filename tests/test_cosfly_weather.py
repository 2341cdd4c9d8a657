"""Weather and time of day: presets, modes, seeds, pools, records, coverage; a picture changes, its labels never."""

from __future__ import annotations

import hashlib
import random
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_cosfly_render import needs_gl
from test_renderers_contract import HIP, circling, opened, pose_towards, street, write_inputs
from typer.testing import CliRunner

from cosfly.app.settings import RunConfig
from cosfly.cli import app
from cosfly.errors import ConfigError, InputError, RenderError
from cosfly.geometry import intrinsic_matrix, rotation_matrices
from cosfly.look.coverage_page import coverage_html
from cosfly.products.boxes import MapHeader, make_box_map
from cosfly.products.coverage import Coverage, coverage_of
from cosfly.products.flights import find_flights
from cosfly.products.frames import read_depth, read_instance, read_meta, read_rgb
from cosfly.products.kinds import KINDS
from cosfly.products.playback import read_flight, write_flight
from cosfly.products.walks import walk_id
from cosfly.products.weather import TIMES, WEATHER_GROUPS, WEATHERS, WeatherParams, resolved, sky_kind
from cosfly.reading.documents import read_json
from cosfly.render.contract import PosedPerson
from cosfly.render.gl.lamps import APART_M, HIGH_M, lamps_along_streets
from cosfly.render.gl.weather_pass import light_direction, lights_on
from cosfly.render.person import choose_clothes
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, run
from cosfly.render.weather import coverage_of as weather_coverage
from cosfly.render.weather import fog_extinction, fog_hides, path_seed, read_pools, weather_of
from cosfly.studies.weather import run as draw_gallery
from cosfly.work.config import build, load, shipped

SIZE = (320, 180)
RANDOM = {"weather_mode": "random_per_path"}
SMALL = {"width_px": 160, "height_px": 90, "fovs_deg": [60.0], "town": "Street", "first_timestamp": 1776000000}


def config(**settings) -> RenderConfig:
    return build(RenderConfig, settings, "test")


# --- presets, modes, seeds --------------------------------------------------------------------------------------------


def test_the_presets_are_those_of_the_paper():
    assert [len(group) for group in WEATHER_GROUPS.values()] == [5, 4, 3, 3]
    assert len(WEATHERS) * len(TIMES) == 60
    knobs = {name: tuple(preset.model_dump().values()) for name, preset in WEATHERS.items()}
    assert knobs["heavy_rain"] == (95, 90, 25, 20)
    assert knobs["dust_haze"] == (70, 0, 70, 12)
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


def test_drawn_by_weight_skies_have_their_shares_in_each_town_and_in_all():
    """Of ten flights a town of `diverse`, on ten seeds; a flight's sky is the same however many follow it."""
    cfg = load(RunConfig, shipped("diverse.yaml"))
    towns = [cfg.of_town(name).render for name in cfg.towns]
    assert {town.weather_mode for town in towns} == {"by_weight"}
    assert len({town.weather_seed for town in towns}) == 8
    assert towns[0].sky_shares["day_dry"] == 0.7 * sum(towns[0].sky_shares.values())
    for seed in range(10):
        total = Counter()
        for town in towns:
            chosen = town.model_copy(update={"weather_seed": town.weather_seed + 1000 * seed})
            skies = [weather_of(chosen, read_pools(chosen), k) for k in range(10)]
            kinds = Counter(sky_kind(sky.params) for sky in skies)
            assert 5 <= kinds["day_dry"] <= 9, "seven of ten, give or take two"
            total += kinds
        assert 0.65 <= total["day_dry"] / 80 <= 0.75
        assert set(total) >= {kind for kind, share in towns[0].sky_shares.items() if share > 5}, "each occurs"


def test_skies_by_weight_take_presets_of_ones_own_by_their_knobs(tmp_path):
    (tmp_path / "sky.yaml").write_text(POOL)
    own = {"weather_mode": "by_weight", "weather_pool": str(tmp_path / "sky.yaml")}
    with pytest.raises(ConfigError, match=r"no presets of a kind of sky.*day_dry, day_fog, dusk_dry, night_dry"):
        read_pools(config(**own))
    cfg = config(**own, sky_shares={"night_rain": 1, "day_rain": 3})
    skies = [weather_of(cfg, read_pools(cfg), k) for k in range(40)]
    assert {sky.weather_name for sky in skies} == {"sleet"}
    assert {sky.mode for sky in skies} == {"by_weight"}
    assert sum(sky.tod_name == "night" for sky in skies) == pytest.approx(10, abs=2)
    told = weather_coverage(cfg, [(sky.weather_name, sky.tod_name) for sky in skies])
    assert told["kinds"]["day_rain"] == sum(sky.tod_name != "night" for sky in skies) - told["kinds"]["dusk_rain"]
    assert told["expected"] == {"kinds": {"night_rain": 10, "day_rain": 30}}
    assert "sky_shares" in cfg.recorded()
    assert "sky_shares" not in config(**RANDOM).recorded()
    for wrong, words in (({"sky_shares": {"day_dry": 0}}, "more than 0"), ({"sky_shares": {"day_dry": -1}}, "greater"),
                         ({"sky_shares": {"day_snow": 1}}, "day_snow"), ({**RANDOM, "sky_shares": {"day_dry": 1}}, "by_weight, and the mode is")):  # fmt: skip
        with pytest.raises(ConfigError, match=words):
            config(**({"weather_mode": "by_weight"} | wrong))


def test_off_is_the_default_and_leaves_no_trace():
    cfg = config()
    assert weather_of(cfg, read_pools(cfg), 0) is None
    assert not {name for name in cfg.recorded() if "weather" in name or "tod" in name}
    assert config(weather_mode=False) == cfg, "YAML reads off as false"
    assert config(weather_mode="random-per-path") == config(**RANDOM)
    assert config(**RANDOM).recorded()["weather_seed"] == 20260423


def test_fixed_takes_the_named_presets():
    params = {
        "cloudiness": 95,
        "precipitation": 90,
        "fog_density": 25,
        "fog_distance": 20,
        "sun_altitude_angle": -30,
        "sun_azimuth_angle": 0,
    }
    wanted = {"mode": "fixed", "weather_name": "heavy_rain", "tod_name": "night", "params": params}
    for name in ("heavy_rain", "heavy rain", "Heavy-Rain"):
        cfg = config(weather_mode="fixed", weather_name=name, tod_name="night")
        assert weather_of(cfg, read_pools(cfg), 3).model_dump() == wanted


def test_settings_that_cannot_be_are_one_error():
    near = ["did you mean 'heavy_rain'", "did you mean 'morning'"]
    for settings, words in (
        ({"weather_mode": "fixed"}, ["weather_name is needed", "tod_name is needed"]),
        ({"weather_name": "mist"}, ["weather_name is for weather_mode fixed"]),
        ({"weather_mode": "fixed", "weather_name": "hevy_rain", "tod_name": "mornin"}, near),
        ({"weather_mode": "sometimes"}, ["random_per_path"]),
        ({**RANDOM, "backend": "pyrender"}, ["draws no weather"]),
        ({**RANDOM, "look": {"exposure": 1.0}}, ["look is for flights without weather"]),
        ({"weather_pool": "sky.yaml"}, ["weather_pool is given, and weather_mode is off"]),
    ):
        with pytest.raises(ConfigError) as caught:
            config(**settings)
        assert all(word in str(caught.value) for word in words)


POOL = "presets:\n  sleet: {cloudiness: 90, precipitation: 40, fog_density: 20, fog_distance: 25}\n"


def test_presets_of_ones_own(tmp_path):
    (tmp_path / "sky.yaml").write_text(POOL)
    (tmp_path / "tod.yaml").write_text("presets:\n  late: {sun_altitude_angle: 5, sun_azimuth_angle: 250.5}\n")
    files = {"weather_pool": str(tmp_path / "sky.yaml"), "tod_pool": str(tmp_path / "tod.yaml")}
    cfg = config(**RANDOM, **files)
    record = weather_of(cfg, read_pools(cfg), 0)
    assert (record.weather_name, record.tod_name, record.params.sun_azimuth_angle) == ("sleet", "late", 250.5)
    assert "weather_pool" not in cfg.recorded(), "its content is an input of the stage, its place is of this machine"
    with pytest.raises(ConfigError, match="did you mean 'sleet'"):
        read_pools(config(weather_mode="fixed", weather_name="sleat", tod_name="late", **files))


def test_pools_that_cannot_be_are_one_error_with_all_problems(tmp_path):
    sky, tod = tmp_path / "sky.yaml", tmp_path / "tod.yaml"
    rest = "precipitation: 0, fog_density: 0, fog_distance: 9}"
    many = ["a.cloudiness", "presets.a.precipitation", "finite", "a.fog_density", "a.fog_distance", "4 to mend"]
    outside = "cloudiness: 101, precipitation: .nan, fog_density: -1, fog_distance: 0"
    for text, words in (
        ("presets: {a: {cloudiness: 1, fog_density: 5, fog_distance: 9}}", ["presets.a.precipitation", "required"]),
        (f"presets: {{a: {{{outside}}}}}", many),
        (f"presets: {{a: {{cloudyness: 1, {rest}}}", ["did you mean 'cloudiness'"]),
        (f"presets: {{a: {{cloudiness: on, {rest}}}", ["presets.a.cloudiness"]),
        ("presets: {}", ["presets"]),
        ("{}", ["presets"]),
        ("presets: [1]", ["presets"]),
        (f"presets: {{a b: &x {{cloudiness: 1, {rest}, a_b: *x}}", ["two presets have one name"]),
        ("!!python/object:os.system {}", ["tag"]),
    ):
        sky.write_text(text)
        with pytest.raises(ConfigError) as caught:
            read_pools(config(**RANDOM, weather_pool=str(sky)))
        assert [word for word in [*words, "sky.yaml"] if word not in str(caught.value)] == []
    tod.write_text("presets: {late: {sun_altitude_angle: 91, sun_azimuth_angle: 360}}")
    with pytest.raises(ConfigError) as caught:  # problems of both pools together
        read_pools(config(**RANDOM, weather_pool=str(tmp_path / "none.yaml"), tod_pool=str(tod)))
    assert all(word in str(caught.value) for word in ("none.yaml", "sun_altitude_angle", "sun_azimuth_angle"))


# --- light and fog in numbers -----------------------------------------------------------------------------------------


def params(weather: str = "clear", time: str = "noon", **knobs: float) -> WeatherParams:
    return resolved(WEATHERS[weather], TIMES[time]).model_copy(update=knobs)


def test_the_sun_stands_where_its_knobs_say():
    np.testing.assert_allclose(
        light_direction(params(time="morning")), [np.cos(np.radians(15)), 0, np.sin(np.radians(15))], atol=1e-12
    )
    np.testing.assert_allclose(light_direction(params())[:2] / np.cos(np.radians(75)), [0, -1], atol=1e-12)
    assert light_direction(params(time="dusk"))[0] < -0.99
    assert light_direction(params(time="night"))[2] > 0.5, "the moon"
    assert [lights_on(params(time=time)) > 0.5 for time in TIMES] == [False, False, True, True], "lamps in the dark"


@given(st.floats(0, 100), st.floats(0, 100), st.floats(0, 100))
def test_more_fog_and_more_rain_hide_more(low, high, rain):
    low, high = sorted((low, high))
    assert fog_extinction(params(fog_density=low, precipitation=rain)) <= fog_extinction(
        params(fog_density=high, precipitation=rain)
    )
    assert fog_extinction(params(precipitation=low)) <= fog_extinction(params(precipitation=high))


# --- pictures ---------------------------------------------------------------------------------------------------------


def town():
    """The street of the renderers' tests with lamps along it, a car and a tree."""
    plain = street()
    rows = [("Poles", (x, -5.4, 3.0), (1.2, 0.15, 3.0)) for x in (-20.0, 0.0, 20.0)]
    rows += [("Car", (8.0, -3.0, 0.75), (2.2, 0.9, 0.75)), ("Vegetation", (-4.0, -12.0, 3.0), (2.0, 2.0, 3.0))]
    centers, halves = ([row[k] for row in rows] for k in (1, 2))
    return make_box_map(
        np.vstack([plain.centers, centers]), np.vstack([plain.half_extents, halves]),
        np.vstack([plain.rotations_deg, np.zeros((len(rows), 3))]), [*plain.kinds, *(KINDS[row[0]] for row in rows)],
        [*plain.ids, *range(20, 20 + len(rows))], MapHeader(name="street", ground_z_m=0.0),
    )  # fmt: skip


POSE = pose_towards((-14.0, -16.0, 8.0), (12.0, 2.0, 2.0))
WALKER = PosedPerson(HIP, 0.7, 1.2, 1.0, choose_clothes(np.random.default_rng(3)))


@pytest.fixture(scope="module")
def renderer():
    opened("gl", street()).close()  # skips where it cannot run
    renderer = open_renderer("gl", town(), *SIZE)
    yield renderer
    renderer.close()


def drawn(renderer, knobs: WeatherParams | None, pose: np.ndarray = POSE):
    renderer.prepare(np.array([-60.0, -60.0, 0.0]), np.array([60.0, 60.0, 20.0]), knobs)
    return renderer.render(pose, intrinsic_matrix(*SIZE, 70.0), WALKER)


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


def brightness(rgb: np.ndarray, where: np.ndarray) -> float:
    return float(rgb[where].mean())


def test_each_knob_is_seen(renderer):
    clear = drawn(renderer, params())
    sky, road = clear.kinds == KINDS["Sky"], clear.kinds == KINDS["Roads"]
    assert sky.sum() > 500
    assert road.sum() > 2000

    def blue_of_the_sky(frame) -> float:
        return float((frame.rgb[sky][:, 2].astype(float) - frame.rgb[sky][:, 0]).mean())

    assert blue_of_the_sky(clear) > blue_of_the_sky(drawn(renderer, params("overcast"))) + 10.0
    # Fog hides what is far and leaves what is near: contrast with the fog's own colour falls with the true depth.
    bare, thick = drawn(renderer, params("overcast")), drawn(renderer, params("dense_fog"))
    houses = bare.kinds == KINDS["Buildings"]
    near, far = (bare.depth < 18.0), houses & (bare.depth > 35.0)
    assert min(near.sum(), far.sum()) > 50
    kept = [thick.rgb[where].std() / bare.rgb[where].std() for where in (far, near)]
    assert kept[0] < 0.35 < kept[1], kept
    night = drawn(renderer, params(time="night"))
    assert brightness(night.rgb, sky) < 0.3 * brightness(clear.rgb, sky)
    assert night.rgb[houses].max() > 200, "a window is lit"
    assert clear.rgb[sky].mean() > 100
    dusk = drawn(renderer, params(time="dusk"), pose_towards((20.0, -5.0, 8.0), (-20.0, 0.0, 5.0)))
    west = dusk.rgb[dusk.kinds == KINDS["Sky"]].astype(float).mean(axis=0)
    assert west[0] > west[2], "warm where the sun goes down"


def test_a_map_without_lamps_is_lit_along_its_streets_and_only_when_it_is_dark(renderer, monkeypatch):
    assert len(renderer.scene.lamps) == 0, "it has lamps of its own"
    frames = {}
    for name in ("lit", "dark"):
        if name == "dark":
            monkeypatch.setattr("cosfly.render.gl.scene.lamps_along_streets", lambda box_map: np.zeros((0, 3)))
        plain = opened("gl", street())
        frames[name] = {time: drawn(plain, params(time=time)) for time in ("noon", "night")}
        plain.close()
    lit, dark = frames["lit"], frames["dark"]
    road = dark["night"].kinds == KINDS["Roads"]
    assert brightness(lit["night"].rgb, road) > 2.0 * brightness(dark["night"].rgb, road)
    assert len({labels(frame) for pair in (lit, dark) for frame in pair.values()}) == 1
    np.testing.assert_array_equal(lit["noon"].rgb, dark["noon"].rgb)


def test_lamps_stand_by_turns_along_streets_and_not_in_each_other():
    yaw = 30.0
    turn = rotation_matrices(np.radians([[0.0, yaw, 0.0]]))[0]
    rows = [
        ("Roads", (100.0, 5.0, -0.15), (40.0, 4.0, 0.15)),
        ("Roads", (100.0, 5.0, -0.15), (4.0, 39.0, 0.15)),
        ("Buildings", (0, 0, 5), (5, 5, 5)),
    ]
    centers, halves = (np.array([row[k] for row in rows], dtype=float) for k in (1, 2))
    crossing = make_box_map(
        centers,
        halves,
        np.array([[0.0, yaw, 0.0]] * 3),
        [KINDS[row[0]] for row in rows],
        [1, 2, 3],
        MapHeader(name="x", ground_z_m=0.0),
    )
    lamps = lamps_along_streets(crossing)
    local = (lamps - centers[0]) @ turn
    first = local[:5]  # of the larger road: every 16 m, by turns 0.5 m from either edge
    np.testing.assert_allclose(first[:, 0], [-32, -16, 0, 16, 32], atol=1e-9)
    np.testing.assert_allclose(first[:, 1], [-3.5, 3.5, -3.5, 3.5, -3.5], atol=1e-9)
    np.testing.assert_allclose(lamps[:, 2], HIGH_M)
    apart = np.linalg.norm(lamps[:, None, :2] - lamps[None, :, :2], axis=2) + 1e9 * np.eye(len(lamps))
    assert apart.min() >= APART_M
    assert 5 < len(lamps) < 10, "those of the other road, less that of the crossing"
    assert lamps_along_streets(crossing.select(np.array([2]))).shape == (0, 3)


def test_rain_falls_and_wets_the_road(renderer):
    dry = params("overcast", fog_density=0, precipitation=0)
    wet = dry.model_copy(update={"precipitation": 90.0})
    before, after = drawn(renderer, dry), drawn(renderer, wet)
    sky = before.kinds == KINDS["Sky"]
    assert after.rgb[sky].astype(float).std() > before.rgb[sky].astype(float).std(), "streaks"
    above = pose_towards((0.0, -1.0, 12.0), (0.0, 0.0, 0.0))
    road = [drawn(renderer, knobs, above) for knobs in (dry, wet)]
    where = road[0].kinds == KINDS["Roads"]
    assert np.median(road[1].rgb[where]) < 0.85 * np.median(road[0].rgb[where]), "darker from above"
    moved = drawn(renderer, wet, pose_towards((-14.0, -16.0, 8.01), (12.0, 2.0, 2.0)))
    assert (moved.rgb[:20] != after.rgb[:20]).any(), "drops fall anew in another frame"


def test_clouds_take_the_shadows(renderer):
    above = pose_towards((0.0, 2.0, 40.0), (0.0, 3.0, 0.0))
    flat = drawn(renderer, params("overcast", "morning", cloudiness=100.0), above)
    ground = np.isin(flat.kinds, [KINDS["Roads"], KINDS["Sidewalks"]])
    spread = []
    for weather in ("clear", "partly_cloudy", "cloudy", "overcast"):
        light = drawn(renderer, params(weather, "morning"), above).rgb[ground].mean(axis=1) / flat.rgb[ground].mean(
            axis=1
        )
        spread.append(np.ptp(np.quantile(light, [0.02, 0.98])) / np.median(light))
    assert spread == sorted(spread, reverse=True), spread
    assert spread[0] > 0.3 > 0.05 > spread[-1], spread


def test_the_second_renderer_refuses_weather():
    renderer = opened("pyrender", street())
    with pytest.raises(RenderError, match="draws no weather"):
        renderer.prepare(np.zeros(3), np.ones(3), params())
    renderer.close()


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trees(tmp_path_factory):
    """Three flights of both tracks: without weather, and drawn by seed; and the folder of their inputs."""
    if needs_gl.args[0]:
        pytest.skip(needs_gl.kwargs["reason"])
    folder = tmp_path_factory.mktemp("weather")
    inputs = write_inputs(folder / "in", [circling(3, f"path_{k:03d}") for k in range(3)])
    return [
        run(config(**SMALL, **settings), *inputs, folder / name, seed=5)
        for name, settings in (("off", {}), ("random", RANDOM))
    ], inputs


def test_records_stand_in_every_file_and_labels_are_those_of_fair_weather(trees):
    (off, drawn_tree), _ = trees
    cfg = config(**RANDOM)
    for folder in find_flights(off):
        plain, flight = read_flight(folder), read_flight(drawn_tree / folder.relative_to(off))
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
            assert meta.model_copy(update={"weather": None, "look": fair.look, "target": target}) == fair


def test_a_run_tells_its_coverage(trees):
    (off, tree), _ = trees
    told = read_json(tree / "manifest.json")["weather"]
    assert told["trajectories"] == 3 == sum(told["weathers"].values()) == sum(told["times"].values())
    assert sum(count for _, _, count in told["pairs"]) == 3
    assert told["expected"] == {"weathers": 0.2, "times": 0.75}
    assert "weather" not in read_json(off / "manifest.json")
    parts = [coverage_of(read_flight(folder)) for folder in find_flights(tree)]
    total = Coverage.total(parts)
    assert sum(total.skies.values()) == sum(total.weathers.values()) == total.frames == 18
    page = coverage_html(total)
    assert "frames by weather and time of day" in page
    assert all(name.replace("_", " ") in page for name in WEATHERS)
    assert "by weather" not in coverage_html(coverage_of(read_flight(find_flights(off)[0])))


def test_a_negative_seed_draws_one_and_a_resumed_run_keeps_it(trees, tmp_path):
    _, inputs = trees
    cfg = config(**SMALL, **RANDOM, weather_seed=-1, tracks=["clean"])
    tree = run(cfg, *inputs, tmp_path / "tree", seed=5)
    seeds = {flight["weather_seed"] for flight in read_json(tree / "manifest.json")["flights"]}
    assert len(seeds) == 1
    assert min(seeds) >= 0
    (tree / "manifest.json").unlink()
    lines = (tree / "items.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) == 3
    (tree / "items.jsonl").write_text("".join(lines[:-1]))
    run(cfg, *inputs, tmp_path / "tree", seed=5)
    again = read_json(tree / "manifest.json")["flights"]
    assert len(again) == 3
    assert {flight["weather_seed"] for flight in again} == seeds


def test_a_record_that_breaks_the_schema_is_refused_or_noted(trees, tmp_path):
    (_, tree), _ = trees
    whole = read_flight(find_flights(tree)[0]).raw["weather"]
    folder = tmp_path / "Town_Street/trajectory_1776000000/ORI"
    folder.mkdir(parents=True)
    for change, where in (
        ({"mode": "sometimes"}, "weather: mode"),
        ({"weather_name": ""}, "weather: weather_name"),
        ({"params": {}}, "weather: params.cloudiness"),
        ({"params": {**params().model_dump(), "fog_distance": 0}}, "weather: params.fog_distance"),
        ({"params": {**params().model_dump(), "sun_azimuth_angle": 360}}, "weather: params.sun_azimuth_angle"),
        ({"colour": "red"}, "weather: colour"),
    ):
        flight = read_flight(find_flights(tree)[0])
        flight.raw["weather"] = whole | change
        write_flight(folder, flight)
        with pytest.raises(InputError, match=where.replace(".", r"\.")):
            read_flight(folder)
        noted = read_flight(folder, strict=False)
        assert any(where in issue for issue in noted.issues)
        assert noted.weather_record is None


def test_the_gallery_has_nine_pictures_and_a_sheet_of_all(trees, tmp_path):
    import cv2

    _, inputs = trees
    (tmp_path / "sky.yaml").write_text(POOL)
    cfg = config(**SMALL, **RANDOM, weather_pool=str(tmp_path / "sky.yaml"))
    drawn_pairs = []
    figure, sheet = draw_gallery(cfg, inputs[0], inputs[2], tmp_path / "out", advance=lambda: drawn_pairs.append(1))
    assert len(drawn_pairs) == 4
    assert cv2.imread(str(sheet)).shape == (180 + 26, 4 * 320, 3)
    assert cv2.imread(str(figure)).shape == (2 * (360 + 26), 3 * 640, 3)
    with pytest.raises(InputError, match="no such flight"):
        draw_gallery(cfg, inputs[0], inputs[2], tmp_path / "out", trajectory=3)
    with pytest.raises(InputError, match="no such frame"):
        draw_gallery(cfg, inputs[0], inputs[2], tmp_path / "out", frame=3)


@pytest.mark.parametrize(("kind", "is_dark"), [("Buildings", True), ("Sidewalks", False), ("Poles", False)])
def test_flights_that_nobody_can_see_are_told_before_they_are_drawn(tmp_path, kind, is_dark):
    (tmp_path / "own.csv").write_text(
        f"type,x_m,y_m,length_m,width_m,height_m\nBuildings,0,0,9,9,8\n{kind},20,0,9,9,3\n"
    )
    settings = "{maps: {source: boxes, boxes: {path: own.csv, licence: cc-by-4.0}}, pedestrians: {num_paths: 8},"
    settings += " render: {weather_mode: random_per_path}}"
    (tmp_path / "own.yaml").write_text(settings.replace("own.csv", str(tmp_path / "own.csv")))
    cfg = build(RenderConfig, RANDOM, "test")
    by_night = [k for k in range(8) if weather_of(cfg, read_pools(cfg), k).tod_name == "night"]
    words = f"{len(by_night)} of 8 flights are dark ({', '.join(walk_id(k) for k in by_night[:4])}"
    for command in (["config", "check"], ["run", "--dry-run", "--out", str(tmp_path / "out")]):
        told = CliRunner().invoke(app, [*command, str(tmp_path / "own.yaml")])
        assert told.exit_code == 0, told.output
        assert (words in told.output) == is_dark, told.output


@needs_gl
def test_flights_that_fog_hides_from_end_to_end_are_told_before_they_are_drawn(tmp_path, caplog):
    skies = (config(weather_mode="fixed", weather_name=name, tod_name="noon") for name in ("dense_fog", "thin_fog"))
    dense, thin = (weather_of(one, read_pools(one), 0) for one in skies)
    assert [fog_hides(dense, distance_m) for distance_m in (5.0, 30.0, 40.0)] == [False, False, True]
    assert not fog_hides(thin, 60.0)
    far = circling(2, "path_001")
    far.positions_m[:, 2] += 80.0
    inputs = write_inputs(tmp_path / "inputs", [circling(2), far])
    for name, told in (("dense_fog", "path_001"), ("thin_fog", "")):
        cfg = config(**SMALL, weather_mode="fixed", weather_name=name, tod_name="noon", tracks=["clean"])
        caplog.clear()
        run(cfg, *inputs, tmp_path / name)
        lines = [one.getMessage() for one in caplog.records if "fog hides" in one.getMessage()]
        assert len(lines) == bool(told)
        assert all(told in line and "path_000" not in line for line in lines)
