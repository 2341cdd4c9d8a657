"""`cosfly release verify`: is a release folder what its records say? From cheap to dear, reading nothing but the folder.

Structure, names and sizes; checksums; every number of release.json and of the card computed again from the shards; the
target projected again from pose and intrinsics; every picture decoded.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from cosfly.errors import InputError
from cosfly.geometry import project, world_from_camera
from cosfly.issues import Report
from cosfly.products.captions import ACTIONS
from cosfly.products.frames import FrameFile
from cosfly.reading.arrays import parse_array, parse_picture
from cosfly.reading.files import read_bytes, sha256_file
from cosfly.reading.tables import open_table
from cosfly.stage_folder import flattened
from cosfly.store import CHECKSUMS, inside, read_checksums
from release import columns
from release.card.croissant import CROISSANT, render_croissant
from release.card.numbers import compute_numbers, read_rows
from release.card.render import render_card
from release.columns import CAPTION_COLUMNS, CAPTION_FIELDS, CAPTION_LISTS, PICTURES, PLACE, POINT
from release.record import ReleaseRecord, read_record
from release.subsample import select_frames

REPROJECTION_TOLERANCE_PX = 0.5
RECORDS = ("README.md", "release.json", CROISSANT, CHECKSUMS)
ALLOWED = (".git", ".gitattributes", ".cache")  # what the hub and its client put beside a data set
NEVER_NULL = (
    "decision",
    "label_from",
    "teacher_kind",
    "writing",
    *CAPTION_LISTS,
    *CAPTION_FIELDS,
)  # where there is a caption

Pixels = Literal["all", "none"]


def verify(folder: Path, *, pixels: Pixels = "all") -> Report:
    """Check a release folder (or the `dataset` folder inside a release stage's).

    Args:
        pixels: `none` leaves out decoding the pictures, the dearest check.
    Returns:
        Report; `is_ok` is False when anything is wrong. Later checks are left out where earlier ones make them senseless.
    """
    if not (folder / "release.json").is_file() and (folder / "dataset" / "release.json").is_file():
        folder = folder / "dataset"
    report = Report()
    record = _read_record(folder, report)
    if record is None:
        return report
    shards = _check_names_and_sizes(folder, record, report)
    _check_checksums(folder, record, report)
    readable = _readable(folder, shards, record, report)
    _check_sums(record, report)
    if readable == [entry.path for entry in record.shards]:
        paths = [folder / name for name in readable]
        checks = [_check_rows, _check_numbers, *([_check_pictures] if pixels == "all" else [])]
        for check in checks:
            try:
                check(paths, record, report)
            except (
                InputError,
                ValueError,
                KeyError,
                TypeError,
            ) as error:  # a value of no sense, or none where one must be
                report.error("unreadable", "data", f"{type(error).__name__}: {error}", "rows that can be read")
    _check_card(folder, record, report)
    return report


# --- the folder -------------------------------------------------------------------------------------------------------


def _read_record(folder: Path, report: Report) -> ReleaseRecord | None:
    """Read release.json; None, with findings, when nothing else can be checked."""
    if not folder.is_dir():
        report.error("missing", folder, "no such folder", "a release folder")
        return None
    try:
        return read_record(folder / "release.json")
    except InputError as error:
        where = str(error.where).replace(f"{folder}/", "")
        report.error("record", where, error.got or error.what, error.expected or "a release record")
        return None


def _check_names_and_sizes(folder: Path, record: ReleaseRecord, report: Report) -> list[str]:
    """Compare the files that are there with those that should be; give the shards that are there."""
    listed = {entry.path: entry for entry in record.shards}
    paths = [path for path in folder.rglob("*") if not path.is_dir()]
    paths = [path for path in paths if path.relative_to(folder).parts[0] not in ALLOWED]
    names = {path.relative_to(folder).as_posix() for path in paths}
    found = {
        path.relative_to(folder).as_posix() for path in paths if path.is_file()
    }  # neither a pipe nor a broken link
    for name in sorted({*listed, *RECORDS} - found):
        report.error("missing", name, "no such file", "a file of the release")
    for name in sorted(names - {*listed, *RECORDS}):
        report.error("unexpected", name, "a file", "nothing: release.json does not know it")
    for name in sorted(listed.keys() & found):
        size = (folder / name).stat().st_size
        if size != listed[name].bytes:
            report.error("size", name, f"{size} bytes", f"{listed[name].bytes} bytes")
    report.facts.append(f"{len(found)} files, {sum((folder / name).stat().st_size for name in found):,} bytes")
    return [name for name in listed if name in found]


def _check_checksums(folder: Path, record: ReleaseRecord, report: Report) -> None:
    try:
        digests = read_checksums(folder)
    except InputError as error:
        report.error("checksum", CHECKSUMS, error.got or error.what, "lines of sha256sum")
        return
    listed = {entry.path: entry.sha256 for entry in record.shards}
    for name in sorted({*listed, "README.md", "release.json", CROISSANT} ^ set(digests)):
        place = "only in release.json" if name in listed else "only in one of the lists"
        report.error("checksum", f"{CHECKSUMS}: {name}", place, "one line per file")
    for name, digest in sorted(digests.items()):
        path = inside(folder, name)
        if not path.is_file():
            continue  # reported as missing
        found = sha256_file(path)
        if found != digest:
            report.error("checksum", name, found, digest)
        if listed.get(name, digest) != digest:
            report.error("checksum", f"release.json: shards: {name}", listed[name], digest)


def _readable(folder: Path, names: list[str], record: ReleaseRecord, report: Report) -> list[str]:
    """Open every shard; give those that have the release's columns and number of rows."""
    rows = {entry.path: entry.rows for entry in record.shards}
    expected = columns.schema(record.settings.modalities)
    good = []
    for name in names:
        try:
            with open_table(folder / name, tree=folder) as table:
                schema, num_rows = table.schema_arrow, table.metadata.num_rows
        except InputError as error:
            report.error("unreadable", name, error.got or error.what, "a parquet file")
            continue
        has_features = (schema.metadata or {}).get(b"huggingface") == expected.metadata[b"huggingface"]
        if not schema.equals(expected) or not has_features:
            wrong = ", ".join(m.name for m in schema if m not in list(expected))
            got = wrong or "the order, or the features in the metadata"
            report.error("columns", name, got, "the columns of the release")
        elif num_rows != rows[name]:
            report.error("rows", name, num_rows, str(rows[name]))
        else:
            good.append(name)
    return good


# --- the numbers ------------------------------------------------------------------------------------------------------


def _check_numbers(paths: list[Path], record: ReleaseRecord, report: Report) -> None:
    """Compute every number again and compare."""
    computed = flattened(compute_numbers(paths, record.settings.num_frames).model_dump())
    written = flattened(record.numbers.model_dump())
    for name in sorted(computed.keys() | written.keys()):
        if computed.get(name) != written.get(name):
            report.error("number", f"release.json: numbers.{name}", written.get(name), f"{computed.get(name)}")
    report.facts.append(f"{len(computed)} numbers computed again from {len(paths)} shards")


def _check_sums(record: ReleaseRecord, report: Report) -> None:
    """What the shards cannot tell must at least add up."""
    planned, flights, captions = record.history.trajectories, record.history.flights, record.history.captions
    sums = [
        ("flights.found", flights.found, flights.released + sum(flights.left_out.values())),
        ("flights.released", flights.released, record.numbers.flights),
        ("captions.read", captions.read, captions.accepted + sum(captions.dropped.values())),
        ("captions.accepted", captions.accepted,
         captions.released + captions.frame_not_selected + captions.window_not_whole + captions.flight_left_out),
        ("captions.released", captions.released, record.numbers.captions.frames_with),
    ]  # fmt: skip
    if planned is not None:
        sums += (
            ("trajectories.planned", planned.planned,
             sum(planned.dropped.values()) + planned.not_rendered + planned.rendered),
            ("trajectories.rendered", planned.rendered, planned.accepted + planned.review + planned.rejected),
        )  # fmt: skip
    for name, whole, parts in sums:
        if whole != parts:
            report.error("sum", f"release.json: history.{name}", whole, f"{parts}, the sum of its parts")


def _check_card(folder: Path, record: ReleaseRecord, report: Report) -> None:
    """The card must be the one that release.json gives, to the letter."""
    path = folder / "README.md"
    if not path.is_file():
        return
    try:
        found = read_bytes(path, what="card", tree=folder).decode(errors="replace").split("\n")
    except InputError as error:
        report.error("card", "README.md", error.got or error.what, "the card")
        return
    croissant = folder / CROISSANT
    if croissant.is_file() and read_bytes(croissant, tree=folder) != render_croissant(record).encode():
        report.error("card", CROISSANT, "other words", "what release.json gives")
    wanted = render_card(record).split("\n")
    for number, (line, expected) in enumerate(itertools.zip_longest(found, wanted, fillvalue="the end"), 1):
        if line != expected:
            report.error("card", f"README.md:{number}", repr(line[:120]), repr(expected[:120]))


# --- the rows ---------------------------------------------------------------------------------------------------------


def _check_rows(paths: list[Path], record: ReleaseRecord, report: Report) -> None:
    """Check ids, frame selection, captions and the projection of the target, flight by flight."""
    flights = {entry.flight: entry for entry in record.flights}
    frames: dict[str, list[int]] = {}
    seen: set[str] = set()
    num_projected, worst_px = 0, 0.0
    for row in read_rows(paths):
        flight, where = "/".join(row[name] for name in PLACE), row["sample_id"]
        frames.setdefault(flight, []).append(row["frame_index"])
        if row["sample_id"] in seen:
            report.error("duplicate", where, "a second row", "one row per frame")
        seen.add(row["sample_id"])
        _check_caption(row, where, report)
        distance_px = projection_error_px(row)
        if distance_px is not None:
            num_projected += 1
            worst_px = max(worst_px, distance_px)
            if distance_px > REPROJECTION_TOLERANCE_PX:
                expected = f"at most {REPROJECTION_TOLERANCE_PX} px between target_uv and the projected target"
                report.error("projection", where, f"{distance_px:.3f} px", expected)
    for flight in sorted(flights.keys() ^ frames.keys()):
        report.error("flight", flight, "only in one of release.json and the shards", "the same flights in both")
    for flight, indices in frames.items():
        if flight not in flights:
            continue
        entry = flights[flight]
        expected_indices = select_frames(
            entry.frames_available, record.settings.num_frames, record.settings.window_frames
        ).tolist()
        if indices != expected_indices or len(indices) != entry.frames:
            got = f"{len(indices)} frames, first {indices[:3]}"
            report.error("frames", flight, got, f"{len(expected_indices)} frames by the rule of release.json")
    report.facts.append(
        f"{len(seen):,} rows of {len(frames)} flights; {num_projected:,} targets projected, worst {worst_px:.4f} px"
    )


def _check_caption(row: dict[str, Any], where: str, report: Report) -> None:
    """A row has a whole caption or none; its decision is of the closed set and the same in both languages."""
    if not row["has_caption"]:
        present = [name for name in CAPTION_COLUMNS if row[name] is not None]
        if present:
            report.error("caption", f"{where}: {present[0]}", "a value", "null: has_caption is false")
        return
    absent = [name for name in NEVER_NULL if not row[name]]
    if absent:
        report.error("caption", f"{where}: {absent[0]}", repr(row[absent[0]]), "a value: has_caption is true")
    decisions = {row["decision"], row["caption_en_flight_decision"], row["caption_zh_flight_decision"]}
    if len(decisions) != 1 or not decisions <= set(ACTIONS):
        report.error("caption", f"{where}: decision", sorted(map(str, decisions)), "one action of the closed set")


def projection_error_px(row: dict[str, Any]) -> float | None:
    """Project a row's target with its pose and intrinsics; give the distance to its target_uv, None where it has none."""
    if row["target"] is None or row["target_uv"] is None:
        return None
    pose, k = row["pose"], row["intrinsics"]
    rotation = np.array([pose[name] for name in ("pitch_deg", "yaw_deg", "roll_deg")])
    camera = world_from_camera(np.array([pose[name] for name in POINT]), rotation)
    intrinsic = np.array([[k["fx"], 0.0, k["cx"]], [0.0, k["fy"], k["cy"]], [0.0, 0.0, 1.0]])
    uv, _ = project(np.array([[row["target"][name] for name in POINT]]), camera, intrinsic)
    recorded = np.array([row["target_uv"]["u_px"], row["target_uv"]["v_px"]])
    distance = float(np.hypot(*(uv[0] - recorded)))
    return distance if np.isfinite(distance) else float("inf")


# --- the pictures -----------------------------------------------------------------------------------------------------


def _check_pictures(paths: list[Path], record: ReleaseRecord, report: Report) -> None:
    """Decode every picture and compare its size with the row's."""
    files = record.settings.modalities
    count = 0
    pictures = [PICTURES[file].name for file in files]
    for row in read_rows(paths, ["sample_id", "width_px", "height_px", *pictures]):
        size = (row["height_px"], row["width_px"])
        for file, column in zip(files, pictures, strict=True):
            problem = picture_problem(file, row[column], size)
            count += 1
            if problem:
                expected = f"a {file} picture of {size[1]} x {size[0]} px"
                report.error("picture", f"{row['sample_id']}: {column}", problem, expected)
    report.facts.append(f"{count:,} pictures decoded")


def picture_problem(file: FrameFile, value: Any, size: tuple[int, int]) -> str | None:
    """Say why a picture is not one of (height, width), None if it is."""
    try:
        if file == "depth":
            found = parse_array(value or b"", "depth", dtype=np.float32, ndim=2).shape
        else:
            data = (value or {}).get("bytes") or b""
            found = parse_picture(data, file, flags=cv2.IMREAD_UNCHANGED).shape[:2]
    except InputError as error:
        return f"{error.what}: {error.got}"
    return None if found == size else f"{found[1]} x {found[0]} px"
