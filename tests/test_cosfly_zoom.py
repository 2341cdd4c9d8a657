"""cosfly/render/lens.py: levels of zoom, changes between them, and who reads the camera of a frame; what cannot be
drawn."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, street, write_inputs

from cosfly.errors import ConfigError, InputError, NothingKept, RenderError
from cosfly.inspection import stage as inspection
from cosfly.inspection.flight import InspectConfig
from cosfly.maps.stage import MapsConfig
from cosfly.maps.stage import run as make_map
from cosfly.products.boxes import MapHeader, check_ground, write_boxes
from cosfly.products.flights import find_flights
from cosfly.products.frames import level_name, read_meta
from cosfly.products.inspection import read_inspection
from cosfly.products.playback import read_flight, write_flight
from cosfly.products.segments import Segment
from cosfly.products.traces import DroneTrace
from cosfly.render.flight import check_flight
from cosfly.render.lens import ZoomConfig, cameras_of, zoomed_deg
from cosfly.render.perturbation import Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.studies import weather
from cosfly.work.config import build
from cosfly.work.stage_folder import read_failures, read_manifest
from release.columns import INTRINSICS, Placement, matrices_of, scalar_row
from specimens import make_flight

LEVELS = (110.0, 90.0, 60.0, 30.0)
SMALL = {"width_px": 160, "height_px": 90, "town": "Street", "first_timestamp": 1776000000}
DYNAMIC = {"mode": "dynamic", "part_s": 2.0, "ramp_s": 1.0}


def zoomed(num_frames: int, seed: int = 0, segments: tuple[Segment, ...] = (), **settings: float) -> np.ndarray:
    zoom = ZoomConfig.model_validate({"mode": "dynamic", **settings})
    return zoomed_deg(110.0, LEVELS, zoom, np.arange(num_frames) * 0.5, segments, np.random.default_rng(seed))


# --- levels -----------------------------------------------------------------------------------------------------------


def test_focal_lengths_and_names_of_levels():
    """Of a picture 1280 px wide; a lens of 18 mm shows 90 degrees on film 36 mm wide."""
    found = [
        cameras_of((1280, 720), fov, LEVELS, ZoomConfig(), np.zeros(1), (), np.random.default_rng(0)) for fov in LEVELS
    ]
    np.testing.assert_allclose([camera.focal_px for (camera,) in found], [448.13, 640.0, 1108.51, 2388.51], atol=0.01)
    np.testing.assert_allclose([camera.focal_35mm_mm for (camera,) in found], [12.60, 18.0, 31.18, 67.18], atol=0.01)
    np.testing.assert_allclose([camera.fov_deg for (camera,) in found], LEVELS)
    assert [level_name(fov) for fov in (*LEVELS, 45.0)] == ["wide-angle", "standard", "narrow", "telephoto", ""]


def test_a_field_of_view_outside_0_to_180_is_an_error_and_any_inside_is_taken():
    for fov in (0.0, -30.0, 180.0, 200.0, float("nan")):
        with pytest.raises(ConfigError, match=r"fovs_deg"):
            build(RenderConfig, {"fovs_deg": [90.0, fov]}, "test")
    for fov in (0.1, 179.0):
        assert build(RenderConfig, {"fovs_deg": [fov]}, "test").fovs_deg == (fov,)


# --- changes ----------------------------------------------------------------------------------------------------------


def test_a_flight_goes_from_level_to_level():
    """Parts of 10 s: a level for 20 frames, then a change over 2 s, 4 frames, to another one."""
    fovs = zoomed(60, part_s=10.0, ramp_s=2.0)
    assert np.allclose(fovs[:21], 110.0)
    for begin in (24, 44):
        held = fovs[begin : begin + 16]
        assert np.allclose(held, held[0])
        assert round(held[0], 6) in LEVELS
    assert fovs[20] != pytest.approx(fovs[24])
    assert fovs[24] != pytest.approx(fovs[44])
    focal = 1.0 / np.tan(np.radians(fovs) / 2.0)
    assert focal[22] == pytest.approx(np.sqrt(focal[20] * focal[24])), "halfway the picture is halfway larger"


def test_levels_change_where_segments_begin():
    parts = (Segment("follow", 0, 10), Segment("orbit", 10, 30), Segment("follow", 30, 40))
    fovs = zoomed(40, segments=parts, ramp_s=1.0)
    changes = np.flatnonzero(np.abs(np.diff(fovs)) > 1e-9)
    assert set(changes) == {10, 11, 30, 31}


@given(st.integers(2, 120), st.floats(1, 60), st.floats(0, 20), st.integers(0, 5))
def test_every_frame_stays_between_the_levels(num_frames, part_s, ramp_s, seed):
    fovs = zoomed(num_frames, seed, part_s=part_s, ramp_s=ramp_s)
    assert len(fovs) == num_frames
    assert fovs.min() >= min(LEVELS) - 1e-9
    assert fovs.max() <= max(LEVELS) + 1e-9
    assert fovs[0] == pytest.approx(110.0)
    zoom = ZoomConfig(mode="dynamic", part_s=part_s, ramp_s=ramp_s)
    assert np.allclose(zoomed_deg(60.0, (60.0,), zoom, np.arange(30) * 0.5, (), np.random.default_rng(seed)), 60.0)


# --- trajectory.json --------------------------------------------------------------------------------------------------


def zooming(num_points: int = 8):
    flight, _ = make_flight(num_points)
    intrinsics = np.tile(flight.camera.intrinsic, (num_points, 1, 1))
    intrinsics[:, [0, 1], [0, 1]] *= np.linspace(1.0, 2.0, num_points)[:, None]
    return replace(flight, intrinsics=intrinsics)


def test_the_cameras_of_a_flight_survive_the_file(tmp_path):
    flight, folder = zooming(), tmp_path / "Town01/trajectory_1/ORI"
    folder.mkdir(parents=True)
    write_flight(folder, flight)
    found = read_flight(folder)
    np.testing.assert_array_equal(found.intrinsics, flight.intrinsics)
    assert found.camera_at(7).focal_px == pytest.approx(2 * found.camera.focal_px)
    assert found.fovs_deg[0] < found.fovs_deg[1] == pytest.approx(60.0)
    row = scalar_row(found, 7, None, Placement("", "walk", "train", None))
    np.testing.assert_array_equal(
        matrices_of(np.array([row["intrinsics"][name] for name in INTRINSICS])[None])[0], flight.intrinsics[7]
    )
    assert row["fov_deg"] == pytest.approx(found.camera_at(7).fov_deg, abs=1e-6)
    raw = json.loads((folder / "trajectory.json").read_text())
    raw["points"][3]["camera"]["intrinsic"] = [[0, 0, 0]] * 3
    (folder / "trajectory.json").write_text(json.dumps(raw))
    with pytest.raises(InputError, match=r"points\[3\]\.camera\.intrinsic"):
        read_flight(folder)
    assert any("points[3].camera" in issue for issue in read_flight(folder, strict=False).issues)
    write_flight(folder, replace(flight, intrinsics=None))  # one camera is said once
    assert all("camera" not in point for point in json.loads((folder / "trajectory.json").read_text())["points"])
    assert read_flight(folder).intrinsics is None


# --- a tree that zooms ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def zoomed_tree(tmp_path_factory) -> tuple[Path, list[Path]]:
    folder = tmp_path_factory.mktemp("zoomed")
    inputs = write_inputs(folder / "inputs", [circling(16)])
    cfg = RenderConfig.model_validate({**SMALL, "zoom": DYNAMIC})
    return run(cfg, *inputs, folder / "render", seed=2), inputs


@needs_gl
def test_every_frame_tells_the_camera_it_was_drawn_with(zoomed_tree):
    tree, _ = zoomed_tree
    flights = [read_flight(folder) for folder in find_flights(tree)]
    clean, shaken = flights
    np.testing.assert_array_equal(clean.intrinsics, shaken.intrinsics)
    assert len(np.unique(clean.intrinsics[:, 0, 0])) > 4
    for flight in flights:
        for i in range(len(flight)):
            meta = read_meta(flight.frame_folder(i)).camera
            camera = flight.camera_at(i)
            assert meta.intrinsic == camera.intrinsic.tolist()
            assert meta.fov_deg == pytest.approx(camera.fov_deg, abs=1e-6)
            assert meta.focal_length_35mm_mm == pytest.approx(camera.focal_35mm_mm, abs=1e-6)


@needs_gl
def test_the_inspection_projects_with_each_frames_camera(zoomed_tree, tmp_path):
    """Its pixels, boxes and masks agree; with the first frame's camera for all they do not."""
    tree, (_, simplified, traces) = zoomed_tree
    cfg = InspectConfig(clearance_min_m=0.0, smoothness_min=0.0, jerk_rms_max_mps3=1e3, accel_rms_max_mps2=1e3)
    codes = [
        issue.code
        for flight in read_inspection(inspection.run(cfg, simplified, traces, tree, tmp_path / "a")).flights
        for issue in flight.issues
        if issue.severity == "error"
    ]
    assert codes == []
    for folder in find_flights(tree):
        flight = read_flight(folder)
        seen = np.flatnonzero(
            flight.target_in_view & (np.abs(flight.intrinsics[:, 0, 0] / flight.camera.focal_px - 1) > 0.2)
        )
        assert len(seen)


# --- what cannot be drawn ---------------------------------------------------------------------------------------------


def moved(trace: DroneTrace, name: str, frame: int, place: tuple[float, float, float]) -> DroneTrace:
    places = getattr(trace, name).copy()
    places[frame] = place
    return replace(trace, **{name: places})


IN_THE_WALL = moved(circling(4, "path_001"), "positions_m", 2, (-6.0, -16.0, 0.5))
UNDER_GROUND = moved(circling(4, "path_002"), "targets_m", 1, (-7.0, -9.0, -3.0))
IN_A_SLAB = moved(circling(4, "path_003"), "targets_m", 1, (0.0, 0.0, 0.05))


def test_what_cannot_be_drawn_is_named():
    for trace, words in (
        (IN_THE_WALL, r"path_001: frame 2: a camera inside a box.*1 of 4 frames"),
        (UNDER_GROUND, r"path_002: frame 1: a target under ground.*feet 3\.\d+ m below"),
        (IN_A_SLAB, r"path_003: frame 1: a target under ground.*feet 0\.\d+ m below"),
    ):
        with pytest.raises(RenderError, match=words):
            check_flight(trace, Surroundings(street()))
    check_flight(circling(20), Surroundings(street()))


@needs_gl
def test_a_bad_flight_stops_no_other(tmp_path):
    inputs = write_inputs(tmp_path / "inputs", [circling(3), IN_THE_WALL, UNDER_GROUND, circling(3, "path_009")])
    tree = run(RenderConfig.model_validate({**SMALL, "tracks": ["clean"]}), *inputs, tmp_path / "render")
    counts = read_manifest(tree).counts
    assert (counts.input, counts.kept, counts.failed.total()) == (4, 2, 2)
    told = {failure.id: failure.message for failure in read_failures(tree / "failures.jsonl")}
    assert "a camera inside a box" in told["path_001/ORI"]
    assert "a target under ground" in told["path_002/ORI"]
    assert [folder.parent.name for folder in find_flights(tree)] == ["trajectory_1776000000", "trajectory_1776000003"]
    alone = write_inputs(tmp_path / "alone", [IN_THE_WALL])
    with pytest.raises(NothingKept, match="a camera inside a box"):
        run(RenderConfig.model_validate(SMALL), *alone, tmp_path / "none")


def test_a_map_without_ground_is_an_error(tmp_path):
    walls = street()
    walls = replace(walls.select(np.isin(walls.kinds, [3, 4])), header=MapHeader(name="walls"))
    inputs = write_inputs(tmp_path / "inputs", [circling(3)])
    write_boxes(inputs[0], walls)
    of_these_boxes = MapsConfig.model_validate({"source": "boxes", "boxes": {"path": inputs[0]}})
    for begin in (
        lambda: make_map(of_these_boxes, tmp_path / "maps"),  # before anybody walks or flies there
        lambda: run(RenderConfig.model_validate(SMALL), *inputs, tmp_path / "render"),
        lambda: weather.run(RenderConfig(), inputs[0], inputs[2], tmp_path / "gallery"),
    ):
        with pytest.raises(InputError, match=r"boxes_3d\.json: the map has no ground.*ground_z_m"):
            begin()
    check_ground(replace(walls, header=MapHeader(name="walls", ground_z_m=0.0)), inputs[0])
    check_ground(street(), inputs[0])
