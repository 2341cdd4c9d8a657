"""Tracks of a playback tree: finding, choosing, and the clean twin of a perturbed one."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cosfly.formats.places import ALL_FLIGHTS, TRACKS, TrackChoice, TrackName
from cosfly.formats.playback import ORIGINAL, Track, read_track
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import files_named

TWIN_TOLERANCE_S = 1e-3


def find_tracks(root: Path, choice: TrackChoice = ALL_FLIGHTS) -> list[Path]:
    """Return the chosen folders that hold a `trajectory.json`, sorted."""
    if not root.is_dir():
        raise InputError("there is no such folder", where=root, expected="a playback tree", fix="check the path")
    folders = [path.parent for path in files_named(root, "trajectory.json")]
    if not folders:
        raise InputError(
            "not a playback tree",
            where=root,
            got="no trajectory.json below it",
            expected="Town*/trajectory_*/ORI/trajectory.json",
            fix="check --data",
        )
    return chosen_tracks(folders, root, choice)


def chosen_tracks(folders: Sequence[Path], root: Path, choice: TrackChoice) -> list[Path]:
    """Return the chosen tracks of a tree."""
    chosen = [folder for folder in folders if choice.names(folder.relative_to(root).as_posix())]
    if folders and not chosen:
        what, expected = "no flight of the tree has such a name", folders[0].relative_to(root).as_posix()
        expected = f"a pattern for {expected} and its like"
        raise InputError(what, where=root, got=", ".join(choice.match), expected=expected, fix="check --flights")
    if len(choice.tracks) < len(TRACKS):
        chosen = [folder for folder in chosen if track_of(folder) in choice.tracks]
        if not chosen:
            what, got = "no flight of the tree is of this track", ", ".join(choice.tracks)
            raise InputError(what, where=root, got=got, fix="check --tracks")
    return chosen


def track_of(folder: Path) -> TrackName:
    """Return the kind of a track by its folder's name or its file; an unreadable one counts as perturbed."""
    if folder.name == ORIGINAL:
        return "clean"
    if re.fullmatch(r"aug_\d+", folder.name):
        return "perturbed"
    try:
        return "clean" if read_track(folder, strict=False).is_original else "perturbed"
    except InputError:
        return "perturbed"


def read_twin(flight: Track) -> Track | None:
    """Read the clean twin of a perturbed track, None where there is none; raises VerifyError if its frames differ."""
    if flight.is_original or flight.folder is None:
        return None
    own = type(flight.folder)(os.path.abspath(flight.folder))
    named = own.parent / ORIGINAL
    has_named = named != own and (named / "trajectory.json").exists()
    for folder in [named] if has_named else sorted(p.parent for p in own.parent.glob("[!.]*/trajectory.json")):
        twin = read_track(folder, strict=False) if folder != own else flight
        if twin.is_original:
            break
        if has_named:
            raise _no_twin(flight, twin)
    else:
        return None
    if len(twin) != len(flight) or np.abs(twin.time_s - flight.time_s).max() >= TWIN_TOLERANCE_S:
        raise _no_twin(flight, twin)
    return twin


def _no_twin(flight: Track, other: Track) -> VerifyError:
    got, expected = (f"{len(f)} points from {f.time_s[0]:.3f} to {f.time_s[-1]:.3f} s" for f in (other, flight))
    got = f"{got}, is_original {other.is_original}"
    return VerifyError(
        "the clean track does not belong to the perturbed track next to it",
        where=other.folder,
        got=got,
        expected=expected,
    )
