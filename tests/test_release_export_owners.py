"""Exports opened by LeRobot, in an environment of its own."""

import hashlib
import io
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from owners import LEROBOT, python_with
from specimens_release import make_release, rows_by_id
from test_release_export import config

from cosfly.runtime.arrays import parse_picture
from release.columns import POSE
from release.export.stage import run as export

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def sha256(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def test_lerobot_opens_it(tmp_path):
    dataset = make_release(tmp_path)
    product = export(config("lerobot"), dataset, tmp_path / "out")
    python = python_with(LEROBOT)
    reader = Path(__file__).with_name("read_lerobot.py")
    rows = list(rows_by_id(dataset).values())
    indices = [0, 5, 13, len(rows) - 1]
    done = subprocess.run(
        [str(python), str(reader), str(product), *map(str, indices)],
        capture_output=True, text=True, check=False, env={"HF_HOME": str(tmp_path / "hf"), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("LOOK ")]
    seen = json.loads(line.removeprefix("LOOK "))
    assert (seen["frames"], seen["episodes"], seen["fps"], seen["splits"]) == (72, 6, 2, {"train": "0:6"})
    assert seen["batch"] == [4, 3, 54, 96]
    for index in indices:
        row, item = rows[index], seen["items"][str(index)]
        assert item["sample_id"] == row["sample_id"]
        assert item["observation.depth"] == sha256(np.load(io.BytesIO(row["depth"])))
        for name, column in (("rgb", "image"), ("instance", "instance")):
            assert item[f"observation.images.{name}"] == sha256(parse_picture(row[column]["bytes"], "x")[..., ::-1])
        pose = np.array([row["pose"][member] for member in POSE])
        assert item["pose"] == pose.astype(np.float32).tolist()
        if row["action"] is not None:
            assert item["action"] == np.array(list(row["action"].values()), dtype=np.float32).tolist()
        assert item["observation.state"][4] == np.float32(row["pose"]["pitch_deg"])
        assert item["timestamp"] == row["frame_index"] * 0.5
        assert item["caption_zh_reasoning_trace"] == (row["caption_zh_reasoning_trace"] or "")
        decision = row["decision"]
        assert item["task"].endswith(f"Now: {decision.replace('_', ' ')}." if decision else "from the air.")
    assert seen["before"][1] == seen["items"][str(indices[-1])]["observation.state"]
    assert seen["before"][0][4] == np.float32(rows[indices[-1] - 1]["pose"]["pitch_deg"])
    poses = np.array([[row["pose"][member] for member in POSE] for row in rows], dtype=np.float32)
    assert np.allclose(seen["stats"]["pose"]["mean"], poses.mean(axis=0), rtol=1e-5)
    assert np.allclose(seen["stats"]["pose"]["std"], poses.std(axis=0), rtol=1e-4, atol=1e-6)
    assert np.shape(seen["stats"]["observation.images.rgb"]["mean"]) == (3, 1, 1)
