"""The commands of steps 1 to 6: `cosfly maps`, `simplify`, `pedestrians`, `plan`, `render`, `gallery`, `convert-tree`, `inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli import options

app = typer.Typer()


@app.command()
def maps(
    out: options.Out,
    source: Annotated[
        str | None, typer.Option(help="synthetic, simworld, cityjson or boxes; short for --set maps.source=...")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    resume: options.Resume = "if-same",
) -> None:
    """Step 1: make boxes_3d.json from a map source."""
    from cosfly.maps import stage

    cfg = options.resolve(config, overrides, {"maps.source": source, "seed": seed})
    typer.echo(stage.run(cfg.maps, out, seed=cfg.seed, resume=resume))


@app.command()
def simplify(
    map_: options.Map,
    out: options.Out,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Step 2: merge, crop and prune boxes_3d.json into step2_simplified.json."""
    from cosfly.simplify import stage

    cfg = options.resolve(config, overrides)
    options.verify_first(verify, map_, out)
    typer.echo(stage.run(cfg.simplify, map_, out, resume=resume))


@app.command()
def pedestrians(
    map_: options.Map,
    out: options.Out,
    roi: Annotated[Path | None, typer.Option(help="Region of interest: roi_polygon.json.")] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Step 3: walks of 50-100 m on the simplified map, path.json."""
    from cosfly.pedestrians import stage

    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    options.set_aside(out, repair)
    options.verify_first(verify, map_, roi, out)
    given = options.manner(cfg, resume) | {"seed": cfg.seed, "roi": roi or cfg.roi}
    options.tell_product(stage.run(cfg.pedestrians, map_, out, **given), out, cfg)


plan_app = typer.Typer(invoke_without_command=True, help="Step 4: drone flights.")
app.add_typer(plan_app, name="plan")


@plan_app.callback()
def plan(
    context: typer.Context,
    map_: Annotated[Path | None, typer.Option("--map", help="Boxes: step2_simplified.json. [required]")] = None,
    paths: Annotated[Path | None, typer.Option(help="Walks: path.json. [required]")] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder. [required]")] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Step 4: a drone flight for every walk, drone_trace.json."""
    if context.invoked_subcommand is not None:
        return
    from cosfly.planners import stage

    box_map, walks, folder = _needed("--map", map_), _needed("--paths", paths), _needed("--out", out)
    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    options.set_aside(folder, repair)
    options.verify_first(verify, box_map, walks, folder)
    product = stage.run(cfg.plan, box_map, walks, folder, seed=cfg.seed, **options.manner(cfg, resume))
    options.tell_product(product, folder, cfg)


def _needed(name: str, value: Path | None) -> Path:
    """An option that a stage needs but its subcommands do not: a usage error, exit 2, where it is missing."""
    if value is None:
        raise typer.BadParameter("it must be given", param_hint=f"'{name}'")
    return value


@plan_app.command("compare")
def plan_compare(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="Boxes: step2_simplified.json.")],
    paths: Annotated[Path, typer.Argument(metavar="PATHS", help="Walks: path.json.")],
    out: options.Out,
    planner: Annotated[
        list[str] | None,
        typer.Option(help="A planner to compare; repeat it. The others are held against the first. [default: all]"),
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Planners on the same walks: tables, compare.json, the flights, and pictures."""
    from rich.table import Table

    from cosfly.config import build
    from cosfly.console import console
    from cosfly.planners import compare
    from cosfly.planners.compare_tables import text_tables

    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    options.set_aside(out, repair)
    settings = cfg.plan.model_dump() | ({"planners": planner} if planner else {})
    compared = build(compare.CompareConfig, settings, "--planner")
    options.verify_first(verify, map_, paths, out)
    product = compare.run(compared, map_, paths, out, seed=cfg.seed, **options.manner(cfg, resume))
    for text in text_tables(product):
        table = Table(title=text.title, title_justify="left")
        for k, column in enumerate(text.columns):
            table.add_column(column, justify="right" if k else "left")
        for row in text.rows:
            table.add_row(*row)
        console.print(table)
    typer.echo(product)


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

    box_map, plain_map = _needed("--map", map_), _needed("--simplified", simplified)
    flights, folder = _needed("--traces", traces), _needed("--out", out)
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


@render_app.command("weather-gallery")
def weather_gallery(
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
    from cosfly.console import progress_bar
    from cosfly.render import weather_gallery
    from cosfly.render.weather import read_pools

    pools = {"render.weather_pool": weather_pool, "render.tod_pool": tod_pool}
    mode = {"render.weather_mode": "random_per_path"} if any(pools.values()) else {}
    cfg = options.resolve(config, overrides, {"seed": seed, **mode, **pools})
    presets = read_pools(cfg.render)
    with progress_bar("weather-gallery: pictures", len(presets.weathers) * len(presets.times)) as advance:
        product = weather_gallery.run(
            cfg.render, map_, traces, out, trajectory=trajectory, frame=frame, fov_deg=fov, seed=cfg.seed, advance=lambda: advance(1),
        )  # fmt: skip
    for path in product:
        typer.echo(path)


@render_app.command("zoom-study")
def render_zoom_study(
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

    from cosfly.config import build
    from cosfly.console import console
    from cosfly.reading.documents import read_object
    from cosfly.render.zoom import study

    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    options.set_aside(out, repair)
    options.verify_first(verify, map_, simplified, traces, out)
    given = {"num_flights": flights, "every": every}
    settings = cfg.render.model_dump() | {name: value for name, value in given.items() if value is not None}
    studied = build(study.ZoomStudyConfig, settings, "--flights, --every")
    product = study.run(studied, map_, simplified, traces, out, seed=cfg.seed, **options.manner(cfg, resume))
    table = Table(title="Zoom (mean ± standard deviation over flights)", title_justify="left")
    for column in ("level", "deg", "35 mm", "target px", "visibility %", "IoU"):
        table.add_column(column)
    for row in study.text_rows(read_object(product, what="zoom study")):
        table.add_row(*row)
    console.print(table)
    options.tell_product(product, out, cfg)


@render_app.command("sample")
def render_sample(
    out: Annotated[Path, typer.Option(help="PNG to write.")],
    data: options.Data = None,
    frame: Annotated[
        str | None,
        typer.Option(help="Folder of a frame in the tree. [default: a frame that shows the target whole]"),
    ] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="Boxes that were drawn: boxes_3d.json; needed without debug.png.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """One frame's four pictures: colours, depth, instances, and boxes with ids and distances."""
    from cosfly.gallery import four_panels
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
    from cosfly.config import build
    from cosfly.gallery import contact_sheet, preview_gif
    from cosfly.products.places import FlightChoice

    options.resolve(config, overrides)
    tree = options.data_folder(data)
    given = options.chosen_flights("", flights, tracks)
    choice = build(FlightChoice, {name.strip("."): value for name, value in given.items() if value}, "the options")
    contact_sheet(tree, out / "contact_sheet.png", choice)
    preview_gif(tree, out / "preview.gif", choice)
    typer.echo(out)


@app.command("convert-tree")
def convert_tree(
    data: Annotated[Path, typer.Option(help="Playback tree of an earlier cosfly; it stays as it is.")],
    out: Annotated[Path, typer.Option(help="Folder of the converted tree.")],
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """An older playback tree to one that public readers of CosFly-Track take; pictures are linked, not copied."""
    from cosfly.render import older_trees

    cfg = options.resolve(config, overrides, {"workers": workers})
    options.set_aside(out, repair)
    options.verify_first(verify, data, out)
    options.tell_product(older_trees.run(data, out, **options.manner(cfg, resume)), out, cfg)


inspect_app = typer.Typer(invoke_without_command=True, help="Step 6: accept, route to review or reject every flight.")
app.add_typer(inspect_app, name="inspect")


@inspect_app.callback()
def inspect(
    context: typer.Context,
    out: Annotated[Path | None, typer.Option(help="Output folder. [required]")] = None,
    map_: Annotated[
        Path | None,
        typer.Option("--map", help="Simplified map: step2_simplified.json; none for a tree of somebody else."),
    ] = None,
    traces: Annotated[
        Path | None, typer.Option(help="Flights: drone_trace.json; none for a tree of somebody else.")
    ] = None,
    data: options.Data = None,
    flights: options.Flights = None,
    tracks: options.Tracks = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Step 6: accept, route to review or reject every flight; inspect.json and an HTML report."""
    if context.invoked_subcommand is not None:
        return
    from cosfly.inspection import stage

    folder = _needed("--out", out)
    chosen = {"workers": workers} | options.chosen_flights("inspect.flights", flights, tracks)
    cfg, tree = options.resolve(config, overrides, chosen), options.data_folder(data)
    options.set_aside(folder, repair)
    options.verify_first(verify, map_, traces, tree, folder)
    product = stage.run(cfg.inspect, map_, traces, tree, folder, **options.manner(cfg, resume))
    options.tell_product(product, folder, cfg)


@inspect_app.command("review")
def inspect_review(
    folder: Annotated[Path, typer.Option("--inspect", help="Folder of the inspection, or its inspect.json.")],
    accept: Annotated[
        list[str] | None,
        typer.Option(metavar="FLIGHT", help="Accept a flight, or the flights in review of a trajectory; repeat it."),
    ] = None,
    reject: Annotated[
        list[str] | None, typer.Option(metavar="FLIGHT", help="Reject a flight, or those of a trajectory; repeat it.")
    ] = None,
    by: Annotated[str | None, typer.Option(help="Who decides.")] = None,
    reason: Annotated[str | None, typer.Option(help="Why.")] = None,
    decisions: Annotated[
        Path | None, typer.Option(help="What review.html saved: take its decisions, by whom it says.")
    ] = None,
) -> None:
    """Decide flights that the inspection left to a person: make review.html, or take what was decided, into review.jsonl."""
    from cosfly.inspection import review
    from cosfly.products.review import Verdict

    product = folder / "inspect.json" if folder.is_dir() else folder
    chosen: list[tuple[Verdict, str]] = [("accepted", name) for name in accept or []]
    chosen += [("rejected", name) for name in reject or []]
    if decisions is not None and chosen:
        raise typer.BadParameter("a file of decisions, or flights, not both", param_hint="'--decisions'")
    if chosen and not (by and reason):
        raise typer.BadParameter("who decides and why must be given", param_hint="'--by', '--reason'")
    if decisions is not None:
        review.take(product, decisions)
    elif chosen:
        review.decide(product, chosen, by or "", reason or "")
    else:
        typer.echo(review.write_page(product))
    typer.echo(review.summary(product))
