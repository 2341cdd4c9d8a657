"""The commands `cosfly distill ...`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from cosfly.cli import options

app = typer.Typer(no_args_is_help=True, help="Teach a small model: training set, LoRA, inference, evaluation.")


DatasetOption = Annotated[Path, typer.Option(help="Training set, the output of `distill prepare`.")]
ModelOption = Annotated[Path, typer.Option(help="Folder of the student's base model.")]


@app.command("tiny-student")
def distill_tiny_student(out: options.Out, seed: Annotated[int, typer.Option(help="Seed of the weights.")] = 0) -> None:
    """Make a tiny, randomly initialised student, to try the way without weights."""
    from distill.student.random_student import make_tiny_student

    typer.echo(make_tiny_student(out, seed))


@app.command("prepare")
def distill_prepare(
    out: options.Out,
    runs: Annotated[
        list[Path] | None, typer.Argument(help="Run folders, as `cosfly run` makes them; all go into one training set.")
    ] = None,
    captions: Annotated[
        list[Path] | None, typer.Option(help="captions.jsonl of a tree; repeat both for several.")
    ] = None,
    data: options.Trees = None,
    flights: options.Flights = None,
    tracks: options.Tracks = None,
    limit: Annotated[
        int | None, typer.Option(help="Windows in all splits together, of each decision and flight its share; 0: all.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Captions of one run or several to a training set with splits that share no walk."""
    from distill.prepare import stage as prepare
    from distill.prepare.sources import Source

    sources = [Source.of_run(folder) for folder in runs or []]
    if captions or data or not sources:
        trees = options.data_folders(data)
        if len(trees) != len(captions or []):
            raise typer.BadParameter("give --data and --captions, one of each for a tree, or run folders")
        sources += [Source.of_files(*files) for files in zip(trees, captions or [], strict=True)]
    chosen = {"seed": seed, "distill.prepare.limit": limit}
    chosen |= options.chosen_flights("distill.prepare.flights", flights, tracks)
    cfg = options.resolve(config, overrides, chosen)
    options.verify_first(verify, *(path for source in sources for path in (source.data, source.captions)), out)
    typer.echo(prepare.run(cfg.distill.prepare, sources, out, seed=cfg.seed, resume=resume))


@app.command("dual-track")
def distill_dual_track(
    out: options.Out,
    runs: Annotated[list[Path] | None, typer.Argument(help="Run folders, as `cosfly run` makes them.")] = None,
    data: options.Trees = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Windows over clean and perturbed flights, to learn denoising and prediction from, by split."""
    from distill.prepare import dual_track

    trees = [folder / "render" for folder in runs or []]
    if data or not trees:
        trees += options.data_folders(data)
    cfg = options.resolve(config, overrides, {"seed": seed})
    options.verify_first(verify, *trees, out)
    options.tell_product(dual_track.run(cfg.distill.dual_track, trees, out, seed=cfg.seed, resume=resume), out, cfg)


@app.command("train")
def distill_train(
    dataset: DatasetOption,
    student: Annotated[
        str,
        typer.Option(
            help="Who learns: a model folder, the name of a repository as Qwen/Qwen3.5-2B, or, of random weights, tiny, tiny:small, "
            "tiny:medium, random."
        ),
    ],
    out: options.Out,
    data: options.Trees = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Train a student, LoRA or in full, in one process or many (torchrun); continues from its last checkpoint."""
    from distill.training import stage as train
    from distill.training.ranks import is_first_process

    cfg, trees = options.resolve(config, overrides, {"seed": seed}), options.data_folders(data)
    options.verify_first(verify, dataset, *trees, out)
    product = train.run(cfg.distill.train, dataset, trees, student, out, seed=cfg.seed, resume=resume)
    if is_first_process():
        typer.echo(product)


@app.command("infer")
def distill_infer(
    dataset: DatasetOption,
    model: Annotated[
        str,
        typer.Option(
            help="Folder of the student's base model, or the name of its repository; with --engine endpoint a URL."
        ),
    ],
    out: options.Out,
    engine: Annotated[
        str | None, typer.Option(help="transformers, endpoint (a server) or vllm. [default: transformers]")
    ] = None,
    adapter: Annotated[Path | None, typer.Option(help="Adapter folder; none: the base model as it is.")] = None,
    data: options.Trees = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
    repair: options.Repair = False,
) -> None:
    """Let the student answer a split; continues where it stopped."""
    from distill.inference import stage as infer

    cfg, trees = options.resolve(config, overrides, {"distill.infer.engine": engine}), options.data_folders(data)
    options.set_aside(out, repair)
    options.verify_first(verify, dataset, *trees, adapter, out)
    product = infer.run(cfg.distill.infer, dataset, trees, model, out, adapter=adapter, resume=resume)
    options.tell_product(product, out, cfg)


@app.command("merge")
def distill_merge(
    model: ModelOption,
    adapter: Annotated[Path, typer.Option(help="Adapter folder, the output of `distill train`.")],
    out: options.Out,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Put an adapter into the weights of its base: a model folder for transformers, vLLM and servers."""
    from distill.inference import merge

    cfg = options.resolve(config, overrides, {})
    options.verify_first(verify, adapter, out)
    typer.echo(merge.run(cfg.distill.merge, model, adapter, out, resume=resume))


@app.command("floors")
def distill_floors(
    dataset: DatasetOption,
    out: options.Out,
    split: Annotated[Literal["train", "val", "test"], typer.Option(help="Samples to answer.")] = "test",
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
) -> None:
    """Answers without a look at a window, as predictions: `caption --teacher student:` judges their sentences beside a student's."""
    from distill.evaluation.floors import write_floors

    for path in write_floors(dataset, split, out, options.resolve(config, overrides, {"seed": seed}).seed):
        typer.echo(path)


@app.command("evaluate")
def distill_evaluate(
    dataset: DatasetOption,
    predictions: Annotated[Path, typer.Option(help="Predictions, the output of `distill infer`.")],
    out: options.Out,
    bertscore_en: Annotated[
        Path | None,
        typer.Option(help="Local model folder for BERTScore of English (roberta-large); none: not computed."),
    ] = None,
    bertscore_zh: Annotated[
        Path | None,
        typer.Option(help="Local model folder for BERTScore of Chinese (bert-base-chinese); none: not computed."),
    ] = None,
    judged: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]CAPTIONS",
            help="captions.jsonl that `caption --teacher student:` made of these predictions, one a tree; of a floor's as shuffled=... or constant=...",
        ),
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    verify: options.Verify = False,
    resume: options.Resume = "if-same",
) -> None:
    """Parse rate, decisions, verdicts on the true future, BERTScore and evidence, each beside its floors and with its interval."""
    from distill.evaluation import stage as evaluate

    cfg = options.resolve(config, overrides, {"seed": seed})
    options.verify_first(verify, predictions, dataset, out)
    models = {"en": bertscore_en, "zh": bertscore_zh}
    given: Any = {
        "bertscore_models": {language: folder for language, folder in models.items() if folder is not None},
        "judged": _by_name(map(_judged, judged or [])), "seed": cfg.seed, "resume": resume,
    }  # fmt: skip
    typer.echo(evaluate.run(cfg.distill.evaluate, predictions, dataset, out, **given))


def _by_name(given: Iterable[tuple[str, Path]]) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for name, path in given:
        found.setdefault(name, []).append(path)
    return found


def _judged(text: str) -> tuple[str, Path]:
    name, mark, path = text.partition("=")
    if not mark:
        return "student", Path(text)
    if name not in ("student", "shuffled", "constant"):
        raise typer.BadParameter(f"{name}: not student, shuffled or constant", param_hint="--judged")
    return name, Path(path)


@app.command("report")
def distill_report(
    evaluations: Annotated[
        list[Path], typer.Argument(help="Folders of `distill evaluate`, one a student; their names name the rows.")
    ],
    out: options.Out,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    resume: options.Resume = "if-same",
) -> None:
    """Students side by side: the trade-off table, and differences by paired bootstrap over walks."""
    from distill.evaluation import compare

    cfg = options.resolve(config, overrides, {"seed": seed})
    typer.echo(compare.run(cfg.distill.report, evaluations, out, seed=cfg.seed, resume=resume))
