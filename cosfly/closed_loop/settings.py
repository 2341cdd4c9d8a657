"""Settings of the closed loop: the drone's limits and `cosfly fly`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from cosfly.geometry.motion import ACTION
from cosfly.runtime.config import Config
from cosfly.runtime.errors import nearest

ROUNDING = 1e-9  # of a command scaled to the greatest speed


@dataclass(frozen=True)
class Drone:
    """The limits of the drone; a command outside its bounds is rejected."""

    speed_max_mps: float = 10.0  # over ground (tab:drone_params)
    climb_max_mps: float = 4.0  # up and down
    accel_max_mps2: float = 5.0  # sec:step6
    yaw_rate_max_degps: float = 60.0
    yaw_accel_max_degps2: float = 120.0
    gimbal_rate_max_degps: float = 60.0
    gimbal_deg: tuple[float, float] = (-90.0, 30.0)  # least and greatest pitch of the camera
    radius_m: float = 0.5  # nearer to an obstacle or the ground is a crash

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest command, (5,) each as ACTION."""
        high = [self.speed_max_mps, self.speed_max_mps, self.climb_max_mps, self.yaw_rate_max_degps, self.gimbal_deg[1]]
        return np.array([*[-value for value in high[:4]], self.gimbal_deg[0]]), np.array(high)

    def problem_of(self, command: np.ndarray) -> str | None:
        """Return why a command is invalid, None if it is valid."""
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (len(ACTION),) or not np.isfinite(command).all():
            return f"a command must be {len(ACTION)} finite numbers: {', '.join(ACTION)}"
        low, high = self.bounds
        if (outside := (command < low) | (command > high)).any():
            k = int(np.argmax(outside))
            return f"{ACTION[k]} must be from {low[k]:g} to {high[k]:g}, got {command[k]:g}"
        if (speed_mps := float(np.hypot(*command[:2]))) > self.speed_max_mps * (1 + ROUNDING):
            return f"the speed over ground must be at most {self.speed_max_mps:g} m/s, got {speed_mps:g} m/s"
        return None

    def within_speed(self, command: np.ndarray) -> np.ndarray:
        """Return a command, (5,) as ACTION, with its speed over ground limited to the greatest."""
        command = command.copy()
        command[:2] *= min(1.0, self.speed_max_mps / max(float(np.hypot(*command[:2])), 1e-9))
        return command


class RelabelConfig(Config):
    """Settings of `cosfly fly --relabel`."""

    stride: int = Field(5, ge=1, description="frames between relabelled decisions")
    future_frames: int = Field(
        10, ge=5, le=100, description="number of frames that the planner adds after those of the student"
    )
    round: int = Field(1, ge=1, description="round of DAgger, recorded in the output")


CONTROLLER_FILE = Path(__file__).with_name("controller.yaml")
BASELINES = ("track_straight", "random")
MODELS = ("endpoint", "vllm", "transformers")
ENGINES = ("rules", *MODELS, "policy", *BASELINES, "planner")
KINDS = "rules, a URL, vllm:MODEL_DIR, transformers:MODEL_DIR, policy:MODULE:CLASS, track_straight, random or planner"


class FlyConfig(Config):
    """Settings of `cosfly fly`."""

    student: str = Field("rules", description=f"source of the decisions: {KINDS}")
    as_student: Path | None = Field(None, description="output of `distill train` or `merge`, whose prompts a URL gets")
    adapter: Path | None = Field(None, description="adapter of `distill train` for transformers:MODEL_DIR")
    lead_frames: int = Field(21, ge=5, le=1000, description="number of planned frames up to that of the first decision")
    answer_limit_s: float = Field(60.0, gt=0, description="time limit of a decision, s; after it, the drone hovers")
    lost_s: float = Field(
        30.0, ge=0, description="an episode ends after this time without a visible target, s; 0: never"
    )
    most_decisions: int = Field(
        0, ge=0, description="an episode ends after this number of decisions; 0: with its trajectory"
    )
    reasons: bool = Field(
        True, description="false: a student of transformers: answers with its decision alone, which must come first"
    )
    side_by_side: int = Field(16, ge=1, le=1024, description="episodes that a worker flies at once, as one batch")
    tree: bool = Field(True, description="render the playback tree of what was flown")
    relabel: RelabelConfig = Field(RelabelConfig(), description="settings of `cosfly fly --relabel`")

    @property
    def engine(self) -> str:
        """The kind of student."""
        kind = self.student.partition(":")[0]
        return "endpoint" if kind in ("http", "https") else kind

    @property
    def asks_model(self) -> bool:
        """Whether a model decides: then one process flies all episodes, with one engine and one batch."""
        return self.engine in MODELS

    @property
    def batch(self) -> int:
        """Number of episodes that a worker flies at once; one with a policy, because a policy has a state."""
        return 1 if self.engine == "policy" else self.side_by_side

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        if self.engine not in ENGINES:
            raise ValueError(f"fly.student {self.student!r} is unknown{nearest(self.student, ENGINES)}; use {KINDS}")
        if self.adapter is not None and self.engine != "transformers":
            raise ValueError(
                f"fly.adapter works only with fly.student=transformers:MODEL_DIR, but fly.student is {self.student!r}"
            )
        if not self.reasons and self.engine != "transformers":
            raise ValueError(
                f"fly.reasons=false works only with fly.student=transformers:MODEL_DIR, not with {self.student!r}"
            )
        return self

    def recorded(self) -> dict[str, Any]:
        """Return the settings on record, without a model's address and the paths of files, which change no result."""
        paths = {name: "own" if getattr(self, name) else None for name in ("as_student", "adapter")}
        return super().recorded() | {"student": self.engine if self.asks_model else self.student} | paths
