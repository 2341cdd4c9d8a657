"""Whether a numeral of a text is the size of a claim: the same number, a share of two, about, more or less than it."""

from __future__ import annotations

from collections.abc import Iterable

from caption.verification.numerals import Numeral
from caption.verification.stated import Stated, read_stated
from cosfly.formats.captions import Claim, Language

RATIO_SLACK = 0.13  # of shares and multiples in words: "a third" of 0.30 to 0.38
EXACT_PERCENT, ABOUT_PERCENT = 0.02, 0.06
MORE_SLACK = 0.45  # and on one side, where the text says "more than" or "less than"
ABOUT_SHARE, ROUND_SHARE = 0.02, 0.06  # how far "about 17 m" and "about 120 deg" reach
BOUND_SHARE = 0.12  # how far "more than 20 m" reaches


def same_size(numeral: Numeral, claim: Claim) -> bool:
    """Return whether a numeral is a claim's size, to the digits of the numeral."""
    value = float(claim.value)
    unit = claim.unit or ""
    if numeral.unit and unit and numeral.unit != unit and not may_mean(numeral.unit, unit):
        return False
    if numeral.kind == "ratio" and unit not in ("times", ""):
        return False
    if numeral.is_negative and value > 0:
        return False
    if numeral.kind == "one":
        return abs(abs(value) - 1.0) <= RATIO_SLACK
    if numeral.kind == "ratio":
        return abs(numeral.value - abs(value)) <= RATIO_SLACK * abs(value)
    slack = numeral.half if numeral.factor != 1.0 or numeral.digits < written_digits(value) else 0.0
    if numeral.is_about:
        slack = max(slack, about_share(numeral.value) * numeral.value)
    if numeral.bound and 0.0 <= numeral.bound * (abs(value) - numeral.value) <= BOUND_SHARE * numeral.value:
        return True
    return abs(numeral.value - abs(value)) <= slack + 1e-6


def numeral_of(sentence: str, claim: Claim, language: Language) -> Numeral | None:
    """Return the numeral by which a claim's number stands in its sentence, None where it does not."""
    found = [n for n in read_stated(sentence, language).numerals if n.kind == "number" and same_size(n, claim)]
    return max(found, key=lambda numeral: numeral.digits, default=None)


def about_share(value: float) -> float:
    """How far "about" reaches: farther from a number that is rounded to fives or tens."""
    return ROUND_SHARE if value >= 10 and value % 5 == 0 else ABOUT_SHARE


def may_mean(written: str, unit: str) -> bool:
    """Return whether a number written in one unit may be meant in another: people drop "per second"."""
    return (written, unit) in (("deg", "dps"), ("m", "mps"), ("times", "percent"))


def written_digits(value: float) -> int:
    """Digits after the point that a claim's number is written with."""
    return len(repr(value).partition(".")[2]) if value % 1 else 0


def ways(ratio: float, numeral: Numeral) -> list[float]:
    """Return a multiple of the drone's speed as a numeral may say it: of drone, target or either, and how much more or
    less that is."""
    if not numeral.about or ratio <= 0:
        return both_ways(ratio, numeral)
    said = ratio if numeral.about == "drone" else 1.0 / ratio
    return [said, abs(said - 1.0)]


def both_ways(ratio: float, numeral: Numeral | None = None) -> list[float]:
    """Return the shares and multiples by which a multiple is told, from either side; only the differences where a
    numeral is one."""
    if ratio <= 0:
        return [abs(ratio), abs(1.0 - ratio)]
    differences = [abs(ratio - 1.0), abs(1.0 / ratio - 1.0)]
    is_share_more = numeral is not None and numeral.is_difference and numeral.value < (100.0 if numeral.unit else 1.0)
    return differences if is_share_more else [ratio, 1.0 / ratio, *differences]


def is_share(numeral: Numeral, ratios: Iterable[float], stated: Stated) -> bool:
    """Return whether a share or multiple is one of these, or on the side of it that "more than" or "less than" says."""
    share = numeral.value / 100.0 if numeral.unit == "percent" else numeral.value
    if numeral.unit == "percent":
        slack = ABOUT_PERCENT if numeral.is_about else EXACT_PERCENT
    else:
        slack = RATIO_SLACK if numeral.kind == "ratio" or stated.is_approximate else 0.05
    low = share * (1.0 - slack - (MORE_SLACK if numeral.bound < 0 else 0.0)) - 0.01
    high = share * (1.0 + slack + (MORE_SLACK if numeral.bound > 0 else 0.0)) + 0.01
    return any(low <= ratio <= high for ratio in ratios)
