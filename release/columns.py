"""The columns of the released parquet files: schema, one row per frame, and what a reader needs to decode them.

The HuggingFace key in the schema's metadata makes `datasets.load_dataset` decode `image` and `instance` as pictures. No
list and no nested list stands in a row except the caption's window, so that every reader of parquet shows plain columns.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from cosfly.errors import InputError
from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.products.playback import Flight, sample_id

Modality = Literal["rgb", "depth", "instance"]
MODALITIES: tuple[Modality, ...] = ("rgb", "depth", "instance")

# modality -> (column, file in the frame folder)
FILES = {"rgb": ("image", "rgb.png"), "depth": ("depth", "depth.npy"), "instance": ("instance", "instance.png")}

POSE = ("x_m", "y_m", "z_m", "pitch_deg", "yaw_deg", "roll_deg")
POINT = ("x_m", "y_m", "z_m")
CAPTION_FIELDS = tuple(
    f"caption_{language}_{field}"
    for language in ("en", "zh")
    for field in ("critical_components", "reasoning_trace", "flight_decision")
)
CAPTION_FACTS = ("decision", "label", "verdict", "repair_strategy", "teacher_kind", "teacher_model")

# name -> type: a name of a scalar, or the members of a struct (all float64)
SCALARS: dict[str, str | tuple[str, ...]] = {
    "sample_id": "string",
    "town": "string",
    "trajectory": "string",
    "variant": "string",
    "track": "string",
    "frame_index": "int32",
    "time_s": "float64",
    "width_px": "int32",
    "height_px": "int32",
    "fov_deg": "float64",
    "intrinsics": ("fx", "fy", "cx", "cy"),
    "pose": POSE,
    "target": POINT,
    "target_uv": ("u_px", "v_px"),
    "target_bbox": ("xmin_px", "ymin_px", "xmax_px", "ymax_px"),
    "target_depth_m": "float64",
    "target_in_view": "bool",
    "target_visible": "bool",
    "visibility": "float64",
    "is_perturbed": "bool",
    "drone_offset": POSE,
    "target_offset": POINT,
    "has_caption": "bool",
    **dict.fromkeys(CAPTION_FACTS, "string"),
    **dict.fromkeys(CAPTION_FIELDS, "string"),
}
WINDOW = "caption_window"
PNG_END = b"IEND\xaeB`\x82"  # the last chunk and its checksum

CONTRACT: dict[str, Any] = {
    "handedness": "right",
    "position": "metres; x east, y north, z up",
    "rotation": "degrees; yaw counter-clockwise from east seen from above, pitch nose-up, roll right-side-down",
    "world_from_body": "Rz(yaw) @ Ry(-pitch) @ Rx(roll); body axes: x forward, y left, z up",
    "body_from_camera": BODY_FROM_CAMERA.astype(int).tolist(),
    "camera": "pose is the camera's; image x right, y down, z along the optical axis; pixel (0, 0) is the corner, "
    "the centre of the first pixel is (0.5, 0.5)",
    "projection": "u = fx * x / z + cx, v = fy * y / z + cy for a point (x, y, z) in camera axes",
    "depth": f"z-depth along the optical axis, metres, float32; {SKY_DEPTH_M:g} sky, {INVALID_DEPTH_M:g} invalid",
    "instance": "PNG; R semantic number (CARLA 0.9.16 CityObjectLabel), G low and B high byte of the instance id",
    "target": "hip of the tracked person",
    "offsets": "the perturbation of the frame, already contained in pose and target; where a position was shifted the camera "
    "was aimed anew, and the rotation offset is its turn away from that aim",
    "time": "seconds; frames are 0.5 s apart in the flight",
}


@dataclass(frozen=True)
class ReleasedCaption:
    """What a row holds of an accepted caption."""

    window: tuple[int, ...]
    texts: dict[str, str]  # CAPTION_FIELDS
    facts: dict[str, str | None]  # CAPTION_FACTS


def schema(modalities: tuple[Modality, ...] | list[Modality]) -> pa.Schema:
    """Give the parquet schema, features for HuggingFace `datasets` in its metadata."""
    fields: list[pa.Field] = []
    features: dict[str, Any] = {}
    types = {"string": pa.string(), "int32": pa.int32(), "float64": pa.float64(), "bool": pa.bool_()}
    for modality in MODALITIES:
        if modality not in modalities:
            continue
        column = FILES[modality][0]
        if modality == "depth":
            fields.append(pa.field(column, pa.binary()))
            features[column] = {"dtype": "binary", "_type": "Value"}
        else:
            fields.append(pa.field(column, pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
            features[column] = {"_type": "Image"}
    for name, kind in SCALARS.items():
        if isinstance(kind, tuple):
            fields.append(pa.field(name, pa.struct([(member, pa.float64()) for member in kind])))
            features[name] = {member: {"dtype": "float64", "_type": "Value"} for member in kind}
        else:
            fields.append(pa.field(name, types[kind]))
            features[name] = {"dtype": kind, "_type": "Value"}
    fields.append(pa.field(WINDOW, pa.list_(pa.field("element", pa.int32()))))  # parquet's own name of it
    # `Sequence` is what `datasets` before version 4 calls a list; later versions still read it.
    features[WINDOW] = {"feature": {"dtype": "int32", "_type": "Value"}, "_type": "Sequence"}
    return pa.schema(fields, {b"huggingface": json.dumps({"info": {"features": features}}).encode()})


def scalar_names() -> list[str]:
    """Names of the columns that are small: everything but pictures and depth."""
    return [*SCALARS, WINDOW]


def row(
    flight: Flight, i: int, modalities: tuple[Modality, ...] | list[Modality], caption: ReleasedCaption | None
) -> dict[str, Any]:
    """Give the row of one frame, right-handed axes.

    Raises:
        InputError: a file of the frame cannot be read.
    """
    intrinsic = flight.camera.intrinsic
    values: dict[str, Any] = {
        "sample_id": sample_id(flight.flight_id, i),
        "town": flight.town,
        "trajectory": flight.trajectory,
        "variant": flight.variant,
        "track": "clean" if flight.is_original else "perturbed",
        "frame_index": i,
        "time_s": float(flight.time_s[i]),
        "width_px": flight.camera.width_px,
        "height_px": flight.camera.height_px,
        "fov_deg": round(flight.camera.fov_deg, 6),
        "intrinsics": _struct("intrinsics", intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]]),
        "pose": _struct("pose", np.concatenate([flight.positions_m[i], flight.rotations_deg[i]])),
        "target": _struct("target", flight.targets_m[i]),
        "target_uv": _struct("target_uv", flight.target_uv[i]),
        "target_bbox": _struct("target_bbox", flight.target_bbox[i]),
        "target_depth_m": _number(flight.target_depth_m[i]),
        "target_in_view": bool(flight.target_in_view[i]),
        "target_visible": bool(flight.target_visible[i]),
        "visibility": _number(flight.visibility[i]),
        "is_perturbed": bool(flight.is_perturbed[i]),
        "drone_offset": _struct(
            "drone_offset", np.concatenate([flight.drone_offsets_m[i], flight.rotation_offsets_deg[i]])
        ),
        "target_offset": _struct("target_offset", flight.target_offsets_m[i]),
        "has_caption": caption is not None,
        WINDOW: list(caption.window) if caption else None,
    }
    values.update(caption.texts if caption else dict.fromkeys(CAPTION_FIELDS))
    values.update(caption.facts if caption else dict.fromkeys(CAPTION_FACTS))
    for modality in modalities:
        column, name = FILES[modality]
        data = _read(flight.frame_folder(i) / name, modality, flight.camera.width_px * flight.camera.height_px)
        values[column] = data if modality == "depth" else {"bytes": data, "path": f"{values['sample_id']}_{name}"}
    return values


def _struct(name: str, numbers: np.ndarray) -> dict[str, float] | None:
    """Name the numbers of a struct column; None where they are unknown. Adding 0.0 turns -0.0 into 0.0."""
    if np.isnan(numbers).any():
        return None
    members = SCALARS[name]
    assert isinstance(members, tuple)
    return dict(zip(members, (np.asarray(numbers, dtype=np.float64) + 0.0).tolist(), strict=True))


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _read(path: Path, modality: Modality, num_pixels: int) -> bytes:
    """Read a frame's file and see that its end is there; `release verify` decodes all of it."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            "cannot read a frame's file", where=path, got=error.strerror, fix="run cosfly inspect again"
        ) from None
    is_whole = len(data) > 4 * num_pixels if modality == "depth" else PNG_END in data[-256:]
    if not is_whole:
        raise InputError("a frame's file is cut short", where=path, got=f"{len(data)} bytes", fix="render it again")
    return data
