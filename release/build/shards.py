"""One shard: the frames of some tracks, read once, compared with their digests and written as parquet.

A worker writes whole shards, so that no byte is written twice.
"""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel

from cosfly.formats.frames import (
    FILE_NAMES,
    FRAMES_DIR,
    SKY_DEPTH_M,
    FrameFile,
    as_depth_npy,
    depth_values,
    frame_name,
    frame_path,
    tree_of,
)
from cosfly.formats.playback import TARGET_FILE, Track
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import CHECKSUMS, atomic_file, check_stays_below, read_bytes, read_checksums, sha256_file
from cosfly.runtime.png import colours_of, png_size
from cosfly.runtime.run_dir import TRACK_FILE, digest_of, folder_digests
from cosfly.runtime.worker import advance
from release import columns
from release.build.plan import Chosen, open_track
from release.build.sources import Candidate
from release.columns import PICTURES, caption_values
from release.record import StoredFile

# Values between two looks at the size of a page: with more a page takes a whole row group, twice in memory.
VALUES_PER_BATCH = 4
MOST_ROWS = 1000  # of a row group: of small pictures it would hold more rows than memory should
RENDER = "render the track again, or restore the file"
RESTORE = "restore the file, or inspect and caption the changed tree"


class ShardResult(BaseModel):
    """A shard that is written: its frames and points, whose paths are those of the parts."""

    frames: StoredFile
    points: StoredFile


def write_shard(
    path: Path, tracks: Sequence[Chosen], files: Collection[FrameFile], row_group_bytes: int
) -> ShardResult:
    """Write the selected frames of some tracks, and all of their points, a row group each; InputError or VerifyError
    names the first file that cannot be released."""
    points_path, schema = points_part(path), columns.points_schema()
    with (
        atomic_file(points_path) as points_file,
        atomic_file(path) as file,
        pq.ParquetWriter(points_file, schema, compression="zstd", version="2.6", write_page_index=True) as points,
        open_writer(file, columns.schema(files)) as writer,
    ):
        frames = _RowGroups(writer, row_group_bytes)
        for chosen in tracks:
            track = open_track(chosen.candidate)
            _write_frames(chosen, track, files, frames)
            rows = [columns.point_row(track, i, chosen.placement) for i in range(len(track))]
            points.write_table(pa.Table.from_pylist(rows, schema=schema))
        frames.flush()
    num_frames, num_points = sum(len(track.selected) for track in tracks), sum(track.num_frames for track in tracks)
    return ShardResult(frames=_stored(path, num_frames), points=_stored(points_path, num_points))


def points_part(path: Path) -> Path:
    """Return the file of a shard's points, given that of its frames, while the release is being built."""
    return path.with_suffix(".points.parquet")


def _stored(path: Path, rows: int) -> StoredFile:
    return StoredFile(path=path.name, rows=rows, bytes=path.stat().st_size, sha256=sha256_file(path))


# --- rows -------------------------------------------------------------------------------------------------------------


class _RowGroups:
    """Collects rows into row groups of a size that viewers load one at a time, and writes them."""

    def __init__(self, writer: pq.ParquetWriter, row_group_bytes: int) -> None:
        self._writer = writer
        self._most_bytes = row_group_bytes
        self._rows: list[dict[str, Any]] = []
        self._num_bytes = 0

    def add(self, row: dict[str, Any], num_bytes: int) -> None:
        """Add a frame, whose pictures have so many bytes."""
        self._rows.append(row)
        self._num_bytes += num_bytes
        if self._num_bytes >= self._most_bytes or len(self._rows) >= MOST_ROWS:
            self.flush()

    def flush(self) -> None:
        if self._rows:
            table = pa.Table.from_pylist(self._rows, schema=self._writer.schema)
            self._writer.write_table(table, row_group_size=table.num_rows)
            self._rows, self._num_bytes = [], 0


def open_writer(sink: str | IO[bytes], schema: pa.Schema) -> pq.ParquetWriter:
    """Open a parquet file whose bytes depend on the rows alone.

    PNG files do not compress, so they are stored as they are; everything else is zstd. Statistics of pictures would
    only repeat their first bytes. The page index lets the hub's viewer read one row without its row group.
    """
    leaves: list[str] = []  # parquet's paths of the primitive columns
    for field in schema:
        if pa.types.is_struct(field.type):
            leaves += [f"{field.name}.{member.name}" for member in field.type]
        elif pa.types.is_list(field.type):
            leaves.append(f"{field.name}.list.element")
        else:
            leaves.append(field.name)
    compression = {name: "none" if name.endswith(".bytes") else "zstd" for name in leaves}
    small = [name for name in leaves if name != PICTURES["depth"].name and not name.endswith(".bytes")]
    repeated = [name for name in small if name in schema.names and schema.field(name).type == pa.string()]
    return pq.ParquetWriter(
        sink, schema, compression=compression, use_dictionary=repeated, write_statistics=small, version="2.6",
        write_page_index=True, write_batch_size=VALUES_PER_BATCH,
    )  # fmt: skip


def _write_frames(chosen: Chosen, track: Track, files: Collection[FrameFile], frames: _RowGroups) -> None:
    """Write the rows of the selected frames of a track, with their checked pictures and captions."""
    folder = chosen.candidate.folder
    digests = _digests(chosen.candidate)
    tree = tree_of(track.frame_folder(0))
    check_stays_below(folder / FRAMES_DIR, tree)
    for i in chosen.selected:
        frame = track.frame_folder(i)
        if frame.is_symlink():
            check_stays_below(frame, tree)
        caption = caption_values(chosen.captions.read(i)) if i in chosen.captions.spans else None
        row = columns.scalar_row(track, i, caption, chosen.placement)
        num_bytes = 0
        for file in files:
            path = frame_path(frame, FILE_NAMES[file])
            allowed_in = tree if path.is_symlink() else None  # its folder was checked above
            data = read_bytes(path, what="file of the frame", fix="render the track again", tree=allowed_in)
            size_px = (track.camera.width_px, track.camera.height_px)
            _check_picture(file, data, size_px, path, is_inspected=chosen.candidate.sha256 is not None)
            _check_digest(folder, f"{frame_name(i)}/{path.name}", data, digests)
            if file == "depth":
                row[PICTURES[file].name] = data = as_depth_npy(data, path)
            else:
                row[PICTURES[file].name] = {"bytes": data, "path": f"{row['sample_id']}_{FILE_NAMES[file]}"}
            num_bytes += len(data)
        frames.add(row, num_bytes)
        advance()


# --- checks of the files ----------------------------------------------------------------------------------------------


def _check_picture(file: FrameFile, data: bytes, size_px: tuple[int, int], where: Path, *, is_inspected: bool) -> None:
    """Check that a file has the (width, height) of its track. The inspection has unpacked the pictures that it saw, and
    `_check_digest` finds those that have changed since."""
    if file == "depth":
        depth = depth_values(data, where)
        low, high = float(depth.min(initial=0.0)), float(depth.max(initial=0.0))  # NaN if any is
        if not 0.0 <= low <= high <= SKY_DEPTH_M:
            what, expected = "the depth image has values that are not depths", f"0 to {SKY_DEPTH_M:g} m"
            raise InputError(what, where=where, got=f"{low:g} to {high:g} m", expected=expected, fix=RENDER)
        picture_px: tuple[int, ...] | None = depth.shape[::-1]
    else:
        picture_px = png_size(data) if is_inspected else colours_of(data, where).shape[1::-1]
    if picture_px != size_px:
        got = "no PNG" if picture_px is None else "{} x {} px".format(*picture_px)
        expected = "{} x {} px".format(*size_px)
        raise InputError("the picture has the wrong size", where=where, got=got, expected=expected, fix=RENDER)


def _digests(candidate: Candidate) -> dict[str, str]:
    """Return the recorded sha256 of each file of a track; VerifyError if it has changed since its inspection."""
    folder = candidate.folder
    if candidate.sha256 is None:
        digests = read_checksums(folder) if (folder / CHECKSUMS).is_file() else {}
    else:
        digests = folder_digests(folder)
        if digest_of(digests) != candidate.sha256:
            got, expected = digest_of(digests), f"{candidate.sha256}, the digest at the inspection"
            what = "the track has changed since its inspection"
            raise VerifyError(what, where=folder, got=got, expected=expected, fix=RESTORE)
    _check_digest(folder, TRACK_FILE, None, digests)
    _check_digest(folder, TARGET_FILE, None, digests)
    return digests


def _check_digest(folder: Path, name: str, data: bytes | None, digests: Mapping[str, str]) -> None:
    """Compare a file, of which `data` was read, with its digest where there is one."""
    if not digests or (data is None and not (folder / name).is_file()):
        return
    got = sha256_file(folder / name) if data is None else hashlib.sha256(data).hexdigest()
    if got != digests.get(name):
        expected = digests.get(name, "a recorded digest")
        what = "the file has changed since its digest was recorded"
        raise VerifyError(what, where=folder / name, got=got, expected=expected, fix=RESTORE)
