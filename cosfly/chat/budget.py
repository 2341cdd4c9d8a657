"""Tokens and money: what was used, and whether one more request may be sent.

Counted over all runs into one folder, from the journal, so that running the same command again cannot spend the same budget
twice. A request is let through only if it and all those in flight, each taken at the largest seen so far, still fit.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator

from caption.schema import BudgetConfig
from cosfly.errors import TeacherError

MILLION = 1_000_000


class BudgetSpent(Exception):
    """The next request might pass a limit; `args[0]` says which."""


class Budget:
    """Keeps the count. `totals` is the journal's: prompt_tokens and completion_tokens of every answer kept."""

    def __init__(self, cfg: BudgetConfig, totals: Counter[str], *, first_prompt: int, first_completion: int) -> None:
        """
        Args:
            first_prompt, first_completion: tokens that a request is taken for until one was answered.
        """
        self.cfg, self.totals = cfg, totals
        self.num_in_flight = 0
        self._largest = (first_prompt, first_completion)
        self._is_measured = False

    @property
    def is_limited(self) -> bool:
        return self.cfg.max_cost is not None or self.cfg.max_tokens is not None

    def cost(self, prompt_tokens: int, completion_tokens: int) -> float:
        return (prompt_tokens * self.cfg.price_prompt + completion_tokens * self.cfg.price_completion) / MILLION

    @property
    def spent(self) -> float:
        return self.cost(self.totals["prompt_tokens"], self.totals["completion_tokens"])

    @contextlib.contextmanager
    def request(self) -> Iterator[None]:
        """Hold one request's share of the budget.

        Raises:
            BudgetSpent: it does not fit.
        """
        reserved = self.num_in_flight + 1
        prompt, completion = (count * reserved for count in self._largest)
        tokens = self.totals["prompt_tokens"] + self.totals["completion_tokens"]
        if self.cfg.max_tokens is not None and tokens + prompt + completion > self.cfg.max_tokens:
            raise BudgetSpent(f"{tokens:,} of at most {self.cfg.max_tokens:,} tokens are used")
        if self.cfg.max_cost is not None and self.spent + self.cost(prompt, completion) > self.cfg.max_cost:
            raise BudgetSpent(f"{self.spent:.4f} of at most {self.cfg.max_cost:g} are spent")
        self.num_in_flight += 1
        try:
            yield
        finally:
            self.num_in_flight -= 1

    def note(self, usage: dict[str, int], where: str) -> None:
        """Learn from an answer how large requests are.

        Raises:
            TeacherError: a limit is set and the server does not say what it used, so the limit could not be kept.
        """
        if not usage and self.is_limited:
            raise TeacherError(
                "the endpoint reports no token usage, so a limit of tokens or cost cannot be kept",
                where=where,
                fix="leave out --max-cost and --max-tokens, and use --limit",
            )
        seen = usage.get("prompt_tokens", 0), usage.get("completion_tokens", 0)
        self._largest = (max(self._largest[0], seen[0]), max(self._largest[1], seen[1])) if self._is_measured else seen
        self._is_measured = True
