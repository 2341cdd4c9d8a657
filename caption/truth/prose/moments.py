"""When: the frames that the words leave no doubt of."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import NOW

# Of another moment, or of a part of the window.
_ELSEWHERE = {
    "en": re.compile(
        r"\b(?:was|were|had|from|before|earlier|after|first|then|start\w*|began|opened|previous\w*|last|until|since(?! the (?!start|first|last|begin)| its?\b| we\b| they\b| he\b| she\b| our\b| both\b)|once|peak\w*|mean|average|maximum|minimum|ago|step|steps|frames?|per|each|more|less|than|by|formerly|instead|rather|not|initial\w*|early|used to|did|against|versus|vs|as (?:high|low|fast|slow) as|for (?:an?|one|most|half))\b|\|"
    ),
    "zh": re.compile(
        r"不是|而非|先|曾|初|原|从|自(?!身|己)|由|起|回|步(?![速行伐频])|前(?!方|面)|后(?!方|面)|帧|峰|均|最|每(?!秒)|比|较|差|再|随|还|(?<![到至])了|(?<![已现])(?:升到|降到)(?!了)|增|减|\|"
    ),
}
_LATER = {
    "en": re.compile(
        r"\b(?:earlier|before|ago|previously|become|became|turned into|at first|initial\w*|in the|at the|was|were|had|per|each|less|more|than|then|later|until|since|steps|frames)\b|\|"
    ),
    "zh": re.compile(r"先|曾|初|原|前(?!方|面)|后(?!方|面)|帧|峰|均|每(?!秒)|比|较|差|再|随|起|\|"),
}
# What goes on with another moment: "1.3 m/s for three steps, then 3.2".
_THEN = {
    "en": re.compile(r"[\s,;]*(?:and |but |only )?(?:then|before|afterwards?|later|until|followed)\b"),
    "zh": re.compile(r"[\s,;]*(?:然后|随后|接着|后来|之后|再)"),
}
# What goes on with a later moment, however far on: "the drone moved at 1.8 m/s, 7 m away; then it shot up".
_THEN_LATER = {
    "en": re.compile(r"(?:[,;]|\band|\bbut) then\b"),
    "zh": re.compile(r"[,;](?:然后|随后|接着|后来|最后[^,;#]{0,3}又)"),
}
_NEXT = re.compile(r"\bthen\b|再|又")
_PAST = re.compile(
    r"(?<!has )(?<!have )(?<!been )(?<!is )(?<!are )\b(?!cent(?:re|ere)d|occluded|\w*speed|need|indeed|exceed)\w{2,}ed\b|\b(?:went|came|rose|fell|flew|ran|shot|made|took)\b|了"
)


_AFTER_CHANGE = re.compile(r"#\s*(?:米|度|m|°)之?后(?!,)")  # "爬升 2.3 米之后高度为 20.3 米"


class Moments:
    """The certain moments of one clause."""

    def __init__(self, sentence: Sentence, clause: Clause) -> None:
        self.sentence, self.clause = sentence, clause
        self.text, self.language = sentence.text, sentence.language

    def frames(self, numeral: Numeral, *, is_value: bool) -> tuple[int, ...] | None:
        """Give the frame of which a number surely is. is_value: it is no change, whatever else it may be."""
        frame = self.beside(numeral)
        if frame is None:
            frame = self._only_moment()
        if frame is None and not self.clause.of("time"):
            frame = self._headed_moment()
        if frame is not None:
            return (frame,)
        if self._is_aside_of_past():
            return None
        following = [n.start for n in self._measured() if n.start > numeral.start]
        after = following[0] if following else self.clause.end
        if _ELSEWHERE[self.language].search(_AFTER_CHANGE.sub("", self._without_todays(numeral))):
            return None
        if _LATER[self.language].search(self.text, numeral.end, after) or _THEN[self.language].match(self.text, after):
            return None
        if self.goes_on_after(numeral):
            return None
        for time in self.clause.of("time"):
            if _is_reached(time, numeral) or _AFTER_CHANGE.search(self.text, self.clause.start, time.end + 1):
                continue
            is_next = (bool(following) and time.end >= after - 2) or (
                time.start >= numeral.end and time.value in ("since", "past")
            )
            if time.start < after and not is_next and time.value not in self._todays(numeral):
                return None
        return (NOW,) if self._is_told_of_now(numeral, is_value=is_value) else None

    def is_some(self) -> bool:
        """Tell whether the clause tells of a moment before now without saying which: "the surge of 8.4 m/s is behind us"."""
        return _SOME_MOMENT.search(self.text, self.clause.start, self.clause.end) is not None

    def goes_on_after(self, numeral: Numeral) -> bool:
        """Tell whether the sentence tells of a later moment behind a number."""
        return _THEN_LATER[self.language].search(self.text, numeral.end) is not None

    def _without_todays(self, numeral: Numeral) -> str:
        """Give what stands before a number in its clause, without the words for its own moment."""
        part, at = "", self.clause.start
        for time in self.clause.of("time", *self._todays(numeral)):
            if at <= time.start and time.end <= numeral.start:
                part, at = part + self.text[at : time.start], time.end
        return part + self.text[at : numeral.start]

    def _measured(self) -> list[Numeral]:
        numerals = [self.sentence.numerals[i] for i in self.clause.numerals]
        times = self.clause.of("time", "some")  # "frame 4"
        return [
            n for n in numerals if n.unit not in ("s", "frames") and not any(t.start <= n.start < t.end for t in times)
        ]

    @staticmethod
    def _todays(numeral: Numeral) -> tuple[str, ...]:
        return ("now", "last_step") if numeral.unit == "mps" else ("now",)  # a speed is that of the step before it

    def _is_told_of_now(self, numeral: Numeral, *, is_value: bool) -> bool:
        """Tell whether a clause without a time speaks of now: it names its own quantity or owner, or nothing before it was of another time."""
        since = self.text.rfind(";", 0, self.clause.start) + 1
        if _FROM_THEN_ON.search(self.text, since, self.clause.start) and _REACHES.search(
            self.text, self.clause.start, numeral.start
        ):
            return False  # "from t3 on both sped up, the drone to 5.8 m/s": at some frame since
        before = [c for c in self.sentence.clauses if since <= c.start and c.end <= self.clause.start]
        if self.clause.has("time", *self._todays(numeral)):
            return True
        is_own = is_value and self.clause.has("quantity")
        if is_own:
            before = [c for c in before if c is self.sentence.clauses[0] or c.has("quantity") or not c.numerals]
        told = "" if is_own else self.text[since : self.clause.start]
        return all(_reaches_now(c) for c in before) and not _PAST.search(told)

    def beside(self, numeral: Numeral) -> int | None:
        match = _MOMENT_AFTER[self.language].match(self.text, numeral.end)
        if match is None and self.language == "en" and (nth := _NTH_AFTER.match(self.text, numeral.end)):
            return _frame_of(nth) if nth["of"] == "frame" or numeral.unit == "mps" else None
        match = match or _MOMENT_BEFORE[self.language].search(self.text, max(0, numeral.start - _REACH), numeral.start)
        if match is not None and _IS_OF_ANOTHER.search(self.text, 0, match.start()):
            match = None
        if match is None and (frame := self._told_after(numeral)) is not None:
            return frame
        if match is None:
            is_at = _IS_AT[self.language].search(self.text, self.clause.start, numeral.start) is not None
            is_now = is_at and not _AND_NEXT.match(self.text, numeral.end)
            return NOW if is_now and all(t.value == "now" for t in self.clause.of("time")) else None
        if self.language == "zh" and match.groupdict().get("first"):
            return 1 if numeral.unit == "mps" else 0
        return NOW if match["frame"] is None else int(match["frame"])

    def _told_after(self, numeral: Numeral) -> int | None:
        """Give the frame whose name follows a number: "8.0 m at the start", "3.8 m/s in the step before"."""
        if self.language == "zh":
            return None
        times = times_of(self.clause)
        near = [(t, frames) for t, frames in times if _BEHIND.fullmatch(self.text, numeral.end, t.start)]
        if len(near) != 1 or self.clause.has("link", "than"):
            return None
        frames = near[0][1]
        return frames[numeral.unit == "mps"] if len(frames) == 2 else frames[0]

    def _only_moment(self) -> int | None:
        """Give the one frame of a clause with one number: "at t1 the range still read 21.2 m"."""
        times = times_of(self.clause)
        if len(times) != 1 or len(times[0][1]) != 1 or len(self._measured()) != 1:
            return None
        number = self._measured()[0]
        if _NEXT.search(self.text, times[0][0].end, number.start):
            return None  # "at t3, then recovered to 3.2 m/s"
        spanning = [t for t in self.clause.of("time", *_SPANNING) if not _is_reached(t, number)]
        if spanning or self.clause.has("link", "than", "from", "between"):
            return None
        return times[0][1][0]

    def _is_aside_of_past(self) -> bool:
        """Tell whether a number alone in brackets may belong to where something came from: "from a near standstill (0.11 m/s) he ran"."""
        if self.clause.tokens or not self.text.startswith("(", max(0, self.clause.start - 1)):
            return False
        before = self.text.rfind(",", 0, self.clause.start) + 1
        return _CAME_FROM.search(self.text, before, self.clause.start) is not None

    def _headed_moment(self) -> int | None:
        """Give the frame under which a sentence stands: "t4 log: height 18.3 m, range 22.5 m"."""
        head = self.sentence.clauses[0]
        times = times_of(head)
        if (
            head.numerals
            or len(head.of("time")) != 1
            or len(times) != 1
            or len(times[0][1]) != 1
            or not self.text.startswith(":", head.end)
        ):
            return None
        return times[0][1][0]

    def span(self) -> tuple[int, int] | None:
        """Give the two frames between which a clause tells of a change."""
        spans = [_SPANS[t.value] for t in self.clause.of("time", *_SPANS)]
        named = [
            (t, frames[0])
            for t, frames in times_of(self.clause)
            if (len(frames) == 1 or t.value == "start") and frames != (NOW,) and t.value not in _SPANS
        ]
        before = [t.end for t in (*self.clause.of("time", "since"), *self.clause.of("link", "than"))]
        spans += [(frame, NOW) for t, frame in named if any(0 <= t.start - end <= 6 for end in before)]
        return spans[0] if len(set(spans)) == 1 and len(named) <= 1 else None


def _frame_of(nth: re.Match[str]) -> int:
    """Give the frame of "in the second step" or "frame"; a step is told at its end."""
    if nth["nth"] not in _ORDER:
        return NOW
    return _ORDER.index(nth["nth"]) + (nth["of"] == "step")


def _is_reached(time: Token, numeral: Numeral) -> bool:
    """Tell whether "up to" is to a number and not to a time: "已降到 17.8 米"."""
    return time.value == "until" and 0 <= numeral.start - time.end <= 1


def _reaches_now(clause: Clause) -> bool:
    """Tell whether a clause names no time that ends before now."""
    since = [t.end for t in clause.of("time", "since")]
    return all(
        t.value.partition(":")[0] in _TODAY
        or (t.value[0] == "t" and any(0 <= t.start - end <= 2 for end in since))
        or t.value == "since"
        for t in clause.of("time")
    )


_ORDER = ("first", "second", "third", "fourth")
_NTH_AFTER = re.compile(
    r"\s*(?:in|at|during|over) the (?P<nth>first|second|third|fourth|last|final|latest) (?P<of>step|frame)\b"
)
# "after 1.3 m/s at t2 only 0.19 is left", "t0 to t4: 0.19"
_IS_OF_ANOTHER = re.compile(r"#\s*(?:m/s|m|px|°|degrees) at $|\bt\d\s*(?:至|到|to|→|-|~)\s*$")
_SOME_MOMENT = re.compile(
    r"\bis (?:now )?behind us\b|\bhaving (?:touched|reached)\b|# px (?:up|down) to (?:\w+ )?#|\blast two steps (?:were|had)\b|\b(?:undone|taken back|cancelled out)\b|抵消"
)
_AND_NEXT = re.compile(r"\s*(?:and|,) then\b")
_IS_AT = {  # what a value has come to
    "en": re.compile(r"\b(?:is|are) (?:now |already |back )?(?:down|up) to (?:(?:only|just|about|roughly|some|a mere) )*$|\b(?:is|are) (?:(?:\w+ly|now|already|still|just|merely) )?\w+ing (?:again |along |on |away )?at (?:(?:only|just|about|roughly|some|a mere) )*$"),
    "zh": re.compile(r"已(?:经)?(?:提速?|升|降|减速?|放慢|加速|回落|收|缩|变|压|拉|涨|飞|走|跑|转)?(?:到|至|为|达)(?:了)?(?:约)?\s*$"),
}  # fmt: skip
_CAME_FROM = re.compile(r"\b(?:from|after|before|against)\b|从|自|由")
_FROM_THEN_ON = re.compile(r"[从自]\s*t\d\s*(?:起|开始|以后|之后)|\b(?:from|since) t\d\b")
_REACHES = re.compile(r"[到至](?:了)?\s*$|\b(?:to|reach\w*|hit\w*|touch\w*) $")
# Times that reach up to now: what goes on after them without a time is told of now.
_TODAY = ("now", "window", "last_step", "last_second", "last", "last_s", "mean")
_SPANS = {"last_step": (-2, NOW), "last_second": (-3, NOW)}
_MOMENT_BEFORE = {
    "en": re.compile(r"(?:\bt(?P<frame>\d)|\b(?P<now>now|currently))\s*(?::|=|at|is|was|of|stands at|stood at|reads|read|about|only|just|a)*\s*$"),
    "zh": re.compile(r"(?:t(?P<frame>\d)\s*(?:时|帧|时刻|处)?|(?P<now>现在|当前|目前|如今|此刻|眼下|这会儿|现|末帧|末步|这一步|最近一步|最后一步|最后一帧)|(?P<first>首帧|第一帧|起初|最初|开始时|窗口开始时))(?:的|之|所处|:|=|为|是|达到|达|约|只有|仅|曾|一度|还有|仍有|有|已|升到|升至|降到|降至|俯仰|高度|速度|相机|航向|又|分别|回到|落回|落到|回落到|回升到|的左偏|的右偏|剩|剩下|竟|\s)*$"),
}  # fmt: skip
_MOMENT_AFTER = {
    "en": re.compile(r"\s*(?:(?:to the |to )?(?:left|right|high|low|up|down)\s+(?=at t|in t))?(?:(?:\(|at |in |, at )?t(?P<frame>\d)(?!\s*(?:-|~|→|,? ?t\d|(?:to|and)\b\s*(?:at )?t\d))|(?P<now>now|at present|currently)\b(?! than))"),
    "zh": re.compile(r"\s*\(\s*t(?P<frame>\d)\s*时?\s*\)"),
}  # fmt: skip
_BEHIND = re.compile(r"\s*(?:(?:in|at|on|the|one|its|only|still)\s+)*")
_REACH = 30  # letters before a number in which its frame stands
_SPANNING = ("since", "until", "window", "last_step", "last_second", "max", "min", "mean")
