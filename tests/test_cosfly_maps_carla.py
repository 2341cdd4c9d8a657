"""Maps of a CARLA server: through the unmodified client from a server of ours, and what is odd in real exports."""

import json

import numpy as np
import pytest
from simulator_serving import free_port, serving
from test_renderers_contract import street
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.maps import carla_export
from cosfly.maps.carla_export import CarlaMapConfig, CarlaTown, box_map_of
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.runtime.errors import ConfigError, EnvironmentMissing

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
            ConfigError, match=rf"127\.0\.0\.1:{port} \(CARLA 0\.9\.16\).*no such town.*Town99.*{town.name}"
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
    for words in ("no objects of Train, Bus", "'huge': 2", "1 objects repeated an id", "2 of 3 points on roads"):
        assert words in caplog.text
