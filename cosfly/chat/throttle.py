"""How many requests may be in flight: additive increase, multiplicative decrease, below a ceiling.

A run starts with a few and triples per round of answers (8, 24, 72) until the server first says "busy" (429, 503); from then
on it adds one per round and halves at every "busy". A server that is overloaded at once thus sees at most 8 requests before it
can say so. A Retry-After holds all requests back, not only the one that was told.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable

FIRST_LIMIT = 8
RAMP_PER_ANSWER = 2.0  # triples the limit per round


class Throttle:
    """Hands out slots for requests. All methods run on one event loop."""

    def __init__(self, ceiling: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.ceiling = ceiling
        self.limit = float(min(FIRST_LIMIT, ceiling))
        self.num_active = 0
        self._clock = clock
        self._held_until_s = 0.0
        self._last_decrease_s = float("-inf")
        self._is_ramping = True
        self._changed = asyncio.Condition()

    @contextlib.asynccontextmanager
    async def slot(self) -> AsyncIterator[float]:
        """Wait for a slot and hold it; yields the time at which it was given."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.num_active < int(self.limit))
            self.num_active += 1
        try:
            while (wait_s := self._held_until_s - self._clock()) > 0:
                await asyncio.sleep(wait_s)
            yield self._clock()
        finally:
            async with self._changed:
                self.num_active -= 1
                self._changed.notify(max(int(self.limit) - self.num_active, 0))

    def succeeded(self) -> None:
        """Note an answer."""
        self.limit = min(float(self.ceiling), self.limit + (RAMP_PER_ANSWER if self._is_ramping else 1.0 / self.limit))

    def was_busy(self, given_s: float, retry_after_s: float | None) -> None:
        """Note that the server is overloaded.

        Args:
            given_s: when the request got its slot. Requests sent before the last decrease say nothing new.
        """
        now_s = self._clock()
        self._is_ramping = False
        if given_s >= self._last_decrease_s:
            self.limit = max(1.0, self.limit / 2.0)
            self._last_decrease_s = now_s
        if retry_after_s is not None:
            self._held_until_s = max(self._held_until_s, now_s + retry_after_s)
