"""How groups of flights are handed out to the splits of a release: the rule that its record tells, for who builds one and who verifies it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from cosfly.products.splits import Split, assign_splits
from release.columns import SplitName

NAME_OF: dict[Split, SplitName] = {"train": "train", "val": "validation", "test": "test"}
SPLIT_RULE = (
    "whole walks (a walk: flights of one town, in any of its builds, whose person is at the same places at the same seconds), or whole towns; ranked "
    "by sha256 of the seed and the name, the first to test, the next to validation, the rest to train, one at least for each split that has a share; "
    "fewer than splits fill train, then validation"
)


def split_groups(
    groups: Iterable[str], fractions: Mapping[SplitName, float], seed: int, what: str
) -> dict[str, SplitName]:
    """Give each group, a walk or a family of towns, its split. Those of which no flight is released are not among them, and have no rank.

    Raises:
        InputError: there is no group; names `what` is missing.
    """
    shares: dict[Split, float] = {"val": fractions["validation"], "test": fractions["test"]}
    splits = assign_splits(groups, shares, seed, too_few="fill", what=what)
    return {group: NAME_OF[split] for group, split in splits.items()}
