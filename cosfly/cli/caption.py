"""The commands `cosfly caption ...`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, SettingOption, command, track_options

if TYPE_CHECKING:
    from caption.schema import CaptionConfig

options.add_group("caption")

TEACHERS = "rules, URL of an OpenAI-compatible server, vllm:MODEL_DIR, file:PATH, or student:PATH of `distill infer`."
TEACHER = SettingOption("caption.teacher", TEACHERS, default="rules")
MODEL_HELP = "Model name at the server; by default its only model."
MODEL = SettingOption("caption.endpoint.model", MODEL_HELP)
JUDGE_MODEL = SettingOption("caption.judge.model", MODEL_HELP)
STUDENT = "Output of `distill train` or `merge`: ask the model in the form that this student was trained on."


@command(
    "cosfly caption --data render --teacher http://localhost:8000",
    "caption",
    STAGE,
    **track_options("caption"),
    teacher=TEACHER,
    as_student=SettingOption("caption.student.folder", STUDENT, Path),
    model=MODEL,
    judge=SettingOption("caption.judge.url", "URL of a server that judges conflicts; it never accepts a hard one."),
    limit=SettingOption("caption.limit", "Caption at most this many windows; a later run resumes.", int),
    max_cost=SettingOption("caption.budget.max_cost", "Stop at this cost; prices: caption.budget.price_*.", float),
    max_tokens=SettingOption("caption.budget.max_tokens", "Stop at this number of tokens, over all runs.", int),
)
def caption(
    job: Job,
    data: options.Trees = None,
    out: Annotated[Path | None, Option(show_default="`caption` next to the tree", help="Output directory.")] = None,
    num_tried: Annotated[
        int | None, Option("--try", min=1, help="Show this many windows: each question, answer, complaint and outcome.")
    ] = None,
    retry_failed: Annotated[
        bool, Option("--retry-failed", help="Request windows in quarantine.jsonl again: failed, refused, declined.")
    ] = False,
    check: Annotated[bool, Option(help="Test the server before the first request of a directory.")] = True,
) -> None:
    """Ask a teacher for the reason of every manoeuvre, verify it against geometry, regenerate, translate (step 7)."""
    cfg = job.cfg.caption
    tree = job.tree(data)
    target = out or tree.resolve().parent / "caption"
    is_student = cfg.student.folder is not None  # it answers one kind of question, so the examination does not fit
    if check and cfg.teacher_kind == "endpoint" and not is_student and not (target / "answers").exists():
        _examine_endpoint(cfg.teacher, cfg)
    if num_tried is not None:
        for line in job.call("caption.stage.trial:show_windows", cfg, tree, target, num_tried):
            typer.echo(line)
    else:
        job.run("caption.stage.stage", cfg, tree, target, retry_failed=retry_failed)


@command("cosfly caption doctor http://localhost:8000", "caption", model=MODEL)
def doctor(job: Job, url: Annotated[str, Argument(help="URL of an OpenAI-compatible server.")]) -> None:
    """Test what a server can do: text, images, schema, thinking, context, time. Exit with 1 if it cannot caption."""
    _examine_endpoint(url, job.cfg.caption)
    typer.echo("Pass --no-check to cosfly caption with these settings: it would repeat the tests.")


def _examine_endpoint(url: str, cfg: CaptionConfig) -> None:
    from caption.teachers.doctor import examine_endpoint
    from caption.teachers.prompt_files import vocabulary_of

    options.print_checks(examine_endpoint(url, cfg, vocabulary_of(cfg)), "What the server can do")


@command("cosfly caption prompts --export my-prompts", "caption")
def prompts(
    job: Job,
    export: Annotated[Path | None, Option(help="Folder to write the current prompts to.")] = None,
    check: Annotated[Path | None, Option(help="Folder with your own prompts, to be checked.")] = None,
) -> None:
    """Export the prompts to a folder, or check a folder of your own, for --set caption.prompts=DIR."""
    from caption.teachers.prompt_files import export_prompts, own_prompts, vocabulary_of

    if check is not None and export is None:
        typer.echo(f"{check}: {len(own_prompts(check))} prompts, no problem found")
    elif export is not None and check is None:
        typer.echo(f"{export}: {len(export_prompts(export, vocabulary_of(job.cfg.caption).prompts))} prompts")
    else:
        raise typer.BadParameter("pass either --export DIR or --check DIR")


@command("cosfly caption judge-check http://localhost:8000", "caption", model=JUDGE_MODEL)
def judge_check(
    job: Job,
    url: Annotated[str, Argument(help="URL of the judge's server.")],
    limit: Annotated[int | None, Option(min=1, help="Ask about at most this many conflicts.")] = None,
) -> None:
    """Measure a judge on a small gold set: agreement, position bias, unparsable answers."""
    from caption.teachers.judge import check_judge, gold_conflicts
    from caption.teachers.prompt_files import vocabulary_of
    from cosfly.llm.contract import run_until_interrupted
    from cosfly.runtime.config import build

    cfg = job.cfg.caption
    judge = build(type(cfg.judge), cfg.judge.model_dump() | {"url": url}, "caption.judge")
    checked = check_judge(judge, vocabulary_of(cfg), gold_conflicts()[:limit], job.cfg.seed)
    report = run_until_interrupted(checked, keeps_work=False)
    head = ("figure", "value", "meaning")
    options.print_table(head, report.rows(), f"Judge {report.model}", left=head)


@command(
    "cosfly caption compare-strategies --teacher URL --out compared",
    "caption",
    "seed",
    **track_options("caption"),
    teacher=TEACHER,
    model=MODEL,
)
def compare_strategies(
    job: Job,
    out: Annotated[Path, Option(help="Folder for compare_strategies.json and the answers.")],
    data: options.Trees = None,
    conflicts: Annotated[int, Option(min=1, help="Stop after this number of conflicts.")] = 50,
) -> None:
    """Compare hint, multi_sample, anchored and cascade on the same conflicts: consistency, text, requests, tokens."""
    from caption.stage.compare import COLUMNS

    comparisons = job.call("caption.stage.compare", job.cfg.caption, job.tree(data), out, conflicts=conflicts)
    title = f"Regeneration of the same {comparisons[0].num_conflicts} conflicts"
    options.print_table(COLUMNS, [comparison.row for comparison in comparisons], title)
