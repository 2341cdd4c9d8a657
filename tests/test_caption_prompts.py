"""Prompts: the state of a window in both languages, goals and other people, and prompts of the user's own."""

import dataclasses
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import invoke, obeyed

from caption.answer_formats.formats import FORMATS, Draft
from caption.schema import CaptionConfig, ObservedWindow, WindowConfig, observed_frames
from caption.stage.stage import run
from caption.stage.windows import cut_windows
from caption.teachers.prompt_files import (
    PROMPTS,
    export_prompts,
    own_prompts,
    shipped_prompts,
    vocabulary_of,
)
from caption.teachers.prompts import user_prompts
from caption.verification.facts import measure_facts
from caption.verification.references import look_up, parse_reference
from cosfly.formats.captions import OWN_PROMPTS, PICTURES_MARK, Coc, Prompt, read_captions
from cosfly.formats.people import Goal
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.errors import ConfigError, ResumeError
from specimens import make_playback_tree

RELATIVE, PAPER = vocabulary_of(CaptionConfig()), vocabulary_of(CaptionConfig(text_state="paper"))


def make_window(hidden: tuple[bool, ...] = (False,) * 5, turn_deg: float = 0.0) -> ObservedWindow:
    """A drone that flies along +y at 1 m/s, 19.1 m above the hip of a pedestrian who walks along -x at 2 m/s."""
    x = np.arange(5.0)
    flags = np.array(hidden)
    frames = observed_frames(
        0.5 * x,
        np.stack([0 * x + 100.0, 0.5 * x, 0 * x + 20.0], axis=1),
        np.stack([0 * x - 45.0, 90.0 + turn_deg * x, 0 * x], axis=1),
        np.stack([102.0 - x, 0 * x + 20.0, 0 * x + 0.9], axis=1),
        np.full((5, 2), np.nan),
        np.stack([650.0 + 10 * x, 320.0 - 2.5 * x, 670.0 + 10 * x, 380.0 + 2.5 * x], axis=1),
        np.ones(5, bool),
        ~flags,
        np.where(flags, 0.0, 1.0),
    )
    folders = (Path("frame"),) * 5
    place = ("track_ORI_frame_00004", "Town", "track", "ORI", tuple(range(5)), 1280, 720)
    return ObservedWindow(*place, frames, folders, (frozenset[str](),) * 5)


def lines_of(window: ObservedWindow, vocabulary=RELATIVE, language="en") -> list[str]:
    return user_prompts(window, measure_facts(window), vocabulary)[language].splitlines()


def test_the_relative_state_by_hand():
    assert lines_of(make_window()) == [
        f"5 frames, 0.5 s apart, oldest first. {PICTURES_MARK}",
        "Target: visible in all frames",
        "Turn: left 0.0 deg/s, left 0.0 deg since the first frame",
        "Drone velocity: forward 1.00, left 0.00, up 0.00 m/s; speed 1.00 m/s, at first 1.00",
        "Altitude: 20.0 m, higher by 0.0 m",
        "Target velocity: forward 0.00, left 2.00 m/s; speed 2.00 m/s, at first 2.00",
        "Target place: forward 18.0, left 2.0, down 19.1 m",
        "Horizontal distance: 18.1 m, nearer by 2.0 m",
        "Target bearing: left 6.3 deg, at first right 5.7",
        "Target in the image: right 60, up 10 px from the centre; box larger by 33 %",
    ]


def test_both_languages_state_the_same_numbers():
    for hidden in ((False,) * 5, (True, False, False, True, False), (False, False, False, False, True), (True,) * 5):
        for vocabulary in (RELATIVE, PAPER):
            told = [lines_of(make_window(hidden), vocabulary, language) for language in ("en", "zh")]
            numbers = [
                [re.findall(r"(?<![a-zA-Z])[+-]?\d[\d.]*\d|(?<![a-zA-Z])[+-]?\d", line) for line in lines]
                for lines in told
            ]
            assert numbers[0][1:] == numbers[1][1:]
            assert sorted(numbers[0][0]) == sorted(numbers[1][0]) == ["0.5", "5"]


def test_nothing_is_stated_of_a_hidden_target():
    lines = lines_of(make_window((True, False, False, False, True)))
    assert lines[1] == "Target: occluded, visible, visible, visible, occluded"
    assert lines[5].endswith("; speed unknown m/s, at first unknown")
    assert lines[6] == "Target place: unknown, unknown, unknown m"
    assert lines[7] == "Horizontal distance: unknown m, unknown m"
    late = lines_of(make_window((True, False, False, False, False)))
    assert late[7] == "Horizontal distance: 18.1 m, nearer by 1.4 m"
    assert late[8] == "Target bearing: left 6.3 deg, at first unknown"
    once = lines_of(make_window((True, True, True, True, False)))
    assert once[7] == "Horizontal distance: 18.1 m, unknown m"
    assert lines_of(make_window((True,) * 5))[1] == "Target: occluded in all frames"
    paper = lines_of(make_window((True, False, False, True, True)), PAPER)
    assert paper[4] == "Target ground speed: 2.00 m/s."
    assert paper[7].endswith(": unknown; (101.00, 20.00, 0.90); (100.00, 20.00, 0.90); unknown; unknown.")


def test_the_relative_state_does_not_depend_on_the_place_in_the_world():
    window = make_window()
    turned = dataclasses.replace(window, frames=tuple(
        dataclasses.replace(
            frame, position_m=(-frame.position_m[1] + 7.0, frame.position_m[0] - 9.0, frame.position_m[2]),
            target_m=(-frame.target_m[1] + 7.0, frame.target_m[0] - 9.0, frame.target_m[2]),
            rotation_deg=(frame.rotation_deg[0], frame.rotation_deg[1] + 90.0, frame.rotation_deg[2]),
        )
        for frame in window.frames
    ))  # fmt: skip
    assert lines_of(turned) == lines_of(window)
    assert lines_of(turned, PAPER) != lines_of(window, PAPER)


def test_the_papers_state():
    lines = lines_of(make_window(), PAPER)
    assert lines[1] == "Velocity: [0.0, 1.00, 1.00, 1.00, 1.00] m/s (the first frame has no earlier one and reads 0.0)."
    assert lines[2] == "Altitude: [20.0, 20.0, 20.0, 20.0, 20.0] m."
    assert lines[4] == "Target ground speed: 2.00 m/s."
    assert lines[6].partition(": ")[2].startswith("(100.00, 0.00, 20.00; -45.0, 90.0, 0.0); (100.00, 0.50,")


def test_the_example_of_the_slots_prompt_is_accepted():
    slots = FORMATS["slots"]
    [example] = [line for line in RELATIVE.templates[slots.system].template.splitlines() if line.startswith('{"')]
    answer = parse_answer(example, more=("therefore",))
    draft = slots.read(answer.coc, measure_facts(make_window(turn_deg=1.0)))
    assert isinstance(draft, Draft), draft
    assert "now 18.1 m" in draft.coc.reasoning_trace
    assert draft.num_filled == 7


OWN_LINE = "Costs $$5 & 100 %: you speak as a coast guard."


def export(folder: Path) -> Path:
    export_prompts(folder, shipped_prompts())
    return folder


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_what_is_exported_is_what_ships(tmp_path):
    folder = tmp_path / "mine"
    obeyed("caption prompts --export", folder)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == {p.name: p.read_bytes() for p in PROMPTS.glob("*.txt")}
    obeyed("caption prompts --check", folder)
    (folder / "user_zh.txt").unlink()  # as after a kill
    obeyed("caption prompts --export", folder)
    for name in ("user_en", "system_zh"):
        edit(folder / f"{name}.txt", "the" if name == "user_en" else "无人机", "2")
    (folder / "user_zh.txt").unlink()
    again = invoke("caption prompts --export", folder)
    assert not (folder / "user_zh.txt").exists()
    assert isinstance(again.exception, ConfigError)
    assert "got system_zh.txt, user_en.txt" in str(again.exception)


def test_all_problems_are_told_at_once(tmp_path, caplog):
    folder = export(tmp_path / "mine")
    (folder / "hint_en.txt").unlink()
    (folder / "hints_en.txt").write_text("# version: 1\nx\n")
    (folder / "system_en.txt").write_bytes(b"\xff\xfe")
    (folder / "mirror_user.txt").write_text("# version: 1\n\n")
    with pytest.raises(ConfigError, match="5 to fix"):
        own_prompts(folder)
    told = "\n".join(record.message for record in caplog.records)
    assert "hints_en.txt: no prompt has this name (did you mean 'hint_en'?)" in told
    assert "hint_en.txt: the prompt is missing; copy it from the exported prompts" in told
    assert "system_en.txt" in told
    assert "mirror_user.txt:2: the prompt is empty" in told
    with pytest.raises(ConfigError, match="the folder of prompts does not exist"):
        own_prompts(tmp_path / "nowhere")


@pytest.mark.slow
def test_captions_are_asked_with_them_and_keep_them(tmp_path):
    """Another system text and another order of lines, which say the same things."""
    mine, tree, out = export(tmp_path / "mine"), make_playback_tree(tmp_path / "tree", 3, 14), tmp_path / "out"
    for name in ("system_en", "system_zh", "system_slots_en", "system_prose_en"):
        with (mine / f"{name}.txt").open("a", encoding="utf-8") as file:
            file.write(OWN_LINE + "\n")
    edit(mine / "user_en.txt", "Altitude: $altitude m", "HEIGHT ${altitude} m 100 % $$1")
    product = run(CaptionConfig(prompts=mine), tree, out, workers=2)
    for caption in read_captions(product):
        assert caption.prompt["en"].system.endswith(OWN_LINE.replace("$$", "$"))
        assert caption.prompt["zh"].system.endswith(OWN_LINE.replace("$$", "$"))
        [line] = [line for line in caption.prompt["en"].user.splitlines() if line.startswith("HEIGHT ")]
        assert " m 100 % $1, " in line
    assert {p.name: p.read_bytes() for p in (out / OWN_PROMPTS).iterdir()} == {
        p.name: p.read_bytes() for p in mine.iterdir()
    }
    listed = {entry["path"] for entry in json.loads((out / "manifest.json").read_text())["outputs"]}
    assert {f"{OWN_PROMPTS}/{p.name}" for p in mine.iterdir()} <= listed
    with pytest.raises(ResumeError, match="prompts"):
        run(CaptionConfig(), tree, out)
    edit(mine / "hint_en.txt", "Hint:", "A hint:")
    with pytest.raises(ResumeError, match="prompts"):
        run(CaptionConfig(prompts=mine), tree, out)


GOAL = Goal(0, "the woman in the red jacket", "穿红色夹克的女子", ("figure", "top"))
BYSTANDER_COLUMNS = np.array(
    [[0, np.nan, np.nan, np.nan, np.nan], [1, 4.04, 9, 9, 2], [2, 3.5, 9, 8, 1], [3, 2.26, 7, 8, 1], [3, 2.5, 7, 8, 1]]
)


@pytest.fixture(scope="module")
def flight(tree):
    return read_track(find_tracks(tree)[0])


def window_of(flight):
    return next(cut_windows(flight, WindowConfig(require_images=False))).observed


def in_company(flight):
    rows = np.vstack([BYSTANDER_COLUMNS, np.tile(BYSTANDER_COLUMNS[-1], (len(flight) - 5, 1))])
    return window_of(replace(flight, goal=GOAL, bystanders=rows))


def test_a_prompt_tells_the_goal_and_the_others_in_both_languages(flight):
    window = in_company(flight)
    prompts = user_prompts(window, measure_facts(window), RELATIVE)
    assert "\nGoal: follow the woman in the red jacket.\nOther people in view: [0, 1, 2, 3, 3];" in prompts["en"]
    assert "\n任务：跟踪穿红色夹克的女子。\n" in prompts["zh"]
    numbers = [re.findall(r"\d+(?:\.\d+)?", text.rpartition("\n")[2]) for text in prompts.values()]
    assert numbers == [["0", "1", "2", "3", "3", "4.0", "3.5", "2.3", "2.5", "2", "1", "1", "1"]] * 2
    for text in prompts.values():  # pictures alone: the goal stays
        assert Prompt(system="", user=text).filled("P", measured=False).user.count("\n") == 1


def test_what_is_said_of_others_is_judged_by_the_geometry(flight):
    facts = measure_facts(in_company(flight))
    found = {name: look_up(parse_reference(name), facts) for name in ("others_in_view@t2", "other_distance@t3")}
    assert [(fact.value, fact.unit) for fact in found.values()] == [(2, "people"), (2.3, "m")]
    assert [look_up(parse_reference(f"alike_differences@t{i}"), facts).value for i in (1, 4)] == [2, 1]
    assert look_up(parse_reference("other_distance@t0"), facts) == "unknown_fact"


def test_slots_of_other_people_are_filled(flight):
    facts, slots = measure_facts(in_company(flight)), FORMATS["slots"]
    text = "In view are {others_in_view}, the nearest {other_distance} away, with {alike_differences} that differ."
    draft = slots.read(Coc(critical_components=text, reasoning_trace="So be it.", flight_decision="hover"), facts)
    assert draft.coc.critical_components == (
        "In view are 3 other people, the nearest 2.5 m away, with 1 of the items of appearance that differ."
    )
    assert "{others_in_view} 3 other people" in slots.table(facts)
