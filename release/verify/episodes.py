"""The rows and pictures of an exported LeRobot data set, read again from its episodes: of a release what LeRobot has features for.

Episodes are joined to flights by the export's own table of them, and what LeRobot adds (numbers, times, tasks, actions, statistics) is made
again from what stands beside it. Poses and points are float32 here.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cosfly.errors import InputError
from cosfly.products.frames import FrameFile, depth_bytes
from cosfly.products.playback import ORIGINAL
from cosfly.reading.arrays import check_pixels
from cosfly.reading.documents import read_object
from cosfly.reading.tables import arrow_errors, open_table, read_row_group, row_batches, rows_of
from release.columns import INTRINSICS, PLACE, POSE
from release.export.lerobot import (
    ACTION,
    CAMERAS,
    FLAGS,
    STATE,
    TEXTS,
    VECTORS,
    VERSION,
    features_of,
    moves,
    schema_of,
    task_of,
)
from release.verify.findings import Findings
from release.verify.rows import Row
from release.verify.sources import BATCH_ROWS, Entry, Pictures, pictures_of, rows_of_table, with_ids

INFO = "meta/info.json"
EPISODE: dict[str, type] = {
    "episode_index": int,
    "flight": str,
    "split": str,
    "first_frame": int,
    "length": int,
    "tasks": list,
}
ACTION_SLACK = 2e-3  # m, degrees: of poses in float32, a few kilometres from the origin
# TIFF 6.0: an entry is tag, kind, how many, and the value or its place; of the tags those of a plane of float32.
TIFF_ENTRY, MOST_TAGS, MOST_STRIPS = struct.Struct("<HHI4s"), 64, 100_000
WIDTH, HEIGHT, OFFSETS, SIZES = 256, 257, 273, 279
FLOAT32 = {258: 32, 259: 1, 277: 1, 339: 3}  # bits, no compression, one sample, IEEE numbers


@dataclass(frozen=True)
class Episodes:
    """Data files of a folder. A part is (file, row group, first row, row behind the last, frame of the flight of the first row)."""

    folder: Path
    files: tuple[FrameFile, ...]
    size_px: tuple[int, int]
    fps: int
    splits: dict[str, str]
    pairs: dict[str, str]

    def rows(self, entry: Entry) -> list[Row]:
        found: list[Row] = []
        names = [STATE, "visibility", "target_depth_m", *VECTORS, *FLAGS, *TEXTS]
        for name, group, begin, end, frame in entry.parts:
            path = self.folder / name
            with open_table(path, tree=self.folder) as table:
                own = read_row_group(path, table, group, names).slice(begin, end - begin)
            found += [self._row(entry, frame + i, told) for i, told in enumerate(rows_of_table(own, path))]
        return found

    def _row(self, entry: Entry, frame: int, told: Row) -> Row:
        """Give a frame the release's names; columns that LeRobot has no feature for are left out."""
        (width, height), variant = self.size_px, entry.name.rpartition("/")[2]
        row: Row = dict(zip(PLACE, entry.name.split("/"), strict=True))
        row |= {"track": "clean" if variant == ORIGINAL else "perturbed", "split": self.splits[entry.name]}
        row |= {"pair": self.pairs.get(entry.name), "frame_index": frame, "time_s": frame / self.fps}
        row |= {"width_px": width, "height_px": height, "pose": _group(POSE, told[STATE])}
        row |= {column: _group(members, told[name]) for name, (column, members) in VECTORS.items()}
        row |= {name: _number(told[name]) for name in ("visibility", "target_depth_m")}
        row |= {name: told[name] for name in FLAGS} | {name: told[name] or None for name in TEXTS}
        focal_px = (row["intrinsics"] or dict.fromkeys(INTRINSICS, np.nan))["fx"]
        return row | {"fov_deg": float(np.degrees(2.0 * np.arctan2(width / 2.0, focal_px)))}

    def pictures(self, entry: Entry) -> Iterator[Pictures]:
        names = {file: CAMERAS[file] for file in self.files}
        for name, group, begin, end, _ in entry.parts:
            path = self.folder / name
            with open_table(path, tree=self.folder) as table:
                row = 0
                for batch in row_batches(path, table, group, list(names.values()), BATCH_ROWS):
                    for found in pictures_of(batch, names)[max(begin - row, 0) : max(end - row, 0)]:
                        if depth := found.get("depth"):
                            found["depth"] = _npy_of_tiff(depth, f"{name}: {entry.name}")
                        yield found
                    row += len(batch)


def _group(names: tuple[str, ...], values: list[float] | None) -> dict[str, float] | None:
    """Give a group of numbers by name; LeRobot has NaN where the release has null."""
    return None if values is None or np.isnan(values).any() else dict(zip(names, values, strict=True))


def _number(value: float | None) -> float | None:
    return None if value is None or np.isnan(value) else value


def found_episodes(folder: Path, names: list[str], findings: Findings) -> tuple[Episodes, list[Entry]]:
    """Find the flights of data files, and see that what LeRobot adds to their rows is so.

    Args:
        names: of the files that are there.
    Raises:
        InputError: a file cannot be read, or holds something else.
    """
    files, size_px, info = _info(folder, findings)
    told = {row["episode_index"]: row for row in _lines(folder, names)}
    tasks = _tasks(folder)
    parts, splits = defaultdict[str, list[tuple[str, int, int, int, int]]](list), dict[str, str]()
    num_rows = num_episodes = 0
    schema = schema_of(features_of(files, size_px))
    for name in sorted(name for name in names if name.startswith("data/")):
        for number, own, rows in _episodes_in(folder, name, schema):
            about, where = told.pop(number, None), f"{name}: episode {number}"
            if about is None:
                raise InputError("an episode that no table has, or twice", where=where)
            flight, split, frame = about["flight"], about["split"], about["first_frame"]
            _check_episode(rows, about, num_rows, info["fps"], tasks, where, findings)
            if splits.setdefault(flight, split) != split:
                findings.error("leak", f"{where}: {flight}", f"{split} and {splits[flight]}", "one split")
            for path, group, begin, end in own:
                parts[flight].append((path, group, begin, end, frame))
                frame += end - begin
            num_rows, num_episodes = num_rows + len(rows), num_episodes + 1
    for number in told:
        findings.error("missing", f"episode {number}", "no rows", "the rows of every episode")
    for key, count in (("total_frames", num_rows), ("total_episodes", num_episodes), ("total_tasks", len(tasks))):
        if info[key] != count:
            findings.error("sum", f"{INFO}: {key}", info[key], f"{count:,}, as counted")
    flights = [name for name in parts if name.count("/") == len(PLACE) - 1]
    entries = [Entry(name, tuple(parts[name]), sum(part[3] - part[2] for part in parts[name])) for name in flights]
    return Episodes(folder, files, size_px, info["fps"], splits, _twins(flights)), with_ids(entries)


def _twins(flights: list[str]) -> dict[str, str]:
    """Give each flight's twin, which LeRobot has no column for: the other one of its trajectory."""
    of: dict[str, list[str]] = defaultdict(list)
    for flight in flights:
        of[flight.rpartition("/")[0]].append(flight)
    return {one: other for own in of.values() if len(own) == 2 for one, other in (own, own[::-1])}


# --- its records ------------------------------------------------------------------------------------------------------


def _info(folder: Path, findings: Findings) -> tuple[tuple[FrameFile, ...], tuple[int, int], dict[str, Any]]:
    """Give kinds of pictures, their size, and what else `info.json` counts.

    Raises:
        InputError: it is not as an export writes it.
    """
    told = read_object(folder / INFO, what="LeRobot's info", tree=folder)
    try:
        declared = told["features"]
        files = tuple(file for file, name in CAMERAS.items() if name in declared)
        height, width = (int(n) for n in declared[CAMERAS[files[0]]]["shape"][:2])
        info = {name: int(told[name]) for name in ("fps", "total_frames", "total_episodes", "total_tasks")}
        info["version"] = told["codebase_version"]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InputError("not the info of an export", where=INFO, got=f"{type(error).__name__}: {error}") from None
    if info["version"] != VERSION or min(info["fps"], width, height) < 1:
        raise InputError("not the info of an export", where=INFO, got=f"{info['version']}, {info['fps']} a second, {width} x {height} px")  # fmt: skip
    expected = {name: feature.declared() for name, feature in features_of(files, (width, height)).items()}
    if declared != expected:
        findings.error("columns", f"{INFO}: features", "others", "the features of an export")
    return files, (width, height), info


def _lines(folder: Path, names: list[str]) -> Iterator[dict[str, Any]]:
    """Yield what is told of each episode.

    Raises:
        InputError: it is not what an export tells.
    """
    tables = sorted(name for name in names if name.startswith("meta/episodes/"))
    rows = (row for name in tables for row in rows_of(folder / name, list(EPISODE), tree=folder))
    for row in rows:
        if not isinstance(row, dict) or any(not isinstance(row.get(key), kind) for key, kind in EPISODE.items()):
            raise InputError("not an episode", where="meta/episodes", got=str(row)[:200], expected=", ".join(EPISODE))
        yield row


def _tasks(folder: Path) -> list[str]:
    """Give the tasks by their numbers."""
    name = "meta/tasks.parquet"
    rows = list(rows_of(folder / name, ["task_index", "task"], tree=folder))
    try:
        tasks = {row["task_index"]: str(row["task"]) for row in rows}
        return [tasks[number] for number in range(len(rows))]
    except (KeyError, TypeError) as error:
        raise InputError("not a table of tasks", where=name, got=f"{type(error).__name__}: {error}") from None


# --- its rows ---------------------------------------------------------------------------------------------------------


def _episodes_in(folder: Path, name: str, schema: pa.Schema) -> Iterator[tuple[int, list[tuple[str, int, int, int]], pa.Table]]:  # fmt: skip
    """Yield the episodes of a data file, in the order in which they stand: number, (path, row group, first row, row behind the last) of each
    piece, and its rows without pictures and texts.

    Raises:
        InputError: it cannot be read, or has other columns.
    """
    light = [field.name for field in schema if not pa.types.is_struct(field.type) and field.name not in TEXTS[4:]]
    pieces: list[tuple[str, int, int, int]] = []
    tables: list[pa.Table] = []
    current = -1
    with open_table(folder / name, tree=folder) as table:
        if not table.schema_arrow.equals(schema):
            raise InputError("not a data file of an export", where=name, got="other columns", expected=", ".join(schema.names[:4]) + " ...")  # fmt: skip
        for group in range(table.num_row_groups):
            rows = read_row_group(folder / name, table, group, light)
            _check_values(rows, f"{name}: row group {group}")
            numbers = rows.column("episode_index").to_numpy()
            edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(rows)]
            for begin, end in pairwise(edges):
                if begin == end:
                    continue
                if pieces and numbers[begin] != current:
                    yield current, pieces, pa.concat_tables(tables)
                    pieces, tables = [], []
                current = int(numbers[begin])
                pieces.append((name, group, begin, end))
                tables.append(rows.slice(begin, end - begin))
    if pieces:
        yield current, pieces, pa.concat_tables(tables)


def _check_values(rows: pa.Table, where: str) -> None:
    """See that texts are texts, and that no number is null: what a release does not know is NaN here.

    Raises:
        InputError: names the column.
    """
    with arrow_errors(where):
        rows.validate(full=True)
    for name, column in zip(rows.column_names, rows.columns, strict=True):
        inner = column.combine_chunks().flatten() if pa.types.is_fixed_size_list(column.type) else column
        if column.null_count or inner.null_count:
            raise InputError("a value that is missing", where=f"{where}: {name}", got="null")


def _check_episode(
    rows: pa.Table, about: dict[str, Any], first: int, fps: int, tasks: list[str], where: str, findings: Findings
) -> None:
    """What LeRobot adds to an episode's rows follows from their order, their poses and their decisions."""
    n = len(rows)
    state, action = (np.array(rows.column(name).to_pylist(), dtype=np.float64).reshape(n, -1) for name in (STATE, ACTION))  # fmt: skip
    wanted = moves(state)
    wanted[:, 3] += np.round((action[:, 3] - wanted[:, 3]) / 360.0) * 360.0  # half a turn has either sign
    decisions = [decision or "" for decision in rows.column("decision").to_pylist()]
    numbers = rows.column("task_index").to_pylist()
    relations = (
        ("length", about["length"] == n, about["length"], f"{n} rows"),
        ("frame_index", rows.column("frame_index").to_pylist() == list(range(n)), "others", "0, 1, 2 ..."),
        ("index", rows.column("index").to_pylist() == list(range(first, first + n)), "others", f"{first:,} and on, through all files"),
        ("timestamp", np.allclose(rows.column("timestamp").to_numpy(), np.arange(n) / fps, rtol=1e-6, atol=1e-6), "others", f"{fps} frames a second from 0 s on"),
        ("next.done", rows.column("next.done").to_pylist() == [False] * (n - 1) + [True], "others", "true at the last frame alone"),
        ("action", np.allclose(action, wanted, rtol=1e-5, atol=ACTION_SLACK), "another way", "what takes each pose to the next"),
        ("task_index", [tasks[k] if 0 <= (k or 0) < len(tasks) else None for k in numbers] == [task_of(d) for d in decisions], "others", "the task of each decision"),
        ("tasks", list(about["tasks"]) == [task_of(d) for d in dict.fromkeys(decisions)], about["tasks"], "the tasks of its rows"),
    )  # fmt: skip
    for name, is_so, got, expected in relations:
        if not is_so:
            findings.error("episode", f"{where}: {name}", got, expected)


# --- depth ------------------------------------------------------------------------------------------------------------


def _npy_of_tiff(data: bytes | memoryview, where: str) -> bytes:
    """Give the bytes of a `depth.npy` of a TIFF as an export writes them: one plane of float32, not compressed, low bytes first.

    Raises:
        InputError: it is anything else, or cut short.
    """
    view = memoryview(data)
    try:
        mark, at = struct.unpack_from("<4sI", view)
        (count,) = struct.unpack_from("<H", view, at)
        tags: dict[int, list[int]] = {}
        for k in range(min(count, MOST_TAGS)):
            tag, kind, length, value = TIFF_ENTRY.unpack_from(view, at + 2 + k * TIFF_ENTRY.size)
            letter = {3: "H", 4: "I"}.get(kind)
            if letter is None or length > MOST_STRIPS:
                continue
            size = struct.calcsize(f"<{length}{letter}")
            place = (view, struct.unpack("<I", value)[0]) if size > 4 else (value, 0)
            tags[tag] = list(struct.unpack_from(f"<{length}{letter}", *place))
        (width,), (height,) = tags[WIDTH], tags[HEIGHT]
        check_pixels(width * height, where, f"{width} x {height} px")
        strips = [view[begin : begin + size] for begin, size in zip(tags[OFFSETS], tags[SIZES], strict=True)]
        is_float32 = all(tags.get(tag, [default]) == [default] for tag, default in FLOAT32.items())
        if mark != b"II*\0" or not is_float32 or sum(map(len, strips)) != width * height * 4:
            raise ValueError(f"{width} x {height} px in {sum(map(len, strips)):,} bytes")
        return depth_bytes(np.frombuffer(b"".join(strips), "<f4").reshape(height, width))
    except (struct.error, KeyError, ValueError) as error:
        raise InputError("not a depth image", where=where, got=f"{type(error).__name__}: {error}", expected="a TIFF of float32") from None  # fmt: skip
