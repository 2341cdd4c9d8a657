"""Prose read into claims by a language model: a perfect reader, readers with stated faults, and a run with one. No real
model is asked."""

from __future__ import annotations

import asyncio
import json
import re
from contextlib import nullcontext
from functools import cache, partial

import pytest
from commands import invoke
from measure_prose import answers_of, loses, misquotes, misreads, perfect_readings, turns
from specimens_captions import ACTION_TABLE, VOCABULARY, saying
from teacher_server import is_mirror

from caption.run.forecast import make_forecast
from caption.run.released import state_lies
from caption.run.stage import run
from caption.run.windows import cut_windows
from caption.schema import CaptionConfig, EvidenceConfig, ReaderConfig, WindowConfig
from caption.teachers.asked import AskedModel
from caption.teachers.doctor import READ_CAPTIONS, examine_endpoint
from caption.teachers.reader import Reader, ReaderCheck, measure_reader, prompt_digest, read_reading
from caption.truth.facts import measure_facts
from caption.truth.gold import GoldCaption, read_gold
from caption.truth.mirror import TEXTS
from cosfly.chat.answers import KeptAnswers
from cosfly.chat.contract import Reply
from cosfly.errors import NothingKept
from cosfly.products.captions import Claim, Coc, Usage, read_captions
from cosfly.products.flights import find_flights
from cosfly.products.playback import read_flight
from release.columns import caption_values
from release.flight_rows import shown_caption


@cache
def gold() -> tuple[GoldCaption, ...]:
    """Captions with claims by their writers, who knew no rule of ours: every fourth."""
    return tuple(caption for caption in read_gold() if caption.claims)[::4]


class FakeEngine:
    """Answers as a reader with a fault does, without a server."""

    kind, where, model = "endpoint", "nowhere", "perfect"  # type: ignore

    def __init__(self, fault=None, *, alike: bool = False) -> None:
        self.text = answers_of(perfect_readings(gold()), fault, alike=alike)

    async def answer(self, request) -> Reply:
        return Reply(self.text({"messages": request.messages}), Usage(prompt_tokens=900), "plain", "stop")


@cache
def measured(fault=None, *, alike: bool = False) -> ReaderCheck:
    engine = FakeEngine(fault, alike=alike)
    reader = Reader([AskedModel(KeptAnswers(engine, None), ReaderConfig(), 0)], VOCABULARY)
    return asyncio.run(measure_reader(reader, gold()))


def test_a_perfect_reader_flags_no_true_caption_and_catches_most_errors():
    check = measured()
    assert check.num_true >= 60
    assert check.num_flagged == 0
    assert check.num_caught >= 0.75 * check.num_false


@pytest.mark.parametrize("fault", [loses, misreads, misquotes, turns])
def test_readers_with_faults_lose_proofs_and_flag_next_to_nothing(fault):
    perfect, check = measured(), measured(fault)
    assert check.num_flagged <= 0.02 * check.num_true
    assert check.num_proved <= perfect.num_proved
    assert check.num_claims < perfect.num_claims
    assert check.num_caught > 0.4 * check.num_false


def test_two_readings_that_err_alike_are_believed():
    """What the agreement of two readings cannot find: one model with one fault twice. Hence reader-check."""
    assert measured(turns, alike=True).num_flagged > 3


def test_a_claim_must_quote_words_that_hold_its_number():
    coc = Coc(
        critical_components="The walker is 12.5 m away and to the left.",
        reasoning_trace="The gap has grown by 2 m, so speed up.",
        flight_decision="speed_up",
    )
    plain = {"sentence": "C1", "quantity": "distance", "at": "t4", "value": 12.5, "unit": "m", "modality": "observed"}
    wrong = [
        plain | {"quote": "13.5 m"},  # not in the sentence
        plain | {"quote": "to the left"},  # without the number
        plain | {"quote": "12.5 m away", "value": 13.5},
        plain | {"quote": "by 2 m", "sentence": "R1"},
        plain | {"quote": "12.5 m", "sentence": "C9"},
        plain,
        "12.5 m",
    ]
    answer = json.dumps({"claims": [plain | {"quote": "12.5 m away"}, *wrong]})
    assert read_reading(answer, "stop", coc, "en") == [Claim(**plain, quote="12.5 m away")]
    assert read_reading("I cannot.", "stop", coc, "en") is None


def texts_at(altitude: str, decision: str) -> dict[str, dict[str, str]]:
    """An answer in both languages that gives an altitude, and nothing else that can be measured."""
    texts = {
        "en": (f"We fly at {altitude} m over the road.", "There is nothing to say against this manoeuvre here."),
        "zh": (f"我们以 {altitude} m 的高度在道路上空飞行。", "此处没有任何理由反对这一机动动作。"),
    }
    return {name: dict(zip(TEXTS, own, strict=True)) | {"flight_decision": decision} for name, own in texts.items()}


def reading_of(body: dict) -> str:
    """Read a made-up text of one sentence each: the altitude that it gives."""
    lines = re.findall(r"^(\w\d): (.*)$", body["messages"][1]["content"], re.MULTILINE)
    claims = [
        {"sentence": name, "quantity": "altitude", "at": "t4", "value": float(found[1]), "unit": "m",
        "modality": "observed",
         "quote": found[0]}
        for name, text in lines if (found := re.search(r"([\d.]+) m", text))
    ]  # fmt: skip
    return json.dumps({"claims": claims})


def test_a_run_reads_prose_of_others_and_keeps_the_claims(tree, tmp_path):
    rules = list(read_captions(run(CaptionConfig(), tree, tmp_path / "rules")))
    altitudes = [float(re.search(r"Altitude[^\[]*\[(.*?)\]", c.prompt["en"].user)[1].split(",")[-1]) for c in rules]
    lines = []
    for number, (caption, altitude) in enumerate(zip(rules, altitudes, strict=True)):
        texts = texts_at(f"{altitude + 5 * (number % 2):.1f}", caption.label or "hover")
        lines.append({"sample_id": caption.sample_id, **texts})
    path = tmp_path / "theirs.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with saying(reading_of) as server:
        cfg = CaptionConfig.model_validate({"teacher": f"file:{path}", "reader": {"urls": [server.url]}})
        plan = make_forecast(cfg, tree, tmp_path / "out")
        assert plan.calls.expected == 4 * plan.num_windows  # two readings in each language, and no teacher
        assert plan.prompt_tokens.expected > 0
        found = list(read_captions(run(cfg, tree, tmp_path / "out")))
        assert len(server.bodies) == 4 * len(lines)
        run(cfg, tree, tmp_path / "out")
        assert len(server.bodies) == 4 * len(lines)  # nothing is asked twice, nor what the plan asked
    assert [c.checks.sentences["en"][0] for c in found] == [
        "contradicted" if n % 2 else "proved" for n in range(len(found))
    ]
    assert all(c.reader.prompt == prompt_digest(VOCABULARY) and c.reader.claims["en"][0].quote for c in found)
    windows = list(cut_windows(read_flight(find_flights(tree)[0]), WindowConfig(), ACTION_TABLE))
    lie_of_state, lie_of_claim = 0, 0
    for caption, window in zip(found, windows, strict=True):
        row = caption_values(caption) | {"sample_id": caption.sample_id, "frame_index": caption.frame_index}
        facts = measure_facts(window.observed, caption.picture_px)
        assert (
            state_lies(shown_caption(row), facts, EvidenceConfig(), VOCABULARY) == []
        )  # from the row alone: nobody is asked
        states = ["unread", *row["sentence_states_en"][1:]]
        lie_of_state += len(
            state_lies(shown_caption(row | {"sentence_states_en": states}), facts, EvidenceConfig(), VOCABULARY)
        )
        evidence = row["evidence"].replace('"value":', '"value":9')
        lie_of_claim += len(
            state_lies(shown_caption(row | {"evidence": evidence}), facts, EvidenceConfig(), VOCABULARY)
        )
        assert (
            state_lies(shown_caption(row | {"evidence": "[]"}), facts, EvidenceConfig(), VOCABULARY)[0].code
            == "evidence"
        )
    assert lie_of_state == len(found)
    assert lie_of_claim >= len(found) // 2  # what was proved no longer is


def test_a_contradicted_caption_is_asked_again_with_the_fact_and_then_dropped(tree, tmp_path):

    def text(body: dict, mends: bool) -> str:
        words = json.dumps(body["messages"], ensure_ascii=False)
        if "C1: " in words:
            return reading_of(body)
        if is_mirror(body):
            english = json.loads(body["messages"][-1]["content"])
            altitude = re.search(r"[\d.]+", english["critical_components"])[0]
            return json.dumps(texts_at(altitude, english["flight_decision"])["zh"])
        fact = re.search(r"It contradicts the facts.*altitude: [^m]*?([\d.]+) m", words) if mends else None
        answer = texts_at(fact[1] if fact else "99.0", "track_straight")["en"]
        return json.dumps(answer | {"therefore": "track_straight"})

    for mends in (True, False):
        with saying(partial(text, mends=mends)) as server, nullcontext() if mends else pytest.raises(NothingKept):
            cfg = {"teacher": server.url, "writing": "prose", "reader": {"urls": [server.url]},
                   "repair": {"hard_conflict": "keep"}, "window": {"require_images": False}}  # fmt: skip
            run(CaptionConfig.model_validate(cfg), tree, tmp_path / str(mends))
        found = list(read_captions(tmp_path / str(mends) / "captions.jsonl"))
        assert {c.drop_reason for c in found} == {None if mends else "evidence"}, found[0].checks
        assert all("evidence" in c.checks.refused for c in found)
        assert all(c.checks.sentences["en"][0] == ("proved" if mends else "contradicted") for c in found)


def test_the_command_measures_an_endpoint():
    with saying(lambda body: "I cannot.") as server:
        result = invoke("caption reader-check", server.url, "--limit 2")
    assert result.exit_code == 0, result.output
    assert "flagged" in result.output
    assert "unreadable" in result.output


def test_the_doctor_tells_a_reader_from_a_model_that_reads_nothing():
    answer = answers_of(perfect_readings([caption for caption in read_gold() if caption.claims][:READ_CAPTIONS]), None)
    for reads, state in ((True, "ok"), (False, "unusable")):

        def text(body, reads=reads):
            return answer(body) if reads and body["messages"][0]["role"] == "system" else "ready"

        with saying(text) as server:
            findings = {f.name: f for f in examine_endpoint(server.url, CaptionConfig(), VOCABULARY, as_reader=True)}
        assert findings["reads prose"].state == state, findings
        assert "image input" not in findings
