"""Stages on a Ray cluster: an actor on a node with free resources starts a worker process and relays its messages.

Ray finds the node, carries bytes and reports lost nodes. `pool` decides when a worker counts as stalled and what
is tried again, as for the processes of one machine. Ray transfers no files: the nodes share the folder of the stage and
its inputs. Workers receive one item at a time, and no frame passes through Ray.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import Field

import cosfly
from cosfly.runtime.config import Config
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.events import Vitals
from cosfly.runtime.io import sha256_file
from cosfly.runtime.worker import Item, Message, Start

log = logging.getLogger(__name__)

ALL_ROOM = 2**31  # this number of workers means: as many as fit on the cluster when a stage begins
STORE_BYTES = 80_000_000  # object store of a cluster of this machine: Ray's minimum, since it stores nothing of ours
ANSWER_S = 5.0  # time limit for an answer of a head node or an actor
ROUNDING = 1e-6  # lets four shares of 0.25 fit in one device
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # send no usage report
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # otherwise it hides the GPUs from workers that request none
}
MOST_TEMP_BYTES = 38  # of a temporary directory: Ray adds up to 69 bytes to it, and the path of a socket has 107
WAITING_S = 30.0  # interval of warnings that no node has free resources


class RayConfig(Config):
    """The address of a Ray cluster, and the resources of a worker."""

    address: str = Field(
        "", pattern=r"^(auto|[^/\s]+:\d+)?$",
        description="host:port of the head node, or auto for the cluster of this machine; empty: the address in "
        "$RAY_ADDRESS, or else a cluster of this machine alone, which ends with the command",
    )  # fmt: skip
    worker_cpus: float = Field(1.0, gt=0, description="number of CPUs that a worker reserves on its node")
    worker_gpus: float = Field(
        0.0, ge=0, description="number of GPUs that a worker reserves; 0.25 lets four workers share one; 0: none"
    )


class Cluster:
    """A cluster whose nodes share the folder of a stage."""

    def __init__(self, cfg: RayConfig, folder: Path) -> None:
        self._folder = folder
        self._ray = connected(cfg)
        self._record_sha256 = sha256_file(folder / "stage.json")
        self._actor_options = {"num_cpus": cfg.worker_cpus, "num_gpus": cfg.worker_gpus, "max_restarts": 0}
        shares = {"CPU": cfg.worker_cpus}
        if cfg.worker_gpus:
            shares["GPU"] = cfg.worker_gpus
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        self.room = 0  # the number of workers that fit on the nodes when they are idle
        for node in nodes:
            self.room += min(int(node.get(name, 0.0) / share + ROUNDING) for name, share in shares.items())
        # The resources of a worker, in words.
        self.needs = " and ".join(f"{share:g} {name}s" for name, share in shares.items())
        if not self.room:
            got = ", ".join(f"{node.get('CPU', 0):g} CPUs and {node.get('GPU', 0):g} GPUs" for node in nodes)
            what = "no node is large enough for a worker"
            expected = f"a node with at least {self.needs}"
            fix = "lower ray.worker_cpus or ray.worker_gpus, or add a larger node"
            raise EnvironmentMissing(what, got=f"nodes with {got}", expected=expected, fix=fix)
        self._actor = self._ray.remote(_host())

    def start_transport(self, *options: Any) -> RayTransport:
        """Request a worker on any node; the options are the arguments of `LocalTransport`."""
        host = self._actor.options(**self._actor_options).remote()
        started = host.start.remote(
            options, str(self._folder), self._record_sha256, os.getcwd(), sys.path, cosfly.__version__
        )
        worker_index = options[-1]
        return RayTransport(self._ray, host, started, worker_index, self.needs)


class RayTransport:
    """The connection to a worker process on a node; its methods are those of `LocalTransport`."""

    def __init__(self, ray: Any, host: Any, started: Any, worker_index: int, needs: str) -> None:
        self.pid: int | None = None
        self.node: str | None = None
        self._ray = ray
        self._host = host
        self._started = started
        self._worker_index = worker_index
        self._needs = needs
        self._call: Any = None
        self._received = deque[bytes]()
        self._vitals: Vitals | None = Vitals(0.0, 0.0)

    def send(self, message: Start | Item | None) -> None:
        """Send a message once the worker has started; raises EnvironmentMissing if its node cannot run it."""
        data = pickle.dumps(message)
        with self._gone_as_eof():
            while self.pid is None:
                if self._ray.wait([self._started], timeout=WAITING_S)[0]:
                    self.node, self.pid, problem = self._ray.get(self._started)
                    if problem:
                        raise EnvironmentMissing(**problem)  # the pool adds the node
                elif self._worker_index == 0:
                    log.warning("worker 0 waits until a node has %s free; run `ray status` for details", self._needs)
            self._call = self._host.exchange.remote(data)

    def receive(self) -> Message:
        while not self._received:
            if self._vitals is None:
                raise EOFError
            with self._gone_as_eof():
                call = self._call or self._host.exchange.remote(None)
                self._call = None
                received, vitals = self._ray.get(call)
            self._received.extend(received)
            self._vitals = None if vitals is None else Vitals(*vitals)
        return pickle.loads(self._received.popleft())

    def look(self) -> Vitals | None:
        return self._vitals  # the last received ones: those of a lost node stay the same, so that it counts as stalled

    def kill(self, patience_s: float) -> None:
        unreachable = self._ray.exceptions.RayError
        if self.pid is not None:
            # The host confirms that the worker is gone. A lost node does not answer.
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
            log.debug("worker %d: %s", self._worker_index, error)
            raise EOFError from None


def _host() -> type:
    """Return the class of the actors.

    Ray pickles a local class by value, so it also runs on a node without this version of cosfly, and can report that.
    """

    class Host:
        """Starts a worker on its node and relays its messages. One call at a time."""

        def start(
            self, options: tuple, folder: str, record_sha256: str, cwd: str, path: list[str], version: str
        ) -> tuple:
            """Return the node's name, the worker's process id, and the arguments of an error, if there is one."""
            import os
            import queue
            import socket
            import sys
            import threading

            import ray

            node = socket.gethostname()
            problem = self._find_problem(folder, record_sha256, cwd, version)
            if problem is not None:
                return node, None, problem
            from cosfly.runtime.worker import LocalTransport

            if devices := ray.get_gpu_ids():
                os.environ.setdefault("GLCONTEXT_DEVICE_INDEX", str(devices[0]))  # EGL lists NVIDIA devices first
            sys.path.extend(entry for entry in path if entry not in sys.path)  # a spawned process inherits it
            vars(sys.modules["__main__"]).pop("__file__", None)  # a spawned process would run Ray's main module again
            self.heartbeat_s = options[0]
            self.inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()  # a worker reads nothing while it imports
            self.worker = LocalTransport(*options)
            threading.Thread(target=self._send, daemon=True).start()
            return node, self.worker.pid, None

        def _find_problem(self, folder: str, record_sha256: str, cwd: str, version: str) -> dict[str, str] | None:
            """Enter `cwd` and check this node; return the arguments of an error, or None."""
            import os
            import sys
            from pathlib import Path

            python = f"Python {sys.executable}"
            try:
                import cosfly
            except ImportError as error:
                fix = f"install cosfly {version} on the node, or start Ray there with the Python that has cosfly"
                return {"what": "cosfly is not installed on the node", "got": f"{error} ({python})", "fix": fix}
            if cosfly.__version__ != version:
                fix = "install the same version on every node, then start Ray again on the nodes"
                got = f"{cosfly.__version__} ({python})"
                what = "the node has a different version of cosfly"
                return {"what": what, "got": got, "expected": version, "fix": fix}
            from cosfly.runtime.errors import InputError
            from cosfly.runtime.io import sha256_file

            try:
                os.chdir(cwd)
                is_same = sha256_file(Path(folder) / "stage.json") == record_sha256
            except (OSError, InputError):
                is_same = False
            if is_same:
                return None
            got = f"no folder {Path(cwd) / folder}, or one with a different stage.json"
            fix = "put the run directory and the inputs on storage that all nodes mount at the same path"
            return {"what": "the node cannot read the folder of the stage", "got": got, "fix": fix}

        def _send(self) -> None:
            try:
                while True:
                    self.worker.connection.send_bytes(self.inbox.get())
            except OSError:
                pass  # the worker is gone; `exchange` reports it

        def exchange(self, data: bytes | None) -> tuple:
            """Forward a message; return the worker's new messages, and its vitals or None if it is gone."""
            if data is not None:
                self.inbox.put(data)
            received: list[bytes] = []
            try:
                while self.worker.connection.poll(0.0 if received else self.heartbeat_s):
                    received.append(self.worker.connection.recv_bytes())
            except (EOFError, OSError):
                return received, None
            vitals = self.worker.look()
            if vitals is not None:
                return received, tuple(vitals)
            return received, (0.0, 0.0) if received else None  # its last messages come before the news of its end

        def end(self, patience_s: float) -> None:
            """End the worker and wait until it is gone."""
            self.worker.kill(patience_s)

    return Host


# --- the connection ---------------------------------------------------------------------------------------------------


def connected(cfg: RayConfig) -> Any:
    """Connect this process to the cluster, if it is not connected, and return the module `ray`."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import ray
        from ray._private import worker as ray_worker
    except ImportError:
        fix = "pip install -e '.[ray]', on every node"
        raise EnvironmentMissing("the package ray is not installed", where="--engine ray", fix=fix) from None
    if ray.is_initialized():
        return ray
    address = cfg.address or os.environ.get("RAY_ADDRESS") or "local"
    local_options: dict[str, Any] = {}
    if address == "local":
        local_options = {"object_store_memory": STORE_BYTES, "include_dashboard": False}
        place = os.environ.get("RAY_TMPDIR") or tempfile.gettempdir()
        if len(place.encode()) > MOST_TEMP_BYTES:
            local_options["_temp_dir"] = short = f"/tmp/ray-{os.getuid()}"
            log.info("ray: the temporary directory %s is too long for the paths of its sockets; using %s", place, short)
    if ":" in address:
        _check_reachable(address)
    handler = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address, **local_options, log_to_driver=False, logging_level=logging.ERROR, namespace="cosfly")
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise _refused(address, error) from None
    finally:
        # Ray would write messages about lost nodes to the standard output.
        ray_worker.print_to_stdstream = lambda data, **_: log.debug("ray: %s", " ".join(data["lines"]))
        with contextlib.suppress(ValueError, TypeError):  # outside the main thread, where Ray sets no handler
            signal.signal(signal.SIGTERM, handler)
    return ray


def _check_reachable(address: str) -> None:
    """Check that a gRPC server answers at a host and port: Ray itself would try for a quarter of an hour."""
    import grpc
    from ray._private.gcs_utils import create_gcs_channel

    channel = create_gcs_channel(address)
    try:
        grpc.channel_ready_future(channel).result(ANSWER_S)
    except grpc.FutureTimeoutError:
        raise _refused(address, f"no answer of a gRPC server within {ANSWER_S:g} s") from None
    finally:
        channel.close()


def _refused(address: str, error: Exception | str) -> EnvironmentMissing:
    fix = "start a cluster there (ray start --head), or omit --address to use this machine alone"
    got = " ".join(str(error).split())
    return EnvironmentMissing("no Ray cluster answers at this address", where=address, got=got, fix=fix)
