"""How much a file may ask of this machine before it is refused, and which links are followed: settings `reading.*`.

They decide what is refused and never what is made, so they are the process's and not a stage's; workers get those of
the process that started them (worker_pool.py).
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from cosfly.errors import InputError

MB = 1_000_000


class Limits(BaseModel):
    """What a file may ask for. The defaults let a city of 16 GB pass, 10,000-frame flights and pictures of 8K."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    follow_links: bool = Field(
        False,
        description="read through symbolic links that lead out of the playback tree, run or release they stand in",
    )
    file_mb: int = Field(2_048, ge=1, description="largest file that is read as a whole, MB")
    city_mb: int = Field(16_384, ge=1, description="largest city model, MB as it stands there and unpacked")
    unpack_factor: int = Field(
        100, ge=1, description="a packed file may unpack to so many times its own size; JSON packs to a tenth"
    )
    line_mb: int = Field(64, ge=1, description="longest line of a JSON-lines file, MB")
    picture_mpx: int = Field(50, ge=1, description="largest picture or depth image, million pixels; 8K has 33")
    mesh_mb: int = Field(512, ge=1, description="largest file of meshes, and of what it names beside it, MB")
    mesh_triangles: int = Field(
        2_000_000, ge=1, description="most triangles of a file of meshes, and of all that a map draws of them"
    )
    polygon_vertices: int = Field(100_000, ge=3, description="most vertices of one polygon, its holes included")
    polygon_crossings: int = Field(
        500,
        ge=0,
        description="how often the outline of one polygon may cross itself; mending 1,000 takes a second",
    )


_limits = Limits()


def limits() -> Limits:
    """Give the limits of this process."""
    return _limits


def use_limits(chosen: Limits) -> None:
    """Set the limits of this process."""
    global _limits
    _limits = chosen


def over_limit(name: str, where: object, got: str, unit: str = "") -> InputError:
    """Give the error of what is over one of the limits; it says how to raise it."""
    return InputError(
        f"over the limit reading.{name}",
        where=str(where),
        got=got,
        expected=f"at most {getattr(_limits, name):,}{unit}",
        fix=f"if you trust the file, raise it with --set reading.{name}=...",
    )
