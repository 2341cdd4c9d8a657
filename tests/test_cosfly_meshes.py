"""Meshes: read as trimesh reads them, drawn where its rays meet them, hostile ones refused; CityJSON solids."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from test_renderers_contract import pose_towards

from cosfly.formats.boxes import BoxMap, read_boxes, write_boxes
from cosfly.formats.frames import Look
from cosfly.formats.kinds import KINDS
from cosfly.formats.mesh_files import read_meshes, write_meshes
from cosfly.formats.meshes import MESHES_FILE, Meshes, MeshRef
from cosfly.geometry.axes import intrinsic_matrix
from cosfly.maps import cityjson
from cosfly.maps.cityjson import CityJsonConfig, solid_mesh
from cosfly.maps.stage import MapsConfig
from cosfly.maps.stage import run as make_map
from cosfly.render.contract import (
    GROUND_PLANE_DROP_M,
    GROUND_PLANE_HALF_M,
    NEAR_M,
    NO_INSTANCE,
    plane_z_m,
    scene_origin,
)
from cosfly.render.stage import RENDERERS, open_renderer
from cosfly.render.surfaces import solids_of
from cosfly.runtime.config import build
from cosfly.runtime.errors import InputError
from cosfly.simplify.passes import SimplifyConfig, simplify
from specimens import map_of

SIZE = (320, 180)
INTRINSIC = intrinsic_matrix(*SIZE, 70.0)
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from glTF's axes


def sorted_rows(corners: np.ndarray) -> np.ndarray:
    """Triangles in an order that does not depend on who wrote them; each begins at its smallest corner."""
    corners = np.round(corners, 5) + 0.0
    first = np.array([min(range(3), key=lambda k, t=t: tuple(t[k])) for t in corners])
    turned = np.array([np.roll(t, -k, axis=0) for t, k in zip(corners, first, strict=True)])
    return turned[np.lexsort(turned.reshape(len(turned), -1).T[::-1])]


def test_nodes_of_gltf_stand_where_they_were_put(tmp_path: Path) -> None:
    """A turned, stretched ball below a node that is itself moved, and a mirrored box."""
    path, theirs = tmp_path / "things.glb", trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3), (0.5, 0, 0))
    ball, box = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.box((1.0, 2.0, 3.0))
    theirs.add_geometry(ball, node_name="ball", transform=turn @ np.diag([1.0, 2.0, 0.5, 1.0]))
    theirs.add_geometry(box, node_name="box", transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    theirs.export(path)
    found = read_meshes(path, tree=tmp_path)
    assert set(found) == {"ball", "box"}
    for name, mesh in found.items():
        transform, geometry = theirs.graph[name]
        corners = trimesh.transform_points(theirs.geometry[geometry].triangles.reshape(-1, 3), transform) @ UP.T
        expected = corners.reshape(-1, 3, 3)
        assert mesh.shape == expected.shape
        if name == "box":  # mirrored: turned round to face out again
            expected = expected[:, ::-1]
            assert trimesh.Trimesh(**trimesh.triangles.to_kwargs(mesh)).volume > 0
        np.testing.assert_allclose(sorted_rows(mesh), sorted_rows(expected), atol=2e-5)


def test_obj_is_read_as_trimesh_reads_it_without_its_materials(tmp_path: Path) -> None:
    text = (
        "mtllib missing.mtl\no shed\nv 0 0 0\nv 2 0 0\nv 2 3 0\nv 0 3 0\n# a comment\nv 1 1 4\nusemtl red\nf 1 4 3 2\n"
    )
    text += "usemtl wood\nf 1//1 2//1 5\nf 2/2 3/1 5/2\no lid\nusemtl red\nf 3 4 5\nf 4 1 5\n"
    (tmp_path / "shed.obj").write_text(text)
    found = read_meshes(tmp_path / "shed.obj", tree=tmp_path)
    (mesh,) = found.values()
    theirs = trimesh.load_mesh(tmp_path / "shed.obj", skip_materials=True, process=False)
    np.testing.assert_allclose(sorted_rows(mesh), sorted_rows(np.asarray(theirs.triangles)))


def test_what_is_written_trimesh_opens_and_we_read_again(tmp_path: Path) -> None:
    far = np.array([4_000.25, -9_000.5, 12.0])  # single precision alone would be worth a millimetre here
    ball = np.asarray(trimesh.creation.icosphere(subdivisions=2).triangles) + far
    write_meshes(tmp_path / "m.glb", {"ball": ball})
    (mesh,) = read_meshes(tmp_path / "m.glb", tree=tmp_path).values()
    np.testing.assert_allclose(sorted_rows(mesh), sorted_rows(ball), atol=1e-5)
    theirs = trimesh.load_scene(tmp_path / "m.glb").to_mesh()
    np.testing.assert_allclose(
        np.sort((theirs.bounds @ UP.T), axis=0), np.stack([ball.min((0, 1)), ball.max((0, 1))]), atol=1e-2
    )
    write_meshes(tmp_path / "n.glb", {"ball": ball})
    assert (tmp_path / "m.glb").read_bytes() == (tmp_path / "n.glb").read_bytes()


def glb(document: dict, binary: bytes = b"") -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, **document}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def one_triangle(places: list[float], **changes) -> bytes:
    document = {
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36}],
    }  # fmt: skip
    return glb(document | changes, struct.pack("<9f", *places))


FLAT = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
ONE_ACCESSOR = {"bufferView": 0, "componentType": 5126, "type": "VEC3"}
HOSTILE = {
    "no_numbers.glb": (one_triangle([float("nan"), *FLAT[1:]]), "not finite"),
    "far.glb": (one_triangle([1e30, *FLAT[1:]]), "not finite or is more than 10,000,000 m"),
    "count.glb": (
        one_triangle(FLAT, accessors=[{**ONE_ACCESSOR, "count": 2_000_000_000}]),
        "over the limit; got 666,666,666 triangles",
    ),
    "below_nothing.glb": (
        one_triangle(FLAT, bufferViews=[{"buffer": 0, "byteLength": n} for n in (36, -9, 36, 36)]),
        "declares more bytes than there are, or a negative number",
    ),
    "short_buffer.glb": (one_triangle(FLAT, accessors=[{**ONE_ACCESSOR, "count": 6}]), "cannot be parsed"),
    "repeated.glb": (
        one_triangle(FLAT, bufferViews=[{"buffer": 0, "byteLength": 2**30}] * 9),
        "declares more bytes than there are, or a negative number",
    ),
    "empty.glb": (one_triangle(FLAT, accessors=[{**ONE_ACCESSOR, "count": 0}]), "no triangles"),
    "sparse.glb": (
        one_triangle(FLAT, accessors=[{"componentType": 5126, "type": "VEC3", "count": 3}]),
        "not supported; got an accessor without a bufferView",
    ),
    "changed.glb": (
        one_triangle(FLAT, accessors=[{**ONE_ACCESSOR, "count": 3, "sparse": {"count": 1}}]),
        "not supported; got a sparse accessor",
    ),
    "strip.glb": (
        one_triangle(FLAT, meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}]),
        "not supported; got strips or fans of triangles",
    ),
    "negative.glb": (one_triangle(FLAT, accessors=[{**ONE_ACCESSOR, "count": -3}]), "negative count"),
    "loop.glb": (one_triangle(FLAT, nodes=[{"mesh": 0, "children": [0]}], scenes=[{"nodes": [0]}]), "two parents"),
    "packed.glb": (one_triangle(FLAT, extensionsRequired=["EXT_meshopt_compression"]), "a glTF extension"),
    "out.glb": (one_triangle(FLAT, buffers=[{"byteLength": 36, "uri": "../secret.bin"}]), "data in another file"),
    "index.glb": (one_triangle(FLAT, nodes=[{"mesh": 7}]), "cannot be parsed"),
    "short.glb": (one_triangle(FLAT)[:-10], "incomplete"),
    "other.glb": (b"not a mesh at all, whatever its name says", "not binary glTF"),
    "deep.glb": (glb({"nodes": [json.loads("[" * 90 + "]" * 90)]}), "deep"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    "corner.obj": (b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", "cannot be parsed"),
    "from_end.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n", "negative vertex indices"),
    "nothing.obj": (b"# nothing\n", "no triangles"),
}


def test_a_hostile_mesh_is_a_clear_error(tmp_path: Path, subtests) -> None:
    (tmp_path / "secret.bin").write_bytes(struct.pack("<9f", *FLAT))
    (tmp_path / "maps").mkdir()
    for name, (data, words) in HOSTILE.items():
        (tmp_path / "maps" / name).write_bytes(data)
        with subtests.test(name), pytest.raises(InputError, match=f"{name}.*{words}"):
            read_meshes(tmp_path / "maps" / name, tree=tmp_path / "maps")


HOUSE = "v 0 0 0\nv 4 0 0\nv 4 0 -3\nv 0 5 0\nf 1 2 4\nf 1 4 3\n"  # y is up


def test_appearance_never_refuses_a_mesh(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for number, before in enumerate(
        ("", "mtllib C:\\\\x.mtl\n", "mtllib\nusemtl none\n", "vt 1\nvn x y z\n", "o h\xe4\n")
    ):
        (tmp_path / f"{number}.obj").write_bytes((before + HOUSE.replace("-3\n", "-3 0.5\n")).encode("latin-1"))
        assert len(read_meshes(tmp_path / f"{number}.obj", tree=tmp_path)["mesh"]) == 2
    assert "1.obj: materials are not read" in caplog.text
    assert "0.obj" not in caplog.text
    for number, changes in enumerate(
        (
            {"extensionsRequired": ["KHR_materials_unlit", "KHR_texture_transform", "EXT_texture_webp"]},
            {"materials": [{"pbrMetallicRoughness": {"baseColorFactor": 0.5}}], "images": [{"uri": "none.png"}]},
            {"accessors": [{**ONE_ACCESSOR, "count": 3}, {"sparse": {}, "count": 3, "type": "VEC2"}]},
        )
    ):
        (tmp_path / f"{number}.glb").write_bytes(one_triangle(FLAT, **changes))
        assert len(read_meshes(tmp_path / f"{number}.glb", tree=tmp_path)["0"]) == 1


def test_the_axis_that_is_up_is_a_field_and_a_likely_mistake_is_a_warning(tmp_path, caplog) -> None:
    (tmp_path / "house.obj").write_text(HOUSE)
    for up, height_m in ((None, 3.0), ("y", 5.0)):
        caplog.clear()
        ref = MeshRef(file="house.obj", fit="world", up=up)
        (mesh,) = Meshes({1: ref}, folder=tmp_path).resolved().values()
        assert np.ptp(mesh[..., 2]) == height_m
        assert ('add "up": "y"' in caplog.text) == (up is None)
    both = Meshes({k: MeshRef(file="house.obj", fit="world", up=up) for k, up in enumerate((None, "y", "z"))}, tmp_path)
    moved = both.relative_to(tmp_path / "out").resolved()
    assert [round(float(np.ptp(mesh[..., 2])), 6) for mesh in moved.values()] == [3.0, 5.0, 3.0]


def test_what_nodes_repeat_is_counted_before_it_is_placed(tmp_path: Path) -> None:
    chain = [{"mesh": 0, "translation": [0, 0, 1], "children": [k + 1]} for k in range(2_999)]
    (tmp_path / "chain.glb").write_bytes(one_triangle(FLAT, nodes=[*chain, {"mesh": 0}], scenes=[{"nodes": [0]}]))
    meshes = read_meshes(tmp_path / "chain.glb", tree=tmp_path)
    assert len(meshes) == 3_000
    np.testing.assert_allclose(meshes["2999"][0, 0], [0, -2_999, 0])  # +z of glTF is -y
    primitive = {"attributes": {"POSITION": 0}}
    for changes in ({"nodes": [{"mesh": 0}] * 3_000}, {"meshes": [{"primitives": [primitive] * 3_000}]}):
        changes |= {"accessors": [{**ONE_ACCESSOR, "count": 3_000}]}  # of which the file has three
        (tmp_path / "many.glb").write_bytes(one_triangle(FLAT, **changes))
        with pytest.raises(InputError, match="got 3,000,000 triangles"):
            read_meshes(tmp_path / "many.glb", tree=tmp_path)
    scaled = [{"mesh": 0, "scale": [9, 9, 9], "children": [k + 1]} for k in range(399)]
    (tmp_path / "scaled.glb").write_bytes(one_triangle(FLAT, nodes=[*scaled, {"mesh": 0}]))
    with pytest.raises(InputError, match="not finite or is more than"):
        read_meshes(tmp_path / "scaled.glb", tree=tmp_path)


def test_a_box_names_no_file_outside_of_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "boxes_3d.json"
    write_boxes(path, map_of(("Static", (0, 0, 1), (1, 1, 1))))
    value = json.loads(path.read_text())
    for name in ("../m.glb", "/m.glb", "a/../../m.glb", "m.fbx", "", "m.glb\0"):
        value["boxes"][0]["mesh"] = {"file": name}
        path.write_text(json.dumps(value))
        with pytest.raises(InputError, match=r"mesh\.file"):
            read_boxes(path)


ROOF = [  # a house of 10 x 8 m, eaves at 4 m, ridge at 7 m
    (0, 0, 1), (10, 0, 1), (10, 8, 1), (0, 8, 1), (0, 0, 4), (10, 0, 4), (10, 8, 4), (0, 8, 4), (0, 4, 7), (10, 4, 7),
]  # fmt: skip
FACES = [[[0, 3, 2, 1]], [[0, 1, 5, 4]], [[2, 3, 7, 6]], [[1, 2, 6, 9, 5]], [[3, 0, 4, 8, 7]], [[4, 5, 9, 8]]]
FACES.append([[6, 7, 8, 9]])
BLOCK = [[[0, 3, 2, 1]], [[0, 1, 5, 4]], [[2, 3, 7, 6]], [[1, 2, 6, 5]], [[3, 0, 4, 7]], [[4, 5, 6, 7]]]


def city_file(path: Path) -> Path:
    """One house in two levels of detail, a block and one with a roof, beside a road."""
    road = [(-20, -10, 0), (40, -10, 0), (40, -4, 0), (-20, -4, 0)]
    house = [{"type": "Solid", "lod": lod, "boundaries": [faces]} for lod, faces in (("1.2", BLOCK), ("2.2", FACES))]
    path.write_text(json.dumps({
        "type": "CityJSON", "version": "2.0", "transform": {"scale": [1, 1, 1], "translate": [85_000, 447_000, 0]},
        "vertices": [list(v) for v in (*ROOF, *road)],
        "CityObjects": {
            "house": {"type": "Building", "geometry": house},
            "road": {"type": "Road", "geometry": [{"type": "MultiSurface", "lod": "1",
                "boundaries": [[[10, 11, 12, 13]]]}]},
        },
    }))  # fmt: skip
    return path


def test_a_solid_is_drawn_as_its_finest_surfaces_and_kept_out_of_as_boxes(tmp_path: Path) -> None:
    box_map = cityjson.load(CityJsonConfig(path=city_file(tmp_path / "city.json")))
    houses = np.flatnonzero(box_map.kinds == KINDS["Buildings"])
    assert set(box_map.meshes.refs) == set(box_map.ids[houses].tolist())
    solids = solids_of(box_map)
    as_mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(solids.corners_m))
    as_mesh.merge_vertices()
    assert as_mesh.is_watertight
    assert as_mesh.volume == pytest.approx(10 * 8 * 4 + 0.5 * 8 * 3 * 10)  # its foot comes down to the road, at 0
    assert box_map.maxs[houses, 2].max() == pytest.approx(7.0), "the box holds the ridge"
    assert (solids.rows == houses[0]).all()
    write_boxes(tmp_path / "boxes_3d.json", box_map)
    again = solids_of(read_boxes(tmp_path / "boxes_3d.json"))
    np.testing.assert_allclose(sorted_rows(again.corners_m), sorted_rows(solids.corners_m), atol=1e-5)
    plain = cityjson.load(CityJsonConfig(path=tmp_path / "city.json", solids=False))
    assert not plain.meshes.refs
    assert len(plain) == len(box_map)
    assert not simplify(box_map, SimplifyConfig()).meshes.refs


def scene_map(folder: Path) -> BoxMap:
    """A ball in a turned box, a cone in another, a house for two boxes, a road, a plain wall."""
    trimesh.creation.icosphere(subdivisions=2).export(folder / "ball.obj")
    (folder / "models").mkdir(exist_ok=True)
    trimesh.creation.cone(1.0, 2.0, sections=8).export(folder / "models/cone.glb")
    house = solid_mesh([[np.array([ROOF[i] for i in ring], dtype=float)] for (ring,) in FACES], 0.0)
    assert house is not None
    write_meshes(folder / "house.glb", {"house": house, "unused": house})
    box_map = map_of(
        ("Roads", (0, 0, -0.1), (60, 5, 0.1)), ("Buildings", (5, 10, 3.5), (5, 4, 3.5)),
        ("Buildings", (5, 15, 3.5), (5, 1, 3.5)), ("Static", (-6, 6, 2.0), (3, 1, 2.0), 30.0),
        ("Static", (14, 3, 1.0), (1, 1, 1.0)), ("Walls", (-4, 14, 1), (6, 0.2, 1.0), 5.0), ids=[7, 40, 41, 9, 300, 12],
    )  # fmt: skip
    world = MeshRef(file="house.glb", node="house", fit="world")
    refs = {40: world, 41: world, 9: MeshRef(file="ball.obj"), 300: MeshRef(file="models/cone.glb")}
    return replace(box_map, meshes=Meshes(refs, folder))


def traced(triangles: np.ndarray, owners: np.ndarray, pose: np.ndarray):
    """Every pixel's ray against every triangle, by trimesh's geometry: z-depth and owner."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(INTRINSIC).T @ pose[:3, :3].T
    depth, ids = np.full(len(rays), np.inf), np.full(len(rays), NO_INSTANCE)
    normals, is_valid = trimesh.triangles.normals(triangles)
    assert is_valid.all()
    eyes = np.broadcast_to(pose[:3, 3], rays.shape)
    for triangle, normal, owner in zip(triangles, normals, owners, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            z = ((triangle[0] - pose[:3, 3]) @ normal) / (rays @ normal)
        ahead = np.isfinite(z) & (z > NEAR_M) & (z < depth)
        if not ahead.any():
            continue
        points = eyes[ahead] + rays[ahead] * z[ahead, None]
        inside = (trimesh.triangles.points_to_barycentric(np.tile(triangle, (len(points), 1, 1)), points) >= 0).all(
            axis=1
        )
        rows = np.flatnonzero(ahead)[inside]
        depth[rows], ids[rows] = z[rows], owner
    return depth.reshape(SIZE[::-1]), ids.reshape(SIZE[::-1])


@pytest.fixture(scope="module")
def traced_views(tmp_path_factory) -> tuple[BoxMap, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """The scene, and of three views the pose, depth and ids by rays."""
    box_map = scene_map(tmp_path_factory.mktemp("traced"))
    solids = solids_of(box_map)
    boxes = [
        trimesh.creation.box(2 * box_map.half_extents[row],
            trimesh.transformations.translation_matrix(box_map.centers[row])
            @ trimesh.transformations.rotation_matrix(np.radians(box_map.rotations_deg[row, 1]), (0, 0, 1)))
        for row in (0, 5)
    ]  # fmt: skip
    x, y, z = [*scene_origin(box_map)[:2], plane_z_m(box_map) - GROUND_PLANE_DROP_M]
    plane = GROUND_PLANE_HALF_M * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) + (x, y, z)
    boxes.append(trimesh.Trimesh(plane, [(0, 1, 2), (0, 2, 3)]))
    triangles = np.concatenate([solids.corners_m, *(np.asarray(box.triangles) for box in boxes)])
    owners = np.concatenate([box_map.ids[solids.rows].astype(int), np.full(12, 7), np.full(12, 12), [NO_INSTANCE] * 2])
    views = []
    for eye, target in (((-18, -14, 12), (2, 8, 1)), ((22, -4, 3), (4, 10, 2)), ((4, 11, 30), (4, 12, 0))):
        pose = pose_towards(eye, target)
        views.append((pose, *traced(triangles, owners, pose)))
    return box_map, views


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(RENDERERS.keys() - {"carla", "unrealcv"}))
def test_depth_and_ids_are_those_of_trimesh_rays(traced_views, name: str) -> None:
    box_map, views = traced_views
    renderer, shown = open_renderer(name, box_map, *SIZE, Look()), set[int]()
    for pose, depth, ids in views:
        renderer.prepare(np.array([-20.0, -20.0, 0.0]), np.array([25.0, 25.0, 30.0]))
        frame = renderer.render(pose, INTRINSIC, {})
        again = renderer.render(pose, INTRINSIC, {})
        for part in ("rgb", "depth", "kinds", "ids"):
            np.testing.assert_array_equal(getattr(frame, part), getattr(again, part))
        known = np.isfinite(depth)
        same = known & (ids == frame.ids)
        differ = known & ~same
        border = cv2.dilate(ids.astype(np.float32), np.ones((3, 3))) != cv2.erode(
            ids.astype(np.float32), np.ones((3, 3))
        )
        assert not (differ & ~border).any(), "a wrong id that is not on a silhouette"
        error = np.abs(frame.depth - depth)[same & ~border & (depth < 60.0)]
        assert len(error) > 3000
        assert np.median(error) < 1e-4
        assert error.max() < 1e-3
        shown |= set(np.unique(frame.ids).tolist())
        assert 41 not in frame.ids, "a thing of several boxes has the id of the first"
        assert (frame.kinds[frame.ids == 40] == KINDS["Buildings"]).all()
    assert {40, 9, 300, 7, 12} <= shown
    renderer.close()


def test_boxes_of_ones_own_bring_their_meshes_along(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    write_boxes(tmp_path / "mine/boxes_3d.json", scene_map(tmp_path / "mine"))
    cfg = build(MapsConfig, {"source": "boxes", "boxes": {"path": str(tmp_path / "mine/boxes_3d.json")}}, "test")
    product = make_map(cfg, tmp_path / "maps")
    ours, theirs = (solids_of(read_boxes(path)) for path in (product, tmp_path / "mine/boxes_3d.json"))
    np.testing.assert_allclose(ours.corners_m, theirs.corners_m, atol=1e-5)
    assert np.array_equal(ours.rows, theirs.rows)
    assert [path.name for path in read_boxes(product).meshes.files().values()] == [MESHES_FILE]
    assert MESHES_FILE in (tmp_path / "maps/manifest.json").read_text()
    cone = (tmp_path / "mine/models/cone.glb").rename(tmp_path / "cone.glb")
    (tmp_path / "mine/models/cone.glb").symlink_to(cone)
    with pytest.raises(InputError, match="leads out of its folder"):
        make_map(cfg, tmp_path / "linked")
    again = make_map(cfg, tmp_path / "linked", follow_links=True)
    assert (again.parent / MESHES_FILE).read_bytes() == (product.parent / MESHES_FILE).read_bytes()
    (tmp_path / "mine/models/cone.glb").unlink()
    with pytest.raises(InputError, match=r"cone\.glb: the mesh cannot be read"):
        solids_of(read_boxes(tmp_path / "mine/boxes_3d.json"))
    wrong = replace(
        scene_map(tmp_path / "mine"), meshes=Meshes({9: MeshRef(file="house.glb", node="roof")}, tmp_path / "mine")
    )
    with pytest.raises(InputError, match=r"box 9: .*: the mesh file has no node of this name; got roof"):
        solids_of(wrong)
