"""The meshes of a map: which mesh is drawn instead of which box, and `meshes.glb` next to the map.

Planners and visibility use the boxes.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from cosfly.formats.mesh_files import (
    SUFFIXES,
    check_num_triangles,
    read_meshes,
    write_meshes,
    y_up_from_z_up,
    z_up_from_y_up,
)
from cosfly.runtime.errors import InputError

log = logging.getLogger(__name__)

MESHES_FILE = "meshes.glb"
START_M = 1e-3  # a mesh that stands on the ground of its axes begins this near to 0


class MeshRef(BaseModel):
    """The mesh that is drawn instead of a box."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    file: str = Field(min_length=1, max_length=1024)
    node: str | None = None  # None: all nodes of the file
    # box: the bounds of the mesh are stretched to the box, axis by axis. world: its vertices are positions in the map,
    # in metres; if several boxes name the same mesh, it is drawn once, with the id of the first box.
    fit: Literal["box", "world"] = "box"
    up: Literal["y", "z"] | None = None  # the axis that points up in the file; None: y in glTF, z in an OBJ

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
    """The meshes of a map."""

    refs: dict[int, MeshRef] = field(default_factory=dict)  # box id -> the mesh that is drawn
    folder: Path | None = None  # of the files
    made: dict[str, np.ndarray] = field(default_factory=dict)  # node -> mesh, of a MESHES_FILE that is not written yet

    def files(self) -> dict[str, Path]:
        """Return the files that boxes name, by name."""
        names = sorted({ref.file for ref in self.refs.values()})
        return {name: self.folder / name for name in names} if self.folder is not None else {}

    def resolved(self) -> dict[MeshRef, np.ndarray]:
        """Read the meshes that the boxes name, (k, 3, 3) m, z up."""
        folder = self.folder or Path()
        nodes_by_file = {name: read_meshes(path, tree=folder) for name, path in self.files().items()}
        meshes: dict[MeshRef, np.ndarray] = {}
        for box_id, ref in self.refs.items():
            nodes = nodes_by_file.get(ref.file, self.made)
            if ref.node is not None and ref.node not in nodes:
                what = "the mesh file has no node of this name"
                expected = f"the name of a node in this file, such as {', '.join(list(nodes)[:8])}"
                raise InputError(what, where=f"box {box_id}: {ref.file}", got=ref.node[:80], expected=expected)
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
            return z_up_from_y_up(mesh) if ref.up == "y" else y_up_from_z_up(mesh)
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
        meshes = self.resolved()
        node_names: dict[MeshRef, str] = {}
        for ref in meshes:
            name = ref.node if self.made and ref.node else f"{ref.file}#{ref.node or ''}"
            if name in node_names.values():  # another reference to the same node
                name += f" ({ref.fit}, {ref.up})" if ref.up else f" ({ref.fit})"
            node_names[ref] = name
        write_meshes(folder / MESHES_FILE, {node_names[ref]: mesh for ref, mesh in meshes.items()})
        # Without `up`: `resolved` has turned the meshes.
        moved = {ref: MeshRef(file=MESHES_FILE, node=name, fit=ref.fit) for ref, name in node_names.items()}
        return replace(self, refs={box_id: moved[ref] for box_id, ref in self.refs.items()}, folder=folder, made={})
