"""The default renderer: OpenGL without a window (EGL), on a GPU or the CPU (llvmpipe).

One pass draws colour, z-depth (float32, metres) and kind with instance id.
"""

from __future__ import annotations

import copy
import weakref
from typing import Any, NamedTuple

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import SKY_DEPTH_M, Look
from cosfly.formats.kinds import KINDS
from cosfly.formats.weather import WeatherParams
from cosfly.render.contract import FAR_M, NEAR_M, PERSON_ID, Frame, PosedPeople, PosedPerson, check_pose, far_as_sky
from cosfly.render.gl import meshes, programs
from cosfly.render.gl.parts import DRAW_ORDER, NEVER_PX, NUM_MATERIALS, PART, CameraView, Parts, materials_of
from cosfly.render.gl.people import CAPSULE_M, PERSON_RADIUS_M, PersonParts, person_parts, shadow_corners
from cosfly.render.gl.programs import LooseBuffers, Programs, set_uniform
from cosfly.render.gl.scene import build_scene
from cosfly.render.gl.weather_pass import DEPTH_UNIT, WeatherPass, defines
from cosfly.runtime.worker import return_freed_memory

SHADOW_SIZE_PX = 2560  # side of the sun's shadow map
HEIGHT_SIZE_PX = 768  # side of the height map
AMBIENT_BLUR_M = 5.0
TALLEST_AMBIENT_M = 14.0  # a tower hides no more sky from the street than a house of this height
SMALLEST_SHADOW_AREA_M, LARGEST_SHADOW_AREA_M = 40.0, 420.0  # side
SHADOW_MARGIN = 1.1  # the shadow map is this many times as wide, so that its edge is outside the area
ABOVE_CASTERS_M, BELOW_GROUND_M = 1.0, 10.0  # depth range of the height map
EDGE_LEVELS = 5  # larger steps of brightness are smoothed
EDGE_BLUR_PX = 0.62
TAG_UNIT = 4  # texture unit, after those of the weather
MESH_STRIDE = 64  # more than there are meshes
SOFTWARE = "llvmpipe"  # draws on the processor, and interpolates where hardware snaps to a grid (scene.frag.glsl)
# Triangles that llvmpipe may hold back. It allocates another list of them (36 MB) whenever one is full while the last
# is still being drawn, and never frees one: without this limit a process grows by a seventh over thousands of frames.
MOST_WAITING = 30_000
PATTERN_M = 720.0  # common multiple of the patterns' sizes: the scene's origin modulo this keeps coordinates small
ORIGIN_STEP_M = 2.0 * PATTERN_M  # a trajectory farther off than half of this has an origin of its own


class _WeatherPrograms(NamedTuple):
    """What draws one kind of weather."""

    programs: Programs
    sky: Any  # vertex array of a triangle over the picture
    shadow: Any  # the same, for the shadow of one person
    weather: WeatherPass | None  # None in fair weather


class GlRenderer:
    """A renderer on EGL. One object holds one GL context and belongs to the thread that made it.

    Positions whose names do not end in _m are relative to `origin_m`, in m.
    """

    dresses = True
    # Set by `prepare`:
    origin_m: np.ndarray  # (3,) world
    _parts: Parts  # those that a camera of the trajectory can see
    _part_groups: np.ndarray  # (k,) of `_parts`, as `_groups` returns them
    _sun: np.ndarray  # (3,) unit vector towards the sun
    _area: dict[str, Any]  # uniforms of the shadow map and the height map

    def __init__(self, box_map: BoxMap, width_px: int, height_px: int, look: Look, num_others: int = 0) -> None:
        self.context = programs.open_context()
        self._release = weakref.finalize(self, _release, self.context)  # closed or not
        self._release.atexit = False
        driver = (str(self.context.info[f"GL_{name}"]) for name in ("VENDOR", "RENDERER", "VERSION"))
        self.device = ", ".join(("EGL", *driver))
        self._opened_by: GlRenderer | None = None
        self._is_software = SOFTWARE in self.device
        self.look = look
        self.num_others = num_others
        self.width_px, self.height_px = width_px, height_px
        context = self.context
        size = (width_px, height_px)
        with context:
            self._color = context.texture(size, 4)
            self._depth = context.texture(size, 1, dtype="f4")
            self._tags = context.texture(size, 1, dtype="u4")
            self._image = context.framebuffer([self._color, self._depth, self._tags], context.depth_renderbuffer(size))
            self._over_color = context.framebuffer([self._color])
            all_meshes = meshes.all_meshes()
            self._meshes = [
                (context.buffer(mesh.vertices.tobytes()), context.buffer(mesh.triangles.tobytes()))
                for mesh in all_meshes
            ]
            self._num_triangles = [len(mesh.triangles) for mesh in all_meshes]
            self._num_waiting = 0
            self._arrays: dict[tuple[int, int], tuple[Any, Any]] = {}  # made when needed
            texts = programs.sources(("part.glsl", "depth.vert.glsl"), ("depth.frag.glsl",))
            self._depth_program = context.program(*texts)
            self._by_weather: dict[str | None, _WeatherPrograms] = {}
            self._use_weather(None)
        self._open_map(box_map)
        self.prepare(*self.scene.bounds())

    def with_map(self, box_map: BoxMap) -> GlRenderer:
        """Return a renderer of another map with the GL context and the programs of this one; `prepare` it first.

        Closing one of them closes all.
        """
        other = copy.copy(self)
        other._opened_by = self  # whose end releases the context
        other._by_weather = {None: self._by_weather[None]}  # the others are prepared for a map
        other._open_map(box_map)
        return other

    def _open_map(self, box_map: BoxMap) -> None:
        """Build the scene of a map, and textures for its shadows and heights."""
        context = self.context
        self.scene = build_scene(box_map, self.num_others)
        with context:
            self._loose = LooseBuffers(context, self.scene.loose)
            self._shadow = context.depth_texture((SHADOW_SIZE_PX, SHADOW_SIZE_PX))
            self._shadow.compare_func = "<="
            self._shadow_target = context.framebuffer(depth_attachment=self._shadow)
            self._height = context.texture((HEIGHT_SIZE_PX, HEIGHT_SIZE_PX), 1, dtype="f4")
            self._height.filter = (context.NEAREST, context.NEAREST)  # it is smooth already, and this is faster
            for texture in (self._shadow, self._height):
                texture.repeat_x = texture.repeat_y = False
        self._area = {}

    def _use_weather(self, define: str | None) -> None:
        """Switch to the programs of fair weather (None), or of a weather with these defines."""
        if define not in self._by_weather:
            compiled = programs.programs_of(self.context, define, snaps=not self._is_software)
            weather = None
            if define is not None:
                weather = WeatherPass(self.context, self._over_color, self._depth, compiled.rain)
            sky, shadow = (self.context.vertex_array(program, []) for program in (compiled.sky, compiled.shadow))
            self._by_weather[define] = _WeatherPrograms(compiled, sky, shadow, weather)
        self._programs, self._sky, self._shadow_triangle, self._weather = self._by_weather[define]

    def _array(self, program: Any, mesh: int) -> tuple[Any, Any]:
        """Return vertex array and instance buffer of a program for a mesh."""
        if (program.glo, mesh) not in self._arrays:
            vertices, triangles = self._meshes[mesh]
            instances = self.context.buffer(reserve=PART.itemsize, dynamic=True)
            names = ("in_center", "in_half", "in_quaternion", "in_color", "in_tag", "in_bias")
            content = [
                programs.attributes(program, vertices, "3f 3f", ("in_position", "in_normal")),
                programs.attributes(program, instances, "3f 3f 4f 4f 1u 1f /i", names),
            ]
            array = self.context.vertex_array(program, content, index_buffer=triangles)
            self._arrays[program.glo, mesh] = array, instances
        return self._arrays[program.glo, mesh]

    # --- one trajectory ---

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Compute sun shadows and sky openness for an area of the world, (3,) corners, and set the weather."""
        low_m, high_m = np.asarray(low_m), np.asarray(high_m)
        self._select_parts(low_m, high_m)
        low = low_m - self.origin_m
        high = high_m - self.origin_m
        middle = (low + high) / 2.0
        half_m = float(np.clip((high - low)[:2].max(), SMALLEST_SHADOW_AREA_M, LARGEST_SHADOW_AREA_M)) / 2.0
        shift_m = self.origin_m - self.scene.origin_m

        def are_near(centers: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
            return (np.abs(centers[:, :2] - middle[:2]) < half_m * 2.0 + radii_m[:, None]).all(axis=1)

        parts = self._parts
        is_detailed = parts.max_px >= NEVER_PX  # the simple forms of objects cast no shadows
        casting = np.flatnonzero(are_near(parts.object_centers, parts.object_radii) & is_detailed)
        with self.context:
            self._use_weather(None if weather is None else defines(weather))
            self._loose.place(shift_m)
            if self._weather is not None and weather is not None:
                self._weather.prepare(weather, parts, self.scene.lamps - shift_m, middle, half_m)
            self._sun = self.look.sun_direction() if self._weather is None else self._weather.sun_direction
            near = are_near(self._loose.centers, self._loose.radii)
            centers = np.concatenate([parts.object_centers[casting], self._loose.centers[near]])
            radii_m = np.concatenate([parts.object_radii[casting], self._loose.radii[near]])
            self._loose.see(None)
            self._prepare_shadow(casting, centers, radii_m, middle, half_m)
            top = float((centers[:, 2] + radii_m).max(initial=self._ground_z)) + ABOVE_CASTERS_M
            self._prepare_openness(casting, top, middle, half_m)

    def _select_parts(self, low_m: np.ndarray, high_m: np.ndarray) -> None:
        """Select the parts that a camera within the corners can see, and move the origin near them.

        Each frame tests all selected parts, and kilometres from the origin float32 resolves only a millimetre.
        """
        parts = self.scene.parts
        zero_m = self.scene.origin_m
        outside_m = np.maximum(low_m - zero_m - parts.object_centers, parts.object_centers - (high_m - zero_m))
        away_m = np.linalg.norm(np.maximum(outside_m, 0.0), axis=1) - parts.object_radii
        shift_m = np.round(((low_m + high_m) / 2.0 - zero_m) / ORIGIN_STEP_M) * [1.0, 1.0, 0.0] * ORIGIN_STEP_M
        self.origin_m = zero_m + shift_m
        self._parts = parts.select(away_m < FAR_M).relative_to(shift_m)
        self._part_groups = _groups(self._parts.records, self._parts.mesh)

    @property
    def _ground_z(self) -> np.float64:
        """Return the height of the ground plane relative to the origin; float32 arrays become float64 by it."""
        return self.scene.plane_z_m - self.origin_m[2]

    def _prepare_shadow(
        self, casting: np.ndarray, centers: np.ndarray, radii_m: np.ndarray, middle: np.ndarray, half_m: float
    ) -> None:
        """Draw the shadow map of the sun; centers, radii_m: of the casters near the middle."""
        sun = self._sun
        side = np.cross([0.0, 0.0, 1.0], sun)
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(sun, side), -sun])  # rows: right, up, away from the sun
        depth_half_m = float((np.abs((centers - middle) @ sun) + radii_m).max(initial=half_m))  # towers cast from afar
        width_half_m = half_m * SHADOW_MARGIN
        clip_from_world = np.eye(4)
        clip_from_world[:3, :3] = axes / np.array([[width_half_m], [width_half_m], [depth_half_m]])
        clip_from_world[:3, 3] = -clip_from_world[:3, :3] @ middle
        self._draw_depth(self._shadow_target, clip_from_world, casting)
        to_texture = np.diag([0.5, 0.5, 0.5, 1.0])
        to_texture[:3, 3] = 0.5
        self._area["shadow_from_world"] = to_texture @ clip_from_world
        self._area["shadow_texel_m"] = 2.0 * width_half_m / SHADOW_SIZE_PX

    def _prepare_openness(self, casting: np.ndarray, top: float, middle: np.ndarray, half_m: float) -> None:
        """Draw a blurred height map from above: higher objects nearby darken a point. top: no caster is higher."""
        depth_m = top - self._ground_z + BELOW_GROUND_M
        low = middle[:2] - half_m
        pixel_m = 2.0 * half_m / HEIGHT_SIZE_PX
        clip_from_world = np.diag([1.0 / half_m, 1.0 / half_m, -2.0 / depth_m, 1.0])
        clip_from_world[:3, 3] = -middle[0] / half_m, -middle[1] / half_m, 2.0 * top / depth_m - 1.0
        texture = self.context.depth_texture((HEIGHT_SIZE_PX, HEIGHT_SIZE_PX))
        target = self.context.framebuffer(depth_attachment=texture)
        self._draw_depth(target, clip_from_world, casting)
        share = np.frombuffer(texture.read(alignment=1), np.float32).reshape(HEIGHT_SIZE_PX, HEIGHT_SIZE_PX)
        target.release()
        texture.release()
        heights = np.where(share >= 1.0, self._ground_z, (top - share * depth_m).astype(np.float32))
        heights = np.minimum(heights, self._ground_z + TALLEST_AMBIENT_M).astype(np.float32)
        heights = cv2.GaussianBlur(heights, (0, 0), max(AMBIENT_BLUR_M / pixel_m, 0.5))
        self._height.write(np.ascontiguousarray(heights).tobytes())
        self._area["height_area"] = np.array([*low, 0.5 / half_m, 0.5 / half_m])

    def _draw_depth(self, target: Any, clip_from_world: np.ndarray, rows: np.ndarray) -> None:
        target.use()
        target.clear(depth=1.0)
        self.context.enable_only(self.context.DEPTH_TEST)
        set_uniform(self._depth_program, "clip_from_world", clip_from_world)
        for mesh in range(len(self._meshes)):
            self._draw(self._depth_program, mesh, self._parts.records[rows[self._parts.mesh[rows] == mesh]])
        self._loose.draw_shadows(self._depth_program)

    # --- one frame ---

    def render(self, camera_pose: np.ndarray, intrinsic: np.ndarray, people: PosedPeople) -> Frame:
        """Draw one frame, as the contract says."""
        check_pose(camera_pose, intrinsic)
        eye = camera_pose[:3, 3] - self.origin_m
        view = CameraView(camera_pose[:3, :3], eye, intrinsic, self.width_px, self.height_px)
        persons = [
            person_parts(person, instance_id, self.origin_m)
            for instance_id, person in people.items()
            if view.can_show(person.hip_m - self.origin_m, PERSON_RADIUS_M)
        ]
        uniforms = self._uniforms(view, camera_pose, people.get(PERSON_ID))
        with self.context:
            self._set_uniforms(uniforms)
            rows = view.part_rows_in_view(self._parts)
            self._loose.see(view)
            self._image.use()
            self._image.clear(depth=1.0)
            self.context.enable_only(self.context.DEPTH_TEST | self.context.CULL_FACE)
            self.context.front_face = "cw"  # the image is upside down for GL: row 0 is the top
            self.context.depth_func = "<="
            self._shadow.use(0)
            self._height.use(1)
            if self._weather is not None:
                self._weather.use()
            self._draw_scene(rows, persons)
            # Clearing targets of mixed types leaves garbage: the sky's triangle writes all three where nothing is.
            self.context.disable(self.context.CULL_FACE)
            self._sky.render(vertices=3)
            self._draw_shadows(view, people)
            if self._weather is not None:
                self._weather.draw_rain(uniforms)
            return self._read()

    def _uniforms(self, view: CameraView, camera_pose: np.ndarray, person: PosedPerson | None) -> dict[str, Any]:
        """Return the uniforms of a frame; those of a weather replace those of the look."""
        of_weather = {} if self._weather is None else self._weather.frame_values(view.eye, camera_pose, person)
        return {
            "lens": np.array([*np.diag(view.intrinsic)[:2], *view.intrinsic[:2, 2]]),
            "image_size": np.array([self.width_px, self.height_px]),
            "world_from_camera": view.world_from_camera,
            "sun_direction": self._sun,
            "haze_m": self.look.haze_m,
            "exposure": self.look.exposure,
            "clip_m": np.array([NEAR_M, FAR_M]),
            "camera_from_world": view.world_from_camera.T,
            "camera_position": view.eye,
            "world_offset": np.mod(self.origin_m[:2], PATTERN_M),
            "ground_z": self._ground_z,
            "shadow_map": 0,
            "height_map": 1,
            "sky_depth_m": SKY_DEPTH_M,
            "sky_tag": KINDS["Sky"],
            "person_kind": KINDS["Pedestrians"],
            "depth_map": DEPTH_UNIT,
            "tag_map": TAG_UNIT,
            "capsule": CAPSULE_M,
            **self._area,
            **of_weather,
        }

    def _set_uniforms(self, values: dict[str, Any]) -> None:
        """Set the uniforms of all programs that draw the scene."""
        for name, value in values.items():
            packed = programs.packed(value)
            for program in (*self._programs.materials, self._programs.sky, self._programs.shadow):
                set_uniform(program, name, packed)

    def _draw_shadows(self, view: CameraView, people: PosedPeople) -> None:
        """Darken the finished colours where people keep sun and sky from the ground."""
        context = self.context
        self._over_color.use()
        context.enable_only(context.BLEND)
        context.blend_func = context.DST_COLOR, context.ZERO  # the product of both colours
        self._depth.use(DEPTH_UNIT)
        self._tags.use(TAG_UNIT)
        for person in people.values():
            hip = person.hip_m - self.origin_m
            rectangle = view.rectangle_px(shadow_corners(hip, self._sun))
            if rectangle is not None:
                x0, y0, x1, y1 = rectangle
                self._over_color.scissor = x0, y0, x1 - x0, y1 - y0
                set_uniform(self._programs.shadow, "hip", hip)
                self._shadow_triangle.render(vertices=3)
        self._over_color.scissor = None

    def _draw_scene(self, rows: np.ndarray, persons: list[PersonParts]) -> None:
        """Draw people and these rows of the parts by material, in DRAW_ORDER."""
        records = np.concatenate([*(person.records for person in persons), self._parts.records[rows]])
        groups = np.concatenate([*(_groups(*person) for person in persons), self._part_groups[rows]])
        order = np.argsort(groups, kind="stable")
        records = records[order]
        starts = np.searchsorted(groups[order], np.arange(NUM_MATERIALS * MESH_STRIDE + 1))
        for material in DRAW_ORDER:
            for mesh in range(len(self._meshes)):
                group = material * MESH_STRIDE + mesh
                self._draw(self._programs.materials[material], mesh, records[starts[group] : starts[group + 1]])
            self._loose.draw(self._programs.materials[material], material)

    def _draw(self, program: Any, mesh: int, records: np.ndarray) -> None:
        """Draw instances of one mesh."""
        if len(records) == 0:
            return
        array, instances = self._array(program, mesh)
        instances.orphan(2 * records.nbytes if instances.size < records.nbytes else -1)  # -1: as it was
        instances.write(records.tobytes())
        array.render(instances=len(records))
        self._num_waiting += len(records) * self._num_triangles[mesh]
        if self._is_software and self._num_waiting > MOST_WAITING:
            self.context.finish()
            self._num_waiting = 0

    def _read(self) -> Frame:
        """Read the frame from the renderer's targets."""
        shape = (self.height_px, self.width_px)
        color = np.empty((*shape, 4), np.uint8)
        depth = np.empty(shape, np.float32)
        tag = np.empty(shape, np.uint32)
        self._image.read_into(color, components=4, attachment=0)
        self._image.read_into(depth, components=1, attachment=1, dtype="f4")
        self._image.read_into(tag, components=1, attachment=2, dtype="u4")
        rgb = smoothed(cv2.cvtColor(color, cv2.COLOR_RGBA2RGB))
        if self._weather is not None:
            rgb = self._weather.glowing(rgb)
        return far_as_sky(Frame(rgb, depth, (tag & 0xFF).astype(np.uint8), (tag >> 16).astype(np.uint16)))

    def close(self) -> None:
        self._release()


def _release(context: Any) -> None:
    """Free 0.1 GB, or 0.8 GB after every weather: most of it is what the driver compiled, in small pieces."""
    context.release()
    return_freed_memory()


def smoothed(rgb: np.ndarray) -> np.ndarray:
    """Smooth edges in a picture, (h, w, 3) uint8, where brightness jumps."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    steps = cv2.absdiff(gray, cv2.GaussianBlur(gray, (3, 3), 0.8))
    _, mask = cv2.threshold(steps, EDGE_LEVELS, 255, cv2.THRESH_BINARY)
    return cv2.copyTo(cv2.GaussianBlur(rgb, (3, 3), EDGE_BLUR_PX), mask, rgb)


def _groups(records: np.ndarray, mesh_numbers: np.ndarray) -> np.ndarray:
    """Return a number for each combination of material and mesh, (k,)."""
    return materials_of(records).astype(np.int64) * MESH_STRIDE + mesh_numbers
