"""The commands of steps 1 to 6: `cosfly maps`, `simplify`, `pedestrians`, `roi`, `plan`, `render` and `inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, WORKERS, Job, Short, takes

app = typer.Typer()

Paths = Annotated[Path, Option(help="Pedestrian trajectories: path.json.")]
PathsArgument = Annotated[Path, Argument(metavar="PATHS", help="Pedestrian trajectories: path.json.")]
Planners = Annotated[list[str] | None, Option("--planner", show_default="all", help="Planner to compare; repeat it.")]
SOURCE = Short("maps.source", "synthetic, simworld, cityjson, boxes, carla or unrealcv.")
BACKEND = Short("render.backend", "Renderer: gl, pyrender, carla or unrealcv.")

maps_app = options.stage_group("Make a map of boxes (step 1).")
app.add_typer(maps_app, name="maps")


@maps_app.callback(epilog="cosfly maps --source synthetic --out maps")
@takes(
    "maps", "town seed resume", source=Short("maps.source", "synthetic, simworld, cityjson, boxes, carla or unrealcv.")
)
def maps(job: Job, out: options.Out) -> None:
    """Make boxes_3d.json from a map source (step 1)."""
    from cosfly.maps import stage

    cfg = job.cfg
    job.finish(stage.run(cfg.maps, out, seed=cfg.seed, resume=job.resume, follow_links=cfg.follow_links), out)


@maps_app.command("roi-backdrop", epilog="cosfly maps roi-backdrop --map maps/boxes_3d.json --out above.png")
@takes("render", "seed", backend=BACKEND)
def maps_roi_backdrop(
    job: Job,
    map_: options.Map,
    out: Annotated[Path, Option(help="PNG to write, with its world frame in a JSON file next to it.")],
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        Option(metavar="W S E N", show_default="the whole map", help="Area to draw, world metres."),
    ] = None,
    pixels_per_m: Annotated[float, Option(min=0.01, max=100, help="Scale.")] = 4.0,
) -> None:
    """Draw the map from above with a renderer, for `roi edit --backdrop`."""
    from cosfly.render import backdrop

    cfg = job.cfg
    typer.echo(backdrop.run(cfg.render, map_, out, bounds_m=bounds, pixels_per_m=pixels_per_m, seed=cfg.seed))


@app.command(epilog="cosfly simplify --map maps/boxes_3d.json --out simplify")
@takes("simplify", "town resume")
def simplify(job: Job, map_: options.Map, out: options.Out) -> None:
    """Merge, crop and prune boxes_3d.json into step2_simplified.json (step 2)."""
    from cosfly.simplify import stage

    job.finish(stage.run(job.cfg.simplify, map_, out, resume=job.resume), out)


@app.command(epilog="cosfly pedestrians --map simplify/step2_simplified.json --out pedestrians")
@takes("pedestrians", STAGE, roi=Short("roi", "Region of interest: roi_polygon.json.", Path))
def pedestrians(job: Job, map_: options.Map, out: options.Out) -> None:
    """Plan pedestrian trajectories of 50 to 100 m on the simplified map, path.json (step 3)."""
    from cosfly.pedestrians import stage

    product = stage.run(job.cfg.pedestrians, map_, out, seed=job.cfg.seed, roi=job.cfg.roi, **job.worker_options)
    job.finish(product, out)


roi_app = typer.Typer(help="Draw the region of interest for pedestrians.", no_args_is_help=True)
app.add_typer(roi_app, name="roi")


@roi_app.command("edit", epilog="cosfly roi edit simplify/step2_simplified.json --roi roi_polygon.json")
@takes("pedestrians", "town")
def roi_edit(
    job: Job,
    map_: options.MapArgument,
    roi: Annotated[Path, Option(help="Region to edit, if it exists, and to save.")] = Path("roi_polygon.json"),
    backdrop: Annotated[Path | None, Option(help="PNG of `maps roi-backdrop`.")] = None,
    port: Annotated[int, Option(min=0, max=65535, help="Port on this machine; 0 takes a free one.")] = 0,
) -> None:
    """Edit the region of interest on a local page, over the planning grid; end with Ctrl-C."""
    from cosfly.pedestrians.roi_editor import open_editor

    server = open_editor(map_, job.cfg.pedestrians, roi, port, backdrop)
    typer.echo(f"open {server.address}")
    server.serve()


@roi_app.command("propose", epilog="cosfly roi propose simplify/step2_simplified.json --out roi_polygon.json")
@takes("pedestrians", "town")
def roi_propose(
    job: Job, map_: options.MapArgument, out: Annotated[Path, Option(help="Region to write: roi_polygon.json.")]
) -> None:
    """Write the outline of the walkable ground as a first region, to edit with `cosfly roi edit`."""
    from cosfly.pedestrians.roi_editor import run_propose

    typer.echo(run_propose(map_, job.cfg.pedestrians, out))
    typer.echo(out)


plan_app = options.stage_group("Plan drone trajectories (step 4).")
app.add_typer(plan_app, name="plan")


@plan_app.callback(epilog="cosfly plan --map simplify/step2_simplified.json --paths pedestrians/path.json --out plan")
@takes("plan", STAGE)
def plan(job: Job, map_: options.Map, paths: Paths, out: options.Out) -> None:
    """Plan a drone trajectory for each pedestrian, drone_trace.json (step 4)."""
    from cosfly.planners import stage

    job.finish(stage.run(job.cfg.plan, map_, paths, out, seed=job.cfg.seed, **job.worker_options), out)


@plan_app.command("compare", epilog="cosfly plan compare step2_simplified.json path.json --out compare")
@takes("plan", STAGE)
def plan_compare(
    job: Job, map_: options.MapArgument, paths: PathsArgument, out: options.Out, planner: Planners = None
) -> None:
    """Compare planners on the same pedestrians, against the first: tables, compare.json, trajectories, pictures.

    TA*+Smooth is the paper's search with our smoothing, MuCO the paper's objective with our step."""
    from cosfly.planners import compare
    from cosfly.runtime.config import build
    from cosfly.runtime.console import console

    settings = job.cfg.plan.model_dump() | ({"planners": planner} if planner else {})
    cfg = build(compare.CompareConfig, settings, "--planner")
    product = compare.run(cfg, map_, paths, out, seed=job.cfg.seed, **job.worker_options)
    for table in compare.text_tables(product):
        options.print_table(console, table.columns, table.rows, title=table.title)
    typer.echo(product)


@plan_app.command("benchmark", epilog="cosfly plan benchmark step2_simplified.json path.json --out benchmark")
@takes("plan", STAGE)
def plan_benchmark(
    job: Job,
    map_: options.MapArgument,
    paths: PathsArgument,
    out: options.Out,
    scenarios: Annotated[int, Option(help="Number of pedestrians, the first of the file.")] = 20,
    planner: Planners = None,
) -> None:
    """Compare the paper's 14 planners and ours: tables with intervals, benchmark.json, figures.

    TA*+Smooth is the paper's search with our smoothing, MuCO the paper's objective with our step."""
    from cosfly.planners import benchmark
    from cosfly.planners.contract import title_of
    from cosfly.runtime.config import build
    from cosfly.runtime.console import console
    from cosfly.runtime.json_io import read_object

    settings = job.cfg.plan.model_dump() | {"scenarios": scenarios} | ({"planners": planner} if planner else {})
    cfg = build(benchmark.BenchmarkConfig, settings, "plan benchmark")
    product = benchmark.run(cfg, map_, paths, out, seed=job.cfg.seed, **job.worker_options)
    found = read_object(product, what=benchmark.FORMAT.what)
    table = next(benchmark.text_tables(found))
    narrow = [[row[k] for k in (0, 1, 5, 6, 7)] for row in (table.columns, *table.rows)]  # fits eighty columns
    options.print_table(console, narrow[0], narrow[1:], title=table.title)
    for name, note in found["notes"].items():
        console.print(f"{title_of(name)}: {note}")
    console.print(f"all tables: {out / 'benchmark.md'}")
    typer.echo(product)


@app.command(
    epilog="cosfly render --map boxes_3d.json --simplified step2_simplified.json --traces drone_trace.json --out render"
)
@takes(
    "render",
    STAGE,
    backend=BACKEND,
    weather_mode=Short("render.weather_mode", "How weather is chosen."),
    weather_name=Short("render.weather_name", "Weather of mode fixed, such as heavy_rain."),
    tod_name=Short("render.tod_name", "Time of day of mode fixed, such as night."),
    weather_pool=Short("render.weather_pool", "YAML file with your own weather presets.", Path),
    tod_pool=Short("render.tod_pool", "YAML file with your own times of day.", Path),
    weather_seed=Short("render.weather_seed", "Seed of the weather; a negative one is replaced by a new seed.", int),
    path_index=Short("render.path_index", "Index of one trajectory of the traces, or all.", words={"all": None}),
    cvip=Short("render.unrealcv.host", "UnrealCV: host."),
    cvport=Short("render.unrealcv.port", "UnrealCV: port.", int),
    settle_delay=Short("render.unrealcv.settle_delay_s", "UnrealCV: seconds from a pose to its pictures.", float),
    coord_scale=Short("render.unrealcv.coord_scale", "UnrealCV: its units per metre.", float),
    coord_z_offset=Short("render.unrealcv.coord_z_offset", "UnrealCV: metres added to heights.", float),
)
def render(
    job: Job,
    map_: options.Map,
    simplified: options.Simplified,
    traces: options.Traces,
    out: options.Out,
    others: options.Bystanders = None,
    require_rgb: Annotated[bool | None, Option(show_default="as in settings", help="Write RGB.")] = None,
    require_depth: Annotated[bool | None, Option(show_default="as in settings", help="Write depth.")] = None,
    gif: Annotated[bool, Option("--gif", help="Also write an animation of the first trajectory.")] = False,
    gif_fps: Annotated[float, Option(min=0.1, max=50, help="Frames per second of the animation.")] = 4.0,
    gif_name: Annotated[str, Option(help="File name of the animation, in the output directory.")] = "preview.gif",
) -> None:
    """Render RGB, depth and instance frames of the clean and the perturbed track (step 5)."""
    from cosfly.render import stage
    from cosfly.render.settings import RenderConfig
    from cosfly.runtime.config import build
    from cosfly.runtime.io import inside
    from cosfly.viz.gallery import preview_gif

    wanted = {"rgb": require_rgb, "depth": require_depth}
    modalities: list[str] = [name for name in job.cfg.render.modalities if wanted.get(name) is not False]
    modalities += [name for name, is_wanted in wanted.items() if is_wanted and name not in modalities]
    cfg = build(RenderConfig, job.cfg.render.model_dump() | {"modalities": modalities}, "render")
    product = stage.run(cfg, map_, simplified, traces, out, seed=job.cfg.seed, others=others, **job.worker_options)
    if gif:
        preview_gif(product, inside(out, gif_name), frames_per_s=gif_fps)
    job.finish(product, out)


inspect_app = options.stage_group("Accept, review or reject every track (step 6).")
app.add_typer(inspect_app, name="inspect")


@inspect_app.callback(epilog="cosfly inspect --map step2_simplified.json --traces drone_trace.json --out inspect")
@takes("inspect", f"town {WORKERS} resume", **options.choice_of("inspect"))
def inspect(
    job: Job,
    out: options.Out,
    map_: Annotated[Path | None, Option("--map", help="step2_simplified.json; not for a foreign tree.")] = None,
    traces: Annotated[Path | None, Option(help="drone_trace.json; not for a foreign tree.")] = None,
    data: options.Trees = None,
) -> None:
    """Accept, route to review or reject every track; write inspect.json and an HTML report (step 6)."""
    from cosfly.inspection import stage

    job.finish(stage.run(job.cfg.inspect, map_, traces, job.tree(data), out, **job.worker_options), out)


TRACK_HELP = "a track, or all tracks of a trajectory; repeat it."


@inspect_app.command(
    "review",
    epilog="cosfly inspect review --inspect inspect --accept trajectory_1 --by me --reason clear",
)
def inspect_review(
    folder: Annotated[Path, Option("--inspect", help="Output directory of the inspection, or its inspect.json.")],
    accept: Annotated[list[str] | None, Option(metavar="TRACK", help=f"Accept {TRACK_HELP}")] = None,
    reject: Annotated[list[str] | None, Option(metavar="TRACK", help=f"Reject {TRACK_HELP}")] = None,
    by: Annotated[str | None, Option(help="Name of the reviewer.")] = None,
    reason: Annotated[str | None, Option(help="Reason of the decision.")] = None,
) -> None:
    """Decide tracks that wait for review, into review.jsonl; without a decision, list them."""
    from cosfly.formats.inspection import Choice, add_decisions, summary

    product = folder / "inspect.json" if folder.is_dir() else folder
    if accept or reject:
        if not (by and reason):
            raise typer.BadParameter("give the reviewer and the reason", param_hint="'--by', '--reason'")
        choices = [
            Choice.model_validate({"folder": name, "verdict": verdict, "reason": reason})
            for verdict, names in (("accepted", accept), ("rejected", reject))
            for name in names or []
        ]
        add_decisions(product, choices, by)
    typer.echo(summary(product))
