"""Captioned windows for training code of one's own: frames, facts, caption, from a playback tree, a run or a release.

`Windows` needs no torch and gives NumPy arrays; `WindowDataset` the same as tensors. Both are map-style data sets,
pickle, and open their files anew in each process, so they go into a `DataLoader` with workers as they are. Right-handed
axes, as in a release.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypedDict, get_args

import cv2
import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from cosfly.formats.captions import FIELDS, Language, Prompt, read_captions
from cosfly.formats.frames import frame_name
from cosfly.formats.playback import Track, read_track
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, InputError, nearest, shown
from cosfly.runtime.io import check_stays_below, inside
from cosfly.runtime.json_io import read_object, validated
from cosfly.runtime.png import colours_of
from cosfly.runtime.tables import TableRows, open_table, rows_of
from cosfly.viz.frame_views import VIEW_FILES, Pictures, read_view, scaled_size

# What is known of each frame, as the columns of a release are called: members of a struct, "" for a number.
FACTS: dict[str, tuple[str, ...]] = {
    "time_s": ("",),
    "pose": ("x_m", "y_m", "z_m", "pitch_deg", "yaw_deg", "roll_deg"),
    "intrinsics": ("fx", "fy", "cx", "cy"),
    "target": ("x_m", "y_m", "z_m"),
    "target_uv": ("u_px", "v_px"),
    "target_bbox": ("xmin_px", "ymin_px", "xmax_px", "ymax_px"),
    "target_mask_bbox": ("xmin_px", "ymin_px", "xmax_px", "ymax_px"),
    "target_depth_m": ("",),
    "target_in_view": ("",),
    "target_visible": ("",),
    "visibility": ("",),
}
FLAGS = ("target_in_view", "target_visible")
PLACE = ("run", "town", "trajectory", "variant")


@dataclass(frozen=True)
class WindowPlace:
    """A window before it is read: its flight, its frames, and where its caption and they stand in the source."""

    sample_id: str
    flight: tuple[str, ...]
    window: tuple[int, ...]
    where: Any


@dataclass(frozen=True)
class ReadWindow:
    """What a source knows of a window. pictures: of its frames, (h, w, 3). size_px: (width, height) for the teacher."""

    pictures: list[np.ndarray]
    facts: dict[str, np.ndarray]
    prompt: dict[str, str]
    caption: dict[str, str]
    size_px: tuple[int, int]


class WindowSource(Protocol):
    def places(self, left_out: Counter[str]) -> Iterator[WindowPlace]: ...

    def read(self, place: WindowPlace) -> ReadWindow: ...


def open_source(source: Path, captions: Path | None, language: Language, split: str | None) -> WindowSource:
    """Open a release, a run, or a playback tree with its captions; arguments as of `Windows`."""
    # A run is taken as its tree, which holds all of it, unless a split of its release is asked for.
    released = [source, source / "dataset", *([source / "release/dataset"] if split else [])]
    for folder in released if captions is None else ():
        if (folder / "release.json").is_file():
            return _Release(folder, language, split)
    if split is not None:
        fix = "build a release with cosfly release build, or omit split"
        raise ConfigError("only a release has splits", where=source, got=f"split={split!r}", fix=fix)
    if captions is None and (source / "render").is_dir():
        source, captions = source / "render", source / "caption/captions.jsonl"
        check_stays_below(captions, captions.parent)
    if captions is None:
        fix = "for a playback tree, pass its captions too: Windows(tree, captions)"
        raise InputError("the source is neither a release nor a run directory", where=source, fix=fix)
    return _Tree(source, captions, language)


def _prompt(text: Prompt, size_px: tuple[int, int], language: Language) -> dict[str, str]:
    told = text.told(Pictures(("rgb",), size_px).sentence(language))
    return {"system": told.system, "user": told.user}


class _Tree:
    """A playback tree and its captions, whose texts stay in memory: some 4 kB a window."""

    def __init__(self, tree: Path, captions: Path, language: Language) -> None:
        self.tree, self.captions, self.language = tree, captions, language
        self.run = tree.absolute().parent.name
        self._flights: dict[Path, Track] = {}

    def places(self, left_out: Counter[str]) -> Iterator[WindowPlace]:
        whole: dict[Path, set[int]] = {}
        for caption in read_captions(self.captions):
            folder = inside(self.tree, f"{caption.town}/{caption.trajectory}/{caption.variant}", in_parent=True)
            if folder not in whole:
                whole[folder] = _frames_in(folder)
            if caption.status != "accepted":
                left_out[f"dropped_{caption.drop_reason}"] += 1
            elif getattr(caption, self.language) is None or self.language not in caption.prompt:
                left_out[f"no_{self.language}"] += 1
            elif not whole[folder].issuperset(caption.window):
                left_out["missing_frame"] += 1
            else:
                prompt = _prompt(caption.prompt[self.language], caption.picture_px, self.language)
                texts = getattr(caption, self.language).model_dump()
                texts |= {"label": caption.label or "", "verdict": caption.verdict or ""}
                flight, where = (self.run, *folder.parts[-3:]), (folder, prompt, texts, caption.picture_px)
                yield WindowPlace(caption.sample_id, flight, tuple(caption.window), where)

    def read(self, place: WindowPlace) -> ReadWindow:
        folder, prompt, caption, size_px = place.where
        if folder not in self._flights:
            self._flights[folder] = read_track(folder, strict=False)
        pictures = [read_view(folder / frame_name(index), "rgb") for index in place.window]
        return ReadWindow(pictures, facts_of(self._flights[folder], place.window), prompt, caption, size_px)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_flights": {}}  # a process reads what it needs


def _frames_in(folder: Path) -> set[int]:
    """Return the frames of a flight that have a picture; none where it has no trajectory.json."""
    if not (folder / "trajectory.json").is_file():
        return set()
    frames = (folder / frame_name(0)).parent.glob("frame_*")
    return {int(f.name[6:]) for f in frames if f.name[6:].isdecimal() and (f / VIEW_FILES["rgb"]).is_file()}


def facts_of(flight: Track, window: Sequence[int]) -> dict[str, np.ndarray]:
    """Return FACTS of some frames of a flight."""
    if max(window) >= len(flight):
        raise InputError(
            "a caption refers to a frame that its track does not have", where=flight.folder, got=str(max(window))
        )
    at, mask = list(window), flight.target.mask_bbox
    values: dict[str, Any] = {
        "pose": np.hstack([flight.positions_m[at], flight.rotations_deg[at]]),
        "intrinsics": [flight.camera_at(i).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]] for i in at],
        "target": flight.targets_m[at],
        "target_mask_bbox": np.full((len(at), 4), np.nan) if mask is None else mask[at],
    }
    values |= {"time_s": flight.time_s[at], "visibility": flight.target.visibility[at]}
    of_target = ("uv", "bbox", "depth_m", "in_view", "visible")
    values |= {f"target_{name}": getattr(flight.target, name)[at] for name in of_target}
    return {name: np.array(values[name], dtype=bool if name in FLAGS else np.float64) for name in FACTS}


class _Shard(BaseModel):
    path: str
    split: str


class _Settings(BaseModel):
    selection: str


class _ReleasedTrack(BaseModel):
    frames: int
    frames_available: int


class _Record(BaseModel):
    """What is read of `release.json`."""

    shards: list[_Shard]
    settings: _Settings
    flights: list[_ReleasedTrack]


class _Release:
    """A release: rows by number, captions read when they are asked for."""

    def __init__(self, folder: Path, language: Language, split: str | None) -> None:
        self.folder, self.language = folder, language
        path = folder / "release.json"
        record = validated(_Record, read_object(path, what="release", tree=folder), path)
        shards = record.shards
        if record.settings.selection == "stride" and any(f.frames < f.frames_available for f in record.flights):
            raise InputError(
                "windows need consecutive frames, of which this release has a uniform stride only", where=folder,
                fix="build the release with --set release.selection=windows, or pass the run",
            )  # fmt: skip
        splits = sorted({shard.split for shard in shards})
        if split is not None and split not in splits:
            near, expected = nearest(split, splits), ", ".join(splits)
            raise ConfigError(
                f"the release has no split of this name{near}", where=folder, got=split, expected=expected
            )
        self._names = [shard.path for shard in shards if split in (None, shard.split)]
        texts = [f"caption_{language}_{field}" for field in FIELDS]
        prompts = [f"system_{language}", f"prompt_{language}"]
        self._columns = ["image", *FACTS, *texts, *prompts, "caption_picture_px", "label", "verdict"]
        self._shards = [TableRows(inside(folder, name), self._columns) for name in self._names]

    def places(self, left_out: Counter[str]) -> Iterator[WindowPlace]:
        text = f"caption_{self.language}_reasoning_trace"
        light = [*PLACE, "frame_index", "sample_id", "caption_window", text]
        for shard, name in enumerate(self._names):  # a flight stands in one shard, whole
            path = inside(self.folder, name)
            _check_columns(path, self.folder, [*self._columns, *light])
            rows: dict[tuple[str, ...], dict[int, int]] = {}
            captioned: list[tuple[tuple[str, ...], str, tuple[int, ...]]] = []
            for number, row in enumerate(rows_of(path, light, tree=self.folder)):
                flight = tuple(row[part] for part in PLACE)
                if None in (*flight, row["sample_id"], row["frame_index"]):
                    raise InputError("the frame has no id", where=f"{path}: row {number}", got=shown(list(flight)))
                rows.setdefault(flight, {})[row["frame_index"]] = number
                if row[text] and row["caption_window"]:
                    captioned.append((flight, row["sample_id"], tuple(row["caption_window"])))
                elif row["caption_window"]:
                    left_out[f"no_{self.language}"] += 1
            for flight, sample_id, window in captioned:
                if rows[flight].keys() >= set(window):
                    where = shard, tuple(rows[flight][index] for index in window)
                    yield WindowPlace(sample_id, flight, window, where)
                else:
                    left_out["missing_frame"] += 1

    def read(self, place: WindowPlace) -> ReadWindow:
        shard, numbers = place.where
        rows = [self._shards[shard][number] for number in numbers]
        pictures = [_picture(row, f"{self._names[shard]}: {place.sample_id}") for row in rows]
        facts = {name: _column(rows, name, members) for name, members in FACTS.items()}
        last, language = rows[-1], self.language
        if not all(isinstance(last[f"{part}_{language}"], str) for part in ("system", "prompt")):
            raise InputError("the caption has no prompt", where=f"{self._names[shard]}: {place.sample_id}")
        prompt = Prompt(system=last[f"system_{language}"], user=last[f"prompt_{language}"])
        width_px, height_px = (last["caption_picture_px"] or pictures[-1].shape[1::-1])[:2]
        caption = {field: last[f"caption_{language}_{field}"] or "" for field in FIELDS}
        told = {name: last[name] or "" for name in ("label", "verdict")}
        size_px = (width_px, height_px)
        return ReadWindow(pictures, facts, _prompt(prompt, size_px, language), caption | told, size_px)


# Types of the columns that are read: all others are texts.
TYPES: dict[str, pa.DataType] = {
    **{name: pa.struct([(m, pa.float64()) for m in members]) for name, members in FACTS.items() if len(members) > 1},
    **{name: pa.float64() for name, members in FACTS.items() if len(members) == 1},
    **dict.fromkeys(FLAGS, pa.bool_()),
    **dict.fromkeys(("caption_window", "caption_picture_px"), pa.list_(pa.int32())),
    "image": pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
    "frame_index": pa.int32(),
}


def _check_columns(path: Path, tree: Path, wanted: Sequence[str]) -> None:
    """Check that a shard has columns as they are read."""
    with open_table(path, tree=tree) as table:
        found = {field.name: field.type for field in table.schema_arrow}
    if wrong := ", ".join(name for name in wanted if found.get(name) != TYPES.get(name, pa.string())):
        fix = "build the release with this version of cosfly, or download it with --modality rgb"
        raise InputError("columns are missing or have the wrong type", where=path, got=wrong[:200], fix=fix)


def _picture(row: Mapping[str, Any], where: str) -> np.ndarray:
    data = row["image"] and row["image"]["bytes"]
    if not data:
        raise InputError("the frame has no picture", where=where, fix="download the release with --modality rgb")
    return colours_of(data, where)


def _column(rows: Sequence[Mapping[str, Any]], name: str, members: tuple[str, ...]) -> np.ndarray:
    if name in FLAGS:
        return np.array([bool(row[name]) for row in rows])
    if members == ("",):
        return np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=np.float64)
    nothing = dict.fromkeys(members, np.nan)
    return np.array([[(row[name] or nothing)[member] for member in members] for row in rows], dtype=np.float64)


class WindowData(TypedDict):
    """One window of k frames.

    flight: run/town/trajectory/variant. window: (k,) int64, frames of the flight, the caption's own last. frames: (k,
    3, h, w) uint8 RGB. facts: FACTS, (k, members) or (k,) float64, NaN where it is not known;
    FLAGS (k,) bool; pixels are those of the unscaled frame. prompt: system and user. caption: the three texts, `label`
    and `verdict`; "" where there is none.
    """

    sample_id: str
    flight: str
    window: np.ndarray
    frames: np.ndarray
    facts: dict[str, np.ndarray]
    prompt: dict[str, str]
    caption: dict[str, str]


class Windows(Sequence[WindowData]):
    """The accepted captions of a source with the frames that they were made of, in the order of the source.

    Args:
        source: a release (or its `dataset/`), a run folder, or a playback tree; then `captions` names its
            captions.jsonl.
        language: of prompt and caption. split: of a release `train`, `validation` or `test`; None takes all.
        max_side_px: frames are scaled down to this longest side; None takes the size that pixels in prompt and caption
            refer to.
    """

    def __init__(
        self, source: str | Path, captions: str | Path | None = None, *, language: Language = "en",
        split: str | None = None, max_side_px: int | None = None,
    ) -> None:  # fmt: skip
        if language not in get_args(Language):
            raise ConfigError(
                "there are no captions in this language", got=str(language), expected=", ".join(get_args(Language))
            )
        if max_side_px is not None and max_side_px < 1:
            raise ConfigError(
                "the picture size is not positive", where="max_side_px", got=max_side_px, expected="1 or more"
            )
        self.max_side_px = max_side_px
        source = Path(source) if isinstance(source, str) else source
        captions = Path(captions) if isinstance(captions, str) else captions
        self._source = open_source(source, captions, language, split)
        self.left_out = Counter[str]()  # captions that give no window, by reason
        self._places = list(self._source.places(self.left_out))
        if not self._places:
            why = ", ".join(f"{reason} {count}" for reason, count in self.left_out.items()) or "no captions"
            expected = f"accepted captions in {language!r} whose frames exist"
            raise InputError("the source has no usable window", where=source, got=why, expected=expected)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> WindowData:  # type: ignore[override]  # one window at a time
        place = self._places[index]
        read = self._source.read(place)
        sizes = {picture.shape for picture in read.pictures}
        if len(sizes) != 1:
            raise InputError("the frames of a window differ in size", where=place.sample_id, got=str(sorted(sizes)))
        height_px, width_px = read.pictures[0].shape[:2]
        size = scaled_size(width_px, height_px, self.max_side_px or max(read.size_px))
        frames = read.pictures
        if size != (width_px, height_px):
            frames = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in frames]
        return WindowData(
            sample_id=place.sample_id, flight="/".join(place.flight), window=np.array(place.window, dtype=np.int64),
            frames=np.ascontiguousarray(np.stack(frames).transpose(0, 3, 1, 2)), facts=read.facts, prompt=read.prompt,
            caption=read.caption,
        )  # fmt: skip


class WindowDataset(Windows):
    """Captioned windows as tensors, a map-style data set for PyTorch's `DataLoader`; arguments as of `Windows`."""

    def __init__(self, source: str | Path, captions: str | Path | None = None, **options: Any) -> None:
        if importlib.util.find_spec("torch") is None:
            raise EnvironmentMissing("PyTorch is not installed", fix="pip install 'cosfly[distill]'")
        super().__init__(source, captions, **options)

    def __getitem__(self, index: int) -> dict[str, Any]:  # type: ignore[override]
        import torch

        window = super().__getitem__(index)
        facts = {name: torch.from_numpy(value) for name, value in window["facts"].items()}
        arrays = {"window": window["window"], "frames": window["frames"]}
        return {**window, "facts": facts, **{name: torch.from_numpy(array) for name, array in arrays.items()}}
