"""The rim beyond a map: where it begins, whose it is, and that nobody but a renderer knows of it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from specimens_slopes import sloped_town

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.maps.stage import MapsConfig
from cosfly.maps.stage import load_map as load_source
from cosfly.render.contract import NO_INSTANCE, instance_ids
from cosfly.render.rim import FLIGHTS_TO_M, REACH_M, SOLIDS_FROM_M, check_outside_rim, rim_of
from cosfly.render.stage import open_renderer
from cosfly.runtime.config import build
from cosfly.runtime.errors import EnvironmentMissing, RenderError

FLAT = [KINDS["Terrain"], KINDS["Roads"]]


@cache
def delft(path: Path) -> BoxMap:
    return load_source(build(MapsConfig, {"source": "cityjson", "cityjson": {"path": path}}, "maps"), seed=0)


@cache
def town(preset: str = "grid") -> BoxMap:
    return load_source(build(MapsConfig, {"synthetic": {"preset": preset}}, "maps"), seed=0)


@pytest.fixture(params=["grid", "village", "delft", "hill"])
def box_map(request) -> BoxMap:
    if request.param == "hill":
        return sloped_town("hill")
    if request.param != "delft":
        return town(request.param)
    path = request.getfixturevalue("shared_data") / "delft-bgt-lod1" / "delft.json.gz"
    return delft(path)


@pytest.mark.slow
def test_what_stands_begins_where_no_flight_comes_and_fields_cover_the_ground(box_map: BoxMap):
    rim, (low, high) = rim_of(box_map, 0), box_map.bounds()
    flat = np.isin(rim.kinds, FLAT)
    assert set(np.unique(rim.kinds)) == {KINDS[name] for name in ("Terrain", "Roads", "Buildings", "Vegetation")}
    gaps = np.maximum(low - rim.maxs, rim.mins - high)[~flat, :2].max(axis=1)  # along the axis that parts them
    corner = np.linalg.norm(np.maximum(np.maximum(low - rim.maxs, rim.mins - high), 0.0)[~flat, :2], axis=1)
    assert (gaps > 0.0).all()
    assert corner.min() > SOLIDS_FROM_M
    assert SOLIDS_FROM_M > FLIGHTS_TO_M
    fields = rim.select(rim.kinds == KINDS["Terrain"])
    area = (4.0 * fields.half_extents[:, 0] * fields.half_extents[:, 1]).sum()
    assert area == pytest.approx(((high - low)[:2] + 2 * REACH_M).prod(), rel=1e-3)  # no field lies on another
    roads = rim.select(rim.kinds == KINDS["Roads"])
    assert not ((roads.mins < high) & (roads.maxs > low))[:, :2].all(axis=1).any()  # none on the map


def test_a_flight_that_comes_there_is_refused():
    box_map = town("village")
    east = box_map.bounds()[1][0]
    places = np.column_stack([east + np.array([0.0, FLIGHTS_TO_M - 1.0]), np.zeros(2), np.full(2, 20.0)])
    ones = np.ones(2)
    trace = DroneTrace("path_004", "hand", 0.5 * np.arange(2), places, 0 * places, places, ones, ones)
    check_outside_rim(trace, box_map)
    with pytest.raises(RenderError, match=r"path_004.*72 m") as error:
        check_outside_rim(replace(trace, positions_m=places + np.array([3.0, 0.0, 0.0])), box_map)
    assert "render.rim" in str(error.value.fix)


@pytest.mark.parametrize("name", ["gl", pytest.param("pyrender", marks=pytest.mark.slow)])
def test_pixels_of_the_map_stay_what_they_are_and_those_of_the_rim_are_nobodys(name: str):
    box_map = town("village")
    pose = world_from_camera(np.array([100.0, 30.0, 25.0]), np.array([-12.0, 20.0, 0.0]))
    frames = []
    for rim in (None, rim_of(box_map, 0)):
        try:
            renderer = open_renderer(name, box_map, 320, 180, rim=rim)
        except EnvironmentMissing as error:
            pytest.skip(str(error))
        frames.append(renderer.render(pose, intrinsic_matrix(320, 180, 75.0), None))
        renderer.close()
    bare, frame = frames
    own = bare.ids != NO_INSTANCE
    assert np.isin(np.unique(frame.ids), np.append(instance_ids(box_map), NO_INSTANCE)).all()
    assert 0.1 < own.mean() < 0.9
    for image in ("ids", "kinds"):
        assert (getattr(frame, image) == getattr(bare, image))[own].mean() > 0.999
    assert np.abs(frame.depth - bare.depth)[own & (frame.ids == bare.ids)].max() < 1e-3
    nobodys = frame.ids == NO_INSTANCE
    seen = {KINDS[kind] for kind in ("Terrain", "Roads", "Buildings", "Vegetation", "Sky")}
    assert set(np.unique(frame.kinds[nobodys])) == seen
    on_ground = (frame.kinds == KINDS["Terrain"]) & nobodys & (bare.depth < 300.0)
    assert np.abs(frame.depth - bare.depth)[on_ground].max() < 1e-3 * 300.0
