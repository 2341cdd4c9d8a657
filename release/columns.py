"""The columns of the released parquet files, as one table.

A new column is one row of FRAME or CAPTION: its type, the values that it may hold, the field that it is taken from, and
how the card counts it. Schema, rows, card and `release verify` follow from it. Lists are flat, so that every reader of
parquet shows plain columns.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa

from cosfly.formats.captions import FIELDS, Caption, LabelFrom, Language, TeacherKind, ValueCounts, Verdict, Writing
from cosfly.formats.frames import LEAST_FOV_DEG, MOST_FOV_DEG, PERSON_ID, FrameFile
from cosfly.formats.places import sample_id
from cosfly.formats.playback import EVENTS, Track
from cosfly.formats.weather import WeatherMode, WeatherParams
from cosfly.geometry.motion import ACTION
from cosfly.runtime.config import read_yaml
from cosfly.runtime.json_io import dump_json

POSE = ("x_m", "y_m", "z_m", "pitch_deg", "yaw_deg", "roll_deg")
POINT = ("x_m", "y_m", "z_m")
INTRINSICS = ("fx", "fy", "cx", "cy")
WEATHER_PARAMS = tuple(WeatherParams.model_fields)
BOX = ("xmin_px", "ymin_px", "xmax_px", "ymax_px")
LANGUAGES: tuple[Language, ...] = get_args(Language)
LANGUAGE_NAMES: dict[Language, str] = {"en": "English", "zh": "Chinese"}
VALUES = tuple(ValueCounts.model_fields)  # values_filled, values_matched, values_contradicted
VALUE_COLUMNS = tuple(f"{name}_{language}" for language in LANGUAGES for name in VALUES)
CAPTION_FIELDS = tuple(f"caption_{language}_{name}" for language in LANGUAGES for name in FIELDS)
TARGET_PICTURE = "target_picture"
COMPANY_COLUMNS = ("others_in_view", "other_distance_m", "other_id", "alike_id", "alike_differences")  # frames.COMPANY
WINDOW, PICTURE_PX = "caption_window", "caption_picture_px"
ReleasedCaption = dict[str, Any]  # name of a column of CAPTION -> value
PLACE = ("run", "town", "trajectory", "variant")  # identifies a track
Place = tuple[str, str, str, str]
SplitName = Literal["train", "validation", "test"]
SPLIT_NAMES: tuple[SplitName, ...] = get_args(SplitName)  # as `datasets` shows them

# Axes, units and meanings, which every release states.
CONTRACT: dict[str, Any] = read_yaml(Path(__file__).with_name("coordinates.yaml"))


# --- the table --------------------------------------------------------------------------------------------------------

LISTS = {"indices": "int32", "texts": "string", "numbers": "float64"}  # types that are lists of values


@dataclass(frozen=True)
class Placement:
    """The place of a track in the release: its rows have these values in the columns of these names."""

    walk: str
    split: SplitName
    pair: str | None = None  # the name of its twin in the records, None if that is not released


@dataclass(frozen=True)
class Column:
    """One column. Its value is that of a frame or of the frame's caption, if it has one; NaN becomes null. Without
    `of_frame` and `of_caption` it is a picture, which the writer reads, or a field of Placement."""

    name: str
    # A type of `datasets.Value`, "image", "events", one of LISTS, or the members of a struct of numbers.
    type: str | tuple[str, ...]
    of_frame: Callable[[Track, int], Any] | None = None  # returns the value at frame i of a track
    of_caption: Callable[[Caption], Any] | None = None
    words: tuple[str, ...] | Literal["actions"] = ()  # allowed ones; empty: any; "actions": decisions of the release
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # of its numbers, by member ("" if none)
    required: bool = False  # null in no row; if it is of captions, in no row with a caption
    constant: bool = False  # does not change within a track
    title: str = ""  # heading in the card, which counts the captions by its values; empty: it does not

    def cell(self, track: Track, i: int, caption: ReleasedCaption | None, placement: Placement) -> Any:
        """Return the value in the row of a frame."""
        value: Any
        if self.of_caption is not None:
            value = None if caption is None else caption[self.name]
        elif self.of_frame is not None:
            value = self.of_frame(track, i)
        else:
            value = getattr(placement, self.name)
        if isinstance(self.type, tuple):
            numbers = [] if value is None else value.tolist()  # for a few numbers faster than an array
            if not numbers or any(map(math.isnan, numbers)):
                return None
            return {name: x + 0.0 for name, x in zip(self.type, numbers, strict=True)}  # + 0.0: no negative zero
        if self.type == "numbers":
            return None if np.isnan(value).any() else (value.ravel() + 0.0).tolist()
        if self.type == "float64":
            return None if value is None or math.isnan(value) else float(value)
        if self.type == "bool" and (value is not None or self.required):
            return bool(value)
        return value


def _weather_params(track: Track, i: int) -> np.ndarray | None:
    """Return WEATHER_PARAMS, (6,), None if the file of the track has none."""
    record = track.weather_record
    return None if record is None else np.array([getattr(record.params, name) for name in WEATHER_PARAMS])


def _goal(name: str, track: Track, i: int) -> Any:
    return None if track.goal is None else getattr(track.goal, name)


def _bystander_number(k: int, track: Track, i: int) -> int | None:
    """Return a whole number about the other people: column k of `bystanders`, as COMPANY_COLUMNS."""
    value = math.nan if track.bystanders is None else track.bystanders[i, k]
    return None if math.isnan(value) else int(value)


def _decision(caption: Caption) -> str | None:
    coc = caption.en or caption.zh
    return None if coc is None else coc.flight_decision


def _num_values(name: str, language: Language, caption: Caption) -> int | None:
    """Return a field of ValueCounts of the text in a language, None if its values were not counted."""
    counts = (caption.checks.values or {}).get(language)
    return None if counts is None else getattr(counts, name)


def _text(language: Language, name: str, caption: Caption) -> str | None:
    coc = caption.en if language == "en" else caption.zh
    return None if coc is None else getattr(coc, name)


def _evidence(caption: Caption) -> str:
    return dump_json(caption.evidence.model_dump(mode="json", exclude_none=True))


def _prompt(language: Language, part: str, caption: Caption) -> str | None:
    prompt = caption.prompt.get(language)
    return None if prompt is None else getattr(prompt, part)


PICTURES: dict[FrameFile, Column] = {
    "rgb": Column("image", "image"),
    "depth": Column("depth", "binary"),
    "instance": Column("instance", "image"),
}


ZERO_TO_ONE = {"": (0.0, 1.0)}
PIXELS = {"": (1, 100_000)}
FRAME = (  # everything of a frame but pictures and depth
    Column("sample_id", "string", lambda f, i: sample_id(f.flight_id, i), required=True),
    Column("run", "string", lambda f, i: f.run, required=True, constant=True),
    Column("town", "string", lambda f, i: f.town, required=True, constant=True),
    Column("trajectory", "string", lambda f, i: f.trajectory, required=True, constant=True),
    Column("variant", "string", lambda f, i: f.variant, required=True, constant=True),
    Column(
        "track", "string", lambda f, i: "clean" if f.is_original else "perturbed",
        words=("clean", "perturbed"), required=True, constant=True,
    ),
    Column("style", "string", lambda f, i: f.styles[i], required=True),
    Column("planner", "string", lambda f, i: f.planner, constant=True),
    Column("pace", "string", lambda f, i: f.pace, required=True, constant=True),
    Column("walk", "string", constant=True),
    Column("split", "string", constant=True),
    Column("pair", "string", constant=True),
    Column("people", "string", lambda f, i: dump_json(asdict(f.people)) if f.people else None, constant=True),
    Column("goal_en", "string", partial(_goal, "en"), constant=True),
    Column("goal_zh", "string", partial(_goal, "zh"), constant=True),
    Column("goal_says", "texts", lambda f, i: list(f.goal.says) if f.goal else None, constant=True),
    Column("goal_frame", "int32", partial(_goal, "frame"), constant=True),
    Column(TARGET_PICTURE, "image", lambda f, i: f.target_picture(i)),
    Column("weather", "string", lambda f, i: f.weather["weather"], constant=True),
    Column("time_of_day", "string", lambda f, i: f.weather["time_of_day"], constant=True),
    Column(
        "weather_mode", "string", lambda f, i: f.weather_record.mode if f.weather_record else None,
        words=get_args(WeatherMode), constant=True,
    ),
    Column(
        "weather_params", WEATHER_PARAMS, _weather_params, constant=True,
        ranges={
            **dict.fromkeys(("cloudiness", "precipitation", "fog_density"), (0.0, 100.0)), "fog_distance": (1e-9, 1e6),
            "sun_altitude_angle": (-90.0, 90.0), "sun_azimuth_angle": (0.0, 360.0),
        },
    ),
    Column("frame_index", "int32", lambda f, i: i, required=True),
    Column("time_s", "float64", lambda f, i: f.time_s[i], ranges={"": (0.0, 1e7)}, required=True),
    Column("width_px", "int32", lambda f, i: f.camera.width_px, ranges=PIXELS, required=True, constant=True),
    Column("height_px", "int32", lambda f, i: f.camera.height_px, ranges=PIXELS, required=True, constant=True),
    Column(
        "fov_deg", "float64", lambda f, i: round(f.camera_at(i).fov_deg, 6),
        ranges={"": (LEAST_FOV_DEG, MOST_FOV_DEG)}, required=True, constant=True,  # but of a camera that zooms
    ),
    Column(
        "intrinsics", INTRINSICS, lambda f, i: f.camera_at(i).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]], required=True,
        constant=True,
    ),
    Column(
        "pose", POSE, lambda f, i: np.concatenate([f.positions_m[i], f.rotations_deg[i]]),
        ranges={"pitch_deg": (-90.0, 90.0), "yaw_deg": (-360.0, 360.0), "roll_deg": (-180.0, 180.0)},
        required=True,
    ),
    Column("target", POINT, lambda f, i: f.targets_m[i]),
    Column("target_heading_deg", "float64", lambda f, i: f.target_headings_deg[i], ranges={"": (-360.0, 360.0)}),
    Column("target_uv", ("u_px", "v_px"), lambda f, i: f.target.uv[i]),
    Column("target_bbox", BOX, lambda f, i: f.target.bbox[i]),
    Column(
        "target_mask_bbox", BOX,
        lambda f, i: np.full(4, np.nan) if f.target.mask_bbox is None else f.target.mask_bbox[i],
    ),
    Column("target_depth_m", "float64", lambda f, i: f.target.depth_m[i]),
    Column("target_in_view", "bool", lambda f, i: f.target.in_view[i], required=True),
    Column("target_visible", "bool", lambda f, i: f.target.visible[i], required=True),
    Column("visibility", "float64", lambda f, i: f.target.visibility[i], ranges=ZERO_TO_ONE),
    Column("target_height_px", "float64", lambda f, i: f.legibility_at(i)["height_px"], ranges={"": (0.0, 100_000.0)}),
    Column("target_contrast", "float64", lambda f, i: f.legibility_at(i)["contrast"], ranges={"": (0.0, 300.0)}),
    Column("target_legible", "bool", lambda f, i: f.legibility_at(i)["legible"]),
    Column("others_in_view", "int32", partial(_bystander_number, 0)),
    Column(
        "other_distance_m", "float64", lambda f, i: None if f.bystanders is None else f.bystanders[i, 1],
        ranges={"": (0.0, 1e6)},
    ),
    Column("other_id", "int32", partial(_bystander_number, 2), ranges={"": (0, PERSON_ID)}),
    Column("alike_id", "int32", partial(_bystander_number, 3), ranges={"": (0, PERSON_ID)}),
    Column("alike_differences", "int32", partial(_bystander_number, 4)),
    Column("is_perturbed", "bool", lambda f, i: f.perturbation.is_perturbed[i], required=True),
    Column("perturbation", "events", lambda f, i: f.events(i)),
    Column(
        "drone_offset",
        POSE,
        lambda f, i: np.concatenate([f.perturbation.drone_m[i], f.perturbation.rotation_deg[i]]),
    ),
    Column("target_offset", POINT, lambda f, i: f.perturbation.target_m[i]),
    Column("action", ACTION, lambda f, i: f.motion.action[i]),
    Column("actions", "numbers", lambda f, i: f.motion.action[i]),
    Column("waypoints", "numbers", lambda f, i: f.motion.waypoints(i)),
    Column("body_waypoints", "numbers", lambda f, i: f.motion.body_waypoints(i)),
    Column("has_caption", "bool", of_caption=lambda c: True, required=True),
)  # fmt: skip
CAPTION = (  # what a row holds of an accepted caption, and nulls where there is none
    Column("decision", "string", of_caption=_decision, words="actions", required=True, title="decision"),
    Column("label", "string", of_caption=lambda c: c.label, words="actions", title="label"),
    Column(
        "label_from", "string", of_caption=lambda c: c.label_from, words=get_args(LabelFrom), required=True,
        title="label from",
    ),
    Column(
        "verdict", "string", of_caption=lambda c: c.verdict, words=get_args(Verdict), required=True,
        title="verdict against the geometry",
    ),
    Column("repair_strategy", "string", of_caption=lambda c: c.repair.strategy if c.repair else None, title="repair"),
    Column("repair_rung", "string", of_caption=lambda c: c.repair.rung if c.repair else None, title="repaired by"),
    Column(
        "teacher_kind", "string", of_caption=lambda c: c.teacher.kind, words=get_args(TeacherKind), required=True,
        title="kind of teacher",
    ),
    Column(
        "teacher_model", "string", of_caption=lambda c: published_name(c.teacher.model), required=True,
        title="teacher model",
    ),
    Column(
        "writing", "string", of_caption=lambda c: c.writing, words=get_args(Writing), required=True,
        title="written as",
    ),
    *(  # numbers with a unit, and relations that fill slots; nothing else of a text is checked
        Column(f"{name}_{language}", "int32", of_caption=partial(_num_values, name, language))
        for language in LANGUAGES for name in VALUES
    ),
    *(
        Column(
            f"caption_{language}_{name}", "string", required=True, words="actions" if name == "flight_decision" else (),
            of_caption=partial(_text, language, name),
        )
        for language in LANGUAGES for name in FIELDS
    ),
    *(
        Column(f"{name}_{language}", "string", of_caption=partial(_prompt, language, part))
        for language in LANGUAGES for name, part in (("system", "system"), ("prompt", "user"))
    ),
    Column("evidence", "string", of_caption=_evidence, required=True),
    Column(WINDOW, "indices", of_caption=lambda c: c.window, required=True),
    Column(PICTURE_PX, "indices", of_caption=lambda c: list(c.picture_px), required=True),
)  # fmt: skip
SCALARS = (*FRAME, *CAPTION)
# The table of all points of a track, also those without a picture: labels, verdicts and values of captions are
# recomputed from it. The point of a released frame has the values of the frame's row.
POINT_NAMES = (
    *PLACE, "track", "style", "walk", "split", "pair", "frame_index", "time_s", "width_px", "height_px", "fov_deg",
    "intrinsics", "pose", "target", "target_heading_deg", "target_uv", "target_bbox", "target_mask_bbox",
    "target_depth_m", "target_in_view", "target_visible", "visibility", "target_height_px", "target_contrast",
    "target_legible", *COMPANY_COLUMNS, "is_perturbed", "perturbation", "drone_offset", "target_offset",
)  # fmt: skip
POINTS = tuple(column for column in FRAME if column.name in POINT_NAMES)
SCALAR_NAMES = [column.name for column in SCALARS]
COUNTED = [column.name for column in CAPTION if column.title]
assert len(POINTS) == len(POINT_NAMES)
REQUIRED = frozenset(column.name for column in FRAME if column.required)


def caption_values(caption: Caption) -> ReleasedCaption:
    """Return what a row holds of a caption."""
    return {column.name: column.of_caption(caption) for column in SCALARS if column.of_caption is not None}


def matrices_of(intrinsics: np.ndarray) -> np.ndarray:
    """Return camera matrices, (n, 3, 3), of INTRINSICS (n, 4)."""
    matrices = np.zeros((len(intrinsics), 3, 3))
    matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] = intrinsics
    matrices[:, 2, 2] = 1.0
    return matrices


def columns_of(files: Collection[FrameFile]) -> list[Column]:
    """Return the columns in their order; of the pictures those of the wanted files."""
    return [*(column for file, column in PICTURES.items() if file in files), *SCALARS]


def schema(files: Collection[FrameFile]) -> pa.Schema:
    """Return the schema of the frames, with the features of `datasets` in its metadata."""
    return _schema(tuple(column.name for column in columns_of(files)))


def points_schema() -> pa.Schema:
    """Return the schema of the points."""
    return _schema(tuple(column.name for column in POINTS))


@cache
def _schema(names: tuple[str, ...]) -> pa.Schema:
    from datasets import Features, Image, List, Value  # it takes a second and more to import

    def feature(column_type: str | tuple[str, ...]) -> Any:
        if isinstance(column_type, tuple):
            return {member: Value("float64") for member in column_type}
        if column_type == "events":
            return {event: Value("string") for event in EVENTS}
        if column_type == "image":
            return Image()
        return List(Value(LISTS[column_type])) if column_type in LISTS else Value(column_type)

    types = {column.name: column.type for column in (*PICTURES.values(), *SCALARS)}
    return Features({name: feature(types[name]) for name in names}).arrow_schema


def scalar_row(track: Track, i: int, caption: ReleasedCaption | None, placement: Placement) -> dict[str, Any]:
    """Return the row of one frame without its pictures, right-handed axes."""
    return {column.name: column.cell(track, i, caption, placement) for column in SCALARS}


def point_row(track: Track, i: int, placement: Placement) -> dict[str, Any]:
    """Return the row of one point, right-handed axes."""
    return {column.name: column.cell(track, i, None, placement) for column in POINTS}


# --- tracks -----------------------------------------------------------------------------------------------------------


def track_name(place: Place) -> str:
    """Return the name of a track in the records."""
    return "/".join(map(str, place))


# --- published names --------------------------------------------------------------------------------------------------

ADDRESS = re.compile(r"[A-Za-z][\w+.-]*://[^\s,;'\"]*")
# A path in a text: from the root, a home or a drive. Behind letters (`and/or`) a slash begins no path.
ABSOLUTE = re.compile(r"(?<![\w.])(?:~|[A-Za-z]:)?[\\/][^\s,;'\"]*")
IS_ABSOLUTE = re.compile(r"~|[\\/]|[A-Za-z]:[\\/]")
# A text that is a path: `./a`, `a/b/c`, `a\b`; with one slash it is a name on the hub.
RELATIVE = re.compile(r"\.{1,2}[\\/]\S*|[\w.-]+(?:[\\/][\w.-]+){2,}[\\/]?|[\w.-]+\\[\w.-]+")


def published_name(text: str) -> str:
    """Return a text with each path replaced by its last name, and each URL by `an address`."""
    if IS_ABSOLUTE.match(text) or RELATIVE.fullmatch(text):
        return _last_name(text)
    text = ADDRESS.sub("an address", text)
    return ABSOLUTE.sub(lambda match: _last_name(match.group()), text)


def published(value: Any) -> Any:
    """Return settings with paths and URLs replaced as by `published_name`."""
    if isinstance(value, str):
        return published_name(value)
    if isinstance(value, dict):
        return {published_name(str(key)): published(member) for key, member in value.items()}
    return [published(member) for member in value] if isinstance(value, list | tuple) else value


def _last_name(path: str) -> str:
    """Return the last part of a path that is a name, not `..` or `~`."""
    return next((part for part in reversed(re.split(r"[\\/]", path)) if part.strip("~.")), "a path")
