"""Which style a flight gets: drawn by seed from the shares of the settings, and judged when it is flown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cosfly.planners.contract import PlanConfig, Scenario, Wish
from cosfly.planners.courses import wish_of
from cosfly.planners.mission import wish_of_mission
from cosfly.planners.reacquire import finds_again, wish_of_reacquire
from cosfly.planners.styles import REACQUIRE, RETURN_HOME, WHOLE
from cosfly.products.segments import FOLLOW, Mission, Segment
from cosfly.work.chance import draw_by_share

if TYPE_CHECKING:
    from cosfly.space.kernels import BoxIndex

# A flight holds its style where the walker sees it within this angle of the wished place and within this ratio of its distance.
HELD_DEG, HELD_RATIO, HELD_SHARE = 25.0, 1.4, 0.7

POINTS_LEAST = 4  # of a part

NO_HIDING_PLACE, NOT_FOUND_AGAIN, NOT_HELD = "no_hiding_place", "not_lost_and_found", "style_not_held"


@dataclass(frozen=True)
class Intent:
    """What a flight is meant to be. segments: empty for the paper's flight from end to end.

    impossible: why the map cannot hold the style; the wish is the paper's then.
    """

    wish: Wish
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    impossible: str | None = None

    @property
    def styles(self) -> str:
        return ", ".join(part.style for part in self.segments)

    @property
    def searches(self) -> bool:
        return any(part.style == REACQUIRE for part in self.segments)


def draw_intent(
    scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig, rng: np.random.Generator
) -> Intent:
    """Draw the style or styles of a flight. screens: the obstacles that hide a person for certain."""
    name, num = draw_by_share(cfg.styles, rng), len(scenario.targets_m)
    if name == REACQUIRE:
        wish = wish_of_reacquire(scenario, obstacles, screens, cfg, rng)
        segment = Segment(name, 0, num, keeps_sight=False)
        if wish is None:
            return Intent(scenario.wish, (segment,), impossible=NO_HIDING_PLACE)
        return Intent(wish, (segment,))
    names = _parts(name, num, scenario.dt_s, cfg, rng)
    cuts = np.linspace(0, num, len(names) + 1).round().astype(int).tolist()
    segments = tuple(Segment(*part) for part in zip(names, cuts[:-1], cuts[1:], strict=True))
    is_paper = set(names) == {FOLLOW}
    wish = scenario.wish if is_paper else wish_of(names, scenario, obstacles, cfg, rng)
    if name != RETURN_HOME:
        return Intent(wish, () if is_paper else segments)
    wish, mission = wish_of_mission(wish, scenario, cfg, rng)
    at = mission.at_frame
    before = tuple(Segment(p.style, p.begin, min(p.end, at)) for p in segments if p.begin < at)
    return Intent(wish, (*before, Segment(RETURN_HOME, at, num, keeps_sight=False)), mission)


def _parts(name: str, num_points: int, dt_s: float, cfg: PlanConfig, rng: np.random.Generator) -> list[str]:
    """Give the styles of a flight's parts, of which the first is `name` if it takes parts at all."""
    shares = {style: share for style, share in cfg.styles.items() if style not in WHOLE and share > 0} or {FOLLOW: 1.0}
    num = round(num_points * dt_s / cfg.segment_s) if cfg.segment_s else 1
    num = max(1, min(num, num_points // POINTS_LEAST))
    return [name if k == 0 and name not in WHOLE else draw_by_share(shares, rng) for k in range(num)]


def why_not_held(intent: Intent, scenario: Scenario, positions_m: np.ndarray, seen: np.ndarray) -> str | None:
    """Say why a flight is not what it was meant to be, None where it is.

    Args:
        positions_m: (n, 3), as flown. seen: (n,) five-ray visibility past the screens.
    """
    if intent.impossible is not None or not intent.segments:
        return intent.impossible
    if intent.searches:
        return None if finds_again(seen, scenario.dt_s) else NOT_FOUND_AGAIN
    wished = intent.wish.places_m(scenario.targets_m, scenario.ground_m) - scenario.targets_m
    flown = positions_m - scenario.targets_m
    wished_m, flown_m = np.linalg.norm(wished, axis=1), np.linalg.norm(flown, axis=1)
    cosine = (wished * flown).sum(axis=1) / np.maximum(wished_m * flown_m, 1e-9)
    ratio = np.maximum(flown_m, 1e-9) / np.maximum(wished_m, 1e-9)
    held = (cosine >= np.cos(np.radians(HELD_DEG))) & (ratio <= HELD_RATIO) & (ratio >= 1.0 / HELD_RATIO)
    return None if held.mean() >= HELD_SHARE else NOT_HELD
