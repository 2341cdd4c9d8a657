"""Meshes: binary glTF 2.0 (.glb) and Wavefront OBJ (.obj) read through trimesh, and `meshes.glb` next to a map.

A mesh is its triangles, corners (k, 3, 3) float64 m, z up, counter-clockwise from outside; its colour is that of the
kind of its box. +y is up in glTF and becomes +z; in an OBJ +z is up. A mesh is one file: what it names is not read, and
counts are bounded before trimesh loads it. Planners and visibility use boxes.
"""

from __future__ import annotations

import io
import json
import re
import struct
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import MB, decoded, over_limit, read_bytes, write_bytes
from cosfly.runtime.json_io import parse_document

MOST_TRIANGLES = 2_000_000  # of a file, and of all meshes of a map
FILE_MB = MOST_TRIANGLES * 256 / MB  # an OBJ takes some 100 bytes for a triangle
MOST_NUMBERS = 12 * MOST_TRIANGLES  # of vertices and indices; three of each are usual for a triangle
SUFFIXES = (".glb", ".obj")
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from glTF's axes
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
GLB_HEADER_BYTES = 12
TRIANGLES, STRIP = 4, 5  # modes of primitives that are drawn
LARGEST_M = 1e7
# What trimesh raises on a file that contradicts itself.
NOT_READ = (ValueError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError, NotImplementedError)


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
    """Read the meshes of a glTF document by the names of their nodes; trimesh gets its triangles only."""
    document = parse_document(text, path)
    accessors, views, nodes, meshes = (
        document.get(name, []) for name in ("accessors", "bufferViews", "nodes", "meshes")
    )
    is_plain = not document.get("extensionsRequired") and all(
        "bufferView" in a and "sparse" not in a for a in accessors
    )
    if not is_plain or any("uri" in buffer for buffer in document.get("buffers", ())):
        raise InputError(
            "the mesh file uses an unsupported feature: a glTF extension, a sparse accessor, or data in another file",
            where=path,
            expected="glTF 2.0 without these features, in one file",
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
    counts = [*(a["count"] for a in accessors), *(view["byteLength"] for view in views)]
    most = int(MOST_NUMBERS + FILE_MB * MB)
    if min(counts, default=0) < 0 or sum(counts) > most:
        expected = f"no negative number, and at most {most:,} values and bytes in all"
        what = "the mesh file declares a negative number of values, or too many values"
        got, fix = f"{sum(counts):,} values and bytes in all", "export the mesh again with fewer triangles"
        raise InputError(what, where=path, got=got, expected=expected, fix=fix)
    plain_document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": roots}], "accessors": accessors, "bufferViews": views,
        "nodes": [{key: value for key, value in node.items() if key != "camera"} for node in nodes],
        "meshes": [{"primitives": _triangles_of(mesh)} for mesh in meshes],
        "buffers": [{"uri": "binary"}],
    }  # fmt: skip
    scene = _scene(json.dumps(plain_document).encode(), "gltf", resolver={"binary": binary})
    placed = {frame: scene.graph[frame] for frame in scene.graph.nodes_geometry}
    check_num_triangles(path, sum(len(scene.geometry[key].faces) for _, key in placed.values()))
    parts: dict[str, list[np.ndarray]] = {}
    for frame, (world, key) in placed.items():
        corners = scene.geometry[key].triangles @ world[:3, :3].T + world[:3, 3]
        is_mirrored = np.linalg.det(world[:3, :3]) < 0
        parent = scene.graph.transforms.parents[frame]  # of one of several primitives: the node
        name = parent if frame.startswith(f"{parent}_") else frame
        parts.setdefault(name, []).append((corners[:, ::-1] if is_mirrored else corners) @ Z_UP.T)
    return {name: np.concatenate(corners) for name, corners in parts.items()}


def _triangles_of(mesh: dict) -> list[dict]:
    """Return the primitives of a mesh that are triangles, without normals, colours and extensions."""
    return [
        {key: primitive[key] for key in ("mode", "indices") if key in primitive}
        | {"attributes": {"POSITION": primitive["attributes"]["POSITION"]}}
        for primitive in mesh["primitives"]
        if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP)
    ]


def _scene(data: bytes, file_type: str, **options: Any) -> Any:
    import trimesh

    return trimesh.load_scene(io.BytesIO(data), file_type=file_type, skip_materials=True, **options)


def _read_obj(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the triangles of an OBJ; its materials are not read."""
    if re.search(r"(?m)^[ \t]*f[ \t].*-", text := decoded(data, path)):
        raise InputError(
            "the OBJ file uses negative vertex indices, which are not supported",
            where=path,
            expected="indices from 1",
            fix="export the mesh with absolute indices",
        )
    shapes = [
        shape for shape in _scene(text.encode(), "obj", process=False).geometry.values() if hasattr(shape, "faces")
    ]
    check_num_triangles(path, sum(len(shape.faces) for shape in shapes))
    return {"mesh": np.concatenate([np.asarray(shape.triangles) for shape in shapes])} if shapes else {}


MESHES_FILE = "meshes.glb"
FLOAT, ARRAY_BUFFER = 5126, 34962  # numbers of glTF


class MeshRef(BaseModel):
    """The mesh that is drawn instead of a box.

    fit `box`: The bounds of the mesh are stretched to the box, axis by axis. fit `world`: Its vertices are positions in
    the map, in metres; if several boxes name the same mesh, it is drawn once, with the id of the first box.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    file: str = Field(min_length=1, max_length=1024)
    node: str | None = None
    fit: Literal["box", "world"] = "box"

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
                meshes[ref] = np.concatenate(list(nodes.values())) if ref.node is None else nodes[ref.node]
        num_triangles = sum(len(meshes[ref]) for ref in self.refs.values() if ref.fit == "box")
        num_triangles += sum(len(mesh) for ref, mesh in meshes.items() if ref.fit == "world")
        check_num_triangles(self.folder or "map", num_triangles)
        return meshes

    def relative_to(self, folder: Path) -> Meshes:
        """Return the meshes moved to MESHES_FILE of a folder, writing it where needed."""
        if not self.refs or (self.folder == folder and not self.made):
            return self
        names: dict[MeshRef, str] = {}
        loaded = self.resolved()
        for ref in loaded:
            name = ref.node if self.made and ref.node else f"{ref.file}#{ref.node or ''}"
            names[ref] = name if name not in names.values() else f"{name} ({ref.fit})"
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
