"""Trial windows: what a teacher can write, found by letting it write about flights that are made up and pictures that
are drawn.

Three windows for each way of writing, asked as a run asks: freely, then with what was wrong, `correction_asks` times.
The English alone.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from caption.schema import CaptionConfig, ImageConfig, ObservedWindow, observed_frames
from caption.teachers.images import EncodedImage, encode_image
from caption.teachers.prompts import Correction, Question, make_question, question_messages
from caption.truth.vocabulary import Vocabulary
from caption.writing.contract import Refused, more_fields, refuse_decision
from cosfly.look.frame_views import VIEW_FILES, Pictures
from cosfly.products.answer_text import answer_schema, parse_answer
from cosfly.products.captions import Writing

STEP_S = 0.5
CAMERA_PX = (1280, 720)
FOCAL_PX = 900.0
PERSON_M = 1.7
CUT_SHORT, NO_ANSWER = "structure_cut_short", "no_answer"
ENOUGH = 2  # of the windows: a way that a teacher is said to master

# Messages and schema of an ask -> the text of its answer and whether it was cut short; None where there was none.
Ask = Callable[[list[dict], dict], Awaitable[tuple[str, bool] | None]]


@dataclass(frozen=True)
class TrialScene:
    """A made-up flight: of the drone its height, speed, climb and turn, of the person speed, and the frames in which it
    is hidden."""

    name: str
    altitude_m: float
    speed_mps: float
    climb_mps: float
    turn_dps: float
    walking_mps: float
    hidden: tuple[int, ...] = ()


SCENES = (
    TrialScene("trial1", altitude_m=15.0, speed_mps=2.0, climb_mps=0.0, turn_dps=0.0, walking_mps=1.2),
    TrialScene("trial2", altitude_m=12.0, speed_mps=3.0, climb_mps=2.0, turn_dps=6.0, walking_mps=1.5),
    TrialScene("trial3", altitude_m=20.0, speed_mps=0.1, climb_mps=0.0, turn_dps=-4.0, walking_mps=0.0, hidden=(3,)),
)


@dataclass(frozen=True)
class Result:
    """How a way of writing went. reasons: of the answers that were refused in the end."""

    writing: Writing
    passed: int
    tried: int
    reasons: Counter[str]

    @property
    def is_enough(self) -> bool:
        return self.passed >= ENOUGH

    @property
    def detail(self) -> str:
        most = self.reasons.most_common(1)
        longer = "; raise caption.endpoint.max_tokens" if CUT_SHORT in self.reasons else ""
        return (
            f"{self.passed} of {self.tried} answers passed" + (f"; most often: {most[0][0]}" if most else "") + longer
        )


async def try_ways(ask: Ask, cfg: CaptionConfig, vocabulary: Vocabulary, ways: Iterable[Writing]) -> list[Result]:
    """Let a teacher write about every trial window in each way; results in the order of the ways."""
    return [await _try_way(ask, cfg, vocabulary, way) for way in ways]


async def _try_way(ask: Ask, cfg: CaptionConfig, vocabulary: Vocabulary, writing: Writing) -> Result:
    windows = [trial_window(scene, cfg.window.num_frames) for scene in SCENES]
    questions = [make_question(window, cfg.image, writing, vocabulary) for window in windows]
    reasons = await asyncio.gather(*(_reason(ask, cfg, question) for question in questions))
    refused = Counter(reason for reason in reasons if reason)
    return Result(writing, len(reasons) - refused.total(), len(reasons), refused)


async def _reason(ask: Ask, cfg: CaptionConfig, question: Question) -> str:
    """Give why an answer about a window was not taken in the end; "" where it was."""
    way, actions = question.way, question.way.vocabulary.actions
    more = more_fields(way)
    reason = ""
    for number in range(cfg.correction_asks + 1):
        messages, _ = question_messages(question, TrialFrames(question.window, cfg.image))
        answered = await ask(messages, answer_schema(actions, more=more))
        if answered is None:
            return NO_ANSWER
        text, is_cut = answered
        parsed = parse_answer(text, actions, more=tuple(more), optional=way.optional)
        if parsed.coc is None:
            return CUT_SHORT if is_cut else f"structure_{parsed.reason}"
        answer = refuse_decision(parsed) or way.read(parsed, question.facts)
        if not isinstance(answer, Refused):
            judged = way.judge(answer, question.facts, cfg.evidence, "en")
            return "contradicted" if any(one.state == "contradicted" for one in judged) else ""
        reason = answer.reason
        question = _corrected(question, text, answer, number + 1)
    return reason


def _corrected(question: Question, text: str, refused: Refused, number: int) -> Question:
    return replace(question, correction=Correction(text, refused.complaint, number))


def best_way(results: list[Result]) -> Writing | None:
    """Give the first way of these that a teacher masters, else the one that went best, None where none went at all."""
    for result in results:
        if result.is_enough:
            return result.writing
    best = max(results, key=lambda result: result.passed, default=None)
    return best.writing if best is not None and best.passed else None


# --- made-up windows --------------------------------------------------------------------------------------------------


def trial_question(question: Question, cfg: CaptionConfig, scene: TrialScene) -> Question:
    """Give a question about a made-up window, with pictures of the number, views and size of another question's."""
    window, way = trial_window(scene, cfg.window.num_frames), question.way
    return replace(make_question(window, cfg.image, way.name, way.vocabulary), pictures=question.pictures)


def trial_window(scene: TrialScene, count: int) -> ObservedWindow:
    """Make the observed frames of a scene: the drone flies north behind a person who walks ahead of it."""
    time_s = STEP_S * np.arange(count)
    yaw = 90.0 + scene.turn_dps * time_s
    drone = np.stack([0.0 * time_s, scene.speed_mps * time_s, scene.altitude_m + scene.climb_mps * time_s], axis=1)
    target = np.stack([0.0 * time_s, 18.0 + scene.walking_mps * time_s, 0.0 * time_s + 0.9], axis=1)
    flat = np.hypot(*(target - drone)[:, :2].T)
    pitch = -np.degrees(np.arctan2(drone[:, 2] - 0.9, flat))
    hidden = np.isin(np.arange(count), scene.hidden)
    slant = np.hypot(flat, drone[:, 2] - 0.9)
    height = FOCAL_PX * PERSON_M * np.cos(np.radians(pitch)) / slant
    u = CAMERA_PX[0] / 2.0 + FOCAL_PX * np.tan(np.radians(yaw - 90.0))
    v = np.full(count, CAMERA_PX[1] / 2.0)
    return ObservedWindow(
        sample_id=f"{scene.name}_ORI_frame_{count - 1:05d}",
        town="trial",
        trajectory=scene.name,
        variant="ORI",
        indices=tuple(range(count)),
        width_px=CAMERA_PX[0],
        height_px=CAMERA_PX[1],
        frames=observed_frames(
            time_s,
            drone,
            np.stack([pitch, yaw, 0.0 * yaw], axis=1),
            target,
            np.stack([u, v], axis=1),
            np.stack([u - 0.2 * height, v - 0.5 * height, u + 0.2 * height, v + 0.5 * height], axis=1),
            np.ones(count, bool),
            ~hidden,
            np.where(hidden, 0.1, 1.0),
        ),
        frame_folders=tuple(Path(f"frame_{number:05d}") for number in range(count)),
        frame_files=tuple(frozenset(VIEW_FILES.values()) for _ in range(count)),
    )


class TrialFrames:
    """Pictures of a made-up window: the ground, the person as an upright box, a wall where it is hidden."""

    def __init__(self, window: ObservedWindow, cfg: ImageConfig) -> None:
        self.window, self.cfg = window, cfg

    def encode(self, frame: Path, pictures: Pictures) -> list[EncodedImage]:
        index = self.window.frame_folders.index(frame)
        drawn = [self._draw(index, view, pictures.size_px) for view in pictures.views]
        return [encode_image(one, self.cfg) for one in ([np.hstack(drawn)] if pictures.layout == "tiled" else drawn)]

    def _draw(self, index: int, view: str, size_px: tuple[int, int]) -> np.ndarray:
        ground, person, wall = _COLOURS[view]
        image = np.full((size_px[1], size_px[0], 3), ground, np.uint8)
        scale = size_px[0] / self.window.width_px
        left, top, right, bottom = (round(edge * scale) for edge in self.window.frames[index].target_bbox)
        is_hidden = not self.window.frames[index].visible
        grow = (right - left) if is_hidden else 0
        cv2.rectangle(
            image, (left - grow, top - grow), (right + grow, bottom + grow), wall if is_hidden else person, -1
        )
        return image


# RGB of ground, person and wall in each view.
_COLOURS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "rgb": ((110, 120, 105), (190, 60, 50), (150, 140, 130)),
    "depth": ((90, 40, 140), (230, 200, 40), (230, 160, 60)),
    "segmentation": ((60, 60, 60), (255, 0, 0), (120, 120, 120)),
}
