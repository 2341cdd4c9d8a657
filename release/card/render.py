"""The data-set card: `render_card` turns release.json into README.md, so that a card which says anything else is found.

Its numbers are those of `numbers.py`, its words those of `claims.py`: build writes the numbers into release.json, verify computes them again and compares.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import yaml

from cosfly.escaping import for_markdown, for_terminal, markdown_code
from cosfly.look.coverage_page import ranges, shares
from cosfly.products.captions import FIELDS
from cosfly.products.coverage import NAMED, Coverage
from cosfly.products.frames import FrameFile
from cosfly.reading.files import read_text
from release.card import claims, snippets
from release.columns import PICTURES, schema
from release.record import CaptionNumbers, DepthCodingName, FramesBy, History, Numbers, ReleaseRecord, shard_pattern

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
            [(_Code(name), f"{n:,}", _share(n, captions.frames_with)) for name, n in captions.decision.items()],
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
        "shown": claims.shown(record),
        "verification": claims.verification(record),
        "limits": claims.limits(record),
        "modalities": "\n".join(f"- {_file_text(record, name)}" for name in settings.modalities),
        "decode": snippets.one_row(record),
        "parts": snippets.parts(record),
        "windows": snippets.windows(record),
        "columns_table": _columns(settings.modalities),
        "coordinates": claims.coordinates_block(record),
        "licence": for_markdown(record.licence),
        "credits": claims.credits(record),
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
    groups = (
        ("verdict against the geometry", captions.verdict),
        ("label from", captions.label_from),
        ("written as", captions.writing),
        ("repair", captions.repair_strategy),
        ("kind of teacher", captions.teacher_kind),
        ("teacher model", captions.teacher_model),
    )
    rows: list[tuple[str, ...]] = [
        (title, _Code(value), f"{n:,}") for title, counts in groups for value, n in counts.items()
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
        "tags": claims.tags(record),
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
    rows = []
    for member in schema(files):
        kind = "float64" if str(member.type) == "double" else str(member.type)
        if member.name in (PICTURES["rgb"].name, PICTURES["instance"].name):
            kind = "image"
        elif kind.startswith("struct"):
            kind = "texts " if member.type[0].type == "string" else "numbers "
            kind += ", ".join(child.name for child in member.type)
        elif kind.startswith("list"):
            kind = f"list of {member.type.value_type}"
        rows.append((_Code(member.name), kind))
    return _table(("column", "type"), rows)


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
