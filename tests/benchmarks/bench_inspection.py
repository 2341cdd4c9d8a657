"""What the inspection of frames costs, by part, and against the plain way: processor-milliseconds a frame of one core.

    cosfly run quickstart --out work/bench -s pedestrians.num_paths=4
    python tests/benchmarks/bench_inspection.py work/bench

`ours` and `plain` take turns, frame by frame, so that other programs slow both: the plain way reads each file for its
checksum and again to decode it, decodes with OpenCV, and asks NumPy one question after the other. What compiles is run
before. The last lines are whole inspections of the run by two workers, on the clock: what they need with their start,
and while they are at work.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cosfly.geometry import mask_box, world_from_camera
from cosfly.inspection.frames import SMALL_PX, SMALL_ROWS
from cosfly.inspection.pixels import NUM_IDS, look_at, unpack
from cosfly.inspection.settings import InspectConfig
from cosfly.inspection.stage import run
from cosfly.products.flights import find_flights
from cosfly.products.frames import FILE_NAMES, frame_path, read_depth, read_instance, read_meta, read_rgb
from cosfly.products.playback import Flight, read_flight
from cosfly.reading.files import read_bytes, sha256_file
from cosfly.space.reprojection import View, compare_views
from cosfly.work.stage_events import read_events
from cosfly.work.store import sha256_bytes

NOBODY = np.zeros(NUM_IDS, dtype=np.bool_)


class Parts:
    """Processor seconds by part."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def time(self, part: str, work: Callable[[], Any]) -> Any:
        begin_s = time.process_time()
        result = work()
        self.seconds[part] += time.process_time() - begin_s
        return result


def ours(flight: Flight, i: int, before: View | None, parts: Parts) -> View:
    """What the inspection does with a frame."""
    folder = flight.frame_folder(i)
    paths = [frame_path(folder, name) for name in FILE_NAMES.values()]
    files = parts.time("ours: read", lambda: {path.name: read_bytes(path) for path in paths})
    parts.time("ours: sha256", lambda: [sha256_bytes(data) for data in files.values()])
    parts.time("ours: annotation", lambda: read_meta(folder))
    picture = parts.time("ours: unpack", lambda: unpack(files, folder))
    parts.time("ours: all pixels at once", lambda: look_at(picture, NOBODY, 0.99))
    parts.time(
        "ours: small picture, range of depth",
        lambda: (
            cv2.resize(picture.colours[::SMALL_ROWS], SMALL_PX, interpolation=cv2.INTER_AREA),
            picture.depth.min(),
            picture.depth.max(),
        ),
    )
    return parts.time("ours: against the frame before", lambda: _compare(flight, i, picture, before))


def _compare(flight: Flight, i: int, picture: Any, before: View | None) -> View:
    pose = world_from_camera(flight.positions_m[i], flight.rotations_deg[i])
    view = View(picture.depth, picture.instance, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy())
    if before is not None:
        matrix = flight.camera.intrinsic
        compare_views(before, view, np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]))
    return view


def plain(flight: Flight, i: int, parts: Parts) -> None:
    """The checks that need no other frame, in the plain way."""
    folder = flight.frame_folder(i)
    parts.time("plain: read, sha256", lambda: [sha256_file(frame_path(folder, name)) for name in FILE_NAMES.values()])
    parts.time("plain: annotation", lambda: read_meta(folder))
    parts.time(
        "plain: read, crc32", lambda: [zlib.crc32(read_bytes(folder / name)) for name in ("rgb.png", "instance.png")]
    )
    rgb = parts.time("plain: decode colours", lambda: read_rgb(folder))
    kinds, ids = parts.time("plain: decode instances", lambda: read_instance(folder))
    depth = parts.time("plain: read depth", lambda: read_depth(folder))
    parts.time(
        "plain: small picture, range of depth",
        lambda: (
            cv2.resize(rgb, SMALL_PX, interpolation=cv2.INTER_AREA),
            np.isfinite(depth).all(),
            depth.min(),
            depth.max(),
            (depth == 0).mean(),
        ),
    )
    parts.time("plain: surfaces", lambda: plain_surfaces(rgb, kinds, ids))
    parts.time("plain: person", lambda: mask_box(kinds == 12))


def plain_surfaces(rgb: np.ndarray, kinds: np.ndarray, ids: np.ndarray) -> tuple:
    """Equal neighbours by id, magenta, and ids that alternate in a row: what one compiled pass finds."""
    same_id = ids[:, 1:] == ids[:, :-1]
    equal = (rgb[:, 1:] == rgb[:, :-1]).all(axis=2) & same_id
    pairs = np.bincount(ids[:, 1:][same_id], minlength=NUM_IDS), np.bincount(ids[:, 1:][equal], minlength=NUM_IDS)
    magenta = ((rgb[..., 0] >= 200) & (rgb[..., 2] >= 200) & (rgb[..., 1] <= 60)).mean()
    stripes = (ids[:, :-3] == ids[:, 2:-1]) & (ids[:, 1:-2] == ids[:, 3:]) & (ids[:, :-3] != ids[:, 1:-2])
    return pairs, magenta, stripes.sum()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument(
        "--frames", type=int, default=60, help="frames of the first flight that are measured part by part"
    )
    parser.add_argument("--repeats", type=int, default=3, help="whole inspections")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    flight = read_flight(find_flights(given.run / "render")[0])
    count = min(given.frames, len(flight))
    for parts, num in ((Parts(), 2), (Parts(), count)):  # the first compiles
        before = None
        for i in range(num):
            before = ours(flight, i, before, parts)
            plain(flight, i, parts)
    for way in ("ours", "plain"):
        lines = {part: 1e3 * s / count for part, s in parts.seconds.items() if part.startswith(way)}
        for part, ms in lines.items():
            print(f"{part:45s} {ms:6.2f} ms")
        print(f"{way:45s} {sum(lines.values()):6.2f} ms, {2e3 / sum(lines.values()):.0f} frames/s on two cores\n")
    num_frames = sum(len(read_flight(folder)) for folder in find_flights(given.run / "render"))
    for _ in range(given.repeats):
        with tempfile.TemporaryDirectory() as scratch:
            begin_s = time.monotonic()
            inputs = [
                given.run / name for name in ("simplify/step2_simplified.json", "plan/drone_trace.json", "render")
            ]
            run(InspectConfig(), *inputs, Path(scratch) / "inspect", workers=2)
            whole_s = time.monotonic() - begin_s
            busy_s = sum(
                event.seconds or 0.0 for event in read_events(Path(scratch) / "inspect") if event.event == "item_done"
            )
        print(
            f"the stage by two workers: {num_frames} frames in {whole_s:.1f} s with start and page; at work "
            f"{1e3 * busy_s / num_frames:.2f} ms"
            f" a frame of one, {2 * num_frames / busy_s:.0f} frames/s of two"
        )


if __name__ == "__main__":
    main()
