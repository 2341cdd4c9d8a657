"""Maps of one's own: tables and GeoJSON of boxes as people write them, and what is wrong with others, all at once."""

import contextlib
import json
import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapely import LineString, MultiLineString, Point, Polygon, affinity, union_all

from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.maps.box_rows import BoxesConfig
from cosfly.maps.boxfile import load
from cosfly.maps.footprints import CUT_SHARES, footprints, num_cuts
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


def loaded(tmp_path: Path, text: str, suffix: str = ".csv", **settings: object) -> BoxMap:
    path = tmp_path / f"own{suffix}"
    path.write_text(text, encoding="utf-8")
    return load(BoxesConfig(path=path, **settings))  # type: ignore[arg-type]


def test_a_table_is_read(tmp_path):
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


def square(x: float, y: float, side: float = 12.0, height: float | None = None) -> list:
    ring = [[x, y], [x + side, y], [x + side, y + side], [x, y + side], [x, y]]
    return [[[*place, height] for place in ring] if height is not None else ring]


def houses(x: float = 0.0, y: float = 0.0, scale: float = 1.0, **properties: object) -> list[dict]:
    """Nine houses of 12 m, 40 m apart."""
    properties = {"type": "Buildings", "height_m": 9} | properties
    corners = [(x + 40 * scale * (k // 3), y + 40 * scale * (k % 3)) for k in range(9)]
    return [feature("Polygon", square(*corner, 12 * scale), **properties) for corner in corners]


DEGREES = 1 / 111_320  # of latitude in a metre


def test_longitude_and_latitude_become_metres(tmp_path, subtests):
    """At 52 degrees north a degree of latitude is 111,267 m, one of longitude 68,677 m (tables of WGS 84)."""
    ring = [[4.0, 52.0], [4.001, 52.0], [4.001, 52.001], [4.0, 52.001], [4.0, 52.0]]
    town = [feature("Polygon", [ring], type="Buildings", height_m=9)]
    for settings, more in (({}, {}), ({"units": "degrees"}, {}), ({}, {"crs": crs("urn:ogc:def:crs:OGC:1.3:CRS84")})):
        box_map = loaded(tmp_path, collection(*town, **more), ".geojson", **settings)
        assert_allclose(sorted(box_map.half_extents[0, :2] * 2), [68.677, 111.267], rtol=2e-4)
    with pytest.raises(InputError, match=r"too small to be metres;.*maps\.boxes\.units=degrees"):
        loaded(tmp_path, collection(*town), ".geojson", units="m")
    with pytest.raises(InputError, match="too large to be degrees"):
        loaded(tmp_path, collection(*houses()), ".geojson", units="degrees")
    with pytest.raises(InputError, match="fit both metres and degrees"):
        loaded(tmp_path, collection(*houses(scale=0.01)), ".geojson")
    lake = feature("Polygon", square(4.0, 52.0, 0.03), type="Roads")
    assert loaded(tmp_path, collection(lake, crs=crs("EPSG:4326")), ".geojson").half_extents.max() > 1_000
    with pytest.raises(InputError, match="too large to be degrees"):
        loaded(tmp_path, collection(*houses(), crs=crs("EPSG:4326")), ".geojson")
    table = "type,x,y,length,width,height\n" + "".join(f"Buildings,4.{k},52.{k},9,9,9\n" for k in (3001, 3002, 3004))
    with pytest.raises(InputError, match=r"too small to be metres;.*maps\.boxes\.units=degrees"):
        loaded(tmp_path, table)
    assert len(loaded(tmp_path, table, units="degrees")) == 3
    across = loaded(tmp_path, collection(*houses(179.9995, -17.0, DEGREES)), ".geojson")  # the date line
    assert np.ptp(across.centers[:, 0]) < 90


def crs(name: str) -> dict:
    return {"type": "name", "properties": {"name": name}}


def test_a_declared_coordinate_system_is_used_or_refused_by_name(tmp_path, subtests):
    for name in ("EPSG:28992", "urn:ogc:def:crs:EPSG::25832", "http://www.opengis.net/def/crs/EPSG/0/32631"):
        assert len(loaded(tmp_path, collection(*houses(85_000, 447_000), crs=crs(name)), ".geojson")) == 9
    for declared, words in (
        (crs("urn:ogc:def:crs:EPSG::2263"), "EPSG::2263"),
        (crs("EPSG:3857"), "EPSG:3857"),  # metres, but not true ones
        (crs("ESRI:102718"), "ESRI:102718"),
        (crs("EPSG:999999"), "EPSG:999999"),
        ({"type": "EPSG", "properties": {"code": 2263}}, "2263"),
        ({"type": "link", "properties": {"href": "http://spatialreference.org/ref/epsg/2263/proj4/"}}, "epsg/2263"),
        ("EPSG:2263", "EPSG:2263"),
    ):
        with subtests.test(words), pytest.raises(InputError, match=f"crs: the declared.*{words}.*m, ft or us-ft"):
            loaded(tmp_path, collection(*houses(985_000, 199_000), crs=declared), ".geojson")
    in_feet = loaded(tmp_path, collection(*houses(985_000, 199_000, 3.2808), crs=crs("EPSG:2263")), ".geojson",
                     units="us-ft")  # fmt: skip
    assert_allclose(2 * in_feet.half_extents[0], [12, 12, 9], rtol=1e-4)


def test_a_bad_feature_is_skipped_and_counted(tmp_path, caplog, subtests):
    fine = houses()
    bow = [[[500, 0], [520, 20], [520, 0], [500, 20], [500, 0]]]
    for bad, reason, words in (
        (feature("Point", [4e6, 4e6], type="Vegetation", name="stray", length_m=4, width_m=4, height_m=6),
         "far_away", r"feature 10 \(stray\): it is 5,?\d*,000 km|feature 10 \(stray\): it is 4,000 km"),
        ({"type": "Feature", "properties": {"type": "Walls"}, "geometry": None}, "bad_geometry", "geometry None"),
        (5, "bad_geometry", "geometry None"),
        (feature("Polygon", [], type="Walls", height_m=2), "bad_geometry", "are invalid"),
        (feature("Polygon", [[[0, 0], [9, 0], [0, 0], [0, 0]]], type="Walls", height_m=2), "no_area", "no area"),
        (feature("Polygon", [[[5, 5]] * 5], type="Walls", height_m=2), "no_area", "no area"),
        (feature("Polygon", square(200, 0), type="House", height_m=2), "unknown_type", "unknown type 'House'"),
        (feature("Polygon", square(200, 0), type="Walls", height_m=-2), "bad_value", "must be above 0"),
        (feature("Polygon", square(200, 0), type="Walls", height="tall"), "bad_value", "'tall'"),
        (feature("Polygon", bow, type="Buildings", height_m=9), "", "crosses itself and is repaired"),
        (feature("Polygon", square(200, 0, 0.1), type="Poles", height_m=4), "", ""),
    ):  # fmt: skip
        caplog.clear()
        with subtests.test(words):
            box_map = loaded(tmp_path, collection(*fine, bad), ".geojson")
            assert box_map.header.dropped_objects == ({reason: 1} if reason else {})
            assert box_map.header.num_objects == 10
            assert len(box_map) >= 9 + (not reason)
            assert re.search(words, caplog.text)
    with pytest.raises(InputError, match=r"geometry None.*at most 20% invalid rows \(maps\.boxes\.most_skipped\)"):
        loaded(tmp_path, collection(*fine, *[{"type": "Feature", "properties": {}, "geometry": None}] * 3), ".geojson")
    with pytest.raises(InputError, match="feature 10"):
        loaded(tmp_path, collection(*fine, 5), ".geojson", most_skipped=0.0)
    towns = [feature("Polygon", square(4 + k, 52, 1e-4), type="Buildings", height_m=9) for k in range(5)]
    with pytest.raises(InputError, match=r"feature 1: it is 137 km from the middle of the map, at 4, 52"):
        loaded(tmp_path, collection(*towns), ".geojson")


def test_z_of_coordinates_is_reported(tmp_path, caplog):
    outlines = [feature("Polygon", square(40 * k, 0, 12, 34 + k), type="Buildings", height_m=9) for k in range(3)]
    assert_allclose(loaded(tmp_path, collection(*outlines), ".geojson").mins[:, 2], 0)
    assert "z of coordinates, 34 to 36, is ignored" in caplog.text


def test_declared_heights_are_used(tmp_path, subtests):
    for properties, low_m, high_m in (
        ({"height": 12}, 0, 12),
        ({"height": "12 m"}, 0, 12),
        ({"height": "12.5m"}, 0, 12.5),
        ({"height": "40'"}, 0, 12.192),
        ({"height": "40 ft"}, 0, 12.192),
        ({"height": "39'4\""}, 0, 11.9888),
        ({"building:levels": "3"}, 0, 9),
        ({"num_floors": 4, "min_floor": 1}, 3, 12),
        ({"height": "12", "min_height": "3 m"}, 3, 12),
        ({"height_m": 8, "building:levels": "3"}, 0, 8),
    ):
        with subtests.test(properties):
            house = feature("Polygon", square(0, 0), type="Buildings", **properties)
            box_map = loaded(tmp_path, collection(house), ".geojson")
            assert_allclose([box_map.mins[0, 2], box_map.maxs[0, 2]], [low_m, high_m])
    for properties in ({"height": "2;3"}, {"height": True}, {"height": 3, "min_height": 12}, {"building:levels": "x"}):
        house = feature("Polygon", square(0, 0), type="Buildings", **properties)
        with subtests.test(properties), pytest.raises(InputError):
            loaded(tmp_path, collection(house), ".geojson")


def test_openstreetmap_and_overture_need_the_name_of_the_type_column(tmp_path, caplog):
    at = 4.3, 52.0
    way = [[4.2995, 52.0003], [4.3005, 52.0003], [4.3005, 52.0013]]
    town = [{**one, "properties": {"@id": f"way/{k}", "building": "yes", "height": "12 m"}}
            for k, one in enumerate(houses(*at, DEGREES))]  # fmt: skip
    town += [
        feature("LineString", way, highway="residential", lanes="2", name="Main street"),
        feature("MultiLineString", [way], highway="footway", width="2 m"),
        feature("Point", [4.3001, 52.0001], natural="tree"),
        feature("Point", [4.3002, 52.0001], amenity="bench"),
        feature("LineString", way, highway="primary", tunnel="yes"),
        feature("LineString", way, highway="footway", width="2 m", tunnel="building_passage"),
        feature("MultiPolygon", [square(4.302, 52.0, 1e-4)], building="church", **{"building:levels": "2"}),
    ]
    osm = loaded(tmp_path, collection(*town), ".geojson", type_column="building,highway,natural",
                 derive_pavements=False)  # fmt: skip
    assert osm.counts() == {"Buildings": 10, "Roads": 2, "Sidewalks": 4, "Vegetation": 1}
    assert_allclose(np.unique(2 * osm.half_extents[osm.kinds == 1][:, 1]), 7.0)
    assert osm.header.num_objects == 16
    assert osm.header.dropped_objects == {"unmapped_type": 1, "underground": 1}
    assert osm.header.extent_sources == {"file": 15, "default": 1, "levels": 1}
    assert "1 a default size" in caplog.text
    of_ogr = [{**one, "properties": {"building": "yes", "other_tags": '"roof"=>"a \\"b\\"","height"=>"12 m"', "height": None}}
              for one in houses(*at, DEGREES)]  # fmt: skip
    box_map = loaded(tmp_path, collection(*of_ogr), ".geojson", type_column="building,highway,natural")
    assert_allclose(2 * box_map.half_extents[:, 2], 12.0)
    overture = [{**one, "properties": {"id": f"08-{k}", "sources": [{}], "class": "house" if k else None,
                                       "num_floors": 3, "height": 11.5 if k % 2 else None}}
                for k, one in enumerate(houses(*at, DEGREES))]  # fmt: skip
    overture.append(feature("LineString", way, subtype="road", **{"class": "residential"}))
    box_map = loaded(tmp_path, collection(*overture), ".geojson", type_column="class")
    assert box_map.counts() == {"Buildings": 9, "Roads": 2, "Sidewalks": 4}
    assert box_map.header.extent_sources == {"levels": 5, "file": 4, "default": 6}
    with pytest.raises(InputError, match="not used: class=x 1"):
        loaded(tmp_path, collection(feature("Point", way[0], **{"class": "x"})), ".geojson", type_column="class")


@pytest.mark.parametrize(("tags", "sides"), [
    ({}, (1, 1)), ({"sidewalk": "both"}, (1, 1)), ({"sidewalk": "no"}, (0, 0)), ({"sidewalk": "separate"}, (0, 0)),
    ({"sidewalk": "left"}, (1, 0)), ({"sidewalk": "right"}, (0, 1)), ({"sidewalk:left": "no"}, (0, 1)),
    ({"sidewalk:both": "no"}, (0, 0)), ({"sidewalk:both": "no", "sidewalk:right": "yes"}, (0, 1)),
    ({"highway": "service"}, (0, 0)), ({"highway": "motorway"}, (0, 0)),
])  # fmt: skip
def test_streets_get_the_pavements_that_their_tags_allow(tmp_path, tags, sides):
    """A street of 6 m to the north-east, with the left pavement in the north-west."""
    street = feature("LineString", [[0, 0], [70, 70]], **{"highway": "residential", "width": "6"} | tags)
    box_map = loaded(tmp_path, collection(street), ".geojson", type_column="highway", units="m")
    header = box_map.header
    assert header.num_objects == 1
    assert header.added_boxes == header.derived_ground == sum(sides)
    assert ("Pavements are derived by cosfly" in header.credits) == any(sides)
    pavements = box_map.select(box_map.kinds == KINDS["Sidewalks"])
    offsets_m = (pavements.centers[:, 1] - pavements.centers[:, 0]) / np.sqrt(2)
    assert_allclose(sorted(offsets_m), [4.0 * side for side in (-1, 1) if sides[side < 0]], atol=1e-3)
    assert_allclose(2 * pavements.half_extents[:, 1], 2.0)


def test_pavements_leave_carriageways_and_mapped_pavements_free(tmp_path):
    """A crossing of a bent street of two ways and a side street, and a mapped footway along a part of it."""
    turned = affinity.rotate(
        MultiLineString([[[0, 0], [60, 0]], [[60, 0], [110, 20]], [[60, 0], [60, -50]]]), 17, (0, 0)
    )
    ways = [feature("LineString", np.asarray(line.coords).tolist(), highway="residential") for line in turned.geoms]
    path = affinity.rotate(LineString([[10, 4.5], [30, 4.5]]), 17, (0, 0))
    ways.append(feature("LineString", np.asarray(path.coords).tolist(), highway="footway"))
    mapped, both = (
        loaded(tmp_path, collection(*ways), ".geojson", type_column="highway", units="m", derive_pavements=derive)
        for derive in (False, True)
    )
    roads, footway = (
        union_all(footprints(mapped.select(mapped.kinds == KINDS[kind]))) for kind in ("Roads", "Sidewalks")
    )
    derived = union_all(footprints(both)[len(mapped) :])
    assert derived.intersection(roads).area < 0.02 * derived.area
    assert derived.intersection(footway).area < 2.1  # half a metre of the 2 m at each end
    # Along every street of 7 m, but for the crossing and the mapped footway, both sides are paved without a gap.
    for line in turned.geoms:
        for side in (-4.5, 4.5):
            edge = line.offset_curve(side)
            free = edge.difference(roads.buffer(0.6)).difference(footway.buffer(0.6))
            assert free.difference(derived).length < 0.01 * edge.length


def test_crossings_have_stripes_and_footways_end_at_the_kerb(tmp_path):
    """A street of 7 m along x, with a crossing as a way and as a node, and footways that cross it or end in it."""
    features = [
        feature("LineString", [[0, 0], [90, 0]], highway="residential", sidewalk="no"),
        feature("LineString", [[20, -8], [20, 8]], highway="footway", footway="crossing"),
        feature("Point", [60, 0], highway="crossing", crossing="zebra"),
        feature("Point", [20, 0], highway="crossing"),  # of the way
        feature("LineString", [[40, 0], [40, 20]], highway="footway"),
        feature("LineString", [[45, -20], [45, 20]], highway="footway", bridge="yes"),
    ]
    made = loaded(tmp_path, collection(*features), ".geojson", type_column="highway", units="m")
    paint = made.select(made.kinds == KINDS["RoadLines"])
    assert_allclose(np.unique(np.round(paint.centers[:, 0], 3)), [20.0, 60.0])
    assert_allclose(np.sort(paint.centers[paint.centers[:, 0] > 50, 1]), np.arange(-3.0, 3.5))
    assert_allclose(np.sort(2 * paint.half_extents[:, :2]), [[0.5, 3.0]] * len(paint))
    paths = footprints(made.select(made.kinds == KINDS["Sidewalks"]))
    bridge = [path for path in paths if path.distance(Point(45, 0)) < 0.1]
    assert len(bridge) == 1
    assert all(path.distance(LineString([[0, 0], [90, 0]])) > 2.9 for path in paths if path not in bridge)
    assert made.header.dropped_objects == {"unmapped_type": 1}


def test_streets_and_rows_out_of_proportion_are_refused(tmp_path):
    ends = [([[0, 3 * k], [900, 3 * k]], [[3 * k, 0], [3 * k, 900]]) for k in range(300)]
    grid = [feature("LineString", line, highway="residential") for lines in ends for line in lines]
    rows = [feature("LineString", [[0, k], [19_000, k]], natural="tree_row") for k in range(30)]
    for features, words in ((grid, "streets with more than"), (rows, "71,250 trees")):
        with pytest.raises(InputError, match=words):
            loaded(tmp_path, collection(*features), ".geojson", type_column="highway,natural", units="m")


STREET_TAGS = (
    {"highway": "residential"}, {"highway": "residential", "width": "0"}, {"highway": "footway"},
    {"highway": "footway", "footway": "crossing"}, {"highway": "crossing"}, {"highway": "secondary", "bridge": "yes"},
    {"natural": "tree_row"}, {"natural": "water"}, {"barrier": "wall"}, {"building": "yes"},
)  # fmt: skip


def test_streets_of_any_shape_are_read_or_refused(tmp_path):
    """Lines and outlines that cross themselves, end where they begin, have no length, or lie on each other."""
    for seed in range(60, 100):  # in 86, water lies wholly below bridges
        rng = np.random.default_rng(seed)
        features = []
        for _ in range(rng.integers(1, 14)):
            line = rng.choice([0.0, 10.0, 20.0, 20.00001, 37.3], (rng.integers(2, 7), 2)).tolist()
            coordinates = {"Point": line[0], "LineString": line, "MultiLineString": [line, line[:2]],
                           "Polygon": [[*line, [0.0, 0.0], line[0]]]}  # fmt: skip
            form = str(rng.choice(list(coordinates)))
            features.append(feature(form, coordinates[form], **STREET_TAGS[rng.integers(len(STREET_TAGS))]))
        with contextlib.suppress(InputError):
            loaded(
                tmp_path, collection(*features), ".geojson", type_column="building,highway,natural,barrier", units="m"
            )


def test_tags_of_openstreetmap_mean_what_they_say(tmp_path, caplog):
    yard = square(0, 0, 20)
    features = [
        feature("LineString", [[0, 50], [40, 50]], natural="tree_row"),
        feature("Polygon", yard, landuse="residential", barrier="wall"),
        feature("Polygon", square(60, 0), building="yes", height="ca. 9"),
        feature("Polygon", square(90, 0), building="yes", layer="-1"),
        feature("Polygon", square(120, 0), building="yes", location="underground"),
        feature("Polygon", square(150, 0), building="roof"),
        feature("Polygon", [*square(180, 0, 40), *square(190, 12, 10)], building="yes"),
    ]
    columns = {"type_column": "building,natural,landuse,barrier", "units": "m", "types": {"roof": "NONE"}}
    made = loaded(tmp_path, collection(*features), ".geojson", **columns)
    assert made.counts() == {"Vegetation": 6, "Walls": 4, "Buildings": 1 + 10}
    assert not any(footprint.contains(Point(195, 17)) for footprint in footprints(made))  # a yard of 6 %
    assert made.header.dropped_objects == {"underground": 2, "unmapped_type": 1}
    assert "height_m='ca. 9': the value is not a number, so a default is used" in caplog.text


def test_bounds_crop_features_and_tables(tmp_path):
    text = collection(
        feature("LineString", [[-3000, 0], [3000, 0]], highway="residential", sidewalk="no"),
        feature("Point", [500, 5], natural="tree"),
        feature("Polygon", [[[0, 20], [90, 20], [0, 40], [90, 40], [0, 20]]], building="yes"),  # crosses itself
    )
    settings = {"type_column": "highway,natural,building", "units": "m"}
    cropped = loaded(tmp_path, text, ".geojson", bounds=(-50, -50, 60, 50), **settings)
    low, high = cropped.bounds()
    assert_allclose([low[0], high[0]], [-50, 60], atol=4)  # boxes of lines are longer by half of their width
    assert cropped.header.dropped_objects == {"outside_bounds": 1}
    table = loaded(tmp_path, PLAIN, bounds=(0, -1, 30, 30))
    assert (len(table), table.header.dropped_objects) == (2, {"outside_bounds": 1})
    with pytest.raises(InputError, match=r"bounds contains no part .*\[100.* within -3000, 0, 3000, 40"):
        loaded(tmp_path, text, ".geojson", bounds=(100, 100, 200, 200), **settings)
    with pytest.raises(ValueError, match="west < east"):
        BoxesConfig(bounds=(10, 0, 0, 10))


def test_streets_and_buildings_are_as_pedestrians_meet_them(tmp_path, caplog):
    caplog.set_level("INFO")
    pond = Point(30, 30).buffer(5)
    text = collection(
        feature("Polygon", square(0, 0, 60), highway="pedestrian", area="yes"),
        feature("Polygon", [list(map(list, pond.exterior.coords))], natural="water"),
        feature("Polygon", square(100, 0, 30), building="yes"),
        feature("LineString", [[90, 15], [140, 15]], highway="footway", tunnel="building_passage"),
        feature("LineString", [[-50, -40], [50, -40]], waterway="stream", width="3"),
        feature("LineString", [[0, -80], [0, -20]], highway="service"),
        feature("Polygon", square(200, 0, 40), natural="wood"),
        feature("LineString", [[0, 90], [50, 90]], barrier="bollard"),
        feature("Polygon", square(300, 0), building="roof", height="5"),
    )
    columns = {"type_column": "building,highway,natural,waterway,barrier", "units": "m"}
    box_map = loaded(tmp_path, text, ".json", **columns)  # as an editor may name it
    areas = {
        kind: union_all(footprints(box_map)[box_map.kinds == KINDS[kind]])
        for kind in ("Sidewalks", "Water", "Buildings")
    }
    for kind, inside, outside in (("Sidewalks", (10, 10), (30, 30)), ("Water", (20, -40), (0, -40)),
                                  ("Buildings", (110, 5), (115, 15))):  # fmt: skip
        assert areas[kind].contains(Point(inside)), kind
        assert not areas[kind].contains(Point(outside)), kind
    assert areas["Water"].intersection(pond.buffer(5)).symmetric_difference(pond).area < 0.05 * pond.area
    assert np.count_nonzero(box_map.kinds == KINDS["Vegetation"]) == 25
    is_roof = box_map.centers[:, 0] > 290
    assert_allclose([box_map.mins[is_roof, 2], box_map.maxs[is_roof, 2]], [[4.7], [5.0]], atol=1e-9)
    assert "not used: barrier=bollard 1" in caplog.text
    with pytest.raises(InputError, match="Overpass's own JSON"):
        loaded(tmp_path, '{"version": 0.6, "elements": []}', ".json", **columns)
    with pytest.raises(InputError, match=r"type_column \(did you mean 'building'"):
        loaded(tmp_path, text, ".geojson", type_column="buildings", units="m")


def test_water_is_open_below_bridges(tmp_path):
    """A river as a line and as an outline, a skew street with and without a bridge over it."""
    street = {"highway": "residential", "width": "8"}
    line = feature("LineString", [[-90.0, 0.0], [90.0, 0.0]], waterway="river", width="20")
    outline = feature("Polygon", [[[-90, -10], [90, -10], [90, 10], [-90, 10], [-90, -10]]], natural="water")
    columns = {"type_column": "highway,natural,waterway", "units": "m"}
    for river, bridge in product((line, outline), (None, "no", "yes")):
        across = feature("LineString", [[-40.0, -50.0], [10.0, 50.0]], **street, bridge=bridge)
        box_map = loaded(tmp_path, collection(river, across), ".geojson", **columns)
        water = union_all(footprints(box_map)[box_map.kinds == KINDS["Water"]])
        road = LineString([(-40.0, -50.0), (10.0, 50.0)]).buffer(4.0, cap_style="flat")
        open_share = (
            1.0 - water.intersection(road).area / Polygon(outline["geometry"]["coordinates"][0]).intersection(road).area
        )
        assert open_share > 0.9 if bridge == "yes" else open_share < 0.05
        assert water.area > 0.85 * 180 * 20
    wrong = feature("LineString", [[0.0, 0.0], [1.0, 0.0]], waterway="river", width="-3")
    box_map = loaded(tmp_path, collection(outline, across, across, across, across, wrong), ".geojson", **columns)
    assert box_map.header.dropped_objects == {"bad_value": 1}


def test_what_an_outline_asks_for_is_bounded_before_it_is_made(tmp_path):
    def star(x: float, k: int) -> dict:
        angles, radii = np.linspace(0, 2 * np.pi, 9), np.where(np.arange(9) % 2, 2_000.0, 900.0)
        ring = np.column_stack([x + radii * np.cos(angles), radii * np.sin(angles) + k])
        return feature("Polygon", [ring.tolist()], type="Roads")

    with pytest.raises(InputError, match="over the limit; got outlines that need"):
        loaded(tmp_path, collection(*(star(9 * k, k) for k in range(60))), ".geojson")
    hall = Polygon([(0, 0), (500, 0), (500, 400), (300, 400), (300, 500), (0, 500)])
    assert num_cuts(hall, 3.0, np.inf, CUT_SHARES) == 0  # large, but without slanted edges
    for row in ("Roads,0,0,1e9,1e9,", "Buildings,0,0,9,9,1e9"):
        with pytest.raises(InputError, match="too wide or too high"):
            loaded(tmp_path, f"type,x_m,y_m,length_m,width_m,height_m\nBuildings,0,0,9,9,9\n{row}\n")


def test_ours_is_read_as_it_is_and_named_anew(tmp_path):
    town = invent(SyntheticConfig(size_m=120.0, num_blocks=1), 0)
    write_boxes(tmp_path / "own.json", town)
    box_map = load(BoxesConfig(path=tmp_path / "own.json", name="Mine", licence="mit"))
    assert (box_map.name, box_map.header.licence, len(box_map)) == ("Mine", "mit", len(town))
    with pytest.raises(ConfigError, match="its own types, units and ground height"):
        load(BoxesConfig(path=tmp_path / "own.json", ignore=["*"]))
    text = (tmp_path / "own.json").read_text()
    for declared in ('"units": "ft"', '"crs": "EPSG:2263"', '"up_axis": "y"'):
        (tmp_path / "own.json").write_text(text.replace("{", f"{{{declared},", 1))
        with pytest.raises(InputError, match="declares another unit or coordinate system"):
            load(BoxesConfig(path=tmp_path / "own.json"))


@pytest.mark.parametrize(("text", "words"), [
    (PLAIN.replace("Vegetation", "vegetable").replace("Roads", "roads"),
     r"line 3: unknown type 'vegetable'.*line 4: unknown type 'roads' \(did you mean 'Roads'\?\); expected"),
    (PLAIN.replace(",yaw_deg", ",yaw_dge"), r"unknown column 'yaw_dge' \(did you mean 'yaw_deg'\?\)"),
    (PLAIN.replace("type,x_m", "name,east"),
     r"column type is missing.*unknown column 'east'.*column x_m is missing"),
    (PLAIN.replace("height_m,yaw_deg", "height_m,z_m"), "column z_m occurs twice"),
    (PLAIN.replace(",12,8,8,30", ",12,8,8"), "line 2: 8 cells, but the first line has 9"),
    (PLAIN.replace("12,8,8,30", '"12,5",8,8,30'), r"length_m is not a finite number: '12,5'"),
    (PLAIN.replace("12,8,8,30", "-12,8,8,30").replace("4,4,6,0", "4,4,nan,0"),
     r"line 2: length_m must be above 0; line 3: height_m is not a finite number: 'nan'"),
    (PLAIN.replace("10,20,4", "1e12,20,4"), "line 2: it is 1,000,000,000 km from the middle of the map"),
    (PLAIN.replace("7,Buildings", "8,Buildings"), "ids must be different whole numbers"),
    (PLAIN.replace(",", ";"), "column type is missing.*separated by commas"),
    ("", "has no boxes"),
    (collection(feature("CurvePolygon", [], type="Walls")),
     "feature 1: the geometry CurvePolygon is not supported; expected one of Point"),
    (collection(feature("Polygon", [[[0, 0], [9, 0]]], type="Walls")),
     r"feature 1: the coordinates of the Polygon are invalid; expected \[x, y\], at least four points in a ring"),
    (collection(feature("Polygon", [[[0, 0], [9, 0], [9, 9], [0, 0]]], type="Buildings")),
     "feature 1: height_m is missing"),
    (
        collection(
            {**feature("LineString", [[0, 0], [1, 1]], type="Walls"), "id": "way/7"},
            feature("Point", [5, 5], type="Vegetation", name="old oak", height_m="tall"),
            feature("Point", [5, 5], type="house", length_m=4, width_m=4, height_m=6),
        ),
        r"feature 1 \(way/7\): width_m is missing, height_m is missing.*feature 2 \(old oak\): "
        r"length_m is missing, width_m is missing, height_m is not a finite number: 'tall'"
        r".*feature 3: unknown type 'house'.*expected .*columns .*types .*3 to fix",
    ),
    (collection(feature("Point", [5, 5], type="Walls", colour=3)), "unknown column 'colour'"),
    (json.dumps({"type": "Topology"}), "not GeoJSON"),
    (collection(), "has no boxes"),
])  # fmt: skip
def test_all_that_is_wrong_with_a_table_or_with_geojson_is_told(tmp_path, text, words):
    with pytest.raises(InputError, match=words):
        loaded(tmp_path, text, ".geojson" if text.startswith("{") else ".csv")
