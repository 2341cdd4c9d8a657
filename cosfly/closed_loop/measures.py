"""The measures of closed-loop episodes, computed from their records (cosfly/formats/episodes.py). Writes no file.

Success is our definition: the drone followed to the end of the pedestrian trajectory, the target was visible within the
last LOSS_S, and the drone ended within BAND_M of it. EVT-Bench (TrackVLA, its public code) requires the same at the
episode's end, facing the target at 1 to 3 m, and ends an episode at a collision or after 20 steps beyond 4 m; DAT's
success rate is the share of time with a visible target (our `in_view`). UAV-Track VLA reports 61.76 % success and
269.65 tracked frames on far pedestrians in CARLA without a definition that we could find: these are not comparable.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from itertools import groupby, pairwise

import numpy as np

from cosfly.formats.episodes import Episode, EpisodeScore, Figure, Score
from cosfly.geometry.trajectory_metrics import RELAXED_SAFETY_M, derivative_rms, draw_pedestrians, figure_of_draws
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for

LOSS_S = 2.0  # the target is lost if not visible for so long; a tree or a lamp hides it for less
BAND_M = (5.0, 40.0)  # over ground: a quarter and twice of what plans keep (plan.behind_distance_m)
NEAR_MISS_M = RELAXED_SAFETY_M  # least clearance of any plan
# Groups by their upper ends: the mean turn of the target, and the share of frames that hide the target from a drone
# right behind it.
TURNS_DEGPS = {"straight": 3.0, "bends": 6.0, "turns": np.inf}
HIDDEN = {"open": 0.02, "partly hidden": 0.2, "hidden": 1.0}
GROUPS = ("map", "pace", "turn", "occlusion", "training")
RESAMPLES, CONFIDENCE = 2000, 0.95

# Name -> description; each is the ratio of two sums over episodes (EpisodeScore.sums).
MEASURES = {
    "success": "success",
    "in_view": "target visible, share of all frames of the pedestrian trajectories",
    "in_picture": "target in the picture, hidden or not",
    "tracked_frames": "frames with a visible target, per episode",
    "kept_s": "time to the first loss, crash or the end, s",
    "lost": f"episodes that lose the target for {LOSS_S:g} s",
    "reacquired": "losses after which the target is found again",
    "reacquire_s": "time until the target is found again, s",
    "distance_m": "distance over ground, m",
    "in_band": f"frames at {BAND_M[0]:g} to {BAND_M[1]:g} m",
    "height_m": "height over the target's ground, m",
    "crashed": "episodes that end in a crash",
    "left": "episodes that leave the map",
    "near_misses_pmin": f"times nearer than {NEAR_MISS_M:g} m to an obstacle, per minute",
    "jerk_rms_mps3": "RMS jerk, m/s^3",
    "yaw_jerk_rms_degps3": "RMS jerk of yaw, deg/s^3",
    "changes_pmin": "changes of decision, per minute",
    "no_decision": "decisions that were missing or invalid",
    "decision_s": "time of a decision, s",
}
SHARES = {"success", "in_view", "in_picture", "lost", "reacquired", "in_band", "crashed", "left", "no_decision"}


def measure(record: Episode, trained_on: Collection[str] | None = None) -> EpisodeScore:
    """Measure one episode. trained_on: towns of the student's training, None if unknown.

    Frames after an early end count as frames without a visible target.
    """
    flown = record.flown
    decisions = record.decisions
    dt_s = record.dt_s
    num_frames = len(flown)
    minutes = num_frames * dt_s / 60.0
    losses = _losses([frame.visible for frame in flown], max(1, round(LOSS_S / dt_s)))
    reacquired = [count for begin, count in losses if begin + count < num_frames]
    is_lost = len(reacquired) < len(losses)  # at the end
    in_band = [BAND_M[0] <= frame.distance_m <= BAND_M[1] for frame in flown]
    success = record.ended == "finished" and not is_lost and in_band[-1]
    is_close = [frame.clearance_m < NEAR_MISS_M for frame in decisions]
    num_near_misses = sum(value for value, _ in groupby(is_close))
    if record.ended == "crashed" and is_close[-1]:
        num_near_misses -= 1  # the last one is the crash
    poses = np.array([frame.pose for frame in record.frames[record.num_lead :]])
    yaw_deg = np.degrees(np.unwrap(np.radians(poses[:, 4])))
    actions = [frame.action for frame in decisions if frame.action is not None]
    answer_times_s = [frame.answer_s for frame in decisions if frame.answer_s is not None]
    answers = Counter(frame.answer for frame in decisions)
    sums = {
        "success": (success, 1),
        "in_view": (sum(frame.visible for frame in flown), record.num_walk_frames),
        "in_picture": (sum(frame.in_view for frame in flown), record.num_walk_frames),
        "tracked_frames": (sum(frame.visible for frame in flown), 1),
        "kept_s": ((losses[0][0] if losses else num_frames) * dt_s, 1),
        "lost": (bool(losses), 1),
        "reacquired": (len(reacquired), len(losses)),
        "reacquire_s": (sum(reacquired) * dt_s, len(reacquired)),
        "distance_m": (sum(frame.distance_m for frame in flown), num_frames),
        "in_band": (sum(in_band), num_frames),
        "height_m": (sum(frame.height_m for frame in flown), num_frames),
        "crashed": (record.ended == "crashed", 1),
        "left": (record.ended == "left", 1),
        "near_misses_pmin": (num_near_misses, minutes),
        "jerk_rms_mps3": (derivative_rms(poses[:, :3], 3, dt_s), 1),
        "yaw_jerk_rms_degps3": (derivative_rms(np.column_stack([yaw_deg, np.zeros((len(poses), 2))]), 3, dt_s), 1),
        "changes_pmin": (sum(a != b for a, b in pairwise(actions)), minutes if actions else 0),
        "no_decision": (len(decisions) - answers["ok"], len(decisions)),
        "decision_s": (sum(answer_times_s), len(answer_times_s)),
    }
    style = record.style
    training = "unknown"
    if trained_on is not None:
        training = "trained on" if record.town in trained_on else "never trained on"
    return EpisodeScore(
        episode=record.episode, town=record.town, walk=f"{record.map_sha256[:12]}/{record.walk}",
        groups={
            "map": record.town, "pace": style.pace, "turn": _group(style.turn_degps, TURNS_DEGPS),
            "occlusion": _group(style.hidden_share, HIDDEN), "training": training,
        },
        ended=record.ended, answers=dict(sorted(answers.items())),
        sums={name: (round(float(a), 4), round(float(b), 4)) for name, (a, b) in sums.items()},
    )  # fmt: skip


def _losses(visible: Sequence[bool], least_frames: int) -> list[tuple[int, int]]:
    """Return first frame and number of frames of each interval in which the target is lost."""
    losses = []
    begin = 0
    for is_visible, interval in groupby(visible):
        count = len(list(interval))
        if not is_visible and count >= least_frames:
            losses.append((begin, count))
        begin += count
    return losses


def _group(value: float, ends: dict[str, float]) -> str:
    return next(name for name, end in ends.items() if value <= end)


def episode_digest(episode: Episode) -> str:
    """Return the digest of an episode's task: map, camera and lead frames, which no student decides."""
    lead = [[frame.pose, frame.target_m] for frame in episode.frames[: episode.num_lead + 1]]
    task = [
        episode.map_sha256, episode.walk, episode.episode, episode.list_sha256, episode.num_walk_frames, episode.dt_s,
        episode.camera_px, episode.fov_deg, lead,
    ]  # fmt: skip
    return sha256_bytes(dump_json(task).encode())


def score_episodes(records: Iterable[Episode], *, trained_on: Sequence[str] | None = None, seed: int = 0) -> Score:
    """Score the episodes of one student, at least one, in any order."""
    measured = []
    digests = []
    for episode in records:
        measured.append(measure(episode, trained_on))
        digests.append(episode_digest(episode))
    measured.sort(key=lambda score: (score.town, score.episode))
    by: dict[str, dict[str, dict[str, Figure]]] = {kind: {} for kind in GROUPS}
    for kind, groups in by.items():
        for name in sorted({score.groups[kind] for score in measured}):
            group = [score for score in measured if score.groups[kind] == name]
            groups[name] = figures_of(group, rng_for(seed, "score", "draws"))
    figures = figures_of(measured, rng_for(seed, "score", "draws"))
    return Score(
        episodes_sha256=sha256_bytes(dump_json(sorted(digests)).encode()), trained_on=trained_on,
        student=episode.student, engine=episode.engine, list_sha256=episode.list_sha256,
        confidence=CONFIDENCE, resamples=RESAMPLES, figures=figures, by=by, flights=tuple(measured),
    )  # fmt: skip


def figures_of(
    measured: Sequence[EpisodeScore], rng: np.random.Generator, before: Sequence[EpisodeScore] | None = None
) -> dict[str, Figure]:
    """Return all figures with intervals by bootstrap over pedestrian trajectories; with `before`, their changes."""
    walks = sorted({score.walk for score in measured})
    draws = np.vstack([np.ones(len(walks)), draw_pedestrians(len(walks), RESAMPLES, rng)])  # the first: each once
    drawn = _ratios(draws, measured, walks)
    counts = [sum(score.sums[name][1] > 0 for score in measured) for name in MEASURES]
    if before is not None:
        drawn = drawn - _ratios(draws, before, walks)
        counts = [len(walks)] * len(MEASURES)
    return {
        name: figure_of_draws(float(drawn[0, k]), drawn[1:, k], counts[k], len(walks), CONFIDENCE)
        for k, name in enumerate(MEASURES)
    }


def _ratios(draws: np.ndarray, measured: Sequence[EpisodeScore], walks: list[str]) -> np.ndarray:
    """Return the figures of each draw, (draws, figures), NaN if undefined. draws: (draws, walks), how often each."""
    sums = np.zeros((len(walks), len(MEASURES), 2))
    for score in measured:
        sums[walks.index(score.walk)] += [score.sums[name] for name in MEASURES]
    totals = np.tensordot(draws, sums, axes=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(totals[..., 1] > 0, totals[..., 0] / totals[..., 1], np.nan)
