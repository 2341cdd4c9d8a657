"""Small playback trees for tests: a walking person, a drone that follows, and every file of every frame.

Images are painted by a plain NumPy ray caster (a ground plane, some boxes, the person), so the pictures, depths, ids,
boxes and visibilities agree with the poses in `trajectory.json`.
"""

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.boxes import BoxMap, MapHeader, make_box_map
from cosfly.formats.frames import (
    SKY_DEPTH_M,
    Camera,
    FrameMeta,
    PerturbationMeta,
    TargetMeta,
    camera_meta,
    depth_bytes,
    frame_name,
    instance_bytes,
    rgb_bytes,
)
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M, TARGET_HEIGHT_M
from cosfly.formats.playback import Perturbation, TargetRecord, Track
from cosfly.formats.playback_file import write_track
from cosfly.geometry.axes import DT_S, intrinsic_matrix, look_at, world_from_camera
from cosfly.render.camera import view_target

PERSON_ID = 0x1234  # two different bytes, so that a swap of the channels shows
FIRST_SECOND = 1_776_047_127


@dataclass(frozen=True)
class Scene:
    """Boxes that stand on the ground: centers, half_extents (k, 3) m; colors (k, 3) uint8 RGB; kinds, ids (k,)."""

    centers: np.ndarray
    half_extents: np.ndarray
    colors: np.ndarray
    kinds: np.ndarray
    ids: np.ndarray


def map_of(*rows: tuple, ids: Any = None, **header: Any) -> BoxMap:
    """Make a map of boxes: kind, centre, half extents and, where one is turned, its yaw in degrees."""
    turns = [(0.0, row[3] if len(row) > 3 else 0.0, 0.0) for row in rows]
    kinds = [KINDS[row[0]] for row in rows]
    return make_box_map([row[1] for row in rows], [row[2] for row in rows], turns, kinds, ids, MapHeader(**header))


def make_playback_tree(
    root: Path,
    num_flights: int = 2,
    num_points: int = 24,
    *,
    width_px: int = 64,
    height_px: int = 36,
    towns: tuple[str, ...] = ("Town01",),
    with_images: bool = True,
    with_augmented: bool = True,
) -> Path:
    """Write a playback tree of trajectories, whose towns take turns, and give its root."""
    for index in range(num_flights):
        town = towns[index % len(towns)]
        for variant in ("ORI", "aug_001") if with_augmented else ("ORI",):
            flight, scene = make_flight(
                num_points, seed=index, town=town, trajectory=f"trajectory_{FIRST_SECOND + 1000 * index}",
                variant=variant, width_px=width_px, height_px=height_px,
            )  # fmt: skip
            folder = root / town / flight.trajectory / variant
            write_track(folder, flight)
            if with_images:
                for i in range(num_points):
                    _write_frame(folder / frame_name(i), flight, scene, i)
    return root


def make_flight(
    num_points: int = 24,
    *,
    seed: int = 0,
    town: str = "Town01",
    trajectory: str = f"trajectory_{FIRST_SECOND}",
    variant: str = "ORI",
    width_px: int = 64,
    height_px: int = 36,
) -> tuple[Track, Scene]:
    rng = np.random.default_rng([seed, 77])
    targets = _walk(num_points, rng)
    positions, rotations = _follow(targets, rng)
    scene = _scene(targets, positions, rng)
    noise, zero = np.random.default_rng([seed, 78]), np.zeros((num_points, 3))
    drone_offsets, rotation_offsets = (noise.uniform(-most, most, zero.shape) for most in (0.4, 1.5))
    if variant == "ORI":
        drone_offsets, rotation_offsets = zero, zero.copy()
    aimed_before = look_at(positions, targets)
    positions, rotations = positions + drone_offsets, rotations + rotation_offsets
    # A shifted camera is aimed anew, as the renderer aims it.
    rotations[:, :2] += np.degrees(np.subtract(look_at(positions, targets), aimed_before).T)
    camera = Camera(width_px, height_px, intrinsic_matrix(width_px, height_px, 60.0))
    seen = seen_by(camera, positions, rotations, targets)
    shares = [_visible_share(scene, target, position) for target, position in zip(targets, positions, strict=True)]
    visibility = np.where(seen["in_view"], shares, 0.0)
    flight = Track(
        town=town, trajectory=trajectory, variant=variant, camera=camera, time_s=np.arange(num_points) * DT_S,
        positions_m=positions, rotations_deg=rotations, targets_m=targets,
        target=TargetRecord(**seen, visible=visibility >= 0.3, visibility=visibility),
        perturbation=Perturbation(np.full(num_points, variant != "ORI"), drone_offsets, rotation_offsets, zero.copy()),
        source={
            "path_index": seed, "scenario_id": f"specimen_{seed}", "scenario_name": "specimen", "algorithm": "muco",
        },
        is_original=variant == "ORI",
    )  # fmt: skip
    return flight, scene


def seen_by(camera: Camera, positions_m: np.ndarray, rotations_deg: np.ndarray, targets_m: np.ndarray) -> dict:
    """Return the fields of a target record about the view of a camera."""
    poses = map(world_from_camera, positions_m, rotations_deg)
    views = [view_target(target_m, pose, camera) for target_m, pose in zip(targets_m, poses, strict=True)]
    in_view = np.array([view.in_view for view in views])
    uv = np.where(in_view[:, None], [view.uv for view in views], np.nan)
    columns = {"depth_m": [view.depth_m for view in views], "bbox": [view.bbox_px for view in views]}
    return {"in_view": in_view, "uv": uv, **{name: np.array(values) for name, values in columns.items()}}


def _walk(num_points: int, rng: np.random.Generator) -> np.ndarray:
    """Hip positions (n, 3): straight legs, turns to both sides, a stop, a faster leg."""
    heading, position = rng.uniform(-np.pi, np.pi), np.array([0.0, 0.0, TARGET_HEIGHT_M])
    positions, turn_rad, speed_mps, left = [], 0.0, 1.2, 0
    for _ in range(num_points):
        positions.append(position.copy())
        if left == 0:
            left = int(rng.integers(4, 8))
            turn_rad = float(rng.choice([0.0, 0.25, -0.25, 0.1, -0.1]))
            speed_mps = float(rng.choice([1.2, 1.2, 1.6, 0.7, 0.0], p=[0.4, 0.2, 0.2, 0.1, 0.1]))
        left -= 1
        heading += turn_rad
        position += np.array([np.cos(heading), np.sin(heading), 0.0]) * speed_mps * DT_S
    return np.array(positions)


def _follow(targets: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Drone positions (n, 3) and rotations (n, 3) deg: some 12 m behind and 8 m above, with a lag, looking at the
    person."""
    n = len(targets)
    bearing = rng.uniform(-np.pi, np.pi)
    altitude = 8.0 + 1.5 * np.sin(np.arange(n) * 0.35 + rng.uniform(0.0, 6.0))
    position = targets[0] + np.array([12.0 * np.cos(bearing), 12.0 * np.sin(bearing), altitude[0]])
    positions, rotations, yaw = [], [], None
    for i in range(n):
        away = position[:2] - targets[i, :2]
        wanted = targets[i, :2] + 12.0 * away / np.linalg.norm(away)
        position = np.append(position[:2] + 0.5 * (wanted - position[:2]), altitude[i])
        pitch_rad, yaw_rad = look_at(position, targets[i])
        # The camera turns by 70 % of the way per step, so a turning person drifts off the middle.
        yaw = yaw_rad if yaw is None else yaw + 0.7 * ((yaw_rad - yaw + np.pi) % (2 * np.pi) - np.pi)
        positions.append(position.copy())
        rotations.append([np.degrees(pitch_rad), np.degrees(yaw), 0.0])
    return np.array(positions), np.array(rotations)


def _scene(targets: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> Scene:
    """A few buildings beside the walk and one wall that hides the person for some frames in the middle of the
    flight."""
    rows, middle, k = [], targets[len(targets) // 2], int(0.6 * len(targets))
    for _ in range(6):
        angle, distance_m = rng.uniform(-np.pi, np.pi), rng.uniform(25.0, 45.0)
        half = [rng.uniform(3.0, 7.0), rng.uniform(3.0, 7.0), rng.uniform(3.0, 9.0)]
        center = [middle[0] + distance_m * np.cos(angle), middle[1] + distance_m * np.sin(angle), half[2]]
        rows.append((center, half, rng.integers(90, 200, 3), KINDS["Buildings"]))
    between = targets[k, :2] + 0.12 * (positions[k, :2] - targets[k, :2])
    rows.append(([*between, 1.5], [0.6, 0.6, 1.5], np.array([120, 110, 100]), KINDS["Walls"]))
    centers, halves, colors, kinds = map(np.array, zip(*rows, strict=True))
    return Scene(centers, halves, colors.astype(np.uint8), kinds, np.arange(1, len(rows) + 1))


def _visible_share(scene: Scene, target: np.ndarray, position: np.ndarray) -> float:
    points = target + np.linspace(-0.8, 0.8, 9)[:, None] * np.array([0.0, 0.0, 1.0])
    directions = points - position
    near, far = _slabs(scene.centers, scene.half_extents, position, directions)
    hidden = ((near <= far) & (near > 0) & (near < 1)).any(axis=1)
    return float(1.0 - hidden.mean())


def _slabs(centers: np.ndarray, halves: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> tuple:
    """Entry and exit parameters (n, k) of n rays and k boxes."""
    safe = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    one = ((centers - halves)[None] - origin) / safe[:, None]
    two = ((centers + halves)[None] - origin) / safe[:, None]
    return np.minimum(one, two).max(axis=2), np.maximum(one, two).min(axis=2)


def paint(scene: Scene, flight: Track, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Give rgb (h, w, 3) uint8, depth (h, w) float32, semantic kinds (h, w) and ids (h, w) of one frame."""
    camera = flight.camera
    h, w = camera.height_px, camera.width_px
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    rays = np.stack([u.ravel(), v.ravel(), np.ones(h * w)], axis=1) @ np.linalg.inv(camera.intrinsic).T
    pose = world_from_camera(flight.positions_m[i], flight.rotations_deg[i])
    directions = rays @ pose[:3, :3].T  # camera z is 1, so the parameter along the ray is the z-depth
    origin = pose[:3, 3]
    centers = np.vstack([scene.centers, flight.targets_m[i]])
    halves = np.vstack([scene.half_extents, PERSON_HALF_EXTENTS_M])
    colors = np.vstack([scene.colors, [200, 40, 40]])
    kinds = np.append(scene.kinds, KINDS["Pedestrians"])
    own_ids = np.append(scene.ids, PERSON_ID)
    near, far = _slabs(centers, halves, origin, directions)
    near = np.where((near <= far) & (near > 0), near, np.inf)
    with np.errstate(divide="ignore"):
        ground = np.where(directions[:, 2] < 0, -origin[2] / directions[:, 2], np.inf)
    hit, first = near.min(axis=1), near.argmin(axis=1)
    on_box = hit < ground
    depth = np.minimum(hit, ground)
    is_sky = depth > SKY_DEPTH_M
    points = origin + directions * np.where(is_sky, 0.0, depth)[:, None]
    checks = (np.floor(points[:, 0] / 2) + np.floor(points[:, 1] / 2)) % 2
    rgb = np.where(checks[:, None] == 0, [96, 110, 90], [110, 122, 100])
    rgb = np.where(on_box[:, None], colors[first], rgb)
    rgb = np.where(is_sky[:, None], [150, 180, 220], rgb)
    semantic = np.where(is_sky, KINDS["Sky"], np.where(on_box, kinds[first], KINDS["Terrain"]))
    instance = np.where(on_box & ~is_sky, own_ids[first], 0)
    depth = np.where(is_sky, SKY_DEPTH_M, depth).astype(np.float32)
    rgb, ids = rgb.reshape(h, w, 3).astype(np.uint8), instance.reshape(h, w).astype(np.uint16)
    return rgb, depth.reshape(h, w), semantic.reshape(h, w).astype(np.uint8), ids


def change_json(path: Path, change: Callable[[Any], object]) -> None:
    """Change a JSON file by a function that changes its value."""
    value = json.loads(path.read_text())
    change(value)
    path.unlink()  # it may be a link
    path.write_text(json.dumps(value))


def _write_frame(folder: Path, flight: Track, scene: Scene, i: int) -> None:
    rgb, depth, semantic, instance = paint(scene, flight, i)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rgb.png").write_bytes(rgb_bytes(rgb))
    (folder / "depth.npy").write_bytes(depth_bytes(depth))
    (folder / "instance.png").write_bytes(instance_bytes(semantic, instance))
    (folder / "meta.json").write_bytes(_meta(flight, i, int((instance == PERSON_ID).sum())).to_bytes())


def _meta(flight: Track, i: int, num_pixels: int) -> FrameMeta:
    nowhere = np.zeros(3)
    target = TargetMeta(
        world_location=flight.targets_m[i], half_extents_m=PERSON_HALF_EXTENTS_M, instance_id=PERSON_ID,
        semantic_id=KINDS["Pedestrians"], image_uv=None, bbox_2d=None, depth_m=float(flight.target.depth_m[i]),
        in_view=bool(flight.target.in_view[i]), visible=bool(flight.target.visible[i]),
        visibility=float(flight.target.visibility[i]), num_pixels=num_pixels,
    )  # fmt: skip
    return FrameMeta(
        index=i, time_s=float(flight.time_s[i]), town=flight.town, trajectory=flight.trajectory, variant=flight.variant,
        camera=camera_meta(flight.camera, 0.3, SKY_DEPTH_M),
        drone_pose=np.hstack([flight.positions_m[i], flight.rotations_deg[i]]), target=target,
        perturbation=PerturbationMeta(
            position="none", rotation="none", drone_position=nowhere, target_position=nowhere,
            drone_rotation=nowhere,
        ),
    )  # fmt: skip


def _chunk(name: bytes, data: bytes) -> bytes:
    body = name + data
    return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))


def png_around(packed: bytes, width: int, height: int) -> bytes:
    """Return a PNG file around any bytes, whatever its header says of them; checksums are right."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = (_chunk(b"IHDR", head), _chunk(b"IDAT", packed), _chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
