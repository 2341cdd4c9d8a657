"""`release verify`: what honest releases get, what lies it finds that make everything else right again, and what hostile files do to it."""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from release_lies import LIES
from release_tampering import errors_in, forge, read_all, set_depth
from specimens_foreign import hub_snapshot, write_foreign_tree
from typer.testing import CliRunner

from caption.run.released import read_released
from cosfly.app import pipeline
from cosfly.app.settings import RunConfig
from cosfly.cli import app
from cosfly.errors import InputError
from cosfly.products.flights import find_flights
from cosfly.products.frames import instance_bytes
from cosfly.reading.documents import read_json
from cosfly.work.config import load
from cosfly.work.store import write_bytes
from release.columns import POSE
from release.package import stage as package
from release.package.config import ReleaseConfig
from release.package.sources import Source
from release.record import read_record
from release.rules import split_groups
from release.verify.by_rule import check_inspected
from release.verify.findings import EXAMPLES, Findings
from release.verify.rows import FlightRows
from release.verify.shards import check_shards
from release.verify.verify import verify

TINY = [
    "pedestrians.num_paths=4", "pedestrians.min_distance_m=15", "pedestrians.max_distance_m=25", "render.width_px=160",
    "render.height_px=90", "render.fovs_deg=[60, 90]", "caption.window.stride=2", "workers=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def honest_run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("verify") / "run"
    pipeline.run(load(RunConfig, None, TINY), out)
    return out


@pytest.fixture(scope="module")
def honest(honest_run, tmp_path_factory) -> Path:
    """A small release of what the whole way makes: two walks, both tracks, twenty frames each."""
    cfg = ReleaseConfig(num_frames=20, licence="cc-by-4.0")
    return package.run(cfg, [Source.of_run(honest_run)], tmp_path_factory.mktemp("verify") / "release")


@pytest.fixture
def dataset(honest, tmp_path) -> Path:
    return shutil.copytree(honest, tmp_path / "dataset")


# --- honest -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["structure", "rows", "pixels"])
def test_an_honest_release_passes(honest, level):
    report = verify(honest, level=level, reader=read_released)
    assert report.is_ok, str(report)
    assert report.issues == []


def test_a_release_that_the_kit_wrote_again_passes(honest, tmp_path):
    """Else every lie below would be found for the kit's own faults."""
    assert errors_in(forge(honest, tmp_path / "again")) == {}


def test_processes_find_what_one_finds(honest, tmp_path):
    forged = forge(honest, tmp_path / "forged", LIES["depth_doubled"][0])
    one, two = (verify(forged, workers=workers, reader=read_released) for workers in (0, 2))
    assert not one.is_ok
    assert str(one) == str(two)


@pytest.mark.parametrize(("name", "is_found"), [("LICENSE", False), (".gitattributes", False), ("notes.txt", True)])
def test_a_file_that_no_record_knows_is_told_but_for_a_licence_and_what_the_hub_adds(honest, tmp_path, name, is_found):
    folder = shutil.copytree(honest, tmp_path / "release")
    (folder / name).write_text("words")
    assert errors_in(folder, "structure") == ({"unexpected": 1} if is_found else {})


def test_an_empty_folder_is_seen(dataset):
    (dataset / "data/more/inner").mkdir(parents=True)
    assert errors_in(dataset, "structure") == {"unexpected": 1}


@pytest.mark.parametrize(
    ("add", "expected"),
    [
        (lambda place: place.symlink_to("/etc/hostname"), {"unreadable": 1}),
        (lambda place: write_bytes(place / "more.bin", b"anything"), {"unexpected": 1}),
        (os.mkfifo, {"unreadable": 1}),
    ],
)
def test_a_licence_is_a_file_of_the_folder(honest, tmp_path, add, expected):
    folder = shutil.copytree(honest, tmp_path / "release")
    add(folder / "LICENSE")
    assert errors_in(folder, "structure") == expected


def test_a_snapshot_of_the_hubs_cache_passes(honest, tmp_path):
    assert errors_in(hub_snapshot(honest, tmp_path)) == {}


def test_trees_pass_ours_and_the_public_layout(honest_run, tmp_path):
    assert errors_in(honest_run / "render") == {}
    assert errors_in(write_foreign_tree(tmp_path / "public")) == {}


# --- lies -------------------------------------------------------------------------------------------------------------


# One of each kind of check; all of them take a minute and more.
QUICK_LIES = {
    "sample_id_of_another_frame", "target_pixel_moved", "offsets_with_the_other_sign", "pace_called_otherwise", "hard_conflict_called_soft",
    "all_sentences_called_proved", "prompt_that_holds_the_future", "split_that_leaks", "box_against_mask", "depth_set_off", "bytes_behind_a_picture",
    "ids_of_things_exchanged", "poses_of_two_frames_exchanged",
}  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK_LIES else pytest.mark.slow) for name in LIES])  # fmt: skip
def test_a_lie_is_found(honest, tmp_path, name):
    lie, is_of_pixels = LIES[name]
    forged = forge(honest, tmp_path / "forged", lie)
    assert errors_in(forged, "pixels" if is_of_pixels else "rows"), name


def test_statistics_that_a_filter_goes_by_are_the_rows(honest, dataset):
    """A footer is bytes of the same length with another word for a split in it."""
    record = read_record(dataset / "release.json")
    found = Findings()
    check_shards(dataset, record, found)
    assert not found.kinds
    shard = next(shard for shard in record.shards if shard.split == "train")
    data = (dataset / shard.path).read_bytes()
    begin = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    (dataset / shard.path).write_bytes(data[:begin] + data[begin:].replace(b"train", b"trail"))
    check_shards(dataset, record, found)
    assert {code for _, code in found.kinds} == {"statistics"}


def test_the_shards_tell_which_library_wrote_them(honest):
    record = read_record(honest / "release.json")
    record.provenance.versions["pyarrow"] = "1.0.0"
    found = Findings()
    check_shards(honest, record, found)
    assert [kind.severity for kind in found.kinds.values()] == ["warning"]


@pytest.mark.parametrize(("most", "num_frames", "is_found"), [(5.0, 20, False), (0.5, 20, True), (0.5, 30, False)])
def test_a_whole_clean_flight_keeps_the_bounds_of_its_inspection(most, num_frames, is_found):
    """One that goes to and fro by a metre every second; of a flight in part nobody knows."""
    rows = [
        {
            "frame_index": k,
            "time_s": 0.5 * k,
            "track": "clean",
            "pose": dict.fromkeys(POSE, 0.0) | {"x_m": float(k // 2 % 2)},
        }
        for k in range(20)
    ]
    found = Findings()
    check_inspected(
        FlightRows("run/Town/trajectory/ORI", rows, num_frames=num_frames), {"accel_rms_max_mps2": most}, found
    )
    assert [code for _, code in found.kinds] == ["settings"] * is_found


RECORD_LIES = {
    "axes of the other hand": lambda r: r["coordinates"].update(handedness="left"),
    "no coordinates": lambda r: r["coordinates"].clear(),
    "no maps": lambda r: r["maps"].clear(),
    "another rule of frames": lambda r: r.update(frame_selection="the best ones"),
    "nothing was repaired": lambda r: r["provenance"]["repairs"].update(accepted=0),
    "another teacher": lambda r: r["provenance"]["teachers"][0].update(model="somebody"),
    "fewer captions were read": lambda r: r["provenance"]["teachers"][0].update(captions=1),
    "flights were left out": lambda r: r["history"]["flights"]["left_out"].update(bad=3),
    "another version": lambda r: r.update(made_by="cosfly 99"),
    "a run that is no source": lambda r: r["provenance"]["sources"][0].update(run="elsewhere"),
    "fewer frames available": lambda r: r["flights"][0].update(frames_available=r["flights"][0]["frames"]),
    "splits by town": lambda r: r["splits"].update(by="town"),
    "another rule of splits": lambda r: r["splits"].update(rule="by taste"),
    "another seed of splits": lambda r: r["splits"].update(seed=_seed_of_other_splits(r)),
    "shares above one": lambda r: r["splits"]["fractions"].update(test=1.5),
    "fewer asks than captions": lambda r: r["provenance"].update(asks=1),
    "rules that take tokens": lambda r: r["provenance"]["tokens"].update(completion_tokens=1_000_000),
    "captions of another tree": lambda r: _stage(r, "caption")["inputs"].update(data="0" * 64),
    "an inspection of another tree": lambda r: _stage(r, "inspect")["inputs"].update(data="0" * 64),
    "a flight rejected for nothing": lambda r: _one_less(r, "rejected"),
    "larger pictures": lambda r: _stage(r, "render")["config"].update(width_px=1920, height_px=1080),
    "longer windows": lambda r: _stage(r, "caption")["config"]["window"].update(num_frames=9),
    "a sky of 999 m": lambda r: r["depth"].update(sky=999.0),
    "a town of another map": lambda r: r["maps"][0].update(name="Delft"),
}


def _seed_of_other_splits(record: dict) -> int:
    """The first seed under which the walks of the record stand in other splits."""
    told = record["splits"]
    walks = {flight["walk"]: flight["split"] for flight in record["flights"]}
    return next(seed for seed in range(100) if split_groups(walks, told["fractions"], seed, "walks") != walks)


def _stage(record: dict, name: str) -> dict:
    return next(stage for stage in record["provenance"]["sources"][0]["stages"] if stage["stage"] == name)


def test_another_teacher_in_rows_and_record_is_found(honest, tmp_path):
    def rows_too(rows):
        for row in rows:
            if row["has_caption"]:
                row["teacher_kind"], row["teacher_model"] = "endpoint", "somebody"

    def teachers(record):
        for teacher in record["provenance"]["teachers"]:
            teacher.update(kind="endpoint", model="somebody")

    assert "provenance" in errors_in(forge(honest, tmp_path / "forged", rows_too, teachers), "rows")


@pytest.mark.parametrize(("stage", "key"), [("plan", "map"), ("render", "boxes")])
def test_stages_that_went_by_other_maps_are_told(honest, tmp_path, stage, key):
    forged = forge(
        honest, tmp_path / "forged", change_record=lambda r: _stage(r, stage)["inputs"].update({key: "0" * 64})
    )
    report = verify(forged, level="structure")
    assert report.is_ok
    assert [(kind.severity, kind.code) for kind in report.kinds] == [("warning", "provenance")]


def _one_less(record: dict, reason: str) -> None:
    """One flight more was found, and left out."""
    flights = record["history"]["flights"]
    flights["found"] += 1
    flights["left_out"][reason] = 1


def test_rejected_flights_without_a_rejected_trajectory_are_told(honest, tmp_path):
    """A warning: flights that nobody planned count for no trajectory."""
    forged = forge(honest, tmp_path / "forged", change_record=lambda r: _one_less(r, "rejected: jerk"))
    report = verify(forged, level="structure")
    assert [(kind.severity, kind.code) for kind in report.kinds] == [("warning", "sum")]


def test_another_seed_of_the_draws_is_told(honest, tmp_path):
    """A warning: another version may have drawn."""
    forged = forge(honest, tmp_path / "forged", change_record=lambda r: _stage(r, "render").update(seed=99))
    report = verify(forged, level="rows")
    assert {(kind.severity, kind.code) for kind in report.kinds} == {("warning", "draw")}


def test_decisions_of_people_have_a_digest(honest, tmp_path):
    def rejected(record, digest=None):
        _one_less(record, "rejected: review")
        record["provenance"]["sources"][0]["review_sha256"] = digest

    for digest, codes in ((None, ["provenance", "sum"]), ("0" * 64, ["sum"])):
        forged = forge(honest, tmp_path / "forged", change_record=lambda r, digest=digest: rejected(r, digest))
        assert [kind.code for kind in verify(forged, level="structure").kinds] == codes


@pytest.mark.parametrize("name", [name for name in RECORD_LIES if name != "splits by town"])
def test_a_lie_of_the_record_is_found(honest, tmp_path, name):
    forged = forge(honest, tmp_path / "forged", change_record=RECORD_LIES[name])
    assert errors_in(forged, "rows"), name


def test_towns_in_two_splits_are_a_leak_where_splits_are_by_town(honest, tmp_path):
    splits = {flight["split"] for flight in read_json(honest / "release.json")["flights"]}
    forged = forge(honest, tmp_path / "forged", change_record=RECORD_LIES["splits by town"])
    assert ("leak" in errors_in(forged, "rows")) == (len(splits) > 1)


# --- hostile files ----------------------------------------------------------------------------------------------------


def large_png(width: int, height: int) -> bytes:
    """A PNG whose header claims more than there is; its checksums hold."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(b"\0" * 1000)), (b"IEND", b""))
    packed = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def large_array() -> bytes:
    """A float32 array of 4 TB, by its header."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def a_broken_link(folder: Path) -> None:
    shard = next((folder / "data").iterdir())
    shard.unlink()
    shard.symlink_to("nowhere.parquet")


def a_link_that_leads_out(folder: Path) -> None:
    shard = next((folder / "data").iterdir())
    shutil.move(shard, folder.parent / "elsewhere.parquet")
    shard.symlink_to(folder.parent / "elsewhere.parquet")


def a_loop_of_links(folder: Path) -> None:
    (folder / "data/deeper").symlink_to(folder, target_is_directory=True)


def checksums_in_another_encoding(folder: Path) -> None:
    (folder / "checksums.sha256").write_bytes(b"\xff\xfe\x00" * 40)


def a_card_in_another_encoding(folder: Path) -> None:
    (folder / "README.md").write_bytes(b"\xff\xfe\x00" * 40)


def a_shard_cut_short(folder: Path) -> None:
    shard = next((folder / "data").iterdir())
    os.truncate(shard, shard.stat().st_size // 2)


def a_shard_of_another_schema(folder: Path) -> None:
    pq.write_table(pa.table({"a": [1, 2, 3]}), next((folder / "data").iterdir()))


def a_sparse_shard(folder: Path) -> None:
    os.truncate(next((folder / "data").iterdir()), 20_000_000_000)


def a_sparse_file_beside(folder: Path) -> None:
    (folder / "data/more.parquet").touch()
    os.truncate(folder / "data/more.parquet", 20_000_000_000)


def a_pipe(folder: Path) -> None:
    shard = next((folder / "data").iterdir())
    shard.unlink()
    os.mkfifo(shard)


def a_folder_for_a_file(folder: Path) -> None:
    (folder / "README.md").unlink()
    (folder / "README.md").mkdir()


def a_number_that_overflows(folder: Path) -> None:
    text = (folder / "release.json").read_text()
    (folder / "release.json").write_text(text.replace('"frames": ', '"frames": 1e999, "x": ', 1))


def a_path_that_escapes(folder: Path) -> None:
    record = json.loads((folder / "release.json").read_text())
    record["shards"][0]["path"] = "../../etc/passwd"
    (folder / "release.json").write_text(json.dumps(record))


def a_checksum_of_a_file_outside(folder: Path) -> None:
    with (folder / "checksums.sha256").open("a") as file:
        file.write(f"{'0' * 64}  ../../../etc/passwd\n")


HOSTILE = (
    a_broken_link, a_link_that_leads_out, a_loop_of_links, checksums_in_another_encoding, a_card_in_another_encoding,
    a_shard_cut_short, a_shard_of_another_schema, a_sparse_shard, a_sparse_file_beside, a_pipe, a_folder_for_a_file,
    a_number_that_overflows, a_path_that_escapes, a_checksum_of_a_file_outside,
)  # fmt: skip


@pytest.mark.parametrize("damage", HOSTILE, ids=lambda damage: damage.__name__)
def test_hostile_files_are_findings_and_no_traceback(dataset, damage):
    damage(dataset)
    for level in ("structure", "pixels"):
        assert errors_in(dataset, level)


def _claims(column: str, data: bytes):
    def change(rows):
        if column == "depth":
            rows[2]["depth"] = data
        else:
            rows[2][column]["bytes"] = data

    return change


def _null_pose(rows):
    rows[2]["pose"] = None


def _null_everything(rows):
    keep = {"sample_id", "run", "town", "trajectory", "variant", "frame_index", "image", "instance", "depth", "split", "walk", "pair",
            "width_px", "height_px", "track", "time_s", "fov_deg", "pose", "has_caption"}  # fmt: skip
    rows[2].update({name: None for name in rows[2] if name not in keep})


def _half_a_caption(rows):
    row = next(row for row in rows if row["has_caption"])
    row["caption_window"], row["caption_picture_px"] = [], [0]


def _zero_focal(rows):
    for row in rows:
        row["intrinsics"] = {"fx": 0.0, "fy": 0.0, "cx": 0.0, "cy": 0.0}


def _zero_focal_at_the_end(rows):
    rows[-1]["intrinsics"]["fx"] = 0.0


def _infinitely_far(rows):
    for row in rows:
        row["target"]["x_m"] = math.inf


def _palette(rows):
    rows[1]["instance"]["bytes"] = instance_bytes(np.zeros((90, 160), np.uint8), np.zeros((90, 160), np.uint16))[:-30]


def _flat_depth(rows):
    set_depth(rows[1], np.full((90, 160), 7.0, np.float32))


def _double_depth(rows):
    from io import BytesIO

    buffer = BytesIO()
    np.save(buffer, np.full((90, 160), 7.0))
    rows[1]["depth"] = buffer.getvalue()


ODD_ROWS = {
    "a PNG of 60,000 x 60,000": _claims("image", large_png(60_000, 60_000)),
    "an instance of 60,000 x 60,000": _claims("instance", large_png(60_000, 60_000)),
    "a PNG that unpacks to less": _claims("image", large_png(160, 90)),
    "an array of 4 TB": _claims("depth", large_array()),
    "no bytes": _claims("image", b""),
    "no depth": _claims("depth", b""),
    "text for a picture": _claims("instance", b"hello" * 100),
    "no pose": _null_pose,
    "hardly anything": _null_everything,
    "an empty window": _half_a_caption,
    "no focal length": _zero_focal,
    "no focal length in the last frame": _zero_focal_at_the_end,
    "people infinitely far away": _infinitely_far,
    "an instance cut short": _palette,
    "a flat depth": _flat_depth,
    "depth in double": _double_depth,
}


@pytest.mark.parametrize("name", ODD_ROWS)
def test_odd_rows_are_findings_and_no_traceback(honest, tmp_path, name):
    try:
        forged = forge(honest, tmp_path / "forged", ODD_ROWS[name])
    except (InputError, TypeError, KeyError):  # no card comes of it: then the old one stands there, which is found too
        forged = _rows_alone(honest, tmp_path / "forged", ODD_ROWS[name])
    assert errors_in(forged)


def _rows_alone(honest: Path, out: Path, change) -> Path:
    """Change rows and nothing else."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(honest, out)
    record, shards = read_all(out)
    change(shards[0])
    path = out / record.shards[0].path
    schema = pq.read_schema(path)
    pq.write_table(pa.Table.from_pylist(shards[0], schema=schema), path)
    entry = json.loads((out / "release.json").read_text())
    entry["shards"][0]["bytes"] = path.stat().st_size
    (out / "release.json").write_text(json.dumps(entry))
    return out


# --- what it tells ----------------------------------------------------------------------------------------------------


def test_one_line_a_kind_with_count_and_first_places():
    findings = Findings()
    for number in range(1000):
        findings.error("kind", f"row {number}", number, "nothing")
    findings.warn("other", "row 7", "a\nline", "none")
    report = findings.report()
    lines = str(report).splitlines()
    assert len(lines) == 3
    assert "kind: 1,000 times: row 0: got 0" in lines[0]
    assert all(f"row {number}" in lines[0] for number in range(EXAMPLES))
    assert report.num("error") == 1000


def test_the_command_tells_people_and_machines(honest, tmp_path):
    forged = forge(honest, tmp_path / "forged", LIES["visibility_above_one"][0])
    before = {path: path.read_bytes() for path in forged.rglob("*") if path.is_file()}
    arguments = ["release", "verify", str(forged), "--level", "rows", "--json", str(tmp_path / "found.json"), "--repair-plan", "--workers", "1"]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert "range: once" in result.output
    assert "repair plan: range" in result.output
    told = read_json(tmp_path / "found.json")
    assert told["ok"] is False
    assert {kind["code"] for kind in told["findings"]} == {"range"}
    assert {path: path.read_bytes() for path in forged.rglob("*") if path.is_file()} == before
    assert CliRunner().invoke(app, ["release", "verify", str(honest), "--level", "structure"]).exit_code == 0
    assert CliRunner().invoke(app, ["release", "verify", str(honest), "--level", "all"]).exit_code == 2


def test_a_frame_that_is_missing_in_a_tree_is_found(honest_run, tmp_path):
    tree = shutil.copytree(honest_run / "render", tmp_path / "tree")
    (find_flights(tree)[0] / "frames_playback/frame_00003/rgb.png").unlink()
    assert {"missing", "picture"} <= set(errors_in(tree))
