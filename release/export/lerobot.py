"""LeRobot v3.0: consecutive frames of a track are an episode; a track with gaps is several.

    data/chunk-000/file-000.parquet of several episodes, meta/{info.json, stats.json, tasks.parquet,
    episodes/chunk-000/file-000.parquet}, and with `video` videos/<camera>/chunk-000/file-000.mp4

`observation.*` is what a policy sees, `action` what it answers, and `timestamp` counts from the start of an episode.
The task of a frame is the goal of its track and the decision of its caption, in words. Pictures are the released PNG
bytes, depth is TIFF of float32, LeRobot's own lossless form. The constants are those of lerobot 0.4.
"""

import contextlib
import io
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.formats.captions import TOKENS, not_in_set
from cosfly.formats.frames import FrameFile
from cosfly.geometry.motion import ACTION, PlannedMotion
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import EnvironmentMissing, InputError
from cosfly.runtime.io import atomic_file, write_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.png import colours_of
from release.columns import BOX, CAPTION_FIELDS, POINT, POSE
from release.export.stage import ExportConfig, ExportSource, FormatFacts, SourceTrack, shards
from release.reading import Row, vectors
from release.record import ReleaseRecord, Spread

VERSION = "v3.0"
CHUNK = 1000  # files of one folder
NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH, EPISODES_PATH = f"data/{NAME}.parquet", f"meta/episodes/{NAME}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{NAME}.mp4"
DEFAULTS = {"timestamp": "float32", **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")}
CODEC, CODEC_OPTIONS = "libsvtav1", {"g": "2", "crf": "30"}  # LeRobot's defaults
STEP_TOLERANCE_S = 1e-3
PAPER_FPS = 2
ROWS_HELD = 64  # rows of a row group
FOLLOW_TASK = "Follow the walking person from the air."
CAMERAS: dict[FrameFile, str] = {
    "rgb": "observation.images.rgb", "depth": "observation.depth", "instance": "observation.images.instance",
}  # fmt: skip
STATE, ACTED = "observation.state", "action"
TEXTS = ("sample_id", "decision", "label", "verdict", *CAPTION_FIELDS)
FLAGS = ("target_in_view", "target_visible", "is_perturbed", "has_caption")
NUMBERS = ("visibility", "target_depth_m")
VECTORS = {  # feature -> the release's column and its members
    ACTED: ("action", ACTION),
    "pose": ("pose", POSE),
    "target": ("target", POINT),
    "target_uv": ("target_uv", ("u_px", "v_px")),
    "target_bbox": ("target_bbox", BOX),
    "intrinsics": ("intrinsics", ("fx", "fy", "cx", "cy")),
}


# --- features ---------------------------------------------------------------------------------------------------------


def features_of(modalities: Sequence[FrameFile], size_px: tuple[int, int], fps: int, video: bool) -> dict[str, Any]:
    """Return the features of `info.json`; pictures are (width, height) px."""
    width, height = size_px
    features: dict[str, dict[str, Any]] = {}
    for file in modalities:
        shape, names = [height, width, 3], ["height", "width", "channels"]
        camera: dict[str, Any] = {"dtype": "image", "shape": shape, "names": names}
        if file == "depth":
            camera |= {"shape": [height, width, 1], "info": {"is_depth_map": True, "depth_unit": "m"}}
        elif video:
            info = {
                "video.height": height, "video.width": width, "video.codec": "av1", "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False, "video.fps": fps, "video.channels": 3, "has_audio": False,
            }  # fmt: skip
            camera |= {"dtype": "video", "info": info}
        features[CAMERAS[file]] = camera
    for name, members in {STATE: ACTION, **{name: members for name, (_, members) in VECTORS.items()}}.items():
        features[name] = {"dtype": "float32", "shape": [len(members)], "names": list(members)}
    scalars = dict.fromkeys(NUMBERS, "float32") | dict.fromkeys((*FLAGS, "next.done"), "bool")
    scalars |= dict.fromkeys(TEXTS, "string") | DEFAULTS
    return features | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in scalars.items()}


def schema_of(features: dict[str, Any]) -> pa.Schema:
    """Return the parquet schema of features, as lerobot derives it; videos are not in the tables."""
    from datasets import Features, Image, List, Value

    columns: dict[str, Any] = {}
    for name, feature in features.items():
        if feature["dtype"] == "image":
            columns[name] = Image()
        elif feature["dtype"] != "video":
            value, (length,) = Value(feature["dtype"]), feature["shape"]
            columns[name] = value if length == 1 else List(value, length=length)
    return Features(columns).arrow_schema


def states(rows: list[Row]) -> np.ndarray:
    """Return the motion that a drone knows at each frame, (n, 5) as ACTION: the mean velocities of the step that ends
    there, in the axes at its end, and the camera's pitch. At the first frame it has not moved."""
    pose = vectors(rows, "pose", POSE)
    time_s = np.array([row["time_s"] for row in rows])
    yaw_deg, pitch_deg = pose[:, 4], pose[:, 3]
    motion = PlannedMotion(time_s, pose, np.roll(yaw_deg, -1), pose[:, :3])
    known = np.zeros((len(rows), len(ACTION)))
    known[1:, :4] = motion.action[:-1, :4]
    known[:, 4] = pitch_deg
    return known


def values_of(rows: list[Row], episode: int, first: int, fps: int, tasks: Sequence[int]) -> dict[str, Any]:
    """Return the values of all features of an episode but its pictures: arrays (n,) or (n, d), and lists of n texts. A
    missing number is NaN, a missing text empty. first: number of its first frame in the data set."""
    n = len(rows)
    values: dict[str, Any] = {
        name: vectors(rows, column, members).astype(np.float32) for name, (column, members) in VECTORS.items()
    }
    values[STATE] = states(rows).astype(np.float32)
    values[ACTED] = np.nan_to_num(values[ACTED])  # the last frame has no action, and trainers take no NaN
    values |= {name: np.array([row[name] for row in rows], dtype=np.float32) for name in NUMBERS}
    values |= {name: np.array([bool(row[name]) for row in rows]) for name in FLAGS}
    values |= {name: [row[name] or "" for row in rows] for name in TEXTS}
    frames = np.arange(n, dtype=np.int64)
    return values | {
        "next.done": frames == n - 1, "frame_index": frames, "timestamp": (frames / fps).astype(np.float32),
        "episode_index": np.full(n, episode, dtype=np.int64), "index": first + frames,
        "task_index": np.array(tasks, dtype=np.int64),
    }  # fmt: skip


def task_of(goal: str, decision: str) -> str:
    """Return the task of a frame in words."""
    follow = f"Follow {goal} from the air." if goal else FOLLOW_TASK
    return f"{follow} Now: {decision.replace('_', ' ')}." if decision else follow


# --- statistics -------------------------------------------------------------------------------------------------------

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SAMPLED_FRAMES = 5  # of an episode, whose pictures count
PIXEL_STEP = 4  # every fourth row and column of a picture counts
Summary = dict[str, list]  # name of the statistic -> values, nested as lerobot has them


def summarize(values: np.ndarray, count: int, *, is_picture: bool = False) -> Summary:
    """Summarize (k, d) values of `count` frames; NaN is skipped. If all are NaN, the statistics and the count are 0."""
    has_any = (~np.isnan(values)).any(axis=0)
    filled = np.where(has_any, values, 0.0)
    statistics = {
        "min": np.nanmin(filled, axis=0),
        "max": np.nanmax(filled, axis=0),
        "mean": np.nanmean(filled, axis=0),
        "std": np.nanstd(filled, axis=0),
        **{name: np.nanquantile(filled, share, axis=0) for name, share in QUANTILES.items()},
    }
    if is_picture:
        statistics = {name: value.reshape(-1, 1, 1) for name, value in statistics.items()}
    summary = {name: value.tolist() for name, value in statistics.items()}
    return summary | {"count": [count if has_any.any() else 0]}


def merged(summaries: Sequence[Summary]) -> Summary:
    """Merge summaries: exact but for the quantiles, which are means of quantiles, as lerobot's are."""
    parts = [part for part in summaries if part["count"][0]] or summaries
    counts = np.array([part["count"][0] for part in parts], dtype=np.float64)
    weights = counts / counts.sum() if counts.sum() else np.full(len(parts), 1 / len(parts))
    stacked = {name: np.array([part[name] for part in parts], dtype=np.float64) for name in parts[0] if name != "count"}
    result: dict[str, Any] = {name: np.tensordot(weights, stacked[name], axes=1) for name in (*QUANTILES, "mean")}
    variance = np.tensordot(weights, stacked["std"] ** 2 + (stacked["mean"] - result["mean"]) ** 2, axes=1)
    result |= {"min": stacked["min"].min(axis=0), "max": stacked["max"].max(axis=0), "std": np.sqrt(variance)}
    return {name: value.tolist() for name, value in result.items()} | {"count": [int(counts.sum())]}


def _merge_all(stats: Sequence[dict[str, Summary]]) -> dict[str, Summary]:
    return {name: merged([by_feature[name] for by_feature in stats]) for name in stats[0]}


# --- the export -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layout:
    """The place of a file in the data set."""

    file: int  # its number
    episode: int  # number of its first episode
    index: int  # number of its first frame
    fps: int
    size_px: tuple[int, int]  # of all pictures

    @property
    def place(self) -> dict[str, int]:
        return {"chunk_index": self.file // CHUNK, "file_index": self.file % CHUNK}


class DataFile(NamedTuple):
    """A data file that is being written, with the videos that belong to it."""

    layout: Layout
    features: dict[str, Any]
    tasks: dict[str, int]  # task -> number
    table: pq.ParquetWriter
    videos: dict[str, Callable[[np.ndarray], None]]  # camera -> function that adds a picture


def write(source: ExportSource, folder: Path, cfg: ExportConfig, advance: Advance) -> FormatFacts:
    """Write the data files, an episode after the other, and `meta/`."""
    tasks = dict[str, int]()  # task -> number
    features = dict[str, Any]()
    stats: list[dict[str, Summary]] = []  # of each file
    episodes_of_split = Counter[str]()
    layout = Layout(file=0, episode=0, index=0, fps=_fps(source.record), size_px=(0, 0))
    for name, episodes in shards(_episodes(source, tasks), cfg.shard_mb):
        first = next(episodes)
        if cfg.video and any(side % 2 for side in first.size_px):
            got, fix = "{} x {} px".format(*first.size_px), "export without --video"
            raise InputError("--video needs pictures of even width and height", where=source.folder, got=got, fix=fix)
        if not layout.file:
            layout = replace(layout, size_px=first.size_px)
            features = features_of(source.modalities, first.size_px, layout.fps, cfg.video)
        rows = _write_file(source, itertools.chain([first], episodes), layout, features, tasks, folder, advance)
        stats.append(_merge_all([row["stats"] for row in rows]))
        split, _, _ = name.rpartition("-")
        episodes_of_split[split] += len(rows)
        episode, index = layout.episode + len(rows), rows[-1]["dataset_to_index"]
        layout = replace(layout, file=layout.file + 1, episode=episode, index=index)
    ends = dict(zip(episodes_of_split, itertools.accumulate(episodes_of_split.values()), strict=True))
    info = {
        "codebase_version": VERSION, "robot_type": "cosfly_drone", "total_episodes": layout.episode,
        "total_frames": layout.index, "total_tasks": len(tasks), "chunks_size": CHUNK, "fps": layout.fps,
        "splits": {split: f"{end - episodes_of_split[split]}:{end}" for split, end in ends.items()},
        "data_path": DATA_PATH, "video_path": VIDEO_PATH if cfg.video else None, "features": features,
        "data_files_size_in_mb": cfg.shard_mb, "video_files_size_in_mb": cfg.shard_mb,
    }  # fmt: skip
    write_bytes(folder / "meta/stats.json", dump_json(_merge_all(stats), indent=4).encode())
    write_bytes(folder / "meta/info.json", dump_json(info, indent=4).encode())
    _write_tasks(folder / "meta/tasks.parquet", list(tasks))
    facts = {"num_episodes": layout.episode, "fps": layout.fps, "has_depth": "depth" in source.modalities}
    return FormatFacts(facts, split_files={"train": "data/*/*.parquet"})


def _episodes(source: ExportSource, tasks: dict[str, int]) -> Iterator[SourceTrack]:
    """Yield the tracks, cut at gaps between their frames, and give their new tasks the next numbers in `tasks`."""
    for track in source.tracks():
        decisions = {row["decision"] or "" for row in track.rows}
        if unknown := decisions - {"", *TOKENS}:
            raise not_in_set(", ".join(sorted(unknown))[:200], track.name)
        for decision in ("", *TOKENS):
            if decision in decisions:
                tasks.setdefault(task_of(track.rows[0]["goal_en"] or "", decision), len(tasks))
        gaps = np.flatnonzero(np.diff(track.frame_index) != 1) + 1
        yield from track.cut([0, *gaps.tolist(), len(track)])


def _write_tasks(path: Path, tasks: list[str]) -> None:
    """Write the table of tasks, whose texts lerobot reads as the index of a data frame."""
    import pandas as pd

    buffer = io.BytesIO()
    pd.DataFrame({"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task")).to_parquet(buffer)
    write_bytes(path, buffer.getvalue())


def _fps(record: ReleaseRecord) -> int:
    """Return the number of frames per second; it must be whole and the same in all tracks."""
    steps_s = [float(step) for step in record.numbers.of("step_s")]  # rounded to milliseconds
    num_steps = sum(track.frames_available - 1 for track in record.flights)
    duration = record.numbers.spreads.get("track_duration_s", Spread())
    total_s = (duration.mean or 0.0) * duration.count
    fps = 0 if steps_s else PAPER_FPS  # tracks of one frame have no steps
    if total_s > STEP_TOLERANCE_S:
        fps = round(num_steps / total_s)
    if any(abs(step - 1 / (fps or 1)) > STEP_TOLERANCE_S for step in steps_s):
        what = "LeRobot needs a whole number of frames per second, the same in all tracks"
        raise InputError(what, where="time_s", got=f"steps of {', '.join(map(str, sorted(steps_s)[:10]))} s")
    return fps


def _write_file(
    source: ExportSource, episodes: Iterable[SourceTrack], layout: Layout, features: dict[str, Any],
    tasks: dict[str, int], folder: Path, advance: Advance,
) -> list[dict[str, Any]]:  # fmt: skip
    """Write a data file, its videos, and its part of the table of episodes; return the rows of that table."""
    schema = schema_of(features)
    cameras = [name for name, feature in features.items() if feature["dtype"] == "video"]
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    options: dict[str, Any] = {"compression": "zstd", "use_dictionary": texts, "write_statistics": ["episode_index"]}
    rows: list[dict[str, Any]] = []
    first = layout.index
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(atomic_file(folder / DATA_PATH.format(**layout.place)))
        table = stack.enter_context(pq.ParquetWriter(file, schema, **options))
        paths = {name: folder / VIDEO_PATH.format(video_key=name, **layout.place) for name in cameras}
        videos = {name: stack.enter_context(video_writer(path, layout)) for name, path in paths.items()}
        data_file = DataFile(layout, features, tasks, table, videos)
        for number, episode in enumerate(episodes, layout.episode):
            rows.append(_write_episode(source, episode, number, first, data_file, advance))
            first += len(episode)
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([_flat_row(row, layout, cameras) for row in rows]), buffer)
    write_bytes(folder / EPISODES_PATH.format(**layout.place), buffer.getvalue())
    return rows


@contextlib.contextmanager
def video_writer(path: Path, layout: Layout) -> Iterator[Callable[[np.ndarray], None]]:
    """Open the video of a camera; yield the function that adds a picture, (h, w, 3) uint8 RGB."""
    try:
        import av
    except ImportError:
        raise EnvironmentMissing("--video needs PyAV", fix="pip install av, or export without --video") from None
    with atomic_file(path) as file, av.open(file, "w", format="mp4") as container:
        stream = container.add_stream(CODEC, layout.fps, options=CODEC_OPTIONS)
        stream.width, stream.height = layout.size_px
        stream.pix_fmt = "yuv420p"
        yield lambda picture: container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def _write_episode(
    source: ExportSource, track: SourceTrack, number: int, first: int, file: DataFile, advance: Advance
) -> dict[str, Any]:
    """Write the rows and pictures of an episode; return its row of the table of episodes."""
    layout, table, videos = file.layout, file.table, file.videos
    if track.size_px != layout.size_px:
        problem, fix = "the lerobot export needs pictures of one size", "build one release for each size"
        got, expected = ("{} x {} px".format(*size) for size in (track.size_px, layout.size_px))
        raise InputError(problem, where=track.name, got=got, expected=expected, fix=fix)
    n = len(track)
    tasks = [task_of(row["goal_en"] or "", row["decision"] or "") for row in track.rows]
    values = values_of(track.rows, number, first, layout.fps, [file.tasks[task] for task in tasks])
    sampled = {int(i) for i in np.linspace(0, n - 1, min(n, SAMPLED_FRAMES)).round()}  # frames whose pixels count
    pixels: dict[str, list[np.ndarray]] = {CAMERAS[modality]: [] for modality in source.modalities}
    frames = track.frames()
    for start in range(0, n, ROWS_HELD):
        images: dict[str, list[Any]] = {name: [] for name in pixels}
        for i, (row, pictures) in enumerate(itertools.islice(frames, ROWS_HELD), start):
            for modality in source.modalities:
                name, data = CAMERAS[modality], pictures[modality]
                if name in videos:
                    videos[name](colours_of(data, row["sample_id"]))
                else:
                    images[name].append(_image(data, row["sample_id"], modality))
                if i in sampled:
                    pixels[name].append(_pixels(data, row["sample_id"], modality))
            advance(1)
        part = slice(start, start + ROWS_HELD)
        columns = {name: images.get(name) or list(values[name][part]) for name in table.schema.names}
        table.write_table(pa.Table.from_pydict(columns, schema=table.schema))
    stats = {name: summarize(np.concatenate(parts), len(parts), is_picture=True) for name, parts in pixels.items()}
    for name, feature in file.features.items():
        if name not in pixels and feature["dtype"] != "string":
            stats[name] = summarize(np.asarray(values[name], dtype=np.float64).reshape(n, -1), n)
    return {
        "episode_index": number, "tasks": list(dict.fromkeys(tasks)), "length": n, "track": track.name,
        "split": track.split, "first_frame": track.frame_index[0], "dataset_from_index": first,
        "dataset_to_index": first + n, "stats": stats,
    }  # fmt: skip


def _image(data: bytes, name: str, file: FrameFile) -> dict[str, Any]:
    """Return a cell of a picture: the released PNG, or depth as TIFF."""
    if file != "depth":
        return {"bytes": data, "path": f"{name}.{file}.png"}
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(parse_array(data, name, dtype=np.float32, ndim=2)).save(buffer, "TIFF")
    return {"bytes": buffer.getvalue(), "path": f"{name}.depth.tiff"}


def _pixels(data: bytes, name: str, file: FrameFile) -> np.ndarray:
    """Return a part of the pixels, (k, channels) float64: colours from 0 to 1, depth in metres."""
    if file == "depth":
        depth = parse_array(data, name, dtype=np.float32, ndim=2)
        return depth[::PIXEL_STEP, ::PIXEL_STEP].reshape(-1, 1).astype(np.float64)
    return colours_of(data, name)[::PIXEL_STEP, ::PIXEL_STEP].reshape(-1, 3) / 255.0


def _flat_row(row: dict[str, Any], layout: Layout, cameras: list[str]) -> dict[str, Any]:
    """Return a row of the table of episodes with its files, the times in its videos, and flat statistics."""
    begin_s = (row["dataset_from_index"] - layout.index) / layout.fps
    end_s = begin_s + row["length"] / layout.fps
    flat = {name: value for name, value in row.items() if name != "stats"}
    for folder in ("data", "meta/episodes", *(f"videos/{name}" for name in cameras)):
        flat |= {f"{folder}/{name}": value for name, value in layout.place.items()}
    for name in cameras:
        flat |= {f"videos/{name}/from_timestamp": begin_s, f"videos/{name}/to_timestamp": end_s}
    for name, summary in row["stats"].items():
        flat |= {f"stats/{name}/{statistic}": values for statistic, values in summary.items()}
    return flat
