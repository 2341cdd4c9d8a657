"""The same walks under other settings of step 4, one change at a time: the sweep over the beam of TA*+Smooth.

Differences are those of the walks that a variant and the settings as they are both fly, so that no walk that fails
makes a variant look better.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from cosfly.errors import NoPathError
from cosfly.planners.compare import INTERVAL_PERCENT, NUM_RESAMPLES, flight_figures
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import check_ids, draw_styles_of, make_scenario, plan_flight, warm_up
from cosfly.products.boxes import read_boxes
from cosfly.products.walks import read_paths
from cosfly.reading.documents import FileFormat
from cosfly.work.chance import rng_for
from cosfly.work.config import apply_overrides, build
from cosfly.work.runner import Item, Outcome, Watch, Work, run_items
from cosfly.work.stage_folder import Resume, StageFolder, result_of
from cosfly.work.store import write_json

FORMAT = FileFormat("cosfly.plan_variants", "1.0")
AS_SET = "as set"
# What is told of a variant: name, title, digits.
SHOWN = (
    ("five_ray_mean", "average visibility", 3),
    ("length_m", "path length, m", 1),
    ("jerk_rms_mps3", "jerk RMS, m/s3", 3),
    ("clearance_min_m", "least clearance, m", 2),
    ("target_distance_mean_m", "target distance, m", 2),
    ("altitude_mean_m", "altitude, m", 2),
)


class VariantsConfig(PlanConfig):
    """Settings of a study: those of step 4, and what is changed in each variant."""

    variants: dict[str, tuple[str, ...]] = Field(
        description="name -> changes of settings of step 4, as in --set: a.b=c"
    )

    def of(self, name: str) -> PlanConfig:
        """Give the settings of a variant."""
        plain = self.model_dump(mode="json", exclude={"variants"})
        return build(PlanConfig, apply_overrides(plain, self.variants[name]), f"the variant {name}")


def beam_study(cfg: PlanConfig, beams: tuple[int, ...]) -> VariantsConfig:
    """Give the study of the beam of TA*'s search; the settings' own is the one that the others are held against."""
    others = {f"beam {beam}": (f"track_astar.beam={beam}",) for beam in beams if beam != cfg.track_astar.beam}
    settings = cfg.model_dump() | {"planner": "track_astar", "variants": {AS_SET: (), **others}}
    return build(VariantsConfig, settings, "the study")


# --- flights ----------------------------------------------------------------------------------------------------------


class Flown(BaseModel):
    """One walk under one variant. figures: None where no flight was found. reason: why it is not kept, None if it is.

    times_ms: `all` that planning took; of TA*+Smooth `search` and `smooth` alone, each measured once more by itself.
    """

    figures: dict[str, float] | None = None
    reason: str | None = None
    solver: dict[str, Any] = {}
    times_ms: dict[str, float]


class _Walk(BaseModel):
    flown: dict[str, Flown]


def make_worker(cfg: VariantsConfig, simplified_map: Path, seed: int) -> Work:
    """Load and index the map once; give the function that plans one walk under each variant."""
    from cosfly.planners.reacquire import screens_of
    from cosfly.planners.smoothing import smooth_flight
    from cosfly.planners.track_astar import search_flight
    from cosfly.space.kernels import obstacle_index

    box_map = read_boxes(simplified_map)
    obstacles, screens = obstacle_index(box_map), screens_of(box_map)
    settings = {name: cfg.of(name) for name in cfg.variants}
    for one in {(one.planner, one.muco.step): one for one in settings.values()}.values():
        warm_up(one)

    def fly(walk: Any, styles: list[str], own: PlanConfig) -> Flown:
        begin_s, times_ms = time.perf_counter(), dict[str, float]()
        try:
            trace = plan_flight(walk, obstacles, own, seed, screens, styles)
        except NoPathError:
            return Flown(reason="no_path", times_ms={"all": _since(begin_s)})
        times_ms["all"] = _since(begin_s)
        if own.planner == "track_astar":
            scenario, begin_s = make_scenario(walk, obstacles, own), time.perf_counter()
            found = search_flight(scenario, obstacles, own, own.safety_distance_m)
            times_ms["search"], begin_s = _since(begin_s), time.perf_counter()
            if found is not None:
                smooth_flight(found[0], scenario, obstacles, own, own.safety_distance_m)
                times_ms["smooth"] = _since(begin_s)
        figures = flight_figures(trace)
        return Flown(figures=figures, reason=trace.drop_reason, solver=trace.solver, times_ms=times_ms)

    def work(item: Item) -> Outcome:
        walk, styles = item.payload
        rows = {name: fly(walk, styles, own).model_dump() for name, own in settings.items()}
        return Outcome({"flown": rows})

    return work


def _since(begin_s: float) -> float:
    return round(1000.0 * (time.perf_counter() - begin_s), 2)


def run(
    cfg: VariantsConfig,
    simplified_map: Path,
    paths: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Reads a simplified map and `path.json`, writes `variants.json`; gives it.

    Times, which are other ones in every run, stand in the journal alone.

    Raises:
        InputError: a file is not what it must be. NothingKept: there is no walk.
    """
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_variants", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product = out / "variants.json"
    if stage.is_complete:
        return product
    walks = read_paths(paths)
    check_ids(walks, paths)
    items = [Item(w.path_id, (w, styles)) for w, styles in zip(walks, draw_styles_of(walks, cfg, seed), strict=True)]
    finished = run_items(stage, items, make_worker, (cfg, simplified_map, seed), workers=workers, watch=watch)
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally)
    studied = {record.id: result_of(record, _Walk).flown for record in finished.kept}
    flown = {name: [walk[name] for walk in studied.values()] for name in cfg.variants}
    rows = summarize(flown, rng_for(seed, "plan_variants", "intervals"))
    scenarios = [
        {"id": walk_id, **{name: one.model_dump(exclude={"times_ms"}) for name, one in walk.items()}}
        for walk_id, walk in studied.items()
    ]
    header = {"seed": seed, "settings": cfg.model_dump(mode="json", exclude={"variants"})}
    write_json(product, {**FORMAT.header, **header, "variants": rows, "scenarios": scenarios})
    stage.finish([product], finished.tally)
    return product


def summarize(flown: dict[str, list[Flown]], rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Give of each variant how many walks it flies and keeps, and its figures beside those of the settings as they are.

    Args:
        flown: variant -> walks, the same in the same order; AS_SET is one of them.
    Returns:
        variant -> `walks`, `kept`, `reasons`, and by figure `mean` and `difference` with `low` and `high` of its 95 %
        interval, over walks drawn with replacement (Efron 1979).
    """
    rows = {}
    for name, many in flown.items():
        pairs = [(a.figures, b.figures) for a, b in zip(many, flown[AS_SET], strict=True) if a.figures and b.figures]
        draws = rng.integers(max(len(pairs), 1), size=(NUM_RESAMPLES, len(pairs)))
        figures = {}
        for figure, _, _ in SHOWN if pairs else ():
            own, base = (np.array([pair[k][figure] for pair in pairs]) for k in (0, 1))
            low, high = np.percentile((own - base)[draws].mean(axis=1), INTERVAL_PERCENT)
            found = {"mean": own.mean(), "difference": (own - base).mean(), "low": low, "high": high}
            figures[figure] = {part: round(float(value), 4) for part, value in found.items()}
        reasons = dict(sorted(Counter(one.reason for one in many if one.reason).items()))
        kept = len(many) - sum(reasons.values())
        rows[name] = {"walks": len(many), "kept": kept, "reasons": reasons, "figures": figures}
    return rows
