"""The commands of steps 1 to 6: `cosfly maps`, `simplify`, `pedestrians`, `plan`, `render`, `gallery`, `inspect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli.options import (
    ConfigFile,
    DataOption,
    MapOption,
    OutOption,
    Overrides,
    ResumeMode,
    ResumeOption,
    Seed,
    Workers,
    data_folder,
    manner,
    resolve,
    tell_product,
)

app = typer.Typer()


@app.command()
def maps(
    out: OutOption,
    source: Annotated[
        str | None, typer.Option(help="synthetic, simworld or cityjson; short for --set maps.source=...")
    ] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 1: make boxes_3d.json from a map source."""
    import cosfly.maps.stage

    cfg = resolve(config, [*(overrides or []), *([f"maps.source={source}"] if source else [])], seed)
    typer.echo(cosfly.maps.stage.run(cfg.maps, out, seed=cfg.seed, resume=resume.value))


@app.command()
def simplify(
    map_: MapOption,
    out: OutOption,
    config: ConfigFile = None,
    overrides: Overrides = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 2: merge, crop and prune boxes_3d.json into step2_simplified.json."""
    import cosfly.simplify.stage

    cfg = resolve(config, overrides)
    typer.echo(cosfly.simplify.stage.run(cfg.simplify, map_, out, resume=resume.value))


@app.command()
def pedestrians(
    map_: MapOption,
    out: OutOption,
    roi: Annotated[Path | None, typer.Option(help="Region of interest: roi_polygon.json.")] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 3: walks of 50-100 m on the simplified map, path.json."""
    import cosfly.pedestrians.stage

    cfg = resolve(config, overrides, seed, workers)
    tell_product(
        cosfly.pedestrians.stage.run(
            cfg.pedestrians, map_, out, seed=cfg.seed, roi=roi or cfg.roi, **manner(cfg, resume)
        ),
        out,
        cfg,
    )


plan_app = typer.Typer(invoke_without_command=True, help="Step 4: drone flights.")
app.add_typer(plan_app, name="plan")


@plan_app.callback()
def plan(
    context: typer.Context,
    map_: Annotated[Path | None, typer.Option("--map", help="Boxes: step2_simplified.json. [required]")] = None,
    paths: Annotated[Path | None, typer.Option(help="Walks: path.json. [required]")] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder. [required]")] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 4: a drone flight for every walk, drone_trace.json."""
    if context.invoked_subcommand is not None:
        return
    import cosfly.planners.stage

    box_map, walks, folder = _needed("--map", map_), _needed("--paths", paths), _needed("--out", out)
    cfg = resolve(config, overrides, seed, workers)
    tell_product(
        cosfly.planners.stage.run(cfg.plan, box_map, walks, folder, seed=cfg.seed, **manner(cfg, resume)), folder, cfg
    )


def _needed(name: str, value: Path | None) -> Path:
    """An option that a stage needs but its subcommands do not: a usage error, exit 2, where it is missing."""
    if value is None:
        raise typer.BadParameter("it must be given", param_hint=f"'{name}'")
    return value


@plan_app.command("compare")
def plan_compare(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="Boxes: step2_simplified.json.")],
    paths: Annotated[Path, typer.Argument(metavar="PATHS", help="Walks: path.json.")],
    out: OutOption,
    planner: Annotated[
        list[str] | None,
        typer.Option(help="A planner to compare; repeat it. The others are held against the first. [default: all]"),
    ] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Planners on the same walks: tables, compare.json, the flights, and pictures."""
    from rich.table import Table

    import cosfly.planners.compare
    from cosfly.config import build
    from cosfly.console import console

    cfg = resolve(config, overrides, seed, workers)
    settings = cfg.plan.model_dump() | ({"planners": planner} if planner else {})
    compared = build(cosfly.planners.compare.CompareConfig, settings, "--planner")
    product = cosfly.planners.compare.run(compared, map_, paths, out, seed=cfg.seed, **manner(cfg, resume))
    for text in cosfly.planners.compare.text_tables(product):
        table = Table(title=text.title, title_justify="left")
        for k, column in enumerate(text.columns):
            table.add_column(column, justify="right" if k else "left")
        for row in text.rows:
            table.add_row(*row)
        console.print(table)
    typer.echo(product)


@app.command()
def render(
    map_: MapOption,
    simplified: Annotated[Path, typer.Option(help="Simplified map: step2_simplified.json.")],
    traces: Annotated[Path, typer.Option(help="Flights: drone_trace.json.")],
    out: Annotated[Path, typer.Option(help="Output folder, the playback tree.")],
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 5: RGB, depth and instance frames of the clean and the perturbed flight."""
    import cosfly.render.stage

    cfg = resolve(config, overrides, seed, workers)
    tell_product(
        cosfly.render.stage.run(cfg.render, map_, simplified, traces, out, seed=cfg.seed, **manner(cfg, resume)),
        out,
        cfg,
    )


@app.command()
def gallery(
    out: Annotated[Path, typer.Option(help="Folder for contact_sheet.png and preview.gif.")],
    data: DataOption = None,
) -> None:
    """A contact sheet and a preview GIF of a playback tree."""
    from cosfly.gallery import contact_sheet, preview_gif

    tree = data_folder(data)
    contact_sheet(tree, out / "contact_sheet.png")
    preview_gif(tree, out / "preview.gif")
    typer.echo(out)


@app.command()
def inspect(
    traces: Annotated[Path, typer.Option(help="Flights: drone_trace.json.")],
    out: OutOption,
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 6: accept, route to review or reject every flight; inspect.json and an HTML report."""
    import cosfly.inspection.stage

    cfg = resolve(config, overrides, None, workers)
    tell_product(
        cosfly.inspection.stage.run(cfg.inspect, traces, data_folder(data), out, **manner(cfg, resume)), out, cfg
    )
