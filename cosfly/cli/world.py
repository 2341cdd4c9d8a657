"""The command `cosfly world`: from a prompt to a world, to several, and on to a data set."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import WORKERS, Job, Sets, takes

app = typer.Typer()


@app.command()
@takes("seed", *WORKERS, "resume")
def world(
    job: Job,
    prompt: Annotated[str, Argument(help="What the world shall be, in plain English."), Sets("world.prompt")],
    out: Annotated[
        Path | None, Option(show_default="worlds/<prompt>-<time>", help="New folder for the world, or the worlds.")
    ] = None,
    planner: Annotated[
        str | None, Option(metavar="URL", help="Language model that plans; none: rules."), Sets("world.planner")
    ] = None,
    model: Annotated[str | None, Option(help="Its name."), Sets("world.endpoint.model")] = None,
    count: Annotated[int, Option(min=1, max=1000, help="So many worlds, each of a seed of its own.")] = 1,
    run: Annotated[
        bool, Option("--run", help="Go on: walks, flights, frames and all that `cosfly run` makes, with --set.")
    ] = False,
) -> None:
    """Text to world: a town that a prompt describes, as SimWorld's combined_world.json."""
    from cosfly.worldgen import stage

    words = "-".join(re.findall(r"[a-z0-9]+", prompt.lower())[:5]) or "world"
    out = out or Path("worlds") / f"{words[:40]}-{time.strftime('%Y%m%d-%H%M%S')}"
    folders = [out] if count == 1 else [out / f"world_{number:03}" for number in range(count)]
    for number, folder in enumerate(folders):
        job.finish(stage.run(job.cfg.world, folder, seed=job.cfg.seed + number, resume=job.resume), folder)
    if run:
        for number, folder in enumerate(folders):
            _go_on(job, folder, job.cfg.seed + number)


def _go_on(job: Job, folder: Path, seed: int) -> None:
    """Do the rest of the loop: a first region is proposed from the simplified map, then all stages follow."""
    from cosfly.cli.run import _closing_table
    from cosfly.pedestrians.roi_editor import run_propose
    from cosfly.pipeline import run as pipeline
    from cosfly.worldgen.stage import LOOP_FILE

    told = list(job.overrides)
    where: dict[str, Any] = {"workers": job.cfg.workers, "engine": job.cfg.engine, "ray.address": job.cfg.ray.address}
    given = where | {"seed": seed}
    cfg, out = options.resolve(folder / LOOP_FILE, told, given), folder / "run"
    for first in pipeline.stages(cfg, out)[:2]:
        first.work()
    roi = out / "roi_polygon.json"
    if not roi.exists():
        run_propose(out / "simplify/step2_simplified.json", cfg.pedestrians, roi)
    cfg = options.resolve(folder / LOOP_FILE, told, given | {"roi": roi})
    _closing_table(pipeline.run(cfg, out), out)
