"""COCO: the boxes and masks of the people in the pictures, for pycocotools and detectors.

    annotations/instances_train.json, train/trajectory_1_ORI_frame_00000.png

Masks and boxes are those of the pixels in `instance.png`, as run-length codes that pycocotools encodes when it loads
them. The target and the other people are two categories of the supercategory person.
"""

import itertools
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.frames import PERSON_ID, FrameFile
from cosfly.formats.kinds import KINDS
from cosfly.runtime.console import Advance
from cosfly.runtime.io import atomic_file, write_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.png import colours_of
from release.columns import BOX, SplitName
from release.export.stage import ExportConfig, ExportSource, FormatFacts
from release.reading import Row

TARGET, OTHER = 1, 2
CATEGORIES = [
    {"id": TARGET, "name": "target", "supercategory": "person"},
    {"id": OTHER, "name": "other person", "supercategory": "person"},
]
MOST_IDS = 1 << 16  # of instances in a picture; the id of an annotation is picture id * MOST_IDS + instance id


def write(source: ExportSource, folder: Path, cfg: ExportConfig, advance: Advance) -> FormatFacts:
    """Write the pictures, and the annotations as one file a split."""
    record = source.record
    about = {
        "info": {"description": record.name, "contributor": record.credits, "version": record.content_digest},
        "licenses": [{"id": 1, "name": record.licence, "url": ""}], "categories": CATEGORIES,
    }  # fmt: skip
    image_ids = itertools.count(1)
    num_people = 0
    splits: list[SplitName] = []
    for split, tracks in itertools.groupby(source.tracks(), lambda track: track.split):
        splits.append(split)
        path = folder / f"annotations/instances_{split}.json"
        # The annotations follow all images in the file, so that they are kept in another one until then.
        with atomic_file(path) as file, tempfile.TemporaryFile(dir=folder) as annotations_file:
            file.write(dump_json(about)[:-1].encode() + b',"images":[')
            frames = ((track.name, *frame) for track in tracks for frame in track.frames())
            for number, (name, row, pictures) in enumerate(frames):
                image, annotations = _annotate(name, row, pictures, next(image_ids), folder / split)
                file.write((b",\n" if number else b"") + dump_json(image).encode())
                for annotation in annotations:
                    separator = b",\n" if annotations_file.tell() else b""
                    annotations_file.write(separator + dump_json(annotation).encode())
                num_people += len(annotations)
                advance(1)
            file.write(b'],\n"annotations":[')
            annotations_file.seek(0)
            shutil.copyfileobj(annotations_file, file)
            file.write(b"]}\n")
    return FormatFacts({"num_people": num_people, "first_split": splits[0]})


def _annotate(
    track: str, row: Row, pictures: dict[FrameFile, bytes], image_id: int, folder: Path
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Write the picture of a row; return its image and the annotations of its people."""
    name = f"{row['sample_id']}.png"
    write_bytes(folder / name, pictures["rgb"])
    image = {
        "id": image_id, "file_name": name, "width": row["width_px"], "height": row["height_px"],
        "track": track, "frame_index": row["frame_index"],
    }  # fmt: skip
    instances = colours_of(pictures["instance"], row["sample_id"])
    return image, list(people_in(row, instances, image_id))


def people_in(row: Row, instances: np.ndarray, image_id: int) -> Iterator[dict[str, Any]]:
    """Yield the annotation of each person with a pixel in the instance picture of a row, (h, w, 3) uint8."""
    kind, low, high = np.moveaxis(instances, 2, 0)
    is_person = kind == KINDS["Pedestrians"]
    ids = low | high.astype(np.uint16) << 8
    people = np.unique(ids[is_person]).tolist()
    target = PERSON_ID if PERSON_ID in people else _most_in_box(np.where(is_person, ids.astype(np.int64), -1), row)
    for person in people:
        mask = is_person & (ids == person)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        x, y = int(columns[0]), int(rows[0])
        annotation = {
            "id": image_id * MOST_IDS + person, "image_id": image_id,
            "category_id": TARGET if person == target else OTHER,
            "bbox": [x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1], "area": int(mask.sum()), "iscrowd": 0,
            "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)}, "instance_id": person,
        }  # fmt: skip
        if person == target:
            annotation["visibility"] = row["visibility"]
        yield annotation


def _most_in_box(ids: np.ndarray, row: Row) -> int | None:
    """Return the person with most pixels in the box of the target; `ids`, (h, w) int64, are -1 outside of people."""
    box = row["target_mask_bbox"]
    if box is None and row["perturbation"] is None:  # not of cosfly, whose targets have PERSON_ID in the picture
        box = row["target_bbox"]
    if box is None:
        return None
    xmin, ymin, xmax, ymax = (max(0, round(box[name])) for name in BOX)
    people, counts = np.unique(ids[ymin:ymax, xmin:xmax], return_counts=True)
    counts[people < 0] = 0
    return int(people[counts.argmax()]) if counts.any() else None


def run_lengths(mask: np.ndarray) -> list[int]:
    """Return the lengths of the runs of a mask by columns; the first run is outside the mask, perhaps of length 0."""
    flat = mask.ravel(order="F")
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    begin = [0, 0] if flat[0] else [0]
    return np.diff([*begin, *edges.tolist(), len(flat)]).tolist()
