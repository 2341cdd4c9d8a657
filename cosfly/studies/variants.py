"""The same walks under other settings of step 4, one change at a time: `cosfly study muco`, and the sweep over the beam
of TA*+Smooth.

MuCO's weights were set by hand, and the paper leaves their sensitivity to future work (subsec:appendix_planner_muco):
here each is taken at a quarter to four times its value, and at none, which takes its term out. The printed step flies
beside them. Differences are those of the walks that a variant and the settings as they are both fly, so that no walk
that fails makes a variant look better.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from cosfly.errors import NoPathError
from cosfly.look.topview import INK, PAPER, draw_dot, draw_line, draw_text, png_bytes
from cosfly.planners.compare import INTERVAL_PERCENT, NUM_RESAMPLES, flight_figures
from cosfly.planners.contract import MucoConfig, PlanConfig
from cosfly.planners.stage import check_ids, draw_styles_of, make_scenario, plan_flight, warm_up
from cosfly.products.boxes import read_boxes
from cosfly.products.segments import FOLLOW
from cosfly.products.walks import read_paths
from cosfly.reading.documents import FileFormat
from cosfly.work.chance import rng_for
from cosfly.work.config import apply_overrides, build
from cosfly.work.runner import Item, Outcome, Watch, Work, run_items
from cosfly.work.stage_folder import Resume, StageFolder, result_of
from cosfly.work.store import write_bytes, write_json

FORMAT = FileFormat("cosfly.plan_variants", "1.0")
AS_SET = "as set"
FACTORS = (0.0, 0.25, 0.5, 2.0, 4.0)
PRINTED_STEP = "printed step"
OF_STYLES = ("weight_bearing", "weight_beneath")  # nothing where all flights follow
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


def weight_study(cfg: PlanConfig) -> VariantsConfig:
    """Give the study of MuCO's weights: each times each of FACTORS, one at a time; and the step as it is printed."""
    unused = OF_STYLES if set(cfg.styles) == {FOLLOW} else ()
    weights = [name for name in MucoConfig.model_fields if name.startswith("weight_") and name not in unused]
    changes = {
        name_of(weight, factor): (f"muco.{weight}={factor * getattr(cfg.muco, weight):g}",)
        for weight in weights
        for factor in FACTORS
    }
    return _study(cfg, "muco", changes | {PRINTED_STEP: ("muco.step=paper",)})


def name_of(weight: str, factor: float) -> str:
    return f"{weight} x {factor:g}"


def beam_study(cfg: PlanConfig, beams: tuple[int, ...]) -> VariantsConfig:
    """Give the study of the beam of TA*'s search; the settings' own is the one that the others are held against."""
    others = {f"beam {beam}": (f"track_astar.beam={beam}",) for beam in beams if beam != cfg.track_astar.beam}
    return _study(cfg, "track_astar", others)


def _study(cfg: PlanConfig, planner: str, changes: Mapping[str, tuple[str, ...]]) -> VariantsConfig:
    settings = cfg.model_dump() | {"planner": planner, "variants": {AS_SET: (), **changes}}
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
    """Reads a simplified map and `path.json`, writes `variants.json` and, of weights, `variants.png`; gives the former.

    Times, which are other ones in every run, stand in the journal alone.

    Raises:
        InputError: a file is not what it must be. NothingKept: there is no walk.
    """
    inputs = {"map": simplified_map, "paths": paths}
    stage = StageFolder.open(out, "plan_variants", config=cfg, inputs=inputs, seed=seed, resume=resume)
    product, picture = out / "variants.json", out / "variants.png"
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
    weights = list(dict.fromkeys(name.partition(" x ")[0] for name in rows if " x " in name))
    tables = {"variants": rows, "changes": changes_of(rows, weights)}
    write_json(product, {**FORMAT.header, **header, **tables, "scenarios": scenarios})
    outputs = [product]
    if weights and rows[AS_SET]["figures"]:
        write_bytes(picture, draw_weights(rows, weights))
        outputs.append(picture)
    stage.finish(outputs, finished.tally)
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


# --- for people -------------------------------------------------------------------------------------------------------


def changes_of(rows: dict[str, dict[str, Any]], weights: list[str]) -> dict[str, dict[str, list[str | int]]]:
    """Give tables of what weights change: figure -> weight -> a cell for each of FACTORS, with a star where the
    interval leaves no change out, and how many walks are kept at least."""

    def cell(row: dict[str, Any], figure: str, digits: int) -> str:
        found = row["figures"].get(figure)
        if not found:
            return "-"
        return f"{found['difference']:+.{digits}f}{'*' if found['low'] > 0 or found['high'] < 0 else ''}"

    many = {weight: [rows[name_of(weight, factor)] for factor in FACTORS] for weight in weights}
    return {
        figure: {
            weight.removeprefix("weight_"): [*(cell(row, figure, digits) for row in own), min(r["kept"] for r in own)]
            for weight, own in many.items()
        }
        for figure, _, digits in SHOWN
    }


PANEL_PX, LINE_PX, LEFT_PX, TOP_PX, COLUMNS = 560, 26, 150, 70, 3
GREY = (175, 175, 175)
COLORS = {0.0: INK, 0.25: (120, 170, 235), 0.5: (60, 110, 200), 2.0: (235, 150, 70), 4.0: (200, 70, 30)}


def draw_weights(rows: dict[str, dict[str, Any]], weights: list[str]) -> bytes:
    """Draw a panel for each figure: a line for each weight from its least to its greatest mean, a dot for each factor,
    a ring where the term is taken out; the upright line is the settings as they are; PNG bytes.
    """
    height, width = TOP_PX + LINE_PX * len(weights) + 46, PANEL_PX - LEFT_PX - 24
    picture = np.full((height * -(-len(SHOWN) // COLUMNS) + 30, PANEL_PX * COLUMNS, 3), PAPER, dtype=np.uint8)
    for place, (figure, title, digits) in enumerate(SHOWN):
        left, top = PANEL_PX * (place % COLUMNS) + LEFT_PX, height * (place // COLUMNS) + TOP_PX
        means = {n: row["figures"][figure]["mean"] for n, row in rows.items() if row["figures"] and n != PRINTED_STEP}
        low, high = min(means.values()), max(means.values())
        x = {name: left + (value - low) * width / max(high - low, 1e-9) for name, value in means.items()}
        bottom = top + LINE_PX * len(weights)
        draw_text(picture, f"{title}: {means[AS_SET]:.{digits}f} as set", left, top - 24)
        draw_line(picture, np.array([[x[AS_SET], top - 12], [x[AS_SET], bottom]]), INK)
        draw_text(picture, f"{low:.{digits}f}", left, bottom + 16, 0.42)
        draw_text(picture, f"{high:.{digits}f}", left + width, bottom + 16, 0.42, align=1.0)
        for line, weight in enumerate(weights):
            y, at = top + LINE_PX * (line + 0.5), {f: x[n] for f in FACTORS if (n := name_of(weight, f)) in x}
            draw_text(picture, weight.removeprefix("weight_").replace("_", " "), left - 14, y + 5, 0.45, align=1.0)
            ends = [*at.values(), x[AS_SET]]
            draw_line(picture, np.array([[min(ends), y], [max(ends), y]]), GREY, 2)
            for factor, there in at.items():
                draw_dot(picture, np.array([there, y]), 5, COLORS[factor], -1 if factor else 2)
    end, y = 16.0, picture.shape[0] - 14.0
    for factor, color in COLORS.items():
        draw_dot(picture, np.array([end, y - 5]), 5, color, -1 if factor else 2)
        end = draw_text(picture, f"weight x {factor:g}" if factor else "without the term", end + 12, y, 0.5) + 28.0
    return png_bytes(picture)
