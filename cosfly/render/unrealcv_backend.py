"""Rendering by a running UnrealCV server, such as SimWorld's (app:simworld, step 6).

The server draws its own level and people; this module decodes its pictures. The colour of a pixel in the object mask
identifies an object, and the object's name identifies its box. The level is compared with the map, because with another
scale the camera would be at a wrong place.
"""

import logging
import re
import time
import weakref
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.formats.kinds import KINDS
from cosfly.formats.weather import WeatherParams
from cosfly.render.contract import NEAR_M, NO_INSTANCE, Frame, PosedPeople, PosedPerson, far_as_sky, instance_ids
from cosfly.render.simulator import NoPictureError, ServerCommand, SimulatorRenderer, placement_of
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.errors import ConfigError, InputError, RenderError, shown
from cosfly.runtime.png import colours_of
from cosfly.simulators import unrealcv_client
from cosfly.simulators.assets import id_of, kind_of
from cosfly.simulators.conventions import FAR_UNITS, camera_rotation_deg, unreal_pose, world_pose
from cosfly.simulators.guard import EngineGuard
from cosfly.simulators.unrealcv_client import NoAnswerError, UnrealCvConfig, UnrealCvConnection, is_refusal

log = logging.getLogger(__name__)

MOST_CHECKED = 200  # objects that are compared with the map
SAME_BOX_M = 1.0  # largest median distance of objects from their boxes
SAME_PLACE_M = 0.1  # largest distance of the camera from where it was put
COLORS = 1 << 24
CAMERA = "/camera/0"  # the first of `vget /cameras`


class UnrealCvRenderConfig(UnrealCvConfig, ServerCommand):
    """UnrealCV as a renderer; worker i asks the server at port + i."""

    coord_z_offset: float = Field(
        0.0, description="offset added to all heights, m, if the heights of map and level differ"
    )
    settle_delay_s: float = Field(0.1, ge=0, description="time that the engine runs after a pose is set, s")
    animate: bool = Field(True, description="people walk while the engine settles; false: they are only placed")
    person_asset: ClassVar[str] = "/Game/TrafficSystem/Pedestrian/Base_User_Agent.Base_User_Agent_C"


class _LevelObject(NamedTuple):
    """An object of the server's level."""

    name: str
    color: int | None  # in the object mask, 24 bits; None without one
    class_name: str
    row: int | None  # of its box in the map; None if the map does not have it


class UnrealCvRenderer(SimulatorRenderer):
    """A renderer that uses an UnrealCV server with the level of the map."""

    engine = "unrealcv"
    _guard: EngineGuard | None = None
    # The following belong to one connection.
    _server: UnrealCvConnection
    _spawned: dict[int, str]  # names of people by instance id
    _fov_deg: float  # of the camera; 0 if it is not set yet
    _ids: np.ndarray  # (COLORS,) uint16 instance ids
    _kinds: np.ndarray  # (COLORS,) uint8
    _used_colors: set[int]

    # --- the server ---------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        """Start the server if a command is given, connect, and find the map in its level."""
        is_first = self._guard is None
        self._guard = self._guard or self._start_guard()
        try:
            self._server = unrealcv_client.connect(self._cfg, self._port)
            weakref.finalize(self, self._server.close)  # a server has one client at a time
            try:
                with self._server.asking("UnrealCV did not describe its level"):
                    self._begin(is_first)
            except Exception:
                self._server.close()
                raise
        except Exception:
            if is_first:
                self._leave()
            raise

    def _begin(self, is_first: bool) -> None:
        """Read the objects of the level; at the first connection, send the camera's state to the guard."""
        self.device = f"UnrealCV {self._server.version} at {self._server.endpoint}, {self._server.level}"
        self._spawned = {}
        self._fov_deg = 0.0
        if is_first and self._guard is not None:
            properties = [f"{CAMERA}/{what}" for what in ("size", "fov", "pose")]
            state = zip(properties, self._server.ask(*(f"vget {name}" for name in properties)), strict=True)
            self._guard.note([f"vset {name} {text!s}" for name, text in state if not is_refusal(text)])
        (answer,) = self._server.ask("vget /objects")
        leftover = unrealcv_client.spawned_by_cosfly(str(answer))  # by a connection that broke
        self._server.run(*(f"vset /object/{name}/destroy" for name in leftover))
        objects = self._read_objects([name for name in str(answer).split() if name not in leftover])
        num_doubtful = self._make_tables(objects)
        rows = {level_object.name: level_object.row for level_object in objects if level_object.row is not None}
        self._check_level(rows, num_doubtful)
        self._server.run(f"vset {CAMERA}/size {self._size_px[0]} {self._size_px[1]}")

    def _read_objects(self, names: list[str]) -> list[_LevelObject]:
        """Ask for the colours and classes of objects, and find their boxes."""
        row_of_id = {int(box_id): row for row, box_id in enumerate(self._map.ids)}
        queries = (f"vget /object/{name}/{what}" for name in names for what in ("color", "uclass_name"))
        answers = self._server.ask(*queries)
        return [
            _LevelObject(name, _color_of(color), str(class_name), row_of_id.get(id_of(name)))
            for name, color, class_name in zip(names, answers[::2], answers[1::2], strict=True)
        ]

    def _make_tables(self, objects: list[_LevelObject]) -> int:
        """Make the tables from colours of the object mask to instance ids and kinds.

        Return the number of objects without a colour of their own: their pixels get the id of another object, or none.
        """
        ids = instance_ids(self._map, self._num_others)
        self._ids = np.full(COLORS, NO_INSTANCE, dtype=np.uint16)
        self._kinds = np.full(COLORS, KINDS["NONE"], dtype=np.uint8)
        self._used_colors = set()
        for level_object in objects:
            if level_object.color is None or level_object.color in self._used_colors:
                continue
            self._used_colors.add(level_object.color)
            if level_object.row is None:
                self._kinds[level_object.color] = KINDS[kind_of(level_object.class_name) or "Other"]
            else:
                self._ids[level_object.color] = ids[level_object.row]
                self._kinds[level_object.color] = self._map.kinds[level_object.row]
        return len(objects) - len(self._used_colors)

    def _check_level(self, row_of: dict[str, int], num_doubtful: int) -> None:
        """Check that the level is that of the map, at its scale. row_of: boxes of the map by the names of objects."""
        if not row_of:
            what = "none of the boxes of the map is in the level that the server has loaded"
            fix = "export the map from this level (cosfly maps --source unrealcv)"
            raise InputError(what, where=self._server.where, got=f"the map {self._map.name}", fix=fix)
        if len(row_of) < len(self._map) or num_doubtful:
            note = "%s: %d of %d boxes are objects of the level; %d objects have no colour of their own"
            log.warning(note, self._server.where, len(row_of), len(self._map), num_doubtful)
        names = list(row_of)[:: max(1, len(row_of) // MOST_CHECKED)]
        answers = self._server.ask(*(f"vget /object/{name}/bounds" for name in names))
        bounds = {row_of[name]: self._server.numbers(answer, 6) for name, answer in zip(names, answers, strict=True)}
        middles = {row: np.reshape(ends, (2, 3)).mean(axis=0) for row, ends in bounds.items() if ends}
        if not middles:
            return
        raw = np.array([world_pose([*middle, 0.0, 0.0, 0.0])[0] for middle in middles.values()])
        boxes = self._map.select(np.array(list(middles)))
        middles_m = (boxes.mins + boxes.maxs) / 2
        offset_m = np.array([0.0, 0.0, self._cfg.coord_z_offset])
        gap_m = float(np.median(np.linalg.norm(raw / self._cfg.coord_scale - offset_m - middles_m, axis=1)))
        if gap_m <= SAME_BOX_M:
            return
        raise ConfigError(
            "the map and the level differ in scale or height, so the camera would be in the wrong place",
            where=self._server.where,
            got=f"objects {gap_m:.1f} m away from their boxes with coord_scale {self._cfg.coord_scale:g} and "
            f"coord_z_offset {self._cfg.coord_z_offset:g} m",
            expected=f"at most {SAME_BOX_M:g} m",
            fix="set --coord-scale and --coord-z-offset, or export the map from this level",
        )

    def _recover(self, problem: Exception) -> None:
        self._server.close()
        if self._cfg.server_command:
            self._leave()
        self._open()

    def close(self) -> None:
        """Restore the level, and disconnect."""
        self._server.close()
        self._leave()

    def _leave(self) -> None:
        if self._guard is not None:
            self._guard.close()
            self._guard = None

    # --- one frame ----------------------------------------------------------------------------------------------------

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Remove all people; the weather of the level stays."""
        if weather is not None:
            fix = "set render.backend to `gl` or `carla`, or render.weather_mode to `off`"
            raise RenderError("the renderer `unrealcv` cannot draw weather", where=self.device, fix=fix)
        with self._server.asking("UnrealCV did not remove people"):
            for instance_id in list(self._spawned):
                self._server.run(self._forget(instance_id))

    def _frame(self, camera_pose: np.ndarray, fov_deg: float, people: PosedPeople) -> Frame:
        place, turn = self._in_level(camera_pose[:3, 3], camera_rotation_deg(camera_pose))
        try:
            commands = ["vset /action/game/resume"]
            commands += [self._forget(instance_id) for instance_id in self._spawned.keys() - people.keys()]
            for instance_id, person in people.items():
                commands += self._placing(instance_id, person)
            if fov_deg != self._fov_deg:
                commands.append(f"vset {CAMERA}/fov {fov_deg:.6f}")
            self._server.run(*commands, f"vset {CAMERA}/pose {place} {turn}")
            self._fov_deg = fov_deg
            time.sleep(self._cfg.settle_delay_s)
            queries = [f"vget {CAMERA}/{what}" for what in ("location", "lit png", "object_mask png", "depth npy")]
            _, location, lit, mask, depth = self._server.ask("vset /action/game/pause", *queries)
            self._check_place(camera_pose[:3, 3], location)
            return self._decoded(lit, mask, depth)
        except (NoAnswerError, InputError) as error:
            raise NoPictureError(str(error)) from None

    def _in_level(self, position_m: np.ndarray, rotation_deg: np.ndarray) -> tuple[str, str]:
        """Return a position in the level's units and its rotation, as words of commands."""
        x, y, z, *turn = unreal_pose(position_m + np.array([0.0, 0.0, self._cfg.coord_z_offset]), rotation_deg)
        place = (f"{part * self._cfg.coord_scale:.6f}" for part in (x, y, z))
        return " ".join(place), " ".join(f"{part:.6f}" for part in turn)

    def _check_place(self, position_m: np.ndarray, location: str | bytes) -> None:
        """Check that the location in a reply is the position that the camera was set to, (3,) world."""
        numbers = self._server.numbers(location, 3)
        if numbers is None:
            raise NoAnswerError(f"the server sent {location!r} instead of the three numbers of the camera's position")
        found_m = world_pose([*(part / self._cfg.coord_scale for part in numbers), 0.0, 0.0, 0.0])[0]
        found_m[2] -= self._cfg.coord_z_offset
        if np.linalg.norm(found_m - position_m) <= SAME_PLACE_M:
            return

        def described(point_m: np.ndarray) -> str:
            return f"{point_m.round(2).tolist()}, {point_m[2] - self._map.ground_z_m:.1f} m over the ground"

        what = "the camera is not at the requested position"
        fix = "switch off what moves the camera in the level, such as gravity or a script"
        raise RenderError(what, where=self.device, got=described(found_m), expected=described(position_m), fix=fix)

    def _decoded(self, lit: str | bytes, mask: str | bytes, depth: str | bytes) -> Frame:
        """Convert a server's pictures to a frame; raise InputError if one is damaged."""
        width_px, height_px = self._size_px
        pictures = []
        for name, data in (("lit", lit), ("object_mask", mask)):
            if isinstance(data, str):
                raise InputError("the server sent text instead of a picture", where=name, got=shown(data))
            pictures.append(colours_of(data, name))
        raw = parse_array(depth if isinstance(depth, bytes) else depth.encode(), "depth", dtype=np.float32, ndim=2)
        for name, picture in zip(("lit", "object_mask", "depth"), (*pictures, raw), strict=True):
            if picture.shape[:2] != (height_px, width_px):
                raise InputError(
                    f"the server sent the picture `{name}` in the wrong size",
                    where=self.device,
                    got="{1} x {0} px".format(*picture.shape),
                    expected=f"{width_px} x {height_px} px",
                    fix="set render.width_px and render.height_px to the size that the server sends",
                )
        colors = pictures[1].astype(np.int64) @ [1 << 16, 1 << 8, 1]  # red, green, blue as one number
        kinds = self._kinds[colors]
        ids = self._ids[colors]
        depth_m = raw / np.float32(self._cfg.coord_scale)
        is_sky = ~(raw < FAR_UNITS)  # NaN is sky too
        depth_m[depth_m < NEAR_M] = INVALID_DEPTH_M
        depth_m[is_sky] = SKY_DEPTH_M
        kinds[is_sky] = KINDS["Sky"]
        ids[is_sky] = NO_INSTANCE
        return far_as_sky(Frame(pictures[0], depth_m, kinds, ids))

    # --- people -------------------------------------------------------------------------------------------------------

    def _placing(self, instance_id: int, person: PosedPerson) -> list[str]:
        """Spawn a person who is not in the level yet, and return the commands that place the person.

        One who walks starts earlier on the way, by the settle delay.
        """
        name = self._spawned.get(instance_id) or self._spawn(instance_id)
        animate = self._cfg.animate
        placement = placement_of(person, self._cfg.settle_delay_s if animate else 0.0)
        place, turn = self._in_level(placement.hip_m, placement.rotation_deg)
        commands = [f"vset /object/{name}/location {place}", f"vset /object/{name}/rotation {turn}"]
        if animate and placement.speed_mps > 0.0:
            speed = f"{placement.speed_mps * self._cfg.coord_scale:.3f}"
            commands += [f"vbp {name} SetMaxSpeed {speed}", f"vbp {name} MoveForward"]
        elif animate:
            commands.append(f"vbp {name} StopAgent")
        return commands

    def _spawn(self, instance_id: int) -> str:
        """Spawn a person, in a colour that no other object has; return its name."""
        name = f"{unrealcv_client.OURS}{instance_id}"
        color = next(c for c in range(COLORS - 1, 0, -1) if c not in self._used_colors)
        paint = f"{color >> 16} {color >> 8 & 0xFF} {color & 0xFF}"
        self._server.run(
            f"vset /objects/spawn_bp_asset {self._cfg.person_asset} {name}", f"vset /object/{name}/color {paint}"
        )
        self._used_colors.add(color)
        self._ids[color] = instance_id
        self._kinds[color] = KINDS["Pedestrians"]
        self._spawned[instance_id] = name
        return name

    def _forget(self, instance_id: int) -> str:
        """Forget a spawned person; return the command that removes the person from the level."""
        return f"vset /object/{self._spawned.pop(instance_id)}/destroy"


def _color_of(answer: str | bytes) -> int | None:
    """Return the colour of an answer `(R=1,G=2,B=3,A=255)`; None if it is black or no colour."""
    match = re.match(r"\(R=(\d{1,3}),G=(\d{1,3}),B=(\d{1,3})", answer) if isinstance(answer, str) else None
    red, green, blue = map(int, match.groups()) if match else (0, 0, 0)
    if max(red, green, blue) > 255:
        return None
    return (red << 16 | green << 8 | blue) or None
