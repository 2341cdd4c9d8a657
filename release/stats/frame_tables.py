"""Tables of weather, light and perturbation, frame by frame."""

from __future__ import annotations

from collections import Counter

from cosfly.products.weather import TIMES, WEATHERS, preset_token
from release.stats.cells import SPREAD, percent, spread_row
from release.stats.counting import Counts
from release.stats.schema import Cell, Table


def weather(counts: Counts) -> list[Table]:
    """Frames by preset and time of day: no table where no frame names one, and sun and air where the frames tell these."""
    tables = []
    named = Counter(
        {
            (_token(weather), _token(time)): n
            for (weather, time), n in counts.weather.items()
            if weather is not None or time is not None
        }
    )
    if named:
        presets = list(WEATHERS)
        presets += sorted({weather for weather, _ in named} - set(presets))
        times = [*TIMES, *sorted({time for _, time in named} - set(TIMES))]
        rows: list[list[Cell]] = [[preset, *(named[preset, time] for time in times)] for preset in presets]
        note = f"Frames. Presets of the paper are all listed; {len(named)} of {len(presets) * len(times)} pairs are in this release."
        tables.append(
            Table(
                key="weather",
                title="Weather and time of day",
                paper="tab:weather_coverage",
                note=note,
                head=["preset", *times],
                rows=rows,
                plot="heat",
            )
        )
    if counts.looks:
        rows = [[look, count] for look, count in counts.looks.most_common(40)]
        tables.append(
            Table(
                key="looks",
                title="Sun and air",
                note="Of the renderer's own settings.",
                head=["look", "frames"],
                rows=rows,
            )
        )
    return tables


def _token(text: str | None) -> str:
    return "not told" if text is None else preset_token(text)


def perturbation(counts: Counts) -> list[Table]:
    tables = []
    total = counts.states.total()
    if total:
        order = ("unperturbed", "position only", "rotation only", "full")
        rows: list[list[Cell]] = [
            [state, counts.states[state], percent(counts.states[state], total)] for state in order
        ]
        note = "Frames of perturbed flights by what of their recorded offsets is not zero: after fallbacks, so fewer are perturbed than were drawn."
        tables.append(
            Table(
                key="augmentation_states",
                title="Perturbation",
                paper="tab:augmentation_states",
                note=note,
                head=["state", "frames", "%"],
                rows=rows,
                plot="bars",
            )
        )
        names = [name for name in counts.over_frames if name.endswith((", m", ", deg"))]
        spreads = [spread_row(name, counts.over_frames[name].spread()) for name in names]
        tables.append(
            Table(
                key="offsets", title="Size of the offsets", note="Where they are not zero.", head=SPREAD, rows=spreads
            )
        )
    if counts.events:
        rows = [[track, event, outcome, count] for (track, event, outcome), count in sorted(counts.events.items())]
        tables.append(
            Table(
                key="events",
                title="What became of each perturbation",
                paper="sec:exp_zoom",
                head=["track", "event", "outcome", "frames"],
                rows=rows,
            )
        )
    return tables
