"""What the claims of one sentence say: their numbers, the shares and multiples that follow, and the opposites that they
stand for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations

from caption.verification.borne_out import bears_out_number
from caption.verification.facts import Facts
from caption.verification.glossary import LANGUAGES
from caption.verification.numerals import Numeral, numbers_in
from caption.verification.poles import Pair, poles_between, poles_of, side_word
from caption.verification.references import QUANTITIES, TURNING, Fact, look_up, parse_reference
from caption.verification.sizes import both_ways, is_share, same_size, ways
from caption.verification.stated import Pole, Stated, read_stated
from cosfly.formats.captions import Claim, Language

HOUR_DEG = 30.0
HOUR_SLACK_DEG = 20.0  # an hour of the clock is told by eye
SCENE = "scene"
IN_ANY_WORDS = (0.0, 0.5, 1.0, 1.5, 2.0)  # "half a second", "a bench", "both": said in too many ways to be looked for
SAME_MPS = 0.015  # speeds that are printed alike
SPEEDS = {"speed", "target_speed"}


def frames_of(claim: Claim) -> Iterator[int]:
    """Return the observed frames that a claim is of, 0 the first; none where it names no frame."""
    reference = parse_reference(f"speed@{claim.at}") or parse_reference(f"change:speed@{claim.at}")
    if reference is not None and reference.first is not None:
        yield from range(reference.first, (reference.last or reference.first) + 1)


def _is_expected(claim: Claim, pole: Pair) -> bool:
    """Return whether a sentence with a claim in words is likely to have this word of it."""
    if claim.modality != "observed":
        return pole[0] == "side" and claim.modality == "predicted"
    return pole[0] != "bend" or claim.quantity.rpartition(":")[2] in TURNING


class Said:
    """The claims of one sentence: their numbers, and the opposites that they stand for."""

    def __init__(self, claims: Sequence[Claim], facts: Facts, language: Language) -> None:
        self.facts, self.language = facts, language
        self.claims = [claim for claim in claims if claim.quantity != SCENE]
        self.scene = [str(claim.value) for claim in claims if claim.quantity == SCENE]
        self.numbers = [claim for claim in self.claims if isinstance(claim.value, float)]
        self.words = [claim for claim in self.claims if isinstance(claim.value, str)]
        self.is_scenery = bool(self.scene) and not self.claims
        self.has_plan = any(claim.modality != "observed" for claim in self.claims)
        self.poles: set[Pair] = set()
        self.observed: set[Pair] = set()
        for claim in self.claims:
            self.poles.update(self.poles_of(claim))
            if claim.modality == "observed":
                self.observed.update(self.poles_of(claim))
        self.worded = {pole for claim in self.words for pole in self.poles_of(claim) if _is_expected(claim, pole)}
        between = set(poles_between(self.numbers))
        self.poles |= between
        self.observed |= between
        kinds = {(claim.unit, claim.quantity.rpartition(":")[2]) for claim in self.numbers}
        units = [unit for unit, _ in kinds]
        self.compares = len(set(units)) < len(units) or any("comparison" in claim.quantity for claim in self.words)
        for text in self.scene:
            for either in LANGUAGES:
                self.poles.update((pole.dimension, pole.value) for pole in read_stated(text, either).poles)

    def poles_of(self, claim: Claim) -> set[Pair]:
        return poles_of(claim)

    def names_frames(self, pole: Pole) -> bool:
        """Return whether a claim of visibility is of a frame that stands beside a word of it."""
        return any(c.quantity == "visibility" and pole.frames.intersection(frames_of(c)) for c in self.words)

    def denies_frames(self, pole: Pole) -> bool:
        """Return whether claims of the frames that stand beside a word of visibility say another."""
        of_frames = [c for c in self.words if c.quantity == "visibility" and pole.frames.intersection(frames_of(c))]
        return bool(of_frames) and not any(("visibility", pole.value) in self.poles_of(claim) for claim in of_frames)

    def covers_numeral(self, numeral: Numeral, stated: Stated) -> bool:
        if numeral.kind == "clock":
            return self._covers_hour(numeral.value)
        if numeral.kind == "one" or any(same_size(numeral, claim) for claim in self.numbers):
            return True
        is_share_of = numeral.kind == "ratio" or numeral.unit == "percent"
        if self._is_of_scene(numeral):  # a share of what was measured is none of the scene
            return not is_share_of or self.is_scenery or bears_out_number(numeral, self.facts)
        if is_share_of:
            is_all = (
                numeral.unit == "percent"
                and numeral.value in (0, 100)
                and any(of == "visibility" for of, _ in self.poles)
            )
            return is_all or is_share(numeral, self._ratios(numeral), stated)
        is_steady = any(pole.dimension == "trend" and pole.value == "steady" for pole in stated.poles)
        return numeral.unit == "px" and numeral.value == 1 and is_steady  # "not by a single pixel"

    def _is_of_scene(self, numeral: Numeral) -> bool:
        if numeral.unit in ("px", "") and numeral.value in (self.facts.width_px, self.facts.height_px):
            return True  # the size of the picture
        return any(
            numeral.text in text
            or _number_in(text) == numeral.value * (100.0 if numeral.kind == "ratio" else 1.0)
            or _number_in(text) == numeral.value
            or numeral.text.split()[0].lower() in text.lower().split()
            for text in self.scene
        )

    def _covers_hour(self, hour: float) -> bool:
        angle = -(hour % 12) * HOUR_DEG
        angle = angle + 360.0 if angle < -180.0 else angle
        for claim in self.claims:
            name = claim.quantity.rpartition(":")[2]
            if name == "bearing" and isinstance(claim.value, float):
                apart = abs((angle - claim.value + 180.0) % 360.0 - 180.0)
                if apart <= HOUR_SLACK_DEG:
                    return True
            elif name in ("bearing", "offset_x"):
                value = claim.value if isinstance(claim.value, str) else side_word(name, claim.value)
                side = "left" if 0 < angle < 180 else "right" if -180 < angle < 0 else "centred"
                if value == side or (side == "centred" and value in ("straight", "centred")):
                    return True
        return any("clock" in text or "点" in text or _number_in(text) == hour for text in self.scene)

    def _ratios(self, numeral: Numeral) -> list[float]:
        """Return the shares and multiples that a numeral may be, by the claims: of a growth, of two speeds, of two
        values of a quantity."""
        found = [r for ratio in self._speed_ratios() for r in ways(ratio, numeral)]
        multiples = [1.0 + float(claim.value) / 100.0 for claim in self.numbers if claim.unit == "percent"]
        spanned = [claim for claim in self.numbers if claim.quantity.startswith("change:")]
        multiples += [m for c in (*spanned, *self.words) if (m := self._multiple(c)) is not None]
        for one, other in combinations(self.numbers, 2):
            is_pair = (
                one.unit == other.unit
                and (":" in one.quantity) == (":" in other.quantity)
                and one.unit not in ("times", "percent")
                and one.value
                and other.value
            )
            if is_pair and {one.quantity, other.quantity} != SPEEDS:
                multiples.append(abs(float(one.value) / float(other.value)))
        return found + [r for multiple in multiples for r in both_ways(multiple, numeral)]

    def _speed_ratios(self) -> list[float]:
        """Return the multiples of the target's speed that the drone's is, by the claims."""
        found = [abs(float(claim.value)) for claim in self.numbers if claim.unit == "times"]
        for claim in self.words:
            if claim.quantity == "comparison:speed":
                found += _speed_ratios(self.facts, claim)
        for one, other in permutations(self.numbers, 2):
            if (one.quantity, other.quantity) == ("speed", "target_speed") and other.value:
                found.append(abs(float(one.value) / float(other.value)))
        return found

    def _multiple(self, claim: Claim) -> float | None:
        """Return what a quantity has become of its first value, where a change or a trend of it is claimed."""
        aspect, _, name = claim.quantity.partition(":")
        reference = parse_reference(f"growth:{name}" + (f"@{claim.at}" if claim.at else ""))
        fact = look_up(reference, self.facts) if reference and aspect in ("change", "trend") else None
        return None if not isinstance(fact, Fact) or isinstance(fact.value, str) else 1.0 + fact.value / 100.0

    def is_written(self, claim: Claim, stated: Stated) -> bool:
        """Return whether a claim's number stands in the text as it is; a share or a multiple in any of its forms."""
        value = float(claim.value)
        if value == 0 or claim.quantity.endswith("bearing"):
            return True  # "dead ahead", "no change", "twelve o'clock": checked as words
        if any(same_size(numeral, claim) for numeral in stated.numerals if numeral.kind != "clock"):
            return True
        if claim.unit not in ("times", "percent"):
            return False
        shares = [n for n in stated.numerals if n.kind == "ratio" or n.unit in ("percent", "times")]
        if claim.unit == "times":
            shares += [n for n in stated.numerals if not n.unit and n.digits and not self.covers_numeral(n, stated)]
            return not shares or any(is_share(numeral, ways(abs(value), numeral), stated) for numeral in shares)
        multiple = 1.0 + value / 100.0
        return not shares or any(is_share(numeral, both_ways(multiple, numeral), stated) for numeral in shares)

    def absent_scenery(self, stated: Stated) -> Iterator[str]:
        """Yield the numbers that are claimed of the scene and do not stand in the sentence, in digits or in words."""
        written = {value for n in numbers_in(stated.text, self.language) for value in (n, 100.0 * n, 10.0 * n)}
        for text in self.scene:
            value = _number_in(text)
            if value is not None and value not in IN_ANY_WORDS and not any(abs(value - w) <= 0.1 * w for w in written):
                yield text

    def implied_by(self, claim: Claim) -> Iterator[Claim]:
        """Yield what a writer may give in a claim's place: the ends of a change, the change between two values."""
        aspect, _, name = claim.quantity.rpartition(":")
        frames = sorted(set(frames_of(claim)))
        if name not in QUANTITIES or not frames:
            return
        if aspect:
            meant = [(name, f"t{frame}") for frame in (frames[0], frames[-1])]
        else:
            others = {frame for one in self.numbers if one.quantity == name for frame in frames_of(one)} - {frames[0]}
            spans = [f"t{min(other, frames[0])}-t{max(other, frames[0])}" for other in others]
            meant = [(f"{of}:{name}", span) for span in spans for of in ("change", "rate", "growth")]
        for quantity, at in meant:
            reference = parse_reference(f"{quantity}@{at}")
            fact = look_up(reference, self.facts) if reference else None
            if isinstance(fact, Fact) and not isinstance(fact.value, str):
                yield claim.model_copy(
                    update={"quantity": quantity, "at": at, "value": float(fact.value), "unit": fact.unit}
                )

    def turned_comparisons(self) -> Iterator[str]:
        """Yield the comparisons of the two speeds that the target's speed of the same sentence contradicts."""
        for claim in self.words:
            theirs = [float(one.value) for one in self.numbers if one.quantity == "target_speed" and one.at == claim.at]
            if claim.quantity != "comparison:speed" or claim.modality != "observed" or not theirs:
                continue
            frame = next(frames_of(claim), len(self.facts) - 1)
            ours = self.facts.speed_mps[frame] if frame < len(self.facts) else None
            if ours is None or claim.value == "matching":
                continue
            if (ours - theirs[0] > 0.0) != (claim.value == "faster") or abs(ours - theirs[0]) < SAME_MPS:
                yield f"{claim.quantity} {claim.value}"


def _speed_ratios(facts: Facts, claim: Claim) -> list[float]:
    frames = list(frames_of(claim)) or [len(facts) - 1]
    found = []
    for frame in frames:
        ours = facts.speed_mps[frame] if frame < len(facts) else None
        theirs = [
            facts.target_speed_mps,
            facts.target_speeds_mps[frame] if facts.target_speeds_mps and frame < len(facts) else None,
        ]
        found += [ours / speed for speed in theirs if ours and speed]
    return found


def _number_in(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
