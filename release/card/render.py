"""The data-set card: `render_card` turns release.json into README.md, so that a card which says anything else is found.

Its numbers are those of `numbers.py`: build writes them into release.json, verify computes them again and compares.
In words it says only what the record gives grounds for. Where it gives none, that is said.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from cosfly.escaping import for_markdown, for_terminal, markdown_code
from cosfly.look.coverage_page import ranges, shares
from cosfly.products.captions import FIELDS
from cosfly.products.coverage import NAMED, Coverage
from cosfly.products.frames import FrameFile
from cosfly.reading.files import read_text
from release.columns import CAPTION, PICTURES, SCALARS, SPLIT_NAMES, schema
from release.record import (
    CaptionNumbers,
    DepthCodingName,
    FramesBy,
    History,
    Numbers,
    ReleaseRecord,
    SourceRecord,
    shard_pattern,
)

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
    missing = [name for name in record.closed_set if name not in captions.frames_by["decision"]]
    if captions.frames_with and missing:
        lines.append(f"Decisions that no caption has: {', '.join(markdown_code(name) for name in missing)}.")
    if captions.frames_with:
        top, count = max(captions.frames_by["decision"].items(), key=lambda pair: pair[1])
        lines.append(
            f"The most frequent decision, {markdown_code(top)}, has {count / captions.frames_with:.1%} of the captions: always saying it scores as much."
        )
    if "rules" in captions.frames_by["teacher_kind"]:
        share = captions.frames_by["teacher_kind"]["rules"] / captions.frames_with
        lines.append(
            f"{share:.1%} of the captions are by the rule teacher: sentences of fixed forms, filled with measurements, by a program that sees no picture."
        )
    repaired = sum(count for name, count in captions.frames_by["repair_strategy"].items() if name != "none")
    if repaired:
        lines.append(
            f"{repaired:,} captions ({repaired / captions.frames_with:.1%}) are not their teacher's first answer, which was rejected; `repair_strategy` says how they were mended."
        )
    noisy = captions.frames_by["label_from"].get("perturbed", 0)
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


DEPTH = {
    "float32": 'depth_m = np.load(io.BytesIO(row["depth"]))  # float32 (height, width)',
    "float16": 'depth_m = np.load(io.BytesIO(row["depth"])).astype(np.float32)  # (height, width)',
    "millimetre_png": 'depth_m = np.asarray(Image.open(io.BytesIO(row["depth"]))) / np.float32(1000.0)  # (height, width); 65.535 is sky, 0 invalid',
}


def one_row(record: ReleaseRecord) -> str:
    """Give what loads one split and decodes a row."""
    files = record.settings.modalities
    is_png = record.depth is not None and record.depth.coding == "millimetre_png"
    lines = [
        "import io",
        "import numpy as np",
        "from datasets import load_dataset",
        *(["from PIL import Image"] if is_png else []),
        "",
    ]
    lines += [
        f'data = load_dataset(FOLDER, split="{first_split(record)}")  # this folder, or its name on the hub',
        "row = data[0]",
    ]
    if "rgb" in files:
        lines.append('rgb = np.asarray(row["image"].convert("RGB"))')
    if record.depth is not None:
        lines.append(DEPTH[record.depth.coding])
    if "instance" in files:
        lines += [
            'coded = np.asarray(row["instance"].convert("RGB")).astype(np.uint16)',
            "semantic, instance_id = coded[..., 0], coded[..., 1] | (coded[..., 2] << 8)",
        ]
    lines += [
        'intrinsics, pose = row["intrinsics"], row["pose"]',
        'reason = row["caption_en_reasoning_trace"]  # or _zh_',
    ]
    return "\n".join(lines)


def parts(record: ReleaseRecord) -> str:
    """Give what loads by split, row by row, or a part."""
    split, names = first_split(record), ", ".join(record.splits.splits)
    return "\n".join(
        [
            "from datasets import load_dataset",
            "import pyarrow.dataset",
            "",
            f"splits = load_dataset(FOLDER)  # all of them: {names}",
            f'flow = load_dataset(FOLDER, split="{split}", streaming=True)  # row by row, nothing is downloaded first',
            'places = [row["target"] for row in flow.select_columns(["sample_id", "target"]).take(10)]',
            "",
            "# Of a folder on disk some columns and rows alone; nothing else is read.",
            'rows = pyarrow.dataset.dataset(f"{FOLDER}/data", format="parquet")',
            f'poses = rows.to_table(columns=["sample_id", "pose"], filter=pyarrow.dataset.field("split") == "{split}")',
        ]
    )


def windows(record: ReleaseRecord) -> str:
    """Give what makes captioned windows of the rows, with `datasets` alone."""
    has_rgb = "rgb" in record.settings.modalities
    frames = ['    frames = [row["image"] for row in rows]'] if has_rgb else []
    given = ['"frames": frames'] if has_rgb else []
    given += ['"facts": facts', '"prompt": last["prompt_en"]', '"caption": last["caption_en_reasoning_trace"]']
    return "\n".join(
        [
            "from datasets import load_dataset",
            "",
            f'data = load_dataset(FOLDER, split="{first_split(record)}")',
            'flight = ["run", "town", "trajectory", "variant"]',
            'keys = data.select_columns([*flight, "frame_index"])',
            "place = {tuple(key.values()): number for number, key in enumerate(keys)}",
            'captioned = [number for number, has in enumerate(data["has_caption"]) if has]',
            "",
            "def window(i):",
            "    last = data[captioned[i]]",
            "    name = [last[part] for part in flight]",
            '    rows = data.select([place[(*name, index)] for index in last["caption_window"]])',
            *frames,
            '    facts = rows.select_columns(["time_s", "pose", "target", "target_bbox", "target_visible"])[:]',
            f"    return {{{', '.join(given)}}}",
        ]
    )


def first_split(record: ReleaseRecord) -> str:
    """Give the first split that has rows."""
    return next((name for name in SPLIT_NAMES if name in record.splits.splits), SPLIT_NAMES[0])


FILE_TEXT: dict[FrameFile, str] = {  # of depth: DEPTH_TEXT
    "rgb": "`image`: colour, PNG",
    "instance": "`instance`: semantic number and instance id, PNG",
}
DEPTH_TEXT: dict[DepthCodingName, str] = {
    "float32": "z-depth in metres, float32 `.npy` bytes, lossless",
    "float16": "z-depth in metres, float16 `.npy` bytes",
    "millimetre_png": "z-depth in millimetres, PNG of 16 bits",
}


def render_card(record: ReleaseRecord) -> str:
    """Give README.md for a release.json."""
    template = read_text(Path(__file__).with_name("template.md"))
    values = _values(record)
    names = set(re.findall(r"\{\{(\w+)\}\}", template))
    assert names == set(values), f"template and values differ: {sorted(names ^ set(values))}"
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match.group(1)], template)


def size_category(num_frames: int) -> str:
    """Give the hub's size category."""
    limits = ("1K", "10K", "100K", "1M", "10M")
    k = sum(num_frames >= 10 ** (3 + i) for i in range(len(limits)))
    return f"n<{limits[0]}" if k == 0 else f"n>{limits[-1]}" if k == len(limits) else f"{limits[k - 1]}<n<{limits[k]}"


def _values(record: ReleaseRecord) -> dict[str, str]:
    numbers, history, settings = record.numbers, record.history, record.settings
    captions, frames = numbers.captions, numbers.frames
    return {
        "front_matter": _front_matter(record),
        "name": for_markdown(record.name),
        "summary": _summary(record),
        "frames_table": _table(("", "frames"), _groups(numbers.frames_by)),
        "fov_trajectories": ", ".join(f"{fov}: {n:,}" for fov, n in numbers.trajectories_by_fov_deg.items()),
        "flights_table": _spreads(numbers),
        "visible": f"{_share(numbers.frames_target_visible, frames)} of the frames",
        "perturbed": f"{numbers.frames_perturbed:,} ({_share(numbers.frames_perturbed, frames)})",
        "num_frames": "all" if settings.num_frames is None else str(settings.num_frames),
        "splits_table": _splits(record),
        "split_by": record.splits.by,
        "split_rule": for_markdown(record.splits.rule),
        "frame_rule": for_markdown(record.frame_selection),
        "short_flights": str(numbers.flights_shorter_than_num_frames),
        "captions_with": f"{captions.frames_with:,}",
        "captions_without": f"{captions.frames_without:,}",
        "agreement": _share(captions.decision_equals_label, captions.with_label),
        "with_label": f"{captions.with_label:,}",
        "example": _example(captions.example),
        "decisions_table": _table(
            ("decision", "frames", "share"),
            [
                (_Code(name), f"{n:,}", _share(n, captions.frames_with))
                for name, n in captions.frames_by["decision"].items()
            ],
        ),
        "coverage_table": _covered(numbers.coverage),
        "provenance_table": _provenance(captions),
        "characters_table": _characters(captions.mean_characters),
        "files_table": _table(
            ("", "bytes"),
            [(name, f"{size:,}") for name, size in numbers.files.bytes_by_modality.items()]
            + [("all shards", f"{numbers.files.bytes:,}")],
        ),
        "funnel_table": _funnel(history),
        "flights_without_length": str(numbers.flights - numbers.flight_length_m.count),
        "shown": shown(record),
        "verification": verification(record),
        "limits": limits(record),
        "modalities": "\n".join(f"- {_file_text(record, name)}" for name in settings.modalities),
        "decode": one_row(record),
        "parts": parts(record),
        "windows": windows(record),
        "columns_table": _columns(settings.modalities),
        "coordinates": coordinates_block(record),
        "licence": for_markdown(record.licence),
        "credits": credits(record),
        "citation": read_text(Path(__file__).with_name("citation.bib")).strip(),
        "made_by": for_markdown(record.made_by),
    }


def _file_text(record: ReleaseRecord, file: FrameFile) -> str:
    """Say what a picture column holds; of a coded depth also what the coding costs."""
    if file != "depth" or record.depth is None:
        return FILE_TEXT.get(file, "")
    coded = record.depth
    text = f"`depth`: {DEPTH_TEXT[coded.coding]}"
    if coded.coding == "float32":
        return text
    reach = "" if coded.min_m is None else f", {coded.min_m:g} to {coded.max_m:g} m"
    return f"{text}{reach}; {coded.sky:g} sky, {coded.invalid:g} invalid; greatest error of a pixel {coded.max_error_m:g} m"


def _provenance(captions: CaptionNumbers) -> str:
    rows: list[tuple[str, ...]] = [
        (column.title, _Code(value), f"{n:,}")
        for column in CAPTION
        if column.counted and column.words != "actions"  # which have a table of their own
        for value, n in captions.frames_by[column.name].items()
    ]
    for name, share in captions.mean_proved.items():
        rows.append(("sentences proved, mean", _Code(name), "-" if share is None else f"{100.0 * share:.1f} %"))
    return _table(("", "", "frames"), rows)


def _front_matter(record: ReleaseRecord) -> str:
    matter = {
        "license": for_terminal(record.licence),
        "language": ["en", "zh"],
        "pretty_name": for_terminal(record.name),
        "size_categories": [size_category(record.numbers.frames)],
        "task_categories": ["image-text-to-text", "robotics"],
        "tags": tags(record),
        "configs": [{"config_name": "default", "data_files": _data_files(record)}],
    }
    return yaml.safe_dump(matter, sort_keys=False, allow_unicode=True).strip()


def _data_files(record: ReleaseRecord) -> list[dict[str, str]]:
    """Give the pattern of each split's shards. It names the content: by it the library's cache tells one release from another."""
    return [{"split": split, "path": shard_pattern(split, record.content_digest)} for split in record.splits.splits]


def _splits(record: ReleaseRecord) -> str:
    rows = [
        (
            split,
            *(
                f"{n:,}"
                for n in (own.frames, own.captions, own.flights, own.trajectories, len(own.walks), len(own.towns))
            ),
        )
        for split, own in record.splits.splits.items()
    ]
    return _table(("split", "frames", "captions", "flights", "trajectories", "walks", "towns"), rows)


def _summary(record: ReleaseRecord) -> str:
    numbers = record.numbers
    tracks = ", ".join(f"{count} {name}" for name, count in numbers.flights_by_track.items())
    towns = len(numbers.frames_by.town)
    part = record.part_of
    whole = f" A part of the release {part.name}, content {part.content_digest}." if part is not None else ""
    return for_markdown(
        f"{numbers.frames:,} frames of {numbers.flights:,} flights ({tracks}) "
        f"over {numbers.trajectories:,} trajectories in {towns} {'town' if towns == 1 else 'towns'}; "
        f"{numbers.captions.frames_with:,} frames carry a reason in English and in Chinese.{whole}"
    )


def _groups(frames_by: FramesBy) -> list[tuple[str, str]]:
    titles = {"town": "town", "track": "track", "fov_deg": "field of view (degrees)", "image_px": "image (px)"}
    return [(f"{titles[name]} {value}", f"{count:,}") for name, counts in frames_by for value, count in counts.items()]


def _spreads(numbers: Numbers) -> str:
    titles = (
        ("frames per flight", numbers.frames_per_flight),
        ("duration of a flight, s", numbers.flight_duration_s),
        ("length of a flight without its perturbation, through its released frames, m", numbers.flight_length_m),
        ("height over the target's hip, m", numbers.height_over_target_m),
        ("distance to the target, m", numbers.distance_to_target_m),
        ("rendered visibility of the target", numbers.visibility),
    )
    rows = []
    for title, spread in titles:
        values = (spread.mean, spread.std, spread.min, spread.max)
        rows.append((title, *("-" if value is None else f"{value:,.3f}" for value in values), f"{spread.count:,}"))
    return _table(("", "mean", "std", "min", "max", "values"), rows)


def _covered(coverage: Coverage) -> str:
    tables = [_table(("5 % to 95 % of the frames", "here", "plain run"), ranges(coverage))]
    for kind in NAMED:
        rows = [(_Code(name), f"{n:,}", share, plain) for name, n, share, plain in shares(coverage, kind)]
        tables += [_table((kind, "frames", "share", "plain run"), rows)] if rows else []
    return "\n\n".join(tables)


def _characters(mean: dict[str, float | None]) -> str:
    cells = {name: "-" if value is None else f"{value:.1f}" for name, value in mean.items()}
    return _table(("mean characters", "English", "Chinese"), _both_languages(cells))


def _example(example: dict[str, str]) -> str:
    if not example:
        return "No frame has a caption."
    return f"{markdown_code(example['sample_id'])}:\n\n{_table(('', 'English', 'Chinese'), _both_languages(example))}"


def _both_languages(cells: dict[str, str]) -> list[tuple[str, ...]]:
    """Give a row for each field of a caption, of cells by column."""
    return [(name, *(cells.get(f"caption_{language}_{name}", "-") for language in ("en", "zh"))) for name in FIELDS]


def _funnel(history: History) -> str:
    planned, flights, captions = history.trajectories, history.flights, history.captions
    rows: list[tuple[str, int]] = []
    if planned is not None:
        rows += [("trajectories planned", planned.planned)]
        rows += [(f"dropped before rendering: {reason}", count) for reason, count in planned.dropped.items()]
        rows += [("trajectories not rendered", planned.not_rendered), ("trajectories rendered", planned.rendered)]
    rows += [("flights found", flights.found), ("of these inspected", flights.inspected)]
    rows += [(f"flights left out: {reason}", count) for reason, count in flights.left_out.items()]
    rows += [("flights released", flights.released), ("captions made", captions.read)]
    rows += [(f"captions dropped: {reason}", count) for reason, count in captions.dropped.items()]
    rows += [
        ("captions accepted, frame not selected", captions.frame_not_selected),
        ("captions accepted, window not whole", captions.window_not_whole),
        ("captions accepted, flight left out", captions.flight_left_out),
        ("captions released", captions.released),
    ]
    return _table(("step", "number"), [(name.replace("_", " "), f"{count:,}") for name, count in rows])


def _columns(files: list[FrameFile]) -> str:
    rows, words = [], {column.name: column.words for column in SCALARS}
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
        rows.append((_Code(member.name), kind, "a decision" if allowed == "actions" else ", ".join(allowed)))
    return _table(("column", "type", "values"), rows)


def _share(count: int, total: int) -> str:
    return f"{100.0 * count / total:.1f} %" if total else "-"


class _Code(str):
    """A cell that is shown as code."""


def _table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Give a Markdown table; numbers to the right. Cells are foreign text: they are shown as they are."""
    lines = [
        "| " + " | ".join(heads) + " |",
        "|" + "|".join("---" if i == 0 else "---:" for i in range(len(heads))) + "|",
    ]
    lines += ["| " + " | ".join(map(_cell, cells)) + " |" for cells in rows]
    return "\n".join(lines)


def _cell(text: str) -> str:
    return markdown_code(text) if isinstance(text, _Code) else for_markdown(text)
