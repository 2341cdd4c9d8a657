"""A running UnrealCV server as a renderer, as SimWorld's: it draws its own level and people, and we decode
(app:simworld, step 6).

A frame: everybody and the camera are put in their places, the engine goes on for the settle delay, and is paused while
its three pictures are read. Whose a pixel is, its colour in the object mask tells, and a box's id the object's name
(`cosfly.simulators.assets.id_of`); of an object that has no box the id is NO_INSTANCE.

A flight whose lengths were not converted is one of people's legs, with a camera at ground level. So the level is held
against the map before anything is drawn, and the camera against its place in each frame.
"""

from __future__ import annotations

import logging
import re
import time
import weakref
from collections.abc import Sequence
from typing import ClassVar

import cv2
import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M, Look
from cosfly.formats.kinds import KINDS
from cosfly.formats.weather import WeatherParams
from cosfly.render.contract import (
    NEAR_M,
    NO_INSTANCE,
    PERSON_ID,
    Frame,
    PosedBystander,
    PosedCar,
    PosedPerson,
    check_pose,
    far_as_sky,
    instance_ids,
)
from cosfly.render.engines import WALK_MPS, NoPictureError, fov_of, keep_asking
from cosfly.runtime.arrays import parse_array, parse_picture
from cosfly.runtime.config import MayDiffer
from cosfly.runtime.errors import ConfigError, InputError, RenderError
from cosfly.runtime.worker import worker_place
from cosfly.simulators.assets import id_of, kind_of
from cosfly.simulators.conventions import FAR_CM, camera_rotation_deg, unreal_pose, world_pose
from cosfly.simulators.guard import EngineGuard
from cosfly.simulators.unrealcv_client import OURS, NoAnswerError, UnrealCvConfig, connect, is_refusal, ours

log = logging.getLogger(__name__)

MOST_CHECKED = 200  # objects that are held against the map
SAME_BOX_M, SAME_PLACE_M = 1.0, 0.1
COLORS = 1 << 24


class UnrealCvRenderConfig(UnrealCvConfig):
    """UnrealCV as a renderer; worker i asks the server at port + i."""

    coord_z_offset: float = Field(0.0, description="added to all heights, m, where the recorded altitude is off")
    settle_delay_s: float = Field(0.1, ge=0, description="how long the engine goes on after a pose, s")
    camera: int = Field(0, ge=0, description="number of the camera, of `vget /cameras`")
    animate: bool = Field(True, description="people walk while the engine settles; false: they are only placed")
    # blueprint of people
    person_asset: ClassVar[str] = "/Game/TrafficSystem/Pedestrian/Base_User_Agent.Base_User_Agent_C"
    car_asset: ClassVar[str] = "/Game/TrafficSystem/Vehicle/Vehicle1.Vehicle1_C"  # blueprint of cars
    server_command: MayDiffer[str] = Field(
        "",
        description="starts a server, with {port} in it; it is started again when it dies; empty: servers run already",
    )
    retries: MayDiffer[int] = Field(2, ge=0, description="how often a frame is asked again, on a new connection")


class UnrealCvRenderer:
    """Draws by an UnrealCV server whose level is the map's."""

    dresses = False  # people wear what their blueprint wears

    def __init__(
        self,
        box_map: BoxMap,
        width_px: int,
        height_px: int,
        look: Look,
        num_others: int = 0,
        rim: BoxMap | None = None,
        settings: UnrealCvRenderConfig = UnrealCvRenderConfig(),
    ) -> None:
        self._map, self._size_px, self._num_others, self._cfg = box_map, (width_px, height_px), num_others, settings
        self._port = settings.port + worker_place()
        self._guard: EngineGuard | None = None
        self._open()

    # --- the server ---------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        """Start the server if that is ours to do, connect, and find the map in its level."""
        cfg, is_first = self._cfg, self._guard is None
        if self._guard is None:
            self._guard = EngineGuard("unrealcv", cfg.host, self._port, cfg.server_command, cfg.timeout_s)
        try:
            self._server = connect(cfg, self._port)
            weakref.finalize(self, self._server.close)  # one client at a time: who asks no more makes room
            try:
                with self._server.asking("the level was not given"):
                    self._begin(self._guard if is_first else None)
            except Exception:
                self._server.close()
                raise
        except Exception:
            if is_first:
                self._leave()
            raise

    def _begin(self, guard: EngineGuard | None) -> None:
        """Learn what is there; a guard is told how the camera was found."""
        self.device = f"UnrealCV {self._server.version} at {self._server.endpoint}, {self._server.level}"
        self._spawned: dict[int, str] = {}
        self._fov_deg = 0.0
        if guard is not None:
            asked = ("size", "fov", "pose")
            found = zip(asked, self._server.ask(*(f"vget {self._camera}/{what}" for what in asked)), strict=True)
            guard.note([f"vset {self._camera}/{what} {text!s}" for what, text in found if not is_refusal(text)])
        names = str(*self._server.ask("vget /objects"))
        left = ours(names)  # by a connection that broke
        self._server.tell(*(f"vset /object/{name}/destroy" for name in left))
        self._link([name for name in names.split() if name not in left])
        self._server.tell(f"vset {self._camera}/size {self._size_px[0]} {self._size_px[1]}")

    @property
    def _camera(self) -> str:
        return f"/camera/{self._cfg.camera}"

    def _link(self, names: list[str]) -> None:
        """Make tables from colours of the object mask to our ids and kinds."""
        ids, rows = instance_ids(self._map, self._num_others), {int(k): row for row, k in enumerate(self._map.ids)}
        self._ids = np.full(COLORS, NO_INSTANCE, dtype=np.uint16)
        self._kinds = np.full(COLORS, KINDS["NONE"], dtype=np.uint8)
        asked = (f"vget /object/{name}/{what}" for name in names for what in ("color", "uclass_name"))
        answers, linked = iter(self._server.ask(*asked)), dict[str, int]()
        self._used = set[int]()
        num_doubtful = 0
        for name in names:
            color, class_name = _color_of(next(answers)), str(next(answers))
            row = rows.get(id_of(name))
            if row is not None:
                linked[name] = row
            if color is None or color in self._used:
                num_doubtful += 1
                continue
            self._used.add(color)
            self._ids[color] = NO_INSTANCE if row is None else ids[row]
            self._kinds[color] = KINDS[kind_of(class_name) or "Other"] if row is None else self._map.kinds[row]
        if not linked:
            what, fix = (
                "no box of the map is in the level",
                "cosfly maps --source unrealcv exports the level",
            )
            raise InputError(what, where=self._server.where, got=self._map.name, fix=fix)
        if len(linked) < len(self._map) or num_doubtful:
            what = "%s: %d of %d boxes are objects of the level; %d objects have no colour of their own"
            log.warning(what, self._server.where, len(linked), len(self._map), num_doubtful)
        self._check_scale(linked)

    def _check_scale(self, linked: dict[str, int]) -> None:
        """Hold places of objects against the map's boxes: with another scale the camera would stand elsewhere."""
        names = list(linked)[:: max(1, len(linked) // MOST_CHECKED)]
        told = [self._server.numbers(one, 6) for one in self._server.ask(*(f"vget /object/{n}/bounds" for n in names))]
        pairs = [(np.reshape(b, (2, 3)).mean(axis=0), linked[name]) for name, b in zip(names, told, strict=True) if b]
        if not pairs:
            return
        raw = np.array([world_pose([*middle, 0.0, 0.0, 0.0])[0] for middle, _ in pairs])
        boxes = self._map.select(np.array([row for _, row in pairs]))
        middles_m = (boxes.mins + boxes.maxs) / 2
        offset_m = np.array([0.0, 0.0, self._cfg.coord_z_offset])
        gap_m = float(np.median(np.linalg.norm(raw / self._cfg.coord_scale - offset_m - middles_m, axis=1)))
        if gap_m <= SAME_BOX_M:
            return
        away, away_m = (np.linalg.norm(p - np.median(p, axis=0), axis=1) for p in (raw, middles_m))
        scale = float(np.median(away[away_m > 0] / away_m[away_m > 0])) if (away_m > 0).any() else 0.0
        scale = scale or float("nan")  # all in one place
        high_m = float(np.median(raw[:, 2] / scale - middles_m[:, 2]))
        raise ConfigError(
            "the level is of another scale than the map: the camera would stand at ground level, or beside the town",
            where=self._server.where,
            got=f"coord_scale {self._cfg.coord_scale:g}, coord_z_offset {self._cfg.coord_z_offset:g}: objects are "
            f"{gap_m:.1f} m from their boxes",
            expected=f"coord_scale {scale:.4g}, coord_z_offset {high_m:.2f}",
            fix="set --coord-scale and --coord-z-offset, or export the map from this level",
        )

    def _mend(self, problem: Exception) -> None:
        self._server.close()
        if self._cfg.server_command:
            self._leave()
        self._open()

    def close(self) -> None:
        """Leave the level as it was found."""
        self._server.close()
        self._leave()

    def _leave(self) -> None:
        if self._guard is not None:
            self._guard.close()
            self._guard = None

    # --- one frame ----------------------------------------------------------------------------------------------------

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Have everybody spawned anew; the level's own weather stays."""
        if weather is not None:
            raise RenderError("this renderer draws no weather", where=self.device, fix="take gl or carla")
        with self._server.asking("people were not taken away"):
            for number in list(self._spawned):
                self._server.tell(self._removal(number))

    def render(
        self,
        camera_pose: np.ndarray,
        intrinsic: np.ndarray,
        person: PosedPerson | None,
        others: Sequence[PosedBystander] = (),
    ) -> Frame:
        """Draw one frame, as the contract says."""
        check_pose(camera_pose, intrinsic)
        fov_deg = fov_of(intrinsic, self._size_px, self.device)
        bodies = ({} if person is None else {PERSON_ID: person}) | {one.instance_id: one.body for one in others}
        return keep_asking(
            lambda: self._frame(camera_pose, fov_deg, bodies), self._mend, self._cfg.retries, self.device
        )

    def _frame(self, camera_pose: np.ndarray, fov_deg: float, bodies: dict[int, PosedPerson | PosedCar]) -> Frame:
        place, turn = self._there(camera_pose[:3, 3], camera_rotation_deg(camera_pose))
        try:
            commands = ["vset /action/game/resume", *(self._removal(n) for n in self._spawned.keys() - bodies.keys())]
            for number, body in bodies.items():
                commands += self._placing(number, body)
            if fov_deg != self._fov_deg:
                commands.append(f"vset {self._camera}/fov {fov_deg:.6f}")
            self._server.tell(*commands, f"vset {self._camera}/pose {place} {turn}")
            self._fov_deg = fov_deg
            time.sleep(self._cfg.settle_delay_s)
            asked = ("location", "lit png", "object_mask png", "depth npy")
            commands = ["vset /action/game/pause", *(f"vget {self._camera}/{what}" for what in asked)]
            _, found, lit, mask, depth = self._server.ask(*commands)
            self._check_place(camera_pose[:3, 3], found)
            return self._decoded(lit, mask, depth)
        except (NoAnswerError, InputError) as error:
            raise NoPictureError(f"camera {self._cfg.camera}: {error}") from None

    def _there(self, position_m: np.ndarray, rotation_deg: np.ndarray) -> tuple[str, str]:
        """Return a place in the level's units and its rotation, as words of commands."""
        x, y, z, *turn = unreal_pose(position_m + np.array([0.0, 0.0, self._cfg.coord_z_offset]), rotation_deg)
        place = (f"{part * self._cfg.coord_scale:.6f}" for part in (x, y, z))
        return " ".join(place), " ".join(f"{part:.6f}" for part in turn)

    def _check_place(self, position_m: np.ndarray, found: str | bytes) -> None:
        numbers = self._server.numbers(found, 3)
        if numbers is None:
            raise NoAnswerError(f"its place is {found!r}")
        place_m = world_pose([*(part / self._cfg.coord_scale for part in numbers), 0.0, 0.0, 0.0])[0]
        place_m[2] -= self._cfg.coord_z_offset
        if np.linalg.norm(place_m - position_m) > SAME_PLACE_M:
            both = np.stack([place_m, position_m])
            over_m = both[:, 2] - self._map.ground.height_at(both)
            got, wanted = (
                f"{np.round(p, 2).tolist()}, {over:.1f} m over the ground" for p, over in zip(both, over_m, strict=True)
            )
            what, fix = "the camera is not where it was put", "see what moves it, as a pawn's gravity; or take another"
            raise RenderError(what, where=self.device, got=got, expected=wanted, fix=f"{fix} (render.unrealcv.camera)")

    def _decoded(self, lit: str | bytes, mask: str | bytes, depth: str | bytes) -> Frame:
        """Make a frame of a server's pictures; InputError where one is none."""
        shape, pictures = self._size_px[::-1], []
        for name, data in (("lit", lit), ("object_mask", mask)):
            if isinstance(data, str):
                raise InputError("not an image", where=name, got=repr(data)[:80])
            pictures.append(parse_picture(data, name, flags=cv2.IMREAD_COLOR))
        raw = parse_array(depth if isinstance(depth, bytes) else depth.encode(), "depth", dtype=np.float32, ndim=2)
        if sizes := [one.shape[:2] for one in (*pictures, raw) if one.shape[:2] != shape]:
            raise InputError("a picture of another size", where=self.device, got=str(sizes[0]), expected=str(shape))
        blue, green, red = (pictures[1][..., k].astype(np.int64) for k in range(3))
        colors = red << 16 | green << 8 | blue
        kinds, ids, depth_m = self._kinds[colors], self._ids[colors], raw / np.float32(self._cfg.coord_scale)
        is_sky = ~(raw < FAR_CM)
        depth_m[depth_m < NEAR_M], depth_m[is_sky] = INVALID_DEPTH_M, SKY_DEPTH_M
        kinds[is_sky], ids[is_sky] = KINDS["Sky"], NO_INSTANCE
        return far_as_sky(Frame(np.ascontiguousarray(pictures[0][..., ::-1]), depth_m, kinds, ids))

    # --- people and cars ----------------------------------------------------------------------------------------------

    def _placing(self, number: int, body: PosedPerson | PosedCar) -> list[str]:
        """Put somebody where the frame has them; who walks is put so that the settle delay leads there."""
        name, turn_deg = self._spawned.get(number) or self._spawn(number, body), np.zeros(3)
        turn_deg[1] = np.degrees(body.heading_rad)
        if isinstance(body, PosedCar):
            position_m, walk = body.center_m - np.array([0.0, 0.0, body.half_extents_m[2]]), list[str]()
        else:
            position_m, walk = self._walk(name, body)
        place, turn = self._there(position_m, turn_deg)
        return [f"vset /object/{name}/location {place}", f"vset /object/{name}/rotation {turn}", *walk]

    def _walk(self, name: str, body: PosedPerson) -> tuple[np.ndarray, list[str]]:
        """Where somebody begins who walks while the engine settles, (3,) m, and the commands of it."""
        speed_mps = WALK_MPS * body.swing
        if not self._cfg.animate or speed_mps <= 0.0:
            return body.hip_m, [f"vbp {name} StopAgent"] if self._cfg.animate else []
        ahead = np.array([np.cos(body.heading_rad), np.sin(body.heading_rad), 0.0])
        speed = f"vbp {name} SetMaxSpeed {speed_mps * self._cfg.coord_scale:.3f}"
        return body.hip_m - ahead * speed_mps * self._cfg.settle_delay_s, [speed, f"vbp {name} MoveForward"]

    def _spawn(self, number: int, body: PosedPerson | PosedCar) -> str:
        """Spawn somebody in a colour that no object has."""
        name, is_person = f"{OURS}{number}", isinstance(body, PosedPerson)
        asset = self._cfg.person_asset if is_person else self._cfg.car_asset
        color = next(c for c in range(COLORS - 1, 0, -1) if c not in self._used)
        paint = f"{color >> 16} {color >> 8 & 0xFF} {color & 0xFF}"
        self._server.tell(f"vset /objects/spawn_bp_asset {asset} {name}", f"vset /object/{name}/color {paint}")
        self._used.add(color)
        self._ids[color], self._kinds[color] = number, KINDS["Pedestrians" if is_person else "Car"]
        self._spawned[number] = name
        return name

    def _removal(self, number: int) -> str:
        return f"vset /object/{self._spawned.pop(number)}/destroy"


def _color_of(answer: str | bytes) -> int | None:
    """Read `(R=1,G=2,B=3,A=255)`."""
    found = re.match(r"\(R=(\d{1,3}),G=(\d{1,3}),B=(\d{1,3})", answer) if isinstance(answer, str) else None
    red, green, blue = map(int, found.groups()) if found else (0, 0, 0)
    return (red << 16 | green << 8 | blue) or None if max(red, green, blue) < 256 else None
