"""`cosfly depth-study`: what ways to store depth cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli import options

app = typer.Typer()


@app.command("depth-study")
def depth_study(
    out: Annotated[Path, typer.Option(help="Folder for depth_study.json, depth_study.md and depth_study.png.")],
    data: options.Data = None,
    frame: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a frame, from the tree on or as a path, or a .npy of depth in metres, float32 or float64. [default: a frame of the tree that shows the target whole]"
        ),
    ] = None,
) -> None:
    """The ways to store depth on one frame: errors, entropy, edges and size, with a figure."""
    from cosfly.depth_study import study
    from cosfly.look.gallery import best_frame, frame_in

    if frame is None:
        frame = best_frame(options.data_folder(data), "depth.npy")
    elif data and not frame.exists():
        frame = frame_in(options.data_folder(data), frame)
    study.run(frame, out)
    typer.echo(out / "depth_study.md")
