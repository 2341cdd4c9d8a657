"""`cosfly depth-study`: what ways to store depth cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command("depth-study")
def depth_study(
    frame: Annotated[
        Path, typer.Option(help="Folder of a frame in a playback tree, or a .npy of depth, float32 or float64.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for depth_study.json, depth_study.md and depth_study.png.")],
) -> None:
    """The ways to store depth on one frame: errors, entropy, edges and size, with a figure."""
    from cosfly.depth_study import study

    study.run(frame, out)
    typer.echo(out / "depth_study.md")
