"""The commands `cosfly study ...`: depth formats, levels of zoom, weathers, each on the same frames and flights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, takes
from cosfly.cli.stages import Simplification, Traces

ABOUT = "Compare depth formats, levels of zoom and weathers on the same frames and flights."
app = typer.Typer(no_args_is_help=True, help=ABOUT)


@app.command("depth")
@takes()
def study_depth(
    job: Job,
    out: Annotated[Path, Option(help="Folder for depth_study.json, depth_study.md and depth_study.png.")],
    data: options.Trees = None,
    frame: Annotated[
        Path | None,
        Option(
            show_default="one that shows the target whole",
            help="Folder of a frame, in the tree or a path; or a .npy, in metres.",
        ),
    ] = None,
) -> None:
    """The ways to store depth on one frame: errors, entropy, edges and size, with a figure."""
    from cosfly.studies import depth
    from cosfly.viz.gallery import best_frame, frame_in

    if frame is None:
        frame = best_frame(job.tree(data), "depth.npy")
    elif data and not frame.exists():
        frame = frame_in(job.tree(data), frame)
    depth.run(frame, out)
    typer.echo(out / "depth_study.md")


@app.command("weather")
@takes("seed")
def study_weather(
    job: Job,
    map_: options.Map,
    traces: Traces,
    out: Annotated[Path, Option(help="Folder for weather_gallery.jpg and weather_sheet.jpg.")],
    trajectory: Annotated[int, Option(help="Which flight of the traces, counted from 0.")] = 0,
    frame: Annotated[
        int | None, Option(show_default="the one that looks down least", help="Which of its frames.")
    ] = None,
    fov: Annotated[float, Option(min=1.0, max=169.0, help="Horizontal field of view, degrees.")] = 67.38,
) -> None:
    """One view under every weather and time of day: nine pictures, and a sheet of all."""
    from cosfly.formats.weather import TIMES, WEATHERS
    from cosfly.runtime.console import progress_bar
    from cosfly.studies import weather

    with progress_bar("study weather: pictures", len(WEATHERS) * len(TIMES)) as advance:
        chosen: Any = {"trajectory": trajectory, "frame": frame, "fov_deg": fov, "seed": job.cfg.seed}
        product = weather.run(job.cfg.render, map_, traces, out, **chosen, advance=lambda: advance(1))
    for path in product:
        typer.echo(path)


@app.command("zoom")
@takes(*STAGE)
def study_zoom(
    job: Job,
    map_: options.Map,
    simplified: Simplification,
    traces: Traces,
    out: options.Out,
    flights: Annotated[int | None, Option(show_default="50", help="Flights at most.")] = None,
    every: Annotated[int | None, Option(show_default="2", help="Every how many frames of a flight are drawn.")] = None,
) -> None:
    """The same flights at every level of zoom: target size, visibility, track quality; optical against digital zoom."""
    from cosfly.runtime.config import build
    from cosfly.runtime.console import console
    from cosfly.runtime.json_io import read_object
    from cosfly.studies import zoom

    given = {name: value for name, value in (("num_flights", flights), ("every", every)) if value is not None}
    studied = build(zoom.ZoomStudyConfig, job.cfg.render.model_dump() | given, "--flights, --every")
    product = zoom.run(studied, map_, simplified, traces, out, seed=job.cfg.seed, **job.worker_options)
    table = zoom.text_table(read_object(product, what="zoom study"))
    options.tell_table(console, table.columns, table.rows, title=table.title)
    job.finish(product, out)
