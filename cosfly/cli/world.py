"""The command `cosfly world`: from a prompt to one or more worlds, and on to a data set."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import WORKERS, Job, Short, takes

app = typer.Typer()


@app.command(epilog='cosfly world "a small village by a river" --out village')
@takes(
    "world",
    f"seed {WORKERS} resume",
    planner=Short("world.planner", "Language model that plans the world; none: embedded rules.", metavar="URL"),
    model=Short("world.model", "Name of the language model."),
)
def world(
    job: Job,
    prompt: Annotated[str, Argument(help="The world, in plain English.")],
    out: Annotated[Path | None, Option(show_default="worlds/<prompt>-<time>", help="New folder.")] = None,
    count: Annotated[int, Option(min=1, max=1000, help="Number of worlds, each with its own seed.")] = 1,
    run: Annotated[bool, Option("--run", help="Also make a data set in it, as `cosfly run` does.")] = False,
) -> None:
    """Make a world from text: SimWorld's combined_world.json of the town that a prompt describes."""
    from cosfly.runtime.config import build
    from cosfly.worldgen import stage

    words = "-".join(re.findall(r"[a-z0-9]+", prompt.lower())[:5]) or "world"
    out = out or Path("worlds") / f"{words[:40]}-{time.strftime('%Y%m%d-%H%M%S')}"
    cfg = build(type(job.cfg.world), job.cfg.world.model_dump() | {"prompt": prompt}, "world")
    folders = [out] if count == 1 else [out / f"world_{number:03}" for number in range(count)]
    for number, folder in enumerate(folders):
        job.finish(stage.run(cfg, folder, seed=job.cfg.seed + number, resume=job.resume), folder)
    if run:
        for number, folder in enumerate(folders):
            _make_data_set(job, folder, job.cfg.seed + number)


def _make_data_set(job: Job, folder: Path, seed: int) -> None:
    """Run all stages on a world, with a region of interest that is proposed from the simplified map."""
    from cosfly.cli.run import print_results
    from cosfly.pedestrians.roi_editor import run_propose
    from cosfly.pipeline import run as pipeline
    from cosfly.worldgen.stage import LOOP_FILE

    given: dict[str, Any] = {"workers": job.cfg.workers, "engine": job.cfg.engine, "ray.address": job.cfg.ray.address}
    given["seed"] = seed
    cfg, out = options.resolve(folder / LOOP_FILE, job.overrides, given), folder / "run"
    for first in pipeline.stages(cfg, out)[:2]:
        first.work()
    roi = out / "roi_polygon.json"
    if not roi.exists():
        run_propose(out / "simplify/step2_simplified.json", cfg.pedestrians, roi)
    cfg = options.resolve(folder / LOOP_FILE, job.overrides, given | {"roi": roi})
    print_results(pipeline.run(cfg, out), out)
