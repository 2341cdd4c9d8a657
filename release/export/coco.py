"""COCO: the boxes and masks of the people in the pictures, for pycocotools and detectors.

    annotations/instances_train.json, train/trajectory_1_ORI_frame_00000.png

Masks and boxes are those of the pixels in `instance.png`, as run-length codes that pycocotools encodes when it loads
them. The target and the other people are two categories of the supercategory person.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.frames import PERSON_ID
from cosfly.formats.kinds import KINDS
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_file, read_lines, write_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.png import colours_of
from cosfly.runtime.worker import advance
from release.columns import BOX, PICTURES, SPLIT_NAMES
from release.export.source import PART, ExportSource, Row
from release.export.stage import (
    Done,
    ExportConfig,
    ExportUnit,
    FormatFacts,
    scratch_of,
    track_units,
    write_joined,
)

TARGET, OTHER = 1, 2
CATEGORIES = [
    {"id": TARGET, "name": "target", "supercategory": "person"},
    {"id": OTHER, "name": "other person", "supercategory": "person"},
]
IDS = 1 << 16  # of instances in a picture; the id of an annotation is that of its picture times this, plus its instance
COLUMNS = [
    "sample_id", "frame_index", "width_px", "height_px", "target_bbox", "target_mask_bbox", "perturbation",
    "visibility", PICTURES["rgb"].name, PICTURES["instance"].name,
]  # fmt: skip


def plan(source: ExportSource, cfg: ExportConfig) -> list[ExportUnit]:
    """Return one unit per track; its `extra` is the id of its first picture."""
    units, first = [], 1
    for unit in track_units(source):
        units.append(replace(unit, extra=first))
        first += unit.frames
    return units


def write(source: ExportSource, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> dict[str, Any]:
    """Write the pictures of one track, and its images and annotations as lines of two files for `finish`."""
    track, num_people = unit.track, 0
    with atomic_file(_lines(folder, unit, "images")) as images, atomic_file(_lines(folder, unit, "people")) as people:
        for image_id, row in enumerate(track.rows(COLUMNS), unit.extra):
            if not PART.fullmatch(row["sample_id"]):
                raise InputError("the sample_id of a frame is not a file name", where=unit.name, got=row["sample_id"])
            name = f"{row['sample_id']}.png"
            write_bytes(folder / unit.split / name, track.picture(row, "rgb"))
            image = {
                "id": image_id, "file_name": name, "width": row["width_px"], "height": row["height_px"],
                "track": unit.name, "frame_index": row["frame_index"],
            }  # fmt: skip
            images.write((dump_json(image) + "\n").encode())
            instances = colours_of(track.picture(row, "instance"), row["sample_id"])
            for annotation in people_in(row, instances, image_id):
                people.write((dump_json(annotation) + "\n").encode())
                num_people += 1
            advance()
    return {"people": num_people}


def _lines(folder: Path, unit: ExportUnit, kind: str) -> Path:
    return scratch_of(folder) / f"{unit.file_name}.{kind}.jsonl"


def people_in(row: Row, instances: np.ndarray, image_id: int) -> Iterator[dict[str, Any]]:
    """Yield the annotation of each person with a pixel in the instance picture of a row, (h, w, 3) uint8."""
    red, green, blue = np.moveaxis(instances, 2, 0)
    is_person, ids = red == KINDS["Pedestrians"], green | blue.astype(np.uint16) << 8
    people = np.unique(ids[is_person]).tolist()
    target = PERSON_ID if PERSON_ID in people else _most_in_box(np.where(is_person, ids.astype(np.int64), -1), row)
    for person in people:
        mask = is_person & (ids == person)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        x, y = int(columns[0]), int(rows[0])
        found = {
            "id": image_id * IDS + person, "image_id": image_id, "category_id": TARGET if person == target else OTHER,
            "bbox": [x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1], "area": int(mask.sum()), "iscrowd": 0,
            "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)}, "instance_id": person,
        }  # fmt: skip
        yield found | ({"visibility": row["visibility"]} if person == target else {})


def _most_in_box(ids: np.ndarray, row: Row) -> int | None:
    """Return the person with most pixels in the box of the target. Only pictures of others need the projected box:
    cosfly's have the id PERSON_ID, and record the outcome of perturbations in each frame."""
    box = row["target_mask_bbox"] or (row["target_bbox"] if row["perturbation"] is None else None)
    if box is None:
        return None
    xmin, ymin, xmax, ymax = (max(0, round(box[name])) for name in BOX)
    found, counts = np.unique(ids[ymin:ymax, xmin:xmax], return_counts=True)
    counts[found < 0] = 0
    return int(found[counts.argmax()]) if counts.any() else None


def run_lengths(mask: np.ndarray) -> list[int]:
    """Return the lengths of the runs of a mask by columns; the first run is outside the mask, perhaps of length 0."""
    flat = mask.ravel(order="F")
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    starts = [0, *([0] if flat[0] else []), *edges.tolist(), len(flat)]
    return np.diff(starts).tolist()


def finish(source: ExportSource, done: Done, folder: Path, cfg: ExportConfig) -> FormatFacts:
    """Write the annotations, one file a split."""
    record = source.record
    about = {
        "info": {"description": record.name, "contributor": record.credits, "version": record.content_digest},
        "licenses": [{"id": 1, "name": record.licence, "url": ""}], "categories": CATEGORIES,
    }  # fmt: skip
    used = [split for split in SPLIT_NAMES if any(unit.split == split for unit, _ in done)]
    for split in used:
        own = [unit for unit, _ in done if unit.split == split]
        with atomic_file(folder / f"annotations/instances_{split}.json") as file:
            file.write(dump_json(about)[:-1].encode())
            for kind, key, end in (("images", b',"images":[', b"],\n"), ("people", b'"annotations":[', b"]}\n")):
                lines = (line.rstrip() for unit in own for line in read_lines(_lines(folder, unit, kind)))
                file.write(key)
                write_joined(file, lines, b",\n")
                file.write(end)
    num_people, num_frames = sum(counts["people"] for _, counts in done), sum(unit.frames for unit, _ in done)
    return FormatFacts(
        format_version="instances",
        codings={
            "pictures": "PNG, the released bytes",
            "masks": "run lengths of the pixels in instance.png; boxes enclose these pixels",
        },
        notes=[
            f"{num_people:,} people in {num_frames:,} pictures. file_name is relative to the folder of the split; "
            "instance_id is the same person through a track.",
        ],
        how_to_open=f'from pycocotools.coco import COCO\ncoco = COCO("annotations/instances_{used[0]}.json")',
    )
