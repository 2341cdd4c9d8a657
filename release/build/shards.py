"""One shard: the frames of some flights, read once, held against their digests and written as parquet.

A worker writes whole shards, so that no byte is written twice.
"""

from __future__ import annotations

import hashlib
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
    tree_of,
)
from cosfly.formats.playback import TARGET_FILE, Track
from cosfly.runtime.errors import CosflyError, InputError, VerifyError
from cosfly.runtime.io import CHECKSUMS, atomic_file, check_stays_below, read_bytes, read_checksums, sha256_file
from cosfly.runtime.png import PNG_HEADER_BYTES, parse_png, png_size
from cosfly.runtime.run_dir import TRACK_FILE, digest_of, folder_digests
from cosfly.runtime.worker import advance
from release import columns
from release.build.captions import FlightCaptions
from release.build.rows import Rows, ShardPlan, open_writer, points_writer
from release.build.sources import Candidate
from release.build.survey import look_of, open_flight
from release.columns import Placement, ReleasedCaption, caption_values
from release.record import StoredFile
from release.rules import select_frames

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
    """See that a file is whole and of its flight's size.

    Args:
        size_px: width, height. is_known: its digest was compared, so that a PNG's own checksums need not be.
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


MOST_TOLD = 20  # problems of one shard: after so many the others need not be looked for
META = "meta.json"
RESTORE = "restore the file, or inspect and caption the changed tree"


@dataclass(frozen=True)
class FlightPart:
    """A flight of a shard."""

    candidate: Candidate
    placement: Placement
    captions: FlightCaptions


class ReleasedPart(BaseModel):
    """What a shard holds of a flight: counts of frames and captions.

    frames_without: The frames without a caption, by reason.
    """

    name: str
    frames: int
    frames_available: int
    captions: int
    frame_not_selected: int
    frames_without: dict[str, int]


class ShardResult(BaseModel):
    """A shard that is written: its frames and points, whose paths are those of the parts."""

    frames: StoredFile
    points: StoredFile
    flights: list[ReleasedPart]


def write_shard(path: Path, parts: Sequence[FlightPart], plan: ShardPlan) -> ShardResult:
    """Write the selected frames of some flights.

    Raises:
        InputError, VerifyError: names everything that is wrong with them.
    """
    problems = _Problems()
    flights: list[ReleasedPart] = []
    of_points = points_part(path)
    with atomic_file(of_points) as points, atomic_file(path) as file:
        with open_writer(file, columns.schema(plan.files)) as writer, points_writer(points) as add_points:
            rows = Rows(writer, plan)
            for part in parts:
                with problems.collected():
                    flights.append(_write_flight(part, plan, rows, add_points, problems))
            rows.flush()
        problems.raise_any()
    frames = _stored(path, sum(flight.frames for flight in flights))
    points_file = _stored(of_points, sum(flight.frames_available for flight in flights))
    return ShardResult(frames=frames, points=points_file, flights=flights)


def points_part(path: Path) -> Path:
    """Return the file of a shard's points, given that of its frames, while the release is being built."""
    return path.with_suffix(".points.parquet")


def _stored(path: Path, rows: int) -> StoredFile:
    return StoredFile(path=path.name, rows=rows, bytes=path.stat().st_size, sha256=sha256_file(path))


def _write_flight(
    part: FlightPart, plan: ShardPlan, rows: Rows, add_points: Callable[[Track, Placement], None], problems: _Problems
) -> ReleasedPart:
    folder = part.candidate.folder
    digests = _digests(part.candidate)
    flight = open_flight(part.candidate)
    selected = select_frames(len(flight), plan.num_frames, plan.selection, plan.window_frames).tolist()
    captions, not_selected = _captions_of(part.captions, set(selected))
    tree = tree_of(flight.frame_folder(0))
    check_stays_below(folder / FRAMES_DIR, tree)
    for i in selected:
        with problems.collected():
            frame = flight.frame_folder(i)
            if frame.is_symlink():
                check_stays_below(frame, tree)
            _check_digest(folder, f"{frame_name(i)}/{META}", None, digests)
            placement = replace(part.placement, look=look_of(flight, i))
            pictures = dict[FrameFile, bytes]()
            for file in plan.files:
                path = frame_path(frame, FILE_NAMES[file])
                pictures[file] = _read_picture(flight, path, file, tree, is_known=bool(digests))
                _check_digest(folder, f"{frame_name(i)}/{path.name}", pictures[file], digests)
            scalars = columns.scalar_row(flight, i, captions.get(i), placement)
            if not problems.errors:  # else nothing will be written any more
                rows.add(scalars, pictures, flight, i)
        advance()
    if not problems.errors:
        add_points(flight, part.placement)
    without = Counter(part.captions.why_none(i) for i in selected if i not in captions)
    return ReleasedPart(
        name=part.candidate.name, frames=len(selected), frames_available=len(flight), captions=len(captions),
        frame_not_selected=not_selected, frames_without=dict(without),
    )  # fmt: skip


def _captions_of(captions: FlightCaptions, selected: set[int]) -> tuple[dict[int, ReleasedCaption], int]:
    """Return the captions of released frames, by frame, and how many are of other frames."""
    found: dict[int, ReleasedCaption] = {}
    not_selected = 0
    for caption in captions.read():
        if caption.frame_index in selected:
            found[caption.frame_index] = caption_values(caption)
        else:
            not_selected += 1
    return found, not_selected


# --- what is read -----------------------------------------------------------------------------------------------------


class _Problems:
    """What is wrong with the flights of a shard: reading goes on after an error, writing does not."""

    def __init__(self) -> None:
        self.errors: list[CosflyError] = []

    @contextmanager
    def collected(self) -> Iterator[None]:
        try:
            yield
        except (InputError, VerifyError) as error:
            self.errors.append(error)
            if len(self.errors) >= MOST_TOLD:
                self.raise_any()

    def raise_any(self) -> None:
        """Raise what was collected as one error."""
        if len(self.errors) == 1:
            raise self.errors[0]
        if self.errors:
            kind = VerifyError if all(isinstance(error, VerifyError) for error in self.errors) else InputError
            more = " or more" if len(self.errors) >= MOST_TOLD else ""
            raise kind(f"the track has {len(self.errors)}{more} problems", got=" | ".join(map(str, self.errors)))


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


def _read_picture(flight: Track, path: Path, file: FrameFile, tree: Path, *, is_known: bool) -> bytes:
    """Read a picture, and see that it is what it must be.

    Args:
        is_known: its digest will be compared.
    """
    inside = tree if path.is_symlink() else None  # its folder was looked at
    data = read_bytes(path, what="file of the frame", fix="render the track again", tree=inside)
    check_picture(file, data, (flight.camera.width_px, flight.camera.height_px), path, is_known=is_known)
    return data
