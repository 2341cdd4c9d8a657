"""Decision engines: prompted models, the rules, two baselines and an upper bound.

An engine gets the last frames of several episodes and returns a decision for each. An error in one of them is recorded
as the student's failure, and the episode goes on.
"""

import asyncio
import math
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from caption.answer_formats.formats import THEREFORE, Draft
from caption.schema import CaptionConfig, ObservedFrame, ObservedWindow
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.prompts import Question, make_question
from caption.teachers.rule_decisions import decide
from caption.teachers.students import student_settings
from caption.teachers.teacher import open_teacher
from cosfly.closed_loop.settings import BASELINES, FlyConfig
from cosfly.closed_loop.stepper import ClosedLoopTrajectory, Moment
from cosfly.formats.captions import TOKENS
from cosfly.formats.episodes import MOST_WORDS, Answer
from cosfly.formats.frames import FILE_NAMES, depth_file, frame_name, instance_bytes, rgb_bytes
from cosfly.formats.places import sample_id
from cosfly.geometry.axes import wrap_deg
from cosfly.geometry.motion import in_axes_of
from cosfly.llm.answer_text import normalize_action, parse_answer
from cosfly.llm.answers import Answer as BookAnswer
from cosfly.llm.answers import AnswerBook, Budget
from cosfly.llm.contract import NoAnswer
from cosfly.llm.student_chat import CHAT_FORMAT_FILE, read_chat_format
from cosfly.runtime.errors import ConfigError, CosflyError
from cosfly.runtime.model_json import find_object
from cosfly.runtime.seeding import rng_for
from distill.inference.answers import LocalAnswers
from distill.inference.samples import InferConfig, Inputs
from distill.schema import Sample

DECISION_END = '",'  # behind a decision that is the first field of an answer
UNKNOWN_DECISION = "decision_not_in_closed_set"  # of readable answers with an unknown decision


@dataclass(frozen=True)
class EngineDecision:
    """A student's decision."""

    answer: Answer
    action: str | None = None
    words: str | None = None  # reasons of the student, or the failure
    answer_s: float | None = None  # time that the student needed
    command: np.ndarray | None = None  # (5,) as ACTION, of a student that returns commands


@dataclass(frozen=True)
class Observation:
    """The input of one decision."""

    episode: str
    simulation: ClosedLoopTrajectory
    moments: Sequence[Moment]  # the last frames, oldest first


class DecisionEngine(Protocol):
    """A student that decides."""

    name: str  # in records
    num_frames: int  # most frames of an observation

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        """Return one decision for each observation."""


def open_engine(cfg: FlyConfig, caption: CaptionConfig, infer: InferConfig, seed: int, answers: Path) -> DecisionEngine:
    """Open the student of the settings. answers: folder of a model's answer journal."""
    if cfg.student == "planner":
        return PlannerEngine()
    if cfg.student in BASELINES:
        return BaselineEngine(cfg.student, seed)
    if cfg.engine == "policy":
        from cosfly.closed_loop.policy import Policy

        return Policy(cfg.student.partition(":")[2], cfg.answer_limit_s, seed)
    kind = LocalEngine if cfg.engine == "transformers" else PromptedEngine
    return kind(cfg, caption, infer, seed, answers)


class BaselineEngine:
    """A baseline that sees nothing: a fixed or a random decision."""

    num_frames = 1

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self._seed = seed

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        if self.name != "random":
            return [EngineDecision("ok", self.name)] * len(observations)
        items = (f"{observation.episode}/{observation.moments[-1].index}" for observation in observations)
        return [EngineDecision("ok", str(rng_for(self._seed, "fly", item).choice(TOKENS))) for item in items]


class PlannerEngine:
    """The upper bound: it flies from any pose to the next pose of the plan, which knows the whole trajectory."""

    name = "planner"
    num_frames = 1

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        commands = [self.to_next(observation.simulation, observation.moments[-1]) for observation in observations]
        return [EngineDecision("ok", command=command) for command in commands]

    @staticmethod
    def to_next(simulation: ClosedLoopTrajectory, now: Moment) -> np.ndarray:
        """Return the command that leads to the plan's next pose, or as near as the drone's limits allow."""
        dt_s = simulation.dt_s
        position_m = simulation.planned.positions_m[now.index + 1]
        pitch_deg, yaw_deg, _ = simulation.planned.rotations_deg[now.index + 1]
        velocity_mps = in_axes_of(now.rotation_deg[1], position_m - now.position_m) / dt_s
        turn_degps = float(wrap_deg(yaw_deg - now.rotation_deg[1])) / dt_s
        command = simulation.drone.within_speed(np.array([*velocity_mps, turn_degps, pitch_deg]))
        return np.clip(command, *simulation.drone.bounds)


class PromptedEngine:
    """A student that is asked like a teacher (caption/teachers): the rules, a model behind an endpoint or in vLLM.

    A trained student (`caption.student.folder`) gets the prompts and pictures of its training.
    """

    def __init__(self, cfg: FlyConfig, caption: CaptionConfig, infer: InferConfig, seed: int, answers: Path) -> None:
        is_local = cfg.engine == "transformers"
        model = Path(cfg.student.partition(":")[2])
        trained = cfg.as_student  # folder with the chat format of a trained student
        if is_local:
            trained = cfg.adapter or model
        elif cfg.engine == "vllm" and trained is None and (model / CHAT_FORMAT_FILE).is_file():
            trained = model
        update: dict[str, Any] = {"teacher": "rules" if is_local else cfg.student}
        if trained is not None:
            update["student"] = caption.student.model_copy(update={"folder": trained})
        self.vocabulary = vocabulary_of(caption)
        self.caption_cfg = student_settings(caption.model_copy(update=update), self.vocabulary)
        self.limit_s = cfg.answer_limit_s
        self.num_frames = self.caption_cfg.window.num_frames
        self._is_rules = cfg.engine == "rules"
        self._book = AnswerBook(answers)
        self._runner = asyncio.Runner()
        self._scratch = tempfile.TemporaryDirectory(prefix="cosfly-fly-")
        self._open(cfg, infer, seed)

    def _open(self, cfg: FlyConfig, infer: InferConfig, seed: int) -> None:
        budget = Budget(self.caption_cfg.budget, self.caption_cfg.most_in_flight, self._book.totals)
        self._opened = open_teacher(self.caption_cfg, self._book, seed, budget)
        self._teacher = self._runner.run(self._opened.__aenter__())  # open as long as the engine
        self.name = self._teacher.record.model

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        """Ask about all episodes at once."""
        return self._runner.run(self._ask_all([self._question(observation) for observation in observations]))

    async def _ask_all(self, questions: Sequence[Question]) -> list[EngineDecision]:
        return await asyncio.gather(*map(self._ask, questions))

    async def _ask(self, question: Question) -> EngineDecision:
        begun_s = time.monotonic()
        try:
            reply = await asyncio.wait_for(self._teacher.ask(question), self.limit_s)
        except TimeoutError:
            return EngineDecision("late", answer_s=time.monotonic() - begun_s)
        except (NoAnswer, CosflyError) as error:
            if isinstance(error, CosflyError) and error.fatal:
                raise
            if self._is_rules and isinstance(error, NoAnswer):
                # A flight needs a decision, also where no fact supports one.
                return EngineDecision("ok", decide(question.facts), str(error)[:MOST_WORDS])
            return EngineDecision("none", words=str(error)[:MOST_WORDS])
        is_timed = not (self._is_rules or reply.is_kept)  # so that the records of rules are always the same
        answer_s = time.monotonic() - begun_s if is_timed else None
        return self._read(reply.text, question, answer_s, reply.finish_reason)

    def _read(self, text: str, question: Question, answer_s: float | None, finish_reason: str | None) -> EngineDecision:
        """Return the decision of an answer. Its words are the reasons with their slots filled, or the raw text."""
        more = () if self.caption_cfg.student.folder is not None else tuple(THEREFORE)
        parsed = parse_answer(text, more=more, finish_reason=finish_reason)
        if parsed.coc is None:
            answer: Answer = "invalid" if parsed.reason == UNKNOWN_DECISION else "unreadable"
            return EngineDecision(answer, None, text[:MOST_WORDS], answer_s)
        draft = question.format.read(parsed.coc, question.facts)
        coc = draft.coc if isinstance(draft, Draft) else parsed.coc
        words = f"{coc.critical_components} {coc.reasoning_trace}"[:MOST_WORDS]
        return EngineDecision("ok", parsed.coc.flight_decision, words, answer_s)

    def _question(self, observation: Observation) -> Question:
        script = observation.simulation.script
        moments = observation.moments
        place = script.town, script.trajectory, script.variant
        height_px, width_px, _ = moments[-1].frame.rgb.shape
        window = ObservedWindow(
            sample_id(f"{script.trajectory}_{script.variant}", moments[-1].index), *place,
            indices=tuple(moment.index for moment in moments), width_px=width_px, height_px=height_px,
            frames=tuple(map(_observed, moments)),
            frame_folders=tuple(self._folder(place, moment) for moment in moments),
            frame_files=(frozenset(FILE_NAMES.values()),) * len(moments),
        )  # fmt: skip
        return make_question(window, self.caption_cfg.image, self.caption_cfg.writing, self.vocabulary)

    def _folder(self, place: tuple[str, str, str], moment: Moment) -> Path:
        """Write a frame for the student, remove the oldest one, and return the frame's folder."""
        if self._is_rules:  # they see no pictures
            return Path()
        track_folder = Path(self._scratch.name, *place)
        folder = track_folder / frame_name(moment.index)
        frame = moment.frame
        if not folder.is_dir():
            oldest = max(moment.index - self.caption_cfg.window.num_frames, 0)
            shutil.rmtree(track_folder / frame_name(oldest), ignore_errors=True)
            folder.mkdir(parents=True)
            (folder / FILE_NAMES["rgb"]).write_bytes(rgb_bytes(frame.rgb))
            (folder / FILE_NAMES["instance"]).write_bytes(instance_bytes(frame.kinds, frame.ids))
            name, data = depth_file(frame.depth, "png")
            (folder / name).write_bytes(data)
        return folder


def _observed(moment: Moment) -> ObservedFrame:
    """Return the flight data of a frame for a prompt."""
    target = moment.target
    bystanders = {name: math.nan if value is None else float(value) for name, value in moment.bystanders.items()}
    return ObservedFrame(
        time_s=moment.time_s, position_m=moment.position_m.tolist(), rotation_deg=moment.rotation_deg.tolist(),
        target_m=moment.target_m.tolist(), target_uv=target.image_uv or [math.nan] * 2,
        target_bbox=target.mask_bbox_2d or [math.nan] * 4, in_view=target.in_view, visible=target.visible,
        visibility=target.visibility, legible=bool(target.legible),
        others_in_view=bystanders.get("in_view", math.nan), other_distance_m=bystanders.get("nearest_m", math.nan),
        alike_differences=bystanders.get("alike_differences", math.nan),
    )  # fmt: skip


class LocalEngine(PromptedEngine):
    """A student in this process (distill/inference); the questions of all episodes are one batch."""

    def _open(self, cfg: FlyConfig, infer: InferConfig, seed: int) -> None:
        model = Path(cfg.student.partition(":")[2])
        inputs = Inputs((), {"": Path(self._scratch.name)}, model, cfg.adapter)
        self._has_reasons = cfg.reasons
        if not cfg.reasons and read_chat_format(cfg.adapter or model).decision != "first":
            raise ConfigError(
                "the student writes its reasons before its decision", where="fly.reasons", got="false", expected="true",
                fix="leave fly.reasons at true, or train a student with distill.prepare.decision=first",
            )  # fmt: skip
        self._local = LocalAnswers(infer, inputs, self._book, stop="" if cfg.reasons else DECISION_END)
        self.name = inputs.name

    async def _ask_all(self, questions: Sequence[Question]) -> list[EngineDecision]:
        begun_s = time.monotonic()
        samples = map(self._sample, questions)
        results = [result async for result in self._local.answers(samples, lambda count, told="": None)]
        answer_s = time.monotonic() - begun_s  # of the whole batch
        if answer_s > self.limit_s:
            return [EngineDecision("late", answer_s=answer_s)] * len(results)
        decisions = []
        for result, question in zip(results, questions, strict=True):
            answer = result.result
            if isinstance(answer, BookAnswer):
                time_s = answer_s if result.is_new else None
                decisions.append(self._read(answer.text, question, time_s, answer.finish_reason))
            else:
                decisions.append(EngineDecision("none", words=answer.message[:MOST_WORDS]))
        return decisions

    def _read(self, text: str, question: Question, answer_s: float | None, finish_reason: str | None) -> EngineDecision:
        if self._has_reasons:
            return super()._read(text, question, answer_s, finish_reason)
        answer = find_object(text + '"}', ("flight_decision",), finish_reason)
        if answer.value is None:
            return EngineDecision("unreadable", None, text[:MOST_WORDS], answer_s)
        action = normalize_action(str(answer.value.get("flight_decision", "")))
        return EngineDecision("ok" if action else "invalid", action, text[:MOST_WORDS], answer_s)

    @staticmethod
    def _sample(question: Question) -> Sample:
        window = question.window
        pictures = question.pictures
        return Sample(
            sample_id=window.sample_id, window_id=window.sample_id, run="", town=window.town,
            trajectory=window.trajectory, variant=window.variant, walk="", window=window.indices, language="en",
            views=pictures.views, picture_px=pictures.size_px, depth_range_m=pictures.depth_range_m,
            prompt=question.asked["en"], answer="", decision="", label=None, contradicted=None,
        )  # fmt: skip
