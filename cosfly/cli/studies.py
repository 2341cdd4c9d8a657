"""The commands `cosfly study ...`: depth formats, weathers and levels of zoom, on the same frames and trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, takes

ABOUT = "Compare depth formats, weathers and levels of zoom on the same frames and trajectories."
app = typer.Typer(no_args_is_help=True, help=ABOUT)


@app.command("depth", epilog="cosfly study depth --data render --out depth")
@takes()
def study_depth(
    job: Job,
    out: Annotated[Path, Option(help="Folder for depth_study.json, depth_study.md and depth_study.png.")],
    data: options.Trees = None,
    frame: Annotated[Path | None, Option(help="Frame folder in the tree, or a .npy in metres.")] = None,
) -> None:
    """Compare ways to store the depth of one frame: errors, entropy, edges and size."""
    from cosfly.studies import depth
    from cosfly.viz.gallery import best_frame, frame_in

    if frame is None:
        frame = best_frame(job.tree(data), "depth.npy")
    elif data and not frame.exists():
        frame = frame_in(job.tree(data), frame)
    depth.run(frame, out)
    typer.echo(out / "depth_study.md")


@app.command("weather", epilog="cosfly study weather --map boxes_3d.json --traces drone_trace.json --out weather")
@takes("render", "seed")
def study_weather(
    job: Job,
    map_: options.Map,
    traces: options.Traces,
    out: Annotated[Path, Option(help="Folder for weather_gallery.jpg and weather_sheet.jpg.")],
    trajectory: Annotated[int, Option(help="Index of the trajectory in the traces.")] = 0,
    frame: Annotated[int | None, Option(show_default="looks down least", help="Index of its frame.")] = None,
    fov: Annotated[float, Option(min=1.0, max=169.0, help="Horizontal field of view, degrees.")] = 67.38,
) -> None:
    """Draw one view under every weather and time of day: nine pictures, and a sheet of all."""
    from cosfly.formats.weather import TIMES, WEATHERS
    from cosfly.runtime.console import progress_bar
    from cosfly.studies import weather

    with progress_bar("study weather: pictures", len(WEATHERS) * len(TIMES)) as advance:
        product = weather.run(
            job.cfg.render, map_, traces, out, trajectory=trajectory, frame=frame, fov_deg=fov, seed=job.cfg.seed,
            advance=lambda: advance(1),
        )  # fmt: skip
    for path in product:
        typer.echo(path)


@app.command(
    "zoom",
    epilog="cosfly study zoom --map boxes.json --simplified simplified.json --traces traces.json --out zoom",
)
@takes("render", STAGE)
def study_zoom(
    job: Job,
    map_: options.Map,
    simplified: options.Simplified,
    traces: options.Traces,
    out: options.Out,
    every: Annotated[int, Option(min=1, max=100, help="Draw one of this many frames.")] = 2,
) -> None:
    """Compare levels of zoom on the same trajectories: target size, visibility, track quality; optical and digital."""
    from cosfly.runtime.console import console
    from cosfly.runtime.json_io import read_object
    from cosfly.studies import zoom

    cfg = job.cfg.render
    product = zoom.run(cfg, map_, simplified, traces, out, every=every, seed=job.cfg.seed, **job.worker_options)
    table = zoom.text_table(read_object(product, what="zoom study"))
    options.print_table(console, table.columns, table.rows, title=table.title)
    job.finish(product, zoom.tree_of(out, max(cfg.fovs_deg)))
