"""Two speeds that a sentence sets against each other."""

from __future__ import annotations

import re
from itertools import pairwise

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.numerals import Numeral

_BOTH = re.compile(r"\b(?:speeds|paces|both|each other|the two)\b|两者|二者|彼此|双方")
_VERSUS = {
    "en": re.compile(r"[\s,]*(?:against|versus|vs\.?|compared (?:with|to)|and|/|to (?=our|their|his|her|its|the|walker|drone|target))\s*(?:about |only |just )?(?:for )?(?:(?:our|their|his|her|the|a|own|(?:walker|drone|target|pedestrian|person|subject|aircraft|uav)(?:'s)?)\s*)*"),
    "zh": re.compile(r"\s*(?:对|比|vs|和|与|、|/)\s*(?:约|行人的?|目标的?|他的?|对方的?|无人机的?|本机的?)?\s*"),
}  # fmt: skip


_AGAINST_ONE = re.compile(
    r"\b(?:against|versus|vs\.?) (?:the )?(?:our|his|her|their|(?:walker|drone|target|pedestrian|person|subject|aircraft|uav)'s)\b"
)


def pairs_of_speeds(sentence: Sentence, clause: Clause) -> list[tuple[Numeral, Numeral]]:
    """Give the pairs of speeds that a sentence sets against each other: "1.2 against 1.4 m/s", "1.2 对 1.4 米/秒"."""
    numerals = sentence.numerals
    if sum(n.unit in ("mps", "") for n in numerals) < 2:
        return []
    near = [c for c in sentence.clauses if c is clause or (c.end == clause.start - 1 and sentence.text[c.end] in "(:,")]
    owners = {t.value for c in near for t in c.of("who", "drone", "target")}
    if any(t.value not in ("now", "last_step", "mean") for c in near for t in c.of("time")):
        return []
    groups = [n.group for n in numerals]
    is_told = any(owners_behind(sentence, clause))
    is_told = is_told or _BOTH.search(sentence.text, near[0].start, clause.end) is not None
    is_told = is_told or _AGAINST_ONE.search(sentence.text, clause.start) is not None
    if len(owners) < 2 and not is_told and not any(c.has("compare", "faster", "slower") for c in sentence.clauses):
        return []
    return [
        (a, b)
        for a, b in pairwise(numerals)
        if a.unit in ("mps", "")
        and b.unit == "mps"
        and groups.count(a.group) <= 2
        and _VERSUS[sentence.language].fullmatch(sentence.text, a.end, b.start)
    ]


def owners_behind(sentence: Sentence, clause: Clause) -> list[str]:
    """Give the two owners that stand alone in brackets behind a clause."""
    if not sentence.text.startswith("(", clause.end):
        return ["", ""]
    end = sentence.text.find(")", clause.end)
    inside = [t.value for c in sentence.clauses if clause.end < c.end <= end for t in c.of("who")]
    return inside if set(inside) == {"drone", "target"} and len(inside) == 2 else ["", ""]
