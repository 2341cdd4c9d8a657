"""The rule teacher: true sentences, the same in both languages, and a decision with a reason."""

import re

import pytest

from caption.schema import WindowConfig
from caption.stage.windows import cut_windows
from caption.teachers.rules import sentences
from caption.verification.references import parse_reference
from caption.verification.vocabulary import terms_in
from specimens import make_flight

SLOT = re.compile(r"\{([^{}]*)\}")
PAIRS = [
    (part, group.name, pair)
    for parts in sentences().values()
    for part, groups in parts.items()
    for group in groups.values()
    for pair in group.smooth
]


def windows(tmp_path):
    for seed in range(6):
        for variant in ("ORI", "aug_001"):
            flight = make_flight(seed=seed, variant=variant)[0]
            flight = flight.__class__(**{**vars(flight), "folder": tmp_path})
            yield from (window.observed for window in cut_windows(flight, WindowConfig()))


@pytest.mark.parametrize(("part", "name", "pair"), PAIRS, ids=[pair[2][0][:40] for pair in PAIRS])
def test_both_languages_of_a_sentence_hold_the_same_slots_and_terms(part, name, pair):
    english, chinese = pair
    assert sorted(SLOT.findall(english)) == sorted(SLOT.findall(chinese)) or "compared:speed" in chinese
    assert all(zh in chinese for _, zh in terms_in(SLOT.sub("", english)))
    assert all(slot == "decision" or parse_reference(slot) for slot in SLOT.findall(english + chinese))
