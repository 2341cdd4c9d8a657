"""Checks on the files of one flight: are they all there, of the right kind and size, and those that were recorded?

They judge nothing: findings go into a Report; the thresholds that make a flight acceptable stand in flight.py.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from cosfly.formats.frames import FRAME_FILES, FRAMES_DIR, FrameMeta, frame_name, frame_path, public_name, read_meta
from cosfly.formats.issues import Report
from cosfly.formats.places import tree_of_track
from cosfly.formats.playback import Track
from cosfly.runtime.arrays import array_header, picture_size
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, read_checksums, sha256_bytes, sha256_file
from cosfly.runtime.worker import advance


def check_files(flight: Track, report: Report) -> dict[int, FrameMeta | None]:
    """Check that every frame has its files, of the right size and type by their headers, and no frame stands alone.

    A flight may lack a kind of file altogether that its checksums do not list, as one of somebody else does:
    `meta.json` is cosfly's own, and public readers ask for `rgb.png` alone. One of cosfly's lacks what was not drawn
    (`render.modalities`).

    Returns:
        of each frame that is complete so far its annotation, None in a tree without.
    """
    assert flight.folder is not None
    tree = tree_of_track(flight.folder)
    size = (flight.camera.width_px, flight.camera.height_px)
    complete: dict[int, FrameMeta | None] = {}
    absent = [name for name in FRAME_FILES[1:] if not _has_any(flight, name)]
    absent = [] if absent and _lists(flight, absent) else absent
    names = [name for name in FRAME_FILES if name not in absent]
    for name in absent:
        report.add(
            "note", "not_in_this_tree", f"{FRAMES_DIR}/*/{name}", "no such file", "one a frame, in cosfly's trees"
        )
    for i in range(len(flight)):
        problems_before, meta = len(report.issues), None
        for name in names:
            path = frame_path(flight.frame_folder(i), name)
            where = f"{frame_name(i)}/{path.name}"
            if not path.is_file():
                report.error("missing_file", where, "no such file", "one file per frame and modality")
            elif name == "meta.json":
                meta = _check_meta(flight, i, report)
            else:
                _check_header(path, size, tree, where, report)
        if len(report.issues) == problems_before:
            complete[i] = meta
    known = {Path(frame_name(i)).name for i in range(len(flight))}
    frames = flight.folder / FRAMES_DIR
    for stray in sorted(p.name for p in frames.iterdir() if p.name not in known) if frames.is_dir() else []:
        report.warn("stray_frame", f"{FRAMES_DIR}/{stray}", "no point of this index", f"{len(known)} frames")
    return complete


def _lists(flight: Track, names: Collection[str]) -> bool:
    """Return whether the checksums of a flight list a file of these names; where they cannot be read, they may."""
    assert flight.folder is not None
    if not (flight.folder / CHECKSUMS).is_file():
        return False
    try:
        return any(public_name(listed.rpartition("/")[2]) in names for listed in read_checksums(flight.folder))
    except InputError:
        return True


def _has_any(flight: Track, name: str) -> bool:
    return any(frame_path(flight.frame_folder(i), name).exists() for i in range(len(flight)))


def _check_header(path: Path, size: tuple[int, int], tree: Path, where: str, report: Report) -> None:
    """Check type and (width, height) of a picture or a depth image, by its header."""
    is_depth = path.suffix == ".npy"
    expected = f"float32 ({size[1]}, {size[0]})" if is_depth else f"a PNG of {size[0]} x {size[1]} px"
    try:
        if is_depth:
            found: object = str(array_header(path, tree=tree))
        else:
            found = picture_size(path, tree=tree) or "no PNG header"
    except InputError as error:
        found = error.got or error.what
    if found != (expected if is_depth else size):
        report.error("wrong_format", where, found, expected)


def _check_meta(flight: Track, i: int, report: Report) -> FrameMeta | None:
    where = f"{frame_name(i)}/meta.json"
    try:
        meta = read_meta(flight.frame_folder(i))
    except InputError as error:
        report.error("broken_annotation", where, error.got, "a frame annotation")
        return None
    if meta.index != i:
        report.error("broken_annotation", f"{where}: index", meta.index, str(i))
    return meta


class Checksums:
    """The digests that `checksums.sha256` lists, each compared once: with a file that is read anyway, or at the end."""

    def __init__(self, flight: Track, report: Report, *, is_wanted: bool) -> None:
        self._flight, self._report = flight, report
        self._open = _listed(flight, report) if is_wanted else {}

    def compare(self, name: str, data: bytes) -> None:
        """Compare the bytes of a file, whose name is relative to the flight's folder."""
        digest = self._open.pop(name, None)
        if digest is not None and sha256_bytes(data) != digest:
            self._tell(name)

    def compare_others(self) -> None:
        """Read the files whose bytes nobody brought."""
        assert self._flight.folder is not None
        for name, digest in self._open.items():
            advance()
            path = self._flight.folder / name
            if not path.is_file():
                self._report.error("missing_file", name, "no such file", f"a file, listed in {CHECKSUMS}")
            elif sha256_file(path) != digest:
                self._tell(name)

    def _tell(self, name: str) -> None:
        self._report.error("checksum", name, "other bytes", f"the digest in {CHECKSUMS}")


def _listed(flight: Track, report: Report) -> dict[str, str]:
    assert flight.folder is not None
    if not (flight.folder / CHECKSUMS).is_file():
        report.add("note", "no_checksums", CHECKSUMS, "no such file", "digests of the flight's files")
        return {}
    try:
        return read_checksums(flight.folder)
    except InputError as error:
        report.error("checksum", CHECKSUMS, error.got or error.what, "lines of sha256sum")
        return {}


def check_recorded(flight: Track, root: Path, recorded: Mapping[str, str], report: Report) -> None:
    """Compare a flight's own records with its tree's manifest, `recorded`: path in the tree -> sha256."""
    assert flight.folder is not None
    for name in ("trajectory.json", CHECKSUMS) if recorded else ():
        path = flight.folder / name
        digest = recorded.get(path.relative_to(root).as_posix())
        if digest is None and name == "trajectory.json":
            report.error(
                "not_of_this_tree", name, "no such entry in the tree's manifest", "a flight that was made with it"
            )
        elif digest is not None and not path.is_file():
            report.error("missing_file", name, "no such file", "a file, listed in the tree's manifest")
        elif digest is not None and sha256_file(path) != digest:
            report.error("checksum", name, "other bytes", "the digest in the tree's manifest")
