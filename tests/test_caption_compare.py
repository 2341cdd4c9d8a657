"""What becomes of conflicts: soft ones by their setting, and the four strategies compared on the same ones."""

import asyncio
import dataclasses
from pathlib import Path

from specimens_captions import VOCABULARY
from tables import each

from caption.schema import CaptionConfig, RepairConfig, WindowConfig
from caption.stage.compare import compare
from caption.stage.window_loop import Trial, caption_window
from caption.stage.windows import cut_windows
from caption.teachers.teacher import RuleTeacher
from cosfly.formats.captions import Caption, Coc
from specimens import make_flight

CFG = CaptionConfig(window=WindowConfig(require_images=False))


@each("treatment", ["keep", "repair", "drop"])
def test_what_becomes_of_a_soft_conflict(treatment):
    flight = dataclasses.replace(make_flight(60)[0], folder=Path("nowhere"))
    windows = list(cut_windows(flight, CFG.window))

    def captioned(repair: RepairConfig) -> list[Caption]:
        cfg = CFG.model_copy(update={"repair": repair})
        return [asyncio.run(caption_window(window, RuleTeacher(0), cfg, VOCABULARY)) for window in windows]

    soft = [i for i, caption in enumerate(captioned(RepairConfig())) if caption.verdict == "SOFT_CONFLICT"]
    assert soft
    treated = captioned(RepairConfig(soft_conflict=treatment))
    for caption in (treated[i] for i in soft):
        if treatment == "keep":
            assert (caption.status, caption.verdict, caption.repair) == ("accepted", "SOFT_CONFLICT", None)
        elif treatment == "drop":
            assert caption.drop_reason == "soft_conflict"
        else:
            assert (caption.verdict, caption.repair.first_verdict) == ("CONSISTENT", "SOFT_CONFLICT")


def coc(text: str) -> Coc:
    return Coc(critical_components=text, reasoning_trace="r", flight_decision="hover")


def test_a_comparison_by_hand():
    trials = [
        Trial(coc("a b c"), coc("a b c"), "CONSISTENT", 1, 100),
        Trial(coc("a b c"), coc("x y z"), "SOFT_CONFLICT", 2, 200),
        Trial(coc("a b c"), None, "HARD_CONFLICT", 3, 300),
    ]
    found = compare("hint", trials)
    assert (found.num_conflicts, found.repaired, found.consistent) == (3, 2, 1)
    assert (found.asks_per_conflict, found.tokens_per_conflict, found.text_distance) == (2.0, 200.0, 0.375)
