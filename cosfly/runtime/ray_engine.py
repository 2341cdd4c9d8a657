"""Stages on a Ray cluster: an actor is the post of a worker process, on whichever node Ray has room for it.

Ray finds the node, carries bytes and tells of nodes that are lost. When a worker counts as stalled, what is tried again
and what is told of it is `worker_pool`'s, as for the processes of one machine. Files do not travel: the nodes share the
folder of the stage and its inputs. Items are handed out one at a time, and no frame passes through Ray.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import sys
from collections import deque
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import Field

import cosfly
from cosfly.runtime.config import Config
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.events import Vitals
from cosfly.runtime.io import sha256_file
from cosfly.runtime.worker import Item, Message, Start, WorkerOptions

log = logging.getLogger(__name__)

ALL_ROOM = 2**31  # as many workers as the cluster has room for when a stage begins
STORE_BYTES = 80_000_000  # of a cluster of this machine: what Ray asks for at least; nothing of ours is kept in it
ANSWER_S = 5.0  # within which a head node or an actor answers
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # it would tell its makers
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # it would hide the GPUs from workers that ask for no share
}
WAITING_S = 30.0  # after so long it is told that there is no room


class RayConfig(Config):
    """Where a Ray cluster is, and what a worker takes of it."""

    address: str = Field(
        "", pattern=r"^(auto|[^/\s]+:\d+)?$",
        description="the head node's host:port, or auto for that of this machine; empty: $RAY_ADDRESS, and without it "
        "a cluster of this machine alone, which ends with the command",
    )  # fmt: skip
    worker_cpus: float = Field(1.0, gt=0, description="CPUs that a worker takes of its node")
    worker_gpus: float = Field(
        0.0, ge=0, description="GPUs that a worker takes: 0.25 lets four share one; 0: where CPUs are free"
    )


class Cluster:
    """A cluster, and a stage's folder that its nodes share."""

    def __init__(self, cfg: RayConfig, folder: Path) -> None:
        self._cfg, self._folder, self._ray = cfg, folder, connected(cfg)
        self._record = sha256_file(folder / "stage.json")
        if not self.room:
            nodes = [node["Resources"] for node in self._alive()]
            got = ", ".join(f"{node.get('CPU', 0):g} CPUs and {node.get('GPU', 0):g} GPUs" for node in nodes)
            fix = "lower ray.worker_cpus or ray.worker_gpus, or add a node that has as many"
            raise EnvironmentMissing(
                "no node has room for a worker", got=f"nodes of {got}", expected=self.needs, fix=fix
            )

    @property
    def needs(self) -> str:
        """What a worker takes, in words."""
        gpus = f" and {self._cfg.worker_gpus:g} GPUs" if self._cfg.worker_gpus else ""
        return f"{self._cfg.worker_cpus:g} CPUs{gpus}"

    @cached_property
    def room(self) -> int:
        """How many workers the nodes have room for, if nobody else is there."""
        shares = {"CPU": self._cfg.worker_cpus, "GPU": self._cfg.worker_gpus}
        taken = [(name, share) for name, share in shares.items() if share]
        return sum(
            min(int(node["Resources"].get(name, 0.0) / share + 1e-6) for name, share in taken) for node in self._alive()
        )

    def _alive(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def start_transport(self, worker_options: WorkerOptions) -> RayTransport:
        """Ask for a worker somewhere."""
        takes = {"num_cpus": self._cfg.worker_cpus, "num_gpus": self._cfg.worker_gpus, "max_restarts": 0}
        host = self._actor.options(**takes).remote(
            worker_options.heartbeat_s, worker_options.log_level, worker_options.place
        )
        begun = host.begin.remote(str(self._folder), self._record, os.getcwd(), sys.path, cosfly.__version__)
        return RayTransport(self._ray, host, begun, worker_options.place, self.needs)

    @cached_property
    def _actor(self) -> Any:
        return self._ray.remote(_host())


class RayTransport:
    """The way to a worker process on a node."""

    def __init__(self, ray: Any, host: Any, begun: Any, place: int, needs: str) -> None:
        self.pid: int | None = None
        self.node: str | None = None
        self._ray, self._host, self._begun, self._place, self._needs = ray, host, begun, place, needs
        self._said: Any = None
        self._heard = deque[bytes]()
        self._vitals: Vitals | None = Vitals(0.0, 0.0)

    def send(self, what: Start | Item | None) -> None:
        data = pickle.dumps(what)
        with self._gone_as_eof():
            if self.pid is None:
                self._settle()
            self._said = self._host.talk.remote(data)

    def _settle(self) -> None:
        """Wait until it has a node and has started there; raises EnvironmentMissing where the node will not do."""
        while not self._ray.wait([self._begun], timeout=WAITING_S)[0]:
            if self._place == 0:
                log.warning("worker 0 waits for a node with %s free; `ray status` tells who has them", self._needs)
        node, pid, problem = self._ray.get(self._begun)
        if problem:
            raise EnvironmentMissing(where=f"node {node}", **problem)
        self.node, self.pid = node, pid

    def receive(self) -> Message:
        while not self._heard:
            if self._vitals is None:
                raise EOFError
            with self._gone_as_eof():
                said, self._said = self._said or self._host.talk.remote(None), None
                heard, vitals = self._ray.get(said)
            self._heard.extend(heard)
            self._vitals = None if vitals is None else Vitals(*vitals)
        return pickle.loads(self._heard.popleft())

    def look(self) -> Vitals | None:
        return self._vitals  # the last that came: those of a node that is lost change no more

    def kill(self, patience_s: float) -> None:
        unreachable = self._ray.exceptions.RayError
        if self.pid is not None:
            # By its host, so that it is known to be gone. A node that is lost does not answer.
            with contextlib.suppress(unreachable):
                self._ray.get(self._host.end.remote(patience_s), timeout=ANSWER_S + patience_s)
        with contextlib.suppress(unreachable):
            self._ray.kill(self._host)

    @contextlib.contextmanager
    def _gone_as_eof(self) -> Iterator[None]:
        errors = self._ray.exceptions
        try:
            yield
        except (errors.RayActorError, errors.WorkerCrashedError, errors.ObjectLostError) as error:
            log.debug("worker %d: %s", self._place, error)
            raise EOFError from None


def _host() -> type:
    """Make the class of the actors. Within a function: so Ray carries its code along, and not only its name, and it
    can speak on a node that has another cosfly, or none."""

    class Host:
        """Starts a worker on its node, and passes on what it is told and says. One call at a time."""

        def __init__(self, heartbeat_s: float, log_level: int, place: int) -> None:
            import queue

            self.heartbeat_s, self.log_level, self.place = heartbeat_s, log_level, place
            self.inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()  # a worker that still imports reads nothing

        def begin(self, folder: str, record: str, cwd: str, path: list[str], version: str) -> tuple:
            """Return the node's name, the worker's process id, and what is wrong with the node."""
            import os
            import socket
            import sys
            import threading
            from pathlib import Path

            import ray

            node, python = socket.gethostname(), f"Python {sys.executable}"
            try:
                import cosfly
            except ImportError as error:
                fix = f"install cosfly {version} there, or start the node with the Python that has it"
                return node, None, {"what": "cosfly is not there", "got": f"{error} ({python})", "fix": fix}
            if cosfly.__version__ != version:
                fix = "install the same on every node, then start Ray there again"
                got = f"{cosfly.__version__} ({python})"
                return node, None, {"what": "another cosfly", "got": got, "expected": version, "fix": fix}
            from cosfly.runtime.io import sha256_file
            from cosfly.runtime.pool import LocalTransport
            from cosfly.runtime.worker import WorkerOptions

            try:
                os.chdir(cwd)
                is_same = sha256_file(Path(folder) / "stage.json") == record
            except (OSError, cosfly.runtime.errors.InputError):
                is_same = False
            if not is_same:
                got = f"no {Path(cwd) / folder}, or another folder of that name"
                fix = "have run folder and inputs on storage that all nodes share, at the same path"
                return node, None, {"what": "the stage's folder is not there", "got": got, "fix": fix}
            if devices := ray.get_gpu_ids():
                os.environ.setdefault("GLCONTEXT_DEVICE_INDEX", str(devices[0]))  # of EGL, which counts NVIDIA's first
            sys.path.extend(place for place in path if place not in sys.path)  # a spawned process takes it over
            vars(sys.modules["__main__"]).pop("__file__", None)  # Ray's own, which a spawned process would run again
            self.post = LocalTransport(WorkerOptions(os.getpid(), self.heartbeat_s, self.log_level, self.place))
            threading.Thread(target=self._send, daemon=True).start()
            return node, self.post.pid, None

        def _send(self) -> None:
            try:
                while True:
                    self.post.connection.send_bytes(self.inbox.get())
            except OSError:
                pass  # the worker is gone; `talk` tells

        def talk(self, data: bytes | None) -> tuple:
            """Pass something on; give what the worker has said since, and how it is: None if it is gone."""
            if data is not None:
                self.inbox.put(data)
            heard: list[bytes] = []
            try:
                while self.post.connection.poll(0.0 if heard else self.heartbeat_s):
                    heard.append(self.post.connection.recv_bytes())
            except (EOFError, OSError):
                return heard, None
            vitals = self.post.look()
            return heard, None if vitals is None and not heard else tuple(vitals or (0.0, 0.0))[:2]

        def end(self, patience_s: float) -> None:
            """End the worker; it is gone then."""
            self.post.kill(patience_s)

    return Host


# --- the way in -------------------------------------------------------------------------------------------------------


def connected(cfg: RayConfig) -> Any:
    """Connect this process to the cluster, if it is not; gives the module `ray`."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import ray
        from ray._private import worker as speaker
    except ImportError:
        fix = "pip install 'cosfly[ray]', on every node"
        raise EnvironmentMissing("the package ray is missing", where="--engine ray", fix=fix) from None
    if ray.is_initialized():
        return ray
    address = cfg.address or os.environ.get("RAY_ADDRESS") or "local"
    own: dict[str, Any] = {"object_store_memory": STORE_BYTES, "include_dashboard": False} if address == "local" else {}
    _knock(address)
    ends_it = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address, **own, log_to_driver=False, logging_level=logging.ERROR, namespace="cosfly")
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise _refused(address, error) from None
    finally:
        # What it tells of nodes that are lost it would write on the standard output.
        speaker.print_to_stdstream = lambda data, **_: log.debug("ray: %s", " ".join(data["lines"]))
        with contextlib.suppress(ValueError, TypeError):  # not the main thread, where Ray leaves it alone
            signal.signal(signal.SIGTERM, ends_it)
    return ray


def _knock(address: str) -> None:
    """See that somebody who speaks gRPC is at a host and port: Ray itself would try for a quarter of an hour."""
    import grpc
    from ray._private.gcs_utils import create_gcs_channel

    if ":" not in address:
        return
    channel = create_gcs_channel(address)
    try:
        grpc.channel_ready_future(channel).result(ANSWER_S)
    except grpc.FutureTimeoutError:
        raise _refused(address, f"nobody who speaks gRPC within {ANSWER_S:g} s") from None
    finally:
        channel.close()


def _refused(address: str, error: Exception | str) -> EnvironmentMissing:
    fix = "start one there (ray start --head), or leave out --address for a cluster of this machine"
    got = " ".join(str(error).split())
    return EnvironmentMissing("no Ray cluster answers", where=address, got=got, fix=fix)
