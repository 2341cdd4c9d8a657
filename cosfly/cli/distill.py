"""The commands `cosfly distill ...` of students, and `cosfly fly` and `cosfly leaderboard`, which measure them."""

import os
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, SettingOption, command

options.add_group("distill", "Train a small student: training set, LoRA, inference, evaluation.")

Dataset = Annotated[Path, Option(help="Training set: the output of `distill prepare`.")]
STUDENTS = "Model folder, GGUF file, repository such as Qwen/Qwen3.5-2B, or tiny (random weights)."
JUDGED = "captions.jsonl of `caption --teacher student:PATH`, one per tree; repeat it."
LIMIT = SettingOption("distill.prepare.limit", "Windows in all splits, chosen at random; 0 for all.", int)


@command("cosfly distill prepare runs/diverse --out dataset", "distill", "seed", limit=LIMIT)
def prepare(
    job: Job,
    out: options.Out,
    runs: options.Runs = None,
    captions: Annotated[list[Path] | None, Option(help="captions.jsonl of a tree; repeat both for several.")] = None,
    data: options.Trees = None,
) -> None:
    """Make a training set from the captions of one or more runs, with splits that share no pedestrian."""
    from distill.prepare.stage import RunSource

    sources = [RunSource.of_run(folder) for folder in options.each_run(runs)]
    if captions or data or not sources:
        trees = job.trees(data)
        if len(trees) != len(captions or []):
            raise typer.BadParameter("pass one --captions for each --data, or pass run directories")
        sources += [RunSource(*files) for files in zip(trees, captions or [], strict=True)]
    job.run("distill.prepare.stage", job.cfg.distill.prepare, sources, out)


@command("cosfly distill dual-track runs/diverse --out windows", "distill", "seed")
def dual_track(job: Job, out: options.Out, runs: options.Runs = None, data: options.Trees = None) -> None:
    """Make windows over clean and perturbed tracks, by split, to learn denoising and prediction from."""
    trees = [folder / "render" for folder in options.each_run(runs)]
    if data or not trees:
        trees += job.trees(data)
    job.run("distill.prepare.dual_track", job.cfg.distill.dual_track, trees, out)


def _trees(job: Job, dataset: Path, data: list[Path] | None) -> list[Path]:
    """Return the playback trees of a training set; none if its samples have no pictures."""
    from distill.schema import read_training_set

    return job.trees(data) if data or read_training_set(dataset).trees else []


@command("cosfly distill train --dataset dataset --student Qwen/Qwen3.5-2B --out student", "distill", "seed")
def train(
    job: Job,
    dataset: Dataset,
    student: Annotated[str, Option(help=STUDENTS)],
    out: options.Out,
    data: options.Trees = None,
) -> None:
    """Train a student, by LoRA or in full, in one process or many (torchrun); resume from its last checkpoint."""
    trees = _trees(job, dataset, data)
    product = job.call("distill.training.stage", job.cfg.distill.train, dataset, trees, student, out)
    if os.environ.get("RANK", "0") == "0":  # the first of the processes that `torchrun` started
        typer.echo(product)


ENGINE = SettingOption("distill.infer.engine", "transformers, endpoint (a server) or vllm.", default="transformers")
INFER = "cosfly distill infer --dataset dataset --model Qwen/Qwen3.5-2B --out predictions"


@command(INFER, "distill", engine=ENGINE)
def infer(
    job: Job,
    dataset: Dataset,
    model: Annotated[str, Option(help="Base model: folder, repository or GGUF file; with --engine endpoint a URL.")],
    out: options.Out,
    adapter: Annotated[Path | None, Option(help="Adapter folder; none: the base model alone.")] = None,
    data: options.Trees = None,
) -> None:
    """Run a student on the samples of a split; resume where it stopped."""
    cfg = job.cfg.distill.infer
    job.run("distill.inference.stage", cfg, dataset, _trees(job, dataset, data), model, out, adapter=adapter)


@command("cosfly distill merge --model models/Qwen3.5-2B --adapter student/adapter --out merged")
def merge(
    job: Job,
    model: Annotated[Path, Option(help="Base model of the student: folder, repository or GGUF file.")],
    adapter: Annotated[Path, Option(help="Adapter folder, the output of `distill train`.")],
    out: options.Out,
) -> None:
    """Merge an adapter into its base: a model folder for transformers, vLLM and servers."""
    job.run("distill.inference.merge", model, adapter, out)


@command("cosfly distill evaluate --dataset dataset --predictions student-2B --out scores", common="seed")
def evaluate(
    job: Job,
    dataset: Dataset,
    predictions: Annotated[
        list[Path], Option(help="Output folder of `distill infer`; repeat it for several students.")
    ],
    out: options.Out,
    bertscore_en: Annotated[
        Path | None, Option(help="Encoder for BERTScore of English: roberta-large's folder.")
    ] = None,
    bertscore_zh: Annotated[Path | None, Option(help="Encoder for Chinese: bert-base-chinese's folder.")] = None,
    judged: Annotated[list[Path] | None, Option(help=JUDGED)] = None,
) -> None:
    """Score and compare students: decisions, verdicts, BERTScore and values, with baselines and intervals."""
    folders = {"en": bertscore_en, "zh": bertscore_zh}
    encoders = {language: folder for language, folder in folders.items() if folder is not None}
    product = job.call("distill.evaluation.stage", predictions, dataset, out, encoders=encoders, judged=judged or [])
    for table in job.call("distill.evaluation.report:summary_tables", product):
        options.print_table(table.columns, table.rows, table.title)
    job.finish(product, out)


FLYING = "rules, a URL, vllm:MODEL_DIR, transformers:MODEL_DIR, policy:MODULE:CLASS, track_straight, random, planner."


@command(
    "cosfly fly --map maps/boxes_3d.json --paths pedestrians/path.json --student rules --out flown",
    "fly plan render caption distill",
    STAGE,
    student=SettingOption("fly.student", FLYING, default="rules"),
    as_student=SettingOption("fly.as_student", "Output of `distill train` or `merge`: the student behind a URL.", Path),
    adapter=SettingOption("fly.adapter", "Adapter of transformers:MODEL_DIR.", Path),
)
def fly(
    job: Job,
    out: options.Out,
    map_: Annotated[Path | None, Option("--map", help="Boxes that are drawn: boxes_3d.json.")] = None,
    paths: Annotated[Path | None, Option(help="Pedestrian trajectories: path.json.")] = None,
    env: Annotated[str | None, Option(help="Benchmark instead of map and paths: cosfly/Follow-v0.")] = None,
    simplified: Annotated[Path | None, Option(help="Simplified map for collisions; by default --map.")] = None,
    others: options.Bystanders = None,
    relabel: Annotated[Path | None, Option(help="Output of `cosfly fly` to relabel by the planner.")] = None,
) -> None:
    """Fly a student in a closed loop: its decisions move the drone, and the new view is drawn."""
    from cosfly.closed_loop.stage import ClosedLoopConfig

    cfg = job.cfg
    run = ClosedLoopConfig(fly=cfg.fly, plan=cfg.plan, render=cfg.render, caption=cfg.caption, infer=cfg.distill.infer)
    if relabel is not None:
        if map_ is None or paths or env:
            raise typer.BadParameter("--relabel needs --map, and does not allow --paths and --env")
        job.run("cosfly.closed_loop.relabel", run, relabel, map_, simplified or map_, out)
    elif env is not None:
        if map_ or paths or simplified or others:
            raise typer.BadParameter(
                "--env has its own maps and pedestrians; remove --map, --paths, --simplified and --others"
            )
        from cosfly.envs.listed import ListConfig

        job.run("cosfly.envs.listed", ListConfig(**dict(run), env=env), out)
    elif map_ is None or paths is None:
        raise typer.BadParameter("pass --map and --paths, or pass --env")
    else:
        job.run("cosfly.closed_loop.stage", run, map_, simplified or map_, paths, out, others=others)


@command("cosfly leaderboard rules=flown0 student=flown1 --out board")
def leaderboard(
    job: Job,
    folders: Annotated[list[str], Argument(metavar="[NAME=]DIR...", help="Outputs of `cosfly fly`, by student.")],
    out: options.Out,
) -> None:
    """Compare students: figures with intervals, floors and a ceiling."""
    parts = (text.partition("=") for text in folders)
    named = [(name, Path(folder)) if equals else ("", Path(name)) for name, equals, folder in parts]
    product = job.call("cosfly.closed_loop.leaderboard", named, out)
    for table in job.call("cosfly.closed_loop.leaderboard:summary_tables", product):
        options.print_table(table.columns, table.rows, table.title)
    job.finish(product, out)
