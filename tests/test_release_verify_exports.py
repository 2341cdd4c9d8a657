"""`release verify` on exports: made again from their release, so that lies are found whatever checksums say."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

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


def make_right(folder: Path, path: Path) -> None:
    """Make the checksums right again."""
    name = path.relative_to(folder).as_posix()
    write_checksums(folder, read_checksums(folder) | {name: sha256_file(path)})


@pytest.mark.parametrize("name", FORMATS)
def test_an_honest_export_passes(honest_exports, name):
    for level in ("structure", "rows", "pixels"):
        report = verify(honest_exports[name], level=level, reader=read_released)
        assert report.is_ok, str(report)
        assert [kind.code for kind in report.kinds] == ["not_checked"] * (name != "tree"), "the release tells more"


@pytest.mark.parametrize("coding", ["float16", "millimetre_png"])
def test_an_honest_tree_of_coded_depth_passes(run, tmp_path, coding):
    release = released(run, tmp_path / "release", depth=coding)
    report = verify(exported_as("tree", release, tmp_path / "tree"), level="pixels", reader=read_released)
    assert report.issues == [], str(report)


@pytest.mark.parametrize("name", FORMATS)
def test_an_export_is_what_its_release_gives(honest, honest_exports, tmp_path, name):
    report = verify(honest_exports[name], level="structure", source=honest)
    assert report.issues == [], str(report)
    assert any("made again" in fact for fact in report.facts)
    other = forge(honest, tmp_path / "other", lambda rows: rows[3]["pose"].update(roll_deg=0.01))
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


@pytest.mark.parametrize("name", ["depth_doubled", "empty_instances", "pose_jumps"])
def test_a_lie_is_found_in_a_tree(honest, tmp_path, name):
    forged = forge(honest, tmp_path / "forged", LIES[name][0])
    assert errors_in(exported_as("tree", forged, tmp_path / "export"))


@pytest.mark.parametrize("name", FORMATS)
def test_changed_files_of_an_export_are_found(honest_exports, tmp_path, name):
    folder = shutil.copytree(honest_exports[name], tmp_path / name)
    largest = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(data)
    (folder / "README.md").write_text("words")
    (folder / "more.txt").write_text("words")
    assert {"card", "checksum", "unexpected"} <= set(errors_in(folder))
