"""What the card says in words: only what the record gives grounds for. Where it gives none, that is said."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import yaml

from cosfly.escaping import for_markdown, markdown_code
from release.record import ReleaseRecord, SourceRecord

# What a map is, by what made it (`maps.source`): no more than the program knows.
MAPS = {
    "synthetic": "made by cosfly's generator from a seed; no real place",
    "simworld": "a SimWorld world: procedural, no real place that cosfly knows of",
    "cityjson": "a 3D city model (CityJSON), of a real place where its makers say so; the buildings are theirs, surfaces and plants are drawn by cosfly",
}
UNKNOWN_MAP = "made elsewhere; what it shows is not known to cosfly, see its licence and credits"


def map_kinds(record: ReleaseRecord) -> dict[str, str]:
    """Give what the map of each run is; UNKNOWN_MAP where its stages do not say."""
    return {source.run: _map_kind(source) for source in record.provenance.sources}


def _map_kind(source: SourceRecord) -> str:
    configs = [stage.config for stage in source.stages if stage.stage == "maps"]
    kinds = {MAPS.get(str(config.get("source")), UNKNOWN_MAP) for config in configs}
    return kinds.pop() if len(kinds) == 1 else UNKNOWN_MAP


def is_rendered_by_us(source: SourceRecord) -> bool:
    """Tell whether a stage of cosfly drew the frames of a source."""
    return any(stage.stage == "render" for stage in source.stages)


def shown(record: ReleaseRecord) -> str:
    """Say what the pictures show, and of which maps."""
    ours = [source.run for source in record.provenance.sources if is_rendered_by_us(source)]
    others = [source.run for source in record.provenance.sources if not is_rendered_by_us(source)]
    lines = []
    if ours:
        whose = "" if not others else f" of {_codes(ours)}"
        lines.append(
            f"The pictures{whose} are rendered by cosfly from maps of boxes: nobody was filmed, and the person who is followed is a drawn figure on a planned walk."
        )
    if others:
        lines.append(f"The pictures of {_codes(others)} were made elsewhere: cosfly cannot say how, or whom they show.")
    by_kind: dict[str, list[str]] = defaultdict(list)
    for run, kind in map_kinds(record).items():
        by_kind[kind].append(run)
    for kind, runs in by_kind.items():
        lines.append(f"Maps{'' if len(by_kind) == 1 else f' of {_codes(runs)}'}: {kind}.")
    return "\n".join(lines)


def tags(record: ReleaseRecord) -> list[str]:
    """Give the hub's tags; `synthetic` only where all pictures are known to be rendered."""
    rendered = all(is_rendered_by_us(source) for source in record.provenance.sources)
    files = {"depth": "depth", "instance": "instance-segmentation"}
    return [
        "uav", "aerial-tracking", *(["synthetic"] if rendered else []), *(tag for file, tag in files.items() if file in record.settings.modalities),
        *(["chain-of-thought"] if record.numbers.captions.frames_with else []),
    ]  # fmt: skip


def coordinates_block(record: ReleaseRecord) -> str:
    """Give the coordinates as a block that a program reads: YAML."""
    values: dict[str, Any] = {"coordinates": record.coordinates}
    if record.depth is not None:
        values["depth"] = record.depth.model_dump(mode="json")
    text = yaml.safe_dump(values, sort_keys=False, width=150).strip()  # what is not ASCII as escapes
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))  # no text of the record ends the block
    return f"{fence}yaml\n{text}\n{fence}"


def verification(record: ReleaseRecord) -> str:
    """Say what was checked before this release, by the record, and what can be checked of it now."""
    flights, captions = record.history.flights, record.numbers.captions
    lines = [
        f"Inspected: {flights.inspected:,} of {flights.found:,} flights that were found (smoothness, clearance, visibility, complete and decodable files); "
        f"{sum(flights.left_out.values()):,} were left out.",
    ]
    if captions.frames_with:
        judged = ", ".join(
            f"{share:.1%} ({name.removeprefix('proved_')})"
            for name, share in captions.mean_proved.items()
            if share is not None
        )
        proved = (
            f" On average {judged} of a caption's sentences are proved; the rest is not verified."
            if judged
            else " No sentence was judged."
        )
        lines.append(
            f"Captions: each decision is of the closed set and the same in both languages; its verdict says how it agrees with the positions that follow.{proved}"
        )
    lines.append(
        "Bytes: every shard is listed with its sha256, and the digest of all of them stands in the names of the files."
    )
    lines.append(
        "`cosfly release verify FOLDER` computes every number of this card again from the shards, and holds rows, pictures and splits against each other."
    )
    return "\n".join(f"- {line}" for line in lines)


def limits(record: ReleaseRecord) -> str:
    """Say what this release lacks, as far as its numbers tell."""
    numbers = record.numbers
    captions = numbers.captions
    lines = []
    if any(is_rendered_by_us(source) for source in record.provenance.sources):
        lines.append(
            "The renderer draws boxes as a town, plainly lit: no sensor noise, motion blur, lens distortion or rolling shutter. A model trained on it needs checking on real images."
        )
        lines.append("People walk planned ways; real ones do what no plan has.")
    missing = [name for name in record.closed_set if name not in captions.decision]
    if captions.frames_with and missing:
        lines.append(f"Decisions that no caption has: {', '.join(markdown_code(name) for name in missing)}.")
    if captions.frames_with:
        top, count = max(captions.decision.items(), key=lambda pair: pair[1])
        lines.append(
            f"The most frequent decision, {markdown_code(top)}, has {count / captions.frames_with:.1%} of the captions: always saying it scores as much."
        )
    if "rules" in captions.teacher_kind:
        share = captions.teacher_kind["rules"] / captions.frames_with
        lines.append(
            f"{share:.1%} of the captions are by the rule teacher: sentences of fixed forms, filled with measurements, by a program that sees no picture."
        )
    repaired = sum(count for name, count in captions.repair_strategy.items() if name != "none")
    if repaired:
        lines.append(
            f"{repaired:,} captions ({repaired / captions.frames_with:.1%}) are not their teacher's first answer, which was rejected; `repair_strategy` says how they were mended."
        )
    noisy = captions.label_from.get("perturbed", 0)
    if noisy:
        lines.append(
            f"{noisy:,} labels come from a perturbed motion that nobody can take the noise out of (`label_from` is `perturbed`)."
        )
    small = [name for name, own in record.splits.splits.items() if len(own.walks) < 10]
    if small:
        lines.append(f"Splits of fewer than ten walks, too few for figures that generalise: {', '.join(small)}.")
    if len(numbers.frames_by.town) == 1:
        lines.append("There is one town: nothing here tells how a model does in another.")
    lines.append("Captions are in English and Chinese alone." if captions.frames_with else "There are no captions.")
    return "\n".join(f"- {line}" for line in lines)


def credits(record: ReleaseRecord) -> str:
    """Give a line a map, with its licence and who must be named; then the release's own credits."""
    lines = [
        f"Map of {one.town}: {one.name}, licence {one.licence}.{' ' * bool(one.credits)}{one.credits}"
        for one in record.maps
    ]
    return "".join(f"\n\n{for_markdown(line)}" for line in (*lines, record.credits) if line)


def _codes(names: Iterable[str]) -> str:
    return ", ".join(markdown_code(name) for name in names)
