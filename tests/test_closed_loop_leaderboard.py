"""The leaderboard: one table for one list of episodes, gains of rounds, and a page that escapes."""

import json

from commands import invoke
from test_closed_loop_measures import flight

from cosfly.closed_loop.measures import score_episodes
from cosfly.formats.episodes import SCORE, SCORE_FORMAT, episode_file, write_episode
from cosfly.runtime.json_io import write_model

GOOD, BAD = "1111111111", "1111100000"


def folder(root, name, seen, *, student=None, **columns):
    flights = [flight(one, walk=f"path_{k}", **columns) for k, one in enumerate(seen)]
    flights = [one.model_copy(update={"student": student or name}) for one in flights]
    for one in flights:
        write_episode(episode_file(root / name, one.episode), one)
    write_model(root / name / SCORE, score_episodes(flights), SCORE_FORMAT)
    return root / name


def board(out, *words):
    done = invoke(f"leaderboard {' '.join(map(str, words))} --out {out}")
    assert done.exit_code == 0, (done.output, done.exception)
    return json.loads((out / "leaderboard.json").read_text())["tables"], (out / "leaderboard.html").read_text()


def test_the_best_is_first_and_foreign_words_are_escaped(tmp_path):
    worse = folder(tmp_path, "worse", [GOOD, BAD, BAD], words=["<script>alert(1)</script>"] * 9)
    better = folder(tmp_path, "better", [GOOD, GOOD, BAD])
    (table,), page = board(tmp_path / "out", worse, better)
    assert [one["name"] for one in table["standings"]] == ["better", "worse"]
    assert [one["score"]["figures"]["success"]["value"] for one in table["standings"]] == [2 / 3, 1 / 3]
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_other_episodes_are_another_table_and_two_folders_of_one_student_are_put_together(tmp_path):
    one = folder(tmp_path, "one", [GOOD, BAD], student="s")
    other = folder(tmp_path, "other", [GOOD, BAD, GOOD], student="s")
    third = folder(tmp_path, "third", [GOOD, BAD, GOOD])
    tables, page = board(tmp_path / "a", f"x={one}", f"y={other}", third)
    assert [len(table["standings"]) for table in tables] == [1, 2]
    assert "different lists of episodes" in page
    for same in (one, other):  # all of its episodes, or some
        done = invoke(f"leaderboard {one} s={same} --out {tmp_path / 'b'}")
        assert "NAME=DIR" in str(done.exception)
