"""Maps and frames of an UnrealCV server, through the real client, against the embedded renderer's."""

import contextlib
import json
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import invoke, obeyed
from simulator_serving import free_port, serving
from simulators import unrealcv_server
from simulators.scene import clothes_of
from simulators.unrealcv_server import UnrealCvServer
from test_renderers_contract import street
from test_simulators_carla import (
    CLEAN,
    FRAMES,
    files_of,
    flown,
    same_boxes,
    same_but_for_people,
    same_but_for_pictures,
    schema_of,
)
from test_simulators_carla import config as carla_config

from cosfly.formats.boxes import BoxMap, read_boxes, write_boxes
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.maps import carla_export, unrealcv_export
from cosfly.maps.carla_export import CarlaMapConfig
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.maps.unrealcv_export import UnrealCvMapConfig, level_map
from cosfly.render.contract import PERSON_ID, PosedPerson, other_id
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, run
from cosfly.render.unrealcv_backend import UnrealCvRenderConfig
from cosfly.runtime.config import build
from cosfly.runtime.errors import EnvironmentMissing, InputError, RenderError
from cosfly.simulators.assets import id_of, kind_of
from cosfly.simulators.unrealcv_client import UnrealCvConfig, connect

pytest.importorskip("unrealcv")


@contextlib.contextmanager
def beside(box_map: BoxMap, *faults: str):
    port = free_port()
    server = UnrealCvServer(box_map, port, faults)
    threading.Thread(target=server.serve, daemon=True).start()
    yield port


def are_told(town: BoxMap) -> np.ndarray:
    """Where an object's bounds tell the sides of its box."""
    turned = np.radians(town.rotations_deg)
    told = (np.abs(np.cos(2 * turned[:, 1])) > 0.21) & (turned[:, [0, 2]] == 0).all(axis=1)
    assert told.mean() > 0.5
    return told


@pytest.mark.slow
def test_a_served_town_comes_back_as_it_is(tmp_path):
    town = invent(SyntheticConfig(), 3)
    with serving(town, tmp_path / "town", protocol="unrealcv") as port:
        settings = f"maps.unrealcv={{port: {port}}}"
        words = ["maps", "--source", "unrealcv", "--set", settings, "--out", str(tmp_path / "out")]
        assert "using ip-port socket" not in obeyed(words)
    exported = read_boxes(tmp_path / "out/boxes_3d.json")
    ids = [id_of(f"{KIND_NAMES[kind]}_{number}") for kind, number in zip(town.kinds, town.ids, strict=True)]
    same_boxes(exported, replace(town, ids=np.array(ids)), 1e-6, are_told)
    header, num_roads = exported.header, town.counts()["Roads"]
    assert header.extent_sources == {"road": num_roads, "bbox": 0, "engine": len(town) - num_roads, "default": 0}
    assert (header.name, header.source.tool, header.source.version) == (town.name, "UnrealCV", "1.1.0")
    assert header.dropped_objects == {"huge": 1}, "the landscape under everything"
    assert header.num_objects == len(town) + 1
    assert header.ground_z_m == pytest.approx(town.header.ground_z_m, abs=0.1)
    sidecar = json.loads((tmp_path / "out/boxes_meta.json").read_text())
    assert sidecar["extent_sources"] == header.extent_sources
    assert [one["id"] for one in sidecar["objects"]] == exported.ids.tolist()
    assert all(id_of(one["name"]) == one["id"] and kind_of(one["class"]) == one["type"] for one in sidecar["objects"])
    page = (tmp_path / "out/boxes.html").read_text()
    assert town.name in page
    assert 'id="space"' in page
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert {"boxes_meta.json", "boxes.html"} <= {one["path"] for one in manifest["outputs"]}


@pytest.mark.parametrize(("protocol", "load", "config", "silent"), [
    ("carla", carla_export.load, CarlaMapConfig, "no CARLA server.*time-out of 1000ms"),
    ("unrealcv", unrealcv_export.load, UnrealCvMapConfig, "no answer in 1 s"),
])  # fmt: skip
def test_a_server_that_is_not_there_or_is_silent_is_named(protocol, load, config, silent, tmp_path):
    port = free_port()
    with pytest.raises(EnvironmentMissing, match=rf"(?i)127\.0\.0\.1:{port}.*no {protocol}.*refused"):
        load(config(port=port), 0)
    with (
        serving(street(), tmp_path, "hang@0", protocol=protocol) as port,
        pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port}.*{silent}"),
    ):
        load(config(port=port, timeout_s=1.0), 0)


def test_a_server_that_is_old_or_another_is_named(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port}.*is not UnrealCV"):
            unrealcv_export.load(UnrealCvMapConfig(port=port, timeout_s=0.5), 0)
    for version in ("0.3.10", "error Can not find a handler"):
        monkeypatch.setattr(unrealcv_server, "VERSION", version)
        with (
            beside(street()) as port,
            pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port}.*{version}.*0\.4\.0"),
        ):
            unrealcv_export.load(UnrealCvMapConfig(port=port), 0)


def told(class_name: str, bounds_m=None, yaw: float = 0.0, at_m=(0.0, 0.0, 0.0), scale=(1.0, 1.0, 1.0)):
    bounds = None if bounds_m is None else tuple(100.0 * part for part in bounds_m)
    at = tuple(100.0 * part for part in at_m)
    return unrealcv_export._Object(f"{class_name}_7", class_name, at, (0.0, yaw, 0.0), bounds, scale)


def test_where_sizes_come_from_and_what_is_left_out(tmp_path):
    table = tmp_path / "Bbox.json"
    table.write_text(json.dumps({"buildings": {"BP_Building_09_C": {"bbox": {"x": 1000.0, "y": 600.0, "z": 2000.0}}}}))
    objects = [
        told("BP_Road_C", (-10.0, -4.0, -0.1, 10.0, 4.0, 0.0)),
        told(
            "BP_Building_09_C", (0.0, 0.0, 0.0, 1.0, 1.0, 1.0), yaw=45.0, at_m=(30.0, 10.0, 0.0), scale=(1.0, 1.0, 0.5)
        ),
        told("BP_Tree1_C", (0.0, 0.0, 0.0, 2.0, 2.0, 6.0), yaw=45.0),
        told("BP_Hydrant_C", (5.0, 5.0, 0.0, 5.0, 5.0, 0.0), at_m=(5.0, 5.0, 0.0)),
        told("StaticMeshActor", (7.0, 7.0, 0.0, 8.0, 9.0, 2.0)),
        told("BP_Sky_Sphere_C", (-900.0, -900.0, -900.0, 900.0, 900.0, 900.0)),
        told("Landscape", (-900.0, -900.0, -9.0, 900.0, 900.0, 0.0)),
        told("PlayerStart"),
        told("Base_User_Agent_C", (0.0, 0.0, 0.0, 0.6, 0.6, 1.8)),
    ]
    found = level_map(objects, UnrealCvMapConfig(sizes=[table]), "here", "1.1.0", "City")
    assert found.header.extent_sources == {"road": 1, "bbox": 1, "engine": 2, "default": 1}
    assert found.header.dropped_objects == {"not of the town": 2, "huge": 1, "no body": 1}
    kinds = ["Roads", "Buildings", "Vegetation", "Static", "Other"]
    assert found.kinds.tolist() == [KINDS[kind] for kind in kinds]
    np.testing.assert_allclose(found.centers[1], [30.0, -10.0, 5.0])
    np.testing.assert_allclose(found.half_extents[1:4], [[5.0, 3.0, 5.0], [1.0, 1.0, 3.0], [0.2, 0.2, 0.45]])
    assert found.rotations_deg[:, 1].tolist() == [0.0, -45.0, 0.0, 0.0, 0.0], "at 45 degrees bounds tell no sides"
    assert found.header.ground_z_m == 0.0
    with pytest.raises(InputError, match="here: the map has no boxes; got 1 objects"):
        level_map(objects[-1:], UnrealCvMapConfig(), "here", "1.1.0", "City")


QUICK = {"timeout_s": 60.0, "settle_delay_s": 0.02}


def exported() -> BoxMap:
    with beside(street()) as port:
        return unrealcv_export.load(UnrealCvMapConfig(port=port), 0)


def inputs(folder: Path, num_flights: int = 1, num_frames: int = 3) -> list[Path]:
    boxes, simplified, traces = flown(folder, num_flights, num_frames)
    for path in (boxes, simplified):
        write_boxes(path, exported())
    return [boxes, simplified, traces]


def config(port: int, settings: dict = CLEAN, **own) -> RenderConfig:
    return build(RenderConfig, {**settings, "backend": "unrealcv", "unrealcv": {"port": port, **QUICK, **own}}, "test")


def opened(port: int, box_map: BoxMap, **own):
    settings = build(UnrealCvRenderConfig, {"port": port, **QUICK, **own}, "test")
    return open_renderer("unrealcv", box_map, 160, 90, settings=settings, num_others=4)


@pytest.mark.slow
def test_a_tree_is_the_embedded_renderers_by_recursive_diff(tmp_path):
    """Step 6's contract: the same folders, files, schemas and frames; poses byte for byte; other pixels of people."""
    given = inputs(tmp_path / "in", 2, 4)
    reference = run(build(RenderConfig, FRAMES, "test"), *given, tmp_path / "gl", seed=5, workers=1)
    with serving(street(), tmp_path / "town", protocol="unrealcv") as port:
        tree = run(config(port, FRAMES), *given, tmp_path / "unrealcv", seed=5, workers=1)
        objects, until_s = "COSFLY", time.monotonic() + 60.0
        while "COSFLY" in str(objects) and time.monotonic() < until_s:  # a guard takes them away when a worker is gone
            time.sleep(1.0)
            connection = connect(UnrealCvConfig(port=port), port)
            objects, pose, size = connection.ask("vget /objects", "vget /camera/0/pose", "vget /camera/0/size")
            connection.close()
        assert "COSFLY" not in str(objects), "nobody is left"
        assert (str(pose).split()[0], size) == ("0.000000", "640 480"), "the camera is where it was"
    for ours, theirs in same_but_for_pictures(tree, reference):
        half_step_m, is_sky = np.maximum(theirs[3] * 2.0**-11, 1e-3), theirs[3] >= 650.0
        # Houses are painted by other ids.
        rest = same_but_for_people(ours, theirs, 1.01 * half_step_m, 8, most_levels=10.0, is_far=is_sky)
        assert (ours[3][is_sky & rest] == 1000.0).all(), "half precision ends at 655 m"
        assert schema_of(ours[-1].model_dump()) == schema_of(theirs[-1].model_dump())


def test_people_stand_where_they_are_and_the_lens_changes():
    clothes = clothes_of("Base_User_Agent_C")
    pose = world_from_camera(np.array([-1.0, -9.5, 5.5]), np.array([-32.5, 60.0, 0.0]))
    person = PosedPerson(np.array([4.0, -3.0, 0.90625]), 0.0, 0.0, 1.0, clothes)
    both = {PERSON_ID: person, other_id(0): PosedPerson(np.array([1.0, -4.0, 0.90625]), 1.0, 0.0, 0.0, clothes)}
    frames = []
    with beside(street()) as port:
        ours = opened(port, exported())
        theirs = open_renderer("gl", exported(), 160, 90, num_others=4)
        for renderer in (ours, theirs):
            frames.append(renderer.render(pose, intrinsic_matrix(160, 90, 60.0), both))
        near = ours.render(pose, intrinsic_matrix(160, 90, 30.0), {PERSON_ID: person})
        with pytest.raises(RenderError, match=r"cannot render with this intrinsic matrix.*square pixels"):
            ours.render(pose, intrinsic_matrix(160, 90, 60.0) + np.eye(3)[0], {})
        ours.close()
        theirs.close()
    for number in (PERSON_ID, other_id(0)):
        masks = [frame.ids == number for frame in frames]
        assert masks[0].sum() > 30
        assert np.argwhere(masks[0]).mean(axis=0) == pytest.approx(np.argwhere(masks[1]).mean(axis=0), abs=1.5)
    assert (near.ids == PERSON_ID).sum() > 2.5 * (frames[0].ids == PERSON_ID).sum()
    assert not (near.ids == other_id(0)).any(), "who is gone is taken away"


def test_a_camera_that_falls_is_found(monkeypatch):
    done = UnrealCvServer._done

    def fallen(server, command: str) -> bytes:
        if command.startswith("vset /camera/0/pose"):
            words = command.split()
            words[4] = "60.0"  # a pawn that gravity takes down
            command = " ".join(words)
        return done(server, command)

    monkeypatch.setattr(UnrealCvServer, "_done", fallen)
    with beside(street()) as port:
        renderer = opened(port, exported())
        pose = world_from_camera(np.array([-1.0, -9.5, 12.5]), np.array([-32.5, 60.0, 0.0]))
        told = rf"127\.0\.0\.1:{port}, street: the camera is not at the requested.*0\.6 m over the ground.*12\.5 m over"
        with pytest.raises(RenderError, match=told):
            renderer.render(pose, intrinsic_matrix(160, 90, 60.0), {})
        renderer.close()


# protocol -> the inputs of a run, and its settings
SIMULATORS = {"carla": (flown, carla_config), "unrealcv": (inputs, config)}


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "faults", "own"), [
    ("carla", ("drop:depth@5", "duplicate@7", "reorder:rgb@9", "delay:instance@11=7"), {"timeout_s": 6.0}),
    ("unrealcv", ("drop:depth@2", "duplicate:lit@4", "malformed:object_mask@6", "malformed:depth@8", "delay:lit@9=4"),
        {"timeout_s": 3.0, "animate": False}),
])  # fmt: skip
def test_lost_late_double_broken_and_disordered_pictures_change_nothing(protocol, faults, own, tmp_path):
    fly, settings = SIMULATORS[protocol]
    given, trees = fly(tmp_path / "in", 1, 5), []
    for name, planted in {"plain": (), "faulty": faults}.items():
        with serving(street(), tmp_path / name, *planted, protocol=protocol) as port:
            trees.append(run(settings(port, **own), *given, tmp_path / f"tree_{name}", workers=1))
    assert files_of(trees[0]) == files_of(trees[1])


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "fault", "timeout_s", "told"), [
    ("carla", "die@10", 5.0, ""),
    ("unrealcv", "die@8", 8.0, r" \(UnrealCV.*refused"),
    ("unrealcv", "hang@8", 8.0, r" \(UnrealCV.*no answer in 8 s"),
])  # fmt: skip
def test_a_server_that_ends_is_named_and_the_run_goes_on_with_the_next(protocol, fault, timeout_s, told, tmp_path):
    fly, settings = SIMULATORS[protocol]
    given, tree = fly(tmp_path / "in", 2, 5), tmp_path / "tree"
    with (
        serving(street(), tmp_path / "town", fault, protocol=protocol) as port,
        pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port}{told}"),
    ):
        run(settings(port, timeout_s=timeout_s), *given, tree, workers=1)
    assert len(find_tracks(tree)) == 1
    kept = files_of(tree)
    with serving(street(), tmp_path / "town", protocol=protocol) as port:
        files = files_of(run(settings(port), *given, tree, workers=1))
    assert len(find_tracks(tree)) == 2
    assert {name: files[name] for name in kept} == kept


@pytest.mark.slow
def test_the_papers_options(tmp_path):
    boxes, simplified, traces = inputs(tmp_path / "in", 2, 3)
    with serving(street(), tmp_path / "town", protocol="unrealcv") as port:
        words = [
            *("render", "--backend", "unrealcv", "--cvip", "127.0.0.1", "--cvport", str(port), "--path-index", "1"),
            *("--no-require-depth", "--require-rgb", "--settle-delay", "0.02", "--coord-scale", "100.0"),
            *("--coord-z-offset", "0.0", "--gif", "--gif-fps", "8", "--gif-name", "look.gif", "--workers", "1"),
            *("--map", str(boxes), "--simplified", str(simplified), "--traces", str(traces)),
            *("--out", str(tmp_path / "render"), "--set", "render.width_px=160", "--set", "render.height_px=90"),
        ]
        obeyed(words)
    words[words.index("--path-index") + 1], words[words.index("--out") + 1] = "7", str(tmp_path / "other")
    other = invoke(words)
    flights = find_tracks(tmp_path / "render")
    assert {json.loads((f / "trajectory.json").read_text())["source"]["path_index"] for f in flights} == {1}
    names = {p.name for p in (tmp_path / "render").rglob("frame_00000/*")}
    assert "rgb.png" in names
    assert not any(name.startswith("depth") for name in names)
    from PIL import Image

    with Image.open(tmp_path / "render/look.gif") as gif:
        assert (gif.n_frames, gif.info["duration"]) == (3, 120)
    words = "render.path_index: the input has no drone trajectory with this index; got 7; expected an index from 0 to 1"
    assert words in str(other.exception)
    assert not (tmp_path / "other").exists()
