"""The strictest reader of the public layout, by its demands alone: whatever it refuses, other people's loaders refuse.

The demands were gathered from the design's contract of the layout and from what public loaders of the release check. It
knows nothing of cosfly's reader.
"""

import itertools
import json
import math
from pathlib import Path
from typing import Any

from PIL import Image

TRACES = ("ORI", "aug_001")


def need(condition: Any, where: object, what: str) -> None:
    assert condition, f"{where}: {what}"


def read_public(root: Path, *, exported: bool = False) -> dict[str, dict[str, dict]]:
    """Read a tree. exported: Demand also the forms of fields that the public files have."""
    parents = sorted(root.glob("Town*/trajectory_*"))
    need(parents, root, "no Town*/trajectory_*")
    trees = {parent.relative_to(root).as_posix(): _parent(parent) for parent in parents}
    for name, traces in trees.items() if exported else ():
        for trace, payload in traces.items():
            _forms(payload, root / name / trace)
    return trees


def _parent(parent: Path) -> dict[str, dict]:
    traces = {trace: _trace(parent / trace, trace) for trace in TRACES}
    clean, perturbed = traces.values()
    need(len(clean["points"]) == len(perturbed["points"]), parent, "the traces differ in length")
    need(clean["augmentation"]["is_original"] is True, parent, "ORI is not the original")
    need(perturbed["augmentation"]["is_original"] is False, parent, "aug_001 is an original")
    for key in ("path_index", "scenario_id", "scenario_name"):
        need(clean["source"][key] == perturbed["source"][key], parent, f"source.{key} differs")
    return traces


def _trace(folder: Path, trace: str) -> dict:
    path = folder / "trajectory.json"
    need(path.is_file(), path, "missing")
    payload = json.loads(path.read_text(encoding="utf-8"))
    need(payload.get("schema") == "drone_nav_traj_v7" and payload.get("schema_version") == "7.0.0", path, "schema")
    need(payload.get("trace_dir") == trace, path, f"trace_dir {payload.get('trace_dir')!r}")
    camera, points = payload.get("camera"), payload.get("points")
    need(isinstance(points, list) and points, path, "points")
    need(isinstance(camera, dict), path, "camera")
    need(all(type(camera.get(k)) is int and camera[k] > 0 for k in ("width", "height")), path, "camera size")
    rows = camera.get("intrinsic")
    need(len(rows) == 3 and all(len(row) == 3 and all(map(math.isfinite, row)) for row in rows), path, "intrinsic")
    need([point.get("index") for point in points] == list(range(len(points))), path, "index")
    times = [point["timing"]["trace_timestamp"] for point in points]
    need(all(b > a for a, b in itertools.pairwise(times)), path, "time")
    for i, point in enumerate(points):
        _point(point, points[i + 1] if i + 1 < len(points) else None, f"{path} {i}")
        picture = folder / "frames_playback" / f"frame_{i:05d}" / "rgb.png"
        need(picture.is_file() and picture.stat().st_size, picture, "missing or empty")
        with Image.open(picture) as image:
            need(image.size == (camera["width"], camera["height"]), picture, f"size {image.size}")
            image.verify()
    return payload


def _forms(payload: dict, folder: Path) -> None:
    need(payload["dataset_format"] == "v7", folder, "dataset_format")
    source = payload["source"]
    need(all(type(source[key]) is int for key in ("path_index", "scenario_id")), folder, "source")
    need(all(type(source[key]) is str for key in ("scenario_name", "algorithm")), folder, "source")
    for i, point in enumerate(payload["points"]):
        flags = [point["perturbation"][key] for key in ("drone_position", "drone_rotation")]
        need(all(type(flag) is bool for flag in (point["is_perturbed"], *flags)), folder, f"flags {i}")
        need(folder.joinpath("frames_playback", f"frame_{i:05d}", "depth.npy").is_file(), folder, f"depth {i}")


def _point(point: dict, following: dict | None, where: str) -> None:
    pose, waypoint = point["drone_pose"], point["nav_waypoint"]["t1_world"]
    need(all(math.isfinite(float(pose[name])) for name in ("x", "y", "z", "yaw")), where, "drone_pose")
    if following is None:
        need(waypoint is None, where, "t1_world is not null at the last point")
    else:
        need(isinstance(waypoint, dict), where, f"t1_world {waypoint!r}")
        near = all(abs(waypoint[axis] - following["drone_pose"][axis]) <= 1e-5 for axis in "xyz")
        need(near, where, "t1_world is not the next position")
    target = point.get("target") or {}
    uv, box = target.get("image_uv"), target.get("bbox_2d")
    need(uv is None or (isinstance(uv, list) and len(uv) == 2), where, f"image_uv {uv!r}")
    need(box is None or {"xmin", "ymin", "xmax", "ymax"} <= set(box), where, f"bbox_2d {box!r}")
