"""cosfly/viz/overlay.py and `cosfly view --frame`: boxes, ids and distances over a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, street, write_inputs
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.frames import read_instance, read_meta, read_rgb
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.playback import read_track
from cosfly.formats.town import read_instance_ids
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import box_corners, intrinsic_matrix, project, world_from_camera
from cosfly.render.contract import instance_ids
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_checksums
from cosfly.viz.gallery import four_panels
from cosfly.viz.overlay import TARGET_COLOR, Overlay, _lines

SETTINGS = {
    "width_px": 320,
    "height_px": 180,
    "fovs_deg": [60.0],
    "town": "Street",
    "tracks": ["clean"],
    "first_timestamp": 1776000000,
}


@pytest.fixture(scope="module")
def trees(tmp_path_factory) -> dict[bool, Path]:
    folder = tmp_path_factory.mktemp("overlay")
    inputs = write_inputs(folder / "inputs", [circling(3)])
    return {
        debug: run(RenderConfig.model_validate({**SETTINGS, "debug": debug}), *inputs, folder / str(debug) / "render")
        for debug in (True, False)
    }


def frame_of(tree: Path, index: int = 1) -> Path:
    return read_track(find_tracks(tree)[0]).frame_folder(index)


@needs_gl
def test_debug_pictures_are_written_where_they_are_asked_for(trees):
    assert not list(trees[False].rglob("debug.png"))
    (folder,) = find_tracks(trees[True])
    named = [name for name in read_checksums(folder) if name.endswith("debug.png")]
    assert len(named) == len(list(folder.rglob("debug.png"))) == 3
    for name in ("rgb.png", "depth_float32.png", "instance.png"):
        assert (frame_of(trees[True]) / name).read_bytes() == (frame_of(trees[False]) / name).read_bytes()


@needs_gl
def test_the_targets_box_stands_where_its_corners_are(trees):
    frame = frame_of(trees[True])
    flight, meta = read_track(find_tracks(trees[True])[0]), read_meta(frame)
    drawn = np.asarray(Image.open(frame / "debug.png"))
    corners = box_corners(flight.targets_m[1], np.array(PERSON_HALF_EXTENTS_M))
    pose = world_from_camera(flight.positions_m[1], flight.rotations_deg[1])
    uv, _ = project(corners, pose, flight.camera_at(1).intrinsic)
    near = [
        np.abs(drawn[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2].astype(int) - TARGET_COLOR)
        .sum(axis=2)
        .min()
        for u, v in uv
    ]
    assert max(near) < 120  # antialiased, one pixel wide; another colour is farther
    again = Overlay(street(), instance_ids(street())).draw(read_rgb(frame), read_instance(frame)[1], meta)
    np.testing.assert_array_equal(again, drawn)
    assert (drawn != read_rgb(frame)).any(axis=2).mean() < 0.3


def test_a_box_round_the_camera_is_cut_at_the_near_plane():
    pose, intrinsic = world_from_camera(np.zeros(3), np.zeros(3)), intrinsic_matrix(320, 180, 90.0)
    round_it = _lines(box_corners(np.zeros(3), np.full(3, 5.0)), pose, intrinsic, 0.3)
    assert len(round_it) == 8  # the four edges behind are gone, the four that go backwards are cut
    assert np.isfinite(np.array(round_it)).all()
    assert _lines(box_corners(np.array([-20.0, 0, 0]), np.ones(3)), pose, intrinsic, 0.3) == []


@needs_gl
def test_four_pictures_of_a_frame(trees, tmp_path):
    result = CliRunner().invoke(app, ["view", str(trees[True]), "--frame", "best", "--out", str(tmp_path / "a.png")])
    assert result.exit_code == 0, result.output
    assert Image.open(tmp_path / "a.png").size == (640, 2 * (180 + 36))
    name = four_panels(trees[False], tmp_path / "b.png", box_map=street())
    assert name in result.output
    for frame in (name, str(trees[False] / name)):
        assert four_panels(trees[False], tmp_path / "b.png", frame=frame, box_map=street()) == name
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), np.asarray(Image.open(tmp_path / "b.png")))


@needs_gl
def test_without_boxes_there_is_one_clear_error(trees, tmp_path):
    with pytest.raises(InputError, match=r"without debug\.png.*--map.*render\.debug=true"):
        four_panels(trees[False], tmp_path / "a.png")
    with pytest.raises(InputError):
        four_panels(trees[True], tmp_path / "a.png", frame="../../elsewhere")


@needs_gl
def test_ids_of_boxes_are_those_of_the_renderer(trees):
    ids = read_instance_ids(find_tracks(trees[True])[0].parents[1])
    assert ids.of_boxes(street()).tolist() == instance_ids(street()).tolist()
