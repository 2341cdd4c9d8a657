"""The sweep over the beam of TA*+Smooth (subsec:appendix_planner_tastar): the same pedestrians at each beam.

Each beam is compared with the paper's on the pedestrians that both can follow, so that failures of a beam do not
improve its figures. Search and smoothing are timed by themselves. Only the journal holds the times, because they differ
from run to run.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

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
BEAMS = (64, 256, 512, 1024, PAPER_BEAM, 4096)
NUM_RESAMPLES, INTERVAL_PERCENT = 1000, (2.5, 97.5)  # of pedestrian trajectories, for intervals (Efron 1979)
FIGURES = ("five_ray_mean", "length_m", "jerk_rms_mps3", "clearance_min_m")


class Planned(BaseModel):
    """The outcome for one pedestrian at one beam."""

    figures: dict[str, float] | None = None  # values of FIGURES; None if no trajectory was found
    reason: str | None = None  # of a dropped trajectory; None if it was accepted
    times_ms: dict[str, float] = {}  # of `search` and `smooth`


class PlannedByBeam(BaseModel):
    """Journal entry of one pedestrian."""

    flown: dict[str, Planned]


def make_worker(cfg: PlanConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; return the function that plans one pedestrian at each beam."""
    from cosfly.planners.smoothing import smooth_trajectory
    from cosfly.planners.track_astar import search_trajectory

    obstacles, screens = load_obstacles(simplified_map)
    settings = {}
    for beam in BEAMS:
        track_astar = cfg.track_astar.model_copy(update={"beam": beam})
        settings[str(beam)] = cfg.model_copy(update={"planner": "track_astar", "track_astar": track_astar})
    warm_up(settings[str(PAPER_BEAM)])

    def plan(pedestrian: Any, styles: list[str], beam_cfg: PlanConfig) -> Planned:
        try:
            trace = plan_trajectory(pedestrian, obstacles, beam_cfg, seed, screens, styles)
        except NoPathError:
            return Planned(reason="no_path")
        scenario = make_scenario(pedestrian, obstacles, beam_cfg)
        times_s = [time.perf_counter()]
        raw = search_trajectory(scenario, obstacles, beam_cfg, beam_cfg.safety_distance_m)
        times_s.append(time.perf_counter())
        if raw is not None:
            smooth_trajectory(raw[0], scenario, obstacles, beam_cfg, beam_cfg.safety_distance_m)
            times_s.append(time.perf_counter())
        times_ms = (1000.0 * np.diff(times_s)).round(2).tolist()
        figures = {name: float(trace.metrics[name]) for name in FIGURES}
        return Planned(
            figures=figures, reason=trace.drop_reason, times_ms=dict(zip(("search", "smooth"), times_ms, strict=False))
        )

    def work(item: Item) -> Outcome:
        pedestrian, styles = item.payload
        planned = {beam: plan(pedestrian, styles, beam_cfg) for beam, beam_cfg in settings.items()}
        return Outcome(PlannedByBeam(flown=planned).model_dump())

    return work


def run(
    cfg: PlanConfig, simplified_map: Path, paths: Path, out: Path, *, seed: int = 0, resume: Resume = "if-same",
    **pool: Any,
) -> Path:  # fmt: skip
    """Read a simplified map and `path.json`; write `beam_study.json` and return its path."""
    inputs = {"map": simplified_map, "paths": paths}
    product = out / "beam_study.json"
    stage = StageFolder.open(out, "beam_study", config=cfg, inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return product
    items = make_items(read_inputs(simplified_map, paths)[1], cfg, seed)
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), **pool)
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally)
    results = [result_of(record, PlannedByBeam).flown for record in finished.kept]
    planned = {beam: [result[str(beam)] for result in results] for beam in BEAMS}
    rows = summarize(planned, rng_for(seed, "beam_study", "intervals"))
    write_json(product, {**FORMAT.header, "seed": seed, "settings": cfg.all_values(), "beams": rows})
    stage.finish([product], finished.tally)
    return product


def summarize(planned: dict[int, list[Planned]], rng: np.random.Generator) -> dict[int, dict[str, Any]]:
    """Count the pedestrians that each beam can follow, and compare its figures with those of the paper's beam.

    Args:
        planned: beam -> outcomes of the same pedestrians in the same order.
    Returns:
        beam -> `walks`, `kept`, and by figure `mean` and `difference` with `low` and `high` of its 95 % interval.
    """
    rows = {}
    for beam, outcomes in planned.items():
        pairs = zip(outcomes, planned[PAPER_BEAM], strict=True)
        both = [[list(p.figures.values()) for p in pair if p.figures] for pair in pairs]
        table = np.array([pair for pair in both if len(pair) == 2])  # (n, 2, figures)
        draws = rng.integers(max(len(table), 1), size=(NUM_RESAMPLES, len(table)))
        figures = {}
        for k, name in enumerate(FIGURES if len(table) else ()):
            differences = table[:, 0, k] - table[:, 1, k]
            low, high = np.percentile(differences[draws].mean(axis=1), INTERVAL_PERCENT)
            row = {"mean": table[:, 0, k].mean(), "difference": differences.mean(), "low": low, "high": high}
            figures[name] = {what: round(float(value), 4) for what, value in row.items()}
        kept = sum(outcome.reason is None for outcome in outcomes)
        rows[beam] = {"walks": len(outcomes), "kept": kept, "figures": figures}
    return rows
