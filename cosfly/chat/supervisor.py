"""Starts servers of a model, waits until they answer, starts those anew that end, and ends them: `cosfly teacher
serve`, `--teacher serve:MODEL`. What serves is a command, vLLM's unless the settings name another.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import shutil
import socket
import tempfile
import threading
import time
from pathlib import Path
from string import Template

import httpx
from pydantic import Field

from cosfly.chat.client import EndpointConfig
from cosfly.chat.contract import NoAnswer, Reply, Request, Troubles
from cosfly.chat.servers import ChatClient
from cosfly.errors import ConfigError, EnvironmentMissing, TeacherError
from cosfly.reading.files import read_tail
from cosfly.work.config import Config
from cosfly.work.server_process import guarded
from cosfly.work.stage_events import num_gpus

log = logging.getLogger(__name__)

VLLM = (
    "vllm", "serve", "$model", "--served-model-name", "$name", "--host", "$host", "--port", "$port",
    "--tensor-parallel-size", "$gpus",
    # Without the 0, room is kept for a video; without a backend's name, white space cannot be forbidden.
    "--limit-mm-per-prompt", '{"image": $images, "video": 0}',
    "--structured-outputs-config", '{"backend": "xgrammar", "disable_any_whitespace": true}',
)  # fmt: skip
LOOK_S, ANSWER_S, FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0, 1.0, 60.0
ASKED_BEFORE_HUNG = 10  # times that a server is asked whether it lives, before it counts as hung
DYING_S = 10.0  # vLLM answers 500 so long once its engine has died, before it ends
MOST_ENDS = 2  # of a server while a request is asked; at the next it may be the request that ends it
MOST_SAID = 300  # characters of a line of a server's log
CAUSES = {
    "its accelerator's memory is full": r"out of memory|no available memory|free memory on device",
    "it finds no accelerator": r"no cuda gpus|failed to infer device type|no cuda-capable|libcuda|nvml",
    "its port is taken": r"address already in use",
    "it does not know an argument": r"unrecognized arguments|invalid choice",
    "it has no such model": r"repo id|(repository|localentry)notfound|is not a local folder|no such file or directory",
}
HARMLESS = r"\b(DEBUG|INFO|WARNING)\b"  # a warning quotes errors that others had
SAYS_WHY = r"(^|[\])] )([\w.]*(Error|Exception): (?!\d+ validation error)|Value error, )"  # a logger puts more before


class ServeConfig(Config):
    """Servers of a teacher that cosfly starts."""

    command: tuple[str, ...] = Field(
        VLLM, min_length=1, description="what is run; $model $name $host $port $gpus $images are filled in"
    )
    arguments: tuple[str, ...] = Field((), description="further arguments of the command")
    replicas: int = Field(1, ge=1, le=256, description="servers, each on accelerators of its own, at ports in a row")
    gpus: int = Field(1, ge=1, description="accelerators of one server, which share the model")
    host: str = Field("127.0.0.1", description="address they listen at; 0.0.0.0: all of this machine's")
    port: int = Field(8000, ge=1, le=65535, description="port of the first")
    ready_s: float = Field(900.0, gt=0, description="limit of the time until a server answers, s")
    hung_s: float = Field(120.0, gt=0, description="time without an answer after which a server that lives is ended, s")
    restarts: int = Field(5, ge=0, description="times that a server which ended is started anew")


class _Replica:
    """One server: how it is started, and what becomes of it."""

    def __init__(self, number: int, model: str, cfg: ServeConfig, num_images: int, folder: Path) -> None:
        self.port, self.log_file, self.cfg = cfg.port + number, folder / f"server_{number}.log", cfg
        self.host = "127.0.0.1" if cfg.host == "0.0.0.0" else cfg.host
        shown = socket.gethostname() if cfg.host == "0.0.0.0" else cfg.host
        self.url = f"http://{shown}:{self.port}/v1"
        name = Path(model).resolve().name if Path(model).is_dir() else model
        filled = {"model": model, "name": name, "host": cfg.host, "port": self.port}
        filled |= {"gpus": cfg.gpus, "images": num_images}
        self.words = [Template(word).safe_substitute(filled) for word in (*cfg.command, *cfg.arguments)]
        self.environment = {"VLLM_NO_USAGE_STATS": "1", **os.environ, **_devices(number, cfg)}
        self.is_ready, self.failure, self.num_starts = False, "", 0

    def serve(self, stop: threading.Event) -> None:
        """Keep a server running until it is told to stop, or it was started anew too often; `failure` says why."""
        for number in range(self.cfg.restarts + 1):
            if number:
                pause_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** (number - 1))
                told = f"{self.failure}; started anew in {pause_s:g} s, {number} of {self.cfg.restarts}"
                log.warning("%s: %s", self.url, told)
                stop.wait(pause_s)
            self.failure = self._serve_once(stop) or self.failure
            was_ready, self.is_ready = self.is_ready, False
            if stop.is_set() or not (was_ready or number):  # one that never worked here will not
                return
        log.error("%s: %s; given up after %d starts", self.url, self.failure, self.cfg.restarts + 1)

    def _serve_once(self, stop: threading.Event) -> str:
        """Run a server until it ends, hangs or is told to end; gives why it ended."""
        try:
            socket.create_server((self.cfg.host, self.port)).close()
        except (OSError, OverflowError) as error:
            return f"port {self.port} cannot be had ({error}); choose another with --port"
        begin = self.log_file.stat().st_size if self.log_file.exists() else 0
        self.num_starts += 1
        asked_s = answered_s = time.monotonic()
        with guarded(self.words, self.log_file, self.environment) as process:
            while not stop.wait(LOOK_S):
                if (code := process.poll()) is not None:
                    how = f"ended by signal {code - 128}" if code > 128 else f"ended with status {code}"
                    return f"{how}{self._why(begin)}"
                if self.is_ready and time.monotonic() - asked_s < self.cfg.hung_s / ASKED_BEFORE_HUNG:
                    continue
                asked_s = time.monotonic()
                silent_s = asked_s - answered_s
                if self._answers():
                    if not self.is_ready:
                        log.info("%s: ready", self.url)
                    self.is_ready, answered_s = True, asked_s
                elif self.is_ready and silent_s > self.cfg.hung_s:
                    return f"lives, and has not answered for {silent_s:.0f} s (caption.serve.hung_s){self._why(begin)}"
                elif not self.is_ready and silent_s > self.cfg.ready_s:
                    return f"not ready within {self.cfg.ready_s:g} s (caption.serve.ready_s){self._why(begin)}"
        return ""

    def _answers(self) -> bool:
        url = f"http://{self.host}:{self.port}/v1/models"
        try:
            return httpx.get(url, timeout=ANSWER_S, trust_env=False, verify=False).status_code < 500
        except httpx.HTTPError:
            return False

    def _why(self, begin: int) -> str:
        """Give what its log says since it was started: a cause that is known, and the line that tells it; else its
        first error, for later ones follow from it; else its last line."""
        text = re.sub(r"\x1b\[[\d;]*m", "", read_tail(self.log_file, begin))
        lines = [" ".join(line.split())[:MOST_SAID] for line in text.splitlines() if line.strip()]
        lines = [line for line in lines if not re.search(HARMLESS, line)] or lines
        errors = [line for line in lines if re.search(SAYS_WHY, line)]
        for cause, signs in CAUSES.items():
            if found := next((line for line in errors + lines if re.search(signs, line, re.IGNORECASE)), None):
                return f": {cause}: {found!r} (log: {self.log_file})"
        return f": {(errors or lines[-1:] or ['it says nothing'])[0]!r} (log: {self.log_file})"


def _devices(number: int, cfg: ServeConfig) -> dict[str, str]:
    """Give the variable that shows a server its accelerators; none where this machine has none."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    devices = given.split(",") if given else [str(index) for index in range(num_gpus())]
    if not devices:
        return {}
    if len(devices) < cfg.replicas * cfg.gpus:
        got, expected = f"{len(devices)} accelerators", f"{cfg.replicas} x {cfg.gpus} (replicas x gpus)"
        raise ConfigError("too few accelerators for the servers", where="caption.serve", got=got, expected=expected)
    return {"CUDA_VISIBLE_DEVICES": ",".join(devices[number * cfg.gpus : (number + 1) * cfg.gpus])}


class TeacherServers:
    """All servers of a model, each watched by a thread. Use as a context manager: inside, all answer."""

    def __init__(self, model: str, cfg: ServeConfig, num_images: int) -> None:
        """
        Args:
            num_images: most pictures of one request.
        """
        if shutil.which(cfg.command[0]) is None:
            fix = 'pip install "cosfly[vllm]" where the servers run' if cfg.command == VLLM else "caption.serve.command"
            raise EnvironmentMissing("the command of the servers is not installed", got=cfg.command[0], fix=fix)
        self.folder = Path(tempfile.mkdtemp(prefix="cosfly-teacher-"))
        self.replicas = [_Replica(number, model, cfg, num_images, self.folder) for number in range(cfg.replicas)]
        self.urls = ",".join(replica.url for replica in self.replicas)
        self.stop = threading.Event()
        self._threads = [threading.Thread(target=one.serve, args=(self.stop,), daemon=True) for one in self.replicas]

    def __enter__(self) -> TeacherServers:
        log.info("starting %s; log: %s", self.urls, self.folder)
        for thread in self._threads:
            thread.start()
        try:
            while not (self.stop.is_set() or all(one.is_ready for one in self.replicas)):
                self.check(some_failed=True)
                time.sleep(LOOK_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def check(self, *, some_failed: bool = False) -> None:
        """
        Raises:
            TeacherError: all servers, or some, have ended for good.
        """
        ended = [one for one, thread in zip(self.replicas, self._threads, strict=True) if not thread.is_alive()]
        if (ended and some_failed) or len(ended) == len(self.replicas):
            fix, one = "mend that, then run the same command again", ended[0]
            raise TeacherError("a server of the teacher does not run", where=one.url, got=one.failure, fix=fix)

    def __exit__(self, *exc: object) -> None:
        """End all servers. The log stays where one of them failed."""
        self.stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        if not any(one.failure for one in self.replicas):
            shutil.rmtree(self.folder, ignore_errors=True)


class ServedClient(ChatClient):
    """Engine `endpoint` over servers that are started with it and end with it: `--teacher serve:MODEL`."""

    def __init__(
        self, model: str, serve: ServeConfig, num_images: int, cfg: EndpointConfig, troubles: Troubles | None
    ) -> None:
        self._supervised = TeacherServers(model, serve, num_images)
        super().__init__(self._supervised.urls, cfg, troubles)
        self.where = f"serve:{model}"

    async def start(self) -> None:
        """Start the servers; raises as `TeacherServers` and `ChatClient.start`."""
        await asyncio.to_thread(self._supervised.__enter__)
        await super().start()

    async def answer(self, request: Request) -> Reply:
        """Answer as `ChatClient` does; servers that are being started anew are waited for."""
        num_ends = 0
        while True:
            while (number := self._number_if_ready()) is None:
                self._supervised.check()
                await asyncio.sleep(LOOK_S)
            try:
                return await super().answer(request)
            except NoAnswer as error:
                if error.is_final or num_ends == MOST_ENDS:
                    raise
                until_s = time.monotonic() + DYING_S
                while self._number_if_ready() == number:
                    if time.monotonic() > until_s:
                        raise
                    await asyncio.sleep(LOOK_S)
                num_ends += 1

    def _number_if_ready(self) -> int | None:
        """Tell which servers these are, by how often one was started; None while none is ready."""
        replicas = self._supervised.replicas
        return sum(one.num_starts for one in replicas) if any(one.is_ready for one in replicas) else None

    async def close(self) -> None:
        await super().close()
        await asyncio.to_thread(self._supervised.__exit__)
