"""What is done for windows before anybody is asked: measured, labelled, their questions written."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from caption.schema import CaptionConfig, Window
from caption.teachers.foreign import Terms
from caption.teachers.prompts import Question, make_question, prompt_hash
from caption.teachers.teacher import Teacher, terms_of
from caption.truth.actions import Motion, contradicted_by, label_of, measure


class Prepared(NamedTuple):
    """A window, what is asked about it, and what its answer is held against."""

    window: Window
    terms: Terms
    question: Question
    prompt_hash: str
    motion: Motion
    label: str | None
    contradicted: list[str]


def prepare(windows: Sequence[Window], teacher: Teacher, cfg: CaptionConfig) -> list[Prepared]:
    """Measure windows and write their questions: each step for all of them, while the processor's caches hold its code."""
    terms = [terms_of(teacher, window.observed.sample_id, cfg) for window in windows]
    questions = [make_question(w.observed, cfg.image, t.writing) for w, t in zip(windows, terms, strict=True)]
    hashes = [prompt_hash(question) for question in questions]
    motions = [measure(window.future) for window in windows]
    labels = [label_of(motion, cfg.label) for motion in motions]
    contradicted = [contradicted_by(m, cfg.label, label) for m, label in zip(motions, labels, strict=True)]
    return list(map(Prepared, windows, terms, questions, hashes, motions, labels, contradicted))
