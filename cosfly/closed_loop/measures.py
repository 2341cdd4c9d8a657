"""The measures of closed-loop episodes, computed from their records (cosfly/formats/episodes.py). Writes no file.

Success is our definition: the drone followed to the end of the pedestrian trajectory, the target was visible within the
last LOSS_S, and the drone ended within BAND_M of it. EVT-Bench (TrackVLA, its public code) requires the same at the
episode's end, facing the target at 1 to 3 m, and ends an episode at a collision or after 20 steps beyond 4 m; DAT's
success rate is the share of time with a visible target (our `visible`). UAV-Track VLA reports 61.76 % success and
269.65 tracked frames on far pedestrians in CARLA without a definition that we could find: these are not comparable.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby

import numpy as np

from cosfly.formats.episodes import Episode, EpisodeScore, Figure, Score
from cosfly.geometry.trajectory_metrics import draw_pedestrians, figure_of_draws
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for

LOSS_S = 2.0  # the target is lost if not visible for so long; a tree or a lamp hides it for less
BAND_M = (5.0, 40.0)  # over ground: a quarter and twice of what plans keep (plan.behind_distance_m)
RESAMPLES, CONFIDENCE = 2000, 0.95

# Name -> description; each is the ratio of two sums over episodes (EpisodeScore.sums).
MEASURES = {
    "success": "success",
    "visible": "target visible, share of all frames of the pedestrian trajectories",
    "in_view": "target in the picture, hidden or not",
    "tracked_frames": "frames with a visible target, per episode",
    "kept_s": "time to the first loss, crash or the end, s",
    "lost": f"episodes that lose the target for {LOSS_S:g} s",
    "distance_m": "distance over ground, m",
    "in_band": f"frames at {BAND_M[0]:g} to {BAND_M[1]:g} m",
    "crashed": "episodes that end in a crash",
    "left": "episodes that leave the map",
    "no_decision": "decisions that were missing or invalid",
}
SHARES = {"success", "visible", "in_view", "lost", "in_band", "crashed", "left", "no_decision"}


def measure(record: Episode) -> EpisodeScore:
    """Measure one episode.

    Frames after an early end count as frames without a visible target.
    """
    flown = record.flown
    decisions = record.decisions
    dt_s = record.dt_s
    num_frames = len(flown)
    losses = _losses([frame.visible for frame in flown], max(1, round(LOSS_S / dt_s)))
    is_lost = bool(losses) and sum(losses[-1]) == num_frames  # at the end
    in_band = [BAND_M[0] <= frame.distance_m <= BAND_M[1] for frame in flown]
    success = record.ended == "finished" and not is_lost and in_band[-1]
    answers = Counter(frame.answer for frame in decisions)
    sums = {
        "success": (success, 1),
        "visible": (sum(frame.visible for frame in flown), record.num_walk_frames),
        "in_view": (sum(frame.in_view for frame in flown), record.num_walk_frames),
        "tracked_frames": (sum(frame.visible for frame in flown), 1),
        "kept_s": ((losses[0][0] if losses else num_frames) * dt_s, 1),
        "lost": (bool(losses), 1),
        "distance_m": (sum(frame.distance_m for frame in flown), num_frames),
        "in_band": (sum(in_band), num_frames),
        "crashed": (record.ended == "crashed", 1),
        "left": (record.ended == "left", 1),
        "no_decision": (len(decisions) - answers["ok"], len(decisions)),
    }
    return EpisodeScore(
        episode=record.episode, town=record.town, walk=f"{record.map_sha256[:12]}/{record.walk}",
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


def episode_digest(episode: Episode) -> str:
    """Return the digest of an episode's task: map, camera and lead frames, which no student decides."""
    lead = [[frame.pose, frame.target_m] for frame in episode.frames[: episode.num_lead + 1]]
    task = [
        episode.map_sha256, episode.walk, episode.episode, episode.list_sha256, episode.num_walk_frames, episode.dt_s,
        episode.camera_px, episode.fov_deg, lead,
    ]  # fmt: skip
    return sha256_bytes(dump_json(task).encode())


def score_episodes(records: Iterable[Episode], *, seed: int = 0, most_decisions: int = 0) -> Score:
    """Score the episodes of one student, at least one, in any order. most_decisions: The limit that may have shortened
    them."""
    measured = []
    digests = []
    for episode in records:
        measured.append(measure(episode))
        digests.append(episode_digest(episode))
    measured.sort(key=lambda score: (score.town, score.episode))
    if not any(sum(score.answers.values()) == most_decisions for score in measured):
        most_decisions = 0
    figures = figures_of(measured, rng_for(seed, "score", "draws"))
    return Score(
        episodes_sha256=sha256_bytes(dump_json(sorted(digests)).encode()),
        student=episode.student, engine=episode.engine, list_sha256=episode.list_sha256, most_decisions=most_decisions,
        confidence=CONFIDENCE, resamples=RESAMPLES, figures=figures, flights=tuple(measured),
    )  # fmt: skip


def figures_of(measured: Sequence[EpisodeScore], rng: np.random.Generator) -> dict[str, Figure]:
    """Return all figures with intervals by bootstrap over pedestrian trajectories."""
    walks = sorted({score.walk for score in measured})
    draws = np.vstack([np.ones(len(walks)), draw_pedestrians(len(walks), RESAMPLES, rng)])  # the first: each once
    figures = _ratios(draws, measured, walks)
    counts = [sum(score.sums[name][1] > 0 for score in measured) for name in MEASURES]
    return {
        name: figure_of_draws(float(figures[0, k]), figures[1:, k], counts[k], len(walks), CONFIDENCE)
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
