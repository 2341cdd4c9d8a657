"""The judge: lenient reading, never an acceptance by accident, never over geometry; its check finds what is planted."""

import asyncio
import json
import threading

import pytest
from specimens_captions import VOCABULARY
from tables import each
from teacher_server import TeacherServer, is_mirror, obedient_answer

from caption.schema import CaptionConfig, JudgeConfig
from caption.stage.stage import run
from caption.teachers.judge import JUDGEMENTS, UNJUDGED, check_judge, gold_conflicts, judge_messages, parse_judgement
from cosfly.formats.captions import read_captions
from cosfly.runtime.errors import TeacherError
from specimens import make_playback_tree


def judging_server(answer, fault=None):
    """A chat server whose text is `answer(body)`."""
    server = TeacherServer(fault)
    server.text = answer
    return server


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 2, 18)


@each(("text", "verdict"), [
    ('{"verdict": "FIX_LABEL", "reason": "the text argues for the label"}', "FIX_LABEL"),
    ('```json\n{"verdict": "REJECT_REGEN", "reason": "wrong"}\n```', "REJECT_REGEN"),
    ("ACCEPT_ALTERNATIVE", UNJUDGED),
    ("", UNJUDGED),
    ('{"verdict": "ACCEPT", "reason": "fine"}', UNJUDGED),
    ('{"verdict": "ACCEPT_ALTERNATIVE"}', UNJUDGED),
    ('{"verdict": "ACCEPT_ALTERNATIVE", "reason": " "}', UNJUDGED),
    ('{"verdict": ["ACCEPT_ALTERNATIVE"], "reason": "x"}', UNJUDGED),
    ('{"verdict": "ACCEPT_ALTERNATIVE", "reason": "x"} {"verdict": "REJECT_REGEN", "reason": "y"}', "REJECT_REGEN"),
    ('{"verdict": "ACCEPT_ALTERNATIVE", "reason": ', UNJUDGED),
    ('["ACCEPT_ALTERNATIVE"]', UNJUDGED),
])  # fmt: skip
def test_reading_a_judgement(text, verdict):
    assert parse_judgement(text)[0] == verdict


def teacher_in_conflict(**options) -> TeacherServer:
    """A teacher whose free decisions differ from the label in part of the windows; its text names its decision."""
    server = TeacherServer(decision=lambda body: ("hover", "track_straight", "speed_up")[body["seed"] % 3], **options)

    def text(body: dict) -> str:
        answer = obedient_answer(server, body)
        named = (
            "因此应{decision}，使目标留在画面中。"
            if is_mirror(body)
            else "So the drone should {decision} in this case."
        )
        return json.dumps(answer | {"reasoning_trace": named})

    server.text = text
    return server


def judged(tree, out, answer, **settings):
    with judging_server(answer) as server, teacher_in_conflict() as teacher:
        cfg = {"teacher": teacher.url, "judge": {"url": server.url, **settings}, "image": {"max_side_px": 32}}
        path = run(CaptionConfig.model_validate(cfg), tree, out)
        return list(read_captions(path)), json.loads((out / "caption_report.json").read_text()), server


def test_a_hard_conflict_stays_one_whatever_the_judge_says(tree, tmp_path):
    accept = '{"verdict": "ACCEPT_ALTERNATIVE", "reason": "looks fine"}'
    captions, report, server = judged(tree, tmp_path / "out", lambda body: accept)
    hard = [c for c in captions if c.repair]
    soft = [c for c in captions if c.judge and not c.repair]
    assert hard, "the specimens must hold a hard conflict"
    assert soft, "the specimens must hold a soft conflict"
    assert all(c.judge.overruled_by == "geometry" and c.verdict != "HARD_CONFLICT" for c in hard)
    assert all(c.verdict == "SOFT_CONFLICT" and c.judge.overruled_by is None for c in soft)
    assert report["judgements"] == {"ACCEPT_ALTERNATIVE": len(hard) + len(soft), "overruled_by_geometry": len(hard)}
    assert len(server.bodies) == len(hard) + len(soft)  # consistent answers are not judged


def test_a_label_is_put_in_where_the_text_allows_it(tree, tmp_path):
    fix = '{"verdict": "FIX_LABEL", "reason": "replace it"}'
    with TeacherServer(decision=lambda body: "hover") as teacher, judging_server(lambda body: fix) as judge:
        cfg = CaptionConfig.model_validate({"teacher": teacher.url, "judge": {"url": judge.url}})
        captions = list(read_captions(run(cfg, tree, tmp_path / "out")))
    fixed = [c for c in captions if c.repair]
    assert fixed
    for caption in fixed:
        assert caption.repair.rung == caption.repair.strategy == "fix_label"
        assert (caption.repair.asks, caption.repair.first_decision) == (0, "hover")
        assert caption.en.flight_decision == caption.zh.flight_decision == caption.label


def test_a_label_is_not_put_under_a_text_that_states_another_decision(tree, tmp_path):
    captions, _, _ = judged(tree, tmp_path / "out", lambda body: '{"verdict": "FIX_LABEL", "reason": "replace it"}')
    asked = [c for c in captions if c.judge]  # of the rule teacher, whose text names its decision
    assert asked
    assert all(c.judge.overruled_by == "text" and c.repair.rung == "anchored" for c in asked)


def test_a_judges_tokens_count_in_the_budget_and_are_shown(tree, tmp_path):
    out, reject = tmp_path / "out", '{"verdict": "REJECT_REGEN", "reason": "no"}'
    # Each judgement: 1,000 tokens in, 100 out.
    with judging_server(lambda body: reject) as server, teacher_in_conflict() as teacher:
        settings = {
            "teacher": teacher.url,
            "judge": {"url": server.url, "concurrency": 1},
            "endpoint": {"max_tokens": 64},
            "image": {"max_side_px": 32},  # pictures count in the guess of the first request
        }
        with pytest.raises(TeacherError, match="captioning stopped, because the next request may exceed"):
            run(CaptionConfig.model_validate(settings | {"budget": {"max_tokens": 10_000}}), tree, out)
        assert 0 < len(server.bodies) * 1100 <= 10_000
        whole = run(CaptionConfig.model_validate(settings), tree, out).read_bytes()
        num_asked = len(server.bodies)
        report = json.loads((out / "caption_report.json").read_text())
        assert run(CaptionConfig.model_validate(settings), tree, tmp_path / "other").read_bytes() == whole
        assert len(server.bodies) == 2 * num_asked  # what was judged before the budget stopped was not asked again
    assert report["judge_tokens"] == {"prompt_tokens": 1000 * num_asked, "completion_tokens": 100 * num_asked}
    assert f"{1000 * num_asked:,} in, {100 * num_asked:,} out" in (out / "report.html").read_text(encoding="utf-8")


def test_the_check_tells_a_perfect_judge_and_one_that_always_says_the_same():
    gold = [pair for judgement in JUDGEMENTS for pair in [g for g in gold_conflicts() if g.judgement == judgement][:12]]
    right = {judge_messages(case, VOCABULARY)[1]["content"]: case.judgement for case in gold}

    def checked(answer):
        together = threading.Barrier(2)  # no answer comes before two have asked

        def wait(number, body):
            together.wait(60)

        with judging_server(lambda body: json.dumps({"verdict": answer(body), "reason": "because"}), wait) as server:
            found = asyncio.run(check_judge(JudgeConfig(url=server.url), VOCABULARY, gold))
        return found.agreement, found.num_unjudged, found.num_moved, found.first_share

    assert checked(lambda body: right[body["messages"][1]["content"]]) == (1.0, 0, 0, pytest.approx(1 / 3))
    assert checked(lambda body: JUDGEMENTS[0]) == (pytest.approx(1 / 3), 0, 0, pytest.approx(1 / 3))
