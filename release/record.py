"""`release.json`: what a release says about itself. Written by package, checked by validate, rendered by card."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from cosfly.products.coverage import Coverage
from cosfly.products.frames import FrameFile
from cosfly.products.inspection import TrajectoryFunnel
from cosfly.products.town import TownMap
from cosfly.reading.documents import read_model
from cosfly.store import write_model

RELEASE_SCHEMA, RELEASE_VERSION = "cosfly.release", "2.0"

Counts = dict[str, int]


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Shard(Strict):
    """One parquet file."""

    path: str
    rows: int
    bytes: int
    sha256: str


class ReleasedFlight(Strict):
    """One flight, `run/town/trajectory/variant`; `frames_available` is the length of the flight that was rendered."""

    flight: str
    frames: int
    frames_available: int


class ReleasedMap(TownMap):
    """The map of one town of the tree."""

    town: str


class Settings(Strict):
    """The settings that change what is released."""

    num_frames: int = Field(ge=1)
    tracks: list[str]
    modalities: list[FrameFile] = Field(min_length=1)


class Spread(Strict):
    """Mean, standard deviation (of the population), least, greatest and number of values."""

    count: int
    mean: float | None
    std: float | None
    min: float | None
    max: float | None


class CaptionNumbers(Strict):
    """Frames by what their captions say; mean_proved: of their sentences the share that the geometry proves, where any was judged;
    `example` is the first one's sample_id and texts, empty without any."""

    frames_with: int
    frames_without: int
    with_label: int
    decision_equals_label: int
    decision: Counts
    label: Counts
    label_from: Counts
    verdict: Counts
    repair_strategy: Counts
    teacher_kind: Counts
    teacher_model: Counts
    writing: Counts
    mean_proved: dict[str, float | None]
    mean_characters: dict[str, float | None]
    example: dict[str, str]


class FileNumbers(Strict):
    shards: int
    bytes: int
    bytes_by_modality: Counts


class FramesBy(Strict):
    town: Counts
    track: Counts
    fov_deg: Counts
    image_px: Counts


class Numbers(Strict):
    """Every number of the card; all can be computed from the shards."""

    frames: int
    flights: int
    trajectories: int
    frames_by: FramesBy
    trajectories_by_fov_deg: Counts
    flights_by_track: Counts
    frames_per_flight: Spread
    flights_shorter_than_num_frames: int
    flight_duration_s: Spread
    flight_length_m: Spread
    height_over_target_m: Spread
    distance_to_target_m: Spread
    visibility: Spread
    frames_perturbed: int
    frames_target_in_view: int
    frames_target_visible: int
    coverage: Coverage
    captions: CaptionNumbers
    files: FileNumbers


class FlightHistory(Strict):
    """inspected = released + left_out, by reason."""

    inspected: int
    released: int
    left_out: Counts


class CaptionHistory(Strict):
    """read = accepted + dropped, by reason; accepted = released + frame_not_selected + flight_left_out."""

    read: int
    dropped: Counts
    accepted: int
    released: int
    frame_not_selected: int
    flight_left_out: int


class History(Strict):
    """What the shards cannot tell: where all flights and captions went. It can only add up."""

    trajectories: TrajectoryFunnel
    flights: FlightHistory
    captions: CaptionHistory


class ReleaseRecord(Strict):
    """The whole file."""

    name: str
    licence: str
    credits: str
    maps: list[ReleasedMap] = []  # older releases name theirs in `credits`
    made_by: str
    settings: Settings
    frame_selection: str
    coordinates: dict[str, Any]
    numbers: Numbers
    history: History
    flights: list[ReleasedFlight]
    shards: list[Shard]


def write_record(path: Path, record: ReleaseRecord) -> None:
    write_model(path, record, schema=RELEASE_SCHEMA, version=RELEASE_VERSION)


def read_record(path: Path) -> ReleaseRecord:
    """Read `release.json`.

    Raises:
        InputError: names the file and the field.
    """
    return read_model(
        path, ReleaseRecord, schema=RELEASE_SCHEMA, version=RELEASE_VERSION, what="release record", tree=path.parent
    )
