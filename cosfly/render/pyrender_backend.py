"""The second renderer, a slow cross-check of the default one, through trimesh and pyrender (EGL).

It draws plain boxes, trees and figures. Each frame is drawn three times in segmentation mode, for tags, colours and the
float32 bits of the depth: pyrender's own depth is wrong by centimetres at 30 m.
"""

import os
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import SKY_DEPTH_M, Look
from cosfly.formats.kinds import KINDS
from cosfly.formats.weather import WeatherParams
from cosfly.geometry.axes import rotation_matrices
from cosfly.render import contract
from cosfly.render.contract import FAR_M, NEAR_M, NO_INSTANCE, Frame, PosedPeople, PosedPerson
from cosfly.render.person import figure_of
from cosfly.render.surfaces import are_solids, layers_of, solids_of
from cosfly.runtime.errors import EnvironmentMissing, RenderError

SKY_COLOR = np.array([0.52, 0.64, 0.78])  # also the haze's, linear RGB like all colours here
AMBIENT = 0.45  # share of a surface's colour that the sky lights; the sun adds the rest to what faces it
SUNLIT_GAIN = 1.6  # on all colours, which are of unlit materials: a sunlit surface is this much brighter
GAMMA = 2.2  # of displays
PLAIN_COLOR = (0.42, 0.40, 0.37)  # of kinds without an entry in COLORS
STEM_COLOR = (0.16, 0.11, 0.075)
COLORS = {
    "Roads": (0.11, 0.11, 0.115), "Sidewalks": (0.36, 0.345, 0.32), "Buildings": (0.50, 0.38, 0.29),
    "Vegetation": (0.09, 0.165, 0.04), "Terrain": (0.105, 0.14, 0.045), "Ground": (0.24, 0.21, 0.16),
    "Water": (0.05, 0.12, 0.16), "RoadLines": (0.66, 0.66, 0.63), "Car": (0.30, 0.05, 0.05),
    "Truck": (0.05, 0.10, 0.26), "Bus": (0.62, 0.44, 0.05), "Poles": (0.18, 0.18, 0.19),
}  # fmt: skip

LIMB_SHARE = (0.85, 0.85, 0.95)  # of its half sizes, that an untapered limb fills
TAGS, LIT_COLORS, DEPTH_BITS = 255, 128, 0  # what the fragment shader writes, by the red that pyrender passes to it


# k triangles to draw: corners, (k, 3, 3) m relative to the scene's origin, linear RGB, (k, 3), and tags, (k, 4).
Triangles = tuple[np.ndarray, np.ndarray, np.ndarray]


class UnitSolids(NamedTuple):
    """One solid in each of some boxes, of n in all."""

    mesh: Any  # trimesh, half size 1
    rows: np.ndarray  # (n,) bool, the boxes that have one
    half_m: np.ndarray  # (n, 3) half sizes
    lift: np.ndarray  # (n,) of its middle over the box's, in half heights of the box
    colors: np.ndarray  # (n, 3) linear RGB


def _open_screen(width_px: int, height_px: int) -> Any:
    """Load pyrender and open its context without a window."""
    os.environ["PYOPENGL_PLATFORM"] = "egl"  # read by the first import of OpenGL
    np.infty = np.inf  # type: ignore[attr-defined]  # pyrender 0.1.45 uses the name that NumPy 2 dropped
    try:
        import pyrender
        import trimesh  # noqa: F401
        from pyrender.shader_program import ShaderProgramCache

        screen = pyrender.OffscreenRenderer(width_px, height_px)
    except ModuleNotFoundError as error:
        fix = 'pip install -e ".[pyrender]"'
        raise EnvironmentMissing("the renderer pyrender is not installed", got=str(error), fix=fix) from None
    # Without libEGL, PyOpenGL raises errors of its own or an ImportError, and pyrender's platforms bare assertions.
    except Exception as error:
        fix = f"apt-get install {contract.DEBIAN_PACKAGES}"
        raise EnvironmentMissing("OpenGL cannot draw without a window (EGL)", got=str(error), fix=fix) from None
    screen._renderer._program_cache = ShaderProgramCache(str(Path(__file__).parent / "pyrender_shaders"))
    # pyrender has loaded the EGL functions by now, also where someone imported OpenGL for another platform before.
    from OpenGL.EGL import eglDestroyContext

    # Closing ends this context only: pyrender would end the display, which all contexts share.
    platform = screen._platform
    platform.delete_context = lambda: eglDestroyContext(platform._egl_display, platform._egl_context)
    return screen


class PyrenderRenderer:
    """A renderer of plain boxes and round crowns. Positions on the device are relative to the map's middle."""

    dresses = True

    def __init__(self, box_map: BoxMap, width_px: int, height_px: int, look: Look, num_others: int = 0) -> None:
        self._screen = _open_screen(width_px, height_px)
        self._look = look
        import pyrender
        from OpenGL.GL import GL_RENDERER, glGetString

        self.device = f"pyrender, EGL, {glGetString(GL_RENDERER).decode()}"
        self._origin = contract.scene_origin(box_map)
        self._scene = pyrender.Scene()
        self._scene.add(self._mesh(_map_triangles(box_map, self._origin, num_others)))

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Check that no weather is asked for; there are no shadows to compute."""
        if weather is not None:
            fix = "set render.backend to `gl`, or render.weather_mode to `off`"
            raise RenderError("the renderer `pyrender` cannot draw weather", fix=fix)

    def render(self, camera_pose: np.ndarray, intrinsic: np.ndarray, people: PosedPeople) -> Frame:
        """Draw one frame, as the contract says."""
        contract.check_pose(camera_pose, intrinsic)
        import pyrender

        flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera looks along -z, y up
        pose = camera_pose @ flip
        pose[:3, 3] -= self._origin
        lens = [intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2], intrinsic[1, 2]]
        added = [self._scene.add(pyrender.IntrinsicsCamera(*lens, NEAR_M, FAR_M), pose=pose)]
        for instance_id, person in people.items():
            added.append(self._scene.add(self._mesh(_person_triangles(person, instance_id, self._origin))))
        tags, colors, bits = (self._draw(output) for output in (TAGS, LIT_COLORS, DEPTH_BITS))
        for node in added:
            self._scene.remove_node(node)
        return self._frame(tags, colors, bits)

    def close(self) -> None:
        self._screen.delete()

    def _draw(self, output: int) -> np.ndarray:
        """Draw one picture of the scene, (h, w, 4) uint8, of TAGS, LIT_COLORS or DEPTH_BITS."""
        from pyrender import RenderFlags

        nodes = dict.fromkeys(self._scene.mesh_nodes, (output, 0, 0))
        image, _ = self._screen.render(self._scene, RenderFlags.SEG | RenderFlags.RGBA, nodes)
        return np.ascontiguousarray(image)

    def _frame(self, tags: np.ndarray, colors: np.ndarray, bits: np.ndarray) -> Frame:
        """Return the frame of the three pictures, (h, w, 4) uint8.

        tags: kind, low byte of the instance id, high byte, and whether it is sky. bits: one float32 of depth, m.
        """
        is_sky = tags[..., 3] > 0
        depth = np.where(is_sky, np.float32(SKY_DEPTH_M), bits.view("<f4")[..., 0])
        kinds = np.where(is_sky, np.uint8(KINDS["Sky"]), tags[..., 0])
        ids = np.where(is_sky, np.uint16(NO_INSTANCE), tags[..., 1] | tags[..., 2].astype(np.uint16) << 8)
        clear = np.where(is_sky, 0.0, np.exp(-depth / self._look.haze_m)).astype(np.float32)[..., None]
        sky = _as_byte(SKY_COLOR * self._look.exposure).astype(np.float32)
        rgb = cv2.convertScaleAbs(sky + clear * (colors[..., :3] - sky))
        return contract.far_as_sky(Frame(rgb, depth, kinds, ids))

    def _mesh(self, triangles: Triangles) -> Any:
        """Make a mesh of triangles, lit by the sun."""
        import pyrender

        corners_m, colors, tags = triangles
        normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        sun = np.maximum(normals @ self._look.sun_direction(), 0.0)[:, None]
        light = AMBIENT + (1.0 - AMBIENT) * sun
        lit = _as_byte(colors * light * SUNLIT_GAIN * self._look.exposure) / 255.0
        opaque = np.column_stack([lit, np.ones(len(lit))])
        attributes = {"tangents": np.repeat(tags, 3, axis=0), "color_0": np.repeat(opaque, 3, axis=0)}
        return pyrender.Mesh([pyrender.Primitive(corners_m.reshape(-1, 3), **attributes)])


def _as_byte(linear: np.ndarray) -> np.ndarray:
    """Return linear colours as they are displayed, 0 to 255 in whole numbers, float."""
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA))


def _tags(kinds: np.ndarray, ids: np.ndarray, layers: np.ndarray) -> np.ndarray:
    """Return kind, low and high byte of the id, and depth bias of the layer for the vertex shader, (n, 4) float."""
    ids = ids.astype(np.int64)
    return np.column_stack([kinds, ids & 255, ids >> 8, contract.LAYER_STEP * layers]).astype(np.float32)


def _map_triangles(box_map: BoxMap, origin: np.ndarray, num_others: int) -> Triangles:
    """Return the triangles of every box and solid of a map, and of its ground plane."""
    import trimesh

    plane_center, plane_half = contract.ground_plane(box_map)
    centers = np.vstack([box_map.centers, plane_center]) - origin
    halves = np.maximum(np.vstack([box_map.half_extents, plane_half]), 1e-3)
    turns = rotation_matrices(np.radians(np.vstack([box_map.rotations_deg, np.zeros(3)])))
    kinds = np.append(box_map.kinds, KINDS["Terrain"])
    colors_by_kind = np.tile(PLAIN_COLOR, (256, 1))
    colors_by_kind[[KINDS[name] for name in COLORS]] = list(COLORS.values())
    colors = colors_by_kind[kinds]
    ids = np.append(contract.instance_ids(box_map, num_others), np.uint16(NO_INSTANCE))
    tags = _tags(kinds, ids, np.append(layers_of(box_map), 0))
    crowns, stems = _trees(box_map, centers, halves, colors)
    is_box = np.append(~are_solids(box_map), True)
    is_plain = ~crowns.rows
    box = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    pieces = []
    for solid in (UnitSolids(box, is_plain, halves, np.zeros(len(kinds)), colors), crowns, stems):
        rows = solid.rows & is_box
        middles = centers[rows] + turns[rows, :, 2] * (solid.lift * halves[:, 2])[rows, None]
        vertices = solid.half_m[rows, None] * solid.mesh.vertices
        corners = np.einsum("nij,nvj->nvi", turns[rows], vertices) + middles[:, None]
        repeated = (np.repeat(values[rows], len(solid.mesh.faces), axis=0) for values in (solid.colors, tags))
        pieces.append((corners[:, solid.mesh.faces].reshape(-1, 3, 3), *repeated))
    placed = solids_of(box_map)
    for sides in (placed.corners_m, placed.corners_m[:, ::-1]):  # seen from both
        pieces.append((sides - origin, colors[placed.rows], tags[placed.rows]))
    corners_m, colors, tags = map(np.concatenate, zip(*pieces, strict=True))
    return corners_m, colors, tags


def _trees(
    box_map: BoxMap, centers: np.ndarray, halves: np.ndarray, colors: np.ndarray
) -> tuple[UnitSolids, UnitSolids]:
    """Return the crowns of trees and bushes, which replace their boxes, and the stems of the trees.

    centers, halves, colors: (n, 3) of the map's boxes and its ground plane.
    """
    import trimesh

    is_round = np.zeros(len(halves), dtype=bool)
    # In half heights over the middle of the box: -1 without a stem. The crown ends at the top of the box, 1.
    crown_bottom = np.full(len(halves), -1.0)
    plants = np.flatnonzero(box_map.kinds == KINDS["Vegetation"])
    seeds = contract.seeds_of(box_map.ids[plants])
    forms, crown_bottom[plants] = contract.plants_of(centers[plants], halves[plants], seeds)
    is_round[plants] = forms >= contract.BUSH
    crown_middle = (1.0 + crown_bottom) / 2.0
    crowns_m = halves * np.column_stack([np.ones((len(halves), 2)), (1.0 - crown_bottom) / 2.0])
    radius_m = contract.stem_radius_m(halves)
    stems_m = np.column_stack([radius_m, radius_m, halves[:, 2] * (1.0 + crown_middle) / 2.0])
    ball = trimesh.creation.icosphere(subdivisions=1)
    box = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    bark = np.tile(STEM_COLOR, (len(halves), 1))
    crowns = UnitSolids(ball, is_round, crowns_m, crown_middle, colors)
    # A stem reaches from the bottom of the box, -1, to the middle of the crown.
    return crowns, UnitSolids(box, crown_bottom > -1.0, stems_m, (crown_middle - 1.0) / 2.0, bark)


def _person_triangles(person: PosedPerson, instance_id: int, origin: np.ndarray) -> Triangles:
    """Return the triangles of a person: balls, boxes and cylinders."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    box = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    rod = trimesh.creation.cylinder(1.0, 2.0, sections=12).triangles
    units = {"ball": ball.triangles, "rounded": box.triangles, "disc": rod, "limb": rod * LIMB_SHARE}
    figure = figure_of(person)
    solids = zip(figure.shapes, figure.centers_m, figure.turns, figure.half_m, strict=True)
    parts = [(units[shape] * half) @ turn.T + center - origin for shape, center, turn, half in solids]
    corners_m = np.concatenate(parts)
    colors = np.repeat(figure.colors, [len(part) for part in parts], axis=0)
    kinds, ids, layers = (np.array([tag]) for tag in (KINDS["Pedestrians"], instance_id, contract.STANDING_LAYER))
    return corners_m, colors, np.repeat(_tags(kinds, ids, layers), len(corners_m), axis=0)
