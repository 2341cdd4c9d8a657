"""The commands of steps 1 to 6: `cosfly world`, `maps`, `simplify`, `pedestrians`, `roi`, `plan`, `render` ..."""

import re
import time
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, WORKERS, Job, SettingOption, command, track_options

for stage in ("plan", "inspect"):
    options.add_group(stage)
options.add_group("roi", "Draw the region of interest for pedestrians.")

Paths = Annotated[Path, Option(help="Pedestrian trajectories: path.json.")]
PathsArgument = Annotated[Path, Argument(metavar="PATHS", help="Pedestrian trajectories: path.json.")]
SOURCE = SettingOption("maps.source", "synthetic, simworld, cityjson, boxes, carla or unrealcv.")
ROI = SettingOption("roi", "Region of interest: roi_polygon.json.", Path)
BACKEND = SettingOption("render.backend", "Renderer: gl, pyrender, carla or unrealcv.")


@command(
    'cosfly world "a small village by a river" --out village',
    "world",
    "seed",
    planner=SettingOption(
        "world.planner", "Language model that plans the world; by default, built-in rules.", metavar="URL"
    ),
    model=SettingOption("world.endpoint.model", "Name of the language model."),
)
def world(
    job: Job,
    prompt: Annotated[str, Argument(help="The world, in plain English, or a plan.yaml of another world.")],
    out: Annotated[Path | None, Option(show_default="worlds/<prompt>-<time>", help="New folder.")] = None,
    count: Annotated[
        int, Option(min=1, max=1000, help="Number of worlds, each with its own seed, pattern and sizes.")
    ] = 1,
) -> None:
    """Make a world from text: SimWorld's combined_world.json of the town that a prompt or a plan describes."""
    from cosfly.runtime.config import build

    name = "-".join(re.findall(r"[a-z0-9]+", prompt.lower())[:5]) or "world"
    out = out or Path("worlds") / f"{name[:40]}-{time.strftime('%Y%m%d-%H%M%S')}"
    source = {"plan": prompt} if prompt.endswith((".yaml", ".yml")) else {"prompt": prompt}
    cfg = build(type(job.cfg.world), job.cfg.world.model_dump() | source, "world")
    folders = [out] if count == 1 else [out / f"world_{number:03}" for number in range(count)]
    seeds = range(job.cfg.seed, job.cfg.seed + count)
    for seed, folder in zip(seeds, folders, strict=True):
        job.run("cosfly.worldgen.stage", cfg, folder, seed=seed)


@command("cosfly maps --source synthetic --out maps", "maps", "town seed", source=SOURCE)
def maps(job: Job, out: options.Out) -> None:
    """Make boxes_3d.json, a map of boxes, from a map source (step 1)."""
    job.run("cosfly.maps.stage", job.cfg.maps, out, follow_links=job.cfg.follow_links)


@command("cosfly simplify --map maps/boxes_3d.json --out simplify", "simplify", "town")
def simplify(job: Job, map_: options.Map, out: options.Out) -> None:
    """Merge, crop and prune boxes_3d.json into step2_simplified.json (step 2)."""
    job.run("cosfly.simplify.stage", job.cfg.simplify, map_, out)


@command("cosfly pedestrians --map step2_simplified.json --out pedestrians", "pedestrians", STAGE, roi=ROI)
def pedestrians(job: Job, map_: options.Map, out: options.Out) -> None:
    """Plan pedestrian trajectories of 50 to 100 m on the simplified map, path.json (step 3)."""
    job.run("cosfly.pedestrians.stage", job.cfg.pedestrians, map_, out, roi=job.cfg.roi)


@command("cosfly roi edit simplify/step2_simplified.json --roi roi_polygon.json", "pedestrians", "town")
def edit(
    job: Job,
    map_: options.MapArgument,
    roi: Annotated[Path, Option(help="Region to edit, if it exists, and to save.")] = Path("roi_polygon.json"),
    port: Annotated[int, Option(min=0, max=65535, help="Port on this machine; 0 takes a free one.")] = 0,
) -> None:
    """Edit the region of interest on a local page, over the planning grid; end with Ctrl-C."""
    server = job.call("cosfly.pedestrians.roi_editor:open_editor", map_, job.cfg.pedestrians, roi, port)
    typer.echo(f"open {server.address}")
    server.serve()


@command("cosfly plan --map simplified.json --paths pedestrians/path.json --out plan", "plan", STAGE)
def plan(job: Job, map_: options.Map, paths: Paths, out: options.Out) -> None:
    """Plan a drone trajectory for each pedestrian, drone_trace.json (step 4)."""
    job.run("cosfly.planners.stage", job.cfg.plan, map_, paths, out)


@command("cosfly plan compare step2_simplified.json path.json --out compare", "plan", STAGE)
def compare(
    job: Job,
    map_: options.MapArgument,
    paths: PathsArgument,
    out: options.Out,
    planner: Annotated[
        list[str] | None,
        Option(show_default="foresight, track_astar, muco", help="Planner to compare; repeat it, or all."),
    ] = None,
) -> None:
    """Compare planners on the same pedestrians, against the first: tables, compare.json, trajectories, a picture.

    TA*+Smooth is the paper's search with our smoothing, MuCO the paper's objective with our step."""
    from cosfly.planners import compare
    from cosfly.planners.contract import ALL_PLANNERS
    from cosfly.runtime.config import build

    planners = tuple(ALL_PLANNERS) if "all" in (planner or ()) else planner
    settings = job.cfg.plan.model_dump() | ({"planners": planners} if planners else {})
    cfg = build(compare.CompareConfig, settings, "--planner")
    product = job.call("cosfly.planners.compare", cfg, map_, paths, out)
    for table in compare.text_tables(product):
        options.print_table(table.columns, table.rows, table.title)
    typer.echo(product)


@command(
    "cosfly render --map boxes_3d.json --simplified step2_simplified.json --traces drone_trace.json --out render",
    "render",
    STAGE,
    backend=BACKEND,
    weather_mode=SettingOption("render.weather_mode", "Choice of weather: off, fixed, random_per_path or by_weight."),
    weather_name=SettingOption("render.weather_name", "Weather of mode fixed, such as heavy_rain."),
    tod_name=SettingOption("render.tod_name", "Time of day of mode fixed, such as night."),
    weather_pool=SettingOption("render.weather_pool", "YAML file with your own weather presets.", Path),
    tod_pool=SettingOption("render.tod_pool", "YAML file with your own times of day.", Path),
    weather_seed=SettingOption(
        "render.weather_seed", "Seed of the weather; a negative one is replaced by a new seed.", int
    ),
    path_index=SettingOption(
        "render.path_index", "Index of one trajectory of the traces, or all.", values={"all": None}
    ),
    cvip=SettingOption("render.unrealcv.host", "UnrealCV: host."),
    cvport=SettingOption("render.unrealcv.port", "UnrealCV: port.", int),
    settle_delay=SettingOption(
        "render.unrealcv.settle_delay_s", "UnrealCV: seconds from a pose to its pictures.", float
    ),
    coord_scale=SettingOption("render.unrealcv.coord_scale", "UnrealCV: Unreal units per metre.", float),
    coord_z_offset=SettingOption("render.unrealcv.coord_z_offset", "UnrealCV: metres added to heights.", float),
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
    from cosfly.render.settings import RenderConfig
    from cosfly.runtime.config import build
    from cosfly.runtime.io import inside
    from cosfly.viz.gallery import preview_gif

    required = {"rgb": require_rgb, "depth": require_depth}
    modalities: list[str] = [name for name in job.cfg.render.modalities if required.get(name) is not False]
    modalities += [name for name, is_required in required.items() if is_required and name not in modalities]
    cfg = build(RenderConfig, job.cfg.render.model_dump() | {"modalities": modalities}, "render")
    product = job.call("cosfly.render.stage", cfg, map_, simplified, traces, out, others=others)
    if gif:
        preview_gif(product, inside(out, gif_name), frames_per_s=gif_fps)
    job.finish(product, out)


@command(
    "cosfly inspect --map step2_simplified.json --traces drone_trace.json --out inspect",
    "inspect",
    f"town {WORKERS}",
    **track_options("inspect"),
)
def inspect(
    job: Job,
    out: options.Out,
    map_: Annotated[Path | None, Option("--map", help="step2_simplified.json; not for a foreign tree.")] = None,
    traces: Annotated[Path | None, Option(help="drone_trace.json; not for a foreign tree.")] = None,
    data: options.Trees = None,
) -> None:
    """Accept, route to review or reject every track; write inspect.json and an HTML report (step 6)."""
    job.run("cosfly.inspection.stage", job.cfg.inspect, map_, traces, job.tree(data), out)


@options.groups["inspect"].command(
    epilog="cosfly inspect review --inspect inspect --accept Town01/trajectory_1/ORI --by me --reason clear"
)
def review(
    folder: Annotated[Path, Option("--inspect", help="Output directory of the inspection, or its inspect.json.")],
    accept: Annotated[list[str] | None, Option(metavar="TRACK", help="Accept a track; repeat it.")] = None,
    reject: Annotated[list[str] | None, Option(metavar="TRACK", help="Reject a track; repeat it.")] = None,
    by: Annotated[str | None, Option(help="Name of the reviewer.")] = None,
    reason: Annotated[str | None, Option(help="Reason of the decision.")] = None,
) -> None:
    """Record decisions on tracks in review in review.jsonl; without a decision, list these tracks."""
    from cosfly.formats.inspection import Choice, add_decisions, summary

    product = folder / "inspect.json" if folder.is_dir() else folder
    if accept or reject:
        if not (by and reason):
            raise typer.BadParameter("a decision needs a reviewer and a reason", param_hint="'--by', '--reason'")
        choices = [
            Choice.model_validate({"folder": name, "verdict": verdict, "reason": reason})
            for verdict, names in (("accepted", accept), ("rejected", reject))
            for name in names or []
        ]
        add_decisions(product, choices, by)
    typer.echo(summary(product))
