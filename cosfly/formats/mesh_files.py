"""Mesh files: binary glTF 2.0 (.glb), read and written, and Wavefront OBJ (.obj), read.

A mesh is its triangles, corners (k, 3, 3) float64 m, z up, counter-clockwise from outside. In glTF +y is up and becomes
+z; in an OBJ +z is up. Materials and pictures are not read, and a fault in them refuses no mesh. Files are not trusted:
no other file that they name is opened, and counts are checked before arrays are made.
"""

import json
import logging
import re
import struct
from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import MB, over_limit, read_bytes, write_bytes
from cosfly.runtime.json_io import parse_document

log = logging.getLogger(__name__)

SUFFIXES = (".glb", ".obj")
MOST_TRIANGLES = 2_000_000  # of a file, and of all meshes of a map
MOST_NODES = MOST_TRIANGLES // 4  # no closed mesh has fewer than four triangles
FILE_MB = MOST_TRIANGLES * 256 / MB  # an OBJ takes some 100 bytes for a triangle
LARGEST_M = 1e7
Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

# Numbers of glTF.
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
GLB_HEADER_BYTES, CHUNK_HEADER_BYTES = 12, 8
TRIANGLES = 4  # mode of a primitive; smaller ones are points and lines, larger ones strips and fans
FLOAT, ARRAY_BUFFER = 5126, 34962
DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}  # by component type
# Extensions that change colours, light and records, but no vertex.
APPEARANCE = re.compile(r"[A-Z]+_(materials|texture|lights|techniques|xmp|animation|audio)")

# What Python and NumPy raise for a file that contradicts itself, such as an index beyond the last vertex. A programming
# error in this module would look the same.
NOT_READ = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


def z_up_from_y_up(points: np.ndarray) -> np.ndarray:
    """Turn points, (..., 3), from axes whose +y is up to those whose +z is up."""
    return points @ Z_UP_FROM_Y_UP.T


def y_up_from_z_up(points: np.ndarray) -> np.ndarray:
    """Turn points, (..., 3), from axes whose +z is up to those whose +y is up."""
    return points @ Z_UP_FROM_Y_UP


def check_num_triangles(where: object, num_triangles: int) -> None:
    """Raise InputError if a file or a map has too many triangles."""
    if num_triangles > MOST_TRIANGLES:
        raise over_limit(where, f"{num_triangles:,} triangles", f"{MOST_TRIANGLES:,} triangles", "simplify the meshes")


def read_meshes(path: Path, *, tree: Path) -> dict[str, np.ndarray]:
    """Read a file of meshes by the names of their nodes; an OBJ is one mesh.

    tree: The folder that must contain the file.
    """
    data = read_bytes(path, what="mesh", tree=tree, most_mb=FILE_MB)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        what = "the file type of the mesh is not supported"
        fix = "export the mesh again with one of these file types"
        raise InputError(what, where=path, got=path.suffix, expected=" or ".join(SUFFIXES), fix=fix)
    try:
        with np.errstate(all="ignore"):  # a chain of scales overflows; the corners are checked below
            meshes = _read_obj(data, path) if suffix == ".obj" else _read_glb(data, path)
    except NOT_READ as error:
        got = f"{type(error).__name__}: {error}"[:120]
        fix = "open the file in a mesh viewer, and export the mesh again"
        raise InputError("the mesh file cannot be parsed", where=path, got=got, fix=fix) from None
    if not any(map(len, meshes.values())):
        raise InputError("the mesh has no triangles", where=path, fix="export the mesh again with its faces")
    for name, corners in meshes.items():
        is_valid = (np.abs(corners) <= LARGEST_M).all(axis=2)  # NaN fails
        if not is_valid.all():
            what = f"mesh {name!r} has a vertex that is not finite or is more than {LARGEST_M:,.0f} m from the origin"
            vertex = ", ".join(f"{value:g}" for value in corners[~is_valid][0])
            fix = "move or remove the vertex, and export the mesh in metres"
            raise InputError(what, where=path, got=f"the vertex ({vertex}) m", fix=fix)
    return meshes


@cache
def _warn_of_materials(path: Path) -> None:
    log.warning("%s: materials are not read; the mesh has the colours of the type of its box", path)


def _read_obj(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the triangles of an OBJ: vertices and faces, of which each is a fan of triangles."""
    text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    if re.search(r"(?m)^[ \t]*mtllib\b", text):
        _warn_of_materials(path)
    positions: list[list[str]] = []
    faces: list[list[int]] = []  # numbers of vertices, from 1
    for kind, words in re.findall(r"(?m)^[ \t]*([vf])[ \t]+([^#\r\n]+)", text):
        if kind == "v":
            positions.append(words.split()[:3])
        else:
            faces.append([int(word.partition("/")[0]) for word in words.split()])
    vertices = np.array(positions, dtype=np.float64).reshape(len(positions), 3)
    check_num_triangles(path, sum(max(len(face) - 2, 0) for face in faces))
    triangles = [(first, *edge) for first, *others in faces for edge in pairwise(others)]
    corners = np.array(triangles, dtype=np.int64).reshape(-1, 3) - 1
    if corners.min(initial=0) < 0:
        what = "the OBJ file uses negative vertex indices, which are not supported"
        raise InputError(what, where=path, expected="indices from 1", fix="export the mesh with absolute indices")
    return {"mesh": vertices[corners]}


# --- reading glTF -----------------------------------------------------------------------------------------------------


def _read_glb(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the triangles of a binary glTF by the names of their nodes."""
    text, binary = _chunks_of(data, path)
    gltf = _Gltf(parse_document(text, path), binary)
    _check_features(gltf, path)
    _check_counts(gltf, path)
    roots = _roots_of(gltf, path)
    triangles_of = [
        np.concatenate([np.zeros((0, 3, 3)), *map(gltf.triangles, primitives)]) for primitives in gltf.primitives
    ]
    names = _node_names(gltf.nodes)
    meshes: dict[str, np.ndarray] = {}
    for node_index, world in _world_matrices(gltf.nodes, roots).items():
        node = gltf.nodes[node_index]
        if "mesh" in node:
            triangles = triangles_of[node["mesh"]] @ world[:3, :3].T + world[:3, 3]
            if np.linalg.det(world[:3, :3]) < 0:  # mirrored: the corners turn the other way
                triangles = triangles[:, ::-1]
            meshes[names[node_index]] = z_up_from_y_up(triangles)
    return meshes


def _chunks_of(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """Return the JSON and the binary chunk of a binary glTF."""
    if struct.unpack_from("<II", data.ljust(GLB_HEADER_BYTES)) != (GLB_MAGIC, 2):
        raise InputError("the mesh file is not binary glTF 2.0", where=path, fix="export the mesh as binary glTF 2.0")
    chunks: dict[int, bytes] = {}
    end = GLB_HEADER_BYTES
    while end + CHUNK_HEADER_BYTES <= len(data):
        size, kind = struct.unpack_from("<II", data, end)
        begin = end + CHUNK_HEADER_BYTES
        end = begin + size
        chunks.setdefault(kind, data[begin:end])
    if end > len(data):
        got = f"{len(data)} bytes"
        expected = f"{end} bytes"
        fix = "copy or export the mesh file again"
        raise InputError("the mesh file is incomplete", where=path, got=got, expected=expected, fix=fix)
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK, b"")


class _Gltf:
    """A glTF document and its binary chunk."""

    def __init__(self, document: dict, binary: bytes) -> None:
        self.document = document
        self.binary = binary
        self.nodes = document.get("nodes") or []
        self.accessors = document.get("accessors") or []
        self.views = document.get("bufferViews") or []
        self.primitives: list[list[dict]] = [  # the groups of triangles of each mesh
            [primitive for primitive in mesh["primitives"] if primitive.get("mode", TRIANGLES) >= TRIANGLES]
            for mesh in document.get("meshes") or []
        ]

    def num_triangles(self, primitive: dict) -> int:
        """Return the number of triangles that a primitive declares."""
        count = self.accessors_of(primitive)[0]["count"]
        if count < 0:
            raise ValueError("an accessor has a negative count")
        return count // 3

    def accessors_of(self, primitive: dict) -> list[dict]:
        """Return the accessors of a primitive's indices, if it has them, and of its positions."""
        keys = [primitive["indices"]] if "indices" in primitive else []
        return [self.accessors[key] for key in (*keys, primitive["attributes"]["POSITION"])]

    def values(self, accessor: dict, num_columns: int) -> np.ndarray:
        """Return the values of an accessor, (n, num_columns), as a view on the binary chunk."""
        if accessor["type"] != {1: "SCALAR", 3: "VEC3"}[num_columns]:
            raise ValueError(f"an accessor of type {accessor['type']} is used for {num_columns} columns")
        view = self.views[accessor["bufferView"]]
        dtype = np.dtype(DTYPES[accessor["componentType"]])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = (view.get("byteStride") or num_columns * dtype.itemsize, dtype.itemsize)
        return np.ndarray((accessor["count"], num_columns), dtype, self.binary, start, strides)

    def triangles(self, primitive: dict) -> np.ndarray:
        """Return the triangles of a primitive, (k, 3, 3) float64."""
        *indices, positions = self.accessors_of(primitive)
        corners = self.values(positions, 3)
        if indices:
            corners = corners[self.values(indices[0], 1)[:, 0]]
        return corners[: len(corners) // 3 * 3].reshape(-1, 3, 3).astype(np.float64)


def _check_features(gltf: _Gltf, path: Path) -> None:
    """Raise InputError if geometry is in a form or place that is not read; log a warning if there are materials."""
    feature = next(_unsupported_features(gltf), None)
    if feature is not None:
        what = "the mesh file uses a feature of glTF that is not supported"
        expected = "glTF 2.0 in one file, with lists of triangles"
        fix = "export the mesh again as .glb: triangles, without compression, sparse accessors and other extensions"
        raise InputError(what, where=path, got=feature[:99], expected=expected, fix=fix)
    if gltf.document.get("materials"):
        _warn_of_materials(path)


def _unsupported_features(gltf: _Gltf) -> Iterator[str]:
    """Yield the words for features that are not read; an accessor in a later one may be missing or damaged."""
    for name in gltf.document.get("extensionsRequired") or []:
        if not APPEARANCE.match(name):
            yield f"a glTF extension: {name}"
    if any("uri" in buffer for buffer in gltf.document.get("buffers") or []):
        yield "data in another file"
    for primitive in chain(*gltf.primitives):
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            yield "strips or fans of triangles"
        for accessor in gltf.accessors_of(primitive):
            if "sparse" in accessor:
                yield "a sparse accessor"
            if "bufferView" not in accessor:
                yield "an accessor without a bufferView"


def _check_counts(gltf: _Gltf, path: Path) -> None:
    """Raise InputError if a file declares more nodes, bytes or triangles than it may or can have."""
    if len(gltf.nodes) > MOST_NODES:
        raise over_limit(path, f"{len(gltf.nodes):,} nodes", f"{MOST_NODES:,} nodes", "join the meshes")
    num_bytes = [view["byteLength"] for view in gltf.views]
    if min(num_bytes, default=0) < 0 or max(num_bytes, default=0) > len(gltf.binary):
        what = "a buffer view of the mesh file declares more bytes than there are, or a negative number"
        got = f"{min(num_bytes):,} to {max(num_bytes):,} bytes"
        expected = f"0 to {len(gltf.binary):,} bytes"
        fix = "copy or export the mesh file again"
        raise InputError(what, where=path, got=got, expected=expected, fix=fix)
    num_triangles = [sum(map(gltf.num_triangles, primitives)) for primitives in gltf.primitives]
    check_num_triangles(path, sum(num_triangles))
    # Nodes may place the same mesh again and again.
    check_num_triangles(path, sum(num_triangles[node["mesh"]] for node in gltf.nodes if "mesh" in node))


def _roots_of(gltf: _Gltf, path: Path) -> list[int]:
    """Return the nodes at the top of the scene; without scenes, the nodes that are no child."""
    children = [child for node in gltf.nodes for child in node.get("children", ())]
    if "scenes" in gltf.document:
        roots = gltf.document["scenes"][gltf.document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(gltf.nodes))) - set(children))
    if repeated := [node for node, count in Counter([*children, *roots]).items() if count > 1]:  # also a cycle
        what = "a node of the mesh file has two parents"
        got = f"node {repeated[0]}"
        raise InputError(what, where=path, got=got, expected="one parent at most", fix="export the mesh again")
    return roots


def _node_names(nodes: list[dict]) -> list[str]:
    """Return a different name for each node: its own or its index, with a suffix if another node has that name."""
    counts = Counter[str]()
    names: dict[str, None] = {}
    for index, node in enumerate(nodes):
        name = str(node.get("name", index))
        unique = name
        while unique in names:
            counts[name] += 1
            unique = f"{name}_{counts[name]}"
        names[unique] = None
    return list(names)


def _world_matrices(nodes: list[dict], roots: list[int]) -> dict[int, np.ndarray]:
    """Return the matrix (4, 4) from each node to the world; a chain of nodes may be of any length."""
    from scipy.spatial.transform import Rotation  # imported here: most commands need no mesh

    matrices: dict[int, np.ndarray] = {}
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        index, parent = waiting.pop()
        node = nodes[index]
        local = np.reshape(node.get("matrix", np.eye(4)), (4, 4)).T.astype(float)
        local[:3, 3] += np.array(node.get("translation", (0.0, 0.0, 0.0)), dtype=float)
        if "rotation" in node:
            local[:3, :3] @= Rotation.from_quat(node["rotation"]).as_matrix()
        local[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
        matrices[index] = parent @ local
        waiting += [(child, matrices[index]) for child in reversed(node.get("children", ()))]
    return matrices


# --- writing glTF -----------------------------------------------------------------------------------------------------


def write_meshes(path: Path, meshes: dict[str, np.ndarray]) -> None:
    """Write binary glTF 2.0 with a node for each mesh: vertices in single precision relative to the node's position."""
    nodes: list[dict] = []
    views: list[dict] = []
    accessors: list[dict] = []
    binary = bytearray()
    for index, (name, triangles) in enumerate(meshes.items()):
        corners = y_up_from_z_up(triangles.reshape(-1, 3))
        middle = np.round((corners.min(axis=0) + corners.max(axis=0)) / 2)
        offsets = (corners - middle).astype("<f4")
        accessors.append(
            {"bufferView": index, "componentType": FLOAT, "type": "VEC3", "count": len(offsets),
             "min": offsets.min(axis=0).tolist(), "max": offsets.max(axis=0).tolist()}
        )  # fmt: skip
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": offsets.nbytes, "target": ARRAY_BUFFER})
        binary += offsets.tobytes()
        nodes.append({"name": name, "mesh": index, "translation": middle.tolist()})
    document = {
        "asset": {"version": "2.0", "generator": "cosfly"}, "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": k}, "mode": TRIANGLES}]} for k in range(len(nodes))
        ],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    write_bytes(path, struct.pack("<III", GLB_MAGIC, 2, GLB_HEADER_BYTES + len(chunks)) + chunks)
