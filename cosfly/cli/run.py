"""The command `cosfly run`, and what tells of this installation: `cosfly config ...` and `cosfly doctor`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosfly.cli import options

if TYPE_CHECKING:
    from cosfly.app.pipeline import StageResult
    from cosfly.app.runs import StageLook
    from cosfly.app.settings import RunConfig

app = typer.Typer()


@app.command()
def run(
    config: Annotated[
        Path,
        typer.Argument(
            help="YAML file, or the name of one that ships: quickstart, diverse, learning, simworld, delft; or a run folder, to continue."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Run folder; by default runs/<name>, or that of the run.yaml.")
    ] = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what it would take (time, disk, tokens by stage) and write nothing.")
    ] = False,
) -> None:
    """Make a data set from a configuration: all stages in order. Run it again, or with the run's folder, to continue."""
    from cosfly.app import pipeline

    is_folder = (config / "run.yaml").is_file()
    if is_folder:
        config = config / "run.yaml"
    cfg = options.resolve(config, overrides, {"seed": seed, "workers": workers})
    if out is None and (is_folder or _is_begun(config, cfg)):
        out = config.parent  # the settings of that run: it goes on
    out = out or Path("runs") / cfg.name
    if dry_run:
        pipeline.check_out(out)
        pipeline.check_with_files(cfg)
        return _tell_estimate(cfg, out)
    options.set_aside(out, repair)
    options.verify_first(
        verify, *sorted(path.parent for depth in ("*", "*/*") for path in out.glob(f"{depth}/manifest.json"))
    )
    results = pipeline.run(cfg, out, resume=resume)
    _closing_table(results, out)
    options.check_failures({r.stage.name: r.manifest.counts for r in results}, out, cfg)


def _is_begun(config: Path, cfg: RunConfig) -> bool:
    """Tell whether stages of a run, or of its towns, stand beside its settings."""
    places = [config.parent, *(config.parent / town for town in cfg.towns)]
    return config.name == "run.yaml" and any(any(place.glob("*/stage.json")) for place in places)


def _tell_estimate(cfg: RunConfig, out: Path) -> None:
    from rich.table import Table

    from caption.run.progress import duration
    from cosfly.app import estimate
    from cosfly.app.ahead import not_compiled
    from cosfly.work.console import answer_console

    rows = estimate.estimate(cfg, out, estimate.rates_near(out))
    table = Table(title=f"What {out} would take; nothing is written", title_justify="left")
    for column in ("stage", "to do", "time", "disk", "tokens in, out"):
        table.add_column(column, justify="left" if column == "stage" else "right", overflow="fold")
    for row in rows:
        unit = estimate.UNITS[row.name.rpartition("/")[2]]
        time = "done" if row.is_done else "unknown" if row.seconds is None else duration(row.seconds)
        tokens = (
            "unknown"
            if row.tokens is None
            else f"{row.tokens[0]:,.0f}, {row.tokens[1]:,.0f}"
            if any(row.tokens)
            else "0"
        )
        table.add_row(row.name, f"{row.count:,} {unit}", time, _size(row.bytes), tokens)
    answer_console.print(table)
    for basis in dict.fromkeys(row.basis for row in rows):
        by = dict.fromkeys(row.name.rpartition("/")[2] for row in rows if row.basis == basis)
        answer_console.print(f"figures of {', '.join(by)}: {basis}", soft_wrap=True)
    needed, free = sum(row.bytes for row in rows), estimate.free_bytes(out)
    answer_console.print(
        f"in all about {estimate.time_left(rows)}; {_size(needed)} of disk, {_size(free)} are free", soft_wrap=True
    )
    if not_compiled(cfg.plan.planner, {row.name.rpartition("/")[2] for row in rows if not row.is_done}):
        answer_console.print("and half a minute or more of compiling, once on this machine", soft_wrap=True)
    if any(row.tokens is None for row in rows):
        answer_console.print(f"tokens are {estimate.UNKNOWN_TOKENS}", soft_wrap=True)
    if more := estimate.more_walks(cfg, out):
        answer_console.print(
            f"{out} goes on with {more} more walks; what stands there is kept and not counted, but for the release, which is built anew",
            soft_wrap=True,
        )
    elif others := estimate.other_settings(cfg, out):
        answer_console.print(
            f"{out} was made with other settings ({', '.join(others[:6])}{' ...' if len(others) > 6 else ''}): its finished stages refuse "
            "them, and only a greater pedestrians.num_paths goes on there; choose another --out", soft_wrap=True,
        )  # fmt: skip
    if needed > free:
        answer_console.print(
            "there is not enough space for it: choose another --out, or fewer walks or pixels", soft_wrap=True
        )


def _closing_table(results: list[StageResult], out: Path) -> None:
    from rich.table import Table

    from cosfly.work.console import console

    table = Table(title=f"What was made in {out}", title_justify="left")
    for column in ("stage", "kept", "dropped", "failed", "seconds"):
        table.add_column(column, justify="right" if column in ("kept", "seconds") else "left", overflow="fold")
    for result in results:
        counts = result.manifest.counts
        dropped, failed = (
            ", ".join(f"{k} {v}" for k, v in reasons.items()) or "-" for reasons in (counts.dropped, counts.failed)
        )
        seconds = "before" if result.was_complete else f"{result.manifest.seconds:.1f}"
        table.add_row(result.stage.name, f"{counts.kept} of {counts.input}", dropped, failed, seconds)
    console.print(table)
    made = (os.path.relpath(result.stage.product, out) for result in results)
    console.print(f"  made     {', '.join(made)}", soft_wrap=True)  # a path that a table folds cannot be copied
    for name in ("contact_sheet.png", "preview.gif", "inspect/report.html", "release/dataset/README.md"):
        if (out / name).exists():  # of several towns only the release is here
            console.print(f"  look at  {os.path.relpath(out / name)}", soft_wrap=True)


@app.command()
def show(run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")]) -> None:
    """Show a run: its stages, what they kept and take on the disk, the settings that are not the defaults."""
    from rich.table import Table

    from cosfly.app.runs import look
    from cosfly.products.review import how_to_decide
    from cosfly.work.console import answer_console
    from cosfly.work.store import dump_json

    seen = look(run)
    at_work = ", at work now" if seen.is_at_work else ""
    answer_console.print(
        f"{run}: {seen.cfg.name}, {seen.num_complete} of {len(seen.stages)} stages complete, {_size(seen.size_bytes)}{at_work}"
    )
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("stage", "state", "items", "seconds", "on disk"):
        table.add_column(column, justify="right" if column in ("seconds", "on disk") else "left", overflow="fold")
    for stage in seen.stages:
        seconds = "" if stage.seconds is None else f"{stage.seconds:.1f}"
        size = _size(stage.size_bytes) if stage.size_bytes else ""
        table.add_row(stage.name, stage.state, _items_of(stage), seconds, size)
    answer_console.print(table)
    if seen.differing:
        answer_console.print("settings that are not the defaults:")
    for setting in seen.differing:
        answer_console.print(f"  {setting.name} = {dump_json(setting.value)}", soft_wrap=True)
    for path in seen.to_look_at:
        answer_console.print(f"look at  {os.path.relpath(path)}", soft_wrap=True)
    for folder, count in seen.waiting().items():
        answer_console.print(
            f"review   {count} flights wait for a person: {how_to_decide(Path(os.path.relpath(folder)))}",
            soft_wrap=True,
        )
    if seen.num_complete < len(seen.stages) and not seen.is_at_work:
        answer_console.print(f"continue  cosfly run {os.path.relpath(run)}", soft_wrap=True)


def _items_of(stage: StageLook) -> str:
    """Say what became of a stage's items; of one at work how far it is: `120 of 428 frames, about 3 min left`."""
    from caption.run.progress import duration

    if stage.far is None:
        return "" if stage.tally is None else str(stage.tally)
    what = "frames" if stage.far.unit == "steps" else "items"
    left = "" if stage.left_s is None else f", about {duration(stage.left_s)} left"
    return f"{stage.far.done:,} of {stage.far.total:,} {what}{left}"


@app.command("list")
def list_runs(root: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where runs are.")] = Path("runs")) -> None:
    """List the runs in a folder: how far they are, flights, captions, size."""
    from rich.table import Table

    from cosfly.app.runs import looks
    from cosfly.errors import CosflyError
    from cosfly.work.console import answer_console

    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("run", "map", "stages", "flights", "captions", "on disk", ""):
        table.add_column(
            column, justify="right" if column in ("flights", "captions", "on disk") else "left", overflow="fold"
        )
    errors = []
    for seen in looks(root):
        if isinstance(seen, CosflyError):
            errors.append(seen)
            continue
        kept = {
            name: sum(stage.tally.kept for stage in seen.stages if stage.name.endswith(name) and stage.tally)
            for name in ("render", "caption")
        }
        source = f"{len(seen.cfg.towns)} towns" if seen.cfg.towns else seen.cfg.maps.source
        stages = f"{seen.num_complete} of {len(seen.stages)}"
        state = "at work" if seen.is_at_work else ""
        table.add_row(
            os.path.relpath(seen.path, root),
            source,
            stages,
            *(str(count or "") for count in kept.values()),
            _size(seen.size_bytes),
            state,
        )
    answer_console.print(table if table.row_count else f"no runs in {root}")
    for error in errors:
        answer_console.print(f"not readable: {error}", soft_wrap=True)


@app.command()
def bench(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run that is finished up to the stage.")],
    out: Annotated[Path, typer.Option(help="New folder for bench.json and bench.md.")],
    stage: Annotated[str, typer.Option(help="Stage to measure.")] = "render",
    workers: Annotated[str, typer.Option(help="Counts of worker processes, as in 1,2,4.")] = "1,2,4",
    overrides: options.Overrides = None,
) -> None:
    """Measure a stage with one worker process and more: the paper's tables of scaling and of reliability."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from cosfly.app import bench as benchmark
    from cosfly.work.console import console

    counts = [int(word) if word.isdecimal() else 0 for word in workers.split(",")]
    if min(counts) < 1:
        raise typer.BadParameter("whole numbers from 1 up, with commas between them", param_hint="'--workers'")
    measured = benchmark.run(options.resolve(run / "run.yaml", overrides), run, out, stage, counts)
    for title, head, rows in benchmark.tables(measured):
        # Eighty columns hold the widest.
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=0, show_edge=False)
        for number, name in enumerate(head):
            table.add_column(name, justify="right" if number else "left")
        for row in rows:
            table.add_row(*row)
        console.print(table)
    typer.echo(out)


def _size(size_bytes: float) -> str:
    return f"{size_bytes / 1e9:.2f} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.1f} MB"


config_app = typer.Typer(no_args_is_help=True, help="Look at configurations.")
app.add_typer(config_app, name="config")


@config_app.command("check")
def config_check(
    config: Annotated[Path, typer.Argument(help="YAML file, or the name of one that ships.")],
    overrides: options.Overrides = None,
) -> None:
    """Check a configuration without running it; reports all problems at once, also a map's file that is not there and a licence that nobody names."""
    from cosfly.app import pipeline

    pipeline.check_with_files(options.resolve(config, overrides))
    typer.echo(f"{config}: ok")


@config_app.command("show")
def config_show(
    config: Annotated[
        str | None,
        typer.Argument(help="YAML file, or the name of one that ships; none: the defaults. Or a section."),
    ] = None,
    section: Annotated[str | None, typer.Argument(help="Only this section or setting, for instance plan.muco.")] = None,
    overrides: options.Overrides = None,
    describe: Annotated[bool, typer.Option("--describe", help="Say what each setting means and may be.")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="With --describe: as a page.")] = False,
    changed: Annotated[bool, typer.Option("--changed", help="Only what is not the default.")] = False,
    find: Annotated[
        list[str] | None,
        typer.Option(
            "--find", metavar="WORD", help="Only settings whose name, value or meaning has this word; may be repeated."
        ),
    ] = None,
) -> None:
    """Print the resolved configuration: every setting with its value, and with --describe or --find what it means."""
    import yaml

    from cosfly.app import settings_guide
    from cosfly.work.console import answer_console

    if section is None and config is not None and _is_section(config):
        config, section = None, config
    cfg = options.resolve(None if config is None else Path(config), overrides)
    explained = (settings_guide.changed if changed else settings_guide.explain)(cfg, section)
    if find:
        explained = settings_guide.with_words(explained, find)
    if markdown:
        typer.echo(settings_guide.as_page(explained), nl=False)
    elif describe or find:
        for line in settings_guide.as_lines(explained):
            answer_console.print(line)
    else:
        values = settings_guide.nested(explained)
        typer.echo(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), nl=False)


def _is_section(word: str) -> bool:
    """Tell whether a word is no file and no configuration that ships."""
    from cosfly.work.config import shipped

    path = Path(word)
    return not path.exists() and path.suffix not in (".yaml", ".yml") and not shipped(f"{path.name}.yaml").exists()


@config_app.command("schema")
def config_schema() -> None:
    """Print the JSON schema of a configuration file, for editors that complete and check one."""
    from cosfly.app.settings import RunConfig
    from cosfly.work.store import dump_json

    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "cosfly run"}
    typer.echo(dump_json(RunConfig.model_json_schema() | dialect, indent=1))


@app.command()
def doctor(
    teacher: Annotated[str | None, typer.Option(help="URL of an endpoint to ask as well.")] = None,
    out: Annotated[Path, typer.Option(help="Where runs will be written.")] = Path("runs"),
) -> None:
    """What works here: GL, GPU, packages, endpoint, disk. Exit 1 if the main job cannot run."""
    from cosfly.app import doctor as examination
    from cosfly.work.console import answer_console

    options.tell_checks(examination.examine(out, teacher), answer_console)
