"""`cosfly teacher serve` and `--teacher serve:MODEL` over a real server's process: its life, its faults, its end."""

from __future__ import annotations

import contextlib
import http.client
import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from processes import is_running, wait_until
from simulator_serving import free_port
from specimens_captions import settings
from teacher_process import __file__ as SERVER
from teacher_process import journaled
from teacher_server import kept_answers

from caption.run.stage import run
from caption.schema import CaptionConfig
from cosfly.chat.supervisor import ServeConfig, TeacherServers
from cosfly.errors import ConfigError, CosflyError, EnvironmentMissing
from cosfly.products.captions import read_captions
from specimens import make_playback_tree

COMMAND = (sys.executable, SERVER, "$name", "--port", "$port")
PATIENT = {"max_tries": 6, "timeout_s": 3.0, "backoff_s": 0.1, "max_backoff_s": 0.5, "concurrency": 4}

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what a killed process leaves is found through /proc")


def serving(*more: object, **changes) -> ServeConfig:
    changes = {"port": free_port(), "ready_s": 60.0, **changes}
    return ServeConfig(command=COMMAND, arguments=tuple(map(str, more)), **changes)


@pytest.fixture(autouse=True)
def logs_stay_here(tmp_path, monkeypatch) -> None:
    """Logs of servers that failed stay; those of a test, where the test is."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)


def pids_in(path: Path) -> list[int]:
    return list(map(int, path.read_text().split()))


def listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
        return True
    return False


def test_replicas_have_accelerators_and_ports_of_their_own_and_end_with_their_children(monkeypatch, tmp_path):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,4,5,6")
    child = tmp_path / "child"
    cfg = serving("--child", child, replicas=2, gpus=2)
    with TeacherServers("some/model", cfg, 15) as servers:
        assert servers.urls == f"http://127.0.0.1:{cfg.port}/v1,http://127.0.0.1:{cfg.port + 1}/v1"
        for number, devices in enumerate(("3,4", "5,6")):
            connection = http.client.HTTPConnection("127.0.0.1", cfg.port + number)
            connection.request("GET", "/v1/models")
            assert b"some/model" in connection.getresponse().read()
            log = servers.replicas[number].log_file
            wait_until(lambda log=log, devices=devices: devices in log.read_text())
        pids = pids_in(child)
        assert all(map(is_running, pids))
    assert not any(map(is_running, pids)), "the child has a session of its own"
    assert not listens(cfg.port)
    assert not servers.folder.exists()
    with pytest.raises(ConfigError, match=r"4 accelerators.*3 x 2"):
        TeacherServers("some/model", serving(replicas=3, gpus=2), 15)


@pytest.mark.parametrize(("arguments", "changes", "words"), [
    (["--silent"], {"ready_s": 1.5}, ["not ready within 1.5 s", "ready_s"]),
    (["--last-words", "torch.OutOfMemoryError: CUDA out of memory"], {}, ["memory is full", "status 3"]),
    (["--last-words", "RuntimeError: No CUDA GPUs are available"], {}, ["finds no accelerator", "RuntimeError: No CU"]),
    (["--last-words", "ValueError: a head of 7"], {}, ["status 3: 'ValueError: a head of 7'"]),
    (["--last-words", "bye"], {}, ["status 3: 'the engine did not start'"]),
    (["--speed", "9"], {}, ["status 2", "does not know an argument", "--speed"]),
])  # fmt: skip
def test_a_server_that_does_not_start_says_why(arguments, changes, words):
    cfg = serving(*arguments, **changes)
    with pytest.raises(CosflyError) as refused, TeacherServers("model", cfg, 15):
        pass
    for word in [*words, f"http://127.0.0.1:{cfg.port}/v1"]:
        assert word in str(refused.value)


WARNS = (
    "(APIServer pid=1) WARNING 11-27 10:44:51 [system_utils.py:255] Found ulimit of 20000 and failed to automatically "
    "increase. This can cause fd limit errors like `OSError: [Errno 24] Too many open files`."
)
ENDS = "RuntimeError: Engine core initialization failed. See root cause above. Failed core proc(s): {'EngineCore': 1}"


@pytest.mark.parametrize(("lines", "told"), [
    (["(Worker pid=3) ERROR 11-27 10:45:23 [multiproc_executor.py:1063] ValueError: Available memory on node 0", ENDS],
     "status 3: '(Worker pid=3) ERROR 11-27 10:45:23 [multiproc_executor.py:1063] ValueError: Available memory"),
    (["pydantic_core._pydantic_core.ValidationError: 1 validation error for ModelConfig",
      "  Value error, User-specified max_model_len (2000000) is greater than the derived max_model_len"],
     "status 3: 'Value error, User-specified max_model_len (2000000)"),
    (["    raise LocalEntryNotFoundError(", "huggingface_hub.errors.LocalEntryNotFoundError: Cannot find a snapshot"],
     "it has no such model: 'huggingface_hub.errors.LocalEntryNotFoundError"),
    (["(EngineCore pid=2) ERROR 11-27 10:45:41 [core.py:1510] AssertionError: Not enough allowed NUMA nodes", ENDS],
     "AssertionError: Not enough allowed NUMA nodes"),
])  # fmt: skip
def test_of_what_vllm_says_the_line_is_told_that_says_why(lines, told):
    """Lines of vLLM 0.32.0, which warns in each of a limit of files."""
    cfg = serving("--last-words", "\n".join([WARNS, *lines]))
    with pytest.raises(CosflyError) as refused, TeacherServers("model", cfg, 15):
        pass
    assert told in str(refused.value)


def test_a_port_that_is_taken_and_a_command_that_is_not_there():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        servers = TeacherServers("model", serving(port=port), 15)
        with pytest.raises(CosflyError, match=rf"port {port} cannot be had.*--port"), servers:
            pass
    with pytest.raises(EnvironmentMissing, match=r"vllm-of-nobody.*caption.serve.command"):
        TeacherServers("model", ServeConfig(command=("vllm-of-nobody",)), 15)


def test_vllm_is_started_with_what_our_prompts_need(tmp_path):
    folder = tmp_path / "student"
    folder.mkdir()
    fake = tmp_path / "vllm"
    fake.write_text("#!/bin/sh\necho \"$@\" | sed 's/^/Error: asked for /'; exit 7\n")
    fake.chmod(0o755)
    cfg = ServeConfig(port=free_port(), gpus=2, arguments=("--gdn-prefill-backend", "triton"))
    cfg = cfg.model_copy(update={"command": (str(fake), *cfg.command[1:])})
    with pytest.raises(CosflyError) as refused, TeacherServers(str(folder), cfg, 15):
        pass
    for words in (
        f"serve {folder} --served-model-name student --host 127.0.0.1 --port {cfg.port} --tensor-parallel-size 2",
        '--limit-mm-per-prompt {"image": 15, "video": 0}',
    ):
        assert words in str(refused.value)


def test_a_server_that_dies_is_started_anew_a_bounded_number_of_times(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr("cosfly.chat.supervisor.FIRST_PAUSE_S", 0.1)
    child, seen = tmp_path / "child", set()
    with TeacherServers("model", serving("--child", child, restarts=2), 15) as servers:
        for _ in range(3):
            wait_until(lambda: servers.replicas[0].is_ready and pids_in(child)[0] not in seen)
            seen.add(pids_in(child)[0])
            os.kill(pids_in(child)[0], signal.SIGKILL)
            wait_until(lambda: not servers.replicas[0].is_ready)
        wait_until(lambda: "given up" in caplog.text)
        with pytest.raises(CosflyError, match="ended by signal 9"):
            servers.check()
    assert len(seen) == 3
    assert caplog.text.count("started anew") == 2
    assert servers.folder.exists(), "the log of one that failed stays"


# --- the commands -----------------------------------------------------------------------------------------------------


def cosfly(*words: object, **more) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "cosfly", *map(str, words)], text=True, **more)


def as_settings(cfg: ServeConfig) -> list[str]:
    told = {name: list(value) if isinstance(value, tuple) else value for name, value in cfg.model_dump().items()}
    return [word for name, value in told.items() for word in ("--set", f"caption.serve.{name}={value}")]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_no_server_is_left_however_the_command_ends(number, tmp_path):
    cfg, child = serving("--child", tmp_path / "child", port=free_port()), tmp_path / "child"
    process = cosfly("teacher", "serve", "model", *as_settings(cfg), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == f"--teacher http://127.0.0.1:{cfg.port}/v1\n"
        pids = pids_in(child)
        process.send_signal(number)
        assert process.wait(60) in (-number, 128 + number)
        wait_until(lambda: not any(map(is_running, pids)))
        wait_until(lambda: not listens(cfg.port))  # its last threads may end, and let it go, a moment later
    finally:
        process.kill()
        process.communicate()


def served(cfg: ServeConfig) -> CaptionConfig:
    return settings("serve:test-teacher", endpoint=PATIENT, serve=cfg.model_dump())


@pytest.mark.parametrize("fault", ["--die-after 15", "--die-after 15 --dying-s 6", "--hang-after 15"])
def test_servers_of_one_run_begin_and_end_with_it_and_one_that_dies_or_hangs_costs_nothing(
    monkeypatch, tmp_path, caplog, fault
):
    monkeypatch.setattr("cosfly.chat.supervisor.FIRST_PAUSE_S", 0.1)
    monkeypatch.setattr("cosfly.chat.supervisor.ANSWER_S", 2.0)
    tree = make_playback_tree(tmp_path / "tree", 1, 20, with_augmented=False)  # 11 windows
    journal, child = tmp_path / "journal", tmp_path / "child"
    hung_s = {"hung_s": 5.0} if "--hang-after" in fault else {}  # a busy machine's server is not hung
    cfg = serving("--journal", journal, "--child", child, *fault.split(), **hung_s)
    run(served(cfg), tree, tmp_path / "out")
    assert ("has not answered for" in caplog.text) == ("--hang-after" in fault)
    assert {caption.status for caption in read_captions(tmp_path / "out" / "captions.jsonl")} == {"accepted"}
    keys = [record["key"] for record in kept_answers(tmp_path / "out")]
    assert len(keys) == len(set(keys)) == 22
    assert len({pid for pid, _ in journaled(journal)}) == 2, "it is of no use after fifteen answers"
    assert not any(map(is_running, pids_in(child)))
    asked = len(journaled(journal))
    run(served(cfg), tree, tmp_path / "out")  # complete: nothing is started
    assert len(journaled(journal)) == asked


def test_a_killed_run_leaves_no_server_and_goes_on(tmp_path):
    tree = make_playback_tree(tmp_path / "tree", 1, 30, with_augmented=False)
    journal, child, out = tmp_path / "journal", tmp_path / "child", tmp_path / "out"
    cfg = serving("--journal", journal, "--child", child, "--delay", 0.1)
    words = ["caption", "--teacher", "serve:test-teacher", "--data", tree, "--out", out, *as_settings(cfg)]
    words += ["--set", "caption.image.max_side_px=32", "--set", "caption.endpoint.concurrency=2"]
    process = cosfly(*words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_until(lambda: len(journaled(journal)) >= 6 and len(kept_answers(out)) >= 4)
    pids = pids_in(child)
    process.kill()
    process.wait()
    wait_until(lambda: not any(map(is_running, pids)))
    kept = len(kept_answers(out))
    assert kept >= 4
    assert cosfly(*words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).wait() == 0
    keys = [record["key"] for record in kept_answers(out)]
    assert len(keys) == len(set(keys)) > kept
    assert not any(map(is_running, pids_in(child)))
