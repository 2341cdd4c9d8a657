"""What tests of captions share."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from teacher_server import TeacherServer

from caption.answer_formats.formats import FORMATS, Draft
from caption.schema import CaptionConfig, Window, WindowConfig
from caption.stage.windows import cut_windows
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.rules import write_templates
from caption.verification.facts import Facts
from caption.verification.values import check_values
from cosfly.formats.captions import Coc, Language
from cosfly.llm.answer_text import sentences_of
from specimens import make_flight

VOCABULARY = vocabulary_of(CaptionConfig())  # what ships
SLOTS = FORMATS["slots"]


def make_facts(**measured) -> Facts:
    """Facts of five frames, of which only these are measured."""
    none = (None,) * 5
    rest = dict.fromkeys((field.name for field in dataclasses.fields(Facts)), none)
    rest |= dict.fromkeys(("mission", "target_velocity_mps", "target_speed_mps", "target_turn_deg"))
    rest |= {"velocity_mps": (2.7, 0.0, 0.5), "mean_speed_mps": 2.75, "step_s": 0.5, "target_speeds_mps": none}
    return Facts(**rest | measured)


# A drone that climbs, speeds up and turns right; the target is hidden once.
FACTS = make_facts(
    speed_mps=(2.0, 2.0, 2.5, 3.0, 4.0), altitude_m=(20.0, 20.0, 20.5, 21.0, 22.0),
    yaw_deg=(0.0, -1.0, -3.0, -6.0, -10.0), pitch_deg=(-40.0, -40.2, -40.1, -40.0, -40.3),
    distance_m=(20.0, 19.5, 19.0, 18.5, 18.0), slant_m=(28.0, 28.5, 29.0, 28.5, 28.0), target_speed_mps=1.6,
    target_turn_deg=-30.0, box_width_px=(30, 30, 31, 33, 36), box_height_px=(60, 61, 62, 66, 72),
    offset_x_px=(0, 10, -40, -50, -64), offset_y_px=(0, 0, 5, 10, 20),
    visibility=("visible", "visible", "partly_occluded", "occluded", "visible"), width_px=640, height_px=360,
    target_speeds_mps=(1.6, 1.6, 1.6, 1.6, 1.6), target_headings_deg=(90.0, 90.0, 80.0, 70.0, 60.0),
    bearing_deg=(0.0, -1.0, 3.0, 5.0, 6.5), heading_deg=(10.0, 9.0, 7.0, 4.0, 0.0),
    yaw_rate_dps=(-2.0, -3.0, -5.0, -7.0, -8.0), climb_mps=(0.0, 0.5, 1.0, 1.5, 2.0),
    travelled_m=(0.0, 1.0, 2.2, 3.7, 5.7), displacement_m=(0.0, 1.0, 2.2, 3.7, 5.5),
)  # fmt: skip
# The same, of which nothing is known at t3, and little of the target.
GAP = dataclasses.replace(
    FACTS, distance_m=(20.0, 19.5, 19.0, None, 18.0), slant_m=(28.0, 28.5, 29.0, None, 28.0),
    box_width_px=(30, 30, 31, None, 36), box_height_px=(60, 61, 62, None, 72), offset_x_px=(0, 10, -40, None, -64),
    offset_y_px=(0, 0, 5, None, 20), target_speeds_mps=(None,) * 5, target_headings_deg=(None,) * 5,
    bearing_deg=(None,) * 5,
)  # fmt: skip


def write_answers(facts: Facts, rng: np.random.Generator, decision: str | None = None) -> tuple[Coc, Coc] | None:
    """Return the filled answers of the rule teacher; None where no fact supports the given decision."""
    answers = write_templates(facts, rng.bytes(32), decision)
    if answers is None:
        return None
    english, chinese = (Coc(**answer) for answer in answers)
    first = SLOTS.read(english, facts)
    assert isinstance(first, Draft), first
    second = SLOTS.read_mirror(chinese, first, facts, True)
    assert isinstance(second, Draft), second
    return first.coc, second.coc


def cut_flight(num_points: int, stride: int = 1, **how) -> list[Window]:
    """Cut a specimen flight of which no pictures exist."""
    flight = dataclasses.replace(make_flight(num_points, **how)[0], folder=Path("nowhere"))
    return list(cut_windows(flight, WindowConfig(require_images=False, stride=stride)))


def contradictions_of(coc: Coc, facts: Facts, language: Language) -> list[str]:
    return list(check_values(sentences_of(coc), facts, language).contradictions)


QUICK = {"max_tries": 2, "timeout_s": 60.0, "concurrency": 4}


def settings(url: str, **changes) -> CaptionConfig:
    """Settings of a quick run: small pictures, short waits, and conflicts that stay."""
    endpoint = QUICK | changes.pop("endpoint", {})
    base = {"teacher": url, "endpoint": endpoint, "repair": {"hard_conflict": "keep"}, "image": {"max_side_px": 32}}
    return CaptionConfig.model_validate(base | changes)


def deciding(decision: str = "hover", fault=None, **options) -> TeacherServer:
    return TeacherServer(fault, decision=lambda body: decision, **options)


def saying(text: Callable[[dict], str], fault=None) -> TeacherServer:
    """A server whose text is `text(body)`."""
    server = TeacherServer(fault)
    server.text = text
    return server


def report_of(out: Path) -> dict:
    return json.loads((out / "caption_report.json").read_text(encoding="utf-8"))
