"""`croissant.json`: mlcroissant accepts it, and loads every row by it."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from specimens_release import rows_by_id

from cosfly.reading.arrays import parse_picture
from release.card.croissant import CROISSANT, render_croissant
from release.columns import schema
from release.record import read_record
from release.verify.verify import verify


def test_it_is_what_the_record_gives(dataset, tmp_path):
    record = read_record(dataset / "release.json")
    assert (dataset / CROISSANT).read_text() == render_croissant(record)
    said = json.loads((dataset / CROISSANT).read_text())
    (records,) = said["recordSet"]
    columns = {field["source"]["extract"]["column"] for field in records["field"]}
    assert columns == set(schema(record.settings.modalities).names)
    shards = {entry["@id"]: entry for entry in said["distribution"] if entry["@type"] == "cr:FileObject"}
    assert {name: entry["sha256"] for name, entry in shards.items()} == {s.path: s.sha256 for s in record.shards}


def test_a_changed_word_of_it_is_found(dataset, tmp_path):
    broken = shutil.copytree(dataset, tmp_path / "broken")
    text = (broken / CROISSANT).read_text()
    (broken / CROISSANT).write_text(text.replace("cc-by-4.0", "cc0-1.0"))
    assert not verify(broken).is_ok


def test_mlcroissant_accepts_it(dataset):
    pytest.importorskip("mlcroissant", reason="extra dev")
    code = "from mlcroissant.scripts.cli import main; sys.argv[1:] = ['validate', '--jsonld', sys.argv[1]]; main()"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {code}", str(dataset / CROISSANT)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Done" in done.stderr


def test_mlcroissant_loads_every_row(dataset):
    mlcroissant = pytest.importorskip("mlcroissant", reason="extra dev")
    rows = rows_by_id(dataset)
    found = list(mlcroissant.Dataset(jsonld=str(dataset / CROISSANT)).records("frames"))
    assert {row["frames/sample_id"].decode() for row in found} == rows.keys()
    assert {row["frames/split"].decode() for row in found} == {"train", "validation"}
    for one in found[::9]:
        row = rows[one["frames/sample_id"].decode()]
        assert (np.asarray(one["frames/image"]) == parse_picture(row["image"]["bytes"], "x")[..., ::-1]).all()
        assert np.load(io.BytesIO(one["frames/depth"])).tobytes() == np.load(io.BytesIO(row["depth"])).tobytes()
        assert one["frames/pose/x_m"] == row["pose"]["x_m"]
        assert one["frames/time_s"] == row["time_s"]
        text = one["frames/caption_zh_reasoning_trace"]
        assert (text and text.decode()) == row["caption_zh_reasoning_trace"]
        assert (one["frames/caption_window"] or None) == row["caption_window"]
