"""Students side by side, of the folders of `cosfly fly`: `leaderboard.json` and a page that stands alone.

Only students that were to fly the same episodes stand in one table. Of those whose open-loop accuracy is told, the
table says how well it foretells closed-loop success.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cosfly.closed_loop.measures import (
    CONFIDENCE,
    MEASURES,
    RESAMPLES,
    SHARES,
    ratios,
    score_flights,
    walk_sums,
)
from cosfly.closed_loop.settings import FLOORS
from cosfly.errors import InputError
from cosfly.look.frame_views import thumbnail
from cosfly.look.page import page
from cosfly.products.figures import Figure, draw_walks, figure_of_draws, interval_of
from cosfly.products.flight_scores import FlightScore, Score, read_score
from cosfly.products.flights import find_flights
from cosfly.products.playback import Flight, read_flight
from cosfly.products.pursuits import Pursuit, PursuitFrame, pursuit_file, read_pursuit
from cosfly.reading.documents import FileFormat
from cosfly.work.chance import rng_for
from cosfly.work.config import Config
from cosfly.work.stage_folder import Resume, StageFolder, Tally
from cosfly.work.store import sha256_bytes, write_bytes, write_model
from distill.evaluation.measure import STUDENT, read_report
from distill.evaluation.pages import COLORS, STYLE, bars

LEAST_CHECKPOINTS = 8  # of fewer nothing is claimed: by chance alone 1 of 12 orders of 4 is one or its reverse
HEADLINE = ("success", "in_view", "tracked_frames", "kept_s", "lost", "crashed")
MOST_MAPS, STRIP_FRAMES, STRIP_PX = 6, 8, 200
BOARD_FORMAT = FileFormat("cosfly.leaderboard", "1.0", "leaderboard")


class LeaderboardConfig(Config):
    """`cosfly leaderboard`: nothing is set in files."""

    rounds: bool = False
    open_loop: dict[str, float] = Field(default_factory=dict)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Standing(_Strict):
    """One student in a table. open_loop: its share of right decisions where nothing is flown. gain: of a round, its
    figures less those of the round before on the same draws of walks."""

    name: str
    role: Literal["student", "floor", "ceiling"]
    score: Score
    open_loop: float | None = None
    gain: dict[str, Figure] | None = None


class Correlation(_Strict):
    """How the order by open-loop accuracy agrees with that by a closed-loop figure, over `checkpoints`; intervals by
    bootstrap over checkpoints and walks. All None where they are too few, or all alike."""

    figure: str
    checkpoints: int
    spearman: Figure
    kendall: Figure


class StudentTable(_Strict):
    """episodes: of each folder what was to be flown; the same of all students."""

    episodes: tuple[str, ...]
    standings: tuple[Standing, ...]
    correlations: tuple[Correlation, ...]


class Leaderboard(_Strict):
    """`leaderboard.json`."""

    tables: tuple[StudentTable, ...]


@dataclass
class _Flown:
    """Folders of one student."""

    folders: list[Path] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)


def run(
    cfg: LeaderboardConfig, folders: Sequence[tuple[str, Path]], out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read folders of `cosfly fly`, each with a name or ""; write `leaderboard.json` and `leaderboard.html`, whose path
    is given.

    Raises:
        InputError: two folders of one name hold the same episodes, or nobody is called as an accuracy says.
    """
    inputs = {f"{number}/{name}": folder for number, (name, folder) in enumerate(folders)}
    flown: dict[str, _Flown] = {}
    for name, folder in folders:
        score = read_score(folder)
        one = flown.setdefault(name or score.student, _Flown())
        if score.episodes_sha256 in {other.episodes_sha256 for other in one.scores}:
            fix, got = "name them: NAME=DIR", f"{name or score.student}: {folder}"
            raise InputError("two folders of one name hold the same episodes", got=got, fix=fix)
        one.folders.append(folder)
        one.scores.append(score)
    if unknown := sorted(cfg.open_loop.keys() - flown.keys()):
        raise InputError("nobody is called so", where="--open-loop", got=unknown[0], expected=", ".join(flown))
    stage = StageFolder.open(out, "leaderboard", config=cfg, inputs=inputs, seed=seed, resume=resume)
    path, record = out / "leaderboard.html", out / "leaderboard.json"
    if not stage.is_complete:
        board = Leaderboard(tables=tuple(tables_of(flown, cfg, seed)))
        write_model(record, board, BOARD_FORMAT)
        write_bytes(path, page_of(board, {name: one.folders for name, one in flown.items()}).encode())
        stage.finish([record, path], Tally(input=len(folders), kept=len(folders)))
    return path


def open_loop_of(folder: Path) -> float:
    """Give the share of right decisions that an evaluation of `distill evaluate` found; raises as `read_report`."""
    figure = read_report(folder).all.who[STUDENT].figures["accuracy"]
    if figure.value is None:
        raise InputError("no decision was judged", where=folder)
    return figure.value


def tables_of(flown: Mapping[str, _Flown], cfg: LeaderboardConfig, seed: int) -> list[StudentTable]:
    """Put those that were to fly the same into one table each, the best first, or rounds in their order."""
    groups: dict[tuple[str, ...], list[Standing]] = {}
    for name, one in flown.items():
        flights: list[FlightScore] = [flight for score in one.scores for flight in score.flights]
        digests, first = tuple(sorted(score.episodes_sha256 for score in one.scores)), one.scores[0]
        role: Any = "floor" if first.engine in FLOORS else "ceiling" if first.engine == "planner" else "student"
        towns = [score.trained_on for score in one.scores]
        together = score_flights(
            flights, first.student, first.engine, sha256_bytes(" ".join(digests).encode()), seed=seed,
            list_sha256=first.list_sha256 if len(one.scores) == 1 else None,
            trained_on=None if None in towns else sorted({town for known in towns for town in known or ()}),
        )  # fmt: skip
        group = groups.setdefault(digests, [])
        gain = gains(group[-1].score, together, seed) if cfg.rounds and group else None
        told = cfg.open_loop.get(name)
        group.append(Standing(name=name, role=role, score=together, open_loop=told, gain=gain))
    if not cfg.rounds:
        for group in groups.values():
            group.sort(key=lambda one: [-(one.score.figures[name].value or 0.0) for name in ("success", "in_view")])
    return [
        StudentTable(episodes=digests, standings=tuple(group), correlations=tuple(correlations(group, seed)))
        for digests, group in groups.items()
    ]


def gains(before: Score, after: Score, seed: int) -> dict[str, Figure]:
    """Give by how much figures changed from one to another who flew the same walks."""
    names = list(MEASURES)
    (walks, one), (_, other) = (walk_sums(score.flights, names) for score in (before, after))
    draws = draw_walks(len(walks), RESAMPLES, rng_for(seed, "leaderboard", "gains"))
    whole = ratios(np.ones((1, len(walks))), other)[0] - ratios(np.ones((1, len(walks))), one)[0]
    drawn = ratios(draws, other) - ratios(draws, one)
    return {
        name: figure_of_draws(float(whole[k]), drawn[:, k], len(walks), len(walks), CONFIDENCE)
        for k, name in enumerate(names)
    }


def correlations(group: Sequence[Standing], seed: int) -> list[Correlation]:
    """Correlate open-loop accuracy with success and with the share that shows the person, over who has both."""
    from scipy.stats import kendalltau, spearmanr

    known = [one for one in group if one.open_loop is not None]
    if not known:
        return []
    told, found, names = np.array([one.open_loop for one in known]), [], ("success", "in_view")
    sums = np.array([walk_sums(one.score.flights, names)[1] for one in known])  # (students, walks, figures, 2)
    rng, num = rng_for(seed, "leaderboard", "correlation"), len(known)
    draws = draw_walks(sums.shape[1], RESAMPLES, rng)
    drawn = np.array([ratios(draws, own) for own in sums])  # (students, draws, figures)
    whole = np.array([ratios(np.ones((1, sums.shape[1])), own)[0] for own in sums])
    chosen = rng.integers(num, size=(RESAMPLES, num))
    for k, name in enumerate(names):
        figures = []
        for statistic in (spearmanr, kendalltau):

            def of(x: np.ndarray, y: np.ndarray, statistic: Any = statistic) -> float:
                is_told = num >= LEAST_CHECKPOINTS and len(set(x)) > 1 and len(set(y)) > 1
                return float(statistic(x, y).statistic) if is_told else np.nan

            value = of(told, whole[:, k])
            again = [np.nan if np.isnan(value) else of(told[c], drawn[c, d, k]) for d, c in enumerate(chosen)]
            low, high = interval_of(np.array(again), CONFIDENCE)
            is_none = bool(np.isnan(value))
            figures.append(Figure(value=None if is_none else value, low=low, high=high, count=num))
        found.append(Correlation(figure=name, checkpoints=num, spearman=figures[0], kendall=figures[1]))
    return found


# --- the page ---------------------------------------------------------------------------------------------------------


def shown(name: str, figure: Figure, *, signed: bool = False) -> str:
    """Give a figure with its interval in words."""
    if figure.value is None:
        return "–"
    form = ("{:+.1%}" if signed else "{:.1%}") if name in SHARES else "{:+.2f}" if signed else "{:.2f}"
    ends = "" if figure.low is None else f" ({form.format(figure.low)} to {form.format(figure.high)})"
    return form.format(figure.value) + ends


def page_of(board: Leaderboard, folders: Mapping[str, Sequence[Path]]) -> str:
    """Give the page. folders: of each student, for its flights; one that has none is shown by its figures alone."""
    drawn = []
    for table in board.tables:
        names = [one.name for one in table.standings]
        pursuits = {name: _pursuits(folders[name]) for name in names}
        bar = {
            words: {one.name: one.score.figures[measure] for one in table.standings}
            for measure, words in (("success", "success"), ("in_view", "person seen"))
        }
        longest = max((len(p.flown) for own in pursuits.values() for p in own), default=0)
        curves = [
            ("Share of flights that show the person, by time, s", {n: _seen(p, longest) for n, p in pursuits.items()}),
            ("Median distance over ground, m, by time, s", {n: _distance(p, longest) for n, p in pursuits.items()}),
        ]
        drawn.append({
            "table": table, "bars": bars(bar), "curves": [_chart(title, own) for title, own in curves if longest],
            "maps": _maps(pursuits), "strips": [_strips(one, folders[one.name]) for one in table.standings],
        })  # fmt: skip
    return page(
        "cosfly/closed_loop/leaderboard.html", title="Closed loop", style=STYLE, tables=drawn, measures=MEASURES,
        headline=HEADLINE, shown=shown, colors=COLORS, least=LEAST_CHECKPOINTS,
    )  # fmt: skip


def _pursuits(folders: Sequence[Path]) -> list[Pursuit]:
    scores = [(folder, read_score(folder)) for folder in folders]
    paths = [pursuit_file(folder, flight.episode) for folder, score in scores for flight in score.flights]
    return [read_pursuit(path) for path in paths if path.is_file()]


def _seen(pursuits: Sequence[Pursuit], longest: int) -> list[tuple[float, float]]:
    """Of walks that go on so long the share whose frame shows the person."""
    points = []
    for k in range(longest):
        on = [p for p in pursuits if p.num_walk_frames > k]
        if on:
            points.append(((k + 1) * on[0].dt_s, sum(k < len(p.flown) and p.flown[k].visible for p in on) / len(on)))
    return points


def _distance(pursuits: Sequence[Pursuit], longest: int) -> list[tuple[float, float]]:
    points = []
    for k in range(longest):
        if on := [p for p in pursuits if len(p.flown) > k]:
            points.append(((k + 1) * on[0].dt_s, float(np.median([p.flown[k].distance_m for p in on]))))
    return points


def _chart(title: str, lines: Mapping[str, Sequence[tuple[float, float]]]) -> dict[str, Any]:
    """Give lines on axes that begin at zero, 620 by 220 px."""
    most = np.array([point for line in lines.values() for point in line]).max(axis=0)
    digits = 0 if most[1] >= 10 else 2
    ticks = [
        (46 + 560 * i / 4, 206 - 190 * i / 4, f"{most[0] * i / 4:.0f}", f"{most[1] * i / 4:.{digits}f}")
        for i in range(5)
    ]
    scaled = {n: [(46 + 560 * x / most[0], 206 - 190 * y / max(most[1], 1e-9)) for x, y in p] for n, p in lines.items()}
    return {"title": title, "ticks": ticks, "lines": {name: _points(line) for name, line in scaled.items()}}


def _points(places: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)


def _maps(pursuits: Mapping[str, Sequence[Pursuit]]) -> list[dict[str, Any]]:
    """Draw from above, north up, the walks on which students differ most: the person's way and all flights."""
    of: dict[tuple[str, str], dict[str, Pursuit]] = {}
    for name, own in pursuits.items():
        for one in own:
            of.setdefault((one.town, one.episode), {})[name] = one
    spread = {key: np.ptp([len(one.flown) for one in own.values()]) for key, own in of.items()}
    found = []
    for key in sorted(of, key=lambda key: (-spread[key], key))[:MOST_MAPS]:
        ways = {name: np.array([frame.pose[:2] for frame in one.frames]) for name, one in of[key].items()}
        longest = max(of[key].values(), key=lambda one: len(one.frames))
        walk = np.array([frame.target_m[:2] for frame in longest.frames])
        low, high = (end(np.concatenate([walk, *ways.values()]), axis=0) for end in (np.min, np.max))
        scale = 300 / max(float((high - low).max()), 1.0)

        def px(way: np.ndarray, west: Any = low[0], north: Any = high[1], scale: float = scale) -> str:
            return _points([(10 + (x - west) * scale, 10 + (north - y) * scale) for x, y in way.tolist()])

        size = (high - low) * scale + 20
        lines = {name: px(way) for name, way in ways.items()}
        title = f"{key[0]}, {key[1]}; 10 m: "
        found.append({"title": title, "size": size.tolist(), "walk": px(walk), "lines": lines, "bar": 10 * scale})
    return found


def _strips(one: Standing, folders: Sequence[Path]) -> dict[str, Any]:
    """Give the best and the worst flight of a student, by how much of the walk shows the person: frames and words."""
    ranked = sorted(one.score.flights, key=lambda f: (f.sums["in_view"][0] / f.sums["in_view"][1], f.episode))
    found = []
    for title, flight in (("best", ranked[-1]), ("worst", ranked[0])):
        for folder in folders:
            path = pursuit_file(folder, flight.episode)
            if path.is_file() and (pursuit := read_pursuit(path)).town == flight.town:
                places = np.unique(np.linspace(pursuit.num_lead, len(pursuit.frames) - 1, STRIP_FRAMES).astype(int))
                tree = _flight_of(folder / "render", pursuit)
                frames = [_frame(pursuit.frames[i], tree, i) for i in places.tolist()]
                seen = flight.sums["in_view"][0] / flight.sums["in_view"][1]
                found.append({"title": title, "flight": flight, "seen": seen, "frames": frames})
                break
    return {"name": one.name, "flights": found}


def _frame(frame: PursuitFrame, tree: Flight | None, i: int) -> tuple[PursuitFrame, str | None]:
    return frame, None if tree is None else thumbnail(tree.frame_folder(i), STRIP_PX)


def _flight_of(tree: Path, pursuit: Pursuit) -> Flight | None:
    flights = map(read_flight, find_flights(tree)) if tree.is_dir() else iter(())
    return next((one for one in flights if one.source.get("scenario_id") == pursuit.walk), None)
