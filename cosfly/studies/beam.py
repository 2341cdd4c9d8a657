"""The sweep over the beam of TA*+Smooth (subsec:appendix_planner_tastar): the same walks at each beam.

Differences are those of the walks that a beam and the paper's both fly, so that no walk that fails makes a beam look
better.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from cosfly.formats.boxes import read_boxes
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.planners.compare import INTERVAL_PERCENT, NUM_RESAMPLES
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import check_ids, draw_styles_of, make_scenario, plan_trajectory, warm_up
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item, Outcome, Work

FORMAT = FileFormat("cosfly.beam_study", "1.0")
PAPER_BEAM = 2048
FIGURES = ("five_ray_mean", "length_m", "jerk_rms_mps3", "clearance_min_m")


class BeamConfig(PlanConfig):
    """Settings of the study: those of step 4, whose planner and beam count for nothing here, and the beams."""

    beams: tuple[int, ...] = Field((64, 256, 512, 1024, PAPER_BEAM, 4096), description="beams of TA*'s search")

    def of(self, beam: int) -> PlanConfig:
        """Return the settings at a beam."""
        track_astar = self.track_astar.model_copy(update={"beam": beam})
        return self.model_copy(update={"planner": "track_astar", "track_astar": track_astar})


class Flown(BaseModel):
    """One walk at one beam. figures: None where no flight was found; reason: why it is not kept, None if it is.

    times_ms: `search` and `smooth`, each measured once more by itself.
    """

    figures: dict[str, float] | None = None
    reason: str | None = None
    times_ms: dict[str, float] = {}


class _Walk(BaseModel):
    flown: dict[str, Flown]


def make_worker(cfg: BeamConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; return the function that plans one walk at each beam."""
    from cosfly.geometry.kernels import obstacle_index
    from cosfly.planners.reacquire import screens_of
    from cosfly.planners.smoothing import smooth_trajectory
    from cosfly.planners.track_astar import search_trajectory

    box_map = read_boxes(simplified_map)
    obstacles, screens = obstacle_index(box_map), screens_of(box_map)
    warm_up(cfg.of(PAPER_BEAM))

    def fly(walk: Any, styles: list[str], own: PlanConfig) -> Flown:
        try:
            trace = plan_trajectory(walk, obstacles, own, seed, screens, styles)
        except NoPathError:
            return Flown(reason="no_path")
        scenario, begin_s = make_scenario(walk, obstacles, own), time.perf_counter()
        found = search_trajectory(scenario, obstacles, own, own.safety_distance_m)
        times_ms, begin_s = {"search": _since(begin_s)}, time.perf_counter()
        if found is not None:
            smooth_trajectory(found[0], scenario, obstacles, own, own.safety_distance_m)
            times_ms["smooth"] = _since(begin_s)
        figures = {name: float(trace.metrics[name]) for name in FIGURES}
        return Flown(figures=figures, reason=trace.drop_reason, times_ms=times_ms)

    def work(item: Item) -> Outcome:
        walk, styles = item.payload
        return Outcome({"flown": {str(beam): fly(walk, styles, cfg.of(beam)).model_dump() for beam in cfg.beams}})

    return work


def _since(begin_s: float) -> float:
    return round(1000.0 * (time.perf_counter() - begin_s), 2)


def run(
    cfg: BeamConfig,
    simplified_map: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Reads a simplified map and `path.json`, writes `beam_study.json`; returns its path.

    Times, which differ from run to run, are in the journal alone.

    Raises:
        InputError: a file is not what it must be. NothingKept: there is no walk.
    """
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "beam_study", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product = out / "beam_study.json"
    if stage.is_complete:
        return product
    walks = read_paths(paths)
    check_ids(walks, paths)
    items = [Item(w.path_id, (w, styles)) for w, styles in zip(walks, draw_styles_of(walks, cfg, seed), strict=True)]
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally)
    studied = [result_of(record, _Walk).flown for record in finished.kept]
    flown = {beam: [walk[str(beam)] for walk in studied] for beam in cfg.beams}
    rows = summarize(flown, rng_for(seed, "beam_study", "intervals"))
    write_json(product, {**FORMAT.header, "seed": seed, "settings": cfg.all_values(), "beams": rows})
    stage.finish([product], finished.tally)
    return product


def summarize(flown: dict[int, list[Flown]], rng: np.random.Generator) -> dict[int, dict[str, Any]]:
    """Return of each beam how many walks it flies and keeps, and its figures against those of the paper's beam.

    Args:
        flown: beam -> walks, the same in the same order; PAPER_BEAM is one of them.
    Returns:
        beam -> `walks`, `kept`, and by figure `mean` and `difference` with `low` and `high` of its 95 % interval, over
        walks drawn with replacement (Efron 1979).
    """
    rows = {}
    for beam, many in flown.items():
        pairs = [
            (a.figures, b.figures) for a, b in zip(many, flown[PAPER_BEAM], strict=True) if a.figures and b.figures
        ]
        draws = rng.integers(max(len(pairs), 1), size=(NUM_RESAMPLES, len(pairs)))
        figures = {}
        for figure in FIGURES if pairs else ():
            own, base = (np.array([pair[k][figure] for pair in pairs]) for k in (0, 1))
            low, high = np.percentile((own - base)[draws].mean(axis=1), INTERVAL_PERCENT)
            found = {"mean": own.mean(), "difference": (own - base).mean(), "low": low, "high": high}
            figures[figure] = {part: round(float(value), 4) for part, value in found.items()}
        kept = sum(one.reason is None for one in many)
        rows[beam] = {"walks": len(many), "kept": kept, "figures": figures}
    return rows
