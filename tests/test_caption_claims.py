"""Claims: true ones of a true text pass, and one thing wrong in the text, in the claims or in both is a problem that
names it."""

from __future__ import annotations

import dataclasses

import pytest
from measure_prose import claims_problems, measure, planted
from tables import each

from caption.schema import EvidenceConfig
from caption.truth.claims import judge_claims
from caption.truth.facts import Facts
from caption.truth.gold import GoldCaption, read_gold
from caption.truth.numerals import chinese_number, english_number, read_numerals
from caption.truth.stated import read_stated
from cosfly.products.captions import Claim, Coc, Language

FACTS = Facts(
    speed_mps=(None, 2.0, 2.5, 3.0, 4.0),
    altitude_m=(20.0, 20.0, 20.5, 21.0, 22.0),
    yaw_deg=(0.0, -1.0, -3.0, -6.0, -10.0),
    pitch_deg=(-40.0, -40.2, -40.1, -40.0, -40.3),
    distance_m=(20.0, 20.5, 21.0, 20.0, 18.0),
    slant_m=(28.0, 28.5, 29.0, 28.5, 28.0),
    target_speed_mps=1.6,
    target_turn_deg=-30.0,
    box_width_px=(30, 30, 31, 33, 36),
    box_height_px=(60, 61, 62, 66, 72),
    offset_x_px=(0, 10, -40, -50, -64),
    offset_y_px=(0, 0, 5, 10, 20),
    visibility=("visible", "visible", "partly_occluded", "occluded", "visible"),
    width_px=640,
    height_px=360,
    target_speeds_mps=(None, 1.6, 1.6, 1.6, 1.6),
    target_headings_deg=(None, 90.0, 80.0, 70.0, 60.0),
    bearing_deg=(0.0, -1.0, 3.0, 5.0, 6.5),
)
FILLER = "Nothing else is of any weight for the moment in this place."


def claim(
    sentence: str, quantity: str, value: float | str, at: str | None = None, unit: str | None = None, **more
) -> Claim:
    return Claim(sentence=sentence, quantity=quantity, at=at, value=value, unit=unit, **more)


def judged(first: str, claims: list[Claim], language: Language = "en", reasons: str = FILLER, decision: str = "hover"):
    coc = Coc(critical_components=first, reasoning_trace=reasons, flight_decision=decision)
    return judge_claims(coc, claims, FACTS, EvidenceConfig(), language)


DISTANCE = claim("C1", "distance", 18.0, "t4", "m")
SPEED = claim("C1", "speed", 4.0, "t4", "mps")
YAW = claim("C1", "yaw", -10.0, "t4", "deg")
BOX = [claim("C1", "box_width", 36.0, "t4", "px"), claim("C1", "box_height", 72.0, "t4", "px")]
HEIGHTS = [claim("C1", "altitude", 21.0, "t3", "m"), claim("C1", "altitude", 22.0, "t4", "m")]
FASTER = [claim("C1", "comparison:speed", "faster", "t4"), claim("C1", "target_speed", 1.6, "t4", "mps")]
GROWN = [claim("C1", "box_width", 30.0, "t0", "px"), claim("C1", "box_width", 36.0, "t4", "px")]
SPEEDING = claim("C1", "trend:speed", "increasing", "t1-t4")

# What is reached on the gold set, with a small margin; may only get better.
MOST_FLAGGED, LEAST_CAUGHT = 0.0, 0.925  # by claims alone; 0.015 and 0.95 with a reader of prose beside them
LEAST_CAUGHT_IN = {"text": 0.88, "claims": 0.97, "both": 0.925}

# A true sentence with its claims; then pieces of it, what a wrong writer puts there, and words of the problem.
SENTENCES: list[tuple[Language, str, list[Claim], list[tuple[str, str, str]]]] = [
    (
        "en",
        "The walker is 18.0 m away.",
        [DISTANCE],
        [("18.0 m", "20.0 m", "20.0 m"), ("18.0 m", "18.0 km", "18.0 km"), ("away", "away, 27 px wide", "27 px")],
    ),
    ("zh", "行人距离 18.0 米。", [DISTANCE], [("18.0 米", "20.0 米", "20.0"), ("18.0 米", "18.0 公里", "18.0 公里")]),
    (
        "en",
        "The drone does four metres per second, two and a half times the walker's speed.",
        [SPEED, claim("C1", "speed_ratio", 2.5, "t4", "times")],
        [("four metres", "nine metres", "nine metres"), ("two and a half times", "six times", "six times")],
    ),
    (
        "zh",
        "无人机每秒四米，是行人速度的两倍半。",
        [SPEED, claim("C1", "speed_ratio", 2.5, "t4", "times")],
        [("四米", "九米", "九米"), ("两倍半", "六倍", "六倍")],
    ),
    (
        "en",
        "The nose has swung 10.0 degrees to the right since t0.",
        [claim("C1", "yaw", -10.0, "t4", "deg"), claim("C1", "side:yaw", "right", "t0-t4")],
        [("to the right", "to the left", "left"), ("to the right", "anticlockwise", "anticlockwise")],
    ),
    (
        "zh",
        "机头自 t0 起向右转了 10.0 度。",
        [claim("C1", "yaw", -10.0, "t4", "deg"), claim("C1", "side:yaw", "right", "t0-t4")],
        [("向右", "向左", "左"), ("向右", "逆时针", "逆时针")],
    ),
    (
        "en",
        "The drone flies faster than the walker.",
        [claim("C1", "comparison:speed", "faster", "t4")],
        [("faster", "slower", "slower")],
    ),
    (
        "en",
        "He is slower than us.",
        [claim("C1", "comparison:speed", "faster", "t4")],
        [("slower", "faster", "faster")],
    ),
    ("zh", "无人机比行人快。", [claim("C1", "comparison:speed", "faster", "t4")], [("快", "慢", "慢")]),
    (
        "en",
        "Altitude climbs by 2.0 m to 22.0 m.",
        [
            claim("C1", "change:altitude", 2.0, "t0-t4", "m"),
            claim("C1", "altitude", 22.0, "t4", "m"),
            claim("C1", "trend:altitude", "increasing"),
        ],
        [("climbs", "sinks", "sinks"), ("climbs by", "is steady, not climbing, by", "steady")],
    ),
    (
        "en",
        "The person is fully visible again after being hidden at t3.",
        [claim("C1", "visibility", "visible", "t4"), claim("C1", "visibility", "occluded", "t3")],
        [("fully visible", "still hidden", "visibility")],
    ),
    (
        "en",
        "At t2 the person is partly hidden, at t3 hidden, at t4 fully visible.",
        [
            claim("C1", "visibility", "partly_occluded", "t2"),
            claim("C1", "visibility", "occluded", "t3"),
            claim("C1", "visibility", "visible", "t4"),
        ],
        [("at t3 hidden", "at t3 fully visible too", "visib")],
    ),
    (
        "en",
        "The walker is less than 19 m away, more than 17 m.",
        [claim("C1", "distance", 18.0, "t4", "m")],
        [("less than 19", "less than 15", "15 m")],
    ),
    (
        "en",
        "Not climbing but sinking would be wrong here; the drone has gained about 2 m.",
        [
            claim("C1", "change:altitude", 2.0, unit="m"),
            claim("C1", "trend:altitude", "decreasing", modality="hypothetical"),
        ],
        [("about 2 m", "about 3 m", "3 m")],
    ),
    ("zh", "目标现在可见。", [claim("C1", "visibility", "visible", "t4")], [("可见", "不可见", "不可见")]),
    (
        "en",
        "Seen from the nose the person is at twelve o'clock.",
        [claim("C1", "bearing", 6.5, "t4", "deg")],
        [("twelve", "three", "three o'clock")],
    ),
    (
        "en",
        "The box has grown by a fifth in height.",
        [claim("C1", "growth:box_height", 20.0, "t0-t4", "percent")],
        [("a fifth", "two thirds", "two thirds"), ("grown", "shrunk", "shrunk")],
    ),
]


@each(("language", "text", "claims", "errors"), SENTENCES, ids=[text[:24] for _, text, _, _ in SENTENCES])
def test_a_true_sentence_is_proved_and_one_wrong_word_is_named(language, text, claims, errors):
    first = judged(text, claims, language)[0]
    assert (first.state, first.problems) == ("proved", ())
    for old, new, words in errors:
        assert text.count(old) == 1
        wrong = judged(text.replace(old, new), claims, language)[0]
        assert wrong.state == "contradicted", new
        assert words in " ".join(wrong.problems), wrong.problems


TRUE: list[tuple[Language, str, list[Claim]]] = [
    (
        "en",
        "The path is 7.2 m long, the net way shorter at 6.9 m.",
        [claim("C1", "travelled", 7.2, "t4", "m"), claim("C1", "displacement", 6.9, "t4", "m")],
    ),
    (
        "en",
        "The nose is 10.0 deg to the right; four tenths of that came last.",
        [claim("C1", "yaw", -10.0, "t4", "deg"), claim("C1", "change:yaw", -4.0, "t3-t4", "deg")],
    ),
    (
        "en",
        "Altitude stands at 22.0 m, and the right choice is to keep the person in view.",
        [claim("C1", "altitude", 22.0, "t4", "m")],
    ),
    ("en", "There is no reason to come any closer to the person.", []),
    (
        "en",
        "So hover, and do not climb, to keep the gap from growing.",
        [claim("C1", "decision", "hover", modality="predicted")],
    ),
    (
        "en",
        "The box is exactly twice as tall as it is wide, 36 px.",
        [claim("C1", "box_width", 36.0, "t4", "px"), claim("C1", "box_height", 72.0, "t4", "px")],
    ),
    ("zh", "没必要再靠近，目标没有被任何东西挡住。", [claim("C1", "visibility", "visible", "t4")]),
    (
        "zh",
        "综上应悬停，并把速度降到三米每秒以下。",
        [
            claim("C1", "decision", "hover", modality="predicted"),
            claim("C1", "speed", 3.0, unit="mps", modality="predicted"),
        ],
    ),
    ("en", "It is not that they are hidden.", [claim("C1", "visibility", "visible", "t4")]),
    ("en", "The course has swung right round, and something stands in the way of a shortcut.", []),
    ("en", "For two steps, twice running, the drone was not hurrying.", []),
    (
        "en",
        "Should the person turn left, a climb would help; should they stop, hover.",
        [claim("C1", "side:target_heading", "left", modality="hypothetical")],
    ),
    (
        "zh",
        "t2 时只露出一部分，现在完整可见。",
        [claim("C1", "visibility", "partly_occluded", "t2"), claim("C1", "visibility", "visible", "t4")],
    ),
    ("zh", "平均距离约 20 米左右，可见性良好。", [claim("C1", "mean:distance", 20.0, "t0-t4", "m")]),
]


@each(("language", "text", "claims"), TRUE, ids=[text[:24] for _, text, _ in TRUE])
def test_what_states_nothing_wrong_is_not_flagged(language, text, claims):
    facts = dataclasses.replace(FACTS, travelled_m=(0.0, 1.5, 3.0, 5.0, 7.2), displacement_m=(0.0, 1.5, 3.0, 4.9, 6.9))
    coc = Coc(critical_components=text, reasoning_trace=FILLER, flight_decision="hover")
    assert judge_claims(coc, claims, facts, EvidenceConfig(), language)[0].problems == ()


@each(
    ("wrong", "words"),
    [
        (claim("C1", "distance", 18.4, "t4", "m"), "false: distance@t4 = 18.4 m"),
        (claim("C1", "distance", 18.0, "t3", "m"), "false: distance@t3"),
        (claim("C1", "distance", 18.0, "t4", "km"), "false"),
        (claim("C1", "distance", "far", "t4"), "false"),
        (claim("C1", "distance", 18.0, "t7", "m"), "unobserved frame: distance@t7"),
        (claim("C1", "range", 18.0, "t4", "m"), "unknown quantity: range@t4"),
        (claim("C9", "distance", 18.0, "t4", "m"), "claim of no sentence: C9"),
        (claim("C1", "height_over_target", 18.0, "t4", "m"), "unknown fact"),
    ],
)
def test_a_wrong_claim_is_named(wrong, words):
    assert words in " ".join(judged("The walker is 18.0 m away.", [wrong])[0].problems)


def test_a_claim_that_nobody_wrote_is_no_problem_and_a_true_number_that_nobody_claimed_only_not_proved():
    first = judged("The walker is 18.0 m away.", [DISTANCE, claim("C1", "altitude", 22.0, "t4", "m")])[0]
    assert (first.state, first.problems) == ("proved", ())
    assert judged("The walker is 18.0 m away.", [])[0].state == "unread"
    assert judged("The walker is 18.0 m away, the drone at 22.0 m.", [DISTANCE])[0].state == "unread"
    assert judged("The walker is 18.3 m away.", [])[0].problems == ("uncovered: 18.3 m",)
    assert judged("The walker is 18.0 m away, visible and left of the middle.", [DISTANCE])[0].state == "unread"
    assert judged("The walker is 18.0 m away, and we are slower than the walker.", [DISTANCE])[0].problems


def test_a_number_in_the_place_of_a_claim_is_a_problem_even_where_another_fact_has_it():
    assert "uncovered: 20.0 m" in judged("The walker is 20.0 m away.", [DISTANCE])[0].problems
    height = claim("C1", "altitude", 22.0, "t4", "m")
    assert judged("The walker is 22.0 m away, the drone at 22.0 m.", [DISTANCE, height])[0].state == "contradicted"


@each(
    ("text", "claims", "is_true"),
    [
        ("The walker is 59 ft away.", [DISTANCE], True),
        ("The walker is 62 ft away.", [DISTANCE], False),
        ("The drone does 14.4 km/h.", [SPEED], True),
        ("The drone does 7.8 knots.", [SPEED], True),
        ("In knots, that is 7.8 for the drone.", [SPEED], True),
        ("The drone does 8.9 knots.", [SPEED], False),
        ("The box is 36x72 px.", BOX, True),
        ("The nose is 10.0° right of its start.", [YAW], True),
        ("The nose is 10.0° left of its start.", [YAW], False),
        ("Height went from 21.0 to 22.0 m.", HEIGHTS, True),
        ("Height went from 22.0 to 21.0 m.", HEIGHTS, False),
        ("The drone has climbed to 22.0 m.", HEIGHTS[1:], True),
        ("The drone has sunk to 22.0 m.", HEIGHTS[1:], False),
        ("It is faster than the walker, who does 1.6 m/s.", FASTER, True),
        ("It is slower than the walker, who does 1.6 m/s.", FASTER, False),
        ("The drone is accelerating, and faster than the walker at 1.6 m/s.", [*FASTER, SPEEDING], True),
        ("The drone is braking, and faster than the walker at 1.6 m/s.", [*FASTER, SPEEDING], False),
        ("The person is visible, but hidden at t3.", [claim("C1", "visibility", "visible", "t4")], True),
        ("The person is visible, but hidden at t1.", [claim("C1", "visibility", "visible", "t4")], False),
        ("The gap went from 20.0 m to 18.0 m.", [claim("C1", "change:distance", -2.0, "t0-t4", "m"), DISTANCE], True),
        ("The gap went from 21.0 m to 18.0 m.", [claim("C1", "change:distance", -2.0, "t0-t4", "m"), DISTANCE], False),
        ("The gap has shrunk by 2.0 m since t0.", [claim("C1", "distance", 20.0, "t0", "m"), DISTANCE], True),
        ("The gap has shrunk by 3.0 m since t0.", [claim("C1", "distance", 20.0, "t0", "m"), DISTANCE], False),
        ("The box grew from 30 to 36 px, as the drone climbed.", GROWN, True),
        ("The box grew from 30 to 36 px, as the drone sank.", GROWN, False),
        ("It is a fifth taller than before.", [claim("C1", "growth:box_height", 20.0, "t0-t4", "percent")], True),
        ("It is four fifths taller than before.", [claim("C1", "growth:box_height", 20.0, "t0-t4", "percent")], False),
        ("The ratio of speeds is 2.5.", [claim("C1", "speed_ratio", 2.5, "t4", "times")], True),
        ("The ratio of speeds is 3.6.", [claim("C1", "speed_ratio", 2.5, "t4", "times")], False),
        ("A row of five sheds stands there.", [claim("C1", "scene", 5.0)], True),
        ("A row of five sheds stands there.", [claim("C1", "scene", 8.0)], False),
        ("The person appears to be standing still.", [claim("C1", "target_motion", "walking", "t4")], False),
        ("A turn would push them out of the middle.", [claim("C1", "side:offset_x", "centred", "t0")], True),
        (
            "The drone turns faster now, 10.0 deg right.",
            [YAW, claim("C1", "decision", "hover", modality="predicted")],
            True,
        ),
        ("The person stands still.", [claim("C1", "visibility", "visible", "t4")], False),
        ("A bench on the left stands some 3 m short of the path.", [claim("C1", "scene", 3.0)], True),
    ],
)
def test_units_sides_order_and_courses_beside_numbers(text, claims, is_true):
    first = judged(text, claims)[0]
    assert (first.problems == ()) == is_true, first.problems


def test_a_claim_of_the_sentence_beside_counts_and_one_far_outside_is_a_problem():
    for name in ("C2", "C3"):
        assert judged("The walker is 18.0 m away.", [DISTANCE.model_copy(update={"sentence": name})])[0].problems == ()
    ratio = claim("C2", "speed_ratio", 2.5, "t4", "times")
    assert judged("We fly at two and a half times his speed. He walks on.", [ratio])[0].problems == ()


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2])
def test_the_gold_sets_hold_their_bounds(number):
    score = measure((caption for caption in read_gold() if caption.set == number), claims_problems)
    assert score.flagged_share <= MOST_FLAGGED
    assert score.caught_share() >= LEAST_CAUGHT
    for place, least in LEAST_CAUGHT_IN.items():
        assert score.caught_share(0, place) >= least, place
    assert judged("The walker keeps to the pavement here.", [])[0].state == "unread"


@each(
    ("planned", "decision", "is_problem"),
    [
        (claim("R1", "decision", "yaw_left_to_follow", modality="predicted"), "yaw_left_to_follow", False),
        (claim("R1", "decision", "yaw_left_to_follow", modality="predicted"), "yaw_right_to_follow", True),
        (claim("R1", "side:yaw", "left", modality="predicted"), "yaw_left_to_follow", False),
        (claim("R1", "side:yaw", "left", modality="predicted"), "yaw_right_to_follow", True),
        (claim("R1", "side:yaw", "left", modality="hypothetical"), "yaw_left_to_follow", False),
        (claim("R1", "side:yaw", "left"), "yaw_left_to_follow", True),  # observed: the nose went right
    ],
)
def test_a_plan_is_held_against_the_decision(planned, decision, is_problem):
    plan = "So the nose should now turn to the left without delay."
    reasons = judged("The walker is 18.0 m away.", [DISTANCE, planned], reasons=plan, decision=decision)[1]
    assert bool(reasons.problems) == is_problem, reasons.problems


def test_a_hypothesis_is_compared_with_nothing_and_proves_nothing():
    text = "If the walker turned left, the drone would have to follow that turn."
    told = claim("C1", "side:target_heading", "left", modality="hypothetical")
    assert judged(text, [told])[0].state == "unread"
    assert judged(text, [told.model_copy(update={"modality": "observed"})])[0].state == "contradicted"


def test_the_speed_of_the_step_and_of_the_window_are_both_true():
    facts = dataclasses.replace(FACTS, target_speeds_mps=(None, 1.0, 1.2, 1.8, 2.0))
    coc = Coc(critical_components="The walker does 2.0 m/s.", reasoning_trace=FILLER, flight_decision="hover")
    for value, state in ((2.0, "proved"), (1.6, "proved"), (1.2, "contradicted")):
        text = coc.model_copy(update={"critical_components": f"The walker does {value} m/s."})
        told = [claim("C1", "target_speed", value, "t4", "mps")]
        assert judge_claims(text, told, facts, EvidenceConfig(), "en")[0].state == state


def test_the_chinese_text_is_covered_by_the_claims_of_the_english():
    claims = [DISTANCE, claim("C1", "side:offset_x", "left", "t4")]
    assert judged("The walker is 18.0 m away and left of the middle.", claims)[0].state == "proved"
    assert judged("行人距离 18.0 米，位于中间偏左。", claims, "zh")[0].state == "proved"
    assert judged("行人距离 18.0 米，位于中间偏右。", claims, "zh")[0].state == "contradicted"


@pytest.mark.parametrize(
    ("text", "value"),
    [("twenty-one", 21), ("one point two five", 1.25), ("a hundred and five", 105), ("zero", 0), ("ninety", 90)],
)
def test_english_numbers_in_words(text, value):
    assert english_number(text) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "value"), [("二十一", 21), ("一点二五", 1.25), ("一百零五", 105), ("十二", 12), ("两", 2)]
)
def test_chinese_numbers_in_words(text, value):
    assert chinese_number(text) == pytest.approx(value)


@pytest.mark.parametrize(
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


@pytest.mark.parametrize(
    ("language", "text"),
    [
        ("en", "At t3 the first of the two walkers was seen in five frames, half a second apart."),
        ("en", "1) One person, right now, in the second half of 2 s; all right."),
        ("zh", "t3 时第二帧里有一名行人，两秒内走了几步，一度停顿，左右摇晃。"),
    ],
)
def test_counts_frames_and_durations_measure_nothing(language, text):
    stated = read_stated(text, language)
    assert stated.numerals == ()
    assert [pole for pole in stated.poles if pole.dimension == "side"] == []


def test_measure_counts_flags_and_catches():
    error = {"kind": "num", "field": "critical_components", "old": "18.0", "new": "20.0", "claim": 0, "claim_value": 20}
    line = GoldCaption(
        id="one",
        set=1,
        language="en",
        facts=dataclasses.asdict(FACTS),
        label="hover",
        critical_components="The walker is 18.0 m away.",
        reasoning_trace=FILLER,
        flight_decision="hover",
        claims=(DISTANCE,),
        errors=[error],
    )
    found = measure([line], lambda coc, claims, *_: ["x"] if "20" in coc.critical_components else [])
    assert (found.num_true, found.flagged, found.planted.total(), found.caught.total()) == (1, [], 3, 2)
    assert planted(line, line.errors[0].model_copy(update={"claim": None}), "both") is None
    assert measure([line], claims_problems).caught.total() == 3


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("距离约20.5米，偏移0像素。", [20.5, 0.0]),
        ("框15 x 36像素，高度20.0米。", [15.0, 36.0, 20.0]),
        ("目标t3时在18.3米处，第2帧可见。", [18.3]),
    ],
)
def test_a_chinese_number_that_touches_a_character_is_read(text, values):
    assert [numeral.value for numeral in read_stated(text, "zh").numerals] == values
