"""Multiples and percentages against a window: of the two numbers of a sentence, of the two speeds, of a series now and before."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

from caption.truth.prose.measured import Measured, picture_shares
from caption.truth.prose.statements import NOW, Statement

_ROUGH, _HEDGED = 0.08, 0.14  # shares of a multiple by which it may be off: "twice" of 1.9, "about twice" of 1.75
_ROUGH_PERCENT, _HEDGED_PERCENT = 0.04, 0.1


def ratio_holds(s: Statement, measured: Measured, read: dict[int, tuple[float, float]]) -> bool | None:
    """Judge a multiple or a percentage; None where nothing says of what it is, or where it holds of other frames.

    read: the value and half a unit of the last digit of each of its numbers and operands.
    """
    value, step = read[s.numbers[0]] if s.numbers else (s.value, 0.0)
    unit = 100.0 if s.kind == "percent" else 1.0
    if s.kind == "percent":
        slack = max(1.0, (_HEDGED_PERCENT if s.hedge else _ROUGH_PERCENT) * value) + step
    else:
        slack = min(step, 0.1 * value) + (_HEDGED if s.hedge else _ROUGH) * value
    if s.operands is not None:
        a, b = (read[i][0] for i in s.operands)
        if not a or not b:
            return None
        return any(_is_told(value, unit * ratio, slack, s.hedge) for ratio in _of_operands(s, a / b))
    if not s.names:
        shares = picture_shares(measured.facts)
        if any(_is_told(value, unit * share, slack, s.hedge) for share in shares):
            return True
        return False if s.word == "picture" and s.kind == "percent" else None
    found = list(_ratios(s, measured))
    if any(_is_told(value, unit * ratio, slack, s.hedge) for ratio in found):
        return True
    if found and s.names == ("speed_ratio",) and s.frames == (NOW,):
        return False  # of the two speeds now
    return (
        None
        if not found or any(abs(value - unit * ratio) <= slack for ratio in _at_other_frames(s, measured))
        else False
    )


def _is_told(told: float, true: float, slack: float, hedge: str) -> bool:
    if hedge == "more":
        return told - slack <= true <= 1.5 * told + slack
    if hedge == "less":
        return 0.7 * told - slack <= true <= told + slack
    return abs(told - true) <= slack


def _of_operands(s: Statement, ratio: float) -> Iterator[float]:
    """Yield how two numbers may be told: as a multiple; of a change also the other way round, and as what is left or lost.

    "from 20.0 m to 16.0 m, 20 percent", "peaked at 7.5 m/s and has halved to 3.7 m/s".
    """
    is_change = s.mode != "value"
    if s.kind == "percent" and is_change and s.trend and not s.is_ordered:
        low, high = min(ratio, 1.0 / ratio), max(ratio, 1.0 / ratio)
        if _is_added(s):
            yield 1.0 - low if s.trend < 0 else high - 1.0
            return
        yield from (low, 1.0 - low) if s.trend < 0 else (high, high - 1.0)
        return
    is_one_way = s.is_ordered and (s.kind == "percent" or not is_change)
    for told in (ratio,) if is_one_way else (ratio, 1.0 / ratio):
        if not _is_added(s):
            yield told
        if s.kind == "percent" or is_change:
            yield abs(told - 1.0)


def _is_added(s: Statement) -> bool:
    """Tell whether it is what was added or lost alone: "30 % lower"; "twice more" may be the multiple itself."""
    return s.mode == "change" and (s.kind == "percent" or 0.0 < s.value < 1.0)


def _with_share(s: Statement, ratio: float) -> Iterator[float]:
    """Yield a ratio, and what is added or lost where that may be told."""
    if not _is_added(s):
        yield ratio
    if s.mode != "value":
        yield abs(ratio - 1.0)


def _ways_round(s: Statement, ratio: float) -> Iterator[float]:
    """Yield the drone's speed over the target's, or the inverse, as it is told; both where nothing tells."""
    if s.side >= 0:
        yield ratio
    if s.side <= 0 and ratio:
        yield 1.0 / ratio


def _ratios(s: Statement, measured: Measured) -> Iterator[float]:
    """Yield what the words mean: the two speeds now, or a series now against its earlier frames."""
    for name in s.names:
        if name == "speed_ratio":
            for ratio in _of_speeds(measured, now=s.frames is not None):
                for true in _ways_round(s, ratio):
                    yield from _with_share(s, true)
            continue
        series = [abs(v) for v in measured.known(name)]
        if s.span is not None:
            first = next((v for v in measured.series(name)[s.span[0] :] if v is not None), None)
            series = [] if first is None else [abs(first), series[-1]]
        for before in series[:-1]:
            if before and series[-1] and s.trend * (series[-1] / before - 1.0) >= 0:
                yield from _with_share(s, series[-1] / before)


def _of_speeds(measured: Measured, *, now: bool) -> Iterator[float]:
    """Yield the drone's speed against the target's, now and (unless only that is meant) at other frames and over the window."""
    ours, theirs = measured.series("speed"), measured.series("target_speed")
    mean = measured.facts.target_speed_mps
    known = measured.known("speed")
    for i, v in enumerate(ours):
        if v is None or (now and i < len(ours) - 1):
            continue
        if i == len(ours) - 1 and mean:
            yield v / mean
        if theirs and (t := theirs[i]):
            yield v / t
    if mean and known and not now:
        yield sum(known) / len(known) / mean


def _at_other_frames(s: Statement, measured: Measured) -> Iterator[float]:
    """Yield ratios of the same series at any frames: of the two speeds the way round that is told, of one series either way."""
    for name in s.names:
        if name != "speed_ratio":
            if s.span is not None:
                continue
            for a, b in permutations([abs(v) for v in measured.known(name) if v], 2):
                yield from _with_share(s, a / b)
            continue
        ours = measured.known("speed")
        ours = [*ours, sum(ours) / len(ours)] if ours else []
        for a, b in product(ours, [*measured.known("target_speed"), *measured.known("target_mean")]):
            if b:
                for ratio in _ways_round(s, a / b):
                    yield from _with_share(s, ratio)
            elif a and s.side <= 0:
                yield from _with_share(s, 0.0)  # standing against flying
