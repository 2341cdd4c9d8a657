"""Slots and references: the fact at an address, what is refused and why, and that both languages hold the same facts."""

import dataclasses
import json
import re

import pytest
from specimens_captions import GAP, SLOTS, report_of, saying, settings
from teacher_server import CHINESE, ENGLISH, TeacherServer, is_mirror

from caption.answer_formats.formats import Draft, Filler, Refused, fact_table
from caption.answer_formats.templates import InvalidSlot, read_sentence
from caption.stage.stage import run
from caption.verification.references import Fact, look_up, parse_reference
from caption.verification.values import check_values
from cosfly.formats.captions import Coc, Language, read_captions
from cosfly.runtime.errors import NothingKept, counts_text

FACTS = dataclasses.replace(GAP, yaw_deg=(0.0, 1.0, 3.0, -6.0, -10.0), offset_x_px=(0, 10, 40, None, -64))


def filled(text: str, language: Language) -> str | Refused:
    try:
        return Filler(FACTS, "yaw_right_to_follow", language).fill(read_sentence(text, language, len(FACTS)))
    except InvalidSlot as error:
        return Refused("invalid_slot", str(error))


def test_what_a_template_becomes():
    for language, template, text in [
        ("en", "The gap {trend:distance} from {distance@t0} to {distance}.", "The gap decreases from 20.0 m to 18.0 m."),
        ("en", "The gap has {trend:distance} to {distance}.", "The gap has decreased to 18.0 m."),
        ("en", "A {trend:speed} pace and a {trend:distance} gap.", "An increasing pace and a decreasing gap."),
        ("en", "It lies {offset_x} to the {side:offset_x} of the middle.", "It lies 64 px to the left of the middle."),
        ("en", "An offset of {offset_x} is large.", "An offset of -64 px is large."),  # no slot says its side
        ("en", "The nose swung {yaw} {side:yaw}, at {yaw_rate}.", "The nose swung 10.0 deg right, at -8.0 deg/s."),
        ("en", "It was {yaw@t2} to the {side:yaw@t2} at t2.", "It was 3.0 deg to the left at t2."),
        ("en", "The height {trend:altitude} by {change:altitude}.", "The height increases by 2.0 m."),
        ("en", "The box measures {box@t4} now, {box@t0} then.", "The box measures 36 x 72 px now, 30 x 60 px then."),
        ("en", "The box {trend:box_height} by {growth:box_height}.", "The box increases by 20%."),
        ("en", "It was {visibility@t3}, falling behind by {change:altitude}.", "It was occluded, falling behind by 2.0 m."),
        ("en", "The drone is {comparison:speed} the walker.", "The drone is faster than the walker."),
        ("en", "The drone is {comparison:speed}.", "The drone is faster."),
        ("en", "The gap is {distance} m wide.", "The gap is 18.0 m wide."),  # the unit once
        ("en", "At {speed} m/s it flies.", "At 4.00 m/s it flies."),
        ("en", "It should {decision}, to the {side:decision}.", "It should yaw right to follow, to the right."),
        ("en", "{Distance @ t0} it was.", "20.0 m it was."),
        ("en", "The walker {target_motion} and is {target_motion}.", "The walker walks and is walking."),
        ("zh", "水平距离从 {distance@t0}{trend:distance}到 {distance}。", "水平距离从 20.0 米减小到 18.0 米。"),
        ("zh", "目标位于画面中心{side:offset_x}侧 {offset_x} 处。", "目标位于画面中心左侧 64 像素处。"),
        ("zh", "无人机{comparison:speed}目标，因此{decision}。", "无人机快于目标，因此向右偏航跟随。"),
        ("zh", "高度为 {altitude} 米。", "高度为 22.0 米。"),
        ("en", "From {min:yaw@t0-t2} to {max:yaw}, {pitch@t1}.", "From 0.0 deg to 3.0 deg, -40.2 deg."),
        ("zh", "从 {min:yaw@t0-t2} 到 {max:yaw}，{pitch@t1}。", "从 0.0 度到 3.0 度，-40.2 度。"),
        ("en", "It flew {travelled@t2}, {change:speed@t1-t4} more.", "It flew 2.2 m, 2.00 m/s more."),
        ("zh", "飞行 {travelled@t2}，增加 {change:speed@t1-t4}，框高 {box_height@t1}。", "飞行 2.2 米，增加 2.00 米/秒，框高 61 像素。"),
    ]:  # fmt: skip
        assert filled(template, language) == text


REFUSED = [
    ("en", "The gap is {distanse}.", "did you mean 'distance'"),
    ("en", "The gap is {side:speed}.", "table of facts"),
    ("en", "The gap was {distance@t3}.", "leave it out"),
    ("en", "The gap was {distance@t7}.", "t0 to t4"),
    ("en", "The gap grew {change:distance@t1-t3}.", "leave it out"),
    ("en", "The gap grew {change:distance@t1-t1}.", "leave it out"),
    ("en", "The gap is {distance.", "brace"),
    ("en", "The gap is {{distance}}.", "brace"),
    ("en", "The gap is {distance} px.", "its unit is m"),
    ("en", "The target is no longer {visibility}.", "negate"),
    ("en", "The speed is not {trend:speed}.", "negate"),
    ("en", "Turned {yaw@t2} to the {side:yaw}.", "same frames"),
    ("en", "It {trend:altitude} by {change:altitude} to the {side:offset_y@t0}.", "neither side"),
    ("en", "The gap has fallen by {change:distance}.", "does not fit"),
    # The decision is to the right, the offset to the left.
    ("en", "The nose has to turn to the {side:decision}: the target is to its {side:offset_x}.", "no reason for"),
    ("zh", "需要向{side:decision}转：目标在画面中心{side:offset_x}侧。", "no reason for"),
    ("zh", "距离减少了 {change:distance}。", "does not fit"),
    ("en", "The drone is descending slowly at {climb_rate}.", "does not fit"),
    ("zh", "间距在扩大，速度为 {altitude}；高度下降 {change:altitude}。", "does not fit"),
    ("zh", "目标不{visibility}。", "negate"),
    ("zh", "距离{trend:distanc}。", "table of facts"),
    ("zh", "速度为 {speed} 米。", "米/秒"),
]


def test_a_refused_slot_names_the_fault_and_the_fix():
    for language, text, words in REFUSED:
        found = filled(text, language)
        assert isinstance(found, Refused)
        assert found.reason == "invalid_slot"
        assert words in found.complaint
    sentence = read_sentence("The turn to the {side:decision} has to go on.", "en", len(FACTS))
    with pytest.raises(InvalidSlot, match="has to go on': the turn is to the right here"):
        Filler(FACTS, "yaw_left_to_follow", "en").fill(sentence)


def drafts(english: str, chinese: str) -> Draft | Refused:
    en = Coc(critical_components="The walker is {visibility}.", reasoning_trace=english, flight_decision="hover")
    zh = Coc(critical_components="行人{visibility}。", reasoning_trace=chinese, flight_decision="hover")
    first = SLOTS.read(en, FACTS)
    assert isinstance(first, Draft), first
    return SLOTS.read_mirror(zh, first, FACTS, True)


def test_the_mirror_holds_the_same_slots_sentence_by_sentence():
    for english, chinese, reason in [
        ("The gap {trend:distance} to {distance}.", "距离{trend:distance}到 {distance}。", None),
        ("With {distance} the gap {trend:distance}.", "距离{trend:distance}，为 {distance}。", None),  # another order
        ("The gap is {distance}. It should {decision}.", "距离为 {distance}，应{decision}。", "sentences"),
        ("The gap {trend:distance} to {distance}.", "距离为 {distance}。", "slots"),
        ("The gap is {distance}.", "距离为 {altitude}。", "slots"),
        ("The gap is {distance@t0}.", "距离为 {distance}。", "slots"),
        ("The gap is {distance}.", "The gap is {distance}。", "script"),
        ("The gap is {distance}.", "距离为 {distanse}。", "invalid_slot"),
        ("The gap of {distance} shrinks.", "距离 {distance}正在扩大。", "polarity_trend"),
        ("The altitude is {altitude}.", "海拔为 {altitude}。", "glossary"),
    ]:  # fmt: skip
        found = drafts(english, chinese)
        assert (found.reason if isinstance(found, Refused) else None) == reason
        if isinstance(found, Refused):
            assert found.complaint


def test_numbers_outside_slots_are_compared_with_the_facts():
    def checked(reasons: str):
        coc = Coc(critical_components="The target is {visibility}.", reasoning_trace=reasons, flight_decision="hover")
        draft = SLOTS.read(coc, FACTS)
        return check_values(draft.outside, FACTS, "en", draft.num_filled).counts.model_dump().values()

    assert list(checked("The gap of {distance} {trend:distance}, so {decision}.")) == [3, 0, 0]
    assert list(checked("The gap was 19.5 m at t1.")) == [1, 1, 0]
    assert list(checked("The gap was 47 m at t1.")) == [1, 0, 1]


def writing_server(english: str, corrected: str | None = None) -> TeacherServer:
    """A teacher whose reasoning is `english`, and `corrected` once it is told what was wrong."""

    def text(body: dict) -> str:
        if is_mirror(body):
            wanted = json.loads(body["messages"][-1]["content"])["reasoning_trace"]
            told = "距离为 {distance}，保持稳定，因此该动作可将其保持在画面内。"
            reasons = {"reasoning_trace": told} if "{distance}" in wanted else {}
            return json.dumps({**CHINESE, **reasons, "flight_decision": "hover"})
        reasons = corrected if corrected and len(body["messages"]) > 2 else english
        return json.dumps({**ENGLISH, "reasoning_trace": reasons, "therefore": "hover", "flight_decision": "hover"})

    return saying(text)


def test_a_record_holds_the_plain_text_and_the_template(tree, tmp_path):
    with writing_server("The gap of {distance} calls for this decision.") as server:
        captions = list(read_captions(run(settings(server.url, limit=1), tree, tmp_path / "out")))
    for caption in captions:
        assert caption.writing == "slots"
        assert caption.slots["en"].reasoning_trace == "The gap of {distance} calls for this decision."
        assert re.fullmatch(r"The gap of \d+\.\d m calls for this decision\.", caption.en.reasoning_trace)
        number = re.search(r"\d+\.\d", caption.en.reasoning_trace)[0]
        assert f"{number} 米" in caption.zh.reasoning_trace
        counts = {language: found.values_filled for language, found in caption.checks.values.items()}
        assert counts == {"en": 2, "zh": 2}


def test_a_contradicted_value_is_asked_for_again_with_the_measured_ones(tree, tmp_path):
    with writing_server("The gap of 47.5 m calls for it.", "The gap of {distance} calls for it.") as server:
        captions = list(read_captions(run(settings(server.url, limit=1), tree, tmp_path / "out")))
    assert [caption.checks.refused for caption in captions] == [["contradicted_value"]]
    assert [caption.checks.contradictions for caption in captions] == [None]
    corrections = [json.loads(body)["messages"][-1]["content"] for body in server.bodies]
    complaints = [content[0]["text"] for content in corrections if isinstance(content, list) and len(content) == 1]
    assert len(complaints) == 1
    assert all('"47.5 m"' in text and "horizontal distance: " in text for text in complaints)


FALSE, UNKNOWN = "The gap of 47.5 m calls for nothing.", "The gap of {gap} calls for this decision."


@pytest.mark.parametrize(("reasons", "corrected", "rejected", "asks"), [
    (FALSE, FALSE, {"contradicted_value": 2}, 6),  # both answers share one mirror
    (UNKNOWN, UNKNOWN, {"invalid_slot": 4}, 4),
    # The false one has its mirror before it is corrected.
    (FALSE, UNKNOWN, {"contradicted_value": 2, "invalid_slot": 4}, 8),
])  # fmt: skip
def test_an_answer_that_stays_wrong_drops_its_window_for_that_reason(
    tree, tmp_path, reasons, corrected, rejected, asks
):
    with writing_server(reasons, corrected) as server, pytest.raises(NothingKept, match=counts_text(rejected)):
        run(settings(server.url, limit=2), tree, tmp_path / "out")
    report = report_of(tmp_path / "out")
    assert (report["windows"]["dropped"], report["rejected_answers"]) == ({list(rejected)[-1]: 2}, rejected)
    assert len(server.bodies) == asks
    for caption in read_captions(tmp_path / "out" / "captions.jsonl"):
        if corrected == UNKNOWN:  # of a refused answer nothing stands there
            assert (caption.en, caption.verdict) == (None, None)
            assert (caption.checks.values, caption.checks.contradictions) == (None, None)


def test_the_question_shows_what_is_known_by_its_slot(tree, tmp_path):
    table = fact_table(FACTS)
    assert (
        "{distance@t0} to {distance@t4}: 20.0, 19.5, 19.0, -, 18.0 m; {change:distance} -2.0 m; {trend:distance} "
        "decreases" in table
    )
    assert "{side:offset_x} left" in table
    # Not known.
    assert "heading}" not in table.replace("{side:target_heading}", "").replace("{change:target_heading}", "")
    with writing_server("The gap of {distance} calls for nothing.") as server:
        run(settings(server.url, limit=1), tree, tmp_path / "out")
    questions = [body["messages"] for body in map(json.loads, server.bodies) if not is_mirror(body)]
    assert all("{distance@t0} to {distance@t4}: " in user["content"][-1]["text"] for _, user in questions)
    assert len({system["content"] for system, _ in questions}) == 1  # a constant prefix


LEFTWARD = dataclasses.replace(GAP, yaw_deg=(0.0, 1.0, 3.0, 6.0, 10.0))


def test_the_fact_at_an_address():
    for address, fact in [
        ("distance@t3", "unknown_fact"),
        ("distance@t5", "unobserved_frame"),
        ("change:distance", Fact(-2.0, "m", 1)),
        ("growth:box_height", Fact(20.0, "percent", 0)),
        ("rate:altitude@t3-t4", Fact(2.0, "mps", 1)),
        ("rate:yaw@t2-t4", Fact(7.0, "dps", 1)),
        ("climb_rate@t2", Fact(1.0, "mps", 2)),
        ("mean:speed@t2-t4", Fact(3.17, "mps", 2)),
        ("mean:target_speed", Fact(1.6, "mps", 2)),
        ("change:target_heading", "unknown_fact"),
        ("side:yaw", Fact("left")),
        ("side:offset_x@t1", Fact("centred")),
        ("side:offset_y", Fact("below")),
        ("trend:speed", Fact("increasing")),
        ("trend:pitch", Fact("steady")),
        ("target_motion", Fact("walking")),
        ("drone_motion", Fact("moving")),
        ("bearing", "unknown_fact"),
        ("sideways_speed", Fact(0.0, "mps", 2)),
        ("forward_speed@t3", "unknown_fact"),
    ]:  # fmt: skip
        reference = parse_reference(address)
        assert reference is not None
        assert look_up(reference, LEFTWARD) == fact
        assert parse_reference(str(reference)) == reference


def test_what_names_nothing():
    for address in [
        "", "colour", "distance@now", "distance@t0-t4", "trend:visibility", "side:distance", "sum:distance", "change:",
        "x" * 9,
    ]:  # fmt: skip
        assert parse_reference(address) is None


def test_a_series_that_ends_where_it_began_has_no_trend():
    for distance_m in ((20.5, 20.8, 20.5, 19.3, 20.5), (20.0, 22.0, 18.0, 21.0, 20.2)):
        facts = dataclasses.replace(LEFTWARD, distance_m=distance_m)
        assert look_up(parse_reference("trend:distance"), facts) == Fact("mixed")
