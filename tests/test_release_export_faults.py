"""Exports of what has nothing to export, and onto a full disk: one line, and nothing under the name of the product."""

import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from specimens_release import release_of

from cosfly.runtime.config import build
from cosfly.runtime.errors import CosflyError, InputError, StorageError
from release.export.stage import EXPORTS, ExportConfig
from release.export.stage import run as export
from specimens import make_playback_tree

DISK_BYTES = 5_000  # the largest file that the system permits


@pytest.fixture(scope="module")
def whole_release(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("whole")
    make_playback_tree(root / "tree", 2, 9, width_px=96, height_px=54)
    return release_of(root)


@pytest.mark.parametrize("format", ["chat", "sharegpt"])
def test_a_release_without_captions_is_refused(tmp_path, format):
    make_playback_tree(tmp_path / "tree", 1, 4, width_px=96, height_px=54)  # too short for a window
    dataset = release_of(tmp_path)
    with pytest.raises(CosflyError, match="no caption to export") as caught:
        export(build(ExportConfig, {"format": format}, "test"), dataset, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out" / format).exists()


@pytest.mark.parametrize("format", EXPORTS)
def test_what_is_not_a_release_is_refused(whole_release, tmp_path, format):
    run = tmp_path / "run"
    shutil.copytree(whole_release.parents[1] / "tree", run / "render")
    with pytest.raises(InputError, match=r"the folder is not a release.*cosfly release build") as caught:
        export(build(ExportConfig, {"format": format}, "test"), run, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@contextmanager
def full_disk() -> Iterator[None]:
    """Limit the size of files: the system cuts the write that exceeds it, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("format", EXPORTS)
def test_a_full_disk_leaves_nothing_half_written(whole_release, tmp_path, format):
    cfg, out = build(ExportConfig, {"format": format}, "test"), tmp_path / "out"
    with full_disk(), pytest.raises(StorageError, match="the file cannot be written") as caught:
        export(cfg, whole_release, out)
    assert "\n" not in str(caught.value)
    assert not (out / format).exists()
    assert list(out.rglob("*.partial")) == []
    assert (export(cfg, whole_release, out) / "README.md").is_file()
