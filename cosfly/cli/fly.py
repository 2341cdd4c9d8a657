"""The command `cosfly fly`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, Sets, takes

app = typer.Typer()

STUDENT = "rules, a URL, vllm:MODEL_DIR, transformers:MODEL_DIR; floors: track_straight, random; ceiling: planner."


@app.command()
@takes(*STAGE)
def fly(
    job: Job,
    out: options.Out,
    map_: Annotated[Path | None, Option("--map", help="Boxes that are drawn: boxes_3d.json.")] = None,
    paths: Annotated[Path | None, Option(help="Walks: path.json.")] = None,
    env: Annotated[
        str | None, Option(help="A benchmark's list of episodes in place of map and walks: cosfly/Follow-v0.")
    ] = None,
    policy: Annotated[
        str | None, Option(metavar="MODULE:CLASS", help="Of yours, in place of --student: runs its code.")
    ] = None,
    student: Annotated[str | None, Option(show_default="rules", help=STUDENT), Sets("fly.student")] = None,
    as_student: Annotated[
        Path | None,
        Option(help="Folder of `distill train` or `merge`: who is behind a URL."),
        Sets("fly.as_student"),
    ] = None,
    adapter: Annotated[Path | None, Option(help="Of transformers:MODEL_DIR."), Sets("fly.adapter")] = None,
    simplified: Annotated[
        Path | None, Option(show_default="that of --map", help="Boxes that are flown in: step2_simplified.json.")
    ] = None,
    others: Annotated[Path | None, Option(help="Who else moves: others.json, beside path.json.")] = None,
    relabel: Annotated[
        Path | None, Option(help="Folder of `cosfly fly`: the planner goes on from where that student was.")
    ] = None,
) -> None:
    """A student flies: its decisions move the drone, and what it then sees is drawn. Records of all, and their tree."""
    from cosfly.closed_loop import stage

    if policy and student:
        raise typer.BadParameter("either --policy or --student flies")
    cfg = job.cfg
    flown = cfg.fly.model_copy(update={"student": f"policy:{policy}"}) if policy else cfg.fly
    run = stage.ClosedLoopConfig(
        fly=flown, plan=cfg.plan, render=cfg.render, caption=cfg.caption, infer=cfg.distill.infer
    )
    if relabel is not None:
        if map_ is None or paths or env or policy or student:
            raise typer.BadParameter("--relabel takes --map, and who flew where stands in its folder")
        from cosfly.closed_loop.relabel import run as replan

        job.finish(replan(run, relabel, map_, simplified or map_, out, **job.worker_options), out)
        return
    if env is not None:
        if map_ or paths or simplified or others:
            raise typer.BadParameter("--env has its own maps and walks")
        from cosfly.envs import listed

        job.finish(listed.run(listed.ListConfig(**dict(run), env=env), out, seed=cfg.seed, **job.worker_options), out)
        return
    if map_ is None or paths is None:
        raise typer.BadParameter("--map and --paths are needed, or --env")
    job.finish(
        stage.run(run, map_, simplified or map_, paths, out, seed=cfg.seed, others=others, **job.worker_options), out
    )


@app.command()
@takes("seed", "resume")
def leaderboard(
    job: Job,
    folders: Annotated[
        list[str], Argument(metavar="[NAME=]DIR...", help="Folders of `cosfly fly`; those of one name are one student.")
    ],
    out: options.Out,
    rounds: Annotated[
        bool, Option("--rounds", help="They are rounds of one student, in order: the gain of each.")
    ] = False,
) -> None:
    """Students side by side: figures with intervals, and frames of their best and worst flights."""
    from cosfly.closed_loop import leaderboard as board

    named = [
        (text.partition("=")[0], Path(text.partition("=")[2])) if "=" in text else ("", Path(text)) for text in folders
    ]
    cfg = board.LeaderboardConfig(rounds=rounds)
    typer.echo(board.run(cfg, named, out, seed=job.cfg.seed, resume=job.resume))
