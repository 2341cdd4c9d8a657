"""The CARLA server of the tests and our encodings of its axes; what it serves is in test_render_carla.py."""

import contextlib
import queue

import numpy as np
import pytest
from simulator_serving import as_client, serving
from simulators.carla_server import depth_picture
from test_renderers_contract import street

from cosfly.geometry.axes import world_from_camera
from cosfly.simulators.conventions import DEPTH_STEP_M, camera_rotation_deg, depth_of, unreal_pose, world_pose

pytest.importorskip("carla")


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


def frames_of(port: int, num_ticks: int) -> list[int]:
    """The numbers of the pictures of a depth camera, counted from the first tick, as they come."""
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
            came.append(inbox.get(timeout=3.0) - first + 1)
    return [number for number in came if number > 0]


@pytest.mark.slow
def test_planted_faults_come_true(tmp_path):
    """The client's first tick is that of its settings: here the second is 1."""
    faults = ("drop:depth@3", "drop:rgb@4", "duplicate@4", "reorder:depth@5", "delay:depth@7=1", "drop@9+")
    with serving(street(), tmp_path, *faults) as port:
        assert as_client(frames_of, port, 9) == [1, 3, 3, 5, 4, 7, 6]
