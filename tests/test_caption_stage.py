"""Stage `caption`: products, report, resume and bad input; what becomes of conflicts, by strategies and by a judge."""

import asyncio
import contextlib
import json
import re
import shutil
import threading
from collections import Counter

import pytest
from specimens_captions import VOCABULARY, cut_flight, report_of, saying
from teacher_server import TeacherServer, is_mirror, obedient_answer

from caption.schema import CaptionConfig, JudgeConfig, RepairConfig, WindowConfig
from caption.stage import stage
from caption.stage.compare import Trial, compare, try_strategy
from caption.stage.stage import run
from caption.stage.windows import cut_windows
from caption.teachers.judge import JUDGEMENTS, UNJUDGED, check_judge, gold_conflicts, judge_messages, parse_judgement
from caption.teachers.teacher import RuleTeacher
from caption.verification.actions import TABLE, measure
from cosfly.formats.captions import Coc, read_captions
from cosfly.formats.playback_file import read_track, write_track
from cosfly.formats.tracks import find_tracks
from cosfly.llm.contract import NoAnswer
from cosfly.runtime.errors import NothingKept, ResumeError, TeacherError
from specimens import change_json, make_playback_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 3, 18)


@pytest.fixture(scope="module")
def done(tree, tmp_path_factory):
    return run(CaptionConfig(), tree, tmp_path_factory.mktemp("done") / "caption").parent


def test_every_window_is_one_line_sorted_and_labelled_from_geometry(tree, done):
    captions = list(read_captions(done / "captions.jsonl"))
    windows = [one for folder in find_tracks(tree) for one in cut_windows(read_track(folder), CaptionConfig().window)]
    expected = {window.observed.sample_id: TABLE.label_of(measure(window.future)) for window in windows}
    assert [caption.sample_id for caption in captions] == sorted(expected)
    assert {caption.sample_id: caption.label for caption in captions} == expected
    assert len(captions) == 6 * 9
    for caption in captions:
        assert (caption.teacher.kind, caption.window[-1]) == ("rules", caption.frame_index)
        assert caption.future[0] == caption.frame_index + 1
        if caption.status == "dropped":
            assert caption.drop_reason == "no_reason"
            continue
        assert caption.verdict != "HARD_CONFLICT"
        assert caption.en.flight_decision == caption.zh.flight_decision


def test_the_report_adds_up_and_repairs_stay_on_record(tree, tmp_path):
    cfg = CaptionConfig.model_validate({"repair": {"soft_conflict": "repair"}})
    done = run(cfg, tree, tmp_path / "out").parent
    captions = list(read_captions(done / "captions.jsonl"))
    report = report_of(done)
    manifest = json.loads((done / "manifest.json").read_text())
    accepted = [caption for caption in captions if caption.status == "accepted"]
    dropped = Counter(caption.drop_reason for caption in captions if caption.status == "dropped")
    counts = {"input": 54, "kept": len(accepted), "dropped": dict(dropped), "failed": {}}
    assert report["windows"] == manifest["counts"] == counts
    assert set(dropped) <= {"no_reason"}
    assert report["labels"] == dict(Counter(caption.label or "none" for caption in captions).most_common())
    repaired = [caption for caption in captions if caption.repair]
    assert repaired, "the specimens must hold a conflict for this test to mean anything"
    first = report["verdicts_of_first_answers"]
    assert report["repair"]["rejected"] == first["SOFT_CONFLICT"] + first.get("HARD_CONFLICT", 0) == len(repaired)
    assert any(caption.repair.rung == "anchored" for caption in repaired)
    anchored = [caption for caption in repaired if caption.status == "accepted"]
    assert all(c.repair.strategy == "anchored" and c.en.flight_decision == c.label for c in anchored)
    assert {c.verdict for c in anchored} == {"CONSISTENT"}
    first = sum(count for row in report["confusion_label_to_first_decision"].values() for count in row.values())
    assert first == sum(report["verdicts_of_first_answers"].values())
    assert 45 <= first == sum(caption.en is not None for caption in captions)
    filled = [sum(caption.checks.values[language].values_filled for caption in accepted) for language in ("en", "zh")]
    assert [report["values"][language]["values_filled"] for language in ("en", "zh")] == filled
    assert min(filled) > 54
    assert not (done / "parts").exists()


def test_who_cannot_be_made_out_changes_what_is_said_to_be_seen_and_no_label(tree, done, tmp_path):
    before = list(read_captions(done / "captions.jsonl"))
    told = {}
    for legible in (True, False):
        dim = shutil.copytree(tree, tmp_path / f"tree_{legible}")
        for folder in find_tracks(dim):
            flight = read_track(folder)
            for point in flight.raw["points"]:
                point["target"]["legible"] = legible and point["target"]["visible"]
            write_track(folder, flight)
        told[legible] = list(read_captions(run(CaptionConfig(), dim, tmp_path / f"out_{legible}")))
    assert [one.model_dump() for one in told[True]] == [one.model_dump() for one in before], "nothing is said anew"
    for one, other in zip(before, told[False], strict=True):
        assert one.label == other.label
        if one.en is None or one.en.flight_decision in ("ascend", "move_backward"):  # which make the person smaller
            continue
        assert (one.verdict, one.en.flight_decision) == (other.verdict, other.en.flight_decision)
        text, chinese = (getattr(other, language).critical_components for language in ("en", "zh"))
        if one.checks.values and "search" not in one.en.flight_decision:
            assert not re.search(r"visible|centred|middle|midline|border|edge|axis", text), text
            assert not re.search("可见|居中|中央|中线|边缘|轴线", chinese), chinese


def test_a_product_never_loses_captions(tmp_path):
    tree, out = make_playback_tree(tmp_path / "tree", 3, 18), tmp_path / "caption"
    run(CaptionConfig(), tree, out)
    before = (out / "captions.jsonl").read_bytes()
    shutil.rmtree(find_tracks(tree)[0])
    with pytest.raises(ResumeError, match=r"the input data .* has changed; choose another --out"):
        run(CaptionConfig(), tree, out)
    assert (out / "captions.jsonl").read_bytes() == before


def test_a_larger_limit_writes_parts_again_that_were_removed(tree, done, tmp_path):
    out = tmp_path / "out"
    run(CaptionConfig(limit=12), tree, out)
    shutil.rmtree(out / "parts")
    product = run(CaptionConfig(limit=20), tree, out)
    lines, all_lines = product.read_bytes().splitlines(), (done / "captions.jsonl").read_bytes().splitlines()
    assert len(lines) == 20
    assert lines == [line for line in all_lines if line in lines]
    assert len({caption.trajectory for caption in read_captions(product)}) > 2  # spread over the tracks


def test_bad_flights_are_counted_and_the_others_captioned(tree, tmp_path):
    root = tmp_path / "tree"
    shutil.copytree(tree, root)
    folders = find_tracks(root)
    flights = [folder / "trajectory.json" for folder in folders]
    change_json(flights[0], lambda raw: raw.update(points=raw["points"][:9]))  # one short of a window and its future
    flights[1].write_text('{"schema":')
    change_json(flights[2], lambda raw: raw["points"][3]["drone_pose"].update(x=None))
    (folders[5] / "frames_playback" / "frame_00006" / "rgb.png").unlink()
    out = run(CaptionConfig(), root, tmp_path / "out").parent
    report = report_of(out)
    # Two that cannot be read, and the perturbed flight beside the second, whose labels come from it.
    assert report["flights"] == {"input": 6, "kept": 2, "dropped": {"too_short": 1}, "failed": {"input": 3}}
    # Frame 6 is observed by the windows at 6..10, of those at 4..12.
    assert report["windows"] == {"input": 18, "kept": 13, "dropped": {"unusable_frame": 5}, "failed": {}}
    failures = (out / "failures.jsonl").read_text()
    assert "points[3].drone_pose.x: Input should be a valid number; got null" in failures
    assert "not valid JSON" in failures


def test_a_perturbed_flight_waits_for_a_clean_one_that_cannot_be_read(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 14)
    clean = next(tree.rglob("ORI")) / "trajectory.json"
    whole = clean.read_bytes()
    clean.write_bytes(whole[:100])
    with pytest.raises(NothingKept):
        run(CaptionConfig(), tree, tmp_path / "out")
    clean.write_bytes(whole)
    found = list(read_captions(run(CaptionConfig(), tree, tmp_path / "again")))
    assert Counter(caption.label_from for caption in found) == {"flight": 5, "twin": 5}


def test_captions_of_another_prompt_are_refused_by_name(tree, tmp_path, monkeypatch):
    shutil.copytree(run(CaptionConfig(), tree, tmp_path / "first").parent, tmp_path / "out")
    changed = tmp_path / "changed"
    changed.write_text("otherwise")
    monkeypatch.setitem(stage.PACKAGE_FILES, "glossary", changed)
    with pytest.raises(ResumeError, match="the glossary has changed"):
        run(CaptionConfig(), tree, tmp_path / "out")


CFG = CaptionConfig(window=WindowConfig(require_images=False))


def test_a_soft_conflict_is_kept_unless_the_settings_drop_it(tree, done, tmp_path):
    cfg = CaptionConfig.model_validate({"repair": {"soft_conflict": "drop"}})
    kept, dropped = (list(read_captions(path)) for path in (done / "captions.jsonl", run(cfg, tree, tmp_path / "out")))
    soft = [(one, other) for one, other in zip(kept, dropped, strict=True) if one.verdict == "SOFT_CONFLICT"]
    assert soft
    for one, other in soft:
        assert (one.status, one.repair, other.drop_reason) == ("accepted", None, "conflict")


@pytest.mark.parametrize("strategy", ["anchored", "cascade"])
def test_a_conflict_without_a_reason_for_its_label_counts_as_not_repaired(strategy):
    cfg = CFG.model_copy(update={"repair": RepairConfig(hard_conflict="repair", soft_conflict="repair")})
    trials = []
    for window in cut_flight(60):
        with contextlib.suppress(NoAnswer):  # the first answer has no reason
            trials.append(asyncio.run(try_strategy(window, RuleTeacher(0), cfg, VOCABULARY, strategy)))
    trials = [trial for trial in trials if trial is not None]
    repaired = [trial for trial in trials if trial.last is not None]
    assert 0 < len(repaired) < len(trials)
    assert compare(strategy, trials).consistency == round(len(repaired) / len(trials), 3)


def test_a_comparison_by_hand():
    first = Coc(critical_components="a b c", reasoning_trace="r", flight_decision="hover")
    trials = [
        Trial(first, first, "CONSISTENT", 1, 100),
        Trial(first, first.model_copy(update={"critical_components": "x y z"}), "SOFT_CONFLICT", 2, 200),
        Trial(first, None, "HARD_CONFLICT", 3, 300),
    ]
    found = compare("hint", trials)
    assert (found.num_conflicts, found.repaired, found.consistency) == (3, 2, 0.333)
    assert (found.asks_per_conflict, found.tokens_per_conflict, found.naturalness) == (2.0, 200.0, 0.625)
    nothing = compare("hint", trials[2:])
    assert (nothing.repaired, nothing.consistency, nothing.naturalness) == (0, 0.0, None)
    assert [one.row[:4] for one in (found, nothing)] == [("hint", "2", "33.3 %", "62.5 %"), ("hint", "0", "0.0 %", "-")]


def test_reading_a_judgement():
    for text, verdict in [
        ('{"verdict": "FIX_LABEL", "reason": "the text argues for the label"}', "FIX_LABEL"),
        ("ACCEPT_ALTERNATIVE", UNJUDGED),
        ('{"verdict": "ACCEPT", "reason": "fine"}', UNJUDGED),
        ('{"verdict": "ACCEPT_ALTERNATIVE"}', UNJUDGED),
        ('{"verdict": "ACCEPT_ALTERNATIVE", "reason": " "}', UNJUDGED),
        ('{"verdict": ["ACCEPT_ALTERNATIVE"], "reason": "x"}', UNJUDGED),
        ('{"verdict": "ACCEPT_ALTERNATIVE", "reason": "x"} {"verdict": "REJECT_REGEN", "reason": "y"}', "REJECT_REGEN"),
    ]:  # fmt: skip
        assert parse_judgement(text)[0] == verdict


def teacher_in_conflict(**options) -> TeacherServer:
    """A teacher whose free decisions differ from the label in part of the windows; its text names its decision."""
    server = TeacherServer(decision=lambda body: ("hover", "track_straight", "speed_up")[body["seed"] % 3], **options)

    def text(body: dict) -> str:
        answer = obedient_answer(server, body)
        chinese, english = "因此应{decision}，使目标留在画面中。", "So the drone should {decision} in this case."
        return json.dumps(answer | {"reasoning_trace": chinese if is_mirror(body) else english})

    server.text = text
    return server


def judged(tree, out, answer, **settings):
    with saying(answer) as server, teacher_in_conflict() as teacher:
        cfg = {"teacher": teacher.url, "judge": {"url": server.url, **settings}, "image": {"max_side_px": 32}}
        path = run(CaptionConfig.model_validate(cfg), tree, out)
        return list(read_captions(path)), report_of(out), server


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
    with TeacherServer(decision=lambda body: "hover") as teacher, saying(lambda body: fix) as judge:
        cfg = CaptionConfig.model_validate({"teacher": teacher.url, "judge": {"url": judge.url}})
        captions = list(read_captions(run(cfg, tree, tmp_path / "out")))
    fixed = [c for c in captions if c.repair]
    assert fixed
    for caption in fixed:
        assert caption.repair.rung == caption.repair.strategy == "fix_label"
        assert (caption.repair.asks, caption.repair.first_decision) == (0, "hover")
        assert caption.en.flight_decision == caption.zh.flight_decision == caption.label


def test_a_label_is_not_put_under_a_text_that_states_another_decision(tree, tmp_path):
    fix = '{"verdict": "FIX_LABEL", "reason": "replace it"}'
    captions, _, _ = judged(tree, tmp_path / "out", lambda body: fix)
    asked = [c for c in captions if c.judge]  # of the rule teacher, whose text names its decision
    assert asked
    assert all(c.judge.overruled_by == "text" and c.repair.rung == "anchored" for c in asked)


def test_a_judges_tokens_count_in_the_budget_and_are_shown(tree, tmp_path):
    out, reject = tmp_path / "out", '{"verdict": "REJECT_REGEN", "reason": "no"}'
    # Each answer, also of the judge: 1,000 tokens in, 100 out.
    with saying(lambda body: reject) as server, teacher_in_conflict() as teacher:
        settings = {"teacher": teacher.url, "judge": {"url": server.url, "concurrency": 1}}
        whole = run(CaptionConfig.model_validate(settings), tree, tmp_path / "other").read_bytes()
        num_asked = len(server.bodies)
        limit = 1100 * (len(teacher.bodies) + 1)  # enough for the teacher alone
        with pytest.raises(TeacherError, match="captioning stopped, because the budget is spent"):
            run(CaptionConfig.model_validate(settings | {"budget": {"max_tokens": limit}}), tree, out)
        assert run(CaptionConfig.model_validate(settings), tree, out).read_bytes() == whole
        assert len(server.bodies) == 2 * num_asked  # what was judged before the budget stopped was not asked again
        report = report_of(out)
    assert report["judge_tokens"] == {"prompt_tokens": 1000 * num_asked, "completion_tokens": 100 * num_asked}
    assert f"{1000 * num_asked:,} in, {100 * num_asked:,} out" in (out / "report.html").read_text(encoding="utf-8")


def test_the_check_tells_a_perfect_judge_and_one_that_always_says_the_same():
    gold = [pair for judgement in JUDGEMENTS for pair in [g for g in gold_conflicts() if g.judgement == judgement][:12]]
    right = {judge_messages(case, VOCABULARY)[1]["content"]: case.judgement for case in gold}

    def checked(answer):
        together = threading.Barrier(2)  # no answer comes before two have asked

        def wait(number, body):
            together.wait(60)

        with saying(lambda body: json.dumps({"verdict": answer(body), "reason": "because"}), wait) as server:
            found = asyncio.run(check_judge(JudgeConfig(url=server.url), VOCABULARY, gold))
        return found.agreement, found.num_unjudged, found.num_moved, found.first_share

    assert checked(lambda body: right[body["messages"][1]["content"]]) == (1.0, 0, 0, pytest.approx(1 / 3))
    assert checked(lambda body: JUDGEMENTS[0]) == (pytest.approx(1 / 3), 0, 0, pytest.approx(1 / 3))
