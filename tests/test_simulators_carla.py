"""Maps and frames of a CARLA server, through the unmodified client, against the embedded renderer's."""

import json
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from commands import obeyed
from simulator_serving import AS_FOUND, as_client, carla_settings, command, free_port, serving
from simulators.carla_server import DEPTH_STEP_M
from simulators.scene import clothes_of
from test_renderers_contract import circling, street, write_inputs

from cosfly.formats.boxes import BoxMap, read_boxes, write_boxes
from cosfly.formats.frames import read_depth, read_instance, read_meta, read_rgb
from cosfly.formats.kinds import KINDS
from cosfly.formats.tracks import find_tracks
from cosfly.formats.weather import WeatherParams
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.maps import carla_export
from cosfly.maps.carla_export import CarlaMapConfig, CarlaTown, box_map_of
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.render.carla_backend import CarlaRenderConfig
from cosfly.render.contract import PERSON_ID, PosedPerson
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, run
from cosfly.runtime.config import build
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, RenderError
from cosfly.simulators.conventions import camera_rotation_deg, unreal_pose, world_pose

pytest.importorskip("carla")


def same_boxes(one: BoxMap, other: BoxMap, atol: float, are_told=lambda box_map: np.full(len(box_map), True)) -> None:
    """In any order: the same ids, each with the same bounds, and the same box where the bounds tell it."""
    assert sorted(one.ids.tolist()) == sorted(other.ids.tolist())
    left, right = (box_map.select(np.argsort(box_map.ids)) for box_map in (one, other))
    np.testing.assert_array_equal(left.kinds, right.kinds)
    told = are_told(right)
    for name in ("mins", "maxs", "centers", "half_extents", "rotations_deg"):
        ours, theirs = (getattr(box_map, name)[... if name in ("mins", "maxs") else told] for box_map in (left, right))
        np.testing.assert_allclose(ours, theirs, atol=atol, err_msg=name)


@pytest.mark.slow
def test_a_served_town_comes_back_as_it_is(tmp_path):
    town = invent(SyntheticConfig(), 3)
    with serving(town, tmp_path / "town") as port:
        words = ["maps", "--source", "carla", "--set", f"maps.carla.port={port}", "--out", str(tmp_path / "out")]
        obeyed(words)
        wrong = CarlaMapConfig(port=port, town="Town99")
        with pytest.raises(
            ConfigError, match=rf"127\.0\.0\.1:{port} \(CARLA 0\.9\.16\).*no town of this name.*Town99.*{town.name}"
        ):
            carla_export.load(wrong, 0)
    exported = read_boxes(tmp_path / "out/boxes_3d.json")
    same_boxes(exported, town, 2e-4)  # over the wire numbers are single precision
    header = exported.header
    assert (header.name, header.source.tool, header.source.version) == (town.name, "CARLA", "0.9.16")
    assert header.num_objects == len(town)
    assert "Train" in header.model_extra["empty_labels"]
    assert header.ground_z_m == pytest.approx(town.header.ground_z_m, abs=0.1)
    counts = json.loads((tmp_path / "out/manifest.json").read_text())["counts_by_kind"]
    assert counts == town.counts()


def test_a_server_that_names_a_file_outside_the_cache_is_refused(tmp_path):
    words = r"names a file outside the client's cache; got \.\./\.\./escaped"
    with serving(street(), tmp_path, "escape@0+") as port, pytest.raises(EnvironmentMissing, match=words):
        carla_export.load(CarlaMapConfig(port=port), 0)


def box(x: float, y: float, half: tuple[float, float, float], yaw: float = 0.0) -> tuple[float, ...]:
    return (x, y, half[2], *half, 0.0, yaw, 0.0)


def told() -> CarlaTown:
    house = box(10.0, 20.0, (4.0, 3.0, 5.0), 30.0)
    rows = [
        ("Roads", 1, "Road", (0.0, 0.0, -0.1, 30.0, 4.0, 0.2, 0.0, 0.0, 0.0)),
        ("Buildings", 2, "House", house),
        ("Buildings", 2, "House", box(10.0, 20.0, (2.0, 2.0, 8.0), 30.0)),  # a building of two boxes, one id
        ("Buildings", 3, "House_again", house),
        ("Vegetation", 4, "All_trees", box(0.0, 0.0, (400.0, 500.0, 9.0))),
        ("Terrain", 5, "Landscape", box(0.0, 0.0, (900.0, 900.0, 60.0))),
        ("Vegetation", 6, "Tree", box(-9.0, 12.0, (2.0, 2.0, 4.0))),
        ("Static", 7, "Nothing", box(3.0, 3.0, (0.0, 0.0, 0.0))),
        ("Poles", 8, "Lost", (float("nan"), *house[1:])),
    ]
    return CarlaTown("Town10HD_Opt", "0.9.16", rows, ["Train", "Bus"])


def test_what_is_odd_is_left_out_counted_and_told(caplog):
    box_map = box_map_of(told(), CarlaMapConfig())
    header = box_map.header
    assert header.dropped_objects == {"duplicate": 1, "huge": 2, "no size": 1, "not finite": 1}
    assert header.num_objects == len(box_map) + sum(header.dropped_objects.values()) == 9
    assert len(set(box_map.ids.tolist())) == len(box_map)
    again = box_map_of(told(), CarlaMapConfig())
    np.testing.assert_array_equal(again.ids, box_map.ids)
    assert box_map.ids[:2].tolist() == [1, 2], "ids of the server stay"
    house = box_map.select(np.array([1]))
    np.testing.assert_allclose(house.centers[0], [10.0, -20.0, 5.0])
    np.testing.assert_allclose(house.rotations_deg[0], [0.0, -30.0, 0.0])
    reach = 4.0 * np.cos(np.radians(30)) + 3.0 * np.sin(np.radians(30))
    assert house.maxs[0, 0] == pytest.approx(10.0 + reach), "corners after the turn"
    assert header.ground_z_m == pytest.approx(0.1), "the road's top"
    assert "huge 2" in caplog.text
    assert header.model_extra == {"empty_labels": ["Train", "Bus"], "repeated_ids": 1}


def test_poses_survive_their_encoding():
    turns = np.random.default_rng(1).uniform([-89, -180, -179], [89, 180, 179], (20, 3))
    for turn in (*turns, [-90.0, 30.0, 0.0], [90.0, -170.0, 0.0]):
        pose = world_from_camera(np.zeros(3), np.array(turn))
        np.testing.assert_allclose(camera_rotation_deg(pose), turn, atol=1e-9)
        position, rotation = world_pose(unreal_pose(np.array([1.0, 2.0, 3.0]), np.array(turn)))
        np.testing.assert_array_equal(np.concatenate([position, rotation]), [1.0, 2.0, 3.0, *turn])


FRAMES = {"width_px": 160, "height_px": 90, "fovs_deg": [60.0], "town": "Street", "first_timestamp": 1776000000}
CLEAN = {**FRAMES, "tracks": ["clean"]}
QUICK = {"timeout_s": 60.0}


def flown(folder: Path, num_flights: int = 1, num_frames: int = 3) -> list[Path]:
    """Inputs of flights at poses that single precision holds."""
    traces = [circling(num_frames, f"path_{k:03d}") for k in range(num_flights)]
    for values in (array for trace in traces for array in (trace.positions_m, trace.rotations_deg)):
        values[:] = np.round(values * 64) / 64
    return write_inputs(folder, traces)


def config(port: int, settings: dict = CLEAN, **own) -> RenderConfig:
    return build(RenderConfig, {**settings, "backend": "carla", "carla": {"port": port, **QUICK, **own}}, "test")


def files_of(tree: Path) -> dict[str, bytes]:
    return {str(p.relative_to(tree)): p.read_bytes() for p in sorted(tree.rglob("frames_playback/**/*")) if p.is_file()}


def pictures_of(tree: Path) -> list[tuple]:
    return [
        (folder.name, frame.name, read_rgb(frame), read_depth(frame), *read_instance(frame), read_meta(frame))
        for folder in find_tracks(tree)
        for frame in sorted((folder / "frames_playback").iterdir())
    ]


def schema_of(value: object) -> object:
    if isinstance(value, dict):
        return {name: schema_of(one) for name, one in value.items()}
    if isinstance(value, list):
        return [schema_of(value[0])] if value else []
    return "number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value).__name__


def same_but_for_pictures(tree: Path, reference: Path) -> Iterable[tuple[tuple, tuple]]:
    """Check folders, files, schemas and poses of a simulator's tree; give the pictures in pairs.

    What a person wears (target.png shows it too) nobody knows of an engine's.
    """
    ours, theirs = (
        {str(p.relative_to(root)) for p in root.rglob("*") if p.name not in ("target.png", "events.jsonl")}
        for root in (tree, reference)
    )
    assert ours == theirs
    for folder in find_tracks(tree):
        ours, theirs = (
            json.loads((root / folder.relative_to(tree) / "trajectory.json").read_text()) for root in (tree, reference)
        )
        assert "people" not in ours, "nobody knows what the server's people wear"
        assert ours.keys() - {"goal"} == theirs.keys() - {"people", "goal"}
        assert ours["camera"] == theirs["camera"]
        for one, other in zip(ours["points"], theirs["points"], strict=True):
            assert schema_of(one).keys() == schema_of(other).keys()
            for name in ("drone_pose", "nav_waypoint", "timing"):
                assert json.dumps(one[name]) == json.dumps(other[name])
            assert json.dumps(one["target"]["world_location"]) == json.dumps(other["target"]["world_location"])
    return zip(pictures_of(tree), pictures_of(reference), strict=True)


@pytest.mark.slow
def test_a_tree_is_the_embedded_renderers_frame_by_frame(tmp_path):
    inputs = flown(tmp_path / "in", 2, 4)
    reference = run(build(RenderConfig, FRAMES, "test"), *inputs, tmp_path / "gl", seed=5)
    with serving(street(), tmp_path / "town") as port:
        tree = run(config(port, FRAMES), *inputs, tmp_path / "carla", seed=5, workers=1)
        assert as_client(carla_settings, port) == AS_FOUND, "the server is left as it was found"
    for ours, theirs in same_but_for_pictures(tree, reference):
        # Half a step of the encoding, and what the device's single precision makes of another origin; light is
        # prepared for the town, not the flight.
        tolerance_m, most_apart = (2.0 * DEPTH_STEP_M, 0) if ours[0] == "ORI" else (2e-3, 8)
        same_but_for_people(ours, theirs, tolerance_m, most_apart, most_levels=5.0)


def same_but_for_people(
    ours: tuple, theirs: tuple, tolerance_m: float | np.ndarray, most_apart: int, most_levels: float, is_far=np.False_
) -> np.ndarray:
    """Compare two frames, what is far away in colour alone; give where nobody is."""
    _, name, rgb, depth, kinds, ids, meta = ours
    _, _, their_rgb, their_depth, their_kinds, their_ids, their_meta = theirs
    rest = (ids != PERSON_ID) & (their_ids != PERSON_ID)
    assert rest.mean() > 0.9
    apart = rest & ~is_far & (np.abs(depth - their_depth) > tolerance_m)
    differs = rest & ~is_far & ((ids != their_ids) | (kinds != their_kinds))
    assert max(apart.sum(), differs.sum()) <= most_apart, name
    assert np.abs(rgb[rest].astype(int) - their_rgb[rest]).mean() < most_levels
    assert ((ids == PERSON_ID) == (kinds == KINDS["Pedestrians"])).all()
    assert meta.target.num_pixels == pytest.approx(their_meta.target.num_pixels, rel=0.5)
    assert meta.target.visibility == pytest.approx(their_meta.target.visibility, abs=0.05)
    assert (meta.drone_pose == their_meta.drone_pose).all()
    return rest


@pytest.mark.slow
def test_a_silent_sensor_fails_the_flight_with_its_name_and_keeps_the_finished_ones(tmp_path):
    inputs = flown(tmp_path / "in", 3, 4)
    with serving(street(), tmp_path / "town", "drop:depth@9+") as port:
        tree = run(config(port, timeout_s=4.5), *inputs, tmp_path / "tree", workers=1)
    failures = [json.loads(line) for line in (tree / "failures.jsonl").read_text().splitlines()]
    assert len(failures) == 2
    for failure in failures:
        assert re.search(rf"CARLA 0\.9\.16 at 127\.0\.0\.1:{port}, street.*camera depth", failure["message"]), failure
    assert len(find_tracks(tree)) == 1


@pytest.mark.slow
def test_a_server_that_we_start_is_started_again(tmp_path):
    inputs = flown(tmp_path / "in", 2, 5)
    write_boxes(tmp_path / "boxes_3d.json", street())
    port = free_port()
    plain = " ".join(command(tmp_path / "boxes_3d.json", 0)).replace(" 0", " {port}")
    start = f"sh -c 'mkdir {tmp_path}/{{port}} 2>/dev/null && exec {plain} die@6; exec {plain}'"
    cfg = config(port, timeout_s=15.0, server_command=start)
    tree = run(cfg, *inputs, tmp_path / "tree", workers=2)
    assert len(find_tracks(tree)) == 2
    assert (tmp_path / str(port)).is_dir()
    assert (tmp_path / str(port + 10)).is_dir(), "ports 10 apart"
    with pytest.raises(EnvironmentMissing, match="no CARLA server"):
        open_renderer(
            "carla", street(), 160, 90, settings=build(CarlaRenderConfig, {"port": port, "timeout_s": 1.0}, "test")
        )


RAINY_NIGHT = WeatherParams(
    cloudiness=90.0, precipitation=60.0, fog_density=35.0, fog_distance=8.0, sun_azimuth_angle=30.0,
    sun_altitude_angle=-40.0,
)  # fmt: skip


def _drawn(port: int) -> tuple:
    """After another client, by CARLA and by the embedded renderer: a walker in step 0, and nobody by day, at a rainy
    night and by day; by CARLA the walker also through a longer lens; the weather that the server was told; places of
    the spectator meanwhile and at the end, and the weather then."""
    import carla

    world = carla.Client("127.0.0.1", port).get_world()
    world.set_weather(carla.WeatherParameters())  # fog from 0 m, and the sun on the horizon
    world.get_spectator().set_transform(carla.Transform(carla.Location(1.0, 2.0, 3.0), carla.Rotation(0.0, 90.0, 0.0)))
    world.wait_for_tick()
    frames, near, told, places = [], None, None, []
    clothes, found = clothes_of("walker.pedestrian.0001"), street()
    pose, lens = world_from_camera(np.array([-1.0, -9.5, 5.5]), np.array([-32.5, 60.0, 0.0])), intrinsic_matrix
    person = PosedPerson(np.array([4.0, -3.0, 0.90625]), 0.0, 0.0, 1.0, clothes)
    for own in ({"settings": build(CarlaRenderConfig, {"port": port, **QUICK}, "test")}, {}):
        renderer = open_renderer("carla" if own else "gl", found, 160, 90, **own)
        frames.append([renderer.render(pose, lens(160, 90, 60.0), {PERSON_ID: person})])
        for weather in (None, RAINY_NIGHT, None):
            renderer.prepare(*found.bounds(), weather)
            frames[-1].append(renderer.render(pose, lens(160, 90, 60.0), {}))
            if own and weather:
                told = world.get_weather()
        if own:
            near = renderer.render(pose, lens(160, 90, 30.0), {PERSON_ID: person})  # other cameras
            with pytest.raises(RenderError, match=r"cannot render with this intrinsic matrix.*square pixels"):
                renderer.render(pose, lens(160, 90, 60.0) + np.eye(3)[0], {})
            places.append(renderer._spectator.get_transform().location)
        renderer.close()
    world.wait_for_tick()
    places.append(world.get_spectator().get_transform().location)
    left = world.get_weather()
    told = {name: getattr(told, name) for name in RAINY_NIGHT.model_dump()}
    return *frames, near, told, [(one.x, one.y, one.z) for one in places], (left.fog_distance, left.sun_altitude_angle)


def test_a_person_zoom_and_weather_are_those_of_the_embedded_renderer_whatever_another_client_left(tmp_path):
    with serving(street(), tmp_path) as port:
        (ours, *pictures), (theirs, *their_pictures), near, told, (camera_m, left_m), weather = as_client(_drawn, port)
        assert as_client(carla_settings, port) == (False, 0, 0.0)
    masks = [frame.ids == PERSON_ID for frame in (ours, theirs)]
    assert masks[0].sum() > 30
    assert np.argwhere(masks[0]).mean(axis=0) == pytest.approx(np.argwhere(masks[1]).mean(axis=0), abs=1.5)
    assert (near.ids == PERSON_ID).sum() > 2.5 * masks[0].sum()
    assert (ours.ids != theirs.ids)[~masks[0] & ~masks[1]].sum() == 0
    assert told == RAINY_NIGHT.model_dump()
    fair, rainy, _ = (one.rgb.astype(float) for one in pictures)
    assert fair.mean() > rainy.mean() + 30.0
    for own, other in zip(pictures, their_pictures, strict=True):
        assert np.abs(own.rgb.astype(float) - other.rgb).mean() < 2.0
    assert camera_m == pytest.approx((-1.0, 9.5, 5.5))
    assert left_m == pytest.approx((1.0, 2.0, 3.0))
    assert weather == (0.0, 0.0)


_WORKER = """
import sys, time, numpy as np, test_simulators_carla as t
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
settings = t.build(t.CarlaRenderConfig, {"port": int(sys.argv[1]), **t.QUICK}, "test")
renderer = t.open_renderer("carla", t.street(), 160, 90, settings=settings)
renderer.prepare(*t.street().bounds(), t.RAINY_NIGHT)
person = t.PosedPerson(np.array([4.0, -3.0, 0.9]), 0.0, 0.0, 1.0, t.clothes_of("walker.pedestrian.0001"))
pose = world_from_camera(np.array([-1.0, -9.5, 5.5]), np.array([-22.5, 60.0, 0.0]))
renderer.render(pose, intrinsic_matrix(160, 90, 60.0), {t.PERSON_ID: person})
print("drawn", flush=True)
time.sleep(600)
"""


def test_a_killed_client_leaves_the_world_as_it_was_found(tmp_path):
    with serving(street(), tmp_path) as port:
        words = [sys.executable, "-c", _WORKER, str(port)]
        worker = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent)
        assert worker.stdout is not None
        assert worker.stdout.readline() == "drawn\n"
        assert as_client(carla_settings, port) == (True, 4, 90.0), "three cameras and a walker"
        worker.kill()
        worker.wait()
        assert as_client(carla_settings, port, AS_FOUND) == AS_FOUND
