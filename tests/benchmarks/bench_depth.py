"""Size of depth in a playback tree, and time to write and read it, in both forms.

    python tests/benchmarks/bench_depth.py --data runs/quickstart/render

Milliseconds of processor time in one thread, the mean over frames that are spread over the tree's first flight.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from cosfly.products.flights import find_flights
from cosfly.products.frames import depth_file, depth_values, read_depth
from cosfly.products.playback import read_flight

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--data", type=Path, required=True, help="playback tree")
parser.add_argument("--frames", type=int, default=40)
arguments = parser.parse_args()

flight = read_flight(find_flights(arguments.data)[0])
chosen = np.unique(np.linspace(0, len(flight) - 1, arguments.frames).round().astype(int))
images = [read_depth(flight.frame_folder(i)) for i in chosen]
depth_values(depth_file(images[0], "png")[1], Path())  # compiles
for form in ("npy", "png"):
    begin = time.process_time()
    files = [depth_file(image, form)[1] for image in images]
    written = time.process_time()
    back = [depth_values(data, Path(form)) for data in files]
    read = time.process_time()
    assert all(np.array_equal(one, other) for one, other in zip(images, back, strict=True))
    size, write_ms, read_ms = (
        total / len(images) for total in (sum(map(len, files)) / 1e6, 1e3 * (written - begin), 1e3 * (read - written))
    )
    print(f"{form}: {size:.2f} MB, write {write_ms:.1f} ms, read {read_ms:.1f} ms a frame of {images[0].shape}")
