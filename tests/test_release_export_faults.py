"""Exports of broken sources, and onto a full disk: one line, and nothing under the name of the product."""

import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PIL import Image
from specimens_release import make_caption, make_inspection

from cosfly.formats.captions import write_captions
from cosfly.formats.inspection import write_inspection
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.config import build
from cosfly.runtime.errors import CosflyError, StorageError
from release.export.stage import EXPORTS, ExportConfig
from release.export.stage import run as export
from specimens import make_playback_tree

DISK_BYTES = 5_000  # the largest file that the system permits


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("whole") / "run"
    tree = make_playback_tree(run / "render", 2, 9, width_px=96, height_px=54)
    captions = [make_caption(track, i) for track in map(read_track, find_tracks(tree)) for i in range(4, 8)]
    (run / "caption").mkdir()
    write_captions(run / "caption/captions.jsonl", captions)
    (run / "inspect").mkdir()
    write_inspection(run / "inspect/inspect.json", make_inspection(tree, {}))
    return run


@pytest.fixture
def broken(whole_run, tmp_path) -> Path:
    return shutil.copytree(whole_run, tmp_path / "run")


def assert_refused(run: Path, out: Path, format: str, words: str) -> None:
    with pytest.raises(CosflyError) as caught:
        export(build(ExportConfig, {"format": format}, "test"), run, out)
    failures = (out / "failures.jsonl").read_text() if (out / "failures.jsonl").exists() else ""
    assert words in str(caught.value) + failures
    assert "\n" not in str(caught.value)
    assert '"bug"' not in failures
    assert not (out / format).exists()


def no_captions(run: Path) -> None:
    shutil.rmtree(run / "caption")


def captions_of_another_tree(run: Path) -> None:
    path = run / "caption/captions.jsonl"
    path.write_text(path.read_text(encoding="utf-8").replace('"trajectory_', '"trajectory_9'), encoding="utf-8")


def picture_of(run: Path) -> Path:
    return find_tracks(run / "render")[0] / "frames_playback/frame_00005/rgb.png"


def missing_picture(run: Path) -> None:
    picture_of(run).unlink()


def smaller_picture(run: Path) -> None:
    Image.new("RGB", (48, 27)).save(picture_of(run))


def tracks_of_two_sizes(run: Path) -> None:
    smaller = make_playback_tree(run.parent / "smaller", 1, 9, width_px=48, height_px=27, towns=("Town07",))
    shutil.copytree(smaller / "Town07", run / "render/Town07")
    write_inspection(run / "inspect/inspect.json", make_inspection(run / "render", {}))


@pytest.mark.parametrize(("fault", "formats", "words"), [
    (no_captions, ["chat", "sharegpt"], "no caption to export"),
    (captions_of_another_tree, EXPORTS, "the captions are of another playback tree"),
    (missing_picture, EXPORTS, "frame_00005/rgb.png"),
    (smaller_picture, EXPORTS, "the picture has another size than its track"),
    (tracks_of_two_sizes, ["lerobot"], "needs pictures of one size"),
])  # fmt: skip
def test_a_broken_source_is_refused(broken, tmp_path, fault: Callable[[Path], None], formats, words):
    fault(broken)
    for format in formats:
        assert_refused(broken, tmp_path / f"out_{format}", format, words)


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
def test_a_full_disk_leaves_nothing_half_written(whole_run, tmp_path, format):
    cfg, out = build(ExportConfig, {"format": format}, "test"), tmp_path / "out"
    with full_disk(), pytest.raises(StorageError, match="the file cannot be written") as caught:
        export(cfg, whole_run, out)
    assert "\n" not in str(caught.value)
    assert not (out / format).exists()
    assert list(out.rglob("*.partial")) == []
    assert (export(cfg, whole_run, out) / "export.json").is_file()
