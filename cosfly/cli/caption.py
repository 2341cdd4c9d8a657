"""The commands `cosfly caption ...`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosfly.cli import options

if TYPE_CHECKING:
    from caption.schema import CaptionConfig
    from cosfly.app.settings import RunConfig
    from cosfly.products.captions import Writing

app = typer.Typer(invoke_without_command=True, help="Step 7: Chain-of-Cause captions in English and Chinese.")


Teacher = Annotated[
    str | None,
    typer.Option(
        help="rules, the URL of an OpenAI-compatible endpoint, vllm:MODEL_DIR, file:PATH or "
        "student:PATH (what `distill infer` wrote). [default: rules]"
    ),
]
AsStudent = Annotated[
    Path | None,
    typer.Option(
        help="What `distill train` or `distill merge` wrote: the teacher is that student behind a server, and is asked as it was taught."
    ),
]
Model = Annotated[str | None, typer.Option(help="Model name at the endpoint; by default its only one.")]
JudgeUrl = Annotated[str | None, typer.Option(help="URL of an endpoint that judges conflicts.")]
Readers = Annotated[
    list[str] | None,
    typer.Option(
        help="URL of an endpoint that reads prose into claims; give it twice for two models, else one is asked in two orders."
    ),
]
Keyframes = Annotated[
    bool | None, typer.Option("--keyframes", help="Only windows at which the label changes, plus a stride.")
]
CaptionOut = Annotated[Path | None, typer.Option(help="Output folder; by default `caption` beside the playback tree.")]
Limit = Annotated[int | None, typer.Option(help="Caption at most this many windows; a later run goes on.")]
MaxCost = Annotated[float | None, typer.Option(help="Stop before this cost is passed; prices: caption.budget.price_*.")]
MaxTokens = Annotated[int | None, typer.Option(help="Stop before this many tokens are passed, all runs.")]
PlanOnly = Annotated[
    bool, typer.Option("--plan", help="Ask about a few windows, print calls, tokens, time and cost, and stop.")
]
RetryFailed = Annotated[bool, typer.Option("--retry-failed", help="Ask only about the windows in quarantine.jsonl.")]
Check = Annotated[bool, typer.Option(help="Before the first request of a folder, try what the endpoint can do.")]


@app.callback()
def caption(
    context: typer.Context,
    teacher: Teacher = None,
    as_student: AsStudent = None,
    model: Model = None,
    judge: JudgeUrl = None,
    reader: Readers = None,
    keyframes: Keyframes = None,
    data: options.Data = None,
    flights: options.Flights = None,
    tracks: options.Tracks = None,
    out: CaptionOut = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    limit: Limit = None,
    max_cost: MaxCost = None,
    max_tokens: MaxTokens = None,
    plan_only: PlanOnly = False,
    retry_failed: RetryFailed = False,
    check: Check = True,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Step 7: ask a teacher for the reason of every manoeuvre, prove it against the geometry, repair, translate."""
    if context.invoked_subcommand is not None:
        return
    from caption.run import stage

    chosen: dict[str, Any] = {
        "caption.teacher": teacher,
        "caption.endpoint.model": model,
        "caption.student.folder": as_student,
        "caption.judge.url": judge,
        "caption.reader.urls": reader or None,
        "caption.window.keyframes": keyframes,
        "caption.limit": limit,
        "caption.budget.max_cost": max_cost,
        "caption.budget.max_tokens": max_tokens,
        "seed": seed,
        "workers": workers,
    } | options.chosen_flights("caption.flights", flights, tracks)
    cfg = options.resolve(config, overrides, chosen)
    tree = options.data_folder(data)
    target = out or tree.resolve().parent / "caption"
    options.set_aside(target, repair)
    options.verify_first(verify, tree, target)
    is_student = cfg.caption.student.folder is not None  # it knows one question, and no other is tried
    if check and cfg.caption.teacher_kind == "endpoint" and not is_student and not (target / "answers").exists():
        _examine_endpoint(cfg.caption.teacher, cfg.caption, [cfg.caption.writing])
    if plan_only:
        _show_forecast(cfg, tree, target, resume)
        return
    given = options.manner(cfg, resume) | {"seed": cfg.seed, "retry_failed": retry_failed}
    options.tell_product(stage.run(cfg.caption, tree, target, **given), target, cfg)


def _show_forecast(cfg: RunConfig, tree: Path, target: Path, resume: options.Resume) -> None:
    from caption.run.forecast import make_forecast
    from cosfly.work.console import console

    forecast = make_forecast(cfg.caption, tree, target, seed=cfg.seed, resume=resume)
    console.print(options.plain_table("What this run will take", forecast.rows()))


@app.command("doctor")
def caption_doctor(
    url: Annotated[str, typer.Argument(help="URL of an OpenAI-compatible endpoint.")],
    model: Model = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Try what an endpoint can do: images, schema, thinking, context length, ways of writing. Exit 1 if captioning cannot work."""
    from caption.writing.contract import WAYS

    _examine_endpoint(url, options.resolve(config, overrides, {"caption.endpoint.model": model}).caption, tuple(WAYS))


def _examine_endpoint(url: str, cfg: CaptionConfig, ways: Sequence[Writing]) -> None:
    """Print a table of what works; exit 1 when the endpoint is unusable."""
    from caption.run.own_files import own_files
    from caption.teachers.doctor import examine_endpoint
    from cosfly.work.console import console

    with own_files(cfg):
        findings = examine_endpoint(url, cfg, ways)
    options.tell_checks(findings, console, "What the endpoint can do")


@app.command("prompts")
def caption_prompts(
    export: Annotated[Path | None, typer.Option(help="Folder to write the prompts in use to, to begin with.")] = None,
    check: Annotated[
        Path | None, typer.Option(help="Folder with prompts of yours: say what is missing or unknown, a line each.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Write the prompts into a folder, or check a folder of yours; --set caption.prompts=DIR asks with it."""
    from caption.run.own_files import own_files
    from caption.teachers.prompt_files import export_prompts, own_prompts

    if (export is None) == (check is None):
        raise typer.BadParameter("give --export DIR or --check DIR")
    cfg = options.resolve(config, overrides)
    if check is not None:
        typer.echo(f"{check}: {len(own_prompts(check) or {})} prompts, nothing wrong")
    elif export is not None:
        with own_files(cfg.caption):
            typer.echo(f"{export}: {len(export_prompts(export))} prompts")


@app.command("actions")
def caption_actions(
    export: Annotated[
        Path | None, typer.Option(help="File to write the set of actions that ships to, to begin with.")
    ] = None,
    check: Annotated[Path | None, typer.Option(help="File with actions of yours: say what is wrong with it.")] = None,
) -> None:
    """Write the closed set of actions into a file, or check a file of yours; --set caption.actions=FILE captions with it."""
    import numpy as np

    from caption.schema import LabelConfig
    from caption.truth.reach import never_labels
    from cosfly.products.actions import export_actions, read_actions

    if (export is None) == (check is None):
        raise typer.BadParameter("give --export FILE or --check FILE")
    if check is not None:
        actions = read_actions(check)
        found = never_labels(actions, LabelConfig(), np.random.default_rng(0))
        typer.echo("".join(f"warning: {line}\n" for line in found), nl=False)
        typer.echo(f"{check}: {len(actions.tokens)} actions, nothing wrong{' but this' if found else ''}")
    elif export is not None:
        export_actions(export)
        typer.echo(export)


@app.command("judge-check")
def caption_judge_check(
    url: Annotated[str, typer.Argument(help="OpenAI-compatible endpoint of the judge.")],
    model: Model = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Measure a judge on a small gold set: agreement, position bias, unparsable answers."""
    import asyncio

    from caption.run.own_files import own_files
    from caption.teachers.judge import check_judge, gold_conflicts, judge_check_table
    from cosfly.work.console import console

    cfg = options.resolve(config, overrides, {"caption.judge.url": url, "caption.judge.model": model})
    with own_files(cfg.caption):
        console.print(judge_check_table(asyncio.run(check_judge(cfg.caption.judge, gold_conflicts(), cfg.seed))))


@app.command("reader-check")
def caption_reader_check(
    urls: Annotated[list[str], typer.Argument(help="OpenAI-compatible endpoint of the reader, or two.")],
    model: Model = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only so many captions, spread over the set.")] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
) -> None:
    """Measure a reader of prose on the gold set: true captions flagged, errors caught, claims, requests, tokens."""
    import asyncio

    from caption.run.own_files import own_files
    from caption.teachers.reader import check_reader, reader_check_table
    from caption.truth.gold import read_gold
    from cosfly.work.console import console

    given = {"caption.reader.urls": urls, "caption.reader.models": None if model is None else [model]}
    cfg, gold = options.resolve(config, overrides, given), list(read_gold())
    gold = gold if limit is None else gold[:: -(-len(gold) // limit)]
    with own_files(cfg.caption):
        check = asyncio.run(check_reader(cfg.caption.reader, gold, cfg.seed))
        console.print(reader_check_table(check, cfg.caption.budget))


@app.command("compare-strategies")
def caption_compare_strategies(
    out: Annotated[Path, typer.Option(help="Folder for compare_strategies.json and the answers.")],
    data: options.Data = None,
    flights: options.Flights = None,
    tracks: options.Tracks = None,
    teacher: Annotated[str | None, typer.Option(help="rules, or the URL of an endpoint. [default: rules]")] = None,
    model: Model = None,
    conflicts: Annotated[int, typer.Option(min=1, help="Stop looking for conflicts after so many.")] = 50,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    repair: options.Repair = False,
) -> None:
    """Compare hint, multi_sample, anchored and cascade on the same conflicts: consistency, text, asks, tokens."""
    from caption.run import compare
    from cosfly.work.console import console

    chosen = {"caption.teacher": teacher, "caption.endpoint.model": model, "seed": seed}
    chosen |= options.chosen_flights("caption.flights", flights, tracks)
    cfg = options.resolve(config, overrides, chosen)
    options.set_aside(out, repair)
    comparisons = compare.run(cfg.caption, options.data_folder(data), out, seed=cfg.seed, conflicts=conflicts)
    console.print(compare.comparison_table(comparisons))
