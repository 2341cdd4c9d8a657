"""The commands of steps 1 to 4 and 6: `cosfly maps`, `simplify`, `pedestrians`, `plan`, `inspect`."""

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

    box_map, walks, folder = (
        options.needed("--map", map_),
        options.needed("--paths", paths),
        options.needed("--out", out),
    )
    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    options.set_aside(folder, repair)
    options.verify_first(verify, box_map, walks, folder)
    product = stage.run(cfg.plan, box_map, walks, folder, seed=cfg.seed, **options.manner(cfg, resume))
    options.tell_product(product, folder, cfg)


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

    from cosfly.planners import compare
    from cosfly.planners.compare_tables import text_tables
    from cosfly.work.config import build
    from cosfly.work.console import console

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

    folder = options.needed("--out", out)
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
