"""The data-set card: `render_card` turns release.json into README.md, so that a card which says anything else is found.

Build writes its numbers (release/counting.py) into release.json, verify computes them again and compares.
In words it says only what the record gives grounds for. Where it gives none, that is said. Every text that the template
prints is escaped.
"""

from pathlib import Path
from typing import Any

import yaml

from cosfly.formats.captions import FIELDS, TOKENS
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import read_text
from cosfly.viz.page import markdown
from release.card.tables import shown, tables_of
from release.record import FRAMES_FOLDER, POINTS_FOLDER, ReleaseRecord, SourceRecord, shard_pattern

FEW_WALKS = 10


def render_card(record: ReleaseRecord) -> str:
    """Return README.md for a release.json."""
    numbers, splits = record.numbers, record.splits.splits
    decided, repairs = numbers.of("decision"), numbers.of("repair_strategy")
    return markdown(
        "release/card/template.md", record=record, numbers=numbers, flags=numbers.of("flags"),
        teacher_kind=numbers.of("teacher_kind"), label_from=numbers.of("label_from"), splits=splits,
        modalities=record.settings.modalities, front_matter=_front_matter(record),
        ours=[source.run for source in record.provenance.sources if _is_rendered_by_us(source)],
        others=[source.run for source in record.provenance.sources if not _is_rendered_by_us(source)],
        first_split=next(iter(splits), "train"), points=sum(shard.points.rows for shard in record.shards),
        is_whole=all(t.frames == t.frames_available for t in record.flights), tables=tables_of(record),
        shown=shown, fields=FIELDS, never_decided=[name for name in TOKENS if name not in decided],
        most_decided=max(decided.items(), key=lambda pair: pair[1], default=("none", 0)),
        repaired=repairs.total() - repairs["none"],
        small_splits=[name for name, split in splits.items() if len(split.walks) < FEW_WALKS],
        coordinates=_coordinates(record), citation=read_text(Path(__file__).with_name("citation.bib")).strip(),
    )  # fmt: skip


def _is_rendered_by_us(source: SourceRecord) -> bool:
    """Return whether a stage of cosfly drew the frames of a source."""
    return any(stage.stage == "render" for stage in source.stages)


def _front_matter(record: ReleaseRecord) -> str:
    """Return what the hub reads. `synthetic`: only where all pictures are known to be rendered. The patterns of shards
    name the content: by it the library's cache tells one release from another."""
    rendered = all(_is_rendered_by_us(source) for source in record.provenance.sources)
    tags = ["uav", "aerial-tracking", *(["synthetic"] if rendered else [])]
    files = {"depth": "depth", "instance": "instance-segmentation"}
    tags += [tag for file, tag in files.items() if file in record.settings.modalities]
    tags += ["chain-of-thought"] if record.numbers.of("flags")["has_caption"] else []
    patterns = list(record.splits.splits)
    configs = {
        name: [{"split": split, "path": shard_pattern(split, record.content_digest, folder)} for split in patterns]
        for name, folder in (("default", FRAMES_FOLDER), ("points", POINTS_FOLDER))
    }
    matter = {
        "license": for_terminal(record.licence), "language": ["en", "zh"], "pretty_name": for_terminal(record.name),
        "task_categories": ["image-text-to-text", "robotics"], "tags": tags,
        "configs": [{"config_name": name, "data_files": files} for name, files in configs.items()],
    }  # fmt: skip
    return yaml.safe_dump(matter, sort_keys=False, allow_unicode=True).strip()


def _coordinates(record: ReleaseRecord) -> str:
    """Return the coordinates as a block that a program reads: YAML."""
    values: dict[str, Any] = {"coordinates": record.coordinates}
    if record.depth is not None:
        values["depth"] = record.depth.model_dump(mode="json")
    text = yaml.safe_dump(values, sort_keys=False, width=150).strip()  # what is not ASCII as escapes
    return f"```yaml\n{text}\n```"
