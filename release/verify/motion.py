"""Do the rows of a flight follow each other as a flight does: time, speed, heading, perturbation, and the clean flight
beside it?"""

from __future__ import annotations

from typing import Any

import numpy as np

from cosfly.geometry import look_at, wrap_deg
from cosfly.products.motion import ACTION, BODY_WAYPOINT, NUM_WAYPOINTS, WAYPOINT
from cosfly.products.playback import EVENTS, HEADING_FRAMES, STANDS_M
from release.flight_rows import FlightRows
from release.verify.findings import Findings

STEP_S = 1e-3  # frames are one time step apart; times are written with three digits at least
# The inspection's limits for teleports: nothing in the data flies 25 m/s or walks 10 m/s.
DRONE_MPS, TARGET_MPS = 25.0, 10.0
UNTOLD_M = 6.0  # a shift that a public file does not tell: the paper's 3 m of the drone, at both ends
EXACT_M, EXACT_DEG, EXACT_PX = 1e-4, 1e-3, 1e-3  # sums and differences of what stands in two rows
# Greatest shifts of tab:augmentation_params, in a cube (sampling: cubic) and with a step of the ground.
DRONE_SHIFT_M, TURN_DEG = 3.0 * np.sqrt(3.0), 45.0
# By twins.
SHARED = ("pace", "walk", "split", "width_px", "height_px", "weather", "time_of_day", "weather_params", "look")


def check_motion(flight: FlightRows, twin: FlightRows | None, settings: dict[str, Any], findings: Findings) -> None:
    """Check a flight's rows one after the other, and against the rows of the clean flight of the same trajectory.

    Args:
        settings: of the perturbation, as the record has them; empty: those of the paper.
    """
    _check_steps(flight, findings)
    _check_heading(flight, findings)
    _check_perturbation(flight, settings, findings)
    _check_actions(flight, findings)
    if twin is not None:
        _check_twin(flight, twin, findings)
    elif not flight.is_clean:
        _check_signs(flight, findings)


def clean_positions(flight: FlightRows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take recorded shifts off: drone (n, 3), target (n, 3), and how far an untold shift may have moved either, (n,)
    m."""
    is_untold = np.isnan(flight.drone_offset[:, :3]).any(axis=1) & ~flight.is_clean
    drone = flight.pose[:, :3] - np.nan_to_num(flight.drone_offset[:, :3])
    target = flight.target_m - np.nan_to_num(flight.target_offset)
    return drone, target, np.where(is_untold, UNTOLD_M, 0.0)


def _check_steps(flight: FlightRows, findings: Findings) -> None:
    """Times grow with the index, by one step of the flight; nobody goes faster than flights and people do."""
    gaps, steps = np.diff(flight.index), np.diff(flight.time_s)
    if not len(gaps) or (gaps <= 0).any():
        return
    drone, target, slack_m = clean_positions(flight)
    step_s = float(np.median(steps / gaps))
    drone_mps, target_mps = (
        (np.linalg.norm(np.diff(way, axis=0), axis=1) - slack_m[1:]) / steps for way in (drone, target)
    )

    def later(wrong: np.ndarray) -> np.ndarray:
        return np.append(False, wrong)

    findings.judge(flight, (
        ("time", "time_s", later(~(steps > 0)), lambda i: f"{flight.time_s[i]} after another", "times that grow"),
        ("time", "time_s", later((steps > 0) & (np.abs(steps - gaps * step_s) > STEP_S * gaps)),
         lambda i: f"{steps[i - 1]:.4f} s for {gaps[i - 1]} frames", f"{step_s:g} s a frame, as elsewhere"),
        ("speed", "pose", later((steps > 0) & (drone_mps > DRONE_MPS)), lambda i: f"{drone_mps[i - 1]:.1f} m/s",
         f"at most {DRONE_MPS:g} m/s"),
        ("speed", "target", later((steps > 0) & (target_mps > TARGET_MPS)), lambda i: f"{target_mps[i - 1]:.1f} m/s",
         f"at most {TARGET_MPS:g} m/s"),
    ))  # fmt: skip


def _check_heading(flight: FlightRows, findings: Findings) -> None:
    """Whither the person walks, by the rows two frames before and after (Flight.target_headings_deg); who stands keeps
    the direction of before."""
    at, last = {int(index): k for k, index in enumerate(flight.index)}, (flight.num_frames or 2**40) - 1
    around = [
        (at.get(max(i - HEADING_FRAMES, 0)), at.get(min(i + HEADING_FRAMES, last))) for i in flight.index.tolist()
    ]
    known = np.array([None not in pair for pair in around])
    behind, ahead = np.array([pair if None not in pair else (0, 0) for pair in around]).T
    x, y, _ = (flight.target_m[ahead] - flight.target_m[behind]).T
    expected, heading = np.degrees(np.arctan2(y, x)), flight.numbers("target_heading_deg")
    wrong = known & (np.hypot(x, y) >= STANDS_M) & ~(np.abs(wrap_deg(heading - expected)) <= 0.01)
    findings.judge(flight, [(
        "heading", "target_heading_deg", wrong, lambda i: f"{heading[i]:.2f}",
        lambda i: f"{expected[i]:.2f}, whither the target goes",
    )])  # fmt: skip


def _check_actions(flight: FlightRows, findings: Findings) -> None:
    """Actions and waypoints are those of the poses, wherever the frames that they lead to are in the rows."""
    motion, index = flight.flight.motion, flight.index
    for column, width, of_row in (
        ("action", len(ACTION), lambda i, m: motion.action[i]),
        ("actions", len(ACTION), lambda i, m: motion.actions[i]),
        ("waypoints", len(WAYPOINT), lambda i, m: motion.waypoints(i)[:m]),
        ("body_waypoints", len(BODY_WAYPOINT), lambda i, m: motion.body_waypoints(i)[:m]),
    ):
        values = [list(one.values()) if isinstance(one, dict) else one for one in flight.column(column)]
        is_ahead, last = column.endswith("waypoints"), (flight.num_frames or len(flight)) - 1
        for i, told in enumerate(values):
            reach = len(told or ()) // width if is_ahead else 1
            if not any(values) or i + reach >= len(flight) or index[i + reach] - index[i] != reach:
                continue  # the format has no such column, or frames were left out
            expected = np.ravel(of_row(i, reach))
            if is_ahead and flight.num_frames and told is not None and reach != min(NUM_WAYPOINTS, last - index[i]):
                findings.error("action", flight.where(i, column), f"{reach} of them", f"the next {NUM_WAYPOINTS}")
            elif told is None and np.isnan(expected).any():
                continue
            elif told is None or len(told) != len(expected) or not (np.abs(told - expected) <= EXACT_M).all():
                got = "null" if told is None else np.round(told, 3).tolist()
                findings.error("action", flight.where(i, column), got, f"{expected.round(3).tolist()}, by the poses")


# --- perturbation -----------------------------------------------------------------------------------------------------


def _check_perturbation(flight: FlightRows, settings: dict[str, Any], findings: Findings) -> None:
    """Flags, words and offsets of a perturbation say the same, none is beyond its radius, and a clean flight has
    none."""
    perturbed = flight.flags("is_perturbed")
    shift, turn = np.linalg.norm(flight.drone_offset[:, :3], axis=1), np.abs(flight.drone_offset[:, 3:]).max(axis=1)
    person = np.linalg.norm(flight.target_offset, axis=1)
    is_told, moved, turned = ~np.isnan(shift), (shift > 0) | (person > 0), turn > 0
    drone_m = settings.get("drone_radius_m", 3.0) / 3.0 * DRONE_SHIFT_M
    person_m = settings.get("pedestrian_radius_m", 2.0) * np.sqrt(2.0) + 0.5
    view_deg = max(settings.get("max_view_deg", TURN_DEG), settings.get("max_roll_deg", 0.0))

    for column, size, most in (
        ("drone_offset", shift, drone_m), ("target_offset", person, person_m), ("drone_offset", turn, view_deg),
    ):  # fmt: skip
        for i in np.flatnonzero(size > most + EXACT_DEG).tolist():
            expected = f"at most {most:.2f}, its radius"
            findings.error("perturbation", flight.where(i, column), f"{size[i]:.2f}", expected)
    said = {event: [words and words[event] for words in flight.events] for event in EVENTS}
    for event, happened in (("position", moved), ("rotation", turned)):
        for i, words in enumerate(said[event]):
            if is_told[i] and words is not None and (words == "applied") != happened[i]:
                got = f"{words!r}, offsets {'other than' if happened[i] else 'of'} zero"
                expected = "applied exactly where there is an offset"
                findings.error("perturbation", flight.where(i, f"perturbation.{event}"), got, expected)
    findings.judge(flight, [
        ("perturbation", "is_perturbed", is_told & (perturbed & ~(moved | turned)), "true", "false, by its offsets"),
        ("perturbation", "is_perturbed", is_told & (~perturbed & (moved | turned)), "false", "true, by its offsets"),
        ("perturbation", "is_perturbed", perturbed & flight.is_clean, "true", "false in a clean flight"),
    ])  # fmt: skip


def _check_twin(flight: FlightRows, twin: FlightRows, findings: Findings) -> None:
    """A perturbed flight less its offsets is the clean flight of the trajectory, in every frame that both show."""
    first, theirs_first = flight.rows[0], twin.rows[0]
    for name in SHARED:
        if first.get(name) != theirs_first.get(name):
            expected = f"{theirs_first.get(name)}, as in its clean flight"
            findings.error("pair", flight.where(0, name), first.get(name), expected)
    _, mine, theirs = np.intersect1d(flight.index, twin.index, return_indices=True)
    drone, target, untold = (values[mine] for values in clean_positions(flight))

    def told(off: np.ndarray) -> np.ndarray:
        return np.where(untold > 0, 0.0, off)

    styles = np.array(flight.column("style"))[mine] != np.array(twin.column("style"))[theirs]
    for column, off, limit, unit in (
        ("time_s", np.abs(flight.time_s[mine] - twin.time_s[theirs]), STEP_S, "s"),
        ("pose", told(np.linalg.norm(drone - twin.pose[theirs, :3], axis=1)), EXACT_M, "m"),
        ("target", told(np.linalg.norm(target - twin.target_m[theirs], axis=1)), EXACT_M, "m"),
        ("pose", told(_unaimed_deg(flight, mine, twin, theirs)), EXACT_DEG, "degrees"),
        ("intrinsics", np.abs(flight.intrinsics[mine] - twin.intrinsics[theirs]).max(axis=1), EXACT_PX, "px"),
        ("style", styles.astype(float), 0.0, ""),
    ):
        for k in np.flatnonzero(off > limit):
            expected = f"that of its clean flight and the offset, within {limit:g} {unit}"
            findings.error("pair", flight.where(mine[k], column), f"{off[k]:.4f} {unit} beside it", expected)


def _unaimed_deg(flight: FlightRows, mine: np.ndarray, twin: FlightRows, theirs: np.ndarray) -> np.ndarray:
    """How far a row's view, less its turn and its new aim, is from the clean one: (k,) degrees, the greatest of the
    three angles."""
    own, clean = flight.pose[mine], twin.pose[theirs]
    aims = [look_at(own[:, :3], flight.target_m[mine]), look_at(clean[:, :3], twin.target_m[theirs])]
    aimed = np.degrees(np.stack(aims[0], axis=1) - np.stack(aims[1], axis=1))
    is_shifted = (flight.drone_offset[mine, :3] != 0).any(axis=1) | (flight.target_offset[mine] != 0).any(axis=1)
    aim = np.zeros((len(mine), 3))
    aim[:, :2] = np.where(is_shifted[:, None], aimed, 0.0)
    return np.abs(np.asarray(wrap_deg(own[:, 3:] - flight.drone_offset[mine, 3:] - aim - clean[:, 3:]))).max(axis=1)


def _check_signs(flight: FlightRows, findings: Findings) -> None:
    """Without its clean flight: with the offsets taken off the way is smoother than with them added, where these are
    large."""
    is_inner = np.zeros(len(flight), np.bool_)
    is_inner[1:-1] = (np.diff(flight.index)[1:] == 1) & (np.diff(flight.index)[:-1] == 1)
    for column, places, shifts in (
        ("drone_offset", flight.pose[:, :3], flight.drone_offset[:, :3]),
        ("target_offset", flight.target_m, flight.target_offset),
    ):
        clean, between = places - shifts, np.full(places.shape, np.nan)
        between[1:-1] = (clean[:-2] + clean[2:]) / 2.0
        taken, added, size = (np.linalg.norm(v, axis=1) for v in (clean - between, places + shifts - between, shifts))
        # A true offset leaves the bend of the way; one of the other sign leaves twice itself.
        wrong = is_inner & (size > 0.5) & (taken > 1.2 * size) & (added < 0.5 * size)
        got = lambda i, taken=taken: f"an offset that leaves a jump of {taken[i]:.2f} m"  # noqa: E731
        findings.judge(flight, [("perturbation", column, wrong, got, "the shift that the pose contains")])
