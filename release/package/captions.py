"""Which captions go into a release: the accepted ones, by flight and frame, and an account of all."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.captions import FIELDS, Caption, read_captions
from cosfly.products.places import town_folder
from release.columns import PICTURE_PX, WINDOW, ReleasedCaption

ByFlight = dict[
    tuple[str, str, str], dict[int, ReleasedCaption]
]  # town's folder, trajectory, variant -> frame -> caption


def load_captions(path: Path) -> tuple[ByFlight, Counter[str]]:
    """Read the captions, without their prompts: the accepted ones, and how many were dropped for which reason.

    Raises:
        InputError: a frame has two accepted captions, or an accepted one lacks a language or disagrees with itself.
    """
    by_flight: ByFlight = {}
    dropped = Counter[str]()
    for caption in read_captions(path):
        if caption.status != "accepted":
            dropped[caption.drop_reason or "no reason given"] += 1
            continue
        frames = by_flight.setdefault((town_folder(caption.town), caption.trajectory, caption.variant), {})
        if caption.frame_index in frames:
            raise InputError("a frame has two accepted captions", where=path, got=caption.sample_id)
        frames[caption.frame_index] = _released(caption, f"{path}: {caption.sample_id}")
    return by_flight, dropped


def _released(caption: Caption, where: str) -> ReleasedCaption:
    if caption.en is None or caption.zh is None:
        fix = "release captions in both languages; English alone can be reported and train students"
        raise InputError("an accepted caption lacks a language", where=where, fix=fix)
    if caption.en.flight_decision != caption.zh.flight_decision:
        got = f"{caption.en.flight_decision} and {caption.zh.flight_decision}"
        raise InputError("the two languages decide differently", where=where, got=got)
    return {
        WINDOW: caption.window,
        PICTURE_PX: list(caption.picture_px),
        "decision": caption.en.flight_decision,
        "label": caption.label,
        "label_from": caption.label_from,
        "verdict": caption.verdict,
        "repair_strategy": caption.repair.strategy if caption.repair else None,
        "teacher_kind": caption.teacher.kind,
        "teacher_model": caption.teacher.model,
        "writing": caption.writing,
        "proved_en": caption.coverage("en"),
        "proved_zh": caption.coverage("zh"),
        **{f"caption_en_{name}": getattr(caption.en, name) for name in FIELDS},
        **{f"caption_zh_{name}": getattr(caption.zh, name) for name in FIELDS},
    }
