"""Draws of a perturbed flight made again from the seeds that `release.json` tells: which events, which offsets, at
which pace the person went.

Which walk a flight is of no row says. It is the one whose draws give one of the flight's shifts to a tenth of a
millimetre on three axes; where no walk's do, another version drew, or the seed is another one: a warning.
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
from cosfly.products.walks import paces_of, walk_id
from release.flight_rows import FlightRows
from release.record import MadeBy
from release.verify.findings import Findings

EXACT_M, EXACT_DEG = 1e-4, 1e-3  # files keep all digits; those of older ones four
# Of each walk, and walks of a run: to draw them takes a second or so, once a process. Nothing is said of a flight whose
# shifts all come later, or of a later walk.
FRAMES_TRIED, MOST_WALKS, MOST_FRAMES = 64, 512, 100_000
SHIFTS_TRIED = 3  # of a flight: the first one may be a lie


@dataclass(frozen=True)
class DrawSettings:
    """What one run's flights were drawn from: the stages `render` and `pedestrians`."""

    render: MadeBy
    walks: MadeBy

    @classmethod
    def of_stages(cls, made: dict[str, MadeBy]) -> DrawSettings | None:
        """Take it from the stages of a source; None where one of both does not tell."""
        render, walks = made.get("render"), made.get("pedestrians")
        if render is None or walks is None or not isinstance(render.config.get("perturbation"), dict):
            return None
        return cls(render, walks) if isinstance(walks.config.get("num_paths"), int) else None

    @property
    def perturbation(self) -> dict[str, Any]:
        return self.render.config["perturbation"]

    @property
    def num_walks(self) -> int:
        return self.walks.config["num_paths"]

    @cached_property
    def first_shifts(self) -> np.ndarray:
        """Where the drone is drawn to in the first frames of each walk, (walks, FRAMES_TRIED, 3) m."""
        walks = (self.draws(walk_id(k)) for k in range(min(self.num_walks, MOST_WALKS)))
        return np.array([[draw.drone_m for draw in islice(draws, FRAMES_TRIED)] for draws in walks])

    def draws(self, path_id: str) -> Iterator[ShiftDraw]:
        told, rng = self.perturbation, rng_of_shifts(self.render.seed, path_id)
        radii = {
            name: told[name.replace("person", "pedestrian")]
            for name in ("person_radius_m", "drone_radius_m", "view_radius_m")
        }
        return shift_draws(rng, **radii, is_cubic=told["sampling"] == "cubic")

    def pace(self, number: int) -> str | None:
        """The pace of a walk, None where nobody tells the shares."""
        shares = self.walks.config.get("pace")
        return None if shares is None else paces_of(number + 1, shares, self.walks.seed)[number]


def check_draws(flight: FlightRows, drawn: DrawSettings | None, findings: Findings) -> None:
    """Compare a perturbed flight with the draws of its walk.

    Args:
        drawn: of its run; None where nobody tells.
    """
    if drawn is None or flight.rows[0].get("variant") != PERTURBED or flight.index.max() > MOST_FRAMES:
        return
    shifted = [i for i, words in enumerate(flight.events) if words is not None and words["position"] == "applied"]
    shifted = [i for i in shifted if flight.index[i] < FRAMES_TRIED][:SHIFTS_TRIED]
    number = _walk_of(flight, shifted, drawn)
    if number is None:
        if shifted and drawn.num_walks <= MOST_WALKS:
            got = f"shifts that none of {drawn.num_walks} walks draws under seed {drawn.render.seed}"
            expected = "the seed that they were drawn from, or another version of cosfly drew them"
            findings.warn("draw", flight.where(shifted[0], "drone_offset"), got, expected)
        return
    draws = list(islice(drawn.draws(walk_id(number)), int(flight.index[-1]) + 1))
    for i, words in enumerate(flight.events):
        if words is not None:
            for column, got, expected in _odd_in_frame(flight, i, words, draws[flight.index[i]], drawn.perturbation):
                findings.error("draw", flight.where(i, column), got, f"{expected}, by the seed's draw")
    pace, own = drawn.pace(number), flight.rows[0].get("pace")
    if None not in (pace, own) and own != pace:
        findings.error("draw", flight.where(0, "pace"), own, f"{pace}, drawn for {walk_id(number)}")


def _walk_of(flight: FlightRows, shifted: list[int], drawn: DrawSettings) -> int | None:
    for i in shifted:
        if len(drawn.first_shifts):
            off_m = np.abs(drawn.first_shifts[:, flight.index[i]] - flight.drone_offset[i, :3]).max(axis=1)
            if off_m.min() <= EXACT_M:
                return int(off_m.argmin())
    return None


def _odd_in_frame(
    flight: FlightRows, i: int, words: dict[str, str], draw: ShiftDraw, told: dict[str, Any]
) -> Iterator[tuple[str, Any, str]]:
    """A frame's words are none exactly where nothing was drawn, and what was applied is what was drawn. Yields column,
    got, expected."""
    for event, chance in zip(("position", "rotation"), draw.events, strict=True):
        happened = bool(chance < told[f"{event}_probability"])
        if happened != (words[event] != "none"):
            yield f"perturbation.{event}", words[event], "applied, or fallback and why" if happened else "none"
            return
    offset, person = flight.drone_offset[i], flight.target_offset[i]
    if words["position"] == "applied":
        for column, shift, drawn_m in (
            ("drone_offset", offset[:3], draw.drone_m),
            ("target_offset", person[:2], draw.person_m[:2]),
        ):
            if not np.abs(shift - drawn_m).max() <= EXACT_M:
                yield column, shift.round(4).tolist(), f"{drawn_m.round(4).tolist()} m"
    if words["rotation"] == "applied":
        eye, target = flight.pose[i, :3], flight.target_m[i]
        turn = wrap_deg(np.degrees(np.subtract(look_at(eye, target + draw.view_m), look_at(eye, target))))
        turn = np.clip(turn, -told["max_view_deg"], told["max_view_deg"])
        turn = np.append(turn, told.get("max_roll_deg", 0.0) * draw.roll)
        if not np.abs(offset[3:] - turn).max() <= EXACT_DEG:
            yield "drone_offset", f"turned by {offset[3:].round(3).tolist()} degrees", f"{turn.round(3).tolist()}"
