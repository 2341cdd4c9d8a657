"""`cosfly release stats`: what the paper tells of its data, computed again from the rows of a release."""

from __future__ import annotations

from pathlib import Path

from cosfly.work.console import progress_bar
from cosfly.work.store import write_bytes, write_json
from release.card.numbers import RowCounts, check_rows, row_lists
from release.columns import SHORT_NAMES
from release.record import read_record, release_folder
from release.stats.counting import Counts
from release.stats.page import markdown, page_html, tiles_of
from release.stats.pixels import look_at, middle_picture
from release.stats.tables import make_stats


def run(dataset: Path, out: Path, *, pixels: int = 200) -> Path:
    """Reads a release folder; writes `stats.json`, `stats.md`, `stats.html` and gives the page. Memory holds a row
    group and a few numbers a flight.

    Args:
        pixels: frames whose depth and instance pictures are decoded; 0 for none.
    Raises:
        InputError: it is no release, or something in it cannot be read.
    """
    dataset = release_folder(dataset)
    record = read_record(dataset / "release.json")
    counts, card = Counts(), RowCounts()
    with progress_bar("stats: rows", sum(shard.rows for shard in record.shards)) as advance:
        for shard in record.shards:
            check_rows(dataset / shard.path, shard.rows)
            for rows in row_lists(dataset / shard.path, SHORT_NAMES):
                card.add(rows)
                for row in rows:
                    counts.add(row)
                advance(len(rows))
    looked = look_at(dataset, record, pixels) if pixels else None
    stats = make_stats(record, counts, looked)
    write_json(out / "stats.json", {**stats.model_dump(mode="json"), "coverage": card.coverage.model_dump(mode="json")})
    write_bytes(out / "stats.md", markdown(stats).encode())
    page = page_html(stats, card.coverage, tiles_of(record, stats), middle_picture(dataset, record))
    write_bytes(out / "stats.html", page.encode())
    return out / "stats.html"
