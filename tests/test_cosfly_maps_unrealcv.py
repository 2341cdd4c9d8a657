"""Maps of an UnrealCV server: through the real client over a real socket from a server of ours, and what is odd."""

import contextlib
import json
import socket
import threading

import numpy as np
import pytest
from simulator_serving import free_port, serving
from simulators import unrealcv_server
from simulators.unrealcv_server import UnrealCvServer
from test_renderers_contract import street
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.kinds import KINDS
from cosfly.maps import unrealcv_export
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.maps.unrealcv_export import UnrealCvMapConfig, level_map
from cosfly.runtime.errors import EnvironmentMissing, InputError
from cosfly.simulators.assets import id_of, kind_of

pytest.importorskip("unrealcv")


@contextlib.contextmanager
def beside(box_map: BoxMap, *faults: str):
    port = free_port()
    server = UnrealCvServer(box_map, port, faults)
    threading.Thread(target=server.serve, daemon=True).start()
    yield port


def same_boxes(exported: BoxMap, town: BoxMap) -> None:
    """Each object's bounds are the box's; where these tell the sides, so is all of it."""
    names = [f"{next(k for k, v in KINDS.items() if v == kind)}_{n}" for kind, n in zip(town.kinds, town.ids)]  # noqa: B905
    assert sorted(exported.ids.tolist()) == sorted(map(id_of, names))
    exported = exported.select(np.argsort(exported.ids))
    town = town.select(np.argsort([id_of(name) for name in names]))
    np.testing.assert_array_equal(exported.kinds, town.kinds)
    turned = np.radians(town.rotations_deg)
    is_told = (np.abs(np.cos(2 * turned[:, 1])) > 0.21) & (turned[:, [0, 2]] == 0).all(axis=1)
    assert is_told.mean() > 0.5
    for name in ("mins", "maxs"):
        np.testing.assert_allclose(getattr(exported, name), getattr(town, name), atol=1e-6, err_msg=name)
    for name in ("centers", "half_extents", "rotations_deg"):
        ours, theirs = getattr(exported, name)[is_told], getattr(town, name)[is_told]
        np.testing.assert_allclose(ours, theirs, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_a_served_town_comes_back_as_it_is(tmp_path):
    town = invent(SyntheticConfig(), 3)
    with serving(town, tmp_path / "town", protocol="unrealcv") as port:
        settings = f"maps.unrealcv={{port: {port}, most_default: 0.01}}"
        words = ["maps", "--source", "unrealcv", "--set", settings, "--out", str(tmp_path / "out")]
        done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "using ip-port socket" not in done.output
    exported = read_boxes(tmp_path / "out/boxes_3d.json")
    same_boxes(exported, town)
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


def test_a_server_that_is_not_there_silent_old_or_another_is_named(monkeypatch):
    port = free_port()
    with pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port} \(UnrealCV unknown\): no UnrealCV.*refused"):
        unrealcv_export.load(UnrealCvMapConfig(port=port), 0)
    with beside(street(), "hang@0") as port, pytest.raises(EnvironmentMissing, match=rf":{port}.*no answer in 1 s"):
        unrealcv_export.load(UnrealCvMapConfig(port=port, timeout_s=1.0), 0)
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
