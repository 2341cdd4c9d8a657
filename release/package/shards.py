"""One shard: the frames of some flights, read once, held against their digests and written as parquet.

A worker writes whole shards, so that no byte is written twice, and pictures are read into memory that is used again: parquet takes them from there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel

from cosfly.errors import CosflyError, InputError, VerifyError
from cosfly.items import advance
from cosfly.products.frames import FILE_NAMES, FRAMES_DIR, FrameFile, frame_name, tree_of
from cosfly.products.playback import Flight, sample_id
from cosfly.provenance import FLIGHT, digest_of, folder_digests
from cosfly.reading.files import check_stays_below, read_into, sha256_file
from cosfly.store import CHECKSUMS, atomic_file, read_checksums
from release import columns
from release.columns import PICTURES, Placed, ReleasedCaption
from release.package.captions import FlightCaptions, released
from release.package.depth import DepthErrors, encoded
from release.package.pictures import check_picture
from release.package.sources import Candidate
from release.package.survey import Placing, look_of, open_flight
from release.record import DepthCodingName
from release.subsample import is_whole, select_frames

MB = 1024 * 1024
VALUES_A_BATCH = (
    4  # values between two looks at the size of a page: with more a page takes a whole row group, twice in memory
)
MOST_ROWS = 1000  # of a row group: of small pictures it would hold more rows than memory should
MOST_TOLD = 20  # problems of one shard: after so many the others need not be looked for
META = "meta.json"
ANEW = "put the file back, or inspect and caption the tree as it is now"


@dataclass(frozen=True)
class FlightPart:
    """A flight of a shard."""

    candidate: Candidate
    placing: Placing
    captions: FlightCaptions


class ShardPlan(BaseModel):
    """How rows are chosen and cut."""

    num_frames: int | None
    window_frames: int
    files: tuple[FrameFile, ...]
    depth: DepthCodingName
    row_group_bytes: int


class ReleasedPart(BaseModel):
    """What a shard holds of a flight: counts of frames and captions."""

    name: str
    frames: int
    frames_available: int
    captions: int
    frame_not_selected: int
    window_not_whole: int


class Written(BaseModel):
    """A shard that is written."""

    rows: int
    bytes: int
    sha256: str
    flights: list[ReleasedPart]
    depth: DepthErrors


def write_shard(path: Path, parts: Sequence[FlightPart], plan: ShardPlan) -> Written:
    """Write the selected frames of some flights.

    Raises:
        InputError, VerifyError: names everything that is wrong with them.
    """
    problems = _Problems()
    flights: list[ReleasedPart] = []
    with atomic_file(path) as file:
        hashed = _HashedFile(file)
        with open_writer(pa.PythonFile(hashed, mode="w"), columns.schema(plan.files)) as writer:
            rows = _Rows(writer, plan)
            for part in parts:
                with problems.collected():
                    flights.append(_write_flight(part, plan, rows, problems))
            rows.flush()
        problems.raise_any()
    return Written(
        rows=sum(flight.frames for flight in flights),
        bytes=path.stat().st_size,
        sha256=hashed.sha256.hexdigest(),
        flights=flights,
        depth=rows.depth,
    )


def _write_flight(part: FlightPart, plan: ShardPlan, rows: _Rows, problems: _Problems) -> ReleasedPart:
    folder = part.candidate.folder
    digests = _digests(part.candidate)
    flight = open_flight(part.candidate)
    selected = select_frames(len(flight), plan.num_frames, plan.window_frames).tolist()
    captions, not_selected, not_whole = _captions_of(part.captions, set(selected))
    placing, tree = part.placing, tree_of(flight.frame_folder(0))
    check_stays_below(folder / FRAMES_DIR, tree)
    for i in selected:
        with problems.collected():
            if flight.frame_folder(i).is_symlink():
                check_stays_below(flight.frame_folder(i), tree)
            _check_digest(folder, f"{frame_name(i)}/{META}", None, digests)
            placed = Placed(placing.walk, placing.split, placing.pair, look_of(flight, i))
            for file in plan.files:
                _read_picture(flight, i, file, digests, tree, rows)
            rows.add(columns.scalar_row(flight, i, captions.get(i), placed), flight, i, keep=not problems.errors)
        advance()
    return ReleasedPart(
        name=part.candidate.name,
        frames=len(selected),
        frames_available=len(flight),
        captions=len(captions),
        frame_not_selected=not_selected,
        window_not_whole=not_whole,
    )


def _captions_of(captions: FlightCaptions, selected: set[int]) -> tuple[dict[int, ReleasedCaption], int, int]:
    """Give the captions whose whole window is released, by frame, and how many lack their own frame or another one."""
    found: dict[int, ReleasedCaption] = {}
    not_selected = not_whole = 0
    for caption in captions.read():
        if caption.frame_index not in selected:
            not_selected += 1
        elif not is_whole(caption.window, selected):
            not_whole += 1
        else:
            found[caption.frame_index] = released(caption)
    return found, not_selected, not_whole


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
            raise kind(f"{len(self.errors)}{more} things are wrong", got=" | ".join(map(str, self.errors)))


def _digests(candidate: Candidate) -> dict[str, str]:
    """Give the sha256 of each file of a flight, as far as they are known, once it is clear that they are those that were inspected.

    Raises:
        VerifyError: they are not.
    """
    folder = candidate.folder
    if candidate.sha256 is None:
        digests = read_checksums(folder) if (folder / CHECKSUMS).is_file() else {}
    else:
        digests = folder_digests(folder)
        if digest_of(digests) != candidate.sha256:
            got, expected = digest_of(digests), f"{candidate.sha256}, as in the inspection"
            what = "the flight is not the one that was inspected"
            raise VerifyError(what, where=folder, got=got, expected=expected, fix=ANEW)
    _check_digest(folder, FLIGHT, None, digests)
    return digests


def _check_digest(folder: Path, name: str, data: memoryview | None, digests: Mapping[str, str]) -> None:
    """Compare a file, of which `data` was read, with its digest where there is one.

    Raises:
        VerifyError: it is another one, or there are digests and none of it.
    """
    if not digests or (data is None and not (folder / name).is_file()):
        return
    got = sha256_file(folder / name) if data is None else hashlib.sha256(data).hexdigest()
    if got != digests.get(name):
        expected = digests.get(name, "a digest on record")
        what = "a file is not the one that is on record"
        raise VerifyError(what, where=folder / name, got=got, expected=expected, fix=ANEW)


def _read_picture(flight: Flight, i: int, file: FrameFile, digests: Mapping[str, str], tree: Path, rows: _Rows) -> None:
    """Read a picture into its column, and see that it is what it must be."""
    folder, name = flight.folder, f"{frame_name(i)}/{FILE_NAMES[file]}"
    assert folder is not None
    path = folder / name
    data = rows.pictures[file].read(path, tree if path.is_symlink() else None)  # its folder was looked at
    size_px = flight.camera.width_px, flight.camera.height_px
    check_picture(file, data, size_px, path, is_known=bool(digests))
    _check_digest(folder, name, data, digests)


# --- what is written --------------------------------------------------------------------------------------------------


class _HashedFile:
    """A file under construction with the digest of what was written, so that a shard needs not be read again for its own."""

    closed = False  # whoever opened the file closes it

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.sha256 = file, hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.sha256.update(data)
        return self._file.write(data)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        """Leave the file open: its end is flushed to disk before it has its name."""


class _Column:
    """The files of one picture column of a row group, one after the other in memory that every row group uses again."""

    def __init__(self, num_bytes: int) -> None:
        self._memory = np.empty(
            2 * num_bytes, np.uint8
        )  # the last file goes beyond; pages that nobody writes to take no memory
        self.ends = [0]  # of the files that are kept, from byte 0 on
        self._last = 0  # end of the one that was read last

    def read(self, path: Path, tree: Path | None) -> memoryview:
        """Read a file behind those that are kept; gives its bytes, which the next one replaces."""
        size = read_into(path, self._room, what="frame's file", fix="render it again", tree=tree)
        return self._set(size)

    def replace(self, data: bytes) -> None:
        """Put other bytes in the place of the file that was read last."""
        self._room(len(data))[:] = data
        self._set(len(data))

    def keep(self) -> int:
        """Keep the file that was read last; gives its size."""
        self.ends.append(self._last)
        return self.ends[-1] - self.ends[-2]

    def last(self) -> memoryview:
        return self._memory.data[self.ends[-1] : self._last]

    def clear(self) -> None:
        self.ends, self._last = [0], 0

    def array(self) -> pa.Array:
        """Give the files as binary values; nothing is copied."""
        offsets = pa.py_buffer(np.array(self.ends, np.int32))
        return pa.Array.from_buffers(pa.binary(), len(self.ends) - 1, [None, offsets, pa.py_buffer(self._memory)])

    def _room(self, size: int) -> memoryview:
        begin = self.ends[-1]
        if begin + size > len(self._memory):
            grown = np.empty(2 * (begin + size), np.uint8)
            grown[:begin] = self._memory[:begin]
            self._memory = grown
        return self._memory.data[begin : begin + size]

    def _set(self, size: int) -> memoryview:
        self._last = self.ends[-1] + size
        return self.last()


class _Rows:
    """Rows on their way into row groups of a size that viewers load one at a time."""

    def __init__(self, writer: pq.ParquetWriter, plan: ShardPlan) -> None:
        self._writer, self._plan = writer, plan
        self.pictures = {file: _Column(plan.row_group_bytes) for file in PICTURES if file in plan.files}
        self._scalars: list[dict[str, Any]] = []
        self._paths: list[str] = []
        self._num_bytes = 0
        self.depth = DepthErrors()

    def add(self, scalars: dict[str, Any], flight: Flight, i: int, *, keep: bool) -> None:
        """Add a frame whose pictures were read. keep: False where nothing will be written any more."""
        if "depth" in self.pictures and self._plan.depth != "float32":
            where = flight.frame_folder(i) / FILE_NAMES["depth"]
            coded, cost = encoded(self.pictures["depth"].last(), self._plan.depth, where)
            self.pictures["depth"].replace(coded)
            self.depth = self.depth.merged(cost)
        if not keep:
            return
        self._scalars.append(scalars)
        self._paths.append(sample_id(flight.flight_id, i))
        self._num_bytes += sum(column.keep() for column in self.pictures.values())
        if self._num_bytes >= self._plan.row_group_bytes or len(self._scalars) >= MOST_ROWS:
            self.flush()

    def flush(self) -> None:
        if not self._scalars:
            return
        schema = columns.schema(self._plan.files)
        arrays = [
            self._array(file, column, schema.field(PICTURES[file].name).type) for file, column in self.pictures.items()
        ]
        scalars = pa.Table.from_pylist(
            self._scalars, schema=pa.schema([schema.field(name) for name in columns.SCALAR_NAMES])
        )
        table = pa.Table.from_arrays([*arrays, *scalars.columns], schema=schema)
        self._writer.write_table(table, row_group_size=table.num_rows)
        for column in self.pictures.values():
            column.clear()
        self._scalars, self._paths, self._num_bytes = [], [], 0

    def _array(self, file: FrameFile, column: _Column, kind: pa.DataType) -> pa.Array:
        if not pa.types.is_struct(kind):
            return column.array()
        paths = pa.array([f"{stem}_{FILE_NAMES[file]}" for stem in self._paths], pa.string())
        return pa.StructArray.from_arrays([column.array(), paths], fields=list(kind))


def open_writer(sink: str | pa.NativeFile, schema: pa.Schema) -> pq.ParquetWriter:
    """Open a parquet file whose bytes depend on the rows alone.

    PNG files do not compress, so they are stored as they are; everything else is zstd. Statistics of pictures would only
    repeat their first bytes. The page index lets the hub's viewer read one row without its row group.
    """
    leaves: list[str] = []  # parquet's paths of the primitive columns
    for member in schema:
        inner = [child.name for child in member.type] if pa.types.is_struct(member.type) else []
        inner = ["list.element"] if pa.types.is_list(member.type) else inner
        leaves += [f"{member.name}.{name}" for name in inner] or [member.name]
    compression = {name: "none" if name.endswith(".bytes") else "zstd" for name in leaves}
    small = [name for name in leaves if name != PICTURES["depth"].name and not name.endswith(".bytes")]
    repeated = [name for name in small if name in schema.names and schema.field(name).type == pa.string()]
    return pq.ParquetWriter(
        sink,
        schema,
        compression=compression,
        use_dictionary=repeated,
        write_statistics=small,
        version="2.6",
        write_page_index=True,
        write_batch_size=VALUES_A_BATCH,
    )
