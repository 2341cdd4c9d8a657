"""Captions as conversations with pictures, one file a split: `chat` for TRL, transformers and ms-swift, `sharegpt` for
LLaMA-Factory.

    train.jsonl or train.json, images/<town>/<trajectory>/<variant>/frame_00004.png

A sample is a window in one language: its pictures, oldest first, the question, and the answer as JSON. Names of
pictures are relative to the folder of the export.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cosfly.formats.captions import FIELDS, Language, Prompt
from cosfly.runtime.errors import NothingKept
from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.worker import advance
from cosfly.viz.frame_views import Pictures, frame_label
from release.columns import LANGUAGES, PICTURE_PX, PICTURES, SPLIT_NAMES, WINDOW
from release.export.source import ExportSource, Row, picture
from release.export.stage import (
    ExportConfig,
    ExportUnit,
    Files,
    FormatFacts,
    UnitFiles,
    join_parts,
    scratch_of,
    track_units,
)

IMAGE = "<image>"  # where ShareGPT has a picture; loaders count these marks
MARKS = (IMAGE, "<video>", "<audio>")
LAST: dict[Language, str] = {
    "en": "One picture is given, that of the current frame: RGB. Pixel values refer to pictures of {} x {} px.",
    "zh": "仅给出当前帧的一张图像：RGB 图像。像素值以 {} × {} 像素的图像为准。",
}
COLUMNS = [
    "sample_id", "frame_index", "has_caption", WINDOW, PICTURE_PX,
    *(f"caption_{language}_{name}" for language in LANGUAGES for name in FIELDS),
    *(f"{part}_{language}" for language in LANGUAGES for part in ("system", "prompt")),
]  # fmt: skip
DATASET_INFO = "dataset_info.json"  # where LLaMA-Factory looks up its data sets


def plan(source: ExportSource, cfg: ExportConfig) -> list[ExportUnit]:
    """Return one unit per track."""
    return track_units(source)


def write(source: ExportSource, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> UnitFiles:
    """Write the pictures of one track that its samples show, and its samples as lines of a part."""
    (piece,), files, skipped = unit.pieces, Files(folder), Counter[str]()
    place = "/".join(filter(None, ("images", *unit.name.split("/"))))
    known, shown, num_samples = set(piece.track.frame_index.tolist()), set[int](), 0
    with atomic_file(_part(folder, unit)) as part:
        for row in piece.track.rows(COLUMNS):
            for sample in _samples(row, known, place, cfg, skipped):
                part.write((json.dumps(sample, ensure_ascii=False) + "\n").encode())
                shown |= {int(Path(name).stem.rpartition("_")[2]) for name in sample["images"]}
                num_samples += 1
    for row in piece.track.rows(["sample_id", "frame_index", PICTURES["rgb"].name]) if shown else ():
        if row["frame_index"] in shown:
            files.put(f"{place}/frame_{row['frame_index']:05d}.png", picture(row, "rgb"))
        advance()
    return files.written(samples=num_samples, skipped=skipped)


def _part(folder: Path, unit: ExportUnit) -> Path:
    return scratch_of(folder) / f"{unit.name.replace('/', '_')}.jsonl"


def _samples(
    row: Row, known: set[int], place: str, cfg: ExportConfig, skipped: Counter[str]
) -> Iterator[dict[str, Any]]:
    """Yield the samples of a row, one per language; count by reason what cannot be one."""
    if not row["has_caption"]:
        return
    window = row[WINDOW][-1:] if cfg.frames == "last" else row[WINDOW]
    if not set(window) <= known:
        skipped["frames of the window are not in the source"] += 1
        return
    images = [f"{place}/frame_{index:05d}.png" for index in window]
    for language in cfg.languages:
        answer = {name: row[f"caption_{language}_{name}"] for name in FIELDS}
        system, user = row[f"system_{language}"], row[f"prompt_{language}"]
        if None in answer.values() or None in (system, user):
            skipped[f"no text or question in {language}"] += 1
            continue
        size_px = tuple(row[PICTURE_PX])
        told = (
            LAST[language].format(*size_px) if cfg.frames == "last" else Pictures(("rgb",), size_px).sentence(language)
        )
        prompt, reply = Prompt(system=system, user=user).told(told), dump_json(answer)
        if any(mark in text for mark in MARKS for text in (prompt.system, prompt.user, reply)):
            skipped["a text with a mark for pictures"] += 1  # a loader would look for one more
            continue
        labels = [""] if cfg.frames == "last" else [frame_label(number) for number in range(len(images))]
        form = _messages if cfg.format == "chat" else _sharegpt
        yield {"id": f"{row['sample_id']}_{language}", **form(prompt, labels, reply), "images": images}


def _messages(prompt: Prompt, labels: Sequence[str], reply: str) -> dict[str, Any]:
    """Return the turns as typed blocks. The system prompt begins the question: ms-swift takes no blocks in a system
    turn, and TRL and `datasets` need blocks in all turns or in none."""

    def text(text: str) -> dict[str, str]:
        return {"type": "text", "text": text}

    asked = [text(f"{prompt.system}\n\n")]
    for label in labels:
        asked += [text(f"{label} "), {"type": "image"}] if label else [{"type": "image"}]
    turns = {"user": [*asked, text(f"\n\n{prompt.user}")], "assistant": [text(reply)]}
    return {"messages": [{"role": role, "content": content} for role, content in turns.items()]}


def _sharegpt(prompt: Prompt, labels: Sequence[str], reply: str) -> dict[str, Any]:
    """Return the turns as LLaMA-Factory reads them, a mark for each picture."""
    asked = "\n".join(f"{label} {IMAGE}".lstrip() for label in labels) + f"\n\n{prompt.user}"
    turns = [{"from": "human", "value": asked}, {"from": "gpt", "value": reply}]
    return {"conversations": turns, "system": prompt.system}


def finish(
    source: ExportSource, units: Sequence[ExportUnit], written: Sequence[UnitFiles], folder: Path, cfg: ExportConfig
) -> FormatFacts:
    """Join the parts to one file a split."""
    skipped = sum((Counter(one.facts["skipped"]) for one in written), Counter[str]())
    reasons = ", ".join(f"{reason}: {count}" for reason, count in sorted(skipped.items()))
    if not (total := sum(one.facts["samples"] for one in written)):
        got = f"no caption; {reasons}" if reasons else "no caption"
        raise NothingKept(
            "the source has no caption to export", where=source.folder, got=got, expected="accepted captions"
        )
    names = {}
    for split in SPLIT_NAMES:
        own = [unit for unit, one in zip(units, written, strict=True) if unit.split == split and one.facts["samples"]]
        if own and cfg.format == "chat":
            names[split] = f"{split}.jsonl"
            join_parts([_part(folder, unit) for unit in own], folder / names[split])
        elif own:
            names[split] = f"{split}.json"
            join_parts([_part(folder, unit) for unit in own], folder / names[split], b"[\n", b",\n", b"\n]\n")
    files = Files(folder)
    for name in names.values():
        files.note(name)
    first = next(iter(names.values()))
    run_here = "Names of pictures are relative to this folder: start the training in it."
    opened = f'from datasets import load_dataset\nsamples = load_dataset("json", data_files="{first}", split="train")'
    if cfg.format == "sharegpt":
        columns = {"messages": "conversations", "system": "system", "images": "images"}
        about = {
            f"cosfly_{split}": {"file_name": name, "formatting": "sharegpt", "columns": columns}
            for split, name in names.items()
        }
        files.put(DATASET_INFO, (dump_json(about, indent=1) + "\n").encode())
        run_here = "dataset_dir and media_dir of LLaMA-Factory are this folder, which has the dataset_info.json."
        opened = "# llamafactory-cli train --dataset_dir . --media_dir . --dataset cosfly_train ..."
    return FormatFacts(
        version="messages and images" if cfg.format == "chat" else "ShareGPT",
        codings={"images": "PNG, the released bytes", "answer": "JSON text of the three fields of a caption"},
        notes=[f"{total} samples, one per window and language. Skipped: {reasons or 'none'}.", run_here],
        how_to_open=opened, files=files.digests,
    )  # fmt: skip
