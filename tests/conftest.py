"""Fixtures shared by all tests."""

import contextlib
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

# A busy machine is not a failure; pytest-timeout ends what hangs. Equal examples in every run: what no change caused
# fails nobody's change.
hypothesis.settings.register_profile(
    "cosfly", deadline=None, derandomize=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("cosfly")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


# Files that take a minute or more, the longest first: begun last, one would leave the other worker without work.
LONG = (
    "test_docs_run.py", "test_release_honest.py", "test_crashes.py", "test_release_verify.py",
    "test_pipeline_tiny.py", "test_planners_contract.py", "test_release_build.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; `--dist loadfile --no-loadscope-reorder` hands files out in this order."""
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


@pytest.fixture
def shared_data() -> Path:
    """The folder of real maps beside the repository; the test is skipped where it is absent."""
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


HOLDER = """
import sys, time
from pathlib import Path
from cosfly.runtime.run_dir import hold_folder
lock = hold_folder(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(600)
"""


@contextlib.contextmanager
def _held_by_another(folder: Path) -> Iterator[subprocess.Popen]:
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        try:
            yield other
        finally:
            other.kill()


@pytest.fixture
def held_by_another() -> Callable[[Path], contextlib.AbstractContextManager[subprocess.Popen]]:
    """Give a context in which another process holds a folder; it is killed at the end."""
    return _held_by_another


@pytest.fixture(scope="session")
def place(tmp_path_factory) -> Path:
    """A playback tree, a training set and a tiny student, read by many tests; what a test writes has a folder of its
    own."""
    from specimens_students import make_place

    return make_place(tmp_path_factory.mktemp("students") / "students0")  # its run, by whose name chance is drawn


@pytest.fixture(scope="session")
def tree(tmp_path_factory) -> Path:
    """A tree of one flight of fourteen frames, which are five windows; read by many tests."""
    from specimens import make_playback_tree

    return make_playback_tree(tmp_path_factory.mktemp("five"), 1, 14, with_augmented=False)


@pytest.fixture(scope="session")
def two_splits(tmp_path_factory) -> Path:
    """A release of six flights in two towns, a split each, several shards; read by many tests."""
    from specimens_release import TWO_SPLITS, make_release

    return make_release(tmp_path_factory.mktemp("two_splits"), **TWO_SPLITS)


@pytest.fixture(scope="session")
def dataset(two_splits) -> Path:
    """The release of a test that does not mind which."""
    return two_splits


@pytest.fixture(scope="session")
def release_inputs(tmp_path_factory) -> Path:
    """tree/, captions.jsonl and inspect.json of six flights, two of which are not accepted; read by many tests."""
    from specimens_release import make_inputs

    return make_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture(scope="session")
def built(release_inputs, tmp_path_factory) -> Path:
    """What `release_inputs` become: a release of eight frames of each of four flights; read by many tests."""
    from specimens_release import build

    return build(release_inputs, tmp_path_factory.mktemp("built") / "release")


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """PyTorch in one thread: sums then do not depend on the machine, and a tiny model is faster so."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
