"""Meshes of glTF 2.0 (.glb, .gltf) and Wavefront OBJ (.obj): triangles and their plain colours, a node each. No textures.

Read here and not by a library: what such a file names or counts is checked before anything is opened or made of it. glTF's +y is up and becomes
+z; OBJ has no rule, and is taken as it stands, z up. Source: Khronos glTF 2.0; the OBJ appendix of Wavefront's manual.
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from cosfly.errors import InputError
from cosfly.reading.documents import parse_document
from cosfly.reading.files import decoded, read_bytes
from cosfly.reading.limits import limits, over_limit

WHAT = "mesh"
SUFFIXES = (".glb", ".gltf", ".obj")
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # from glTF's axes
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes; points and lines have no surface
DISPLAY_GAMMA = 2.2  # an OBJ's colours are those of a screen
LARGEST_M = 1e7


@dataclass(frozen=True)
class Mesh:
    """Triangles, k of them: corners_m (k, 3, 3) float64, z up, counter-clockwise from outside; colors (k, 3) linear RGB, NaN where the file tells none."""

    corners_m: np.ndarray
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.corners_m)


def joined(meshes: list[Mesh]) -> Mesh:
    """All of some meshes, at least one, as one."""
    return Mesh(np.concatenate([m.corners_m for m in meshes]), np.concatenate([m.colors for m in meshes]))


def read_meshes(path: Path, *, tree: Path) -> dict[str, Mesh]:
    """Read a file of meshes, node by node; what it names beside it is read too.

    Args:
        tree: the folder that neither the file nor what it names may lie outside of.
    Raises:
        InputError: missing, outside, too large, of another format, or malformed; names the field.
    """
    data = read_bytes(path, what=WHAT, tree=tree, limit="mesh_mb")
    readers = {".glb": _read_glb, ".gltf": _read_gltf, ".obj": _read_obj}
    if path.suffix.lower() not in readers:
        raise InputError("not a mesh that is known", where=path, got=path.suffix, expected=", ".join(SUFFIXES))
    found: dict[str, Mesh] = {}
    num_triangles = 0
    for name, mesh in readers[path.suffix.lower()](data, path, tree):
        num_triangles += len(mesh)
        _check_count(num_triangles, path)
        if not (np.abs(mesh.corners_m) <= LARGEST_M).all():  # NaN is not
            raise InputError(
                "a vertex is not finite or too far off", where=f"{path}: {name}", expected=f"within {LARGEST_M:g} m"
            )
        found[name] = joined([found[name], mesh]) if name in found else mesh
    if not num_triangles:
        raise InputError("the mesh has no triangles", where=path)
    return found


def _check_count(num_triangles: int, where: object) -> None:
    if num_triangles > limits().mesh_triangles:
        raise over_limit("mesh_triangles", where, f"{num_triangles:,} triangles or more")


def _beside(name: str, path: Path, tree: Path) -> bytes:
    """Read what a file names beside it."""
    inner = PurePosixPath(unquote(name))
    if inner.is_absolute() or ".." in inner.parts or "\\" in name or ":" in name or "\0" in name or not inner.parts:
        raise InputError(
            "the mesh names a file outside of its folder", where=path, got=name[:80], expected="a name below it"
        )
    return read_bytes(path.parent / inner, what=f"file that {path.name} names", tree=tree, limit="mesh_mb")


# --- glTF -------------------------------------------------------------------------------------------------------------


def _read_glb(data: bytes, path: Path, tree: Path) -> Iterator[tuple[str, Mesh]]:
    if len(data) < 20 or struct.unpack_from("<II", data) != (GLB_MAGIC, 2):
        raise InputError("not a binary glTF 2.0", where=path, got=f"{len(data)} bytes", expected="a .glb of version 2")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > len(data):
            raise InputError("the mesh is cut short", where=path, got=f"{len(data)} bytes", expected=f"{at + 8 + size}")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return _Gltf(
        parse_document(chunks.get(JSON_CHUNK, b""), path, what=WHAT), chunks.get(BINARY_CHUNK), path, tree
    ).nodes()


def _read_gltf(data: bytes, path: Path, tree: Path) -> Iterator[tuple[str, Mesh]]:
    return _Gltf(parse_document(data, path, what=WHAT), None, path, tree).nodes()


class _Gltf:
    """One glTF document and the bytes that it counts in."""

    def __init__(self, document: Any, binary: bytes | None, path: Path, tree: Path) -> None:
        self._document, self._binary, self._path, self._tree = document, binary, path, tree
        self._buffers: dict[int, bytes] = {}
        if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
            raise self._wrong("asset", "not a glTF document")
        if needed := document.get("extensionsRequired"):
            raise self._wrong("extensionsRequired", "needs what is not read here", str(needed)[:80], "plain glTF 2.0")

    def _wrong(
        self, field: str, what: str = "malformed", got: str | None = None, expected: str | None = None
    ) -> InputError:
        return InputError(
            f"the mesh cannot be read: {what}", where=f"{self._path}: {field}", got=got, expected=expected
        )

    def _item(self, name: str, number: Any) -> dict:
        """Member `number` of a list of objects of the document."""
        items = self._document.get(name)
        if not isinstance(items, list) or type(number) is not int or not 0 <= number < len(items):
            count = len(items) if isinstance(items, list) else 0
            raise self._wrong(name, "no such member", repr(number)[:40], f"0 to {count - 1}")
        if not isinstance(items[number], dict):
            raise self._wrong(f"{name}[{number}]", got=type(items[number]).__name__, expected="an object")
        return items[number]

    def _number(self, value: dict, name: str, where: str, default: int | None = None) -> int:
        number = value.get(name, default)
        if type(number) is not int or number < 0:
            raise self._wrong(f"{where}.{name}", got=repr(number)[:40], expected="a whole number from 0")
        return number

    # --- the tree of nodes ---

    def nodes(self) -> Iterator[tuple[str, Mesh]]:
        """Every mesh where its node stands, with the node's name."""
        roots = self._roots()
        todo = [(number, np.eye(4)) for number in reversed(roots)]
        seen: set[int] = set()
        num_triangles = 0
        while todo:
            number, world = todo.pop()
            node = self._item("nodes", number)
            if number in seen:
                raise self._wrong(f"nodes[{number}]", "a node with two parents")
            seen.add(number)
            world = world @ self._placement(node, f"nodes[{number}]")
            if "mesh" in node:
                name = node.get("name", f"node_{number}")
                for mesh in self._mesh(node["mesh"]):
                    num_triangles += len(mesh)
                    _check_count(num_triangles, self._path)
                    corners = (mesh.corners_m @ world[:3, :3].T + world[:3, 3]) @ Z_UP.T
                    mirrored = np.linalg.det(world[:3, :3]) < 0
                    yield str(name), Mesh(corners[:, ::-1] if mirrored else corners, mesh.colors)
            todo += [(child, world) for child in reversed(self._numbers(node, "children", f"nodes[{number}]"))]

    def _roots(self) -> list[int]:
        if "scenes" in self._document:
            scene = self._item("scenes", self._document.get("scene", 0))
            return self._numbers(scene, "nodes", "scenes")
        every = self._document.get("nodes")
        count = len(every) if isinstance(every, list) else 0
        children = {c for n in range(count) for c in self._numbers(self._item("nodes", n), "children", f"nodes[{n}]")}
        return [number for number in range(count) if number not in children]

    def _numbers(self, value: dict, name: str, where: str) -> list[int]:
        numbers = value.get(name, [])
        if not isinstance(numbers, list) or not all(type(n) is int for n in numbers):
            raise self._wrong(f"{where}.{name}", got=repr(numbers)[:40], expected="whole numbers")
        return numbers

    def _placement(self, node: dict, where: str) -> np.ndarray:
        """A node's matrix, (4, 4)."""
        if "matrix" in node:
            return self._vector(node["matrix"], 16, f"{where}.matrix").reshape(4, 4).T  # by columns
        matrix = np.eye(4)
        x, y, z, w = self._vector(node.get("rotation", [0, 0, 0, 1]), 4, f"{where}.rotation")
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= self._vector(node.get("scale", [1, 1, 1]), 3, f"{where}.scale")
        matrix[:3, 3] = self._vector(node.get("translation", [0, 0, 0]), 3, f"{where}.translation")
        return matrix

    def _vector(self, values: Any, count: int, where: str) -> np.ndarray:
        numbers = isinstance(values, list) and len(values) == count and all(type(v) in (int, float) for v in values)
        vector = np.array(values, dtype=np.float64) if numbers else np.full(count, np.nan)
        if not (np.abs(vector) <= LARGEST_M).all():
            raise self._wrong(where, got=repr(values)[:60], expected=f"{count} finite numbers")
        return vector

    # --- triangles ---

    def _mesh(self, number: Any) -> Iterator[Mesh]:
        primitives = self._item("meshes", number).get("primitives")
        if not isinstance(primitives, list):
            raise self._wrong(f"meshes[{number}].primitives", got=type(primitives).__name__, expected="a list")
        for k, primitive in enumerate(primitives):
            where = f"meshes[{number}].primitives[{k}]"
            attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
            if not isinstance(attributes, dict) or "POSITION" not in attributes:
                raise self._wrong(f"{where}.attributes", "no places of vertices", expected="POSITION")
            mode = primitive.get("mode", TRIANGLES)
            if mode not in (TRIANGLES, STRIP, FAN):
                continue
            places = self._accessor(attributes["POSITION"], 3)
            rows = np.arange(len(places))
            if "indices" in primitive:
                rows = self._accessor(primitive["indices"], 1)[:, 0].astype(np.int64)
                if rows.max(initial=-1) >= len(places):
                    raise self._wrong(f"{where}.indices", "no such vertex", str(rows.max()), f"0 to {len(places) - 1}")
            triangles = _triangles_of(rows, mode)
            colors = np.tile(self._color(primitive.get("material"), where), (len(triangles), 1))
            if "COLOR_0" in attributes:
                painted = self._accessor(attributes["COLOR_0"], None, normalized=True)[:, :3]
                if len(painted) != len(places) or painted.shape[1] != 3:
                    raise self._wrong(f"{where}.attributes.COLOR_0", got=str(painted.shape), expected="one a vertex")
                colors = np.where(np.isnan(colors), 1.0, colors) * painted[triangles].mean(axis=1)
            yield Mesh(places[triangles], np.clip(colors, 0.0, 1.0))

    def _color(self, number: Any, where: str) -> np.ndarray:
        """The plain colour of a material, NaN where there is none or a picture has it."""
        if number is None:
            return np.full(3, np.nan)
        value = self._item("materials", number).get("pbrMetallicRoughness", {})
        if not isinstance(value, dict) or "baseColorTexture" in value or "baseColorFactor" not in value:
            return np.full(3, np.nan)
        return self._vector(value["baseColorFactor"], 4, f"{where}.material")[:3]

    def _accessor(self, number: Any, width: int | None, *, normalized: bool = False) -> np.ndarray:
        """Numbers of an accessor, (n, width) float64 or whole."""
        value, where = self._item("accessors", number), f"accessors[{number}]"
        form, columns = COMPONENTS.get(value.get("componentType", 0)), WIDTHS.get(str(value.get("type")))
        if form is None or columns is None or (width is not None and columns != width):
            got = f"{value.get('componentType')}, {value.get('type')}"
            raise self._wrong(where, "another kind of numbers", got[:60])
        if "sparse" in value or "bufferView" not in value:
            raise self._wrong(where, "sparse numbers are not read here", expected="a bufferView")
        view, dtype = self._item("bufferViews", value["bufferView"]), np.dtype(form)
        data = self._buffer(view.get("buffer"))
        first = self._number(view, "byteOffset", "bufferViews", 0)
        span = data[first : first + self._number(view, "byteLength", "bufferViews")]
        offset, count = self._number(value, "byteOffset", where, 0), self._number(value, "count", where)
        stride = self._number(view, "byteStride", "bufferViews", 0) or columns * dtype.itemsize
        if count and offset + (count - 1) * stride + columns * dtype.itemsize > len(span):
            raise self._wrong(where, "more numbers than bytes", f"{count} of {stride} bytes", f"{len(span)} bytes")
        if not count:
            return np.zeros((0, columns))
        numbers = np.ndarray((count, columns), dtype, span, offset, (stride, dtype.itemsize)).astype(np.float64)
        return numbers / np.iinfo(dtype).max if normalized and dtype.kind != "f" else numbers

    def _buffer(self, number: Any) -> bytes:
        buffer = self._item("buffers", number)
        if number not in self._buffers:
            uri = buffer.get("uri")
            if uri is None:
                if self._binary is None:
                    raise self._wrong(f"buffers[{number}]", "no bytes", expected="a uri, or the binary part of a .glb")
                self._buffers[number] = self._binary
            elif not isinstance(uri, str):
                raise self._wrong(f"buffers[{number}].uri", got=type(uri).__name__, expected="a text")
            elif uri.startswith("data:"):
                try:
                    self._buffers[number] = base64.b64decode(uri.partition(",")[2], validate=True)
                except (binascii.Error, ValueError):
                    raise self._wrong(f"buffers[{number}].uri", "not base64") from None
            else:
                self._buffers[number] = _beside(uri, self._path, self._tree)
        return self._buffers[number]


def _triangles_of(rows: np.ndarray, mode: int) -> np.ndarray:
    """Vertex indices of triangles, (k, 3), of a list, strip or fan of vertices."""
    if mode == TRIANGLES:
        return rows[: len(rows) // 3 * 3].reshape(-1, 3)
    count = max(len(rows) - 2, 0)
    k = np.arange(count)
    if mode == FAN:
        return np.stack(
            [np.zeros(count, int) if count == 0 else np.full(count, rows[0]), rows[k + 1], rows[k + 2]], axis=1
        )
    odd = k % 2
    return np.stack([rows[k], rows[k + 1 + odd], rows[k + 2 - odd]], axis=1)


# --- OBJ --------------------------------------------------------------------------------------------------------------


def _read_obj(data: bytes, path: Path, tree: Path) -> Iterator[tuple[str, Mesh]]:
    """Yield the objects (`o`) and groups (`g`) of an OBJ."""
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
            _check_count(num_triangles, path)
            faces.setdefault(name, []).append((corners, paint))
        elif word in ("o", "g"):
            name = rest.strip() or name
        elif word == "mtllib":
            colors |= _materials(decoded(_beside(rest.strip(), path, tree), path), path)
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
