"""The command line: one command per stage. The only place with log handlers, tables on the terminal and exit codes.

Nothing heavy is imported before a command runs, so that `cosfly --help` is instant.
"""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosfly import __version__
from cosfly.errors import ConfigError, CosflyError, InputError, nearest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from caption.schema import CaptionConfig
    from cosfly.pipeline import RunConfig, StageResult

INTERRUPTED = 130  # the exit code of Ctrl-C: Typer makes it of a KeyboardInterrupt, without a word

app = typer.Typer(
    help="From a 3D map to a data set that teaches a vision-language model to follow a person from the air.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class ResumeMode(StrEnum):
    never = "never"
    if_same = "if-same"
    force = "force"


ConfigFile = Annotated[Path | None, typer.Option("--config", "-c", help="YAML file with the settings of a run.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", "-s", metavar="A.B=C", help="Override one setting; may be repeated.")
]
Seed = Annotated[int | None, typer.Option(help="Seed; every random choice derives from it.")]
Workers = Annotated[int | None, typer.Option(help="Worker processes; 0 takes one per core.")]
ResumeOption = Annotated[
    ResumeMode,
    typer.Option(
        help="What to do with a folder that holds work: refuse, continue if the settings are the same, or continue."
    ),
]
OutOption = Annotated[Path, typer.Option(help="Output folder.")]
MapOption = Annotated[Path, typer.Option("--map", help="Boxes: boxes_3d.json or step2_simplified.json.")]
DataOption = Annotated[
    Path | None, typer.Option("--data", help="Playback tree; by default that of the run folder one stands in.")
]


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


def _settings(
    config: Path | None, overrides: list[str] | None, seed: int | None = None, workers: int | None = None
) -> RunConfig:
    """Resolve the settings: defaults, file, --set, then the plain options."""
    from cosfly.config import load
    from cosfly.pipeline import RunConfig

    extra = [f"{name}={value}" for name, value in (("seed", seed), ("workers", workers)) if value is not None]
    return load(RunConfig, _config_path(config), [*(overrides or []), *extra])


def _config_path(config: Path | None) -> Path | None:
    """A path, or the bare name of a configuration that ships with cosfly."""
    from cosfly.config import shipped

    if config is not None and not config.exists() and config.suffix == "" and len(config.parts) == 1:
        packaged = shipped(f"{config}.yaml")
        if packaged.exists():
            return packaged
        names = sorted(path.stem for path in packaged.parent.glob("*.yaml") if path.stem != "glossary")
        raise ConfigError(
            f"no such configuration{nearest(str(config), names)}", where=config,
            expected=f"a YAML file, or one that ships: {', '.join(names)}",
        )  # fmt: skip
    return config


def _spread(cfg: RunConfig) -> int:
    from cosfly.pipeline import num_workers

    return num_workers(cfg.workers)


def _made(product: Path, out: Path, cfg: RunConfig) -> None:
    """Name a stage's product. Nothing kept, or too much failed, is an error: whoever calls the next stage must know."""
    from cosfly.store import read_json

    typer.echo(product)
    counts = read_json(out / "manifest.json")["counts"]
    if counts["kept"] == 0:
        got = {word: counts[word] for word in ("dropped", "failed") if counts[word]}
        raise InputError("nothing was kept", where=out, got=str(got), fix="see the records in that folder")
    _check_failures({out.name: counts}, out / "failures.jsonl", cfg)


def _check_failures(counts_by_stage: dict[str, dict], where: Path, cfg: RunConfig) -> None:
    """Exit 1, after everything was done, where more items failed than the settings accept."""
    failed = {stage: counts["failed"] for stage, counts in counts_by_stage.items() if counts["failed"]}
    if sum(sum(reasons.values()) for reasons in failed.values()) > cfg.max_failed:
        raise InputError(
            "some items failed; the others are done",
            where=where,
            got=str(failed),
            expected=f"at most {cfg.max_failed} (max_failed)",
            fix="mend what the records name and run the same command again: only the failed ones are done again",
        )


def _data(data: Path | None) -> Path:
    """The playback tree: given, or that of the run folder one stands in."""
    if data is not None:
        return data
    for candidate in (Path("render"), Path()):
        if (candidate / "manifest.json").exists() and candidate.resolve().name == "render":
            return candidate
    raise InputError(
        "no playback tree", where=Path.cwd(), got="no --data, and this is not a run folder", fix="give --data DIR"
    )


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

    cfg = _settings(config, overrides, seed, workers)
    out = out or Path("runs") / cfg.name
    results = pipeline.run(cfg, out, resume=resume.value)
    _closing_table(results, out)
    _check_failures({r.stage: r.manifest["counts"] for r in results}, out, cfg)


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

    cfg = _settings(config, [*(overrides or []), *([f"maps.source={source}"] if source else [])], seed)
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

    cfg = _settings(config, overrides)
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

    cfg = _settings(config, overrides, seed, workers)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    _made(cosfly.pedestrians.run(cfg.pedestrians, map_, out, seed=cfg.seed, roi=roi or cfg.roi, **spread), out, cfg)


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
    cfg = _settings(config, overrides, seed, workers)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    _made(cosfly.planners.run(cfg.plan, box_map, walks, folder, seed=cfg.seed, **spread), folder, cfg)


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

    cfg = _settings(config, overrides, seed, workers)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    product = cosfly.planners.compare.run(cfg.plan, map_, paths, out, seed=cfg.seed, **spread)
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

    cfg = _settings(config, overrides, seed, workers)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    _made(cosfly.render.run(cfg.render, map_, simplified, traces, out, seed=cfg.seed, **spread), out, cfg)


@app.command()
def gallery(
    out: Annotated[Path, typer.Option(help="Folder for contact_sheet.png and preview.gif.")],
    data: DataOption = None,
) -> None:
    """A contact sheet and a preview GIF of a playback tree."""
    from cosfly.gallery import contact_sheet, preview_gif

    tree = _data(data)
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

    cfg = _settings(config, overrides, None, workers)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    _made(cosfly.qc.run(cfg.inspect, traces, _data(data), out, **spread), out, cfg)


caption_app = typer.Typer(invoke_without_command=True, help="Step 7: Chain-of-Cause captions in English and Chinese.")
app.add_typer(caption_app, name="caption")


@caption_app.callback()
def caption(
    context: typer.Context,
    teacher: Annotated[
        str | None,
        typer.Option(help="rules, the URL of an OpenAI-compatible endpoint, or vllm:MODEL_DIR. [default: rules]"),
    ] = None,
    model: Annotated[str | None, typer.Option(help="Model name at the endpoint; by default its only one.")] = None,
    judge: Annotated[str | None, typer.Option(help="URL of an endpoint that judges conflicts.")] = None,
    keyframes: Annotated[
        bool | None, typer.Option("--keyframes", help="Only windows at which the label changes, plus a stride.")
    ] = None,
    data: DataOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; by default `caption` beside the playback tree.")
    ] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    workers: Workers = None,
    limit: Annotated[int | None, typer.Option(help="Caption at most this many windows; a later run goes on.")] = None,
    max_cost: Annotated[
        float | None, typer.Option(help="Stop before this cost is passed; prices: caption.budget.price_*.")
    ] = None,
    max_tokens: Annotated[int | None, typer.Option(help="Stop before this many tokens are passed, all runs.")] = None,
    plan_only: Annotated[
        bool, typer.Option("--plan", help="Ask about a few windows, print calls, tokens, time and cost, and stop.")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Ask only about the windows in quarantine.jsonl.")
    ] = False,
    check: Annotated[
        bool, typer.Option(help="Before the first request of a folder, try what the endpoint can do.")
    ] = True,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Step 7: ask a teacher for the reason of every manoeuvre, prove it against the geometry, repair, translate."""
    if context.invoked_subcommand is not None:
        return
    import caption.stage

    chosen: dict[str, Any] = {"caption.teacher": teacher, "caption.endpoint.model": model}
    chosen |= {"caption.judge.url": judge, "caption.window.keyframes": keyframes, "caption.limit": limit}
    chosen |= {"caption.budget.max_cost": max_cost, "caption.budget.max_tokens": max_tokens}
    extra = [f"{key}={value}" for key, value in chosen.items() if value is not None]
    cfg = _settings(config, [*(overrides or []), *extra], seed, workers)
    tree = _data(data)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    target = out or tree.resolve().parent / "caption"
    if check and cfg.caption.teacher.startswith("http") and not (target / "answers.jsonl").exists():
        _examine_endpoint(cfg.caption.teacher, cfg.caption)
    if plan_only:
        from caption.plan import make_plan

        planned = make_plan(cfg.caption, tree, target, seed=cfg.seed, resume=resume.value)
        _print_rows("What this run will take", planned.rows())
        return
    _made(caption.stage.run(cfg.caption, tree, target, seed=cfg.seed, retry_failed=retry_failed, **spread), target, cfg)


@caption_app.command("doctor")
def caption_doctor(
    url: Annotated[str, typer.Argument(help="URL of an OpenAI-compatible endpoint.")],
    model: Annotated[str | None, typer.Option(help="Model name at the endpoint; by default its only one.")] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Try what an endpoint can do: images, schema, thinking, context length. Exit 1 if captioning cannot work."""
    extra = [f"caption.endpoint.model={model}"] if model is not None else []
    _examine_endpoint(url, _settings(config, [*(overrides or []), *extra]).caption)


def _examine_endpoint(url: str, cfg: CaptionConfig) -> None:
    """Print a table of what works; exit 1 when the endpoint is unusable."""
    from rich.markup import escape

    from caption.doctor import examine_endpoint

    findings = examine_endpoint(url, cfg)
    color = {"ok": "green", "warning": "yellow", "unusable": "red"}
    rows = [(f.name, f"[{color[f.state]}]{f.state}[/]", escape(f.detail)) for f in findings]
    _print_rows("What the endpoint can do", rows)
    if any(finding.state == "unusable" for finding in findings):
        raise typer.Exit(1)


def _print_rows(title: str, rows: Sequence[Sequence[str]]) -> None:
    from rich.table import Table

    from cosfly.console import console

    table = Table(title=title, title_justify="left", show_header=False, box=None)
    for row in rows:
        table.add_row(*row)
    console.print(table)


@caption_app.command("judge-check")
def caption_judge_check(
    url: Annotated[str, typer.Argument(help="OpenAI-compatible endpoint of the judge.")],
    model: Annotated[str | None, typer.Option(help="Model name at the endpoint; by default its only one.")] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Measure a judge on a small gold set: agreement, position bias, unparsable answers."""
    import asyncio

    from caption.judge import check_judge, judge_check_table
    from caption.judge_gold import read_gold
    from cosfly.console import console

    chosen = {"caption.judge.url": url, "caption.judge.model": model}
    extra = [f"{key}={value}" for key, value in chosen.items() if value is not None]
    cfg = _settings(config, [*(overrides or []), *extra])
    console.print(judge_check_table(asyncio.run(check_judge(cfg.caption.judge, read_gold(), cfg.seed))))


@caption_app.command("compare-strategies")
def caption_compare_strategies(
    out: Annotated[Path, typer.Option(help="Folder for compare_strategies.json and the answers.")],
    data: DataOption = None,
    teacher: Annotated[str | None, typer.Option(help="rules, or the URL of an endpoint. [default: rules]")] = None,
    model: Annotated[str | None, typer.Option(help="Model name at the endpoint; by default its only one.")] = None,
    conflicts: Annotated[int, typer.Option(min=1, help="Stop looking for conflicts after so many.")] = 50,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
) -> None:
    """Compare hint, multi_sample, anchored and cascade on the same conflicts: consistency, text, asks, tokens."""
    from caption import compare
    from cosfly.console import console

    chosen = {"caption.teacher": teacher, "caption.endpoint.model": model}
    extra = [f"{key}={value}" for key, value in chosen.items() if value is not None]
    cfg = _settings(config, [*(overrides or []), *extra], seed)
    comparisons = compare.run(cfg.caption, _data(data), out, seed=cfg.seed, conflicts=conflicts)
    console.print(compare.comparison_table(comparisons))


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

    cfg = _settings(config, overrides, None, workers)
    spread: Any = {"workers": _spread(cfg), "resume": resume.value}
    _made(release.package.run(cfg.release, _data(data), captions, inspected, out, **spread), out, cfg)


@release_app.command("verify")
def release_verify(folder: Annotated[Path, typer.Argument(help="Release folder.")]) -> None:
    """Check structure, checksums, every number of the card, and re-projection. Exit 1 if anything is wrong."""
    import release.validate

    report = release.validate.verify(folder)
    typer.echo(str(report))
    if not report.is_ok:
        raise typer.Exit(1)


# --- students ---------------------------------------------------------------------------------------------------------

distill_app = typer.Typer(no_args_is_help=True, help="Teach a small model: training set, LoRA, inference, evaluation.")
app.add_typer(distill_app, name="distill")


DatasetOption = Annotated[Path, typer.Option(help="Training set, the output of `distill prepare`.")]
ModelOption = Annotated[Path, typer.Option(help="Folder of the student's base model.")]


@distill_app.command("tiny-student")
def distill_tiny_student(out: OutOption, seed: Annotated[int, typer.Option(help="Seed of the weights.")] = 0) -> None:
    """Make a tiny, randomly initialised student, to try the way without weights."""
    import distill.student

    typer.echo(distill.student.make_tiny_student(out, seed))


@distill_app.command("prepare")
def distill_prepare(
    captions: Annotated[Path, typer.Option(help="captions.jsonl")],
    out: OutOption,
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Captions to a training set with splits that share no trajectory."""
    import distill.dataset

    cfg = _settings(config, overrides, seed)
    typer.echo(distill.dataset.run(cfg.distill.prepare, captions, _data(data), out, seed=cfg.seed, resume=resume.value))


@distill_app.command("train")
def distill_train(
    dataset: DatasetOption,
    model: ModelOption,
    out: OutOption,
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Train LoRA adapters; continues from its last checkpoint."""
    import distill.train

    cfg = _settings(config, overrides, seed)
    typer.echo(
        distill.train.run(cfg.distill.train, dataset, _data(data), model, out, seed=cfg.seed, resume=resume.value)
    )


@distill_app.command("infer")
def distill_infer(
    dataset: DatasetOption,
    model: ModelOption,
    out: OutOption,
    adapter: Annotated[Path | None, typer.Option(help="Adapter folder; none: the base model as it is.")] = None,
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Let the student answer a split; continues where it stopped."""
    import distill.infer

    cfg = _settings(config, overrides)
    typer.echo(
        distill.infer.run(cfg.distill.infer, dataset, _data(data), model, out, adapter=adapter, resume=resume.value)
    )


@distill_app.command("evaluate")
def distill_evaluate(
    dataset: DatasetOption,
    predictions: Annotated[Path, typer.Option(help="Predictions, the output of `distill infer`.")],
    out: OutOption,
    bertscore_model: Annotated[
        Path | None, typer.Option(help="Local model folder for BERTScore; none: not computed.")
    ] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    seed: Seed = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """JSON parse rate, decision accuracy beside the majority floor, BERTScore beside a shuffled floor."""
    import distill.evaluate

    cfg = _settings(config, overrides, seed)
    given: Any = {"bertscore_model": bertscore_model, "seed": cfg.seed, "resume": resume.value}
    typer.echo(distill.evaluate.run(cfg.distill.evaluate, predictions, dataset, out, **given))


# --- this installation ------------------------------------------------------------------------------------------------

config_app = typer.Typer(no_args_is_help=True, help="Look at configurations.")
app.add_typer(config_app, name="config")


@config_app.command("check")
def config_check(
    config: Annotated[Path, typer.Argument(help="YAML file, or the name of one that ships.")],
    overrides: Overrides = None,
) -> None:
    """Check a configuration without running it; reports all problems at once."""
    _settings(config, overrides)
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

    cfg = _settings(config, overrides)
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
