"""Types and settings of the caption stage.

`ObservedWindow` is all that a teacher may know: it has no future. Label and verdict follow from `FutureMotion`. Only
`windows.py` makes both, and nothing that builds a prompt takes a `FutureMotion`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from cosfly.formats.captions import LabelFrom, Language, TeacherKind, Verdict, Writing
from cosfly.formats.places import TrackChoice
from cosfly.formats.predictions import PREDICTIONS
from cosfly.llm.answers import BudgetConfig
from cosfly.llm.client import EndpointConfig
from cosfly.llm.protocol import check_url
from cosfly.llm.vllm_engine import VllmConfig
from cosfly.runtime.config import Config, MayDiffer
from cosfly.viz.frame_views import DEPTH_RANGE_M, Layout, View

Strategy = Literal["anchored", "hint", "multi_sample", "cascade"]
Treatment = Literal["keep", "repair", "drop"]
Judgement = Literal["ACCEPT_ALTERNATIVE", "FIX_LABEL", "REJECT_REGEN"]
TextState = Literal["relative", "paper"]


# --- windows ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """The flight data of one frame, in plain numbers, NaN if unknown. Windows share it, so it is computed once."""

    time_s: float
    position_m: Sequence[float]  # x, y, z of the drone
    rotation_deg: Sequence[float]  # pitch, yaw, roll
    target_m: Sequence[float]  # x, y, z
    target_uv: Sequence[float]  # u, v, px
    # Left, top, right, bottom, px: of the target's visible part, or of its projected 3D box in a tree without masks.
    target_bbox: Sequence[float]
    in_view: bool
    visible: bool
    visibility: float  # rendered score
    legible: bool = True  # a visible target can be recognized
    others_in_view: float = math.nan  # number of other people in view
    other_distance_m: float = math.nan  # from the target to the nearest of them
    alike_differences: float = math.nan  # items in which the most similar of them looks different


def observed_frames(*columns: np.ndarray) -> tuple[ObservedFrame, ...]:
    """Return n frames from one array (n, ...) per field, in the order of the fields."""
    return tuple([ObservedFrame(*row) for row in zip(*[column.tolist() for column in columns], strict=True)])


@dataclass(frozen=True)
class ObservedWindow:
    """The observed frames t0..t(n-1) of one sample, oldest first; the last is the current one. Right-handed axes."""

    sample_id: str
    town: str
    trajectory: str
    variant: str
    indices: tuple[int, ...]  # of the frames in the track
    width_px: int
    height_px: int
    frames: tuple[ObservedFrame, ...]
    frame_folders: tuple[Path, ...]
    frame_files: tuple[frozenset[str], ...]  # names of the files in each folder
    mission: str | None = None  # the order that ends the pursuit (MISSION_KINDS), if it is known at the current frame
    goal: dict[Language, str] | None = None  # description of the target, in tracks with other people


@dataclass(frozen=True)
class FutureMotion:
    """The motion after the current frame, never shown to a teacher. Arrays have m + 1 rows, the first of this frame."""

    indices: tuple[int, ...]  # (m,), of the future frames
    time_s: np.ndarray  # (m + 1,)
    positions_m: np.ndarray  # (m + 1, 3), of the drone
    yaw_deg: np.ndarray  # (m + 1,)
    targets_m: np.ndarray  # (m + 1, 3)
    visible: np.ndarray  # (m + 1,) bool
    speed_before_mps: float  # over the last observed step, with which the future speed is compared
    label_from: LabelFrom = "flight"
    order: str | None = None  # the decision that the mission orders at the current frame


@dataclass(frozen=True)
class Window:
    """The observed frames and the future of one sample. A teacher gets `observed` only."""

    observed: ObservedWindow
    future: FutureMotion
    problem: str | None = None  # why no teacher may be asked, for instance a missing image


# --- settings ---------------------------------------------------------------------------------------------------------


class WindowConfig(Config):
    num_frames: int = Field(5, ge=3, le=32, description="observed frames of a window, one time step apart")
    future_frames: int = Field(5, ge=1, le=32, description="frames after the current one that determine the label")
    stride: int = Field(1, ge=1, description="frames between the current frames of two windows; 1 takes every frame")
    require_images: bool = Field(True, description="drop a window that lacks the rgb.png of an observed frame")


class ImageConfig(Config):
    modalities: tuple[View, ...] = Field(
        ("rgb", "depth", "segmentation"), description="views of a frame; none for a model without vision"
    )
    layout: Layout = Field("separate", description="separate: one image per view; tiled: one per frame, side by side")
    max_side_px: int = Field(
        640, ge=28, description="longest side of a view, px; pixel values in prompts refer to this size"
    )
    depth_range_m: float = Field(DEPTH_RANGE_M, gt=0, description="depth at the dark end of the pseudo-colour, m")


class JudgeConfig(EndpointConfig):
    """A language model that judges conflicts between a decision and the label; it never excuses a hard conflict."""

    own_names: ClassVar[dict[str, str]] = {"caption.endpoint": "caption.judge"}
    url: str | None = Field(None, description="OpenAI-compatible endpoint of the judge; empty: no judge")
    temperature: float = Field(0.0, ge=0, le=2, description="sampling temperature; 0 is greedy")
    max_tokens: int = Field(512, ge=64, description="longest judgement, tokens")

    @model_validator(mode="after")
    def _is_url(self) -> Self:
        if self.url is not None:
            check_url(self.url)
        return self

    def recorded(self) -> dict[str, Any]:
        """Return the settings without the address, which does not change the judgements."""
        return super().recorded() | {"url": None if self.url is None else "endpoint"}


class RepairConfig(Config):
    hard_conflict: Treatment = Field(
        "repair",
        description="treatment of a decision that the trajectory contradicts: repair (ask again), drop or keep",
    )
    soft_conflict: Treatment = Field(
        "keep", description="treatment of a decision that differs from the label, without a judge: keep, repair or drop"
    )
    strategy: Strategy = Field(
        "anchored",
        description="anchored: the new prompt gives the label; hint: it names the rejected decision; multi_sample: the "
        "same prompt again; cascade: hint, multi_sample and anchored, until a decision is the label",
    )
    max_asks: int = Field(3, ge=0, le=10, description="most regenerations of an answer in conflict; 0: drop it at once")

    def treatment_of(self, verdict: Verdict | None) -> Treatment:
        """Return the treatment of an answer with this verdict."""
        return {"HARD_CONFLICT": self.hard_conflict, "SOFT_CONFLICT": self.soft_conflict}.get(str(verdict), "keep")


class StudentConfig(Config):
    """A student as a teacher: behind a server or in vLLM (caption/teachers/students.py), or by its predictions."""

    folder: Path | None = Field(
        None,
        description="output of `distill train` or `merge`, if the teacher is this student, for prompts as in its "
        "training; empty: no student",
    )
    constrained: bool = Field(False, description="enforce the JSON schema of the student's answers")
    run: str | None = Field(
        None, description="tree to caption, as named in the training set, if student:PATH has predictions for several"
    )

    def recorded(self) -> dict[str, Any]:
        """Return the settings without the place of the folder; its content is recorded in the other settings."""
        return super().recorded() | {"folder": None if self.folder is None else "student"}


class CaptionConfig(Config):
    """Settings of stage `caption`."""

    teacher: str = Field(
        "rules",
        description="`rules` (built in, no model), the URL of an OpenAI-compatible endpoint, `vllm:MODEL_DIR`, "
        "`file:PATH` with one caption per line, or `student:PATH`, output of `distill infer`",
    )
    writing: Writing = Field(
        "slots",
        description="form of the answers. slots: they name facts, and cosfly fills in the values; prose: plain text",
    )
    text_state: TextState = Field(
        "relative",
        description="flight data in a prompt. relative: place and motion in the axes of the drone, with their changes; "
        "paper: velocity, altitude, yaw, target speed, visibility, world poses",
    )
    prompts: Path | None = Field(
        None, description="folder with your own prompts; `cosfly caption prompts --export DIR` writes one to begin with"
    )
    flights: TrackChoice = Field(TrackChoice(), description="tracks to caption")
    window: WindowConfig = Field(WindowConfig(), description="windows")
    image: ImageConfig = Field(ImageConfig(), description="pictures in a request")
    contradicted_values: Literal["drop", "keep"] = Field(
        "drop", description="treatment of a caption with a number that contradicts the measured facts"
    )
    endpoint: EndpointConfig = Field(EndpointConfig(), description="requests to an endpoint")
    student: StudentConfig = Field(StudentConfig(), description="settings of a teacher that is a student")
    vllm: MayDiffer[VllmConfig] = Field(VllmConfig(), description="the engine of teacher vllm:MODEL_DIR")
    budget: MayDiffer[BudgetConfig] = Field(BudgetConfig(), description="prices and limits of tokens and money")
    repair: RepairConfig = Field(RepairConfig(), description="regeneration of rejected samples")
    judge: JudgeConfig = Field(JudgeConfig(), description="an optional judge of conflicts")
    stop_after_dropped: MayDiffer[int] = Field(
        50, ge=0, description="end the run if none of this number of first windows is accepted; 0: never"
    )
    limit: MayDiffer[int | None] = Field(None, ge=1, description="caption at most this many windows; empty: all")

    @model_validator(mode="after")
    def _fits_teacher(self) -> Self:
        kind = self.teacher_kind
        if kind == "rules" and self.writing != "slots":
            raise ValueError(
                f"the teacher `rules` needs writing=slots, got {self.writing!r}; set writing, or choose another teacher"
            )
        if self.student.folder is not None and kind not in ("endpoint", "vllm"):
            raise ValueError(f"student.folder needs the teacher URL or vllm:MODEL_DIR, got {self.teacher!r}")
        if kind == "endpoint":
            try:
                check_url(self.teacher)
            except ValueError as error:
                kinds = "`rules`, a URL, vllm:MODEL_DIR, file:PATH or student:PATH"
                raise ValueError(f"teacher must be {kinds}; {error}") from None
        return self

    @property
    def teacher_kind(self) -> TeacherKind:
        if self.teacher == "rules":
            return "rules"
        kinds: tuple[TeacherKind, ...] = ("file", "student", "vllm")
        return next((kind for kind in kinds if self.teacher.startswith(f"{kind}:")), "endpoint")

    @property
    def caption_file(self) -> Path | None:
        """The captions of teacher file:PATH, the predictions of student:PATH."""
        if self.teacher_kind not in ("file", "student"):
            return None
        path = Path(self.teacher.partition(":")[2])
        return path / PREDICTIONS if self.teacher_kind == "student" and path.is_dir() else path

    @property
    def most_in_flight(self) -> int:
        """Number of requests that the teacher takes at once."""
        if self.teacher_kind == "endpoint":
            return self.endpoint.concurrency
        return self.vllm.batch if self.teacher_kind == "vllm" else 1

    @property
    def num_images(self) -> int:
        """Largest number of pictures of a question."""
        return self.window.num_frames * (1 if self.image.layout == "tiled" else len(self.image.modalities))

    def recorded(self) -> dict[str, Any]:
        """Return the settings without places, which do not change answers; digests of own files are recorded apart."""
        return super().recorded() | {"teacher": self.teacher_kind, "prompts": "own" if self.prompts else None}
