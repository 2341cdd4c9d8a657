"""The CARLA server of the tests, through the unmodified client of CARLA 0.9.16 over a real socket."""

import queue
import time
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
from simulator_serving import as_client, serving
from simulators.carla_server import depth_picture
from test_renderers_contract import street

from cosfly.formats.kinds import KINDS
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.render.stage import open_renderer
from cosfly.simulators.conventions import DEPTH_STEP_M, camera_rotation_deg, depth_of, tags_of, unreal_pose, world_pose

pytest.importorskip("carla")
SIZE = (160, 96)
EYE, TURN = (-10.0, -22.0, 14.0), (-22.5, 60.0, 0.0)  # what float32 holds, as all that goes over the wire
KINDS_OF_CAMERA = ("rgb", "depth", "semantic_segmentation", "instance_segmentation")


def connected(port: int):
    import carla

    client = carla.Client("127.0.0.1", port)
    client.set_timeout(60.0)  # the first picture opens the server's renderer
    return carla, client, client.get_world()


def carla_transform(carla, position_m, rotation_deg):
    x, y, z, pitch, yaw, roll = unreal_pose(np.array(position_m), np.array(rotation_deg))
    return carla.Transform(carla.Location(x, y, z), carla.Rotation(pitch, yaw, roll))


def cameras(carla, world, names=KINDS_OF_CAMERA):
    library, actors, inboxes = world.get_blueprint_library(), [], {}
    for name in names:
        blueprint = library.find(f"sensor.camera.{name}")
        blueprint.set_attribute("image_size_x", str(SIZE[0]))
        blueprint.set_attribute("image_size_y", str(SIZE[1]))
        blueprint.set_attribute("fov", "60.0")
        actor, inbox = world.spawn_actor(blueprint, carla_transform(carla, EYE, TURN)), queue.Queue()
        actor.listen(lambda image, inbox=inbox: inbox.put((image.frame, bytes(image.raw_data))))
        actors.append(actor)
        inboxes[name] = inbox
    time.sleep(0.5)  # streams are opened beside this thread
    return actors, inboxes


def lead(carla, world) -> None:
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
    world.apply_settings(settings)


def look(port: int) -> dict:
    carla, client, world = connected(port)
    lead(carla, world)
    library = world.get_blueprint_library()
    walker = world.spawn_actor(
        library.find("walker.pedestrian.0001"), carla_transform(carla, (4.0, -3.0, 0.9), (0.0, 0.0, 0.0))
    )
    actors, inboxes = cameras(carla, world)
    frame = world.tick()
    pictures = {}
    for name, inbox in inboxes.items():
        number, data = inbox.get(timeout=60)
        assert number == frame
        pictures[name] = np.frombuffer(data, np.uint8).reshape(SIZE[1], SIZE[0], 4).copy()
    walker.apply_control(carla.WalkerControl(carla.Vector3D(1.0, 0.0, 0.0), 1.0))
    for _ in range(20):
        world.tick()
    place = walker.get_transform().location
    numbers = {
        "walker": walker.id,
        "boxes": {b.actor_id: b.extent.z for b in world.get_level_bbs(carla.CityObjectLabel.Any)},
    }
    assert all(actor.destroy() for actor in [*actors, walker])
    world.tick()
    assert world.get_snapshot().find(walker.id) is None
    objects = world.get_environment_objects(carla.CityObjectLabel.Buildings)
    told = [
        (one.id, one.name, str(one.type), one.bounding_box.location.y, one.bounding_box.rotation.yaw) for one in objects
    ]
    errors = []
    for ask in (
        lambda: client.load_world("Nowhere"),
        lambda: world.spawn_actor(library.find("vehicle.tesla.model3"), None),
    ):
        try:
            ask()
        except Exception as error:
            errors.append(str(error))
    return {
        "pictures": pictures, "numbers": numbers, "walked": (place.x, place.y), "objects": told, "errors": errors,
        "maps": client.get_available_maps(), "name": world.get_map().name,
        "is_led": world.get_settings().synchronous_mode,
    }  # fmt: skip


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    with serving(street(), tmp_path_factory.mktemp("carla")) as port:
        yield as_client(look, port)


def test_a_client_is_given_the_town(seen):
    assert (seen["maps"], seen["name"]) == (["/Game/Carla/Maps/street"], "Carla/Maps/street")
    assert seen["is_led"]
    assert [(row[0], row[2]) for row in seen["objects"]] == [(4000, "Buildings"), (12, "Buildings")]
    assert [row[3:] for row in seen["objects"]] == [(-14.0, -20.0), (-16.0, 35.0)], "left-handed axes"
    assert "no map Nowhere; there is street" in seen["errors"][0]
    assert len(seen["numbers"]["boxes"]) == len(street())


def test_a_walker_goes_where_its_control_leads_it(seen):
    assert seen["walked"] == pytest.approx((5.0, 3.0), abs=1e-4), "20 ticks of 0.05 s at 1 m/s; y to the right"


def test_pictures_are_the_embedded_renderers(seen):
    renderer = open_renderer("gl", street(), *SIZE)
    frame = renderer.render(world_from_camera(np.array(EYE), np.array(TURN)), intrinsic_matrix(*SIZE, 60.0), None)
    renderer.close()
    kinds, actors = tags_of(seen["pictures"]["instance_segmentation"])
    is_walker = kinds == KINDS["Pedestrians"]
    assert is_walker.sum() > 3
    assert set(actors[is_walker].tolist()) == {seen["numbers"]["walker"]}
    rest = ~is_walker
    assert np.abs(depth_of(seen["pictures"]["depth"]) - frame.depth)[rest].max() <= DEPTH_STEP_M
    np.testing.assert_array_equal(kinds[rest], frame.kinds[rest])
    np.testing.assert_array_equal(tags_of(seen["pictures"]["semantic_segmentation"])[0], kinds)
    away = rest & ~np.roll(is_walker, 20, axis=1) & ~np.roll(is_walker, -20, axis=1)  # no shadow of the walker there
    assert np.abs(seen["pictures"]["rgb"][..., 2::-1].astype(int) - frame.rgb)[away].mean() < 0.5
    low_bits = {number & 0xFFFF for number in seen["numbers"]["boxes"]}
    assert set(np.unique(actors[rest]).tolist()) - {0} <= low_bits, "each box's number stands in its bounding box"


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


def frames_of(port: int, num_ticks: int) -> tuple[list[int], str]:
    carla, client, world = connected(port)
    lead(carla, world)
    (camera,), inboxes = cameras(carla, world, ["depth"])
    first, error, came = world.tick(), "", []
    client.set_timeout(3.0)
    try:
        for _ in range(num_ticks - 1):
            world.tick()
        client.get_server_version()
    except RuntimeError as caught:
        error = str(caught)
    while camera.is_alive:
        try:
            came.append(inboxes["depth"].get(timeout=1.5)[0] - first + 1)
        except queue.Empty:
            break
    return came, error


# The client's first tick is that of its settings: here the second is 1.
ALL_OF_MESSAGES = ("drop:depth@3", "drop:rgb@4", "duplicate@4", "reorder:depth@5", "delay:depth@7=1", "drop@9+")


@pytest.mark.parametrize(("faults", "num_ticks", "came", "error"), [
    (ALL_OF_MESSAGES, 9, [1, 3, 3, 5, 4, 7, 6], ""),
    (["late@3=4"], 3, [1, 2], "time-out of 3000ms"),
    (["unhealthy@3"], 3, [1, 2, 3], "time-out of 3000ms"),
    (["hang@3"], 3, [1, 2], "time-out of 3000ms"),
    (["die@3"], 3, [1], "time-out of 3000ms"),
], ids=["messages", "late", "unhealthy", "hang", "die"])  # fmt: skip
@pytest.mark.slow
def test_planted_faults(faults, num_ticks, came, error, tmp_path):
    with serving(street(), tmp_path, *faults) as port:
        told = as_client(frames_of, port, num_ticks)
    assert told[0] == came
    assert error in told[1]
    assert bool(error) == bool(told[1])


@pytest.mark.slow
def test_a_malformed_stream_ends_the_clients_process_not_the_servers(tmp_path):
    with serving(street(), tmp_path, "malformed@3") as port:
        with pytest.raises(BrokenProcessPool):
            as_client(frames_of, port, 4)
        assert as_client(frames_of, port, 2)[0] == [1, 2]
