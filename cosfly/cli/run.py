"""The command `cosfly run`, what looks at runs, `cosfly config ...` and `cosfly doctor`."""

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
CONFIG = "YAML file, quickstart, showcase, diverse, learning, simworld or delft, or a run directory to continue."
Until = Literal["maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release"]
PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)}


@app.command()
@takes("seed", *WORKERS, "resume")
def run(
    job: Job,
    config: Annotated[Path, Argument(help=CONFIG)],
    out: Annotated[Path | None, Option(show_default="runs/<name>, or that of the run.yaml", help="Run folder.")] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Say what it would take (time and disk by stage) and write nothing.")
    ] = False,
    until: Annotated[Until, Option(help="The last stage that is done.")] = "release",
) -> None:
    """Make a data set from a configuration: all stages in order. Run it again to continue."""
    from cosfly.pipeline import run as pipeline

    if (config / "run.yaml").is_file():
        out = out or config
    elif _is_begun(config, job.cfg):
        out = out or config.parent  # the settings of that run: it goes on
    out = out or Path("runs") / job.cfg.name
    if dry_run:
        pipeline.check_out(out)
        pipeline.check_with_files(job.cfg)
        return _tell_estimate(job.cfg, out)
    results = pipeline.run(job.cfg, out, resume=job.resume, until=until)
    _closing_table(results, out)
    job.check_failures({r.stage.name: r.manifest.counts for r in results}, out)


def _is_begun(config: Path, cfg: RunConfig) -> bool:
    """Return whether stages of a run, or of its towns, stand beside its settings."""
    places = [config.parent, *(config.parent / town for town in cfg.towns)]
    return config.name == "run.yaml" and any(any(place.glob("*/stage.json")) for place in places)


def _tell_estimate(cfg: RunConfig, out: Path) -> None:
    from caption.run.progress import duration
    from cosfly.pipeline import estimate
    from cosfly.runtime.console import answer_console

    rows, told = estimate.estimate(cfg, out), []
    for row in rows:
        time = "done" if row.is_done else "unknown" if row.seconds is None else duration(row.seconds)
        told.append((row.name, f"{row.count:,} {estimate.UNITS[row.stage]}", time, estimate.in_words(row.bytes)))
    title = f"What {out} would take; nothing is written"
    options.tell_table(answer_console, ("stage", "to do", "time", "disk"), told, title=title)
    for line in estimate.remarks(cfg, out, rows):
        answer_console.print(line, soft_wrap=True)


def _closing_table(results: list[StageResult], out: Path) -> None:
    from cosfly.runtime.console import console

    rows = []
    for result in results:
        counts = result.manifest.counts
        lost = [", ".join(f"{k} {v}" for k, v in reasons.items()) or "-" for reasons in (counts.dropped, counts.failed)]
        seconds = "before" if result.was_complete else f"{result.manifest.seconds:.1f}"
        rows.append((result.stage.name, f"{counts.kept} of {counts.input}", *lost, seconds))
    head = ("stage", "kept", "dropped", "failed", "seconds")
    options.tell_table(console, head, rows, title=f"What was made in {out}", left=("dropped", "failed"))
    made = (os.path.relpath(result.stage.product, out) for result in results)
    console.print(f"  made     {', '.join(made)}", soft_wrap=True)  # a path that a table folds cannot be copied
    pages = [out / name for name in ("viewer.html", "contact_sheet.png", "inspect/report.html")]
    if is_there := [os.path.relpath(page) for page in pages if page.exists()]:  # several towns have their own
        console.print(f"  open     {', '.join(is_there)}", soft_wrap=True)


@app.command()
def show(run: Annotated[Path, Argument(metavar="RUN", help="A run folder.")]) -> None:
    """Show a run: its stages, what they kept and take on the disk, the settings that are not the defaults."""
    from cosfly.formats.review import how_to_decide
    from cosfly.pipeline.estimate import in_words as size
    from cosfly.pipeline.runs import look
    from cosfly.runtime.console import answer_console
    from cosfly.runtime.json_io import dump_json

    seen = look(run)
    at_work = ", at work now" if seen.is_at_work else ""
    complete = f"{seen.num_complete} of {len(seen.stages)} stages complete"
    answer_console.print(f"{run}: {seen.cfg.name}, {complete}, {size(seen.size_bytes)}{at_work}")
    rows = []
    for one in seen.stages:
        seconds = "" if one.seconds is None else f"{one.seconds:.1f}"
        rows.append(
            (
                one.name,
                one.state,
                "" if one.tally is None else str(one.tally),
                seconds,
                size(num) if (num := one.size_bytes) else "",
            )
        )
    head = ("stage", "state", "items", "seconds", "on disk")
    options.tell_table(answer_console, head, rows, left=("state", "items"), **PLAIN)
    lines = ["settings that are not the defaults:"] if seen.differing else []
    lines += [f"  {setting.name} = {dump_json(setting.value)}" for setting in seen.differing]
    lines += [f"look at  {os.path.relpath(path)}" for path in seen.to_look_at]
    for folder, count in seen.waiting().items():
        lines.append(f"review   {count} flights wait for a person: {how_to_decide(Path(os.path.relpath(folder)))}")
    if seen.num_complete < len(seen.stages) and not seen.is_at_work:
        lines.append(f"continue  cosfly run {os.path.relpath(run)}")
    for line in lines:
        answer_console.print(line, soft_wrap=True)


@app.command("list")
def list_runs(root: Annotated[Path, Argument(metavar="[DIR]", help="Where runs are.")] = Path("runs")) -> None:
    """List the runs in a folder: how far they are, flights, captions, size."""
    from cosfly.pipeline.estimate import in_words as size
    from cosfly.pipeline.runs import looks
    from cosfly.runtime.console import answer_console
    from cosfly.runtime.errors import CosflyError

    rows, errors = [], []
    for seen in looks(root):
        if isinstance(seen, CosflyError):
            errors.append(seen)
            continue
        kept = [seen.tally(of).kept for of in ("render", "caption")]
        source = f"{len(seen.cfg.towns)} towns" if seen.cfg.towns else seen.cfg.maps.source
        stages, state = f"{seen.num_complete} of {len(seen.stages)}", "at work" if seen.is_at_work else ""
        counts = (str(count or "") for count in kept)
        rows.append((os.path.relpath(seen.path, root), source, stages, *counts, size(seen.size_bytes), state))
    head = ("run", "map", "stages", "flights", "captions", "on disk", "")
    if rows:
        options.tell_table(answer_console, head, rows, left=("map", "stages", ""), **PLAIN)
    else:
        answer_console.print(f"no runs in {root}")
    for error in errors:
        answer_console.print(f"not readable: {error}", soft_wrap=True)


@app.command()
@takes("engine", "address")
def bench(
    job: Job,
    config: Annotated[Path, Argument(metavar="RUN", help="Folder of a run that is finished up to the stage.")],
    out: Annotated[Path, Option(help="New folder for bench.json.")],
    stage: Annotated[str, Option(help="Stage to measure.")] = "render",
    workers: Annotated[str, Option(help="Counts of worker processes, as in 1,2,4.")] = "1,2,4",
) -> None:
    """Measure a stage with one worker process and more: the paper's tables of scaling and of reliability."""
    from rich.box import SIMPLE_HEAD

    from cosfly.pipeline import bench as benchmark
    from cosfly.runtime.console import console

    counts = [int(word) if word.isdecimal() else 0 for word in workers.split(",")]
    if min(counts) < 1:
        raise typer.BadParameter("whole numbers from 1 up, with commas between them", param_hint="'--workers'")
    measured = benchmark.run(job.cfg, config, out, stage, counts)
    for title, (head, *rows) in benchmark.tables(measured).items():  # eighty columns hold the widest
        options.tell_table(console, head, rows, title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    typer.echo(out)


@app.command()
@takes(*WORKERS, "resume")
def reproduce(
    job: Job,
    config: Annotated[Path, Argument(metavar="[RUN]", help="A run folder; of several towns, that of one.")] = Path(),
    out: Annotated[Path | None, Option(show_default="RUN/reproduce", help="Folder for the page.")] = None,
    walks: Annotated[int, Option(min=1, help="Walks on the run's map that planners are measured on.")] = 20,
) -> None:
    """The paper's tables and figures from one run, beside the paper's own, on one page. Run it again to continue."""
    from cosfly.pipeline import reproduce as reproduction

    out = out or config / "reproduce"
    typer.echo(reproduction.run(job.cfg, config, out, walks=walks, resume=job.resume))


config_app = typer.Typer(no_args_is_help=True, help="Look at configurations.")
app.add_typer(config_app, name="config")


@config_app.command("check")
@takes()
def config_check(job: Job, config: Annotated[Path, Argument(help="YAML file, or the name of one that ships.")]) -> None:
    """Check a configuration without running it: all problems at once, also missing files and licences."""
    from cosfly.pipeline import estimate
    from cosfly.pipeline import run as pipeline

    pipeline.check_with_files(job.cfg)
    for line in estimate.caveats(job.cfg):
        typer.echo(line)
    typer.echo(f"{config}: ok")


@config_app.command("show")
def config_show(
    config: Annotated[
        str | None, Argument(help="YAML file, or the name of one that ships; none: the defaults. Or a section.")
    ] = None,
    section: Annotated[str | None, Argument(help="Only this section or setting, for instance plan.muco.")] = None,
    overrides: Annotated[list[str] | None, Option("--set", "-s", metavar="A.B=C", help="Override one setting.")] = None,
    describe: Annotated[bool, Option("--describe", help="Say what each setting means and may be.")] = False,
    changed: Annotated[bool, Option("--changed", help="Only what is not the default.")] = False,
) -> None:
    """Print the resolved configuration: every setting with its value, and with --describe what it means."""
    import yaml

    from cosfly.pipeline import settings_guide
    from cosfly.runtime.console import answer_console

    if section is None and config is not None and _is_section(config):
        config, section = None, config
    cfg = options.resolve(None if config is None else Path(config), overrides)
    explained = (settings_guide.changed if changed else settings_guide.explain)(cfg, section)
    if describe:
        for line in settings_guide.as_lines(explained):
            answer_console.print(line)
    else:
        values = settings_guide.nested(explained)
        typer.echo(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), nl=False)


def _is_section(word: str) -> bool:
    """Return whether a word is no file and no configuration that ships."""
    from cosfly.runtime.config import shipped

    path = Path(word)
    return not path.exists() and path.suffix not in (".yaml", ".yml") and not shipped(f"{path.name}.yaml").exists()


@app.command()
def doctor(
    out: Annotated[Path, Option(help="Where runs will be written.")] = Path("runs"),
) -> None:
    """What works here: GL, GPU, packages, disk. Exit 1 if the main job cannot run."""
    from cosfly.pipeline import doctor as examination
    from cosfly.runtime.console import answer_console

    options.tell_checks(examination.examine(out), answer_console)
