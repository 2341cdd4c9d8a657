"""The record of one flown flight: written as read, and refused where it cannot have been flown."""

import json

import pytest
from tables import each

from cosfly.formats.episodes import Episode, EpisodeFrame, PathDifficulty, episode_file, read_episode, write_episode
from cosfly.runtime.errors import InputError


def frame(time_s: float, answer: str, **more) -> EpisodeFrame:
    told = {"answer": answer, "in_view": True, "visible": True, "visibility": 0.9, "num_pixels": 40}
    told |= {"distance_m": 20.0, "height_m": 20.0, "clearance_m": 12.0, "speed_mps": 1.2}
    told |= {"pose": (0, 0, 20, -43, 0, 0), "target_m": (20, 0, 0.9)}
    told["command"] = None if answer == "end" else (1.2, 0.0, 0.0, 0.0, -43.0)
    return EpisodeFrame(time_s=time_s, **told | more)


def record(answers=("lead", "lead", "ok", "late", "end"), **more) -> Episode:
    frames = tuple(frame(0.5 * i, answer) for i, answer in enumerate(answers))
    told = {"student": "rules-7", "engine": "rules", "town": "Town_7", "map_sha256": "ab" * 32, "walk": "path_00000"}
    told |= {"seed": 7, "dt_s": 0.5, "camera_px": (640, 360), "fov_deg": 90.0, "drone_radius_m": 0.5}
    style = PathDifficulty(pace="walk", turn_degps=2.0, hidden_share=0.1)
    told |= {"episode": "path_00000", "style": style, "ended": "lost", "num_walk_frames": 9, "frames": frames}
    return Episode(**told | more)


def test_a_record_is_read_as_it_was_written_and_tells_lead_and_decisions_apart(tmp_path):
    path = episode_file(tmp_path, "path_00000")
    write_episode(path, record())
    found = read_episode(path)
    assert found == record()
    assert (found.num_lead, [f.answer for f in found.decisions]) == (2, ["ok", "late"])
    assert [f.time_s for f in found.flown] == [1.5, 2.0]  # what came of the two decisions


@each(("change", "words"), [
    ({"frames": [{"time_s": 0.5}]}, "missing|required"),
    ({"ended": "tired"}, "finished"),
    ({"num_walk_frames": 1}, "2 frames follow the first decision"),
    ({"colour": "red"}, "[Ee]xtra"),
])  # fmt: skip
def test_a_record_that_cannot_be_is_refused(tmp_path, change, words):
    path = tmp_path / "one.json"
    write_episode(path, record())
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=words):
        read_episode(path)


def test_answers_come_in_order_and_only_the_last_frame_has_no_command():
    for answers in (("ok", "lead", "end"), ("ok", "end", "end"), ("lead", "ok"), ("lead", "lead")):
        with pytest.raises(ValueError, match="lead"):
            record(answers)
    with pytest.raises(ValueError, match="command"):
        record(frames=(frame(0, "ok", command=None), frame(0.5, "end")))
