"""Rows a second, and memory, of the card's numbers and of the statistics, on shards of rows without pictures.

python tests/benchmarks/bench_release_pages.py --rows 10000 --rows 100000
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from release.card.numbers import compute_numbers, row_lists
from release.columns import SCALAR_NAMES, schema
from release.stats.counting import COLUMNS, Counts

FLIGHT_ROWS, SHARD_ROWS, GROUP_ROWS = 400, 1000, 40  # as of 1280x720 pictures: 40 rows fill a row group, 1,000 a shard


def write_shards(folder: Path, num_rows: int) -> None:
    """Write shards of made-up flights with captions of usual length."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from specimens_rows import make_row

    (folder / "data").mkdir()
    columns = pa.schema([schema(()).field(name) for name in SCALAR_NAMES])
    text = {"caption_en_critical_components": "x" * 410, "caption_zh_critical_components": "x" * 160}
    for first in range(0, num_rows, SHARD_ROWS):
        rows = [
            make_row(
                i % FLIGHT_ROWS,
                "aug_001" if i // FLIGHT_ROWS % 2 else "ORI",
                f"trajectory_{i // FLIGHT_ROWS // 2}",
                **text,
            )
            for i in range(first, min(first + SHARD_ROWS, num_rows))
        ]
        pq.write_table(
            pa.Table.from_pylist(rows, schema=columns), folder / f"data/{first:07d}.parquet", row_group_size=GROUP_ROWS
        )


def measure(what: str, folder: Path) -> str:
    """Do it, and give seconds of processor time and the peak of memory."""
    shards = sorted((folder / "data").glob("*.parquet"))
    begin = time.process_time()
    if what == "card":
        compute_numbers(shards, FLIGHT_ROWS)
    else:
        counts = Counts()
        for shard in shards:
            for rows in row_lists(shard, COLUMNS):
                for row in rows:
                    counts.add(row)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return f"{time.process_time() - begin:.1f} s of processor time, peak {peak_mib:.0f} MiB"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rows", type=int, action="append")
    parser.add_argument("--measure", nargs=2, metavar=("WHAT", "FOLDER"))
    given = parser.parse_args()
    if given.measure:
        print(measure(given.measure[0], Path(given.measure[1])))
        return
    for num_rows in given.rows or [10_000, 100_000]:
        with tempfile.TemporaryDirectory() as folder:
            write_shards(Path(folder), num_rows)
            for what in ("card", "stats"):  # each in a process of its own, for its peak
                done = subprocess.run(
                    [sys.executable, __file__, "--measure", what, folder], capture_output=True, text=True, check=True
                )
                print(f"{num_rows:,} rows, {what}: {done.stdout.strip()}")


if __name__ == "__main__":
    main()
