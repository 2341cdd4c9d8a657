"""The commands `cosfly distill ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import Job, Short, takes

app = typer.Typer(no_args_is_help=True, help="Train a small student: training set, LoRA, inference, evaluation.")

Dataset = Annotated[Path, Option(help="Training set: the output of `distill prepare`.")]
STUDENTS = "Model folder, repository such as Qwen/Qwen3.5-2B, or random weights: tiny, tiny:small, tiny:medium, random."
JUDGED = "captions.jsonl of `caption --teacher student:PATH`, one per tree; repeat it."


@app.command("prepare", epilog="cosfly distill prepare runs/diverse --out dataset")
@takes(
    "distill",
    "seed resume",
    **options.choice_of("distill.prepare"),
    limit=Short("distill.prepare.limit", "Windows in all splits, shared by the decisions; 0 for all.", int),
)
def distill_prepare(
    job: Job,
    out: options.Out,
    runs: options.Runs = None,
    captions: Annotated[list[Path] | None, Option(help="captions.jsonl of a tree; repeat both for several.")] = None,
    data: options.Trees = None,
) -> None:
    """Make a training set from the captions of one or more runs, with splits that share no pedestrian."""
    from distill.prepare import stage as prepare
    from distill.prepare.sources import RunSource

    sources = [RunSource.of_run(folder) for folder in runs or []]
    if captions or data or not sources:
        trees = job.trees(data)
        if len(trees) != len(captions or []):
            raise typer.BadParameter("give one --captions for each --data, or run directories")
        sources += [RunSource.of_files(*files) for files in zip(trees, captions or [], strict=True)]
    typer.echo(prepare.run(job.cfg.distill.prepare, sources, out, seed=job.cfg.seed, resume=job.resume))


@app.command("dual-track", epilog="cosfly distill dual-track runs/diverse --out windows")
@takes("distill", "seed resume")
def distill_dual_track(job: Job, out: options.Out, runs: options.Runs = None, data: options.Trees = None) -> None:
    """Make windows over clean and perturbed tracks, by split, to learn denoising and prediction from."""
    from distill.prepare import dual_track

    trees = [folder / "render" for folder in runs or []]
    if data or not trees:
        trees += job.trees(data)
    job.finish(dual_track.run(job.cfg.distill.dual_track, trees, out, seed=job.cfg.seed, resume=job.resume), out)


@app.command("train", epilog="cosfly distill train --dataset dataset --student Qwen/Qwen3.5-2B --out student")
@takes("distill", "seed resume")
def distill_train(
    job: Job,
    dataset: Dataset,
    student: Annotated[str, Option(help=STUDENTS)],
    out: options.Out,
    data: options.Trees = None,
) -> None:
    """Train a student, by LoRA or in full, in one process or many (torchrun); resume from its last checkpoint."""
    from distill.training import stage as train
    from distill.training.ranks import is_first_process

    cfg, trees = job.cfg, job.trees(data)
    product = train.run(cfg.distill.train, dataset, trees, student, out, seed=cfg.seed, resume=job.resume)
    if is_first_process():
        typer.echo(product)


ENGINE = Short("distill.infer.engine", "transformers, endpoint (a server) or vllm.", default="transformers")


@app.command(
    "infer",
    epilog="cosfly distill infer --dataset dataset --model Qwen/Qwen3.5-2B --out predictions",
)
@takes("distill", "resume", engine=ENGINE)
def distill_infer(
    job: Job,
    dataset: Dataset,
    model: Annotated[str, Option(help="Base model: folder or repository; with --engine endpoint a URL.")],
    out: options.Out,
    adapter: Annotated[Path | None, Option(help="Adapter folder; none: the base model alone.")] = None,
    data: options.Trees = None,
) -> None:
    """Run a student on the samples of a split; resume where it stopped."""
    from distill.inference import stage as infer

    trees = job.trees(data)
    product = infer.run(job.cfg.distill.infer, dataset, trees, model, out, adapter=adapter, resume=job.resume)
    job.finish(product, out)


@app.command("merge", epilog="cosfly distill merge --model models/Qwen3.5-2B --adapter student/adapter --out merged")
@takes("", "resume")
def distill_merge(
    job: Job,
    model: Annotated[Path, Option(help="Folder of the student's base model.")],
    adapter: Annotated[Path, Option(help="Adapter folder, the output of `distill train`.")],
    out: options.Out,
) -> None:
    """Merge an adapter into its base: a model folder for transformers, vLLM and servers."""
    from distill.inference import merge

    typer.echo(merge.run(model, adapter, out, resume=job.resume))


@app.command("evaluate", epilog="cosfly distill evaluate --dataset dataset --predictions predictions --out evaluation")
@takes("distill", "seed resume")
def distill_evaluate(
    job: Job,
    dataset: Dataset,
    predictions: Annotated[Path, Option(help="Predictions: the output of `distill infer`.")],
    out: options.Out,
    data: Annotated[list[Path] | None, Option(help="Playback tree, for the page's pictures; repeat it.")] = None,
    bertscore_en: Annotated[Path | None, Option(help="roberta-large, for BERTScore of English.")] = None,
    bertscore_zh: Annotated[Path | None, Option(help="bert-base-chinese, for BERTScore of Chinese.")] = None,
    judged: Annotated[list[Path] | None, Option(help=JUDGED)] = None,
) -> None:
    """Score predictions: parse rate, decisions, verdicts, BERTScore and evidence, with baselines and intervals."""
    from distill.evaluation import stage as evaluate

    models = {"en": bertscore_en, "zh": bertscore_zh}
    product = evaluate.run(
        job.cfg.distill.evaluate,
        predictions,
        dataset,
        out,
        bertscore_models={language: folder for language, folder in models.items() if folder is not None},  # type: ignore[misc]
        data=data or [],
        judged=judged or [],
        seed=job.cfg.seed,
        resume=job.resume,
    )
    typer.echo(product)


@app.command("report", epilog="cosfly distill report evaluation-2B evaluation-4B --out report")
@takes("", "seed resume")
def distill_report(
    job: Job,
    evaluations: Annotated[list[Path], Argument(help="Output directories of `distill evaluate`, one per student.")],
    out: options.Out,
) -> None:
    """Compare students: the trade-off table, and differences by paired bootstrap over pedestrians."""
    from distill.evaluation import compare

    typer.echo(compare.run(evaluations, out, seed=job.cfg.seed, resume=job.resume))
