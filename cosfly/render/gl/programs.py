"""Programs of the default renderer: one set for each kind of weather, and how their uniforms are set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.render.contract import DEBIAN_PACKAGES
from cosfly.render.gl.parts import NUM_MATERIALS
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.io import read_text

# Files of shaders that follow light.glsl.
FAIR, WEATHER_SKY, WEATHER_SCENE = ("look.glsl",), ("weather.glsl",), ("weather.glsl", "weather_scene.glsl")


def open_context() -> Any:
    """Open a GL context without a window."""
    try:
        import moderngl

        settings: Any = {"backend": "egl"}  # moderngl's own annotation of this argument is wrong

        return moderngl.create_context(require=330, standalone=True, **settings)
    except ImportError as error:
        raise EnvironmentMissing("the package moderngl is missing", got=str(error), fix="pip install cosfly") from None
    except Exception as error:  # glcontext raises a bare Exception, and OSError where the library is missing
        raise EnvironmentMissing(
            "no OpenGL without a window (EGL)",
            got=str(error),
            fix=f"apt-get install {DEBIAN_PACKAGES} (these serve the CPU too)",
        ) from None


def sources(vertex: tuple[str, ...], fragment: tuple[str, ...], define: str = "") -> tuple[str, str]:
    """Return the texts of a program of these files."""
    folder, head = Path(__file__).parent, "#version 330 core\n" + define
    texts = ["\n".join(read_text(folder / name) for name in names) for names in (vertex, fragment)]
    return head + texts[0], head + texts[1]


@dataclass(frozen=True)
class Programs:
    """What fair weather, or one with such defines, is drawn with; materials and near_movers: one for each material, the
    latter with the shadows of those who move; rain: None in fair weather.
    """

    materials: list[Any]
    near_movers: list[Any]
    sky: Any
    rain: Any


def programs_of(context: Any, define: str | None, *, snaps: bool) -> Programs:
    """Compile programs of fair weather (None), or of one with such defines. snaps: for hardware (scene.frag.glsl)."""
    of_sky = ("light.glsl", *(FAIR if define is None else WEATHER_SKY), "sky.frag.glsl")
    of_surfaces = ("light.glsl", *(FAIR if define is None else WEATHER_SCENE), "scene.frag.glsl")
    vertex, fragment = sources(
        ("part.glsl", "scene.vert.glsl"), of_surfaces, "#define SNAPS\n" * snaps + (define or "")
    )
    materials, near_movers = (
        [
            context.program(vertex, fragment.replace(" MATERIAL;", f" {material};").replace("NEAR_MOVERS;", f"{near};"))
            for material in range(NUM_MATERIALS)
        ]
        for near in ("false", "true")
    )
    sky = context.program(*sources(("screen.vert.glsl",), of_sky, define or ""))
    is_fair = define is None
    rain = None if is_fair else context.program(*sources(("screen.vert.glsl",), ("light.glsl", "rain.frag.glsl")))
    return Programs(materials, near_movers, sky, rain)


def packed(value: Any) -> Any:
    """Return the bytes of an array as a uniform has them, column by column; other values as they are."""
    return np.ascontiguousarray(value.T, dtype=np.float32).tobytes() if isinstance(value, np.ndarray) else value


def set_uniform(program: Any, name: str, value: Any) -> None:
    """Set a uniform that the program uses, to a number, an array or its bytes."""
    uniform = program.get(name, None)  # `in` would look through all of them
    if uniform is None:
        return  # the compiler leaves out what a material does not need
    value = packed(value)
    if isinstance(value, bytes):
        uniform.write(value)
    else:
        uniform.value = value
