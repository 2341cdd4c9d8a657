"""Maps of one's own: tables and GeoJSON of boxes as people write them, and what is wrong with others, all at once."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosfly.errors import ConfigError, InputError
from cosfly.maps.boxfile import BoxesConfig, load
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.synthetic import load as invent
from cosfly.products.boxes import BoxMap, read_boxes, write_boxes
from cosfly.products.kinds import GROUND_KINDS, KIND_NAMES, KINDS

# Three boxes, as a table would have them: a turned house, a tree, a road.
PLAIN = """\
id,type,x,y,z,length,width,height,yaw_deg
7,Buildings,10,20,4,12,8,8,30
8,Vegetation,40,-5,3,4,4,6,0
9,Roads,25,0,-0.15,90,7,0.3,0
"""
FORMS = {
    "plain": (PLAIN, {}),
    "with a byte order mark, blanks and other names": (
        "\ufeffid, Category ,center_x,center_y,center_z,size_x,size_y,size_z,yaw\n"
        "7,Buildings, 10 ,20,4,12,8,8,30\n\n8,Vegetation,40,-5,3,4,4,6,\n9,Roads,25,0,-0.15,90,7,0.3,0\n",
        {},
    ),
    "half sizes and radians": (
        "id,kind,x,y,z,half_x,half_y,half_z,yaw_rad\n"
        "7,Buildings,10,20,4,6,4,4,0.5235987755982988\n"
        "8,Vegetation,40,-5,3,2,2,3,0\n9,Roads,25,0,-0.15,45,3.5,0.15,0\n",
        {},
    ),
    "foot and top": (
        "id,class,x,y,length,width,bottom,top,yaw\n"
        "7,Buildings,10,20,12,8,0,8,30\n8,Vegetation,40,-5,4,4,0,6,0\n9,Roads,25,0,90,7,-0.3,0,0\n",
        {},
    ),
    "heights over the ground, own names": (
        "id,type,x,y,length,width,height,yaw,note\n7,house,10,20,12,8,8,30,a\n"
        "8,tree,40,-5,4,4,6,0,b\n9,road,25,0,90,7,,0,c\n",
        {"types": {"house": "Buildings", "tree": "Vegetation", "road": "Roads"}, "ignore": ["note"]},
    ),
    "centimetres of a left-handed engine": (
        "id,type,x,y,z,extent_x,extent_y,extent_z,yaw\n"
        "7,Buildings,1000,-2000,400,600,400,400,-30\n"
        "8,Vegetation,4000,500,300,200,200,300,0\n9,Roads,2500,0,-15,4500,350,15,0\n",
        {"metres_per_unit": 0.01, "left_handed": True},
    ),
}  # fmt: skip


def town() -> BoxMap:
    return invent(SyntheticConfig(size_m=120.0, num_blocks=1), 0)


def loaded(tmp_path: Path, text: str, suffix: str = ".csv", **settings: object) -> BoxMap:
    path = tmp_path / f"own{suffix}"
    path.write_text(text, encoding="utf-8")
    return load(BoxesConfig(path=path, **settings))  # type: ignore[arg-type]


def test_a_table_in_any_form_says_the_same(tmp_path, subtests):
    for form in FORMS:
        with subtests.test(form=form):
            text, settings = FORMS[form]
            box_map = loaded(tmp_path, text, **settings)
            assert [KIND_NAMES[int(kind)] for kind in box_map.kinds] == ["Buildings", "Vegetation", "Roads"]
            assert box_map.ids.tolist() == [7, 8, 9]
            assert_allclose(box_map.centers, [[10, 20, 4], [40, -5, 3], [25, 0, -0.15]], atol=1e-9)
            assert_allclose(box_map.half_extents, [[6, 4, 4], [2, 2, 3], [45, 3.5, 0.15]], atol=1e-9)
            assert_allclose(box_map.rotations_deg[:, 1], [30, 0, 0], atol=1e-9)


def collection(*features: dict, **more: object) -> str:
    return json.dumps({"type": "FeatureCollection", "features": list(features), **more})


def feature(kind: str, coordinates: list, **properties: object) -> dict:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def test_outlines_and_points_of_geojson(tmp_path):
    angled = [[0, 0], [20, 0], [20, 5], [5, 5], [5, 20], [0, 20], [0, 0]]
    box_map = loaded(
        tmp_path,
        collection(
            feature("Polygon", [[[100, 0], [110, 0], [110, 6], [100, 6], [100, 0]]], type="Buildings", height=9),
            feature("Polygon", [angled], type="Buildings", height=12, base=1.0),
            feature("Point", [50, 50], type="Vegetation", length=4, width=4, height=6),
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
    box_map = loaded(tmp_path, collection(feature("Polygon", [ring], type="Buildings", height=9)), ".geojson")
    size = sorted(box_map.half_extents[0, :2] * 2)
    assert_allclose(size, [68.677, 111.267], rtol=2e-4)


def test_ours_is_read_as_it_is_and_named_anew(tmp_path):
    write_boxes(tmp_path / "own.json", town())
    box_map = load(BoxesConfig(path=tmp_path / "own.json", name="Mine", licence="mit"))
    assert (box_map.name, box_map.header.licence, len(box_map)) == ("Mine", "mit", len(town()))
    with pytest.raises(ConfigError, match=r"maps\.boxes: boxes_3d\.json has its own types.*got metres_per_unit"):
        load(BoxesConfig(path=tmp_path / "own.json", metres_per_unit=0.01))
    with pytest.raises(ConfigError, match=r"and ground.*got ground_z_m"):
        load(BoxesConfig(path=tmp_path / "own.json", ground_z_m=4.0))
    boxes = replace(town(), centers=town().centers * 100, half_extents=town().half_extents * 100)
    write_boxes(tmp_path / "own.json", boxes)
    with pytest.raises(InputError, match=r"are these centimetres\?.*write all of the file in metres"):
        load(BoxesConfig(path=tmp_path / "own.json"))


def test_what_is_wrong_with_many_rows_hides_nothing_else(tmp_path):
    rows = [f"house,{x},0,4,4,6" for x in range(0, 400, 10)] + ["road,5,5,90,7,wide"]
    with pytest.raises(InputError) as caught:
        loaded(tmp_path, "\n".join(["type,x,y,length,width,height", *rows]))
    assert "line 2: unknown type 'house' (and 39 more)" in str(caught.value)
    line_42 = "line 42: unknown type 'road' (did you mean 'Roads'?), height is not a finite number: 'wide'"
    assert line_42 in str(caught.value)
    assert "2 to mend" in str(caught.value)


def test_the_documents_list_every_type():
    page = (Path(__file__).parents[1] / "docs/files.md").read_text(encoding="utf-8")
    listed = page[page.index("Types of surfaces") : page.index("A height without `z`")]
    assert set(re.findall(r"`(\w+)`", listed)) == KINDS.keys() - {"NONE"}
    surfaces = re.findall(r"`(\w+)`", listed.partition(".")[0])
    assert {KINDS[name] for name in surfaces} == GROUND_KINDS


def test_a_map_far_from_the_origin_is_moved_there_and_says_so(tmp_path):
    far = {",10,20,4": ",500010,5000020,4", ",40,-5,3": ",500040,4999995,3", ",25,0,-": ",500025,5000000,-"}
    text = PLAIN
    for near, place in far.items():
        text = text.replace(near, place)
    box_map = loaded(tmp_path, text)
    assert box_map.header.offset_m == {"x": 500025.0, "y": 5000010.0, "z": 0.0}
    assert np.abs(box_map.centers).max() < 100


def test_all_that_is_wrong_with_a_table_is_told(tmp_path, subtests):
    for text, settings, words in [
            (PLAIN.replace("Vegetation", "vegetable").replace("Roads", "roads"), {},
             r"line 3: unknown type 'vegetable' \(did you mean 'Vegetation'\?\); "
             r"line 4: unknown type 'roads' \(did you mean 'Roads'\?\); expected types are Roads.*2 to mend"),
            (PLAIN.replace(",yaw_deg", ",yaw_dge"), {},
             r"column 'yaw_dge' has no meaning here \(did you mean 'yaw_deg'\?\).*maps\.boxes\.ignore"),
            (PLAIN.replace("type,x", "note,x"), {"ignore": ["note"]},
             r"no column for type \(type, category, kind, class\)"),
            (PLAIN.replace("height,yaw_deg", "height,half_z"), {}, "height twice, whole and half"),
            (PLAIN.replace("height,yaw_deg", "height,center_z"), {}, "2 columns are the z: z, center_z"),
            (PLAIN.replace(",12,8,8,30", ",12,8,8"), {}, "line 2: 8 cells, where the first line has 9"),
            (PLAIN.replace("12,8,8,30", '"12,5",8,8,30'), {},
             r"length is not a finite number: '12,5'; write a decimal point"),
            (PLAIN.replace("12,8,8,30", "-12,8,8,30").replace("4,4,6,0", "4,4,nan,0"), {},
             r"line 2: length is not more than 0: -12 m; line 3: height is not a finite number: 'nan'"),
            (PLAIN.replace("7,Buildings", "8,Buildings"), {}, "id 8 occurs 2 times"),
            (PLAIN.replace("7,Buildings", "x,Buildings"), {}, "id 'x' is not a whole number"),
            (PLAIN.replace(",10,20,4", ",1000,200000000,4"), {}, r"are these centimetres\?.*metres_per_unit=0\.01"),
            (PLAIN.replace("12,8,8,30", "12,8,800,30"), {}, r"too high: are these centimetres\?.*usually 800 m"),
            ("x,y,length,type\n1,2,3,Buildngs\n1,zz,3,Buildings\n", {},
             r"no column for width .*; line 2: unknown type 'Buildngs'.*; line 3: y is not .*3 to mend"),
            (PLAIN.replace(",width,height", ",note,height"), {"ignore": ["note"]},
             r"csv: no column for width \(width, size_y, half_width, half_y, extent_y\)$"),
            (PLAIN.replace(",", ";"), {},
             r"line 1: the columns are not parted by commas|parted by commas.*line 1.*expected commas, where ; stand"),
            (PLAIN.replace(",", "\t"), {}, r"commas, where tabs stand"),
            ("", {}, r"holds no boxes; got nothing after the first line; expected a box a line.*docs/files\.md"),
            (PLAIN + "\"a", {}, "not a table"),
        ]:  # fmt: skip
        with subtests.test(text=text, settings=settings), pytest.raises(InputError, match=words):
            loaded(tmp_path, text, **settings)


def test_all_that_is_wrong_with_geojson_is_told(tmp_path, subtests):
    for text, words in [
            (collection(feature("LineString", [[0, 0], [1, 1]], type="Walls")),
             "feature 1: a geometry that has no place here, LineString; there are Point"),
            (collection(feature("Polygon", [[[0, 0], [9, 0]]], type="Walls")),
             "feature 1: its coordinates are not places: at least four finite"),
            (collection(feature("Polygon", [[[0, 0], [9, "x"], [9, 9], [0, 0]]], type="Walls")),
             "not places: at least four"),
            (collection(feature("Polygon", [[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]], type="Buildings", height=3)),
             r"feature 1: the outline crosses itself: Self-intersection\[4\.5 4\.5\]"),
            (collection(feature("Point", [5, 5], type="Vegetation", height=3)),
             "feature 1: neither length nor half_length"),
            (collection(feature("Polygon", [[[0, 0], [9, 0], [9, 9], [0, 0]]], type="Buildings")),
             "feature 1: neither height nor half_height"),
            (collection(feature("Polygon", [[[0, 0], [9, 0], [9, 9], [0, 9]]], type="Buildings", height=3)),
             "the last the first again"),
            (
                collection(
                    {**feature("LineString", [[0, 0], [1, 1]], type="Walls"), "id": "way/7"},
                    feature("Point", [5, 5], type="Vegetation", name="old oak", height="tall"),
                    feature("Point", [5, 5], type="house", levels=3, length=4, width=4, height=6),
                ),
                r"properties: column 'levels' has no meaning.*feature 1 \(way/7\): a geometry.*feature 2 \(old oak\): "
                r"height is not a finite number: 'tall'"
                r".*feature 3: unknown type 'house'.*expected columns .*types are .*4 to mend",
            ),
            (json.dumps({"type": "Topology"}), "not GeoJSON"),
            (collection(), "holds no boxes"),
        ]:  # fmt: skip
        with subtests.test(words), pytest.raises(InputError, match=words):
            loaded(tmp_path, text, ".geojson")


HOUSES = [f"Buildings,{40 * (k % 5)},{40 * (k // 5)},20,15,{9 + k % 4},{20 * k % 90}" for k in range(25)]


def town_table(*rows: str, yaw: str = "yaw_deg", houses: list[str] = HOUSES) -> str:
    return "\n".join([f"type,x,y,length,width,height,{yaw}", *houses, *rows])


def test_what_can_be_meant_and_hardly_is_gets_a_warning(tmp_path, caplog, subtests):
    for text, words in [
            (town_table(houses=[re.sub(r"\d+$", lambda deg: f"{np.radians(int(deg[0])):.3f}", row) for row in HOUSES]),
             "all 22 yaws lie within 1.4 degrees.*yaw_rad"),
            (town_table(*[HOUSES[3]] * 20), "20 of 45 boxes repeat another exactly"),
            (town_table(*(f"Buildings,10,10,12,8,{5 + 0.1 * k},0" for k in range(150))),
             "150 of 175 buildings have their middle at x 10, y 10"),
            (town_table(), ""),
            (town_table(*("Buildings,7,7,4,4,3,5", "Buildings,17,7,4,4,3,5", "Buildings,27,7,4,4,3,2"), houses=[]), ""),
        ]:  # fmt: skip
        with subtests.test(words):
            caplog.clear()
            loaded(tmp_path, text)
            assert len(caplog.messages) == bool(words)
            assert re.search(words, caplog.text)


def test_degrees_as_radians_and_a_town_off_its_ground_are_refused(tmp_path):
    words = r"line 3: yaw_rad is more than a full turn of 6\.2832; .* yaw_deg \(and 21 more\)"
    with pytest.raises(InputError, match=words):
        loaded(tmp_path, town_table(yaw="yaw_rad"))
    for middle_m, words in (
        (-45, "lies below the ground; got 5 boxes, the highest ends 40 m below it"),
        (45, "lies high above the ground; got 5 boxes, the lowest begins 40 m above it"),
    ):
        houses = [f"Buildings,{30 * k},0,{middle_m},9,9,10" for k in range(5)]
        town = "\n".join(["type,x,y,z,length,width,height", "Roads,0,0,-50,90,7,0.2", *houses])
        with pytest.raises(InputError, match=rf"{words}.*--set maps.boxes.ground_z_m={middle_m - 5}$"):
            loaded(tmp_path, town)
        assert len(loaded(tmp_path, town, ground_z_m=middle_m - 5.0)) == 6


def test_a_file_is_needed_and_known_by_its_suffix(tmp_path):
    with pytest.raises(ConfigError, match=r"--set maps\.boxes\.path"):
        load(BoxesConfig())
    with pytest.raises(InputError, match=r"expected \.json, \.csv or \.geojson"):
        loaded(tmp_path, PLAIN, ".txt")
    with pytest.raises(ValueError, match="there is no type 'House'"):
        BoxesConfig(types={"haus": "House"})


def test_what_a_map_tells_beside_its_boxes_must_follow_from_them(tmp_path, subtests):
    for old, new, words in [
        ('"id":1,', '"id":1,"yaw":3,', r"boxes\[0\]\.yaw: Extra inputs"),
        ("x east, y north", "x forward, y right", r"axes: not what its boxes are.*expected right-handed"),
        ('"num_boxes": ', '"num_boxes": 1', "num_boxes: not what its boxes are"),
        ('"Buildings": ', '"Buildings": 1', "counts: not what its boxes are"),
        ('"semantic_id":3', '"semantic_id":4', "semantic_id: not the number of its type; got 4; expected 3, Buildings"),
        ('"max":[', '"max":[8', "max: does not follow from center, extent and rotation"),
    ]:
        with subtests.test(old=old, new=new):
            path = tmp_path / "boxes_3d.json"
            write_boxes(path, town())
            assert old in path.read_text()
            path.write_text(path.read_text().replace(old, new, 1))
            with pytest.raises(InputError, match=words):
                read_boxes(path)
