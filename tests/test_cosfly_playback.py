"""The playback tree: strict and tolerant reading, axes at the door, unknown keys in a round trip."""

import json
import re
from dataclasses import fields

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosfly.formats.frames import read_instance
from cosfly.formats.playback import read_track, write_track
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import project, world_from_camera
from cosfly.runtime.errors import InputError
from specimens import PERSON_ID, make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), num_flights=1, num_points=6)


@pytest.fixture
def clean(tree):
    return find_tracks(tree)[0]


def rewrite(folder, target, change):
    value = json.loads((folder / "trajectory.json").read_text())
    change(value)
    new = target / "Town01" / folder.parent.name / folder.name
    new.mkdir(parents=True, exist_ok=True)
    (new / "trajectory.json").write_text(json.dumps(value))
    return new


def test_axes_are_carlas_on_disk_and_right_handed_in_memory(clean):
    flight = read_track(clean)
    raw = json.loads((clean / "trajectory.json").read_text())
    pose = raw["points"][2]["drone_pose"]
    assert_allclose(flight.positions_m[2], [pose["x"], -pose["y"], pose["z"]])
    assert_allclose(flight.rotations_deg[2], [pose["pitch"], -pose["yaw"], pose["roll"]])
    assert raw["coordinates"]["handedness"] == "left"


def test_poses_and_pictures_agree(tree):
    seen = 0
    for folder in find_tracks(tree):
        flight = read_track(folder)
        for i in np.flatnonzero(flight.target.visible):
            uv, z = project(
                flight.targets_m[i][None],
                world_from_camera(flight.positions_m[i], flight.rotations_deg[i]),
                flight.camera.intrinsic,
            )
            assert_allclose(uv[0], flight.target.uv[i], atol=1e-6)
            assert_allclose(z[0], flight.target.depth_m[i], atol=1e-6)
            kinds, ids = read_instance(flight.frame_folder(i))
            rows, columns = np.nonzero(ids == PERSON_ID)
            assert set(kinds[rows, columns].tolist()) == {12}
            assert abs(columns.mean() - uv[0, 0]) < 4
            assert abs(rows.mean() - uv[0, 1]) < 4
            seen += 1
    assert seen > 3


def test_round_trip_keeps_unknown_keys_and_numbers(clean, tmp_path):
    def change(value):
        value["from_the_future"] = {"a": [1, 2, None]}
        value["points"][1]["sensor_7"] = "x"
        value["points"][1]["target"]["bone_count"] = 31
        value["points"][2]["target"]["bbox_2d"] = [1, 2, 3, 4]  # the older list form
        for point in value["points"]:
            point["target"]["mask_bbox_2d"] = None
        value["points"][2]["target"]["mask_bbox_2d"] = {"xmin": 1, "ymin": 2, "xmax": 3, "ymax": 4}

    folder = rewrite(clean, tmp_path / "a", change)
    first = json.loads((folder / "trajectory.json").read_text())
    flight = read_track(folder)
    assert flight.target.bbox[2].tolist() == flight.target.mask_bbox[2].tolist() == [1, 2, 3, 4]
    assert np.isnan(np.delete(flight.target.mask_bbox, 2, axis=0)).all()
    assert read_track(clean).target.mask_bbox is None
    target = tmp_path / "b" / "Town01" / folder.parent.name / folder.name
    target.mkdir(parents=True)
    write_track(target, flight)
    assert json.loads((target / "trajectory.json").read_text()) == first
    again = read_track(target)
    pairs = [
        (getattr(old, column.name), getattr(new, column.name))
        for old, new in ((flight, again), (flight.target, again.target), (flight.perturbation, again.perturbation))
        for column in fields(old)
        if isinstance(getattr(old, column.name), np.ndarray)
    ]
    assert len(pairs) == 15
    for before, after in pairs:
        assert_array_equal(after, before)


def test_strict_raises_and_tolerant_notes(clean, tmp_path):
    for change, words in (
        (lambda v: v.update(schema="x"), "schema.*'x'"),
        (lambda v: v.update(schema_version="6.9.0"), "schema_version"),
        (lambda v: v.update(trace_dir="other"), "trace_dir"),
        (lambda v: v["points"][3].update(index=7), r"points\[3\].index"),
        (lambda v: v["points"][2]["nav_waypoint"].update(t1_world=[0, 0, 0]), r"points\[2\].nav_waypoint"),
        (lambda v: v["points"][-1]["nav_waypoint"].update(t1_world=[0, 0, 0]), "null at the last point"),
        (lambda v: v["points"][-1]["timing"].update(trace_timestamp=9), "steps of"),
        (lambda v: v["points"][4].pop("target"), "target.*missing"),
    ):
        folder = rewrite(clean, tmp_path, change)
        with pytest.raises(InputError, match=words):
            read_track(folder, strict=True)
        assert any(re.search(words, issue) for issue in read_track(folder, strict=False).issues), words


def test_older_names_and_any_even_time_step_are_read(clean, tmp_path):
    def change(value):
        value["waypoints"] = value.pop("points")
        for i, point in enumerate(value["waypoints"]):
            point["timing"] = {"timestamp": 7.0 + 0.2 * i}
            for name in ("pitch", "roll"):
                point["drone_pose"].pop(name)

    flight = read_track(rewrite(clean, tmp_path, change), strict=False)
    assert len(flight) == 6
    assert (flight.rotations_deg[:, 0] == 0).all()
    assert_allclose(np.diff(flight.time_s), 0.2)
