"""How fast `release build` stores pictures, next to a copy of the same bytes with the digests that a release needs.

    python tests/benchmarks/bench_release.py 3200             # 1280x720, two processes for either

The tree is made of few frames, linked many times, so that it needs little disk; release and copy are written in full.
The copy reads the tree's files and writes them one after the other into one file a flight, flushed to disk at its end
as a shard is: the least that any copy does. It goes through the page cache, as copies do; a shard goes past it where
the file system can. Both read files that are in the page cache.
"""

import argparse
import dataclasses
import hashlib
import os
import shutil
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import scenes  # noqa: F401  # finds the specimens
from specimens_distill import make_captions

from cosfly.formats.frames import FILE_NAMES, FrameFile, depth_bytes, frame_name, instance_bytes, rgb_bytes
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import write_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.io import CHECKSUMS, checksum_lines, sha256_bytes
from release.build.config import ReleaseConfig
from release.build.sources import Source
from release.build.stage import run
from specimens import Scene, make_flight, paint

# Pictures; frames of a flight, as the paper's have, of which 400 are released.
NUM_POOL, NUM_POINTS, NUM_WORKERS = 8, 700, 2
FRAMES_RELEASED = 400
STORED: tuple[FrameFile, ...] = ("rgb", "instance")  # as they are; depth is compressed
SIZE_PX = (1280, 720)
MB = 1e6


def make_tree(root: Path, num_released: int) -> Path:
    """Write a tree of pairs of flights, of which so many frames are released at FRAMES_RELEASED a flight; gives it."""
    flight, scene = make_flight(NUM_POINTS, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    pool = [_paint_files(root / f"pool/{k}", flight, scene, k * 30) for k in range(NUM_POOL)]
    digests = [{name: sha256_bytes((folder / name).read_bytes()) for name in os.listdir(folder)} for folder in pool]
    for number in range(max(1, num_released // (2 * FRAMES_RELEASED))):
        away_m = np.array([0.0, 1000.0 * number, 0.0])  # a walk of its own
        chosen = np.random.default_rng(number).integers(NUM_POOL, size=NUM_POINTS).tolist()  # else it is a copy
        for variant in ("ORI", "aug_001"):
            trajectory = f"trajectory_{1_776_000_000 + number}"
            own = dataclasses.replace(
                flight, trajectory=trajectory, variant=variant, is_original=variant == "ORI",
                positions_m=flight.positions_m + away_m, targets_m=flight.targets_m + away_m,
            )  # fmt: skip
            folder = root / "tree/Town01" / trajectory / variant
            write_track(folder, own)
            listed = {"trajectory.json": sha256_bytes((folder / "trajectory.json").read_bytes())}
            for i in range(NUM_POINTS):
                (folder / frame_name(i)).mkdir(parents=True)
                for name, digest in digests[chosen[i]].items():
                    os.link(pool[chosen[i]] / name, folder / frame_name(i) / name)
                    listed[f"{frame_name(i)}/{name}"] = digest
            (folder / CHECKSUMS).write_text(checksum_lines(listed))
    make_captions(root / "captions.jsonl", root / "tree")
    return root / "tree"


def _paint_files(folder: Path, flight: Track, scene: Scene, i: int) -> Path:
    folder.mkdir(parents=True)
    rgb, depth, kinds, ids = paint(scene, flight, i)
    noise = np.random.default_rng(i).integers(-3, 4, rgb.shape)  # texture: without it a PNG packs to nothing
    (folder / "rgb.png").write_bytes(rgb_bytes(np.clip(rgb + noise, 0, 255).astype(np.uint8)))
    (folder / "depth.npy").write_bytes(depth_bytes(depth))
    (folder / "instance.png").write_bytes(instance_bytes(kinds, ids))
    return folder


def build(root: Path, out: Path) -> tuple[float, int]:
    cfg = ReleaseConfig(licence="cc0-1.0", modalities=STORED, num_frames=FRAMES_RELEASED)
    start_s = time.perf_counter()
    run(cfg, [Source("bench", root / "tree", root / "captions.jsonl")], out, workers=NUM_WORKERS)
    return time.perf_counter() - start_s, sum(p.stat().st_size for p in (out / "dataset/data").iterdir())


def copy_flight(folder: Path, target: Path) -> int:
    """Copy the first FRAMES_RELEASED frames of a flight into one file with two sha256; return its bytes."""
    whole = hashlib.sha256()
    with open(target, "wb") as out:
        for i in range(FRAMES_RELEASED):
            for file in STORED:
                data = (folder / frame_name(i) / FILE_NAMES[file]).read_bytes()
                hashlib.sha256(data).digest()
                whole.update(data)
                out.write(data)
        out.flush()
        os.fsync(out.fileno())
    return target.stat().st_size


def copy(tree: Path, out: Path) -> tuple[float, int]:
    out.mkdir()
    flights = find_tracks(tree)
    start_s = time.perf_counter()
    with ProcessPoolExecutor(NUM_WORKERS, mp_context=get_context("fork")) as pool:
        sizes = list(pool.map(copy_flight, flights, [out / str(k) for k in range(len(flights))]))
    return time.perf_counter() - start_s, sum(sizes)


def measure_speed(num_frames: int, folder: Path, rounds: int) -> None:
    tree, out = make_tree(folder, num_frames), folder / "out"
    shares = []  # of the copy's rate
    for number in range(rounds):
        rates = {}
        for name in ("copy", "build")[:: -1 if number % 2 else 1]:  # none always has the quieter disk
            seconds, stored = copy(tree, out) if name == "copy" else build(folder, out)
            rates[name] = stored / seconds / MB
            print(f"{name}: {num_frames} frames in {seconds:.2f} s, {rates[name]:.0f} MB/s")
            shutil.rmtree(out)
            os.sync()
        shares.append(rates["build"] / rates["copy"])
    print(f"build: {', '.join(f'{100 * share:.0f} %' for share in shares)} of the speed of the copy")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=int)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scratch", type=Path, help="where the tree and both products are written")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.scratch) as folder:
        measure_speed(given.frames, Path(folder), given.rounds)


if __name__ == "__main__":
    main()
