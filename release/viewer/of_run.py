"""What the viewer shows of a run folder or a playback tree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.boxes import read_boxes
from cosfly.formats.captions import Caption, read_captions
from cosfly.formats.frames import frame_path
from cosfly.formats.inspection import read_settled
from cosfly.formats.places import folder_name, place_of, town_folder
from cosfly.formats.playback import Track, read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.viz.frame_views import VIEW_FILES, View, read_view
from cosfly.viz.page_pictures import PagePictures
from release.columns import Placement, caption_values, scalar_row
from release.viewer.content import (
    PageBox,
    PageCaption,
    PageFlight,
    PageFrame,
    ViewerConfig,
    ViewerPage,
    boxes_of,
    caption_of,
    choose_flights,
    choose_frames,
    frame_of,
    page_pictures,
    path_of,
)

Key = tuple[str, str, str]  # a town's folder, trajectory, variant
VIEWS: tuple[View, ...] = ("rgb", "depth", "segmentation")


@dataclass(frozen=True)
class Tree:
    """A playback tree and what was made of it; None where that is not there. run: its name among several."""

    run: str
    data: Path
    captions: Path | None = None
    inspect: Path | None = None
    boxes: Path | None = None


def find_trees(folder: Path, captions: Path | None = None) -> list[Tree]:
    """Return what a folder is: a run, a run of several towns, or a playback tree.

    Args:
        captions: of a tree; a run has its own.
    """
    if (folder / "render").is_dir():
        return [_of_run(folder, captions)]
    towns = sorted(path.parent for path in folder.glob("*/render") if path.is_dir())
    return [_of_run(town, captions) for town in towns] or [Tree("", folder, captions)]


def _of_run(folder: Path, captions: Path | None) -> Tree:
    own = ("caption/captions.jsonl", "inspect/inspect.json", "simplify/step2_simplified.json")
    own_captions, inspected, boxes = (folder / name if (folder / name).exists() else None for name in own)
    return Tree(folder_name(folder.absolute().name), folder / "render", captions or own_captions, inspected, boxes)


def show_run(folder: Path, cfg: ViewerConfig, captions: Path | None = None) -> ViewerPage:
    """Reads a run folder or a playback tree, gives what the page shows of it."""
    trees = find_trees(folder, captions)
    found = [(tree, place) for tree in trees for place in find_tracks(tree.data)]
    groups = [(tree.run, place_of(place).town, place_of(place).trajectory) for tree, place in found]
    chosen = choose_flights(found, groups, cfg.flights)
    notes = [] if len(chosen) == len(found) else [f"{len(chosen):,} of {len(found):,} flights are shown"]
    wanted = {(tree.run, _key(place)) for tree, place in chosen}
    kinds = _kinds(trees, wanted)
    frames: dict[tuple[Tree, Path], list[int]] = {}  # the flights themselves are read again, one at a time
    for tree, place in chosen:
        try:
            num_frames = len(read_track(place, strict=False))
        except InputError as error:
            notes.append(f"not shown: {place.parent.name}/{place.name}: {error.what}")
            continue
        frames[tree, place] = choose_frames(range(num_frames), kinds.get((tree.run, _key(place)), {}), cfg.frames)
    texts = _texts(trees, {(tree.run, _key(place)): set(indices) for (tree, place), indices in frames.items()})
    results = _results(trees)
    pictures = page_pictures(cfg, len(frames), sum(map(len, frames.values())))
    shown = list[PageFlight]()
    with progress_bar("viewer: frames", pictures.num_frames) as advance:
        for (tree, place), indices in frames.items():
            flight, key = read_track(place, strict=False), (tree.run, _key(place))
            one = _flight(tree, flight, results.get(key), len(kinds.get(key, {})))
            for index in indices:
                one.frames.append(_frame(flight, index, texts.get((*key, index)), pictures))
                advance(1)
            shown.append(one)
    maps = _maps(trees, shown)
    return ViewerPage(
        title=folder.absolute().name, kind="run", notes=[*notes, *pictures.notes()], maps=maps, flights=shown
    )


def _key(folder: Path) -> Key:
    place = place_of(folder)
    return town_folder(place.town), place.trajectory, place.variant


def _kinds(trees: list[Tree], wanted: set[tuple[str, Key]]) -> dict[tuple[str, Key], dict[int, tuple]]:
    """Read what the captions of the chosen flights say, by frame: verdict, decision, whether it was dropped."""
    kinds: dict[tuple[str, Key], dict[int, tuple]] = {}
    for run, caption in _read(trees):
        place = (run, (town_folder(caption.town), caption.trajectory, caption.variant))
        if place in wanted:
            decision = caption.en.flight_decision if caption.en else None
            kinds.setdefault(place, {})[caption.frame_index] = (caption.status, caption.verdict, decision)
    return kinds


def _texts(trees: list[Tree], wanted: dict[tuple[str, Key], set[int]]) -> dict[tuple[str, Key, int], Caption]:
    """Read the captions of the chosen frames."""
    texts: dict[tuple[str, Key, int], Caption] = {}
    for run, caption in _read(trees):
        key = (town_folder(caption.town), caption.trajectory, caption.variant)
        if caption.frame_index in wanted.get((run, key), ()):
            texts[run, key, caption.frame_index] = caption
    return texts


def _read(trees: list[Tree]) -> Iterator[tuple[str, Caption]]:
    for tree in trees:
        if tree.captions is not None:
            for caption in read_captions(tree.captions):
                yield tree.run, caption


def _results(trees: list[Tree]) -> dict[tuple[str, Key], str]:
    """Read what the inspection made of each flight."""
    return {
        (tree.run, (town_folder(flight.town), flight.trajectory, flight.variant)): flight.result
        for tree in trees
        if tree.inspect is not None
        for flight in read_settled(tree.inspect).flights
    }


def _flight(tree: Tree, flight: Track, result: str | None, num_captions: int) -> PageFlight:
    names = [name for name in (tree.run, flight.town, flight.trajectory) if name]
    return PageFlight(
        name="/".join([*names, flight.variant]),
        group="/".join(names),
        map=f"{tree.run}/{flight.town}",
        town=flight.town,
        track="clean" if flight.is_original else "perturbed",
        split=None,
        result=result,
        fovs_deg=(round(flight.fovs_deg[0], 1), round(flight.fovs_deg[1], 1)),
        num_frames=len(flight),
        num_captions=num_captions,
        drone_path=path_of(flight.positions_m),
        target_path=path_of(flight.targets_m),
        frames=[],
    )


def _frame(flight: Track, index: int, caption: Caption | None, pictures: PagePictures) -> PageFrame:
    folder = flight.frame_folder(index)
    views: Mapping[View, Callable[[], np.ndarray]] = {
        view: partial(read_view, folder, view) for view in VIEWS if frame_path(folder, VIEW_FILES[view]).exists()
    }
    values = None if caption is None else caption_values(caption)
    row = scalar_row(flight, index, values, Placement(walk="", split="train"))
    return frame_of(row, pictures.of_frame(views), None if caption is None else _caption(caption, row))


def _caption(caption: Caption, row: Mapping[str, Any]) -> PageCaption:
    """Return a caption of a run, of which more is known than a release tells."""
    shown, repair = caption_of(row), caption.repair
    if repair is not None:
        told = f"{repair.rung or repair.outcome}, first {repair.first_decision} ({repair.first_verdict})"
        shown.repair = shown.facts["repair"] = told
    shown.problems = caption.checks.evidence if isinstance(caption.checks.evidence, list) else []
    shown.dropped = caption.drop_reason if caption.status == "dropped" else None
    return shown


def _maps(trees: list[Tree], flights: list[PageFlight]) -> dict[str, list[PageBox]]:
    """Read the boxes round the flights of each town, where the run has them."""
    maps: dict[str, list[PageBox]] = {}
    for tree in trees:
        for name in sorted({flight.map for flight in flights if flight.map.startswith(f"{tree.run}/")}):
            if tree.boxes is not None:
                near = [
                    place
                    for flight in flights
                    if flight.map == name
                    for place in (*flight.drone_path, *flight.target_path)
                ]
                maps[name] = boxes_of(read_boxes(tree.boxes), near)
    return maps
