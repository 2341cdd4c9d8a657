"""`release verify` on exports: rows and pictures of each format are read again, and lies in them are found whatever its checksums say."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from release_lies import LIES
from release_tampering import errors_in, forge, pixels_of, png

from caption.run.released import read_released
from cosfly.app import pipeline
from cosfly.app.settings import RunConfig
from cosfly.reading.documents import read_json
from cosfly.reading.files import sha256_file
from cosfly.work.config import load
from cosfly.work.store import read_checksums, write_checksums
from release.export.contract import FORMATS, ExportConfig
from release.export.stage import run as export
from release.package import stage as package
from release.package.sources import Source
from release.package.stage import ReleaseConfig
from release.verify.verify import verify

TINY = [
    "pedestrians.num_paths=1", "pedestrians.min_distance_m=10", "pedestrians.max_distance_m=20", "render.width_px=160",
    "render.height_px=90", "workers=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("exports") / "run"
    pipeline.run(load(RunConfig, None, TINY), out)
    return out


def released(run: Path, out: Path, **settings) -> Path:
    return package.run(ReleaseConfig(num_frames=16, licence="cc0-1.0", **settings), [Source.of_run(run)], out)


@pytest.fixture(scope="module")
def honest(run, tmp_path_factory) -> Path:
    return released(run, tmp_path_factory.mktemp("exports") / "release")


@pytest.fixture(scope="module")
def honest_exports(honest, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("formats")
    return {name: exported_as(name, honest, folder / name) for name in FORMATS}


def exported_as(name: str, release: Path, out: Path) -> Path:
    return export(ExportConfig(format=name), release, out, workers=0)


@pytest.fixture
def exported(honest_exports, tmp_path) -> Path:
    return shutil.copytree(honest_exports["webdataset"], tmp_path / "webdataset")


@pytest.fixture
def episodes(honest_exports, tmp_path) -> Path:
    return shutil.copytree(honest_exports["lerobot"], tmp_path / "lerobot")


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("level", ["structure", "rows", "pixels"])
def test_an_honest_export_passes(honest_exports, name, level):
    report = verify(honest_exports[name], level=level, reader=read_released)
    assert report.is_ok, str(report)
    assert report.issues == []
    assert level == "structure" or any("32 rows of 2 flights" in fact for fact in report.facts)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("coding", ["float16", "millimetre_png"])
def test_an_honest_export_of_coded_depth_passes(run, tmp_path, name, coding):
    release = released(run, tmp_path / "release", depth=coding)
    report = verify(exported_as(name, release, tmp_path / name), level="pixels", reader=read_released)
    assert report.issues == [], str(report)


@pytest.mark.parametrize("name", FORMATS)
def test_an_export_is_what_its_release_gives(honest, honest_exports, tmp_path, name):
    report = verify(honest_exports[name], level="structure", source=honest)
    assert report.issues == [], str(report)
    assert any("made again" in fact for fact in report.facts)
    other = forge(honest, tmp_path / "other", lambda rows: rows[3].update(style=None))
    assert "source" in errors_in(honest_exports[name], "structure", source=other)
    # A patch of one picture, which nothing else in the export tells.
    patched = exported_as(name, forge(honest, tmp_path / "patched", _patch), tmp_path / name)
    about = read_json(patched / "export.json")
    about["release"] = read_json(honest_exports[name] / "export.json")["release"]
    (patched / "export.json").write_text(json.dumps(about))
    make_right(patched, patched / "export.json")
    assert "source" in errors_in(patched, "structure", source=honest)


def _patch(rows):
    pixels = pixels_of(rows[3], "image")
    pixels[1:3, 1:3] = 255 - pixels[1:3, 1:3]
    rows[3]["image"]["bytes"] = png(pixels)


LIES_BY_FORMAT = {
    "webdataset": (
        "depth_doubled", "colours_of_neighbours_exchanged", "empty_instances", "pose_jumps", "number_differs_between_languages",
        "sample_id_of_another_frame",
    ),
    "lerobot": (
        "depth_doubled", "colours_of_neighbours_exchanged", "empty_instances", "pose_jumps", "sample_id_of_another_frame",
        "verdict_outside_the_set", "consistent_with_another_decision", "visibility_above_one", "visible_but_not_in_view",
        "target_pixel_moved", "target_depth_against_depth", "focal_lengths_exchanged", "all_targets_null", "depth_not_a_number",
        "decision_differs_between_languages", "chinese_in_english", "poses_of_two_frames_exchanged",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("format", "name"), [(f, name) for f, names in LIES_BY_FORMAT.items() for name in names])
def test_a_lie_is_found_in_an_export(honest, tmp_path, format, name):
    forged = forge(honest, tmp_path / "forged", LIES[name][0])
    assert errors_in(exported_as(format, forged, tmp_path / "export"))


# --- what LeRobot adds ------------------------------------------------------------------------------------------------


def change_table(folder: Path, name: str, change: Callable[[list[dict]], None]) -> None:
    """Change the rows of a table, one row group as before, and make the checksums right."""
    path = sorted(folder.glob(name))[0]
    rows = pq.read_table(path).to_pylist()
    schema = pq.read_schema(path)
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), path, compression="zstd")
    make_right(folder, path)


def _set(column: str, value) -> Callable[[list[dict]], None]:
    def change(rows: list[dict]) -> None:
        rows[3][column] = value(rows[3][column])

    return change


def _depth_cut(rows: list[dict]) -> None:
    rows[3]["observation.depth"]["bytes"] = rows[3]["observation.depth"]["bytes"][:-100]


def _depth_elsewhere(rows: list[dict]) -> None:
    """Strips that lie behind the end."""
    data = bytearray(rows[3]["observation.depth"]["bytes"])
    data[4:8] = (len(data) - 3).to_bytes(4, "little")
    rows[3]["observation.depth"]["bytes"] = bytes(data)


CHANGED_EPISODES: dict[str, tuple[Callable[[list[dict]], None], str]] = {
    "another action": (_set("action", lambda a: [a[0] + 0.1, *a[1:]]), "episode"),
    "another time": (_set("timestamp", lambda t: t + 0.1), "episode"),
    "another number": (_set("index", lambda k: k + 1), "episode"),
    "another task": (_set("task_index", lambda k: k + 1), "episode"),
    "done too soon": (_set("next.done", lambda done: True), "episode"),
    "a frame less": (lambda rows: rows.pop(), "episode"),
    "a depth cut short": (_depth_cut, "unreadable"),
    "a depth that lies elsewhere": (_depth_elsewhere, "unreadable"),
}


@pytest.mark.parametrize("name", CHANGED_EPISODES)
def test_a_changed_episode_is_found(episodes, name):
    change, code = CHANGED_EPISODES[name]
    change_table(episodes, "data/*/*.parquet", change)
    assert code in errors_in(episodes)


@pytest.mark.parametrize(
    ("key", "value"),
    [("fps", 4), ("total_frames", 7), ("total_episodes", 9), ("features", {}), ("codebase_version", "v9"), ("fps", 0), ("fps", "x")],
)  # fmt: skip
def test_changed_info_is_found(episodes, key, value):
    path = episodes / "meta/info.json"
    path.write_text(json.dumps(read_json(path) | {key: value}))
    make_right(episodes, path)
    assert errors_in(episodes, "rows")


def test_episodes_of_another_flight_are_found(honest_exports, tmp_path):
    folder = shutil.copytree(honest_exports["lerobot"], tmp_path / "lerobot")
    change_table(
        folder, "meta/episodes/*/*.parquet", lambda rows: rows[0].update(first_frame=rows[0]["first_frame"] + 1)
    )
    assert "sample_id" in errors_in(folder, "rows")
    change_table(folder, "meta/episodes/*/*.parquet", lambda rows: rows.pop())
    assert "unreadable" in errors_in(folder, "rows")


# --- the archives themselves ------------------------------------------------------------------------------------------

Files = list[tuple[tarfile.TarInfo, bytes]]


def change_tar(folder: Path, change: Callable[[Files], Files]) -> None:
    """Change the files of the first shard, and make the checksums right."""
    path = sorted(folder.glob("*.tar"))[0]
    with tarfile.open(path) as tar:
        files = [(member, tar.extractfile(member).read()) for member in tar]
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as tar:
        for member, data in change(files):
            tar.addfile(member, io.BytesIO(data))
    make_right(folder, path)


def make_right(folder: Path, path: Path) -> None:
    name = path.relative_to(folder).as_posix()
    write_checksums(folder, read_checksums(folder) | {name: sha256_file(path)})


def renamed(member: tarfile.TarInfo, name: str) -> tarfile.TarInfo:
    return member.replace(name=name)


def _exchanged(files: Files) -> Files:
    """Depth of two frames of a flight, three seconds apart."""
    a, b = [k for k, (member, _) in enumerate(files) if member.name.endswith("depth.npy")][4:11:6]
    files[a], files[b] = (files[a][0], files[b][1]), (files[b][0], files[a][1])
    return files


def _other_key(files: Files) -> Files:
    key = files[0][0].name.partition(".")[0]
    return [(renamed(m, m.name.replace(key, "trajectory_9_ORI_frame_00000")), data) for m, data in files]


def _of_no_frame(files: Files) -> Files:
    return [*files, (renamed(files[0][0], "notes.txt"), files[0][1])]


TAMPERED: dict[str, tuple[Callable[[Files], Files], str]] = {
    "depth exchanged": (_exchanged, "scene_depth"),
    "a frame without its mask": (lambda files: [f for f in files if f[0].name != files[1][0].name], "missing"),
    "a frame gone": (lambda files: files[4:], "rows"),
    "a frame twice": (lambda files: [*files, *files[:4]], "duplicate"),
    "a file twice": (lambda files: [files[0], *files], "unexpected"),
    "another key": (_other_key, "sample_id"),
    "a file of no frame": (_of_no_frame, "unexpected"),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_a_changed_archive_is_found(exported, name):
    change, code = TAMPERED[name]
    change_tar(exported, change)
    assert code in errors_in(exported)


def _linked(files: Files) -> Files:
    link = tarfile.TarInfo("trajectory_1.json")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    return [(link, b""), *files]


def _not_json(files: Files) -> Files:
    return [(m.replace(deep=True), b"1e999".ljust(len(d)) if m.name.endswith(".json") else d) for m, d in files]


@pytest.mark.parametrize("change", [_linked, _not_json])
def test_hostile_archives_are_findings(exported, change):
    change_tar(exported, change)
    assert "unreadable" in errors_in(exported)


@pytest.mark.parametrize("size", [0, 100, 513, -1024])
def test_cut_archives_are_findings(exported, size):
    path = sorted(exported.glob("*.tar"))[0]
    data = path.read_bytes().rstrip(b"\0") if size < 0 else path.read_bytes()[:size]
    path.write_bytes(data[: len(data) // 512 * 512] if size < 0 else data)
    make_right(exported, path)
    assert "unreadable" in errors_in(exported)


def test_a_size_that_leads_out_of_the_archive_is_not_followed(exported):
    path = sorted(exported.glob("*.tar"))[0]
    data = bytearray(path.read_bytes())
    header = tarfile.TarInfo.frombuf(bytes(data[:512]), "utf-8", "strict")
    header.size = 1 << 50
    data[:512] = header.tobuf(tarfile.GNU_FORMAT)[:512]
    path.write_bytes(data)
    make_right(exported, path)
    assert "unreadable" in errors_in(exported)
