"""What of a release's labels can be told without its pictures, on its own splits, and what hangs on what came later."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosfly.formats.captions import ORDERS, TOKENS
from cosfly.formats.segments import Segment
from cosfly.inspection.blind_baseline import FITTED_ON, LEAST_WINDOWS, fit_deciders, is_drawn_ahead, past_of
from cosfly.runtime.seeding import random_bytes, rng_for
from release.columns import WINDOW
from release.counting import DIGITS
from release.reading import read_tracks
from release.record import Ceilings, ReleaseRecord, Shard

COLUMNS = ("sample_id", "frame_index", "label", "split", WINDOW)
STAGE, FUTURE_FRAMES = "release.ceilings", 5  # of a label, where no record of captions says


def ceilings_of(folder: Path, record: ReleaseRecord) -> Ceilings:
    """Measure them on FITTED_ON labels of a release at most, drawn by their names; raises as `read_tracks`."""
    told = [one for shard in record.shards for one in _windows(folder, shard, record)]
    pasts, labels, splits, ahead = map(np.array, zip(*told, strict=True)) if told else [np.empty(0)] * 4
    split = "test" if "test" in splits else "validation"
    (train, test), known = ((pasts[splits == name], labels[splits == name]) for name in ("train", split)), ahead >= 0
    found = Ceilings(split=split, fitted_on=len(train[1]), tested=len(test[1]), known=int(known.sum()))
    shares = {"drawn_ahead": ahead[known]}
    if min(len(train[1]), len(test[1])) >= LEAST_WINDOWS:
        shares["majority"] = test[1] == np.bincount(train[1]).argmax()
        deciders = fit_deciders(*train, rng_for(0, STAGE, "blind"))
        shares |= {name: test[1] == decide(test[0]) for name, decide in deciders.items()}
    more = {name: round(float(own.mean()), DIGITS) for name, own in shares.items() if len(own)}
    return found.model_copy(update=more)


def _windows(folder: Path, shard: Shard, record: ReleaseRecord) -> Iterator[tuple[np.ndarray, int, str, int]]:
    """Yield of labelled windows the past, the label's number, the split, and whether it may depend on what was drawn
    later, -1 where that is not known. Memory holds a row group and a track."""
    numbers = {name: number for number, name in enumerate(TOKENS)}
    most_rank = 2**64 * FITTED_ON / max(1, record.numbers.captions.with_label)
    configs = [s.config for source in record.provenance.sources for s in source.stages if s.stage == "caption"]
    num_future = max((c["window"]["future_frames"] for c in configs if "window" in c), default=FUTURE_FRAMES)
    for rows, points in read_tracks(folder, shard, COLUMNS):
        styles = points.column("style")
        begins = [now for now in range(1, len(points)) if styles[now] != styles[now - 1]]
        segments = tuple(Segment(styles[now], now, len(points)) for now in begins)
        flight = replace(points.flight, segments=segments)
        for row in rows.rows:
            if row["label"] is None or int.from_bytes(random_bytes(0, STAGE, row["sample_id"])[:8]) > most_rank:
                continue
            now = row["frame_index"]
            is_ordered, last = row["label"] in ORDERS, now + num_future
            is_known = not points.is_foreign and last < len(flight)
            ahead = is_drawn_ahead(flight, now, last, is_ordered) if is_known else None
            past = past_of(flight, row[WINDOW], is_ordered)
            yield past, numbers[row["label"]], row["split"], -1 if ahead is None else int(ahead)
