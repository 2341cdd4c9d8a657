"""The rule teacher: sentences that agree in both languages, true facts, a reason for each decision."""

import re

import numpy as np
import pytest
from specimens_captions import contradictions_of, cut_flight, write_answers

from caption.teachers.rule_decisions import is_shaken, ranked
from caption.teachers.rules import (
    FAMILIES,
    STRIKING_TOPICS,
    TOPICS,
    TOPICS_HIDDEN,
    TOPICS_ORDERED,
    sentences,
    write_templates,
)
from caption.verification.facts import measure_facts
from caption.verification.glossary import count_opposites, terms_in
from caption.verification.mirror import check_mirror
from caption.verification.references import Fact, look_up, parse_reference
from cosfly.formats.captions import ACTIONS, TOKENS
from cosfly.llm.answer_text import cut_sentences
from cosfly.runtime.seeding import random_bytes

SLOT = re.compile(r"\{([^{}]*)\}")
FIELDS = ("critical_components", "reasoning_trace")
PAIRS = [
    pair
    for parts in sentences().values()
    for groups in parts.values()
    for group in groups.values()
    for pair in group.smooth
]


def opposites_in(text, language):
    return count_opposites(SLOT.sub("", text), language)


@pytest.fixture(scope="module")
def facts():
    found = []
    for seed in range(8):
        for variant in ("ORI", "aug_001"):
            windows = cut_flight(30, 2, seed=seed, variant=variant, width_px=640, height_px=360)
            found += [measure_facts(window.observed) for window in windows]
    return found


def test_each_decision_has_a_family_and_each_family_sentences():
    assert sorted(token for family in FAMILIES.values() for token in family.tokens) == sorted(TOKENS)
    assert len({english for english, _ in PAIRS}) >= 60
    for name, family in FAMILIES.items():
        assert sentences()["reasons"][name]
        assert sentences()["consequences"][family.consequences]
    assert {*TOPICS, *TOPICS_HIDDEN, *TOPICS_ORDERED, *STRIKING_TOPICS} == sentences()["facts"].keys()


def test_both_languages_of_a_sentence_agree():
    for english, chinese in PAIRS:
        assert sorted(SLOT.findall(english)) == sorted(SLOT.findall(chinese)), english
        assert all(zh in chinese for zh in terms_in(SLOT.sub("", english)).values()), english
        assert opposites_in(english, "en") == opposites_in(chinese, "zh"), english
        assert all(slot in ("decision", "side:decision") or parse_reference(slot) for slot in SLOT.findall(english)), (
            english
        )
        assert len(cut_sentences(english)) == len(cut_sentences(chinese)) == 1, english


def test_a_caption_has_few_facts_a_reason_and_known_values(facts):
    written = [write_templates(one, random_bytes(0, "rules", str(i))) for i, one in enumerate(facts)]
    assert sum(answer is not None for answer in written) >= 0.6 * len(facts)
    for one, answer in zip(facts, written, strict=True):
        if answer is None:
            continue
        english, chinese = answer
        assert english["flight_decision"] == chinese["flight_decision"]
        assert english["flight_decision"] in ranked(one)
        for name in FIELDS:
            assert len(cut_sentences(english[name])) == len(cut_sentences(chinese[name]))
            for slot in set(SLOT.findall(english[name])) - {"decision", "side:decision"}:
                assert isinstance(look_up(parse_reference(slot), one), Fact), slot
        assert 1 <= len(cut_sentences(english["critical_components"])) <= 5
        assert "{decision}" in english["reasoning_trace"]


def test_a_shaken_track_tells_no_motion_in_numbers(facts):
    written = [write_templates(one, random_bytes(0, "rules", "shaken")) for one in facts if is_shaken(one)]
    assert any(written)
    for english, _ in filter(None, written):
        assert not re.search(r"\{(change:|mean:target_speed|mean:speed|yaw\})", " ".join(english.values()))


def test_captions_are_one_record_in_two_languages(facts):
    written = [(one, write_answers(one, np.random.default_rng(i))) for i, one in enumerate(facts)]
    captions = [(one, *answers) for one, answers in written if answers is not None]
    for one, english, chinese in captions:
        assert check_mirror(english, chinese, one) is None
    # A digit of the Chinese text altered to a value that nothing measured is caught.
    with_numbers = [row for row in captions if re.search(r"\d+\.\d+", row[2].critical_components)]
    assert len(with_numbers) >= 40
    for one, english, chinese in with_numbers[:40]:
        number = re.search(r"\d+\.\d+", chinese.critical_components).group()
        changed = chinese.critical_components.replace(number, f"{float(number) + 137.77:.2f}")
        assert check_mirror(english, chinese.model_copy(update={"critical_components": changed}), one) == "number"


def test_any_given_decision_is_justified_without_contradiction_or_not_argued(facts):
    for decision in TOKENS:
        written = [(one, write_answers(one, np.random.default_rng(3), decision)) for one in facts[::7]]
        given = [(one, *answers) for one, answers in written if answers is not None]
        assert not given or decision != "return_to_home"
        assert len(given) < len(written) or decision != "yaw_left_to_follow"
        for one, english, chinese in given:
            assert english.flight_decision == chinese.flight_decision == decision
            assert contradictions_of(english, one, "en") == contradictions_of(chinese, one, "zh") == []
            assert check_mirror(english, chinese, one) is None
            assert ACTIONS[decision].zh in chinese.reasoning_trace
