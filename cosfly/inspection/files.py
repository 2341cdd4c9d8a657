"""Checks of the files of one track: presence, kind, size, and the recorded digests.

Findings go into a Report; the thresholds of acceptance are in track.py.
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


def check_files(track: Track, report: Report) -> dict[int, FrameMeta | None]:
    """Check by the headers that every frame has its files, of the right size and type.

    A tree of another program may lack a kind of file, such as `meta.json`, if its checksums list none.

    Returns:
        The annotation of each complete frame, None in a tree without annotations.
    """
    assert track.folder is not None
    tree = tree_of_track(track.folder)
    size = (track.camera.width_px, track.camera.height_px)
    complete: dict[int, FrameMeta | None] = {}
    absent = [name for name in FRAME_FILES[1:] if not _has_any(track, name)]
    absent = [] if absent and _lists(track, absent) else absent
    names = [name for name in FRAME_FILES if name not in absent]
    for name in absent:
        report.add(
            "note", "not_in_this_tree", f"{FRAMES_DIR}/*/{name}", "no such file", "one per frame in cosfly's trees"
        )
    for i in range(len(track)):
        num_issues, meta = len(report.issues), None
        for name in names:
            path = frame_path(track.frame_folder(i), name)
            where = f"{frame_name(i)}/{path.name}"
            if not path.is_file():
                report.error("missing_file", where, "no such file", "one file per frame and modality")
            elif name == "meta.json":
                meta = _check_meta(track, i, report)
            else:
                _check_header(path, size, tree, where, report)
        if len(report.issues) == num_issues:
            complete[i] = meta
    known = {Path(frame_name(i)).name for i in range(len(track))}
    frames = track.folder / FRAMES_DIR
    for stray in sorted(p.name for p in frames.iterdir() if p.name not in known) if frames.is_dir() else []:
        report.warn("stray_frame", f"{FRAMES_DIR}/{stray}", "no point of this index", f"{len(known)} frames")
    return complete


def _has_any(track: Track, name: str) -> bool:
    return any(frame_path(track.frame_folder(i), name).exists() for i in range(len(track)))


def _lists(track: Track, names: Collection[str]) -> bool:
    """Return whether a track's checksums list files of these names, or cannot be read."""
    assert track.folder is not None
    try:
        listed = read_checksums(track.folder) if (track.folder / CHECKSUMS).is_file() else {}
    except InputError:
        return True
    return any(public_name(name.rpartition("/")[2]) in names for name in listed)


def _check_header(path: Path, size: tuple[int, int], tree: Path, where: str, report: Report) -> None:
    """Check type and (width, height) of a picture or a depth image by its header."""
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


def _check_meta(track: Track, i: int, report: Report) -> FrameMeta | None:
    where = f"{frame_name(i)}/meta.json"
    try:
        meta = read_meta(track.frame_folder(i))
    except InputError as error:
        report.error("broken_annotation", where, error.got, "a frame annotation")
        return None
    if meta.index != i:
        report.error("broken_annotation", f"{where}: index", meta.index, str(i))
    return meta


class Checksums:
    """The digests in `checksums.sha256`, each compared once: when a file is read anyway, or at the end."""

    def __init__(self, track: Track, report: Report, *, is_wanted: bool) -> None:
        self._track, self._report = track, report
        self._open = self._listed() if is_wanted else {}

    def _listed(self) -> dict[str, str]:
        folder = self._track.folder
        assert folder is not None
        if not (folder / CHECKSUMS).is_file():
            self._report.add("note", "no_checksums", CHECKSUMS, "no such file", "digests of the track's files")
            return {}
        try:
            return read_checksums(folder)
        except InputError as error:
            self._report.error("checksum", CHECKSUMS, error.got or error.what, "lines of sha256sum")
            return {}

    def compare(self, name: str, data: bytes) -> None:
        """Compare the content of a file; its name is relative to the track's folder."""
        digest = self._open.pop(name, None)
        if digest is not None and sha256_bytes(data) != digest:
            _report_changed(name, CHECKSUMS, self._report)

    def compare_rest(self) -> None:
        """Read and compare the files that were not compared yet."""
        assert self._track.folder is not None
        for name, digest in self._open.items():
            advance()
            _compare_file(self._track.folder / name, name, digest, CHECKSUMS, self._report)


def _compare_file(path: Path, name: str, digest: str, listed_in: str, report: Report) -> None:
    if not path.is_file():
        report.error("missing_file", name, "no such file", f"a file, listed in {listed_in}")
    elif sha256_file(path) != digest:
        _report_changed(name, listed_in, report)


def _report_changed(name: str, listed_in: str, report: Report) -> None:
    report.error("checksum", name, "other bytes", f"the digest in {listed_in}")


def check_recorded(track: Track, root: Path, recorded: Mapping[str, str], report: Report) -> None:
    """Compare a track's own records with its tree's manifest. recorded: path in the tree -> sha256."""
    assert track.folder is not None
    for name in ("trajectory.json", CHECKSUMS) if recorded else ():
        path = track.folder / name
        digest = recorded.get(path.relative_to(root).as_posix())
        if digest is not None:
            _compare_file(path, name, digest, "the tree's manifest", report)
        elif name == "trajectory.json":
            got, expected = "no such entry in the tree's manifest", "a track that was made with it"
            report.error("not_of_this_tree", name, got, expected)
