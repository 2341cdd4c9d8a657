"""The second renderer, a slow cross-check of the default one, through trimesh and pyrender (EGL).

It draws plain boxes, trees and figures. pyrender's own depth is wrong by centimetres at 30 m, so each frame is drawn
three times in segmentation mode with our own shaders: for tags, for colours, and for the float32 bits of the depth. The
vertex attribute `tangents` holds the tags, because nothing else uses it, and `color_0` the lit colours.
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
LEAST_HALF_M = 1e-3  # half size of a flat box
# The picture that the fragment shader writes, as the red of the colour that pyrender passes to it.
TAGS, LIT_COLORS, DEPTH_BITS = 255, 128, 0


class Triangles(NamedTuple):
    """k triangles to draw."""

    corners_m: np.ndarray  # (k, 3, 3) relative to the scene's origin
    colors: np.ndarray  # (k, 3) linear RGB
    tags: np.ndarray  # (k, 4) float, as `_tags` returns them


class BoxSolids(NamedTuple):
    """The same solid in some of n boxes. Heights are relative to the box: -1 is its bottom, 1 its top."""

    mesh: Any  # trimesh, half size 1
    is_in_box: np.ndarray  # (n,) bool, which boxes contain the solid
    half_m: np.ndarray  # (n, 3) half sizes
    middle: np.ndarray  # (n,) height of its middle
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
        frame = self._frame(self._draw(TAGS), self._draw(LIT_COLORS), self._draw(DEPTH_BITS))
        for node in added:
            self._scene.remove_node(node)
        return frame

    def close(self) -> None:
        self._screen.delete()

    def _draw(self, red: int) -> np.ndarray:
        """Draw one picture of the scene, (h, w, 4) uint8; red: TAGS, LIT_COLORS or DEPTH_BITS."""
        from pyrender import RenderFlags

        color_of_node = dict.fromkeys(self._scene.mesh_nodes, (red, 0, 0))
        image, _ = self._screen.render(self._scene, RenderFlags.SEG | RenderFlags.RGBA, color_of_node)
        return np.ascontiguousarray(image)

    def _frame(self, tags: np.ndarray, colors: np.ndarray, bits: np.ndarray) -> Frame:
        """Return the frame of three pictures, (h, w, 4) uint8 each.

        Args:
            tags: kind, low byte of the instance id, high byte, and whether the pixel is sky.
            colors: RGB and an unused byte.
            bits: the bytes of one float32, the depth in m.
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

        first, second, third = np.moveaxis(triangles.corners_m, 1, 0)
        normals = np.cross(second - first, third - first)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        sun = np.maximum(normals @ self._look.sun_direction(), 0.0)[:, None]
        light = AMBIENT + (1.0 - AMBIENT) * sun
        lit = _as_byte(triangles.colors * light * SUNLIT_GAIN * self._look.exposure) / 255.0
        opaque = np.column_stack([lit, np.ones(len(lit))])
        attributes = {"tangents": np.repeat(triangles.tags, 3, axis=0), "color_0": np.repeat(opaque, 3, axis=0)}
        return pyrender.Mesh([pyrender.Primitive(triangles.corners_m.reshape(-1, 3), **attributes)])


def _as_byte(linear: np.ndarray) -> np.ndarray:
    """Return linear colours as they are displayed, 0 to 255 in whole numbers, float."""
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA))


def _tags(kinds: np.ndarray, ids: np.ndarray, layers: np.ndarray) -> np.ndarray:
    """Return kind, low and high byte of the id, and depth bias of the layer for the vertex shader, (n, 4) float."""
    ids = ids.astype(np.int64)
    return np.column_stack([kinds, ids & 255, ids >> 8, contract.LAYER_STEP * layers]).astype(np.float32)


def _unit_box() -> Any:
    """Return a box of half size 1, as a trimesh."""
    import trimesh

    return trimesh.creation.box(extents=(2.0, 2.0, 2.0))


def _map_triangles(box_map: BoxMap, origin: np.ndarray, num_others: int) -> Triangles:
    """Return the triangles of a map and of its ground plane, which is the last row of the arrays of boxes here."""
    plane_center, plane_half = contract.ground_plane(box_map)
    centers = np.vstack([box_map.centers, plane_center]) - origin
    halves = np.maximum(np.vstack([box_map.half_extents, plane_half]), LEAST_HALF_M)
    turns = rotation_matrices(np.radians(np.vstack([box_map.rotations_deg, np.zeros(3)])))
    kinds = np.append(box_map.kinds, KINDS["Terrain"])
    colors_by_kind = np.tile(PLAIN_COLOR, (256, 1))
    colors_by_kind[[KINDS[name] for name in COLORS]] = list(COLORS.values())
    colors = colors_by_kind[kinds]
    ids = np.append(contract.instance_ids(box_map, num_others), np.uint16(NO_INSTANCE))
    tags = _tags(kinds, ids, np.append(layers_of(box_map), 0))
    crowns, stems = _trees(box_map, centers, halves, colors)
    whole_boxes = BoxSolids(_unit_box(), ~crowns.is_in_box, halves, np.zeros(len(kinds)), colors)
    has_mesh = np.append(are_solids(box_map), False)  # the mesh is drawn instead of the box
    pieces = []
    for solid in (whole_boxes, crowns, stems):
        rows = np.flatnonzero(solid.is_in_box & ~has_mesh)
        middles = centers[rows] + turns[rows, :, 2] * (solid.middle * halves[:, 2])[rows, None]
        vertices = solid.half_m[rows, None] * solid.mesh.vertices  # in the axes of the box
        corners = np.einsum("nij,nvj->nvi", turns[rows], vertices) + middles[:, None]
        rows_of_faces = np.repeat(rows, len(solid.mesh.faces))
        faces = corners[:, solid.mesh.faces].reshape(-1, 3, 3)
        pieces.append(Triangles(faces, solid.colors[rows_of_faces], tags[rows_of_faces]))
    placed = solids_of(box_map)
    for corners_m in (placed.corners_m, placed.corners_m[:, ::-1]):  # both sides are visible
        pieces.append(Triangles(corners_m - origin, colors[placed.rows], tags[placed.rows]))
    return Triangles(*map(np.concatenate, zip(*pieces, strict=True)))


def _trees(box_map: BoxMap, centers: np.ndarray, halves: np.ndarray, colors: np.ndarray) -> tuple[BoxSolids, BoxSolids]:
    """Return the crowns of trees and bushes, which replace their boxes, and the stems of the trees.

    A crown ends at the top of its box. A stem reaches from the bottom of the box to the middle of the crown.

    Args:
        centers, halves, colors: (n, 3) of the map's boxes and its ground plane.
    """
    import trimesh

    is_round = np.zeros(len(halves), dtype=bool)
    crown_bottom = np.full(len(halves), -1.0)  # at the bottom of the box, so without a stem
    plants = np.flatnonzero(box_map.kinds == KINDS["Vegetation"])
    seeds = contract.seeds_of(box_map.ids[plants])
    forms, crown_bottom[plants] = contract.plants_of(centers[plants], halves[plants], seeds)
    is_round[plants] = forms >= contract.BUSH
    crown_middle, crown_half = _span(crown_bottom, 1.0)
    crowns_m = halves * np.column_stack([np.ones((len(halves), 2)), crown_half])
    stem_middle, stem_half = _span(-1.0, crown_middle)
    radius_m = contract.stem_radius_m(halves)
    stems_m = np.column_stack([radius_m, radius_m, halves[:, 2] * stem_half])
    ball = trimesh.creation.icosphere(subdivisions=1)
    bark = np.tile(STEM_COLOR, (len(halves), 1))
    crowns = BoxSolids(ball, is_round, crowns_m, crown_middle, colors)
    return crowns, BoxSolids(_unit_box(), crown_bottom > -1.0, stems_m, stem_middle, bark)


def _span(bottom: np.ndarray | float, top: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle and the half length of the spans between two heights, (n,) each."""
    return np.asarray(bottom + top) / 2.0, np.asarray(top - bottom) / 2.0


def _person_triangles(person: PosedPerson, instance_id: int, origin: np.ndarray) -> Triangles:
    """Return the triangles of a person: balls, boxes and cylinders."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    rod = trimesh.creation.cylinder(1.0, 2.0, sections=12).triangles
    units = {"ball": ball.triangles, "rounded": _unit_box().triangles, "disc": rod, "limb": rod * LIMB_SHARE}
    figure = figure_of(person)
    solids = zip(figure.shapes, figure.centers_m, figure.turns, figure.half_m, strict=True)
    parts = [(units[shape] * half) @ turn.T + center - origin for shape, center, turn, half in solids]
    corners_m = np.concatenate(parts)
    colors = np.repeat(figure.colors, [len(part) for part in parts], axis=0)
    tag = _tags(*np.array([[KINDS["Pedestrians"]], [instance_id], [contract.STANDING_LAYER]]))
    return Triangles(corners_m, colors, np.repeat(tag, len(corners_m), axis=0))
