"""A real model behind a real server: random weights, so noise, but decoded under our schema. Every answer must parse,
and every window must end somewhere."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from specimens_captions import VOCABULARY
from teacher_server import kept_answers

from caption.run.stage import run
from caption.schema import CaptionConfig
from caption.teachers.doctor import examine_endpoint
from caption.writing.contract import way_of
from cosfly.formats.answer_text import parse_answer
from cosfly.formats.captions import read_captions
from cosfly.runtime.errors import NothingKept
from distill.student.random_student import make_tiny_student
from specimens import make_playback_tree

if TYPE_CHECKING:
    from model_server import ModelServer


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    for package in ("torch", "transformers", "llguidance"):
        pytest.importorskip(package, reason=f"{package} is not installed; it comes with cosfly[dev]")
    from model_server import ModelServer

    with ModelServer(make_tiny_student(tmp_path_factory.mktemp("model") / "student")) as running:
        yield running


def settings(server: ModelServer, **changes) -> CaptionConfig:
    # Noise seldom ends a string by itself: a bias on the quote does it after a few words, within the protocol.
    endpoint = {"concurrency": 2, "max_tokens": 700, "extra_body": {"logit_bias": {str(server.quote_id): 4.0}}}
    base = {"teacher": server.url, "endpoint": endpoint, "image": {"max_side_px": 64}}
    return CaptionConfig.model_validate(base | changes)


@pytest.mark.slow
def test_every_answer_parses_and_every_window_is_accounted_for(server, tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 13, with_augmented=False)
    with pytest.raises(NothingKept):  # a random model seldom decides what it concluded before
        run(settings(server), tree, tmp_path / "out")
    answers, optional = kept_answers(tmp_path / "out"), way_of("slots", VOCABULARY).optional
    assert len(answers) == server.num_answers > 0
    assert server.num_images >= 4 * 15
    for answer in answers:
        assert answer["structured"] == "json_schema"
        is_mirror = answer["purpose"].startswith("mirror")
        language, more = ("zh", ()) if is_mirror else ("en", ("therefore",))
        parsed = parse_answer(answer["text"], language, (*optional, *more), optional=optional)
        # No schema keeps a random model from other alphabets, or from a claim of 1e999.
        noise = ("wrong_language", "unreadable_character", "not_finite")
        is_noise = parsed.reason is not None and parsed.reason.endswith(noise)
        assert parsed.coc is not None or is_noise or answer["finish_reason"] == "length", (
            parsed.reason,
            answer["text"],
        )
        if answer["purpose"].split("/")[0] not in (
            "free",
            "mirror",
        ):  # anchored: the schema's enum enforced the decision
            assert parsed.coc is None or parsed.coc.flight_decision == answer["purpose"].split("/")[0]
    captions = list(read_captions(tmp_path / "out" / "captions.jsonl"))
    report = json.loads((tmp_path / "out" / "caption_report.json").read_text())
    windows = report["windows"]
    assert windows["input"] == len(captions) == 4
    assert windows["kept"] + sum(windows["dropped"].values()) == 4
    assert windows["dropped"] == dict(Counter(c.drop_reason for c in captions if c.status == "dropped"))
    assert sum(caption.attempts for caption in captions) == len(answers)
    assert report["repair"]["rejected"] == sum(caption.repair is not None for caption in captions)
    used = Counter({"prompt_tokens": 0, "completion_tokens": 0})
    for answer in answers:
        used.update(answer["usage"])
    assert dict(used) == report["tokens"]


@pytest.mark.slow
def test_the_doctor_sees_that_this_server_applies_the_schema(server):
    findings = {finding.name: finding for finding in examine_endpoint(server.url, settings(server), VOCABULARY)}
    assert findings["JSON schema"].state == "ok"
    assert findings["answers"].state == "ok"
    assert findings["image input"].state == "ok", findings["image input"].detail
    assert findings["context length"].state == "ok", findings["context length"].detail
