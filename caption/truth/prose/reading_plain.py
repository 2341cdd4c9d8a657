"""What a clause says of the whole window in set words, as statements: that a value is its largest, which way the target goes."""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.cues import TREND_SERIES, times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.statements import NOW

_LENGTHS = ("distance", "slant")
_BOX = ("box_height", "box_width", "box_area")
_SPEED = ("speed", "target_speed")  # narrowed to its owner's
# Superlative -> which end, and of what where its clause names no quantity.
_ENDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "largest": ("max", ()), "biggest": ("max", ()), "greatest": ("max", ()), "smallest": ("min", ()), "least": ("min", ()),
    "tallest": ("max", ("box_height",)), "shortest": ("min", ("box_height", *_LENGTHS)), "widest": ("max", ("box_width",)), "narrowest": ("min", ("box_width",)),
    "highest": ("max", ("altitude",)), "lowest": ("min", ("altitude",)), "fastest": ("max", _SPEED), "quickest": ("max", _SPEED), "slowest": ("min", _SPEED),
    "farthest": ("max", _LENGTHS), "furthest": ("max", _LENGTHS), "longest": ("max", _LENGTHS), "nearest": ("min", _LENGTHS), "closest": ("min", _LENGTHS),
    "高": ("max", ("altitude",)), "低": ("min", ("altitude",)), "矮": ("min", ("box_height",)), "大": ("max", ()), "小": ("min", ()), "远": ("max", _LENGTHS), "近": ("min", _LENGTHS),
    "快": ("max", _SPEED), "慢": ("min", _SPEED), "宽": ("max", ("box_width",)), "窄": ("min", ("box_width",)),
}  # fmt: skip
_RECORD = {
    "en": re.compile(
        rf"\b(?P<word>{'|'.join(word for word in _ENDS if word.isascii())})\b(?: \w+){{0,2}}?"
        r" (?:so far|yet|to date|of all|(?:of|among|in) (?:the |all |these |this |its |our |all the )?(?:whole |entire )?(?:#|four|five|window|sequence|series|clip|frames|steps)\b(?! frames? (?:at|is|was)))"
    ),
    "zh": re.compile(
        r"(?:五帧|四步|各帧|整段|全段|全程|整个窗口|窗口)(?:之中|之内|里面?|中|内|以来|来)?(?:数|的|它|他|她|现在|此刻|当前|都|属|是|算){0,3}最(?P<word>[高低矮大小远近快慢宽窄])(?![一两三几半后新的](?:帧|步|秒)|于)"
    ),
}
_GOES = {
    "en": re.compile(
        r"\b(?:walk|head|mov|go|run|stroll|jog|march|ambl|wander|cross|cut|pass|com|step|sprint|rac|trot|hurr|strid)\w*\b(?: (?!and|then|but|nose|turn)[a-z]+){0,4}?"
        r" (?:(?:to|towards?|into|over to|off to) (?:(?:the|its|our|his|her|their) )?(?P<to>left|right)\b(?! of| turn)|(?P<wards>left|right)wards?\b)"
        r"|\bfrom (?:left|right) to (?P<last>left|right)\b"
    ),
    "zh": re.compile(
        r"(?:[往向朝]|偏向)(?:画面|镜头|机头|无人机)?的?(?P<to>[左右])(?:前|后)?(?:方|侧|边)?(?:快步|慢慢|缓缓|继续)?(?:走|跑|移动|行进|横穿|横走|横着走|奔|去)"
    ),
}
_TURNING = ("yaw", "turn", "yaw_rate", "centre", "bearing")


class PlainReader(ClauseWords):
    """Reads the set words of one clause."""

    def read(self) -> None:
        if not self.is_plan and not self.in_scene:
            self._record()
            self._course()

    def _record(self) -> None:
        """ "the tallest so far", "五帧里最远": of the value that the clause tells of now."""
        match = _RECORD[self.language].search(self.text, self.clause.start, self.clause.end)
        if match is None or self.clause.is_blocked(match.start()) or any(f != (NOW,) for _, f in times_of(self.clause)):
            return
        token = Token("time", match["word"], match.start("word"), match.end("word"))
        if self.sentence.is_negated(self.clause, token) or self.clause.has("hedge", "about"):
            return
        end, names = _ENDS[match["word"]]
        names = self._told_of(token) or names
        if names == _SPEED:
            owner = self._owner(token)
            names = () if not owner else ("speed",) if owner == "drone" else ("target_speed",)
        if names:
            self._add(token, kind="record", names=names, word=end)

    def _told_of(self, token: Token) -> tuple[str, ...]:
        """Give the series that the clause names, or that was spoken of before; () for none."""
        cues = [t for t in self.clause.of("quantity") if t.value in TREND_SERIES or t.value in ("speed", "height")]
        cues = [t for t in cues if t.end <= token.start]
        cue = cues[-1].value if cues else self.context.cue
        if cue in ("box", "tall", "width"):
            return _BOX
        if cue == "speed":
            return _SPEED
        if cue == "height":
            return ("altitude", "box_height")
        return TREND_SERIES.get(cue, ())

    def _course(self) -> None:
        """ "walks off to the right": which way the target goes, as the drone sees it."""
        match = _GOES[self.language].search(self.text, self.clause.start, self.clause.end)
        if match is None or self.clause.is_blocked(match.start()) or self.clause.has("quantity", *_TURNING):
            return
        word = next(v for v in match.groupdict().values() if v)
        token = Token("side", word, match.start(), match.end())
        people = {t.value for t in self.clause.of("who", "drone", "target")}
        owner = "target" if people == {"target"} else self.context.subject if not people else self._owner(token)
        if owner != "target" or self.sentence.is_negated(self.clause, token):
            return
        self._add(token, kind="course_side", side=1 if word in ("left", "左") else -1)
