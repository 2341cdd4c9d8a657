"""The commands `cosfly run`, `show`, `reproduce`, `doctor`, `config ...` and `study ...`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, WORKERS, Job, command

if TYPE_CHECKING:
    from cosfly.pipeline.settings import RunConfig

CONFIG = "YAML file, a shipped one (quickstart, showcase, diverse, simworld, delft), or a run directory."
Until = Literal["maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release"]
PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)}


@command("cosfly run quickstart --out runs/first", "*", f"seed {WORKERS}")
def run(
    job: Job,
    config: Annotated[Path, Argument(help=CONFIG)],
    out: Annotated[Path | None, Option(show_default="runs/<name>", help="Run directory.")] = None,
    dry_run: Annotated[bool, Option("--dry-run", help="Estimate time and disk by stage; write nothing there.")] = False,
    until: Annotated[Until, Option(help="Last stage to run.")] = "release",
) -> None:
    """Make a data set from a configuration: run all stages in order. Repeat the command to resume."""
    from cosfly.pipeline import run as pipeline

    out = out or (config if (config / "run.yaml").is_file() else Path("runs") / job.cfg.name)
    if dry_run:
        pipeline.check_out(out)
        pipeline.check_with_files(job.cfg)
        _print_estimate(job.cfg, out)
    else:
        results = pipeline.run(job.cfg, out, until=until)
        print_run(out)
        job.check_failures({result.stage.name: result.manifest.counts for result in results}, out)


def _print_estimate(cfg: RunConfig, out: Path) -> None:
    from cosfly.pipeline import runs
    from cosfly.runtime.console import duration

    rows = runs.estimate(cfg, out)
    cells = []
    for row in rows:
        if row.is_done:
            time = "done"
        elif row.seconds is None:
            time = "unknown"
        else:
            time = duration(row.seconds)
        cells.append((row.name, row.amount, time, runs.in_words(row.bytes)))
    title = f"Estimate for {out}; nothing is written"
    options.print_table(("stage", "to do", "time", "disk"), cells, title, is_answer=True)
    options.print_lines(runs.remarks(cfg, out, rows))


@options.app.command(epilog="cosfly show runs/first")
def show(run: Annotated[Path, Argument(metavar="RUN", help="A run directory.")]) -> None:
    """Show a run: its stages, what they kept, their disk space, and the settings that are not the defaults."""
    print_run(run, with_settings=True)


def print_run(run: Path, *, with_settings: bool = False) -> None:
    """Print the stages of a run, what to do next, and what to open."""
    from cosfly.formats.inspection import how_to_decide
    from cosfly.pipeline.runs import PAGES, summarize
    from cosfly.pipeline.runs import in_words as size
    from cosfly.pipeline.settings import changed
    from cosfly.runtime.json_io import dump_json

    summary = summarize(run)
    rows = []
    for stage in summary.stages:
        seconds = "" if stage.seconds is None else f"{stage.seconds:.1f}"
        disk = size(stage.size_bytes) if stage.size_bytes else ""
        rows.append((stage.name, stage.state, stage.items, seconds, disk))
    total = sum(stage.size_bytes for stage in summary.stages)
    typer.echo(f"{run}: {summary.cfg.name}, {summary.progress} stages complete, {size(total)}")
    head = ("stage", "state", "items", "seconds", "on disk")
    options.print_table(head, rows, left=("state", "items"), is_answer=True, **PLAIN)
    lines = []
    differing = changed(summary.cfg) if with_settings else []
    if differing:
        lines.append("settings that differ from the defaults:")
        lines += [f"  {setting.name} = {dump_json(setting.value)}" for setting in differing]
    for folder, count in summary.waiting().items():
        lines.append(f"review   {count} tracks wait for a decision: {how_to_decide(Path(os.path.relpath(folder)))}")
    if not summary.is_complete:
        lines.append(f"resume   cosfly run {os.path.relpath(run)}")
    if pages := [os.path.relpath(run / name) for name in PAGES if (run / name).exists()]:  # towns have their own
        lines.append(f"open     {', '.join(pages)}")
    options.print_lines(lines)


@command("cosfly reproduce runs/first", "*", f"{WORKERS}")
def reproduce(
    job: Job,
    config: Annotated[
        Path, Argument(metavar="[RUN]", help="Run directory; with several towns, that of one town.")
    ] = Path(),
    out: Annotated[Path | None, Option(show_default="RUN/reproduce", help="Folder for the page.")] = None,
    pedestrians: Annotated[int, Option(min=1, help="Number of pedestrians for the measurement of planners.")] = 20,
) -> None:
    """Compare the paper's tables and figures with those of one run, on one page. Repeat the command to resume."""
    out = out or config / "reproduce"
    typer.echo(job.call("cosfly.pipeline.reproduce", job.cfg, config, out, pedestrians=pedestrians))


options.add_group("config", "Check and show configurations.")


@command("cosfly config check quickstart", "*")
def check(job: Job, config: Annotated[Path, Argument(help="YAML file, or the name of a shipped one.")]) -> None:
    """Check a configuration without running it: report all problems, also missing files and licences."""
    from cosfly.pipeline.run import check_with_files
    from cosfly.pipeline.runs import caveats

    check_with_files(job.cfg)
    lines = caveats(job.cfg)
    verdict = "valid; read the remarks above" if lines else "ok"
    options.print_lines([*lines, f"{config}: {verdict}"])


@options.groups["config"].command("show", epilog="cosfly config show --describe plan")
def config_show(
    config: Annotated[str | None, Argument(help="YAML file, a shipped name, or a section; none: defaults.")] = None,
    section: Annotated[str | None, Argument(help="Show only this section or setting, such as plan.muco.")] = None,
    overrides: Annotated[list[str] | None, Option("--set", "-s", metavar="A.B=C", help="Set a setting.")] = None,
    describe: Annotated[bool, Option("--describe", help="Explain each setting and its possible values.")] = False,
    changed: Annotated[bool, Option("--changed", help="Show only settings that differ from the defaults.")] = False,
) -> None:
    """Print the resolved configuration: every setting with its value."""
    import yaml

    from cosfly.pipeline import settings

    if section is None and config is not None and _is_section(config):
        section = config
        config = None
    cfg = options.resolve(None if config is None else Path(config), overrides)
    explained = (settings.changed if changed else settings.explain)(cfg, section)
    if describe:
        options.print_lines(settings.as_lines(explained))
    else:
        values = settings.nested(explained)
        typer.echo(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), nl=False)


def _is_section(text: str) -> bool:
    """Return whether the argument of `config show` names a section and not a configuration."""
    from cosfly.pipeline.settings import RunConfig
    from cosfly.runtime.config import shipped

    path = Path(text)
    if path.is_file() or (path / "run.yaml").exists() or shipped(f"{path.name}.yaml").exists():
        return False
    if text.partition(".")[0] in RunConfig.model_fields:  # also where a folder has this name
        return True
    return not (path.exists() or path.suffix in (".yaml", ".yml"))


@options.app.command(epilog="cosfly doctor")
def doctor(out: Annotated[Path, Option(help="Folder that runs will be written to.")] = Path("runs")) -> None:
    """Check what works on this machine: GL, packages, disk. Exit with 1 if the main job cannot run."""
    from cosfly.pipeline.doctor import examine

    options.print_checks(examine(out), is_answer=True)


options.add_group("study", "Compare depth formats, weathers and levels of zoom on the same frames and trajectories.")


@command("cosfly study depth --data render --out depth")
def depth(
    job: Job,
    out: Annotated[Path, Option(help="Folder for depth_study.json, depth_study.md and depth_study.png.")],
    data: options.Trees = None,
    frame: Annotated[Path | None, Option(help="Frame folder in the tree.")] = None,
) -> None:
    """Compare ways to store the depth of one frame: errors, entropy, edges and size."""
    from cosfly.viz.gallery import best_frame, frame_in

    tree = job.tree(data)
    job.call("cosfly.studies.depth", frame_in(tree, frame) if frame else best_frame(tree, "depth.npy"), out)
    typer.echo(out / "depth_study.md")


@command("cosfly study weather --map boxes_3d.json --traces drone_trace.json --out weather", "render", "seed")
def weather(
    job: Job,
    map_: options.Map,
    traces: options.Traces,
    out: Annotated[Path, Option(help="Folder for weather_gallery.jpg and weather_sheet.jpg.")],
) -> None:
    """Draw one view under every weather and time of day: nine pictures, and a sheet of all."""
    for path in job.call("cosfly.studies.weather", job.cfg.render, map_, traces, out):
        typer.echo(path)


@command("cosfly study zoom --map boxes.json --simplified map.json --traces traces.json --out zoom", "render", STAGE)
def zoom(
    job: Job,
    map_: options.Map,
    simplified: options.Simplified,
    traces: options.Traces,
    out: options.Out,
    every: Annotated[int, Option(min=1, max=100, help="Draw every n-th frame.")] = 2,
) -> None:
    """Compare levels of zoom on the same trajectories: target size, visibility, track quality; optical and digital."""
    from cosfly.runtime.json_io import read_object
    from cosfly.studies import zoom

    cfg = job.cfg.render
    product = job.call("cosfly.studies.zoom", cfg, map_, simplified, traces, out, every=every)
    table = zoom.text_table(read_object(product, what="zoom study"))
    options.print_table(table.columns, table.rows, table.title)
    job.finish(product, zoom.tree_of(out, max(cfg.fovs_deg)))
