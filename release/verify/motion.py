"""Do the rows of a flight follow each other as a flight does: time, speed, heading, perturbation, and the clean flight beside it?"""

from __future__ import annotations

from typing import Any

import numpy as np

from cosfly.geometry import look_at, wrap_deg
from cosfly.products.playback import HEADING_FRAMES, STANDS_M
from release.verify.findings import Findings
from release.verify.rows import FlightRows

STEP_S = 1e-3  # frames are one time step apart; times are written with three digits at least
# The inspection's limits for teleports: nothing in the data flies 25 m/s or walks 10 m/s.
DRONE_MPS, TARGET_MPS = 25.0, 10.0
UNTOLD_M = 6.0  # a shift that a public file does not tell: the paper's 3 m of the drone, at both ends
EXACT_M, EXACT_DEG, EXACT_PX = 1e-4, 1e-3, 1e-3  # sums and differences of what stands in two rows
# Greatest shifts of tab:augmentation_params, in a cube (sampling: cubic) and with a step of the ground.
DRONE_SHIFT_M, TARGET_SHIFT_M, TURN_DEG = 3.0 * np.sqrt(3.0), 2.0 * np.sqrt(2.0) + 0.5, 45.0


def check_motion(flight: FlightRows, twin: FlightRows | None, settings: dict[str, Any], findings: Findings) -> None:
    """Check a flight's rows one after the other, and against the rows of the clean flight of the same trajectory.

    Args:
        settings: of the perturbation, as the record has them; empty: those of the paper.
    """
    _check_time(flight, findings)
    _check_speeds(flight, findings)
    _check_heading(flight, findings)
    _check_perturbation(flight, settings, findings)
    if twin is not None:
        _check_twin(flight, twin, findings)
    elif not flight.is_clean:
        _check_signs(flight, findings)


def _check_time(flight: FlightRows, findings: Findings) -> None:
    """Times grow with the index, by one step of the flight."""
    gaps, steps = np.diff(flight.index), np.diff(flight.time_s)
    if not len(gaps) or (gaps <= 0).any():
        return
    step_s = float(np.median(steps / gaps))
    for k in np.flatnonzero(~(steps > 0)):
        findings.error("time", flight.where(k + 1, "time_s"), f"{flight.time_s[k + 1]} after {flight.time_s[k]}", "times that grow")  # fmt: skip
    for k in np.flatnonzero((steps > 0) & (np.abs(steps - gaps * step_s) > STEP_S * np.maximum(1, gaps))):
        findings.error("time", flight.where(k + 1, "time_s"), f"{steps[k]:.4f} s for {gaps[k]} frames", f"{step_s:g} s a frame, as elsewhere in the flight")  # fmt: skip


def clean_positions(flight: FlightRows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take recorded shifts off: drone (n, 3), target (n, 3), and how far an untold shift may have moved either, (n,) m."""
    is_untold = np.isnan(flight.drone_offset[:, :3]).any(axis=1) & ~flight.is_clean
    drone = flight.pose[:, :3] - np.nan_to_num(flight.drone_offset[:, :3])
    target = flight.target_m - np.nan_to_num(flight.target_offset)
    return drone, target, np.where(is_untold, UNTOLD_M, 0.0)


def _check_speeds(flight: FlightRows, findings: Findings) -> None:
    drone, target, slack = clean_positions(flight)
    seconds = np.diff(flight.time_s)
    with np.errstate(invalid="ignore"):
        for column, places, limit in (("pose", drone, DRONE_MPS), ("target", target, TARGET_MPS)):
            ways = np.linalg.norm(np.diff(places, axis=0), axis=1) - slack[1:]
            for k in np.flatnonzero((seconds > 0) & (ways > limit * seconds)):
                findings.error("speed", flight.where(k + 1, column), f"{ways[k] / seconds[k]:.1f} m/s", f"at most {limit:g} m/s")  # fmt: skip


def _check_heading(flight: FlightRows, findings: Findings) -> None:
    """Whither the person walks, by the rows two frames before and after (Flight.target_headings_deg)."""
    heading, n = flight.numbers("target_heading_deg"), len(flight)
    at = {int(index): k for k, index in enumerate(flight.index)}
    last = flight.num_frames - 1 if flight.num_frames is not None else None
    for k in range(n):
        index = int(flight.index[k])
        behind = at.get(max(index - HEADING_FRAMES, 0))
        ahead = at.get(index + HEADING_FRAMES if last is None else min(index + HEADING_FRAMES, last))
        if behind is None or ahead is None or "target_heading_deg" not in flight.rows[k]:
            continue
        x, y = (flight.target_m[ahead] - flight.target_m[behind])[:2]
        if not np.hypot(x, y) >= STANDS_M:
            continue  # who stands keeps the direction of before
        off = abs(float(wrap_deg(heading[k] - np.degrees(np.arctan2(y, x)))))
        if not off <= 0.01:
            findings.error("heading", flight.where(k, "target_heading_deg"), f"{heading[k]:.2f}", f"{np.degrees(np.arctan2(y, x)):.2f}, whither the target goes")  # fmt: skip


# --- perturbation -----------------------------------------------------------------------------------------------------


def _check_perturbation(flight: FlightRows, settings: dict[str, Any], findings: Findings) -> None:
    """Flags, words and offsets of a perturbation say the same, and a clean flight has none."""
    perturbed = flight.flags("is_perturbed")
    shift, turn = np.linalg.norm(flight.drone_offset[:, :3], axis=1), np.abs(flight.drone_offset[:, 3:]).max(axis=1)
    person = np.linalg.norm(flight.target_offset, axis=1)
    is_told = ~np.isnan(shift)
    moved = (shift > 0) | (person > 0)
    with np.errstate(invalid="ignore"):
        turned = turn > 0
    for i in np.flatnonzero(is_told & ((moved | turned) != perturbed)):
        findings.error("perturbation", flight.where(i, "is_perturbed"), perturbed[i], f"{bool(moved[i] or turned[i])}, by its offsets")  # fmt: skip
    if flight.is_clean:
        for i in np.flatnonzero(perturbed):
            findings.error("perturbation", flight.where(i, "is_perturbed"), "true", "false in a clean flight")
    for k, words in enumerate(flight.events):
        if words is None or not is_told[k]:
            continue
        for event, happened in (("position", moved[k]), ("rotation", turned[k])):
            if (words[event] == "applied") != bool(happened):
                got = f"{words[event]!r}, offsets {'other than' if happened else 'of'} zero"
                findings.error("perturbation", flight.where(k, f"perturbation.{event}"), got, "applied exactly where there is an offset")  # fmt: skip
    drone_m = settings.get("drone_radius_m", 3.0) / 3.0 * DRONE_SHIFT_M
    person_m = settings.get("pedestrian_radius_m", 2.0) * np.sqrt(2.0) + 0.5
    view_deg = settings.get("max_view_deg", TURN_DEG)
    for column, size, most in (("drone_offset", shift, drone_m), ("target_offset", person, person_m), ("drone_offset", turn, view_deg)):  # fmt: skip
        with np.errstate(invalid="ignore"):
            for i in np.flatnonzero(size > most + EXACT_DEG):
                findings.error("perturbation", flight.where(i, column), f"{size[i]:.2f}", f"at most {most:.2f}, its radius")  # fmt: skip


def _check_twin(flight: FlightRows, twin: FlightRows, findings: Findings) -> None:
    """A perturbed flight less its offsets is the clean flight of the trajectory, in every frame that both show."""
    for name in (
        "intrinsics",
        "width_px",
        "height_px",
        "pace",
        "walk",
        "split",
        "weather",
        "time_of_day",
        "weather_params",
        "look",
    ):
        if flight.rows[0].get(name) != twin.rows[0].get(name):
            findings.error("pair", flight.where(0, name), flight.rows[0].get(name), f"{twin.rows[0].get(name)}, as in its clean flight")  # fmt: skip
    at = {int(index): k for k, index in enumerate(twin.index)}
    pairs = [(i, at[int(index)]) for i, index in enumerate(flight.index) if int(index) in at]
    if not pairs:
        return
    mine, theirs = (np.array(rows) for rows in zip(*pairs, strict=True))
    if flight.zooms or twin.zooms:  # else the first rows told
        for i in np.flatnonzero(np.abs(flight.intrinsics[mine] - twin.intrinsics[theirs]).max(axis=1) > EXACT_PX):
            findings.error("pair", flight.where(mine[i], "intrinsics"), flight.intrinsics[mine[i]].tolist(), f"{twin.intrinsics[theirs[i]].tolist()}, as in its clean flight")  # fmt: skip
    drone, target, untold = clean_positions(flight)
    off_drone = np.linalg.norm(drone[mine] - twin.pose[theirs, :3], axis=1)
    off_target = np.linalg.norm(target[mine] - twin.target_m[theirs], axis=1)
    turn = _unaimed_deg(flight, mine, twin, theirs)
    checks = (
        ("time_s", np.abs(flight.time_s[mine] - twin.time_s[theirs]), STEP_S, "s"),
        ("pose", np.where(untold[mine] > 0, 0.0, off_drone), EXACT_M, "m"),
        ("target", np.where(untold[mine] > 0, 0.0, off_target), EXACT_M, "m"),
        ("pose", np.where(untold[mine] > 0, 0.0, turn), EXACT_DEG, "degrees"),
    )
    for column, off, limit, unit in checks:
        with np.errstate(invalid="ignore"):
            for k in np.flatnonzero(off > limit):
                expected = f"that of its clean flight and the offset, within {limit:g} {unit}"
                findings.error("pair", flight.where(int(mine[k]), column), f"{off[k]:.4f} {unit} beside it", expected)
    _check_styles(flight, mine, twin, theirs, findings)


def _check_styles(
    flight: FlightRows, mine: np.ndarray, twin: FlightRows, theirs: np.ndarray, findings: Findings
) -> None:
    ours, clean = flight.column("style"), twin.column("style")
    for i, k in zip(mine, theirs, strict=True):
        if ours[i] != clean[k]:
            findings.error("pair", flight.where(int(i), "style"), ours[i], f"{clean[k]}, as in its clean flight")


def _unaimed_deg(flight: FlightRows, mine: np.ndarray, twin: FlightRows, theirs: np.ndarray) -> np.ndarray:
    """How far a row's view, less its turn and its new aim, is from the clean one: (k,) degrees, the greatest of the three angles."""
    own, clean = flight.pose[mine], twin.pose[theirs]
    aimed = np.degrees(
        np.stack(look_at(own[:, :3], flight.target_m[mine]), axis=1)
        - np.stack(look_at(clean[:, :3], twin.target_m[theirs]), axis=1)
    )
    is_shifted = (flight.drone_offset[mine, :3] != 0).any(axis=1) | (flight.target_offset[mine] != 0).any(axis=1)
    aim = np.zeros((len(mine), 3))
    aim[:, :2] = np.where(is_shifted[:, None], aimed, 0.0)
    return np.abs(np.asarray(wrap_deg(own[:, 3:] - flight.drone_offset[mine, 3:] - aim - clean[:, 3:]))).max(axis=1)


def _check_signs(flight: FlightRows, findings: Findings) -> None:
    """Without its clean flight: with the offsets taken off the way is smoother than with them added, where these are large."""
    offsets = flight.drone_offset[:, :3]
    steps = set(flight.steps().tolist())
    middle = [k for k in range(1, len(flight) - 1) if k in steps and k - 1 in steps]
    for sign_of, places, shifts in (("drone_offset", flight.pose[:, :3], offsets), ("target_offset", flight.target_m, flight.target_offset)):  # fmt: skip
        clean = places - shifts
        for k in middle:
            between = (clean[k - 1] + clean[k + 1]) / 2.0
            taken, added = np.linalg.norm(clean[k] - between), np.linalg.norm(places[k] + shifts[k] - between)
            size = np.linalg.norm(shifts[k])
            # A true offset leaves the bend of the way; one of the other sign leaves twice itself.
            if size > 0.5 and taken > 1.2 * size and added < 0.5 * size:
                findings.error("perturbation", flight.where(k, sign_of), f"an offset that leaves a jump of {taken:.2f} m", "the shift that the pose contains")  # fmt: skip
