"""The data-set card: `render_card` turns release.json into README.md, so that a card which says anything else is found.

Its numbers are those of `numbers.py`: build writes them into release.json, verify computes them again and compares.
In words it says only what the record gives grounds for. Where it gives none, that is said. Every text that the template
prints is escaped.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from cosfly.formats.captions import FIELDS, TOKENS
from cosfly.formats.frames import FrameFile
from cosfly.geometry.coverage import NAMED
from cosfly.inspection.blind_baseline import DRAWN_AHEAD, LEAST_WINDOWS, LOOKS_BACK
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import read_text
from cosfly.viz.coverage_page import ranges, shares
from cosfly.viz.page import markdown
from release.columns import CAPTION, PICTURES, SCALARS, SPLIT_NAMES, schema
from release.record import FRAMES_FOLDER, POINTS_FOLDER, History, ReleaseRecord, SourceRecord, shard_pattern

# What a map is, by what made it (`maps.source`): no more than the program knows.
MAPS = {
    "synthetic": "made by cosfly's generator from a seed; no real place",
    "simworld": "a procedural SimWorld world; no real place that cosfly knows of",
    "cityjson": "a 3D city model (CityJSON), of a real place if its makers say so; buildings are from the model, "
    "surfaces and plants are drawn by cosfly",
}
UNKNOWN_MAP = "made elsewhere, with content that is unknown to cosfly; see its licence and credits"
FEW_WALKS = 10


def render_card(record: ReleaseRecord) -> str:
    """Return README.md for a release.json."""
    numbers, splits = record.numbers, record.splits.splits
    captions = numbers.captions
    by_kind: dict[str, list[str]] = defaultdict(list)
    for source in record.provenance.sources:
        by_kind[_map_kind(source)].append(source.run)
    decided = captions.frames_by["decision"]
    return markdown(
        "release/card/template.md",
        record=record,
        numbers=numbers,
        captions=captions,
        splits=splits,
        modalities=record.settings.modalities,
        looks_back=LOOKS_BACK,
        least=LEAST_WINDOWS,
        drawn_ahead=DRAWN_AHEAD,
        front_matter=_front_matter(record),
        ours=[source.run for source in record.provenance.sources if _is_rendered_by_us(source)],
        others=[source.run for source in record.provenance.sources if not _is_rendered_by_us(source)],
        map_kinds=by_kind,
        first_split=first_split(record),
        points=sum(shard.points.rows for shard in record.shards),
        is_whole=all(one.frames == one.frames_available for one in record.flights),
        frames_by={title: getattr(numbers.frames_by, name) for name, title in FRAMES_BY.items()},
        spreads={title: getattr(numbers, name) for name, title in SPREADS.items()},
        ranges=ranges(numbers.coverage),
        shares={kind: shares(numbers.coverage, kind) for kind in NAMED},
        fields=FIELDS,
        counted=[column for column in CAPTION if column.counted and column.words != "actions"],
        funnel=_funnel(record.history),
        never_decided=[name for name in TOKENS if name not in decided],
        most_decided=max(decided.items(), key=lambda pair: pair[1], default=("none", 0)),
        repaired=sum(count for name, count in captions.frames_by["repair_strategy"].items() if name != "none"),
        small_splits=[name for name, own in splits.items() if len(own.walks) < FEW_WALKS],
        columns=_columns(record.settings.modalities),
        coordinates=_coordinates(record),
        citation=read_text(Path(__file__).with_name("citation.bib")).strip(),
    )


FRAMES_BY = {"town": "town", "track": "track", "fov_deg": "field of view (degrees)", "image_px": "image (px)"}
SPREADS = {
    "frames_per_flight": "frames per track",
    "flight_duration_s": "duration of a track, s",
    "flight_length_m": "length of a track without its perturbation, over its released frames, m",
    "height_over_target_m": "height over the target's hip, m",
    "distance_to_target_m": "distance to the target, m",
    "visibility": "rendered visibility of the target",
}


def _map_kind(source: SourceRecord) -> str:
    configs = [stage.config for stage in source.stages if stage.stage == "maps"]
    kinds = {MAPS.get(str(config.get("source")), UNKNOWN_MAP) for config in configs}
    return kinds.pop() if len(kinds) == 1 else UNKNOWN_MAP


def _is_rendered_by_us(source: SourceRecord) -> bool:
    """Return whether a stage of cosfly drew the frames of a source."""
    return any(stage.stage == "render" for stage in source.stages)


def first_split(record: ReleaseRecord) -> str:
    """Return the first split that has rows."""
    return next((name for name in SPLIT_NAMES if name in record.splits.splits), SPLIT_NAMES[0])


def size_category(num_frames: int) -> str:
    """Return the hub's size category."""
    limits = ("1K", "10K", "100K", "1M", "10M")
    k = sum(num_frames >= 10 ** (3 + i) for i in range(len(limits)))
    return f"n<{limits[0]}" if k == 0 else f"n>{limits[-1]}" if k == len(limits) else f"{limits[k - 1]}<n<{limits[k]}"


def _front_matter(record: ReleaseRecord) -> str:
    """Return what the hub reads. `synthetic`: only where all pictures are known to be rendered. The patterns of shards
    name the content: by it the library's cache tells one release from another."""
    rendered = all(_is_rendered_by_us(source) for source in record.provenance.sources)
    tags = ["uav", "aerial-tracking", *(["synthetic"] if rendered else [])]
    files = {"depth": "depth", "instance": "instance-segmentation"}
    tags += [tag for file, tag in files.items() if file in record.settings.modalities]
    tags += ["chain-of-thought"] if record.numbers.captions.frames_with else []
    patterns = list(record.splits.splits)
    configs = {
        name: [{"split": split, "path": shard_pattern(split, record.content_digest, folder)} for split in patterns]
        for name, folder in (("default", FRAMES_FOLDER), ("points", POINTS_FOLDER))
    }
    matter = {
        "license": for_terminal(record.licence),
        "language": ["en", "zh"],
        "pretty_name": for_terminal(record.name),
        "size_categories": [size_category(record.numbers.frames)],
        "task_categories": ["image-text-to-text", "robotics"],
        "tags": tags,
        "configs": [{"config_name": name, "data_files": files} for name, files in configs.items()],
    }
    return yaml.safe_dump(matter, sort_keys=False, allow_unicode=True).strip()


def _coordinates(record: ReleaseRecord) -> str:
    """Return the coordinates as a block that a program reads: YAML."""
    values: dict[str, Any] = {"coordinates": record.coordinates}
    if record.depth is not None:
        values["depth"] = record.depth.model_dump(mode="json")
    text = yaml.safe_dump(values, sort_keys=False, width=150).strip()  # what is not ASCII as escapes
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))  # no text of the record ends the block
    return f"{fence}yaml\n{text}\n{fence}"


def _funnel(history: History) -> list[tuple[str, int]]:
    planned, flights, captions = history.trajectories, history.flights, history.captions
    rows: list[tuple[str, int]] = []
    if planned is not None:
        rows += [("trajectories planned", planned.planned)]
        rows += [(f"dropped before rendering: {reason}", count) for reason, count in planned.dropped.items()]
        rows += [("trajectories not rendered", planned.not_rendered), ("trajectories rendered", planned.rendered)]
    rows += [("tracks found", flights.found), ("of these inspected", flights.inspected)]
    rows += [(f"tracks not released: {reason}", count) for reason, count in flights.left_out.items()]
    rows += [("tracks released", flights.released), ("captions made", captions.read)]
    rows += [(f"captions dropped: {reason}", count) for reason, count in captions.dropped.items()]
    return [
        *rows,
        ("captions accepted, but frame not selected", captions.frame_not_selected),
        ("captions accepted, but track not released", captions.flight_left_out),
        ("captions released", captions.released),
    ]


def _columns(files: list[FrameFile]) -> Iterable[tuple[str, str, str]]:
    """Return of each column its name, type, and the words that it may hold."""
    words = {column.name: column.words for column in SCALARS}
    for member in schema(files):
        kind = "float64" if str(member.type) == "double" else str(member.type)
        if member.name in (PICTURES["rgb"].name, PICTURES["instance"].name):
            kind = "image"
        elif kind.startswith("struct"):
            kind = "texts " if member.type[0].type == "string" else "numbers "
            kind += ", ".join(child.name for child in member.type)
        elif kind.startswith("list"):
            kind = f"list of {member.type.value_type}"
        allowed = words.get(member.name, ())
        yield member.name, kind, "a decision" if allowed == "actions" else ", ".join(allowed)
