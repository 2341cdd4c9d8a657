"""The shared part of renderers of running simulators: settings, retries of a frame, lens, placement of movers."""

import logging
from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import Camera, Look
from cosfly.geometry.axes import focal_px
from cosfly.render.contract import Frame, PosedPeople, PosedPerson, check_pose
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import EnvironmentMissing, RenderError
from cosfly.runtime.worker import worker_index
from cosfly.simulators.guard import EngineGuard

log = logging.getLogger(__name__)

TRIES = 3  # to draw a frame
WALK_MPS = 1.4  # walking speed at full swing
FIX = "read the server's log, then run the same command again; finished trajectories are kept"


class ServerCommand(Config):
    """How to start the server of a simulator."""

    server_command: MayDiffer[str] = Field(
        "",
        description="command that starts a server at {port}, such as 'CarlaUE4.sh -RenderOffScreen "
        "-carla-rpc-port={port}', and again when it dies; empty: the servers already run",
    )


class NoPictureError(Exception):
    """A camera did not send a picture."""


class SimulatorRenderer(ABC):
    """A renderer that asks a server for each frame; each worker has a server of its own.

    It calls `_open` once, `_frame` for each frame, and `_recover` before it tries to draw a failed frame again.
    """

    dresses = False  # people wear what their blueprint wears
    engine: ClassVar[str]
    port_step: ClassVar[int] = 1  # between the servers of two workers
    device: str

    def __init__(
        self, box_map: BoxMap, width_px: int, height_px: int, look: Look, num_others: int = 0, *, settings: Any
    ) -> None:
        self._map = box_map
        self._size_px = (width_px, height_px)
        self._num_others = num_others
        self._cfg = settings
        self._port = settings.port + self.port_step * worker_index()
        self._open()

    @abstractmethod
    def _open(self) -> None:
        """Start the server if a command is given, and connect."""

    @abstractmethod
    def _recover(self, problem: Exception) -> None:
        """Get ready to draw again after a frame failed."""

    @abstractmethod
    def _frame(self, camera_pose: np.ndarray, fov_deg: float, people: PosedPeople) -> Frame:
        """Draw one frame."""

    def _start_guard(self) -> EngineGuard:
        return EngineGuard(self.engine, self._cfg.host, self._port, self._cfg.server_command, self._cfg.timeout_s)

    def render(self, camera_pose: np.ndarray, intrinsic: np.ndarray, people: PosedPeople) -> Frame:
        """Draw one frame, as the contract says; one that fails is drawn again after `_recover`."""
        check_pose(camera_pose, intrinsic)
        fov_deg = self._fov_deg_of(intrinsic)
        problem: Exception | None = None
        for attempt in range(1, TRIES + 1):
            try:
                if problem is not None:
                    self._recover(problem)
                return self._frame(camera_pose, fov_deg, people)
            except (NoPictureError, RuntimeError, EnvironmentMissing) as error:
                if not isinstance(problem, EnvironmentMissing):  # the first one names the cause best
                    problem = error
                log.warning("%s: a frame failed (%d of %d): %s", self.device, attempt, TRIES, error)
        if isinstance(problem, EnvironmentMissing):
            raise problem
        if isinstance(problem, NoPictureError):
            raise RenderError("a camera of the simulator sent no picture", where=self.device, got=str(problem), fix=FIX)
        raise EnvironmentMissing("the simulator no longer answers", where=self.device, got=str(problem), fix=FIX)

    def _fov_deg_of(self, intrinsic: np.ndarray) -> float:
        """Return the horizontal field of view of a matrix, which is all that a simulator knows of a lens."""
        width, height = self._size_px
        fov_deg = round(Camera(width, height, intrinsic).fov_deg, 6)
        f = focal_px(width, fov_deg)
        if not np.allclose(intrinsic, [[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]], atol=1e-3):
            what = "the simulator cannot render with this intrinsic matrix of the camera"
            (fx, skew, cx), (_, fy, cy) = intrinsic[:2]
            got = f"fx {fx:g}, fy {fy:g}, skew {skew:g}, principal point {cx:g}, {cy:g} px"
            expected = "square pixels, and the principal point in the middle of the picture"
            raise RenderError(what, where=self.device, got=got, expected=expected)
        return fov_deg


class Placement(NamedTuple):
    """Where to put a walking person."""

    hip_m: np.ndarray  # (3,) world
    rotation_deg: np.ndarray  # (3,) pitch, yaw, roll
    ahead: np.ndarray  # (3,) unit vector
    speed_mps: float


def placement_of(person: PosedPerson, lead_s: float) -> Placement:
    """Return where to put a person who walks, so that the person reaches the posed place after `lead_s` seconds."""
    rotation_deg = np.array([0.0, np.degrees(person.heading_rad), 0.0])
    ahead = np.array([np.cos(person.heading_rad), np.sin(person.heading_rad), 0.0])
    speed_mps = WALK_MPS * person.swing
    return Placement(person.hip_m - ahead * speed_mps * lead_s, rotation_deg, ahead, speed_mps)
