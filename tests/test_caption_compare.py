"""What becomes of conflicts: soft ones by their setting, and the four strategies compared on the same ones."""

import asyncio
import contextlib
import dataclasses
from pathlib import Path

from specimens_captions import VOCABULARY
from tables import each

from caption.schema import CaptionConfig, RepairConfig, WindowConfig
from caption.stage import compare as compare_stage
from caption.stage.compare import Trial, compare, try_strategy
from caption.stage.window_loop import caption_window
from caption.stage.windows import cut_windows
from caption.teachers.teacher import RuleTeacher
from cosfly.formats.captions import Caption, Coc
from cosfly.llm.contract import NoAnswer
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
            assert caption.drop_reason == "conflict"
        else:
            assert caption.repair is not None
            assert caption.repair.first_verdict == "SOFT_CONFLICT"
            if caption.status == "accepted":
                assert caption.verdict == "CONSISTENT"
            else:
                assert caption.drop_reason == "no_reason"


@each("strategy", ["anchored", "cascade"])
def test_a_conflict_without_a_reason_for_its_label_counts_as_not_repaired(strategy):
    cfg = CFG.model_copy(update={"repair": RepairConfig(hard_conflict="repair", soft_conflict="repair")})
    track = dataclasses.replace(make_flight(60)[0], folder=Path("nowhere"))
    windows = list(cut_windows(track, cfg.window))
    trials = []
    for window in windows:
        with contextlib.suppress(NoAnswer):  # the first answer has no reason
            trials.append(asyncio.run(try_strategy(window, RuleTeacher(0), cfg, VOCABULARY, strategy)))
    trials = [trial for trial in trials if trial is not None]
    repaired = [trial for trial in trials if trial.last is not None]
    assert 0 < len(repaired) < len(trials)
    assert compare(strategy, trials).consistency == round(len(repaired) / len(trials), 3)


def test_a_window_without_a_conflict_is_asked_about_once(monkeypatch):
    asked = []

    async def agree(*args) -> None:
        asked.append(args[-1])

    monkeypatch.setattr(compare_stage, "try_strategy", agree)
    assert asyncio.run(compare_stage._try_each(*[None] * 4)) == []
    assert asked == [compare_stage.STRATEGIES[0]]


def coc(text: str) -> Coc:
    return Coc(critical_components=text, reasoning_trace="r", flight_decision="hover")


def test_a_comparison_by_hand():
    trials = [
        Trial(coc("a b c"), coc("a b c"), "CONSISTENT", 1, 100),
        Trial(coc("a b c"), coc("x y z"), "SOFT_CONFLICT", 2, 200),
        Trial(coc("a b c"), None, "HARD_CONFLICT", 3, 300),
    ]
    found = compare("hint", trials)
    assert (found.num_conflicts, found.repaired, found.consistency) == (3, 2, 0.333)
    assert (found.asks_per_conflict, found.tokens_per_conflict, found.naturalness) == (2.0, 200.0, 0.625)
    nothing = compare("hint", trials[2:])
    assert (nothing.repaired, nothing.consistency, nothing.naturalness) == (0, 0.0, None)
    assert [one.row[:4] for one in (found, nothing)] == [("hint", "2", "33.3 %", "62.5 %"), ("hint", "0", "0.0 %", "-")]
