"""The commands `cosfly distill ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cosfly.cli import options

app = typer.Typer(no_args_is_help=True, help="Teach a small model: training set, LoRA, inference, evaluation.")


DatasetOption = Annotated[Path, typer.Option(help="Training set, the output of `distill prepare`.")]
ModelOption = Annotated[Path, typer.Option(help="Folder of the student's base model.")]


@app.command("tiny-student")
def distill_tiny_student(out: options.Out, seed: Annotated[int, typer.Option(help="Seed of the weights.")] = 0) -> None:
    """Make a tiny, randomly initialised student, to try the way without weights."""
    from distill.student.model import make_tiny_student

    typer.echo(make_tiny_student(out, seed))


@app.command("prepare")
def distill_prepare(
    captions: Annotated[Path, typer.Option(help="captions.jsonl")],
    out: options.Out,
    data: options.Data = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Captions to a training set with splits that share no trajectory."""
    from distill.prepare import stage as dataset

    cfg, tree = options.resolve(config, overrides, {"seed": seed}), options.data_folder(data)
    options.verify_first(verify, captions, tree, out)
    typer.echo(dataset.run(cfg.distill.prepare, captions, tree, out, seed=cfg.seed, resume=resume))


@app.command("train")
def distill_train(
    dataset: DatasetOption,
    model: ModelOption,
    out: options.Out,
    data: options.Data = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Train LoRA adapters; continues from its last checkpoint."""
    from distill.training import stage as train

    cfg, tree = options.resolve(config, overrides, {"seed": seed}), options.data_folder(data)
    options.verify_first(verify, dataset, tree, out)
    typer.echo(train.run(cfg.distill.train, dataset, tree, model, out, seed=cfg.seed, resume=resume))


@app.command("infer")
def distill_infer(
    dataset: DatasetOption,
    model: Annotated[str, typer.Option(help="Folder of the student's base model; with --engine endpoint its URL.")],
    out: options.Out,
    engine: Annotated[
        str | None, typer.Option(help="transformers, endpoint (a server) or vllm. [default: transformers]")
    ] = None,
    adapter: Annotated[Path | None, typer.Option(help="Adapter folder; none: the base model as it is.")] = None,
    data: options.Data = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Let the student answer a split; continues where it stopped."""
    from distill.inference import stage as infer

    cfg, tree = options.resolve(config, overrides, {"distill.infer.engine": engine}), options.data_folder(data)
    options.set_aside(out, repair)
    options.verify_first(verify, dataset, tree, adapter, out)
    typer.echo(infer.run(cfg.distill.infer, dataset, tree, model, out, adapter=adapter, resume=resume))


@app.command("evaluate")
def distill_evaluate(
    dataset: DatasetOption,
    predictions: Annotated[Path, typer.Option(help="Predictions, the output of `distill infer`.")],
    out: options.Out,
    bertscore_model: Annotated[
        Path | None, typer.Option(help="Local model folder for BERTScore; none: not computed.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """JSON parse rate, decision accuracy beside the majority floor, BERTScore beside a shuffled floor."""
    from distill.evaluation import stage as evaluate

    cfg = options.resolve(config, overrides, {"seed": seed})
    options.verify_first(verify, predictions, dataset, out)
    given: Any = {"bertscore_model": bertscore_model, "seed": cfg.seed, "resume": resume}
    typer.echo(evaluate.run(cfg.distill.evaluate, predictions, dataset, out, **given))
