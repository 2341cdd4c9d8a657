"""A language model as the planner: the question, and what is read of its answer.

Client, journal and budget are those of a teacher; `cosfly caption doctor URL` examines its endpoint.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from cosfly.chat.answers import AnswerBook, KeptAnswers
from cosfly.chat.budget import Budget, BudgetConfig
from cosfly.chat.client import ChatClient, EndpointConfig
from cosfly.chat.contract import NoAnswer, Reply, started
from cosfly.errors import TeacherError
from cosfly.reading.documents import validated
from cosfly.reading.objects import find_object
from cosfly.work.folder_lock import hold_folder
from cosfly.work.store import sha256_bytes
from cosfly.worlds.objects import OBJECTS
from cosfly.worlds.plan import WorldPlan

TASK = """You plan a town for a generator that lays out streets, blocks and buildings. The user says what it shall be.
Answer with one JSON object and nothing else. It has these fields, each of them optional:
{fields}
In `objects`, list once, with its count, everything that the user names and this table holds: {objects}.
What the user names and neither the table nor a field holds goes into `not_in_table`, by its name.
Choose ranges wide enough that a town drawn at random meets them, and as narrow as what the user says."""


def plan_by_model(
    prompt: str, seed: int, url: str, endpoint: EndpointConfig, budget: BudgetConfig, cache: Path
) -> tuple[WorldPlan, dict[str, Any]]:
    """Ask a model for the plan of a prompt, or take the answer that it gave before to the same prompt and seed.

    Returns:
        the plan, and the trace: what was asked and answered, to the letter.
    """
    schema = WorldPlan.model_json_schema()
    fields = "\n".join(
        f"- {name}: {one.description}; else {one.default!r}" for name, one in WorldPlan.model_fields.items()
    )
    task = TASK.format(fields=fields, objects=", ".join(OBJECTS))
    messages = [{"role": "system", "content": task}, {"role": "user", "content": prompt}]
    request = endpoint.request(messages, [], schema, seed)
    model, reply = asyncio.run(_ask(request, url, endpoint, budget, cache, sha256_bytes(prompt.encode())[:16]))
    trace = {
        "planner": "model", "url": url, "model": model, "seed": seed, "messages": messages, "answer": reply.text,
        "finish_reason": reply.finish_reason, "usage": reply.usage.model_dump() if reply.usage else None,
    }  # fmt: skip
    return plan_of(reply.text, reply.finish_reason, f"{url}: plan"), trace


def plan_of(text: str, finish_reason: str | None, where: str) -> WorldPlan:
    """Read the plan out of a model's answer; raises TeacherError where there is none, InputError for one that cannot
    be."""
    found = find_object(text, WorldPlan.model_fields.keys(), finish_reason)
    if found.value is None:
        raise TeacherError(
            "the planner's answer holds no plan",
            where=where,
            got=f"{found.reason}: {' '.join(text.split())[:80]!r}",
            expected="a JSON object",
            fix="try another --seed, prompt or model, or leave out --planner: the rules need no model",
        )
    return validated(WorldPlan, found.value, where)


async def _ask(
    request: Any, url: str, endpoint: EndpointConfig, budget: BudgetConfig, cache: Path, name: str
) -> tuple[str, Reply]:
    client = ChatClient(url, endpoint)
    with hold_folder(cache), AnswerBook(cache) as book:
        async with started(client):
            limit = Budget(budget, book.totals, first_prompt=1500, first_completion=endpoint.max_tokens)
            try:
                return client.model, await KeptAnswers(client, book, limit).ask(request, name, name, "plan")
            except NoAnswer as error:
                raise TeacherError(
                    "the planner gave no answer", where=url, got=str(error), fix=error.fix or None
                ) from None
