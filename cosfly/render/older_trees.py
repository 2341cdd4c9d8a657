"""`cosfly convert-tree`: a playback tree of an earlier cosfly to one that public readers of CosFly-Track take.

What they demand and cosfly wrote otherwise at first: town folders `Town*`, `trace_dir` the flight's own folder, and
`nav_waypoint.t1_world` an object. The older tree stays as it is; pictures and depths are linked, not copied, where the disk can.
"""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.flights import find_flights
from cosfly.products.frames import FRAMES_DIR, XYZ, read_meta
from cosfly.products.places import place_of, town_folder
from cosfly.products.playback import read_flight
from cosfly.reading.files import check_stays_below, sha256_file
from cosfly.work.config import Config
from cosfly.work.runner import Item, Outcome, Watch, Work, run_items
from cosfly.work.stage_folder import Resume, StageFolder
from cosfly.work.store import CHECKSUMS, atomic_folder, read_checksums, storage_errors, write_checksums, write_json

log = logging.getLogger(__name__)


class ConvertConfig(Config):
    """Nothing to set."""


def run(data: Path, out: Path, *, workers: int = 0, watch: Watch = Watch(), resume: Resume = "if-same") -> Path:
    """Reads an older playback tree `data`; writes the same flights into `out`, a new tree, and gives it.

    A kill loses the flights in work; run again to continue.

    Raises:
        InputError: not a playback tree, one of it cannot be read, it is in the public form already, or `out` lies in it.
    """
    if out.resolve().is_relative_to(data.resolve()) or data.resolve().is_relative_to(out.resolve()):
        raise InputError("a tree cannot be converted into itself", where=out, fix="choose an --out beside it")
    folders = [folder.relative_to(data) for folder in find_flights(data)]
    for folder in folders:
        place = place_of(data / folder)
        if len(folder.parts) != 3 or not place.trajectory.startswith("trajectory_"):
            raise InputError(
                "not a tree that cosfly wrote", where=data, got=str(folder), expected="<town>/trajectory_*/<variant>"
            )
    towns = sorted({folder.parts[0] for folder in folders})
    if len({town_folder(town) for town in towns}) < len(towns):
        raise InputError(
            "two towns would have one name", where=data, got=", ".join(towns), expected="towns that differ in letters and digits",
            fix="rename one of the folders first",
        )  # fmt: skip
    if all(is_public(data / folder) for folder in folders):
        raise InputError(
            "nothing to convert", where=data, got="a tree in the public form", fix="use it as it is, with --data"
        )
    stage = StageFolder.open(out, "convert-tree", config=ConvertConfig(), inputs={"data": data}, seed=0, resume=resume)
    if stage.is_complete:
        return out
    items = [Item(folder.as_posix(), folder) for folder in folders]
    finished = run_items(stage, items, make_worker, (data, out), workers=workers, watch=watch, label="convert-tree")
    flights = [out / _renamed(Path(record.id)) for record in finished.kept]
    outputs = [path for flight in flights for path in (flight / "trajectory.json", flight / CHECKSUMS) if path.exists()]
    for town in towns:
        outputs += link_files(data / town, out / town_folder(town))
    stage.finish(outputs, finished.tally)
    _tell_what_lacks(folders)
    return out


def is_public(folder: Path) -> bool:
    """Tell whether a flight's folder and file have the public form already.

    Raises:
        InputError: the file cannot be read, or breaks the layout in another way.
    """
    flight = read_flight(folder)
    waypoints = [(point.get("nav_waypoint") or {}).get("t1_world") for point in flight.raw["points"][:-1]]
    has_objects = all(isinstance(waypoint, dict) for waypoint in waypoints)
    return has_objects and flight.raw["trace_dir"] == flight.variant and town_folder(flight.town) == flight.town


def make_worker(data: Path, out: Path) -> Work:
    """Give the function that converts one flight."""

    def work(item: Item) -> Outcome:
        folder: Path = item.payload
        with atomic_folder(out / _renamed(folder)) as unfinished:
            num_frames = convert_flight(data / folder, unfinished)
        return Outcome({"folder": _renamed(folder).as_posix(), "num_frames": num_frames})

    return work


def convert_flight(source: Path, target: Path) -> int:
    """Write a flight's files into an (unfinished) folder in the public form; gives its number of frames.

    Raises:
        InputError: a file cannot be read. StorageError: one cannot be written.
    """
    place = place_of(source)
    raw = read_flight(source).raw
    raw["trace_dir"] = place.variant
    for point in raw["points"]:
        waypoint = point["nav_waypoint"]["t1_world"]
        if isinstance(waypoint, list):
            point["nav_waypoint"]["t1_world"] = dict(zip(XYZ, waypoint, strict=True))
    write_json(target / "trajectory.json", raw)
    link_files(source, target, but=("trajectory.json", CHECKSUMS))
    changed = ["trajectory.json"]
    for frame in sorted(path for path in (source / FRAMES_DIR).glob("*") if path.is_dir()):
        name = frame.relative_to(source)
        link_files(frame, target / name, but=("meta.json",))
        if (frame / "meta.json").exists():
            meta = read_meta(frame).model_copy(update={"town": town_folder(place.town)})
            with storage_errors(target / name):
                (target / name / "meta.json").write_bytes(meta.to_bytes())
            changed.append(f"{name.as_posix()}/meta.json")
    if (source / CHECKSUMS).exists():
        write_checksums(target, read_checksums(source) | {name: sha256_file(target / name) for name in changed})
    return len(raw["points"])


def link_files(source: Path, target: Path, but: tuple[str, ...] = ()) -> list[Path]:
    """Link the files of a folder, not those of folders in it, into another; copy where the disk cannot link.

    Raises:
        InputError: one is a symbolic link out of the folder. StorageError: the other cannot be written to.
    """
    made = []
    with storage_errors(target):
        target.mkdir(parents=True, exist_ok=True)
        for file in sorted(path for path in source.iterdir() if path.is_file() and path.name not in but):
            check_stays_below(file, source)
            made.append(target / file.name)
            made[-1].unlink(missing_ok=True)  # a kill may have left it
            try:
                os.link(file.resolve(), made[-1])  # never a link to a link: nobody writes to such a folder again
            except OSError:  # another disk, or one without links
                shutil.copyfile(file, made[-1])
    return made


def _renamed(folder: Path) -> Path:
    town, trajectory, variant = folder.parts
    return Path(town_folder(town), trajectory, variant)


def _tell_what_lacks(folders: list[Path]) -> None:
    """Public readers want both flights of every trajectory; what is not there is told, never made up."""
    variants: dict[Path, set[str]] = {}
    for folder in folders:
        variants.setdefault(folder.parent, set()).add(folder.name)
    lacking = [parent for parent, found in variants.items() if not found >= {"ORI", "aug_001"}]
    if lacking:
        log.warning("convert-tree: %d trajectories lack a flight, the first %s", len(lacking), lacking[0])
