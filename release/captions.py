"""Which captions go into a release: the accepted ones, by flight and frame, and an account of all."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.captions import FIELDS, Caption, read_captions
from release.columns import ReleasedCaption


@dataclass
class Captions:
    """Accepted captions by flight folder key and frame, and the account of all."""

    by_flight: dict[tuple[str, str, str], dict[int, ReleasedCaption]] = field(default_factory=dict)
    num_read: int = 0
    num_accepted: int = 0
    dropped: Counter[str] = field(default_factory=Counter)


def load_captions(path: Path) -> Captions:
    """Read the captions, without their prompts.

    Raises:
        InputError: a frame has two accepted captions, or an accepted one lacks a language or disagrees with itself.
    """
    captions = Captions()
    for caption in read_captions(path):
        captions.num_read += 1
        if caption.status != "accepted":
            captions.dropped[caption.drop_reason or "no reason given"] += 1
            continue
        captions.num_accepted += 1
        frames = captions.by_flight.setdefault((caption.town, caption.trajectory, caption.variant), {})
        if caption.frame_index in frames:
            raise InputError("a frame has two accepted captions", where=path, got=caption.sample_id)
        frames[caption.frame_index] = _released(caption, path)
    return captions


def _released(caption: Caption, path: Path) -> ReleasedCaption:
    if caption.en is None or caption.zh is None:
        raise InputError("an accepted caption lacks a language", where=f"{path}: {caption.sample_id}")
    if caption.en.flight_decision != caption.zh.flight_decision:
        got = f"{caption.en.flight_decision} and {caption.zh.flight_decision}"
        raise InputError("the two languages decide differently", where=f"{path}: {caption.sample_id}", got=got)
    texts = {
        f"caption_{language}_{name}": getattr(answer, name)
        for language, answer in (("en", caption.en), ("zh", caption.zh))
        for name in FIELDS
    }
    facts = {
        "decision": caption.en.flight_decision,
        "label": caption.label,
        "verdict": caption.verdict,
        "repair_strategy": caption.repair.strategy if caption.repair else None,
        "teacher_kind": caption.teacher.kind,
        "teacher_model": caption.teacher.model,
    }
    return ReleasedCaption(tuple(caption.window), facts | texts)
