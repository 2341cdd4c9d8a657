"""Engine `endpoint`: one server of chat completions or several that serve the same model, asked as one.

A request goes to the server that has the smallest share of its own limit in flight. It is asked until it is answered:
of another server where there is one. A server that fails is left out until it lists the model again, for a time that
doubles. Where none is left, all are tried as one alone would be. Who answered stands in no key, so a run goes on with
another list.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import time
from collections.abc import AsyncIterator
from typing import Any, Literal

from cosfly.chat.client import Ask, ChatServer, EndpointConfig, Failure, Unreachable
from cosfly.chat.contract import NoAnswer, Reply, Request, Troubles
from cosfly.chat.protocol import split_urls
from cosfly.errors import TeacherError

log = logging.getLogger(__name__)

OUT_AFTER = 3  # failures in a row; one of a server that has not answered since it came back
TOO_MANY = "http_429"  # a server that says so works


class _Place(ChatServer):
    """A server in its list, and whether it is asked."""

    num_failed = num_outs = 0  # in a row; since it last answered
    is_refusing = False  # whatever it is asked
    trouble = ""  # why it is left out; "": it is not
    returning: asyncio.Task | None = None


class ChatClient:
    """Has requests answered by the servers of a list."""

    kind: Literal["endpoint"] = "endpoint"

    def __init__(self, urls: str, cfg: EndpointConfig, troubles: Troubles | None = None) -> None:
        """
        Args:
            urls: an address, or several with commas between.
        """
        try:
            self.servers = [_Place(url, cfg) for url in split_urls(urls)]
        except ValueError as error:
            raise TeacherError(str(error)) from None
        self.where = ",".join(server.where for server in self.servers)
        self.cfg, self.model, self.troubles = cfg, "", troubles or Troubles()
        self._changed = asyncio.Condition()  # of a server: its requests in flight, or whether it is asked
        self._jitter = random.Random()  # times of retries only: no product depends on it

    async def start(self) -> None:
        """Find the model at every server; those that nobody answers at are left out for now.

        Raises:
            TeacherError: none can be asked, one refuses us, or they serve different models.
        """
        found = await asyncio.gather(*(server.start() for server in self.servers), return_exceptions=True)
        refusals = [one for one in found if isinstance(one, BaseException) and not isinstance(one, Unreachable)]
        away = {server: one for server, one in zip(self.servers, found, strict=True) if isinstance(one, Unreachable)}
        if refusals or len(self.servers) == 1:
            for error in [*refusals, *away.values()]:
                raise error
        if len(away) == len(self.servers):
            got, fix = "; ".join(f"{server.where}: {error.got}" for server, error in away.items()), "start one of them"
            raise Unreachable("cannot reach any server of the teacher", got=got, fix=fix)
        names = {server.model for server in self.servers} - {""}
        if len(names) > 1:
            listed = ", ".join(f"{server.where}: {server.model or 'away'}" for server in self.servers)
            what = "the servers of one teacher serve different models"
            raise TeacherError(what, got=listed, expected="the same name", fix="leave some out, or give --model")
        [self.model] = names
        for server, error in away.items():
            self._leave_out(server, str(error.got))

    async def close(self) -> None:
        """Close all connections; none may be in use."""
        tasks = [server.returning for server in self.servers if server.returning is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for server in self.servers:
            await server.close()

    async def answer(self, request: Request) -> Reply:
        """Send a request until it is answered.

        Raises:
            NoAnswer: not within the tries and the time that the settings allow, or a server refuses it.
            TeacherError: no request will get an answer.
        """
        asks: dict[_Place, Ask] = {}  # of the servers that were tried
        attempt, deadline_s = 0, float("inf")
        while True:
            async with self._slot(asks) as server:
                given_s = time.monotonic()
                deadline_s = min(deadline_s, given_s + self.cfg.total_timeout_s)
                found = await self._attempt(server, asks.setdefault(server, server.ask_of(request)), given_s)
            if isinstance(found, Reply):
                log.debug("%s: answered at try %d", server.where, attempt + 1)
                return found
            is_moving = any(not one.trouble and one not in asks for one in self.servers)
            attempt += not is_moving  # to ask each server once is one try
            is_last = attempt >= self.cfg.max_tries
            pause_s = self._backoff_s(attempt - 1) if found.wait_s is None else found.wait_s
            pause_s = 0.0 if is_moving else pause_s
            is_late = not is_last and time.monotonic() + pause_s >= deadline_s
            if self.troubles.failed(found.detail):
                what = "given up" if is_last or is_late else "trying again"
                log.warning("%s: %s; %s, failed tries so far: %d", server.where, found.detail, what, self.troubles.num)
            if is_late:
                words = f"no answer within {self.cfg.total_timeout_s:g} s; the last: {found.detail}"
                raise NoAnswer("total_timeout", words)
            if is_last:
                raise NoAnswer(found.cause, found.detail)
            await asyncio.sleep(pause_s)

    async def _attempt(self, server: _Place, ask: Ask, given_s: float) -> Reply | Failure:
        """Send a request to a server once, and note what that says of the server."""
        try:
            found = await server.attempt(ask, given_s)
        except TeacherError as error:
            server.is_refusing = True
            self._leave_out(server, str(error))
            if all(one.is_refusing for one in self.servers):
                raise
            return Failure("refused", str(error))
        if isinstance(found, Reply):
            self.troubles.answered()
            self._bring_in(server)
            server.num_failed = server.num_outs = 0
        elif found.cause != TOO_MANY:
            server.num_failed += 1
            if server.num_failed >= (1 if server.num_outs else OUT_AFTER):
                self._leave_out(server, found.detail)
        return found

    def _backoff_s(self, attempt: int) -> float:
        longest = min(self.cfg.max_backoff_s, self.cfg.backoff_s * 2.0 ** min(attempt, 60))
        return self._jitter.uniform(0.5, 1.0) * longest

    # --- which server ---

    @contextlib.asynccontextmanager
    async def _slot(self, tried: dict[_Place, Any]) -> AsyncIterator[_Place]:
        """Wait for a server with room, one that was not tried where there is any, and hold a slot of it."""
        async with self._changed:
            while not (with_room := [one for one in self._asked(tried) if one.throttle.has_room()]):
                soonest_s = min(one.throttle.room_in_s() for one in self._asked(tried))
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(None if soonest_s == float("inf") else soonest_s):
                        await self._changed.wait()
            server = min(with_room, key=lambda one: one.throttle.load)
            server.throttle.num_active += 1
        try:
            yield server
        finally:
            async with self._changed:
                server.throttle.num_active -= 1
                # Of several, who waits first may wait for another.
                is_alone, room = len(self.servers) == 1, int(server.throttle.limit) - server.throttle.num_active
                self._changed.notify(max(room, 0)) if is_alone else self._changed.notify_all()

    def _asked(self, tried: dict[_Place, Any]) -> list[_Place]:
        asked = [server for server in self.servers if not server.trouble] or self.servers
        return [server for server in asked if server not in tried] or asked

    def _leave_out(self, server: _Place, why: str) -> None:
        if server.trouble or len(self.servers) == 1:
            return
        server.trouble = why or "no answer"
        server.returning = asyncio.create_task(self._await_return(server))
        log.warning("%s: left out: %s", server.where, why)
        if all(one.trouble for one in self.servers):
            listed = "; ".join(f"{one.where}: {one.trouble}" for one in self.servers)
            log.warning("no server of the teacher answers, trying on: %s", listed)

    async def _await_return(self, server: _Place) -> None:
        """Ask a server for its model, ever later, until it has it."""
        while True:
            await asyncio.sleep(self._backoff_s(server.num_outs))
            server.num_outs += 1
            try:
                await server.start(self.model)
            except TeacherError as error:
                why = str(error.got if isinstance(error, Unreachable) else error)
                if why != server.trouble:
                    log.warning("%s: stays out: %s", server.where, why)
                server.trouble = why
            else:
                break
        self._bring_in(server)
        async with self._changed:
            self._changed.notify_all()

    def _bring_in(self, server: _Place) -> None:
        if not server.trouble:
            return
        if server.returning is not asyncio.current_task() and server.returning is not None:
            server.returning.cancel()
        server.trouble, server.returning, server.is_refusing = "", None, False
        server.throttle.restart()
        log.warning("%s: is asked again", server.where)
