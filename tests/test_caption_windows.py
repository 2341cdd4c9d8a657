"""Windows, facts and pictures; above all: nothing of the future reaches a request. Missions.

Prompts: the state of a window in both languages, goals and other people, and prompts of the user's own.
"""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import invoke, obeyed
from specimens_release import all_bytes
from teacher_server import TeacherServer

from caption.answer_formats.formats import FORMATS, Draft
from caption.schema import CaptionConfig, ImageConfig, ObservedWindow, WindowConfig, observed_frames
from caption.stage.stage import run
from caption.stage.windows import current_frames, cut_future, cut_windows, recorded_motion
from caption.teachers.prompt_files import (
    PROMPTS,
    export_prompts,
    own_prompts,
    shipped_prompts,
    vocabulary_of,
)
from caption.teachers.prompts import make_question, user_prompts
from caption.verification.actions import TABLE, measure
from caption.verification.facts import measure_facts
from caption.verification.references import look_up, parse_reference
from cosfly.formats.captions import OWN_PROMPTS, PICTURES_MARK, Coc, Prompt, read_captions
from cosfly.formats.people import Goal
from cosfly.formats.playback_file import read_track, write_track
from cosfly.formats.segments import Mission
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.geometry.axes import look_at
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.errors import ConfigError, ResumeError
from specimens import make_flight, make_playback_tree

RELATIVE, PAPER = vocabulary_of(CaptionConfig()), vocabulary_of(CaptionConfig(text_state="paper"))
NO_IMAGES = WindowConfig(require_images=False)


def flight_in(root):
    return read_track(find_tracks(root)[0])


@pytest.mark.parametrize(
    ("num_points", "stride", "expected"),
    [(9, 1, []), (10, 1, [4]), (12, 1, [4, 5, 6]), (20, 5, [4, 9, 14]), (0, 1, [])],
)
def test_current_frames_have_a_whole_past_and_future(num_points, stride, expected):
    assert list(current_frames(num_points, WindowConfig(stride=stride))) == expected


def spoil_future(root, current: int) -> None:
    folder = find_tracks(root)[0]
    flight = read_track(folder)
    rng = np.random.default_rng(1)
    later = np.arange(len(flight)) > current

    def spoiled(record, *names):
        columns = {name: getattr(record, name).copy() for name in names}
        for values in columns.values():
            is_flag = values.dtype == bool
            values[later] = ~values[later] if is_flag else rng.uniform(5.0, 30.0, values[later].shape)
        return dataclasses.replace(record, **columns)

    target = spoiled(flight.target, "uv", "bbox", "depth_m", "visibility", "in_view", "visible")
    flight = dataclasses.replace(flight, target=target)
    write_track(folder, spoiled(flight, "positions_m", "rotations_deg", "targets_m"))
    for i in np.flatnonzero(later):
        frame = flight.frame_folder(int(i))
        h, w = flight.camera.height_px, flight.camera.width_px
        cv2.imwrite(str(frame / "rgb.png"), rng.integers(0, 256, (h, w, 3), dtype=np.uint8))
        cv2.imwrite(str(frame / "instance.png"), rng.integers(0, 256, (h, w, 3), dtype=np.uint8))
        np.save(frame / "depth.npy", rng.uniform(1, 50, (h, w)).astype(np.float32))


def free_requests(root, out, limit: int, layout: str) -> list[bytes]:
    cfg = {"limit": limit, "repair": {"hard_conflict": "keep"}, "image": {"layout": layout}}
    with TeacherServer(decision=lambda body: "hover") as server:
        run(CaptionConfig.model_validate({"teacher": server.url, **cfg}), root, out)
    return sorted(server.bodies)


@pytest.mark.parametrize("layout", ["separate", "tiled"])
def test_changing_all_future_frames_leaves_requests_byte_identical(tree, tmp_path, layout):
    spoiled = tmp_path / "spoiled"
    shutil.copytree(tree, spoiled)
    spoil_future(spoiled, current=7)
    for limit, is_same in ((4, True), (5, False)):  # of the window that ends at 8 a frame that is observed was changed
        outs = {root: tmp_path / f"{root.name}_{limit}" for root in (tree, spoiled)}
        before, after = (free_requests(root, out, limit, layout) for root, out in outs.items())
        assert len(before) == 2 * limit  # English and Chinese
        assert (before == after) is is_same


def window_of(*columns: np.ndarray) -> ObservedWindow:
    """A window whose frames have these columns, and no pictures."""
    place = ("track_ORI_frame_00004", "Town", "track", "ORI", tuple(range(5)), 1280, 720)
    return ObservedWindow(*place, observed_frames(*columns), (Path("frame"),) * 5, (frozenset[str](),) * 5)


def test_facts_of_a_hand_made_window():
    x = np.arange(5.0)
    window = window_of(
        100.0 + 0.5 * x,
        np.stack([x, 0 * x, 20.0 - 0.5 * x], axis=1),  # 1 m forward, 0.5 m down per 0.5 s
        np.stack([0 * x - 30.0, np.array([178.0, 179.0, -180.0, -179.0, -178.0]), 0 * x], axis=1),
        np.stack([x + 15.0, 0 * x, 0 * x + 0.9], axis=1),
        np.full((5, 2), np.nan),
        np.tile([660.0, 340.0, 680.0, 400.0], (5, 1)),
        np.array([True, True, True, True, False]),
        np.array([True, True, True, False, False]),
        np.array([np.nan, 1.0, 0.5, 0.1, 0.0]),
    )
    facts = measure_facts(window)
    assert facts.speed_mps == (2.24, 2.24, 2.24, 2.24, 2.24)  # sqrt(1 + 0.25) / 0.5
    assert facts.altitude_m == (20.0, 19.5, 19.0, 18.5, 18.0)
    assert facts.yaw_deg == (0.0, 1.0, 2.0, 3.0, 4.0)  # across the seam at 180
    # What concerns the target is known where it is seen.
    assert (facts.distance_m, facts.target_speed_mps) == ((15.0,) * 3 + (None,) * 2, 2.0)
    assert (facts.target_turn_deg, facts.box_width_px[2], facts.box_height_px[2]) == (0.0, 20, 60)
    assert (facts.offset_x_px[2:], facts.offset_y_px[2:]) == ((30, None, None), (10, None, None))
    assert facts.visibility == ("visible", "visible", "partly_occluded", "occluded", "out_of_view")
    # Who is not hidden and cannot be made out is told as that; a tree that does not say so changes nothing.
    dim = dataclasses.replace(window, frames=tuple(dataclasses.replace(f, legible=False) for f in window.frames))
    words = ("illegible", "illegible", "illegible", "occluded", "out_of_view")
    assert measure_facts(dim) == dataclasses.replace(facts, visibility=words)
    told = make_question(dim, ImageConfig(), "prose", RELATIVE).prompts["en"].user
    assert "hard to make out, hard to make out, hard to make out, occluded, out of view\n" in told
    frames = tuple(dataclasses.replace(frame, time_s=0.5 * frame.time_s) for frame in window.frames)
    halved = dataclasses.replace(window, frames=frames)
    doubled = make_question(halved, ImageConfig(), "prose", RELATIVE).prompts
    assert "5 frames, 0.25 s apart," in doubled["en"].user
    assert "speed 4.47 m/s, at first 4.47\n" in doubled["en"].user


NUM_POINTS = 160


@pytest.fixture(scope="module")
def two_tracks(tmp_path_factory):
    """A clean flight and its perturbed twin, whose target is shifted too, on disk; the person is hidden at other times."""
    clean, perturbed = (make_flight(NUM_POINTS, seed=5, variant=variant)[0] for variant in ("ORI", "aug_001"))
    shifts_m = np.random.default_rng(3).uniform(-1.5, 1.5, (NUM_POINTS, 3))
    before, after = (look_at(perturbed.positions_m, perturbed.targets_m + at) for at in (0.0, shifts_m))
    aimed_deg = perturbed.rotations_deg + np.degrees([*np.subtract(after, before), np.zeros(NUM_POINTS)]).T
    hidden = np.isin(np.arange(NUM_POINTS), range(60, 66))
    perturbed = dataclasses.replace(
        perturbed, targets_m=perturbed.targets_m + shifts_m, rotations_deg=aimed_deg,
        perturbation=dataclasses.replace(perturbed.perturbation, target_m=shifts_m),
        target=dataclasses.replace(clean.target, visible=clean.target.visible & ~hidden),
    )  # fmt: skip
    root = tmp_path_factory.mktemp("two")
    for flight in (clean, perturbed):
        write_track(root / flight.town / flight.trajectory / flight.variant, flight)
    return root


def labels_of(windows) -> list[str | None]:
    return [TABLE.label_of(measure(window.future)) for window in windows]


@pytest.mark.parametrize("label_from", ["twin", "offsets"])
def test_both_tracks_have_the_same_labels_where_the_same_was_visible(two_tracks, label_from):
    clean, perturbed = map(read_track, find_tracks(two_tracks))
    twin = read_twin(perturbed) if label_from == "twin" else None
    expected = list(cut_windows(clean, NO_IMAGES))
    found = list(cut_windows(perturbed, NO_IMAGES, twin=twin))
    assert {w.future.label_from for w in expected} == {"flight"}
    assert {w.future.label_from for w in found} == {label_from}
    saw_the_same = [bool((a.future.visible == b.future.visible).all()) for a, b in zip(expected, found, strict=True)]
    pairs = list(zip(labels_of(expected), labels_of(found), saw_the_same, strict=True))
    assert len(pairs) == NUM_POINTS - 9
    assert all(before == after for before, after, same in pairs if same)
    # Hidden frames are those of the flight itself, so its labels say so.
    assert {after for before, after, same in pairs if not same and before != after} == {"search_to_reacquire_target"}
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(a.future.positions_m, b.future.positions_m, atol=1e-9)
        np.testing.assert_allclose(a.future.targets_m, b.future.targets_m, atol=1e-9)
        assert a.future.speed_before_mps == pytest.approx(b.future.speed_before_mps)
    # What is compared is not the same from the start: as flown, a good part of the labels is another.
    flown = recorded_motion(perturbed, "perturbed")
    raw = [TABLE.label_of(measure(cut_future(perturbed, flown, i, 5))) for i in range(4, NUM_POINTS - 5)]
    assert np.mean([a != b for (a, _, _), b in zip(pairs, raw, strict=True)]) > 0.2


MISSION = Mission("battery", 6, 11, (1.0, 2.0, 30.0))


@pytest.fixture(scope="module")
def ordered(tree, tmp_path_factory):
    root = tmp_path_factory.mktemp("ordered") / "tree"
    shutil.copytree(tree, root)
    write_track(find_tracks(root)[0], dataclasses.replace(flight_in(root), mission=MISSION))
    return root


def test_a_mission_gives_labels_and_is_known_from_its_first_frame_on(tree, ordered):
    windows = list(cut_windows(flight_in(ordered), NO_IMAGES))
    currents = [w.observed.indices[-1] for w in windows]
    assert currents == list(range(4, 9))
    plain = {w.observed.indices[-1]: TABLE.label_of(measure(w.future)) for w in cut_windows(flight_in(tree), NO_IMAGES)}
    for now, window in zip(currents, windows, strict=True):
        label, known = TABLE.label_of(measure(window.future)), window.observed.mission
        assert (label, known) == ((plain[now], None) if now < 6 else ("break_off", "battery"))


def test_no_label_comes_from_an_order_that_nobody_knows_yet(ordered):
    windows = list(cut_windows(flight_in(ordered), WindowConfig(require_images=False, future_frames=3)))
    problems = {w.observed.indices[-1]: w.problem for w in windows}
    assert problems == {now: "order_to_come" if now in (4, 5) else None for now in range(4, 11)}


def test_a_mission_reaches_no_request_before_its_order_stands(tree, ordered):
    def users(root):
        observed = [window.observed for window in cut_windows(flight_in(root), NO_IMAGES)]
        asked = [make_question(one, ImageConfig(), "slots", RELATIVE).asked for one in observed]
        return [(prompts["en"].user, prompts["zh"].user) for prompts in asked]

    plain, told = users(tree), users(ordered)
    assert plain[:2] == told[:2]
    for before, after in zip(plain[2:], told[2:], strict=True):
        assert after[0] == before[0] + "\nMission: the battery is down to the reserve for the way home."
        assert after[1] == before[1] + "\n任务状态：电池电量已降至返航储备。"


def make_window(hidden: tuple[bool, ...] = (False,) * 5, turn_deg: float = 0.0) -> ObservedWindow:
    """A drone that flies along +y at 1 m/s, 19.1 m above the hip of a pedestrian who walks along -x at 2 m/s."""
    x = np.arange(5.0)
    flags = np.array(hidden)
    return window_of(
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
    assert all_bytes(out / OWN_PROMPTS) == all_bytes(mine)
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
def in_company(tree):
    """A window of a flight after a described person among others."""
    flight = flight_in(tree)
    rows = np.vstack([BYSTANDER_COLUMNS, np.tile(BYSTANDER_COLUMNS[-1], (len(flight) - 5, 1))])
    return next(cut_windows(dataclasses.replace(flight, goal=GOAL, bystanders=rows), NO_IMAGES)).observed


def test_a_track_that_jitters_has_one_velocity(in_company):
    frames = [dataclasses.replace(f, position_m=(0.0, 0.0, 20.0 + i % 2)) for i, f in enumerate(in_company.frames)]
    facts = measure_facts(dataclasses.replace(in_company, frames=tuple(frames)))
    assert (facts.speed_mps, facts.climb_mps) == ((None, None, None, None, 0.0),) * 2


def test_a_prompt_tells_the_goal_and_the_others_in_both_languages(in_company):
    prompts = user_prompts(in_company, measure_facts(in_company), RELATIVE)
    assert "\nGoal: follow the woman in the red jacket.\nOther people in view: [0, 1, 2, 3, 3];" in prompts["en"]
    assert "\n任务：跟踪穿红色夹克的女子。\n" in prompts["zh"]
    numbers = [re.findall(r"\d+(?:\.\d+)?", text.rpartition("\n")[2]) for text in prompts.values()]
    assert numbers == [["0", "1", "2", "3", "3", "4.0", "3.5", "2.3", "2.5", "2", "1", "1", "1"]] * 2
    for text in prompts.values():  # pictures alone: the goal stays
        assert Prompt(system="", user=text).filled("P", measured=False).user.count("\n") == 1


def test_what_is_said_of_others_is_judged_by_the_geometry(in_company):
    facts = measure_facts(in_company)
    found = {name: look_up(parse_reference(name), facts) for name in ("others_in_view@t2", "other_distance@t3")}
    assert [(fact.value, fact.unit) for fact in found.values()] == [(2, "people"), (2.3, "m")]
    assert [look_up(parse_reference(f"alike_differences@t{i}"), facts).value for i in (1, 4)] == [2, 1]
    assert look_up(parse_reference("other_distance@t0"), facts) == "unknown_fact"


def test_slots_of_other_people_are_filled(in_company):
    facts, slots = measure_facts(in_company), FORMATS["slots"]
    text = "In view are {others_in_view}, the nearest {other_distance} away, with {alike_differences} that differ."
    draft = slots.read(Coc(critical_components=text, reasoning_trace="So be it.", flight_decision="hover"), facts)
    assert draft.coc.critical_components == (
        "In view are 3 other people, the nearest 2.5 m away, with 1 of the items of appearance that differ."
    )
    assert "{others_in_view} 3 other people" in slots.table(facts)
