"""The commands of step 5 and of pictures that are there: `cosfly render ...`, `gallery`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli import options

app = typer.Typer()
render_app = typer.Typer(invoke_without_command=True, help="Step 5: frames of flights.")
app.add_typer(render_app, name="render")


@render_app.callback()
def render(
    context: typer.Context,
    map_: Annotated[Path | None, typer.Option("--map", help="Boxes: boxes_3d.json. [required]")] = None,
    simplified: Annotated[Path | None, typer.Option(help="Simplified map: step2_simplified.json. [required]")] = None,
    traces: Annotated[Path | None, typer.Option(help="Flights: drone_trace.json. [required]")] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder, the playback tree. [required]")] = None,
    others: Annotated[
        Path | None, typer.Option(help="Who else moves: others.json, beside the walks' path.json.")
    ] = None,
    weather_mode: Annotated[str | None, typer.Option(help="Weather: off, fixed or random-per-path.")] = None,
    weather_name: Annotated[str | None, typer.Option(help="Weather preset of mode fixed, as heavy_rain.")] = None,
    tod_name: Annotated[str | None, typer.Option(help="Time-of-day preset of mode fixed, as night.")] = None,
    weather_pool: options.WeatherPool = None,
    tod_pool: options.TimePool = None,
    weather_seed: Annotated[
        int | None, typer.Option(help="Seed of random-per-path; a negative one draws another seed for every run.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Step 5: RGB, depth and instance frames of the clean and the perturbed flight."""
    if context.invoked_subcommand is not None:
        return
    from cosfly.render import stage

    box_map, plain_map = options.needed("--map", map_), options.needed("--simplified", simplified)
    flights, folder = options.needed("--traces", traces), options.needed("--out", out)
    weather = {
        "weather_mode": weather_mode, "weather_name": weather_name, "tod_name": tod_name, "weather_pool": weather_pool,
        "tod_pool": tod_pool, "weather_seed": weather_seed,
    }  # fmt: skip
    of_stage = {f"render.{name}": value for name, value in weather.items()}
    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers, **of_stage})
    options.set_aside(folder, repair)
    options.verify_first(verify, box_map, plain_map, flights, others, folder)
    given = options.manner(cfg, resume) | {"seed": cfg.seed, "others": others}
    product = stage.run(cfg.render, box_map, plain_map, flights, folder, **given)
    options.tell_product(product, folder, cfg)


@render_app.command("sample")
def render_sample(
    out: Annotated[Path, typer.Option(help="PNG to write.")],
    data: options.Data = None,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Folder of a frame, from the tree on or as a path. [default: a frame that shows the target whole]"
        ),
    ] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="Boxes that were drawn: boxes_3d.json; needed without debug.png.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """One frame's four pictures: colours, depth, instances, and boxes with ids and distances."""
    from cosfly.look.gallery import four_panels
    from cosfly.products.boxes import read_boxes

    options.resolve(config, overrides)
    box_map = None if map_ is None else read_boxes(map_)
    typer.echo(four_panels(options.data_folder(data), out, frame=frame, box_map=box_map))
    typer.echo(out)


@app.command()
def gallery(
    out: Annotated[Path, typer.Option(help="Folder for contact_sheet.png and preview.gif.")],
    data: options.Data = None,
    flights: options.Flights = None,
    tracks: options.Tracks = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """A contact sheet and a preview GIF of a playback tree."""
    from cosfly.look.gallery import contact_sheet, preview_gif
    from cosfly.products.places import FlightChoice
    from cosfly.work.config import build

    options.resolve(config, overrides)
    tree = options.data_folder(data)
    given = options.chosen_flights("", flights, tracks)
    choice = build(FlightChoice, {name.strip("."): value for name, value in given.items() if value}, "the options")
    contact_sheet(tree, out / "contact_sheet.png", choice)
    preview_gif(tree, out / "preview.gif", choice)
    typer.echo(out)
