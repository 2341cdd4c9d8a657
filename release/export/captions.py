"""Captions alone, for tools of others: a table, JSON lines, ShareGPT, LLaVA. Pictures are named, not copied.

Names of pictures are relative to the playback tree that the captions are of; those of a release, to the tree that
`cosfly release export --format tree` makes of it.
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

from cosfly.formats.captions import FIELDS, Language, Prompt, read_captions
from cosfly.formats.frames import FILE_NAMES, frame_name
from cosfly.formats.places import Place
from cosfly.runtime.errors import InputError, NothingKept, StorageError, shown
from cosfly.runtime.io import atomic_file, check_stays_below, inside
from cosfly.runtime.json_io import dump_json
from cosfly.viz.frame_views import Pictures, frame_label
from release.columns import LANGUAGES, SplitName, caption_values
from release.export.source import open_release, rows_of_flight, scan
from release.export.tree import tree_folder

FormatName = Literal["csv", "jsonl", "sharegpt", "llava"]
ImageChoice = Literal["all", "last"]
IMAGE = "<image>"  # where a picture goes, in ShareGPT and LLaVA alike; loaders count them
MARKS = (IMAGE, "<video>", "<audio>")
BOM = "\ufeff"  # without it spreadsheets read Chinese as something else
# What a spreadsheet takes for a formula at the begin of a cell (OWASP, CSV injection; full-width forms too).
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
LAST: dict[Language, str] = {
    "en": "One picture is given, that of the current frame: RGB. Pixel values refer to pictures of {} x {} px.",
    "zh": "仅给出当前帧的一张图像：RGB 图像。像素值以 {} × {} 像素的图像为准。",
}


@dataclass(frozen=True)
class CaptionLine:
    """One accepted caption as it leaves. images: of the frames of its window, oldest first. texts: language -> FIELDS
    -> text.
    """

    sample_id: str
    run: str
    town: str
    trajectory: str
    variant: str
    split: str  # "" where there is none
    frame_index: int
    window: list[int]
    images: list[str]
    picture_px: tuple[int, int]
    decision: str
    label: str | None
    verdict: str | None
    repair_strategy: str | None
    teacher: str
    texts: dict[Language, dict[str, str]]
    prompts: dict[Language, Prompt]

    def question(self, language: Language, shown: ImageChoice) -> Prompt:
        """Return the prompt with the sentence about the pictures that are shown."""
        if shown == "last":
            return self.prompts[language].told(LAST[language].format(*self.picture_px))
        return self.prompts[language].told(Pictures(("rgb",), self.picture_px).sentence(language))


# --- sources ----------------------------------------------------------------------------------------------------------


def read_lines(source: Path, left_out: Counter[str]) -> Iterator[CaptionLine]:
    """Yield the accepted captions of a run folder, a captions.jsonl (or the folder it stands in) or a release, in their
    order.

    Args:
        left_out: counts the others by reason.
    """
    if source.is_file():
        return _of_captions(source, None, left_out)
    if (source / "release.json").is_file() or (source / "dataset/release.json").is_file():
        return _of_release(source)
    if (source / "render").is_dir():
        captions = source / "caption/captions.jsonl"
        check_stays_below(captions, captions.parent)
        return _of_captions(captions, source / "render", left_out)
    if (source / "captions.jsonl").is_file():
        return _of_captions(source / "captions.jsonl", None, left_out)
    raise InputError(
        "the source has no captions", where=source,
        expected="a run directory, captions.jsonl or its folder, or a release",
        fix="run cosfly caption first, or pass its captions.jsonl",
    )  # fmt: skip


def _of_captions(path: Path, tree: Path | None, left_out: Counter[str]) -> Iterator[CaptionLine]:
    places: dict[str, str] = {}
    for caption in read_captions(path):
        if caption.status != "accepted":
            left_out[f"dropped_{caption.drop_reason}"] += 1
            continue
        named = f"{caption.town}/{caption.trajectory}/{caption.variant}"
        if named not in places:  # the tree may have been converted since
            places[named] = named if tree is None else inside(tree, named, in_parent=True).relative_to(tree).as_posix()
        images = [f"{places[named]}/{frame_name(index)}/{FILE_NAMES['rgb']}" for index in caption.window]
        if tree is not None and not all((tree / image).is_file() for image in images):
            left_out["missing_picture"] += 1
            continue
        row = caption_values(caption) | {
            "sample_id": caption.sample_id, "frame_index": caption.frame_index, "split": "",
            "teacher_model": caption.teacher.model,
        }  # fmt: skip
        run = "" if tree is None else tree.absolute().parent.name
        yield _of_row(row, Place(run, caption.town, caption.trajectory, caption.variant), images)


_COLUMNS = [
    "sample_id", "frame_index", "split", "has_caption", "caption_window", "caption_picture_px", "decision", "label",
    "verdict", "repair_strategy", "teacher_kind", "teacher_model",
    *(f"caption_{language}_{name}" for language in LANGUAGES for name in FIELDS),
    *(f"{part}_{language}" for language in LANGUAGES for part in ("system", "prompt")),
]  # fmt: skip


def _of_release(folder: Path) -> Iterator[CaptionLine]:
    release = open_release(folder)
    flights = scan(release)
    has_runs = len({flight.run for flight in flights}) > 1
    for flight in flights:
        numbers = {
            int(index): number for number, index in enumerate(flight.frame_index)
        }  # a tree counts released frames
        for row in rows_of_flight(release, flight, _COLUMNS):
            if not row["has_caption"]:
                continue
            window = row["caption_window"]
            if not window or not set(window) <= numbers.keys() or len(row["caption_picture_px"] or ()) != 2:
                raise InputError(
                    "the window of the caption is incomplete", where=f"{folder}: {row['sample_id']}", got=shown(window),
                    fix="check the release with cosfly release verify",
                )  # fmt: skip
            place = tree_folder(flight, has_runs)
            images = [(place / frame_name(numbers[index]) / FILE_NAMES["rgb"]).as_posix() for index in window]
            yield _of_row(row, Place(flight.run, flight.town, flight.trajectory, flight.variant), images)


def _of_row(row: Mapping[str, Any], flight: Place, images: list[str]) -> CaptionLine:
    texts = {
        language: {name: row[f"caption_{language}_{name}"] for name in FIELDS}
        for language in LANGUAGES
        if all(isinstance(row[f"caption_{language}_{name}"], str) for name in FIELDS)
    }
    prompts = {
        language: Prompt(system=row[f"system_{language}"], user=row[f"prompt_{language}"])
        for language in texts
        if row[f"system_{language}"] is not None and row[f"prompt_{language}"] is not None
    }
    width_px, height_px = row["caption_picture_px"]
    return CaptionLine(
        sample_id=row["sample_id"], run=flight.run, town=flight.town, trajectory=flight.trajectory,
        variant=flight.variant, split=row["split"] or "", frame_index=row["frame_index"], window=row["caption_window"],
        images=images, picture_px=(width_px, height_px),
        decision=row["decision"] or "", label=row["label"], verdict=row["verdict"],
        repair_strategy=row["repair_strategy"], teacher=f"{row['teacher_kind']}: {row['teacher_model']}", texts=texts,
        prompts=prompts,
    )  # fmt: skip


# --- formats ----------------------------------------------------------------------------------------------------------


class Wanted(NamedTuple):
    """What of each caption is written; shown: pictures of a conversation."""

    languages: list[Language]
    shown: ImageChoice


@dataclass
class CaptionTally:
    """What an export came to: samples written; captions and samples that were left out, by reason."""

    written: int = 0
    left_out: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(self.left_out.items()))
        return f"{self.written} written{f'; skipped: {reasons}' if reasons else ''}"


def export(
    source: Path,
    out: Path,
    format: FormatName,
    *,
    languages: Collection[Language] = LANGUAGES,
    shown: ImageChoice = "all",
    split: SplitName | None = None,
    overwrite: bool = False,
) -> CaptionTally:
    """Write the accepted captions of a source to one file; a table or JSON lines have a row a window, the others a
    sample a window and language.

    Args:
        shown: pictures of a sample in ShareGPT and LLaVA: those of all frames, or of the last one alone.
        split: the captions of this one alone. overwrite: replace a file that stands at `out`.
    Raises:
        StorageError: something stands at `out`. InputError: there is nothing to read, or conversations would mix
        splits.
        NothingKept: no caption can go out.
    """
    if out.exists() and not (overwrite and out.is_file()):
        fix = "pass --overwrite to replace it, or choose another --out" if out.is_file() else "pass the path of a file"
        raise StorageError(
            "the output file already exists" if out.is_file() else "the output path is a folder", where=out, fix=fix
        )
    told = CaptionTally()
    lines = _of_split(read_lines(source, told.left_out), split, format, told.left_out)
    wanted = Wanted([language for language in LANGUAGES if language in languages], shown)
    with atomic_file(out) as file:
        WRITERS[format](file, lines, wanted, told)
        if told.written == 0:
            raise NothingKept(
                "the source has no caption to export", where=source, got=str(told), expected="accepted captions"
            )
    return told


def _of_split(
    lines: Iterable[CaptionLine], split: SplitName | None, format: FormatName, left_out: Counter[str]
) -> Iterator[CaptionLine]:
    """Leave other splits out; conversations have no place to say which split they are of."""
    first = None
    for line in lines:
        if split not in (None, line.split):
            left_out["another_split"] += 1
            continue
        first = line.split if first is None else first
        if line.split != first and format in ("sharegpt", "llava"):
            fix = "write one file per split with --split train, --split validation and --split test"
            raise InputError(
                "the captions are of several splits", where=line.sample_id, got=f"{first}, {line.split}", fix=fix
            )
        yield line


def _row(line: CaptionLine, languages: list[Language]) -> dict[str, Any]:
    row: dict[str, Any] = {
        "sample_id": line.sample_id, "run": line.run, "town": line.town, "trajectory": line.trajectory,
        "variant": line.variant, "split": line.split, "frame_index": line.frame_index, "window": line.window,
        "images": line.images, "picture_px": list(line.picture_px),
        "decision": line.decision, "label": line.label, "verdict": line.verdict,
        "repair_strategy": line.repair_strategy, "teacher": line.teacher,
    }  # fmt: skip
    for language in languages:
        texts, prompt = (
            line.texts.get(language, {}),
            line.question(language, "all") if language in line.prompts else None,
        )
        row |= {f"{name}_{language}": texts.get(name) for name in FIELDS[:2]}
        row |= {f"system_{language}": prompt and prompt.system, f"prompt_{language}": prompt and prompt.user}
    return row


def _csv(file: IO[bytes], lines: Iterable[CaptionLine], wanted: Wanted, told: CaptionTally) -> None:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\r\n", quoting=csv.QUOTE_MINIMAL)
    file.write(BOM.encode())
    for line in lines:
        row = _row(line, wanted.languages)
        if told.written == 0:
            writer.writerow(row)
        writer.writerow([cell(value) for value in row.values()])
        file.write(buffer.getvalue().encode())
        buffer.seek(0)
        buffer.truncate()
        told.written += 1


def cell(value: Any) -> str:
    """Return a value as a spreadsheet may show it: a list as JSON, nothing for None, and no text that it would
    calculate.
    """
    text = "" if value is None else value if isinstance(value, str) else dump_json(value)
    return f"'{text}" if isinstance(value, str) and text.lstrip(" ").startswith(FORMULA) else text


def _jsonl(file: IO[bytes], lines: Iterable[CaptionLine], wanted: Wanted, told: CaptionTally) -> None:
    for line in lines:
        file.write((dump_json(_row(line, wanted.languages)) + "\n").encode())
        told.written += 1


def _sharegpt(name: str, prompt: Prompt, images: list[str], asked: str, answer: str, wanted: Wanted) -> dict[str, Any]:
    """As LLaMA-Factory reads it: roles in turns, human first; as many marks as `images`, which are joined to its
    media_dir.
    """
    turns = [{"from": "human", "value": asked}, {"from": "gpt", "value": answer}]
    return {"id": name, "conversations": turns, "system": prompt.system, "images": images}


def _llava(name: str, prompt: Prompt, images: list[str], asked: str, answer: str, wanted: Wanted) -> dict[str, Any]:
    """As LLaVA's trainers read it: `image` below its image folder, one name, or a list, which the first LLaVA does not
    take.

    It has no place for a system prompt, so that stands in front of the question.
    """
    marks, question = asked.split("\n\n", 1)
    turns = [{"from": "human", "value": f"{marks}\n{prompt.system}\n\n{question}"}, {"from": "gpt", "value": answer}]
    return {"id": name, "image": images[0] if wanted.shown == "last" else images, "conversations": turns}


def _conversations(
    sample: Callable[..., dict[str, Any]],
    file: IO[bytes],
    lines: Iterable[CaptionLine],
    wanted: Wanted,
    told: CaptionTally,
) -> None:
    """Write a JSON array, a sample a line: LLaVA reads no other form, and memory stays flat."""
    begin, is_last = "[\n", wanted.shown == "last"
    for line, language in ((line, language) for line in lines for language in wanted.languages):
        if language not in line.texts or language not in line.prompts:
            told.left_out[f"no_{language}"] += 1
            continue
        prompt, answer = line.question(language, wanted.shown), dump_json(line.texts[language])
        if any(mark in text for mark in MARKS for text in (prompt.system, prompt.user, answer)):
            told.left_out["text_with_a_mark_for_pictures"] += 1  # a loader would look for one more
            continue
        images = line.images[-1:] if is_last else line.images
        labels = ["" if is_last else f"{frame_label(number)} " for number in range(len(images))]
        asked = "\n".join(f"{label}{IMAGE}" for label in labels) + f"\n\n{prompt.user}"
        told.written += 1
        written = sample(f"{line.sample_id}_{language}", prompt, images, asked, answer, wanted)
        file.write(f"{begin}{json.dumps(written, ensure_ascii=False)}".encode())
        begin = ",\n"
    file.write(b"\n]\n")


LineWriter = Callable[[IO[bytes], Iterable[CaptionLine], Wanted, CaptionTally], None]
WRITERS: dict[FormatName, LineWriter] = {
    "csv": _csv, "jsonl": _jsonl, "sharegpt": partial(_conversations, _sharegpt),
    "llava": partial(_conversations, _llava),
}  # fmt: skip
