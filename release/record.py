"""`release.json`: what a release says about itself. Written by package, checked by validate, rendered by card."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from cosfly.store import check_schema, read_json, validation_errors
from release.columns import Modality

RELEASE_SCHEMA, RELEASE_VERSION = "cosfly.release", "1.0"


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Shard(Strict):
    """One parquet file."""

    path: str
    rows: int
    bytes: int
    sha256: str


class ReleasedFlight(Strict):
    """One flight; `frames_available` is the length of the flight that was rendered."""

    flight: str
    frames: int
    frames_available: int


class Settings(Strict):
    """The settings that change what is released."""

    num_frames: int = Field(ge=1)
    tracks: list[str]
    modalities: list[Modality] = Field(min_length=1)


class ReleaseRecord(Strict):
    """The whole file. `numbers` can be computed from the shards; `history` can only add up."""

    schema_: str = Field(alias="schema")
    schema_version: str
    name: str
    licence: str
    credits: str
    made_by: str
    settings: Settings
    frame_selection: str
    coordinates: dict[str, Any]
    numbers: dict[str, Any]
    history: dict[str, dict[str, Any]]
    flights: list[ReleasedFlight]
    shards: list[Shard]


def read_record(path: Path) -> dict[str, Any]:
    """Read `release.json` as plain data of a checked shape.

    Raises:
        InputError: names the file and the field.
    """
    record = check_schema(read_json(path, what="release record"), RELEASE_SCHEMA, RELEASE_VERSION, path)
    with validation_errors(path):
        ReleaseRecord.model_validate(record)
    return record
