"""`release.json`: the record of a release. Written by build, checked by verify, rendered by card."""

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

Counts = dict[str, int]
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
    """The released frames of some tracks of one split; `points` has all points of these tracks, in the same order."""

    split: SplitName
    points: StoredFile


class ReleasedFlight(Strict):
    """One track, `run/town/trajectory/variant`; `frames_available` is the number of its points.

    pair: the other track of the same trajectory, null where that is not released. five_ray_mean: share of five
    rays that reach the person, as the inspection measured it on the map, which the shards do not hold; null where
    nobody did.
    """

    flight: str
    frames: int
    frames_available: int
    split: SplitName
    walk: str
    pair: str | None
    five_ray_mean: float | None = None

    @property
    def town(self) -> str:
        return f"{self.flight}//".split("/")[1]

    @property
    def trajectory(self) -> str:
        """What it shares with its twin: run/town/trajectory."""
        return self.flight.rpartition("/")[0]


class ReleasedMap(TownMap):
    """The map of one town of the tree."""

    town: str


class Settings(Strict):
    """The settings that change what is released. num_frames: Largest number of each track, except of the selection
    `all`. window_frames: Of a caption's window."""

    selection: Selection
    num_frames: int = Field(ge=1)
    window_frames: int = Field(ge=1)
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
    """One split; walks and towns by name."""

    frames: int
    captions: int
    flights: int
    trajectories: int
    walks: list[str]
    towns: list[str]


class Splits(Strict):
    """What two splits may not share, the rule, and the splits; those without rows are skipped."""

    by: SplitBy
    rule: str
    seed: int
    fractions: dict[SplitName, float]
    splits: dict[SplitName, SplitNumbers]


class MadeBy(Strict):
    """One stage of one source: its settings, seed and version. Paths and addresses are skipped."""

    stage: str
    code_version: str
    seed: int
    config: dict[str, Any]


class SourceRecord(Strict):
    """One source of the release: fingerprints of its tree, captions, inspection and what people decided of that (null:
    without), and the stages that made them."""

    run: str
    data_sha256: str
    captions_sha256: str
    inspect_sha256: str | None = None
    review_sha256: str | None = None
    stages: list[MadeBy]


class ReleasedTeacher(Strict):
    """Who was asked, and how: of all captions that were read, the released ones and the others."""

    kind: str
    model: str
    settings: dict[str, Any]
    captions: int


class Provenance(Strict):
    """Where it all comes from: versions of what built it, its sources and teachers, and the tokens of all asks."""

    versions: dict[str, str]
    sources: list[SourceRecord]
    teachers: list[ReleasedTeacher]
    tokens: Counts
    asks: int


class Spread(Strict):
    """Mean, standard deviation (of the population), least, greatest and number of values."""

    count: int = 0
    mean: float | None = None
    std: float | None = None
    min: float | None = None
    max: float | None = None


class Numbers(Strict):
    """Every number of the card and the statistics; all are computed from the shards (release/counting.py).

    counts: Frames by a value of what the key names. spreads: Of frames, tracks and trajectories. example: The first
    caption's sample_id and texts, empty without captions.
    """

    frames: int
    flights: int
    trajectories: int
    flights_shorter_than_num_frames: int
    counts: dict[str, Counts]
    spreads: dict[str, Spread]
    example: dict[str, str | None]

    def of(self, name: str) -> Counter[str]:
        """Return the counts of a name."""
        return Counter(self.counts.get(name, {}))


class FlightHistory(Strict):
    """found = released + left_out, by reason; those of trees without an inspection were not inspected."""

    found: int
    inspected: int
    released: int
    left_out: Counts


class CaptionHistory(Strict):
    """read = dropped, by reason, + released + frame_not_selected + flight_left_out.

    frames_without: The released frames without a caption, by reason.
    """

    read: int
    dropped: Counts
    released: int
    frame_not_selected: int
    flight_left_out: int
    frames_without: Counts


class History(Strict):
    """What the shards do not show: what became of all tracks and captions.

    trajectories: of the sources that were inspected; null where none was.
    """

    trajectories: TrajectoryFunnel | None
    flights: FlightHistory
    captions: CaptionHistory


class ReleaseRecord(Strict):
    """The whole file."""

    name: str
    licence: str
    credits: str
    maps: list[ReleasedMap]
    made_by: str
    settings: Settings
    frame_selection: str
    depth: StoredDepth | None  # null: without depth
    coordinates: dict[str, Any]
    splits: Splits
    numbers: Numbers
    history: History
    provenance: Provenance
    flights: list[ReleasedFlight]
    content_digest: str
    shards: list[Shard]

    @property
    def files(self) -> list[StoredFile]:
        """All parquet files."""
        return [*self.shards, *(shard.points for shard in self.shards)]

    def require_whole_tracks(self, what: str, where: Path) -> None:
        """Raise InputError if consecutive frames are needed and a uniform stride has skipped some."""
        if self.settings.selection == "stride" and any(one.frames < one.frames_available for one in self.flights):
            raise InputError(
                f"{what} needs consecutive frames, which this release does not have", where=where,
                got=f"{self.settings.num_frames} frames of each track, chosen with a stride",
                fix="build another release of the run with --set release.selection=windows",
            )  # fmt: skip


def numbers_of_splits(
    tracks: Sequence[ReleasedFlight], captions: Mapping[SplitName, int]
) -> dict[SplitName, SplitNumbers]:
    """Return the numbers of each split that has tracks. captions: of each split."""
    found = {}
    for split in SPLIT_NAMES:
        if own := [track for track in tracks if track.split == split]:
            found[split] = SplitNumbers(
                frames=sum(track.frames for track in own),
                captions=captions.get(split, 0),
                flights=len(own),
                trajectories=len({track.trajectory for track in own}),
                walks=sorted({track.walk for track in own}),
                towns=sorted({track.town for track in own}),
            )
    return found


DIGEST_CHARACTERS = 12  # of the content's digest, in the names of shards


def digest_of(shards: Iterable[Shard]) -> str:
    """Return the sha256 of a release's content: of split and sha256 (frames, points) of each shard in order."""
    return sha256_bytes("".join(f"{one.split} {one.sha256} {one.points.sha256}\n" for one in shards).encode())


FRAMES_FOLDER, POINTS_FOLDER = "data", "points"


def shard_paths(splits: Sequence[SplitName], digest: str) -> list[tuple[str, str]]:
    """Return the paths of frames and points of each shard, given its split: it has its number in its split."""
    counts, numbers, paths = Counter(splits), Counter[str](), list[tuple[str, str]]()
    for split in splits:
        name = f"{split}-{digest[:DIGEST_CHARACTERS]}-{numbers[split]:05d}-of-{counts[split]:05d}.parquet"
        paths.append((f"{FRAMES_FOLDER}/{name}", f"{POINTS_FOLDER}/{name}"))
        numbers[split] += 1
    return paths


def shard_pattern(split: SplitName, digest: str, folder: str = FRAMES_FOLDER) -> str:
    """Return the pattern that the card names for a split. The library's cache goes by it: without the digest a new
    release shows old rows."""
    return f"{folder}/{split}-{digest[:DIGEST_CHARACTERS]}-*.parquet"


def release_folder(folder: Path) -> Path:
    """Return the folder that holds the files of a release: this one, or where `release build` and `cosfly run` put them
    below it.

    A folder that holds none is given as it is, for its reader to say so.
    """
    places = (folder, folder / "dataset", folder / "release/dataset")
    return next((place for place in places if (place / RECORD).is_file()), folder)


def write_record(path: Path, record: ReleaseRecord) -> None:
    write_model(path, record, RELEASE_FORMAT)


def read_record(path: Path) -> ReleaseRecord:
    """Read `release.json`.

    Raises:
        InputError: there is none; or names the file and the field.
    """
    if not path.exists():
        raise InputError(
            "the folder is not a release", where=path, expected="the folder of a release, or of a run with a release",
            fix="correct the path, or build a release with cosfly release build",
        )  # fmt: skip
    return read_model(path, ReleaseRecord, RELEASE_FORMAT, tree=path.parent)
