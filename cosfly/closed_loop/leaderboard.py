"""Students side by side, of the folders of `cosfly fly`: `leaderboard.json` and a page that stands alone.

Only students that were to fly the same episodes stand in one table. Of those whose open-loop accuracy is told, the
table says how well it foretells closed-loop success.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cosfly.closed_loop.measures import (
    CONFIDENCE,
    MEASURES,
    RESAMPLES,
    SHARES,
    draws_of,
    figures_of,
    ratios,
    score_flights,
    walk_sums,
)
from cosfly.closed_loop.settings import FLOORS
from cosfly.errors import InputError
from cosfly.look.frame_views import thumbnail
from cosfly.look.page import page
from cosfly.look.topview import TopView
from cosfly.products.figures import Figure, figure_of_draws
from cosfly.products.flight_scores import Score, read_score
from cosfly.products.flights import find_flights
from cosfly.products.playback import read_flight
from cosfly.products.pursuits import Pursuit, pursuit_file, read_pursuit
from cosfly.reading.documents import FileFormat
from cosfly.work.chance import rng_for
from cosfly.work.config import Config
from cosfly.work.stage_folder import Resume, StageFolder, Tally
from cosfly.work.store import sha256_bytes, write_bytes, write_model
from distill.evaluation.measure import STUDENT, read_report
from distill.evaluation.pages import COLORS, STYLE, Chart, bars, color_of, shown_as

LEAST_CHECKPOINTS = 8  # of fewer nothing is claimed: by chance alone 1 of 12 orders of 4 is one or its reverse
HEADLINE = ("success", "in_view", "tracked_frames", "kept_s", "lost", "crashed")
FORETOLD = ("success", "in_view")
MOST_MAPS, MAP_PX, STRIP_FRAMES, STRIP_PX = 6, 320, 8, 200
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
    """How the order by open-loop accuracy agrees with that by a closed-loop figure, over checkpoints; intervals by
    bootstrap over checkpoints and walks. All None where they are too few, or all alike."""

    figure: str
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


Flown = dict[Path, Score]  # the folders of one student


def run(
    cfg: LeaderboardConfig, folders: Sequence[tuple[str, Path]], out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> Path:
    """Read folders of `cosfly fly`, each with a name or ""; write `leaderboard.json` and `leaderboard.html`, whose path
    is given.

    Raises:
        InputError: two folders of one name hold the same episode, or nobody is called as an accuracy says.
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
    if unknown := sorted(cfg.open_loop.keys() - flown.keys()):
        raise InputError("nobody is called so", where="--open-loop", got=unknown[0], expected=", ".join(flown))
    stage = StageFolder.open(out, "leaderboard", config=cfg, inputs=inputs, seed=seed, resume=resume)
    path, record = out / "leaderboard.html", out / "leaderboard.json"
    if not stage.is_complete:
        board = Leaderboard(tables=tuple(tables_of(flown, cfg, seed)))
        write_model(record, board, BOARD_FORMAT)
        write_bytes(path, page_of(board, flown).encode())
        stage.finish([record, path], Tally(input=len(folders), kept=len(folders)))
    return path


def open_loop_of(folder: Path) -> float:
    """Give the share of right decisions that an evaluation of `distill evaluate` found; raises as `read_report`."""
    figure = read_report(folder).all.who[STUDENT].figures["accuracy"]
    if figure.value is None:
        raise InputError("no decision was judged", where=folder)
    return figure.value


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
    (walks, one), (_, other) = (walk_sums(score.flights, list(MEASURES)) for score in (before, after))
    draws = draws_of(len(walks), rng_for(seed, "leaderboard", "gains"))
    return figures_of(ratios(draws, other) - ratios(draws, one), [len(walks)] * len(MEASURES), len(walks))


def correlations(group: Sequence[Standing], seed: int) -> list[Correlation]:
    """Correlate open-loop accuracy with success and with the share that shows the person, over who has both."""
    from scipy.stats import kendalltau, spearmanr

    known = [one for one in group if one.open_loop is not None]
    if not known:
        return []
    told, num = np.array([one.open_loop for one in known]), len(known)
    sums = [walk_sums(one.score.flights, FORETOLD)[1] for one in known]
    rng = rng_for(seed, "leaderboard", "correlation")
    draws = draws_of(len(sums[0]), rng)
    found = np.array([ratios(draws, own) for own in sums])  # (students, draws, figures)
    chosen = np.vstack([np.arange(num), rng.integers(num, size=(RESAMPLES, num))])

    def figure(statistic: Any, k: int) -> Figure:
        values = np.full(len(chosen), np.nan)
        for draw, c in enumerate(chosen if num >= LEAST_CHECKPOINTS else ()):
            x, y = told[c], found[c, draw, k]
            if len(set(x)) > 1 and len(set(y)) > 1:
                values[draw] = statistic(x, y).statistic
        return figure_of_draws(float(values[0]), values[1:], num, num, CONFIDENCE)

    return [
        Correlation(figure=name, spearman=figure(spearmanr, k), kendall=figure(kendalltau, k))
        for k, name in enumerate(FORETOLD)
    ]


# --- the page ---------------------------------------------------------------------------------------------------------


def shown(name: str, figure: Figure, *, signed: bool = False) -> str:
    """Give a figure with its interval in words."""
    sign, digits = "+" if signed else "", ".1%" if name in SHARES else ".2f"
    return shown_as(f"{{:{sign}{digits}}}", figure)


Pursuits = dict[tuple[str, str], tuple[Pursuit, Path]]  # by town and episode, and the folder of each


def page_of(board: Leaderboard, flown: Mapping[str, Flown]) -> str:
    """Give the page; a student whose folders have no flights any more is shown by its figures alone."""
    drawn = []
    for table in board.tables:
        standings = table.standings
        own = {one.name: _pursuits(flown[one.name]) for one in standings}
        groups = {
            words: {one.name: one.score.figures[measure] for one in standings}
            for measure, words in (("success", "success"), ("in_view", "person seen"))
        }
        charts = [("Success, and frames that show the person", bars(groups))]
        if any(own.values()):
            over_time = [_over_time([pursuit for pursuit, _ in one.values()]) for one in own.values()]
            titles = "Share of flights that show the person, by time, s", "Median distance over ground, m, by time, s"
            lines = [dict(zip(own, curves, strict=True)) for curves in zip(*over_time, strict=True)]
            charts += [(title, _curves(line)) for title, line in zip(titles, lines, strict=True)]
        strips = [strip for one in standings for strip in _strips(one, own[one.name])]
        drawn.append({"table": table, "charts": charts, "maps": _maps(own), "strips": strips})
    return page(
        "cosfly/closed_loop/leaderboard.html", title="Closed loop", style=STYLE, tables=drawn, measures=MEASURES,
        headline=HEADLINE, shown=shown, colors=COLORS, least=LEAST_CHECKPOINTS, width_px=STRIP_PX,
    )  # fmt: skip


def _pursuits(own: Flown) -> Pursuits:
    flights = [(folder, flight) for folder, score in own.items() for flight in score.flights]
    paths = [(folder, flight, pursuit_file(folder, flight.episode)) for folder, flight in flights]
    return {(one.town, one.episode): (read_pursuit(path), folder) for folder, one, path in paths if path.is_file()}


Curve = list[tuple[float, float]]


def _over_time(pursuits: Sequence[Pursuit]) -> tuple[Curve, Curve]:
    """Give, of walks that go on so long, the share whose frame shows the person, and of those that are still flown the
    median distance."""
    seen, distances, flown = [], [], [(one.num_walk_frames, one.flown) for one in pursuits]
    for k in range(max((num for num, _ in flown), default=0)):
        time_s, frames = (k + 1) * pursuits[0].dt_s, [frames[k] for _, frames in flown if k < len(frames)]
        seen.append((time_s, sum(frame.visible for frame in frames) / sum(num > k for num, _ in flown)))
        if frames:
            distances.append((time_s, float(np.median([frame.distance_m for frame in frames]))))
    return seen, distances


def _curves(lines: Mapping[str, Curve]) -> Chart:
    """Give lines on axes that begin at zero, 620 by 226 px; names -> line."""
    most = np.maximum(np.max([point for line in lines.values() for point in line], axis=0), 1e-9)
    low, size = np.array([46.0, 206.0]), np.array([560.0, -190.0])
    axes, texts, digits = [], [], 0 if most[1] >= 10 else 2
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        (x, y), (time_s, value) = (low + share * size).tolist(), share * most
        axes.append({"x1": 46, "x2": 606, "y1": y, "y2": y, "kind": "axis"})
        texts.append({"x": 40, "y": y + 4, "words": f"{value:.{digits}f}", "anchor": "end"})
        texts.append({"x": x, "y": 222, "words": f"{time_s:.0f}", "anchor": "middle"})
    ways = [
        _way(name, low + np.array(line) / most * size, color_of(number))
        for number, (name, line) in enumerate(lines.items())
        if line
    ]
    places = {"view": "0 0 620 226", "width": 620}
    return {"names": list(lines), "lines": axes, "rects": [], "texts": texts, "ways": ways, **places}


def _maps(own: Mapping[str, Pursuits]) -> list[tuple[str, Chart]]:
    """Draw the walks on which students differ most."""
    of: dict[tuple[str, str], dict[str, Pursuit]] = {}
    for name, pursuits in own.items():
        for key, (pursuit, _) in pursuits.items():
            of.setdefault(key, {})[name] = pursuit
    spread = {key: np.ptp([len(one.flown) for one in flights.values()]) for key, flights in of.items()}
    colors = {name: color_of(number) for number, name in enumerate(own)}
    keys = sorted(of, key=lambda key: (-spread[key], key))[:MOST_MAPS]
    return [(", ".join(key), _map(of[key], colors)) for key in keys]


def _map(flights: Mapping[str, Pursuit], colors: Mapping[str, str]) -> Chart:
    """Draw flights from above, north up, and the person's way."""
    longest = max(flights.values(), key=lambda one: len(one.frames))
    walk = np.array([frame.target_m[:2] for frame in longest.frames])
    ways = {name: np.array([frame.pose[:2] for frame in one.frames]) for name, one in flights.items()}
    view = TopView.around(np.concatenate([walk, *ways.values()]), MAP_PX)
    (width, height), (x, y) = view.size_px, view.pixels(walk[:1])[0].tolist()
    start = {"x": x - 5, "y": y - 5, "width": 10, "height": 10, "fill": "var(--faint)", "title": "start of the walk"}
    bar = {"x": 0, "y": height + 14, "width": 10 * view.pixels_per_m, "height": 3, "fill": "var(--soft)", "title": ""}
    drawn = [_way("the person", view.pixels(walk), "var(--faint)", dashes="5 4")]
    drawn += [_way(name, view.pixels(way), colors[name]) for name, way in ways.items()]
    texts = [{"x": 0, "y": height + 10, "words": "10 m", "anchor": "start"}]
    places = {"view": f"0 0 {width} {height + 18}", "width": width}
    return {"names": [], "lines": [], "rects": [start, bar], "texts": texts, "ways": drawn, **places}


def _way(title: str, places: np.ndarray, stroke: str, dashes: str = "none") -> dict[str, str]:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places.tolist())
    return {"title": title, "points": points, "stroke": stroke, "dashes": dashes}


def _strips(one: Standing, own: Pursuits) -> list[dict[str, Any]]:
    """Give the best and the worst flight of a student, by how much of the walk shows the person: frames and words."""
    shares = {(f.town, f.episode): f.sums["in_view"][0] / f.sums["in_view"][1] for f in one.score.flights}
    ranked, found = sorted(shares, key=lambda key: (shares[key], key[1])), []
    for title, key in (("best", ranked[-1]), ("worst", ranked[0])):
        if key not in own:
            continue
        pursuit, folder = own[key]
        tree = folder / "render"
        drawn = (read_flight(path) for path in find_flights(tree)) if tree.is_dir() else ()
        flight = next((one for one in drawn if one.source.get("scenario_id") == pursuit.walk), None)
        places = np.unique(np.linspace(pursuit.num_lead, len(pursuit.frames) - 1, STRIP_FRAMES).astype(int)).tolist()
        frames = [(pursuit.frames[i], flight and thumbnail(flight.frame_folder(i), STRIP_PX)) for i in places]
        whose = f"{one.name}: {title}: {', '.join(key)}"
        found.append({"title": whose, "ended": pursuit.ended, "seen": shares[key], "frames": frames})
    return found
