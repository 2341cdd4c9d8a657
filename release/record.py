"""`release.json`: the record of a release. Written by build, checked by verify, rendered by card.

In its fields a flight is a track, `run/town/trajectory/variant`, a walk a pedestrian trajectory, and a pair the clean
and the perturbed track of a drone trajectory.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M, FrameFile
from cosfly.formats.inspection import TrajectoryFunnel
from cosfly.formats.town import TownMap
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import FileFormat, read_model, write_model
from release.columns import SPLIT_NAMES, SplitName

RELEASE_FORMAT = FileFormat("cosfly.release", "7.0", "release record")
RECORD = "release.json"

DIGEST_CHARACTERS = 12  # of the content's digest, in the names of shards
FRAMES_FOLDER, POINTS_FOLDER = "data", "points"  # of the shards

Counts = dict[str, int]  # value -> how often it occurs
SplitBy = Literal["walk", "town"]
Pairs = Literal["both", "any"]
Selection = Literal["stride", "windows", "all"]


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class StoredFile(Strict):
    """One parquet file."""

    path: str
    rows: int
    bytes: int
    sha256: str


class Shard(StoredFile):
    """The released frames of some tracks of one split."""

    split: SplitName
    points: StoredFile  # all points of these tracks, in the same order


class ReleasedFlight(Strict):
    """One track."""

    flight: str  # run/town/trajectory/variant
    frames: int  # released ones
    frames_available: int  # number of its points
    split: SplitName
    walk: str
    pair: str | None  # the other track of the same trajectory, null if that is not released
    # Share of five rays that reach the person, as the inspection measured it on the map; null without an inspection.
    five_ray_mean: float | None = None

    @property
    def town(self) -> str:
        """The town of the track, "" if the record has a flight without one."""
        return f"{self.flight}//".split("/")[1]

    @property
    def trajectory(self) -> str:
        """What it shares with its twin: run/town/trajectory."""
        return self.flight.rpartition("/")[0]


class ReleasedMap(TownMap):
    """The map of one town of the tree."""

    town: str


class Settings(Strict):
    """The settings that change what is released."""

    selection: Selection
    num_frames: int = Field(ge=1)  # the most of each track; not used with selection `all`
    window_frames: int = Field(ge=1)  # of a caption's window
    tracks: list[str]
    pairs: Pairs
    modalities: list[FrameFile] = Field(min_length=1)


class StoredDepth(Strict):
    """How `depth` is stored: float32, without loss."""

    coding: Literal["float32"] = "float32"
    unit: Literal["metre"] = "metre"
    sky: float = SKY_DEPTH_M
    invalid: float = INVALID_DEPTH_M


class SplitNumbers(Strict):
    """One split."""

    frames: int
    captions: int
    flights: int
    trajectories: int
    walks: list[str]  # names
    towns: list[str]


class Splits(Strict):
    """How the splits were assigned, and what they contain."""

    by: SplitBy  # what two splits may not share
    rule: str  # in words
    seed: int
    fractions: dict[SplitName, float]
    splits: dict[SplitName, SplitNumbers]  # without those that have no rows


class SourceStage(Strict):
    """One stage that made a source: its settings, without paths and addresses, seed and version."""

    stage: str
    code_version: str
    seed: int
    config: dict[str, Any]


class SourceRecord(Strict):
    """One source of the release: fingerprints of its files, null if there is none, and the stages that made them."""

    run: str
    data_sha256: str  # of the playback tree
    captions_sha256: str
    inspect_sha256: str | None = None  # of the inspection
    review_sha256: str | None = None  # of what people decided about the tracks to review
    stages: list[SourceStage]


class ReleasedTeacher(Strict):
    """A teacher of the captions that were read, of which not all are released."""

    kind: str
    model: str
    settings: dict[str, Any]
    captions: int  # number of its captions


class Provenance(Strict):
    """Where it all comes from: versions of what built it, its sources and teachers, and the tokens of all asks."""

    versions: dict[str, str]
    sources: list[SourceRecord]
    teachers: list[ReleasedTeacher]
    tokens: Counts
    asks: int


class Spread(Strict):
    """The distribution of some values."""

    count: int = 0
    mean: float | None = None
    std: float | None = None  # standard deviation of the population
    min: float | None = None
    max: float | None = None


class Numbers(Strict):
    """Every number of the card and the statistics; all are computed from the shards (release/counting.py)."""

    frames: int
    flights: int
    trajectories: int
    flights_shorter_than_num_frames: int
    counts: dict[str, Counts]  # what is counted -> frames by its value, as {"decision": {"hover": 12}}
    spreads: dict[str, Spread]  # of frames, tracks and trajectories, as {"distance_m": {"mean": 14.2}}
    example: dict[str, str | None]  # the first caption's sample_id and texts, empty without captions

    def of(self, name: str) -> Counter[str]:
        """Return the counts of a name."""
        return Counter(self.counts.get(name, {}))


class FlightHistory(Strict):
    """Tracks: found = released + left_out."""

    found: int
    inspected: int  # those of trees with an inspection
    released: int
    left_out: Counts  # by reason


class CaptionHistory(Strict):
    """Captions: read = dropped + released + frame_not_selected + flight_left_out."""

    read: int
    dropped: Counts  # by reason
    released: int
    frame_not_selected: int
    flight_left_out: int
    frames_without: Counts  # released frames without a caption, by reason


class History(Strict):
    """What became of all tracks and captions, which the shards do not show."""

    trajectories: TrajectoryFunnel | None  # of the sources with an inspection, null if none has one
    flights: FlightHistory
    captions: CaptionHistory


class ReleaseRecord(Strict):
    """The whole file."""

    name: str
    licence: str
    credits: str  # attribution, besides that of the maps
    maps: list[ReleasedMap]
    made_by: str  # name and version of the program
    settings: Settings
    frame_selection: str  # the rule, in words
    depth: StoredDepth | None  # null: without depth
    coordinates: dict[str, Any]  # axes, units and meanings
    splits: Splits
    numbers: Numbers
    history: History
    provenance: Provenance
    flights: list[ReleasedFlight]
    content_digest: str  # `digest_of` the shards
    shards: list[Shard]

    @property
    def files(self) -> list[StoredFile]:
        """All parquet files."""
        return [*self.shards, *(shard.points for shard in self.shards)]

    def require_whole_tracks(self, what: str, where: Path) -> None:
        """Raise InputError if consecutive frames are needed and a uniform stride has skipped some."""
        is_cut = any(track.frames < track.frames_available for track in self.flights)
        if self.settings.selection == "stride" and is_cut:
            raise InputError(
                f"{what} needs consecutive frames, which this release does not have", where=where,
                got=f"{self.settings.num_frames} frames of each track, chosen with a stride",
                fix="build another release of the run with --set release.selection=windows",
            )  # fmt: skip


def numbers_of_splits(
    tracks: Sequence[ReleasedFlight], captions: Mapping[SplitName, int]
) -> dict[SplitName, SplitNumbers]:
    """Return the numbers of each split that has tracks, given the number of captions of each split."""
    numbers = {}
    for split in SPLIT_NAMES:
        if in_split := [track for track in tracks if track.split == split]:
            numbers[split] = SplitNumbers(
                frames=sum(track.frames for track in in_split), captions=captions.get(split, 0), flights=len(in_split),
                trajectories=len({track.trajectory for track in in_split}),
                walks=sorted({track.walk for track in in_split}), towns=sorted({track.town for track in in_split}),
            )  # fmt: skip
    return numbers


# --- files of a release -----------------------------------------------------------------------------------------------


def digest_of(shards: Iterable[Shard]) -> str:
    """Return the sha256 of a release's content: of split and sha256 (frames, points) of each shard in order."""
    lines = [f"{shard.split} {shard.sha256} {shard.points.sha256}\n" for shard in shards]
    return sha256_bytes("".join(lines).encode())


def shard_paths(splits: Sequence[SplitName], digest: str) -> list[tuple[str, str]]:
    """Return the paths of frames and points of each shard, given the split of each. Shards of a split are numbered:
    `data/train-0123456789ab-00001-of-00003.parquet`."""
    counts = Counter(splits)
    next_number = Counter[str]()
    paths: list[tuple[str, str]] = []
    for split in splits:
        name = f"{split}-{digest[:DIGEST_CHARACTERS]}-{next_number[split]:05d}-of-{counts[split]:05d}.parquet"
        paths.append((f"{FRAMES_FOLDER}/{name}", f"{POINTS_FOLDER}/{name}"))
        next_number[split] += 1
    return paths


def shard_pattern(split: SplitName, digest: str, folder: str = FRAMES_FOLDER) -> str:
    """Return the pattern of a split's files, which the card names. `datasets` uses it as the key of its cache: without
    the digest a new release would show old rows."""
    return f"{folder}/{split}-{digest[:DIGEST_CHARACTERS]}-*.parquet"


def release_folder(folder: Path) -> Path:
    """Return the folder that holds the files of a release: this one, or the one below it where `release build` or
    `cosfly run` puts them; if there is none, this one, so that its reader reports the error."""
    candidates = (folder, folder / "dataset", folder / "release/dataset")
    return next((candidate for candidate in candidates if (candidate / RECORD).is_file()), folder)


def write_record(path: Path, record: ReleaseRecord) -> None:
    write_model(path, record, RELEASE_FORMAT)


def read_record(path: Path) -> ReleaseRecord:
    """Read `release.json`; InputError if there is none, or names the field that is wrong."""
    if not path.exists():
        raise InputError(
            "the folder is not a release", where=path, expected="the folder of a release, or of a run with a release",
            fix="correct the path, or build a release with cosfly release build",
        )  # fmt: skip
    return read_model(path, ReleaseRecord, RELEASE_FORMAT, tree=path.parent)
