"""Every number of the card and of `release.json`, from the counts of the tracks; none is typed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from cosfly.geometry.coverage import Coverage
from cosfly.runtime.tables import open_table
from release.columns import CAPTION_FIELDS, COUNTED, PICTURES, VALUE_COLUMNS
from release.counting import Sum, TrackCount, total_of
from release.record import CaptionNumbers, FileNumbers, FramesBy, Numbers, Shard, Spread


def numbers_of(tracks: Sequence[TrackCount], folder: Path, shards: Sequence[Shard], num_frames: int) -> Numbers:
    """Compute every number of the card.

    Args:
        tracks: The counts of all rows. shards: Of the release in `folder`, of which the footers are read.
        num_frames: The largest number of frames per track; tracks with fewer are counted as short.
    """
    flags = total_of(tracks, "flags")
    num_rows = sum(track.frames for track in tracks)
    fovs: dict[str, set[str]] = {}  # of the tracks of each trajectory
    for track in tracks:
        fovs.setdefault(track.trajectory, set()).add(track.fov)
    fov_of = {name: min(own) if len(own) == 1 else "changing" for name, own in fovs.items()}
    return Numbers(
        frames=num_rows,
        flights=len(tracks),
        trajectories=len(fovs),
        frames_by=FramesBy(
            town=_frames_by((track.town, track.frames) for track in tracks),
            track=_frames_by((track.track, track.frames) for track in tracks),
            fov_deg=_frames_by((fov_of[track.trajectory], track.frames) for track in tracks),
            image_px=_frames_by((track.image_px, track.frames) for track in tracks),
        ),
        trajectories_by_fov_deg=_sorted(Counter(fov_of.values())),
        flights_by_track=_sorted(Counter(track.track for track in tracks)),
        frames_per_flight=spread_of(track.frames for track in tracks),
        flights_shorter_than_num_frames=sum(track.frames < num_frames for track in tracks),
        flight_duration_s=spread_of(track.duration_s for track in tracks),
        flight_length_m=spread_of(track.length_m for track in tracks if track.length_m is not None),
        height_over_target_m=_total(tracks, "height_m").spread(),
        distance_to_target_m=_total(tracks, "distance_m").spread(),
        visibility=_total(tracks, "visibility").spread(),
        frames_perturbed=flags["is_perturbed"],
        frames_target_in_view=flags["target_in_view"],
        frames_target_visible=flags["target_visible"],
        frames_target_legible=flags["target_legible"] if flags["legible_told"] == num_rows else None,
        coverage=Coverage.total(track.coverage for track in tracks),
        captions=_captions(tracks, num_rows),
        files=FileNumbers(
            shards=len(shards),
            bytes=sum(shard.bytes for shard in shards),
            bytes_points=sum(shard.points.bytes for shard in shards),
            bytes_by_modality=_stored_bytes(folder, shards),
        ),
    )


def _captions(tracks: Sequence[TrackCount], num_rows: int) -> CaptionNumbers:
    flags, values = total_of(tracks, "flags"), total_of(tracks, "values")
    means = {name: _total(tracks, name).mean for name in CAPTION_FIELDS}
    return CaptionNumbers(
        frames_with=flags["has_caption"],
        frames_without=num_rows - flags["has_caption"],
        with_label=flags["with_label"],
        decision_equals_label=flags["decision_equals_label"],
        frames_by={name: _sorted(total_of(tracks, name)) for name in COUNTED},
        values={name: values[name] for name in VALUE_COLUMNS},
        mean_characters={name: None if mean is None else round(mean, 1) for name, mean in means.items()},
        example=next((track.example for track in tracks if track.example), {}),
    )


def _total(tracks: Iterable[TrackCount], name: str) -> Sum:
    return Sum.all(track.sums[name] for track in tracks)


def spread_of(values: Iterable[float]) -> Spread:
    """Return the spread of some values."""
    return Sum.of(values).spread()


def _stored_bytes(folder: Path, shards: Iterable[Shard]) -> dict[str, int]:
    """Return the bytes of each picture column, from the footers; all other columns together as `annotations`."""
    owner = {column.name: file for file, column in PICTURES.items()}
    sizes: Counter[str] = Counter()
    for shard in shards:
        with open_table(folder / shard.path, tree=folder) as table:
            for group in range(table.num_row_groups):
                for column in range(table.metadata.num_columns):
                    chunk = table.metadata.row_group(group).column(column)
                    sizes[owner.get(chunk.path_in_schema.split(".")[0], "annotations")] += chunk.total_compressed_size
    return dict(sorted(sizes.items()))


def _frames_by(counts: Iterable[tuple[str, int]]) -> dict[str, int]:
    total = Counter[str]()
    for name, count in counts:
        total[name] += count
    return _sorted(total)


def _sorted(counts: Counter[str]) -> dict[str, int]:
    """Largest first, then by name: the order does not depend on the rows' order."""
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))
