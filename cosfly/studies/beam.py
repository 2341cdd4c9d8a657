"""The sweep over the beam of TA*+Smooth (subsec:appendix_planner_tastar): the same pedestrians at each beam.

Differences are taken over the pedestrians that both a beam and the paper's beam can follow, so that a failure does not
make a beam look better.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

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
    """Settings of the study: those of step 4 but for planner and beam, and the beams."""

    beams: tuple[int, ...] = Field((64, 256, 512, 1024, PAPER_BEAM, 4096), description="beams of TA*'s search")

    def at_beam(self, beam: int) -> PlanConfig:
        """Return the settings of the planner at a beam."""
        track_astar = self.track_astar.model_copy(update={"beam": beam})
        return self.model_copy(update={"planner": "track_astar", "track_astar": track_astar})


class Planned(BaseModel):
    """One pedestrian at one beam. figures: None where no trajectory was found; reason: why it was dropped.

    times_ms: `search` and `smooth`, each measured once more by itself.
    """

    figures: dict[str, float] | None = None
    reason: str | None = None
    times_ms: dict[str, float] = {}


class _Result(BaseModel):
    flown: dict[str, Planned]


def make_worker(cfg: BeamConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; return the function that plans one pedestrian at each beam."""
    from cosfly.planners.smoothing import smooth_trajectory
    from cosfly.planners.track_astar import search_trajectory

    obstacles, screens = load_obstacles(simplified_map)
    warm_up(cfg.at_beam(PAPER_BEAM))

    def plan(pedestrian: Any, styles: list[str], own: PlanConfig) -> Planned:
        try:
            trace = plan_trajectory(pedestrian, obstacles, own, seed, screens, styles)
        except NoPathError:
            return Planned(reason="no_path")
        scenario = make_scenario(pedestrian, obstacles, own)
        times_s = [time.perf_counter()]
        found = search_trajectory(scenario, obstacles, own, own.safety_distance_m)
        times_s.append(time.perf_counter())
        if found is not None:
            smooth_trajectory(found[0], scenario, obstacles, own, own.safety_distance_m)
            times_s.append(time.perf_counter())
        times_ms = dict(zip(("search", "smooth"), np.round(1000.0 * np.diff(times_s), 2).tolist(), strict=False))
        figures = {name: float(trace.metrics[name]) for name in FIGURES}
        return Planned(figures=figures, reason=trace.drop_reason, times_ms=times_ms)

    def work(item: Item) -> Outcome:
        pedestrian, styles = item.payload
        planned = {str(beam): plan(pedestrian, styles, cfg.at_beam(beam)) for beam in cfg.beams}
        return Outcome(_Result(flown=planned).model_dump())

    return work


def run(
    cfg: BeamConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, resume: Resume = "if-same",
    **pool: Any,
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `beam_study.json` and return its path.

    Times differ from run to run and are in the journal only.

    Args:
        pool: `workers` and `watch` of `run_items`.
    Raises:
        InputError: An input is malformed. NothingKept: There is no pedestrian trajectory.
    """
    inputs, product = {"map": simplified_map, "paths": paths}, out / "beam_study.json"
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
    """Return how many pedestrians each beam can follow, and its figures against those of the paper's beam.

    Args:
        planned: beam -> the same pedestrians in the same order; PAPER_BEAM is one of the beams.

    Returns:
        beam -> `walks`, `kept`, and by figure `mean` and `difference` with `low` and `high` of its 95 % interval, over
        pedestrians drawn with replacement (Efron 1979).
    """
    rows = {}
    for beam, many in planned.items():
        pairs = zip(many, planned[PAPER_BEAM], strict=True)
        both = [(a.figures, b.figures) for a, b in pairs if a.figures and b.figures]
        draws = rng.integers(max(len(both), 1), size=(NUM_RESAMPLES, len(both)))
        figures = {}
        for figure in FIGURES if both else ():
            own, base = (np.array([pair[k][figure] for pair in both]) for k in (0, 1))
            low, high = interval((own - base)[draws].mean(axis=1))
            mean, difference = (round(float(values.mean()), 4) for values in (own, own - base))
            figures[figure] = {"mean": mean, "difference": difference, "low": low, "high": high}
        kept = sum(one.reason is None for one in many)
        rows[beam] = {"walks": len(many), "kept": kept, "figures": figures}
    return rows
