"""What a frame of the LeRobot export holds: features as `info.json` declares them, their parquet types, and their values.

LeRobot's conventions: `observation.*` is what a policy sees, `action` what it answers, `timestamp` counts from the start of an episode.
"""

from __future__ import annotations

import io
import json
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from cosfly.geometry import wrap_deg
from cosfly.products.frames import FrameFile
from cosfly.reading.arrays import parse_array
from release.columns import BOX, CAPTION_FIELDS, POINT, POSE
from release.export.source import vectors

STATE, ACTION = "observation.state", "action"
MOVE = ("forward_m", "left_m", "up_m", "yaw_deg")
CAMERAS: dict[FrameFile, str] = {
    "rgb": "observation.images.rgb", "depth": "observation.depth", "instance": "observation.images.instance",
}  # fmt: skip
TEXTS = ("sample_id", "decision", "label", "verdict", *CAPTION_FIELDS)
FLAGS = ("target_in_view", "target_visible", "is_perturbed", "has_caption")
VECTORS = {  # feature -> the release's column and its members
    "target": ("target", POINT),
    "target_uv": ("target_uv", ("u_px", "v_px")),
    "target_bbox": ("target_bbox", BOX),
    "intrinsics": ("intrinsics", ("fx", "fy", "cx", "cy")),
}
DEFAULTS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
# Columns of the release that the values are made of; pictures apart.
COLUMNS = ["pose", "visibility", "target_depth_m", *FLAGS, *TEXTS, *(column for column, _ in VECTORS.values())]


@dataclass(frozen=True)
class Feature:
    """One feature of `info.json`."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None = None
    info: dict[str, Any] | None = None

    def declared(self) -> dict[str, Any]:
        found: dict[str, Any] = {
            "dtype": self.dtype,
            "shape": list(self.shape),
            "names": self.names and list(self.names),
        }
        return found | ({"info": self.info} if self.info else {})

    @property
    def arrow(self) -> pa.DataType:
        if self.dtype == "image":
            return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        plain = pa.type_for_alias(self.dtype)
        return plain if self.shape == (1,) else pa.list_(plain, self.shape[0])

    @property
    def hub(self) -> dict[str, Any]:
        """As `datasets` writes it into a parquet file."""
        if self.dtype == "image":
            return {"_type": "Image"}
        value = {"dtype": self.dtype, "_type": "Value"}
        return value if self.shape == (1,) else {"feature": value, "length": self.shape[0], "_type": "Sequence"}


def features_of(modalities: Collection[FrameFile], size_px: tuple[int, int]) -> dict[str, Feature]:
    """Give the features of frames whose pictures are (width, height) px."""
    width, height = size_px
    found: dict[str, Feature] = {}
    for file in modalities:
        if file == "depth":
            info = {"is_depth_map": True, "depth_unit": "m"}
            found[CAMERAS[file]] = Feature("image", (height, width, 1), ("height", "width", "channels"), info)
        else:
            found[CAMERAS[file]] = Feature("image", (height, width, 3), ("height", "width", "channels"))
    found[STATE] = Feature("float32", (len(POSE),), POSE)
    found[ACTION] = Feature("float32", (len(MOVE),), MOVE)
    found |= {name: Feature("float32", (len(members),), members) for name, (_, members) in VECTORS.items()}
    found |= {name: Feature("float32", (1,)) for name in ("visibility", "target_depth_m")}
    found |= {name: Feature("bool", (1,)) for name in (*FLAGS, "next.done")}
    found |= {name: Feature("string", (1,)) for name in TEXTS}
    return found | {name: Feature(dtype, (1,)) for name, dtype in DEFAULTS.items()}


def schema_of(features: dict[str, Feature]) -> pa.Schema:
    """Give the parquet schema, with what `datasets` wants to know in its metadata."""
    about = {"info": {"features": {name: feature.hub for name, feature in features.items()}}}
    return pa.schema(
        [(name, feature.arrow) for name, feature in features.items()], {b"huggingface": json.dumps(about).encode()}
    )


def values_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Give the values of all features of an episode but pictures and LeRobot's own: arrays (n,) or (n, d), and lists of texts.

    What a frame does not have is NaN, or the empty text.
    """
    pose = vectors(rows, "pose", POSE)
    found: dict[str, Any] = {STATE: pose.astype(np.float32), ACTION: moves(pose).astype(np.float32)}
    found |= {name: vectors(rows, column, members).astype(np.float32) for name, (column, members) in VECTORS.items()}
    for name in ("visibility", "target_depth_m"):
        found[name] = np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=np.float32)
    found |= {name: np.array([bool(row[name]) for row in rows]) for name in FLAGS}
    found["next.done"] = np.arange(len(rows)) == len(rows) - 1
    return found | {name: [row[name] or "" for row in rows] for name in TEXTS}


def moves(poses: np.ndarray) -> np.ndarray:
    """Give what takes each pose to the next, (n, 4): the way in the drone's own level axes, m, and the turn, degrees; zero at the last.

    Args:
        poses: (n, 6) x, y, z in m, pitch, yaw, roll in degrees, right-handed.
    """
    found = np.zeros((len(poses), 4))
    steps = np.diff(poses[:, :3], axis=0)
    yaw_rad = np.radians(poses[:-1, 4])
    found[:-1, 0] = steps[:, 0] * np.cos(yaw_rad) + steps[:, 1] * np.sin(yaw_rad)
    found[:-1, 1] = steps[:, 1] * np.cos(yaw_rad) - steps[:, 0] * np.sin(yaw_rad)
    found[:-1, 2] = steps[:, 2]
    found[:-1, 3] = wrap_deg(np.diff(poses[:, 4]))
    return found


def tiff_of_depth(data: bytes, where: str) -> bytes:
    """Give the bytes of a `depth.npy` as TIFF of float32, in which LeRobot keeps depth: the same numbers, uncompressed.

    Raises:
        InputError: it is no depth image.
    """
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(parse_array(data, where, dtype=np.float32, ndim=2, what="depth image")).save(buffer, "TIFF")
    return buffer.getvalue()
