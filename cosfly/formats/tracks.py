"""Tracks of a playback tree: finding, choosing, and the clean twin of a perturbed one."""

from __future__ import annotations

import os
import re
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
        got, expected = "no trajectory.json below it", "Town*/trajectory_*/ORI/trajectory.json"
        raise InputError("not a playback tree", where=root, got=got, expected=expected, fix="check --data")
    chosen = [folder for folder in folders if choice.names(folder.relative_to(root).as_posix())]
    if not chosen:
        what, got = "no flight of the tree has such a name", ", ".join(choice.match)
        expected = f"a pattern for {folders[0].relative_to(root).as_posix()} and its like"
        raise InputError(what, where=root, got=got, expected=expected, fix="check --flights")
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
    folders = [named] if has_named else sorted(p.parent for p in own.parent.glob("[!.]*/trajectory.json"))
    found = (read_track(folder, strict=False) if folder != own else flight for folder in folders)
    twin = next((track for track in found if track.is_original or has_named), None)
    if twin is None:
        return None
    has_its_times = len(twin) == len(flight) and np.abs(twin.time_s - flight.time_s).max() < TWIN_TOLERANCE_S
    if not (twin.is_original and has_its_times):
        got, expected = (f"{len(f)} points from {f.time_s[0]:.3f} to {f.time_s[-1]:.3f} s" for f in (twin, flight))
        what = "the clean track does not belong to the perturbed track next to it"
        got = f"{got}, is_original {twin.is_original}"
        raise VerifyError(what, where=twin.folder, got=got, expected=expected)
    return twin
