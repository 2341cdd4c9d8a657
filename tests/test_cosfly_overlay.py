"""cosfly/viz/overlay.py and `cosfly view --frame`: boxes, ids and distances over a frame."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, street, write_inputs
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_checksums
from cosfly.viz.gallery import four_panels

SETTINGS = {
    "width_px": 320, "height_px": 180, "fovs_deg": [60.0], "town": "Street", "tracks": ["clean"],
    "first_timestamp": 1776000000,
}  # fmt: skip


@pytest.fixture(scope="module")
def trees(tmp_path_factory) -> dict[bool, Path]:
    folder = tmp_path_factory.mktemp("overlay")
    inputs = write_inputs(folder / "inputs", [circling(3)])
    return {
        debug: run(RenderConfig.model_validate({**SETTINGS, "debug": debug}), *inputs, folder / str(debug) / "render")
        for debug in (True, False)
    }


def frame_of(tree: Path) -> Path:
    return read_track(find_tracks(tree)[0]).frame_folder(1)


@needs_gl
def test_debug_pictures_are_written_where_they_are_asked_for(trees):
    assert not list(trees[False].rglob("debug.png"))
    (folder,) = find_tracks(trees[True])
    named = [name for name in read_checksums(folder) if name.endswith("debug.png")]
    assert len(named) == len(list(folder.rglob("debug.png"))) == 3
    for name in ("rgb.png", "depth_float32.png", "instance.png"):
        assert (frame_of(trees[True]) / name).read_bytes() == (frame_of(trees[False]) / name).read_bytes()


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
    with pytest.raises(InputError, match=r"has no debug\.png.*--map.*render\.debug=true"):
        four_panels(trees[False], tmp_path / "a.png")
    with pytest.raises(InputError):
        four_panels(trees[True], tmp_path / "a.png", frame="../../elsewhere")
