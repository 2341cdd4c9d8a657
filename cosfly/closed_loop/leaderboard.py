"""Students side by side, of the folders of `cosfly fly`: `leaderboard.json` and a page that stands alone.

Only students that were to fly the same episodes are in one table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from cosfly.closed_loop.measures import (
    MEASURES,
    SHARES,
    draws_of,
    figures_of,
    ratios,
    score_flights,
    walk_sums,
)
from cosfly.closed_loop.settings import FLOORS
from cosfly.formats.flight_scores import Figure, Score, read_score
from cosfly.formats.playback import read_track
from cosfly.formats.pursuits import Pursuit, pursuit_file, read_pursuit
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes, write_bytes
from cosfly.runtime.json_io import FileFormat, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page
from distill.evaluation.pages import COLORS, STYLE, bars, shown_as

HEADLINE = ("success", "in_view", "tracked_frames", "kept_s", "lost", "crashed")
STRIP_FRAMES, STRIP_PX = 8, 200
BOARD_FORMAT = FileFormat("cosfly.leaderboard", "1.0", "leaderboard")


class LeaderboardConfig(Config):
    """`cosfly leaderboard`: nothing is set in files."""

    rounds: bool = False


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Standing(_Strict):
    """One student in a table. gain: of a round, its figures less those of the round before on the same draws of
    walks."""

    name: str
    role: Literal["student", "floor", "ceiling"]
    score: Score
    gain: dict[str, Figure] | None = None


class StudentTable(_Strict):
    """episodes: of each folder what was to be flown; the same of all students."""

    episodes: tuple[str, ...]
    standings: tuple[Standing, ...]


class Leaderboard(_Strict):
    """`leaderboard.json`."""

    tables: tuple[StudentTable, ...]


Flown = dict[Path, Score]  # the folders of one student


def run(
    cfg: LeaderboardConfig, folders: Sequence[tuple[str, Path]], out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read folders of `cosfly fly`, each with a name or ""; write `leaderboard.json` and `leaderboard.html`, whose path
    is given.

    Raises:
        InputError: two folders of one name hold the same episode.
    """
    inputs = {f"{number}/{name}": folder for number, (name, folder) in enumerate(folders)}
    flown: dict[str, Flown] = {}
    for name, folder in folders:
        score = read_score(folder)
        own = flown.setdefault(name or score.student, {})
        known = {(flight.town, flight.episode) for other in own.values() for flight in other.flights}
        if twice := [flight for flight in score.flights if (flight.town, flight.episode) in known]:
            what, got = "two folders of one name hold the same episode", f"{twice[0].town}, {twice[0].episode}"
            raise InputError(what, where=f"{name or score.student}: {folder}", got=got, fix="name them: NAME=DIR")
        own[folder] = score
    stage = StageFolder.open(out, "leaderboard", config=cfg, inputs=inputs, seed=seed, resume=resume)
    path, record = out / "leaderboard.html", out / "leaderboard.json"
    if not stage.is_complete:
        board = Leaderboard(tables=tuple(tables_of(flown, cfg, seed)))
        write_model(record, board, BOARD_FORMAT)
        write_bytes(path, page_of(board, flown).encode())
        stage.finish([record, path], Tally(input=len(folders), kept=len(folders)))
    return path


def tables_of(flown: Mapping[str, Flown], cfg: LeaderboardConfig, seed: int) -> list[StudentTable]:
    """Put those that were to fly the same into one table each, the best first, or rounds in their order."""
    groups: dict[tuple[str, ...], list[Standing]] = {}
    for name, own in flown.items():
        scores = list(own.values())
        digests, first = tuple(sorted(score.episodes_sha256 for score in scores)), scores[0]
        role: Any = "floor" if first.engine in FLOORS else "ceiling" if first.engine == "planner" else "student"
        towns = [score.trained_on for score in scores]
        together = score_flights(
            [flight for score in scores for flight in score.flights], first.student, first.engine,
            sha256_bytes(" ".join(digests).encode()), seed=seed,
            list_sha256=first.list_sha256 if len(scores) == 1 else None,
            trained_on=None if None in towns else sorted({town for known in towns for town in known or ()}),
        )  # fmt: skip
        group = groups.setdefault(digests, [])
        gain = gains(group[-1].score, together, seed) if cfg.rounds and group else None
        group.append(Standing(name=name, role=role, score=together, gain=gain))
    if not cfg.rounds:
        for group in groups.values():
            group.sort(key=lambda one: [-(one.score.figures[name].value or 0.0) for name in ("success", "in_view")])
    return [StudentTable(episodes=digests, standings=tuple(group)) for digests, group in groups.items()]


def gains(before: Score, after: Score, seed: int) -> dict[str, Figure]:
    """Return by how much figures changed from one to another who flew the same walks."""
    (walks, one), (_, other) = (walk_sums(score.flights, list(MEASURES)) for score in (before, after))
    draws = draws_of(len(walks), rng_for(seed, "leaderboard", "gains"))
    return figures_of(ratios(draws, other) - ratios(draws, one), [len(walks)] * len(MEASURES), len(walks))


# --- the page ---------------------------------------------------------------------------------------------------------


def shown(name: str, figure: Figure, *, signed: bool = False) -> str:
    """Return a figure with its interval in words."""
    sign, digits = "+" if signed else "", ".1%" if name in SHARES else ".2f"
    return shown_as(f"{{:{sign}{digits}}}", figure)


Pursuits = dict[tuple[str, str], tuple[Pursuit, Path]]  # by town and episode, and the folder of each


def page_of(board: Leaderboard, flown: Mapping[str, Flown]) -> str:
    """Return the page; a student whose folders have no flights any more is shown by its figures alone."""
    drawn = []
    for table in board.tables:
        standings = table.standings
        groups = {
            words: {one.name: one.score.figures[measure] for one in standings}
            for measure, words in (("success", "success"), ("in_view", "person seen"))
        }
        strips = [strip for one in standings for strip in _strips(one, _pursuits(flown[one.name]))]
        drawn.append({"table": table, "chart": bars(groups), "strips": strips})
    return page(
        "cosfly/closed_loop/leaderboard.html", title="Closed loop", style=STYLE, tables=drawn, measures=MEASURES,
        headline=HEADLINE, shown=shown, colors=COLORS, width_px=STRIP_PX,
    )  # fmt: skip


def _pursuits(own: Flown) -> Pursuits:
    flights = [(folder, flight) for folder, score in own.items() for flight in score.flights]
    paths = [(folder, flight, pursuit_file(folder, flight.episode)) for folder, flight in flights]
    return {(one.town, one.episode): (read_pursuit(path), folder) for folder, one, path in paths if path.is_file()}


def _strips(one: Standing, own: Pursuits) -> list[dict[str, Any]]:
    """Return the best and the worst flight of a student, by how much of the walk shows the person: frames and words."""
    shares = {(f.town, f.episode): f.sums["in_view"][0] / f.sums["in_view"][1] for f in one.score.flights}
    ranked, found = sorted(shares, key=lambda key: (shares[key], key[1])), []
    for title, key in (("best", ranked[-1]), ("worst", ranked[0])):
        if key not in own:
            continue
        pursuit, folder = own[key]
        tree = folder / "render"
        drawn = (read_track(path) for path in find_tracks(tree)) if tree.is_dir() else ()
        flight = next((one for one in drawn if one.source.get("scenario_id") == pursuit.walk), None)
        places = np.unique(np.linspace(pursuit.num_lead, len(pursuit.frames) - 1, STRIP_FRAMES).astype(int)).tolist()
        frames = [(pursuit.frames[i], flight and thumbnail(flight.frame_folder(i), STRIP_PX)) for i in places]
        whose = f"{one.name}: {title}: {', '.join(key)}"
        found.append({"title": whose, "ended": pursuit.ended, "seen": shares[key], "frames": frames})
    return found
