"""A tree as other people write the public layout, by a writer that knows nothing of cosfly: plain JSON, Pillow and
NumPy.

Boolean perturbation flags, a clock that starts late, RGBA pictures, no meta.json, frames without a target, axes and
projection of its own (left-handed: x forward, y right, z up, yaw clockwise).
"""

import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 96, 54, 60.0
PEDESTRIAN, GROUND, SKY_M = 12, 25, 1000.0
NOBODY = 2  # the point whose target is null


def write_foreign_tree(
    root: Path,
    *,
    towns: tuple[str, ...] = ("Town01",),
    trajectories: tuple[str, ...] = ("trajectory_1777083733",),
    num_points: int = 16,
    files: tuple[str, ...] = ("rgb.png", "depth.npy", "instance.png"),
) -> Path:
    """Write every trajectory into every town, clean and perturbed, and give the root."""
    for k, (town, trajectory) in enumerate((t, j) for t in towns for j in trajectories):
        for variant in ("ORI", "aug_001"):
            is_clean = variant == "ORI"
            folder = root / town / trajectory / variant
            poses, people = _motion(num_points, k, is_clean)
            points = [_point(i, poses, people, 7.5, is_clean) for i in range(num_points)]
            for i, point in enumerate(points):
                _write_frame(folder / "frames_playback" / f"frame_{i:05d}", poses[i], point, files)
            folder.joinpath("trajectory.json").write_text(json.dumps(_header(variant, is_clean, k, points)))
    return root


def _header(variant: str, is_clean: bool, k: int, points: list[dict]) -> dict:
    return {
        "schema": "drone_nav_traj_v7", "schema_version": "7.0.0", "dataset_format": "v7",
        "source": {"path_index": k, "scenario_id": k, "scenario_name": f"path_{k}", "algorithm": "oneshot"},
        "camera": {
            "width": WIDTH, "height": HEIGHT, "focal_length_px": FOCAL,
            "intrinsic": [[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]],
        },
        "trace_dir": variant, "frames_dir": "frames_playback",
        "augmentation": {"enabled": True, "aug_index": 0 if is_clean else 1, "is_original": is_clean},
        "lens": {"k1": 0.0}, "points": points,  # real files hold more than anybody listed
    }  # fmt: skip


def _motion(num_points: int, k: int, is_clean: bool) -> tuple[list[dict], list[tuple[float, float, float]]]:
    """A person who walks and turns, a drone 12 m behind and 8 m above that looks at it, shaken in the perturbed
    flight."""
    noise = np.random.default_rng([k, 5])
    poses, people = [], []
    x = y = 10.0 * k
    heading = 0.3 * k
    for i in range(num_points):
        heading += 0.12 if i > num_points // 3 else 0.0
        x, y = x + 0.6 * math.cos(heading), y + 0.6 * math.sin(heading)
        people.append((x, y, 0.9))
        camera = [x - 12 * math.cos(heading), y - 12 * math.sin(heading), 8.9]
        shake = noise.uniform(-0.8, 0.8, 4)
        if not is_clean:
            camera = [c + s for c, s in zip(camera, shake[:3], strict=True)]
        ahead = [a - b for a, b in zip(people[-1], camera, strict=True)]
        pitch = math.degrees(math.atan2(ahead[2], math.hypot(ahead[0], ahead[1])))
        yaw = math.degrees(math.atan2(ahead[1], ahead[0])) + (0.0 if is_clean else 6.0 * shake[3])
        pose = dict(zip(("x", "y", "z"), camera, strict=True))
        poses.append({**pose, "pitch": pitch, "yaw": yaw, "roll": 0.0})
    return poses, people


def _point(i: int, poses: list[dict], people: list[tuple[float, float, float]], start_s: float, is_clean: bool) -> dict:
    following = {axis: poses[i + 1][axis] for axis in "xyz"} if i + 1 < len(poses) else None
    return {
        "index": i, "is_perturbed": not is_clean,
        "perturbation": {"drone_position": not is_clean, "drone_rotation": not is_clean},
        "timing": {"trace_timestamp": start_s + 0.5 * i, "sim_timestamp": 100.0 + i}, "drone_pose": poses[i],
        "nav_waypoint": {"t1_world": following}, "target": None if i == NOBODY else _target(poses[i], people[i]),
    }  # fmt: skip


def _project(pose: dict, place: tuple[float, float, float]) -> tuple[float, float, float]:
    pitch, yaw = math.radians(pose["pitch"]), math.radians(pose["yaw"])
    forward = (math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch))
    right = (-math.sin(yaw), math.cos(yaw), 0.0)
    up = (-math.sin(pitch) * math.cos(yaw), -math.sin(pitch) * math.sin(yaw), math.cos(pitch))
    away = [a - pose[axis] for a, axis in zip(place, "xyz", strict=True)]
    depth, side, height = (sum(a * b for a, b in zip(away, axis, strict=True)) for axis in (forward, right, up))
    return WIDTH / 2 + FOCAL * side / depth, HEIGHT / 2 - FOCAL * height / depth, depth


def _target(pose: dict, place: tuple[float, float, float]) -> dict:
    u, v, depth = _project(pose, place)
    half = 0.9 * FOCAL / depth  # their person is not as large as ours
    box = {"xmin": u - half / 3, "ymin": v - half, "xmax": u + half / 3, "ymax": v + half}
    return {
        "enabled": True, "visible": True, "in_view": True, "depth": depth,
        "world_location": dict(zip(("x", "y", "z"), place, strict=True)), "image_uv": [u, v], "bbox_2d": box,
    }  # fmt: skip


def _write_frame(folder: Path, pose: dict, point: dict, files: tuple[str, ...]) -> None:
    folder.mkdir(parents=True)
    depth = np.full((HEIGHT, WIDTH), SKY_M, np.float32)
    rows = np.arange(HEIGHT)[:, None] + np.zeros((1, WIDTH))
    depth[HEIGHT // 5 :] = (14.0 + (HEIGHT - rows) / 3)[HEIGHT // 5 :]
    instance = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    instance[..., 0] = GROUND
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    shift = int(10 * pose["x"] + 7 * pose["y"])
    rgba[..., :3] = ((rows + np.arange(WIDTH) + shift) % 23 * 9)[..., None]
    rgba[..., 3] = 255
    if point["target"]:
        box, away = point["target"]["bbox_2d"], point["target"]["depth"]
        span = slice(round(box["ymin"]), round(box["ymax"])), slice(round(box["xmin"]), round(box["xmax"]))
        depth[span], instance[span], rgba[span] = away, (PEDESTRIAN, 7, 1), (200, 30, 30, 255)
    pictures = {"rgb.png": Image.fromarray(rgba, "RGBA"), "instance.png": Image.fromarray(instance)}
    for name in files:
        if name == "depth.npy":
            np.save(folder / name, depth)
        else:
            pictures[name].save(folder / name)


def hub_snapshot(dataset: Path, cache: Path) -> Path:
    """Lay a release into a cache as a hub's client keeps it: files are links into ../../blobs. Gives its folder."""
    snapshot, blobs = cache / "datasets--me--town/snapshots/0123", cache / "datasets--me--town/blobs"
    blobs.mkdir(parents=True)
    for number, path in enumerate(sorted(path for path in dataset.rglob("*") if path.is_file())):
        shutil.copy(path, blobs / str(number))
        link = snapshot / path.relative_to(dataset)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(blobs / str(number), link.parent))
    return snapshot
