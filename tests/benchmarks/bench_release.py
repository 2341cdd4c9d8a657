"""How fast `release build` stores pictures, beside a copy of the same bytes, plain and with the digests that a release
needs, and how much memory it takes.

    python tests/benchmarks/bench_release.py speed 4000             # 1280x720, two processes for either
    python tests/benchmarks/bench_release.py memory 10000 100000    # small pictures

The tree is made of few frames, linked many times, so that it needs little disk; release and copy are written in full.
The copy reads the tree's files and writes them one after the other into one file a flight, flushed to disk at its end
as a shard is: the least that any copy does. It goes through the page cache, as copies do; a shard goes past it where
the file system can. Both read files that are in the page cache.
"""

import argparse
import dataclasses
import hashlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from specimens_distill import make_captions

from cosfly.formats.frames import FILE_NAMES, FrameFile, depth_bytes, frame_name, instance_bytes, rgb_bytes
from cosfly.formats.playback import Track, write_track
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
SIZES = {"speed": (1280, 720), "memory": (32, 18)}
MB = 1e6
COPIES = {"plain copy": 0, "copy, 2 digests": 2}  # of each byte: its file's, and that of what is written


def make_tree(root: Path, num_released: int, size_px: tuple[int, int]) -> Path:
    """Write a tree of pairs of flights, of which so many frames are released at FRAMES_RELEASED a flight; gives it."""
    flight, scene = make_flight(NUM_POINTS, width_px=size_px[0], height_px=size_px[1])
    pool = [_paint_files(root / f"pool/{k}", flight, scene, k * 30) for k in range(NUM_POOL)]
    digests = [{name: sha256_bytes((folder / name).read_bytes()) for name in os.listdir(folder)} for folder in pool]
    for number in range(max(1, num_released // (2 * FRAMES_RELEASED))):
        away_m = np.array([0.0, 1000.0 * number, 0.0])  # a walk of its own
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
                for name, digest in digests[i % NUM_POOL].items():
                    os.link(pool[i % NUM_POOL] / name, folder / frame_name(i) / name)
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


def cpu_seconds() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def build(root: Path, out: Path, files: tuple[FrameFile, ...], workers: int) -> float:
    cfg = ReleaseConfig(licence="cc0-1.0", modalities=files, num_frames=FRAMES_RELEASED)
    start_s = time.perf_counter()
    run(cfg, [Source("bench", root / "tree", root / "captions.jsonl")], out, workers=workers)
    return time.perf_counter() - start_s


def copy_flight(folder: Path, target: Path, num_digests: int) -> int:
    """Copy the first FRAMES_RELEASED frames of a flight into one file; gives its bytes.

    Args:
        num_digests: 0; 2: a sha256 of each file, and one of what is written.
    """
    whole = hashlib.sha256()
    with open(target, "wb") as out:
        for i in range(FRAMES_RELEASED):
            for file in STORED:
                with open(folder / frame_name(i) / FILE_NAMES[file], "rb") as picture:
                    if not num_digests:
                        shutil.copyfileobj(picture, out, 1 << 20)
                        continue
                    data = picture.read()
                hashlib.sha256(data).digest()
                whole.update(data)
                out.write(data)
        out.flush()
        os.fsync(out.fileno())
    return target.stat().st_size


def copy(tree: Path, out: Path, workers: int, num_digests: int) -> tuple[float, int]:
    out.mkdir()
    flights = find_tracks(tree)
    start_s = time.perf_counter()
    with ProcessPoolExecutor(workers, mp_context=get_context("fork")) as pool:
        sizes = list(
            pool.map(copy_flight, flights, [out / str(k) for k in range(len(flights))], [num_digests] * len(flights))
        )
    return time.perf_counter() - start_s, sum(sizes)


def measure_speed(num_frames: int, folder: Path, rounds: int) -> None:
    tree = make_tree(folder, num_frames, SIZES["speed"])
    print(f"{'':24}{'seconds':>9}{'CPU s':>9}{'MB':>9}{'MB/s':>9}{'frames/s':>10}")
    shares = {name: list[tuple[float, float]]() for name in COPIES}  # of the copy's rate: on the clock, by CPU
    for number in range(rounds):
        rows = []
        for name in list(reversed((*COPIES, "build")))[:: -1 if number % 2 else 1]:  # none always has the quieter disk
            out, cpu_s = folder / "out", cpu_seconds()
            if name in COPIES:
                seconds, stored = copy(tree, out, NUM_WORKERS, COPIES[name])
            else:
                seconds = build(folder, out, STORED, NUM_WORKERS)
                stored = sum(p.stat().st_size for p in (out / "dataset/data").iterdir())
            rows.append((name, seconds, stored / MB, cpu_seconds() - cpu_s))
            shutil.rmtree(out)
            os.sync()
        for name, seconds, stored, used_s in rows:
            rate, pace = stored / seconds, num_frames / seconds
            print(f"{name:24}{seconds:9.2f}{used_s:9.2f}{stored:9.0f}{rate:9.0f}{pace:10.0f}")
        rates = {name: (stored / seconds, stored / used_s) for name, seconds, stored, used_s in rows}
        for name, own in shares.items():
            own.append((rates["build"][0] / rates[name][0], rates["build"][1] / rates[name][1]))
    for name, own in shares.items():
        for what, column in (("on the clock", 0), ("by CPU", 1)):
            told = ", ".join(f"{100 * share[column]:.0f} %" for share in own)
            print(f"stored as they are: {told} of a {name} {what}")
    few = 2 * FRAMES_RELEASED  # the first pair of tracks
    for path in find_tracks(tree)[2::2]:
        shutil.rmtree(path.parent)
    make_captions(folder / "captions.jsonl", tree)
    before_s = cpu_seconds()
    seconds = build(folder, folder / "depth", ("depth",), 1)
    used_s = cpu_seconds() - before_s
    raw = few * SIZES["speed"][0] * SIZES["speed"][1] * 4 / MB
    stored = sum(p.stat().st_size for p in (folder / "depth/dataset/data").iterdir()) / MB
    print(
        f"depth, one core: {raw / seconds:.0f} MB/s of float32 on the clock, {raw / used_s:.0f} by CPU, "
        f"{few / seconds:.0f} frames/s, "
        f"to {100 * stored / raw:.0f} % of its size"
    )


def measure_memory(num_frames: int, folder: Path) -> None:
    seconds = build(folder, folder / "out", ("rgb", "depth", "instance"), 1)
    usage = [resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(f"{num_frames:9,} frames: main {usage[0]:6.0f} MiB, worker {usage[1]:6.0f} MiB, {seconds:7.1f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "memory", "make-tree", "build"))
    parser.add_argument("frames", type=int, nargs="+")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scratch", type=Path, help="where the tree and both products are written")
    given = parser.parse_args()
    if given.what == "make-tree":
        make_tree(given.scratch, given.frames[0], SIZES["memory"])
        return
    if given.what == "build":
        measure_memory(given.frames[0], given.scratch)
        return
    for count in given.frames:
        with tempfile.TemporaryDirectory(dir=given.scratch) as folder:
            if given.what == "speed":
                measure_speed(count, Path(folder), given.rounds)
                continue
            for step in ("make-tree", "build"):  # the build in a process of its own, which the peak is of
                subprocess.run([sys.executable, __file__, step, str(count), "--scratch", folder], check=True)


if __name__ == "__main__":
    main()
