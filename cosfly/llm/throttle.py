"""How many requests may be in flight: additive increase, multiplicative decrease, below a ceiling.

A run starts with a few and doubles every 1.5 s, and triples per round of answers where these come faster, until the
server first says "busy" (429, 503); from then on it adds one per round and halves at every "busy". A server that is
overloaded says so at once: it sees 8 requests before it can, and a failure of any other kind holds the growth back. A
Retry-After holds all requests back, not only the one that was told.
"""

from __future__ import annotations

import time
from collections.abc import Callable

FIRST_LIMIT = 8
RAMP_PER_ANSWER = 2.0  # triples the limit per round
RAMP_S = 1.5  # doubles it: 256 in flight after 7.5 s, when a model that thinks for 8 s has not answered once


class Throttle:
    """Counts the requests in flight at one server. All methods run on one event loop."""

    def __init__(self, ceiling: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.ceiling = ceiling
        self.limit = float(min(FIRST_LIMIT, ceiling))
        self.num_active = 0
        self._clock = clock
        self._held_until_s = 0.0
        self._last_decrease_s = float("-inf")
        self._is_ramping = True
        self._grows_at_s = float("inf")  # from the first request on

    def has_room(self) -> bool:
        """Return whether one more may be in flight; where that is asked and it is time, the limit grows."""
        now_s = self._clock()
        if self._grows_at_s == float("inf"):
            self._grows_at_s = now_s + RAMP_S
        if now_s < self._held_until_s:
            return False
        if self.num_active >= int(self.limit) and self._is_ramping and now_s >= self._grows_at_s:
            self.limit = min(float(self.ceiling), 2.0 * self.limit)
            self._grows_at_s = now_s + RAMP_S
        return self.num_active < int(self.limit)

    def room_in_s(self) -> float:
        """Return the time after which there may be room though nothing was answered, s; infinite: never."""
        now_s = self._clock()
        if now_s < self._held_until_s:
            return self._held_until_s - now_s
        is_growing = self._is_ramping and self.limit < self.ceiling
        return max(0.0, self._grows_at_s - now_s) if is_growing else float("inf")

    def failed(self) -> None:
        """Note a request that failed in another way than for load: no more of them for now."""
        self._grows_at_s = self._clock() + RAMP_S

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
