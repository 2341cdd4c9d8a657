"""One shard: the frames of some tracks, read once, compared with their digests and written as parquet.

A worker writes whole shards, so that no byte is written twice.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from cosfly.formats.frames import (
    FILE_NAMES,
    FRAMES_DIR,
    SKY_DEPTH_M,
    FrameFile,
    depth_values,
    frame_name,
    frame_path,
    read_meta,
    tree_of,
)
from cosfly.formats.playback import TARGET_FILE, Track
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import CHECKSUMS, atomic_file, check_stays_below, read_bytes, read_checksums, sha256_file
from cosfly.runtime.png import PNG_HEADER_BYTES, parse_png, png_size
from cosfly.runtime.run_dir import TRACK_FILE, digest_of, folder_digests
from cosfly.runtime.worker import advance
from release import columns
from release.build.plan import Chosen, open_track
from release.build.problems import Problems
from release.build.rows import Rows, open_writer, points_writer
from release.build.sources import Candidate
from release.columns import caption_values
from release.record import StoredFile

# Bits a channel; colour type, RGB or RGBA; interlacing: bytes 24, 25 and 28 of a PNG. What the readers of a release
# take.
KIND = struct.Struct(">BBxxB")
KINDS = ((8, 2, 0), (8, 6, 0))
CONVERT = (
    "convert it without loss, for instance with Pillow: Image.open(FILE).convert('RGB').save(FILE), and inspect again"
)
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
RENDER = "render the track again, or restore the file"


def check_picture(file: FrameFile, data: bytes, size_px: tuple[int, int], where: Path, *, is_known: bool) -> None:
    """Check that a file is whole and has the size of its track.

    Args:
        size_px: width, height. is_known: Its digest was compared, so that the checksums of a PNG need not be.
    """
    if file == "depth":
        _check_depth(depth_values(data, where), size_px, where)
        return
    found = png_size(data[:PNG_HEADER_BYTES])
    if found is None or data[-len(PNG_END) :] != PNG_END:
        got = f"{len(data)} bytes that do not {'begin' if found is None else 'end'} as a PNG"
        raise InputError("the picture is damaged or cut short", where=where, got=got, fix=RENDER)
    if found != size_px:
        got, expected = (f"{width} x {height} px" for width, height in (found, size_px))
        raise InputError("the picture has the wrong size", where=where, got=got, expected=expected, fix=RENDER)
    bits, colour_type, interlace = KIND.unpack_from(data, PNG_HEADER_BYTES)
    if (bits, colour_type, interlace) not in KINDS:
        got = f"{bits} bits, colour type {colour_type}{', interlaced' if interlace else ''}"
        expected = "8 bits, RGB or RGBA (2 or 6), not interlaced"
        raise InputError("the kind of PNG is not supported", where=where, got=got, expected=expected, fix=CONVERT)
    if not is_known:
        parse_png(data, where)


def _check_depth(values: np.ndarray, size_px: tuple[int, int], where: Path) -> None:
    if values.shape[::-1] != size_px:
        got, expected = (f"{width} x {height} px" for width, height in (values.shape[::-1], size_px))
        raise InputError("the depth image has the wrong size", where=where, got=got, expected=expected, fix=RENDER)
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))  # NaN if any is
    if not 0.0 <= low <= high <= SKY_DEPTH_M:
        raise InputError(
            "the depth image has values that are not depths",
            where=where,
            got=f"{low:g} to {high:g} m",
            expected=f"0 to {SKY_DEPTH_M:g} m",
            fix=RENDER,
        )


MOST_PROBLEMS = 20  # of one shard: after so many the others need not be looked for
META = "meta.json"
RESTORE = "restore the file, or inspect and caption the changed tree"


class ShardResult(BaseModel):
    """A shard that is written: its frames and points, whose paths are those of the parts."""

    frames: StoredFile
    points: StoredFile


def write_shard(
    path: Path, tracks: Sequence[Chosen], files: Collection[FrameFile], row_group_bytes: int
) -> ShardResult:
    """Write the selected frames of some tracks.

    Raises:
        InputError, VerifyError: Names everything that is wrong with them.
    """
    problems = Problems(MOST_PROBLEMS)
    of_points = points_part(path)
    with atomic_file(of_points) as points, atomic_file(path) as file:
        with open_writer(file, columns.schema(files)) as writer, points_writer(points) as add_points:
            rows = Rows(writer, row_group_bytes)
            for chosen in tracks:
                with problems.collected(chosen.name):
                    track = open_track(chosen.candidate)
                    _write_track(chosen, track, files, rows, problems)
                    if not problems.failures:
                        add_points(track, chosen.placement)
            rows.flush()
        problems.raise_any("the tracks have {}")
    frames = _stored(path, sum(len(chosen.selected) for chosen in tracks))
    return ShardResult(frames=frames, points=_stored(of_points, sum(chosen.num_frames for chosen in tracks)))


def points_part(path: Path) -> Path:
    """Return the file of a shard's points, given that of its frames, while the release is being built."""
    return path.with_suffix(".points.parquet")


def _stored(path: Path, rows: int) -> StoredFile:
    return StoredFile(path=path.name, rows=rows, bytes=path.stat().st_size, sha256=sha256_file(path))


def _write_track(chosen: Chosen, track: Track, files: Collection[FrameFile], rows: Rows, problems: Problems) -> None:
    folder = chosen.candidate.folder
    digests = _digests(chosen.candidate)
    tree = tree_of(track.frame_folder(0))
    check_stays_below(folder / FRAMES_DIR, tree)
    for i in chosen.selected:
        with problems.collected(chosen.name):
            frame = track.frame_folder(i)
            if frame.is_symlink():
                check_stays_below(frame, tree)
            _check_digest(folder, f"{frame_name(i)}/{META}", None, digests)
            placement = replace(chosen.placement, look=_look_of(track, i))
            pictures = dict[FrameFile, bytes]()
            for file in files:
                path = frame_path(frame, FILE_NAMES[file])
                pictures[file] = _read_picture(track, path, file, tree, is_known=bool(digests))
                _check_digest(folder, f"{frame_name(i)}/{path.name}", pictures[file], digests)
            caption = caption_values(chosen.captions.read(i)) if i in chosen.captions.spans else None
            scalars = columns.scalar_row(track, i, caption, placement)
            if not problems.failures:  # else nothing will be written any more
                rows.add(scalars, pictures, track, i)
        advance()


def _look_of(track: Track, i: int) -> np.ndarray | None:
    """Return sun and air of a frame, (4,), None where its annotation does not have them."""
    folder = track.frame_folder(i)
    if not (folder / META).is_file():
        return None
    meta = read_meta(folder)
    if meta.index != i:
        what, got = "the annotation belongs to another frame", f"index {meta.index}"
        raise InputError(what, where=folder / META, got=got)
    return None if meta.look is None else np.array(list(meta.look.model_dump().values()))


def _digests(candidate: Candidate) -> dict[str, str]:
    """Return the sha256 of each file of a flight, as far as they are known, once it is clear that they are those that
    were inspected.
    """
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
        what = "the file differs from the recorded digest"
        raise VerifyError(what, where=folder / name, got=got, expected=expected, fix=RESTORE)


def _read_picture(track: Track, path: Path, file: FrameFile, tree: Path, *, is_known: bool) -> bytes:
    """Read a picture and check it.

    Args:
        is_known: Its digest will be compared.
    """
    inside = tree if path.is_symlink() else None  # its folder was looked at
    data = read_bytes(path, what="file of the frame", fix="render the track again", tree=inside)
    check_picture(file, data, (track.camera.width_px, track.camera.height_px), path, is_known=is_known)
    return data
