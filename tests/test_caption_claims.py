"""Claims: true ones of a true sentence pass, and one thing wrong in the sentence or in the claims is a problem that
names it."""

from __future__ import annotations

import dataclasses
import re

import pytest
from specimens_captions import FACTS
from tables import each

from caption.schema import Judged
from caption.truth.claims import judge_sentence
from caption.truth.facts import Facts
from caption.truth.numerals import chinese_number, english_number, read_numerals
from caption.truth.stated import read_stated
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
YAW = claim("yaw@t4=-10.0 deg")
HOVERS = claim("decision=hover", modality="predicted")

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


def names_the_wrong_words(language: Language, text: str, claims: list[Claim], errors: list[tuple[str, str, str]]):
    first = judged(text, claims, language)
    assert (first.state, first.problems) == ("proved", ())
    for old, new, words in errors:
        assert text.count(old) == 1
        wrong = judged(text.replace(old, new), claims, language)
        assert wrong.state == "contradicted", new
        assert words in " ".join(wrong.problems), wrong.problems


@each(("language", "text", "claims", "errors"), SENTENCES)
def test_a_true_sentence_is_proved_and_one_wrong_word_is_named(language, text, claims, errors):
    names_the_wrong_words(language, text, claims_of(claims), errors)


@each(
    ("language", "text", "claims", "state"),
    [
        ("en", "At t0 the person is hard to make out, at t4 in full view.", "visibility@t0=illegible; visibility@t4=visible", "proved"),
        ("zh", "目标在 t0 时难以辨认。", "visibility@t0=illegible", "proved"),
        ("en", "At t0 the person is barely visible.", "visibility@t0=illegible", "proved"),
        ("en", "At t0 the person is visible.", "visibility@t0=visible", "contradicted"),
        ("en", "At t0 the person is in full view.", "visibility@t0=illegible", "contradicted"),
        ("zh", "目标在 t0 时清晰可见。", "visibility@t0=illegible", "contradicted"),
        ("en", "At t0 the person is visible, the drone does 4.0 m/s.", "speed@t4=4.0 mps", "contradicted"),
        ("en", "At t3 the person is hard to make out, the drone does 4.0 m/s.", "speed@t4=4.0 mps", "contradicted"),
    ],
)  # fmt: skip
def test_who_cannot_be_made_out_is_not_said_to_be_seen(language, text, claims, state):
    """Claims of sight are of what a stranger could see: geometry shows the person at t0, the picture does not."""
    facts = dataclasses.replace(FACTS, visibility=("illegible", *FACTS.visibility[1:]))
    assert judged(text, claims_of(claims), language, facts=facts).state == state


def test_a_hypothesis_beside_a_true_sentence_leaves_it_proved():
    claims = [claim("change:altitude=2.0 m"), claim("trend:altitude=decreasing", modality="hypothetical")]
    text = "Not climbing but sinking would be wrong here; the drone has gained about 2 m."
    names_the_wrong_words("en", text, claims, [("about 2 m", "about 3 m", "3 m")])


TRUE: list[tuple[Language, str, str | list[Claim]]] = [
    ("en", "The path is 7.2 m long, the net way shorter at 6.9 m.", "travelled@t4=7.2 m; displacement@t4=6.9 m"),
    ("en", "The nose is 10.0 deg to the right; four tenths of that came last.",
     "yaw@t4=-10.0 deg; change:yaw@t3-t4=-4.0 deg"),
    ("en", "Altitude stands at 22.0 m, and the right choice is to keep the person in view.", "altitude@t4=22.0 m"),
    ("en", "There is no reason to come any closer to the person.", ""),
    ("en", "So hover, and do not climb, to keep the gap from growing.", [HOVERS]),
    ("en", "The box is exactly twice as tall as it is wide, 36 px.", "box_width@t4=36.0 px; box_height@t4=72.0 px"),
    ("zh", "没必要再靠近，目标没有被任何东西挡住。", "visibility@t4=visible"),
    ("zh", "综上应悬停，并把速度降到三米每秒以下。", [HOVERS, claim("speed=3.0 mps", modality="predicted")]),
    ("en", "It is not that they are hidden.", "visibility@t4=visible"),
    ("en", "The course has swung right round, and something stands in the way of a shortcut.", ""),
    ("en", "For two steps, twice running, the drone was not hurrying.", ""),
    ("en", "Should the person turn left, a climb would help; should they stop, hover.",
     [claim("side:target_heading=left", modality="hypothetical")]),
    ("zh", "t2 时只露出一部分，现在完整可见。", "visibility@t2=partly_occluded; visibility@t4=visible"),
    ("zh", "平均距离约 20 米左右，可见性良好。", "mean:distance@t0-t4=20.0 m"),
]  # fmt: skip


@each(("language", "text", "claims"), TRUE)
def test_what_states_nothing_wrong_is_not_flagged(language, text, claims):
    facts = dataclasses.replace(FACTS, travelled_m=(0.0, 1.5, 3.0, 5.0, 7.2), displacement_m=(0.0, 1.5, 3.0, 4.9, 6.9))
    told = claims_of(claims) if isinstance(claims, str) else claims
    assert judged(text, told, language, facts=facts).problems == ()


@each(
    ("wrong", "words"),
    [
        ("distance@t4=18.4 m", "false: distance@t4 = 18.4 m"),
        ("distance@t3=18.0 m", "false: distance@t3"),
        ("distance@t4=18.0 km", "false"),
        ("distance@t4=far", "false"),
        ("distance@t7=18.0 m", "unobserved frame: distance@t7"),
        ("range@t4=18.0 m", "unknown quantity: range@t4"),
        ("height_over_target@t4=18.0 m", "unknown fact"),
    ],
)
def test_a_wrong_claim_is_named(wrong, words):
    assert words in " ".join(judged("The walker is 18.0 m away.", [claim(wrong)]).problems)


def test_a_claim_that_nobody_wrote_is_no_problem_and_a_true_number_that_nobody_claimed_only_not_proved():
    height = claim("altitude@t4=22.0 m")
    first = judged("The walker is 18.0 m away.", [DISTANCE, height])
    assert (first.state, first.problems) == ("proved", ())
    assert judged("The walker is 18.0 m away.", []).state == "unread"
    assert judged("The walker is 18.0 m away, the drone at 22.0 m.", [DISTANCE]).state == "unread"
    assert judged("The walker is 18.3 m away.", []).problems == ("uncovered: 18.3 m",)
    assert judged("The walker is 18.0 m away, visible and left of the middle.", [DISTANCE]).state == "unread"
    assert judged("The walker is 18.0 m away, and we are slower than the walker.", [DISTANCE]).problems
    # A number in the place of a claim is a problem even where another fact has it.
    assert "uncovered: 20.0 m" in judged("The walker is 20.0 m away.", [DISTANCE]).problems
    assert judged("The walker is 22.0 m away, the drone at 22.0 m.", [DISTANCE, height]).state == "contradicted"


FASTER = "comparison:speed@t4=faster; target_speed@t4=1.6 mps"
SPEEDING = f"{FASTER}; trend:speed@t1-t4=increasing"
CLOSER = "change:distance@t0-t4=-2.0 m; distance@t4=18.0 m"
GROWN = "box_width@t0=30.0 px; box_width@t4=36.0 px"
HEIGHTS = "altitude@t3=21.0 m; altitude@t4=22.0 m"
TALLER = "growth:box_height@t0-t4=20.0 percent"


@each(
    ("text", "claims", "is_true"),
    [
        ("The walker is 59 ft away.", "distance@t4=18.0 m", True),
        ("The walker is 62 ft away.", "distance@t4=18.0 m", False),
        ("The drone does 14.4 km/h.", "speed@t4=4.0 mps", True),
        ("The drone does 7.8 knots.", "speed@t4=4.0 mps", True),
        ("In knots, that is 7.8 for the drone.", "speed@t4=4.0 mps", True),
        ("The drone does 8.9 knots.", "speed@t4=4.0 mps", False),
        ("The box is 36x72 px.", "box_width@t4=36.0 px; box_height@t4=72.0 px", True),
        ("The nose is 10.0° right of its start.", "yaw@t4=-10.0 deg", True),
        ("The nose is 10.0° left of its start.", "yaw@t4=-10.0 deg", False),
        ("Height went from 21.0 to 22.0 m.", HEIGHTS, True),
        ("Height went from 22.0 to 21.0 m.", HEIGHTS, False),
        ("The drone has climbed to 22.0 m.", "altitude@t4=22.0 m", True),
        ("The drone has sunk to 22.0 m.", "altitude@t4=22.0 m", False),
        ("It is faster than the walker, who does 1.6 m/s.", FASTER, True),
        ("It is slower than the walker, who does 1.6 m/s.", FASTER, False),
        ("The drone is accelerating, and faster than the walker at 1.6 m/s.", SPEEDING, True),
        ("The drone is braking, and faster than the walker at 1.6 m/s.", SPEEDING, False),
        ("The person is visible, but hidden at t3.", "visibility@t4=visible", True),
        ("The person is visible, but hidden at t1.", "visibility@t4=visible", False),
        ("The gap went from 20.0 m to 18.0 m.", CLOSER, True),
        ("The gap went from 21.0 m to 18.0 m.", CLOSER, False),
        ("The gap has shrunk by 2.0 m since t0.", "distance@t0=20.0 m; distance@t4=18.0 m", True),
        ("The gap has shrunk by 3.0 m since t0.", "distance@t0=20.0 m; distance@t4=18.0 m", False),
        ("The box grew from 30 to 36 px, as the drone climbed.", GROWN, True),
        ("The box grew from 30 to 36 px, as the drone sank.", GROWN, False),
        ("It is a fifth taller than before.", TALLER, True),
        ("It is four fifths taller than before.", TALLER, False),
        ("The ratio of speeds is 2.5.", "speed_ratio@t4=2.5 times", True),
        ("The ratio of speeds is 3.6.", "speed_ratio@t4=2.5 times", False),
        ("A row of five sheds stands there.", "scene=5.0", True),
        ("A row of five sheds stands there.", "scene=8.0", False),
        ("The person appears to be standing still.", "target_motion@t4=walking", False),
        ("A turn would push them out of the middle.", "side:offset_x@t0=centred", True),
        ("The drone turns faster now, 10.0 deg right.", [YAW, HOVERS], True),
        ("The person stands still.", "visibility@t4=visible", False),
        ("A bench on the left stands some 3 m short of the path.", "scene=3.0", True),
    ],
)
def test_units_sides_order_and_courses_beside_numbers(text, claims, is_true):
    first = judged(text, claims_of(claims) if isinstance(claims, str) else claims)
    assert (first.problems == ()) == is_true, first.problems


@each(
    ("planned", "modality", "decision", "is_problem"),
    [
        ("decision=yaw_left_to_follow", "predicted", "yaw_left_to_follow", False),
        ("decision=yaw_left_to_follow", "predicted", "yaw_right_to_follow", True),
        ("side:yaw=left", "predicted", "yaw_left_to_follow", False),
        ("side:yaw=left", "predicted", "yaw_right_to_follow", True),
        ("side:yaw=left", "hypothetical", "yaw_left_to_follow", False),
        ("side:yaw=left", "observed", "yaw_left_to_follow", True),  # the nose went right
    ],
)
def test_a_plan_is_held_against_the_decision(planned, modality, decision, is_problem):
    plan = "So the nose should now turn to the left without delay."
    reasons = judged(plan, [claim(planned, modality=modality)], decision=decision)
    assert bool(reasons.problems) == is_problem, reasons.problems


def test_a_hypothesis_is_compared_with_nothing_and_proves_nothing():
    text = "If the walker turned left, the drone would have to follow that turn."
    told = claim("side:target_heading=left", modality="hypothetical")
    assert judged(text, [told]).state == "unread"
    assert judged(text, [told.model_copy(update={"modality": "observed"})]).state == "contradicted"


def test_the_speed_of_the_step_and_of_the_window_are_both_true():
    facts = dataclasses.replace(FACTS, target_speeds_mps=(None, 1.0, 1.2, 1.8, 2.0))
    for value, state in ((2.0, "proved"), (1.6, "proved"), (1.2, "contradicted")):
        told = [claim(f"target_speed@t4={value} mps")]
        assert judged(f"The walker does {value} m/s.", told, facts=facts).state == state


@each(
    ("read", "text", "value"),
    [
        (english_number, "twenty-one", 21), (english_number, "one point two five", 1.25),
        (english_number, "a hundred and five", 105), (english_number, "zero", 0), (english_number, "ninety", 90),
        (chinese_number, "二十一", 21), (chinese_number, "一点二五", 1.25), (chinese_number, "一百零五", 105),
        (chinese_number, "十二", 12), (chinese_number, "两", 2),
    ],
)  # fmt: skip
def test_numbers_in_words(read, text, value):
    assert read(text) == pytest.approx(value)


@each(
    ("language", "text", "numbers"),
    [
        ("en", "He made one metre and thirty centimetres, we one metre sixty.", [1.3, 1.6]),
        ("en", "It stands 5 m 30 cm off, a dozen pixels wide.", [5.3, 12.0]),
        ("en", "Braking at 1.5 m/s² over 2 m.", [2.0]),
        ("zh", "时速 18 公里，翻了一倍多。", [5.0, 2.0]),
        ("zh", "他只走了一米三，我们飞了一米六五，两米三秒。", [1.3, 1.65, 2.0]),
    ],
)
def test_lengths_in_two_units_are_one_number_and_accelerations_none(language, text, numbers):
    assert [numeral.value for numeral in read_numerals(text, language)] == pytest.approx(numbers)


@each(
    ("language", "text", "values"),
    [
        ("en", "At t3 the first of the two walkers was seen in five frames, half a second apart.", []),
        ("en", "1) One person, right now, in the second half of 2 s; all right.", []),
        ("zh", "t3 时第二帧里有一名行人，两秒内走了几步，一度停顿，左右摇晃。", []),
        ("zh", "距离约20.5米，偏移0像素。", [20.5, 0.0]),  # a number that touches a character
        ("zh", "框15 x 36像素，高度20.0米。", [15.0, 36.0, 20.0]),
        ("zh", "目标t3时在18.3米处，第2帧可见。", [18.3]),
    ],
)
def test_counts_frames_and_durations_measure_nothing(language, text, values):
    stated = read_stated(text, language)
    assert [numeral.value for numeral in stated.numerals] == values
    assert [pole for pole in stated.poles if pole.dimension == "side"] == []
