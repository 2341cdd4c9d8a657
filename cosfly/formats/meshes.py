"""Meshes: glTF 2.0 (.glb, .gltf) and Wavefront OBJ (.obj) read through trimesh, and `meshes.glb` next to a map.

Only triangles and plain colours are read, not textures. +y is up in glTF and becomes +z; in an OBJ +z is up. trimesh
gets bytes only: this module reads the files that a mesh names, from below its folder, and bounds counts before loading.
Planners and visibility use boxes only.
"""

from __future__ import annotations

import base64
import functools
import io
import json
import re
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from urllib.parse import unquote

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import MB, decoded, over_limit, read_bytes, write_bytes
from cosfly.runtime.json_io import parse_document

MOST_TRIANGLES = 2_000_000  # of a file, and of all meshes of a map
FILE_MB = MOST_TRIANGLES * 256 / MB  # an OBJ takes some 100 bytes for a triangle
MOST_NUMBERS = 12 * MOST_TRIANGLES  # of vertices, colours and indices; three of each are usual for a triangle
SUFFIXES = (".glb", ".gltf", ".obj")
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from glTF's axes
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
GLB_HEADER_BYTES = 12
TRIANGLES, STRIP = 4, 5  # modes; points and lines have no surface
DISPLAY_GAMMA = 2.2  # an OBJ's colours are those of a screen
LARGEST_M = 1e7
# What trimesh raises on a file that contradicts itself.
NOT_READ = (ValueError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError, NotImplementedError)


@dataclass(frozen=True)
class Mesh:
    """Triangles, k of them: corners_m (k, 3, 3) float64, z up, counter-clockwise from outside; colors (k, 3) linear
    RGB, NaN where the file has none.
    """

    corners_m: np.ndarray
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.corners_m)


def joined(meshes: list[Mesh]) -> Mesh:
    """Return one mesh with the triangles of several, at least one."""
    return Mesh(np.concatenate([m.corners_m for m in meshes]), np.concatenate([m.colors for m in meshes]))


def too_many(where: object, num_triangles: int) -> InputError:
    """Return the error of a mesh or a map with too many triangles."""
    return over_limit(where, f"{num_triangles:,} triangles", f"{MOST_TRIANGLES:,}", "simplify the meshes")


@dataclass(frozen=True)
class _Folder:
    """The folder of a mesh. trimesh reads files through it and gets materials without textures."""

    path: Path
    tree: Path

    def read(self, name: str) -> bytes:
        inner = PurePosixPath(unquote(name))
        if inner.is_absolute() or ".." in inner.parts or "\\" in name or ":" in name or "\0" in name or not inner.parts:
            what = "the mesh names a file outside of its folder"
            raise InputError(what, where=self.path, got=name[:80], expected="a file below the folder of the mesh")
        where = self.path.parent / inner
        return read_bytes(where, what=f"file that {self.path.name} names", tree=self.tree, most_mb=FILE_MB)

    def __getitem__(self, name: str) -> bytes:
        return re.sub(rb"(?im)^\s*map_kd\b", b"textured", self.read(name))


def read_meshes(path: Path, *, tree: Path) -> dict[str, Mesh]:
    """Read a file of meshes, node by node; an OBJ is one node.

    tree: The folder that must contain the file and all files that it names.
    """
    data = read_bytes(path, what="mesh", tree=tree, most_mb=FILE_MB)
    readers = {".glb": _read_glb, ".gltf": _read_gltf, ".obj": _read_obj}
    if path.suffix.lower() not in readers:
        raise InputError(
            "the file type of the mesh is unknown", where=path, got=path.suffix, expected=", ".join(SUFFIXES)
        )
    try:
        meshes = readers[path.suffix.lower()](data, _Folder(path, tree))
    except NOT_READ as error:
        raise InputError(
            "the mesh file cannot be parsed", where=path, got=f"{type(error).__name__}: {error}"[:120]
        ) from None
    if not any(map(len, meshes.values())):
        raise InputError("the mesh has no triangles", where=path)
    for name, mesh in meshes.items():
        is_valid = (np.abs(mesh.corners_m) <= LARGEST_M).all(axis=2)  # NaN fails
        if not is_valid.all():
            problem = (
                f"mesh {name!r} has a vertex that is not finite or is more than {LARGEST_M:,.0f} m from the origin"
            )
            vertex = ", ".join(f"{value:g}" for value in mesh.corners_m[~is_valid][0])
            fix = "move or remove the vertex, and export the mesh in metres"
            raise InputError(problem, where=path, got=f"the vertex ({vertex}) m", fix=fix)
    return meshes


def _read_glb(data: bytes, folder: _Folder) -> dict[str, Mesh]:
    if struct.unpack_from("<II", data.ljust(20)) != (GLB_MAGIC, 2):
        raise InputError("this file is not a binary glTF 2.0 file", where=folder.path)
    chunks: dict[int, bytes] = {}
    end = GLB_HEADER_BYTES
    while end + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, end)
        chunks.setdefault(kind, data[end + 8 : end + 8 + size])
        end += 8 + size
    if end > len(data):
        got = f"{len(data)} bytes"
        raise InputError("the mesh file is cut short", where=folder.path, got=got, expected=f"{end} bytes")
    return _read_gltf(chunks[JSON_CHUNK], folder, chunks.get(BINARY_CHUNK, b""))


def _read_gltf(data: bytes, folder: _Folder, binary: bytes = b"") -> dict[str, Mesh]:
    """Read the meshes of a glTF document by the names of their nodes.

    trimesh gets a flat document with triangles and colours only, in which each primitive is a mesh of its own.
    """
    document = parse_document(data, folder.path)
    accessors = document.get("accessors", [])
    views = document.get("bufferViews", [])
    if document.get("extensionsRequired") or any("sparse" in a or "bufferView" not in a for a in accessors):
        raise InputError(
            "the mesh requires a glTF extension, a sparse accessor or an accessor without data",
            where=folder.path,
            expected="plain glTF 2.0",
            fix="export it again without compression and other extensions",
        )
    nodes = [dict(node) for node in document.get("nodes", ())]
    roots = _roots(document, nodes, folder)
    owned = _with_own_nodes(document, nodes)
    primitives = [_flat_primitive(primitive, folder) for _, primitive in owned]
    used = [k for flat in primitives for k in (*flat["attributes"].values(), flat.get("indices")) if k is not None]
    counts = [*(accessors[k]["count"] for k in used), *(view["byteLength"] for view in views)]
    most = int(MOST_NUMBERS + FILE_MB * MB)
    if min(counts, default=0) < 0 or sum(counts) > most:
        expected = f"counts of at least 0 and a sum of at most {most:,}"
        raise InputError(
            "the counts of the mesh are negative or too large",
            where=folder.path,
            got=f"{sum(counts):,}",
            expected=expected,
        )
    read_buffer = functools.cache(lambda uri: _buffer(uri, binary, folder))  # several buffers may name one file
    buffers = {str(k): read_buffer(b.get("uri")) for k, b in enumerate(document.get("buffers", ()))}
    flat_document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": roots}], "accessors": accessors, "bufferViews": views,
        "nodes": [node | {"name": str(k)} for k, node in enumerate(nodes)],
        "meshes": [{"name": str(k), "primitives": [flat]} for k, flat in enumerate(primitives)],
        "buffers": [{"uri": name} for name in buffers],
    }  # fmt: skip
    scene = _scene(json.dumps(flat_document).encode(), "gltf", buffers, folder, skip_materials=True)
    meshes_by_node: dict[str, list[Mesh]] = {}
    placed = [scene.graph[name] for name in scene.graph.nodes_geometry]
    for number, world in sorted((int(str(key)), world) for world, key in placed):
        node_index, primitive = owned[number]
        name = str(document["nodes"][node_index].get("name", f"node_{node_index}"))
        mesh = _placed(scene.geometry[str(number)], world, _color(primitive, document))
        meshes_by_node.setdefault(name, []).append(mesh)
    return {name: joined(meshes) for name, meshes in meshes_by_node.items()}


def _roots(document: dict, nodes: list[dict], folder: _Folder) -> list[int]:
    """Return the nodes of the scene, or without scenes those that have no parent."""
    children = [child for node in nodes for child in node.get("children", ())]
    if "scenes" in document:
        roots = document["scenes"][document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(nodes))) - set(children))
    if len({*children, *roots}) < len(children) + len(roots):  # also a cycle
        raise InputError("a node of the mesh has two parents", where=folder.path, expected="one parent for each node")
    return roots


def _with_own_nodes(document: dict, nodes: list[dict]) -> list[tuple[int, dict]]:
    """Replace meshes by a child node for each primitive with triangles, in place; return each with its old node."""
    owned: list[tuple[int, dict]] = []
    for k, node in enumerate(list(nodes)):
        primitives = document["meshes"][node.pop("mesh")]["primitives"] if "mesh" in node else ()
        for primitive in primitives:
            if primitive.get("mode", TRIANGLES) >= TRIANGLES:
                node["children"] = [*node.get("children", ()), len(nodes)]
                nodes.append({"mesh": len(owned)})
                owned.append((k, primitive))
    return owned


def _flat_primitive(primitive: dict, folder: _Folder) -> dict:
    """Return a primitive with its triangles and colours only."""
    if primitive.get("mode", TRIANGLES) > STRIP:
        what = "the mesh has a fan of triangles"
        raise InputError(
            what, where=folder.path, expected="triangles or strips of triangles", fix="triangulate the mesh"
        )
    attributes = {name: k for name, k in primitive["attributes"].items() if name in ("POSITION", "COLOR_0")}
    return {key: primitive[key] for key in ("mode", "indices") if key in primitive} | {"attributes": attributes}


def _buffer(uri: str | None, binary: bytes, folder: _Folder) -> bytes:
    if uri is None:
        return binary
    return base64.b64decode(uri.partition(",")[2]) if uri.startswith("data:") else folder.read(uri)


def _scene(data: bytes, file_type: str, resolver: Any, folder: _Folder, **options: Any) -> Any:
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(data), file_type=file_type, resolver=resolver, **options)
    num_triangles = sum(len(getattr(shape, "faces", ())) for shape in scene.geometry.values())
    if num_triangles > MOST_TRIANGLES:
        raise too_many(folder.path, num_triangles)
    return scene


def _color(primitive: dict, document: dict) -> np.ndarray:
    """Return the plain colour of a primitive, linear RGB; NaN if it has none or has a texture."""
    material = document["materials"][primitive["material"]] if "material" in primitive else {}
    surface = material.get("pbrMetallicRoughness", {})
    is_plain = "baseColorFactor" in surface and "baseColorTexture" not in surface
    return np.array(surface["baseColorFactor"] if is_plain else [np.nan] * 4, np.float64).reshape(4)[:3]


def _placed(shape: Any, world: np.ndarray, color: np.ndarray) -> Mesh:
    """Convert a mesh of trimesh, moved by the transform of its node (4, 4)."""
    corners = (shape.vertices[shape.faces] @ world[:3, :3].T + world[:3, 3]) @ Z_UP.T
    colors = np.tile(color, (len(corners), 1))
    if shape.visual.kind == "vertex":
        painted = np.asarray(shape.visual.vertex_colors)[shape.faces][..., :3].mean(axis=1) / 255
        colors = np.where(np.isnan(colors), 1.0, colors) * painted
    mirrored = np.linalg.det(world[:3, :3]) < 0
    return Mesh(corners[:, ::-1] if mirrored else corners, np.clip(colors, 0.0, 1.0))


def _read_obj(data: bytes, folder: _Folder) -> dict[str, Mesh]:
    """Read an OBJ, with the diffuse colours (`Kd`) of the materials that have no texture."""
    if re.search(r"(?m)^[ \t]*f[ \t].*-", text := decoded(data, folder.path)):
        raise InputError(
            "the OBJ file uses negative vertex indices, which are not supported",
            where=folder.path,
            expected="indices from 1",
            fix="export the mesh with absolute indices",
        )
    for name in re.findall(r"(?m)^[ \t]*mtllib[ \t]+(.*)$", text):
        folder.read(name.strip())  # trimesh would ignore a file that cannot be read
    scene = _scene(text.encode(), "obj", folder, folder, process=False)
    meshes: list[Mesh] = []
    for shape in scene.geometry.values():
        material = getattr(getattr(shape.visual, "material", None), "kwargs", {})
        is_plain = "kd" in material and "textured" not in material
        color = np.clip(material["kd"], 0.0, 1.0) ** DISPLAY_GAMMA if is_plain else np.full(3, np.nan)
        corners = shape.vertices[getattr(shape, "faces", np.zeros((0, 3), int))]
        meshes.append(Mesh(corners, np.tile(np.reshape(color, 3), (len(corners), 1))))
    return {"mesh": joined(meshes)} if meshes else {}


MESHES_FILE = "meshes.glb"
FLOAT, ARRAY_BUFFER = 5126, 34962  # numbers of glTF
NO_COLOR = -1.0  # replaces NaN while colours are sorted


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
            raise ValueError("the name of a mesh must lead to a file below the map's folder")
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"the name of a mesh must end in one of {', '.join(SUFFIXES)}")
        return name


@dataclass(frozen=True)
class Meshes:
    """The meshes of a map. refs: Box id -> the mesh that is drawn. folder: The folder of the files. made: Node -> mesh,
    of a MESHES_FILE that is not written yet.
    """

    refs: dict[int, MeshRef] = field(default_factory=dict)
    folder: Path | None = None
    made: dict[str, Mesh] = field(default_factory=dict)

    def files(self) -> dict[str, Path]:
        """Return the files that boxes name, by name."""
        names = sorted({ref.file for ref in self.refs.values()})
        return {name: self.folder / name for name in names} if self.folder is not None else {}

    def resolved(self) -> dict[MeshRef, Mesh]:
        """Read the meshes that the boxes name."""
        nodes_by_file = {
            name: read_meshes(path, tree=path.parents[len(Path(name).parts) - 1]) for name, path in self.files().items()
        }
        meshes: dict[MeshRef, Mesh] = {}
        for box_id, ref in self.refs.items():
            nodes = nodes_by_file.get(ref.file, self.made)
            if ref.node is not None and ref.node not in nodes:
                raise InputError(
                    "the mesh file has no node of this name",
                    where=f"box {box_id}: {ref.file}",
                    got=ref.node[:80],
                    expected=", ".join(list(nodes)[:8]),
                )
            if ref not in meshes:
                meshes[ref] = joined(list(nodes.values())) if ref.node is None else nodes[ref.node]
        num_triangles = sum(len(meshes[ref]) for ref in self.refs.values() if ref.fit == "box")
        num_triangles += sum(len(mesh) for ref, mesh in meshes.items() if ref.fit == "world")
        if num_triangles > MOST_TRIANGLES:
            raise too_many(self.folder or "map", num_triangles)
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


def write_meshes(path: Path, meshes: dict[str, Mesh]) -> None:
    """Write binary glTF 2.0 with a node for each mesh: vertices in single precision relative to the node's position."""
    nodes: list[dict] = []
    gltf_meshes: list[dict] = []
    views: list[dict] = []
    accessors: list[dict] = []
    material_of: dict[tuple[float, ...], int] = {}
    binary = bytearray()
    for name, mesh in meshes.items():
        corners = mesh.corners_m.reshape(-1, 3) @ Z_UP  # by the transpose, back to +y up
        middle = np.round((corners.min(axis=0) + corners.max(axis=0)) / 2)
        primitives = []
        colors = np.round(np.where(np.isnan(mesh.colors), NO_COLOR, mesh.colors), 4)
        for color in np.unique(colors, axis=0):
            has_color = np.repeat((colors == color).all(axis=1), 3)
            offsets = (corners[has_color] - middle).astype("<f4")
            primitive: dict = {"attributes": {"POSITION": len(accessors)}, "mode": TRIANGLES}
            if (color != NO_COLOR).all():
                primitive["material"] = material_of.setdefault(tuple(color.tolist()), len(material_of))
            primitives.append(primitive)
            accessors.append(
                {"bufferView": len(views), "componentType": FLOAT, "type": "VEC3", "count": len(offsets),
                 "min": offsets.min(axis=0).tolist(), "max": offsets.max(axis=0).tolist()}
            )  # fmt: skip
            views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": offsets.nbytes, "target": ARRAY_BUFFER})
            binary += offsets.tobytes()
        nodes.append({"name": name, "mesh": len(gltf_meshes), "translation": middle.tolist()})
        gltf_meshes.append({"primitives": primitives})
    materials = [{"pbrMetallicRoughness": {"baseColorFactor": [*c, 1.0]}, "doubleSided": True} for c in material_of]
    document = {
        "asset": {"version": "2.0", "generator": "cosfly"}, "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes, "meshes": gltf_meshes, "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}], **({"materials": materials} if materials else {}),
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    write_bytes(path, struct.pack("<III", GLB_MAGIC, 2, GLB_HEADER_BYTES + len(chunks)) + chunks)
