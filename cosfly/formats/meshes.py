"""Meshes: binary glTF 2.0 (.glb) and Wavefront OBJ (.obj), and `meshes.glb` next to a map.

A mesh is its triangles, corners (k, 3, 3) float64 m, z up, counter-clockwise from outside; its colour is that of the
kind of its box. +y is up in glTF and becomes +z; in an OBJ +z is up. A mesh is one file: what it names is not read, and
counts are bounded before anything is made of it. Planners and visibility use boxes.
"""

from __future__ import annotations

import json
import logging
import re
import struct
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import MB, over_limit, read_bytes, write_bytes
from cosfly.runtime.json_io import parse_document

log = logging.getLogger(__name__)

MOST_TRIANGLES = 2_000_000  # of a file, and of all meshes of a map
FILE_MB = MOST_TRIANGLES * 256 / MB  # an OBJ takes some 100 bytes for a triangle
MOST_NUMBERS = 12 * MOST_TRIANGLES  # of vertices and indices; three of each are usual for a triangle
SUFFIXES = (".glb", ".obj")
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from glTF's axes
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
GLB_HEADER_BYTES = 12
TRIANGLES, STRIP = 4, 5  # modes of primitives that are drawn
LARGEST_M = 1e7
START_M = 1e-3  # a mesh that stands on the ground of its axes begins this near to 0
# Extensions of glTF that change colours, light and records, but no vertex.
APPEARANCE = re.compile(r"[A-Z]+_(materials|texture|lights|techniques|xmp|animation|audio)")
NUMBERS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # component types of glTF
# What a file that contradicts itself raises.
NOT_READ = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError)


def check_num_triangles(where: object, num_triangles: int) -> None:
    """Raise InputError if a mesh or a map has too many triangles."""
    if num_triangles > MOST_TRIANGLES:
        raise over_limit(where, f"{num_triangles:,} triangles", f"{MOST_TRIANGLES:,} triangles", "simplify the meshes")


def read_meshes(path: Path, *, tree: Path) -> dict[str, np.ndarray]:
    """Read a file of meshes, node by node; an OBJ is one node.

    tree: The folder that must contain the file.
    """
    data = read_bytes(path, what="mesh", tree=tree, most_mb=FILE_MB)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        what, fix = "the file type of the mesh is not supported", "export the mesh again with one of these file types"
        raise InputError(what, where=path, got=path.suffix, expected=" or ".join(SUFFIXES), fix=fix)
    try:
        with np.errstate(all="ignore"):  # a chain of scales overflows; the corners are checked below
            meshes = _read_obj(data, path) if suffix == ".obj" else _read_gltf(*_chunks_of(data, path), path)
    except NOT_READ as error:
        got, fix = f"{type(error).__name__}: {error}"[:120], "open the file in a mesh viewer, and export the mesh again"
        raise InputError("the mesh file cannot be parsed", where=path, got=got, fix=fix) from None
    if not any(map(len, meshes.values())):
        raise InputError("the mesh has no triangles", where=path, fix="export the mesh again with its faces")
    for name, corners in meshes.items():
        is_valid = (np.abs(corners) <= LARGEST_M).all(axis=2)  # NaN fails
        if not is_valid.all():
            problem = (
                f"mesh {name!r} has a vertex that is not finite or is more than {LARGEST_M:,.0f} m from the origin"
            )
            vertex = ", ".join(f"{value:g}" for value in corners[~is_valid][0])
            fix = "move or remove the vertex, and export the mesh in metres"
            raise InputError(problem, where=path, got=f"the vertex ({vertex}) m", fix=fix)
    return meshes


def _chunks_of(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """Return the JSON and the binary chunk of a binary glTF."""
    if struct.unpack_from("<II", data.ljust(20)) != (GLB_MAGIC, 2):
        raise InputError("the mesh file is not binary glTF 2.0", where=path, fix="export the mesh as binary glTF 2.0")
    chunks: dict[int, bytes] = {}
    end = GLB_HEADER_BYTES
    while end + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, end)
        chunks.setdefault(kind, data[end + 8 : end + 8 + size])
        end += 8 + size
    if end > len(data):
        got, expected, fix = f"{len(data)} bytes", f"{end} bytes", "copy or export the mesh file again"
        raise InputError("the mesh file is incomplete", where=path, got=got, expected=expected, fix=fix)
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK, b"")


def _read_gltf(text: bytes, binary: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the triangles of a glTF document by the names of their nodes."""
    document = parse_document(text, path)
    accessors, views, nodes, meshes, buffers = (
        document.get(name) or [] for name in ("accessors", "bufferViews", "nodes", "meshes", "buffers")
    )
    drawn = [[one for one in mesh["primitives"] if one.get("mode", TRIANGLES) in (TRIANGLES, STRIP)] for mesh in meshes]
    used = {k for mesh in drawn for primitive in mesh for k in _accessors_of(primitive)}
    packed = [name for name in document.get("extensionsRequired") or [] if not APPEARANCE.match(name)]
    is_plain = not packed and all("bufferView" in accessors[k] and "sparse" not in accessors[k] for k in used)
    if not is_plain or any("uri" in buffer for buffer in buffers):
        raise InputError(
            "the mesh file uses a feature of glTF that is not supported",
            where=path,
            got=f"a glTF extension: {packed}"[:99] if packed else "a sparse accessor, or data in another file",
            expected="glTF 2.0 in one file, without sparse accessors and such extensions",
            fix="export the mesh again as .glb without compression and other extensions",
        )
    if any(node.get("mesh", -1) >= len(meshes) for node in nodes):
        raise LookupError("a node refers to a mesh that the file does not have")
    children = [child for node in nodes for child in node.get("children", ())]
    if "scenes" in document:
        roots = document["scenes"][document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(nodes))) - set(children))
    if repeated := [node for node, count in Counter([*children, *roots]).items() if count > 1]:  # also a cycle
        what, got = "a node of the mesh file has two parents", f"node {repeated[0]}"
        raise InputError(what, where=path, got=got, expected="one parent at most", fix="export the mesh again")
    counts = [*(accessors[k]["count"] for k in used), *(view["byteLength"] for view in views)]
    most = int(MOST_NUMBERS + FILE_MB * MB)
    if min(counts, default=0) < 0 or sum(counts) > most:
        what, got = "the mesh file declares too many values, or a negative count", f"{sum(counts):,} values and bytes"
        expected, fix = f"at most {most:,}, and no negative count", "export the mesh again with fewer triangles"
        raise InputError(what, where=path, got=got, expected=expected, fix=fix)
    sizes = [sum(accessors[_accessors_of(primitive)[-1]]["count"] for primitive in mesh) for mesh in drawn]
    check_num_triangles(path, sum(sizes) // 3)
    check_num_triangles(path, sum(sizes[node["mesh"]] for node in nodes if "mesh" in node) // 3)
    if document.get("materials"):
        _warn_of_materials(path)

    def numbers(k: int) -> np.ndarray:
        accessor = accessors[k]
        view, kind = views[accessor["bufferView"]], np.dtype(NUMBERS[accessor["componentType"]])
        shape = (accessor["count"], 3 if accessor["type"] == "VEC3" else 1)
        strides = (view.get("byteStride") or shape[1] * kind.itemsize, kind.itemsize)
        return np.ndarray(shape, kind, binary, view.get("byteOffset", 0) + accessor.get("byteOffset", 0), strides)

    def triangles(primitive: dict) -> np.ndarray:
        corners = numbers(primitive["attributes"]["POSITION"]).astype(np.float64)
        if "indices" in primitive:
            corners = corners[numbers(primitive["indices"])[:, 0]]
        if primitive.get("mode") != STRIP:
            return corners[: len(corners) // 3 * 3].reshape(-1, 3, 3)
        order = np.arange(max(len(corners) - 2, 0))[:, None] + [0, 1, 2]
        order[1::2] = order[1::2, ::-1]
        return corners[order]

    corners_of = [np.concatenate([np.zeros((0, 3, 3)), *map(triangles, mesh)]) for mesh in drawn]
    names = _node_names(nodes)
    parts: dict[str, np.ndarray] = {}
    for k, world in _world_matrices(nodes, roots).items():
        if "mesh" in nodes[k]:
            placed = corners_of[nodes[k]["mesh"]] @ world[:3, :3].T + world[:3, 3]
            is_mirrored = np.linalg.det(world[:3, :3]) < 0
            parts[names[k]] = (placed[:, ::-1] if is_mirrored else placed) @ Z_UP.T
    return parts


def _node_names(nodes: list[dict]) -> list[str]:
    """Return a different name for each node: its own, or its number."""
    counts = Counter[str]()
    names: dict[str, int] = {}
    for k, node in enumerate(nodes):
        name = unique = str(node.get("name", k))
        while unique in names:
            counts[name] += 1
            unique = f"{name}_{counts[name]}"
        names[unique] = k
    return list(names)


def _world_matrices(nodes: list[dict], roots: list[int]) -> dict[int, np.ndarray]:
    """Return the matrix (4, 4) from each node to the world; a chain of nodes may be of any length."""
    from scipy.spatial.transform import Rotation  # imported here: most commands need no mesh

    matrices: dict[int, np.ndarray] = {}
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        k, parent = waiting.pop()
        node = nodes[k]
        local = np.reshape(node.get("matrix", np.eye(4)), (4, 4)).T.astype(float)
        local[:3, 3] += np.array(node.get("translation", (0.0, 0.0, 0.0)), dtype=float)
        if "rotation" in node:
            local[:3, :3] @= Rotation.from_quat(node["rotation"]).as_matrix()
        local[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
        matrices[k] = parent @ local
        waiting += [(child, matrices[k]) for child in reversed(node.get("children", ()))]
    return matrices


def _accessors_of(primitive: dict) -> list[int]:
    """Return the accessors of a primitive: its positions, and its indices if it has some."""
    return [primitive["attributes"]["POSITION"], *([primitive["indices"]] if "indices" in primitive else [])]


@cache
def _warn_of_materials(path: Path) -> None:
    log.warning("%s: materials are not read; the mesh has the colours of the type of its box", path)


def _read_obj(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the triangles of an OBJ: vertices and faces; names, normals, colours and materials are not read."""
    text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    if re.search(r"(?m)^[ \t]*mtllib\b", text):
        _warn_of_materials(path)
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for kind, rest in re.findall(r"(?m)^[ \t]*([vf])[ \t]+([^#\r\n]+)", text):
        words = rest.split()
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
            continue
        corners = [int(word.partition("/")[0]) - 1 for word in words]
        if min(corners) < 0:
            raise InputError(
                "the OBJ file uses negative vertex indices, which are not supported",
                where=path,
                expected="indices from 1",
                fix="export the mesh with absolute indices",
            )
        faces += [(corners[0], *pair) for pair in pairwise(corners[1:])]
    check_num_triangles(path, len(faces))
    return {"mesh": np.reshape(vertices, (-1, 3))[np.reshape(faces, (-1, 3)).astype(int)]}


MESHES_FILE = "meshes.glb"
FLOAT, ARRAY_BUFFER = 5126, 34962  # numbers of glTF


class MeshRef(BaseModel):
    """The mesh that is drawn instead of a box.

    fit `box`: The bounds of the mesh are stretched to the box, axis by axis. fit `world`: Its vertices are positions in
    the map, in metres; if several boxes name the same mesh, it is drawn once, with the id of the first box.

    up: The axis that points up in the file; without it y in glTF and z in an OBJ.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    file: str = Field(min_length=1, max_length=1024)
    node: str | None = None
    fit: Literal["box", "world"] = "box"
    up: Literal["y", "z"] | None = None

    @field_validator("file")
    @classmethod
    def _stays_below(cls, name: str) -> str:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
            raise ValueError("the name of a mesh file must be a relative path without `..` and backslashes")
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"the name of a mesh file must end in one of {', '.join(SUFFIXES)}")
        return name


@dataclass(frozen=True)
class Meshes:
    """The meshes of a map. refs: Box id -> the mesh that is drawn. folder: The folder of the files. made: Node -> mesh,
    of a MESHES_FILE that is not written yet.
    """

    refs: dict[int, MeshRef] = field(default_factory=dict)
    folder: Path | None = None
    made: dict[str, np.ndarray] = field(default_factory=dict)

    def files(self) -> dict[str, Path]:
        """Return the files that boxes name, by name."""
        names = sorted({ref.file for ref in self.refs.values()})
        return {name: self.folder / name for name in names} if self.folder is not None else {}

    def resolved(self) -> dict[MeshRef, np.ndarray]:
        """Read the meshes that the boxes name."""
        nodes_by_file = {
            name: read_meshes(path, tree=path.parents[len(Path(name).parts) - 1]) for name, path in self.files().items()
        }
        meshes: dict[MeshRef, np.ndarray] = {}
        for box_id, ref in self.refs.items():
            nodes = nodes_by_file.get(ref.file, self.made)
            if ref.node is not None and ref.node not in nodes:
                raise InputError(
                    "the mesh file has no node of this name",
                    where=f"box {box_id}: {ref.file}",
                    got=ref.node[:80],
                    expected=f"the name of a node in this file, such as {', '.join(list(nodes)[:8])}",
                )
            if ref not in meshes:
                mesh = np.concatenate(list(nodes.values())) if ref.node is None else nodes[ref.node]
                meshes[ref] = self._turned(mesh, ref)
        num_triangles = sum(len(meshes[ref]) for ref in self.refs.values() if ref.fit == "box")
        num_triangles += sum(len(mesh) for ref, mesh in meshes.items() if ref.fit == "world")
        check_num_triangles(self.folder or "map", num_triangles)
        return meshes

    def _turned(self, mesh: np.ndarray, ref: MeshRef) -> np.ndarray:
        """Return a mesh with the axis `up` of its reference up."""
        usual = "z" if ref.file.lower().endswith(".obj") else "y"
        if ref.up not in (None, usual):
            return mesh @ (Z_UP.T if ref.up == "y" else Z_UP)
        low = mesh.min(axis=(0, 1)) if len(mesh) else np.zeros(3)
        if ref.up is None and usual == "z" and abs(low[1]) < START_M < abs(low[2]):
            log.warning(
                '%s: y begins at 0 and z does not; if y is up in this file, add "up": "y" to the mesh', ref.file
            )
        return mesh

    def relative_to(self, folder: Path) -> Meshes:
        """Return the meshes moved to MESHES_FILE of a folder, writing it where needed."""
        if not self.refs or (self.folder == folder and not self.made):
            return self
        names: dict[MeshRef, str] = {}
        loaded = self.resolved()
        for ref in loaded:
            name = ref.node if self.made and ref.node else f"{ref.file}#{ref.node or ''}"
            names[ref] = name if name not in names.values() else f"{name} ({ref.fit}{f', {ref.up}' if ref.up else ''})"
        write_meshes(folder / MESHES_FILE, {names[ref]: mesh for ref, mesh in loaded.items()})
        moved = {ref: MeshRef(file=MESHES_FILE, node=name, fit=ref.fit) for ref, name in names.items()}
        return replace(self, refs={box_id: moved[ref] for box_id, ref in self.refs.items()}, folder=folder, made={})


def write_meshes(path: Path, meshes: dict[str, np.ndarray]) -> None:
    """Write binary glTF 2.0 with a node for each mesh: vertices in single precision relative to the node's position."""
    nodes: list[dict] = []
    views: list[dict] = []
    accessors: list[dict] = []
    binary = bytearray()
    for number, (name, triangles) in enumerate(meshes.items()):
        corners = triangles.reshape(-1, 3) @ Z_UP  # by the transpose, back to +y up
        middle = np.round((corners.min(axis=0) + corners.max(axis=0)) / 2)
        offsets = (corners - middle).astype("<f4")
        accessors.append(
            {"bufferView": number, "componentType": FLOAT, "type": "VEC3", "count": len(offsets),
             "min": offsets.min(axis=0).tolist(), "max": offsets.max(axis=0).tolist()}
        )  # fmt: skip
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": offsets.nbytes, "target": ARRAY_BUFFER})
        binary += offsets.tobytes()
        nodes.append({"name": name, "mesh": number, "translation": middle.tolist()})
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
