"""Windows, facts, prompts and pictures; above all: nothing of the future reaches a request. Missions."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
from specimens_captions import VOCABULARY
from teacher_server import TeacherServer

from caption.schema import CaptionConfig, ImageConfig, WindowConfig, observed_frames
from caption.stage.stage import run
from caption.stage.windows import current_frames, cut_future, cut_windows, recorded_motion
from caption.teachers.prompts import make_question
from caption.verification.actions import TABLE, measure
from caption.verification.facts import measure_facts
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track, write_track
from cosfly.formats.segments import Mission
from cosfly.formats.tracks import find_tracks, read_twin
from cosfly.geometry.axes import look_at
from specimens import make_flight, make_playback_tree

NO_IMAGES = WindowConfig(require_images=False)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 1, 16, seed=4, with_augmented=False)


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
        before, after = (
            free_requests(root, tmp_path / f"{root.name}_{limit}", limit, layout) for root in (tree, spoiled)
        )
        assert len(before) == 2 * limit  # English and Chinese
        assert (before == after) is is_same


def test_facts_of_a_hand_made_window(tree):
    window = next(cut_windows(flight_in(tree), WindowConfig())).observed
    x = np.arange(5.0)
    window = dataclasses.replace(
        window,
        width_px=640,
        height_px=360,
        frames=observed_frames(
            100.0 + 0.5 * x,
            np.stack([x, 0 * x, 20.0 - 0.5 * x], axis=1),  # 1 m forward, 0.5 m down per 0.5 s
            np.stack([0 * x - 30.0, np.array([178.0, 179.0, -180.0, -179.0, -178.0]), 0 * x], axis=1),
            np.stack([x + 15.0, 0 * x, 0 * x + 0.9], axis=1),
            np.full((5, 2), np.nan),
            np.tile([340.0, 160.0, 360.0, 220.0], (5, 1)),
            np.array([True, True, True, True, False]),
            np.array([True, True, True, False, False]),
            np.array([np.nan, 1.0, 0.5, 0.1, 0.0]),
        ),
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
    told = make_question(dim, ImageConfig(), "prose", VOCABULARY).prompts["en"].user
    assert "hard to make out, hard to make out, hard to make out, occluded, out of view\n" in told
    frames = tuple(dataclasses.replace(frame, time_s=0.5 * frame.time_s) for frame in window.frames)
    halved = dataclasses.replace(window, frames=frames)
    doubled = make_question(halved, ImageConfig(), "prose", VOCABULARY).prompts
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


def flights_of(root) -> tuple[Track, Track]:
    clean, perturbed = (read_track(folder) for folder in find_tracks(root))
    return clean, perturbed


def labels_of(windows) -> list[str | None]:
    return [TABLE.label_of(measure(window.future)) for window in windows]


@pytest.mark.parametrize("label_from", ["twin", "offsets"])
def test_both_tracks_have_the_same_labels_where_the_same_was_visible(two_tracks, label_from):
    clean, perturbed = flights_of(two_tracks)
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


MISSION = Mission("battery", 8, 12, (1.0, 2.0, 30.0))


@pytest.fixture(scope="module")
def ordered(tree, tmp_path_factory):
    root = tmp_path_factory.mktemp("ordered") / "tree"
    shutil.copytree(tree, root)
    write_track(find_tracks(root)[0], dataclasses.replace(flight_in(root), mission=MISSION))
    return root


def test_a_mission_gives_labels_and_is_known_from_its_first_frame_on(tree, ordered):
    windows = list(cut_windows(flight_in(ordered), NO_IMAGES))
    currents = [w.observed.indices[-1] for w in windows]
    assert currents == list(range(4, 11))
    plain = {w.observed.indices[-1]: TABLE.label_of(measure(w.future)) for w in cut_windows(flight_in(tree), NO_IMAGES)}
    for now, window in zip(currents, windows, strict=True):
        label, known = TABLE.label_of(measure(window.future)), window.observed.mission
        assert (label, known) == ((plain[now], None) if now < 8 else ("break_off", "battery"))


def test_no_label_comes_from_an_order_that_nobody_knows_yet(ordered):
    windows = list(cut_windows(flight_in(ordered), WindowConfig(require_images=False, future_frames=3)))
    problems = {w.observed.indices[-1]: w.problem for w in windows}
    assert problems == {now: "order_to_come" if now in (5, 6, 7) else None for now in range(4, 13)}


def test_a_mission_reaches_no_request_before_its_order_stands(tree, ordered):
    def users(root):
        asked = [
            make_question(w.observed, ImageConfig(), "slots", VOCABULARY).asked
            for w in cut_windows(flight_in(root), NO_IMAGES)
        ]
        return [(prompts["en"].user, prompts["zh"].user) for prompts in asked]

    plain, told = users(tree), users(ordered)
    assert plain[:4] == told[:4]
    for before, after in zip(plain[4:], told[4:], strict=True):
        assert after[0] == before[0] + "\nMission: the battery is down to the reserve for the way home."
        assert after[1] == before[1] + "\n任务状态：电池电量已降至返航储备。"
