"""Fixtures shared by all tests."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest
from filelock import FileLock

# A busy machine is not a failure; pytest-timeout ends what hangs. Equal examples in every run: what no change caused
# fails nobody's change.
hypothesis.settings.register_profile(
    "cosfly", deadline=None, derandomize=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("cosfly")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell starts a command of the background so
    signal.signal(signal.SIGINT, signal.default_int_handler)  # else no Ctrl-C of a test reaches its command

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real maps are not here: {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No test sees a key, or reaches a hub, because of the machine it runs on; none inherits the command's SIGTERM."""
    monkeypatch.delenv("COSFLY_API_KEY", raising=False)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def in_this_process() -> Iterator[None]:
    """Work on items in this process."""
    from commands import working_here

    with working_here():
        yield


@pytest.fixture(scope="session")
def built_once(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Return a function that gives a directory by its name; the first worker of the session that asks fills it.

    What is in it is read by many tests; what a test writes has a directory of its own.
    """
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def give(name: str, make: Callable[[Path], object]) -> Path:
        folder, finished = base / "built_once" / name, base / "built_once" / f"{name}.finished"
        folder.parent.mkdir(exist_ok=True)
        with FileLock(f"{folder}.lock"):
            if not finished.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                finished.touch()
        return folder

    return give


@pytest.fixture(scope="session")
def place(built_once) -> Path:
    """A playback tree, a training set and a tiny student."""
    from specimens_students import make_place

    # The last name is that of its run, from which random numbers are drawn.
    return built_once("students", lambda root: make_place(root / "students0")) / "students0"


@pytest.fixture(scope="session")
def tree(built_once) -> Path:
    """A tree of one track of fourteen frames, which are five windows."""
    from specimens import make_playback_tree

    return built_once("five", lambda root: make_playback_tree(root, 1, 14, with_augmented=False))


@pytest.fixture(scope="session")
def two_splits(built_once) -> Path:
    """A release of six tracks in two towns, a split each, several shards."""
    from specimens_release import TWO_SPLITS, make_release

    return built_once("two_splits", lambda root: make_release(root, **TWO_SPLITS)) / "release" / "dataset"


@pytest.fixture(scope="session")
def release_inputs(built_once) -> Path:
    """tree/, captions.jsonl and inspect.json of six tracks, two of which are not accepted."""
    from specimens_release import make_inputs

    return built_once("release_inputs", make_inputs)


@pytest.fixture(scope="session")
def built(release_inputs, built_once) -> Path:
    """A release of eight frames of each of the four accepted tracks of `release_inputs`."""
    from specimens_release import build

    return built_once("built", lambda root: build(release_inputs, root / "release")) / "release" / "dataset"


@pytest.fixture(scope="session")
def small_run(built_once) -> Path:
    """A whole run of two walks, clean and perturbed, of 30 and 43 frames; tests copy what they change of it."""
    from specimens_release import SMALL_RUN, run_here

    return built_once("small_run", lambda root: run_here(SMALL_RUN, root / "run")) / "run"


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """PyTorch in one thread: sums then do not depend on the machine, and a tiny model is faster so."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
