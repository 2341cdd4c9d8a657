"""Meshes of glTF 2.0 (.glb, .gltf) and Wavefront OBJ (.obj): triangles and their plain colours, a node each. No
textures.

What a file names or counts is checked before anything is opened or made of it. glTF is then read by trimesh, which gets
neither names of files nor what is not needed; OBJ is read here, since trimesh counts relative indices from the end of
the file. glTF's +y is up and becomes +z; OBJ has no rule, and is taken as it stands, z up. Source: Khronos glTF 2.0;
the OBJ appendix of Wavefront's manual.
"""

from __future__ import annotations

import base64
import functools
import io
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from cosfly.errors import InputError
from cosfly.reading.documents import parse_document
from cosfly.reading.files import MB, decoded, over_limit, read_bytes

MOST_TRIANGLES = 2_000_000  # of a file, and of all that a map draws; a gigabyte as they are read
TRIANGLE_BYTES = 256  # of a file, at most, for each triangle that is allowed: an OBJ takes some 100
SIMPLIFY = "simplify the meshes, or raise mesh_triangles of maps and render if you trust them"
WHAT = "mesh"
SUFFIXES = (".glb", ".gltf", ".obj")
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from glTF's axes
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
DRACO = "KHR_draco_mesh_compression"
PLACING = ("children", "matrix", "translation", "rotation", "scale")  # of a node
MOST_NUMBERS = 12  # of vertices, their colours and indices, for a triangle; three of each are usual
# What trimesh raises on a document that contradicts itself.
NOT_READ = (ValueError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError, NotImplementedError)
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes; points and lines have no surface
DISPLAY_GAMMA = 2.2  # an OBJ's colours are those of a screen
LARGEST_M = 1e7


@dataclass(frozen=True)
class Mesh:
    """Triangles, k of them: corners_m (k, 3, 3) float64, z up, counter-clockwise from outside; colors (k, 3) linear
    RGB, NaN where the file tells none.
    """

    corners_m: np.ndarray
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.corners_m)


def joined(meshes: list[Mesh]) -> Mesh:
    """All of some meshes, at least one, as one."""
    return Mesh(np.concatenate([m.corners_m for m in meshes]), np.concatenate([m.colors for m in meshes]))


class _Source(NamedTuple):
    """A file that is read; what it names lies in `tree`."""

    path: Path
    tree: Path
    most_triangles: int

    def check_count(self, num_triangles: int) -> None:
        if num_triangles > self.most_triangles:
            raise too_many(self.path, f"{num_triangles:,} triangles or more", self.most_triangles)

    def read(self, path: Path, what: str) -> bytes:
        most_mb = self.most_triangles * TRIANGLE_BYTES / MB
        return read_bytes(path, what=what, tree=self.tree, most_mb=most_mb, split=SIMPLIFY)

    def beside(self, name: str) -> bytes:
        """Read what the file names beside it."""
        inner = PurePosixPath(unquote(name))
        if inner.is_absolute() or ".." in inner.parts or "\\" in name or ":" in name or "\0" in name or not inner.parts:
            what = "the mesh names a file outside of its folder"
            raise InputError(what, where=self.path, got=name[:80], expected="a name below it")
        return self.read(self.path.parent / inner, f"file that {self.path.name} names")

    def malformed(self, field: str, what: str, got: str | None = None, expected: str | None = None) -> InputError:
        where = f"{self.path}: {field}"
        return InputError(f"the mesh cannot be read: {what}", where=where, got=got, expected=expected)


def too_many(where: object, got: str, most: int) -> InputError:
    """Give the error of what draws too much."""
    return over_limit(where, got, f"{most:,}", SIMPLIFY)


def read_meshes(path: Path, *, tree: Path, most_triangles: int = MOST_TRIANGLES) -> dict[str, Mesh]:
    """Read a file of meshes, node by node; what it names beside it is read too.

    Args:
        tree: the folder that neither the file nor what it names may lie outside of.
    """
    source = _Source(path, tree, most_triangles)
    data = source.read(path, WHAT)
    readers = {".glb": _read_glb, ".gltf": _read_gltf, ".obj": _read_obj}
    if path.suffix.lower() not in readers:
        raise InputError("not a mesh that is known", where=path, got=path.suffix, expected=", ".join(SUFFIXES))
    found: dict[str, Mesh] = {}
    num_triangles = 0
    for name, mesh in readers[path.suffix.lower()](data, source):
        num_triangles += len(mesh)
        source.check_count(num_triangles)
        if not (np.abs(mesh.corners_m) <= LARGEST_M).all():  # NaN is not
            raise InputError(
                "a vertex is not finite or too far off", where=f"{path}: {name}", expected=f"within {LARGEST_M:g} m"
            )
        found[name] = joined([found[name], mesh]) if name in found else mesh
    if not num_triangles:
        raise InputError("the mesh has no triangles", where=path)
    return found


# --- glTF -------------------------------------------------------------------------------------------------------------


def _read_glb(data: bytes, source: _Source) -> Iterator[tuple[str, Mesh]]:
    if len(data) < 20 or struct.unpack_from("<II", data) != (GLB_MAGIC, 2):
        raise InputError(
            "not a binary glTF 2.0", where=source.path, got=f"{len(data)} bytes", expected="a .glb of version 2"
        )
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > len(data):
            raise InputError(
                "the mesh is cut short", where=source.path, got=f"{len(data)} bytes", expected=f"{at + 8 + size}"
            )
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return _read_gltf(chunks.get(JSON_CHUNK, b""), source, chunks.get(BINARY_CHUNK))


def _read_gltf(data: bytes, source: _Source, binary: bytes | None = None) -> Iterator[tuple[str, Mesh]]:
    """Yield the mesh of every node."""
    document = parse_document(data, source.path, what=WHAT)
    try:
        yield from _nodes(document, binary, source)
    except NOT_READ as error:
        raise source.malformed("glTF", "malformed", f"{type(error).__name__}: {error}"[:120], "glTF 2.0") from None


def _nodes(document: dict, binary: bytes | None, source: _Source) -> Iterator[tuple[str, Mesh]]:
    """Let trimesh read a document of which only what is drawn is left, and in which each drawn node has one triangle
    mesh and both have numbers for names."""
    if unknown := set(document.get("extensionsRequired", ())) - {DRACO}:
        got = ", ".join(sorted(unknown))[:80]
        raise source.malformed("extensionsRequired", "needs what is not read here", got, "plain glTF 2.0, or Draco")
    nodes, scenes = document.get("nodes", []), document.get("scenes")
    children = [child for node in nodes for child in node.get("children", ())]
    roots = (
        sorted(set(range(len(nodes))) - set(children))
        if scenes is None
        else scenes[document.get("scene", 0)].get("nodes", [])
    )
    if len({*children, *roots}) < len(children) + len(roots):
        raise source.malformed("nodes", "a node with two parents")
    pieces = [
        [p for p in mesh["primitives"] if p.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN)]
        for mesh in document.get("meshes", ())  # points and lines have no surface
    ]
    flat_nodes = [{key: node[key] for key in PLACING if key in node} | {"name": str(k)} for k, node in enumerate(nodes)]
    owners, accessors, num_numbers = list[tuple[int, dict]](), document.get("accessors", []), 0
    for k, node in enumerate(nodes):
        for piece in pieces[node["mesh"]] if "mesh" in node else ():
            num_numbers += 1 + sum(
                _size(accessors[n], "count") for n in _used(piece)
            )  # trimesh makes a copy for each node
            source.check_count(num_numbers // MOST_NUMBERS)
            below = flat_nodes[k]["children"] = list(flat_nodes[k].get("children", ()))
            below.append(len(flat_nodes))
            flat_nodes.append({"name": f"piece {len(owners)}", "mesh": len(owners)})
            owners.append((k, piece))
    read = functools.cache(lambda uri: _buffer(uri, binary, source))  # each once, however many name it
    buffers = {str(k): read(b.get("uri")) for k, b in enumerate(document.get("buffers", ()))}
    views = document.get("bufferViews", [])
    if sum(_size(view, "byteLength") for view in views) > 2 * sum(map(len, buffers.values())):
        raise source.malformed("bufferViews", "more numbers than bytes")
    flat = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": roots}], "nodes": flat_nodes, "bufferViews": views,
        "meshes": [{"name": str(k), "primitives": [_drawn(piece, source)]} for k, (_, piece) in enumerate(owners)],
        "accessors": _accessors(accessors, [piece for _, piece in owners], source),
        "buffers": [{"uri": name} for name in buffers],
    }  # fmt: skip
    import trimesh

    text = io.BytesIO(json.dumps(flat).encode())
    scene = trimesh.load_scene(text, file_type="gltf", resolver=buffers, skip_materials=True)
    placed = [scene.graph[name] for name in scene.graph.nodes_geometry]
    num_triangles = 0
    for number, world in sorted((int(str(key)), world) for world, key in placed):
        k, piece = owners[number]
        shape = scene.geometry[str(number)]
        num_triangles += len(shape.faces)
        source.check_count(num_triangles)
        if DRACO in piece.get("extensions", ()) and not shape.vertices.any():  # trimesh leaves zeros, and warns
            expected = "Draco, and DracoPy installed"
            raise source.malformed("meshes", "the packed vertices do not unpack", expected=expected)
        yield str(nodes[k].get("name", f"node_{k}")), _placed(shape, world, _color(piece, document))


def _drawn(piece: dict, source: _Source) -> dict:
    """What is needed of a primitive."""
    if piece.get("mode") == FAN:
        raise source.malformed("meshes", "a fan of triangles", expected="triangles, or strips of them")
    attributes = {name: piece["attributes"][name] for name in ("POSITION", "COLOR_0") if name in piece["attributes"]}
    extensions = {name: value for name, value in piece.get("extensions", {}).items() if name == DRACO}
    return {key: piece[key] for key in ("mode", "indices") if key in piece} | {
        "attributes": attributes, "extensions": extensions,
    }  # fmt: skip


def _size(record: dict, name: str) -> int:
    if type(record[name]) is not int or record[name] < 0:  # one below 0 would make room for others in a sum
        raise ValueError(f"{name} is {record[name]!r}"[:80])
    return record[name]


def _used(piece: dict) -> list[int]:
    """The accessors that a primitive needs."""
    attributes = piece["attributes"]
    return [n for n in (attributes["POSITION"], attributes.get("COLOR_0"), piece.get("indices")) if n is not None]


def _accessors(accessors: list[dict], pieces: list[dict], source: _Source) -> list[dict]:
    """The accessors that the pieces need; in the place of others stands an empty one."""
    packed = {n for piece in pieces if DRACO in piece.get("extensions", ()) for n in _used(piece)}
    used = {n for piece in pieces for n in _used(piece)}
    for k in used:  # of sparse numbers trimesh gives the others alone
        if "sparse" in accessors[k] or (k not in packed and "bufferView" not in accessors[k]):
            raise source.malformed(f"accessors[{k}]", "sparse numbers are not read here", expected="a bufferView")
    nothing = {"componentType": 5121, "type": "SCALAR", "count": 0}
    return [accessor if k in used else nothing for k, accessor in enumerate(accessors)]


def _buffer(uri: str | None, binary: bytes | None, source: _Source) -> bytes:
    if uri is None:
        if binary is None:
            raise source.malformed("buffers", "no bytes", expected="a uri, or the binary part of a .glb")
        return binary
    return base64.b64decode(uri.partition(",")[2]) if uri.startswith("data:") else source.beside(uri)


def _color(piece: dict, document: dict) -> np.ndarray:
    """The plain colour of a primitive, linear RGB; NaN where it has none or a picture has it."""
    material = document["materials"][piece["material"]] if "material" in piece else {}
    surface = material.get("pbrMetallicRoughness", {})
    is_plain = "baseColorFactor" in surface and "baseColorTexture" not in surface
    return np.array(surface["baseColorFactor"] if is_plain else [np.nan] * 4, np.float64).reshape(4)[:3]


def _placed(shape: Any, world: np.ndarray, color: np.ndarray) -> Mesh:
    """A mesh of trimesh's where its node stands."""
    corners = (shape.vertices[shape.faces] @ world[:3, :3].T + world[:3, 3]) @ Z_UP.T
    colors = np.tile(color, (len(corners), 1))
    if shape.visual.kind == "vertex":
        painted = np.asarray(shape.visual.vertex_colors)[shape.faces][..., :3].mean(axis=1) / 255
        colors = np.where(np.isnan(colors), 1.0, colors) * painted
    mirrored = np.linalg.det(world[:3, :3]) < 0
    return Mesh(corners[:, ::-1] if mirrored else corners, np.clip(colors, 0.0, 1.0))


# --- OBJ --------------------------------------------------------------------------------------------------------------


def _read_obj(data: bytes, source: _Source) -> Iterator[tuple[str, Mesh]]:
    """Yield the objects (`o`) and groups (`g`) of an OBJ."""
    path = source.path
    vertices: list[list[float]] = []
    colors: dict[str, list[float]] = {}
    faces: dict[str, list[tuple[list[int], list[float]]]] = {}
    name, paint, nothing, num_triangles = "mesh", [np.nan] * 3, [np.nan] * 3, 0
    for number, line in enumerate(decoded(data, path).splitlines(), 1):
        word, _, rest = line.partition("#")[0].strip().partition(" ")
        if word == "v":
            vertices.append(_numbers_of(rest, f"{path}:{number}"))
        elif word == "f":
            corners = [_vertex(text, len(vertices), f"{path}:{number}") for text in rest.split()]
            if len(corners) < 3:
                raise InputError("a face of less than three corners", where=f"{path}:{number}", got=rest[:60])
            num_triangles += len(corners) - 2
            source.check_count(num_triangles)
            faces.setdefault(name, []).append((corners, paint))
        elif word in ("o", "g"):
            name = rest.strip() or name
        elif word == "mtllib":
            colors |= _materials(decoded(source.beside(rest.strip()), path), path)
        elif word == "usemtl":
            paint = colors.get(rest.strip(), nothing)
    places = np.array(vertices).reshape(-1, 3)
    for node, found in faces.items():
        fans = [(corners[0], *pair) for corners, _ in found for pair in pairwise(corners[1:])]
        painted = [color for corners, color in found for _ in corners[2:]]
        yield node, Mesh(places[np.array(fans)], np.array(painted))


def _materials(text: str, path: Path) -> dict[str, list[float]]:
    """Diffuse colours (`Kd`) of the materials of an MTL; one with a picture has none."""
    colors: dict[str, list[float]] = {}
    name, pictured = "", set()
    for line in text.splitlines():
        word, _, rest = line.partition("#")[0].strip().partition(" ")
        if word == "newmtl":
            name = rest.strip()
        elif word == "Kd":
            colors[name] = [
                min(max(v, 0.0), 1.0) ** DISPLAY_GAMMA for v in _numbers_of(rest, f"{path}: material {name}")
            ]
        elif word == "map_Kd":
            pictured.add(name)
    return {name: color for name, color in colors.items() if name not in pictured}


def _numbers_of(text: str, where: str) -> list[float]:
    """The first three numbers of a line."""
    try:
        numbers = [float(word) for word in text.split()[:3]]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(number) <= LARGEST_M for number in numbers):  # NaN is not
        raise InputError("not three finite numbers", where=where, got=text[:60])
    return numbers


def _vertex(text: str, count: int, where: str) -> int:
    """The index, from 0, of a corner as `7`, `7/1/3` or, counted from the end, `-1`."""
    word = text.partition("/")[0]
    number = int(word) if word.removeprefix("-").isdecimal() and word.isascii() and len(word) < 12 else 0
    index = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= index < count:
        raise InputError("no such vertex", where=where, got=text[:40], expected=f"1 to {count}")
    return index
