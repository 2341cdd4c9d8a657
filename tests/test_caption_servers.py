"""How servers misbehave, and what becomes of a whole run: the table. The next one that is met is a line in it.

What stands before a colon is whose behaviour it is; where a public thread shows it, the thread is named beside. The
others are what nobody sends by mistake. Each run asks about one window, in two languages, with two tries; then the
server is mended, and the same command is run again.

The endpoint's doctor against servers with one defect each.
"""

import gzip
import json
import re
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import pytest
from commands import invoke
from specimens_captions import VOCABULARY, deciding, report_of
from specimens_captions import settings as quick
from teacher_server import ENGLISH, MODEL, USAGE, Sent, TeacherServer, Wild, completion, obedient_answer, refusal

from caption.schema import CaptionConfig
from caption.stage.stage import run
from caption.teachers.doctor import ODD_WORD, Finding, examine_endpoint
from cosfly.llm.client import KEY_VARIABLE, ChatClient, EndpointConfig
from cosfly.llm.protocol import MEANINGS
from cosfly.llm.student_chat import StudentEndpointConfig
from cosfly.runtime.errors import NothingKept, TeacherError
from distill.inference.samples import InferConfig
from specimens import make_playback_tree

TRIES = 2


def settings(url: str, **changes) -> CaptionConfig:
    # Slow servers are slow for ever: the limit is what a good answer never takes here, however busy the machine is.
    endpoint = {"timeout_s": 60.0, "concurrency": 1} | changes.pop("endpoint", {})
    return quick(url, endpoint=endpoint, **{"limit": 1, **changes})


@pytest.fixture(autouse=True)
def small_replies(monkeypatch):
    monkeypatch.setattr("cosfly.llm.client.MOST_REPLY_MB", 0.5)


@pytest.fixture(scope="module")
def whole(tree, tmp_path_factory) -> bytes:
    with deciding() as server:
        return run(settings(server.url), tree, tmp_path_factory.mktemp("whole") / "out").read_bytes()


def answer(body: dict) -> dict:
    return completion(body, json.dumps(obedient_answer(_OBEDIENT, body), ensure_ascii=False))


_OBEDIENT = deciding()


def message(**fields) -> Callable[[dict], Sent]:
    def sent(body: dict) -> Sent:
        value = answer(body)
        value["choices"][0]["message"] |= fields
        return Sent(200, json.dumps(value).encode())

    return sent


def page(status: int, text: str, **headers: str) -> Callable[[dict], Sent]:
    sent = Sent(status, text.encode(), {name.replace("_", "-"): value for name, value in headers.items()})
    return lambda body: sent


def error(status: int, text: str, **headers: str) -> Callable[[dict], Sent]:
    return page(status, json.dumps({"error": {"message": text, "type": "server_error", "code": status}}), **headers)


def raw(*pieces: bytes, pause_s: float = 0.0, is_endless: bool = False) -> Callable[[dict], Wild]:
    """Write these bytes to the connection and close it; endless: until the client goes away."""

    def write(wire: BinaryIO) -> None:
        for piece in pieces[:1] if is_endless else pieces:
            wire.write(piece)
            time.sleep(pause_s)
        end_s = time.monotonic() + 60
        while is_endless and time.monotonic() < end_s:
            wire.write(pieces[-1])
            wire.flush()
            time.sleep(pause_s)

    return lambda body: write


BOMB = gzip.compress(bytes(20_000_000))
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"


Outcome = tuple[type[Exception], str, int, str | None]  # of a run; words of it; requests it took; why no answer is held


def silent(cause: str, words: str = "", num_asked: int = TRIES) -> Outcome:
    """The window has no answer, and is asked again when the server is mended."""
    return TeacherError, words, num_asked, cause


IMPATIENT = {"timeout_s": 3.0, "max_tries": 1}  # long enough for the list of models on a busy machine
FAULTS: dict[str, tuple] = {
    "vLLM: 500, a library of grammars is missing, vllm 16030": (
        error(500, "xgrammar.so: cannot open shared object file: outlines is not installed either"),
        silent("http_500")),
    "a gateway: 307 elsewhere, letta 3189": (page(307, "", Location="http://127.0.0.1:1/v1/chat/completions"),
        (TeacherError, "not a chat endpoint", 1, None)),
    "nobody: a refusal without end": (raw(b"HTTP/1.1 500 No\r\n\r\n", b"no " * 99_999, is_endless=True),
        silent("http_500", "no no no")),
    "nobody: Retry-After 1e18": (error(429, "busy", Retry_After="1e18"), silent("total_timeout",
        "asks to wait 1000000000000000000 s", 1)),
    # dropped for good: the answer was one, and is not paid for twice
    "nobody: thoughts without end": (message(content="<think>" + "a <think> {" * 30_000),
        (NothingKept, "", 3, "structure")),
    "nobody: a bomb of gzip": (lambda body: Sent(200, BOMB, {"Content-Encoding": "gzip"}), silent("connection",
        "the response is compressed")),
    "nobody: a stream without end": (raw(CHUNKED, b"1000\r\n" + b" " * 4096 + b"\r\n", is_endless=True),
        silent("bad_reply", "longer than 0.5 MB")),
    "Langchain-Chatchat: chunks that end early, its 4383": (raw(CHUNKED, b"5\r\n{\"a\":\r\n"), silent("connection",
        "incomplete chunked read")),
    "llama.cpp: nothing at all, llama.cpp 11738": (raw(b""), silent("connection")),
    "nobody: headers that never end": (raw(HEAD, b"X: y\r\n", pause_s=0.02, is_endless=True), silent("timeout",
        "within 3 s"), IMPATIENT),
    "nobody: a byte now and then": (raw(HEAD + b"Content-Length: 9999\r\n\r\n", b" ", pause_s=0.02, is_endless=True),
        silent("timeout", "raise the limit, such as caption.endpoint.timeout_s=6"), IMPATIENT),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_what_becomes_of_a_run_at_a_server_like_this(tree, tmp_path, whole, name):
    respond, (error_kind, words, most_asked, cause), *patience = FAULTS[name]
    out = tmp_path / "out"
    with deciding(respond=respond) as server:
        with pytest.raises(error_kind, match=re.escape(words) or None):
            run(settings(server.url, endpoint=patience[0] if patience else {}), tree, out)
        # One who waits so short a time may be gone before a busy server has read what was asked, which then comes late.
        asked = len(server.bodies)
        assert asked <= most_asked if patience else asked == most_asked
        assert windows_of(out) == Counter([cause] if cause else [])
        server.respond = None  # it is mended
        if error_kind is NothingKept:
            with pytest.raises(NothingKept):
                run(settings(server.url), tree, out)
            assert len(server.bodies) == asked
        else:
            path = run(settings(server.url), tree, out)
            assert without_tokens(path.read_bytes()) == without_tokens(whole)
            assert len(server.bodies) >= asked + 2 if patience else len(server.bodies) == asked + 2


def events(body: dict) -> Sent:
    """Stream the answer, whatever the request says."""
    text = answer(body)["choices"][0]["message"]["content"]
    deltas = {"role": "assistant"}, {"reasoning_content": "Hm."}, {"content": text[:9]}, {"content": text[9:]}
    chunks = [{"choices": [{"index": 0, "delta": delta, "finish_reason": None}]} for delta in deltas]
    chunks += [{"choices": [{"index": 0, "delta": {}, "finish_reason": "stop"}]}, {"choices": [], "usage": USAGE}]
    lines = [": processing", *(f"data: {json.dumps(chunk)}" for chunk in chunks), "data: [DONE]"]
    return Sent(200, "\n\n".join(lines).encode())


def once(first: Callable[[dict], Sent]) -> Callable[[dict], Sent | None]:
    """Send something else for the first request."""
    seen: list[dict] = []

    def respond(body: dict) -> Sent | None:
        seen.append(body)
        return first(body) if len(seen) == 1 else None

    return respond


def cut_after(num_tokens: int) -> Callable[[dict], Sent]:
    """Answer with nothing but thoughts, to this length."""
    choice = {"message": {"role": "assistant"}, "finish_reason": "length"}
    return page(200, json.dumps({"choices": [choice], "usage": USAGE | {"completion_tokens": num_tokens}}))


NO_SYSTEM = refusal(400, "System role not supported")
ONE_ONLY = refusal(400, "`temperature` and `top_p` cannot both be specified for this model. Please use only one.")
# A server that has to be understood: what it sends, settings, what becomes of the window, words of the report.
UNDERSTOOD: dict[str, tuple] = {
    "streams in spite of stream: false": (events, {}, "accepted", ""),
    "loads its model": (once(error(503, "Loading model")), {}, "accepted", ""),
    "a gateway: 200 with a code": (once(page(200, '{"code": 429, "msg": "concurrency limit exceeded"}')),
        {"max_tries": 2}, "accepted", ""),
    "no system role": (lambda body: NO_SYSTEM if body["messages"][0]["role"] == "system" else None, {}, "accepted", ""),
    "refuses all roles": (error(400, "Conversation roles must alternate user/assistant/user/assistant/..."), {},
        "refused", "roles must alternate"),
    "temperature or top_p": (lambda body: ONE_ONLY if {"temperature", "top_p"} <= body.keys() else None,
        {"extra_body": {"top_p": None}}, "accepted", ""),
    "its thoughts use up all tokens": (cut_after(0), {}, "structure", ""),
    "vLLM: its context is full": (cut_after(7), {}, "context_full", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", UNDERSTOOD)
def test_a_server_is_understood(tree, tmp_path, name):
    respond, endpoint, outcome, words = UNDERSTOOD[name]
    out = tmp_path / "out"
    with deciding(respond=respond) as server, nullcontext() if outcome == "accepted" else pytest.raises(NothingKept):
        run(settings(server.url, endpoint={"max_tries": 1, **endpoint}), tree, out)
    assert all(json.loads(body)["stream"] is False for body in server.bodies)
    report = report_of(out)
    windows = report["windows"]
    assert windows["kept"] == (outcome == "accepted")
    assert windows["dropped"] | windows["failed"] == ({} if outcome == "accepted" else {outcome: 1})
    assert words in str(report["refusals"])


def test_a_full_address_is_used_as_given(tree, tmp_path):
    with deciding(list_models=lambda: Sent(404, b"")) as server:
        url = server.url.removesuffix("/v1") + "/api/chat/completions"
        run(settings(url, endpoint={"model": MODEL}), tree, tmp_path / "out")
        assert set(server.paths) == {"/api/chat/completions"}


def test_prompts_that_a_server_cuts_in_silence_are_reported(tmp_path, caplog):
    caplog.set_level("INFO")
    tree = make_playback_tree(tmp_path / "tree", 1, 24, with_augmented=False)
    with deciding() as server:  # counts 1,000 tokens for every prompt
        run(settings(server.url, limit=15), tree, tmp_path / "out")
    assert "all count 1000 tokens" in caplog.text
    assert caplog.text.count("the first request is sent, with a limit of 60 s") == 1


def without_tokens(product: bytes) -> list[dict]:
    return [json.loads(line) | {"usage": 0} for line in product.splitlines()]


def windows_of(out: Path) -> Counter[str]:
    held = [json.loads(line)["code"] for line in (out / "quarantine.jsonl").read_text(encoding="utf-8").splitlines()]
    if not (out / "caption_report.json").exists():
        return Counter(held)
    tally = report_of(out)["windows"]
    return Counter(kept=tally["kept"]) + Counter(tally["dropped"]) + Counter(held)


# What is sent in place of the list of models, and what the run says; or that it goes on.
LISTS: dict[str, tuple] = {
    "an error": (page(500, "broken"), "HTTP 500 broken"),
    "401 that quotes the key": (page(401, "bad key sk-very-secret"), "refuses the API key; got HTTP 401 bad key ***"),
    "403 in the words of a filter": (page(403, "flagged by our safety system"), "refuses the API key; got HTTP 403 flagged"),
    "names of wrong types": (page(200, json.dumps({"data": [{"id": 7}, {"id": "a\x1b[2J"}, "b", {"id": "x" * 999},
        {"id": MODEL}]})), None),
    "ten thousand models": (page(200, json.dumps({"data": [{"id": f"m{i}"} for i in range(10_000)]})),
        "has several models; got 10000 models"),
    "a body of 20 MB": (page(200, " " * 20_000_000), "does not return a list of models"),
    "headers that never end": (raw(HEAD, b"X: y\r\n", pause_s=0.02, is_endless=True),
        "cannot reach the server; got no answer within 0.3 s"),
}  # fmt: skip


@pytest.mark.parametrize("name", LISTS)
def test_what_becomes_of_a_run_at_a_list_of_models_like_this(tree, tmp_path, monkeypatch, whole, name):
    monkeypatch.setenv(KEY_VARIABLE, "sk-very-secret")
    respond, words = LISTS[name]
    out = tmp_path / "out"
    with deciding(list_models=lambda: respond({})) as server:
        if words is not None:
            impatient = {"timeout_s": 0.3} if "0.3 s" in words else {}
            with pytest.raises(TeacherError) as caught:
                run(settings(server.url, endpoint=impatient), tree, out)
            assert words in str(caught.value)
            assert "very-secret" not in str(caught.value)
            assert not server.bodies
            server.list_models = None  # it is mended
        assert run(settings(server.url), tree, out).read_bytes() == whole
    assert len(server.bodies) == 2


def test_the_key_does_not_follow_a_redirect(tree, tmp_path, monkeypatch):
    monkeypatch.setenv(KEY_VARIABLE, "sk-very-secret")
    with deciding() as elsewhere:
        for status in (301, 302, 303, 307, 308):
            sent = Sent(status, b"", {"Location": f"{elsewhere.url}/chat/completions"})
            with deciding(respond=lambda body, sent=sent: sent) as server, pytest.raises(TeacherError):
                run(settings(server.url), tree, tmp_path / str(status))
            assert len(server.bodies) == 1
        assert not elsewhere.bodies


TOKENS_PER_IMAGE, CONTEXT = 220, 8192


def parts_of(body: dict) -> list[dict]:
    contents = (message["content"] for message in body["messages"])
    return [part for one in contents for part in ([{"text": one}] if isinstance(one, str) else one)]


# A sound endpoint. cuts: prompts to so many tokens, in silence. shortens: the answer to fit the context, in silence. status: of a refusal for too many pictures. in_parts: the answer is a list of parts. takes_null: where a field may be null.
SOUND = {
    "obeys_schema": True, "refuses_schema": False, "max_images": 15, "sees_images": 99, "thinks": False, "counts": True,
    "context": CONTEXT, "shortens": False, "empty": False, "status": 400, "in_parts": False, "takes_null": True,
    "cuts": 10**6, "has_system": True, "most_bytes": 10**9,
}  # fmt: skip


def patient(**defects: Any) -> Callable[[dict], tuple[int, dict]]:
    """A server's behaviour: what it answers to any request."""
    own = SimpleNamespace(**SOUND | defects)

    def respond(body: dict) -> tuple[int, dict]:
        parts = parts_of(body)
        num_images = sum(part.get("type") == "image_url" for part in parts)
        if None in body.values() and not own.takes_null:
            return refusal(400, "Input should be a valid number")
        if body["messages"][0]["role"] == "system" and not own.has_system:
            return NO_SYSTEM
        if len(json.dumps(body)) > own.most_bytes:
            return refusal(413, "Request Entity Too Large")
        num_words = sum(len(part.get("text", "").split()) for part in parts)
        tokens = min(num_words + TOKENS_PER_IMAGE * min(num_images, own.sees_images), own.cuts)
        if num_images > own.max_images:
            return refusal(own.status, f"At most {own.max_images} image(s) may be provided in one prompt.")
        if tokens + (0 if own.shortens else body["max_tokens"]) > own.context:
            return refusal(400, f"This model's maximum context length is {own.context} tokens")
        wanted = body.get("response_format", {}).get("json_schema", {}).get("schema")
        if wanted and own.refuses_schema:
            return refusal(400, "response_format is not supported")
        text = "I am fine, thank you."
        if wanted and own.obeys_schema:
            plain = {**ENGLISH, **dict.fromkeys(("therefore", "flight_decision"), "hover")}
            text = json.dumps({"animal": ODD_WORD, "legs": 7} if "animal" in wanted["properties"] else plain)
        elif isinstance(body["messages"][-1]["content"], list) and body["messages"][0]["role"] == "system":
            text = "Here it is: " + json.dumps(dict.fromkeys(ENGLISH, "hover"))
        text = "" if own.empty else text
        message: dict[str, Any] = {"role": "assistant", "content": text}
        if own.thinks:
            message["reasoning_content"] = "Let me think about that."
        if own.in_parts:
            message["content"] = [{"type": "text", "text": text}]
        is_cut = own.shortens and tokens + body["max_tokens"] > own.context
        usage = {"usage": {"prompt_tokens": tokens, "completion_tokens": 5}} if own.counts else {}
        return 200, {"choices": [{"message": message, "finish_reason": "length" if is_cut else "stop"}], **usage}

    return respond


def examine(behaviour: Callable, context: int = CONTEXT, **changes) -> dict[str, Finding]:
    listed = Sent(200, json.dumps({"data": [{"id": MODEL, "max_model_len": context}]}).encode())
    with TeacherServer(respond=behaviour, list_models=lambda: listed) as server:
        cfg = CaptionConfig.model_validate(changes)
        return {finding.name: finding for finding in examine_endpoint(server.url, cfg, VOCABULARY)}


def test_a_sound_endpoint_passes_every_check():
    findings = examine(patient())
    assert {finding.state for finding in findings.values()} == {"ok"}
    assert list(findings) == ["model", "answers", "thinking", "JSON schema", "image input", "context length", "speed"]
    assert f"{15 * TOKENS_PER_IMAGE} tokens" in findings["image input"].detail


# defect, the finding it must show in, its state, words of the detail
DEFECTS = [
    ({"obeys_schema": False}, "JSON schema", "warning", "accepted but ignored"),
    ({"refuses_schema": True}, "JSON schema", "warning", "refused"),
    ({"max_images": 5}, "image input", "unusable", "At most 5 image(s)"),
    ({"max_images": 5, "status": 200}, "image input", "unusable", "--limit-mm-per-prompt"),
    ({"sees_images": 0}, "image input", "unusable", "accepted but ignored"),
    ({"counts": False}, "image input", "warning", "token usage is not reported"),
    ({"thinks": True}, "thinking", "warning", "switch thinking off"),
    ({"context": 5000}, "context length", "unusable", "--max-model-len"),
    ({"cuts": 4096}, "context length", "unusable", "drops the rest without an error"),
    ({"has_system": False}, "system role", "warning", "sent with the question"),
    ({"most_bytes": 300_000}, "image input", "unusable", "the request has 0.9 MB"),
    ({"context": 6000, "shortens": True}, "context length", "unusable", "more than 6000"),
    ({"context": 6000, "shortens": True}, "answer length", "warning", "raise this limit (a good answer"),
    ({"empty": True}, "answers", "unusable", "an empty answer"),
    ({"empty": True, "thinks": True}, "answers", "unusable", "enable_thinking: false"),
]


@pytest.mark.parametrize(("defects", "settings", "name", "words"), [
    ({"in_parts": True, "takes_null": False}, {"endpoint": {"extra_body": {"temperature": None}}}, "answers", ""),
    ({"refuses_schema": True}, {"endpoint": {"json_schema": False}}, "JSON schema", "switched off"),
    ({"max_images": 0}, {"image": {"modalities": []}}, "answers", ""),
])  # fmt: skip
def test_what_the_settings_do_without_is_no_defect(defects, settings, name, words):
    findings = examine(patient(**defects), **settings)
    assert {finding.state for finding in findings.values()} == {"ok"}
    assert words in findings[name].detail


@pytest.mark.parametrize(("defect", "name", "state", "words"), DEFECTS, ids=lambda value: str(value))
def test_a_defect_is_found(defect, name, state, words):
    findings = examine(patient(**defect), defect.get("context", CONTEXT))
    assert findings[name].state == state
    assert words in findings[name].detail


def test_a_slow_answer_to_the_largest_prompt_is_no_matter_of_the_context():
    slow, sound = raw(HEAD, b"X: y\r\n", pause_s=0.02, is_endless=True), patient()

    def respond(body: dict) -> tuple[int, dict]:
        return (slow if body["messages"][0]["role"] == "system" else sound)(body)

    findings = examine(respond, image={"modalities": []}, endpoint={"timeout_s": IMPATIENT["timeout_s"]})
    assert list(findings) == ["model", "answers", "thinking", "JSON schema", "speed"]
    assert findings["speed"].state == "unusable"
    words = (
        r"an answer of 1024 tokens takes \d+ s(, so it is probably the prompt .*)?; set caption.endpoint.timeout_s=\d+,"
    )
    assert re.search(r"at [\d.]+ tokens/s.* " + words, findings["speed"].detail)


def test_the_command_exits_with_1_when_unusable():
    with TeacherServer(respond=patient()) as server:
        assert invoke("caption doctor", server.url).exit_code == 0
    with TeacherServer(respond=patient(max_images=0)) as server:
        assert invoke("caption doctor", server.url).exit_code == 1


def test_a_fix_names_settings_of_its_client():
    sections = {"caption": CaptionConfig(), "distill.infer": InferConfig()}
    for cfg, own in ((EndpointConfig(), "caption"), (StudentEndpointConfig(), "distill.infer")):
        client = ChatClient("http://h", cfg)
        for meaning in MEANINGS.values():
            named = re.findall(r"\b((?:caption|distill\.infer)(?:\.[a-z_]+)+)", client.fix_of(meaning))
            assert {name.startswith(own) for name in named} <= {True}, named
            for name in named:
                attrgetter(name.removeprefix(f"{own}."))(sections[own])
        assert f"{own}.endpoint.timeout_s" in client.message_of(TimeoutError())
