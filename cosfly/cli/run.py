"""The commands `cosfly run`, `show`, `list`, `bench`, `reproduce`, `doctor` and `config ...`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import WORKERS, Job, takes

if TYPE_CHECKING:
    from cosfly.pipeline.run import StageResult
    from cosfly.pipeline.settings import RunConfig

app = typer.Typer()
CONFIG = "YAML file, a shipped one (quickstart, showcase, diverse, learning, simworld, delft), or a run directory."
Until = Literal["maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release"]
PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)}


@app.command(epilog="cosfly run quickstart --out runs/first")
@takes("*", f"seed {WORKERS} resume")
def run(
    job: Job,
    config: Annotated[Path, Argument(help=CONFIG)],
    out: Annotated[Path | None, Option(show_default="runs/<name>", help="Run directory.")] = None,
    dry_run: Annotated[bool, Option("--dry-run", help="Estimate time and disk by stage and write nothing.")] = False,
    until: Annotated[Until, Option(help="Last stage to run.")] = "release",
) -> None:
    """Make a data set from a configuration: run all stages in order. Repeat the command to resume."""
    from cosfly.pipeline import run as pipeline

    out = out or pipeline.begun_run(config, job.cfg) or Path("runs") / job.cfg.name
    if dry_run:
        pipeline.check_out(out)
        pipeline.check_with_files(job.cfg)
        return _print_estimate(job.cfg, out)
    results = pipeline.run(job.cfg, out, resume=job.resume, until=until)
    print_results(results, out)
    job.check_failures({r.stage.name: r.manifest.counts for r in results}, out)


def _print_estimate(cfg: RunConfig, out: Path) -> None:
    from caption.run.progress import duration
    from cosfly.pipeline import estimate
    from cosfly.runtime.console import answer_console

    rows, cells = estimate.estimate(cfg, out), []
    for row in rows:
        time = "done" if row.is_done else "unknown" if row.seconds is None else duration(row.seconds)
        cells.append((row.name, row.amount, time, estimate.in_words(row.bytes)))
    title = f"What {out} would take; nothing is written"
    options.print_table(answer_console, ("stage", "to do", "time", "disk"), cells, title=title)
    for line in estimate.remarks(cfg, out, rows):
        answer_console.print(line, soft_wrap=True)


def print_results(results: list[StageResult], out: Path) -> None:
    """Print the closing table of a run, and what to look at."""
    from cosfly.runtime.console import console

    rows = []
    for result in results:
        counts = result.manifest.counts
        lost = [", ".join(f"{k} {v}" for k, v in reasons.items()) or "-" for reasons in (counts.dropped, counts.failed)]
        seconds = "before" if result.was_complete else f"{result.manifest.seconds:.1f}"
        rows.append((result.stage.name, f"{counts.kept} of {counts.input}", *lost, seconds))
    head = ("stage", "kept", "dropped", "failed", "seconds")
    options.print_table(console, head, rows, title=f"What was made in {out}", left=("dropped", "failed"))
    made = (os.path.relpath(result.stage.product, out) for result in results)
    console.print(f"  made     {', '.join(made)}", soft_wrap=True)  # a path that a table folds cannot be copied
    pages = [out / name for name in ("viewer.html", "contact_sheet.png", "inspect/report.html")]
    if is_there := [os.path.relpath(page) for page in pages if page.exists()]:  # several towns have their own
        console.print(f"  open     {', '.join(is_there)}", soft_wrap=True)


@app.command(epilog="cosfly show runs/first")
def show(run: Annotated[Path, Argument(metavar="RUN", help="A run directory.")]) -> None:
    """Show a run: its stages, what they kept, their disk space, and the settings that are not the defaults."""
    from cosfly.formats.inspection import how_to_decide
    from cosfly.pipeline.estimate import in_words as size
    from cosfly.pipeline.runs import summarize
    from cosfly.runtime.console import answer_console
    from cosfly.runtime.json_io import dump_json

    seen = summarize(run)
    at_work = ", running now" if seen.is_at_work else ""
    complete = f"{seen.num_complete} of {len(seen.stages)} stages complete"
    answer_console.print(f"{run}: {seen.cfg.name}, {complete}, {size(seen.size_bytes)}{at_work}")
    rows = []
    for one in seen.stages:
        seconds, disk = "" if one.seconds is None else f"{one.seconds:.1f}", one.size_bytes
        tally = "" if one.tally is None else str(one.tally)
        rows.append((one.name, one.state, tally, seconds, size(disk) if disk else ""))
    head = ("stage", "state", "items", "seconds", "on disk")
    options.print_table(answer_console, head, rows, left=("state", "items"), **PLAIN)
    lines = ["settings that are not the defaults:"] if seen.differing else []
    lines += [f"  {setting.name} = {dump_json(setting.value)}" for setting in seen.differing]
    lines += [f"look at  {os.path.relpath(path)}" for path in seen.to_look_at]
    for folder, count in seen.waiting().items():
        lines.append(f"review   {count} tracks wait for a decision: {how_to_decide(Path(os.path.relpath(folder)))}")
    if seen.num_complete < len(seen.stages) and not seen.is_at_work:
        lines.append(f"resume   cosfly run {os.path.relpath(run)}")
    for line in lines:
        answer_console.print(line, soft_wrap=True)


@app.command("list", epilog="cosfly list runs")
def list_runs(root: Annotated[Path, Argument(metavar="[DIR]", help="Folder with runs.")] = Path("runs")) -> None:
    """List the runs in a folder: their progress, tracks, captions and size."""
    from cosfly.pipeline.estimate import in_words as size
    from cosfly.pipeline.runs import summaries
    from cosfly.runtime.console import answer_console
    from cosfly.runtime.errors import CosflyError

    rows, errors = [], []
    for seen in summaries(root):
        if isinstance(seen, CosflyError):
            errors.append(seen)
            continue
        counts = (str(seen.tally(stage).kept or "") for stage in ("render", "caption"))
        source = f"{len(seen.cfg.towns)} towns" if seen.cfg.towns else seen.cfg.maps.source
        stages, state = f"{seen.num_complete} of {len(seen.stages)}", "running" if seen.is_at_work else ""
        rows.append((os.path.relpath(seen.path, root), source, stages, *counts, size(seen.size_bytes), state))
    head = ("run", "map", "stages", "tracks", "captions", "on disk", "")
    if rows:
        options.print_table(answer_console, head, rows, left=("map", "stages", ""), **PLAIN)
    else:
        answer_console.print(f"there are no runs in {root}")
    for error in errors:
        answer_console.print(f"not readable: {error}", soft_wrap=True)


@app.command(epilog="cosfly bench runs/first --stage render --workers 1,2 --out bench")
@takes("*", "engine address")
def bench(
    job: Job,
    config: Annotated[Path, Argument(metavar="RUN", help="Run directory that is finished up to the stage.")],
    out: Annotated[Path, Option(help="New folder for bench.json.")],
    stage: Annotated[str, Option(help="Stage to measure.")] = "render",
    workers: Annotated[str, Option(help="Numbers of worker processes, such as 1,2,4.")] = "1,2,4",
) -> None:
    """Measure a stage with several numbers of workers: the paper's tables of scaling and reliability."""
    from rich.box import SIMPLE_HEAD

    from cosfly.pipeline import bench as benchmark
    from cosfly.runtime.console import console

    counts = [int(word) if word.isdecimal() else 0 for word in workers.split(",")]
    if min(counts) < 1:
        raise typer.BadParameter("give whole numbers from 1 up, separated by commas", param_hint="'--workers'")
    measured = benchmark.run(job.cfg, config, out, stage, counts)
    for title, (head, *rows) in benchmark.tables(measured).items():  # the widest fits eighty columns
        options.print_table(console, head, rows, title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    typer.echo(out)


@app.command(epilog="cosfly reproduce runs/first")
@takes("*", f"{WORKERS} resume")
def reproduce(
    job: Job,
    config: Annotated[Path, Argument(metavar="[RUN]", help="Run directory; of several towns, that of one.")] = Path(),
    out: Annotated[Path | None, Option(show_default="RUN/reproduce", help="Folder for the page.")] = None,
    pedestrians: Annotated[int, Option(min=1, help="Number that planners are measured on.")] = 20,
) -> None:
    """Compare the paper's tables and figures with those of one run, on one page. Repeat the command to resume."""
    from cosfly.pipeline import reproduce as reproduction

    out = out or config / "reproduce"
    typer.echo(reproduction.run(job.cfg, config, out, pedestrians=pedestrians, resume=job.resume))


config_app = typer.Typer(no_args_is_help=True, help="Check and show configurations.")
app.add_typer(config_app, name="config")


@config_app.command("check", epilog="cosfly config check quickstart")
@takes("*")
def config_check(job: Job, config: Annotated[Path, Argument(help="YAML file, or the name of a shipped one.")]) -> None:
    """Check a configuration without running it: report all problems, also missing files and licences."""
    from cosfly.pipeline import estimate
    from cosfly.pipeline import run as pipeline

    pipeline.check_with_files(job.cfg)
    for line in estimate.caveats(job.cfg):
        typer.echo(line)
    typer.echo(f"{config}: ok")


@config_app.command("show", epilog="cosfly config show --describe plan")
def config_show(
    config: Annotated[str | None, Argument(help="YAML file, a shipped name, or a section; none: defaults.")] = None,
    section: Annotated[str | None, Argument(help="Only this section or setting, such as plan.muco.")] = None,
    overrides: Annotated[list[str] | None, Option("--set", "-s", metavar="A.B=C", help="Set a setting.")] = None,
    describe: Annotated[bool, Option("--describe", help="Explain each setting, and what it may be.")] = False,
    changed: Annotated[bool, Option("--changed", help="Only settings that are not the defaults.")] = False,
) -> None:
    """Print the resolved configuration: every setting with its value."""
    import yaml

    from cosfly.pipeline import settings_guide
    from cosfly.runtime.config import shipped
    from cosfly.runtime.console import answer_console

    if section is None and config is not None:
        path = Path(config)
        if not path.exists() and path.suffix not in (".yaml", ".yml") and not shipped(f"{path.name}.yaml").exists():
            config, section = None, config
    cfg = options.resolve(None if config is None else Path(config), overrides)
    explained = (settings_guide.changed if changed else settings_guide.explain)(cfg, section)
    if describe:
        for line in settings_guide.as_lines(explained):
            answer_console.print(line)
    else:
        values = settings_guide.nested(explained)
        typer.echo(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), nl=False)


@app.command(epilog="cosfly doctor")
def doctor(out: Annotated[Path, Option(help="Folder that runs will be written to.")] = Path("runs")) -> None:
    """Check what works on this machine: GL, GPU, packages, disk. Exit with 1 if the main job cannot run."""
    from cosfly.pipeline import doctor as examination
    from cosfly.runtime.console import answer_console

    options.print_checks(examination.examine(out), answer_console)
