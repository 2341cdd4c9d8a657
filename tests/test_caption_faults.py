"""Faults of servers, and what a run must make of each. The tables are where the next one is added.

A run loses nothing: what a server refuses for a reason of its own ends it and is no window's fault, what it refuses of
one window is kept in the server's words, and asked again by `--retry-failed`.
"""

import json
import threading
from collections import Counter
from pathlib import Path

import pytest
from specimens_captions import deciding, report_of, settings
from tables import each
from teacher_server import MODEL, is_mirror, refusal

from caption.stage.stage import run
from cosfly.formats.captions import read_captions
from cosfly.runtime.errors import NothingKept, TeacherError
from specimens import make_playback_tree

TOO_LONG = "This model's maximum context length is 8192 tokens. However, you requested 8203 tokens."
IMAGES = "At most 5 image(s) may be provided in one prompt."
FILTERED = "The response was filtered due to the prompt triggering Azure OpenAI's content management policy."
NOT_KNOWN = "Something about this request is not as it should be."


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 2, 14, with_augmented=False)  # 2 flights of 5 windows


@pytest.fixture(scope="module")
def whole(tree, tmp_path_factory) -> tuple[bytes, list[int]]:
    """Return what an undisturbed run makes, and the seeds of what it asks in English."""
    with deciding() as server:
        path = run(settings(server.url), tree, tmp_path_factory.mktemp("whole") / "out")
    bodies = [json.loads(body) for body in server.bodies]
    return path.read_bytes(), sorted(body["seed"] for body in bodies if not is_mirror(body))


def quarantine(out: Path) -> dict[str, dict]:
    lines = (out / "quarantine.jsonl").read_text(encoding="utf-8").splitlines()
    return {record["id"]: record for record in map(json.loads, lines)}


class Switched:
    def __init__(self, status: int, text: str, num_good: int = 3) -> None:
        self.status, self.text, self.num_good, self.num_asked = status, text, num_good, 0
        self._lock = threading.Lock()

    def __call__(self, body: dict) -> tuple[int, dict] | None:
        with self._lock:
            self.num_asked += 1
            is_good = is_mirror(body) or self.num_asked <= self.num_good
        return None if is_good else refusal(self.status, self.text)


# What a server says to every window from some time on: status, words, and what the error must say beside them.
SERVER_FAULTS = {
    "a lower image limit": (400, IMAGES, "--limit-mm-per-prompt"),
    "no vision": (500, "image input is not supported - hint: if this is unexpected, you may need to provide the mmproj",
        "--mmproj"),
    "another model": (404, f"The model `{MODEL}` does not exist.", "correct the URL or --model"),
    "a parameter": (400, "Unsupported parameter: 'max_tokens' is not supported with this model.", "extra_body"),
    "no credit": (429, "You exceeded your current quota. insufficient_quota",
        "the account has no credit left"),
    "a wrong key": (401, "Incorrect API key provided.", "set COSFLY_API_KEY"),
}  # fmt: skip


@each("name", SERVER_FAULTS)
def test_what_is_the_servers_fault_ends_the_run_and_is_no_windows(tree, tmp_path, whole, name):
    status, text, words = SERVER_FAULTS[name]
    out, behaviour = tmp_path / "out", Switched(status, text)
    with deciding(respond=behaviour) as server:
        with pytest.raises(TeacherError) as caught:
            run(settings(server.url), tree, out)
        assert text in str(caught.value)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
        assert len(server.bodies) < 30  # no window is asked in vain for long
        assert not (out / "manifest.json").exists()
        assert quarantine(out) == {}
        parts = [caption for path in (out / "parts").glob("*") for caption in read_captions(path)]
        assert [caption.checks.refusal for caption in parts if caption.checks.refusal] == []
        behaviour.num_good = 10**9
        assert run(settings(server.url), tree, out).read_bytes() == whole[0]


def test_a_server_that_refuses_every_window_ends_the_run_and_retry_failed_asks_again(
    tree, tmp_path, whole, monkeypatch
):
    monkeypatch.setattr("caption.stage.asking.STOP_AFTER_FAILURES", 3)
    # One good answer, whose mirror may come between the refusals: three in a row are left whatever the order.
    out, behaviour = tmp_path / "out", Switched(400, NOT_KNOWN, num_good=1)
    with deciding(respond=behaviour) as server:
        cfg = settings(server.url, endpoint={"concurrency": 1})
        with pytest.raises(TeacherError) as caught:
            run(cfg, tree, out)
        assert NOT_KNOWN in str(caught.value)
        assert not (out / "manifest.json").exists()
        assert {held["code"] for held in quarantine(out).values()} == {"refused_400"}
        behaviour.num_good = 10**9
        run(cfg, tree, out)
        assert run(cfg, tree, out, retry_failed=True).read_bytes() == whole[0]


# What a server says to some windows while it answers the others: status, words, and the reason they are dropped for.
WINDOW_FAULTS = {
    "too long": (400, TOO_LONG, "refused_too_long"),
    "too long, llama.cpp": (500, "Context size has been exceeded.", "refused_too_long"),
    "too long, LM Studio": (200, "Trying to keep the first 9136 tokens when context the overflows. However, the model "
        "is loaded with context length of only 4096 tokens.", "refused_too_long"),
    "filtered": (400, FILTERED, "refused_content"),
    "flagged": (403, "Your chosen model requires moderation and your input was flagged.", "refused_content"),
    "filtered, with the request": (400, "The request was blocked: response_format=json_schema, messages=...",
        "refused_schema"),
    "a picture": (400, "cannot identify image file <_io.BytesIO object at 0x7f2a>", "refused_400"),
    "words that nobody knows": (400, NOT_KNOWN, "refused_400"),
    "markup and escapes": (400, '[bold]\x1b[31m<script>alert("x")</script>\nnext\x00line[/] %s {0}', "refused_400"),
}  # fmt: skip


@each("name", WINDOW_FAULTS)
def test_what_is_a_windows_fault_costs_that_window_and_is_kept_in_the_servers_words(tree, tmp_path, whole, name):
    status, text, reason = WINDOW_FAULTS[name]
    out = tmp_path / "out"
    with deciding(respond=lambda body: refusal(status, text) if body["seed"] == whole[1][0] else None) as server:
        path = run(settings(server.url), tree, out)
        assert report_of(out)["windows"] == {"input": 10, "kept": 9, "dropped": {}, "failed": {"refused": 1}}
        how = Counter(caption.teacher.structured for caption in read_captions(path))
        assert how == {"json_schema": 9, None: 1}  # nobody else lost the schema
        [dropped] = [caption for caption in read_captions(path) if caption.status == "dropped"]
        [held] = quarantine(out).values()
        words = report_of(out)["refusals"][reason]
        assert held == {"id": dropped.sample_id, "code": reason, "message": words}
        assert dropped.checks.refusal == f"{reason}: {words}"
        assert words.startswith(f"HTTP {status} ")
        assert words.isprintable()
        assert text.split("\n")[0].replace("\x1b", "?")[:60] in words
        page = (out / "report.html").read_text(encoding="utf-8")
        assert "<script>" not in page
        assert reason in page
    assert run(settings(server.url), tree, out) == path  # complete: the server, which is gone, is not asked


def test_a_retry_that_stops_loses_and_doubles_nothing(tree, tmp_path, whole):
    out, status = tmp_path / "out", 400

    def respond(body: dict) -> tuple[int, dict] | None:
        return refusal(status, TOO_LONG) if body["seed"] == whole[1][0] else None

    with deciding(respond=respond) as server:
        first = run(settings(server.url), tree, out).read_bytes()
        status = 401
        with pytest.raises(TeacherError):
            run(settings(server.url), tree, out, retry_failed=True)
        ids = [caption.sample_id for caption in read_captions(out / "captions.jsonl")]
        assert 5 <= len(ids) == len(set(ids))
        flights = report_of(out)["flights"]
        assert flights["input"] == flights["kept"]
        status = 400
        assert run(settings(server.url), tree, out).read_bytes() == first


def test_what_a_model_declined_is_asked_again(tree, tmp_path, whole):
    message = {"content": None, "refusal": "I cannot help with that."}
    completion = {"choices": [{"message": message, "finish_reason": "stop"}], "usage": None}
    out, answer = tmp_path / "out", (200, completion)
    with deciding(respond=lambda body: answer) as server:
        for retry_failed in (False, True):
            with pytest.raises(NothingKept, match=r"10 declined \(the model declined to answer"):
                run(settings(server.url), tree, out, retry_failed=retry_failed)
        answer = None
        assert run(settings(server.url), tree, out, retry_failed=True).read_bytes() == whole[0]


def test_an_error_about_refused_windows_alone_names_the_cause(tree, tmp_path):
    cause = r"fix the causes \(10 refused \(the server or engine refused"
    with deciding(respond=lambda body: refusal(400, TOO_LONG)) as server, pytest.raises(NothingKept, match=cause):
        run(settings(server.url), tree, tmp_path / "out")


@each(("status", "text"), [
    (400, "This response_format type is unavailable now"), (422, "response_format.type `json_schema` is unavailable now"),
    (200, "response_format is not supported by this provider"),
])  # fmt: skip
def test_a_server_that_refuses_the_schema_is_asked_without_it(tree, tmp_path, status, text):
    with deciding(respond=lambda body: refusal(status, text) if "response_format" in body else None) as server:
        path = run(settings(server.url, limit=4, endpoint={"concurrency": 1, "max_tries": 1}), tree, tmp_path / "out")
    assert sum(b"response_format" in body for body in server.bodies) == 1
    assert len(server.bodies) == 8 + 1
    assert [caption.teacher.structured for caption in read_captions(path)] == ["plain"] * 4
    assert report_of(tmp_path / "out")["refusals"] == {}
