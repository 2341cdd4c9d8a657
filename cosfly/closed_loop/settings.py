"""Settings of the closed loop: the drone, and `cosfly fly`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from cosfly.geometry.motion import ACTION
from cosfly.runtime.config import Config
from cosfly.runtime.errors import nearest

ROUNDING = 1e-9  # of a command that was made as fast as it may be


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
    radius_m: float = 0.5  # nearer to an obstacle or to the ground the drone has crashed

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest command, (5,) each as ACTION."""
        high = [self.speed_max_mps, self.speed_max_mps, self.climb_max_mps, self.yaw_rate_max_degps, self.gimbal_deg[1]]
        return np.array([*[-value for value in high[:4]], self.gimbal_deg[0]]), np.array(high)

    def problem_of(self, command: np.ndarray) -> str | None:
        """Return what of a command cannot be flown, None where all can."""
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (len(ACTION),) or not np.isfinite(command).all():
            return f"a command is {len(ACTION)} finite numbers: {', '.join(ACTION)}"
        low, high = self.bounds
        if (outside := (command < low) | (command > high)).any():
            k = int(np.argmax(outside))
            return f"{ACTION[k]} {command[k]:g} is outside {low[k]:g} to {high[k]:g}"
        if (speed_mps := float(np.hypot(*command[:2]))) > self.speed_max_mps * (1 + ROUNDING):
            return f"a speed of {speed_mps:g} m/s over ground is more than {self.speed_max_mps:g}"
        return None

    def within_speed(self, command: np.ndarray) -> np.ndarray:
        """Scale a command's speed over ground, (5,) as ACTION, down to the greatest."""
        command = command.copy()
        command[:2] *= min(1.0, self.speed_max_mps / max(float(np.hypot(*command[:2])), 1e-9))
        return command


class RelabelConfig(Config):
    """`cosfly fly --relabel`: which frames of a flown flight become training data."""

    stride: int = Field(5, ge=1, description="frames from one that is looked at to the next")
    future_frames: int = Field(10, ge=5, le=100, description="frames of the planner after the student's")
    mistakes_only: bool = Field(
        False,
        description="leave out decisions that were no mistake; who learns from the others alone gets worse",
    )
    round: int = Field(1, ge=1, description="of DAgger; told in what is made")


CONTROLLER_FILE = Path(__file__).with_name("controller.yaml")
FLOORS = ("track_straight", "random")
MODELS = ("endpoint", "vllm", "transformers")
ENGINES = ("rules", *MODELS, "policy", *FLOORS, "planner")
KINDS = (
    "rules, a URL, vllm:MODEL_DIR, transformers:MODEL_DIR or policy:MODULE:CLASS; the floors track_straight and "
    "random; the ceiling planner, which flies its plan"
)


class FlyConfig(Config):
    """`cosfly fly`: who flies, and how."""

    student: str = Field("rules", description=f"who decides: {KINDS}")
    as_student: Path | None = Field(
        None, description="what `distill train` or `merge` wrote: a model behind a URL is asked as it was taught"
    )
    adapter: Path | None = Field(None, description="adapter of transformers:MODEL_DIR, as `distill train` wrote it")
    controller: Path | None = Field(
        None, description="file of yours in the place of the table that says what each decision is flown as"
    )
    lead_frames: int = Field(
        21,
        ge=5,
        le=1000,
        description="frames of the plan with which a flight begins, the present one included: 10 s, after which who "
        "walks has walked off and the drone has its pace",
    )
    answer_limit_s: float = Field(
        60.0, gt=0, description="a decision that takes longer is late: the drone hovers; simulated time stands still"
    )
    lost_s: float = Field(30.0, ge=0, description="a flight ends after so long without sight of the person; 0: never")
    most_decisions: int = Field(0, ge=0, description="a flight ends after so many decisions; 0: with its walk")
    side_by_side: int = Field(
        16, ge=1, le=1024, description="flights that a worker flies at once: their frames are one batch to a student"
    )
    tree: bool = Field(True, description="draw the playback tree of what was flown")
    trained_on: tuple[str, ...] | None = Field(
        None, description="towns that the student was trained on: the score marks their flights; null: not known"
    )
    relabel: RelabelConfig = Field(RelabelConfig(), description="`cosfly fly --relabel`: the planner where it erred")

    @property
    def engine(self) -> str:
        """The kind of who decides."""
        kind = self.student.partition(":")[0]
        return "endpoint" if kind in ("http", "https") else kind

    @property
    def asks_model(self) -> bool:
        """Whether an engine decides: one process flies all, so that there is one engine and one batch."""
        return self.engine in MODELS

    @property
    def flock(self) -> int:
        """Flights that a worker flies at once: of a policy one, as it remembers what it has seen."""
        return 1 if self.engine == "policy" else self.side_by_side

    @property
    def table(self) -> Path:
        """The file that says what each decision is flown as."""
        return self.controller or CONTROLLER_FILE

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        if self.engine not in ENGINES:
            raise ValueError(f"there is no student {self.student!r}{nearest(self.student, ENGINES)}; there are {KINDS}")
        if self.adapter is not None and self.engine != "transformers":
            raise ValueError(f"an adapter is read by transformers:MODEL_DIR alone, got student {self.student!r}")
        return self

    def recorded(self) -> dict[str, Any]:
        """Where a model is asked does not decide what it says; a table of one's own counts by its content."""
        own = {name: "own" if getattr(self, name) else None for name in ("controller", "as_student", "adapter")}
        return super().recorded() | {"student": self.engine if self.asks_model else self.student} | own
