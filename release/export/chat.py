"""Captions as conversations with pictures, one file a split: `chat` for TRL, transformers and ms-swift, `sharegpt` for
LLaMA-Factory.

    train.jsonl or train.json, images/<town>/<trajectory>/<variant>/frame_00004.png

A sample is a window in one language: its pictures, oldest first, the question, and the answer as JSON. Names of
pictures are relative to the folder of the export.
"""

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from cosfly.formats.captions import FIELDS, Language, Prompt
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import NothingKept
from cosfly.runtime.io import atomic_file, write_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.png import colours_of, colours_png
from cosfly.viz import frame_views
from release.columns import PICTURE_PX, WINDOW
from release.export.stage import ExportConfig, ExportSource, FormatFacts, SourceTrack
from release.reading import Row

IMAGE = "<image>"  # where ShareGPT has a picture; loaders count these marks
MARKS = (IMAGE, "<video>", "<audio>")
LAST_FRAME_SENTENCE: dict[Language, str] = {  # in place of that of all frames of a window
    "en": "One picture is given, that of the current frame: RGB. Pixel values refer to pictures of {} x {} px.",
    "zh": "仅给出当前帧的一张图像：RGB 图像。像素值以 {} × {} 像素的图像为准。",
}
DATASET_INFO = "dataset_info.json"  # where LLaMA-Factory looks up its data sets


def write(source: ExportSource, folder: Path, cfg: ExportConfig, advance: Advance) -> FormatFacts:
    """Write the pictures that the samples show, and the samples, one file a split."""
    skipped = Counter[str]()  # windows and texts that are no sample, by reason
    counts: dict[str, int] = {}  # file -> samples
    for split, tracks in itertools.groupby(source.tracks(), lambda track: track.split):
        samples = (sample for track in tracks for sample in _samples(track, folder, cfg, skipped, advance))
        name = f"{split}.jsonl" if cfg.format == "chat" else f"{split}.json"
        if count := _write_file(folder / name, samples):
            counts[name] = count
    reasons = ", ".join(f"{reason}: {count}" for reason, count in sorted(skipped.items()))
    if not counts:
        got = f"no caption; {reasons}" if reasons else "no caption"
        what, expected = "the source has no caption to export", "accepted captions"
        raise NothingKept(what, where=source.folder, got=got, expected=expected)
    if cfg.format == "sharegpt":
        columns = {"messages": "conversations", "system": "system", "images": "images"}
        settings = {"formatting": "sharegpt", "columns": columns}
        data_sets = {f"cosfly_{Path(name).stem}": {"file_name": name, **settings} for name in counts}
        write_bytes(folder / DATASET_INFO, (dump_json(data_sets, indent=1) + "\n").encode())
    return FormatFacts({"num_samples": sum(counts.values()), "skipped": reasons, "first_file": next(iter(counts))})


def _write_file(path: Path, samples: Iterable[dict[str, Any]]) -> int:
    """Write samples as JSON Lines or as one JSON array; return their number. Without samples no file stays."""
    begin, between, end = (b"", b"\n", b"\n") if path.suffix == ".jsonl" else (b"[\n", b",\n", b"\n]\n")
    count = 0
    with atomic_file(path) as file:
        file.write(begin)
        for count, sample in enumerate(samples, 1):
            file.write((between if count > 1 else b"") + json.dumps(sample, ensure_ascii=False).encode())
        file.write(end)
    if not count:
        path.unlink()
    return count


def _samples(
    track: SourceTrack, folder: Path, cfg: ExportConfig, skipped: Counter[str], advance: Advance
) -> list[dict[str, Any]]:
    """Return the samples of a track, and write their pictures; count by reason what cannot be a sample."""
    captioned = [row for row in track.rows if row["has_caption"]]
    frame_indices = set(track.frame_index)
    samples = [sample for row in captioned for sample in _samples_of(row, track, frame_indices, cfg, skipped)]
    if not samples:
        return []  # no picture is read
    shown = {name for sample in samples for name in sample["images"]}
    # The texts refer to pixels of the pictures that the teacher saw.
    most_px = max((max(row[PICTURE_PX]) for row in captioned if row[PICTURE_PX]), default=0)
    is_scaled = most_px < max(track.size_px)
    for row, pictures in track.frames():
        name, data = _picture_name(track, row["frame_index"]), pictures["rgb"]
        if name in shown:
            if is_scaled:
                data = colours_png(frame_views.bounded(colours_of(data, row["sample_id"]), most_px))
            write_bytes(folder / name, data)
        advance(1)
    return samples


def _picture_name(track: SourceTrack, index: int) -> str:
    """Return a path within the export; parts of the name of a track may be empty."""
    return "/".join(filter(None, ("images", *track.name.split("/"), f"frame_{index:05d}.png")))


def _samples_of(
    row: Row, track: SourceTrack, frame_indices: set[int], cfg: ExportConfig, skipped: Counter[str]
) -> Iterator[dict[str, Any]]:
    """Yield the samples of a caption, one per language."""
    is_last = cfg.frames == "last"
    window = (row[WINDOW] or [])[-1 if is_last else 0 :]
    if not window or not set(window) <= frame_indices:
        skipped["frames of the window are not in the source"] += 1
        return
    images = [_picture_name(track, index) for index in window]
    for language in cfg.languages:
        answer = {name: row[f"caption_{language}_{name}"] for name in FIELDS}
        system, user = row[f"system_{language}"], row[f"prompt_{language}"]
        if None in (*answer.values(), system, user, row[PICTURE_PX]):
            skipped[f"no text or question in {language}"] += 1
            continue
        size_px = tuple(row[PICTURE_PX])
        sentence = frame_views.Pictures(("rgb",), size_px).sentence(language)
        if is_last:
            sentence = LAST_FRAME_SENTENCE[language].format(*size_px)
        prompt, reply = Prompt(system=system, user=user).filled(sentence), dump_json(answer)
        if any(mark in text for mark in MARKS for text in (prompt.system, prompt.user, reply)):
            skipped["a text with a mark for pictures"] += 1  # a loader would look for one more
            continue
        labels = [""] if is_last else [frame_views.frame_label(number) for number in range(len(images))]
        form = _messages if cfg.format == "chat" else _sharegpt
        yield {"id": f"{row['sample_id']}_{language}", **form(prompt, labels, reply), "images": images}


def _messages(prompt: Prompt, labels: Sequence[str], reply: str) -> dict[str, Any]:
    """Return the turns as typed blocks. The system prompt begins the question: ms-swift takes no blocks in a system
    turn, and TRL and `datasets` need blocks in all turns or in none."""

    def block(text: str) -> dict[str, str]:
        return {"type": "text", "text": text}

    question = [block(f"{prompt.system}\n\n")]
    for label in labels:
        question += [block(f"{label} "), {"type": "image"}] if label else [{"type": "image"}]
    turns = {"user": [*question, block(f"\n\n{prompt.user}")], "assistant": [block(reply)]}
    return {"messages": [{"role": role, "content": content} for role, content in turns.items()]}


def _sharegpt(prompt: Prompt, labels: Sequence[str], reply: str) -> dict[str, Any]:
    """Return the turns as LLaMA-Factory reads them, a mark for each picture."""
    question = "\n".join(f"{label} {IMAGE}".lstrip() for label in labels) + f"\n\n{prompt.user}"
    turns = [{"from": "human", "value": question}, {"from": "gpt", "value": reply}]
    return {"conversations": turns, "system": prompt.system}
