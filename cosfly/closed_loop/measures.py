"""What flights of the closed loop are worth: figures of their records (cosfly/formats/pursuits.py). No file.

Success, as ours: the flight came to its walk's end, the person was seen within the last LOSS_S, and the drone ended
within BAND_M of it. EVT-Bench (TrackVLA, its public code) asks for the same at the episode's end, facing the target at
1 to 3 m, and ends an episode at a collision or after 20 steps beyond 4 m; DAT's success rate is the share of time that
the target is visible (our `in_view`). UAV-Track VLA reports 61.76 % success and 269.65 tracked frames on far
pedestrians in CARLA; how it defines them is not told where we could read, so its numbers are no yardstick for ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise

import numpy as np

from cosfly.formats.flight_scores import Figure, FlightScore, Score
from cosfly.formats.pursuits import Pursuit
from cosfly.geometry.trajectory_metrics import RELAXED_SAFETY_M, derivative_rms, draw_pedestrians, figure_of_draws
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for

LOSS_S = 2.0  # unseen for so long the person is lost; for less it is hidden by a tree or a lamp
BAND_M = (5.0, 40.0)  # over ground: a quarter and twice of what plans keep (plan.behind_distance_m)
NEAR_MISS_M = RELAXED_SAFETY_M  # what a plan never goes below
TURNS_DEGPS = {"straight": 3.0, "bends": 6.0, "turns": np.inf}  # mean turn of who walks, up to
HIDDEN = {"open": 0.02, "partly hidden": 0.2, "hidden": 1.0}  # share that hides the person from right behind, up to
GROUPS = ("map", "pace", "turn", "occlusion", "training")
RESAMPLES, CONFIDENCE = 2000, 0.95

# Name -> words; each is a sum over flights by another one (FlightScore.sums).
MEASURES = {
    "success": "success",
    "in_view": "person seen, of all frames of the walks",
    "in_picture": "person in the picture, hidden or not",
    "tracked_frames": "frames that show the person, a flight",
    "kept_s": "time to the first loss, crash or the end, s",
    "lost": f"flights that lose the person for {LOSS_S:g} s",
    "reacquired": "losses after which it is found again",
    "reacquire_s": "time until it is, s",
    "distance_m": "distance over ground, m",
    "in_band": f"frames at {BAND_M[0]:g} to {BAND_M[1]:g} m",
    "height_m": "height over the person's ground, m",
    "crashed": "flights that crash",
    "left": "flights that leave the map",
    "near_misses_pmin": f"times nearer than {NEAR_MISS_M:g} m to something, a minute",
    "jerk_rms_mps3": "RMS jerk, m/s^3",
    "yaw_jerk_rms_degps3": "RMS jerk of yaw, deg/s^3",
    "changes_pmin": "changes of decision, a minute",
    "no_decision": "decisions that did not come, or were none",
    "decision_s": "time of a decision, s",
}
SHARES = {"success", "in_view", "in_picture", "lost", "reacquired", "in_band", "crashed", "left", "no_decision"}


def measure(pursuit: Pursuit, trained_on: Iterable[str] | None = None) -> FlightScore:
    """Measure one flight. trained_on: towns that its student was trained on, None where nobody knows.

    Frames that a flight did not come to count as frames that do not show the person.
    """
    flown, decisions, dt_s = pursuit.flown, pursuit.decisions, pursuit.dt_s
    num, minutes = len(flown), len(flown) * dt_s / 60.0
    longest = max(1, round(LOSS_S / dt_s))
    runs = [(is_seen, len(list(run))) for is_seen, run in groupby(frame.visible for frame in flown)]
    begins = np.cumsum([0, *(count for _, count in runs)])[:-1].tolist()
    losses = [
        (begin, count) for (seen, count), begin in zip(runs, begins, strict=True) if not seen and count >= longest
    ]
    found = [count for begin, count in losses if begin + count < num]
    last_seen = not runs[-1][0] and runs[-1][1] >= longest
    in_band = [BAND_M[0] <= frame.distance_m <= BAND_M[1] for frame in flown]
    success = pursuit.ended == "finished" and not last_seen and in_band[-1]
    close = [frame.clearance_m < NEAR_MISS_M for frame in decisions]
    near = sum(is_close for is_close, _ in groupby(close)) - (pursuit.ended == "crashed" and close[-1])
    poses = np.array([frame.pose for frame in pursuit.frames[pursuit.num_lead :]])
    yaw_deg = np.degrees(np.unwrap(np.radians(poses[:, 4])))
    actions = [frame.action for frame in decisions if frame.action is not None]
    times = [frame.answer_s for frame in decisions if frame.answer_s is not None]
    answers = Counter(frame.answer for frame in decisions)
    sums = {
        "success": (success, 1),
        "in_view": (sum(frame.visible for frame in flown), pursuit.num_walk_frames),
        "in_picture": (sum(frame.in_view for frame in flown), pursuit.num_walk_frames),
        "tracked_frames": (sum(frame.visible for frame in flown), 1),
        "kept_s": ((losses[0][0] if losses else num) * dt_s, 1),
        "lost": (bool(losses), 1),
        "reacquired": (len(found), len(losses)),
        "reacquire_s": (sum(found) * dt_s, len(found)),
        "distance_m": (sum(frame.distance_m for frame in flown), num),
        "in_band": (sum(in_band), num),
        "height_m": (sum(frame.height_m for frame in flown), num),
        "crashed": (pursuit.ended == "crashed", 1),
        "left": (pursuit.ended == "left", 1),
        "near_misses_pmin": (near, minutes),
        "jerk_rms_mps3": (derivative_rms(poses[:, :3], 3, dt_s), 1),
        "yaw_jerk_rms_degps3": (derivative_rms(np.column_stack([yaw_deg, np.zeros((len(poses), 2))]), 3, dt_s), 1),
        "changes_pmin": (sum(a != b for a, b in pairwise(actions)), minutes if actions else 0),
        "no_decision": (len(decisions) - answers["ok"], len(decisions)),
        "decision_s": (sum(times), len(times)),
    }
    towns = None if trained_on is None else set(trained_on)
    training = "unknown" if towns is None else "trained on" if pursuit.town in towns else "never trained on"
    style = pursuit.style
    return FlightScore(
        episode=pursuit.episode, town=pursuit.town, walk=f"{pursuit.map_sha256[:12]}/{pursuit.walk}",
        groups={
            "map": pursuit.town, "pace": style.pace, "turn": _group(style.turn_degps, TURNS_DEGPS),
            "occlusion": _group(style.hidden_share, HIDDEN), "training": training,
        },
        ended=pursuit.ended, answers=dict(sorted(answers.items())),
        sums={name: (round(float(a), 4), round(float(b), 4)) for name, (a, b) in sums.items()},
    )  # fmt: skip


def _group(value: float, ends: dict[str, float]) -> str:
    return next(name for name, end in ends.items() if value <= end)


def episode_digest(one: Pursuit) -> str:
    """Name what was to be flown: the map, the camera and the beginning of a flight, which no student decides."""
    begin = [[frame.pose, frame.target_m] for frame in one.frames[: one.num_lead + 1]]
    told = [one.map_sha256, one.walk, one.episode, one.list_sha256, one.num_walk_frames, one.dt_s, one.camera_px]
    return sha256_bytes(dump_json([*told, one.fov_deg, begin]).encode())


def score_pursuits(pursuits: Iterable[Pursuit], *, trained_on: Sequence[str] | None = None, seed: int = 0) -> Score:
    """Score the flights of one student, in any order."""
    flights, digests, whose = [], [], set()
    for one in pursuits:
        flights.append(measure(one, trained_on))
        digests.append(episode_digest(one))
        whose.add((one.student, one.engine, one.list_sha256 or ""))
    if len(whose) != 1:
        got = "; ".join(" ".join(filter(None, words)) for words in sorted(whose)[:3]) or "no flight"
        raise InputError("no flights of one student on one list of episodes", where="pursuits", got=got)
    (student, engine, listed), digest = whose.pop(), sha256_bytes(dump_json(sorted(digests)).encode())
    flights.sort(key=lambda flight: (flight.town, flight.episode))
    return score_flights(flights, student, engine, digest, list_sha256=listed or None, trained_on=trained_on, seed=seed)


def score_flights(
    flights: Sequence[FlightScore],
    student: str,
    engine: str,
    episodes_sha256: str,
    *,
    list_sha256: str | None = None,
    trained_on: Sequence[str] | None = None,
    seed: int = 0,
) -> Score:
    """Score flights that were measured, of one map or several."""
    by = {
        kind: {
            group: figures_of_flights([f for f in flights if f.groups[kind] == group], seed)
            for group in sorted({f.groups[kind] for f in flights})
        }
        for kind in GROUPS
    }
    return Score(
        student=student, engine=engine, episodes_sha256=episodes_sha256, list_sha256=list_sha256,
        trained_on=None if trained_on is None else tuple(trained_on), confidence=CONFIDENCE, resamples=RESAMPLES,
        figures=figures_of_flights(flights, seed), by=by, flights=tuple(flights),
    )  # fmt: skip


def walk_sums(flights: Sequence[FlightScore], names: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Return the walks, and what their flights add to some figures: (walks, figures, 2)."""
    walks = sorted({flight.walk for flight in flights})
    sums = np.zeros((len(walks), len(names), 2))
    for flight in flights:
        sums[walks.index(flight.walk)] += [flight.sums[name] for name in names]
    return walks, sums


def ratios(draws: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Return figures on draws of walks, (draws, figures), NaN of nothing; draws: (draws, walks) how often each."""
    totals = np.tensordot(draws, sums, axes=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(totals[..., 1] > 0, totals[..., 0] / totals[..., 1], np.nan)


def draws_of(num_walks: int, rng: np.random.Generator) -> np.ndarray:
    """Draw walks, (1 + RESAMPLES, walks) how often each; the first has each once, as they were flown."""
    return np.vstack([np.ones(num_walks), draw_pedestrians(num_walks, RESAMPLES, rng)])


def figures_of(drawn: np.ndarray, counts: Sequence[int], num_walks: int) -> dict[str, Figure]:
    """Return all figures of their values on `draws_of` walks, (draws, figures); counts: what each is of."""
    return {
        name: figure_of_draws(float(drawn[0, k]), drawn[1:, k], counts[k], num_walks, CONFIDENCE)
        for k, name in enumerate(MEASURES)
    }


def figures_of_flights(flights: Sequence[FlightScore], seed: int = 0) -> dict[str, Figure]:
    """Return all figures of some flights with their intervals, by bootstrap over walks."""
    walks, sums = walk_sums(flights, list(MEASURES))
    drawn = ratios(draws_of(len(walks), rng_for(seed, "score", "draws")), sums)
    return figures_of(drawn, [sum(flight.sums[name][1] > 0 for flight in flights) for name in MEASURES], len(walks))
