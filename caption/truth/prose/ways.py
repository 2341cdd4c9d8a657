"""Ways: a length that somebody covered, and whether it is that of the whole window."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import gap, times_of
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import NOW
from caption.truth.prose.sureness import Sureness

_PRONOUNS = {"he", "she", "they", "his", "her", "their", "他", "她"}  # of whoever was named last, a drone too
WAYS = {"travelled", "displacement", "target_travelled"}
_BESIDE = 10  # letters from a number to the word for a straight line that is its own
_PATH = re.compile(r"\b(?:path|track|trail|trajectory)\b|航程|里程|轨迹|路程|航迹")  # no straight line
_FLIES = re.compile(r"\b(?:flew|flown) (?:\w+ )?$|飞[了出过行]*约?\s*$")
_GOES = {
    "en": re.compile(r"\b(?:covers|covered|flew|flown|walked|strolled|put in|logged)(?: (?:a mere|only|just|about|some|roughly|all of))? $"),
    "zh": re.compile(r"(?:飞行|行走|行进|航行|飞出|走出|走|飞)(?:了|约|共)?\s*$|(?:总共|一共|合计|累计)\s*$"),
}  # fmt: skip
_GONE = re.compile(r"\s*(?:were |was )?(?:(?P<flown>flown)|walked)\b")  # "14.1 m flown against 1.4 m walked"
# The whole of what was seen, where ways are told.
_IN_ALL = {
    "en": re.compile(
        r"\b(?:altogether|all told|in all|in total|overall|so far|since (?:t0|the start)|from t0 to (?:t(?P<last>\d)|now)"
        r"|(?:in|over|across|during|throughout) (?:the )?(?:(?:whole|entire|full) \w+|window)|two seconds(?! (?:ago|earlier|before)))\b"
    ),
    "zh": re.compile(r"从?t0[到至]t(?P<last>\d)|一共|总共|共[飞走]|全程|累计|合计|总计|两秒|全窗|整个窗口|从头到尾"),
}


# A part of it, or something that is told beside it.
_IN_PART = {
    "en": re.compile(
        r"\b(?:steps?|frames?|half|seconds?|intervals?|legs?|stretch|instant|moment|since|after|until|first|last|latest|previous\w*|earlier|before|per|each|every|then|further|another|more|less|extra|additional|remain\w*|of which|between|would|will|if|than|behind|ahead|past)\b"
    ),
    "zh": re.compile(r"秒|步(?![行伐])|帧|半|段|每|起(?!点)|又|再|后|前|先|曾|还|多|少|差|剩|若|将|会|时"),
}


# A turn that is told from the window's start: its sum.
_FROM_START = re.compile(
    r"\b(?:start\w*|began|begun|datum|reference|original\w*|initial\w*|in all|in total|total|net|overall|altogether|cumulative|to date|where it (?:\w+ at t0|was|had been|stood|pointed))\b|起始|初始|起点|出发|基准|最初|累计|总共|一共|合计|净"
)
# The same, where nothing tells of a part of the window.
_SO_FAR = re.compile(
    r"\b(?:so far|two seconds|(?:over|within|in|across) the (?:whole |entire )?window|has (?:now |already |itself )?(?:turned|swung|come round|come around|rotated|drifted|veered|yawed|panned))\b|两秒|窗口内|全程|迄今|已向?[左右]?(?:转|偏|摆)"
)


class Ways:
    """The ways of one clause."""

    def __init__(self, sentence: Sentence, clause: Clause, sureness: Sureness) -> None:
        self.sentence, self.clause, self.sureness = sentence, clause, sureness
        self.text, self.language = sentence.text, sentence.language

    def end_of_all(self) -> tuple[int, ...] | None:
        """Give the last frame of a way that is told from the window's start: "from t0 to t4 she walked 2.0 m", "一共飞了 8.3 米"."""
        words = _IN_ALL[self.language].search(self.text, self.clause.start, self.clause.end)
        inside = {frames for _, frames in times_of(self.clause)} - {(0,), (0, 1), (NOW,)}
        is_alone = sum(self.sentence.numerals[i].unit == "m" for i in self.clause.numerals) == 1
        if words is None or not is_alone or self.clause.has("time", "last_step", "last_second"):
            return None
        last = (int(words["last"]),) if words["last"] else (NOW,)
        return None if inside - {last} else last

    def tells_part(self) -> bool:
        """Tell whether the sentence names the last step or the last second."""
        return any(clause.has("time", "last_step", "last_second", "last_s") for clause in self.sentence.clauses)

    def tells_all(self) -> bool:
        """Tell whether a sentence names no part of the window and no other moment than now: its ways are those of the whole."""
        told = _IN_ALL[self.language].sub("", self.text)
        return not _IN_PART[self.language].search(told) and not any(
            frames not in ((0,), (NOW,)) for clause in self.sentence.clauses for _, frames in times_of(clause)
        )

    def are_from_start(self) -> bool:
        """Tell whether a clause tells of turns from the window's start on."""
        if _FROM_START.search(self.text, self.clause.start, self.clause.end):
            return True
        return _SO_FAR.search(self.text, self.clause.start, self.clause.end) is not None and self.tells_all()

    def _named(self) -> set[str]:
        """Give those whom the sentence names, pronouns of the third person aside."""
        people = [t for clause in self.sentence.clauses for t in clause.of("who", "drone", "target")]
        return {t.value for t in people if self.text[t.start : t.end] not in _PRONOUNS or t.value == "drone"}

    def whole_way(self, numeral: Numeral, names: tuple[str, ...]) -> tuple[str, ...]:
        """Give whose way over the whole window a length is; () where it may be another length, or that of a part."""
        is_told = set(names) <= WAYS if names else _GOES[self.language].search(self.text[: numeral.start])
        if not is_told or numeral.unit != "m":
            return ()
        if self.sureness.is_in_group(numeral) or not self.tells_all():
            return ()
        people = self.clause.of("who", "drone", "target")
        named = {self.text[t.start : t.end] for t in people} - _PRONOUNS
        owners = {t.value for t in people}
        if goes := _GONE.match(self.text, numeral.end):
            owners = {"drone" if goes["flown"] else "target"}
        elif _FLIES.search(self.text, self.clause.start, numeral.start):
            owners = {"drone"}
        elif not people and (told := self.sureness.owners.gone_on_by(numeral)):
            owners = {told}
        elif not people and self._named() == {"drone"} and _PATH.search(self.text, self.clause.start, numeral.start):
            owners = {"drone"}
        elif len(owners) > 1 or not named:
            owners = {"drone", "target"}  # of somebody who may not be known
        ways = ["target_travelled"] if "target" in owners else []
        straight = [
            gap(t, numeral.start, numeral.end)
            for t in self.clause.of("quantity", "displacement")
            if t.start < numeral.start or not self.sureness.is_before_number(t)
        ]
        if "drone" in owners and min(straight, default=99) > _BESIDE:
            ways.append("travelled")
        if "drone" in owners and (straight or not _PATH.search(self.text, self.clause.start, self.clause.end)):
            ways.append("displacement")
        return tuple(ways)
