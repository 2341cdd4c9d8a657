"""Folders and ids of tracks and samples in a playback tree: `Town*/trajectory_<unix seconds>/<variant>/`."""

import os
import re
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal, get_args

from pydantic import Field

from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import is_below, real_path

TOWN = "Town"  # prefix of the name of a town's folder
MOST_NAME = 120  # characters of the name of a folder

TrackName = Literal["clean", "perturbed"]
TRACKS: tuple[TrackName, ...] = get_args(TrackName)


class TrackChoice(Config):
    """Selects tracks of a tree."""

    match: tuple[str, ...] = Field(
        (), description="patterns of track folders, such as Town01/trajectory_17*/ORI or Town0[12]; empty: all"
    )
    tracks: tuple[TrackName, ...] = Field(TRACKS, min_length=1, description="clean, perturbed, or both")

    def names(self, folder: str) -> bool:
        """Return whether a pattern matches the folder of a track in the tree, or a folder above it."""
        parts = folder.split("/")
        heads = ["/".join(parts[:count]) for count in range(1, len(parts) + 1)]
        return not self.match or any(fnmatchcase(head, pattern.strip("/")) for pattern in self.match for head in heads)


ALL_TRACKS = TrackChoice()


@dataclass(frozen=True, order=True)
class Place:
    """The position of a track in the tree of a run; `run` is empty if there is only one tree."""

    run: str
    town: str
    trajectory: str
    variant: str


def folder_name(text: str) -> str:
    """Return a text as the name of a folder."""
    return re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII).lstrip(".")[:MOST_NAME] or "map"


def town_folder(name: str) -> str:
    """Return the name of a map as the name of a town's folder: `Town03` stays, `delft` becomes `Town_delft`."""
    name = folder_name(name)
    return name if name.startswith(TOWN) else f"{TOWN}_{name}"


def place_of(folder: Path, run: str = "") -> Place:
    """Return the place of a track from its folder's name in the tree, where it may be a link."""
    town, trajectory, variant = ("", "", *Path(os.path.abspath(folder)).parts)[-3:]
    return Place(run, town, trajectory, variant)


def tree_of_track(folder: Path) -> Path:
    """Return the tree of a track's folder, which no link may leave.

    For a track that is linked into the tree from elsewhere below the tree's parent, return the track's own folder.
    """
    parents = folder.absolute().parents
    tree = parents[min(2, len(parents) - 1)]
    real, root = real_path(folder), real_path(tree)
    is_beside = not is_below(real, root) and is_below(real, os.path.dirname(root))
    return type(tree)(real) if is_beside else tree


# --- ids --------------------------------------------------------------------------------------------------------------


def flight_ids(places: Collection[Place]) -> dict[Place, str]:
    """Return a unique id for each track: `trajectory_1776047127_ORI`.

    Trajectories that share a name get the town as a prefix, and if necessary the run and the town; all tracks of a
    trajectory get the same prefix. Raises InputError if two tracks agree in all of these.
    """
    groups: dict[str, list[Place]] = defaultdict(list)
    for place in places:
        groups[place.trajectory].append(place)
    ids: dict[Place, str] = {}
    for name, group in groups.items():
        for form in ("", "{0.town}_", "{0.run}_{0.town}_"):
            prefixes = [form.format(place) for place in group]
            if len({(prefix, place.variant) for prefix, place in zip(prefixes, group, strict=True)}) == len(group):
                break
        else:
            expected = "tracks that differ in run, town, trajectory or variant"
            fix = "remove all but one of these tracks, or give the folders of their runs different names"
            got = f"{len(group)} tracks in {name}"
            what = "several tracks have the same run, town, trajectory and variant, so they get the same id"
            raise InputError(what, got=got, expected=expected, fix=fix)
        ids |= {place: f"{prefix}{name}_{place.variant}" for prefix, place in zip(prefixes, group, strict=True)}
    return ids


def sample_id(flight_id: str, frame_index: int) -> str:
    """Return the id of a window, such as `trajectory_1776047127_ORI_frame_00004`."""
    return f"{flight_id}_frame_{frame_index:05d}"


def flight_of(sample_id: str) -> str:
    """Return the flight id of a sample id."""
    return sample_id.rpartition("_frame_")[0]
