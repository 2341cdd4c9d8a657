"""The commands `cosfly study ...`: depth formats, levels of zoom, weathers, each on the same frames and flights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli import options

app = typer.Typer(
    no_args_is_help=True, help="Compare depth formats, levels of zoom and weathers on the same frames and flights."
)


@app.command("depth")
def study_depth(
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
    from cosfly.look.gallery import best_frame, frame_in
    from cosfly.studies import depth

    if frame is None:
        frame = best_frame(options.data_folder(data), "depth.npy")
    elif data and not frame.exists():
        frame = frame_in(options.data_folder(data), frame)
    depth.run(frame, out)
    typer.echo(out / "depth_study.md")


@app.command("weather")
def study_weather(
    map_: options.Map,
    traces: Annotated[Path, typer.Option(help="Flights: drone_trace.json.")],
    out: Annotated[Path, typer.Option(help="Folder for weather_gallery.jpg and weather_sheet.jpg.")],
    trajectory: Annotated[int, typer.Option(help="Which flight of the traces, counted from 0.")] = 0,
    frame: Annotated[
        int | None, typer.Option(help="Which of its frames. [default: the one that looks down least]")
    ] = None,
    fov: Annotated[float, typer.Option(min=1.0, max=169.0, help="Horizontal field of view, degrees.")] = 67.38,
    weather_pool: options.WeatherPool = None,
    tod_pool: options.TimePool = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
) -> None:
    """One view under every weather and time of day: nine pictures, and a sheet of all."""
    from cosfly.render.weather import read_pools
    from cosfly.studies import weather
    from cosfly.work.console import progress_bar

    pools = {"render.weather_pool": weather_pool, "render.tod_pool": tod_pool}
    mode = {"render.weather_mode": "random_per_path"} if any(pools.values()) else {}
    cfg = options.resolve(config, overrides, {"seed": seed, **mode, **pools})
    presets = read_pools(cfg.render)
    with progress_bar("study weather: pictures", len(presets.weathers) * len(presets.times)) as advance:
        product = weather.run(
            cfg.render, map_, traces, out, trajectory=trajectory, frame=frame, fov_deg=fov, seed=cfg.seed, advance=lambda: advance(1),
        )  # fmt: skip
    for path in product:
        typer.echo(path)


@app.command("zoom")
def study_zoom(
    map_: options.Map,
    simplified: Annotated[Path, typer.Option(help="Simplified map: step2_simplified.json.")],
    traces: Annotated[Path, typer.Option(help="Flights: drone_trace.json.")],
    out: options.Out,
    flights: Annotated[int | None, typer.Option(help="Flights at most. [default: 50]")] = None,
    every: Annotated[int | None, typer.Option(help="Every how many frames of a flight are drawn. [default: 2]")] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """The same flights at every level of zoom: target size, visibility, track quality; optical against digital zoom."""
    from rich.table import Table

    from cosfly.reading.documents import read_object
    from cosfly.studies import zoom
    from cosfly.work.config import build
    from cosfly.work.console import console

    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    options.set_aside(out, repair)
    options.verify_first(verify, map_, simplified, traces, out)
    given = {"num_flights": flights, "every": every}
    settings = cfg.render.model_dump() | {name: value for name, value in given.items() if value is not None}
    studied = build(zoom.ZoomStudyConfig, settings, "--flights, --every")
    product = zoom.run(studied, map_, simplified, traces, out, seed=cfg.seed, **options.manner(cfg, resume))
    table = Table(title="Zoom (mean ± standard deviation over flights)", title_justify="left")
    for column in ("level", "deg", "35 mm", "target px", "visibility %", "IoU"):
        table.add_column(column)
    for row in zoom.text_rows(read_object(product, what="zoom study")):
        table.add_row(*row)
    console.print(table)
    options.tell_product(product, out, cfg)
