"""The fields of `trajectory.json` (playback.py), one by one: what the layout asks for, and what a reader tolerates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cosfly.formats.columns import is_number, numbers
from cosfly.formats.frames import ANGLES, XYZ, Camera
from cosfly.geometry.axes import step_s
from cosfly.runtime.arrays import check_pixels
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import MISSING

Told = TypeVar("Told")

SCHEMA, SCHEMA_VERSION = "drone_nav_traj_v7", "7.0.0"
WAYPOINT_TOLERANCE_M = 1e-5  # the public readers' own bound on nav_waypoint.t1_world

BBOX = ("xmin", "ymin", "xmax", "ymax")


class FieldReader:
    """Checks fields of one file: strict raises, tolerant notes."""

    def __init__(self, path: Path, strict: bool) -> None:
        self.path, self.strict = path, strict
        self.issues: list[str] = []

    def error(self, message: str, where: str, got: object, expected: str) -> InputError:
        if str(got) in ("None", "NoneType"):
            return InputError(MISSING, where=f"{self.path}: {where}", expected=expected)
        return InputError(message, where=f"{self.path}: {where}", got=str(got), expected=expected)

    def issue(self, where: str, got: object, expected: str) -> None:
        with self.noted():
            raise self.error("breaks the layout", where, got, expected)

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note an InputError that is raised within, unless the reader is strict."""
        try:
            yield
        except InputError as error:
            if self.strict:
                raise
            self.issues.append(str(error))

    def equal(self, where: str, got: object, expected: object) -> None:
        if got != expected:
            self.issue(where, repr(got), repr(expected))

    def header(self, raw: dict, variant: str) -> None:
        self.equal("schema", raw.get("schema"), SCHEMA)
        self.equal("schema_version", raw.get("schema_version"), SCHEMA_VERSION)
        self.equal("trace_dir", raw.get("trace_dir"), variant)

    def points(self, raw: dict) -> list[dict]:
        points = raw.get("points", None if self.strict else raw.get("waypoints"))
        if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
            raise self.error("no points", "points", type(points).__name__, "a list of objects")
        for i, point in enumerate(points):
            self.equal(f"points[{i}].index", point.get("index"), i)
        return points

    def times(self, points: list[dict]) -> np.ndarray:
        """Times of the points, (n,) s; they must increase."""
        time_s = np.array([self.time(i, point) for i, point in enumerate(points)])
        steps = np.diff(time_s)
        if (steps <= 0).any():
            where = f"points[{int(np.argmax(steps <= 0)) + 1}].timing.trace_timestamp"
            raise self.error("time does not increase", where, float(steps.min()), "strictly increasing times")
        dt_s = step_s(time_s)
        if len(steps) and np.abs(steps - dt_s).max() > 1e-3:
            got = f"steps of {steps.min():.3f} to {steps.max():.3f} s"
            self.issue("points[].timing.trace_timestamp", got, f"even steps, most are {dt_s:g} s")
        return time_s

    def poses(self, points: list[dict]) -> np.ndarray:
        """Poses as the file holds them, (n, 6): x, y, z, pitch, yaw, roll in CARLA's axes."""
        groups = [(f"points[{i}].drone_pose", point.get("drone_pose")) for i, point in enumerate(points)]
        poses = np.array([[self.number(where, group, name) for name in XYZ + ANGLES] for where, group in groups])
        self.waypoints(points, poses[:, :3])
        return poses

    def number(self, where: str, group: Any, name: str) -> float:
        value = group.get(name) if isinstance(group, dict) else None
        if value is None and name in ("pitch", "roll") and not self.strict:
            return 0.0
        if value is None or not is_number(value):
            raise self.error("not a number", f"{where}.{name}", repr(value)[:60], "a finite number")
        return float(value)

    def time(self, i: int, point: dict) -> float:
        timing = object_of(point, "timing")
        if self.strict or "trace_timestamp" in timing:
            return self.number(f"points[{i}].timing", timing, "trace_timestamp")
        return self.number(f"points[{i}].timing", timing if "timestamp" in timing else point, "timestamp")

    def waypoints(self, points: list[dict], positions: np.ndarray) -> None:
        for i, point in enumerate(points):
            nav = point.get("nav_waypoint")
            found = nav.get("t1_world") if isinstance(nav, dict) else "missing"
            where = f"points[{i}].nav_waypoint.t1_world"
            if i + 1 == len(points):
                if found is not None:
                    self.issue(where, repr(found)[:60], "null at the last point")
                return
            vector = vector_of(found, XYZ)
            if np.isnan(vector).any() or np.abs(vector - positions[i + 1]).max() > WAYPOINT_TOLERANCE_M:
                self.issue(where, repr(found)[:60], f"the next point's position {positions[i + 1].tolist()}")
                return  # one note is enough

    def between(self, points: list[dict]) -> np.ndarray | None:
        """Planned poses after each point and before the next, (n, k - 1, 6), NaN after the last; None without any."""
        if len(points) < 2 or not any(point.get("between") for point in points):
            return None
        found = numbers([point.get("between") for point in points[:-1]], None, None, len(XYZ + ANGLES))
        if found is None:
            self.issue("points[].between", "something else", "as many poses of 6 finite numbers after each point")
            return None
        return np.concatenate([found, np.full((1, *found.shape[1:]), np.nan)])

    def told(self, read: Callable[[], Told]) -> Told | None:
        """Return what is read of a field that a file need not have; None where it is somebody else's of this name,
        which is noted."""
        with self.noted():
            return read()
        return None

    def camera(self, group: Any) -> Camera:
        if not isinstance(group, dict):
            raise InputError("missing", where=f"{self.path}: camera", expected="width, height, intrinsic")
        width, height = self.number("camera", group, "width"), self.number("camera", group, "height")
        matrix = numbers(group.get("intrinsic"), 3, 3)
        if matrix is None or matrix[0, 0] <= 0 or width < 1 or height < 1:
            got, expected = repr(group.get("intrinsic"))[:60], "a 3x3 matrix with a positive focal length"
            raise self.error("not a camera", "camera.intrinsic", got, expected)
        check_pixels(width * height, f"{self.path}: camera", f"{width:g} x {height:g} px")
        return Camera(int(width), int(height), matrix)

    def intrinsics(self, points: list[dict], camera: Camera) -> np.ndarray | None:
        """Matrices of the frames, (n, 3, 3), of a flight that zooms; None where `camera` is that of all."""
        found = np.tile(camera.intrinsic, (len(points), 1, 1))
        for i, own in enumerate(object_of(point, "camera") for point in points):
            if own.get("intrinsic") is None:
                continue
            try:
                size = {"width": camera.width_px, "height": camera.height_px}
                found[i] = self.camera({**size, "intrinsic": own["intrinsic"]}).intrinsic
            except InputError as error:
                self.issue(f"points[{i}].camera.intrinsic", error.got, error.expected or "a camera")
        return None if (found == camera.intrinsic).all() else found


def object_of(group: dict, key: str) -> dict:
    """Return the object under a key; an empty one where there is none, or something else."""
    value = group.get(key)
    return value if isinstance(value, dict) else {}


def vector_of(value: Any, names: tuple[str, ...]) -> np.ndarray:
    """Read {"x": .., "y": ..} or [.., ..]; anything else, nulls included, is NaN."""
    return np.array(_parts_of(value, names), dtype=np.float64)


def _parts_of(value: Any, names: tuple[str, ...]) -> list:
    parts = [value.get(n) for n in names] if isinstance(value, dict) else value
    if isinstance(parts, list) and len(parts) == len(names) and all(map(is_number, parts)):
        return parts
    return [np.nan] * len(names)


def vectors_of(groups: list[dict], key: str, names: tuple[str, ...]) -> np.ndarray:
    """Read a vector of each group, as `vector_of` does, (n, len(names))."""
    # One array of all: of each alone it takes twice as long.
    parts = [_parts_of(group.get(key), names) for group in groups]
    return np.array(parts, dtype=np.float64).reshape(-1, len(names))


def mask_boxes(targets: list[dict]) -> np.ndarray | None:
    """Read the boxes of the person's pixels, (n, 4) px; None where the file has no such field."""
    return vectors_of(targets, "mask_bbox_2d", BBOX) if any("mask_bbox_2d" in target for target in targets) else None


def offsets_of(points: list[dict], key: str, names: tuple[str, ...], is_original: bool) -> np.ndarray:
    """Read what was added to each point, (n, len(names)): zero where nothing was, NaN where no file says what."""
    groups = [object_of(p, "perturbation") for p in points]
    is_none = [
        is_original or p.get("is_perturbed") is False or g.get(key) is False
        for p, g in zip(points, groups, strict=True)
    ]
    offsets = vectors_of(groups, key, names)
    offsets[np.isnan(offsets).any(axis=1) & np.array(is_none)] = 0.0
    return offsets


def numbers_of(groups: list[dict], key: str) -> np.ndarray:
    """Read one number of each group, (n,); anything else, nulls included, is NaN."""
    return np.array([_parts_of([group.get(key)], (key,))[0] for group in groups], dtype=np.float64)


def flags_of(groups: list[dict], key: str, default_key: str = "") -> np.ndarray:
    """Read one flag of each group, (n,) bool, under either key; False where there is none."""
    return np.array([bool(group.get(key, group.get(default_key, False))) for group in groups])
