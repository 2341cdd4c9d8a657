"""Random numbers derived from (seed, stage, item), so that none depends on the workers, their order or a resume."""

import hashlib
from collections.abc import Iterator, Mapping
from itertools import count

import numpy as np

BLOCK = 8  # draws that are stratified together; with more, short sequences do not hold the shares any better
GOLDEN = 0.5 * (5**0.5 - 1)  # golden ratio - 1: multiples of it modulo 1 fill [0, 1) evenly and never repeat


def rng_for(seed: int, stage: str, item_id: str) -> np.random.Generator:
    """Return the random generator of one item."""
    return np.random.default_rng(int.from_bytes(random_bytes(seed, stage, item_id)[:16], "little"))


def random_bytes(seed: int, stage: str, item_id: str) -> bytes:
    """Return 32 random bytes of one item: enough for a few choices, in a twentieth of a generator's time."""
    return hashlib.sha256(f"{seed}/{stage}/{item_id}".encode()).digest()


def draw_smooth(num: int, num_axes: int, step_s: float, correlation_s: float, rng: np.random.Generator) -> np.ndarray:
    """Draw a stationary Gaussian process at times `step_s` apart, (num, num_axes), of mean 0 and variance 1.

    Its covariance is exp(-(t / correlation_s)^2 / 2): white noise, averaged with Gaussian weights.
    """
    spread = correlation_s / step_s / 2**0.5  # of the weights, in steps
    reach = int(np.ceil(4.0 * spread))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / spread) ** 2)
    weights /= np.linalg.norm(weights)
    noise = rng.normal(size=(num_axes, num + 2 * reach))
    return np.stack([np.convolve(row, weights, "valid") for row in noise], axis=1)


def draw_to_quota(shares: Mapping[str, float], rng: np.random.Generator) -> Iterator[str]:
    """Yield names endlessly in random order; after any number of draws each name is within three of its share.

    Each block of `BLOCK` draws takes one point from each of as many equal strata of [0, 1), in random order, and maps
    the points to names by the cumulative shares. The offset within the strata moves by GOLDEN from block to block. The
    first draws do not depend on how many follow.
    """
    names, cumulative = _cumulative(shares)
    start = rng.random()
    for block in count():
        points = (rng.permutation(BLOCK) + (start + block * GOLDEN) % 1.0) / BLOCK
        for index in np.searchsorted(cumulative, points * cumulative[-1], side="right").tolist():
            yield names[index]


def draw_by_share(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Return one name, each with the probability of its share; the order of the mapping has no effect."""
    names, cumulative = _cumulative(shares)
    return names[int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))]


def _cumulative(shares: Mapping[str, float]) -> tuple[list[str], np.ndarray]:
    """Return the sorted names, and the cumulative sums of their shares, (n,) float64."""
    names = sorted(shares)
    weights = np.array([shares[name] for name in names], dtype=np.float64)
    if not ((weights >= 0).all() and weights.sum() > 0):
        got = ", ".join(f"{name} {share:g}" for name, share in shares.items()) or "no share"
        raise ValueError(f"shares must not be negative, and their sum must be above 0; got {got}")
    return names, np.cumsum(weights)
