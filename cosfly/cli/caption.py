"""The commands `cosfly caption ...`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, Sets, takes

if TYPE_CHECKING:
    from caption.schema import CaptionConfig

app = options.stage_group("Step 7: Chain-of-Cause captions in English and Chinese.")

TEACHER = "rules, an OpenAI-compatible endpoint's URL, vllm:MODEL_DIR, file:PATH, or student:PATH of `distill infer`."
STUDENT = "Folder of `distill train` or `merge`: the teacher is that student behind a server, asked as it was taught."
Teacher = Annotated[str | None, Option(show_default="rules", help=TEACHER), Sets("caption.teacher")]
Model = Annotated[
    str | None, Option(help="Model name at the endpoint; by default its only one."), Sets("caption.endpoint.model")
]
MaxCost = Annotated[
    float | None,
    Option(help="Stop before this cost is passed; prices: caption.budget.price_*."),
    Sets("caption.budget.max_cost"),
]
MaxTokens = Annotated[
    int | None, Option(help="Stop before this many tokens are passed, all runs."), Sets("caption.budget.max_tokens")
]


@app.callback()
@takes(*STAGE, flights="caption.flights")
def caption(
    job: Job,
    teacher: Teacher = None,
    as_student: Annotated[Path | None, Option(help=STUDENT), Sets("caption.student.folder")] = None,
    model: Model = None,
    judge: Annotated[
        str | None, Option(help="URL of an endpoint that judges conflicts."), Sets("caption.judge.url")
    ] = None,
    keyframes: Annotated[
        bool | None,
        Option("--keyframes", help="Only windows at which the label changes, plus a stride."),
        Sets("caption.window.keyframes"),
    ] = None,
    data: options.Trees = None,
    out: Annotated[
        Path | None, Option(show_default="`caption` beside the playback tree", help="Output folder.")
    ] = None,
    limit: Annotated[
        int | None, Option(help="Caption at most this many windows; a later run goes on."), Sets("caption.limit")
    ] = None,
    max_cost: MaxCost = None,
    max_tokens: MaxTokens = None,
    plan_only: Annotated[
        bool, Option("--plan", help="Ask about a few windows, print calls, tokens, time and cost, and stop.")
    ] = False,
    retry_failed: Annotated[
        bool, Option("--retry-failed", help="Ask only about the windows in quarantine.jsonl.")
    ] = False,
    check: Annotated[bool, Option(help="Before the first request of a folder, try what the endpoint can do.")] = True,
) -> None:
    """Step 7: ask a teacher for the reason of every manoeuvre, prove it against the geometry, repair, translate."""
    from caption.run import stage

    cfg, tree = job.cfg.caption, job.tree(data)
    target = out or tree.resolve().parent / "caption"
    is_student = cfg.student.folder is not None  # it knows one question, and no other is tried
    if check and cfg.teacher_kind == "endpoint" and not is_student and not (target / "answers").exists():
        _examine_endpoint(cfg.teacher, cfg)
    if plan_only:
        return _tell_forecast(job, tree, target)
    job.finish(stage.run(cfg, tree, target, seed=job.cfg.seed, retry_failed=retry_failed, **job.worker_options), target)


def _tell_forecast(job: Job, tree: Path, target: Path) -> None:
    from caption.run.forecast import make_forecast
    from cosfly.runtime.console import console

    forecast = make_forecast(job.cfg.caption, tree, target, seed=job.cfg.seed, resume=job.resume)
    options.tell_table(console, (), forecast, title="What this run will take")


@app.command("doctor")
@takes()
def caption_doctor(
    job: Job,
    url: Annotated[str, Argument(help="URL of an OpenAI-compatible endpoint.")],
    model: Model = None,
) -> None:
    """Try what an endpoint can do: text, images, schema, thinking, context. Exit 1 if it cannot caption."""
    _examine_endpoint(url, job.cfg.caption)


def _examine_endpoint(url: str, cfg: CaptionConfig) -> None:
    """Print a table of what works; exit 1 when the endpoint is unusable."""
    from caption.teachers.doctor import examine_endpoint
    from caption.teachers.prompt_files import vocabulary_of
    from cosfly.runtime.console import console

    findings = examine_endpoint(url, cfg, vocabulary_of(cfg))
    options.tell_checks(findings, console, "What the endpoint can do")


@app.command("prompts")
@takes()
def caption_prompts(
    job: Job,
    export: Annotated[Path | None, Option(help="Folder to write the prompts in use to, to begin with.")] = None,
    check: Annotated[Path | None, Option(help="Folder with prompts of yours: say what is missing or unknown.")] = None,
) -> None:
    """Write the prompts into a folder, or check a folder of yours; --set caption.prompts=DIR asks with it."""
    from caption.teachers.prompt_files import export_prompts, own_prompts, vocabulary_of

    if (export is None) == (check is None):
        raise typer.BadParameter("give --export DIR or --check DIR")
    if check is not None:
        typer.echo(f"{check}: {len(own_prompts(check))} prompts, nothing wrong")
    elif export is not None:
        found = export_prompts(export, vocabulary_of(job.cfg.caption).prompts)
        typer.echo(f"{export}: {len(found)} prompts")


@app.command("judge-check")
@takes()
def caption_judge_check(
    job: Job,
    url: Annotated[str, Argument(help="OpenAI-compatible endpoint of the judge."), Sets("caption.judge.url")],
    model: Annotated[
        str | None, Option(help="Model name at the endpoint; by default its only one."), Sets("caption.judge.model")
    ] = None,
) -> None:
    """Measure a judge on a small gold set: agreement, position bias, unparsable answers."""
    import asyncio

    from caption.teachers.judge import check_judge, gold_conflicts, judge_check_table
    from caption.teachers.prompt_files import vocabulary_of
    from cosfly.runtime.console import console

    cfg, seed = job.cfg.caption, job.cfg.seed
    found = asyncio.run(check_judge(cfg.judge, vocabulary_of(cfg), gold_conflicts(), seed))
    console.print(judge_check_table(found))


@app.command("compare-strategies")
@takes("seed", flights="caption.flights")
def caption_compare_strategies(
    job: Job,
    out: Annotated[Path, Option(help="Folder for compare_strategies.json and the answers.")],
    data: options.Trees = None,
    teacher: Teacher = None,
    model: Model = None,
    conflicts: Annotated[int, Option(min=1, help="Stop looking for conflicts after so many.")] = 50,
) -> None:
    """Compare hint, multi_sample, anchored and cascade on the same conflicts: consistency, text, asks, tokens."""
    from caption.run import compare
    from cosfly.runtime.console import console

    tree = job.tree(data)
    comparisons = compare.run(job.cfg.caption, tree, out, seed=job.cfg.seed, conflicts=conflicts)
    console.print(compare.comparison_table(comparisons))
