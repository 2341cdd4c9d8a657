"""The commands `cosfly distill ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import Job, Sets, takes

app = typer.Typer(no_args_is_help=True, help="Teach a small model: training set, LoRA, inference, evaluation.")

Dataset = Annotated[Path, Option(help="Training set, the output of `distill prepare`.")]
Runs = Annotated[list[Path] | None, Argument(help="Run folders, as `cosfly run` makes them; all are taken together.")]
STUDENTS = (
    "A model folder, a repository as Qwen/Qwen3.5-2B, or of random weights: tiny, tiny:small, tiny:medium, random."
)
ENGINES = "transformers, endpoint (a server) or vllm."
JUDGED = "captions.jsonl of `caption --teacher student:`, one per tree; repeat it."


@app.command("prepare")
@takes("seed", "resume", flights="distill.prepare.flights")
def distill_prepare(
    job: Job,
    out: options.Out,
    runs: Runs = None,
    captions: Annotated[list[Path] | None, Option(help="captions.jsonl of a tree; repeat both for several.")] = None,
    data: options.Trees = None,
    limit: Annotated[
        int | None,
        Option(help="Windows in all splits together, of each decision its share; 0: all."),
        Sets("distill.prepare.limit"),
    ] = None,
) -> None:
    """Captions of one run or several to a training set with splits that share no walk."""
    from distill.prepare import stage as prepare
    from distill.prepare.sources import RunSource

    sources = [RunSource.of_run(folder) for folder in runs or []]
    if captions or data or not sources:
        trees = job.trees(data)
        if len(trees) != len(captions or []):
            raise typer.BadParameter("give --data and --captions, one of each for a tree, or run folders")
        sources += [RunSource.of_files(*files) for files in zip(trees, captions or [], strict=True)]
    typer.echo(prepare.run(job.cfg.distill.prepare, sources, out, seed=job.cfg.seed, resume=job.resume))


@app.command("dual-track")
@takes("seed", "resume")
def distill_dual_track(job: Job, out: options.Out, runs: Runs = None, data: options.Trees = None) -> None:
    """Windows over clean and perturbed flights, to learn denoising and prediction from, by split."""
    from distill.prepare import dual_track

    trees = [folder / "render" for folder in runs or []]
    if data or not trees:
        trees += job.trees(data)
    job.finish(dual_track.run(job.cfg.distill.dual_track, trees, out, seed=job.cfg.seed, resume=job.resume), out)


@app.command("train")
@takes("seed", "resume")
def distill_train(
    job: Job,
    dataset: Dataset,
    student: Annotated[str, Option(help=STUDENTS)],
    out: options.Out,
    data: options.Trees = None,
) -> None:
    """Train a student, LoRA or in full, in one process or many (torchrun); continues from its last checkpoint."""
    from distill.training import stage as train
    from distill.training.ranks import is_first_process

    cfg, trees = job.cfg, job.trees(data)
    product = train.run(cfg.distill.train, dataset, trees, student, out, seed=cfg.seed, resume=job.resume)
    if is_first_process():
        typer.echo(product)


@app.command("infer")
@takes("resume")
def distill_infer(
    job: Job,
    dataset: Dataset,
    model: Annotated[str, Option(help="Base model: a folder, or a repository's name; with --engine endpoint a URL.")],
    out: options.Out,
    engine: Annotated[
        str | None, Option(show_default="transformers", help=ENGINES), Sets("distill.infer.engine")
    ] = None,
    adapter: Annotated[Path | None, Option(help="Adapter folder; none: the base model as it is.")] = None,
    data: options.Trees = None,
) -> None:
    """Let the student answer a split; continues where it stopped."""
    from distill.inference import stage as infer

    trees = job.trees(data)
    product = infer.run(job.cfg.distill.infer, dataset, trees, model, out, adapter=adapter, resume=job.resume)
    job.finish(product, out)


@app.command("merge")
@takes("resume")
def distill_merge(
    job: Job,
    model: Annotated[Path, Option(help="Folder of the student's base model.")],
    adapter: Annotated[Path, Option(help="Adapter folder, the output of `distill train`.")],
    out: options.Out,
) -> None:
    """Put an adapter into the weights of its base: a model folder for transformers, vLLM and servers."""
    from distill.inference import merge

    typer.echo(merge.run(model, adapter, out, resume=job.resume))


@app.command("evaluate")
@takes("seed", "resume")
def distill_evaluate(
    job: Job,
    dataset: Dataset,
    predictions: Annotated[Path, Option(help="Predictions, the output of `distill infer`.")],
    out: options.Out,
    data: Annotated[
        list[Path] | None,
        Option(help="Playback tree, for the pictures of the page; repeat it where there are several."),
    ] = None,
    bertscore_en: Annotated[
        Path | None, Option(help="Model folder for BERTScore of English (roberta-large); none: not computed.")
    ] = None,
    bertscore_zh: Annotated[
        Path | None, Option(help="Model folder for BERTScore of Chinese (bert-base-chinese); none: not computed.")
    ] = None,
    judged: Annotated[list[Path] | None, Option(help=JUDGED)] = None,
) -> None:
    """Parse rate, decisions, verdicts, BERTScore and evidence, each beside its floors and with its interval."""
    from distill.evaluation import stage as evaluate

    given: Any = {"en": bertscore_en, "zh": bertscore_zh}
    more: Any = {"bertscore_models": {language: folder for language, folder in given.items() if folder is not None}}
    more |= {"data": data or [], "judged": judged or [], "seed": job.cfg.seed, "resume": job.resume}
    typer.echo(evaluate.run(job.cfg.distill.evaluate, predictions, dataset, out, **more))


@app.command("report")
@takes("seed", "resume")
def distill_report(
    job: Job,
    evaluations: Annotated[
        list[Path], Argument(help="Folders of `distill evaluate`, one a student; their names name the rows.")
    ],
    out: options.Out,
) -> None:
    """Students side by side: the trade-off table, and differences by paired bootstrap over walks."""
    from distill.evaluation import compare

    typer.echo(compare.run(job.cfg.distill.report, evaluations, out, seed=job.cfg.seed, resume=job.resume))
