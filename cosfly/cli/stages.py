"""The commands of steps 1 to 6: `cosfly maps`, `simplify`, `pedestrians`, `plan`, `render`, `gallery`, `inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, WORKERS, Job, Sets, takes

app = typer.Typer()

Simplification = Annotated[Path, Option(help="Simplification map: step2_simplified.json.")]
Traces = Annotated[Path, Option(help="Flights: drone_trace.json.")]


maps_app = options.stage_group("Step 1: a map of boxes.")
app.add_typer(maps_app, name="maps")


@maps_app.callback()
@takes("town", "seed", "resume")
def maps(
    job: Job,
    out: options.Out,
    source: Annotated[
        str | None, Option(help="synthetic, simworld, cityjson, boxes, carla or unrealcv."), Sets("maps.source")
    ] = None,
) -> None:
    """Step 1: make boxes_3d.json from a map source."""
    from cosfly.maps import stage

    cfg = job.cfg
    job.finish(stage.run(cfg.maps, out, seed=cfg.seed, resume=job.resume, follow_links=cfg.follow_links), out)


@maps_app.command("roi-backdrop")
@takes("seed")
def maps_roi_backdrop(
    job: Job,
    map_: options.Map,
    out: Annotated[Path, Option(help="PNG to write, and beside it a JSON that tells where it lies.")],
    backend: Annotated[str | None, Option(help="gl, pyrender or carla."), Sets("render.backend")] = None,
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        Option(metavar="W S E N", show_default="the whole map", help="What to show, world m."),
    ] = None,
    pixels_per_m: Annotated[float, Option(min=0.01, max=100, help="Scale.")] = 4.0,
) -> None:
    """The map from above as a renderer draws it, for `roi edit --backdrop`."""
    from cosfly.render import backdrop

    cfg = job.cfg
    typer.echo(backdrop.run(cfg.render, map_, out, bounds_m=bounds, pixels_per_m=pixels_per_m, seed=cfg.seed))


@app.command()
@takes("town", "resume")
def simplify(job: Job, map_: options.Map, out: options.Out) -> None:
    """Step 2: merge, crop and prune boxes_3d.json into step2_simplified.json."""
    from cosfly.simplify import stage

    job.finish(stage.run(job.cfg.simplify, map_, out, resume=job.resume), out)


@app.command()
@takes(*STAGE)
def pedestrians(
    job: Job,
    map_: options.Map,
    out: options.Out,
    roi: Annotated[Path | None, Option(help="Region of interest: roi_polygon.json."), Sets("roi")] = None,
) -> None:
    """Step 3: walks of 50-100 m on the simplified map, path.json."""
    from cosfly.pedestrians import stage

    product = stage.run(job.cfg.pedestrians, map_, out, seed=job.cfg.seed, roi=job.cfg.roi, **job.worker_options)
    job.finish(product, out)


roi_app = typer.Typer(help="Region of interest: where people may walk.", no_args_is_help=True)
app.add_typer(roi_app, name="roi")
MapArgument = Annotated[Path, Argument(metavar="MAP", help="Boxes: step2_simplified.json.")]


@roi_app.command("edit")
@takes("town")
def roi_edit(
    job: Job,
    map_: MapArgument,
    roi: Annotated[Path, Option(help="The region: opened where it is there, written when the page saves.")] = Path(
        "roi_polygon.json"
    ),
    backdrop: Annotated[
        Path | None, Option(help="Picture from above, PNG, with its world frame beside it as JSON.")
    ] = None,
    port: Annotated[int, Option(min=0, max=65535, help="Port on this machine; 0 takes a free one.")] = 0,
) -> None:
    """Draw the region of interest on a local page, over the planning grid; Ctrl-C ends it."""
    from cosfly.pedestrians.roi_editor import open_editor

    server = open_editor(map_, job.cfg.pedestrians, roi, port, backdrop)
    typer.echo(f"open {server.address}")
    server.serve()


@roi_app.command("propose")
@takes("town")
def roi_propose(
    job: Job, map_: MapArgument, out: Annotated[Path, Option(help="The region: roi_polygon.json.")]
) -> None:
    """Write a first region: the outline of the walkable ground, to go on with in `cosfly roi edit`."""
    from cosfly.pedestrians.roi_editor import run_propose

    typer.echo(run_propose(map_, job.cfg.pedestrians, out))
    typer.echo(out)


plan_app = options.stage_group("Step 4: drone flights.")
app.add_typer(plan_app, name="plan")


@plan_app.callback()
@takes(*STAGE)
def plan(
    job: Job, map_: options.Map, paths: Annotated[Path, Option(help="Walks: path.json.")], out: options.Out
) -> None:
    """Step 4: a drone flight for every walk, drone_trace.json."""
    from cosfly.planners import stage

    job.finish(stage.run(job.cfg.plan, map_, paths, out, seed=job.cfg.seed, **job.worker_options), out)


@plan_app.command("compare")
@takes(*STAGE)
def plan_compare(
    job: Job,
    map_: MapArgument,
    paths: Annotated[Path, Argument(metavar="PATHS", help="Walks: path.json.")],
    out: options.Out,
    planner: Annotated[
        list[str] | None,
        Option(show_default="all", help="A planner; repeat it. The others are held against the first."),
    ] = None,
) -> None:
    """Planners on the same walks: tables, compare.json, the flights, and pictures."""
    from cosfly.planners import compare
    from cosfly.planners.compare import text_tables
    from cosfly.runtime.config import build
    from cosfly.runtime.console import console

    settings = job.cfg.plan.model_dump() | ({"planners": planner} if planner else {})
    compared = build(compare.CompareConfig, settings, "--planner")
    product = compare.run(compared, map_, paths, out, seed=job.cfg.seed, **job.worker_options)
    for table in text_tables(product):
        options.tell_table(console, table.columns, table.rows, title=table.title)
    typer.echo(product)


@plan_app.command("benchmark")
@takes(*STAGE)
def plan_benchmark(
    job: Job,
    map_: Annotated[Path, Argument(metavar="MAP", help="Boxes: step2_simplified.json.")],
    paths: Annotated[Path, Argument(metavar="PATHS", help="Walks: path.json.")],
    out: options.Out,
    scenarios: Annotated[int, Option(help="Walks, from the first one on.")] = 20,
    planner: Annotated[list[str] | None, Option(show_default="all", help="A planner; repeat it.")] = None,
) -> None:
    """The paper's comparison of 14 planners and ours: tables with intervals, benchmark.json, figures."""
    from cosfly.planners import benchmark
    from cosfly.runtime.config import build
    from cosfly.runtime.console import console

    settings = job.cfg.plan.model_dump() | {"scenarios": scenarios} | ({"planners": planner} if planner else {})
    cfg = build(benchmark.BenchmarkConfig, settings, "plan benchmark")
    product = benchmark.run(cfg, map_, paths, out, seed=job.cfg.seed, **job.worker_options)
    table, *_ = benchmark.text_tables(benchmark.read_benchmark(product))
    narrow = [[row[k] for k in (0, 1, 5, 6, 7)] for row in (table.columns, *table.rows)]  # eighty columns hold these
    options.tell_table(console, narrow[0], narrow[1:], title=table.title)
    console.print(f"all tables: {out / 'benchmark.md'}")
    typer.echo(product)


render_app = options.stage_group("Step 5: frames of flights.")
app.add_typer(render_app, name="render")


@render_app.callback()
@takes(*STAGE)
def render(
    job: Job,
    map_: options.Map,
    simplified: Simplification,
    traces: Traces,
    out: options.Out,
    backend: Annotated[str | None, Option(help="gl, pyrender, carla or unrealcv."), Sets("render.backend")] = None,
    others: Annotated[Path | None, Option(help="Who else moves: others.json, beside path.json.")] = None,
    weather_mode: Annotated[str | None, Option(help="How skies are drawn."), Sets("render.weather_mode")] = None,
    weather_name: Annotated[
        str | None, Option(help="Weather of mode fixed, as heavy_rain."), Sets("render.weather_name")
    ] = None,
    tod_name: Annotated[
        str | None, Option(help="Time of day of mode fixed, as night."), Sets("render.tod_name")
    ] = None,
    weather_pool: Annotated[
        Path | None, Option(help="YAML file with weather presets of yours."), Sets("render.weather_pool")
    ] = None,
    tod_pool: Annotated[
        Path | None, Option(help="YAML file with times of day of yours."), Sets("render.tod_pool")
    ] = None,
    weather_seed: Annotated[
        int | None, Option(help="Seed; a negative one draws one."), Sets("render.weather_seed")
    ] = None,
    cvip: Annotated[str | None, Option(help="Where UnrealCV is."), Sets("render.unrealcv.host")] = None,
    cvport: Annotated[int | None, Option(help="Its port."), Sets("render.unrealcv.port")] = None,
    path_index: Annotated[
        str | None, Option(help="One flight of the traces, or all."), Sets("render.path_index", {"all": None})
    ] = None,
    require_rgb: Annotated[
        bool | None, Option("--require-rgb/--no-require-rgb", help="Write colours.", show_default="as in settings")
    ] = None,
    require_depth: Annotated[
        bool | None, Option("--require-depth/--no-require-depth", help="Write depth.", show_default="as in settings")
    ] = None,
    settle_delay: Annotated[
        float | None,
        Option(help="UnrealCV: seconds from a pose to its pictures."),
        Sets("render.unrealcv.settle_delay_s"),
    ] = None,
    coord_scale: Annotated[
        float | None, Option(help="UnrealCV: its units in 1 m."), Sets("render.unrealcv.coord_scale")
    ] = None,
    coord_z_offset: Annotated[
        float | None, Option(help="UnrealCV: added to heights, m."), Sets("render.unrealcv.coord_z_offset")
    ] = None,
    gif: Annotated[bool, Option("--gif", help="Also make an animation of the first flight.")] = False,
    gif_fps: Annotated[float, Option(min=0.1, max=50, help="Its frames a second.")] = 4.0,
    gif_name: Annotated[str, Option(help="Its name, in the folder.")] = "preview.gif",
) -> None:
    """Step 5: RGB, depth and instance frames of the clean and the perturbed flight."""
    from cosfly.render import stage
    from cosfly.render.settings import RenderConfig
    from cosfly.runtime.config import build
    from cosfly.runtime.io import inside
    from cosfly.viz.gallery import preview_gif

    wanted = {"rgb": require_rgb, "depth": require_depth}
    modalities: list[str] = [name for name in job.cfg.render.modalities if wanted.get(name) is not False]
    modalities += [name for name, is_wanted in wanted.items() if is_wanted and name not in modalities]
    cfg = build(RenderConfig, job.cfg.render.model_dump() | {"modalities": modalities}, "render")
    worker_options = job.worker_options | {"seed": job.cfg.seed, "others": others}
    product = stage.run(cfg, map_, simplified, traces, out, **worker_options)
    if gif:
        preview_gif(product, inside(out, gif_name), frames_per_s=gif_fps)
    job.finish(product, out)


inspect_app = options.stage_group("Step 6: accept, route to review or reject every flight.")
app.add_typer(inspect_app, name="inspect")


@inspect_app.callback()
@takes("town", *WORKERS, "resume", flights="inspect.flights")
def inspect(
    job: Job,
    out: options.Out,
    map_: Annotated[Path | None, Option("--map", help="step2_simplified.json; none for somebody else's tree.")] = None,
    traces: Annotated[Path | None, Option(help="drone_trace.json; none for somebody else's tree.")] = None,
    data: options.Trees = None,
) -> None:
    """Step 6: accept, route to review or reject every flight; inspect.json and an HTML report."""
    from cosfly.inspection import stage

    tree = job.tree(data)
    job.finish(stage.run(job.cfg.inspect, map_, traces, tree, out, **job.worker_options), out)


@inspect_app.command("review")
def inspect_review(
    folder: Annotated[Path, Option("--inspect", help="Folder of the inspection, or its inspect.json.")],
    accept: Annotated[
        list[str] | None, Option(metavar="FLIGHT", help="Accept a flight, or those of a trajectory; repeat it.")
    ] = None,
    reject: Annotated[
        list[str] | None, Option(metavar="FLIGHT", help="Reject a flight, or those of a trajectory; repeat it.")
    ] = None,
    by: Annotated[str | None, Option(help="Who decides.")] = None,
    reason: Annotated[str | None, Option(help="Why.")] = None,
) -> None:
    """Decide flights that were left to a person, into review.jsonl; without a decision, list those that are open."""
    from cosfly.formats.review import Choice, add_decisions, summary

    product = folder / "inspect.json" if folder.is_dir() else folder
    given = {"accepted": accept or [], "rejected": reject or []}
    if accept or reject:
        if not (by and reason):
            raise typer.BadParameter("who decides and why must be given", param_hint="'--by', '--reason'")
        choices = [
            Choice.model_validate({"folder": name, "verdict": verdict, "reason": reason})
            for verdict, names in given.items()
            for name in names
        ]
        add_decisions(product, choices, by)
    typer.echo(summary(product))
