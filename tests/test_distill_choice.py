"""distill/prepare/choice.py: which windows stay."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosfly.products.actions import action_tokens
from distill.prepare.choice import Ranks, cost_of, limit_to


def windows_of(counts: dict[str, int]) -> list[tuple[str, str]]:
    """Name as many windows of each decision: (decision, sample_id)."""
    return [(decision, f"{decision}_{i}") for decision, count in counts.items() for i in range(count)]


def kept(windows: list[tuple[str, str]], ratio: float, seed: int = 0) -> list[tuple[str, str]]:
    ranks = Ranks(seed)
    for i, (decision, name) in enumerate(windows):
        ranks.add(f"group_{i % 3}", decision, name)
    cut = ranks.cut(ranks.flights, ratio)
    return [(decision, name) for decision, name in windows if cut.keeps(decision, name)]


@given(
    counts=st.dictionaries(st.sampled_from(action_tokens()), st.integers(1, 60), min_size=1),
    ratio=st.sampled_from([0.01, 0.3, 1.0, 1.7, 20.0]),
    seed=st.integers(0, 3),
)
def test_each_decision_keeps_what_it_has_up_to_the_bound_in_any_order(counts, ratio, seed):
    windows = windows_of(counts)
    found = kept(windows, ratio, seed)
    most = max(1, int(ratio * len(windows) / len(counts)))
    assert Counter(decision for decision, _ in found) == {name: min(count, most) for name, count in counts.items()}
    assert set(kept(windows[::-1], ratio, seed)) == set(found)


def test_who_stays_at_a_low_bound_stays_at_a_higher_one():
    windows = windows_of({"track_straight": 100, "hover": 20})
    assert set(kept(windows, 0.2)) < set(kept(windows, 0.9))


def test_stray_decisions_do_not_take_the_others_with_them():
    counts = {"track_straight": 600, "yaw_left_to_follow": 390, "hover": 4, "slow_down": 3, "ascend": 2, "descend": 1}
    assert len(kept(windows_of(counts), 1.0)) == 166 + 166 + 10


def test_only_the_groups_that_are_asked_for_count():
    ranks = Ranks(0)
    for decision, name in windows_of({"track_straight": 4, "hover": 4}):
        ranks.add("train_1" if decision == "hover" else "val_1", decision, name)
    assert ranks.cut(["train_1"], 1.0).windows == {"hover": 4}


def test_the_cost_by_hand():
    ranks = Ranks(0)
    for decision, name in windows_of({"track_straight": 8, "hover": 2, "slow_down": 2}):
        ranks.add("group", decision, name)
    cost = cost_of(ranks.cut(["group"], 0.5), 12)
    assert (cost.most_windows, cost.samples_left_out) == (2, 12)
    assert cost.windows == {"hover": 2, "slow_down": 2, "track_straight": 8}
    assert cost.windows_left_out == {"track_straight": 6}
    # Before 1.5 ** (2 / 3) * 6 ** (1 / 3), then three of one size.
    assert cost.effective_decisions == (pytest.approx(2.38, abs=0.01), 3.0)
    assert set(cost.absent) == set(action_tokens()) - {"track_straight", "hover", "slow_down"}
    assert "left 6 of 12 training windows out (12 samples), at most 2 a decision: hover 2 -> 2, " in str(cost)


# --- so many and no more ----------------------------------------------------------------------------------------------

TABLES = st.dictionaries(
    st.sampled_from([f"flight_{i}" for i in range(12)]),
    st.dictionaries(st.sampled_from(action_tokens()[:6]), st.integers(1, 30), min_size=1),
    min_size=1,
)


def limited(table: dict[str, dict[str, int]], num_windows: int, seed: int = 0, ratio: float = 0.0):
    """Give the windows that stay, (flight, decision, name), and the limit."""
    ranks = Ranks(seed)
    windows = [(f, d, f"{f}_{d}_{i}") for f, counts in table.items() for d, n in counts.items() for i in range(n)]
    for window in windows:
        ranks.add(*window)
    cut = ranks.cut(table, ratio) if ratio else None
    limit = limit_to(ranks, num_windows, dict.fromkeys(table, cut))
    left = [window for window in windows if cut is None or cut.keeps(*window[1:])]
    return [window for window in left if limit is None or limit.keeps(*window)], left, limit


@given(TABLES, st.floats(0.0, 1.2), st.integers(0, 2), st.sampled_from([0.0, 0.5, 1.0]))
def test_a_limit_is_exact_and_each_decision_and_flight_has_its_share(table, part, seed, ratio):
    _, left, _ = limited(table, 0, seed, ratio)
    num_windows = int(part * len(left))
    kept, left, limit = limited(table, num_windows, seed, ratio)
    assert len(kept) == min(num_windows, len(left))
    assert (limit is None) == (num_windows >= len(left))
    share = len(kept) / len(left)
    for place, slack in ((1, 1.0), (0, 2.0)):
        before, after = (Counter(window[place] for window in found) for found in (left, kept))
        for name, count in before.items():
            assert abs(after[name] - share * count) <= slack + 1e-9, (name, count, after[name])


def test_a_limit_by_hand():
    table = {"a": {"hover": 60, "track_straight": 20}, "b": {"hover": 20}}
    kept, _, _ = limited(table, 10)
    assert Counter(window[:2] for window in kept) == {("a", "hover"): 6, ("a", "track_straight"): 2, ("b", "hover"): 2}
    assert set(kept) != set(limited(table, 10, seed=1)[0])
    assert set(kept) == set(limited(dict(reversed(table.items())), 10)[0])
