"""Orders of a mission in captions: they give labels, and a teacher is told of them from the frame on at which the drone
knows."""

import dataclasses
import shutil

import pytest

from caption.run.stage import run
from caption.run.windows import cut_windows
from caption.schema import CaptionConfig, ImageConfig, LabelConfig, WindowConfig
from caption.teachers.prompts import make_question
from caption.truth.actions import label_of, measure
from cosfly.products.captions import read_captions
from cosfly.products.flights import find_flights
from cosfly.products.playback import read_flight, write_flight
from cosfly.products.segments import Mission
from specimens import make_playback_tree

NO_IMAGES = WindowConfig(require_images=False)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 1, 16, seed=4, with_augmented=False)


def flight_in(root):
    return read_flight(find_flights(root)[0], strict=False)


MISSION = Mission("battery", 8, 12, (1.0, 2.0, 30.0))


@pytest.fixture(scope="module")
def ordered(tree, tmp_path_factory):
    """The same flight with a mission that ends its pursuit at frame 8."""
    root = tmp_path_factory.mktemp("ordered") / "tree"
    shutil.copytree(tree, root)
    write_flight(find_flights(root)[0], dataclasses.replace(flight_in(root), mission=MISSION))
    return root


def test_a_mission_gives_labels_and_is_known_from_its_first_frame_on(tree, ordered):
    windows = list(cut_windows(flight_in(ordered), NO_IMAGES))
    currents = [w.observed.indices[-1] for w in windows]
    assert currents == list(range(4, 11))
    plain = {
        w.observed.indices[-1]: label_of(measure(w.future), LabelConfig())
        for w in cut_windows(flight_in(tree), NO_IMAGES)
    }
    for now, window in zip(currents, windows, strict=True):
        label, known = label_of(measure(window.future), LabelConfig()), window.observed.mission
        assert (label, known) == ((plain[now], None) if now < 8 else ("break_off", "battery"))


def test_no_label_comes_from_an_order_that_nobody_knows_yet(ordered):
    """The turn for home, seen from before the order, would be a turn after the walker."""
    windows = list(cut_windows(flight_in(ordered), WindowConfig(require_images=False, future_frames=3)))
    problems = {w.observed.indices[-1]: w.problem for w in windows}
    assert problems == {now: "order_to_come" if now in (5, 6, 7) else None for now in range(4, 13)}


def test_a_mission_reaches_no_request_before_its_order_stands(tree, ordered):
    def users(root):
        asked = [
            make_question(w.observed, ImageConfig(), "slots").asked for w in cut_windows(flight_in(root), NO_IMAGES)
        ]
        return [(prompts["en"].user, prompts["zh"].user) for prompts in asked]

    plain, told = users(tree), users(ordered)
    assert plain[:4] == told[:4]
    for before, after in zip(plain[4:], told[4:], strict=True):
        assert after[0] == before[0] + "\nMission: the battery is down to the reserve for the way home."
        assert after[1] == before[1] + "\n任务状态：电池电量已降至返航储备。"


def test_the_rule_teacher_obeys_an_order(ordered, tmp_path):
    product = run(CaptionConfig(window=NO_IMAGES), ordered, tmp_path / "out")
    late = [c for c in read_captions(product) if c.sample_id[-2:] in ("08", "09", "10")]
    assert len(late) == 3
    for caption in late:
        assert caption.label == caption.en.flight_decision == "break_off"
        assert "reserve for the way home" in caption.en.reasoning_trace
