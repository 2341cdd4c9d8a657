"""The reader of free prose: true captions pass, planted errors are caught, on captions that others wrote."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from retold import misread
from specimens_prose import (
    CASES,
    EIGHTEENTH_SET,
    EIGHTH_SET,
    ELEVENTH_SET,
    FIFTEENTH_SET,
    FIFTH_SET,
    FOLLOW,
    FOURTEENTH_SET,
    FOURTH_SET,
    HOLD,
    NINTH_SET,
    SECOND_SET,
    SET_WORDS,
    SEVENTEENTH_SET,
    SEVENTH_SET,
    SIXTEENTH_SET,
    SIXTH_SET,
    TENTH_SET,
    THIRD_SET,
    THIRTEENTH_SET,
    TWELFTH_SET,
    WINDOWS,
    Case,
)
from wordings import FOREIGN, OWN, SETS

from caption.schema import EvidenceConfig
from caption.truth.claims import judge_claims
from caption.truth.facts import Facts
from caption.truth.gold import GOLD_PROSE, read_gold_prose
from caption.truth.prose import judging
from caption.truth.prose.clauses import parse
from caption.truth.prose.judging import check_evidence, judge_sentences
from caption.truth.prose.numerals import masked
from caption.truth.prose.wording import groups_of, met, written
from cosfly.products.captions import Coc, Language
from cosfly.products.sentences import sentences_of

CFG = EvidenceConfig()


def coc_of(record: dict[str, Any]) -> Coc:
    return Coc(**{name: record[name] for name in Coc.model_fields})


def foreign() -> Iterator[tuple[Language, Facts, Coc, list[dict[str, Any]]]]:
    for line in FOREIGN.read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        facts = {name: tuple(v) if isinstance(v, list) else v for name, v in record["facts"].items()}
        yield record["lang"], Facts(**facts), coc_of(record), record["false"]


def group_of(kind: str) -> str:
    if kind.startswith(("num", "halluc", "unit", "words", "ratio")):
        return "numbers"
    return "sides" if kind.startswith(("side", "clock")) else "others"


def measure(captions: Iterable[tuple[Language, Facts, Coc, list[tuple[str, Coc]]]]) -> tuple[float, dict[str, float]]:
    """Give the share of true captions that are flagged, and of errors that are caught, by group and of all."""
    flagged = num_captions = 0
    caught, counts = Counter[str](), Counter[str]()
    for language, facts, coc, errors in captions:
        num_captions += 1
        flagged += bool(check_evidence(coc, facts, CFG, language))
        for kind, changed in errors:
            is_caught = bool(check_evidence(changed, facts, CFG, language))
            for group in (group_of(kind), "all"):
                counts[group] += 1
                caught[group] += is_caught
    return flagged / num_captions, {group: caught[group] / count for group, count in counts.items()}


@pytest.mark.skipif(not FOREIGN.exists(), reason="the foreign captions are not beside this checkout")
def test_foreign_captions_pass_and_their_errors_are_caught():
    flagged, caught = measure(
        (language, facts, coc, [(error["kind"], coc_of(error)) for error in errors])
        for language, facts, coc, errors in foreign()
    )
    assert flagged <= 0.03
    assert caught["all"] >= 0.88
    assert caught["numbers"] >= 0.98
    assert caught["sides"] >= 0.8


@pytest.mark.parametrize(
    ("path", "flagged_at_most", "of_all", "numbers", "sides"),
    [
        (GOLD_PROSE, 0, 0.855, 0.945, 0.87),
        (SECOND_SET, 0, 0.835, 0.91, 0.84),
        (THIRD_SET, 0, 0.71, 0.75, 0.7),
        (FOURTH_SET, 0, 0.83, 0.82, 0.89),
        (FIFTH_SET, 0, 0.68, 0.67, 0.825),
        (SEVENTH_SET, 1, 0.765, 0.87, 0.91),
        (EIGHTH_SET, 0, 0.815, 0.845, 0.77),
        (ELEVENTH_SET, 0, 0.81, 0.835, 0.78),
        # Of these the wordings are not met: hard styles and common ones. What they gave before they were read stands in docs/captions.md.
        (SIXTH_SET, 0, 0.62, 0.69, 0.53),
        (NINTH_SET, 0, 0.78, 0.86, 0.765),
        (TENTH_SET, 3, 0.735, 0.825, 0.83),
        (TWELFTH_SET, 0, 0.795, 0.83, 0.78),
        (THIRTEENTH_SET, 0, 0.8, 0.89, 0.79),
        (FOURTEENTH_SET, 0, 0.76, 0.825, 0.795),
        (FIFTEENTH_SET, 0, 0.745, 0.835, 0.76),
        (SIXTEENTH_SET, 0, 0.725, 0.78, 0.735),
        (SEVENTEENTH_SET, 2, 0.715, 0.81, 0.885),
    ],
    ids=[
        "gold",
        "second",
        "third",
        "fourth",
        "fifth",
        "seventh",
        "eighth",
        "eleventh",
        "sixth",
        "ninth",
        "tenth",
        "twelfth",
        "thirteenth",
        "fourteenth",
        "fifteenth",
        "sixteenth",
        "seventeenth",
    ],
)
def test_captions_of_others_pass_and_their_errors_are_caught(
    path: Path, flagged_at_most: int, of_all: float, numbers: float, sides: float
):
    """Bounds of what is reached on sets that are read by now; wanted are 75 % of all, 95 % of the numbers, 80 % of the sides."""
    captions = list(read_gold_prose(path))
    flagged, caught = measure(
        (one.language, one.facts, one.coc, [(error.kind, error.in_text(one.coc)) for error in one.errors])
        for one in captions
    )
    assert round(flagged * len(captions)) <= flagged_at_most
    assert caught["all"] >= of_all
    assert caught["numbers"] >= numbers
    assert caught["sides"] >= sides


def test_true_captions_of_eight_hands_are_seldom_flagged():
    """Idioms, history before the present and comparisons; each third of them flagged 7 to 13 % when they were new (docs/captions.md)."""
    captions = list(read_gold_prose(EIGHTEENTH_SET))
    flagged = [one.id for one in captions if check_evidence(one.coc, one.facts, CFG, one.language)]
    assert len(captions) == 480
    assert len(flagged) <= 14, flagged


def test_true_captions_told_of_other_windows_stay_true():
    """Where no value is another's by chance, nearly all numbers are still taken for what their writers meant."""
    found = list(misread([*read_gold_prose(), *read_gold_prose(SECOND_SET)], draws=1))
    assert len(found) > 1_500
    assert len({name for name, _, _, is_wrong in found if is_wrong}) <= 4


def state_of(text: str, language: Language) -> str:
    coc = Coc(critical_components=text, reasoning_trace=FILLER[language], flight_decision="ascend")
    return judge_sentences(coc, FOLLOW, CFG, language)[0].state


@pytest.mark.parametrize(
    ("language", "known", "unmet"),
    [
        ("en", "Box width {} px and altitude 20.4 m.", "Matinee box width {} px and tombola altitude 20.4 m."),
        ("zh", "框宽{}像素和高度20.4米。", "戏台框宽{}像素和锣鼓高度20.4米。"),
    ],
)
def test_a_clause_that_is_worded_as_none_that_was_met_contradicts_only_by_a_number_of_nothing(
    language, known, unmet, monkeypatch
):
    assert state_of(known.format("58"), language) == "contradicted"
    assert state_of(unmet.format("58"), language) == "unread"  # its height
    assert state_of(unmet.format("20"), language) == "contradicted"  # of another frame, and of nothing in this one
    assert state_of(unmet.format("90"), language) == "contradicted"
    monkeypatch.setattr(judging, "is_met", lambda *_, **__: True)
    assert (
        state_of(unmet.format("58"), language) == "contradicted"
    )  # it is for its wording alone that it is left unread


@pytest.mark.parametrize(
    ("language", "known", "cited"),
    [
        ("en", "The altitude is {} m.", "Section 7 of the manual says that the altitude is {} m."),
        ("zh", "高度为 {} 米。", "《规程》第 7 条：高度为 {} 米。"),
    ],
)
@pytest.mark.parametrize("value", ["18.9", "35.0"], ids=["of another frame", "of nothing"])
def test_what_is_cited_contradicts_nothing(language, known, cited, value):
    assert state_of(known.format(value), language) == "contradicted"
    assert state_of(cited.format(value), language) == "unread"


def test_the_wordings_of_all_captions_that_were_read_have_been_met():
    """Else a lexicon has changed since: run `python tests/wordings.py`."""
    for path in SETS:
        for line in read_gold_prose(path):
            for _, text in sentences_of(line.coc):
                assert groups_of(written(parse(masked(text, line.language)[0], line.language))) <= met(line.language)


FILLER = {"en": "The scene is calm.", "zh": "场面平静。"}


def problems_of(case: Case, text: str) -> list[str]:
    """Judge a text as the reasoning, where decisions are argued for, or as the components."""
    is_reasoning = any(word in case.text for word in ("Therefore", "Hence", "因此", "所以"))
    texts = (FILLER[case.language], text) if is_reasoning else (text, FILLER[case.language])
    coc = Coc(critical_components=texts[0], reasoning_trace=texts[1], flight_decision=case.decision)
    return check_evidence(coc, case.facts, CFG, case.language)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.text[:40])
def test_a_true_sentence_passes_and_a_false_one_does_not(case):
    assert problems_of(case, case.text) == []
    for old, new in case.errors:
        assert case.text.count(old) >= 1
        assert problems_of(case, case.text.replace(old, new, 1)), f"{old} -> {new}"
    for old, new in case.unread:
        assert case.text.count(old) >= 1
        assert problems_of(case, case.text.replace(old, new, 1)) == [], (
            f"now read, move it to the errors: {old} -> {new}"
        )


@pytest.mark.parametrize("case", SET_WORDS, ids=lambda case: case.text[:40])
def test_set_words_contradict_in_any_wording(case, monkeypatch):
    monkeypatch.setattr(judging, "is_met", lambda *_, **__: False)
    assert problems_of(case, case.text) == []
    for old, new in case.errors:
        assert case.text.count(old) == 1
        assert problems_of(case, case.text.replace(old, new)), f"{old} -> {new}"


@pytest.mark.parametrize(
    ("language", "text"), [("en", "the drone is left of the walker at 3 m "), ("zh", "无人机比行人在左")]
)
def test_a_sentence_without_an_end_is_left_unread(language, text):
    """As a model writes that repeats itself; read, ten thousand words of it would take hours."""
    assert state_of(text * 10_000, language) == "unread"


@pytest.mark.parametrize("case", CASES[::7], ids=lambda case: case.text[:40])
def test_what_is_not_read_is_not_proved(case):
    """A sentence with a number that nothing is known of, or nothing to compare, is unread."""
    text = "A bus stop 7 m away, painted 12 times." if case.language == "en" else "7 米外有一个公交站，共 12 个座位。"
    coc = Coc(critical_components=text, reasoning_trace=FILLER[case.language], flight_decision=case.decision)
    assert [one.state for one in judge_sentences(coc, case.facts, CFG, case.language)] == ["unread", "unread"]


@given(st.text(alphabet="t39 0.5-−+%x→,.;()?！是在了米m/s度°左上 leftdownrangyawspeed约twice", max_size=60))
def test_any_text_is_read_without_an_error(text):
    for language in ("en", "zh"):
        coc = Coc(critical_components=text, reasoning_trace=text[::-1], flight_decision="hover")
        for facts in (FOLLOW, HOLD):
            judged = judge_sentences(coc, facts, CFG, language)
            assert [one.name for one in judged] == [name for name, _ in sentences_of(coc)]
            assert all(bool(one.problems) == (one.state == "contradicted") for one in judged)


@pytest.mark.parametrize(
    "text", ["The drone flies four times as fast as the walker.", "The walker does a quarter of our speed."]
)
def test_a_multiple_of_a_speed_that_is_zero_is_judged(text):
    """Where one of the two stood at a frame, there is a quotient one way only."""
    standing = dataclasses.replace(FOLLOW, target_speeds_mps=(None, 0.0, 0.0, 1.3, 1.4), target_speed_mps=0.7)
    hovering = dataclasses.replace(FOLLOW, speed_mps=(None, 0.0, 0.0, 0.0, 0.0))
    for facts in (standing, hovering):
        coc = Coc(critical_components=text, reasoning_trace=FILLER["en"], flight_decision="hover")
        assert len(judge_sentences(coc, facts, CFG, "en")) == 2


def torn(facts: Facts, rng: np.random.Generator) -> Facts:
    """Make values zero, unknown where the type allows it, or a later series unmeasured, at random."""
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(Facts):
        series, as_what = getattr(facts, field.name), rng.integers(4)
        if field.name == "visibility" or not isinstance(series, tuple):
            continue
        if as_what == 0 and field.default == ():
            changed[field.name] = ()
        elif as_what == 1:
            changed[field.name] = tuple(v if v is None or rng.random() < 0.5 else type(v)(0) for v in series)
        elif as_what == 2 and "None" in str(field.type):
            changed[field.name] = tuple(None if rng.random() < 0.5 else v for v in series)
    means = {name: rng.choice(np.array([None, 0.0, 0.7])) for name in ("target_speed_mps", "target_turn_deg")}
    return dataclasses.replace(facts, **changed, **means)


def test_captions_are_judged_against_windows_of_which_little_is_known():
    """Each against its own window and that of another, with holes and zeros: nothing raises."""
    rng = np.random.default_rng(0)
    lines = list(read_gold_prose(SECOND_SET))
    for line, other in zip(lines, reversed(lines), strict=True):
        for facts in (line.facts, other.facts):
            holed = torn(facts, rng)
            assert judge_sentences(line.coc, holed, CFG, line.language)
            assert judge_claims(line.coc, line.claims, holed, CFG, line.language)


def test_true_prose_of_our_own_passes():
    flagged = []
    for entry in yaml.safe_load(OWN.read_text(encoding="utf-8")):
        language, facts = entry["lang"], WINDOWS[entry["facts"]]
        texts = [(text, FILLER[language]) for text in entry.get("sentences", ())]
        texts = texts or [(entry["critical_components"], entry["reasoning_trace"])]
        for components, reasoning in texts:
            coc = Coc(critical_components=components, reasoning_trace=reasoning, flight_decision=entry["decision"])
            flagged += check_evidence(coc, facts, CFG, language)
    assert flagged == []
