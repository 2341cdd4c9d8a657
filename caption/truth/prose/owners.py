"""Whose a number surely is: of the one named right beside it, or of its clause's or sentence's only subject."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import OBJECTS, Context, is_aimed_at
from caption.truth.prose.lexicon import Token
from caption.truth.prose.numerals import Numeral

LINK = {
    "en": re.compile(r"(?:[\s:=]|\bat t\d|\(t\d\)|is|was|are|of|at|now|currently|today|reads|stands|sits|holds|remains|stays|keeps|just|only|near|a mere|merely|still|a|an|steady|unchanged|constant|to (?:the )?(?:target|walker|subject|pedestrian|person|him|her|them)\b|(?:about|roughly|around|approximately|some|almost|nearly|exactly|again|back|down|up|to|throughout|all along|on the ground|over ground|along the ground)\b)*"),
    "zh": re.compile(r"(?:[\s:=]|t\d时?|为|是|仅|现|约|大约|只有|还有|仍有|目前|当前|现在|已|稳定|保持|维持|恒定|在|仍|有|达|到|回|升|降|至|了|一路|始终|一直|全程|均|都)*"),
}  # fmt: skip
# "20.5 m of ground distance", "16 m flown", "20.1 m straight down the line of sight"
BEHIND = re.compile(
    r"\s*(?:(?:(?:straight |directly )?(?:along|down|up) (?:the |our )|of (?:the |our )?|(?:was|were) (?:being )?))?"
)
_DOES = re.compile(
    r"\s*(?:is )?(?:doing|does|do|did|makes?|making|moves? at|moving at|fl(?:y|ies|ying) at|goes at|going at|walks? at|walking at|on)?\s*(?:about |only |just |a mere |some |still )*"
)
_GENITIVE = re.compile(
    r"(?:'s?|的)?\s*(?:own |current |present |ground |flight |forward |mean |average |walking |latest |recent |final |last |actual |momentary |当前|目前|平均|最新|末步)*"
)
# What a clause without a subject begins with when it goes on about the last one: "but is back to 3.2 m/s", "当前 2.3 米/秒".
GOES_ON = {
    "en": re.compile(r"(?:[\s,=:]|and|but|yet|now|currently|still|is|has|at|about|roughly|only|just|back|down|up|to|doing|making|going|moving|flying|walking|slowed|dropped|fallen|risen|settled|presently|today|then|holding|steady|stands|stayed|stays|remains|remained|reads|on|which|that|speed|minimum|maximum|low|high|peak|trough|of|a|mere|lazy|it|earlier|before|previously|once|at first|initially|having|been|as low as|as high as)*"),
    "zh": re.compile(r"(?:[\s,=:]|却|现在?|当前|目前|如今|此刻|已|仍|还|只|有|仅|达|约|为|是|回|升|降|落|减|增|到|至|速度|步速|了|起初|先前|之前|此前|原先|一开始|开头|曾|其间|期间|最[高低大小快慢远近]|首帧|首步|末帧|末步|起点|前一步|前一帧|上一步|上一帧|在|报|一直|始终|全程|停|稳|锁|定|维持|保持|都)*"),
}  # fmt: skip
_ITS_OWN = re.compile(r"\s*(?:for|by|of) (?:the |our )?|\s*\((?:the )?")  # "1.1 m/s for us", "1.2 m/s (walker)"
_OWNS = re.compile(r"[^,;)]{0,12}#")  # "(the walker 1.3 m/s)" is about another number
_SUBJECT = {
    "en": re.compile(r"[\s,]*(?:(?:and|while|but|the|our|a|an|now|so|then|meanwhile|as|at t\d|given|because|since|that|with|whereas|in|during|over)\b[\s,]*)*"),
    "zh": re.compile(r"[\s,]*(?:此刻|当前|目前|现在|而|且|但|同时|因为|由于|t\d\s*时?|最后一步|末步|,)*"),
}  # fmt: skip
_OTHER = {
    "en": re.compile(
        r"\b(?:than|against|versus|vs|over|past|round|around|behind|(?<!back )(?<!down )(?<!up )(?<!slowed )(?<!fallen )to|toward\w*|compared|you|your)\b"
    ),
    "zh": re.compile(r"比|较|于|与|和|对|你|您"),
}
_COMPARED = re.compile(r"\b(?:than|as) (?:the )?$|比$")


class Owners:
    """The owners of one clause's numbers."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.text, self.language = sentence.text, sentence.language

    def owner(self, numeral: Numeral) -> str:
        """Say whose a number is: of the one named right before it, or of its clause's or sentence's only subject."""
        return self.right_beside(numeral) or self._subject(numeral)

    def right_beside(self, numeral: Numeral) -> str:
        tokens = [t for c in self.sentence.clauses for t in c.tokens]
        people = [t for t in tokens if t.kind == "who" and t.value in ("drone", "target")]
        link = LINK[self.language]
        quantities = [
            t
            for t in tokens
            if t.kind == "quantity" and t.end <= numeral.start and link.fullmatch(self.text, t.end, numeral.start)
        ]
        ways = [t for t in tokens if t.kind == "quantity" and t.value == "travelled" and t.start >= numeral.end]
        for who in reversed(people):
            if any(_GENITIVE.fullmatch(self.text, who.end, t.start) for t in quantities if who.end <= t.start):
                return who.value
            is_subject = (
                who.end <= numeral.start
                and self.text[who.start : who.end] not in OBJECTS
                and not is_aimed_at(self.sentence, self.clause, who)
            )
            if is_subject and _COMPARED.search(self.text, 0, who.start) and ":" in self.text[who.end : numeral.start]:
                continue  # "faster than she was: 4.3 m/s"
            if is_subject and any(
                pattern.fullmatch(self.text, who.end, numeral.start) for pattern in (_GENITIVE, link, _DOES)
            ):
                return who.value
            if any(
                t.start == who.start and BEHIND.fullmatch(self.text, numeral.end, t.start) for t in ways
            ) and not _OWNS.match(self.text, who.end):
                return who.value  # "sixteen metres flown"
            if (
                who.start >= numeral.end
                and _ITS_OWN.fullmatch(self.text, numeral.end, who.start)
                and not _OWNS.match(self.text, who.end)
            ):
                return who.value
        return ""

    def _subject(self, numeral: Numeral) -> str:
        named = self.clause.of("who", "drone", "target")
        if len({t.value for t in named}) == 1 and named[0].end <= numeral.start:
            if self.clause.has("compare", "faster", "slower"):
                return ""  # "faster by 2 m/s"
            is_first = self.opens(named[0])
            return (
                named[0].value
                if is_first and not _OTHER[self.language].search(self.text, named[0].end, numeral.start)
                else ""
            )
        if named or self.text[: self.clause.start].endswith(("(", ":")) or self.context.is_carried:
            return ""
        if self.context.cue not in ("", "speed") or self.context.told not in ("", "speed"):
            return ""
        return self.gone_on_by(numeral)

    def gone_on_by(self, numeral: Numeral) -> str:
        """Give the only one of whom the sentence speaks, where a clause only goes on about them: "but is only 3 m from its start"."""
        quantity = next((t for t in self.clause.of("quantity", "displacement") if t.end <= numeral.start), None)
        at = self.clause.start  # "..., 净位移却仅 1.7 米": it begins with the quantity
        if quantity is not None and GOES_ON[self.language].fullmatch(self.text, at, quantity.start):
            at = quantity.end
        goes_on = GOES_ON[self.language].fullmatch(self.text, at, numeral.start)
        if not goes_on or self.context.is_carried:
            return ""
        if len(set(self.context.people)) == 1:
            return self.context.subject
        return self.named_alone_before()

    def named_alone_before(self) -> str:
        """Give the only one whom the clause before names, where this one goes on: "而行人几乎在挪步,只有 0.62 米/秒"."""
        before = [c for c in self.sentence.clauses if c.end <= self.clause.start]
        if not before or self.text[before[-1].end] != ",":
            return ""
        named = {t.value for t in before[-1].of("who", "drone", "target")}
        return named.pop() if len(named) == 1 else ""

    def opens(self, who: Token) -> bool:
        """Tell whether a clause begins with somebody, times and conjunctions aside."""
        at = self.clause.start
        for time in self.clause.of("time"):
            if (
                at <= time.start
                and time.end <= who.start
                and _SUBJECT[self.language].fullmatch(self.text, at, time.start)
            ):
                at = time.end
        return _SUBJECT[self.language].fullmatch(self.text, at, who.start) is not None
