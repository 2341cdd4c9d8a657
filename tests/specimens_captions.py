"""What tests of captions share: what ships, windows made by hand, the rule teacher's texts, settings and servers of
quick runs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from teacher_server import TeacherServer

from caption.schema import CaptionConfig
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.rules import write_templates
from caption.truth.facts import Facts
from caption.writing.contract import Draft, way_of
from cosfly.formats.captions import Coc
from cosfly.llm.answer_text import Parsed

VOCABULARY = vocabulary_of(CaptionConfig())  # what ships
WAY = way_of("slots", VOCABULARY)
# A drone that climbs, speeds up and turns right; the walker is hidden once.
FACTS = Facts(
    speed_mps=(None, 2.0, 2.5, 3.0, 4.0), altitude_m=(20.0, 20.0, 20.5, 21.0, 22.0),
    yaw_deg=(0.0, -1.0, -3.0, -6.0, -10.0), pitch_deg=(-40.0, -40.2, -40.1, -40.0, -40.3),
    distance_m=(20.0, 20.5, 21.0, 20.0, 18.0), slant_m=(28.0, 28.5, 29.0, 28.5, 28.0), target_speed_mps=1.6,
    target_turn_deg=-30.0, box_width_px=(30, 30, 31, 33, 36), box_height_px=(60, 61, 62, 66, 72),
    offset_x_px=(0, 10, -40, -50, -64), offset_y_px=(0, 0, 5, 10, 20),
    visibility=("visible", "visible", "partly_occluded", "occluded", "visible"), width_px=640, height_px=360,
    target_speeds_mps=(None, 1.6, 1.6, 1.6, 1.6), target_headings_deg=(None, 90.0, 80.0, 70.0, 60.0),
    bearing_deg=(0.0, -1.0, 3.0, 5.0, 6.5),
)  # fmt: skip
# The same, of which nothing is known at t3, and little of the walker.
GAP = dataclasses.replace(
    FACTS, distance_m=(20.0, 20.5, 21.0, None, 18.0), slant_m=(28.0, 28.5, 29.0, None, 28.0),
    box_width_px=(30, 30, 31, None, 36), box_height_px=(60, 61, 62, None, 72), offset_x_px=(0, 10, -40, None, -64),
    offset_y_px=(0, 0, 5, None, 20), target_speeds_mps=(), target_headings_deg=(), bearing_deg=(),
)  # fmt: skip
# A climbing, accelerating drone turns right after a walker who bends right and is partly covered at the end.
FOLLOW = Facts(
    speed_mps=(None, 2.0, 2.4, 2.9, 3.4), altitude_m=(18.0, 18.3, 18.9, 19.6, 20.4),
    yaw_deg=(0.0, -2.0, -4.5, -7.0, -9.6), pitch_deg=(-40.0, -40.5, -41.2, -42.0, -42.9),
    distance_m=(21.5, 21.2, 20.8, 20.3, 19.7), slant_m=(27.5, 27.4, 27.5, 27.6, 27.7), target_speed_mps=1.45,
    target_turn_deg=-20.0, box_width_px=(20, 20, 21, 22, 23), box_height_px=(50, 51, 53, 55, 58),
    offset_x_px=(5, 12, 25, 38, 52), offset_y_px=(0, 2, -3, -8, -14),
    visibility=("visible", "visible", "visible", "partly_occluded", "partly_occluded"), width_px=640, height_px=360,
    heading_deg=(30.0, 28.0, 25.5, 23.0, 20.4), travelled_m=(0.0, 1.0, 2.2, 3.7, 5.4),
    displacement_m=(0.0, 1.0, 2.2, 3.6, 5.2), target_speeds_mps=(None, 1.5, 1.5, 1.4, 1.4),
    target_headings_deg=(None, 10.0, 4.0, -3.0, -10.0), target_travelled_m=(0.0, 0.8, 1.5, 2.2, 2.9),
    height_over_target_m=(17.1, 17.4, 18.0, 18.7, 19.5), bearing_deg=(-0.4, -1.0, -2.2, -3.4, -4.6),
    depression_deg=(38.5, 39.4, 40.9, 42.7, 44.7),
)  # fmt: skip


def write_answers(facts: Facts, rng: np.random.Generator, decision: str | None = None) -> tuple[Coc, Coc]:
    """Give the rule teacher's English and Chinese answer as plain text."""
    english, chinese = (Coc(**answer) for answer in write_templates(facts, rng.bytes(32), decision))
    first = WAY.read(Parsed(english, therefore=english.flight_decision), facts)
    assert isinstance(first, Draft), first
    second = WAY.read_mirror(Parsed(chinese), first, facts)
    assert isinstance(second, Draft), second
    return first.coc, second.coc


QUICK = {"max_tries": 2, "timeout_s": 30.0, "concurrency": 4}


def settings(url: str, **changes) -> CaptionConfig:
    """Settings of a quick run: small pictures, short waits, and conflicts that stay."""
    endpoint = QUICK | changes.pop("endpoint", {})
    base = {"teacher": url, "endpoint": endpoint, "repair": {"hard_conflict": "keep"}, "image": {"max_side_px": 32}}
    return CaptionConfig.model_validate(base | changes)


def deciding(decision: str = "hover", fault=None, **options) -> TeacherServer:
    """A teacher that always decides the same."""
    return TeacherServer(fault, decision=lambda body: decision, **options)


def saying(text: Callable[[dict], str]) -> TeacherServer:
    """A server that answers with any text."""
    server = TeacherServer()
    server.text = text
    return server


def report_of(out: Path) -> dict:
    return json.loads((out / "caption_report.json").read_text(encoding="utf-8"))
