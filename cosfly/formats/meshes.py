"""`meshes.glb` beside a map, and which of its boxes are drawn as meshes; planners and visibility know boxes alone."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from cosfly.runtime.errors import InputError
from cosfly.runtime.meshes import (
    BINARY_CHUNK,
    GLB_MAGIC,
    JSON_CHUNK,
    MOST_TRIANGLES,
    SUFFIXES,
    TRIANGLES,
    Z_UP,
    Mesh,
    joined,
    read_meshes,
    too_many,
)
from cosfly.runtime.store import write_bytes

MESHES_FILE = "meshes.glb"
FLOAT, ARRAY_BUFFER = 5126, 34962
UNTOLD = -1.0  # in the place of a colour that no file told, while they are sorted


class MeshRef(BaseModel):
    """What a box is drawn as.

    fit `box`: what the mesh spans is stretched to the box, axis by axis. fit `world`: its vertices are places of the
    map, in metres; boxes that name the same one stand for one thing, which is drawn once, with the id of the first of
    them.
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
            raise ValueError("not a name of a file below the map's folder")
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"not a mesh that is known, expected {', '.join(SUFFIXES)}")
        return name


@dataclass(frozen=True)
class Meshes:
    """The meshes of a map. refs: box id -> what it is drawn as; folder: that their files are below; made: node -> mesh
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
        """Read what the boxes name."""
        files = self.files().items()
        read = {name: read_meshes(path, tree=path.parents[len(Path(name).parts) - 1]) for name, path in files}
        found: dict[MeshRef, Mesh] = {}
        for box_id, ref in self.refs.items():
            nodes = read.get(ref.file, self.made)
            if ref.node is not None and ref.node not in nodes:
                where, expected = f"{ref.file}, which box {box_id} names", ", ".join(list(nodes)[:8])
                raise InputError("the mesh has no such node", where=where, got=ref.node[:80], expected=expected)
            if ref not in found:
                found[ref] = joined(list(nodes.values())) if ref.node is None else nodes[ref.node]
        num_drawn = sum(len(found[ref]) for ref in self.refs.values() if ref.fit == "box")
        num_drawn += sum(len(mesh) for ref, mesh in found.items() if ref.fit == "world")
        if num_drawn > MOST_TRIANGLES:
            raise too_many(self.folder or "map", num_drawn)
        return found

    def beside(self, folder: Path) -> Meshes:
        """Return the same, all in MESHES_FILE of a folder, which is written unless these stand there already."""
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
    """Write meshes as binary glTF 2.0, a node each: vertices in single precision about the node's place."""
    nodes, shapes, views, accessors, materials = (list[dict]() for _ in range(5))
    parts, colors_known = list[bytes](), dict[tuple[float, ...], int]()
    at = 0
    for name, mesh in meshes.items():
        corners = mesh.corners_m.reshape(-1, 3) @ Z_UP  # the transpose leads back to +y up
        middle = np.round((corners.min(axis=0) + corners.max(axis=0)) / 2)
        primitives = []
        colors = np.round(np.where(np.isnan(mesh.colors), UNTOLD, mesh.colors), 4)
        for color in np.unique(colors, axis=0):
            chosen = np.repeat((colors == color).all(axis=1), 3)
            near = (corners[chosen] - middle).astype("<f4")
            primitive: dict = {"attributes": {"POSITION": len(accessors)}, "mode": TRIANGLES}
            if (color != UNTOLD).all():
                rgb = tuple(color.tolist())
                if rgb not in colors_known:
                    colors_known[rgb] = len(materials)
                    materials.append({"pbrMetallicRoughness": {"baseColorFactor": [*rgb, 1.0]}, "doubleSided": True})
                primitive["material"] = colors_known[rgb]
            primitives.append(primitive)
            accessors.append(
                {"bufferView": len(views), "componentType": FLOAT, "type": "VEC3", "count": len(near),
                 "min": near.min(axis=0).tolist(), "max": near.max(axis=0).tolist()}
            )  # fmt: skip
            views.append({"buffer": 0, "byteOffset": at, "byteLength": near.nbytes, "target": ARRAY_BUFFER})
            parts.append(near.tobytes())
            at += near.nbytes
        nodes.append({"name": name, "mesh": len(shapes), "translation": middle.tolist()})
        shapes.append({"primitives": primitives})
    document = {
        "asset": {"version": "2.0", "generator": "cosfly"}, "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes, "meshes": shapes, "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": at}],
        **({"materials": materials} if materials else {}),
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", at, BINARY_CHUNK) + b"".join(parts)
    write_bytes(path, struct.pack("<III", GLB_MAGIC, 2, 12 + len(chunks)) + chunks)
