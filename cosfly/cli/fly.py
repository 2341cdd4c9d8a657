"""The command `cosfly fly`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosfly.cli import options
from cosfly.cli.options import STAGE, Job, Sets, takes

app = typer.Typer()

STUDENT = "rules, a URL, vllm:MODEL_DIR, transformers:MODEL_DIR; floors: track_straight, random; ceiling: planner."


@app.command()
@takes(*STAGE)
def fly(
    job: Job,
    map_: Annotated[Path, Option("--map", help="Boxes that are drawn: boxes_3d.json.")],
    paths: Annotated[Path, Option(help="Walks: path.json.")],
    out: options.Out,
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
) -> None:
    """A student flies: its decisions move the drone, and what it then sees is drawn. Records of all, and their tree."""
    from cosfly.closed_loop import stage

    cfg = job.cfg
    run = stage.FlightsConfig(
        fly=cfg.fly, plan=cfg.plan, render=cfg.render, caption=cfg.caption, infer=cfg.distill.infer
    )
    job.begin(out, map_, simplified, paths, others)
    job.finish(stage.run(run, map_, simplified or map_, paths, out, seed=cfg.seed, others=others, **job.manner), out)
