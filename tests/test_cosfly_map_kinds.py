"""Kinds of maps as they are met outside: one table of city models in every form; the next such case is added to it."""

import copy
import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS
from cosfly.maps.cityjson import CityJsonConfig
from cosfly.maps.stage import MapsConfig, load_map
from cosfly.runtime.errors import InputError

Model = dict


def prism(x: float, y: float, top: float) -> tuple[list, list]:
    """Vertices, mm, and the outer shell of a house of 10 x 6 m on the ground at 2 m."""
    corners = [(x, y), (x + 10, y), (x + 10, y + 6), (x, y + 6)]
    vertices = [[round(1000 * c) for c in (*corner, z)] for z in (2.0, top) for corner in corners]
    return vertices, [[[3, 2, 1, 0]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]


def counted_from(shell: list, first: int) -> list:
    return [[[first + k for k in ring] for ring in face] for face in shell]


def city() -> Model:
    """CityJSON 2.0: a building whose part has the walls, a second house, a road."""
    house, shell = prism(100.0, 50.0, 14.0)
    other, _ = prism(120.0, 50.0, 8.0)
    road = [[80_000, 40_000, 2000], [140_000, 40_000, 2000], [140_000, 46_000, 2000], [80_000, 46_000, 2000]]
    solid = {"type": "Solid", "lod": "1.2"}
    return {
        "type": "CityJSON", "version": "2.0",
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
        "transform": {"scale": [0.001] * 3, "translate": [0.0, 0.0, 0.0]}, "vertices": house + other + road,
        "CityObjects": {
            "house": {"type": "Building", "children": ["part"]},
            "part": {"type": "BuildingPart", "parents": ["house"], "geometry": [solid | {"boundaries": [shell]}]},
            "other": {"type": "Building", "geometry": [solid | {"boundaries": [counted_from(shell, 8)]}]},
            "road": {
                "type": "Road",
                "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [[[16, 17, 18, 19]]]}],
            },
        },
    }  # fmt: skip


def document(model: Model) -> bytes:
    return json.dumps(model).encode()


def v11_with_a_group(model: Model) -> Model:
    model = copy.deepcopy(model) | {"version": "1.1"}
    model["CityObjects"]["quarter"] = {"type": "CityObjectGroup", "children": ["house", "other"]}
    return model


def with_an_outline(model: Model) -> Model:
    """As 3D BAG has it: the building has its outline at level 0, its part the walls."""
    model = copy.deepcopy(model)
    model["CityObjects"]["house"]["geometry"] = [{"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}]
    return model


def in_a_composite(model: Model) -> Model:
    """The second house one solid of several, below an outline of level 0."""
    model = copy.deepcopy(model) | {"version": "1.1"}
    (solid,) = model["CityObjects"]["other"]["geometry"]
    outline = {"type": "MultiSurface", "lod": "0", "boundaries": [solid["boundaries"][0][0]]}
    several = solid | {"type": "CompositeSolid", "boundaries": [solid["boundaries"]]}
    model["CityObjects"]["other"]["geometry"] = [outline, several]
    return model


def with_a_template(model: Model) -> Model:
    """The second house is an instance of a template of half its size, from its own low corner."""
    model = copy.deepcopy(model)
    _, shell = prism(0.0, 0.0, 0.0)
    corners = [[x, y, z] for z in (0.0, 3.0) for x, y in ((0.0, 0.0), (5.0, 0.0), (5.0, 3.0), (0.0, 3.0))]
    template = {"type": "Solid", "lod": "1.2", "boundaries": [shell]}
    model["geometry-templates"] = {"templates": [template], "vertices-templates": corners}
    matrix = [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]
    instance = {"type": "GeometryInstance", "template": 0, "boundaries": [8], "transformationMatrix": matrix}
    model["CityObjects"]["other"]["geometry"] = [instance]
    return model


def sequence(model: Model, end: str = "\n", start: str = "") -> bytes:
    """A text sequence: first the document without objects, then features with vertices of their own."""
    head = {key: value for key, value in model.items() if key not in ("CityObjects", "vertices")}
    lines = [head | {"CityObjects": {}, "vertices": []}]
    for names in (("house", "part"), ("other",), ("road",)):
        objects = copy.deepcopy({name: model["CityObjects"][name] for name in names})
        geometries = [g for value in objects.values() for g in value.get("geometry", [])]
        used: list[int] = []
        for geometry in geometries:
            geometry["boundaries"] = _renumbered(geometry["boundaries"], used)
        vertices = [model["vertices"][k] for k in used]
        lines.append({"type": "CityJSONFeature", "id": names[0], "CityObjects": objects, "vertices": vertices})
    return "".join(start + json.dumps(line) + end for line in lines).encode()


def _renumbered(value: list | int, used: list[int]) -> list | int:
    if isinstance(value, list):
        return [_renumbered(item, used) for item in value]
    if value not in used:
        used.append(value)
    return used.index(value)


# name -> what makes the file's bytes of city(); LEFT_OUT: what is left out but for one object without geometry
FORMS: dict[str, Callable[[Model], bytes]] = {
    "2.0 printed over many lines": lambda m: json.dumps(m, indent=2).encode(),
    "2.0 with an outline": lambda m: document(with_an_outline(m)),
    "2.0 with a template": lambda m: document(with_a_template(m)),
    "1.1 with a group": lambda m: document(v11_with_a_group(m)),
    "1.1 gzipped, a composite": lambda m: gzip.compress(document(in_a_composite(m)), mtime=0),
    "1.1.3": lambda m: document(copy.deepcopy(m) | {"version": "1.1.3"}),
    "sequence 1.1": lambda m: sequence(m | {"version": "1.1"}),
    "sequence with CR LF": lambda m: sequence(m, "\r\n"),
    "sequence with blank lines": lambda m: sequence(m, "\n\n"),
    "sequence after RFC 7464": lambda m: sequence(m, start="\x1e"),
    "sequence gzipped": lambda m: gzip.compress(sequence(m), mtime=0),
    "sequence that repeats a feature": lambda m: sequence(m) + sequence(m).splitlines()[2] + b"\n",
    "sequence whose document holds the road": lambda m: b"\n".join(
        [document(m | {"CityObjects": {"road": m["CityObjects"]["road"]}}), *sequence(m).splitlines()[1:3]]
    ),
}
LEFT_OUT = {
    "2.0 with an outline": {"outline_of_parts": 1},
    "1.1 with a group": {"no_geometry": 1, "group": 1},
    "sequence that repeats a feature": {"no_geometry": 1, "repeated_id": 1},
}


def load(tmp_path: Path, data: bytes) -> BoxMap:
    path = tmp_path / "model.city"
    path.write_bytes(data)
    return load_map(MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path)))


@pytest.mark.slow
def test_every_form_of_a_city_model_gives_the_same_map(tmp_path: Path, subtests):
    plain = load(tmp_path, document(city()))
    assert plain.counts()["Buildings"] == 2
    for form, write in FORMS.items():
        with subtests.test(form):
            found, dropped = load(tmp_path, write(city())), LEFT_OUT.get(form, {"no_geometry": 1})
            np.testing.assert_allclose(np.sort(found.mins, axis=0), np.sort(plain.mins, axis=0), atol=1e-6)
            np.testing.assert_allclose(np.sort(found.maxs, axis=0), np.sort(plain.maxs, axis=0), atol=1e-6)
            assert found.counts() == plain.counts()
            assert found.header.offset_m == plain.header.offset_m
            assert found.header.dropped_objects == dropped
            assert found.header.num_objects == 3 + sum(dropped.values())
    model = with_an_outline(city())
    model["CityObjects"]["house"]["children"] = ["somewhere else"]
    assert "outline_of_parts" not in load(tmp_path, document(model)).header.dropped_objects, "parts are not in the file"


def test_an_older_city_model_is_refused_with_the_command_that_upgrades_it(tmp_path: Path):
    for version in ("0.8", "1.0", "3.0", None):
        with pytest.raises(InputError, match=r"version.*1\.1 or 2\.0.*cjio OLD upgrade"):
            load(tmp_path, document(city() | {"version": version}))


@pytest.mark.slow
def test_a_real_sequence_of_buildings_is_read(shared_data: Path):
    path = shared_data / "tudelft-3dbag" / "extension.city.jsonl.gz"
    box_map, coarse = (
        load_map(MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path, solids=solids, derive_ground=False)))
        for solids in (True, False)
    )
    assert box_map.header.num_objects == 199
    assert box_map.header.dropped_objects == {"outline_of_parts": 99}
    assert box_map.header.building_covered_share > 0.995
    assert set(box_map.kinds) == {KINDS["Buildings"]}
    assert coarse.maxs[:, 2].max() == pytest.approx(26.396 + 0.075, abs=1e-3)  # at level 1.2
    assert box_map.maxs[:, 2].max() == pytest.approx(76.224 + 0.075, abs=1e-3)  # as drawn, at level 2.2
