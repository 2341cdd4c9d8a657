"""The captioned windows of a release for your own training code: frames, facts, caption.

`WindowDataset` needs no torch: it gives NumPy arrays, which the default collation of PyTorch's `DataLoader` turns into
tensors. It is a map-style data set that pickles; each worker opens the files again.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import cv2
import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from cosfly.formats.captions import FIELDS, Language, Prompt
from cosfly.runtime.errors import ConfigError, InputError, nearest, shown
from cosfly.runtime.io import inside
from cosfly.runtime.json_io import read_object, validated
from cosfly.runtime.png import colours_of
from cosfly.runtime.tables import TableRows, open_table, rows_of
from cosfly.viz.frame_views import Pictures, scaled_size

# The facts of a frame, as the columns of a release are called: members of a struct, none for a number.
XYZ, BOX = ("x_m", "y_m", "z_m"), ("xmin_px", "ymin_px", "xmax_px", "ymax_px")
FACTS: dict[str, tuple[str, ...]] = {
    "time_s": (), "pose": (*XYZ, "pitch_deg", "yaw_deg", "roll_deg"), "intrinsics": ("fx", "fy", "cx", "cy"),
    "target": XYZ, "target_uv": ("u_px", "v_px"), "target_bbox": BOX, "target_mask_bbox": BOX, "target_depth_m": (),
    "target_in_view": (), "target_visible": (), "visibility": (),
}  # fmt: skip
FLAGS = ("target_in_view", "target_visible")
PLACE = ("run", "town", "trajectory", "variant")
# Types of the columns; all others are texts.
TYPES: dict[str, pa.DataType] = {
    **{name: pa.struct(dict.fromkeys(members, pa.float64())) for name, members in FACTS.items() if members},
    **{name: pa.float64() for name, members in FACTS.items() if not members},
    **dict.fromkeys(FLAGS, pa.bool_()),
    **dict.fromkeys(("caption_window", "caption_picture_px"), pa.list_(pa.int32())),
    "image": pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
    "frame_index": pa.int32(),
}


class WindowData(TypedDict):
    """One window of k frames."""

    sample_id: str
    flight: str  # the track: run/town/trajectory/variant
    window: np.ndarray  # (k,) int64, frames of the track, the caption's own last
    frames: np.ndarray  # (k, 3, h, w) uint8 RGB, in the size to which pixels in prompt and caption refer
    # FACTS, (k, members) or (k,) float64, NaN if unknown; FLAGS, (k,) bool. Pixels refer to the unscaled frame.
    facts: dict[str, np.ndarray]
    prompt: dict[str, str]  # system and user
    caption: dict[str, str]  # the three texts, `label` and `verdict`; "" if there is none


class WindowPlace(NamedTuple):
    """A window before it is read."""

    sample_id: str
    flight: tuple[str, ...]  # as PLACE
    window: tuple[int, ...]  # frames of the track
    shard: int  # number of the shard
    rows: tuple[int, ...]  # numbers of the rows of these frames in the shard


class _Shard(BaseModel):
    path: str
    split: str


class _Record(BaseModel):
    """The fields of `release.json` that are read."""

    shards: list[_Shard]


class WindowDataset(Sequence[WindowData]):
    """The accepted captions of a release with all of their frames, in the order of the release.

    Args:
        source: a release, its `dataset/`, or a run directory with a release.
        language: of prompt and caption.
        split: `train`, `validation` or `test`; None takes all.
    """

    def __init__(self, source: str | Path, *, language: Language = "en", split: str | None = None) -> None:
        self.language = language
        candidates = [Path(source, name) for name in ("", "dataset", "release/dataset")]
        releases = [folder for folder in candidates if (folder / "release.json").is_file()]
        if not releases:
            fix = "pass a release, or build one with cosfly release build"
            raise InputError("the source contains no release", where=source, expected="release.json", fix=fix)
        self.folder = releases[0]
        path = self.folder / "release.json"
        record = validated(_Record, read_object(path, what="release", tree=self.folder), path)
        splits = sorted({shard.split for shard in record.shards})
        if split is not None and split not in splits:
            what, expected = f"the release has no split of this name{nearest(split, splits)}", ", ".join(splits)
            raise ConfigError(what, where=self.folder, got=split, expected=expected)
        paths = [inside(self.folder, shard.path) for shard in record.shards if split in (None, shard.split)]
        texts = [f"caption_{language}_{field}" for field in FIELDS]
        prompts = [f"system_{language}", f"prompt_{language}"]
        self._columns = ["image", *FACTS, *texts, *prompts, "caption_picture_px", "label", "verdict"]
        self._shards = [TableRows(path, self._columns) for path in paths]
        self._places = [place for number, path in enumerate(paths) for place in self._places_in(number, path)]
        if not self._places:
            what = "the release has no usable window"
            expected = f"windows with all their frames and an accepted caption in {language!r}"
            fix = "build the release with --set release.selection=windows, which keeps consecutive frames"
            raise InputError(what, where=source, expected=expected, fix=fix)

    def _places_in(self, shard: int, path: Path) -> Iterator[WindowPlace]:
        """Yield the windows of a shard, which contains whole tracks."""
        text = f"caption_{self.language}_reasoning_trace"
        names = [*PLACE, "frame_index", "sample_id", "caption_window", text]
        with open_table(path, tree=self.folder) as table:
            types = {field.name: field.type for field in table.schema_arrow}
        if wrong := [name for name in (*self._columns, *names) if types.get(name) != TYPES.get(name, pa.string())]:
            fix = "build the release with this version of cosfly, or download it with --modality rgb"
            got = ", ".join(wrong)[:200]
            raise InputError("columns are missing or of the wrong type", where=path, got=got, fix=fix)
        row_numbers: dict[tuple[str, ...], dict[int, int]] = {}  # track -> frame -> number of its row
        captioned: list[WindowPlace] = []  # without the numbers of their rows
        for number, row in enumerate(rows_of(path, names, tree=self.folder)):
            flight = tuple(row[part] for part in PLACE)
            if None in (*flight, row["sample_id"], row["frame_index"]):
                raise InputError("a part of the id is null", where=f"{path}: row {number}", got=shown(list(flight)))
            row_numbers.setdefault(flight, {})[row["frame_index"]] = number
            if row[text] and row["caption_window"]:
                captioned.append(WindowPlace(row["sample_id"], flight, tuple(row["caption_window"]), shard, ()))
        for place in captioned:
            of_track = row_numbers[place.flight]
            if of_track.keys() >= set(place.window):
                yield place._replace(rows=tuple(of_track[index] for index in place.window))

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> WindowData:  # type: ignore[override]  # one window at a time
        place = self._places[index]
        rows = [self._shards[place.shard][number] for number in place.rows]
        last, language = rows[-1], self.language
        system, user = last[f"system_{language}"], last[f"prompt_{language}"]
        if not isinstance(system, str) or not isinstance(user, str):
            raise InputError("the caption has no prompt", where=place.sample_id, fix="caption the run again")
        if not all(row["image"] and row["image"]["bytes"] for row in rows):
            fix = "download the release with --modality rgb"
            raise InputError("a frame has no picture", where=place.sample_id, fix=fix)
        frames = [colours_of(row["image"]["bytes"], place.sample_id) for row in rows]
        if len({frame.shape for frame in frames}) != 1:
            raise InputError("the frames of a window differ in size", where=place.sample_id)
        height_px, width_px = frames[0].shape[:2]
        picture_px = tuple(last["caption_picture_px"] or (width_px, height_px))[:2]
        size = scaled_size(width_px, height_px, max(picture_px))
        if size != (width_px, height_px):
            frames = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames]
        sentence = Pictures(("rgb",), (picture_px[0], picture_px[1])).sentence(language)
        caption = {field: last[f"caption_{language}_{field}"] or "" for field in FIELDS}
        return WindowData(
            sample_id=place.sample_id, flight="/".join(place.flight), window=np.array(place.window, dtype=np.int64),
            frames=np.ascontiguousarray(np.stack(frames).transpose(0, 3, 1, 2)),
            facts={name: _column(rows, name) for name in FACTS},
            prompt=Prompt(system=system, user=user).filled(sentence).model_dump(),
            caption=caption | {name: last[name] or "" for name in ("label", "verdict")},
        )  # fmt: skip


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    """Return a fact of some frames, (k, members) or (k,); None becomes NaN or False."""
    members = FACTS[name]
    if members:
        return np.array([[(row[name] or {}).get(member) for member in members] for row in rows], dtype=np.float64)
    return np.array([row[name] for row in rows], dtype=bool if name in FLAGS else np.float64)
