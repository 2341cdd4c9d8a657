"""One contract test over every engine: what it answers, how it refuses, and that it stands behind a teacher as it
is."""

from __future__ import annotations

import asyncio
import json
from contextlib import contextmanager
from pathlib import Path

import pytest
from specimens_captions import settings
from teacher_server import CHINESE, ENGLISH, TeacherServer, is_mirror, kept_answers

from caption.run.stage import run
from caption.teachers import teacher
from cosfly.chat.answers import AnswerBook, KeptAnswers
from cosfly.chat.client import ChatClient, EndpointConfig
from cosfly.chat.contract import NoAnswer, Reply, Request, started
from cosfly.errors import TeacherError
from cosfly.products.answer_text import answer_schema, parse_answer
from cosfly.products.captions import Usage, read_captions

SAMPLING = EndpointConfig(max_tries=1, max_tokens=64)


class PlainEngine:
    """The engine of the recipe in docs/extending.md: a function of the request, in this process."""

    kind, where, model = "endpoint", "plain", ""

    def __init__(self) -> None:
        self.num_answers = self.num_closed = 0

    async def start(self) -> None:
        self.model = "plain-1"

    async def answer(self, request: Request) -> Reply:
        if "refuse me" in json.dumps(request.messages):
            raise NoAnswer("refused", "as asked", is_final=True)
        self.num_answers += 1
        await asyncio.sleep(0)
        decision = request.schema["properties"]["flight_decision"]["enum"][0]
        texts = CHINESE if is_mirror({"messages": request.messages}) else ENGLISH
        decisions = {name: decision for name in request.schema["properties"] if name not in texts}
        return Reply(
            json.dumps({**texts, **decisions}), Usage(prompt_tokens=1000, completion_tokens=100), "json_schema", "stop"
        )

    async def close(self) -> None:
        self.num_closed += 1


@contextmanager
def endpoint():
    fault = lambda number, body: "413" if "refuse me" in json.dumps(body) else None  # noqa: E731
    with TeacherServer(fault, decision=lambda body: "track_straight") as server:
        yield ChatClient(server.url, SAMPLING)


@contextmanager
def plain():
    yield PlainEngine()


ENGINES = {"endpoint": endpoint, "plain": plain}  # vLLM has a file of its own: test_caption_vllm.py


def request_of(text: str, seed: int = 0) -> Request:
    return SAMPLING.request([{"role": "user", "content": [{"type": "text", "text": text}]}], [], answer_schema(), seed)


@pytest.mark.parametrize("name", ENGINES)
def test_many_requests_at_once_are_answered_each_by_its_own(name):
    async def ask(engine) -> list[Reply]:
        async with started(engine):
            assert engine.model
            return await asyncio.gather(*(engine.answer(request_of("go", seed)) for seed in range(12)))

    with ENGINES[name]() as engine:
        replies = asyncio.run(ask(engine))
    assert len(replies) == 12
    assert all(parse_answer(reply.text).coc is not None for reply in replies)
    assert all(reply.usage == Usage(prompt_tokens=1000, completion_tokens=100) for reply in replies)
    assert all(reply.structured in ("json_schema", "plain") and reply.finish_reason == "stop" for reply in replies)


@pytest.mark.parametrize("name", ENGINES)
def test_a_request_that_gets_no_answer_costs_no_other(name):
    async def ask(engine):
        async with started(engine):
            return await asyncio.gather(
                engine.answer(request_of("refuse me")), engine.answer(request_of("go")), return_exceptions=True
            )

    with ENGINES[name]() as engine:
        refused, answered = asyncio.run(ask(engine))
    assert isinstance(refused, NoAnswer)
    assert refused.is_final
    assert isinstance(answered, Reply)


@pytest.mark.parametrize("name", ENGINES)
def test_what_is_kept_is_not_asked_again(name, tmp_path):
    async def ask(engine) -> list[Reply]:
        async with started(engine):
            replies = []
            for _ in range(2):
                with AnswerBook(tmp_path / "answers") as book:
                    kept = KeptAnswers(engine, book)
                    replies.append(await kept.ask(request_of("go"), "flight", "flight_frame_00004", "free/0"))
            return replies

    with ENGINES[name]() as engine:
        first, second = asyncio.run(ask(engine))
    assert first == second
    [record] = kept_answers(tmp_path)
    assert (record["model"], record["sample_id"], record["purpose"]) == (engine.model, "flight_frame_00004", "free/0")


def test_two_that_ask_the_same_at_once_pay_once(tmp_path):
    engine = PlainEngine()

    async def ask() -> list[Reply]:
        async with started(engine):
            with AnswerBook(tmp_path / "answers") as book:
                kept = KeptAnswers(engine, book)
                asked = [kept.ask(request_of("go"), "flight", f"flight_frame_{i:05d}", "judge") for i in range(5)]
                return await asyncio.gather(*asked)

    assert len(set(asyncio.run(ask()))) == 1
    assert engine.num_answers == len(kept_answers(tmp_path)) == 1


def test_an_engine_is_closed_whatever_came_of_its_start():
    class Broken(PlainEngine):
        async def start(self) -> None:
            raise TeacherError("cannot start", where="here")

    async def open_it(engine) -> None:
        async with started(engine):
            pytest.fail("it has not started")

    broken = Broken()
    with pytest.raises(TeacherError):
        asyncio.run(open_it(broken))
    assert broken.num_closed == 1


def test_the_engine_of_the_recipe_captions_a_flight(tree, tmp_path: Path, monkeypatch):
    engine = PlainEngine()
    monkeypatch.setattr(teacher, "make_engine", lambda cfg, troubles: engine)
    cfg = settings("http://plain", mirror_asks=1)
    captions = list(read_captions(run(cfg, tree, tmp_path / "out")))
    assert len(captions) == 5
    for caption in captions:
        teacher_told = caption.teacher.kind, caption.teacher.model, caption.teacher.structured
        assert teacher_told == ("endpoint", "plain-1", "json_schema")
        assert caption.usage.prompt_tokens == 1000 * caption.attempts
    assert engine.num_answers == len(kept_answers(tmp_path / "out")) == sum(caption.attempts for caption in captions)
    assert engine.num_closed == 1
