"""`release verify` on exports: rows and pictures of a WebDataset are read again, and lies in them are found whatever its checksums say."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from release_lies import LIES
from release_tampering import forge

from caption.truth.released import read_released
from cosfly import pipeline
from cosfly.config import load
from cosfly.reading.files import sha256_file
from cosfly.settings import RunConfig
from cosfly.store import read_checksums, write_checksums
from release.export.contract import ExportConfig
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
def honest(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("exports")
    pipeline.run(load(RunConfig, None, TINY), out / "run")
    return package.run(ReleaseConfig(num_frames=16, licence="cc0-1.0"), [Source.of_run(out / "run")], out / "release")


@pytest.fixture
def exported(honest, tmp_path) -> Path:
    return tars_of(honest, tmp_path)


def tars_of(release: Path, out: Path) -> Path:
    return export(ExportConfig(format="webdataset"), release, out / "export", workers=0)


def errors(folder: Path, level: str = "pixels") -> dict[str, int]:
    report = verify(folder, level=level, reader=read_released)
    return {kind.code: kind.count for kind in report.kinds if kind.severity == "error"}


@pytest.mark.parametrize("level", ["structure", "rows", "pixels"])
def test_an_honest_webdataset_passes(exported, level):
    report = verify(exported, level=level, reader=read_released)
    assert report.is_ok, str(report)
    assert report.issues == []
    assert level == "structure" or any("32 rows of 2 flights" in fact for fact in report.facts)


@pytest.mark.parametrize(
    "name",
    [
        "depth_doubled",
        "colours_of_neighbours_exchanged",
        "empty_instances",
        "pose_jumps",
        "number_differs_between_languages",
        "sample_id_of_another_frame",
    ],
)
def test_a_lie_is_found_in_the_tars(honest, tmp_path, name):
    lie, is_of_pixels = LIES[name]
    forged = tars_of(forge(honest, tmp_path / "forged", lie), tmp_path)
    assert errors(forged, "pixels" if is_of_pixels else "rows")


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
    write_checksums(folder, read_checksums(folder) | {path.name: sha256_file(path)})


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
    "a frame twice": (lambda files: [*files, *files[:4]], "unexpected"),
    "another key": (_other_key, "sample_id"),
    "a file of no frame": (_of_no_frame, "unexpected"),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_a_changed_archive_is_found(exported, name):
    change, code = TAMPERED[name]
    change_tar(exported, change)
    assert code in errors(exported)


def _linked(files: Files) -> Files:
    link = tarfile.TarInfo("trajectory_1.json")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    return [(link, b""), *files]


def _not_json(files: Files) -> Files:
    return [(m.replace(deep=True), b"1e999".ljust(len(d)) if m.name.endswith(".json") else d) for m, d in files]


@pytest.mark.parametrize("change", [_linked, _not_json])
def test_hostile_archives_are_findings(exported, change):
    change_tar(exported, change)
    assert "unreadable" in errors(exported)


@pytest.mark.parametrize("size", [0, 100, 513, -1024])
def test_cut_archives_are_findings(exported, size):
    path = sorted(exported.glob("*.tar"))[0]
    data = path.read_bytes().rstrip(b"\0") if size < 0 else path.read_bytes()[:size]
    path.write_bytes(data[: len(data) // 512 * 512] if size < 0 else data)
    make_right(exported, path)
    assert "unreadable" in errors(exported)


def test_a_size_that_leads_out_of_the_archive_is_not_followed(exported):
    path = sorted(exported.glob("*.tar"))[0]
    data = bytearray(path.read_bytes())
    header = tarfile.TarInfo.frombuf(bytes(data[:512]), "utf-8", "strict")
    header.size = 1 << 50
    data[:512] = header.tobuf(tarfile.GNU_FORMAT)[:512]
    path.write_bytes(data)
    make_right(exported, path)
    assert "unreadable" in errors(exported)
