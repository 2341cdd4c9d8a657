"""LeRobot v3.0: a flight is an episode, or several where the release leaves frames of it out.

    data/chunk-000/file-000.parquet of several episodes, meta/{info.json, stats.json, tasks.parquet,
    episodes/chunk-000/file-000.parquet}

LeRobot counts time by frames, so an episode holds frames that follow each other without a gap. Pictures are the
released PNG bytes in the parquet files; depth is TIFF of float32, LeRobot's own lossless form. The task of a frame is
the goal of its flight and the decision of its caption, in words.
`observation.*` is what a policy sees, `action` what it answers, `timestamp` counts from the start of an episode.
"""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.formats.captions import TOKENS
from cosfly.formats.frames import FrameFile
from cosfly.geometry.axes import step_s
from cosfly.geometry.motion import ACTION, PlannedMotion
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.png import colours_of
from cosfly.runtime.worker import advance
from release.columns import BOX, CAPTION_FIELDS, PICTURES, POINT, POSE, SPLIT_NAMES
from release.export.contract import ExportConfig, ExportUnit, Files, FormatFacts, UnitFiles
from release.export.source import (
    DEPTH_CODING,
    Release,
    ReleasedRows,
    picture,
    read_span,
    rows_of_flight,
)
from release.flight_rows import vectors

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SAMPLED_FRAMES, PIXEL_STEP = 5, 4
Summary = dict[str, list]  # name of the statistic -> values, nested as LeRobot has them


def sampled(num_frames: int) -> set[int]:
    """Return the frames of an episode whose pictures count."""
    return {int(i) for i in np.linspace(0, num_frames - 1, min(num_frames, SAMPLED_FRAMES)).round()}


def thinned(picture: np.ndarray) -> np.ndarray:
    """Return every fourth pixel of a picture, (k, channels) float64: colours from 0 to 1, depth (two dimensions) as it
    is.
    """
    few = picture[::PIXEL_STEP, ::PIXEL_STEP]
    return few.reshape(-1, 1).astype(np.float64) if picture.ndim == 2 else few.reshape(-1, 3) / 255.0


def summarize(values: np.ndarray, count: int, *, is_picture: bool = False) -> Summary:
    """Summarize (k, d) values, NaN left out; `count` is the number of frames they are of. Without any value all is
    zero, and so is count.
    """
    known = ~np.isnan(values)
    has_any = known.any(axis=0)
    filled = np.where(has_any, values, 0.0)
    found = {
        "min": np.nanmin(filled, axis=0), "max": np.nanmax(filled, axis=0),
        "mean": np.nanmean(filled, axis=0), "std": np.nanstd(filled, axis=0),
        **{name: np.nanquantile(filled, share, axis=0) for name, share in QUANTILES.items()},
    }  # fmt: skip
    nested = {name: _nested(value, is_picture) for name, value in found.items()}
    return nested | {"count": [count if has_any.any() else 0]}


def merged(summaries: Sequence[Summary]) -> Summary:
    """Summarize what was summarized: exact but for the quantiles, which are means of quantiles, as LeRobot's own
    are.
    """
    parts = [part for part in summaries if part["count"][0]] or summaries
    counts = np.array([part["count"][0] for part in parts], dtype=np.float64)
    weights = counts / counts.sum() if counts.sum() else np.full(len(parts), 1 / len(parts))
    stacked = {name: np.array([part[name] for part in parts], dtype=np.float64) for name in parts[0] if name != "count"}
    mean = np.tensordot(weights, stacked["mean"], axes=1)
    variance = np.tensordot(weights, stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2, axes=1)
    found: dict[str, Any] = {name: np.tensordot(weights, stacked[name], axes=1) for name in QUANTILES}
    found |= {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
    }
    return {name: value.tolist() for name, value in found.items()} | {"count": [int(counts.sum())]}


def _nested(value: np.ndarray, is_picture: bool) -> list:
    return value.reshape(-1, 1, 1).tolist() if is_picture else value.tolist()


STATE, ACTED = "observation.state", "action"
CAMERAS: dict[FrameFile, str] = {
    "rgb": "observation.images.rgb", "depth": "observation.depth", "instance": "observation.images.instance",
}  # fmt: skip
TEXTS = ("sample_id", "decision", "label", "verdict", *CAPTION_FIELDS)
FLAGS = ("target_in_view", "target_visible", "is_perturbed", "has_caption")
VECTORS = {  # feature -> the release's column and its members
    ACTED: ("action", ACTION),
    "pose": ("pose", POSE),
    "target": ("target", POINT),
    "target_uv": ("target_uv", ("u_px", "v_px")),
    "target_bbox": ("target_bbox", BOX),
    "intrinsics": ("intrinsics", ("fx", "fy", "cx", "cy")),
}
DEFAULTS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
# Columns of the release that the values are made of; pictures apart.
COLUMNS = ["time_s", "visibility", "target_depth_m", *FLAGS, *TEXTS, *(column for column, _ in VECTORS.values())]


@dataclass(frozen=True)
class LeRobotFeature:
    """One feature of `info.json`."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None = None
    info: dict[str, Any] | None = None

    def declared(self) -> dict[str, Any]:
        found: dict[str, Any] = {
            "dtype": self.dtype,
            "shape": list(self.shape),
            "names": self.names and list(self.names),
        }
        return found | ({"info": self.info} if self.info else {})

    @property
    def arrow(self) -> pa.DataType:
        if self.dtype == "image":
            return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        plain = pa.type_for_alias(self.dtype)
        return plain if self.shape == (1,) else pa.list_(plain, self.shape[0])

    @property
    def hub(self) -> dict[str, Any]:
        """As `datasets` writes it into a parquet file."""
        if self.dtype == "image":
            return {"_type": "Image"}
        value = {"dtype": self.dtype, "_type": "Value"}
        return value if self.shape == (1,) else {"feature": value, "length": self.shape[0], "_type": "Sequence"}


def features_of(modalities: Collection[FrameFile], size_px: tuple[int, int]) -> dict[str, LeRobotFeature]:
    """Return the features of frames whose pictures are (width, height) px."""
    width, height = size_px
    found: dict[str, LeRobotFeature] = {}
    for file in modalities:
        if file == "depth":
            info = {"is_depth_map": True, "depth_unit": "m"}
            found[CAMERAS[file]] = LeRobotFeature("image", (height, width, 1), ("height", "width", "channels"), info)
        else:
            found[CAMERAS[file]] = LeRobotFeature("image", (height, width, 3), ("height", "width", "channels"))
    found[STATE] = LeRobotFeature("float32", (len(ACTION),), ACTION)
    found |= {name: LeRobotFeature("float32", (len(members),), members) for name, (_, members) in VECTORS.items()}
    found |= {name: LeRobotFeature("float32", (1,)) for name in ("visibility", "target_depth_m")}
    found |= {name: LeRobotFeature("bool", (1,)) for name in (*FLAGS, "next.done")}
    found |= {name: LeRobotFeature("string", (1,)) for name in TEXTS}
    return found | {name: LeRobotFeature(dtype, (1,)) for name, dtype in DEFAULTS.items()}


def schema_of(features: dict[str, LeRobotFeature]) -> pa.Schema:
    """Return the parquet schema, with what `datasets` wants to know in its metadata."""
    about = {"info": {"features": {name: feature.hub for name, feature in features.items()}}}
    return pa.schema(
        [(name, feature.arrow) for name, feature in features.items()], {b"huggingface": json.dumps(about).encode()}
    )


def values_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the values of all features of an episode but pictures and LeRobot's own: arrays (n,) or (n, d), and
    lists of texts.

    What a frame does not have is NaN, or the empty text.
    """
    found: dict[str, Any] = {
        name: vectors(rows, column, members).astype(np.float32) for name, (column, members) in VECTORS.items()
    }
    found[STATE] = states(rows).astype(np.float32)
    found[ACTED] = np.nan_to_num(found[ACTED])  # trainers take no NaN: after an episode's last frame nothing is flown
    for name in ("visibility", "target_depth_m"):
        found[name] = np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=np.float32)
    found |= {name: np.array([bool(row[name]) for row in rows]) for name in FLAGS}
    found["next.done"] = np.arange(len(rows)) == len(rows) - 1
    return found | {name: [row[name] or "" for row in rows] for name in TEXTS}


def states(rows: list[dict[str, Any]]) -> np.ndarray:
    """Return what a drone knows of its own motion at each frame, (n, 5) as ACTION: the mean velocities of the step that
    led there, and the camera's pitch. At the first frame it has not moved."""
    pose = vectors(rows, "pose", POSE)
    time_s, nothing = np.array([row["time_s"] for row in rows]), np.empty((len(rows), 0, 6))
    motion = PlannedMotion(
        time_s, pose, nothing, np.roll(pose[:, 4], -1), pose[:, :3]
    )  # in the axes of each step's end
    found = np.zeros((len(rows), len(ACTION)))
    found[1:, :4] = motion.action[:-1, :4]
    found[:, 4] = pose[:, 3]
    return found


def tiff_of_depth(data: bytes, where: str) -> bytes:
    """Return the bytes of a `depth.npy` as an uncompressed float32 TIFF, which is how LeRobot stores depth."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(parse_array(data, where, dtype=np.float32, ndim=2, what="depth image")).save(buffer, "TIFF")
    return buffer.getvalue()


MB = 1024 * 1024
CHUNK = 1000  # files of one folder
STEP_TOLERANCE_S = 1e-3
FOLLOW_TASK = "Follow the walking person from the air."
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VERSION = "v3.0"


@dataclass(frozen=True)
class Layout:
    """What a unit must know of the whole. episode, index: the numbers of its first episode and frame; file: its own
    number.
    """

    split: str
    file: int
    episode: int
    index: int
    fps: int
    size_px: tuple[int, int]
    tasks: tuple[str, ...]  # in words


def runs_of(flight: ReleasedRows) -> list[tuple[int, int]]:
    """Cut a flight into [start, stop) of frames that follow each other."""
    cuts = np.flatnonzero(np.diff(flight.frame_index) != 1) + 1
    edges = [0, *cuts.tolist(), len(flight)]
    return list(itertools.pairwise(edges))


def task_of(goal: str, decision: str) -> str:
    """Say in words what a frame is an example of; "" where there is no goal, no decision."""
    follow = f"Follow {goal} from the air." if goal else FOLLOW_TASK
    return f"{follow} Now: {decision.replace('_', ' ')}." if decision else follow


def plan(release: Release, flights: list[ReleasedRows], cfg: ExportConfig) -> list[ExportUnit]:
    """Number episodes and frames; a unit is a data file of whole flights."""
    fps, size_px = _fps(flights), _size(release)
    found = {decision for flight in flights for decision in flight.decisions}
    decisions = ("", *TOKENS)
    tasks = tuple(dict.fromkeys(task_of(f.goal, one) for f in flights for one in decisions if one in f.decisions))
    if unknown := found - {*decisions}:
        raise InputError(
            "a decision is not in the closed set of actions", where=release.folder, got=", ".join(sorted(unknown))[:200]
        )
    units: list[ExportUnit] = []
    episode = index = 0
    for split in SPLIT_NAMES:
        groups: list[list[ReleasedRows]] = []
        for flight in (flight for flight in flights if flight.split == split):
            is_full = groups and sum(member.num_bytes for member in groups[-1]) >= cfg.shard_mb * MB
            if not groups or is_full:
                groups.append([])
            groups[-1].append(flight)
        for group in groups:
            layout = Layout(split, len(units), episode, index, fps, size_px, tasks)
            frames = sum(map(len, group))
            units.append(ExportUnit(f"{split}-{len(units):06d}", frames, flights=tuple(group), extra=layout))
            episode += sum(len(runs_of(flight)) for flight in group)
            index += frames
    return units


def _fps(flights: list[ReleasedRows]) -> int:
    wrong, fps = [], set()
    for flight in flights:
        for start, stop in runs_of(flight):
            if stop - start < 2:
                continue
            time_s = flight.time_s[start:stop]
            dt_s = step_s(time_s)
            fps.add(round(1 / dt_s))
            if (
                np.abs(np.diff(time_s) - dt_s).max() > STEP_TOLERANCE_S
                or abs(1 / round(1 / dt_s or 1) - dt_s) > STEP_TOLERANCE_S
            ):
                wrong.append(f"{flight.name}: steps of {np.diff(time_s).min():.4f} to {np.diff(time_s).max():.4f} s")
    if wrong or len(fps) > 1:
        raise InputError(
            "LeRobot needs the same whole number of frames per second in all tracks",
            where="time_s",
            got="; ".join(wrong[:10]) or f"{' and '.join(map(str, sorted(fps)))} frames per second",
        )
    return fps.pop() if fps else 2  # the paper's


def _size(release: Release) -> tuple[int, int]:
    sizes = release.record.numbers.frames_by.image_px
    if len(sizes) != 1:
        raise InputError(
            "LeRobot needs pictures of one size",
            where=release.folder,
            got=", ".join(sizes),
            fix="build one release per size",
        )
    width, _, height = next(iter(sizes)).replace(" ", "").partition("x")
    return int(width), int(height)


# --- a unit -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExportedEpisode:
    """One episode of a unit: its number, its flight, rows [start, stop) of that, the number of its first frame in the
    whole.
    """

    number: int
    flight: ReleasedRows
    start: int
    stop: int
    index: int


def _episodes(unit: ExportUnit) -> Iterator[ExportedEpisode]:
    number, index = unit.extra.episode, unit.extra.index
    for flight in unit.flights:
        for start, stop in runs_of(flight):
            yield ExportedEpisode(number, flight, start, stop, index)
            number, index = number + 1, index + stop - start


def write(release: Release, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> UnitFiles:
    """Write the data files of a unit, and its part of the table of episodes."""
    layout: Layout = unit.extra
    features = features_of(release.modalities, layout.size_px)
    files, rows_about = Files(folder), list[dict[str, Any]]()
    name = DATA_PATH.format(chunk_index=layout.file // CHUNK, file_index=layout.file % CHUNK)
    tables = (table for episode in _episodes(unit) for table in _tables(release, episode, layout, features, rows_about))
    _write_parquet(files, name, schema_of(features), tables)
    _write_episodes(files, layout, rows_about)
    whole = _merge_all([row["stats"] for row in rows_about])
    return files.written(stats=whole, episodes=len(rows_about))


def _tables(
    release: Release,
    episode: ExportedEpisode,
    layout: Layout,
    features: dict[str, LeRobotFeature],
    about: list[dict[str, Any]],
) -> Iterator[pa.Table]:
    """Yield an episode's rows, a row group of the release at a time; at its end `about` has what the records say of
    it.
    """
    flight, n = episode.flight, episode.stop - episode.start
    scalars = [
        row for i, row in enumerate(rows_of_flight(release, flight, COLUMNS)) if episode.start <= i < episode.stop
    ]
    values = values_of(scalars)
    tasks = [task_of(flight.goal, decision) for decision in flight.decisions[episode.start : episode.stop]]
    values["task_index"] = np.array([layout.tasks.index(task) for task in tasks], dtype=np.int64)
    values["frame_index"] = np.arange(n, dtype=np.int64)
    values["timestamp"] = (np.arange(n) / layout.fps).astype(np.float32)
    values["episode_index"] = np.full(n, episode.number, dtype=np.int64)
    values["index"] = episode.index + np.arange(n, dtype=np.int64)
    pixels: dict[str, list[np.ndarray]] = {CAMERAS[file]: [] for file in release.modalities}
    schema, wanted = schema_of(features), sampled(n)
    for first, rows in _pictures(release, episode):
        images = {CAMERAS[file]: [_image(release, row, file) for row in rows] for file in release.modalities}
        for i in wanted & set(range(first, first + len(rows))):
            for file in release.modalities:
                pixels[CAMERAS[file]].append(_pixels(release, rows[i - first], file))
        part = slice(first, first + len(rows))
        columns = [images[name] if name in images else _column(values[name][part], features[name]) for name in features]
        yield pa.table(
            [pa.array(c, schema.field(k).type) if isinstance(c, list) else c for k, c in enumerate(columns)],
            schema=schema,
        )
        advance(len(rows))
    stats: dict[str, Summary] = {}
    for name, feature in features.items():
        if feature.dtype == "image":
            stats[name] = summarize(np.concatenate(pixels[name]), len(pixels[name]), is_picture=True)
        elif feature.dtype != "string":
            stats[name] = summarize(np.asarray(values[name], dtype=np.float64).reshape(n, -1), n)
    about.append(
        {
            "episode_index": episode.number, "tasks": list(dict.fromkeys(tasks)), "length": n,
            "flight": flight.name, "split": flight.split, "first_frame": int(flight.frame_index[episode.start]),
            "from": episode.index, "stats": stats,
        }
    )  # fmt: skip


def _pictures(release: Release, episode: ExportedEpisode) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Yield an episode's rows with pictures alone, and the number of the first of them in the episode."""
    columns = ["sample_id", *(PICTURES[file].name for file in release.modalities)]
    at = 0
    for span in episode.flight.spans:
        begin, end = max(at, episode.start), min(at + span.stop - span.start, episode.stop)
        if begin < end:
            yield begin - episode.start, read_span(release, span, columns)[begin - at : end - at]
        at += span.stop - span.start


def _image(release: Release, row: dict[str, Any], file: FrameFile) -> dict[str, Any]:
    if file == "depth":
        data = tiff_of_depth(picture(row, "depth"), row["sample_id"])
        return {"bytes": data, "path": f"{row['sample_id']}.depth.tiff"}
    return {"bytes": picture(row, file), "path": f"{row['sample_id']}.{file}.png"}


def _pixels(release: Release, row: dict[str, Any], file: FrameFile) -> np.ndarray:
    where = row["sample_id"]
    if file == "depth":
        return thinned(parse_array(picture(row, "depth"), where, dtype=np.float32, ndim=2))
    return thinned(colours_of(picture(row, file), where))


def _column(values: Any, feature: LeRobotFeature) -> Any:
    if feature.dtype == "string":
        return list(values)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return flat if feature.shape == (1,) else pa.FixedSizeListArray.from_arrays(flat, feature.shape[0])


def _write_parquet(files: Files, name: str, schema: pa.Schema, tables: Iterator[pa.Table]) -> None:
    """Write tables as row groups. PNG bytes are stored as they are; everything else, TIFF too, is zstd."""
    leaves = [f"{f.name}.{m.name}" for f in schema if pa.types.is_struct(f.type) for m in f.type]
    leaves += [
        f"{f.name}.list.element" if pa.types.is_list(f.type) or pa.types.is_fixed_size_list(f.type) else f.name
        for f in schema
        if not pa.types.is_struct(f.type)
    ]
    stored = {f"{CAMERAS[file]}.bytes" for file in ("rgb", "instance")}
    compression = {leaf: "none" if leaf in stored else "zstd" for leaf in leaves}
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    with (
        atomic_file(files.folder / name) as file,
        pq.ParquetWriter(
            file, schema, compression=compression, use_dictionary=texts, write_statistics=["episode_index"]
        ) as writer,
    ):
        for table in tables:
            writer.write_table(table, row_group_size=len(table))
    files.note(name)


def _write_episodes(files: Files, layout: Layout, about: list[dict[str, Any]]) -> None:
    """Write a unit's part of the table of episodes."""
    place = {"chunk_index": layout.file // CHUNK, "file_index": layout.file % CHUNK}
    rows = []
    for row in about:
        stats = {
            f"stats/{name}/{kind}": values for name, summary in row["stats"].items() for kind, values in summary.items()
        }
        rows.append(
            {
                **{name: row[name] for name in ("episode_index", "tasks", "length", "flight", "split", "first_frame")},
                **{f"data/{name}": value for name, value in place.items()},
                "dataset_from_index": row["from"], "dataset_to_index": row["from"] + row["length"],
                **stats,
                **{f"meta/episodes/{name}": value for name, value in place.items()},
            }
        )  # fmt: skip
    name = "meta/episodes/chunk-{:03d}/file-{:03d}.parquet".format(*place.values())
    files.put(name, _parquet_bytes(pa.Table.from_pylist(rows)))


def _parquet_bytes(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _merge_all(stats: list[dict[str, Summary]]) -> dict[str, Summary]:
    return {name: merged([one[name] for one in stats]) for name in stats[0]}


# --- the whole --------------------------------------------------------------------------------------------------------


def finish(
    release: Release, units: Sequence[ExportUnit], written: Sequence[UnitFiles], folder: Path, cfg: ExportConfig
) -> FormatFacts:
    """Write `meta/`."""
    layout: Layout = units[0].extra
    files = Files(folder)
    counts = [one.facts["episodes"] for one in written]
    info = _info(release, units, counts, cfg)
    files.put("meta/stats.json", dump_json(_merge_all([one.facts["stats"] for one in written]), indent=4).encode())
    files.put("meta/tasks.parquet", _parquet_bytes(_tasks_table(list(layout.tasks))))
    files.put("meta/info.json", dump_json(info, indent=4).encode())
    num_flights = sum(len(unit.flights) for unit in units)
    codings = dict.fromkeys(release.modalities, "PNG, the released bytes")
    if "depth" in codings:
        codings["depth"] = DEPTH_CODING.format("TIFF, the released numbers")
    rounded = "float32 of the released float64: a coordinate of 1,000 m is rounded by at most 0.00003 m"
    return FormatFacts(
        version=VERSION,
        codings=codings | {"poses and points": rounded},
        notes=[
            f"{info['total_episodes']} episodes of {num_flights} flights at {layout.fps} frames a second; a flight of "
            "which frames were left out is cut there. meta/episodes says of each its flight, split and first frame.",
            "action and observation.state are mean velocities: forward, left, up in m/s in the drone's level axes, "
            "turn in degrees/s (counter-clockwise), the camera's pitch: of the step to the next frame, and of the one "
            "that led here. Zero where there is none, after an episode's last frame (next.done) and before its first.",
            "task is the flight's goal and the caption's decision in words; flights without a goal tell whoever walks, "
            "frames without a caption the order alone. What a frame has not is NaN, or an empty text.",
        ],
        how_to_open="from lerobot.datasets.lerobot_dataset import LeRobotDataset\n"
        "frames = LeRobotDataset('cosfly/flights', root='.')",
        files=files.digests,
    )


def _info(release: Release, units: Sequence[ExportUnit], counts: list[int], cfg: ExportConfig) -> dict[str, Any]:
    layout: Layout = units[0].extra
    splits: dict[str, str] = {}
    total = 0
    for split in SPLIT_NAMES:
        here = sum(count for unit, count in zip(units, counts, strict=True) if unit.extra.split == split)
        if here:
            splits[split] = f"{total}:{total + here}"
        total += here
    features = features_of(release.modalities, layout.size_px)
    info: dict[str, Any] = {
        "codebase_version": VERSION, "robot_type": "cosfly_drone", "total_episodes": total,
        "total_frames": sum(unit.frames for unit in units), "total_tasks": len(layout.tasks), "chunks_size": CHUNK,
        "fps": layout.fps, "splits": splits, "data_path": DATA_PATH, "video_path": None,
        "features": {name: feature.declared() for name, feature in features.items()},
    }  # fmt: skip
    return info | {"data_files_size_in_mb": cfg.shard_mb, "video_files_size_in_mb": cfg.shard_mb}


def _tasks_table(tasks: list[str]) -> pa.Table:
    """Return the table of tasks as pandas reads it: the text is the index."""
    named = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    about = {"index_columns": ["task"], "column_indexes": [], "columns": [named], "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    return table.replace_schema_metadata({b"pandas": json.dumps(about).encode()})
