"""`cosfly leaderboard`: compares students by folders of `cosfly fly`; writes `leaderboard.json` and a page.

A table contains only students with the same episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosfly.closed_loop.measures import MEASURES, SHARES, figures_of, score_measured
from cosfly.closed_loop.settings import BASELINES
from cosfly.formats.episodes import Figure, Score, episode_file, read_episode, read_score
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes, write_bytes
from cosfly.runtime.json_io import FileFormat, Record, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page
from distill.evaluation.pages import COLORS, STYLE, bars, shown_as

HEADLINE = ("success", "in_view", "tracked_frames", "kept_s", "lost", "crashed")
STRIP_FRAMES, STRIP_PX = 8, 200
BOARD_FORMAT = FileFormat("cosfly.leaderboard", "1.0", "leaderboard")


class LeaderboardConfig(Config):
    """Settings of `cosfly leaderboard`, given as options."""

    rounds: bool = False


class Standing(Record):
    """One student of a table. gain: of a round, the change of its figures from the round before."""

    name: str
    role: Literal["student", "floor", "ceiling"]
    score: Score
    gain: dict[str, Figure] | None = None


class StudentTable(Record):
    """Students with the same episodes. episodes: digest of each folder's episodes."""

    episodes: tuple[str, ...]
    standings: tuple[Standing, ...]


class Leaderboard(Record):
    """`leaderboard.json`."""

    tables: tuple[StudentTable, ...]


StudentFolders = dict[Path, Score]  # the folders of one student


def run(
    cfg: LeaderboardConfig, folders: Sequence[tuple[str, Path]], out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read named folders of `cosfly fly`; write `leaderboard.json` and `leaderboard.html`, and return the page's path.

    Args:
        folders: name and folder; "" names it after its student.
    Raises:
        InputError: Two folders of one name contain the same episode.
    """
    students: dict[str, StudentFolders] = {}
    for name, folder in folders:
        score = read_score(folder)
        own = students.setdefault(name or score.student, {})
        known = {(one.town, one.episode) for other in own.values() for one in other.flights}
        if twice := [one for one in score.flights if (one.town, one.episode) in known]:
            what, got = "two folders of one name contain the same episode", f"{twice[0].town}, {twice[0].episode}"
            raise InputError(what, where=f"{name or score.student}: {folder}", got=got, fix="name them: NAME=DIR")
        own[folder] = score
    inputs = {f"{number}/{name}": folder for number, (name, folder) in enumerate(folders)}
    stage = StageFolder.open(out, "leaderboard", config=cfg, inputs=inputs, seed=seed, resume=resume)
    path, record = out / "leaderboard.html", out / "leaderboard.json"
    if not stage.is_complete:
        board = Leaderboard(tables=tuple(tables_of(students, cfg, seed)))
        write_model(record, board, BOARD_FORMAT)
        write_bytes(path, page_of(board, students).encode())
        stage.finish([record, path], Tally(input=len(folders), kept=len(folders)))
    return path


def tables_of(students: Mapping[str, StudentFolders], cfg: LeaderboardConfig, seed: int) -> list[StudentTable]:
    """Return one table for each set of episodes, sorted by success, or by round."""
    groups: dict[tuple[str, ...], list[Standing]] = {}
    for name, own in students.items():
        scores = list(own.values())
        digests, first = tuple(sorted(score.episodes_sha256 for score in scores)), scores[0]
        role: Any = "floor" if first.engine in BASELINES else "ceiling" if first.engine == "planner" else "student"
        towns = [score.trained_on for score in scores]
        merged = score_measured(
            [one for score in scores for one in score.flights], seed, student=first.student, engine=first.engine,
            episodes_sha256=sha256_bytes(" ".join(digests).encode()),
            list_sha256=first.list_sha256 if len(scores) == 1 else None,
            trained_on=None if None in towns else sorted({town for known in towns for town in known or ()}),
        )  # fmt: skip
        group, gain = groups.setdefault(digests, []), None
        if cfg.rounds and group:
            gain = figures_of(merged.flights, rng_for(seed, "leaderboard", "gains"), group[-1].score.flights)
        group.append(Standing(name=name, role=role, score=merged, gain=gain))
    if not cfg.rounds:
        for group in groups.values():
            group.sort(key=lambda one: [-(one.score.figures[name].value or 0.0) for name in ("success", "in_view")])
    return [StudentTable(episodes=digests, standings=tuple(group)) for digests, group in groups.items()]


# --- the page ---------------------------------------------------------------------------------------------------------


def _shown(name: str, figure: Figure, *, signed: bool = False) -> str:
    return shown_as(f"{{:{'+' * signed}{'.1%' if name in SHARES else '.2f'}}}", figure)


def page_of(board: Leaderboard, students: Mapping[str, StudentFolders]) -> str:
    """Return the page; a student whose episodes were deleted has figures but no pictures."""
    tables = []
    for table in board.tables:
        drawn = {"success": "success", "target visible": "in_view"}
        groups = {w: {one.name: one.score.figures[name] for one in table.standings} for w, name in drawn.items()}
        strips = [strip for one in table.standings for strip in _strips(one, students[one.name])]
        tables.append({"table": table, "chart": bars(groups), "strips": strips})
    return page(
        "cosfly/closed_loop/leaderboard.html", title="Closed loop", style=STYLE, tables=tables, measures=MEASURES,
        headline=HEADLINE, shown=_shown, colors=COLORS, width_px=STRIP_PX,
    )  # fmt: skip


def _strips(standing: Standing, own: StudentFolders) -> list[dict[str, Any]]:
    """Return frames of the episodes with the largest and smallest share of frames with a visible target."""
    places = {(one.town, one.episode): folder for folder, score in own.items() for one in score.flights}
    shares = {(one.town, one.episode): one.sums["in_view"] for one in standing.score.flights}
    ranked, strips = sorted(shares, key=lambda key: (shares[key][0] / shares[key][1], key[1])), []
    for title, key in (("best", ranked[-1]), ("worst", ranked[0])):
        path, tree = episode_file(places[key], key[1]), places[key] / "render"
        if not path.is_file():
            continue
        record = read_episode(path)
        tracks = (read_track(folder) for folder in find_tracks(tree)) if tree.is_dir() else ()
        track = next((one for one in tracks if one.source.get("scenario_id") == record.walk), None)
        chosen = np.unique(np.linspace(record.num_lead, len(record.frames) - 1, STRIP_FRAMES).astype(int)).tolist()
        frames = [(record.frames[i], track and thumbnail(track.frame_folder(i), STRIP_PX)) for i in chosen]
        name, seen = f"{standing.name}: {title}: {', '.join(key)}", shares[key][0] / shares[key][1]
        strips.append({"title": name, "ended": record.ended, "seen": seen, "frames": frames})
    return strips
