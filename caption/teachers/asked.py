"""A model that is asked beside the teacher, a judge or a reader: its most likely answer, kept as a teacher's is, within
the same budget."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from math import sqrt

from rich.table import Table

from caption.schema import AskedConfig
from cosfly.chat.answers import AnswerBook, KeptAnswers
from cosfly.chat.budget import Budget
from cosfly.chat.client import ChatClient, EndpointConfig
from cosfly.chat.contract import Reply, Request, Troubles, started
from cosfly.products.places import flight_of


@dataclass(frozen=True)
class AskedModel:
    kept: KeptAnswers
    cfg: AskedConfig
    seed: int

    @property
    def name(self) -> str:
        return self.kept.engine.model

    async def ask(self, messages: list[dict], schema: dict, sample_id: str, purpose: str) -> Reply:
        """Ask about a window; raises as `KeptAnswers.ask`."""
        sampling = {"temperature": 0.0, "seed": self.seed, "max_tokens": self.cfg.max_tokens, **self.cfg.extra_body}
        request = Request(messages, [], schema, sampling)
        return await self.kept.ask(request, flight_of(sample_id), sample_id, purpose)


@asynccontextmanager
async def open_models(
    cfg: AskedConfig,
    where: Sequence[tuple[str, str | None]],
    seed: int,
    book: AnswerBook | None = None,
    budget: Budget | None = None,
    troubles: Troubles | None = None,
) -> AsyncIterator[list[AskedModel]]:
    """Connect to models.

    Args:
        where: URL and name of each; None takes the endpoint's only one.
        book: keeps the answers; None: they are not kept. budget: None sets no limit. troubles: notes tries that fail.
    """
    settings = cfg.model_dump(include=EndpointConfig.model_fields.keys() - {"model", "max_tokens", "extra_body"})
    async with AsyncExitStack() as stack:
        models = []
        for url, name in where:
            client = ChatClient(url, EndpointConfig(**settings, model=name), troubles)
            await stack.enter_async_context(started(client))
            models.append(AskedModel(KeptAnswers(client, book, budget), cfg, seed))
        yield models


def figures_table(title: str) -> Table:
    """Give an empty table of figures for the terminal."""
    table = Table(title=title, title_justify="left")
    for column in ("figure", "value", "meaning"):
        table.add_column(column)
    return table


def share_text(count: int, total: int) -> str:
    """Give a share with its 95 % interval (Wilson 1927)."""
    low, high = interval(count, total)
    return f"{100 * count / max(1, total):.1f} % [{100 * low:.1f} to {100 * high:.1f}]"


def interval(count: int, total: int) -> tuple[float, float]:
    if not total:
        return 0.0, 1.0
    z, share = 1.96, count / total
    middle, scale = share + z * z / (2 * total), 1 + z * z / total
    half = z * sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)
