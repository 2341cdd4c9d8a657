"""Random choices: every generator derives from (seed, stage, item)."""

from __future__ import annotations

import hashlib

import numpy as np


def rng_for(seed: int, stage: str, item_id: str) -> np.random.Generator:
    """Give the random generator of one item: independent of worker count, order and resumption."""
    digest = hashlib.sha256(f"{seed}/{stage}/{item_id}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "little"))
