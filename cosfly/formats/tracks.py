"""Tracks of a playback tree: find and choose them, and read the clean twin of a perturbed one."""

import os
from pathlib import Path

import numpy as np

from cosfly.formats.places import ALL_TRACKS, TRACKS, TrackChoice, TrackName
from cosfly.formats.playback import ORIGINAL, Track
from cosfly.formats.playback_file import read_track
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.io import files_named

TWIN_TOLERANCE_S = 1e-3  # largest difference of the times of two tracks with the same frames


def find_tracks(root: Path, choice: TrackChoice = ALL_TRACKS) -> list[Path]:
    """Return the chosen folders that hold a `trajectory.json`, sorted."""
    if not root.is_dir():
        raise InputError("the directory of rendered tracks does not exist", where=root, fix="check the path")
    folders = [path.parent for path in files_named(root, "trajectory.json")]
    if not folders:
        what = "the directory does not contain rendered tracks"
        got = "no trajectory.json in any folder below the directory"
        expected = "files such as Town*/trajectory_*/ORI/trajectory.json"
        fix = "pass the output directory of cosfly render as --data"
        raise InputError(what, where=root, got=got, expected=expected, fix=fix)
    matching = [folder for folder in folders if choice.names(folder.relative_to(root).as_posix())]
    if not matching:
        what = "no track folder in this directory matches the patterns of --flights"
        expected = f"a pattern that matches a folder such as {folders[0].relative_to(root).as_posix()}"
        fix = "change --flights"
        raise InputError(what, where=root, got=", ".join(choice.match), expected=expected, fix=fix)
    if len(choice.tracks) == len(TRACKS):
        return matching
    chosen = [folder for folder in matching if track_of(folder) in choice.tracks]
    if not chosen:
        what = f"this directory has no {' or '.join(choice.tracks)} track among those that match --flights"
        raise InputError(what, where=root, fix="change --tracks, or render tracks of this kind")
    return chosen


def track_of(folder: Path) -> TrackName:
    """Return the kind of a track from its folder's name."""
    return "clean" if folder.name == ORIGINAL else "perturbed"


def read_twin(track: Track) -> Track | None:
    """Read the clean twin of a perturbed track; None without one, VerifyError if the two do not belong together."""
    if track.is_original or track.folder is None:
        return None
    folder = type(track.folder)(os.path.abspath(track.folder)).with_name(ORIGINAL)
    if not (folder / "trajectory.json").exists():
        return None
    twin = read_track(folder)
    has_same_times = len(twin) == len(track) and np.abs(twin.time_s - track.time_s).max() < TWIN_TOLERANCE_S
    if not (twin.is_original and has_same_times):
        what = "the track next to the perturbed one is not its clean twin"
        got = f"a {'clean' if twin.is_original else 'perturbed'} track, {_time_span(twin)}"
        expected = f"a clean track, {_time_span(track)}"
        fix = "render both tracks again"
        raise VerifyError(what, where=twin.folder, got=got, expected=expected, fix=fix)
    return twin


def _time_span(track: Track) -> str:
    return f"{len(track)} points from {track.time_s[0]:.3f} to {track.time_s[-1]:.3f} s"
