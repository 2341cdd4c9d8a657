"""distill/prepare/choice.py: which windows stay."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosfly.products.actions import action_tokens
from distill.prepare.choice import Balance, WindowRanks, balance_of, keeps, limit_to


def windows_of(counts: dict[str, int]) -> list[tuple[str, str]]:
    """Name as many windows of each decision: (decision, sample_id)."""
    return [(decision, f"{decision}_{i}") for decision, count in counts.items() for i in range(count)]


def ranked(windows: list[tuple[str, str, str]], seed: int = 0) -> WindowRanks:
    ranks = WindowRanks(seed)
    for window in windows:
        ranks.add(*window)
    return ranks


def balanced(windows: list[tuple[str, str]], ratio: float, seed: int = 0) -> list[tuple[str, str]]:
    ranks = ranked([(f"group_{i % 3}", *window) for i, window in enumerate(windows)], seed)
    last_rank = balance_of(ranks, ranks.flights, ratio).last_rank
    return [window for window in windows if keeps(last_rank, seed, *window)]


@given(
    counts=st.dictionaries(st.sampled_from(action_tokens()), st.integers(1, 60), min_size=1),
    ratio=st.sampled_from([0.01, 0.3, 1.0, 1.7, 20.0]),
    seed=st.integers(0, 3),
)
def test_each_decision_keeps_what_it_has_up_to_the_bound_in_any_order(counts, ratio, seed):
    windows = windows_of(counts)
    found = balanced(windows, ratio, seed)
    most = max(1, int(ratio * len(windows) / len(counts)))
    assert Counter(decision for decision, _ in found) == {name: min(count, most) for name, count in counts.items()}
    assert set(balanced(windows[::-1], ratio, seed)) == set(found)


def test_stray_decisions_do_not_take_the_others_with_them():
    counts = {"track_straight": 600, "yaw_left_to_follow": 390, "hover": 4, "slow_down": 3, "ascend": 2, "descend": 1}
    assert len(balanced(windows_of(counts), 1.0)) == 166 + 166 + 10


def test_the_cost_by_hand():
    windows = windows_of({"track_straight": 8, "hover": 2, "slow_down": 2})
    cost = balance_of(ranked([("group", *window) for window in windows]), ["group"], 0.5).cost(12)
    # Effective decisions before: 1.5 ** (2 / 3) * 6 ** (1 / 3), then three of one size.
    assert cost.pop("effective_decisions") == [pytest.approx(2.38, abs=0.01), 3.0]
    assert set(cost.pop("absent")) == set(action_tokens()) - {"track_straight", "hover", "slow_down"}
    assert cost == {
        "ratio": 0.5, "most_windows": 2, "windows": {"hover": 2, "slow_down": 2, "track_straight": 8},
        "windows_left_out": {"track_straight": 6}, "samples_left_out": 12,
    }  # fmt: skip


@given(
    counts=st.dictionaries(st.sampled_from(action_tokens()), st.integers(1, 60), min_size=1),
    part=st.floats(0.0, 1.2),
    seed=st.integers(0, 2),
    ratio=st.sampled_from([0.0, 0.5, 1.0]),
)
def test_a_limit_is_exact_and_each_decision_has_its_share_in_any_order(counts, part, seed, ratio):
    """Half of the flights are cut first, as those of train are."""
    windows = [(f"flight_{i % 5}", *window) for i, window in enumerate(windows_of(counts))]

    def limited(windows: list[tuple[str, str, str]]) -> tuple[list, list, object]:
        ranks = ranked(windows, seed)
        train = [flight for flight in ranks.flights if flight < "flight_2"]
        balance = balance_of(ranks, train, ratio) if ratio and train else Balance(1.0, 1, {}, {})
        left = [one for one in windows if one[0] not in train or keeps(balance.last_rank, seed, *one[1:])]
        limit = limit_to(ranks, int(part * len(left)), train, balance)
        return [one for one in left if limit is None or keeps(limit, seed, *one[1:])], left, limit

    kept, left, limit = limited(windows)
    wanted = int(part * len(left))
    assert len(kept) == min(wanted, len(left))
    assert (limit is None) == (wanted >= len(left))
    before, after = (Counter(decision for _, decision, _ in found) for found in (left, kept))
    assert all(abs(after[name] - len(kept) / len(left) * count) < 1 for name, count in before.items())
    assert set(limited(windows[::-1])[0]) == set(kept)
