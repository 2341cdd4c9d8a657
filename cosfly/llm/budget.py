"""Tokens and money: what was used, and whether one more request may be sent.

Counted over all runs into one folder, from the journal, so that running the same command again cannot spend the same
budget twice. A request is let through only if it and all those in flight, each taken at the largest seen so far, still
fit; until then it waits, and where it would not fit alone there is no more of the budget.
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
BYTES_PER_TOKEN = 3  # a low guess: a budget that counts with it is kept
PIXELS_PER_TOKEN = 28 * 28  # of common vision encoders


class BudgetConfig(Config):
    """What may be used up, counted over all runs into one folder; a judge's tokens count, too."""

    price_prompt: float = Field(0.0, ge=0, description="price of a million prompt tokens, in your currency")
    price_completion: float = Field(0.0, ge=0, description="price of a million answer tokens, in your currency")
    max_cost: float | None = Field(None, gt=0, description="stop before this cost is passed; empty: no limit")
    max_tokens: int | None = Field(None, ge=1, description="stop before this many tokens are passed; empty: no limit")

    @model_validator(mode="after")
    def _priced(self) -> Self:
        if self.max_cost is not None and self.price_prompt == self.price_completion == 0:
            raise ValueError("max_cost needs price_prompt and price_completion, else it could never be reached")
        return self

    def cost(self, prompt_tokens: float, completion_tokens: float) -> float:
        return (prompt_tokens * self.price_prompt + completion_tokens * self.price_completion) / MILLION


class BudgetSpent(TeacherError):
    """The next request might pass a limit; `what` says which."""


class Budget:
    """Keeps the count of all books that share a budget."""

    def __init__(self, cfg: BudgetConfig, *counts: Counter[str], first_prompt: int, first_completion: int) -> None:
        """
        Args:
            counts: `totals` of each book of answers.
            first_prompt, first_completion: tokens that a request is taken for until one was answered.
        """
        self.cfg, self._counts = cfg, counts
        self._first = self._largest = (first_prompt, first_completion)
        self._num_in_flight = self._most_pictures = 0
        self._is_measured = False
        self._freed = asyncio.Event()

    @property
    def totals(self) -> Counter[str]:
        """Answers, prompt_tokens and completion_tokens of every answer kept."""
        return sum(self._counts, Counter())

    @property
    def spent(self) -> float:
        totals = self.totals
        return self.cfg.cost(totals["prompt_tokens"], totals["completion_tokens"])

    @contextlib.asynccontextmanager
    async def request(self, num_pictures: int = 0) -> AsyncIterator[None]:
        """Hold one request's share of the budget.

        Raises:
            BudgetSpent: it does not fit.
        """
        while (spent := self._spent_by_another(num_pictures)) is not None:
            if not self._num_in_flight:
                raise spent
            self._freed.clear()
            await self._freed.wait()
        self._num_in_flight += 1
        try:
            yield
        finally:
            self._num_in_flight -= 1
            self._freed.set()

    def _spent_by_another(self, num_pictures: int) -> BudgetSpent | None:
        """Return which limit one more request might pass, beside those in flight."""
        if num_pictures > self._most_pictures:  # what a judge or a mirror took tells nothing of a request with pictures
            self._most_pictures, self._is_measured = num_pictures, False
            self._largest = _larger(self._first, self._largest)
        prompt, completion = (count * (self._num_in_flight + 1) for count in self._largest)
        totals = self.totals
        tokens = totals["prompt_tokens"] + totals["completion_tokens"]
        if self.cfg.max_tokens is not None and tokens + prompt + completion > self.cfg.max_tokens:
            spent = f"{tokens:,} of at most {self.cfg.max_tokens:,} tokens are used"
            return BudgetSpent(spent, where="budget.max_tokens", fix="raise it")
        if self.cfg.max_cost is not None and self.spent + self.cfg.cost(prompt, completion) > self.cfg.max_cost:
            spent = f"{self.spent:.4f} of at most {self.cfg.max_cost:g} are spent"
            return BudgetSpent(spent, where="budget.max_cost", fix="raise it")
        return None

    def note(self, usage: Usage | None, where: str, num_pictures: int = 0) -> None:
        """Learn from an answer how large requests are.

        Raises:
            TeacherError: a limit is set and the server does not say what it used, so the limit could not be kept.
        """
        if usage is None and (self.cfg.max_cost is not None or self.cfg.max_tokens is not None):
            raise TeacherError(
                "the endpoint reports no token usage, so a limit of tokens or cost cannot be kept",
                where=where,
                fix="leave out --max-cost and --max-tokens, and use --limit",
            )
        seen = (usage.prompt_tokens, usage.completion_tokens) if usage else (0, 0)
        if num_pictures < self._most_pictures or self._is_measured:
            self._largest = _larger(self._largest, seen)
        else:
            self._largest, self._is_measured = seen, True


def _larger(one: tuple[int, int], two: tuple[int, int]) -> tuple[int, int]:
    return max(one[0], two[0]), max(one[1], two[1])
