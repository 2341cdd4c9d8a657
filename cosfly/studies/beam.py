"""The sweep over the beam of TA*+Smooth (subsec:appendix_planner_tastar): the same pedestrians at each beam.

Each beam is compared with the paper's beam on the pedestrians that both can follow. Failures of one beam therefore do
not improve its figures.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, field_validator

from cosfly.planners.compare import NUM_RESAMPLES, interval
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import load_obstacles, make_items, make_scenario, plan_trajectory, read_inputs, warm_up
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.pool import run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work

FORMAT = FileFormat("cosfly.beam_study", "1.0")
PAPER_BEAM = 2048
FIGURES = ("five_ray_mean", "length_m", "jerk_rms_mps3", "clearance_min_m")


class BeamConfig(PlanConfig):
    """Settings of the study: the beams, and the settings of step 4, whose planner and beam are replaced."""

    beams: tuple[int, ...] = Field((64, 256, 512, 1024, PAPER_BEAM, 4096), description="beams of TA*'s search")

    @field_validator("beams")
    @classmethod
    def _include_papers_beam(cls, beams: tuple[int, ...]) -> tuple[int, ...]:
        if PAPER_BEAM not in beams:
            raise ValueError(f"beams must include the paper's {PAPER_BEAM}, because the others are compared with it")
        return beams

    def at_beam(self, beam: int) -> PlanConfig:
        """Return the settings of the planner at a beam."""
        track_astar = self.track_astar.model_copy(update={"beam": beam})
        return self.model_copy(update={"planner": "track_astar", "track_astar": track_astar})


class Planned(BaseModel):
    """The outcome for one pedestrian at one beam."""

    figures: dict[str, float] | None = None  # values of FIGURES; None if no trajectory was found
    reason: str | None = None  # of a dropped trajectory; None if it was accepted
    times_ms: dict[str, float] = {}  # of `search` and `smooth`, from a second run of each


class _Result(BaseModel):
    """The journal's record of one pedestrian, by beam."""

    flown: dict[str, Planned]


def make_worker(cfg: BeamConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; return the function that plans one pedestrian at each beam."""
    from cosfly.planners.smoothing import smooth_trajectory
    from cosfly.planners.track_astar import search_trajectory

    obstacles, screens = load_obstacles(simplified_map)
    warm_up(cfg.at_beam(PAPER_BEAM))

    def plan(pedestrian: Any, styles: list[str], plan_cfg: PlanConfig) -> Planned:
        try:
            trace = plan_trajectory(pedestrian, obstacles, plan_cfg, seed, screens, styles)
        except NoPathError:
            return Planned(reason="no_path")
        scenario = make_scenario(pedestrian, obstacles, plan_cfg)
        times_ms: dict[str, float] = {}
        with _timed(times_ms, "search"):
            trajectory = search_trajectory(scenario, obstacles, plan_cfg, plan_cfg.safety_distance_m)
        if trajectory is not None:
            with _timed(times_ms, "smooth"):
                smooth_trajectory(trajectory[0], scenario, obstacles, plan_cfg, plan_cfg.safety_distance_m)
        figures = {name: float(trace.metrics[name]) for name in FIGURES}
        return Planned(figures=figures, reason=trace.drop_reason, times_ms=times_ms)

    def work(item: Item) -> Outcome:
        pedestrian, styles = item.payload
        planned = {str(beam): plan(pedestrian, styles, cfg.at_beam(beam)) for beam in cfg.beams}
        return Outcome(_Result(flown=planned).model_dump())

    return work


@contextmanager
def _timed(times_ms: dict[str, float], name: str) -> Iterator[None]:
    """Store the wall time of a block under a name, in milliseconds."""
    start_s = time.perf_counter()
    yield
    times_ms[name] = round(1000.0 * (time.perf_counter() - start_s), 2)


def run(
    cfg: BeamConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, resume: Resume = "if-same",
    **pool: Any,
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `beam_study.json` and return its path.

    Only the journal holds the times, because they differ from run to run.

    Args:
        pool: `workers` and `watch` of `run_items`.

    Raises:
        InputError: If an input is malformed.
        NothingKept: If there is no pedestrian trajectory.
    """
    inputs = {"map": simplified_map, "paths": paths}
    product = out / "beam_study.json"
    stage = StageFolder.open(out, "beam_study", config=cfg, inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return product
    items = make_items(read_inputs(simplified_map, paths)[1], cfg, seed)
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), **pool)
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally)
    results = [result_of(record, _Result).flown for record in finished.kept]
    planned = {beam: [result[str(beam)] for result in results] for beam in cfg.beams}
    rows = summarize(planned, rng_for(seed, "beam_study", "intervals"))
    write_json(product, {**FORMAT.header, "seed": seed, "settings": cfg.all_values(), "beams": rows})
    stage.finish([product], finished.tally)
    return product


def summarize(planned: dict[int, list[Planned]], rng: np.random.Generator) -> dict[int, dict[str, Any]]:
    """Count the pedestrians that each beam can follow, and compare its figures with those of the paper's beam.

    Args:
        planned: beam -> outcomes of the same pedestrians in the same order; PAPER_BEAM is one of the beams.

    Returns:
        beam -> `walks`, `kept`, and by figure `mean` and `difference` with `low` and `high` of its 95 % interval, over
        pedestrians drawn with replacement (Efron 1979).
    """
    rows = {}
    for beam, outcomes in planned.items():
        pairs = [
            (outcome.figures, paper.figures)
            for outcome, paper in zip(outcomes, planned[PAPER_BEAM], strict=True)
            if outcome.figures and paper.figures
        ]
        draws = rng.integers(max(len(pairs), 1), size=(NUM_RESAMPLES, len(pairs)))
        figures = {}
        for figure in FIGURES if pairs else ():
            values = np.array([beam_figures[figure] for beam_figures, _ in pairs])
            differences = values - np.array([paper_figures[figure] for _, paper_figures in pairs])
            low, high = interval(differences[draws].mean(axis=1))
            figures[figure] = {
                "mean": round(float(values.mean()), 4),
                "difference": round(float(differences.mean()), 4),
                "low": low,
                "high": high,
            }
        kept = sum(outcome.reason is None for outcome in outcomes)
        rows[beam] = {"walks": len(outcomes), "kept": kept, "figures": figures}
    return rows
