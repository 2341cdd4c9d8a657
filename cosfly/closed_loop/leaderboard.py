"""`cosfly leaderboard`: compares students by folders of `cosfly fly`; writes `leaderboard.json` and a page.

A table contains only students with the same episodes.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

from cosfly.closed_loop.measures import MEASURES, SHARES
from cosfly.closed_loop.settings import BASELINES
from cosfly.formats.episodes import Figure, Score, read_score
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model
from cosfly.runtime.run_dir import StageFolder, Tally
from cosfly.viz.page import page
from cosfly.viz.tables import TextTable

Role = Literal["student", "floor", "ceiling"]
RANKED_BY = ("success", "visible")
SUMMARY = {"success": "success", "visible": "target visible", "crashed": "crashed"}  # in the terminal
HEADLINE = ("success", "visible", "tracked_frames", "kept_s", "lost", "crashed")
BOARD_FORMAT = FileFormat("cosfly.leaderboard", "3.0", "leaderboard")


class Standing(Record):
    """One student of a table."""

    name: str
    role: Role
    score: Score


class StudentTable(Record):
    """Students with the same episodes."""

    episodes_sha256: str
    standings: tuple[Standing, ...]


class Leaderboard(Record):
    """`leaderboard.json`."""

    tables: tuple[StudentTable, ...]


def run(folders: Sequence[tuple[str, Path]], out: Path) -> Path:
    """Read named folders of `cosfly fly`; write `leaderboard.json` and `leaderboard.html`, and return the page's path.

    Args:
        folders: Name and folder; with the name "" the folder is named after its student.
    """
    scores = [read_score(folder) for _, folder in folders]
    students = [(name or score.student, score) for (name, _), score in zip(folders, scores, strict=True)]
    inputs = {f"{number}/{name}": folder for number, (name, folder) in enumerate(folders)}
    stage = StageFolder.open(out, "leaderboard", config=Config(), inputs=inputs, seed=0)
    path = out / "leaderboard.html"
    record = out / "leaderboard.json"
    if not stage.is_complete:
        board = Leaderboard(tables=tuple(tables_of(students)))
        write_model(record, board, BOARD_FORMAT)
        write_bytes(path, page_of(board).encode())
        stage.finish([record, path], Tally(input=len(folders), kept=len(folders)))
    return path


def tables_of(students: Sequence[tuple[str, Score]]) -> list[StudentTable]:
    """Return one table for each set of episodes, sorted by success."""
    groups: dict[str, list[Standing]] = {}
    for name, score in students:
        group = groups.setdefault(score.episodes_sha256, [])
        if name in (standing.name for standing in group):
            fix = "give each student its own name: NAME=DIR"
            raise InputError("two students in one table have the same name", where="leaderboard", got=name, fix=fix)
        role: Role = "ceiling" if score.engine == "planner" else "student"
        if score.engine in BASELINES:
            role = "floor"
        group.append(Standing(name=name, role=role, score=score))
    for group in groups.values():
        group.sort(key=lambda row: [row.score.figures[name].value or 0.0 for name in RANKED_BY], reverse=True)
    return [StudentTable(episodes_sha256=digest, standings=tuple(group)) for digest, group in groups.items()]


def summary_tables(page_path: Path) -> Iterator[TextTable]:
    """Yield the most important figures of a leaderboard, one table for each list of episodes."""
    board = read_model(page_path.with_suffix(".json"), Leaderboard, BOARD_FORMAT)
    for table in board.tables:
        rows = []
        for one in table.standings:
            most = one.score.most_decisions
            shortened = f" (at most {most} decisions)" if most else ""
            rows.append([one.name + shortened, *(_shown(name, one.score.figures[name]) for name in SUMMARY)])
        yield TextTable(f"{len(table.standings[0].score.flights)} episodes", ["", *SUMMARY.values()], rows)


# --- the page ---------------------------------------------------------------------------------------------------------


def _shown(name: str, figure: Figure) -> str:
    return figure.shown(".1%" if name in SHARES else ".2f")


def page_of(board: Leaderboard) -> str:
    """Return the page."""
    return page(
        "cosfly/closed_loop/leaderboard.html", title="Closed loop", tables=board.tables, measures=MEASURES,
        headline=HEADLINE, shown=_shown,
    )  # fmt: skip
