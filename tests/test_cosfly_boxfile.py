"""Maps of one's own: tables and GeoJSON of boxes as people write them, and what is wrong with others, all at once."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.kinds import KIND_NAMES
from cosfly.maps.boxfile import BoxesConfig, load, plausibility
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.runtime.errors import ConfigError, InputError

# Three boxes, as a table would have them: a turned house, a tree, a road.
PLAIN = """\
id,type,x_m,y_m,z_m,length_m,width_m,height_m,yaw_deg
7,Buildings,10,20,4,12,8,8,30
8,Vegetation,40,-5,3,4,4,6,0
9,Roads,25,0,-0.15,90,7,0.3,0
"""


def town() -> BoxMap:
    return invent(SyntheticConfig(size_m=120.0, num_blocks=1), 0)


def loaded(tmp_path: Path, text: str, suffix: str = ".csv", **settings: object) -> BoxMap:
    path = tmp_path / f"own{suffix}"
    path.write_text(text, encoding="utf-8")
    return load(BoxesConfig(path=path, **settings))  # type: ignore[arg-type]


def test_a_table_is_read(tmp_path, caplog):
    caplog.set_level("INFO")
    for text, settings in (
        (PLAIN, {}),
        (
            "\ufeffid, type ,note,x_m,y_m,length_m,width_m,height_m,yaw_deg\n7,house,a, 10 ,20,12,8,8,30\n\n"
            "8,Vegetation,b,40,-5,4,4,6,\n9,Roads,c,25,0,90,7,,0\n",
            {"types": {"house": "Buildings"}, "ignore": ["note"]},
        ),
    ):
        box_map = loaded(tmp_path, text, **settings)
        assert [KIND_NAMES[int(kind)] for kind in box_map.kinds] == ["Buildings", "Vegetation", "Roads"]
        assert box_map.ids.tolist() == [7, 8, 9]
        assert_allclose(box_map.centers, [[10, 20, 4], [40, -5, 3], [25, 0, -0.15]], atol=1e-9)
        assert_allclose(box_map.half_extents, [[6, 4, 4], [2, 2, 3], [45, 3.5, 0.15]], atol=1e-9)
        assert_allclose(box_map.rotations_deg[:, 1], [30, 0, 0], atol=1e-9)
    assert "6 to 8 m high, bases 0 to 0 m above the ground, yaw 0 to 30 degrees, 0% overlap another" in caplog.text
    box_map = loaded(tmp_path, PLAIN.replace("8,Vegetation,40,-5", "8,Vegetation,12,20"))
    assert "100% overlap another" in plausibility(box_map)


def collection(*features: dict, **more: object) -> str:
    return json.dumps({"type": "FeatureCollection", "features": list(features), **more})


def feature(kind: str, coordinates: list, **properties: object) -> dict:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def test_outlines_and_points_of_geojson(tmp_path):
    angled = [[0, 0], [20, 0], [20, 5], [5, 5], [5, 20], [0, 20], [0, 0]]
    box_map = loaded(
        tmp_path,
        collection(
            feature("Polygon", [[[100, 0], [110, 0], [110, 6], [100, 6], [100, 0]]], type="Buildings", height_m=9),
            feature("Polygon", [angled], type="Buildings", height_m=12, z_m=7.0),
            feature("Point", [50, 50], type="Vegetation", length_m=4, width_m=4, height_m=6),
            feature("Polygon", [[[0, -10], [120, -10], [120, -4], [0, -4], [0, -10]]], type="Roads"),
        ),
        ".geojson",
    )
    assert box_map.header.num_objects == 4
    assert box_map.counts() == {"Buildings": 3, "Roads": 1, "Vegetation": 1}  # the angled house is two boxes
    assert_allclose(sorted(np.prod(box_map.half_extents[box_map.kinds == 3][:, :2] * 2, axis=1)), [60, 75, 100])
    house = int(np.argmin(np.linalg.norm(box_map.centers - [105, 3, 4.5], axis=1)))
    assert_allclose(box_map.centers[house], [105, 3, 4.5])
    assert_allclose(box_map.maxs[box_map.kinds == 1][0], [120, -4, 0])


def test_longitude_and_latitude_become_metres(tmp_path):
    """At 52 degrees north a degree of latitude is 111,267 m, one of longitude 68,677 m (tables of WGS 84)."""
    ring = [[4.0, 52.0], [4.001, 52.0], [4.001, 52.001], [4.0, 52.001], [4.0, 52.0]]
    text = collection(feature("Polygon", [ring], type="Buildings", height_m=9))
    with pytest.raises(InputError, match=r"do not look like metres;.*maps\.boxes\.units=degrees"):
        loaded(tmp_path, text, ".geojson")
    with pytest.raises(InputError, match="do not look like degrees"):
        loaded(tmp_path, text.replace("52.001", "58.001"), ".geojson", units="degrees")
    box_map = loaded(tmp_path, text, ".geojson", units="degrees")
    size = sorted(box_map.half_extents[0, :2] * 2)
    assert_allclose(size, [68.677, 111.267], rtol=2e-4)


def test_ours_is_read_as_it_is_and_named_anew(tmp_path):
    write_boxes(tmp_path / "own.json", town())
    box_map = load(BoxesConfig(path=tmp_path / "own.json", name="Mine", licence="mit"))
    assert (box_map.name, box_map.header.licence, len(box_map)) == ("Mine", "mit", len(town()))
    with pytest.raises(ConfigError, match="its own types and ground height"):
        load(BoxesConfig(path=tmp_path / "own.json", ignore=["*"]))


def test_all_that_is_wrong_with_a_table_is_told(tmp_path, subtests):
    for text, words in [
            (PLAIN.replace("Vegetation", "vegetable").replace("Roads", "roads"),
             r"line 3: unknown type 'vegetable'.*line 4: unknown type 'roads' \(did you mean 'Roads'\?\); expected"),
            (PLAIN.replace(",yaw_deg", ",yaw_dge"), r"unknown column 'yaw_dge' \(did you mean 'yaw_deg'\?\)"),
            (PLAIN.replace("type,x_m", "name,x"), r"unknown column 'x'.*column type is missing.*column x_m is missing"),
            (PLAIN.replace("height_m,yaw_deg", "height_m,z_m"), "column z_m occurs twice"),
            (PLAIN.replace(",12,8,8,30", ",12,8,8"), "line 2: 8 cells, but the first line has 9"),
            (PLAIN.replace("12,8,8,30", '"12,5",8,8,30'), r"length_m is not a finite number: '12,5'"),
            (PLAIN.replace("12,8,8,30", "-12,8,8,30").replace("4,4,6,0", "4,4,nan,0"),
             r"line 2: length_m must be above 0; line 3: height_m is not a finite number: 'nan'"),
            (PLAIN.replace("20,4,12", "20,1e18,12"), "line 2: the box has no volume"),
            (PLAIN.replace("7,Buildings", "8,Buildings"), "ids must be different whole numbers"),
            (PLAIN.replace("7,Buildings", "x,Buildings"), "ids must be different whole numbers"),
            (PLAIN.replace(",", ";"), "column type is missing.*separated by commas"),
            ("", "has no boxes"),
            (PLAIN + "\"a", "not a CSV table"),
        ]:  # fmt: skip
        with subtests.test(text=text), pytest.raises(InputError, match=words):
            loaded(tmp_path, text)


def test_all_that_is_wrong_with_geojson_is_told(tmp_path, subtests):
    for text, words in [
            (collection(feature("LineString", [[0, 0], [1, 1]], type="Walls")),
             "feature 1: the geometry LineString is not supported; expected one of Point"),
            (collection(feature("Polygon", [[[0, 0], [9, 0]]], type="Walls")),
             "feature 1: the coordinates of the Polygon are invalid; expected \[x, y\], at least four points in a ring"),
            (collection(feature("Polygon", [[[0, 0], [9, "x"], [9, 9], [0, 0]]], type="Walls")),
             "of the Polygon are invalid; expected"),
            (collection(feature("Polygon", [[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]], type="Buildings", height_m=3)),
             r"feature 1: the outline crosses itself: Self-intersection\[4\.5 4\.5\]"),
            (collection(feature("Point", [5, 5], type="Vegetation", height_m=3)),
             "feature 1: length_m is missing, width_m is missing"),
            (collection(feature("Polygon", [[[0, 0], [9, 0], [9, 9], [0, 0]]], type="Buildings")),
             "feature 1: height_m is missing"),
            (
                collection(
                    {**feature("LineString", [[0, 0], [1, 1]], type="Walls"), "id": "way/7"},
                    feature("Point", [5, 5], type="Vegetation", name="old oak", height_m="tall"),
                    feature("Point", [5, 5], type="house", levels=3, length_m=4, width_m=4, height_m=6),
                ),
                r"unknown column 'levels'.*feature 1 \(way/7\): the geometry .* is not supported.*feature 2 \(old oak\): "
                r"length_m is missing, width_m is missing, height_m is not a finite number: 'tall'"
                r".*feature 3: unknown type 'house'.*expected columns .*types .*4 to fix",
            ),
            (json.dumps({"type": "Topology"}), "not GeoJSON"),
            (collection(), "has no boxes"),
        ]:  # fmt: skip
        with subtests.test(words), pytest.raises(InputError, match=words):
            loaded(tmp_path, text, ".geojson")


def test_a_file_is_needed_and_known_by_its_suffix(tmp_path):
    with pytest.raises(ConfigError, match=r"--set maps\.boxes\.path"):
        load(BoxesConfig())
    with pytest.raises(InputError, match=r"expected \.json, \.csv or \.geojson"):
        loaded(tmp_path, PLAIN, ".txt")
    with pytest.raises(ValueError, match="unknown type 'House'"):
        BoxesConfig(types={"haus": "House"})
