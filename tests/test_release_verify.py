"""`release verify`."""

import math
import os
import shutil
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import invoke
from release_lies import LIES, at, captioned, change, everything, put, with_depth
from release_tampering import errors_in, forge, rewrite, set_depth
from specimens_foreign import hub_snapshot

from caption.stage.released import read_released
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import read_json
from release.build import stage as package
from release.build.config import ReleaseConfig
from release.build.sources import Source
from release.columns import INTRINSICS
from release.verify.verify import verify
from specimens import png_around


@pytest.fixture(scope="module")
def honest(small_run, built_once) -> Path:
    """A small release of what the whole way makes: two walks, both tracks, twenty frames each."""
    cfg = ReleaseConfig(num_frames=20, licence="cc-by-4.0")
    return built_once("honest", lambda root: package.run(cfg, [Source.of_run(small_run)], root / "r")) / "r" / "dataset"


@pytest.fixture
def dataset(honest, tmp_path) -> Path:
    return shutil.copytree(honest, tmp_path / "dataset")


@pytest.mark.parametrize("level", ["structure", "rows", "pixels"])
def test_an_honest_release_passes(honest, level):
    report = verify(honest, level=level, reader=read_released)
    assert report.is_ok, str(report)
    assert report.issues == []


def test_a_release_that_the_kit_wrote_again_passes(honest, tmp_path):
    assert errors_in(forge(honest, tmp_path / "again", lambda rows: None)) == {}


def test_depth_in_half_precision_passes(honest, tmp_path):
    """A server of Unreal sends such depth, in centimetres."""

    def rounded(depth: np.ndarray, _: dict) -> np.ndarray:
        half = (np.minimum(depth, 600.0) * 100).astype(np.float16).astype(np.float32) / 100
        return np.where(depth < 600.0, half, depth)

    assert errors_in(forge(honest, tmp_path / "forged", change(everything, with_depth(rounded)))) == {}


@pytest.mark.slow
def test_processes_find_what_one_finds(honest, tmp_path):
    forged = forge(honest, tmp_path / "forged", LIES["depth_doubled"][0])
    one, two = (verify(forged, workers=workers, reader=read_released) for workers in (0, 2))
    assert not one.is_ok
    assert str(one) == str(two)


@pytest.mark.parametrize(("add", "expected"), [
    (lambda place: place.symlink_to("/etc/hostname"), {"unreadable": 1}),
    (lambda place: write_bytes(place / "more.bin", b"anything"), {"unexpected": 1}),
])  # fmt: skip
def test_a_licence_is_a_file_of_the_folder(honest, tmp_path, add, expected):
    folder = shutil.copytree(honest, tmp_path / "release")
    add(folder / "LICENSE")
    assert errors_in(folder, "structure") == expected


def test_a_snapshot_of_the_hubs_cache_passes(honest, tmp_path):
    assert errors_in(hub_snapshot(honest, tmp_path)) == {}


def test_a_tree_is_no_release(small_run):
    report = verify(small_run / "render")
    assert [(issue.code, issue.where) for issue in report.issues] == [("record", "release.json")]


@pytest.mark.parametrize("name", LIES)
def test_a_lie_is_found(honest, tmp_path, name):
    lie, is_of_pixels = LIES[name]
    forged = forge(honest, tmp_path / "forged", lie)
    assert errors_in(forged, "pixels" if is_of_pixels else "rows"), name


RECORD_LIES = {
    "axes of the other hand": lambda r: r["coordinates"].update(handedness="left"),
    "no coordinates": lambda r: r["coordinates"].clear(),
    "no maps": lambda r: r["maps"].clear(),
    "another rule of frames": lambda r: r.update(frame_selection="the best ones"),
    "flights were left out": lambda r: r["history"]["flights"]["left_out"].update(bad=3),
    "fewer frames available": lambda r: r["flights"][0].update(frames_available=r["flights"][0]["frames"]),
    "another rule of splits": lambda r: r["splits"].update(rule="by taste"),
    "another seed of splits": lambda r: r["splits"].update(seed=3),  # which gives other splits
    "shares above one": lambda r: r["splits"]["fractions"].update(test=1.5),
    "each shard twice": lambda r: r.update(shards=2 * r["shards"]),
    "a sky of 999 m": lambda r: r["depth"].update(sky=999.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORD_LIES)
def test_a_lie_of_the_record_is_found(honest, tmp_path, name):
    forged = forge(honest, tmp_path / "forged", change_record=RECORD_LIES[name])
    assert errors_in(forged, "rows"), name


def shard_of(folder: Path) -> Path:
    return next((folder / "data").iterdir())


def instead(path: Path, make) -> None:
    path.unlink()
    make(path)


def a_link_that_leads_out(folder: Path) -> None:
    shard = shard_of(folder)
    shutil.move(shard, folder.parent / "elsewhere.parquet")
    shard.symlink_to(folder.parent / "elsewhere.parquet")


def large(path: Path) -> None:
    path.touch()
    os.truncate(path, 20_000_000_000)


def in_record(old: str, new: str):
    def change(folder: Path) -> None:
        text = (folder / "release.json").read_text()
        assert old in text
        (folder / "release.json").write_text(text.replace(old, new, 1))

    return change


HOSTILE = {
    "a broken link": lambda f: instead(shard_of(f), lambda path: path.symlink_to("nowhere.parquet")),
    "a link that leads out": a_link_that_leads_out,
    "a loop of links": lambda f: (f / "data/deeper").symlink_to(f, target_is_directory=True),
    "checksums in another encoding": lambda f: (f / "checksums.sha256").write_bytes(b"\xff\xfe\x00" * 40),
    "a card in another encoding": lambda f: (f / "README.md").write_bytes(b"\xff\xfe\x00" * 40),
    "a shard cut short": lambda f: os.truncate(shard_of(f), shard_of(f).stat().st_size // 2),
    "a shard of another schema": lambda f: pq.write_table(pa.table({"a": [1, 2, 3]}), shard_of(f)),
    "a sparse shard": lambda f: large(shard_of(f)),
    "a sparse file beside": lambda f: large(f / "data/more.parquet"),
    "a pipe": lambda f: instead(shard_of(f), os.mkfifo),
    "a folder for a file": lambda f: instead(f / "README.md", Path.mkdir),
    "a number that overflows": in_record('"frames": ', '"frames": 1e999, "x": '),
    "a flight of 10^12 frames": in_record('"frames_available": ', '"frames_available": 1000000000000'),
    "a path that escapes": in_record('"path": "data/', '"path": "../../etc/'),
    "a checksum of a file outside": lambda f: (f / "checksums.sha256").write_text(f"{'0' * 64}  ../../../etc/passwd\n"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_findings_and_no_traceback(dataset, name):
    HOSTILE[name](dataset)
    for level in ("structure", "pixels"):
        assert errors_in(dataset, level)


def picture(column: str, data: bytes):
    if column == "depth":
        return put(at(everything, 2), depth=data)
    return change(at(everything, 2), lambda r: r[column].update(bytes=data))


KEPT = {"sample_id", "run", "town", "trajectory", "variant", "frame_index", "image", "instance", "depth", "split",
    "walk", "pair",
        "width_px", "height_px", "track", "time_s", "fov_deg", "pose", "has_caption"}  # fmt: skip
ODD_ROWS = {
    "a PNG of 60,000 x 60,000": picture("image", png_around(zlib.compress(b"\0" * 1000), 60_000, 60_000)),
    "no bytes": picture("image", b""), "no depth": picture("depth", b""),
    "text for a picture": picture("instance", b"hello" * 100),
    "a flat depth": change(at(everything, 1), lambda r: set_depth(r, np.full((90, 160), 7.0, np.float32))),
    "no pose": put(at(everything, 2), pose=None),
    "hardly anything": change(at(everything, 2), lambda r: r.update(dict.fromkeys(r.keys() - KEPT))),
    "an empty window": put(at(captioned, 0), caption_window=[], caption_picture_px=[0]),
    "no focal length": put(everything, intrinsics=dict.fromkeys(INTRINSICS, 0.0)),
    "no focal length in the last frame": change(at(everything, -1), lambda r: r["intrinsics"].update(fx=0.0)),
    "people infinitely far away": change(everything, lambda r: r["target"].update(x_m=math.inf)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ODD_ROWS)
def test_odd_rows_are_findings_and_no_traceback(honest, dataset, tmp_path, name):
    try:
        forged = forge(honest, tmp_path / "forged", ODD_ROWS[name])
    except (InputError, TypeError, KeyError):  # no card comes of it: then the old one stands there, which is found too
        forged = dataset
        rewrite(forged, ODD_ROWS[name])
    assert errors_in(forged)


@pytest.mark.slow
def test_the_command_tells_people_and_machines(honest, tmp_path):
    forged = forge(honest, tmp_path / "forged", LIES["visibility_above_one"][0])
    before = {path: path.read_bytes() for path in forged.rglob("*") if path.is_file()}
    result = invoke("release verify", forged, "--level rows --workers 0 --json", tmp_path / "found.json")
    assert result.exit_code == 1
    assert "error: range: " in result.output
    told = read_json(tmp_path / "found.json")
    assert told["ok"] is False
    assert {kind["code"] for kind in told["findings"]} == {"range"}
    assert {path: path.read_bytes() for path in forged.rglob("*") if path.is_file()} == before
    assert invoke("release verify", honest, "--level structure").exit_code == 0
    assert invoke("release verify", honest, "--level all").exit_code == 2
