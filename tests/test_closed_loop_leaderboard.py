"""The leaderboard: one table for one list of episodes, gains of rounds, correlation, and a page that escapes."""

import json

import numpy as np
import pytest
from commands import invoke
from scipy.stats import kendalltau, spearmanr
from test_closed_loop_measures import flight

from cosfly.closed_loop.leaderboard import LEAST_CHECKPOINTS
from cosfly.closed_loop.measures import score_pursuits
from cosfly.products.flight_scores import SCORE, SCORE_FORMAT
from cosfly.products.pursuits import pursuit_file, write_pursuit
from cosfly.work.store import write_model

GOOD, BAD = "1111111111", "1111100000"


def folder(root, name, seen, *, student=None, **columns):
    """What `cosfly fly` writes of a student, whose flights show the person as `seen` says."""
    flights = [flight(one, walk=f"path_{k}", **columns) for k, one in enumerate(seen)]
    flights = [one.model_copy(update={"student": student or name}) for one in flights]
    for one in flights:
        write_pursuit(pursuit_file(root / name, one.episode), one)
    write_model(root / name / SCORE, score_pursuits(flights), SCORE_FORMAT)
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
    assert page.count("<polyline") >= 2 * 2 + 3 * 3  # two curves of two students, three walks with both flights


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


def test_open_loop_is_correlated_from_enough_checkpoints_on_and_not_below(tmp_path):
    rng = np.random.default_rng(0)
    told, words = {}, []
    for k in range(LEAST_CHECKPOINTS):
        told[f"c{k}"] = k / 10
        seen = ["1" * n + "0" * (12 - n) for n in np.clip(k + rng.integers(0, 6, size=4), 1, 12)]
        words += [folder(tmp_path, f"c{k}", seen), "--open-loop", f"c{k}={told[f'c{k}']}"]
    (table,), _ = board(tmp_path / "out", *words)
    found = {one["figure"]: one for one in table["correlations"]}["in_view"]
    values = {one["name"]: one["score"]["figures"]["in_view"]["value"] for one in table["standings"]}
    x, y = [told[name] for name in values], list(values.values())
    assert found["spearman"]["value"] == pytest.approx(spearmanr(x, y).statistic)
    assert found["kendall"]["value"] == pytest.approx(kendalltau(x, y).statistic)
    assert found["spearman"]["low"] <= found["spearman"]["value"] <= found["spearman"]["high"]
    (table,), page = board(tmp_path / "few", *words[:-3])
    assert {one["spearman"]["value"] for one in table["correlations"]} == {None}
    assert "no claim" in page
