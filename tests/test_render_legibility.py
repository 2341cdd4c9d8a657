"""Whether a person can be made out: contrast, size and visibility, of the picture as written."""

import json

from tables import each
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, write_inputs

from cosfly.formats.frames import LEGIBLE_CONTRAST, TargetMeta, frame_name, read_meta
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.render.camera import legibility
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.runtime.config import build


@each(
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
        found[name] = flight.legibility_at(1)
        told = read_meta(folder / frame_name(1)).target
        assert found[name] == told.model_dump(include=set(found[name]))
        assert flight.target.visible.all()
    assert found["plain"]["legible"] is True
    assert found["fog"]["legible"] is False
    assert float(found["fog"]["contrast"]) < LEGIBLE_CONTRAST
