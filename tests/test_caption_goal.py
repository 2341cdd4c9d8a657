"""Goals and other people in what teachers are told and say, held against the geometry; nothing of it without them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from caption.answer_formats.formats import FORMATS
from caption.schema import WindowConfig
from caption.stage.windows import cut_windows
from caption.teachers.prompt_files import Vocabulary, shipped_prompts
from caption.teachers.prompts import user_prompts
from caption.verification.facts import measure_facts
from caption.verification.references import look_up, parse_reference
from cosfly.formats.captions import Coc, Prompt
from cosfly.formats.people import Goal
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from specimens import make_playback_tree

GOAL = Goal(0, "the woman in the red jacket", "穿红色夹克的女子", ("figure", "top"))
BYSTANDER_COLUMNS = np.array(
    [[0, np.nan, np.nan, np.nan, np.nan], [1, 4.04, 9, 9, 2], [2, 3.5, 9, 8, 1], [3, 2.26, 7, 8, 1], [3, 2.5, 7, 8, 1]]
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return read_track(find_tracks(make_playback_tree(tmp_path_factory.mktemp("tree"), 1, 12))[0])


@pytest.fixture(scope="module")
def vocabulary():
    return Vocabulary(shipped_prompts())


def window_of(flight):
    return next(cut_windows(flight, WindowConfig(require_images=False))).observed


def in_company(flight):
    rows = np.vstack([BYSTANDER_COLUMNS, np.tile(BYSTANDER_COLUMNS[-1], (len(flight) - 5, 1))])
    return window_of(replace(flight, goal=GOAL, bystanders=rows))


def test_a_prompt_tells_the_goal_and_the_others_in_both_languages(flight, vocabulary):
    window = in_company(flight)
    prompts = user_prompts(window, measure_facts(window), vocabulary)
    assert "\nGoal: follow the woman in the red jacket.\nOther people in view: [0, 1, 2, 3, 3];" in prompts["en"]
    assert "\n任务：跟踪穿红色夹克的女子。\n" in prompts["zh"]
    numbers = [re.findall(r"\d+(?:\.\d+)?", text.rpartition("\n")[2]) for text in prompts.values()]
    assert numbers == [["0", "1", "2", "3", "3", "4.0", "3.5", "2.3", "2.5", "2", "1", "1", "1"]] * 2
    for text in prompts.values():  # pictures alone: the goal stays
        assert Prompt(system="", user=text).told("P", measured=False).user.count("\n") == 1


def test_without_other_people_a_prompt_is_as_it_was(flight, vocabulary):
    plain, alone = window_of(flight), window_of(replace(flight, goal=GOAL))
    told = [user_prompts(one, measure_facts(one), vocabulary) for one in (plain, alone)]
    assert told[0] == told[1]


def test_what_is_said_of_others_is_judged_by_the_geometry(flight):
    facts = measure_facts(in_company(flight))
    found = {name: look_up(parse_reference(name), facts) for name in ("others_in_view@t2", "other_distance@t3")}
    assert [(fact.value, fact.unit) for fact in found.values()] == [(2, "people"), (2.3, "m")]
    assert [look_up(parse_reference(f"alike_differences@t{i}"), facts).value for i in (1, 4)] == [2, 1]
    assert look_up(parse_reference("other_distance@t0"), facts) == "unknown_fact"


def test_slots_of_other_people_are_filled(flight, vocabulary):
    facts, slots = measure_facts(in_company(flight)), FORMATS["slots"]
    text = "In view are {others_in_view}, the nearest {other_distance} away, with {alike_differences} that differ."
    draft = slots.read(Coc(critical_components=text, reasoning_trace="So be it.", flight_decision="hover"), facts)
    assert draft.coc.critical_components == (
        "In view are 3 other people, the nearest 2.5 m away, with 1 of the items of appearance that differ."
    )
    assert "{others_in_view} 3 other people" in slots.table(facts)
