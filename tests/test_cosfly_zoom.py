"""cosfly/render/camera.py: levels of zoom, changes between them, and who reads the camera of a frame."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, write_inputs

from cosfly.formats.frames import read_meta
from cosfly.formats.playback import read_track, write_track
from cosfly.formats.traces import DroneTrace
from cosfly.formats.tracks import find_tracks
from cosfly.render.camera import ZoomConfig, zoomed_deg
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.runtime.config import build
from cosfly.runtime.errors import ConfigError, InputError
from release.columns import INTRINSICS, Placement, matrices_of, scalar_row
from specimens import change_json, make_flight

LEVELS = (110.0, 90.0, 60.0, 30.0)
SMALL = {"width_px": 160, "height_px": 90, "town": "Street", "first_timestamp": 1776000000}
DYNAMIC = {"mode": "dynamic", "part_s": 2.0, "ramp_s": 1.0}


def zoomed(num_frames: int, **settings: float) -> np.ndarray:
    zoom = ZoomConfig.model_validate({"mode": "dynamic", **settings})
    return zoomed_deg(110.0, LEVELS, zoom, np.arange(num_frames) * 0.5, (), np.random.default_rng(0))


def test_a_field_of_view_outside_0_to_180_is_an_error_and_any_inside_is_taken():
    for fov in (0.0, -30.0, 180.0, 200.0, float("nan")):
        with pytest.raises(ConfigError, match=r"fovs_deg"):
            build(RenderConfig, {"fovs_deg": [90.0, fov]}, "test")
    for fov in (0.1, 179.0):
        assert build(RenderConfig, {"fovs_deg": [fov]}, "test").fovs_deg == (fov,)


def test_a_flight_goes_from_level_to_level():
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


def zooming(num_points: int = 8):
    flight, _ = make_flight(num_points)
    intrinsics = np.tile(flight.camera.intrinsic, (num_points, 1, 1))
    intrinsics[:, [0, 1], [0, 1]] *= np.linspace(1.0, 2.0, num_points)[:, None]
    return replace(flight, intrinsics=intrinsics)


def test_the_cameras_of_a_flight_survive_the_file(tmp_path):
    flight, folder = zooming(), tmp_path / "Town01/trajectory_1/ORI"
    folder.mkdir(parents=True)
    write_track(folder, flight)
    found = read_track(folder)
    np.testing.assert_array_equal(found.intrinsics, flight.intrinsics)
    assert found.camera_at(7).focal_px == pytest.approx(2 * found.camera.focal_px)
    assert found.fovs_deg[0] < found.fovs_deg[1] == pytest.approx(60.0)
    row = scalar_row(found, 7, None, Placement("", "walk", "train"))
    np.testing.assert_array_equal(
        matrices_of(np.array([row["intrinsics"][name] for name in INTRINSICS])[None])[0], flight.intrinsics[7]
    )
    assert row["fov_deg"] == pytest.approx(found.camera_at(7).fov_deg, abs=1e-6)
    change_json(folder / "trajectory.json", lambda raw: raw["points"][3]["camera"].update(intrinsic=[[0, 0, 0]] * 3))
    with pytest.raises(InputError, match=r"points\[3\]\.camera\.intrinsic"):
        read_track(folder)
    assert any("points[3].camera" in issue for issue in read_track(folder, strict=False).issues)
    write_track(folder, replace(flight, intrinsics=None))  # one camera is said once
    assert all("camera" not in point for point in json.loads((folder / "trajectory.json").read_text())["points"])
    assert read_track(folder).intrinsics is None


@pytest.fixture(scope="module")
def zoomed_tree(tmp_path_factory) -> tuple[Path, list[Path]]:
    folder = tmp_path_factory.mktemp("zoomed")
    inputs = write_inputs(folder / "inputs", [circling(16)])
    cfg = RenderConfig.model_validate({**SMALL, "zoom": DYNAMIC})
    return run(cfg, *inputs, folder / "render", seed=2), inputs


@needs_gl
def test_every_frame_tells_the_camera_it_was_drawn_with(zoomed_tree):
    tree, _ = zoomed_tree
    flights = [read_track(folder) for folder in find_tracks(tree)]
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


def moved(trace: DroneTrace, name: str, frame: int, place: tuple[float, float, float]) -> DroneTrace:
    places = getattr(trace, name).copy()
    places[frame] = place
    return replace(trace, **{name: places})


IN_THE_WALL = moved(circling(4, "path_001"), "positions_m", 2, (-6.0, -16.0, 0.5))
