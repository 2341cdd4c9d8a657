"""Claims."""

import dataclasses
import re

from specimens_captions import FACTS
from tables import each

from caption.schema import Judged
from caption.verification.claims import judge_sentence
from caption.verification.facts import Facts
from cosfly.formats.captions import Claim, Language


def claim(told: str, **more) -> Claim:
    """Read a claim as it is written here: quantity[@frames]=value[ unit]."""
    found = re.fullmatch(r"([\w:]+)(?:@([\w-]+))?=(\S+)(?: (\w+))?", told)
    assert found, told
    quantity, at, value, unit = found.groups()
    number = float(value) if re.fullmatch(r"-?[\d.]+", value) else value
    return Claim(sentence="C1", quantity=quantity, at=at, value=number, unit=unit, **more)


def claims_of(told: str) -> list[Claim]:
    return [claim(one) for one in filter(None, told.split("; "))]


def judged(
    text: str, claims: list[Claim], language: Language = "en", decision: str = "hover", facts: Facts = FACTS
) -> Judged:
    return judge_sentence("C1", text, claims, decision, facts, language)


DISTANCE = claim("distance@t4=18.0 m")

# A true sentence, its claims; then pieces of it, what a wrong writer puts there, and words of the problem.
SENTENCES: list[tuple[Language, str, str, list[tuple[str, str, str]]]] = [
    ("en", "The walker is 18.0 m away.", "distance@t4=18.0 m",
        [("18.0 m", "20.0 m", "20.0 m"), ("18.0 m", "18.0 km", "18.0 km"), ("away", "away, 27 px wide", "27 px")]),
    ("zh", "行人距离 18.0 米。", "distance@t4=18.0 m",
        [("18.0 米", "20.0 米", "20.0"), ("18.0 米", "18.0 公里", "18.0 公里")]),
    ("en", "The drone does four metres per second, two and a half times the walker's speed.",
        "speed@t4=4.0 mps; speed_ratio@t4=2.5 times",
        [("four metres", "nine metres", "nine metres"), ("two and a half times", "six times", "six times")]),
    ("zh", "无人机每秒四米，是行人速度的两倍半。", "speed@t4=4.0 mps; speed_ratio@t4=2.5 times",
        [("四米", "九米", "九米"), ("两倍半", "六倍", "六倍")]),
    ("en", "The nose has swung 10.0 degrees to the right since t0.", "yaw@t4=-10.0 deg; side:yaw@t0-t4=right",
        [("to the right", "to the left", "left"), ("to the right", "anticlockwise", "anticlockwise")]),
    ("zh", "机头自 t0 起向右转了 10.0 度。", "yaw@t4=-10.0 deg; side:yaw@t0-t4=right",
        [("向右", "向左", "左"), ("向右", "逆时针", "逆时针")]),
    ("en", "The drone flies faster than the walker.", "comparison:speed@t4=faster", [("faster", "slower", "slower")]),
    ("en", "He is slower than us.", "comparison:speed@t4=faster", [("slower", "faster", "faster")]),
    ("zh", "无人机比行人快。", "comparison:speed@t4=faster", [("快", "慢", "慢")]),
    ("en", "Altitude climbs by 2.0 m to 22.0 m.",
        "change:altitude@t0-t4=2.0 m; altitude@t4=22.0 m; trend:altitude=increasing",
        [("climbs", "sinks", "sinks"), ("climbs by", "is steady, not climbing, by", "steady")]),
    ("en", "The person is fully visible again after being hidden at t3.",
        "visibility@t4=visible; visibility@t3=occluded", [("fully visible", "still hidden", "visibility")]),
    ("en", "At t2 the person is partly hidden, at t3 hidden, at t4 fully visible.",
        "visibility@t2=partly_occluded; visibility@t3=occluded; visibility@t4=visible",
        [("at t3 hidden", "at t3 fully visible too", "visib")]),
    ("en", "The walker is less than 19 m away, more than 17 m.", "distance@t4=18.0 m",
        [("less than 19", "less than 15", "15 m")]),
    ("zh", "目标现在可见。", "visibility@t4=visible", [("可见", "不可见", "不可见")]),
    ("en", "Seen from the nose the person is at twelve o'clock.", "bearing@t4=6.5 deg",
        [("twelve", "three", "three o'clock")]),
    ("en", "The box has grown by a fifth in height.", "growth:box_height@t0-t4=20.0 percent",
        [("a fifth", "two thirds", "two thirds"), ("grown", "shrunk", "shrunk")]),
]  # fmt: skip


@each(("language", "text", "claims", "errors"), SENTENCES)
def test_a_true_sentence_is_proved_and_one_wrong_word_is_named(language, text, claims, errors):
    first = judged(text, claims_of(claims), language)
    assert (first.state, first.problems) == ("proved", ())
    for old, new, words in errors:
        assert text.count(old) == 1
        wrong = judged(text.replace(old, new), claims_of(claims), language)
        assert wrong.state == "contradicted", new
        assert words in " ".join(wrong.problems), wrong.problems


@each(("language", "text", "claims", "state"), [
    ("en", "At t0 the person is hard to make out, at t4 in full view.", "visibility@t0=illegible; visibility@t4=visible", "proved"),
    ("zh", "目标在 t0 时难以辨认。", "visibility@t0=illegible", "proved"),
    ("en", "At t0 the person is barely visible.", "visibility@t0=illegible", "proved"),
    ("en", "At t0 the person is visible.", "visibility@t0=visible", "contradicted"),
    ("en", "At t0 the person is in full view.", "visibility@t0=illegible", "contradicted"),
    ("zh", "目标在 t0 时清晰可见。", "visibility@t0=illegible", "contradicted"),
    ("en", "At t0 the person is visible, the drone does 4.0 m/s.", "speed@t4=4.0 mps", "contradicted"),
    ("en", "At t3 the person is hard to make out, the drone does 4.0 m/s.", "speed@t4=4.0 mps", "contradicted"),
])  # fmt: skip
def test_who_cannot_be_made_out_is_not_said_to_be_seen(language, text, claims, state):
    facts = dataclasses.replace(FACTS, visibility=("illegible", *FACTS.visibility[1:]))
    assert judged(text, claims_of(claims), language, facts=facts).state == state


@each(("wrong", "words"), [
    ("distance@t4=18.4 m", "false: distance@t4 = 18.4 m"),
    ("distance@t3=18.0 m", "false: distance@t3"),
    ("distance@t4=18.0 km", "false"),
    ("distance@t4=far", "false"),
    ("distance@t7=18.0 m", "unobserved frame: distance@t7"), ("mean:speed=2.8 mps", "false"), ("speed_ratio=2.4", "false"),
    ("distance@t4=18.0 mps", "false"), ("trend:speed=decreasing", "false"), ("trend:speed=3.0", "false"),
    ("range@t4=18.0 m", "unknown quantity: range@t4"),
    ("height_over_target@t4=18.0 m", "unknown fact"),
])  # fmt: skip
def test_a_wrong_claim_is_named(wrong, words):
    assert words in " ".join(judged("The walker is 18.0 m away.", [claim(wrong)]).problems)


def test_a_claim_that_nobody_wrote_is_no_problem_and_a_true_number_that_nobody_claimed_only_not_proved():
    height = claim("altitude@t4=22.0 m")
    first = judged("The walker is 18.0 m away.", [DISTANCE, height])
    assert (first.state, first.problems) == ("proved", ())
    rounded = [claim("mean:speed=3 mps"), claim("mean:speed=2.9 mps")]  # to what was written
    assert judged("The walker is 18.0 m away.", [DISTANCE, *rounded]).state == "proved"
    assert judged("The walker is 18.0 m away.", []).state == "unread"
    assert judged("The walker is 18.0 m away, the drone at 22.0 m.", [DISTANCE]).state == "unread"
    assert judged("The walker is 18.3 m away.", []).problems == ("uncovered: 18.3 m",)
    assert judged("The walker is 18.0 m away, visible and left of the middle.", [DISTANCE]).state == "unread"
    assert judged("The walker is 18.0 m away, and we are slower than the walker.", [DISTANCE]).problems
    # A number in the place of a claim is a problem even where another fact has it.
    assert "uncovered: 20.0 m" in judged("The walker is 20.0 m away.", [DISTANCE]).problems
    assert judged("The walker is 22.0 m away, the drone at 22.0 m.", [DISTANCE, height]).state == "contradicted"


@each(("planned", "modality", "decision", "is_problem"), [
    ("decision=yaw_left_to_follow", "predicted", "yaw_left_to_follow", False),
    ("decision=yaw_left_to_follow", "predicted", "yaw_right_to_follow", True),
    ("side:yaw=left", "predicted", "yaw_left_to_follow", False),
    ("side:yaw=left", "predicted", "yaw_right_to_follow", True),
    ("side:yaw=left", "hypothetical", "yaw_left_to_follow", False),
    ("side:yaw=left", "observed", "yaw_left_to_follow", True),  # the nose went right
])  # fmt: skip
def test_a_plan_is_held_against_the_decision(planned, modality, decision, is_problem):
    plan = "So the nose should now turn to the left without delay."
    reasons = judged(plan, [claim(planned, modality=modality)], decision=decision)
    assert bool(reasons.problems) == is_problem, reasons.problems
