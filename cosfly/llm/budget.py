"""The budget of tokens and money of an output directory.

All runs into one folder count, from the journal, so that repeating a command does not spend the budget twice. A request
is sent only if it and all in flight, each taken at the largest size so far, fit; until then it waits. If it does
not fit alone, the budget is spent.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator
from typing import Self

from pydantic import Field, model_validator

from cosfly.formats.captions import Usage
from cosfly.runtime.config import Config
from cosfly.runtime.errors import TeacherError

MILLION = 1_000_000
BYTES_PER_TOKEN = 3  # a low guess, so that the budget holds
PIXELS_PER_TOKEN = 28 * 28  # of common vision encoders


class BudgetConfig(Config):
    """Limits over all runs into one folder, a judge's tokens included."""

    price_prompt: float = Field(0.0, ge=0, description="price of a million prompt tokens, in your currency")
    price_completion: float = Field(0.0, ge=0, description="price of a million answer tokens, in your currency")
    max_cost: float | None = Field(None, gt=0, description="stop before this cost is exceeded; empty: no limit")
    max_tokens: int | None = Field(None, ge=1, description="stop before this many tokens are exceeded; empty: no limit")

    @model_validator(mode="after")
    def _priced(self) -> Self:
        if self.max_cost is not None and self.price_prompt == self.price_completion == 0:
            raise ValueError("max_cost needs price_prompt or price_completion; without a price it is never reached")
        return self

    def cost(self, prompt_tokens: float, completion_tokens: float) -> float:
        """Return the price of some tokens."""
        return (prompt_tokens * self.price_prompt + completion_tokens * self.price_completion) / MILLION


class BudgetSpent(TeacherError):
    """The next request might exceed a limit; `what` says which."""


class Budget:
    """The shared budget of several journals of answers."""

    def __init__(self, cfg: BudgetConfig, *counts: Counter[str], first_prompt: int, first_completion: int) -> None:
        """
        Args:
            counts: `AnswerBook.totals` of each journal.
            first_prompt, first_completion: assumed tokens of a request until one is answered.
        """
        self.cfg, self._counts, self._first = cfg, counts, (first_prompt, first_completion)
        self._largest: dict[int, tuple[int, int]] = {}  # prompt and completion tokens by number of pictures
        self._in_flight = Counter[int]()  # requests by number of pictures
        self._freed = asyncio.Event()

    @property
    def totals(self) -> Counter[str]:
        """Answers, prompt_tokens and completion_tokens of all journals."""
        return sum(self._counts, Counter())

    @property
    def spent(self) -> float:
        """Cost so far."""
        totals = self.totals
        return self.cfg.cost(totals["prompt_tokens"], totals["completion_tokens"])

    @contextlib.asynccontextmanager
    async def request(self, num_pictures: int = 0) -> AsyncIterator[None]:
        """Reserve the share of one request; raises BudgetSpent if it does not fit."""
        while (spent := self._exceeded_by_another(num_pictures)) is not None:
            if not self._in_flight.total():
                raise spent
            self._freed.clear()
            await self._freed.wait()
        self._in_flight[num_pictures] += 1
        try:
            yield
        finally:
            self._in_flight[num_pictures] -= 1
            self._freed.set()

    def _exceeded_by_another(self, num_pictures: int) -> BudgetSpent | None:
        """Return which limit one more request might exceed."""
        totals, prompt, completion = self.totals, 0, 0
        for pictures, count in (self._in_flight + Counter([num_pictures])).items():
            one_prompt, one_completion = self._largest.get(pictures, self._first)
            prompt, completion = prompt + count * one_prompt, completion + count * one_completion
        tokens = totals["prompt_tokens"] + totals["completion_tokens"]
        if self.cfg.max_tokens is not None and tokens + prompt + completion > self.cfg.max_tokens:
            spent = f"{tokens:,} of at most {self.cfg.max_tokens:,} tokens are used"
            return BudgetSpent(spent, where="budget.max_tokens", fix="raise the limit")
        if self.cfg.max_cost is not None and self.spent + self.cfg.cost(prompt, completion) > self.cfg.max_cost:
            spent = f"{self.spent:.4f} of at most {self.cfg.max_cost:g} are spent"
            return BudgetSpent(spent, where="budget.max_cost", fix="raise the limit")
        return None

    def note(self, usage: Usage | None, where: str, num_pictures: int = 0) -> None:
        """Record the size of an answered request; raises TeacherError if a limit is set and no usage is reported."""
        if usage is not None:
            prompt, completion = self._largest.get(num_pictures, (0, 0))
            self._largest[num_pictures] = max(prompt, usage.prompt_tokens), max(completion, usage.completion_tokens)
        elif self.cfg.max_cost is not None or self.cfg.max_tokens is not None:
            raise TeacherError(
                "the endpoint reports no token usage, so a limit of tokens or cost cannot be kept",
                where=where,
                fix="remove --max-cost and --max-tokens, and use --limit",
            )
