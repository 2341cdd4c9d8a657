"""Programs and buffers of the default renderer: one set for each kind of weather, uniforms, loose triangles."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.render.contract import DEBIAN_PACKAGES
from cosfly.render.gl.parts import LOOSE_VERTEX, NUM_MATERIALS, CameraView, LooseTriangles
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.io import read_text

# Shader files after light.glsl.
FAIR = ("look.glsl",)
WEATHER_SKY = ("weather.glsl",)
WEATHER_SCENE = ("weather.glsl", "weather_scene.glsl")


def open_context() -> Any:
    """Open a GL context without a window."""
    try:
        import moderngl

        settings: Any = {"backend": "egl"}  # moderngl's own annotation of this argument is wrong
        return moderngl.create_context(require=330, standalone=True, **settings)
    except ImportError as error:
        raise EnvironmentMissing(
            "the package moderngl is not installed", got=str(error), fix="pip install moderngl"
        ) from None
    except Exception as error:  # glcontext raises a bare Exception, and OSError where the library is missing
        fix = f"apt-get install {DEBIAN_PACKAGES} (needed also to render on the CPU)"
        raise EnvironmentMissing("OpenGL cannot draw without a window (EGL)", got=str(error), fix=fix) from None


def sources(vertex: tuple[str, ...], fragment: tuple[str, ...], define: str = "") -> tuple[str, str]:
    """Return the texts of the vertex and the fragment shader that consist of these files."""

    def text_of(names: tuple[str, ...]) -> str:
        return "#version 330 core\n" + define + "\n".join(read_text(Path(__file__).parent / name) for name in names)

    return text_of(vertex), text_of(fragment)


@dataclass(frozen=True)
class Programs:
    """The programs of one kind of weather."""

    materials: list[Any]  # one for each material
    sky: Any
    shadow: Any  # of one person
    rain: Any  # None in fair weather


def programs_of(context: Any, define: str | None, *, snaps: bool) -> Programs:
    """Compile the programs of fair weather (None), or of a weather with these defines.

    Args:
        snaps: Whether the device snaps triangles to a grid, as GPUs do (scene.frag.glsl).
    """
    light = ("light.glsl", *(FAIR if define is None else WEATHER_SKY))
    scene_light = ("light.glsl", *(FAIR if define is None else WEATHER_SCENE))
    defines = ("#define SNAPS\n" if snaps else "") + (define or "")
    vertex, fragment = sources(("part.glsl", "scene.vert.glsl"), (*scene_light, "scene.frag.glsl"), defines)
    materials = [context.program(vertex, fragment.replace(" MATERIAL;", f" {m};")) for m in range(NUM_MATERIALS)]

    def of_screen(*fragment: str) -> Any:
        return context.program(*sources(("screen.vert.glsl",), fragment, define or ""))

    return Programs(
        materials=materials,
        sky=of_screen(*light, "sky.frag.glsl"),
        shadow=of_screen(*scene_light, "shadow.frag.glsl"),
        rain=None if define is None else of_screen("light.glsl", "rain.frag.glsl"),
    )


def packed(value: Any) -> Any:
    """Return the bytes of an array as a uniform, column by column; other values unchanged."""
    return np.ascontiguousarray(value.T, dtype=np.float32).tobytes() if isinstance(value, np.ndarray) else value


def set_uniform(program: Any, name: str, value: Any) -> None:
    """Set a uniform, if the program uses it, to a number, an array or its bytes."""
    uniform = program.get(name, None)  # `in` would search all of them
    if uniform is None:
        return  # the compiler leaves out what a material does not need
    value = packed(value)
    if isinstance(value, bytes):
        uniform.write(value)
    else:
        uniform.value = value


class LooseBuffers:
    """Loose triangles in buffers of one GL context; every vertex holds its part."""

    def __init__(self, context: Any, loose: LooseTriangles) -> None:
        self._context = context
        self._loose = loose
        self._buffers: dict[int, Any] = {}  # the following are by material: vertices
        self._indices: dict[int, Any] = {}  # of the vertices to draw
        self._num_indices: dict[int, int] = {}
        numbers = np.arange(len(loose.centers) + 1)
        # By material, the first vertex of each object, and their number at the end.
        self._firsts = {material: 3 * np.searchsorted(objects, numbers) for material, objects in loose.objects.items()}
        self._arrays: dict[tuple[int, int], Any] = {}  # by program and material
        self.centers = loose.centers.astype(np.float32)
        self.radii = loose.radii.astype(np.float32)
        for material, vertices in loose.vertices.items():
            self._buffers[material] = context.buffer(reserve=vertices.nbytes)
            self._indices[material] = context.buffer(reserve=4 * len(vertices), dynamic=True)
            self._write(material, np.arange(len(vertices)))

    def place(self, shift_m: np.ndarray) -> None:
        """Move the origin, (3,) relative to the scene's: float32 is most precise near 0."""
        for material, buffer in self._buffers.items():
            vertices = self._loose.vertices[material].copy()
            vertices["center"] -= shift_m.astype(np.float32)
            buffer.write(vertices.tobytes())
        self.centers = (self._loose.centers - shift_m).astype(np.float32)

    def see(self, view: CameraView | None) -> None:
        """Select the objects that a camera may see, the nearest first; None selects everything."""
        seen = np.arange(len(self.centers)) if view is None else view.sphere_rows_in_view(self.centers, self.radii)
        for material, firsts in self._firsts.items():
            counts = np.diff(firsts)[seen]
            before = np.cumsum(counts) - counts  # vertices of the objects before each
            # For each object in turn the numbers first, first + 1 ... of its vertices.
            self._write(material, np.repeat(firsts[:-1][seen] - before, counts) + np.arange(counts.sum()))

    def _write(self, material: int, indices: np.ndarray) -> None:
        self._indices[material].orphan()
        self._indices[material].write(indices.astype(np.uint32).tobytes())
        self._num_indices[material] = len(indices)

    def draw(self, program: Any, material: int) -> None:
        """Draw the selected triangles of a material."""
        if not self._num_indices.get(material):
            return
        key = program.glo, material
        if key not in self._arrays:
            names = tuple(f"in_{name}" for name in LOOSE_VERTEX.names or ())
            content = attributes(program, self._buffers[material], "3f 3f 3f 3f 4f 4f 1u 1f", names)
            self._arrays[key] = self._context.vertex_array(program, [content], index_buffer=self._indices[material])
        self._arrays[key].render(vertices=self._num_indices[material])

    def draw_shadows(self, program: Any) -> None:
        """Draw the selected objects with one program."""
        for material in self._firsts:
            self.draw(program, material)


def attributes(program: Any, buffer: Any, layout: str, names: tuple[str, ...]) -> tuple:
    """Return the buffer layout for a program: attributes that its compiler removed become padding."""
    formats = layout.split()  # such as 3f, three floats
    suffix = formats.pop() if formats[-1].startswith("/") else ""
    used_names = [name for name in names if name in program]
    padded = [
        text if name in used_names else f"{4 * int(text[:-1])}x" for name, text in zip(names, formats, strict=True)
    ]
    return (buffer, " ".join(padded) + suffix, *used_names)
