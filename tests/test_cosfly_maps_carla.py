"""The CARLA server of the tests; its maps through the unmodified client, and what is odd in real exports."""

import contextlib
import json
import queue

import numpy as np
import pytest
from simulator_serving import as_client, free_port, serving
from simulators.carla_server import depth_picture
from test_renderers_contract import street
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.geometry.axes import world_from_camera
from cosfly.maps import carla_export
from cosfly.maps.carla_export import CarlaMapConfig, CarlaTown, box_map_of
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.runtime.errors import ConfigError, EnvironmentMissing
from cosfly.simulators.conventions import DEPTH_STEP_M, camera_rotation_deg, depth_of, unreal_pose, world_pose

pytest.importorskip("carla")


def same_boxes(one: BoxMap, other: BoxMap) -> None:
    """In any order: the same ids, each with the same box; over the wire numbers are single precision."""
    assert sorted(one.ids.tolist()) == sorted(other.ids.tolist())
    left, right = (box_map.select(np.argsort(box_map.ids)) for box_map in (one, other))
    np.testing.assert_array_equal(left.kinds, right.kinds)
    for name in ("centers", "half_extents", "rotations_deg", "mins", "maxs"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), atol=2e-4, err_msg=name)


@pytest.mark.slow
def test_a_served_town_comes_back_as_it_is(tmp_path):
    town = invent(SyntheticConfig(), 3)
    with serving(town, tmp_path / "town") as port:
        words = ["maps", "--source", "carla", "--set", f"maps.carla.port={port}", "--out", str(tmp_path / "out")]
        done = CliRunner().invoke(app, words, catch_exceptions=False)
        wrong = CarlaMapConfig(port=port, town="Town99")
        with pytest.raises(
            ConfigError, match=rf"127\.0\.0\.1:{port} \(CARLA 0\.9\.16\).*no town of this name.*Town99.*{town.name}"
        ):
            carla_export.load(wrong, 0)
    assert done.exit_code == 0, done.output
    exported = read_boxes(tmp_path / "out/boxes_3d.json")
    same_boxes(exported, town)
    header = exported.header
    assert (header.name, header.source.tool, header.source.version) == (town.name, "CARLA", "0.9.16")
    assert header.num_objects == len(town)
    assert "Train" in header.model_extra["empty_labels"]
    assert header.ground_z_m == pytest.approx(town.header.ground_z_m, abs=0.1)
    counts = json.loads((tmp_path / "out/manifest.json").read_text())["counts_by_kind"]
    assert counts == town.counts()


def test_a_server_that_is_not_there_or_is_silent_is_named(tmp_path):
    port = free_port()
    with pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port}.*no CARLA server.*refused"):
        carla_export.load(CarlaMapConfig(port=port), 0)
    with serving(street(), tmp_path, "hang@0") as port:
        cfg = CarlaMapConfig(port=port, timeout_s=1.0)
        with pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port}.*no CARLA server.*time-out of 1000ms"):
            carla_export.load(cfg, 0)


def test_a_server_that_names_a_file_outside_the_cache_is_refused(tmp_path):
    words = r"names a file outside the client's cache; got \.\./\.\./escaped"
    with serving(street(), tmp_path, "escape@0+") as port, pytest.raises(EnvironmentMissing, match=words):
        carla_export.load(CarlaMapConfig(port=port), 0)


def box(x: float, y: float, half: tuple[float, float, float], yaw: float = 0.0) -> tuple[float, ...]:
    return (x, y, half[2], *half, 0.0, yaw, 0.0)


def told(**changes) -> CarlaTown:
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
    return CarlaTown("Town10HD_Opt", "0.9.16", rows, ["Train", "Bus"], **changes)


def test_what_is_odd_is_left_out_counted_and_told(caplog):
    caplog.set_level("INFO")
    far = [(5.0, 0.0, 0.0), (400.0, 0.0, 0.0), (500.0, 0.0, 0.0)]
    box_map = box_map_of(told(road_points_m=far), CarlaMapConfig())
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
    for words in ("no objects with the labels Train, Bus", "huge 2", "1 objects had the id", "2 of 3 points on roads"):
        assert words in caplog.text


def test_depth_and_poses_survive_their_encodings():
    rng = np.random.default_rng(1)
    depth = (1000.0 * rng.random((40, 50)) ** 3).astype(np.float32)
    depth[0, :3] = 0.0, 1000.0, 2000.0
    back = depth_of(depth_picture(depth))
    assert np.abs(back - np.minimum(depth, 1000.0)).max() <= DEPTH_STEP_M
    assert back[0, :3].tolist() == [0.0, 1000.0, 1000.0]
    for turn in (*rng.uniform([-89, -180, -179], [89, 180, 179], (20, 3)), [-90.0, 30.0, 0.0], [90.0, -170.0, 0.0]):
        pose = world_from_camera(np.zeros(3), np.array(turn))
        np.testing.assert_allclose(camera_rotation_deg(pose), turn, atol=1e-9)
        position, rotation = world_pose(unreal_pose(np.array([1.0, 2.0, 3.0]), np.array(turn)))
        np.testing.assert_array_equal(np.concatenate([position, rotation]), [1.0, 2.0, 3.0, *turn])


def frames_of(port: int, num_ticks: int, num_pictures: int) -> list[int]:
    """The numbers of the pictures of a depth camera, counted from the first tick, as they come; and of those that come
    though no more should."""
    import carla

    client = carla.Client("127.0.0.1", port)
    client.set_timeout(60.0)  # the first picture opens the server's renderer
    world = client.get_world()
    blueprint, inbox = world.get_blueprint_library().find("sensor.camera.depth"), queue.Queue()
    for name, size_px in (("image_size_x", "160"), ("image_size_y", "96")):
        blueprint.set_attribute(name, size_px)
    camera = world.spawn_actor(blueprint, carla.Transform())
    camera.listen(lambda image: inbox.put(image.frame))
    inbox.get(timeout=60)  # the stream is open
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
    world.apply_settings(settings)
    first, *_ = (world.tick() for _ in range(num_ticks))
    came: list[int] = []
    with contextlib.suppress(queue.Empty):
        while True:
            number = inbox.get(timeout=60.0 if len(came) < num_pictures else 2.0) - first + 1
            came += [number] if number > 0 else []
    return came


@pytest.mark.slow
def test_planted_faults_come_true(tmp_path):
    """The client's first tick is that of its settings: here the second is 1."""
    faults = ("drop:depth@3", "drop:rgb@4", "duplicate@4", "reorder:depth@5", "delay:depth@7=5", "drop@9+")
    with serving(street(), tmp_path, *faults) as port:
        assert as_client(frames_of, port, 9, 7) == [1, 3, 3, 5, 4, 7, 6]
