"""The commands `cosfly fly` and `cosfly leaderboard`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, Short, takes

app = typer.Typer()

STUDENTS = "rules, a URL, vllm:MODEL_DIR, transformers:MODEL_DIR; baselines: track_straight, random; ceiling: planner."


@app.command(epilog="cosfly fly --map maps/boxes_3d.json --paths pedestrians/path.json --student rules --out flown")
@takes(
    "fly plan render caption distill",
    STAGE,
    student=Short("fly.student", STUDENTS, default="rules"),
    as_student=Short("fly.as_student", "Folder of `distill train` or `merge`: the model behind a URL.", Path),
    adapter=Short("fly.adapter", "Adapter of transformers:MODEL_DIR.", Path),
)
def fly(
    job: Job,
    out: options.Out,
    map_: Annotated[Path | None, Option("--map", help="Boxes that are drawn: boxes_3d.json.")] = None,
    paths: Annotated[Path | None, Option(help="Pedestrian trajectories: path.json.")] = None,
    env: Annotated[str | None, Option(help="Benchmark instead of map and paths: cosfly/Follow-v0.")] = None,
    policy: Annotated[str | None, Option(metavar="MODULE:CLASS", help="Policy to import and run.")] = None,
    simplified: Annotated[Path | None, Option(help="Simplified map for collisions; by default --map.")] = None,
    others: options.Bystanders = None,
    relabel: Annotated[Path | None, Option(help="Output of `cosfly fly` to relabel by the planner.")] = None,
) -> None:
    """Fly a student in a closed loop: its decisions move the drone, and the new view is drawn."""
    from cosfly.closed_loop import stage

    cfg = job.cfg
    if policy and (cfg.fly.student != "rules" or "fly.student" in job.given):
        raise typer.BadParameter("give either --policy or --student")
    flown = cfg.fly.model_copy(update={"student": f"policy:{policy}"}) if policy else cfg.fly
    run = stage.ClosedLoopConfig(
        fly=flown, plan=cfg.plan, render=cfg.render, caption=cfg.caption, infer=cfg.distill.infer
    )
    how = job.worker_options
    if relabel is not None:
        if map_ is None or paths or env or policy:
            raise typer.BadParameter("--relabel takes --map only; its folder holds the rest")
        from cosfly.closed_loop import relabel as relabelling

        product = relabelling.run(run, relabel, map_, simplified or map_, out, **how)
    elif env is not None:
        if map_ or paths or simplified or others:
            raise typer.BadParameter("--env has its own maps and pedestrians")
        from cosfly.envs import listed

        product = listed.run(listed.ListConfig(**dict(run), env=env), out, seed=cfg.seed, **how)
    elif map_ is None or paths is None:
        raise typer.BadParameter("give --map and --paths, or --env")
    else:
        product = stage.run(run, map_, simplified or map_, paths, out, seed=cfg.seed, others=others, **how)
    job.finish(product, out)


@app.command(epilog="cosfly leaderboard rules=flown0 student=flown1 --out board")
@takes("", "seed resume")
def leaderboard(
    job: Job,
    folders: Annotated[list[str], Argument(metavar="[NAME=]DIR...", help="Outputs of `cosfly fly`, by student.")],
    out: options.Out,
    rounds: Annotated[bool, Option("--rounds", help="They are rounds of one student, in order.")] = False,
) -> None:
    """Compare students: figures with intervals, and frames of their best and worst trajectories."""
    from cosfly.closed_loop import leaderboard as board

    named = [
        (name if is_named else "", Path(folder if is_named else name))
        for name, is_named, folder in (text.partition("=") for text in folders)
    ]
    cfg = board.LeaderboardConfig(rounds=rounds)
    typer.echo(board.run(cfg, named, out, seed=job.cfg.seed, resume=job.resume))
