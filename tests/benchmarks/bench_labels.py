"""Labels of perturbed flights beside those of the clean flight at the same instant. Run: python tests/benchmarks/bench_labels.py runs/quickstart/render

Ways to get the motion: `twin`, `offsets`, `flown` (nothing taken off), and `shifts` (the drone's and the view's offsets alone, as cosfly
did at first). For each: labels that differ, of these where the same was visible, hard conflicts of the rule teacher, and those among
them whose label, which a repair would force, is not the clean flight's. Last: turns whose shift is more thresholds than they are.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np

from caption.label_motion import LabelMotion, as_flown, label_motion
from caption.schema import LabelConfig, WindowConfig
from caption.teachers.rules import decide
from caption.truth.actions import Motion, label_of, measure, verdict_of
from caption.truth.facts import measure_facts
from caption.windows import current_frames, cut_future, cut_windows
from cosfly.products.flights import find_flights, read_twin
from cosfly.products.playback import Flight, read_flight

WINDOW, LABEL = WindowConfig(require_images=False), LabelConfig()
COLUMNS = ("differ", "differ, same visible", "hard", "hard, label not the clean one's")


def shifts_taken_off(flight: Flight) -> LabelMotion:
    yaw_deg = flight.rotations_deg[:, 1] - flight.rotation_offsets_deg[:, 1]
    return LabelMotion("offsets", flight.positions_m - flight.drone_offsets_m, yaw_deg, flight.targets_m)


def compare(flight: Flight, twin: Flight, counts: Counter[tuple[str, str]]) -> None:
    """Add the windows of a perturbed flight to the counts, (way, column) -> number."""
    ways = {
        "twin": label_motion(flight, twin),
        "offsets": label_motion(flight),
        "flown": as_flown(flight, "perturbed"),
        "shifts": shifts_taken_off(flight),
    }
    clean, n = label_motion(twin), WINDOW.future_frames
    for i, window in zip(current_frames(len(flight), WINDOW), cut_windows(flight, WINDOW), strict=True):
        future = cut_future(twin, clean, i, n)
        expected, decision = label_of(measure(future), LABEL), decide(measure_facts(window.observed))
        same = bool((future.visible == window.future.visible).all())
        for way, motion in ways.items():
            measured = measure(cut_future(flight, motion, i, n))
            label = label_of(measured, LABEL)
            is_hard = verdict_of(decision, measured, LABEL, label) == "HARD_CONFLICT"
            found = (label != expected, label != expected and same, is_hard, is_hard and label != expected)
            counts.update((way, column) for column, holds in zip(COLUMNS, found, strict=True) if holds)


def swing(motion: Motion) -> tuple[bool, float] | None:
    """Of a turn beside a shift that is more thresholds: does it go against the shift, and the radius of the swing, m."""
    turn, shift = motion.yaw_deg / LABEL.yaw_deg, motion.left_m / LABEL.lateral_m
    label = label_of(motion, LABEL)
    is_shift = abs(shift) >= 1.0 and abs(motion.left_m) > abs(motion.forward_m)
    if abs(turn) < 1.0 or abs(shift) <= abs(turn) or not is_shift or label is None:
        return None
    if not label.startswith(("yaw", "strafe")):
        return None
    return turn * shift < 0, abs(motion.left_m / np.sin(np.radians(motion.yaw_deg)))


def main(roots: list[str]) -> None:
    for root in roots:
        counts: Counter[tuple[str, str]] = Counter()
        motions: list[Motion] = []
        num_windows = 0
        for folder in find_flights(Path(root)):
            flight = read_flight(folder, strict=False)
            twin = read_twin(flight)
            windows = list(cut_windows(flight, WINDOW, twin=twin))
            motions += [measure(window.future) for window in windows]
            if twin is not None:
                num_windows += len(windows)
                compare(flight, twin, counts)
        print(f"{root}: {num_windows:,} windows of perturbed flights")
        for way in ("twin", "offsets", "flown", "shifts"):
            print(f"  {way}: " + ", ".join(f"{column} {counts[way, column]:,}" for column in COLUMNS))
        swings = [found for found in map(swing, motions) if found]
        against_m = [radius_m for is_against, radius_m in swings if is_against]
        middle = f", radius of these {np.median(against_m):.1f} m (median)" if against_m else ""
        print(f"  turns with a larger shift: {len(swings):,}; against it {len(against_m):,}{middle}")


if __name__ == "__main__":
    main(sys.argv[1:])
