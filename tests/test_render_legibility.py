"""Whether a person can be made out: contrast, size and visibility, of the picture as written."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, write_inputs

from cosfly.formats.frames import LEGIBLE_CONTRAST, TargetMeta, frame_name, read_meta
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.render.camera import contrast_of, legibility
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.runtime.config import build


def test_contrast_is_of_the_person_against_what_is_around():
    rgb, is_person = np.full((90, 160, 3), 120, np.uint8), np.zeros((90, 160), bool)
    assert contrast_of(rgb, is_person) is None
    is_person[40:60, 70:78] = True
    assert contrast_of(rgb, is_person) == pytest.approx(0.0, abs=0.1)
    rgb[40:50, 70:78] = 30  # a dark jacket over trousers of the ground's colour
    dark = contrast_of(rgb, is_person)
    assert dark is not None
    assert dark > 30
    rgb[:, 120:] = 255  # far beside
    assert contrast_of(rgb, is_person) == dark
    fog = (0.95 * 150 + 0.05 * rgb.astype(float)).astype(np.uint8)
    assert (contrast_of(fog, is_person) or 0.0) < LEGIBLE_CONTRAST


@pytest.mark.parametrize(
    ("change", "is_legible"),
    [({}, True), ({"visible": False}, False), ({"visibility": 0.2}, False), ({"contrast": 3.0}, False),
     ({"contrast": None}, False), ({"bbox_2d": [0.0, 0.0, 6.0, 15.0]}, False), ({"bbox_2d": None}, False)],
)  # fmt: skip
def test_legible_is_what_the_bounds_say(change, is_legible):
    change = {"visible": True, "visibility": 0.9, "bbox_2d": [0.0, 0.0, 8.0, 20.0], "contrast": 20.0} | change
    target = TargetMeta.model_construct(**change)
    told = legibility(target, change["contrast"])
    assert told["legible"] == is_legible
    assert told["height_px"] == (0.0 if target.bbox_2d is None else target.bbox_2d[3])


@needs_gl
def test_legibility_is_of_the_picture_as_written(tmp_path):
    """In dense fog the person is visible, and nobody can make them out."""
    boxes, simplified, traces = write_inputs(tmp_path, [circling(3)])
    size = {"width_px": 320, "height_px": 180, "fovs_deg": [60], "tracks": ["clean"]}
    fog = {"thickest": {"cloudiness": 90.0, "precipitation": 0.0, "fog_density": 100.0, "fog_distance": 1.0}}
    (tmp_path / "fog.yaml").write_text(json.dumps({"presets": fog}))
    dim = {"weather_mode": "fixed", "weather_name": "thickest", "tod_name": "noon",
           "weather_pool": str(tmp_path / "fog.yaml")}  # fmt: skip
    found = {}
    for name, more in (("plain", {}), ("fog", dim)):
        tree = run(build(RenderConfig, size | more, "test"), boxes, simplified, traces, tmp_path / name)
        (folder,) = find_tracks(tree)
        flight = read_track(folder)
        found[name] = flight.told_legibility(1)
        told = read_meta(folder / frame_name(1)).target
        assert found[name] == told.model_dump(include=set(found[name]))
        assert flight.target_visible.all()
    assert found["plain"]["legible"] is True
    assert found["fog"]["legible"] is False
    assert float(found["fog"]["contrast"]) < LEGIBLE_CONTRAST
