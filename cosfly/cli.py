"""The command line: one command per stage. The only place with log handlers, tables on the terminal and exit codes.

Nothing heavy is imported before a command runs, so that `cosfly --help` is instant.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosfly import __version__
from cosfly.cli_caption import app as caption_app
from cosfly.cli_distill import app as distill_app
from cosfly.cli_options import (
    ConfigFile,
    DataOption,
    MapOption,
    OutOption,
    Overrides,
    ResumeMode,
    ResumeOption,
    Seed,
    Workers,
    check_failures,
    data_folder,
    manner,
    resolve,
    tell_product,
)
from cosfly.errors import CosflyError

if TYPE_CHECKING:
    from cosfly.pipeline import StageResult

INTERRUPTED = 130  # the exit code of Ctrl-C: Typer makes it of a KeyboardInterrupt, without a word

app = typer.Typer(
    help="From a 3D map to a data set that teaches a vision-language model to follow a person from the air.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log details.")] = False,
) -> None:
    if version:
        typer.echo(f"cosfly {__version__}")
        raise typer.Exit
    from cosfly.console import set_up_logging

    set_up_logging(verbose)


def main() -> None:
    """Entry point: a CosflyError is one line and exit 1; a bug keeps its traceback."""
    try:
        app()
    except CosflyError as error:
        _fail(str(error), 1)
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        _fail("interrupted; finished work is kept: run the same command again to continue", INTERRUPTED)


def _fail(message: str, status: int) -> None:
    typer.echo(f"error: {message}", err=True)
    sys.stderr.flush()
    sys.exit(status)


# --- the whole way ----------------------------------------------------------------------------------------------------


@app.command()
def run(
    config: Annotated[
        Path, typer.Argument(help="YAML file, or the name of one that ships: quickstart, simworld, delft.")
    ],
    out: Annotated[Path | None, typer.Option(help="Run folder; by default runs/<name>.")] = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Make a data set from a configuration: all stages in order. Run it again to continue."""
    from cosfly import pipeline

    cfg = resolve(config, overrides, seed, workers)
    out = out or Path("runs") / cfg.name
    results = pipeline.run(cfg, out, resume=resume.value)
    _closing_table(results, out)
    check_failures({r.stage: r.manifest["counts"] for r in results}, out, cfg)


def _closing_table(results: list[StageResult], out: Path) -> None:
    from rich.table import Table

    from cosfly.console import console

    table = Table(title=f"What was made in {out}", title_justify="left")
    for column in ("stage", "kept", "dropped", "failed", "seconds", "product"):
        table.add_column(column, justify="right" if column in ("kept", "seconds") else "left", overflow="fold")
    for result in results:
        counts = result.manifest["counts"]
        dropped, failed = (
            ", ".join(f"{k} {v}" for k, v in counts[word].items()) or "-" for word in ("dropped", "failed")
        )
        seconds = "before" if result.was_complete else f"{result.manifest['seconds']:.1f}"
        product = os.path.relpath(result.product, out)
        table.add_row(result.stage, f"{counts['kept']} of {counts['input']}", dropped, failed, seconds, product)
    console.print(table)
    for name in ("contact_sheet.png", "preview.gif", "inspect/report.html", "release/dataset/README.md"):
        console.print(f"  look at  {os.path.relpath(out / name)}", highlight=False)


# --- stages 1-4 -------------------------------------------------------------------------------------------------------


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
    import cosfly.maps

    cfg = resolve(config, [*(overrides or []), *([f"maps.source={source}"] if source else [])], seed)
    typer.echo(cosfly.maps.run(cfg.maps, out, seed=cfg.seed, resume=resume.value))


@app.command()
def simplify(
    map_: MapOption,
    out: OutOption,
    config: ConfigFile = None,
    overrides: Overrides = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 2: merge, crop and prune boxes_3d.json into step2_simplified.json."""
    import cosfly.simplify

    cfg = resolve(config, overrides)
    typer.echo(cosfly.simplify.run(cfg.simplify, map_, out, resume=resume.value))


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
    import cosfly.pedestrians

    cfg = resolve(config, overrides, seed, workers)
    tell_product(
        cosfly.pedestrians.run(cfg.pedestrians, map_, out, seed=cfg.seed, roi=roi or cfg.roi, **manner(cfg, resume)),
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
    import cosfly.planners

    box_map, walks, folder = _needed("--map", map_), _needed("--paths", paths), _needed("--out", out)
    cfg = resolve(config, overrides, seed, workers)
    tell_product(
        cosfly.planners.run(cfg.plan, box_map, walks, folder, seed=cfg.seed, **manner(cfg, resume)), folder, cfg
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
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Both planners on the same walks: a table, compare.json, the flights, and pictures."""
    import cosfly.planners.compare

    cfg = resolve(config, overrides, seed, workers)
    product = cosfly.planners.compare.run(cfg.plan, map_, paths, out, seed=cfg.seed, **manner(cfg, resume))
    _compare_tables(cosfly.planners.compare.table_rows(product))
    typer.echo(product)


def _compare_tables(tables: dict[str, list[list[str]]]) -> None:
    from rich.table import Table

    from cosfly.console import console

    planners = ("TA* + Smooth", "MuCO")
    for name, title, columns in (
        ("figures", "Means over the walks that both fly", ("figure", *planners, "difference", "%")),
        ("axes", "Axis scores, higher is better", ("axis", *planners)),
        ("wins", "TA* + Smooth against MuCO, walk by walk", ("criterion", "count", "rate")),
    ):
        table = Table(title=title, title_justify="left")
        for k, column in enumerate(columns):
            table.add_column(column, justify="right" if k else "left")
        for row in tables[name]:
            table.add_row(*row)
        console.print(table)


# --- stages 5-7 -------------------------------------------------------------------------------------------------------


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
    import cosfly.render

    cfg = resolve(config, overrides, seed, workers)
    tell_product(
        cosfly.render.run(cfg.render, map_, simplified, traces, out, seed=cfg.seed, **manner(cfg, resume)), out, cfg
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
    import cosfly.qc

    cfg = resolve(config, overrides, None, workers)
    tell_product(cosfly.qc.run(cfg.inspect, traces, data_folder(data), out, **manner(cfg, resume)), out, cfg)


app.add_typer(caption_app, name="caption")


# --- release ----------------------------------------------------------------------------------------------------------

release_app = typer.Typer(
    no_args_is_help=True, help="Package captions and frames as a data set that opens with one line."
)
app.add_typer(release_app, name="release")


@release_app.command("build")
def release_build(
    captions: Annotated[Path, typer.Option(help="captions.jsonl")],
    inspected: Annotated[Path, typer.Option("--inspect", help="inspect.json")],
    out: Annotated[Path, typer.Option(help="Release folder.")],
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Select frames, join captions, write parquet, data-set card and checksums."""
    import release.package

    cfg = resolve(config, overrides, None, workers)
    tell_product(
        release.package.run(cfg.release, data_folder(data), captions, inspected, out, **manner(cfg, resume)), out, cfg
    )


@release_app.command("verify")
def release_verify(folder: Annotated[Path, typer.Argument(help="Release folder.")]) -> None:
    """Check structure, checksums, every number of the card, and re-projection. Exit 1 if anything is wrong."""
    import release.validate

    report = release.validate.verify(folder)
    typer.echo(str(report))
    if not report.is_ok:
        raise typer.Exit(1)


app.add_typer(distill_app, name="distill")


# --- this installation ------------------------------------------------------------------------------------------------

config_app = typer.Typer(no_args_is_help=True, help="Look at configurations.")
app.add_typer(config_app, name="config")


@config_app.command("check")
def config_check(
    config: Annotated[Path, typer.Argument(help="YAML file, or the name of one that ships.")],
    overrides: Overrides = None,
) -> None:
    """Check a configuration without running it; reports all problems at once."""
    resolve(config, overrides)
    typer.echo(f"{config}: ok")


@config_app.command("show")
def config_show(
    config: Annotated[
        Path | None, typer.Argument(help="YAML file, or the name of one that ships; none: the defaults.")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Print the resolved configuration: every setting with its value."""
    import yaml

    cfg = resolve(config, overrides)
    typer.echo(yaml.safe_dump(cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True), nl=False)


@app.command()
def doctor(
    teacher: Annotated[str | None, typer.Option(help="URL of an endpoint to ask as well.")] = None,
    out: Annotated[Path, typer.Option(help="Where runs will be written.")] = Path("runs"),
) -> None:
    """What works here: GL, GPU, packages, endpoint, disk. Exit 1 if the main job cannot run."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from cosfly import doctor as examination

    checks = examination.examine(out, teacher)
    table = Table(show_header=False, box=None)
    for check in checks:
        color = {"ok": "green", "missing": "red", "optional": "yellow"}[check.state]
        table.add_row(check.name, f"[{color}]{check.state}[/]", escape(check.detail))
    Console().print(table)
    if any(check.state == "missing" for check in checks):
        raise typer.Exit(1)
