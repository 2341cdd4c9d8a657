"""Draws of a perturbed flight made again from the seeds that `release.json` tells: which events, which offsets, at which pace the person went.

Which walk a flight is of no row says. It is the one whose draws give one of the flight's shifts to a tenth of a millimetre on three axes; where no
walk's do, another version drew, or the seed is another one: a warning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from cosfly.geometry import look_at, wrap_deg
from cosfly.products.shift_draws import PERTURBED, ShiftDraw, rng_of_shifts, shift_draws
from cosfly.products.walks import walk_id
from cosfly.work.chance import draw_by_share, rng_for
from release.record import MadeBy
from release.verify.findings import Findings
from release.verify.rows import FlightRows

EXACT_M, EXACT_DEG = 1e-4, 1e-3  # files keep all digits; those of older ones four
# Of each walk, and walks of a run: to draw them takes a second or so, once a process. Nothing is said of a flight whose shifts all come later,
# or of a later walk.
FRAMES_TRIED, MOST_WALKS, MOST_FRAMES = 64, 512, 100_000
SHIFTS_TRIED = 3  # of a flight: the first one may be a lie


@dataclass(frozen=True)
class Drawn:
    """What one run's flights were drawn from: seed and settings of `render` and of `pedestrians`."""

    seed: int
    perturbation: dict[str, Any]
    walks_seed: int
    num_walks: int
    paces: dict[str, float] | None

    @classmethod
    def of_stages(cls, stages: list[MadeBy]) -> Drawn | None:
        """Take it from the stages of a source; None where one of both is not told, or told twice."""
        found = {name: [stage for stage in stages if stage.stage == name] for name in ("render", "pedestrians")}
        if any(len(own) != 1 for own in found.values()):
            return None
        (render,), (walks,) = found.values()
        perturbation, num_walks = render.config.get("perturbation"), walks.config.get("num_paths")
        if not isinstance(perturbation, dict) or not isinstance(num_walks, int):
            return None
        return cls(render.seed, perturbation, walks.seed, num_walks, walks.config.get("pace"))

    @cached_property
    def first_shifts(self) -> np.ndarray:
        """Where the drone is drawn to in the first frames of each walk, (walks, FRAMES_TRIED, 3) m."""
        walks = (self.draws(walk_id(k)) for k in range(min(self.num_walks, MOST_WALKS)))
        return np.array([[draw.drone_m for draw in islice(draws, FRAMES_TRIED)] for draws in walks])

    def draws(self, path_id: str) -> Iterator[ShiftDraw]:
        told = self.perturbation
        return shift_draws(
            rng_of_shifts(self.seed, path_id),
            person_radius_m=told["pedestrian_radius_m"],
            drone_radius_m=told["drone_radius_m"],
            view_radius_m=told["view_radius_m"],
            is_cubic=told["sampling"] == "cubic",
        )


def check_draws(flight: FlightRows, drawn: Drawn | None, findings: Findings) -> None:
    """Compare a perturbed flight with the draws of its walk.

    Args:
        drawn: of its run; None where nobody tells.
    """
    if drawn is None or flight.rows[0].get("variant") != PERTURBED or flight.index.max() > MOST_FRAMES:
        return
    shifted = [i for i, words in enumerate(flight.events) if words is not None and words["position"] == "applied"]
    shifted = [i for i in shifted if flight.index[i] < FRAMES_TRIED][:SHIFTS_TRIED]
    path_id = _walk_of(flight, shifted, drawn)
    if path_id is None:
        if shifted and drawn.num_walks <= MOST_WALKS:
            got = f"shifts that none of {drawn.num_walks} walks draws under seed {drawn.seed}"
            findings.warn("draw", flight.where(shifted[0], "drone_offset"), got, "the seed that they were drawn from, or another version of cosfly drew them")  # fmt: skip
        return
    draws = list(islice(drawn.draws(path_id), int(flight.index[-1]) + 1))
    for i, words in enumerate(flight.events):
        if words is not None:
            _check_frame(flight, i, words, draws[flight.index[i]], drawn.perturbation, findings)
    if drawn.paces is not None and flight.rows[0].get("pace") is not None:
        walks_rng = rng_for(drawn.walks_seed, "pedestrians", path_id)
        pace = draw_by_share(drawn.paces, walks_rng.spawn(1)[0])  # as the stage draws it: of a child of the walk's own
        if flight.rows[0]["pace"] != pace:
            findings.error("draw", flight.where(0, "pace"), flight.rows[0]["pace"], f"{pace}, drawn for {path_id}")


def _walk_of(flight: FlightRows, shifted: list[int], drawn: Drawn) -> str | None:
    for i in shifted:
        if len(drawn.first_shifts):
            off_m = np.abs(drawn.first_shifts[:, flight.index[i]] - flight.drone_offset[i, :3]).max(axis=1)
            if off_m.min() <= EXACT_M:
                return walk_id(int(off_m.argmin()))
    return None


def _check_frame(
    flight: FlightRows, i: int, words: dict[str, str], draw: ShiftDraw, told: dict[str, Any], findings: Findings
) -> None:
    """A frame's words are none exactly where nothing was drawn, and what was applied is what was drawn."""
    for event, chance in zip(("position", "rotation"), draw.events, strict=True):
        happened = bool(chance < told[f"{event}_probability"])
        if happened != (words[event] != "none"):
            expected = "applied, or fallback and why" if happened else "none"
            findings.error("draw", flight.where(i, f"perturbation.{event}"), words[event], f"{expected}, by the seed's draw")  # fmt: skip
            return
    if words["position"] == "applied":
        for name, shift, drawn_m in (
            ("drone_offset", flight.drone_offset[i, :3], draw.drone_m),
            ("target_offset", flight.target_offset[i, :2], draw.person_m[:2]),
        ):
            if not np.abs(shift - drawn_m).max() <= EXACT_M:
                findings.error("draw", flight.where(i, name), shift.round(4).tolist(), f"{drawn_m.round(4).tolist()} m, by the seed's draw")  # fmt: skip
    if words["rotation"] == "applied":
        eye, target = flight.pose[i, :3], flight.target_m[i]
        turn = wrap_deg(np.degrees(np.subtract(look_at(eye, target + draw.view_m), look_at(eye, target))))
        turn = np.clip(turn, -told["max_view_deg"], told["max_view_deg"])
        turned = flight.drone_offset[i, 3:5]
        if not np.abs(turned - turn).max() <= EXACT_DEG:
            findings.error("draw", flight.where(i, "drone_offset"), f"turned by {turned.round(3).tolist()} degrees", f"{turn.round(3).tolist()}, by the seed's draw")  # fmt: skip
