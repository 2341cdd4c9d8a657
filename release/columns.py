"""The columns of the released parquet files: schema, one row per frame, and what a reader needs to decode them.

The HuggingFace key in the schema's metadata makes `datasets.load_dataset` decode `image` and `instance` as pictures. No
list stands in a row except the caption's window, picture size and states of sentences, so that every reader of parquet shows plain columns.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa

from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.captions import FIELDS, Language, SentenceState
from cosfly.products.frames import INVALID_DEPTH_M, SKY_DEPTH_M, FrameFile, Look
from cosfly.products.places import sample_id
from cosfly.products.playback import EVENTS, Flight
from cosfly.products.weather import WeatherParams

POSE = ("x_m", "y_m", "z_m", "pitch_deg", "yaw_deg", "roll_deg")
POINT = ("x_m", "y_m", "z_m")
INTRINSICS = ("fx", "fy", "cx", "cy")
LOOK = tuple(Look.model_fields)
WEATHER_PARAMS = tuple(WeatherParams.model_fields)
BOX = ("xmin_px", "ymin_px", "xmax_px", "ymax_px")
LANGUAGES: tuple[Language, ...] = get_args(Language)
CAPTION_FIELDS = tuple(f"caption_{language}_{field}" for language in LANGUAGES for field in FIELDS)
CAPTION_FACTS = (
    "decision", "label", "label_from", "verdict", "repair_strategy", "teacher_kind", "teacher_model", "writing",
)  # fmt: skip
CAPTION_SHARES = (
    "proved_en",
    "proved_zh",
)  # of the sentences, those that the geometry proves; null where none was judged

STATES: tuple[SentenceState, ...] = get_args(SentenceState)
# How many sentences the geometry proves, contradicts, leaves unread: `proved_sentences_en`; null where none was judged.
CAPTION_COUNTS = tuple(f"{state}_sentences_{language}" for language in LANGUAGES for state in STATES)
CAPTION_STATES = tuple(f"sentence_states_{language}" for language in LANGUAGES)  # of each sentence, in order
CAPTION_PROMPTS = tuple(f"{part}_{language}" for language in LANGUAGES for part in ("system", "prompt"))

WINDOW, PICTURE_PX = "caption_window", "caption_picture_px"
CAPTION_LISTS = (WINDOW, PICTURE_PX)
# What a row holds of an accepted caption, and nulls where there is none.
CAPTION_COLUMNS = (
    *CAPTION_FACTS, *CAPTION_SHARES, *CAPTION_COUNTS, *CAPTION_STATES, *CAPTION_FIELDS, *CAPTION_PROMPTS, *CAPTION_LISTS
)  # fmt: skip
ReleasedCaption = dict[str, Any]  # CAPTION_COLUMNS -> value
PLACE = ("run", "town", "trajectory", "variant")  # what a flight is told from others by
Place = tuple[str, str, str, str]
SplitName = Literal["train", "validation", "test"]
SPLIT_NAMES: tuple[SplitName, ...] = get_args(SplitName)  # as `datasets` shows them

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
    "target": "hip of the tracked person; target_heading_deg, whither it walks, as yaw; null before its first step",
    "offsets": "the perturbation of the frame, already contained in pose and target; where a position was shifted the camera "
    "was aimed anew, and the rotation offset is its turn away from that aim",
    "perturbation": "what became of the frame's two events, position (shift of drone and person) and rotation (turn of the view): none, applied, "
    "or `fallback: ` and why the frame is as planned; null where the tree does not say",
    "time": "seconds; the frames of a flight are one time step apart, 0.5 s in the paper",
}


# --- the table --------------------------------------------------------------------------------------------------------

# type -> what it is in parquet, and for `datasets`; a tuple names the members of a struct of float64
TYPES: dict[str, tuple[pa.DataType, dict[str, Any]]] = {
    **{
        name: (pa.type_for_alias(name), {"dtype": name, "_type": "Value"})
        for name in ("string", "int32", "float64", "bool", "binary")
    },
    "events": (
        pa.struct([(event, pa.string()) for event in EVENTS]),
        {event: {"dtype": "string", "_type": "Value"} for event in EVENTS},
    ),
    "image": (pa.struct([("bytes", pa.binary()), ("path", pa.string())]), {"_type": "Image"}),
    # `element` is parquet's own name. `Sequence` is what `datasets` before version 4 calls a list; later versions still read it.
    "indices": (
        pa.list_(pa.field("element", pa.int32())),
        {"feature": {"dtype": "int32", "_type": "Value"}, "_type": "Sequence"},
    ),
    "texts": (
        pa.list_(pa.field("element", pa.string())),
        {"feature": {"dtype": "string", "_type": "Value"}, "_type": "Sequence"},
    ),
}


@dataclass(frozen=True)
class Placed:
    """What the rows of a flight say of its place in the release: the columns of these names.

    pair: the name of its twin in the records, None where that is not released. look: (4,) sun and air (LOOK), None where nobody says.
    """

    walk: str
    split: SplitName
    pair: str | None = None
    look: np.ndarray | None = None


Value = Callable[[Flight, int, ReleasedCaption | None], Any]


@dataclass(frozen=True)
class Column:
    """One column: its type (of TYPES, or the members of a struct) and its value at frame i of a flight; NaN becomes null.

    value: None for a picture, whose bytes the writer has, and for what Placed says.
    """

    name: str
    type: str | tuple[str, ...]
    value: Value | None = None

    def cell(self, flight: Flight, i: int, caption: ReleasedCaption | None, placed: Placed) -> Any:
        value = getattr(placed, self.name) if self.value is None else self.value(flight, i, caption)
        if isinstance(self.type, tuple):  # of few numbers Python's own are faster than an array
            numbers = [] if value is None else value.tolist()
            is_null = not numbers or any(map(math.isnan, numbers))
            return None if is_null else {name: x + 0.0 for name, x in zip(self.type, numbers, strict=True)}  # no -0.0
        if self.type == "float64":
            return None if value is None or math.isnan(value) else float(value)
        return bool(value) if self.type == "bool" else value


def _knobs(flight: Flight) -> np.ndarray | None:
    """The six knobs of weather, (6,), None where the file has none."""
    record = flight.weather_record
    return None if record is None else np.array([getattr(record.params, name) for name in WEATHER_PARAMS])


def _said(name: str, kind: str = "string") -> Column:
    return Column(name, kind, lambda _, __, caption: caption and caption[name])


PICTURES: dict[FrameFile, Column] = {
    "rgb": Column("image", "image"),
    "depth": Column("depth", "binary"),
    "instance": Column("instance", "image"),
}


SCALARS = (  # everything but pictures and depth
    Column("sample_id", "string", lambda f, i, _: sample_id(f.flight_id, i)),
    Column("run", "string", lambda f, i, _: f.run),
    Column("town", "string", lambda f, i, _: f.town),
    Column("trajectory", "string", lambda f, i, _: f.trajectory),
    Column("variant", "string", lambda f, i, _: f.variant),
    Column("track", "string", lambda f, i, _: "clean" if f.is_original else "perturbed"),
    Column("style", "string", lambda f, i, _: f.styles[i]),
    Column("pace", "string", lambda f, i, _: f.pace),
    Column("walk", "string"),
    Column("split", "string"),
    Column("pair", "string"),
    Column("weather", "string", lambda f, i, _: f.weather["weather"]),
    Column("time_of_day", "string", lambda f, i, _: f.weather["time_of_day"]),
    Column("weather_mode", "string", lambda f, i, _: f.weather_record and f.weather_record.mode),
    Column("weather_params", WEATHER_PARAMS, lambda f, i, _: _knobs(f)),
    Column("look", LOOK),
    Column("frame_index", "int32", lambda f, i, _: i),
    Column("time_s", "float64", lambda f, i, _: f.time_s[i]),
    Column("width_px", "int32", lambda f, i, _: f.camera.width_px),
    Column("height_px", "int32", lambda f, i, _: f.camera.height_px),
    Column("fov_deg", "float64", lambda f, i, _: round(f.camera_at(i).fov_deg, 6)),
    Column("intrinsics", INTRINSICS, lambda f, i, _: f.camera_at(i).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]]),
    Column("pose", POSE, lambda f, i, _: np.concatenate([f.positions_m[i], f.rotations_deg[i]])),
    Column("target", POINT, lambda f, i, _: f.targets_m[i]),
    Column("target_heading_deg", "float64", lambda f, i, _: f.target_headings_deg[i]),
    Column("target_uv", ("u_px", "v_px"), lambda f, i, _: f.target_uv[i]),
    Column("target_bbox", BOX, lambda f, i, _: f.target_bbox[i]),
    Column(
        "target_mask_bbox",
        BOX,
        lambda f, i, _: np.full(4, np.nan) if f.target_mask_bbox is None else f.target_mask_bbox[i],
    ),
    Column("target_depth_m", "float64", lambda f, i, _: f.target_depth_m[i]),
    Column("target_in_view", "bool", lambda f, i, _: f.target_in_view[i]),
    Column("target_visible", "bool", lambda f, i, _: f.target_visible[i]),
    Column("visibility", "float64", lambda f, i, _: f.visibility[i]),
    Column("is_perturbed", "bool", lambda f, i, _: f.is_perturbed[i]),
    Column("perturbation", "events", lambda f, i, _: f.events(i)),
    Column("drone_offset", POSE, lambda f, i, _: np.concatenate([f.drone_offsets_m[i], f.rotation_offsets_deg[i]])),
    Column("target_offset", POINT, lambda f, i, _: f.target_offsets_m[i]),
    Column("has_caption", "bool", lambda f, i, caption: caption is not None),
    *map(_said, CAPTION_FACTS),
    *(_said(name, "float64") for name in CAPTION_SHARES),
    *(_said(name, "int32") for name in CAPTION_COUNTS),
    *(_said(name, "texts") for name in CAPTION_STATES),
    *map(_said, CAPTION_FIELDS),
    *map(_said, CAPTION_PROMPTS),
    *(_said(name, "indices") for name in CAPTION_LISTS),
)
SCALAR_NAMES = [column.name for column in SCALARS]


def matrices_of(intrinsics: np.ndarray) -> np.ndarray:
    """Give camera matrices, (n, 3, 3), of INTRINSICS (n, 4)."""
    matrices = np.zeros((len(intrinsics), 3, 3))
    matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] = intrinsics
    matrices[:, 2, 2] = 1.0
    return matrices


def columns_of(files: Collection[FrameFile]) -> list[Column]:
    """Give the columns in their order; of the pictures those of the wanted files."""
    return [*(column for file, column in PICTURES.items() if file in files), *SCALARS]


def schema(files: Collection[FrameFile]) -> pa.Schema:
    """Give the parquet schema, features for HuggingFace `datasets` in its metadata."""
    fields: list[pa.Field] = []
    features: dict[str, Any] = {}
    for column in columns_of(files):
        if isinstance(column.type, tuple):
            kind = pa.struct([(member, pa.float64()) for member in column.type])
            features[column.name] = {member: {"dtype": "float64", "_type": "Value"} for member in column.type}
        else:
            kind, features[column.name] = TYPES[column.type]
        fields.append(pa.field(column.name, kind))
    return pa.schema(fields, {b"huggingface": json.dumps({"info": {"features": features}}).encode()})


def scalar_row(flight: Flight, i: int, caption: ReleasedCaption | None, placed: Placed) -> dict[str, Any]:
    """Give the row of one frame without its pictures, right-handed axes."""
    return {column.name: column.cell(flight, i, caption, placed) for column in SCALARS}


def picture_bytes(row: Mapping[str, Any], file: FrameFile) -> bytes:
    """Give the bytes of a picture in a row."""
    value = row[PICTURES[file].name]
    return value if file == "depth" else value["bytes"]


# --- flights ----------------------------------------------------------------------------------------------------------


def flight_spans(rows: pa.Table) -> list[tuple[Place, int, int]]:
    """Give the rows that stand together by flight: its PLACE, its first row, and the one after its last."""
    places: list[Place] = list(zip(*(rows.column(name).to_pylist() for name in PLACE), strict=True))
    begins = [i for i in range(len(places)) if i == 0 or places[i] != places[i - 1]]
    return [(places[begin], begin, end) for begin, end in zip(begins, [*begins[1:], len(places)], strict=True)]


def flight_name(place: Place) -> str:
    """Give the name of a flight in the records."""
    return "/".join(map(str, place))
