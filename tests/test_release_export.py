"""A release in other formats: nothing is lost on the way, whatever interrupts it; LeRobot opens its own."""

import hashlib
import io
import itertools
import json
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from filelock import FileLock
from processes import ran
from public_reader import read_public
from release_tampering import rewrite
from specimens_release import all_bytes, make_release, rows_by_id

from cosfly.formats.playback_file import read_track
from cosfly.formats.town import read_town_map
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.config import build as build_config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, read_checksums, sha256_file
from cosfly.runtime.png import colours_of
from release.columns import POSE
from release.export.lerobot import states
from release.export.stage import EXPORTS, ExportConfig, open_release
from release.export.stage import run as export
from release.record import read_record
from specimens import PERSON_ID, change_json

# Environments of libraries that cannot share the tests' own: made once, one for each list of pins. They see the
# packages of this environment (torch among them, which is large) behind their own.
KEPT_IN = Path(__file__).resolve().parents[1] / ".venv-owners"
UNREACHABLE = (
    *("NewConnectionError", "ConnectTimeoutError", "ReadTimeoutError", "name resolution"),
    *("Network is unreachable", "Max retries exceeded"),
)
_LIGHT = (
    "draccus==0.10.0 mergedeep==1.3.4 typing-inspect==0.9.0 mypy_extensions==1.1.0 pyyaml-include==1.4.1 toml==0.10.2 "
    "pyserial==3.5 deepdiff==8.6.1 orderly-set==5.5.0"
)
_OF_LEROBOT = (
    "torchvision==0.28.0 jsonlines==4.0.0 attrs==25.3.0 einops==0.8.1 termcolor==3.1.0 huggingface_hub==0.35.3"
)
# LeRobot's own pins ask for another torch; what reads data sets works with ours, so the packages are named one by one.
LEROBOT = ("lerobot==0.4.4", "datasets==4.4.1", "av==15.1.0", *_LIGHT.split(), *_OF_LEROBOT.split())


def lerobot_python() -> Path:
    """Return the interpreter of an environment with LeRobot; skip the test if no registry can be reached."""
    folder = KEPT_IN / hashlib.sha256("\n".join([sys.version, *LEROBOT]).encode()).hexdigest()[:16]
    python = folder / "bin" / "python"
    KEPT_IN.mkdir(exist_ok=True)
    with FileLock(f"{folder}.lock"):  # the tests of another worker may need it now, too
        if (folder / ".complete").exists():
            return python
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        (packages,) = folder.glob("lib/python*/site-packages")
        shared = [path for path in sys.path if path.endswith("site-packages")]
        (packages / "shared.pth").write_text("".join(f"{path}\n" for path in shared))
        command = [str(python), "-m", "pip", "install", "--quiet", "--no-deps", *LEROBOT]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode and any(sign in done.stderr for sign in UNREACHABLE):
            shutil.rmtree(folder)
            pytest.skip(f"no package registry can be reached: {done.stderr[-300:]}")
        assert not done.returncode, done.stderr[-3000:]
        (folder / ".complete").touch()
    return python


TEXTS = ("goal_says", "perturbation")  # joined to one text


def config(format: str, **more) -> ExportConfig:
    return build_config(ExportConfig, {"format": format, "shard_mb": 1, **more}, "test")


def assert_same_flight(found: Path, given: Path) -> None:
    a, b = read_track(given), read_track(found)
    records = (a, b), (a.target, b.target), (a.perturbation, b.perturbation)
    fields = [(name, getattr(x, name), getattr(y, name)) for x, y in records for name in type(x).__dataclass_fields__]
    for name, x, y in fields:
        if isinstance(x, np.ndarray):
            assert np.array_equal(x, y, equal_nan=True), name
        elif name not in ("folder", "raw", "source", "camera", "issues", "target", "perturbation"):
            assert x == y, name
    assert np.array_equal(a.camera.intrinsic, b.camera.intrinsic)
    assert (a.camera.width_px, a.camera.height_px) == (b.camera.width_px, b.camera.height_px)
    assert b.source["algorithm"] == a.source["algorithm"] != "unknown"
    assert b.source["released_frames"] == list(range(len(a)))
    for i in range(len(a)):
        for name in ("rgb.png", "depth.npy", "instance.png"):
            assert (a.frame_folder(i) / name).read_bytes() == (b.frame_folder(i) / name).read_bytes()


def test_tree_to_release_to_tree_loses_nothing(two_splits, tmp_path):
    product, tree = export(config("tree"), two_splits, tmp_path / "out"), two_splits.parents[1] / "tree"
    given = find_tracks(tree)
    found = find_tracks(product)
    assert [p.relative_to(product) for p in found] == [p.relative_to(tree) for p in given]
    for a, b in zip(given, found, strict=True):
        assert_same_flight(b, a)
        files = [path for path in b.rglob("*") if path.is_file() and path.name != CHECKSUMS]
        assert read_checksums(b) == {path.relative_to(b).as_posix(): sha256_file(path) for path in files}
    assert len(read_public(product, exported=True)) == 3  # the strictest public reader
    assert read_town_map(product / "Town01").licence == read_record(two_splits / "release.json").maps[0].licence


def test_webdataset_opens_it(two_splits, tmp_path):
    """Both libraries, whose first rows have no caption, find every value of the release."""
    datasets, wds = pytest.importorskip("datasets"), pytest.importorskip("webdataset", reason="extra dev")
    product = export(config("webdataset"), two_splits, tmp_path / "out")
    shards, rows = sorted(str(path) for path in product.glob("*.tar")), rows_by_id(two_splits)
    with tarfile.open(shards[0]) as tar:
        assert all(member.mtime == 0 and member.uid == 0 for member in tar)
    samples = list(wds.WebDataset(shards, shardshuffle=False).decode("rgb8"))
    assert [sample["__key__"] for sample in samples] == list(rows)
    splits = [Path(sample["__url__"]).name.partition("-")[0] for sample in samples]
    assert splits == [row["split"] for row in rows.values()]
    found = datasets.load_dataset("webdataset", data_files=shards, split="train", cache_dir=str(tmp_path / "cache"))
    for sample, other, row in zip(samples, found, rows.values(), strict=True):
        assert (sample["rgb.png"] == colours_of(row["image"]["bytes"], "x")).all()
        assert (np.asarray(other["rgb.png"]) == sample["rgb.png"]).all()
        assert (sample["instance.png"] == colours_of(row["instance"]["bytes"], "x")).all()
        assert (sample["depth.npy"] == np.load(io.BytesIO(row["depth"]))).all()
        assert sample["json"] == other["json"]
        for name, value in row.items():
            if name in sample["json"]:
                assert sample["json"][name] == ("" if value is None else value) or name in TEXTS
            elif name not in ("image", "depth", "instance", "target_picture"):
                numbers = list(value.values()) if isinstance(value, dict) else value
                found_numbers = sample[f"{name}.npy"]
                np.testing.assert_array_equal(found_numbers, other[f"{name}.npy"])
                if value is None:
                    assert np.isnan(found_numbers).all()
                else:
                    assert found_numbers.tolist() == (numbers if isinstance(numbers, list) else [numbers])


def test_coco_opens_it(two_splits, tmp_path):
    """pycocotools finds the pixels of instance.png, and the target by its id."""
    coco_api = pytest.importorskip("pycocotools.coco", reason="extra dev")
    product, rows = export(config("coco"), two_splits, tmp_path / "out"), rows_by_id(two_splits)
    files = {split: coco_api.COCO(product / f"annotations/instances_{split}.json") for split in ("train", "validation")}
    assert sum(len(coco.imgs) for coco in files.values()) == len(rows)
    for split, image in [(split, image) for split, one in files.items() for image in one.imgs.values()]:
        coco, row = files[split], rows[image["file_name"].removesuffix(".png")]
        assert (product / split / image["file_name"]).read_bytes() == row["image"]["bytes"]
        red, green, blue = np.moveaxis(colours_of(row["instance"]["bytes"], "x").astype(int), 2, 0)
        ids = np.where(red == 12, green + 256 * blue, -1)
        annotations = coco.loadAnns(coco.getAnnIds(image["id"]))
        assert {one["instance_id"] for one in annotations} == {*np.unique(ids).tolist()} - {-1}
        for one in annotations:
            mask, (x, y, width, height) = ids == one["instance_id"], one["bbox"]
            assert (coco.annToMask(one) == mask).all()
            assert one["area"] == mask.sum() == mask[y : y + height, x : x + width].sum()
            is_target = one["instance_id"] == PERSON_ID
            assert coco.cats[one["category_id"]]["name"] == ("target" if is_target else "other person")


def test_a_state_is_the_motion_that_led_to_a_frame():
    rows = [
        {"time_s": 0.5 * i, "pose": dict(zip(POSE, pose, strict=True))}
        for i, pose in enumerate([(0, 0, 10, -9, 90, 0), (0, 2, 11, -8, 180, 0), (0, 2, 11, -7, -170, 0)])
    ]
    expected = [[0, 0, 0, 0, -9], [0, -4, 2, 180, -8], [0, 0, 0, 20, -7]]  # it flew north, and looks west
    assert np.allclose(states(rows), expected)


def test_a_flight_with_gaps_is_several_episodes(tmp_path, tmp_path_factory):
    parts = make_release(tmp_path_factory.mktemp("parts"), num_frames=10, window=2, selection="windows")
    product = export(config("lerobot"), parts, tmp_path / "out")
    info = json.loads((product / "meta/info.json").read_text())
    episodes = pq.read_table(product / "meta/episodes").to_pylist()
    indices = [track.frame_index for track in open_release(parts).tracks()]
    gaps = [[0, *(np.flatnonzero(np.diff(one) != 1) + 1), len(one)] for one in indices]
    runs = [length for edges in gaps for length in np.diff(edges).tolist()]
    assert [row["length"] for row in sorted(episodes, key=lambda row: row["episode_index"])] == runs
    assert info["total_episodes"] == len(runs)
    assert info["total_frames"] == 60


@pytest.mark.parametrize("format", EXPORTS)
def test_an_export_has_the_same_bytes_again_lists_all_and_says_where_it_came_from(format, two_splits, tmp_path):
    one, two = (export(config(format), two_splits, tmp_path / name) for name in ("one", "two"))
    assert all_bytes(one) == all_bytes(two)
    listed = read_checksums(one)
    assert all(sha256_file(one / name) == digest for name, digest in listed.items())
    unlisted = set(all_bytes(one)) - set(listed) - {"README.md", CHECKSUMS}
    assert not unlisted or format == "tree"  # whose flights have lists of their own
    source, readme = open_release(two_splits), (one / "README.md").read_text()
    assert source.record.content_digest in readme
    assert f"\n{sum(map(len, source.tracks()))} frames of {source.record.name}" in readme
    assert "license: cc-by-4.0" in readme
    assert "Map: a specimen." in readme
    assert all(f"{one.town}: {one.name}, {one.licence}" in readme for one in source.record.maps)
    assert f"handedness: {'left' if format == 'tree' else source.record.coordinates['handedness']}" in readme


@pytest.fixture
def broken(two_splits, tmp_path) -> Path:
    return shutil.copytree(two_splits, tmp_path / "broken")


@pytest.mark.parametrize(
    "path",
    ["../../secret.parquet", "/etc/passwd", "data/x.parquet", "data/train-0123456789ab-00000-of-00001.parquet/../x"],
)
def test_shards_that_escape_or_have_other_names_are_refused(broken, tmp_path, path):
    change_json(broken / "release.json", lambda record: record["shards"][0].update(path=path))
    with pytest.raises(InputError, match="the release is incomplete"):
        export(config("webdataset"), broken, tmp_path / "out")


@pytest.mark.parametrize(("change", "words"), [
    (lambda rows: rows[3].update(image=None), "the frame has no picture"),
    (lambda rows: rows[3]["image"].update(bytes=b"GIF89a"), "not a PNG"),
    (lambda rows: rows[3].update(depth=None), "the frame has no picture"),
    (lambda rows: rows[3]["pose"].update(x_m=float("inf")), "not finite"),
    (lambda rows: rows[3].update(width_px=None), "width_px: a required value is missing"),
])  # fmt: skip
def test_an_export_that_fails_publishes_nothing(broken, tmp_path, change, words):
    rewrite(broken, change)
    with pytest.raises(InputError, match=words):
        export(config("webdataset"), broken, tmp_path / "out")
    assert not (tmp_path / "out/webdataset").exists()
    assert not list((tmp_path / "out").glob("*.partial"))


@pytest.mark.parametrize(("format", "name"), [*itertools.product(EXPORTS, ["../../escaped", "trajectory_1"])])
def test_a_sample_id_is_a_file_name_of_one_frame(broken, tmp_path, format, name):
    rewrite(broken, lambda rows: [row.update(sample_id=name) for row in rows[3:5]])
    with pytest.raises(InputError, match="the sample_id of a frame is repeated or is not a valid file name"):
        export(config(format), broken, tmp_path / "out")
    assert not (tmp_path / "out" / format).exists()


pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def sha256(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def look(product: Path, home: Path, *indices: int) -> dict:
    """Return what LeRobot itself sees."""
    reader = Path(__file__).with_name("read_lerobot.py")
    done = ran(lerobot_python(), reader, product, *indices, env={"HF_HOME": str(home), "PATH": "/usr/bin:/bin"})
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("LOOK ")]
    return json.loads(line.removeprefix("LOOK "))


def test_lerobot_reads_videos(two_splits, tmp_path):
    """PyAV is in its environment."""
    script = "from cosfly.__main__ import main; main()"
    options = ["--format", "lerobot", "--out", tmp_path / "out", "--video"]
    root = Path(__file__).parents[1]
    ran(lerobot_python(), "-c", script, "release", "export", two_splits, *options, cwd=root)
    seen = look(tmp_path / "out/lerobot", tmp_path / "hf", 0)
    assert seen["batch"] == [4, 3, 54, 96]
    episodes = read_record(two_splits / "release.json").splits.splits["train"].flights
    assert seen["splits"] == {"train": f"0:{episodes}", "validation": f"{episodes}:6"}
    files = list((tmp_path / "out/lerobot").glob("videos/observation.images.rgb/*/*.mp4"))
    assert len(files) == 2  # one of each split


def test_lerobot_opens_it(tmp_path):
    dataset = make_release(tmp_path)
    product = export(config("lerobot", modalities=["rgb", "depth", "instance"]), dataset, tmp_path / "out")
    rows = list(rows_by_id(dataset).values())
    indices = [0, 5, 13, len(rows) - 1]
    seen = look(product, tmp_path / "hf", *indices)
    assert (seen["frames"], seen["episodes"], seen["fps"], seen["splits"]) == (72, 6, 2, {"train": "0:6"})
    assert seen["batch"] == [4, 3, 54, 96]
    for index in indices:
        row, item = rows[index], seen["items"][str(index)]
        assert item["sample_id"] == row["sample_id"]
        assert item["observation.depth"] == sha256(np.load(io.BytesIO(row["depth"])))
        for name, column in (("rgb", "image"), ("instance", "instance")):
            assert item[f"observation.images.{name}"] == sha256(colours_of(row[column]["bytes"], "x"))
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
