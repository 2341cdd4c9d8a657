"""Several servers behind one teacher, each a real process: which is asked, and what becomes of a run when one dies."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from contextlib import ExitStack

import pytest
from specimens_captions import VOCABULARY, deciding, settings
from teacher_process import command, journaled, running
from teacher_server import MODEL, kept_answers

from caption.run.stage import run
from caption.schema import CaptionConfig
from caption.teachers.doctor import examine_endpoint
from cosfly.chat.protocol import split_urls
from cosfly.chat.throttle import Throttle
from cosfly.errors import ConfigError, TeacherError
from cosfly.products.captions import read_captions
from specimens import make_playback_tree

PATIENT = {"max_tries": 6, "backoff_s": 0.1, "max_backoff_s": 0.5, "concurrency": 4}


def asking(*urls: str, **changes) -> CaptionConfig:
    return settings(",".join(urls), endpoint=PATIENT | changes.pop("endpoint", {}), **changes)


def test_a_list_of_addresses():
    assert split_urls("http://a:1, http://b:2/v1") == ["http://a:1", "http://b:2/v1"]
    for text, words in (("http://a,http://a/v1", "twice"), ("http://a,", "begin with"), ("http://a,ftp://b", "begin")):
        with pytest.raises(ValueError, match=words):
            split_urls(text)


def test_one_of_three_dies_and_comes_back_in_the_middle_of_a_run(tree, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    forest = make_playback_tree(tmp_path / "tree", 2, 70, with_augmented=False)
    journal = tmp_path / "journal"
    words = [command(MODEL, "--delay", 0.1, "--journal", journal) for _ in range(3)]
    with ExitStack() as stack:
        servers = [stack.enter_context(running(one)) for one in words]
        came_back = []

        def kill_and_mend() -> None:
            while len(journaled(journal)) < 30:
                time.sleep(0.01)
            servers[0][0].kill()
            servers[0][0].wait()
            asked = len(journaled(journal))
            while len(journaled(journal)) < asked + 40:
                time.sleep(0.01)
            came_back.append(stack.enter_context(running(words[0]))[0].pid)

        killer = threading.Thread(target=kill_and_mend)
        killer.start()
        run(asking(*(url for _, url in servers)), forest, tmp_path / "out")
        killer.join()
    captions = list(read_captions(tmp_path / "out" / "captions.jsonl"))
    assert len(captions) == len({caption.sample_id for caption in captions}) == 122
    keys = Counter(record["key"] for record in kept_answers(tmp_path / "out"))
    assert set(keys.values()) == {1}
    by_server = Counter(pid for pid, _ in journaled(journal))
    assert by_server[came_back[0]] >= 5, "it must have been asked again"
    assert min(by_server[process.pid] for process, _ in servers[1:]) >= 60
    digests = Counter(digest for _, digest in journaled(journal))
    # Only what was in flight when it died can have been answered twice, once to nobody.
    assert sum(count - 1 for count in digests.values()) <= PATIENT["concurrency"]
    told = [record.message for record in caplog.records]
    assert sum("left out" in line and "times" not in line for line in told) == 1
    assert sum("is asked again" in line for line in told) == 1


def test_the_share_of_requests_follows_the_load(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 70, with_augmented=False)

    def wait_for_quick(body: dict) -> None:
        until_s = time.monotonic() + 60.0
        while len(quick.bodies) < 90 and time.monotonic() < until_s:
            time.sleep(0.01)

    with deciding(delay_s=0.01) as quick, deciding(respond=wait_for_quick) as slow:
        run(asking(quick.url, slow.url, endpoint={"timeout_s": 120.0}), tree, tmp_path / "out")
    assert len(quick.bodies) + len(slow.bodies) == 122
    assert len(quick.bodies) >= 90 > len(slow.bodies) > 0
    assert quick.most_at_once <= 4
    assert slow.most_at_once <= 4


@pytest.mark.parametrize("fault", ["500", "503", "404", "reset", "not_json"])
def test_a_server_that_always_fails_costs_no_window(fault, tree, tmp_path, caplog):
    with deciding() as good, deciding(fault=lambda number, body: fault) as bad:
        run(asking(bad.url, good.url), tree, tmp_path / "out")
    assert all(caption.status == "accepted" for caption in read_captions(tmp_path / "out" / "captions.jsonl"))
    assert len(good.bodies) == 10
    assert 0 < len(bad.bodies) <= 12
    assert any("left out" in record.message and bad.url in record.message for record in caplog.records)


def test_who_waits_for_a_server_sleeps_while_another_is_left_out(tmp_path, monkeypatch):
    tree = make_playback_tree(tmp_path / "tree", 1, 20, with_augmented=False)  # 11 windows
    looks, look = [], Throttle.has_room
    monkeypatch.setattr(Throttle, "has_room", lambda self: looks.append(self) or look(self))
    slow = {"concurrency": 9, "backoff_s": 60.0, "max_backoff_s": 60.0}  # one more than it begins with: it would grow
    with deciding(delay_s=1.5) as good, deciding(fault=lambda number, body: "500") as bad:
        run(asking(bad.url, good.url, endpoint=slow), tree, tmp_path / "out")
    assert len(good.bodies) == 22
    assert len(looks) < 500


def test_a_server_that_never_answers_costs_no_window(tree, tmp_path, caplog):
    with deciding() as good, deciding(delay_s=20.0) as silent:
        run(asking(silent.url, good.url, endpoint={"timeout_s": 4.0}), tree, tmp_path / "out")
    assert all(caption.status == "accepted" for caption in read_captions(tmp_path / "out" / "captions.jsonl"))
    assert f"{silent.url}: no answer within 4 s" in caplog.text


def test_a_run_goes_on_with_another_list_of_servers(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 30, with_augmented=False)
    with deciding() as one, deciding() as two, deciding() as three:
        run(asking(one.url, limit=5), tree, tmp_path / "out")
        run(asking(two.url, three.url, limit=None), tree, tmp_path / "out")
        run(asking(one.url, two.url, three.url), tree, tmp_path / "alone")
    assert len(one.bodies) >= 10
    assert (tmp_path / "out" / "captions.jsonl").read_bytes() == (tmp_path / "alone" / "captions.jsonl").read_bytes()
    assert {record["key"] for record in kept_answers(tmp_path / "out")} == {
        record["key"] for record in kept_answers(tmp_path / "alone")
    }


def test_servers_of_different_models_are_refused_with_the_list(tree, tmp_path):
    with deciding() as one, deciding(models=("other",)) as two:
        with pytest.raises(TeacherError, match="different models") as refused:
            run(asking(one.url, two.url), tree, tmp_path / "out")
        findings = examine_endpoint(f"{one.url},{two.url}", asking(one.url), VOCABULARY, ())
    assert f"{one.url}: {MODEL}" in str(refused.value)
    assert f"{two.url}: other" in str(refused.value)
    assert [finding.state for finding in findings if finding.name == "one model"] == ["unusable"]
    assert {finding.name.rpartition(": ")[0] for finding in findings} >= {one.url, two.url}


def test_one_that_is_away_at_the_start_is_left_out_and_all_that_are_away_end_the_run(tree, tmp_path, caplog):
    away = "http://127.0.0.1:9/v1"
    with deciding() as good:
        run(asking(away, good.url), tree, tmp_path / "out")
    assert any(f"{away}: left out" in record.message for record in caplog.records)
    with pytest.raises(TeacherError, match="cannot reach any") as refused:
        run(asking(away, good.url), tree, tmp_path / "none")
    assert away in str(refused.value)
    assert good.url in str(refused.value)


def test_where_all_fail_one_line_names_them_and_the_run_can_go_on(tree, tmp_path, caplog):
    out, is_broken = tmp_path / "out", [True]
    fault = lambda number, body: "500" if is_broken else None  # noqa: E731
    with deciding(fault=fault) as one, deciding(fault=fault) as two:
        with pytest.raises(TeacherError, match="windows"):
            run(asking(one.url, two.url), tree, out)
        lines = [record.message for record in caplog.records if "no server of the teacher" in record.message]
        assert lines
        assert one.url in lines[0]
        assert two.url in lines[0]
        is_broken.clear()
        run(asking(one.url, two.url), tree, out)
    assert len(list(read_captions(out / "captions.jsonl"))) == 5


def test_a_list_with_a_hole_is_refused_as_a_setting():
    with pytest.raises((ConfigError, ValueError), match="URLs"):
        asking("http://a", "")
