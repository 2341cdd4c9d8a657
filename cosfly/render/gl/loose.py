"""Triangles that are no instances of a mesh, on the device: of surfaces on ground that slopes, and of solids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cosfly.render.gl.parts import LOOSE_VERTEX
from cosfly.render.gl.view import CameraView


@dataclass(frozen=True)
class Loose:
    """Triangles by material. vertices: (3 k,) LOOSE_VERTEX, three to a triangle, relative to the scene's origin.

    things: (k,) ascending, which thing each triangle belongs to; centers (n, 3) float64, radii (n,) of these. Without
    things all is always drawn.
    """

    vertices: dict[int, np.ndarray]
    things: dict[int, np.ndarray]
    centers: np.ndarray
    radii: np.ndarray

    @staticmethod
    def all_of(vertices: dict[int, np.ndarray]) -> Loose:
        return Loose(vertices, {}, np.zeros((0, 3)), np.zeros(0))


class LooseTriangles:
    """Loose triangles in buffers of one GL context; every vertex brings its part along."""

    def __init__(self, context: Any, loose: Loose) -> None:
        self._context, self._loose = context, loose
        self._buffers = {material: context.buffer(reserve=rows.nbytes) for material, rows in loose.vertices.items()}
        self._indices = {m: context.buffer(reserve=4 * len(rows), dynamic=True) for m, rows in loose.vertices.items()}
        numbers = np.arange(len(loose.centers) + 1)
        self._firsts = {material: 3 * np.searchsorted(rows, numbers) for material, rows in loose.things.items()}
        self._num_indices = dict.fromkeys(loose.vertices, 0)
        self._arrays: dict[tuple[int, int], Any] = {}
        self.centers, self.radii = loose.centers.astype(np.float32), loose.radii.astype(np.float32)
        self.see(None)

    def place(self, shift_m: np.ndarray) -> None:
        """Count from another origin, (3,) relative to the scene's: single precision is best near its zero."""
        for material, buffer in self._buffers.items():
            vertices = self._loose.vertices[material].copy()
            vertices["center"] -= shift_m.astype(np.float32)
            buffer.write(vertices.tobytes())
        self.centers = (self._loose.centers - shift_m).astype(np.float32)

    def see(self, view: CameraView | None) -> None:
        """Draw from now on what a camera may see, the nearest first; None: everything."""
        for material, firsts in self._firsts.items():
            seen = np.arange(len(self.centers)) if view is None else view.shown(self.centers, self.radii)
            counts = (firsts[1:] - firsts[:-1])[seen]
            before = np.cumsum(counts) - counts
            self._write(material, np.repeat(firsts[:-1][seen] - before, counts) + np.arange(counts.sum()))
        if view is None:
            for material in self._loose.vertices.keys() - self._firsts.keys():
                self._write(material, np.arange(len(self._loose.vertices[material])))

    def _write(self, material: int, indices: np.ndarray) -> None:
        self._indices[material].orphan()
        self._indices[material].write(indices.astype(np.uint32).tobytes())
        self._num_indices[material] = len(indices)

    def draw(self, program: Any, material: int) -> None:
        """Draw what is of a material and seen."""
        if not self._num_indices.get(material):
            return
        key = program.glo, material
        if key not in self._arrays:
            names = tuple(f"in_{name}" for name in LOOSE_VERTEX.names or ())
            content = attributes(program, self._buffers[material], "3f 3f 3f 3f 4f 4f 1u 1f", names)
            self._arrays[key] = self._context.vertex_array(program, [content], index_buffer=self._indices[material])
        self._arrays[key].render(vertices=self._num_indices[material])

    def draw_all(self, program: Any) -> None:
        """Draw every material with one program."""
        for material in self._buffers:
            self.draw(program, material)


def attributes(program: Any, buffer: Any, layout: str, names: tuple[str, ...]) -> tuple:
    """Buffer layout for a program: attributes that its compiler left out become padding."""
    kinds = layout.split()
    suffix = kinds.pop() if kinds[-1].startswith("/") else ""
    used = [name in program for name in names]
    padded = [kind if use else f"{4 * int(kind[:-1])}x" for kind, use in zip(kinds, used, strict=True)]
    return (buffer, " ".join(padded) + suffix, *(name for name, use in zip(names, used, strict=True) if use))
