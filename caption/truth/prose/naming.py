"""Of what a number is: the series that it may be a value of, by the words beside it."""

from __future__ import annotations

import re

from caption.truth.prose.changing import MORE_THAN, ZH_MORE
from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, crossing, cues_of, names_of, owner_of, times_of
from caption.truth.prose.numerals import Numeral

_OF_FIRST = re.compile(r"(?:首帧|起始|初始|最初|t0时?)[^,;#]{0,4}[左右]侧$")
_IS_TURNED = re.compile(r"[偏转摆甩]了(?:约|大约|近)?\s*$")
# "17.5 m beneath us", "19.1 m above the walker": how much higher the drone is.
OVER_OTHER = re.compile(
    r"\s*(?:straight |directly |right |vertically )?(?:above|over|below|beneath|under|underneath|higher than|lower than)"
    r" (?:us|me|him|her(?! \w)|them|the (?:drone|aircraft|camera|craft|uav|walker|person|pedestrian|target|subject))\b(?!')"
    r"|\s*below(?=\s*(?:$|[.,;)]))"  # "10.6 m out and 22 m below"
)
# "4.0 m beneath t2", "0.3 m below that of the first frame": how much higher it is than then.
OVER_MOMENT = re.compile(
    r"\s*(?:above|over|below|beneath|under|higher than|lower than) (?:that of |that in |what it was |the value )?(?:at |in |of )?(?:the |our |its )?"
)
# "比画面中心低 49 像素": above or below it.
OFF_CENTRE = re.compile(
    r"比(?:画面|图像|镜头)?的?(?:中心|正中|中央|中点|画心)[点线]?(?:要|还|略|稍|偏|靠)*[高低上下](?:约|出|了)*\s*$"
)
_WAY_MORE = re.compile(r"[多少](?:走|飞)(?:出|了)?(?:约|大约)?\s*$")
_ON_ITS_WAY = re.compile(r"\s*(?:along|on|ahead|forward)\b")  # "3.6 m further along"
_CHANGED: dict[str, dict[str, tuple[str, ...]]] = {
    "m": {
        "closer nearer farther further 近 远": ("distance", "slant"),
        "higher lower 高 低": ("altitude", "height_over_target"),
    },
    "px": {"taller shorter higher 高": ("box_height",), "wider narrower 宽 窄": ("box_width",)},
}

_FROM_ORIGIN = re.compile(r"[离距](?:起点|出发点)的?(?:直线|水平)?距离[^#]{0,6}$")
_OF_NOSE = {  # before a number with a side, and after it: where somebody is or goes, against the drone's heading
    "en": (
        None,
        re.compile(
            r"\s*(?:off )?(?:to the |on the )?(?:left|right) of (?:where the drone|(?:the |our |its |my |that )?(?:drone's |camera's |aircraft's |own )*(?:-?#(?:\.#)?(?:°| degrees)? )?(?:heading|nose|camera axis|axis|optical axis|camera heading|course|boresight)\b)"
        ),
    ),
    "zh": (
        re.compile(r"比(?:机头|本机航向|航向)[^,;]{0,14}偏?[左右][^,;#]{0,4}$|(?<![始原初])(?:机头|航向)(?:方向)?的?[左右](?:侧|边|前方|后方|方)[^,;#]{0,4}$"),
        None,
    ),
}  # fmt: skip


class Naming:
    """The names of one clause's numbers."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.text, self.language = sentence.text, sentence.language

    def names(self, numeral: Numeral) -> tuple[tuple[str, ...], bool]:
        owner = owner_of(self.sentence, self.clause, numeral.start, numeral.end, self.context)
        named = self.clause.has("who", "drone", "target")
        in_brackets = self.text[: self.clause.start].endswith("(")
        if not named and (self.context.is_carried or (len(set(self.context.people)) == 2 and not in_brackets)):
            owner = ""
        if numeral.unit == "m" and OVER_OTHER.match(self.text, numeral.end):
            return ("height_over_target",), True
        if numeral.unit == "px" and OFF_CENTRE.search(self.text, 0, numeral.start):
            return ("offset_y",), True
        if self.differs_by_way(numeral):
            return ("way_difference",), True
        if self.over_moment(numeral) is not None:
            return ("altitude",), True
        cues = cues_of(self.sentence, self.clause, numeral, owner)
        if cues and not self.clause.has("who", "drone", "target") and cues[0].value in ("turn", "heading", "yaw_rate"):
            owner = ""
        if not cues and numeral.unit == "mps" and self.context.cue == "climb_rate" and not named:
            return names_of("climb_rate", "mps", owner), True
        if not cues and numeral.unit == "mps":
            climbs = any(c.has("trend", "alt_up", "alt_down") for c in self.sentence.clauses)
            return names_of("speed", "mps", owner) + (("climb_rate", "rate:altitude") if climbs else ()), True
        if not cues and numeral.unit == "deg" and owner == "target" and self.clause.has("bend"):
            return names_of("turn", "deg", owner), True
        if not cues and (self.context.cue or self.context.told):
            names = names_of(self.context.told, numeral.unit, owner) or names_of(self.context.cue, numeral.unit, owner)
            if names:
                return names + (("bearing",) if numeral.unit == "deg" and self.clause.has("side") else ()), True
        if not cues and numeral.unit == "deg" and self.clause.has("side"):
            return (*names_of("turn", "deg", ""), "bearing"), False
        if (
            numeral.unit == "deg"
            and self.clause.has("quantity", "yaw")
            and cues
            and cues[0].value in ("yaw", "turn", "heading")
        ):
            cues = [cue for cue in cues if cue.value not in ("turn", "heading")]  # of the drone, whoever else is named
            if self.clause.has("side") or self.clause.has("quantity", "turn"):
                return ("yaw",) if self._is_turned() else ("yaw", "bearing"), True
        found: tuple[str, ...] = ()
        for cue in cues:
            found += tuple(n for n in names_of(cue.value, numeral.unit, owner) if n not in found)
        return found, bool(found)

    def differs_by_way(self, numeral: Numeral) -> bool:
        """ "飞机比人多走了 0.3 米": by how much one way is longer than the other's."""
        if numeral.unit != "m" or self.language == "en" or not self.clause.has("link", "than"):
            return False
        people = {t.value for t in self.clause.of("who", "drone", "target")}
        return len(people) == 2 and _WAY_MORE.search(self.text, self.clause.start, numeral.start) is not None

    def over_moment(self, numeral: Numeral) -> int | None:
        """Give the frame above or below whose height a number tells to be now."""
        if numeral.unit != "m" or self.language == "zh":
            return None
        for time, frames in times_of(self.clause):
            if time.start >= numeral.end and OVER_MOMENT.fullmatch(self.text, numeral.end, time.start):
                return frames[0]
        return None

    def told_after(self, numeral: Numeral) -> tuple[str, ...]:
        """ "1.1 m closer", "0.8 m higher", "近了 1.1 米": the word for the change says of what."""
        if numeral.unit not in ("m", "px"):
            return ()
        if self.language == "en":
            match = MORE_THAN.match(self.text, numeral.end)
            word = match["word"] if match and not _ON_ITS_WAY.match(self.text, match.end()) else ""
        else:
            match = ZH_MORE.search(self.text[self.clause.start : numeral.start])
            word = match.group()[0] if match else ""
        for words, meant in _CHANGED[numeral.unit].items():
            if word and word in words.split():
                return meant
        return ()

    def _is_turned(self) -> bool:
        """Where the nose only points, the angle may be one to the target."""
        part = self.text[self.clause.start : self.clause.end]
        return self.clause.has("quantity", "turn") or re.search(r"yaw|psi|pan|slew|swivel|偏航|ψ|摇", part) is not None

    def differs_by(self, numeral: Numeral) -> bool:
        """ "快于目标 3 米/秒"."""
        before = self.text[: numeral.start]
        return re.search(r"(?:快|慢|高|低)(?:于|出|过)?[^#]{0,12}$", before) is not None or "相差" in before[-6:]

    def is_from_origin(self, numeral: Numeral) -> bool:
        return _FROM_ORIGIN.search(self.text, self.clause.start, numeral.start) is not None

    def is_of_height(self) -> bool:
        """Tell whether a clause without a quantity tells of a climb or descent: "the drone climbs about half a metre"."""
        vertical, apart = ("alt_up", "alt_down"), ("dist_up", "dist_down")
        clause = self.clause
        return not clause.has("quantity") and clause.has("trend", *vertical) and not clause.has("trend", *apart)

    def is_by_a_word(self, numeral: Numeral) -> bool:
        """Tell whether a quantity stands before a number, or behind it and no other: not "at 13.4 m with 5.9 m between us"."""
        cues = self.clause.of("quantity")
        return any(
            t.start < numeral.end or not crossing(self.sentence, self.clause, t, numeral.start, numeral.end)
            for t in cues
        )

    def is_of_first_heading(self, numeral: Numeral) -> bool:
        """Tell whether an angle is against the heading of the first frame: "首帧航向左侧 10°"."""
        return _OF_FIRST.search(self.text, self.clause.start, numeral.start) is not None

    def is_of_nose(self, numeral: Numeral) -> bool:
        """Tell whether an angle is where somebody is or goes, against the drone's heading."""
        if _IS_TURNED.search(self.text, self.clause.start, numeral.start):
            return False  # "机头朝右偏了 5.7°"
        before, after = _OF_NOSE[self.language]
        if before is not None:
            return before.search(self.text, self.clause.start, numeral.start) is not None
        return after is not None and after.match(self.text, numeral.end) is not None
