"""A checked connection to an UnrealCV server, as SimWorld runs one: settings, and errors that name host, port, version.

It works around faults of the package `unrealcv`, which waits forever for a greeting, reads from closed connections,
and prints. A server has one client at a time.
"""

import contextlib
import io
import logging
import re
import socket
import time
import warnings
from collections.abc import Iterator
from typing import Any

from pydantic import Field

from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.escaping import for_terminal

PROBE_S = 5.0  # for a server to accept a connection
LEAST_VERSION = (0, 4, 0)  # the first with bounds, classes, and more than one camera
MOST_AT_ONCE = 200  # commands of a batch, so that neither side waits for the other with full buffers
INSTALL = 'pip install -e ".[unrealcv]" && pip install --no-deps "unrealcv>=1.3.2"'


class UnrealCvConfig(Config):
    """An UnrealCV server."""

    host: MayDiffer[str] = Field("127.0.0.1", min_length=1, description="address of the server")
    port: MayDiffer[int] = Field(9000, ge=1, le=65535, description="port of the server; often 9001 if 9000 is in use")
    timeout_s: MayDiffer[float] = Field(60.0, gt=0, description="time limit for an answer, s")
    coord_scale: float = Field(100.0, gt=0, description="Unreal units per metre; 100: centimetres")


OURS = "COSFLY_"  # prefix of the names of spawned objects


class NoAnswerError(Exception):
    """The server did not answer in time, closed the connection, or sent an unexpected answer."""


class UnrealCvConnection:
    """A client of one server. It is unusable after an error, because a late answer would be read as the next one."""

    def __init__(self, cfg: UnrealCvConfig, port: int) -> None:
        self.endpoint = f"{cfg.host}:{port}"
        self.version = "unknown"
        self.level = ""
        self._client = _client(cfg, port)
        if self._client is None:
            raise NoAnswerError(_why_no_greeting(cfg.host, port))

    @property
    def where(self) -> str:
        return f"{self.endpoint} (UnrealCV {self.version})" + (f", {self.level}" if self.level else "")

    def ask(self, *commands: str) -> list[str | bytes]:
        """Return the answers, in order: text, also of errors, or bytes of pictures."""
        answers: list[str | bytes] = []
        for first in range(0, len(commands), MOST_AT_ONCE):
            if self._client.ended:  # the package would wait forever
                raise NoAnswerError(self._client.ended)
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    answers += self._client.request_batch(list(commands[first : first + MOST_AT_ONCE]))
            except (OSError, AttributeError) as error:  # the socket is gone
                raise NoAnswerError(f"{self._client.ended or error} ({commands[first]})") from None
        return answers

    def run(self, *commands: str) -> None:
        """Run commands; raise EnvironmentMissing if the server refuses one."""
        for command, answer in zip(commands, self.ask(*commands), strict=True):
            if is_refusal(answer):
                got = f"{command}: {answer!r}"
                fix = "use a build of UnrealCV that has this command"
                raise EnvironmentMissing("the server refuses a command", where=self.where, got=got, fix=fix)

    def numbers(self, answer: str | bytes, num: int) -> tuple[float, ...] | None:
        """Return the numbers of an answer; None if it does not hold `num` finite numbers."""
        words = answer.split() if isinstance(answer, str) else []
        with contextlib.suppress(ValueError):
            numbers = tuple(map(float, words))
            if len(numbers) == num and all(abs(number) < 1e12 for number in numbers):
                return numbers
        return None

    def close(self) -> None:
        self._client.disconnect()

    def asking(self, what: str) -> contextlib.AbstractContextManager[None]:
        """Convert errors of the connection to EnvironmentMissing; `what` describes the failure."""
        return _server_errors(what, self.where)


def spawned_by_cosfly(names: str) -> list[str]:
    """Return the objects that cosfly spawned, from the answer to `vget /objects`."""
    return [name for name in names.split() if name.startswith(OURS)]


def is_refusal(answer: str | bytes | None) -> bool:
    """Return whether an answer is missing or an error."""
    return not isinstance(answer, bytes) and (answer is None or answer.lstrip().lower().startswith("error"))


def connect(cfg: UnrealCvConfig, port: int) -> UnrealCvConnection:
    """Connect to the server at a port, and check its version."""
    with _server_errors("no UnrealCV server answers", f"{cfg.host}:{port} (UnrealCV unknown)"):
        connection = UnrealCvConnection(cfg, port)
        version, level = connection.ask("vget /unrealcv/version", "vget /level/name")
    match = re.match(r"v?(\d+)\.(\d+)(?:\.(\d+))?", str(version))
    if match is None or tuple(int(part or 0) for part in match.groups()) < LEAST_VERSION:
        raise EnvironmentMissing(
            "the UnrealCV server is too old",
            where=connection.endpoint,
            got=repr(version)[:80],
            expected=f"{'.'.join(map(str, LEAST_VERSION))} or newer",
            fix="run a newer build, such as the one in SimWorld",
        )
    connection.version = match[0]
    connection.level = "" if is_refusal(level) else for_terminal(str(level).strip())
    return connection


def _client(cfg: UnrealCvConfig, port: int) -> Any:
    """Return a connected client of the package; None if no server greets it."""
    try:
        import unrealcv
    except ModuleNotFoundError as error:
        what = "the package unrealcv is not installed"
        raise EnvironmentMissing(what, got=str(error), fix=INSTALL) from None
    logging.getLogger("unrealcv").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="The connected UnrealCV server")

    class _Client(unrealcv.Client):
        ended = ""  # the reason why no more answers come

        def receive(self) -> bytes:
            since_s = time.monotonic()
            message = unrealcv.SocketMessage.ReceivePayload(self.sock)
            if not message:
                is_late = time.monotonic() - since_s >= 0.9 * cfg.timeout_s
                problem = f"sent no answer in {cfg.timeout_s:g} s" if is_late else "closed the connection"
                raise ConnectionError(f"the server {problem}")
            return message

        def receive_loop_queue(self) -> None:
            try:
                super().receive_loop_queue()
            except (OSError, AssertionError, AttributeError) as error:
                self.ended = self.ended or str(error)
                self.recv_data_q.put(ConnectionError(self.ended))

    client = _Client((cfg.host, port))
    before_s = socket.getdefaulttimeout()
    socket.setdefaulttimeout(cfg.timeout_s)  # the package opens the socket itself, and sets none
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return client if client.connect() else None
    finally:
        socket.setdefaulttimeout(before_s)


def _why_no_greeting(host: str, port: int) -> str:
    """Return why no server greeted the client."""
    try:
        socket.create_connection((host, port), PROBE_S).close()
    except OSError as error:
        return str(error)
    return "the server is not UnrealCV, or already has another client"


@contextlib.contextmanager
def _server_errors(what: str, where: str) -> Iterator[None]:
    try:
        yield
    except NoAnswerError as error:
        fix = "start the server at this address, or raise timeout_s"
        raise EnvironmentMissing(what, where=where, got=str(error), fix=fix) from None
