"""Random choices: all derive from (seed, stage, item), so none depends on worker count, order or resumption."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np


def rng_for(seed: int, stage: str, item_id: str) -> np.random.Generator:
    """Give the random generator of one item."""
    return np.random.default_rng(int.from_bytes(draws_for(seed, stage, item_id)[:16], "little"))


def draws_for(seed: int, stage: str, item_id: str) -> bytes:
    """Give 32 random bytes of one item: enough for a few choices, and made in a twentieth of a generator's time."""
    return hashlib.sha256(f"{seed}/{stage}/{item_id}".encode()).digest()


def draw_by_share(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Draw one of the names, each as likely as its share of the sum. The names' order does not matter; takes one draw.

    Raises:
        ValueError: a share is negative, or none is positive.
    """
    names = sorted(shares)
    weights = np.array([shares[name] for name in names], dtype=np.float64)
    if not ((weights >= 0).all() and weights.sum() > 0):
        raise ValueError(f"shares must not be negative and must add up to something positive: {dict(shares)}")
    ends = np.cumsum(weights)
    return names[int(np.searchsorted(ends, rng.random() * ends[-1], side="right"))]
