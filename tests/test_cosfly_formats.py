"""Products of stages 1-4: round trips, and every error names file and field."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from cosfly.formats.boxes import MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.formats.pedestrian_paths import PedestrianTrajectory, read_paths, write_paths
from cosfly.formats.roi import read_roi
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.runtime.errors import InputError


def some_boxes(n=3, seed=0):
    rng = np.random.default_rng(seed)
    return make_box_map(
        rng.uniform(-100, 100, (n, 3)), rng.uniform(0, 5, (n, 3)), rng.uniform(-180, 180, (n, 3)),
        rng.integers(1, 28, n), header=MapHeader(name="T", ground_z_m=0.0),
    )  # fmt: skip


@given(st.integers(1, 20), st.integers(0, 5))
def test_boxes_round_trip(tmp_path_factory, n, seed):
    path = tmp_path_factory.mktemp("boxes") / "boxes_3d.json"
    boxes = some_boxes(n, seed)
    write_boxes(path, boxes)
    back = read_boxes(path)
    for name in ("centers", "half_extents", "rotations_deg"):
        assert_allclose(getattr(back, name), getattr(boxes, name), atol=1e-6)
    assert (back.kinds.tolist(), back.ids.tolist()) == (boxes.kinds.tolist(), boxes.ids.tolist())
    assert back.name == "T"
    first = path.read_bytes()
    write_boxes(path, back)
    assert path.read_bytes() == first  # idempotent


def test_roi_forms(tmp_path):
    path = tmp_path / "roi_polygon.json"
    square = [[0, 0], [10, 0], [10, 10]]
    path.write_text(json.dumps({"description": "d", "closed": True, "points_world": square}))
    assert len(read_roi(path).rings()) == 1
    path.write_text(json.dumps({"polygons": [{"points_world": square, "holes": [square]}, {"points_world": square}]}))
    assert [len(p.holes) for p in read_roi(path).rings()] == [1, 0]
    around = [[*square, square[0]]]
    path.write_text(
        json.dumps({"type": "Feature", "geometry": {"type": "MultiPolygon", "coordinates": [around, around]}})
    )
    assert [p.points_world for p in read_roi(path).rings()] == [[tuple(map(float, point)) for point in square]] * 2


def a_path(n=4):
    t = np.arange(n) * 0.5
    return PedestrianTrajectory(
        "path_00000", np.array([[0.0, 0], [3, 4]]), t, np.stack([t, t, 0 * t], axis=1), np.ones(n)
    )


def a_trace(n=4):
    t = np.arange(n) * 0.5
    m = np.stack([t, t + 1, t + 20], axis=1)
    return DroneTrace("path_00000", "muco", t, m, m, m, np.ones(n), np.full(n, 5.0), {"a": 1.0}, {"b": 2}, None)


def test_path_and_trace_round_trip(tmp_path, subtests):
    for write, read, make, group in [
        (write_paths, read_paths, a_path, "paths"),
        (write_traces, read_traces, a_trace, "traces"),
        (write_paths, read_paths, lambda: replace(a_path(), pace="hurry"), "paths"),
        (write_traces, read_traces, lambda: replace(a_trace(), pace="hurry"), "traces"),
    ]:
        with subtests.test(write=write, read=read):
            path = tmp_path / "p.json"
            write(path, [make()], {"map": "T", "seed": 0})
            back = read(path)[0]
            for name, value in vars(make()).items():
                if isinstance(value, np.ndarray):
                    assert_allclose(getattr(back, name), value)
                else:
                    assert getattr(back, name) == value
            value = json.loads(path.read_text())
            value[group][0]["t"][1] = "x"
            path.write_text(json.dumps(value))
            with pytest.raises(InputError, match=rf"{group}\[0\]\.t"):
                read(path)
