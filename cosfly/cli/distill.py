"""The commands `cosfly distill ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cosfly.cli.options import (
    ConfigFile,
    DataOption,
    OutOption,
    Overrides,
    ResumeMode,
    ResumeOption,
    Seed,
    data_folder,
    resolve,
)

app = typer.Typer(no_args_is_help=True, help="Teach a small model: training set, LoRA, inference, evaluation.")


DatasetOption = Annotated[Path, typer.Option(help="Training set, the output of `distill prepare`.")]
ModelOption = Annotated[Path, typer.Option(help="Folder of the student's base model.")]


@app.command("tiny-student")
def distill_tiny_student(out: OutOption, seed: Annotated[int, typer.Option(help="Seed of the weights.")] = 0) -> None:
    """Make a tiny, randomly initialised student, to try the way without weights."""
    import distill.student

    typer.echo(distill.student.make_tiny_student(out, seed))


@app.command("prepare")
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

    cfg = resolve(config, overrides, seed)
    typer.echo(
        distill.dataset.run(cfg.distill.prepare, captions, data_folder(data), out, seed=cfg.seed, resume=resume.value)
    )


@app.command("train")
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

    cfg = resolve(config, overrides, seed)
    typer.echo(
        distill.train.run(cfg.distill.train, dataset, data_folder(data), model, out, seed=cfg.seed, resume=resume.value)
    )


@app.command("infer")
def distill_infer(
    dataset: DatasetOption,
    model: Annotated[str, typer.Option(help="Folder of the student's base model; with --engine endpoint its URL.")],
    out: OutOption,
    engine: Annotated[
        str | None, typer.Option(help="transformers, endpoint (a server) or vllm. [default: transformers]")
    ] = None,
    adapter: Annotated[Path | None, typer.Option(help="Adapter folder; none: the base model as it is.")] = None,
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Let the student answer a split; continues where it stopped."""
    import distill.infer

    extra = [] if engine is None else [f"distill.infer.engine={engine}"]
    cfg = resolve(config, [*(overrides or []), *extra])
    typer.echo(
        distill.infer.run(
            cfg.distill.infer, dataset, data_folder(data), model, out, adapter=adapter, resume=resume.value
        )
    )


@app.command("evaluate")
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

    cfg = resolve(config, overrides, seed)
    given: Any = {"bertscore_model": bertscore_model, "seed": cfg.seed, "resume": resume.value}
    typer.echo(distill.evaluate.run(cfg.distill.evaluate, predictions, dataset, out, **given))
