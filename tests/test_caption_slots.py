"""Slots: what is refused and why, what is filled in, and that both languages hold the same facts.

The oracle of numbers (`measured`) reads the series of `Facts` itself; it shares nothing with the filler but them.
"""

import dataclasses
import json
import re
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from specimens_captions import GAP, WAY, report_of, saying, settings
from tables import each
from teacher_server import CHINESE, ENGLISH, TeacherServer, is_mirror

from caption.answer_formats.contract import Draft, Refused
from caption.answer_formats.filling import Filler
from caption.answer_formats.slots import fact_table
from caption.answer_formats.templates import Sentence, read_sentence
from caption.schema import WindowConfig
from caption.stage.stage import run
from caption.stage.windows import cut_windows
from caption.verification.facts import Facts, measure_facts
from cosfly.formats.captions import Coc, Language, read_captions
from cosfly.llm.answer_text import Parsed
from cosfly.runtime.errors import NothingKept
from specimens import make_flight

FACTS = dataclasses.replace(GAP, yaw_deg=(0.0, 1.0, 3.0, -6.0, -10.0), offset_x_px=(0, 10, 40, None, -64))


def filled(
    text: str, language: Language = "en", facts: Facts = FACTS, decision: str = "yaw_right_to_follow"
) -> str | Refused:
    sentence = read_sentence(text, language, len(facts), facts.step_s)
    return sentence if isinstance(sentence, Refused) else Filler(facts, decision, language).fill(sentence)


@each(("template", "text"), [
    ("The gap {trend:distance} from {distance@t0} to {distance}.", "The gap decreases from 20.0 m to 18.0 m."),
    ("The gap is {trending:distance}.", "The gap is decreasing."),
    ("The gap is now {trend:distance}.", "The gap is now decreasing."),
    ("The gap has {trend:distance} to {distance}.", "The gap has decreased to 18.0 m."),
    ("A {trend:speed} pace and a {trend:distance} gap.", "An increasing pace and a decreasing gap."),
    ("It lies {offset_x} to the {side:offset_x} of the middle.", "It lies 64 px to the left of the middle."),
    ("An offset of {offset_x} is large.", "An offset of -64 px is large."),  # no slot says its side
    ("The nose swung {yaw} {side:yaw}, at {yaw_rate}.", "The nose swung 10.0 deg right, at -8.0 deg/s."),
    ("It was {yaw@t2} to the {side:yaw@t2} at t2.", "It was 3.0 deg to the left at t2."),
    ("The height {trend:altitude} by {change:altitude}.", "The height increases by 2.0 m."),
    ("The box measures {box@t4} now, {box@t0} then.", "The box measures 36 x 72 px now, 30 x 60 px then."),
    ("The box {trend:box_height} by {growth:box_height}.", "The box increases by 20%."),
    ("Pitch is {pitch} here.", "Pitch is -40.3 deg here."),
    ("It was {visibility@t3} at t3.", "It was occluded at t3."),
    ("The drone is {comparison:speed} the walker.", "The drone is faster than the walker."),
    ("The drone is {comparison:speed} than the walker.", "The drone is faster than the walker."),
    ("The drone is {comparison:speed}.", "The drone is faster."),
    ("The gap is {distance} m wide.", "The gap is 18.0 m wide."),  # the unit once
    ("At {speed} m/s it flies.", "At 4.00 m/s it flies."),
    ("It should {decision}, to the {side:decision}.", "It should yaw right to follow, to the right."),
    ("{Distance @ t0} it was.", "20.0 m it was."),
    ("The walker {target_motion} and is {target_motion}.", "The walker walks and is walking."),
])  # fmt: skip
def test_what_a_template_becomes(template, text):
    assert filled(template) == text


@each(("template", "text"), [
    ("水平距离从 {distance@t0}{trend:distance}到 {distance}。", "水平距离从 20.0 米减小到 18.0 米。"),
    ("目标位于画面中心{side:offset_x}侧 {offset_x} 处。", "目标位于画面中心左侧 64 像素处。"),
    ("边界框为 {box@t4}。", "边界框为 36 × 72 像素。"),
    ("无人机{comparison:speed}目标，因此{decision}。", "无人机快于目标，因此向右偏航跟随。"),
    ("t3 时目标{visibility@t3}。", "t3 时目标被遮挡。"),
    ("高度为 {altitude} 米。", "高度为 22.0 米。"),
])  # fmt: skip
def test_what_a_chinese_template_becomes(template, text):
    assert filled(template, "zh") == text


REFUSED = [
    ("en", "The gap is {distanse}.", "slots_unknown_reference", "did you mean 'distance'"),
    ("en", "The gap is {side:speed}.", "slots_unknown_reference", "table of facts"),
    ("en", "The gap was {distance@t3}.", "slots_unknown_fact", "leave it out"),
    ("en", "The gap was {distance@t7}.", "slots_unobserved_frame", "t0 to t4"),
    ("en", "At t5 the gap was {distance}.", "slots_unobserved_frame", "t0 to t4"),
    ("en", "The gap is {distance.", "slots_unbalanced_braces", "brace"),
    ("en", "The gap is {{distance}}.", "slots_unbalanced_braces", "brace"),
    ("en", "The gap is 18.0 m.", "slots_number_outside", "18.0"),
    ("en", "The gap is eighteen metres.", "slots_number_outside", "eighteen metres"),
    ("en", "A few metres away, {distance}.", "slots_number_outside", "few metres"),
    ("en", "It flies twice as fast, at {speed}.", "slots_number_outside", "twice"),
    ("en", "The gap is 二十 here.", "slots_number_outside", "二十"),
    ("en", "Over the last 9 frames it was {speed}.", "slots_number_outside", "9"),
    ("en", "The gap is {distance} px.", "slots_unit_outside", "its unit is m"),
    ("en", "The walker is on the left.", "slots_pole_outside", "left"),
    ("en", "The gap increases to {distance}.", "slots_pole_outside", "increases"),
    ("en", "The walker is hidden.", "slots_pole_outside", "hidden"),
    ("en", "The drone is faster.", "slots_pole_outside", "faster"),
    ("en", "The walker is no longer {visibility}.", "slots_negated", "negate"),
    ("en", "The speed is not {trend:speed}.", "slots_negated", "negate"),
    ("en", "Turned {yaw@t2} to the {side:yaw}.", "slots_sign_differs", "same frames"),
    (
        "en",
        "It {trend:altitude} by {change:altitude@t0-t1} to the {side:offset_y@t0}.",
        "slots_no_side",
        "neither side",
    ),
    ("zh", "距离为 18.0 米。", "slots_number_outside", "18.0"), ("zh", "距离约十八米。", "slots_number_outside", "十八米"),
    ("zh", "目标在左侧。", "slots_pole_outside", "左"), ("zh", "目标不{visibility}。", "slots_negated", "negate"),
    ("zh", "距离{trend:distanc}。", "slots_unknown_reference", "table of facts"),
    ("zh", "速度为 {speed} 米。", "slots_unit_outside", "米/秒"),
]  # fmt: skip


@each(("language", "text", "reason", "words"), REFUSED)
def test_what_is_refused_says_why_and_what_is_allowed(language, text, reason, words):
    found = filled(text, language)
    assert isinstance(found, Refused)
    assert found.reason == reason
    assert words in found.complaint


def windows_of(num_flights: int) -> list[Facts]:
    found = []
    for seed in range(num_flights):
        flight = dataclasses.replace(make_flight(30, seed=seed, width_px=640, height_px=360)[0], folder=Path("nowhere"))
        samples = cut_windows(flight, WindowConfig(require_images=False, stride=4))
        found += [measure_facts(sample.observed, (640, 360)) for sample in samples]
    return found


def earned_texts() -> dict[str, list[str]]:
    """Give the sentences of earned.txt by their heading: `false en`, `true zh` ..."""
    lines = (Path(__file__).parent / "earned.txt").read_text("utf-8").splitlines()
    found: dict[str, list[str]] = {}
    for line in filter(None, lines[2:]):
        if line.startswith("["):
            texts = found[line[1:-1]] = []
        else:
            texts.append(line)
    return found


SERIES = {  # slot -> field, digits, unit in both languages
    "speed": ("speed_mps", 2, "m/s", "米/秒"), "altitude": ("altitude_m", 1, "m", "米"), "pitch": ("pitch_deg", 1, "deg",
        "度"),
    "yaw": ("yaw_deg", 1, "deg", "度"), "distance": ("distance_m", 1, "m", "米"), "slant": ("slant_m", 1, "m", "米"),
    "box_width": ("box_width_px", 0, "px", "像素"), "offset_x": ("offset_x_px", 0, "px", "像素"),
    "travelled": ("travelled_m", 1, "m", "米"), "bearing": ("bearing_deg", 1, "deg", "度"),
}  # fmt: skip
WINDOWS = windows_of(4)


def measured(facts: Facts, name: str, first: int, last: int | None, aspect: str) -> float | None:
    series = getattr(facts, SERIES[name][0])
    first = 1 if name == "speed" and aspect and first == 0 and last else first  # of steps: the first frame has none
    values = series[first : (first if last is None else last) + 1]
    if any(value is None for value in values) or (aspect == "change" and first == last):
        return None
    match aspect:
        case "change":
            return values[-1] - values[0]
        case "min":
            return min(values)
        case "max":
            return max(values)
    return values[0]


@st.composite
def slots(draw):
    name, first = draw(st.sampled_from(sorted(SERIES))), draw(st.integers(0, 4))
    aspect = draw(st.sampled_from(["", "change", "min", "max"]))
    last = draw(st.integers(first, 4)) if aspect else None
    return name, first, last, aspect


@given(st.sampled_from(WINDOWS), st.lists(slots(), min_size=1, max_size=4))
def test_the_numbers_of_both_languages_are_the_facts(facts, chosen):
    addresses = [f"{a}:{n}@t{i}-t{j}" if a else f"{n}@t{i}" for n, i, j, a in chosen]
    texts = {
        "en": filled("It reads " + " and then ".join(f"{{{address}}}" for address in addresses) + ".", "en", facts),
        "zh": filled("数值为 " + "，然后为 ".join(f"{{{address}}}" for address in addresses) + "。", "zh", facts),
    }
    values = [measured(facts, *slot) for slot in chosen]
    if None in values:
        assert all(isinstance(text, Refused) and text.reason == "slots_unknown_fact" for text in texts.values())
        return
    for place, (language, text) in enumerate(texts.items()):
        assert isinstance(text, str)
        found = re.findall(r"(-?\d+(?:\.\d+)?) (m/s|deg|px|m|米/秒|度|像素|米)", text)
        expected = [
            (round(value, SERIES[slot[0]][1]), SERIES[slot[0]][2 + place])
            for slot, value in zip(chosen, values, strict=True)
        ]
        assert [unit for _, unit in found] == [unit for _, unit in expected], language
        assert [float(number) for number, _ in found] == pytest.approx([number for number, _ in expected], abs=1e-6)


def drafts(english: str, chinese: str) -> Draft | Refused:
    en = Coc(critical_components="The walker is {visibility}.", reasoning_trace=english, flight_decision="hover")
    zh = Coc(critical_components="行人{visibility}。", reasoning_trace=chinese, flight_decision="hover")
    first = WAY.read(Parsed(en, therefore="hover"), FACTS)
    assert isinstance(first, Draft), first
    return WAY.read_mirror(Parsed(zh), first, FACTS)


@each(("english", "chinese", "reason"), [
    ("The gap {trend:distance} to {distance}.", "距离{trend:distance}到 {distance}。", None),
    ("With {distance} the gap {trend:distance}.", "距离{trend:distance}，为 {distance}。", None),  # another order
    ("The gap is {distance}. It should {decision}.", "距离为 {distance}，应{decision}。", "sentences"),
    ("The gap {trend:distance} to {distance}.", "距离为 {distance}。", "slots"),
    ("The gap is {distance}.", "距离为 {slant}。", "slots"),
    ("The gap is {distance@t0}.", "距离为 {distance}。", "slots"),
    ("The gap is {distance}.", "The gap is {distance}。", "script"),
    ("The gap is {distance}.", "距离为 {distance}，约二十米。", "slots_number_outside"),
    ("The altitude is {altitude}.", "海拔为 {altitude}。", "glossary"),
])  # fmt: skip
def test_the_mirror_holds_the_same_slots_sentence_by_sentence(english, chinese, reason):
    found = drafts(english, chinese)
    assert (found.reason if isinstance(found, Refused) else None) == reason
    if isinstance(found, Refused):
        assert found.complaint


def test_a_sentence_is_proved_only_where_its_words_are_true_with_its_slots():
    texts = earned_texts()
    for language in ("en", "zh"):
        for text in texts[f"false {language}"]:
            found = read_sentence(text, language, 5, 0.5)
            assert isinstance(found, Refused) or found.state == "unread", text
        for text in texts[f"true {language}"]:
            found = read_sentence(text, language, 5, 0.5)
            assert isinstance(found, Sentence), (text, found)
            assert found.state == "proved", text


def claimed(quantity: str, value: str, quote: str, at: str = "t4") -> dict[str, str]:
    return {"sentence": "R1", "quantity": quantity, "at": at, "value": value, "unit": "", "modality": "observed",
            "quote": quote}  # fmt: skip


FASTER, SLOWER = (partial(claimed, "comparison:speed", value) for value in ("faster", "slower"))
STEADY = partial(claimed, "trend:pitch", "steady", at="t0-t4")


@each(("language", "reasons", "claims", "state"), [
    ("en", "The drone at {speed} outpaces the walker.", [FASTER("outpaces")], "proved"),
    ("en", "The drone at {speed} outpaces the walker.", [SLOWER("outpaces")], "contradicted"),
    ("en", "The drone at {speed} outpaces the walker.", [], "unread"),
    ("en", "The drone at {speed} outpaces the lazy walker.", [FASTER("outpaces")], "unread"),  # not covered
    ("en", "The drone at {speed} outpaces the walker.", [FASTER("outruns")], "unread"),  # not what stands there
    ("en", "The drone at {speed} outpaces the walker.", [STEADY("outpaces")], "unread"),  # of another kind
    ("en", "The drone at {speed} is outpaced by the walker.", [FASTER("is outpaced by")], "unread"),
    ("en", "The drone at {speed} is not outpacing the walker.", [FASTER("is not outpacing")], "unread"),
    ("en", "The walker outpaces the drone at {speed}.", [FASTER("outpaces")], "unread"),  # the other order
    ("en", "The walker at {speed} is what the drone outpaces.", [FASTER("outpaces")], "unread"),  # not its slot
    ("en", "The pitch is steady.", [STEADY("is steady")], "proved"),
    ("en", "The altitude of {altitude} is steady.", [STEADY("is steady")], "unread"),  # another series
    ("en", "The altitude is steady.", [STEADY("The altitude is steady")], "unread"),
    ("en", "The pitch is steady.", [{**STEADY("is steady"), "quantity": "trend:distance"}], "contradicted"),
    ("en", "The pitch is steady.", "is steady", "unread"),  # no list
    ("zh", "俯仰角为 {pitch}，保持稳定。", [STEADY("保持稳定")], "proved"),
    ("zh", "俯仰角为 {pitch}，保持稳定。", [], "unread"),
    ("zh", "高度为 {altitude}，保持稳定。", [STEADY("保持稳定")], "unread"),
    ("zh", "距离为 {distance}，行人站立不动。", [claimed("target_motion", "standing", "站立不动")], "contradicted"),
])  # fmt: skip
def test_a_word_beside_slots_needs_a_claim_that_holds(language, reasons, claims, state):
    coc = Coc(critical_components="{visibility}", reasoning_trace=reasons, flight_decision="hover")
    if language == "en":
        found = WAY.read(Parsed(coc, therefore="hover", more={"claims": claims}), FACTS)
    else:
        english = coc.model_copy(update={"reasoning_trace": "With {" + re.search(r"\{(\w+)\}", reasons)[1] + "}."})
        first = WAY.read(Parsed(english, therefore="hover"), FACTS)
        found = WAY.read_mirror(Parsed(coc, more={"claims": claims}), first, FACTS)
    assert isinstance(found, Draft), found
    [_, judged] = WAY.judge(found, FACTS, language)
    assert (judged.state, state == "contradicted") == (state, bool(judged.problems))
    asked_again = isinstance(claims, list) and len(found.template.claims or ()) > 0 and state == "unread"
    assert bool(found.doubt) >= asked_again


def writing_server(english: str, corrected: str | None = None) -> TeacherServer:
    """A teacher whose reasoning is `english`, and `corrected` once it is told what was wrong."""

    def text(body: dict) -> str:
        if is_mirror(body):
            wanted = json.loads(body["messages"][-1]["content"])["reasoning_trace"]
            reasons = (
                "距离为 {distance}，保持稳定，因此该动作可将其保持在画面内。"
                if "{distance}" in wanted
                else CHINESE["reasoning_trace"]
            )
            return json.dumps({**CHINESE, "reasoning_trace": reasons, "flight_decision": "hover"})
        reasons = corrected if corrected and len(body["messages"]) > 2 else english
        return json.dumps({**ENGLISH, "reasoning_trace": reasons, "therefore": "hover", "flight_decision": "hover"})

    return saying(text)


def test_a_record_holds_the_plain_text_and_the_template(tree, tmp_path):
    with writing_server("The gap of {distance} calls for this decision.") as server:
        captions = list(read_captions(run(settings(server.url, limit=2), tree, tmp_path / "out")))
    for caption in captions:
        assert caption.writing == "slots"
        assert caption.slots["en"].reasoning_trace == "The gap of {distance} calls for this decision."
        assert re.fullmatch(r"The gap of \d+\.\d m calls for this decision\.", caption.en.reasoning_trace)
        number = re.search(r"\d+\.\d", caption.en.reasoning_trace)[0]
        assert f"{number} 米" in caption.zh.reasoning_trace
        assert caption.checks.sentences == {"en": ["unread", "proved"], "zh": ["unread", "unread"]}  # "ahead"
        assert caption.coverage("en") == 0.5


def test_a_refused_answer_is_mended_when_it_is_told_what_was_wrong(tree, tmp_path):
    with writing_server("The gap of 18.5 m calls for nothing.", "The gap of {distance} calls for nothing.") as server:
        captions = list(read_captions(run(settings(server.url, limit=2), tree, tmp_path / "out")))
    assert [caption.checks.refused for caption in captions] == [["slots_number_outside"]] * 2
    corrections = [json.loads(body)["messages"][-1]["content"] for body in server.bodies]
    complaints = [
        content[0]["text"]
        for content in corrections
        if isinstance(content, list) and "refused" in content[0].get("text", "")
    ]
    assert len(complaints) == 2
    assert all('"18.5"' in text and "reasoning_trace, sentence 1" in text for text in complaints)


@each(("reasons", "reason"), [
    ("The gap of 18.5 m calls for nothing.", "slots_number_outside"),
    ("The gap of {gap} calls for this decision.", "slots_unknown_reference"),
    ("The walker is on the left of the road there.", "slots_pole_outside"),
    ("The decision is to ascend, given all of this.", "slots_pole_outside"),
    ("The drone should move forward, given all of this.", "decision_against_reasoning"),
])  # fmt: skip
def test_an_answer_that_stays_wrong_drops_its_window_for_that_reason(tree, tmp_path, reasons, reason):
    with writing_server(reasons) as server, pytest.raises(NothingKept):
        run(settings(server.url, limit=2), tree, tmp_path / "out")
    report = report_of(tmp_path / "out")
    assert report["windows"]["dropped"] == {reason: 2}
    assert len(server.bodies) == 4  # each asked once more


def test_the_question_shows_what_is_known_by_its_slot(tree, tmp_path):
    table = fact_table(FACTS)
    assert (
        "{distance@t0} to {distance@t4}: 20.0, 20.5, 21.0, -, 18.0 m; {change:distance} -2.0 m; {trend:distance} "
        "decreases" in table
    )
    assert "{side:offset_x} left" in table
    # Not known.
    assert "heading}" not in table.replace("{side:target_heading}", "").replace("{change:target_heading}", "")
    with writing_server("The gap of {distance} calls for nothing.") as server:
        run(settings(server.url, limit=2), tree, tmp_path / "out")
    questions = [body["messages"] for body in map(json.loads, server.bodies) if not is_mirror(body)]
    assert all("{distance@t0} to {distance@t4}: " in user["content"][-1]["text"] for _, user in questions)
    assert len({system["content"] for system, _ in questions}) == 1  # a constant prefix
