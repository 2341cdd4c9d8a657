"""`cosfly leaderboard`: compares students by folders of `cosfly fly`; writes `leaderboard.json` and a page.

A table contains only students with the same episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from cosfly.closed_loop.measures import MEASURES, SHARES, figures_of, score_measured
from cosfly.closed_loop.settings import BASELINES
from cosfly.formats.episodes import Figure, Score, read_score
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes, write_bytes
from cosfly.runtime.json_io import FileFormat, Record, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.seeding import rng_for
from cosfly.viz.page import page
from distill.evaluation.pages import COLORS, STYLE, bars, shown_as

Role = Literal["student", "floor", "ceiling"]
RANKED_BY = ("success", "in_view")
HEADLINE = ("success", "in_view", "tracked_frames", "kept_s", "lost", "crashed")
BOARD_FORMAT = FileFormat("cosfly.leaderboard", "1.0", "leaderboard")


class LeaderboardConfig(Config):
    """Settings of `cosfly leaderboard`, given as options."""

    rounds: bool = False  # the students are rounds of one student, in order


class Standing(Record):
    """One student of a table."""

    name: str
    role: Role
    score: Score
    gain: dict[str, Figure] | None = None  # of a round: the change of its figures since the previous round


class StudentTable(Record):
    """Students with the same episodes."""

    episodes: tuple[str, ...]  # digest of the episodes of each folder
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
        folders: Name and folder; with the name "" the folder is named after its student.
    """
    students: dict[str, StudentFolders] = {}
    for name, folder in folders:
        score = read_score(folder)
        student = name or score.student
        scores = students.setdefault(student, {})
        earlier = {(flight.town, flight.episode) for other in scores.values() for flight in other.flights}
        for flight in score.flights:
            if (flight.town, flight.episode) in earlier:
                raise InputError(
                    "two folders of the same student contain the same episode",
                    where=f"{student}: {folder}",
                    got=f"{flight.town}, {flight.episode}",
                    fix="give each folder its own name: NAME=DIR",
                )
        scores[folder] = score
    inputs = {f"{number}/{name}": folder for number, (name, folder) in enumerate(folders)}
    stage = StageFolder.open(out, "leaderboard", config=cfg, inputs=inputs, seed=seed, resume=resume)
    path = out / "leaderboard.html"
    record = out / "leaderboard.json"
    if not stage.is_complete:
        board = Leaderboard(tables=tuple(tables_of(students, cfg, seed)))
        write_model(record, board, BOARD_FORMAT)
        write_bytes(path, page_of(board).encode())
        stage.finish([record, path], Tally(input=len(folders), kept=len(folders)))
    return path


def tables_of(students: Mapping[str, StudentFolders], cfg: LeaderboardConfig, seed: int) -> list[StudentTable]:
    """Return one table for each set of episodes, sorted by success, or by round."""
    groups: dict[tuple[str, ...], list[Standing]] = {}
    for name, folders in students.items():
        scores = list(folders.values())
        digests = tuple(sorted(score.episodes_sha256 for score in scores))
        merged = _merged_score(scores, digests, seed)
        group = groups.setdefault(digests, [])
        gain = None
        if cfg.rounds and group:
            gain = figures_of(merged.flights, rng_for(seed, "leaderboard", "gains"), group[-1].score.flights)
        role: Role = "ceiling" if merged.engine == "planner" else "student"
        if merged.engine in BASELINES:
            role = "floor"
        group.append(Standing(name=name, role=role, score=merged, gain=gain))
    if not cfg.rounds:
        for group in groups.values():
            group.sort(key=lambda row: [row.score.figures[name].value or 0.0 for name in RANKED_BY], reverse=True)
    return [StudentTable(episodes=digests, standings=tuple(group)) for digests, group in groups.items()]


def _merged_score(scores: list[Score], digests: tuple[str, ...], seed: int) -> Score:
    """Return the score of one student over all its folders; `trained_on` is known only if all of them know it."""
    first = scores[0]
    trained_on = None
    if all(score.trained_on is not None for score in scores):
        trained_on = sorted({town for score in scores for town in score.trained_on or ()})
    return score_measured(
        [flight for score in scores for flight in score.flights],
        seed,
        student=first.student,
        engine=first.engine,
        episodes_sha256=sha256_bytes(" ".join(digests).encode()),
        list_sha256=first.list_sha256 if len(scores) == 1 else None,
        trained_on=trained_on,
    )


# --- the page ---------------------------------------------------------------------------------------------------------


def _shown(name: str, figure: Figure, *, signed: bool = False) -> str:
    digits = ".1%" if name in SHARES else ".2f"
    return shown_as(f"{{:+{digits}}}" if signed else f"{{:{digits}}}", figure)


def page_of(board: Leaderboard) -> str:
    """Return the page."""
    tables = []
    for table in board.tables:
        chart = {
            title: {standing.name: standing.score.figures[measure] for standing in table.standings}
            for title, measure in (("success", "success"), ("target visible", "in_view"))
        }
        tables.append({"table": table, "chart": bars(chart)})
    return page(
        "cosfly/closed_loop/leaderboard.html", title="Closed loop", style=STYLE, tables=tables, measures=MEASURES,
        headline=HEADLINE, shown=_shown, colors=COLORS,
    )  # fmt: skip
